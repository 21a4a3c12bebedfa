"""The files of ``python -m studies.paper``: report, numbers, figures.

The figures are the paper's 7-11 and 13-17 with every model side by side, and what it does not show: slip and normal forces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, MultipleLocator
from numpy.typing import NDArray

from studies.paper import printed, slip_search
from studies.paper.claims import CheckedClaim, PaperEvidence, claims_table, variant_row
from studies.paper.experiments import (
    DURATION,
    TESTS,
    FromMeasurement,
    IdealMotion,
    PaperTest,
    Record,
    error_of_ignoring_slip,
    inverse_from_record,
)
from studies.paper.slip_search import (
    CANDIDATES,
    ERROR_TOLERANCE,
    LATERAL_TOLERANCE,
    OBSERVABLES,
    READINGS,
    PaperReading,
    SearchFinding,
)
from studies.paper.verdicts import verdict_table
from studies.tables import markdown_table
from wlr_gym.base.files import write_json, write_text
from wlr_gym.base.plots import BLUE, GREEN, GREY, ORANGE, WINE, legend_below, new_figure, save, tidy
from wlr_gym.physics.plants import BACKENDS, REAL, SIMULATORS
from wlr_gym.robot import Robot

Array = NDArray[np.float64]

_STYLES: dict[str, dict[str, Any]] = {
    "gibbs_appell": {"label": "Gibbs-Appell", "color": BLUE, "linewidth": 1.2},
    "mujoco": {"label": "MuJoCo", "color": "black", "linewidth": 1.0, "linestyle": (0, (4, 3))},
    **{model: {"label": model, "color": GREEN, "linewidth": 1.0} for model in REAL},
}
_IDEAL: dict[str, Any] = {"color": "0.6", "linewidth": 3.0, "alpha": 0.6}
#: s; what is before, the robot settling on its legs, is not drawn.
_FROM = -0.5
#: s between two ticks.
_TICK = 5.0
_UNEVEN = (WINE, GREEN)
#: How the paper's prediction may count the wheel angle: relative to the leg or not.
_PREDICTIONS: dict[bool, dict[str, Any]] = {
    True: {"color": BLUE, "marker": "o", "label": "prediction with the encoder's angle", "markersize": 5},
    False: {"color": ORANGE, "marker": "s", "label": "prediction of (3) as printed", "fillstyle": "none", "markersize": 9},
}
#: Combinations in the figure of the open question.
_COMBINATIONS = 8
_RPM = 60.0 / (2.0 * np.pi)
#: A grid of axes.
Panels = NDArray[Any]
Series = Callable[[Record], Array]


def _panels(title: str, rows: int, columns: int, height: float = 2.4) -> tuple[Figure, Panels]:
    figure = new_figure(5.0 * columns, height * rows + 0.8)
    axes = figure.subplots(rows, columns, squeeze=False)
    figure.suptitle(title, fontsize=12)
    for panel in axes.flat:
        tidy(panel)
    return figure, axes


def _over_time(figure: Figure, axes: Panels) -> Figure:
    """Finish a figure whose panels share the time."""
    for panel in axes.flat:
        panel.set_xlim(_FROM, DURATION + 0.5)
        panel.xaxis.set_major_locator(MultipleLocator(_TICK))
    for panel in axes[-1]:
        panel.set_xlabel("time (s)")
    legend_below(figure)
    return figure


def _draw(axes: Axes, records: Sequence[Record], series: Series, title: str, label: str) -> None:
    for record in records:
        shown = record.time > _FROM
        axes.plot(record.time[shown], series(record)[shown], **_STYLES[record.model])
    axes.set_title(title, fontsize=9)
    axes.set_ylabel(label)


def _draw_ideal(axes: Axes, ideal: IdealMotion, values: Array) -> None:
    axes.plot(ideal.time, values, label="no slip, as commanded", zorder=1, **_IDEAL)


def _heading(test: PaperTest, kind: int, what: str) -> str:
    return f"Fig. {test.figures[kind]} ({test.title}): {what}"


#: Column of a joint, its column in u11, and which motors of the paper it stands for: legs above wheels.
_JOINTS = (
    ((0, 5, "front legs (motors 2, 3)"), (2, 6, "rear legs (motors 1, 4)")),
    ((4, 7, "front wheels (motors 6, 7)"), (6, 9, "rear wheels, free (motors 5, 8)")),
)


def _joint_panels(axes: Panels) -> Iterator[tuple[Axes, int, int, str]]:
    """Yield panel, column of the joint, its column in u11 and title of the four kinds of joints."""
    return ((axes[row, k], *joint) for row, joints in enumerate(_JOINTS) for k, joint in enumerate(joints))


def rotation_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Figures 7 and 13: rotation of each joint, left side."""
    figure, axes = _panels(_heading(ideal.test, 0, "rotation of the joints"), 2, 2)
    angles = {0: ideal.front, 2: ideal.rear, 4: ideal.wheels[:, 0], 6: ideal.wheels[:, 2]}
    for panel, joint, _, title in _joint_panels(axes):
        one, label = (180 / np.pi, "rotation (degrees)") if joint < 4 else (0.5 / np.pi, "rotation (turns)")
        _draw_ideal(panel, ideal, one * angles[joint])
        _draw(panel, records, lambda r, j=joint, one=one: one * r.joint_position[:, 0, j], title, label)
    return _over_time(figure, axes)


