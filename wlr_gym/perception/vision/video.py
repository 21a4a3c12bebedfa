"""Where frames come from (video file, folder of images, live camera) and where annotated ones go.

A live camera is filmed without loss, each frame with the time at which it came: one thread takes the frames as they come, so
their times are prompt; the other writes them.
"""

from __future__ import annotations

import csv
import math
import re
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Full, Queue
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import write_text
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Image
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.vision.tracking import LOST, MOVED, OK, PARTIAL, Sample, VideoFrame, check_size

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
_INEXACT = 0.005  # of the number of frames; where it is not stored, it is computed from the duration
_COLOURS = {OK: (60, 180, 60), PARTIAL: (0, 165, 255), LOST: (40, 40, 220), MOVED: (200, 60, 200)}  # blue, green, red


class Frames:
    """The frames of a video file or of a folder of images (in order of name, numbers as numbers); an iterator.

    A note on how the camera was held (a phone's) is not followed: frames are as the sensor read them, so one calibration and
    one readout hold for films taken upright, lying and upside down.

    Args:
        source: path.
        rate: Hz; frames are evenly spaced by it. Default: the times in the video; 30 for images.
        times: CSV with one time (s) per frame in its last column, which goes before ``rate``.
        seconds: stop this long after the first frame.

    Attributes:
        announced: how many frames there should be; 0 = not known, or not yet read from.
        missing: how many frames a video announces that could not be decoded: it is cut off or damaged. Known at its end.
        rate: Hz, as given, or of the times; of a video as it states it, known from the first frame on.

    Raises:
        InputError: no such file, not a video, no frames, or another number of frames than of times.
    """

    def __init__(self, source: str, rate: float | None = None, times: Path | None = None, seconds: float | None = None) -> None:
        require_package("cv2", "vision")
        self.announced = self.missing = 0
        self.rate = rate or 0.0
        self._frames = self._read(source, rate, times, seconds)

    def __iter__(self) -> Iterator[VideoFrame]:
        return self

    def __next__(self) -> VideoFrame:
        return next(self._frames)

    def _read(self, source: str, rate: float | None, times: Path | None, seconds: float | None) -> Iterator[VideoFrame]:
        stamps = None if times is None else _read_times(times)
        if stamps is not None and len(stamps) > 1:
            self.rate = 1 / float(np.median(np.diff(stamps)))
        count, first, cut = 0, 0.0, False
        for index, (stamp, image) in enumerate(self._images(source)):
            if stamps is not None and index >= len(stamps):
                raise InputError(f"{times}: {len(stamps)} times, but {source} has more frames")
            moment = stamps[index] if stamps is not None else index / rate if rate else stamp
            first = moment if index == 0 else first
            cut = seconds is not None and moment - first > seconds
            if cut:
                break
            count += 1
            yield VideoFrame(index, moment, image)
        if not count:
            raise InputError(f"{source}: no frames could be read")
        if stamps is not None and not cut and count < len(stamps):
            broken = f" and {self.missing} that cannot be decoded" if self.missing else ""
            raise InputError(
                f"{times}: {len(stamps)} times, but {source} has {count} frames{broken}; which time is whose cannot be told"
            )

    def _images(self, source: str) -> Iterator[tuple[float, Image]]:
        path = Path(source)
        if path.is_dir():
            return self._folder(path)
        if not path.is_file():  # a device would be a film without end
            raise InputError(f"{source}: no such video or folder of images")
        return self._file(path)

    def _file(self, path: Path) -> Iterator[tuple[float, Image]]:
        import cv2

        video = cv2.VideoCapture(str(path))
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as the sensor read it: lens and shutter belong to that
        if not video.isOpened():
            raise InputError(f"{path}: cannot be read as a video; expected a format that OpenCV reads (AVI, MP4, MKV)")
        rate, announced = _plausible(video.get(cv2.CAP_PROP_FPS)), video.get(cv2.CAP_PROP_FRAME_COUNT)
        self.rate = self.rate or rate
        self.announced = max(round(announced), 0) if math.isfinite(announced) else 0
        index, before = 0, -math.inf
        while (read := video.read())[0]:
            stamp = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if not stamp > before:  # a container without times
                stamp = before + 1 / rate if index else 0.0
            yield stamp, grey(read[1])
            index, before = index + 1, stamp
        video.release()
        if index == 0:
            raise InputError(f"{path}: opened, but no frame could be decoded; is the file whole?")
        if self.announced - index > max(1.0, _INEXACT * self.announced):
            self.missing = self.announced - index

    def _folder(self, folder: Path) -> Iterator[tuple[float, Image]]:
        files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGES]
        # numbers count as numbers, 2 before 10: text, number, text, ...
        parts = {path: re.split(r"(\d+)", path.name) for path in files}
        files.sort(key=lambda path: ([int(part) if k % 2 else part for k, part in enumerate(parts[path])], path.name))
        if not files:
            raise InputError(f"{folder}: no images ({', '.join(IMAGES)})")
        self.announced, self.rate = len(files), self.rate or 30.0
        for index, path in enumerate(files):
            image = read_image(path)
            if image is None:
                raise InputError(f"{path}: cannot be read as an image")
            yield index / 30.0, image


