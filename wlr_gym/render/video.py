"""Write films: animated WebP, GIF and PNG through Pillow, MP4 through ``imageio-ffmpeg`` where it is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import replace_file, require_ending
from wlr_gym.base.paths import as_path

Picture = NDArray[np.uint8]

FPS = 25.0  # pictures per second unless asked otherwise


def check_video(path: Path, option: str = "--video") -> None:
    """Refuse a film that could not be written, before anything is simulated for it.

    Raises:
        InputError: no such folder, or a suffix that is no film.
        MissingPackageError: MP4 without ``imageio-ffmpeg``.
    """
    require_ending(path, _WRITERS, option, any_case=True)
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: folder {path.parent} does not exist")
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder")
    if path.suffix.lower() == ".mp4":
        require_package("imageio_ffmpeg", "video")


def write_video(path: str | Path, pictures: Iterable[Picture], fps: float = FPS, count: int | None = None) -> Path:
    """Write pictures as a film; the suffix of ``path`` decides how. They are taken one by one.

    Args:
        path: file ending in .webp, .gif, .png or .mp4. It appears when it is complete.
        pictures: (H, W, 3) uint8, all of one size. GIF has 256 colours.
        fps: pictures per second. GIF and PNG keep time in steps of 10 ms and 1 ms.
        count: how many pictures there are. Without it, and for .png, a generator's pictures are all held in
            memory (never for .mp4).

    Raises:
        InputError: no pictures, pictures of different sizes, a bad path or frame rate.
        MissingPackageError: MP4 without ``imageio-ffmpeg``.
    """
    path = as_path(path)
    check_video(path, "path")
    if not 0 < fps <= 1000:
        raise InputError(f"fps = {fps!r}: expected more than 0, at most 1000")
    writer = _WRITERS[path.suffix.lower()]
    if count is None and writer is not _write_mp4:
        pictures = pictures if isinstance(pictures, Sequence) else list(pictures)
        count = len(pictures)
    checked = _checked(pictures)
    first = next(checked, None)
    if first is None:
        raise InputError(f"{path}: no pictures to write")
    replace_file(path, lambda temporary: writer(temporary, chain([first], checked), fps, count or 0))
    return path


def _checked(pictures: Iterable[Picture]) -> Iterator[Picture]:
    shape = None
    for index, picture in enumerate(pictures):
        shape = shape or picture.shape
        if picture.dtype != np.uint8 or picture.shape != shape or picture.ndim != 3 or picture.shape[2] != 3:
            raise InputError(f"picture {index} is {picture.dtype} {picture.shape}, expected uint8 {shape} with three colours")
        yield picture


class _Film(Image.Image):
    """Pictures as one image with many frames. Pillow seeks them in order, so only one is in memory."""

    def __init__(self, pictures: Iterator[Picture], count: int) -> None:
        super().__init__()
        self._pictures, self.n_frames, self._at = pictures, count, -1
        self.seek(0)

    def seek(self, frame: int) -> None:
        """Go to the next frame (going back does nothing: Pillow only rewinds after the last one); EOFError after the last."""
        if frame <= self._at:
            return
        picture = next(self._pictures, None)
        if picture is None or frame >= self.n_frames:
            raise EOFError(f"no frame {frame}")
        image = Image.fromarray(picture)
        self._im, self._mode, self._size, self._at = image.im, image.mode, image.size, frame

    def tell(self) -> int:
        """Return the present frame."""
        return self._at


def _write_webp(path: Path, pictures: Iterator[Picture], fps: float, count: int) -> None:
    _save(path, _Film(pictures, count), count, format="WEBP", duration=1000.0 / fps, quality=75, method=2)


def _write_gif(path: Path, pictures: Iterator[Picture], fps: float, count: int) -> None:
    _save(path, _Film(pictures, count), count, format="GIF", duration=round(100.0 / fps) * 10, optimize=False)


def _write_png(path: Path, pictures: Iterator[Picture], fps: float, count: int) -> None:
    """Pillow looks at all frames of a PNG twice, so they are held."""
    first, *others = (Image.fromarray(picture) for picture in pictures)
    if count != 1 + len(others):
        raise InputError(f"{count} pictures were announced, but there are {1 + len(others)}")
    first.save(path, format="PNG", save_all=True, append_images=others, duration=round(1000.0 / fps), loop=0)


def _save(path: Path, film: _Film, count: int, **settings: Any) -> None:
    try:
        film.save(path, save_all=True, loop=0, **settings)
    except EOFError as error:
        raise InputError(f"{count} pictures were announced, but there are fewer: {error}") from None


def _write_mp4(path: Path, pictures: Iterator[Picture], fps: float, count: int) -> None:
    import imageio_ffmpeg

    first = next(pictures)
    height, width = first.shape[:2]
    writer: Any = imageio_ffmpeg.write_frames  # its annotation asks for a whole number of pictures per second
    stream = writer(str(path), (width, height), fps=fps, quality=7, macro_block_size=2)
    stream.send(None)
    try:
        for picture in chain([first], pictures):
            stream.send(np.ascontiguousarray(picture))
    finally:
        stream.close()


_WRITERS: dict[str, Callable[[Path, Iterator[Picture], float, int], None]] = {
    ".webp": _write_webp, ".gif": _write_gif, ".png": _write_png, ".mp4": _write_mp4,
}  # fmt: skip


# ---- two films beside each other -------------------------------------------------------------------------------------


GAP = 4


def side_by_side(left: Iterable[Picture], right: Iterable[Picture], titles: tuple[str, str] = ("", "")) -> Iterator[Picture]:
    """Put two films (pictures of one height) next to each other, each under its title; the shorter one holds its last picture.

    Raises:
        InputError: pictures of different heights, or an empty film.
    """
    from wlr_gym.render.scene import banner  # loads MuJoCo; to check a film's name takes none

    last: list[Picture | None] = [None, None]
    for pair in zip_longest(left, right):
        last = [new if new is not None else old for new, old in zip(pair, last, strict=True)]
        shown = [picture for picture in last if picture is not None]
        if len(shown) < 2:
            raise InputError(f"film '{titles[0 if last[0] is None else 1]}' has no pictures")
        height, other = (picture.shape[0] for picture in shown)
        if height != other:
            raise InputError(f"pictures are {height} and {other} pixels high, expected one height for both films")
        if any(titles):
            labels = [banner(one.shape[1], title, max(18, height // 16)) for one, title in zip(shown, titles, strict=True)]
            shown = [np.vstack(pair) for pair in zip(labels, shown, strict=True)]
        yield np.hstack([shown[0], np.full((shown[0].shape[0], GAP, 3), 255, np.uint8), shown[1]])
