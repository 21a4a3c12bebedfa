"""The paper's figures 7-11 and 13-17 with every model side by side, and what it does not show: slip and normal forces.

Matplotlib only, drawn without a display.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from wlr_gym.base.files import replace_file
from wlr_gym.studies.paper import printed
from wlr_gym.studies.paper.experiments import MODELS, REDUCED, PaperTest, Record, duration
from wlr_gym.studies.paper.ideal import IdealMotion
from wlr_gym.studies.paper.measured import FromMeasurement
from wlr_gym.studies.paper.slip_candidates import READINGS
from wlr_gym.studies.paper.slip_search import SearchFinding

Array = NDArray[np.float64]

_STYLES: dict[str, dict[str, Any]] = {
    REDUCED: {"color": "tab:orange", "linewidth": 2.4, "alpha": 0.7},
    "gibbs_appell": {"color": "tab:blue", "linewidth": 1.2},
    "mujoco": {"color": "black", "linewidth": 1.0, "linestyle": (0, (4, 3))},
}
_IDEAL: dict[str, Any] = {"color": "0.6", "linewidth": 3.0, "alpha": 0.6}
#: s; what is before, the robot settling on its legs, is not drawn.
_FROM = -0.5
#: s between two ticks.
_TICK = 5.0
_UNEVEN = ("tab:purple", "tab:green")
_RPM = 60.0 / (2.0 * np.pi)
#: A grid of axes.
Panels = NDArray[Any]
Series = Callable[[Record], Array]


def _style(model: str) -> dict[str, Any]:
    return _STYLES.get(model, {"color": "tab:green", "linewidth": 1.0})


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG."""
    FigureCanvasAgg(figure)
    replace_file(path, lambda temporary: figure.savefig(temporary, dpi=110, format="png"))
    return path