def speed_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Figures 8 and 14: speed of each joint, left side."""
    figure, axes = _panels(_heading(ideal.test, 1, "speed of the joints"), 2, 2)
    for panel, joint, column, title in _joint_panels(axes):
        _draw_ideal(panel, ideal, ideal.u[:, column] * _RPM)
        _draw(panel, records, lambda r, j=joint: r.joint_velocity[:, 0, j] * _RPM, title, "speed (rpm)")
    return _over_time(figure, axes)


def torque_figure(records: Sequence[Record], ideal: IdealMotion, measured: FromMeasurement | None) -> Figure:
    """Figures 9 and 15: motor torque of each joint, and what inverse dynamics says, as printed and as corrected.

    Args:
        records, ideal: of one test.
        measured: inverse dynamics of the first simulator's record; None = none.
    """
    figure, axes = _panels(_heading(ideal.test, 2, "motor torque of the joints"), 2, 2, 2.8)
    source = next(iter(records), None)

    def of_joint(legs: Array, wheels: Array, joint: int) -> Array:
        return legs[:, joint // 2] / 2 if joint < 4 else wheels[:, joint - 4]

    inverse = ideal.inverse_dynamics()
    for panel, joint, _, title in _joint_panels(axes):
        _draw_ideal(panel, ideal, of_joint(inverse.leg_torque, inverse.wheel_torque, joint))
        _draw(panel, records, lambda r, j=joint: r.torque[:, 0, j], f"{title}, each", "torque (N m)")
        if measured is not None and source is not None:
            right = of_joint(measured.right.leg_torque, measured.right.wheel_torque, joint)
            label = "corrected (19)-(24) from the motion: behind the gears"
            panel.plot(source.time, right, color=WINE, linewidth=0.8, label=label)
            as_printed = of_joint(measured.leg_torque_printed, measured.wheel_torque_printed, joint)
            panel.plot(source.time, as_printed, color=GREEN, linewidth=0.8, label="printed (19)-(24)")
    return _over_time(figure, axes)


def body_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Figures 10 and 16: position, velocity and rotation of the body."""
    figure, axes = _panels(_heading(ideal.test, 3, "position, velocity and rotation of the body"), 3, 3, 2.1)
    ground = {0: ideal.x, 2: ideal.posture.height * 100}
    for k, (axis, unit, factor) in enumerate((("x", "m", 1.0), ("y", "mm", 1e3), ("z", "cm", 100.0))):
        if k in ground:
            _draw_ideal(axes[0, k], ideal, ground[k])
        _draw(axes[0, k], records, lambda r, j=k, f=factor: f * r.position[:, 0, j], "", f"position {axis} ({unit})")
    for k, column in enumerate((0, 1, 3)):
        _draw_ideal(axes[1, k], ideal, 1e3 * ideal.u[:, column])
        _draw(axes[1, k], records, lambda r, j=k: 1e3 * r.velocity[:, 0, j], "", f"velocity {'xyz'[k]} (mm/s)")
    for k, name in enumerate(("yaw", "pitch", "roll")):
        if k == 1:
            _draw_ideal(axes[2, k], ideal, np.degrees(ideal.posture.pitch))
        _draw(axes[2, k], records, lambda r, j=k: np.degrees(r.attitude[:, 0, j]), "", f"{name} (degrees)")
    for panel in (axes[0, 1], axes[2, 0], axes[2, 2], axes[1, 1]):
        low, high = panel.get_ylim()
        if high - low < 1.0:
            panel.set_ylim(-0.5, 0.5)  # numerical noise is not to be blown up
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
        panel.plot(record.position[:, 0, 0], 100 * record.position[:, 0, 1], **_STYLES[record.model])
    for (label, path), colour in zip(variants.items(), _UNEVEN, strict=True):
        panel.plot(path[:, 0], 100 * path[:, 1], linewidth=1.4, color=colour, label=f"Gibbs-Appell, {label}")
    for sign in (1, -1):
        panel.axhline(100 * sign * test.lateral, color=GREY, linestyle=":", linewidth=1.0, label="paper's lateral displacement")
    panel.set(xlabel="x (m)", ylabel="y (cm)")
    legend_below(figure, columns=3)
    return figure


