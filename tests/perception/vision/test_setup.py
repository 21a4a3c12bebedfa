"""What is printed and configured: sheets to scale, calibration, target and camera files, frames, commands."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from studies.bench.__main__ import main as bench
from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.perception.markers.calibration import calibrate
from wlr_gym.perception.markers.camera import Camera, load_camera, save_camera
from wlr_gym.perception.markers.detection import detect
from wlr_gym.perception.markers.targets import load_target
from wlr_gym.perception.scene import Facet, Look, Renderer, ScenePose, rotation_of
from wlr_gym.perception.vision.sheets import Board, board_page, target_pages, write_pages
from wlr_gym.perception.vision.tracking import Sample, VideoFrame
from wlr_gym.perception.vision.video import AnnotatedVideo, Frames, VideoFile, annotate, film

TRUE = Camera(width=640, height=480, focal=(620.0, 615.0), centre=(325.0, 236.0), distortion=(-0.2, 0.05, 0.001, -0.002, 0.0))


def raster(page, scale):
    """A page in grey, ``scale`` px per mm."""
    page.set_dpi(25.4 * scale)
    canvas = FigureCanvasAgg(page)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, 0])


def test_printed_sheet_shows_the_target_to_scale():
    target = load_target("body")
    (page,) = target_pages(target).values()
    image = raster(page, scale=2)
    height, width = image.shape
    camera = Camera(width=width, height=height, focal=(1e3, 1e3), centre=(width / 2, height / 2))
    found = {d.code: d for d in detect(image, camera) if d.code == target.codes[target.key]}
    markers = detect(image, camera)
    assert sorted(d.code for d in markers) == sorted(target.codes)
    centre = found[target.codes[target.key]].ellipse[:2]
    others = np.array([d.ellipse[:2] for d in markers]) - centre
    expected = (target.positions - target.positions[target.key])[:, :2] * [1, -1] * 2000  # 2 px per mm, y down
    for place in expected:
        assert np.abs(others - place).sum(axis=1).min() < 0.05
    assert all(d.radius == pytest.approx(2000 * target.radii[0], abs=0.1) for d in markers)


def test_svg_and_pdf_have_the_size_of_the_page(tmp_path):
    pages = target_pages(load_target("floor"))
    assert len(pages) == 4
    pdf, *drawings = write_pages(tmp_path, "floor_markers", pages)
    head = re.findall(r'<svg [^>]*width="([\d.]+)pt" height="([\d.]+)pt"', drawings[0].read_text())[0]
    assert [float(side) / 72 * 25.4 for side in head] == pytest.approx([297, 210], abs=1e-3)
    boxes = re.findall(rb"MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", pdf.read_bytes())
    assert len(boxes) == 4
    assert float(boxes[0][0]) / 72 * 25.4 == pytest.approx(297, abs=1e-3)
    again = write_pages(tmp_path / "..", "floor_markers", pages)
    assert [path.read_bytes() for path in (pdf, *drawings)] == [path.read_bytes() for path in again]


def board_cells(board):
    return board.aruco().generateImage((20 * board.columns, 20 * board.rows), marginSize=0, borderBits=1)


def test_calibration_recovers_the_lens_from_the_printed_board():
    board = Board()
    bits = np.ones((180, 180), np.uint8)
    bits[30:150] = board_cells(board) > 127
    side = board.columns * board.square
    facet = Facet(np.zeros(3), np.eye(3)[:2], (side / 2 + 0.02, side / 3 + 0.02), 225.0, tags=((0.0, 0.0, side, bits),))
    renderer = Renderer(TRUE, ScenePose(np.zeros(3), np.eye(3)), [], samples=5)
    rng, views = np.random.default_rng(0), []
    for k in range(14):
        distance = rng.uniform(0.35, 0.55)
        place = np.array([rng.uniform(-0.35, 0.35), rng.uniform(-0.25, 0.25), 1.0]) * distance
        turn = rotation_of(rng.uniform(-0.4, 0.4), rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5))
        facets = [facet.moved(place, turn @ np.diag([1.0, -1.0, -1.0]))]
        views.append((f"view {k}", renderer.frame([facets], Look(noise=3.0), k)))
    found = calibrate(views, board)
    assert found.quality is not None
    assert found.quality.rms < 0.3
    assert found.focal == pytest.approx(TRUE.focal, rel=0.004)
    assert found.centre == pytest.approx(TRUE.centre, abs=2.5)
    assert found.distortion[0] == pytest.approx(TRUE.distortion[0], abs=0.02)
    with pytest.raises(InputError, match=r"seen well in 2 of 2 images; at least 6"):
        calibrate(views[:2], board)
    with pytest.raises(InputError, match=r"view 1: 600 x 480 px, the images before it 640 x 480"):
        calibrate([views[0], ("view 1", np.ascontiguousarray(views[1][1][:, :600]))], board)


def test_views_that_are_all_frontal_do_not_calibrate():
    board = Board()
    view = np.full((480, 640), 255, np.uint8)
    view[60:420, 50:590] = np.kron(board_cells(board), np.ones((3, 3), np.uint8))
    with pytest.raises(InputError, match="which does not tell the focal length"):
        calibrate([(f"view {k}", view) for k in range(8)], board)


def test_camera_file_round_trip_and_faults(tmp_path):
    path = tmp_path / "camera.yaml"
    save_camera(path, TRUE)
    assert load_camera(path) == TRUE
    path.write_text(path.read_text().replace("focal", "foccal"))
    with pytest.raises(InputError, match="foccal"):
        load_camera(path)
    save_camera(path, TRUE.model_copy(update={"focal": (16.0, 16.0)}))
    with pytest.raises(InputError, match="look like millimetres"):
        load_camera(path)
    with pytest.raises(InputError, match="no such camera file; make one with"):
        load_camera(tmp_path / "none.yaml")
    with pytest.raises(InputError, match=r"emulated: no such camera file; make one with: .* --out camera\.yaml"):
        load_camera("emulated")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("0.14, 0.10", "140, 0.10"), "look like millimetres"),
        (lambda text: text.replace("body_key", "bodykey"), r"unknown marker code 'bodykey'.*did you mean 'body_key'"),
        (lambda text: text.replace("body_key", "body"), "one marker with a code of its own"),
        (lambda text: "\n".join(text.splitlines()[:-1]), "3 markers; a target needs at least 4"),
        (lambda text: text.replace("[-0.14, -0.10, 0.04]", "[-0.14, -0.10, 0.05]"), "expected one plane"),
        (lambda text: text.replace("[0.14, -0.10, 0.04]", "[0.14, 0.06, 0.04]"), "white margin"),
    ],
    ids=["millimetres", "code", "no key", "too few", "not flat", "too close"],
)
def test_wrong_targets_are_refused(change, message, tmp_path):
    from wlr_gym.base.paths import find_config

    path = tmp_path / "body.yaml"
    path.write_text(change(find_config("vision", "body").read_text()))
    with pytest.raises(InputError, match=message):
        load_target(path)


def test_frames_from_a_folder_a_video_and_times(tmp_path):
    import cv2

    images = [np.full((48, 64), 20 * k, np.uint8) for k in range(5)]
    for k, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"f{4 * k}.png"), image)  # in order of their numbers
    assert [int(f.image[0, 0]) for f in Frames(str(tmp_path))] == [0, 20, 40, 60, 80]
    assert [f.time for f in Frames(str(tmp_path), rate=10)] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48), False)
    for image in images:
        video.write(image)
    video.release()
    assert [f.time for f in Frames(str(tmp_path / "v.avi"))] == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    times = tmp_path / "times.csv"
    times.write_text("frame,t\n0,1.0\n1,1.1\n2,1.3\n3,1.4\n4,1.5\n")
    assert [f.time for f in Frames(str(tmp_path / "v.avi"), times=times)] == [1.0, 1.1, 1.3, 1.4, 1.5]
    assert len(list(Frames(str(tmp_path / "v.avi"), times=times, seconds=0.35))) == 3
    for count in (4, 6):
        times.write_text("\n".join(str(1 + 0.1 * k) for k in range(count)))
        with pytest.raises(InputError, match=f"{count} times, but"):
            list(Frames(str(tmp_path / "v.avi"), times=times))
    for text, number, value in (("t\n1.0\n0.9\n", 1, "0.9"), ("t\n1\n2\nnan\n4\n5\n", 2, "nan")):
        times.write_text(text)
        with pytest.raises(InputError, match=f"frame {number}: times must be finite and increase, not {value}"):
            list(Frames(str(tmp_path / "v.avi"), times=times))
    times.write_text("t\n1.0\n", encoding="utf-16")
    with pytest.raises(InputError, match="not a table of frame times"):
        list(Frames(str(tmp_path / "v.avi"), times=times))
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"not a video")
    with pytest.raises(InputError, match="cannot be read as a video"):
        list(Frames(str(broken)))
    for source in (str(tmp_path / "nothing.mp4"), os.devnull):  # a device would be a film without end
        with pytest.raises(InputError, match="no such video or folder of images"):
            list(Frames(source))


@pytest.mark.parametrize(("share", "missing"), [(1.0, 0), (0.5, 20)])
def test_a_video_that_is_cut_off_is_noticed(share, missing, tmp_path):
    import cv2

    path = tmp_path / "v.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25, (64, 48), False)
    for k in range(40):
        video.write(np.random.default_rng(k).integers(0, 255, (48, 64), np.uint8))
    video.release()
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    frames = Frames(str(path))
    assert len(list(frames)) + frames.missing == 40
    assert frames.missing == pytest.approx(missing, abs=2)
    shorter = Frames(str(path), seconds=0.2)
    assert len(list(shorter)) == 6
    assert shorter.missing == 0


NOWHERE = Sample(0, 0.0, "lost", np.full(6, np.nan), np.full((6, 6), np.nan), 0, np.nan, np.full((4, 2), np.nan))


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize("count", [1, 30])
def test_an_annotated_video_is_whole_or_what_it_was(fails, count, tmp_path):
    path = tmp_path / "annotated.avi"
    path.write_bytes(b"earlier")
    source: Any = SimpleNamespace(rate=30.0)
    with (
        pytest.raises(ZeroDivisionError) if fails else nullcontext(),
        AnnotatedVideo(path, load_target("body"), source) as video,
    ):
        for k in range(count):
            video.add(VideoFrame(k, k / 30, np.zeros((48, 64), np.uint8)), NOWHERE)
        assert path.read_bytes() == b"earlier"
        assert 1 / (not fails)
    assert (path.read_bytes() == b"earlier") == fails
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("rate", [12.5, 29.97, 60.0, 200 / 3])
@pytest.mark.parametrize("name", ["annotated.avi", "annotated.mp4"])
def test_an_annotated_video_plays_at_the_cameras_rate(rate, name, tmp_path):
    """That of the times, of which one is missing, or that which the video states."""
    import cv2

    with VideoFile(tmp_path / "film.avi", "MJPG", rate) as video:
        for _ in range(25):
            video.write(np.zeros((48, 64), np.uint8))
    (tmp_path / "times.csv").write_text("\n".join(f"{7.0 + (k + (k > 4)) / rate:.9f}" for k in range(25)))
    for times in (None, tmp_path / "times.csv"):
        source = Frames(str(tmp_path / "film.avi"), times=times)
        with AnnotatedVideo(tmp_path / name, load_target("body"), source) as video:
            for frame in source:
                video.add(frame, NOWHERE)
        written = cv2.VideoCapture(str(tmp_path / name))
        assert written.get(cv2.CAP_PROP_FPS) == pytest.approx(rate, abs=0.01)
        assert len(list(Frames(str(tmp_path / name)))) == 25


@pytest.mark.parametrize("hidden", [None, 0, 3])
def test_the_arrow_points_where_the_layout_says(hidden):
    """With the markers in any order, and one hidden."""
    target = load_target("body")
    target = target.model_copy(update={"markers": tuple(target.markers[k] for k in (3, 0, 2, 1))})
    turn = rotation_of(0.7)[:2, :2] * 800 / 2.0
    centres = np.array([300.0, 240.0]) + target.positions[:, :2] @ turn.T * [1, -1]
    if hidden is not None:
        centres[hidden] = np.nan
    trail: list = []
    sample = Sample(0, 0.0, "ok", np.full(6, np.nan), np.full((6, 6), np.nan), 4, 0.02, centres)
    picture = annotate(np.zeros((480, 640), np.uint8), sample, target, trail)
    assert trail == [(300, 240)]
    tip = np.array([300.0, 240.0]) + 0.2 * turn[:, 0] * [1, -1]
    behind = np.array([300.0, 240.0]) - 0.1 * turn[:, 0] * [1, -1]
    assert picture[round(tip[1]), round(tip[0])].any()
    assert not picture[round(behind[1]), round(behind[0])].any()


class StandIn:
    """A camera that gives so many frames of a size, then none (or for ever)."""

    def __init__(self, size, count):
        self.size, self.left, self.released = size, count, False
        self.interrupted_at = -1

    def isOpened(self):  # noqa: N802 - OpenCV's names
        return self.size is not None

    def set(self, *_):
        return False

    def get(self, _):
        return 0.0

    def grab(self):
        time.sleep(0.005)
        self.left -= 1
        if self.left == self.interrupted_at:
            os.kill(os.getpid(), signal.SIGINT)
        return self.left >= 0

    def retrieve(self):
        return True, np.full((self.size[1], self.size[0], 3), self.left % 200, np.uint8)

    def release(self):
        self.released = True


def stand_in(monkeypatch, size, count=10**9):
    import cv2

    real, device = cv2.VideoCapture, StandIn(size, count)
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: device if isinstance(source, int) else real(source))
    return device


@pytest.mark.parametrize("ended", ["by time", "by Ctrl-C"])
def test_a_live_camera_is_filmed_without_loss(ended, monkeypatch, tmp_path):
    device, handler = stand_in(monkeypatch, (640, 480)), signal.getsignal(signal.SIGINT)
    if ended == "by Ctrl-C":
        device.interrupted_at = device.left - 60  # while it films: Ctrl-C before would end the tests
    video, times = film(0, tmp_path, TRUE, 0.4 if ended == "by time" else None)
    frames = list(Frames(str(video), times=times))
    assert len(frames) > 5
    shades = np.array([int(f.image.min()) for f in frames])
    assert set(np.diff(shades) % 200) == {199}  # every frame, in order, as it was
    assert all(np.ptp(f.image) == 0 for f in frames)
    assert np.diff([f.time for f in frames]).min() > 0.004
    assert device.released
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.parametrize(
    ("size", "count", "message", "kept"),
    [
        (None, 0, "camera 0: cannot be opened", False),
        ((640, 480), 0, "camera 0: gave no frame", False),
        ((320, 240), 9, "320 x 240 px, but the camera was calibrated for 640 x 480", False),
        ((640, 480), 9, "no more frames .was it unplugged.. after .* 9 frames are kept", True),
    ],
    ids=["none", "no frame", "size", "unplugged"],
)
def test_a_live_camera_that_fails_is_told(size, count, message, kept, monkeypatch, tmp_path):
    stand_in(monkeypatch, size, count)
    with pytest.raises(InputError, match=message):
        film(0, tmp_path, TRUE)
    assert {path.name for path in tmp_path.iterdir()} == ({"film.avi", "film.csv"} if kept else set())


def test_command_films_before_it_reads_the_run(monkeypatch, tmp_path, capsys):
    """The run may not be there yet when the film starts; when it never comes, the film is kept."""
    monkeypatch.chdir(tmp_path)
    save_camera(tmp_path / "camera.yaml", TRUE)
    stand_in(monkeypatch, (640, 480))
    arguments = ["--run", "log/run.csv", "--out", "out", "--camera", "camera.yaml", "--seconds", "0.1"]
    assert main(["vision", "0", *arguments]) == 2
    printed = capsys.readouterr()
    assert "log/run.csv: no such file" in printed.err.replace("\n", "")
    assert "with --times out/film.csv" in printed.out.replace("\n", "")
    assert len(list(Frames("out/film.avi", times=tmp_path / "out" / "film.csv"))) > 2


def test_command_writes_the_sheets(tmp_path, capsys):
    assert main(["calibrate", "targets", "--out", str(tmp_path)]) == 0
    assert "print at 100 %" in capsys.readouterr().out
    assert {"body_markers.pdf", "floor_markers.pdf", "calibration_board.pdf"} <= {path.name for path in tmp_path.iterdir()}
    assert board_page(Board()).get_size_inches() * 25.4 == pytest.approx([297.0, 210.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["vision", "v.avi", "--run", "none.csv", "--out", "o", "--camera", "c.yaml"], "none.csv: no such file"),
        (["vision", ".", "--run", "none.csv", "--out", "o", "--camera", "c.yaml"], "images do not say when they were taken"),
        (["vision", "v.avi", "--run", "r.csv", "--out", "o", "--camera", "c.yaml", "--seconds", "-1"], "--seconds -1: exp"),
        (["calibrate", "camera", "nothing", "--out", "camera.yaml"], "no such video"),
        (
            ["calibrate", "camera", ".", "--out", "camera.yaml", "--square", "28"],
            "expected more than 0.001 and less than 0.5 m, as measured on the print (28 mm = 0.028)",
        ),
        (["calibrate", "camera", ".", "--out", "camera.txt"], "expected a file that ends in .yaml, .yml"),
    ],
)
def test_bad_input_is_named(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert message in capsys.readouterr().err.replace("\n", "")
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
def test_bench_reports_every_bar(tmp_path):
    file = tmp_path / "bench.json"
    assert bench(["vision", "--quick", "--rounds", "1", "--save", str(file)]) == 0
    rows = json.loads(file.read_text())["vision"]
    assert {row["method"].split()[0] for row in rows} == {"ours", "paper's", "tags"}
    assert all(row["met"] for row in rows if row["bar"] is not None and "frames per second" not in row["what"])


@pytest.mark.slow
def test_process_ends_well_after_apriltag_3():
    """The package's destructor frees memory and then uses it: a crash at the end of the process, or later."""
    pytest.importorskip("pupil_apriltags")
    code = "from studies.bench.vision import tag_kinds, tag_poses; print(tag_poses(0.0, 4, tag_kinds()[-1])[1])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (0, "all four in 4 of 4 frames\n")
