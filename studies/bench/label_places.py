"""Labels beside the points of a picture, each where it covers least of the lines, the points and the labels before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

#: Where a label may be, best first: points from its point to the right and up, and how it is aligned.
_PLACES = (
    (7, 0, "left", "center"),
    (-7, 0, "right", "center"),
    (5, -5, "left", "top"),
    (-5, 5, "right", "bottom"),
    (5, 5, "left", "bottom"),
    (-5, -5, "right", "top"),
    (0, 6, "center", "bottom"),
    (0, -6, "center", "top"),
)
#: Pixels between the places at which a line and a label are sampled.
_STEP = 2.0
#: Half the width of a marker, pixels.
_MARKER = 4.0


@dataclass(frozen=True)
class Label:
    """A text beside a point of the data."""

    x: float
    y: float
    text: str
    colour: str


def place_labels(figure: Figure, axes: Axes, labels: Sequence[Label]) -> None:
    """Write the labels; everything else of the figure must have been drawn, for its layout."""
    figure.draw_without_rendering()
    taken = np.concatenate([_samples(axes.transData.transform(np.asarray(line.get_xydata()))) for line in axes.lines])
    for label in labels:
        covered = [_covered(axes, label, k, taken) for k in range(len(_PLACES))]
        box = _write(axes, label, int(np.argmin(covered)))
        taken = np.concatenate([taken, _grid(box)])


def _write(axes: Axes, label: Label, place: int) -> Array:
    """Write a label at one of its places; return its corners, pixels."""
    x, y, horizontal, vertical = _PLACES[place]
    style = {"textcoords": "offset points", "fontsize": 7.5, "color": label.colour, "ha": horizontal, "va": vertical}
    return axes.annotate(label.text, (label.x, label.y), (x, y), **style).get_window_extent().get_points()


def _covered(axes: Axes, label: Label, place: int, taken: Array) -> int:
    """Return how many of the samples a label would cover."""
    (left, bottom), (right, top) = _write(axes, label, place)
    axes.texts[-1].remove()
    return int(np.sum((taken[:, 0] > left) & (taken[:, 0] < right) & (taken[:, 1] > bottom) & (taken[:, 1] < top)))


def _samples(points: Array) -> Array:
    """Return points on the lines between points (N, 2), and all over their markers."""
    counts = np.ceil(np.linalg.norm(np.diff(points, axis=0), axis=1) / _STEP).astype(int) + 1
    pieces = [np.linspace(start, end, count) for start, end, count in zip(points[:-1], points[1:], counts, strict=True)]
    markers = [_grid(np.stack([point - _MARKER, point + _MARKER])) for point in points]
    return np.concatenate([*markers, *pieces])


def _grid(box: Array) -> Array:
    """Return points all over a box of two corners."""
    x, y = (np.arange(low, high, _STEP) for low, high in box.T)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