def slip_figure(records: Sequence[Record], ideal: IdealMotion) -> Figure:
    """Slip velocity and accumulated slip of the left wheels, and normal forces beside (16) and (17)."""
    figure, axes = _panels(f"{ideal.test.title}: slip of the wheels, and load on them", 3, 2, 2.1)
    s = ideal.state()
    c = ideal.constants
    static = printed.eq16_normal_force_in_front(c, s), printed.eq17_normal_force_behind(c, s)
    for k, (wheel, title) in enumerate(((0, "left front"), (2, "left rear"))):
        _draw(axes[0, k], records, lambda r, j=wheel: 1e3 * r.slip[:, 0, j, 0], f"{title} wheel", "longitudinal slip (mm/s)")
        _draw(axes[1, k], records, lambda r, j=wheel: 1e3 * r.slip_path[:, 0, j, 0], "", "accumulated slip (mm)")
        axes[2, k].plot(ideal.time, static[k], label="(16), (17) as printed", zorder=1, **_IDEAL)
        _draw(axes[2, k], records, lambda r, j=wheel: r.force[:, 0, j, 2], "", "normal force (N)")
    return _over_time(figure, axes)


def question_figure(findings: Sequence[SearchFinding]) -> Figure:
    """How near departures from the nominal robot come to the paper's four numbers: one at a time, and the best combinations."""
    nearest = sorted(findings, key=lambda finding: min(map(finding.closest, READINGS)))
    alone = [finding for finding in nearest if len(finding.names) == 1]
    meaning = {candidate.name: candidate.doc for candidate in CANDIDATES}
    together = [finding for finding in nearest if len(finding.names) > 1][:_COMBINATIONS]
    groups = [
        ("one departure, and what it is", alone, [f"{finding.label}: {meaning[finding.label]}" for finding in alone]),
        ("several at once: the closest", together, [finding.label for finding in together]),
    ]
    groups = [group for group in groups if group[1]]
    heights = [0.9 + 0.21 * len(shown) for _, shown, _ in groups]
    figure = new_figure(8.5, sum(heights) + 1.0)
    figure.suptitle("How near do departures from the nominal robot come to the paper's four numbers?", fontsize=11)
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=heights)[:, 0]
    for panel, (title, shown, labels) in zip(panels, groups, strict=True):
        _draw_misses(panel, shown, labels)
        panel.set_title(title, fontsize=9, loc="left")
        tidy(panel)
    panels[-1].set_xlabel("largest of four errors, closest robot (1 = tolerance)", fontsize=9)
    legend_below(figure)
    return figure


def _draw_misses(panel: Axes, shown: Sequence[SearchFinding], labels: Sequence[str]) -> None:
    """Draw by how much each departure misses the paper's numbers, in tolerances, a row each."""
    panel.axvspan(0.0, 1.0, color=GREEN, alpha=0.2, linewidth=0.0, label="match: all four within tolerance")
    for on_leg, style in _PREDICTIONS.items():
        readings = [reading for reading in READINGS if reading.encoder_on_leg is on_leg]
        misses = [min(map(finding.closest, readings)) for finding in shown]
        panel.plot(misses, range(len(shown)), linestyle="", markeredgewidth=1.5, **style)
    panel.set_yticks(range(len(shown)), labels)
    panel.set_ylim(len(shown) - 0.4, -0.6)
    panel.set_xlim(left=0.0)
    panel.xaxis.set_major_locator(MaxNLocator(6, integer=True))