def _plausible(rate: float) -> float:
    """The rate (Hz) that a video or a driver states, or a usual one."""
    return rate if 1 < rate < 2000 else 30.0


def read_image(path: Path) -> Image | None:
    """A picture in grey as the sensor read it, however the camera was held; None = it cannot be read."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if image is None else np.asarray(image, np.uint8)


def grey(image: Any) -> Image:
    """Return one channel (H, W)."""
    import cv2

    return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _read_times(path: Path) -> list[float]:
    if not path.is_file():
        raise InputError(f"{path}: no such file of frame times")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            cells = [row[-1].strip() for row in csv.reader(file) if row]
        try:
            stamps = [float(cell) for cell in cells]
        except ValueError:
            stamps = [float(cell) for cell in cells[1:]]  # the first was a heading
    except ValueError as error:
        raise InputError(f"{path}: not a table of frame times: {error}") from None
    wrong = np.flatnonzero(~np.isfinite(stamps) | (np.diff(stamps, prepend=-math.inf) <= 0))
    if len(wrong):
        raise InputError(f"{path}: frame {wrong[0]}: times must be finite and increase, not {stamps[wrong[0]]:g}")
    return stamps


class VideoFile:
    """A video that gets its name when it is whole. A context manager: after an error, what was there before stays.

    ``code``: four letters of the codec. ``rate``: Hz.
    """

    def __init__(self, path: Path, code: str, rate: float) -> None:
        self.path, self.rate, self._code = path, rate, code
        self._unfinished = path.with_name(f".{path.stem}.unfinished{path.suffix}")
        self._writer = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, fault: type[BaseException] | None, *_: object) -> None:
        if self._writer is None:
            return
        self._writer.release()
        if fault is None:
            self._unfinished.replace(self.path)
        else:
            self._unfinished.unlink(missing_ok=True)

    def write(self, image: NDArray[np.uint8]) -> None:
        """Append an image, grey (H, W) or colour (H, W, 3)."""
        import cv2

        if self._writer is None:
            code, size = cv2.VideoWriter.fourcc(*self._code), (image.shape[1], image.shape[0])
            rate = round(self.rate, 2)  # finer ones are more than MPEG-4's clock can take
            self._writer = cv2.VideoWriter(str(self._unfinished), code, rate, size, image.ndim == 3)
            if not self._writer.isOpened():
                raise InputError(f"{self.path}: cannot be written as a video")
        self._writer.write(image)


class AnnotatedVideo(VideoFile):
    """Frames with what was found in them, at the rate at which they were filmed.

    Args:
        path: of an ``.mp4`` or ``.avi`` file. body: the markers on the robot. source: of the frames.
    """

    def __init__(self, path: Path, body: Target, source: Frames) -> None:
        super().__init__(path, "mp4v" if path.suffix == ".mp4" else "MJPG", 0.0)
        self.body, self._source = body, source
        self._trail: list[tuple[int, int]] = []

    def add(self, frame: VideoFrame, sample: Sample) -> None:
        """Append one frame."""
        self.rate = self._source.rate
        self.write(annotate(frame.image, sample, self.body, self._trail))


def annotate(image: Image, sample: Sample, body: Target, trail: list[tuple[int, int]]) -> NDArray[np.uint8]:
    """Return a colour copy with markers, heading, track and pose; ``trail`` is added to."""
    import cv2

    picture: Any = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    colour, seen = _COLOURS.get(sample.status, (40, 40, 220)), np.isfinite(sample.centres[:, 0])
    for x, y in sample.centres[seen]:
        cv2.drawMarker(picture, (round(x), round(y)), colour, cv2.MARKER_CROSS, 18, 2)
    if seen.sum() >= 3:
        # from the body's origin, at the height of its markers, to a point in front: by the affine map from the markers' places
        # to their centres, which is enough to look at
        places = np.column_stack([body.positions[:, :2], np.ones(len(seen))])
        plane = np.linalg.lstsq(places[seen], sample.centres[seen], rcond=None)[0]
        ahead = 1.5 * float(np.abs(body.positions[:, 0]).max())
        (x, y), tip = np.rint([[0.0, 0.0, 1.0], [ahead, 0.0, 1.0]] @ plane).astype(int).tolist()
        trail.append((x, y))
        cv2.arrowedLine(picture, (x, y), tip, colour, 2, cv2.LINE_AA, tipLength=0.15)
    if len(trail) > 1:
        cv2.polylines(picture, [np.array(trail, np.int32)], False, (200, 120, 0), 2, cv2.LINE_AA)
    text = f"frame {sample.index}  {sample.time:.3f} s  {sample.status}"
    if math.isfinite(sample.pose[0]):
        x, y, z, yaw, pitch, _ = sample.pose
        text += f"  x {x:+.4f}  y {y:+.4f}  z {z:.4f} m  yaw {math.degrees(yaw):+.2f}  pitch {math.degrees(pitch):+.2f} deg"
    picture[:40] //= 3  # a dark strip to read the text on
    cv2.putText(picture, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


# --- live camera ------------------------------------------------------------------------------------------------------


_BACKLOG = 300  # frames that may wait to be written


def film(number: int, folder: Path, camera: Camera, seconds: float | None = None) -> tuple[Path, Path]:
    """Film until Ctrl-C, or for some time.

    Args:
        number: of the camera. folder: for ``film.avi`` and ``film.csv`` (number and time, s, of every frame).
        camera: its calibration; the size of its images is requested from the driver. seconds: None = until Ctrl-C.

    Returns:
        The two paths.

    Raises:
        InputError: no such camera, another size than calibrated, or it stopped by itself; what was filmed is kept.
    """
    require_package("cv2", "vision")
    import cv2

    capture = open_device(number, camera)
    queue: Queue[tuple[float, Image] | str] = Queue(_BACKLOG)
    stop = threading.Event()
    thread = threading.Thread(target=_grab, args=(capture, queue, stop), daemon=True)
    rate = _plausible(capture.get(cv2.CAP_PROP_FPS))
    times: list[float] = []
    fault = ""
    try:
        with _stopped_by_interrupt(stop), VideoFile(folder / "film.avi", "FFV1", rate) as video:
            thread.start()
            while not isinstance(item := queue.get(), str):
                moment, image = item
                check_size(image, camera, f"camera {number}")
                video.write(image)
                times.append(moment)
                if seconds is not None and moment - times[0] >= seconds:
                    stop.set()
            fault = item
    finally:
        stop.set()
        thread.join(timeout=5)
        capture.release()
    if not times:
        raise InputError(f"camera {number}: gave no frame")
    rows = "".join(f"{index},{moment:.6f}\n" for index, moment in enumerate(times))
    write_text(folder / "film.csv", "frame,t\n" + rows)
    if fault:
        raise InputError(f"camera {number}: {fault} after {times[-1]:.1f} s; {len(times)} frames are kept in {folder}")
    return folder / "film.avi", folder / "film.csv"


def open_device(device: int | str, camera: Camera) -> Any:
    """Return a camera's ``cv2.VideoCapture``, asked for pictures of the size it was calibrated with."""
    import cv2

    capture = cv2.VideoCapture(device)
    if not capture.isOpened():
        raise InputError(f"camera {device}: cannot be opened; is it plugged in, and free?")
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
    return capture


def _grab(capture: Any, queue: Queue[tuple[float, Image] | str], stop: threading.Event) -> None:
    """Put (time, image) of every frame, then what went wrong; empty = nothing."""
    start, fault = time.monotonic(), ""
    while not (stop.is_set() or fault):
        grabbed = capture.grab()
        moment = time.monotonic() - start
        decoded, image = capture.retrieve() if grabbed else (False, None)
        try:
            if decoded:
                queue.put_nowait((moment, grey(image)))
            else:
                fault = "no more frames (was it unplugged?)"
        except Full:
            fault = "frames come faster than they can be written; film slower or smaller"
    queue.put(fault)


@contextmanager
def _stopped_by_interrupt(stop: threading.Event) -> Iterator[None]:
    """Let Ctrl-C set ``stop`` instead of tearing the film; only a program's main thread hears of it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: stop.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
