"""Curves over time on the page, drawn by uPlot, which viser's page brings along."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import viser

Array = NDArray[np.float64]

#: Columns of a plot: more points than it has pixels are not drawn.
COLUMNS = 400
#: Colours of a plot's curves, and of the line at the present time.
COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#17becf", "#e377c2")
_NOW = "#444444"
#: Pixels; height of a plot.
_HEIGHT = 190
#: s; half the width of the line at the present time.
_THIN = 1e-6
NOTHING = "(nothing)"


@dataclass(frozen=True, eq=False)
class Curve:
    """A channel over time.

    Attributes:
        label: in the legend.
        t: (n,) s, rising.
        values: (n,); NaN where there is none.
        dashed: as of what is simulated beside what was measured.
        colour: place in :data:`COLOURS`.
    """

    label: str
    t: Array
    values: Array
    dashed: bool = False
    colour: int = 0


def thinned(curve: Curve, begin: float, end: float) -> tuple[Array, Array]:
    """Return a curve between two times with at most about two points per column: the least and the greatest in it.

    Values that are NaN are left out: a line goes to the next one.
    """
    first, last = np.searchsorted(curve.t, [begin, end])
    first, last = max(int(first) - 1, 0), min(int(last) + 1, len(curve.t))
    t, values = curve.t[first:last], curve.values[first:last]
    known = np.isfinite(values)
    t, values = t[known], values[known]
    if len(t) <= 2 * COLUMNS:
        return t, values
    width = -(-len(t) // COLUMNS)
    padded = np.pad(values, (0, -len(values) % width), mode="edge").reshape(-1, width)
    starts = width * np.arange(len(padded))
    kept = np.unique(np.concatenate([starts + padded.argmin(axis=1), starts + padded.argmax(axis=1)]))
    return t[kept], values[kept]


def aligned(curves: Sequence[Curve], begin: float, end: float, now: float) -> tuple[Array, ...]:
    """Return what uPlot draws: common times, a row of values per curve, and a row that is a line at the present time.

    A curve has a value at each of the times between its own: on the line between them, so that what is drawn is the same.
    Before and after all its own times it stays as it is, and the line at the present time runs along the bottom: with a NaN
    in it, uPlot as viser feeds it draws nothing.
    """
    pieces = [thinned(curve, begin, end) for curve in curves]
    shown = np.concatenate([values for _, values in pieces]) if pieces else np.zeros(0)
    low, high = (float(shown.min()), float(shown.max())) if len(shown) else (0.0, 1.0)
    margin = 0.05 * (high - low) or 1e-3
    t = np.unique(np.concatenate([[begin, now - _THIN, now, now + _THIN, end], *(piece for piece, _ in pieces)]))
    t = t[(t >= begin) & (t <= end)]
    rows = [np.interp(t, *piece) if len(piece[0]) else np.zeros(len(t)) for piece in pieces]
    line = np.full(len(t), low - margin)
    place = int(np.searchsorted(t, now))
    line[place : place + 1] = high + margin
    return (t, *rows, line)


class Plots:
    """Plots that whoever watches chooses the channels of.

    Args:
        server: of the page.
        place: panel that they stand in.
        titles: what can be drawn, and its unit.
        first: what is drawn until something else is chosen.
    """

    def __init__(self, server: viser.ViserServer, place: Any, titles: Mapping[str, str], first: Sequence[str]) -> None:
        self._server, self._place, self._units = server, place, dict(titles)
        options = (NOTHING, *titles)
        self._choices: list[Any] = []
        self._plots: list[Any] = []
        self._drawn: list[tuple[str, ...]] = []
        with place:
            for k, name in enumerate(first):
                chosen = name if name in titles else NOTHING
                self._choices.append(server.gui.add_dropdown(f"plot {k + 1}", options, initial_value=chosen))
                self._plots.append(None)
                self._drawn.append(())
        self._places = [choice.order for choice in self._choices]

    @property
    def chosen(self) -> list[str]:
        """What each plot shows."""
        return [str(choice.value) for choice in self._choices]

    def offer(self, titles: Mapping[str, str]) -> None:
        """Change what can be drawn; what is drawn stays where it can."""
        self._units = dict(titles)
        for choice in self._choices:
            kept = choice.value if choice.value in titles else NOTHING
            choice.options = (NOTHING, *titles)
            choice.value = kept

    def draw(self, curves: Mapping[str, Sequence[Curve]], begin: float, end: float, now: float) -> None:
        """Draw, from ``begin`` to ``end`` (s), the curves of what was chosen."""
        for k, name in enumerate(self.chosen):
            mine = [one for one in curves.get(name, ()) if len(one.t) > 0 and one.t[0] <= end and one.t[-1] >= begin]
            drawn = (name, *(curve.label for curve in mine))
            if self._plots[k] is not None and drawn != self._drawn[k]:
                self._plots[k].remove()
                self._plots[k] = None
            self._drawn[k] = drawn
            if not mine:
                continue
            data = aligned(mine, begin, end, now)
            if self._plots[k] is None:
                self._plots[k] = self._add(name, mine, data, self._places[k] + 0.5)
            else:
                self._plots[k].data = data

    def _add(self, name: str, curves: Sequence[Curve], data: tuple[Array, ...], order: float) -> Any:
        series: list[dict[str, Any]] = [{"label": "t (s)"}]
        for curve in curves:
            line = {"label": curve.label, "stroke": COLOURS[curve.colour % len(COLOURS)], "width": 1.5}
            series.append(line | ({"dash": (6, 4)} if curve.dashed else {}))
        series.append({"label": "now", "stroke": _NOW, "width": 1})
        unit = self._units.get(name, "")
        with self._place:
            return self._server.gui.add_uplot(
                data,
                tuple(series),  # pyright: ignore[reportArgumentType]
                title=f"{name} ({unit})" if unit else name,
                scales={"x": {"time": False}},
                legend={"show": True},
                height=_HEIGHT,
                order=order,
            )