# ---- agreement of the models -----------------------------------------------------------------------------------------


Records = Mapping[str, Mapping[str, Record]]
#: label of a finding -> observable -> lowest and highest of its matches.
Decisive = Mapping[str, Mapping[str, tuple[float, float]]]


def agreement(records: Records) -> dict[str, dict[str, dict[str, float]]]:
    """Return how far every model is from Gibbs-Appell, per test.

    Position: distance of the ends over the travel. Yaw: degrees, at the end. Leg and wheel torque: rms difference over rms,
    left and right taken together (how wheels that stick share a load is open), from the commands on.
    """
    reference = records.get("gibbs_appell")
    others = [model for model in records if model in SIMULATORS and model != "gibbs_appell"]
    if reference is None:
        return {}
    return {model: {name: _apart(reference[name], records[model][name]) for name in TESTS} for model in others}


def _apart(a: Record, b: Record) -> dict[str, float]:
    def torques(record: Record, joints: slice) -> Array:
        values = record.torque[a.time > 0.0][:, 0, joints]
        return values.reshape(len(values), -1, 2).mean(axis=2)

    def torque(joints: slice) -> float:
        ours, theirs = torques(a, joints), torques(b, joints)
        return float(np.sqrt(np.mean((ours - theirs) ** 2) / np.mean(ours**2)))

    return {
        "position": float(np.linalg.norm(a.end[0] - b.end[0]) / np.abs(a.end[0, 0])),
        "yaw_degrees": float(np.degrees(np.abs(a.attitude[-1, 0, 0] - b.attitude[-1, 0, 0]))),
        "leg_torque": torque(slice(0, 4)),
        "wheel_torque": torque(slice(4, 6)),
    }


# ---- what would decide -----------------------------------------------------------------------------------------------


def what_would_decide(robot: Robot, findings: Sequence[SearchFinding], threads: int = 2) -> dict[str, Decisive]:
    """Return, per reading, what the matching robots of every finding would show in other measurements."""
    decisive = {}
    for reading in READINGS:
        found = slip_search.matching(findings, reading)
        shown = slip_search.observables(robot, found, reading, threads=threads)
        decisive[reading.name] = {
            finding.label: {name: (float(values.min()), float(values.max())) for name, values in own.items()}
            for finding, own in zip(found, shown, strict=True)
        }
    return decisive


# ---- files -----------------------------------------------------------------------------------------------------------


def write_figures(folder: Path, records: Records, evidence: PaperEvidence, findings: Sequence[SearchFinding]) -> None:
    """Write all figures as PNG."""
    source = next((records[model] for model in SIMULATORS if model in records), evidence.plant)
    for name, test in TESTS.items():
        ideal, variants = evidence.ideal[name], evidence.variants[name]
        labels = "more drag left", "left front wheel 2 % small"
        paths = {label: variants.position[:, variant_row(label), :2] for label in labels}
        own = sorted((record[name] for record in records.values()), key=lambda record: list(BACKENDS).index(record.model))
        drawn = (
            rotation_figure(own, ideal),
            speed_figure(own, ideal),
            torque_figure(own, ideal, inverse_from_record(evidence.robot, source[name])),
            body_figure(own, ideal),
            path_figure(own, paths, test),
        )
        for number, figure in zip(test.figures, drawn, strict=True):
            save(figure, folder / f"figure_{number:02d}.png")
        save(slip_figure(own, ideal), folder / f"{name}_slip.png")
    if findings:
        save(question_figure(findings), folder / "open_question.png")


