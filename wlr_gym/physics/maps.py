"""Maps of a floor, of heights or of friction: read from files, drawn from a seed, kept as text in the floor's own content.

A map has rows and columns of square cells and is seen from above: its columns lie along x, its first row has the largest y, as
in a picture. Inside, the first row has the smallest y. A floor holds the numbers themselves, so that what was driven on it can
be driven again when the file has changed or is gone.
"""

from __future__ import annotations

import base64
import binascii
import warnings
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.physics.plants.relief import enter_map, map_of

Array = NDArray[np.float64]

#: Numbers are kept in whole multiples of this: heights to a micrometre.
RESOLUTION = 1e-6
#: A map's content goes into every file that names the floor: no more cells than these.
MOST_CELLS = 2**16
_LARGEST = 1e3  # differences fit 32 bits


def read_map(path: Path) -> str:
    """Return the text of a map in a file: CSV or NPY with its numbers, or PNG with 0 for black to 1 for white.

    Raises:
        InputError: naming the file, what is wrong with it, and what is expected.
    """
    readers = {".csv": _read_csv, ".npy": _read_npy, ".png": _read_png}
    kind = path.suffix.lower()
    if kind not in readers:
        raise InputError(f"{path}: '{kind}' is no kind of map{nearest(kind, readers)}; expected {', '.join(readers)}")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; expected a map of the floor")
    try:
        values = readers[kind](path)
    except Exception as error:  # a broken file makes readers raise nearly anything
        raise InputError(f"{path}: cannot be read as {kind[1:].upper()}: {error}; expected a table of numbers") from None
    if values.dtype.kind not in "biuf":
        raise InputError(f"{path}: holds values of type {values.dtype}: expected real numbers")
    return map_text(values.astype(np.float64), str(path))


def _read_csv(path: Path) -> Array:
    with warnings.catch_warnings(action="ignore", category=UserWarning):  # an empty file is refused for its shape
        return np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")  # spreadsheets write a byte-order mark


def _read_npy(path: Path) -> NDArray[Any]:
    with path.open("rb") as file:  # np.load would open archives, too
        return np.lib.format.read_array(file)


def _read_png(path: Path) -> Array:
    from matplotlib.image import imread

    picture = np.asarray(imread(path), np.float64)
    return picture if picture.ndim == 2 else picture[:, :, : 3 if picture.shape[2] > 2 else 1].mean(axis=2)


def map_text(values: Array, where: str = "map") -> str:
    """Return a map, its first row with the largest y, as text."""
    if values.ndim != 2 or not values.size:
        raise InputError(f"{where}: has shape {values.shape}: expected rows and columns")
    if values.size > MOST_CELLS:
        rows, columns = values.shape
        raise InputError(
            f"{where}: has {rows} x {columns} cells: expected at most {MOST_CELLS} in all; cut it, or widen its cells"
        )
    wrong = values[~(np.abs(values) <= _LARGEST)]
    if wrong.size:
        raise InputError(f"{where}: holds {wrong[0]:g}: expected finite numbers within {_LARGEST:g}")
    whole = np.rint(values / RESOLUTION).astype("<i4")
    packed = zlib.compress(np.diff(whole, axis=1, prepend=0).astype("<i4").tobytes(), 9)
    return f"{values.shape[0]}x{values.shape[1]}_{base64.b64encode(packed).decode()}"


@cache
def map_values(text: str) -> Array:
    """Return the numbers of a map's text, the first row with the smallest y."""
    size, _, packed = text.partition("_")
    try:
        rows, columns = map(int, size.split("x"))
        whole = np.frombuffer(zlib.decompress(base64.b64decode(packed)), "<i4")
        if min(rows, columns) < 1 or rows * columns != whole.size:
            raise ValueError
    except (ValueError, binascii.Error, zlib.error):
        raise InputError(f"data = {text[:20]!r}...: is no map; expected 'file', or what a floor's content says") from None
    return RESOLUTION * np.cumsum(whole.reshape(rows, columns), axis=1, dtype=np.int64)[::-1].astype(np.float64)


@cache
def random_heights(seed: int, size: tuple[float, float], cell: float, height: float, length: float) -> str:
    """Return the text of Gaussian heights of zero mean: alike in all directions, correlated as exp(-(distance/length)^2).

    Args:
        seed: of what is drawn.
        size: along x and y, m.
        cell: m.
        height: root mean square, m.
        length: m.
    """
    columns, rows = (max(round(side / cell), 1) for side in size)
    if rows * columns > MOST_CELLS:  # before they are drawn
        raise InputError(f"random.size = {size}: {rows} x {columns} cells of {cell:g} m: expected at most {MOST_CELLS} in all")
    noise = np.fft.rfft2(np.random.default_rng(seed).standard_normal((rows, columns)))
    squared = (2 * np.pi / cell) ** 2 * (np.fft.fftfreq(rows)[:, None] ** 2 + np.fft.rfftfreq(columns) ** 2)
    field = np.fft.irfft2(noise * np.exp(-squared * length**2 / 8), (rows, columns))
    field -= field.mean()
    return map_text(height * field / max(float(field.std()), 1e-12))


@cache
def enter_heights(text: str) -> int:
    """Return the number of the map of weights with which a biquadratic spline goes through the heights of a text."""
    from scipy.ndimage import spline_filter

    heights = map_values(text)
    # 'reflect' takes the outermost row for its own neighbour, as the contact does
    return enter_map(spline_filter(heights, order=2, mode="reflect") if heights.size > 1 else heights)


@cache
def enter_friction(text: str) -> int:
    """Return the number of the map of friction of a text."""
    return enter_map(map_values(text))


@cache
def sharpest(number: int) -> float:
    """Return the largest curvature of the spline over a map of weights, per cell: of corners, edges and middles of cells."""
    weights = np.pad(map_of(number), 2, mode="edge")
    share = {0.0: (0.5, 0.5, 0.0), 0.5: (0.125, 0.75, 0.125), 1.0: (0.0, 0.5, 0.5)}
    slope = {0.0: (-1.0, 1.0, 0.0), 0.5: (-0.5, 0.0, 0.5), 1.0: (0.0, -1.0, 1.0)}

    def along(values: Array, factors: tuple[float, ...]) -> Array:
        return sum((factor * values[:, k : values.shape[1] - 2 + k] for k, factor in enumerate(factors)), np.zeros(1))

    def across(values: Array, factors: tuple[float, ...]) -> Array:
        return along(values.T, factors).T

    most = 0.0
    for u in share:
        for v in share:
            xx, yy = (across(along(weights, (1.0, -2.0, 1.0)), share[v]), along(across(weights, (1.0, -2.0, 1.0)), share[u]))
            xy = across(along(weights, slope[u]), slope[v])
            most = max(most, float((0.5 * np.abs(xx + yy) + np.hypot(0.5 * (xx - yy), xy)).max()))
    return most
