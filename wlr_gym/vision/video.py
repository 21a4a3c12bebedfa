"""Where frames come from (video file, folder of images, live camera) and where annotated ones go."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.errors import InputError, require_package
from wlr_gym.vision.detect import Image
from wlr_gym.vision.track import LOST, MOVED, OK, PARTIAL, Frame, Sample

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
_COLOURS = {OK: (60, 180, 60), PARTIAL: (0, 165, 255), LOST: (40, 40, 220), MOVED: (200, 60, 200)}  # blue, green, red


def read_frames(
    source: str, rate: float | None = None, times: Path | None = None, seconds: float | None = None
) -> Iterator[Frame]:
    """Yield the frames of a video file, of a folder of images (in order of name), or of a live camera (its number).

    Args:
        source: path, or a number for a live camera.
        rate: Hz; frames are evenly spaced by it. Default: the times in the video; 30 for images; the clock for a live camera.
        times: CSV with one time (s) per frame in its last column, which goes before ``rate``.
        seconds: stop this long after the first frame.

    Raises:
        InputError: no such file, not a video, no frames, or another number of frames than of times.
    """
    require_package("cv2", "vision")
    stamps = None if times is None else _read_times(times)
    count, first, cut = 0, 0.0, False
    for index, (stamp, image) in enumerate(_images(source)):
        if stamps is not None and index >= len(stamps):
            raise InputError(f"{times}: {len(stamps)} times, but {source} has more frames")
        moment = stamps[index] if stamps is not None else index / rate if rate else stamp
        first = moment if index == 0 else first
        cut = seconds is not None and moment - first > seconds
        if cut:
            break
        count += 1
        yield Frame(index, moment, image)
    if not count:
        raise InputError(f"{source}: no frames could be read")
    if stamps is not None and not cut and count < len(stamps):
        raise InputError(f"{times}: {len(stamps)} times, but {source} has {count} frames; which time is whose cannot be told")


def _images(source: str) -> Iterator[tuple[float, Image]]:
    path = Path(source)
    if source.isdigit() and not path.exists():
        return _live(int(source))
    if path.is_dir():
        return _folder(path)
    if not path.is_file():
        raise InputError(f"{source}: no such video, folder of images or camera number")
    return _file(path)


def _file(path: Path) -> Iterator[tuple[float, Image]]:
    import cv2

    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise InputError(f"{path}: cannot be read as a video; expected a format that OpenCV reads (AVI, MP4, MKV)")
    rate = video.get(cv2.CAP_PROP_FPS)
    rate = rate if 1 < rate < 2000 else 30.0
    index, before = 0, -math.inf
    while True:
        ok, image = video.read()
        if not ok:
            break
        stamp = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
        if not stamp > before:  # a container without times
            stamp = index / rate if index == 0 else before + 1 / rate
        yield stamp, _grey(image)
        index, before = index + 1, stamp
    video.release()
    if index == 0:
        raise InputError(f"{path}: opened, but no frame could be decoded; is the file whole?")


def _folder(folder: Path) -> Iterator[tuple[float, Image]]:
    import cv2

    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGES)
    if not files:
        raise InputError(f"{folder}: no images ({', '.join(IMAGES)})")
    for index, path in enumerate(files):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise InputError(f"{path}: cannot be read as an image")
        yield index / 30.0, np.asarray(image, np.uint8)


def _live(number: int) -> Iterator[tuple[float, Image]]:
    import cv2

    video = cv2.VideoCapture(number)
    if not video.isOpened():
        raise InputError(f"camera {number}: cannot be opened; is it plugged in, and free?")
    try:
        start = time.monotonic()
        while True:
            ok = video.grab()
            stamp = time.monotonic() - start
            ok, image = video.retrieve() if ok else (False, None)
            if not ok:
                raise InputError(f"camera {number}: no more frames after {stamp:.1f} s; was it unplugged?")
            yield stamp, _grey(image)
    except KeyboardInterrupt:  # the way to end a live recording
        return
    finally:
        video.release()


def _grey(image: Any) -> Image:
    import cv2

    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _read_times(path: Path) -> list[float]:
    if not path.is_file():
        raise InputError(f"{path}: no such file of frame times")
    with path.open(newline="", encoding="utf-8-sig") as file:
        cells = [row[-1].strip() for row in csv.reader(file) if row]
    try:
        stamps = [float(cell) for cell in (cells[1:] if cells and not _is_number(cells[0]) else cells)]
    except ValueError as error:
        raise InputError(f"{path}: not a table of frame times: {error}") from None
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back) or not np.isfinite(stamps).all():
        where = int(back[0]) + 1 if len(back) else 0
        raise InputError(f"{path}: frame {where}: times must be finite and increase")
    return stamps


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


class AnnotatedVideo:
    """Writes frames with what was found in them. A context manager.

    Args:
        path: of an ``.mp4`` or ``.avi`` file. rate: Hz. scale: size of the copy.
    """

    def __init__(self, path: Path, rate: float, scale: float = 1.0) -> None:
        self.path, self.rate, self.scale = path, rate, scale
        self._unfinished = path.with_name(f".{path.stem}.unfinished{path.suffix}")
        self._writer = None
        self._trail: list[tuple[int, int]] = []

    def __enter__(self) -> AnnotatedVideo:
        return self

    def __exit__(self, fault: type[BaseException] | None, *_: object) -> None:
        """Give the file its name; after an error, leave what was there before."""
        if self._writer is None:
            return
        self._writer.release()
        if fault is None:
            self._unfinished.replace(self.path)
        else:
            self._unfinished.unlink(missing_ok=True)

    def add(self, frame: Frame, sample: Sample) -> None:
        """Append one frame."""
        import cv2

        image = annotate(frame.image, sample, self._trail)
        if self.scale != 1.0:
            image = cv2.resize(image, None, fx=self.scale, fy=self.scale, interpolation=cv2.INTER_AREA)
        if self._writer is None:
            code = cv2.VideoWriter.fourcc(*("mp4v" if self.path.suffix == ".mp4" else "MJPG"))
            self._writer = cv2.VideoWriter(str(self._unfinished), code, self.rate, (image.shape[1], image.shape[0]))
            if not self._writer.isOpened():
                raise InputError(f"{self.path}: cannot be written as a video")
        self._writer.write(image)


def annotate(image: Image, sample: Sample, trail: list[tuple[int, int]]) -> NDArray[np.uint8]:
    """Return a colour copy with markers, heading, track and pose; ``trail`` is added to."""
    import cv2

    picture: Any = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    colour = _COLOURS.get(sample.status, (40, 40, 220))
    seen = np.isfinite(sample.centres[:, 0])
    for x, y in sample.centres[seen]:
        cv2.drawMarker(picture, (round(x), round(y)), colour, cv2.MARKER_CROSS, 18, 2)
    if seen.all() and len(seen) == 4:
        front, rear = sample.centres[:2].mean(axis=0), sample.centres[2:].mean(axis=0)
        trail.append(_whole(0.5 * (front + rear)))
        cv2.arrowedLine(picture, _whole(rear), _whole(front + 0.5 * (front - rear)), colour, 2, cv2.LINE_AA, tipLength=0.15)
    if len(trail) > 1:
        cv2.polylines(picture, [np.array(trail, np.int32)], False, (200, 120, 0), 2, cv2.LINE_AA)
    text = f"frame {sample.index}  {sample.time:.3f} s  {sample.status}"
    if math.isfinite(sample.pose[0]):
        x, y, z, yaw, pitch, _ = sample.pose
        text += f"  x {x:+.4f}  y {y:+.4f}  z {z:.4f} m  yaw {math.degrees(yaw):+.2f}  pitch {math.degrees(pitch):+.2f} deg"
    picture[:40] //= 3  # a dark strip to read the text on
    cv2.putText(picture, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def _whole(point: Sequence[float] | NDArray[np.float64]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))