def write_report(
    folder: Path,
    robot: Robot,
    records: Records,
    claims: Sequence[CheckedClaim],
    findings: Sequence[SearchFinding],
    decisive: Mapping[str, Decisive],
) -> None:
    """Write report.md, claims.json, agreement.json and search.json."""
    apart = agreement(records)
    write_json(folder / "claims.json", [asdict(claim) for claim in claims])
    write_json(folder / "agreement.json", apart)
    write_json(folder / "search.json", {"findings": [finding.as_dict() for finding in findings], "decisive": decisive})
    lines = ["# The paper, repeated", "", "## The two tests", "", *_ends_table(robot, records), ""]
    if apart:
        rows = [
            (model, name, f"{100 * found['position']:.3f} %", f"{found['yaw_degrees']:.4f} degrees",
             f"{100 * found['leg_torque']:.2f} %", f"{100 * found['wheel_torque']:.2f} %")
            for model, tests in apart.items() for name, found in tests.items()
        ]  # fmt: skip
        table = markdown_table(("model", "test", "position", "yaw", "leg torque", "wheel torque"), rows)
        lines += ["## How far the models are from Gibbs-Appell", "", *table, ""]
    lines += ["## Claims", "", *claims_table(claims), ""]
    if findings:
        lines += ["## What could explain the paper's slip", "", *question_lines(findings, decisive), ""]
    lines += ["## Equations", "", *verdict_table()]
    write_text(folder / "report.md", "\n".join(lines) + "\n")


def _ends_table(robot: Robot, records: Records) -> list[str]:
    def number(value: float, digits: int, unit: str = "") -> str:
        return f"{value:.{digits}f}{unit}" if np.isfinite(value) else "not measured"

    rows = []
    for model, tests in records.items():
        for name, record in tests.items():
            x, y = record.end[0]
            front, rear = record.joint_position[-1, 0, [4, 6]] / (2 * np.pi)
            error = 100 * float(error_of_ignoring_slip(robot, record)[0])
            slipped = 1e3 * float(np.abs(record.slip_path[-1, 0, :, 0]).max())
            ends = number(x, 4), number(1e3 * y, 2), number(error, 2, " %")
            rows.append((model, name, *ends, f"{front:.3f}, {rear:.3f}", number(slipped, 2)))
    headings = "model", "test", "x (m)", "y (mm)", "error of ignoring slip", "front, rear turns", "most slip of a wheel (mm)"
    return markdown_table(headings, rows)


def question_lines(findings: Sequence[SearchFinding], decisive: Mapping[str, Decisive]) -> list[str]:
    """Return the answer to the open question as Markdown: closest misses, matches with their ranges, what would decide."""
    draws = sum(len(finding.values) for finding in findings)
    lines = [
        f"{len(findings)} departures from the nominal robot, alone and together; {draws} robots drove both tests. A miss of 1 "
        f"or less is a match: both errors within {100 * ERROR_TOLERANCE:.1f} points, both lateral displacements "
        f"within {1e3 * LATERAL_TOLERANCE:.0f} mm.",
        "",
    ]
    for reading in READINGS:
        closest = []
        for count in sorted({len(finding.names) for finding in findings}):
            alike = sorted((f for f in findings if len(f.names) == count), key=lambda f: f.closest(reading))
            closest += [(count, f.label, f"{f.closest(reading):.2f}", len(f.matches(reading))) for f in alike[:3]]
        lines += [f"### Reading: {reading.doc}", "", *markdown_table(("at once", "closest", "miss", "matches"), closest), ""]
        matches = slip_search.matching(findings, reading)
        lines += [_ranges(finding, reading) for finding in matches] or ["No match."]
        lines.append("")
        found = decisive.get(reading.name, {})
        if len(found) > 1:
            headings = [f"{meaning} ({unit})" for meaning, unit in OBSERVABLES.values()]
            rows = [
                (label, *("{:.2f} to {:.2f}".format(*values[name]) for name in OBSERVABLES)) for label, values in found.items()
            ]
            lines += ["What the matching robots would show elsewhere (lowest to highest):", ""]
            lines += [*markdown_table(("explanation", *headings), rows), ""]
    return lines


def _ranges(finding: SearchFinding, reading: PaperReading) -> str:
    """Say within which range of every dial the matches of a finding lie."""
    entry: dict[str, Any] = finding.as_dict()["readings"][reading.name]
    ranges = (
        f"{name} {span['low']:.3g} to {span['high']:.3g} {span['unit']}".rstrip(" -") for name, span in entry["ranges"].items()
    )
    return f"- **{finding.label}** ({entry['matches']} matches): {'; '.join(ranges)}"
