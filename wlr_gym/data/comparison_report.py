"""What a comparison of plants looks like: tables for screen and Markdown, a figure per motion, a map of all differences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wlr_gym.base.plots import BLUE, GREEN, ORANGE, new_figure, save, text_colour, tidy
from wlr_gym.data.comparison import BOUNDS, HORIZON, Comparison, MotionComparison, difference

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Panels of a motion's figure: signals drawn together.
_PANELS = (
    ("true_xy",), ("true_yaw", "true_tilt"), ("pos_leg",), ("vel_wheel",), ("motor_torque_leg",), ("motor_torque_wheel",),
    ("normal_force",), ("total_along", "total_across"), ("total_turn",), ("slip_along", "slip_across"), ("gyro",),
    ("friction_across",),
)  # fmt: skip
# Colours of the first and the second plant.
_FIRST, _SECOND = BLUE, ORANGE


@dataclass(frozen=True)
class ReportTable:
    """A table of strings: title, headings, rows; the first column holds names."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Return it as Markdown."""
        lines = [self.headings, tuple("---" if k == 0 else "--:" for k in range(len(self.headings))), *self.rows]
        return "\n".join([f"**{self.title}**", "", *(f"| {' | '.join(line)} |" for line in lines)])


def tables(comparison: Comparison) -> list[ReportTable]:
    """Return the tables of one comparison: agreement, differences by signal, and what becomes of them at half the steps."""
    plants = " against ".join(traces.plant.label for traces in (comparison.second, comparison.first))
    note = f"{plants}; effects: {comparison.effects}"
    found = [_agreement_table(f"Agreement, {note}", comparison.cases)]
    if comparison.half:
        found.append(_agreement_table("The same at half of both steps", comparison.half))
    rows = [
        (
            _starred(comparison, name),
            signal.unit,
            f"{signal.resolution:.2g}",
            *(_noise(case.differences[name].rms_in_noise) for case in comparison.cases),
        )
        for name, signal in comparison.signals.items()
    ]
    motions = tuple(case.motion for case in comparison.cases)
    found.append(
        ReportTable(
            "Rms difference in units of sensor noise; *: how wheels that stick share a load is open",
            ("signal", "unit", "noise", *motions),
            tuple(rows),
        )
    )
    if comparison.half and comparison.own:
        found.append(_convergence_table(comparison, comparison.half, *comparison.own))
    return found


def _agreement_table(title: str, cases: Sequence[MotionComparison]) -> ReportTable:
    """Return the figures that :data:`wlr_gym.data.comparison.BOUNDS` bounds, one row per case; ``!`` marks a broken bound."""
    headings = (
        "motion", "travel m", f"apart after {HORIZON:g} s mm", "% of travel", "yaw deg", "leg torque %", "wheel torque %",
        "diverges first in", "at s",
    )  # fmt: skip
    rows = []
    for case in cases:
        found, (first, time) = case.agreement, case.first or ("never", None)
        figures = _figures({bound: getattr(found, bound) for bound in BOUNDS})
        at = "-" if time is None else f"{time:.2f}"
        rows.append((case.motion, f"{found.travel:.2f}", f"{1e3 * found.apart:.2f}", *figures, first, at))
    return ReportTable(title, headings, tuple(rows))


def summary_table(comparisons: Sequence[Comparison]) -> ReportTable:
    """Return one row per comparison: its worst figures over all motions, and the motions that break a bound."""
    headings = (
        "effects", "apart mm", "% of travel", "yaw deg", "leg torque %", "wheel torque %", "largest signal", "broken by"
    )  # fmt: skip
    rows = []
    for comparison in comparisons:
        cases = comparison.half or comparison.cases
        worst = {name: max(getattr(case.agreement, name) for case in cases) for name in ("apart", *BOUNDS)}
        signals = [name for name, signal in comparison.signals.items() if not signal.shared]
        size, signal = max((case.differences[name].rms_in_noise, name) for case in cases for name in signals)
        broken = ", ".join(case.motion for case in cases if case.agreement.broken) or "-"
        figures = _figures(worst)
        rows.append((comparison.effects, f"{1e3 * worst['apart']:.2f}", *figures, f"{signal} {_noise(size)}", broken))
    step = " at half of both steps" if comparisons[0].half else ""
    return ReportTable(f"Worst of all motions{step}", headings, tuple(rows))


def _figures(values: dict[str, float]) -> tuple[str, ...]:
    scale = {"position": 100.0, "yaw": 180 / np.pi, "leg_torque": 100.0, "wheel_torque": 100.0}
    return tuple(f"{scale[name] * values[name]:.2f}{'' if values[name] <= bound else ' !'}" for name, bound in BOUNDS.items())


def _convergence_table(
    comparison: Comparison,
    half: Sequence[MotionComparison],
    first: Sequence[MotionComparison],
    second: Sequence[MotionComparison],
) -> ReportTable:
    def pooled(cases: Sequence[MotionComparison], name: str) -> str:
        return _noise(float(np.sqrt(np.mean([case.differences[name].rms_in_noise ** 2 for case in cases]))))

    sets = (comparison.cases, half, first, second)
    labels = [traces.plant.label for traces in (comparison.first, comparison.second)]
    headings = ("signal", "apart", "at half the steps", *(f"own step of {label}" for label in labels))
    rows = tuple((_starred(comparison, name), *(pooled(cases, name) for cases in sets)) for name in comparison.signals)
    return ReportTable("Does it shrink with the step? All motions, rms in units of sensor noise", headings, rows)


