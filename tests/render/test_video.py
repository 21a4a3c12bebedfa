"""Films: written whole or not at all, with the pictures and the speed asked for."""

import importlib.util
import weakref
from typing import Any

import numpy as np
import pytest
from PIL import Image

from wlr_gym.base.errors import InputError, MissingPackageError
from wlr_gym.render.video import GAP, check_video, side_by_side, write_video

MP4 = pytest.param(".mp4", marks=pytest.mark.skipif(not importlib.util.find_spec("imageio_ffmpeg"), reason="no imageio-ffmpeg"))


def film(count=5, size=(64, 48)):
    """Pictures of one grey each, brighter from one to the next."""
    for index in range(count):
        yield np.full((size[1], size[0], 3), 40 * (index + 1), np.uint8)


def read(path):
    if path.suffix == ".mp4":
        import imageio_ffmpeg

        frames = imageio_ffmpeg.read_frames(str(path))
        meta = next(frames)
        width, height = meta["size"]
        return [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames], 1000 / meta["fps"]
    opened: Any = Image.open(path)
    with opened as image:
        pictures, durations = [], []
        for index in range(image.n_frames):
            image.seek(index)
            pictures.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
        return pictures, float(np.mean(durations))


@pytest.mark.parametrize("suffix", [".webp", ".gif", ".png", MP4])
@pytest.mark.parametrize("count", [None, 5])
def test_pictures_and_speed_come_back(tmp_path, suffix, count):
    path = write_video(tmp_path / f"film{suffix}", film(), fps=20, count=count)
    pictures, duration = read(path)
    assert [round(picture.mean() / 40) for picture in pictures] == [1, 2, 3, 4, 5]
    assert pictures[0].shape == (48, 64, 3)
    assert duration == pytest.approx(50, abs=1)
    assert [child.name for child in tmp_path.iterdir()] == [f"film{suffix}"]


@pytest.mark.parametrize("suffix", [".webp", MP4])
def test_pictures_are_not_hoarded(tmp_path, suffix):
    seen, most = [], 0

    def watched():
        nonlocal most
        for index in range(20):
            picture = np.full((48, 64, 3), index, np.uint8)
            seen.append(weakref.ref(picture))
            most = max(most, sum(reference() is not None for reference in seen))
            yield picture

    write_video(tmp_path / f"film{suffix}", watched(), count=20)
    assert len(seen) == 20
    assert most <= 3


@pytest.mark.parametrize("suffix", [".webp", ".gif", ".png", MP4])
def test_a_film_that_breaks_off_leaves_the_old_one_and_no_litter(tmp_path, suffix):
    path = tmp_path / f"film{suffix}"
    write_video(path, film(), count=5)
    before = path.read_bytes()

    def broken():
        yield from film(2)
        raise RuntimeError("the plant blew up")

    with pytest.raises(RuntimeError, match="blew up"):
        write_video(path, broken(), count=5)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "pictures", "keywords", "expected"),
    [
        ("film.avi", film(), {}, r"ends in \.webp, \.gif, \.png, \.mp4"),
        ("no/film.webp", film(), {}, "folder .* does not exist"),
        ("film.webp", [], {}, "no pictures"),
        ("film.webp", film(), {"fps": 0}, "fps = 0"),
        ("film.webp", film(3), {"count": 5}, "5 pictures were announced, but there are fewer"),
        ("film.webp", [*film(1), *film(1, (32, 32))], {}, r"picture 1 is uint8 \(32, 32, 3\), expected uint8 \(48, 64, 3\)"),
        ("film.webp", [np.zeros((48, 64, 3))], {}, "picture 0 is float64"),
    ],
)
def test_bad_films(tmp_path, name, pictures, keywords, expected):
    with pytest.raises(InputError, match=expected):
        write_video(tmp_path / name, pictures, **keywords)
    assert list(tmp_path.iterdir()) == []


def test_an_ending_in_capitals_is_a_film_too(tmp_path):
    check_video(tmp_path / "FILM.WEBP")


def test_mp4_without_its_package(monkeypatch, tmp_path):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"imageio_ffmpeg.*wlr-gym\[video\]"):
        check_video(tmp_path / "film.mp4")


def test_side_by_side():
    pictures = list(side_by_side(film(3), film(2), ("left", "a title that is far too long for its narrow picture")))
    assert len(pictures) == 3
    height, width, _ = pictures[0].shape
    assert width == 64 + GAP + 64
    strip = height - 48
    assert [picture[strip + 5, 5, 0] for picture in pictures] == [40, 80, 120]
    assert [picture[strip + 5, -5, 0] for picture in pictures] == [40, 80, 80]
    assert (pictures[0][:strip] < 128).any()
    assert (pictures[0][:strip, 64 : 64 + GAP] == 255).all()


def test_side_by_side_refuses_what_does_not_match():
    with pytest.raises(InputError, match="48 and 32 pixels high"):
        list(side_by_side(film(1), film(1, (64, 32))))
    with pytest.raises(InputError, match="film 'two' has no pictures"):
        list(side_by_side(film(1), [], ("one", "two")))
