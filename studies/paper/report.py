"""The files of ``python -m studies.paper``: report, numbers, figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from studies.paper import slip_search
from studies.paper.claims import CheckedClaim, claims_table
from studies.paper.evidence import PaperEvidence, variant_row
from studies.paper.experiments import REDUCED, TESTS, Record, error_of_ignoring_slip
from studies.paper.measured import inverse_from_record
from studies.paper.slip_candidates import READINGS, PaperReading
from studies.paper.slip_outcomes import ERROR_TOLERANCE, LATERAL_TOLERANCE
from studies.paper.slip_search import OBSERVABLES, SearchFinding
from studies.paper.verdicts import verdict_table
from wlr_gym.base.files import write_json, write_text
from wlr_gym.base.plots import save
from wlr_gym.physics.plants import SIMULATORS
from wlr_gym.robot import Robot

Records = Mapping[str, Mapping[str, Record]]
#: label of a finding -> observable -> lowest and highest of its matches.
Decisive = Mapping[str, Mapping[str, tuple[float, float]]]


# ---- agreement of the models -----------------------------------------------------------------------------------------


def agreement(records: Records) -> dict[str, dict[str, dict[str, float]]]:
    """Return how far every model is from Gibbs-Appell, per test.

    Position: distance of the ends over the travel. Yaw: degrees, at the end. Leg and wheel torque: rms difference over rms,
    left and right taken together (how wheels that stick share a load is open), from the commands on.
    """
    reference = records.get("gibbs_appell")
    if reference is None:
        return {}
    return {
        model: {name: _apart(reference[name], own[name]) for name in TESTS}
        for model, own in records.items()
        if model in (REDUCED, *SIMULATORS) and model != "gibbs_appell"
    }


def _apart(a: Record, b: Record) -> dict[str, float]:
    moving = a.time > 0.0
    distance = float(np.linalg.norm(a.end[0] - b.end[0]))
    torque = {}
    for name, columns in (("leg_torque", (0, 1, 2, 3)), ("wheel_torque", (4, 5))):
        pairs = [[record.torque[moving][:, 0, j] for j in columns] for record in (a, b)]
        first, second = (np.array(pair).reshape(len(columns) // 2, 2, -1).mean(axis=1) for pair in pairs)
        torque[name] = float(np.sqrt(np.mean((first - second) ** 2) / np.mean(first**2)))
    return {
        "position": distance / float(np.abs(a.end[0, 0])),
        "yaw_degrees": float(np.degrees(np.abs(a.attitude[-1, 0, 0] - b.attitude[-1, 0, 0]))),
        **torque,
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
    from studies.paper import figures

    source = next((records[model] for model in SIMULATORS if model in records), evidence.plant)
    for name in TESTS:
        measured = inverse_from_record(evidence.robot, source[name])
        variants = evidence.variants[name]
        paths = {
            label: variants.position[:, variant_row(label), :2] for label in ("more drag left", "left front wheel 2 % small")
        }
        own = [record[name] for record in records.values()]
        for file, figure in figures.figures_of_test(own, evidence.ideal[name], measured, paths).items():
            save(figure, folder / file)
    if findings:
        save(figures.question_figure(findings), folder / "open_question.png")


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
        lines += ["## How far the models are from Gibbs-Appell", "", *_agreement_table(apart), ""]
    lines += ["## Claims", "", *claims_table(claims), ""]
    if findings:
        lines += ["## What could explain the paper's slip", "", *question_lines(findings, decisive), ""]
    lines += ["## Equations", "", *verdict_table()]
    write_text(folder / "report.md", "\n".join(lines) + "\n")


def _ends_table(robot: Robot, records: Records) -> list[str]:
    lines = [
        "| model | test | x (m) | y (mm) | error of ignoring slip | front, rear turns | most slip of a wheel (mm) |",
        "|---|---|---|---|---|---|---|",
    ]
    for model, tests in records.items():
        for name, record in tests.items():
            x, y = record.end[0]
            turns = record.joint_position[-1, 0, [4, 6]] / (2 * np.pi)
            error = 100 * float(error_of_ignoring_slip(robot, record)[0])
            slipped = 1e3 * float(np.abs(record.slip_path[-1, 0, :, 0]).max())
            lines.append(
                f"| {model} | {name} | {_number(x, 4)} | {_number(1e3 * y, 2)} | {_number(error, 2, ' %')} | "
                f"{turns[0]:.3f}, {turns[1]:.3f} | {_number(slipped, 2)} |"
            )
    return lines


def _number(value: float, digits: int, unit: str = "") -> str:
    return f"{value:.{digits}f}{unit}" if np.isfinite(value) else "not measured"


def _agreement_table(apart: Mapping[str, Mapping[str, Mapping[str, float]]]) -> list[str]:
    lines = ["| model | test | position | yaw | leg torque | wheel torque |", "|---|---|---|---|---|---|"]
    for model, tests in apart.items():
        for name, found in tests.items():
            lines.append(
                f"| {model} | {name} | {100 * found['position']:.3f} % | {found['yaw_degrees']:.4f} degrees | "
                f"{100 * found['leg_torque']:.2f} % | {100 * found['wheel_torque']:.2f} % |"
            )
    return lines


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
        lines += [f"### Reading: {reading.doc}", "", *_closest(findings, reading), "", *_ranges(findings, reading)]
        found = decisive.get(reading.name, {})
        if len(found) > 1:
            lines += [*_decisive(found), ""]
    return lines


def _closest(findings: Sequence[SearchFinding], reading: PaperReading) -> list[str]:
    lines = ["| at once | closest | miss | matches |", "|---|---|---|---|"]
    for count in sorted({len(finding.names) for finding in findings}):
        of_count = sorted((f for f in findings if len(f.names) == count), key=lambda f: f.closest(reading))
        for finding in of_count[:3]:
            lines.append(f"| {count} | {finding.label} | {finding.closest(reading):.2f} | {len(finding.matches(reading))} |")
    return lines


def _ranges(findings: Sequence[SearchFinding], reading: PaperReading) -> list[str]:
    lines: list[str] = []
    for finding in slip_search.matching(findings, reading):
        entry: dict[str, Any] = finding.as_dict()["readings"][reading.name]
        ranges = "; ".join(
            f"{name} {span['low']:.3g} to {span['high']:.3g} {span['unit']}".rstrip(" -")
            for name, span in entry["ranges"].items()
        )
        lines += [f"- **{finding.label}** ({entry['matches']} matches): {ranges}"]
    return [*lines, ""] if lines else ["No match.", ""]


def _decisive(found: Decisive) -> list[str]:
    head = ["What the matching robots would show elsewhere (lowest to highest):", ""]
    names = list(OBSERVABLES)
    head += ["| explanation | " + " | ".join(f"{OBSERVABLES[name][0]} ({OBSERVABLES[name][1]})" for name in names) + " |"]
    head += ["|---" * (len(names) + 1) + "|"]
    return head + [
        f"| {label} | " + " | ".join(f"{values[name][0]:.2f} to {values[name][1]:.2f}" for name in names) + " |"
        for label, values in found.items()
    ]
