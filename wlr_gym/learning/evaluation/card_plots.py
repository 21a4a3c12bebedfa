"""Pictures of a score card: sweeps, paired improvements, spectra of the action."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from wlr_gym.learning.evaluation.card import BY_DIFFERENCE, IDLE, MAIN, Card
from wlr_gym.learning.evaluation.metrics import JITTER_FREQUENCY, Metric, has_limits
from wlr_gym.learning.evaluation.plots import save
from wlr_gym.learning.evaluation.sweeps import Sweep

#: Panels of a sweep, each a metric.
SWEPT = ("tracking_error", "success", "excess_slip")
COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive", "tab:cyan")
#: Slip in the picture of tracking against slip.
SLIP = ("slip_speed", "excess_slip", "slip_per_metre", "excess_slip_per_metre")
#: Drawn in grey: what any policy should beat.
REFERENCES = (IDLE, "untrained")
#: Distance between two subjects at one rank of a sweep without numbers.
DODGE = 0.09
MARKERS = "osD^vP*Xh"


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
        return {"color": "0.55", "marker": "", "linestyle": "--" if name == IDLE else ":"}
    rank = [other for other in card.names if other not in REFERENCES].index(name)
    return {"color": COLOURS[rank % len(COLOURS)], "marker": MARKERS[rank % len(MARKERS)]}


def sweep_curves(card: Card, sweep: Sweep) -> Figure:
    """Draw tracking error, success and slip over a sweep, a curve with its interval per subject."""
    chosen = [metric for key in SWEPT for metric in card.metrics if metric.key == key]
    figure = Figure(figsize=(4.6 * len(chosen), 4.2), layout="constrained")
    panels = figure.subplots(1, len(chosen), squeeze=False)[0]
    for axes, metric in zip(panels, chosen, strict=True):
        _draw_sweep(axes, card, sweep, metric)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)), fontsize=8)
    figure.suptitle(f"{sweep.doc}", fontsize=10)
    return figure


def _draw_sweep(axes: Axes, card: Card, sweep: Sweep, metric: Metric) -> None:
    for name in card.names:
        _draw_subject(axes, card, sweep, metric, name)
    if metric.key == "tracking_error":
        axes.axhline(1.0, color="0.3", linestyle=":", linewidth=1.2)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.set_title("tracking error (1 = at the task's scales)", fontsize=9)
    else:
        axes.set_ylim(bottom=0.0)
        axes.set_title(f"{metric.key.replace('_', ' ')} ({metric.unit})", fontsize=9)
    if sweep.name in ("friction", "grip"):
        axes.set_xscale("log")
    axes.set_xticks([point.value for point in sweep.points], [point.label for point in sweep.points], fontsize=8)
    axes.minorticks_off()
    if sweep.name == "slope":
        axes.invert_xaxis()  # the steepest on the right
    axes.set_xlabel(sweep.axis, fontsize=9)
    axes.grid(alpha=0.3)


def _draw_subject(axes: Axes, card: Card, sweep: Sweep, metric: Metric, name: str) -> None:
    x = np.array([point.value for point in sweep.points])
    estimates = [card.scores[sweep.label(point)][name][metric.key] for point in sweep.points]
    mean, low, high = ([getattr(estimate, end) for estimate in estimates] for end in ("mean", "low", "high"))
    style = _style(card, name)
    if sweep.numeric:
        axes.plot(x, mean, label=name, markersize=4, linewidth=1.3, **style)
        axes.fill_between(x, low, high, color=style["color"], alpha=0.18, linewidth=0)
        return
    x = x + DODGE * (card.names.index(name) - (len(card.names) - 1) / 2)
    axes.plot(x, mean, label=name, markersize=4, **(style | {"linestyle": "", "marker": style["marker"] or "_"}))
    axes.vlines(x, low, high, color=style["color"], linewidth=1.2)


def improvements(card: Card) -> Figure:
    """Draw by how much the first subject is better than each baseline that achieves something, in %, with intervals."""
    metrics = [m for m in card.metrics if m.key not in BY_DIFFERENCE and _comparable(card, m)]
    others = _rivals(card)
    figure = Figure(figsize=(9, 0.9 + 0.16 * len(metrics) * (len(others) + 1)), layout="constrained")
    axes = figure.subplots()
    height = 0.8 / len(others)
    for rank, name in enumerate(others):
        estimates = [card.comparison[MAIN][name][metric.key] for metric in metrics]
        y = np.arange(len(metrics)) + (rank - (len(others) - 1) / 2) * height
        mean = np.array([e.mean for e in estimates])
        ends = np.maximum(0.0, np.array([[e.mean - e.low, e.high - e.mean] for e in estimates]).T)
        axes.barh(
            y,
            mean,
            height=0.9 * height,
            xerr=ends,
            color=_style(card, name)["color"],
            label=f"against {name}",
            error_kw={"linewidth": 1},
        )
    axes.axvline(0.0, color="black", linewidth=1)
    axes.set_yticks(range(len(metrics)), [metric.key.replace("_", " ") for metric in metrics])
    axes.invert_yaxis()
    axes.set_xlim(-110, 110)
    axes.set_xlabel(f"{card.names[0]} is better by (%), 95 % interval, paired; beyond -100: cut")
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.grid(alpha=0.3, axis="x")
    return figure


def pareto(card: Card) -> Figure:
    """Draw tracking error against slip, total and excess, per second and per metre: best is what is low and left."""
    figure = Figure(figsize=(9, 7.4), layout="constrained")
    metrics = [metric for key in SLIP for metric in card.metrics if metric.key == key]
    for axes, metric in zip(figure.subplots(2, 2).flat, metrics, strict=True):
        for name in [card.names[0], *_rivals(card)]:
            error, slip = (card.scores[MAIN][name][key] for key in ("tracking_error", metric.key))
            ends = [[[e.mean - e.low], [e.high - e.mean]] for e in (error, slip)]
            style = _style(card, name) | {"linestyle": "", "capsize": 2, "elinewidth": 1}
            axes.errorbar(error.mean, slip.mean, xerr=np.abs(ends[0]), yerr=np.abs(ends[1]), label=name, **style)
        axes.set(xlabel="tracking error", ylabel=f"{metric.key.replace('_', ' ')} ({metric.unit})")
        axes.set_ylim(bottom=0.0)
        axes.set_xlim(left=0.0)
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return figure


def _rivals(card: Card) -> list[str]:
    return [name for name in card.names[1:] if name not in REFERENCES]


def _comparable(card: Card, metric: Metric) -> bool:
    return any(np.isfinite(card.comparison[MAIN][name][metric.key].mean) for name in _rivals(card))


def spectra(card: Card) -> Figure:
    """Draw the power density of each subject's action."""
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, played in card.main.items():
        if np.nanmax(played.power, initial=0.0) > 0.0:
            style = _style(card, name)
            style["marker"] = ""
            axes.plot(played.frequency[1:], played.power[1:], label=name, linewidth=1.4, **style)
    axes.axvline(JITTER_FREQUENCY, color="0.3", linestyle=":", linewidth=1.2)
    axes.set(xlabel="frequency (Hz)", ylabel="power density of the action (1/Hz)", xscale="log", yscale="log")
    axes.set_title(f"Action, mean over joints; jitter is what lies right of {JITTER_FREQUENCY:g} Hz", fontsize=10)
    axes.grid(alpha=0.3, which="both")
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize=8)
    return figure