def _starred(comparison: Comparison, name: str) -> str:
    """Name of a signal; with a star where rigid bodies do not determine it."""
    return f"{name} *" if comparison.signals[name].shared else name


def _noise(value: float) -> str:
    return f"{value:.2f}" if value < 10.0 else f"{value:.0f}"


def markdown(comparisons: Sequence[Comparison], heading: str) -> str:
    """Return the whole report."""
    parts = [f"# {heading}", "How to read this: docs/compare.md."]
    if len(comparisons) > 1:
        parts.append(summary_table(comparisons).markdown())
    for comparison in comparisons:
        parts += [f"## Effects: {comparison.effects}", *(table.markdown() for table in tables(comparison))]
    return "\n\n".join(parts) + "\n"


# ---- figures ---------------------------------------------------------------------------------------------------------


def save_motion_plot(comparison: Comparison, index: int, path: Path) -> Path:
    """Write one motion's figure: both plants over each other, and below each panel their difference in noise units."""
    columns = 3
    figure = new_figure(6.0 * columns, 3.3 * -(-len(_PANELS) // columns))
    outer = figure.add_gridspec(-(-len(_PANELS) // columns), columns)
    for number, names in enumerate(_PANELS):
        inner = outer[number // columns, number % columns].subgridspec(2, 1, height_ratios=(2, 1), hspace=0.05)
        above = figure.add_subplot(inner[0])
        below = figure.add_subplot(inner[1], sharex=above)
        _draw_panel(comparison, index, names, above, below)
        if number >= len(_PANELS) - columns:
            below.set_xlabel("time (s)", fontsize=9)
    labels = [traces.plant.label for traces in (comparison.first, comparison.second)]
    handles = [figure.axes[0].plot([], [], color=colour)[0] for colour in (_FIRST, _SECOND)]
    figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False)
    figure.suptitle(f"{comparison.motions[index].name}, effects: {comparison.effects}", fontsize=13)
    return save(figure, path)


def _draw_panel(comparison: Comparison, index: int, names: Sequence[str], above: Axes, below: Axes) -> None:
    motion = comparison.motions[index]
    t = motion.period * np.arange(len(motion.setpoints) + 1)
    for traces, colour, style in ((comparison.first, _FIRST, "-"), (comparison.second, _SECOND, "--")):
        for name in names:
            values = traces.signals[name][: len(t), index]
            values = np.unwrap(values, axis=0) if comparison.signals[name].turns else values
            above.plot(t, values, color=colour, linestyle=style, linewidth=0.9)
    for name in names:
        signal = comparison.signals[name]
        error = np.abs(difference(comparison.first, comparison.second, name, signal, motion, index))
        below.plot(t, np.maximum(error.max(axis=1) / signal.resolution, 1e-3), linewidth=0.9, color="#444444")
    below.axhline(comparison.threshold, color=GREEN, linewidth=0.8)
    below.set_yscale("log")
    below.set_ylim(1e-3, max(1e2, below.get_ylim()[1]))
    below.set_ylabel("noise units", fontsize=8)
    above.set_title(", ".join(f"{name} ({comparison.signals[name].unit})" for name in names), fontsize=9)
    above.tick_params(labelbottom=False)
    for axes in (above, below):
        tidy(axes)
        axes.margins(x=0.01)


def save_map(comparison: Comparison, path: Path) -> Path:
    """Write the map of all differences: signals by motions, rms in noise units."""
    from matplotlib.colors import LogNorm

    names = list(comparison.signals)
    values = np.array([[case.differences[name].rms_in_noise for case in comparison.cases] for name in names])
    figure = new_figure(2.2 + 0.56 * len(comparison.cases), 1.5 + 0.21 * len(names))
    axes = figure.subplots()
    image = axes.imshow(np.maximum(values, 1e-2), norm=LogNorm(1e-2, 1e2), cmap="RdYlBu_r", aspect="auto")
    axes.set_xticks(
        range(len(comparison.cases)), [case.motion for case in comparison.cases], rotation=40, ha="right", fontsize=8
    )
    axes.set_yticks(range(len(names)), [_starred(comparison, name) for name in names], fontsize=8)
    colours = image.to_rgba(np.maximum(values, 1e-2))
    for row, column in np.ndindex(*values.shape):
        colour = text_colour(colours[row, column].tolist())
        axes.text(column, row, _noise(float(values[row, column])), ha="center", va="center", fontsize=7, color=colour)
    axes.set_title(
        f"{comparison.second.plant.label} minus {comparison.first.plant.label}\n"
        f"rms in units of sensor noise; effects: {comparison.effects}",
        fontsize=10,
    )
    axes.set_xlabel("motion", fontsize=9)
    axes.set_ylabel("signal", fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.8, format="%g", label="rms difference (1 = sensor noise)")
    return save(figure, path)