def _panels(title: str, rows: int, columns: int, height: float = 2.4) -> tuple[Figure, Panels]:
    figure = Figure(figsize=(5.0 * columns, height * rows + 0.8), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    figure.suptitle(title, fontsize=12)
    for panel in axes.flat:
        panel.grid(alpha=0.25)
        panel.tick_params(labelsize=8)
    return figure, axes


def _over_time(figure: Figure, axes: Panels) -> Figure:
    """Finish a figure whose panels share the time."""
    for panel in axes.flat:
        panel.set_xlim(_FROM, duration() + 0.5)
        panel.xaxis.set_major_locator(MultipleLocator(_TICK))
    for panel in axes[-1]:
        panel.set_xlabel("time (s)", fontsize=9)
    return _finish(figure, axes)


def _finish(figure: Figure, axes: Panels, columns: int = 4) -> Figure:
    handles: dict[str, Any] = {}
    for panel in axes.flat:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        figure.legend(
            list(handles.values()), list(handles), loc="outside lower center", ncols=columns, frameon=False, fontsize=9
        )
    return figure


def _draw(axes: Axes, records: Sequence[Record], series: Series, title: str, unit: str) -> None:
    for record in records:
        shown = record.time > _FROM
        axes.plot(record.time[shown], series(record)[shown], label=_label(record.model), **_style(record.model))
    axes.set_title(title, fontsize=9)
    axes.set_ylabel(unit, fontsize=9)


def _label(model: str) -> str:
    return {REDUCED: "reduced model", "gibbs_appell": "Gibbs-Appell", "mujoco": "MuJoCo"}.get(model, model)


def _draw_ideal(axes: Axes, ideal: IdealMotion, values: Array) -> None:
    axes.plot(ideal.time, values, label="no slip, as commanded", zorder=1, **_IDEAL)


def _heading(test: PaperTest, kind: int, what: str) -> str:
    return f"Fig. {test.figures[kind]} ({test.title}): {what}"


#: Column of a joint, and which motors of the paper it stands for.
_LEGS = ((0, "front legs (motors 2, 3)"), (2, "rear legs (motors 1, 4)"))
_WHEELS = ((4, "front wheels (motors 6, 7)"), (6, "rear wheels, free (motors 5, 8)"))


def rotation_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Figures 7 and 13: rotation of each joint, left side."""
    figure, axes = _panels(_heading(ideal.test, 0, "rotation of the joints"), 2, 2)
    legs = (ideal.front, ideal.rear)
    for k, (joint, title) in enumerate(_LEGS):
        _draw_ideal(axes[0, k], ideal, np.degrees(legs[k]))
        _draw(axes[0, k], records, lambda r, j=joint: np.degrees(r.joint_position[:, 0, j]), title, "degrees")
    for k, (joint, title) in enumerate(_WHEELS):
        _draw_ideal(axes[1, k], ideal, ideal.wheels[:, joint - 4] / (2 * np.pi))
        _draw(axes[1, k], records, lambda r, j=joint: r.joint_position[:, 0, j] / (2 * np.pi), title, "turns")
    return _over_time(figure, axes)


def speed_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Figures 8 and 14: speed of each joint, left side."""
    figure, axes = _panels(_heading(ideal.test, 1, "speed of the joints"), 2, 2)
    columns = {0: 5, 2: 6, 4: 7, 6: 9}
    for row, joints in enumerate((_LEGS, _WHEELS)):
        for k, (joint, title) in enumerate(joints):
            _draw_ideal(axes[row, k], ideal, ideal.u[:, columns[joint]] * _RPM)
            _draw(axes[row, k], records, lambda r, j=joint: r.joint_velocity[:, 0, j] * _RPM, title, "rpm")
    return _over_time(figure, axes)


def torque_figure(records: Sequence[Record], ideal: IdealMotion, measured: FromMeasurement | None) -> Figure:
    """Figures 9 and 15: motor torque of each joint, and what inverse dynamics says, as printed and as corrected.

    Args:
        records, ideal: of one test.
        measured: inverse dynamics of the first simulator's record; None = none.
    """
    figure, axes = _panels(_heading(ideal.test, 2, "motor torque of the joints"), 2, 2, 2.8)
    inverse = ideal.inverse_dynamics()
    source = next((record for record in records if record.model != REDUCED), None)
    for row, joints in enumerate((_LEGS, _WHEELS)):
        for k, (joint, title) in enumerate(joints):
            values = inverse.leg_torque[:, k] / 2 if row == 0 else inverse.wheel_torque[:, joint - 4]
            _draw_ideal(axes[row, k], ideal, values)
            _draw(axes[row, k], records, lambda r, j=joint: r.torque[:, 0, j], title + ", each", "N m")
            if measured is None or source is None:
                continue
            right = measured.right.leg_torque[:, k] / 2 if row == 0 else measured.right.wheel_torque[:, joint - 4]
            as_printed = measured.leg_torque_printed[:, k] / 2 if row == 0 else measured.wheel_torque_printed[:, joint - 4]
            axes[row, k].plot(
                source.time,
                right,
                color="tab:red",
                linewidth=0.8,
                label="corrected (19)-(24) from the motion: behind the gears",
            )
            axes[row, k].plot(source.time, as_printed, color="tab:purple", linewidth=0.8, label="printed (19)-(24)")
    return _over_time(figure, axes)


def body_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Figures 10 and 16: position, velocity and rotation of the body."""
    figure, axes = _panels(_heading(ideal.test, 3, "position, velocity and rotation of the body"), 3, 3, 2.1)
    ground = {0: ideal.x, 2: ideal.posture.height * 100}
    for k, (axis, unit, factor) in enumerate((("x", "m", 1.0), ("y", "mm", 1e3), ("z", "cm", 100.0))):
        if k in ground:
            _draw_ideal(axes[0, k], ideal, ground[k])
        _draw(axes[0, k], records, lambda r, j=k, f=factor: f * r.position[:, 0, j], f"position {axis}", unit)
    for k, column in enumerate((0, 1, 3)):
        _draw_ideal(axes[1, k], ideal, 1e3 * ideal.u[:, column])
        _draw(axes[1, k], records, lambda r, j=k: 1e3 * r.velocity[:, 0, j], f"velocity {'xyz'[k]}", "mm/s")
    for k, name in enumerate(("yaw", "pitch", "roll")):
        if k == 1:
            _draw_ideal(axes[2, k], ideal, np.degrees(ideal.posture.pitch))
        _draw(axes[2, k], records, lambda r, j=k: np.degrees(r.attitude[:, 0, j]), name, "degrees")
    for panel in (axes[0, 1], axes[2, 0], axes[2, 2], axes[1, 1]):
        low, high = panel.get_ylim()
        least = 0.5
        if high - low < 2 * least:
            panel.set_ylim(-least, least)  # numerical noise is not to be blown up
    return _over_time(figure, axes)


def path_figure(records: Sequence[Record], variants: Mapping[str, Array], test: PaperTest) -> Figure:
    """Figures 11 and 17: path on the plane; lateral scale blown up.

    Args:
        records: nominal robots on every model.
        variants: label -> (T, 2) paths of robots that are not symmetric.
        test: which.
    """
    figure, axes = _panels(_heading(test, 4, "path on the plane"), 1, 1, 3.4)
    figure.set_size_inches(8.5, 4.2)
    panel = axes[0, 0]
    for record in records:
        panel.plot(record.position[:, 0, 0], 100 * record.position[:, 0, 1], label=_label(record.model), **_style(record.model))
    for (label, path), colour in zip(variants.items(), _UNEVEN, strict=True):
        panel.plot(path[:, 0], 100 * path[:, 1], linewidth=1.4, color=colour, label=f"Gibbs-Appell, {label}")
    for sign in (1, -1):
        panel.axhline(
            100 * sign * test.lateral, color="tab:red", linestyle=":", linewidth=1.0, label="paper's lateral displacement"
        )
    panel.set(xlabel="x (m)", ylabel="y (cm)")
    return _finish(figure, axes, columns=3)


def slip_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Slip velocity and accumulated slip of the left wheels, and normal forces beside (16) and (17)."""
    figure, axes = _panels(f"{ideal.test.title}: slip of the wheels, and load on them", 3, 2, 2.1)
    s = ideal.state()
    static = (
        printed.eq16_normal_force_in_front(ideal.constants, s),
        printed.eq17_normal_force_behind(ideal.constants, s),
    )
    for k, (wheel, title) in enumerate(((0, "left front"), (2, "left rear"))):
        _draw(axes[0, k], records, lambda r, j=wheel: 1e3 * r.slip[:, 0, j, 0], f"{title} wheel, slip velocity along", "mm/s")
        _draw(
            axes[1, k],
            records,
            lambda r, j=wheel: 1e3 * r.slip_path[:, 0, j, 0],
            f"{title} wheel, accumulated slip along",
            "mm",
        )
        axes[2, k].plot(ideal.time, static[k], label="(16), (17) as printed", zorder=1, **_IDEAL)
        _draw(axes[2, k], records, lambda r, j=wheel: r.force[:, 0, j, 2], f"{title} wheel, normal force", "N")
    return _over_time(figure, axes)


def question_figure(findings: Sequence[SearchFinding]) -> Figure:
    """What each departure from the nominal robot can do to the paper's four numbers: every draw, error against lateral."""
    alone = [finding for finding in findings if len(finding.names) == 1]
    best = sorted((f for f in findings if len(f.names) > 1), key=lambda f: min(f.closest(r) for r in READINGS))[:6]
    figure, axes = _panels("What reaches the paper's numbers (crosses)? Every draw; first and second test", 4, 4, 2.5)
    for panel, finding in zip(axes.flat, [*alone, *best], strict=False):
        for k, colour in enumerate(("tab:blue", "tab:orange")):
            values = finding.outcomes
            panel.plot(
                100 * values.error_encoder[:, k], 100 * np.abs(values.lateral[:, k]), ".", color=colour, markersize=2.5,
                label=("first test", "second test")[k],
            )  # fmt: skip
        for (error, sideways), colour in zip(((11.5, 1.1), (5.0, 5.2)), ("tab:blue", "tab:orange"), strict=True):
            panel.plot(error, sideways, "x", color=colour, markersize=9, markeredgewidth=2.5)
        matches = max(len(finding.matches(reading)) for reading in READINGS)
        panel.set_title(f"{finding.label}" + (f": {matches} match" if matches else ""), fontsize=9)
        panel.set(xlim=(-25, 35), ylim=(-0.3, 12))
    for panel in list(axes.flat)[len(alone) + len(best) :]:
        panel.set_axis_off()
    for panel in axes[:, 0]:
        panel.set_ylabel("lateral displacement (cm)", fontsize=9)
    for panel in axes[-1]:
        panel.set_xlabel("error of ignoring slip (%)", fontsize=9)
    return _finish(figure, axes)


def figures_of_test(
    records: Sequence[Record], ideal: IdealMotion, measured: FromMeasurement | None, paths: Mapping[str, Array]
) -> dict[str, Figure]:
    """Return all figures of one test by file name."""
    numbers = ideal.test.figures
    ordered = sorted(records, key=lambda record: MODELS.index(record.model))
    drawn = (
        rotation_figure(ordered, ideal),
        speed_figure(ordered, ideal),
        torque_figure(ordered, ideal, measured),
        body_figure(ordered, ideal),
        path_figure(ordered, paths, ideal.test),
    )
    named = {f"figure_{number:02d}.png": figure for number, figure in zip(numbers, drawn, strict=True)}
    return named | {f"{ideal.test.name}_slip.png": slip_figure(ordered, ideal)}
