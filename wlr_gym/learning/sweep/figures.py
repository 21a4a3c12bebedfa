"""Pictures of a sweep. Matplotlib only, drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.plots import COLOURS, PALE, new_figure, tidy
from wlr_gym.learning.sweep.plan import METRICS
from wlr_gym.learning.sweep.results import Summary, TrialResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: So many values of a setting have a tick each.
_FEW = 5
#: So many letters of words are written level.
_LEVEL = 40
_WORDS = {
    "tracking_error": "tracking error (1 = at the task's scales)",
    "success": "success (%)",
    "excess_slip": "slip beyond a turn's (m/s)",
    "reward": "reward per episode",
}


def curves(ranking: Sequence[Summary], names: Sequence[str], metric: str) -> Figure:
    """Draw the deciding metric and success over the steps: mean over the seeds, and a band from the least to the largest.

    The best settings have a colour each, best first; all others are grey.

    Args:
        ranking: best first.
        names: of the settings in ``ranking``, for the legend.
        metric: that decides.
    """
    figure = new_figure(10.0, 4.6)
    scored = {name for summary in ranking for one in summary.results for name in one.final}
    shown = [metric, *(name for name in ("success", "reward") if name != metric and name in scored)][:2]
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, name in zip(panels, shown, strict=True):
        for rank in reversed(range(len(ranking))):
            _draw(axes, ranking[rank], names[rank], name, COLOURS[rank] if rank < len(COLOURS) else PALE)
        axes.set(xlabel="environment steps (millions)", ylabel=_WORDS[name])
        tidy(axes)
        if name == "success":
            axes.set_ylim(-2.0, 102.0)
        if name == "tracking_error":
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:g}")
            axes.tick_params(axis="y", which="minor", labelsize=7)
    handles, labels = panels[0].get_legend_handles_labels()
    best = slice(None, -len(COLOURS) - 1, -1)
    figure.legend(handles[best], labels[best], loc="outside lower center", ncols=2 if len(labels) > 2 else 1, fontsize=8)
    return figure


def _draw(axes: Axes, summary: Summary, label: str, metric: str, colour: str) -> None:
    steps, rows = _aligned(summary.results, metric)
    if not len(steps):
        return
    style: dict[str, Any] = {"color": colour, "linewidth": 1.6 if colour != PALE else 1.0}
    axes.plot(steps / 1e6, np.nanmean(rows, axis=0), label=label, marker="o", markersize=3, **style)
    if len(rows) > 1:
        low, high = np.nanmin(rows, axis=0), np.nanmax(rows, axis=0)
        axes.fill_between(steps / 1e6, low, high, color=colour, alpha=0.15, linewidth=0)


def _aligned(results: Sequence[TrialResult], metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the steps at which most seeds were scored, and the scores (seeds, steps) there; NaN where one ended before."""
    rows: list[Mapping[float, float]] = [
        {row["steps"]: row[metric] for row in one.scores if row["steps"] > 0 and metric in row} for one in results
    ]
    steps = sorted({step for row in rows for step in row})
    return np.array(steps), np.array([[row.get(step, np.nan) for step in steps] for row in rows])


def effects(results: Sequence[TrialResult], shares: Mapping[str, float], metric: str) -> Figure:
    """Draw the final scores of all trials over each setting, the most important first."""
    names = list(shares)[:4]
    values = [[one.trial.settings[name] for one in results] for name in names]
    words = max(len({value for value in column if isinstance(value, str)}) for column in values)
    figure = new_figure(min(10.0, max(3.3, 0.4 * words) * len(names)), 3.2 if words <= _FEW else 4.4)
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False, sharey=True)[0], names, strict=True):
        _draw_effect(axes, [one for one in results if metric in one.final], name, metric)
        axes.set_title(f"{name}: {100 * shares[name]:.0f} %", fontsize=9)
        tidy(axes)
    figure.axes[0].set_ylabel(_WORDS[metric], fontsize=8)
    return figure


def _draw_effect(axes: Axes, results: Sequence[TrialResult], name: str, metric: str) -> None:
    values = [one.trial.settings[name] for one in results]
    scores = np.array([one.final[metric] for one in results])
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        x = np.array(values, dtype=float)
        if x.min() > 0.0 and x.max() / x.min() >= 10.0:
            axes.set_xscale("log")
        if len(np.unique(x)) <= _FEW:
            axes.set_xticks(np.unique(x), [f"{value:g}" for value in np.unique(x)])
            axes.minorticks_off()
    else:
        words = list(dict.fromkeys(str(value) for value in values))
        x = np.array([words.index(str(value)) for value in values], dtype=float)
        level = sum(map(len, words)) <= _LEVEL
        axes.set_xticks(range(len(words)), words, rotation=0 if level else 40, ha="center" if level else "right")
    axes.plot(x, scores, "o", color=COLOURS[0], markersize=4, alpha=0.5, markeredgewidth=0)
    axes.margins(x=0.15)
    axes.tick_params(labelsize=8)
    kinds = np.unique(x)
    if len(kinds) < len(x):
        axes.plot(kinds, [scores[x == kind].mean() for kind in kinds], "_", color="black", markersize=18)
    if METRICS[metric] and scores.min() > 0.0 and scores.max() / scores.min() > 5.0:
        axes.set_yscale("log")
