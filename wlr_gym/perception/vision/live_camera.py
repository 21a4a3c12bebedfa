"""Film with a live camera, without loss, each frame with the time at which it came: a film to analyse, and to analyse again.

One thread takes the frames as they come, so their times are prompt; the other writes them.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Full, Queue
from typing import Any

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import write_text
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.vision.tracking import check_size
from wlr_gym.perception.vision.video import Image, VideoFile, grey

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
    rate = capture.get(cv2.CAP_PROP_FPS)
    rate = rate if 1 < rate < 2000 else 30.0
    queue: Queue[tuple[float, Image] | str | None] = Queue(_BACKLOG)
    stop = threading.Event()
    thread = threading.Thread(target=_grab, args=(capture, queue, stop), daemon=True)
    times: list[float] = []
    fault = ""
    try:
        with _stopped_by_interrupt(stop), VideoFile(folder / "film.avi", "FFV1", rate) as video:
            thread.start()
            for item in iter(queue.get, None):
                if isinstance(item, str):
                    fault = item
                    continue
                moment, image = item
                check_size(image, camera, f"camera {number}")
                video.write(image)
                times.append(moment)
                if seconds is not None and moment - times[0] >= seconds:
                    stop.set()
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
    """Return a camera's ``cv2.VideoCapture``, asked for pictures of the size it was calibrated with.

    Raises:
        InputError: it cannot be opened.
    """
    import cv2

    capture = cv2.VideoCapture(device)
    if not capture.isOpened():
        raise InputError(f"camera {device}: cannot be opened; is it plugged in, and free?")
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, camera.width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, camera.height)
    return capture


def _grab(capture: Any, queue: Queue[tuple[float, Image] | str | None], stop: threading.Event) -> None:
    """Put (time, image) of every frame, then what went wrong if something did, then None."""
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
    for item in (fault, None) if fault else (None,):
        queue.put(item)


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
