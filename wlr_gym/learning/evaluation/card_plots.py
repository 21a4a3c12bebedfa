"""Pictures of a score card: sweeps, paired improvements, spectra of the action."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MultipleLocator

from wlr_gym.base.plots import COLOURS, GREY, legend_below, new_figure, save, text_colour, tidy
from wlr_gym.learning.evaluation.card import BY_DIFFERENCE, IDLE, MAIN, Card
from wlr_gym.learning.evaluation.metrics import JITTER_FREQUENCY, TRACKING, Metric, has_limits
from wlr_gym.learning.evaluation.statistics import Estimate
from wlr_gym.learning.evaluation.sweeps import Sweep

#: Panels of a sweep, each a metric.
SWEPT = ("tracking_error", "success", "excess_slip")
#: Slip in the picture of tracking against slip.
SLIP = ("slip_speed", "excess_slip")
#: Not among the improvements that are drawn: what another row says too, or shares that are often near 0 %.
UNDRAWN = (*(metric.key for metric in TRACKING), "slip_per_metre", "excess_slip_per_metre", "saturation", "action_saturation")
#: Drawn in grey: what any policy should beat.
REFERENCES = (IDLE, "untrained")
#: Distance between two subjects at one rank of a sweep without numbers.
DODGE = 0.09
MARKERS = "osD^vP*Xh"
#: Told apart without colour too; one more than there are colours, so that the two do not repeat together.
LINES = ("-", (0, (6, 1.5)), "-.", (0, (1.2, 1)), (0, (6, 1.5, 1, 1.5, 1, 1.5)), (0, (3, 3)))
#: %; improvements beyond it are cut off.
CUT = 100.0
#: Largest by smallest value of an axis beyond which it is logarithmic.
WIDE = 10.0


def draw_card(folder: Path, card: Card) -> dict[str, str]:
    """Write the card's pictures into ``folder``; returns name -> file."""
    figures = {"spectrum": spectra(card)}
    if _rivals(card):
        figures["improvement"] = improvements(card)
        if has_limits(card.main[card.names[0]].measures):
            figures["pareto"] = pareto(card)
    figures |= {f"sweep_{sweep.name}": sweep_curves(card, sweep) for sweep in card.sweeps}
    return {name: save(figure, folder / f"{name}.png").name for name, figure in figures.items()}


def _style(card: Card, name: str) -> dict[str, Any]:
    if name in REFERENCES:
        return {"color": GREY, "marker": "", "linestyle": "--" if name == IDLE else ":"}
    rank = [other for other in card.names if other not in REFERENCES].index(name)
    line = LINES[rank % len(LINES)]
    return {"color": COLOURS[rank % len(COLOURS)], "marker": MARKERS[rank % len(MARKERS)], "linestyle": line}


def _scale(metric: Metric) -> tuple[float, str]:
    """Return the factor and the axis label of a metric: slip in mm/s."""
    name = metric.key.replace("_", " ")
    if metric.key == "tracking_error":
        return 1.0, f"{name} (1 = at the task's scales)"
    return (1e3, f"{name} (mm/s)") if metric.key in SLIP else (1.0, f"{name} ({metric.unit})")


def sweep_curves(card: Card, sweep: Sweep) -> Figure:
    """Draw tracking error, success and slip over a sweep below each other, a curve with its interval per subject."""
    chosen = [metric for key in SWEPT for metric in card.metrics if metric.key == key]
    figure = new_figure(7.0, 1.1 + 1.9 * len(chosen))
    panels = figure.subplots(len(chosen), 1, squeeze=False, sharex=True)[:, 0]
    for axes, metric in zip(panels, chosen, strict=True):
        _draw_sweep(axes, card, sweep, metric)
    if sweep.name == "slope":
        panels[-1].invert_xaxis()  # the steepest on the right
    panels[-1].set_xlabel(sweep.axis, fontsize=9)
    legend_below(figure, columns=3)
    figure.suptitle(f"{sweep.doc}", fontsize=10)
    return figure


def _draw_sweep(axes: Axes, card: Card, sweep: Sweep, metric: Metric) -> None:
    for name in card.names:
        _draw_subject(axes, card, sweep, metric, name)
    if metric.key == "tracking_error":
        axes.axhline(1.0, color="0.3", linestyle=":", linewidth=1.2)
        axes.set_yscale("log")
        _plain_log(axes.yaxis)
    else:
        axes.set_ylim(*((-2.0, 102.0) if metric.unit == "%" else (0.0, None)))
    if sweep.name in ("friction", "grip"):
        axes.set_xscale("log")
    axes.set_xticks([point.value for point in sweep.points], [point.label for point in sweep.points])
    axes.minorticks_off()
    axes.set_ylabel(_scale(metric)[1].replace(" (", "\n(", 1))
    tidy(axes, "both" if sweep.numeric else "y")
    if not sweep.numeric:
        for left in np.arange(len(sweep.points) + 1) - 0.5:
            axes.axvline(left, color="0.9", linewidth=0.8, zorder=0)
        axes.set_xlim(-0.5, len(sweep.points) - 0.5)


def _draw_subject(axes: Axes, card: Card, sweep: Sweep, metric: Metric, name: str) -> None:
    x = np.array([point.value for point in sweep.points])
    estimates = [card.scores[sweep.label(point)][name][metric.key] for point in sweep.points]
    ends = np.array([[e.mean, e.low, e.high] for e in estimates])
    mean, low, high = _scale(metric)[0] * ends.T
    style = _style(card, name)
    if sweep.numeric:
        axes.plot(x, mean, label=name, markersize=4, linewidth=1.3, **style)
        axes.fill_between(x, low, high, color=style["color"], alpha=0.15, linewidth=0)
        return
    x = x + DODGE * (card.names.index(name) - (len(card.names) - 1) / 2)
    axes.plot(x, mean, label=name, markersize=4, **(style | {"linestyle": "", "marker": style["marker"] or "_"}))
    axes.vlines(x, low, high, color=style["color"], linewidth=1.2)


