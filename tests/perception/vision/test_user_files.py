"""Films as phones write them, and boards as people have them: HEVC, rotation flags, uneven times, chessboards, shutters."""

import subprocess

import numpy as np
import pytest
from board_films import board_film

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.perception.markers.calibration import CHESSBOARD, LEGACY, Board, Readout, calibrate, calibrate_film
from wlr_gym.perception.markers.camera import Camera, load_camera
from wlr_gym.perception.vision.video import Frames, VideoFile

LENS = Camera(width=640, height=480, focal=(620.0, 615.0), centre=(325.0, 236.0))
COUNT = 10
CODECS = {
    "h264": ["-c:v", "libx264", "-pix_fmt", "yuv420p"],
    "hevc": ["-c:v", "libx265", "-pix_fmt", "yuv420p10le", "-tag:v", "hvc1", "-x265-params", "log-level=none"],
}
BOARDS = {
    "chess": Board(6, 5, 0.04, CHESSBOARD),
    "few": Board(5, 4, 0.045),
    "many": Board(12, 9, 0.02, dictionary="4X4_100"),
    "legacy": Board(9, 6, 0.028, LEGACY, marker=0.02),
}


@pytest.fixture(scope="module")
def ffmpeg():
    return pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()


def pictures():
    """Grey pictures with a bright upper left corner, each brighter than the last."""
    shown = np.full((COUNT, 96, 160), 60, np.uint8) + 10 * np.arange(COUNT, dtype=np.uint8)[:, None, None]
    shown[:, :32, :48] = 230
    return shown


def written(ffmpeg, path, codec, *options):
    command = [ffmpeg, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "gray", "-s", "160x96", "-r", "30", "-i", "-"]
    subprocess.run([*command, *CODECS[codec], *options, str(path)], input=pictures().tobytes(), check=True)
    return path


@pytest.mark.parametrize("codec", ["h264", "hevc"])
@pytest.mark.parametrize("held", [0, 90, 180, 270])
def test_a_phones_film_is_read_as_its_sensor_saw_it(codec, held, ffmpeg, tmp_path):
    """HEVC with 10 bits, and notes on how the phone was held: the same pictures as of a camera that stood upright."""
    plain, noted = written(ffmpeg, tmp_path / "plain.mov", codec), tmp_path / "noted.mov"
    turn = ["-display_rotation", str(held), "-i", str(plain), "-c", "copy", str(noted)]
    subprocess.run([ffmpeg, "-loglevel", "error", *turn], check=True)
    found = list(Frames(str(noted)))
    assert len(found) == COUNT
    for frame, truth in zip(found, pictures(), strict=True):
        assert frame.image.shape == truth.shape
        assert np.abs(frame.image.astype(int) - truth)[4:-4, 4:-4].mean() < 3
        assert frame.image[8, 8] > 200


def test_photographs_are_read_as_the_sensor_saw_them(tmp_path):
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = 6  # turned by 90 degrees
    Image.fromarray(pictures()[0]).save(tmp_path / "photo.jpg", exif=exif, quality=95)
    frame = next(Frames(str(tmp_path)))
    assert frame.image.shape == (96, 160)
    assert frame.image[8, 8] > 200


def test_a_variable_rate_is_followed(ffmpeg, tmp_path):
    """After the fifth picture every other one is left out, as phones do in the dark."""
    uneven = ["-vf", "setpts='if(gt(N,5),N*2,N)/30/TB'", "-fps_mode", "vfr"]
    found = list(Frames(str(written(ffmpeg, tmp_path / "film.mp4", "h264", *uneven))))
    assert [frame.time for frame in found] == pytest.approx([(2 * k if k > 5 else k) / 30 for k in range(COUNT)], abs=1e-3)


# --- calibration --------------------------------------------------------------------------------------------------


def named(film):
    return ((f"frame {frame.index}", frame.time, frame.image) for frame in film)


@pytest.mark.parametrize("readout", [0.018, *(pytest.param(value, marks=pytest.mark.slow) for value in (0.0, -0.012))])
def test_a_film_of_a_moving_board_tells_the_shutter(readout):
    camera, told = calibrate_film(named(board_film(Board(), LENS, readout, 150)), Board(), 8)
    assert told.std < 3e-4
    assert abs(told.value - readout) < 4 * told.std
    assert camera.readout == pytest.approx(readout, abs=1e-3 if readout else 0.0)
    assert camera.focal == pytest.approx(LENS.focal, rel=0.003)
    assert camera.centre == pytest.approx(LENS.centre, abs=2.0)
    assert camera.quality is not None
    assert camera.quality.rms < 0.1  # what the shutter moves is off the corners, too


@pytest.mark.slow
def test_a_board_that_stands_in_every_view_does_not_tell_the_shutter():
    """Its places are those of a moving one, each held for three frames."""
    film = [frame for frame in board_film(Board(), LENS, 0.0, 150) if frame.index % 9 == 0]
    held = [(f"frame {3 * k + i}", (3 * k + i) / 30, f.image) for k, f in enumerate(film) for i in range(3)]
    camera, told = calibrate_film(held[1:], Board(), 3)  # frames before and after a view show the same
    assert told.known is None
    assert camera.readout is None


def test_what_is_known_of_a_readout():
    assert Readout().known is None
    assert Readout(0.02, 0.0004).known is None
    assert Readout(0.2, 0.0001).known is None
    assert Readout(0.02, 0.0001).known == 0.02
    assert Readout(-0.02, 0.0001).known == -0.02
    assert Readout(0.0009, 0.0001).known == 0.0


@pytest.mark.parametrize("name", BOARDS)
def test_boards_of_any_size_calibrate(name):
    board = BOARDS[name]
    views = [(f"view {frame.index}", frame.image) for frame in board_film(board, LENS, 0.0, 20, 2.0)]
    found = calibrate(views, board)
    assert found.focal == pytest.approx(LENS.focal, rel=0.006)
    assert found.centre == pytest.approx(LENS.centre, abs=4.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Board(3, 3), r"3 x 3 squares has 4 inner corners; at least 6"),
        (lambda: Board(17, 13), "has 110 markers, but dictionary 5X5_100 has 100"),
        (lambda: Board(dictionary="5X5_10"), r"unknown dictionary '5X5_10' \(did you mean '5X5_100'"),
        (lambda: Board(marker=0.03), "expected more than 0 and less than a square"),
        (lambda: Board(kind="chess"), "did you mean 'chessboard'"),
    ],
)
def test_boards_that_cannot_be_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.slow
def test_command_writes_the_readout_into_the_camera_file(tmp_path, capsys):
    film = tmp_path / "board.avi"
    with VideoFile(film, "FFV1", 30.0) as video:
        for frame in board_film(Board(), LENS, 0.018, 90):
            video.write(frame.image)
    words = ["calibrate", "camera", str(film), "--out", str(tmp_path / "camera.yaml"), "--every", "5"]
    assert main(words) == 0
    assert "rolling shutter: 1" in capsys.readouterr().out
    found = load_camera(tmp_path / "camera.yaml")
    assert found.readout == pytest.approx(0.018, abs=0.0015)
    assert found.quality is not None
    assert found.quality.readout_std is not None
    assert main([*words, "--readout", "0", "--force"]) == 0
    assert load_camera(tmp_path / "camera.yaml").readout == 0.0
    assert main([*words, "--readout", "18", "--force"]) == 2
    refusal = "--readout 18: expected more than -0.1 and less than 0.1 s (20 ms = 0.02)"
    assert refusal in capsys.readouterr().err.replace("\n", "")
