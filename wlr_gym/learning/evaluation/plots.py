"""Pictures of score cards, of trainings, and of floors that a randomisation draws; drawn without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MultipleLocator
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from wlr_gym.base.plots import BLUE, COLOURS, GREY, legend_below, log_axis, new_figure, save, text_colour, tidy
from wlr_gym.base.random import episode_seeds
from wlr_gym.learning.evaluation.card import BY_DIFFERENCE, IDLE, MAIN, Card
from wlr_gym.learning.evaluation.conditions import Sweep
from wlr_gym.learning.evaluation.metrics import JITTER_FREQUENCY, TRACKING, Estimate, Metric, has_limits
from wlr_gym.robot import CORNER_SIGNS
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.envs.tasks import Randomization

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
        log_axis(axes.yaxis)
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
        text = {"textcoords": "offset points", "va": "center", "fontsize": 7, "color": text_colour(to_rgb(style["color"]))}
        for place, value in zip(y[mean < -CUT], mean[mean < -CUT], strict=True):  # bars that are cut off at their end
            axes.annotate(f"{value:.0f} %", (-CUT, float(place)), (3, -0.5), **text)
    axes.axvline(0.0, color="black", linewidth=1)
    axes.set_yticks(range(len(metrics)), [metric.key.replace("_", " ") for metric in metrics])
    axes.set_ylim(len(metrics) - 0.5, -0.5)
    axes.set_xlim(-CUT, CUT)
    axes.xaxis.set_major_locator(MultipleLocator(25))
    axes.set_xlabel(f"{card.names[0]} is better by (%; left of 0 it is worse; cut at -{CUT:g}), paired, with 95 % interval")
    tidy(axes, "x")
    legend_below(figure)
    return figure


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
    log_axis(axes.xaxis if name == "x" else axes.yaxis)
    axes.minorticks_off()


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


# ---- trainings and episodes ------------------------------------------------------------------------------------------


Array = NDArray[np.float64]

#: Terms of the reward that have a curve of their own.
TERMS = 4


def learning_curve(curve: Sequence[Mapping[str, float]], references: Mapping[str, float]) -> Figure:
    """Draw what training achieved per update.

    Args:
        curve: rows with ``steps``, ``reward_per_second``, ``slip_speed`` and ``term.*``.
        references: name -> reward per second of policies to compare with.
    """
    figure = new_figure(10.0, 4.0)
    left, right = figure.subplots(1, 2)
    steps = np.array([row["steps"] for row in curve]) / 1e6
    left.plot(steps, [row["reward_per_second"] for row in curve], color=BLUE, label="PPO, with its exploration")
    for (name, value), style in zip(references.items(), ("--", ":", "-.", (0, (1, 4))), strict=False):
        left.axhline(value, color="0.3", linestyle=style, linewidth=1.2, label=name)
    left.set(xlabel="environment steps (millions)", ylabel="reward per second", title="Reward while training")
    left.legend(fontsize=8)
    _draw_terms(right, steps, curve)
    for axes in (left, right):
        tidy(axes)
    return figure


def _draw_terms(axes: Axes, steps: Array, curve: Sequence[Mapping[str, float]]) -> None:
    """Draw the terms of the reward that ever count most, and the sum of the others."""
    values = {key.removeprefix("term."): np.array([row[key] for row in curve]) for key in curve[0] if key.startswith("term.")}
    ranked = sorted(values, key=lambda name: -float(np.abs(values[name]).max()))
    for name, colour in zip(ranked[:TERMS], COLOURS, strict=False):
        axes.plot(steps, values[name], color=colour, label=name)
    if others := ranked[TERMS:]:
        axes.plot(steps, np.sum([values[name] for name in others], axis=0), color=GREY, label=f"{len(others)} others")
    axes.set(xlabel="environment steps (millions)", ylabel="reward per second", title="What the reward is made of")
    axes.legend(fontsize=8)


# ---- floors seen from above, coloured by friction, each with its robot's wheels --------------------------------------

#: Floors of one randomisation.
COUNT = 8
#: Floors of one randomisation beside each other, randomisations beside each other.
_COLUMNS, _BLOCKS = 4, 3
#: m from the start that is shown.
_REACH = 1.3
_COLOURS = "viridis"


def draw_floors(path: Path, randomizations: Sequence[Randomization], first_seed: int = 0, count: int = COUNT) -> None:
    """Draw the floors of ``reset(seed=first_seed)`` and the next seeds, a block per randomisation, and write the picture."""
    columns, beside = min(count, _COLUMNS), min(len(randomizations), _BLOCKS)
    rows, below = -(-count // columns), -(-len(randomizations) // beside)
    size = 2.2 if beside == 1 else 1.75 if count == 1 else 1.2
    height = (size * rows + 0.2) * below + 0.3
    figure = new_figure(size * (columns + 0.2) * beside + 0.4, height + 0.7)
    norm = LogNorm(0.05, 1.0, clip=True)  # friction coefficients at the ends of the colours
    floors, foot = figure.add_gridspec(2, 1, height_ratios=(height, 0.6))
    widths = [*([1.0] * columns + [0.2]) * beside][:-1]  # a gap between blocks
    grid = floors.subgridspec(rows * below, len(widths), width_ratios=widths)
    robot_seeds = first_seed + np.arange(count, dtype=np.uint64)
    for block, randomization in enumerate(randomizations):
        top, left = rows * (block // beside), (columns + 1) * (block % beside)
        panels = [figure.add_subplot(grid[top + k // columns, left + k % columns]) for k in range(count)]
        _draw_block(panels, randomization, robot_seeds, norm)
        for k, axes in enumerate(panels):
            is_first, is_last = left + k % columns == 0, block + beside >= len(randomizations) and k + columns >= count
            axes.tick_params(labelleft=is_first, labelbottom=is_last)
            axes.set_ylabel("y (m)" if is_first else "", fontsize=8)
            axes.set_xlabel("x (m)" if is_last else "", fontsize=8)
    place = figure.add_subplot(foot.subgridspec(1, 3, width_ratios=(1, 2, 1))[1])
    ticks = [0.05, 0.1, 0.2, 0.5, 1.0]
    bar = figure.colorbar(ScalarMappable(norm, _COLOURS), place, orientation="horizontal", ticks=ticks, format="%g")
    bar.set_label("friction coefficient along the heading", fontsize=9)
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=8)
    save(figure, path)


def _draw_block(panels: Sequence[Axes], randomization: Randomization, robot_seeds: NDArray[np.uint64], norm: Normalize) -> None:
    seeds = episode_seeds(robot_seeds, np.zeros(len(robot_seeds), np.int64))
    parameters = randomization.parameters(robot_seeds, seeds)
    state = randomization.state(parameters, seeds)
    yaw = 2 * np.arctan2(state.quaternion[:, 3], state.quaternion[:, 0])
    for k, axes in enumerate(panels):
        _draw(axes, Parameters(parameters.values[k : k + 1]), float(yaw[k]), norm)
    panels[0].set_title(randomization.config.name, fontsize=10, loc="left")


def _draw(axes: Axes, parameters: Parameters, yaw: float, norm: Normalize) -> None:
    colours = colormaps[_COLOURS]
    ground = float(parameters["ground.mu_x"].mean())
    axes.set_facecolor(colours(norm(ground)))
    ink = "black" if norm(ground) > 0.6 else "white"
    edges = ("mu", "x_min", "x_max", "y_min", "y_max")
    areas = np.stack([parameters[f"patch.{name}"][0] for name in edges], axis=1)
    for mu, x_min, x_max, y_min, y_max in areas:
        if x_max > x_min and y_max > y_min:
            axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, color=colours(norm(mu)), linewidth=0))
    turn = Affine2D().rotate(yaw) + axes.transData
    hip_x, hip_y, _ = parameters["hip.position"][0]
    for (sign_x, sign_y), grip, mu_x in zip(
        CORNER_SIGNS, parameters["wheel.grip"][0], parameters["ground.mu_x"][0], strict=True
    ):
        x, y = sign_x * hip_x, sign_y * hip_y
        place = np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y
        under = [mu for mu, x_min, x_max, y_min, y_max in areas if x_min < place[0] < x_max and y_min < place[1] < y_max]
        mu = grip * (under[-1] if under else mu_x)
        wheel = Rectangle((x - 0.11, y - 0.06), 0.22, 0.12, facecolor=colours(norm(mu)), edgecolor=ink, linewidth=0.8)
        wheel.set_transform(turn)
        axes.add_patch(wheel)
    axes.plot([0.0, 0.4], [0.0, 0.0], color=ink, linewidth=1.2, transform=turn)
    axes.set(xlim=(-_REACH, _REACH), ylim=(-_REACH, _REACH), aspect="equal", xticks=[-1, 0, 1], yticks=[-1, 0, 1])
    axes.tick_params(labelsize=7)