def improvements(card: Card) -> Figure:
    """Draw by how much the first subject is better than each baseline that achieves something, in %, with intervals."""
    others = _rivals(card)
    better = [card.comparison[MAIN][name] for name in others]
    drawn = [m for m in card.metrics if m.key not in (*BY_DIFFERENCE, *UNDRAWN)]
    metrics = [m for m in drawn if any(np.isfinite(own[m.key].mean) for own in better)]
    figure = new_figure(9.0, 0.9 + 0.12 * len(metrics) * (len(others) + 1))
    axes = figure.subplots()
    height = 0.8 / len(others)
    for rank, name in enumerate(others):
        estimates = [better[rank][metric.key] for metric in metrics]
        y = np.arange(len(metrics)) + (rank - (len(others) - 1) / 2) * height
        mean = np.array([e.mean for e in estimates])
        ends = np.maximum(0.0, np.array([[e.mean - e.low, e.high - e.mean] for e in estimates]).T)
        style = {"color": _style(card, name)["color"], "label": f"against {name}", "error_kw": {"linewidth": 1}}
        axes.barh(y, mean, height=0.9 * height, xerr=ends, **style)
        for place, value in zip(y[mean < -CUT], mean[mean < -CUT], strict=True):
            _write_cut(axes, float(place), float(value), style["color"])
    axes.axvline(0.0, color="black", linewidth=1)
    axes.set_yticks(range(len(metrics)), [metric.key.replace("_", " ") for metric in metrics])
    axes.set_ylim(len(metrics) - 0.5, -0.5)
    axes.set_xlim(-CUT, CUT)
    axes.xaxis.set_major_locator(MultipleLocator(25))
    axes.set_xlabel(f"{card.names[0]} is better by (%; left of 0 it is worse; cut at -{CUT:g}), paired, with 95 % interval")
    tidy(axes, "x")
    legend_below(figure)
    return figure


def _write_cut(axes: Axes, y: float, value: float, colour: str) -> None:
    """Write the value of a bar that is cut off at its end."""
    style = {"textcoords": "offset points", "va": "center", "fontsize": 7, "color": text_colour(to_rgb(colour))}
    axes.annotate(f"{value:.0f} %", (-CUT, y), (3, -0.5), **style)


def pareto(card: Card) -> Figure:
    """Draw tracking error against slip, total and excess: best is what is low and left."""
    figure, shown = new_figure(9.0, 4.0), [card.names[0], *_rivals(card)]
    error, *slips = [metric for key in ("tracking_error", *SLIP) for metric in card.metrics if metric.key == key]
    for axes, slip in zip(figure.subplots(1, len(slips)), slips, strict=True):
        for name in shown:
            scores = card.scores[MAIN][name]
            x, y = (_scale(m)[0] * np.array([scores[m.key].mean, scores[m.key].low, scores[m.key].high]) for m in (error, slip))
            style = _style(card, name) | {"linestyle": "", "capsize": 2, "elinewidth": 1}
            axes.errorbar(x[0], y[0], xerr=np.abs(x[1:, None] - x[0]), yerr=np.abs(y[1:, None] - y[0]), label=name, **style)
        axes.set(xlabel=_scale(error)[1], ylabel=_scale(slip)[1])
        tidy(axes)
        _fit(axes, "x", [card.scores[MAIN][name][error.key] for name in shown])
        _fit(axes, "y", [card.scores[MAIN][name][slip.key] for name in shown])
    legend_below(figure, columns=5)
    return figure


def _fit(axes: Axes, name: Literal["x", "y"], estimates: Sequence[Estimate]) -> None:
    """Let an axis begin at 0, or make it logarithmic where its values are wide apart."""
    low, high = min(one.low for one in estimates), max(one.high for one in estimates)
    if not high > WIDE * low > 0.0:
        axes.set(**{f"{name}lim": (0.0, None)})
        return
    axes.set(**{f"{name}scale": "log"})
    _plain_log(axes.xaxis if name == "x" else axes.yaxis)
    axes.minorticks_off()


def _plain_log(axis: Axis) -> None:
    """Write the numbers of a logarithmic axis without powers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")


def _rivals(card: Card) -> list[str]:
    return [name for name in card.names[1:] if name not in REFERENCES]


def spectra(card: Card) -> Figure:
    """Draw the power density of each subject's action."""
    figure = new_figure(7.0, 4.2)
    axes = figure.subplots()
    for name, played in card.main.items():
        if np.nanmax(played.power, initial=0.0) > 0.0:
            style = _style(card, name)
            style["marker"] = ""
            axes.plot(played.frequency[1:], played.power[1:], label=name, linewidth=1.4, **style)
    axes.axvline(JITTER_FREQUENCY, color="0.3", linestyle=":", linewidth=1.2)
    axes.set(xlabel="frequency (Hz)", ylabel="power density of the action (1/Hz)", xscale="log", yscale="log")
    axes.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axes.set_title(f"Action, mean over joints; jitter is what lies right of {JITTER_FREQUENCY:g} Hz", fontsize=10)
    axes.minorticks_off()
    tidy(axes)
    legend_below(figure, columns=3)
    return figure
