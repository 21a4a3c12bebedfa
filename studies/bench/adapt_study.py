"""How much of what a hidden fault costs a policy is won back, by whom; resumable contender by contender.

Every case is an emulated robot on MuJoCo with a step of 2 ms (the training's plant: the engine, 1 ms), a copy within
tolerances, with a fault. Contenders drive the same fresh episodes on it. Cheap contenders come first in all cases; then those
that need the gap workflow, where the truth helps most first.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from studies.bench.adapt_cases import AdaptCase
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import keep_request, make_output_folder
from wlr_gym.base.provenance import git_commit
from wlr_gym.envs.tasks.randomization import load_randomization
from wlr_gym.gap.analysis import BAD_DATA, NOT_EXCITED
from wlr_gym.gap.decision import Decided
from wlr_gym.gap.estimation.fit import fit, widened
from wlr_gym.gap.estimation.model import nominal_model
from wlr_gym.gap.estimation.uncertainty import half_widths
from wlr_gym.gap.report.result import Result
from wlr_gym.gap.robot.problem import open_robot
from wlr_gym.gap.workflow import SCATTER
from wlr_gym.learning.adaptation.adapt import find_uncertainty, task_randomization
from wlr_gym.learning.adaptation.driving import EmulatedRobot, episodes_of, errors_of
from wlr_gym.learning.adaptation.retraining import accept_policy, train_in, train_supervised
from wlr_gym.learning.adaptation.state import Asked, Progress, open_folder
from wlr_gym.learning.adaptation.uncertainty import Family, Uncertainty, uncertainty_of
from wlr_gym.learning.evaluation.subjects import identity, read_subjects
from wlr_gym.physics.effects import Patch, load_patch
from wlr_gym.robot import Robot, load_robot, robot_hash
from wlr_gym.robot.parameter_table import ELEMENTS
from wlr_gym.robot.parameters import Parameters

POLICY, ENVIRONMENT = "velocity_slip_aware", "WLR-Velocity-v0"
#: Contender -> what it is. The first three need no gap workflow.
CONTENDERS = {
    "none": "no adaptation",
    "truth": "the truth patched in, the copy's numbers too",
    "wide": "retrained once with wider randomisation",
    "ours": "wlr adapt",
    "calibrated": "calibration only, no naming",
}
CHEAP = ("none", "truth", "wide")
LINES_FILE = "adapt.jsonl"
#: s; of the MuJoCo plant behind the emulated robot.
PHYSICS_STEP = 0.002
#: Share of the old policy's error by which the truth must help for a case to count.
HELPS = 0.10
#: Seed of the first episode that is driven for the comparison.
FIRST_SEED = 500_000

Say = Callable[[str], object]


@dataclass(frozen=True)
class AdaptStudy:
    """One study.

    Attributes:
        out: folder for its lines and its work. cases: see :func:`studies.bench.adapt_cases.cases`.
        drives, seconds: episodes of every contender, and their length (s).
        steps, episodes, excitations, budget_runs: see :class:`wlr_gym.learning.adaptation.Asked`.
        contenders: who takes part.
    """

    out: Path
    cases: tuple[AdaptCase, ...]
    drives: int = 24
    seconds: float = 10.0
    steps: int = 7_500_000
    episodes: int = 256
    excitations: tuple[str, ...] = ("straight", "turns", "stop_and_go", "posture")
    budget_runs: int = 1
    contenders: tuple[str, ...] = tuple(CONTENDERS)

    def quick(self) -> AdaptStudy:
        """Return the study at a tiny size: it shows that it runs."""
        short = {"drives": 2, "seconds": 1.0, "steps": 16_384, "episodes": 8, "budget_runs": 0}
        return replace(self, excitations=self.excitations[:3], **short)

    def asked(self, case: AdaptCase) -> Asked:
        """Return what an adaptation is asked in a case."""
        own = load_robot()
        return Asked(
            policy=POLICY,
            identity=identity(read_subjects([POLICY])[0]),
            environment=ENVIRONMENT,
            robot=robot_hash(own),
            driven="emulated",
            effects=[dict(one) for one in case.effects],
            backend="mujoco",
            excitations=self.excitations,
            budget_runs=self.budget_runs,
            drives=self.drives,
            drive_seconds=self.seconds,
            steps=self.steps,
            episodes=self.episodes,
            seed=case.copy,
        )


def run_adapt_study(study: AdaptStudy, say: Say = print) -> list[dict[str, Any]]:
    """Do what is left of a study, and return all its lines.

    Raises:
        InputError: a folder that cannot be written to, or one of a study of another size.
    """
    make_output_folder(study.out)
    size = {"drives": study.drives, "seconds": study.seconds, "steps": study.steps, "episodes": study.episodes}
    size |= {"excitations": list(study.excitations), "budget_runs": study.budget_runs}
    keep_request(study.out / "size.json", size)
    there = read_lines(study.out / LINES_FILE)
    for case, contender in _order(study, there):
        began = time.monotonic()
        line = _line(study, case, contender, say)
        line |= {"wall_seconds": round(time.monotonic() - began, 1), "commit": git_commit()}
        with (study.out / LINES_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        there.append(line)
        error = float(np.mean(line["errors"]))
        say(f"{case.name}, {CONTENDERS[contender]}: tracking error {error:.3f}, {line['wall_seconds']:.0f} s")
    return there


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a study; none without a file.

    Raises:
        InputError: a line that is none.
    """
    if not path.is_file():
        return []
    found = []
    for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            line = json.loads(text)
        except ValueError:
            raise InputError(f"{path}, line {number}: broken JSON") from None
        if not isinstance(line, dict) or not {"case", "contender", "errors"} <= line.keys():
            raise InputError(f"{path}, line {number}: expected case, contender and errors")
        found.append(line)
    return found


def _order(study: AdaptStudy, lines: Sequence[Mapping[str, Any]]) -> Iterator[tuple[AdaptCase, str]]:
    """Yield what is left: cheap contenders of all cases, then the others; ``lines`` grows meanwhile."""
    done = {(one["case"], one["contender"]) for one in lines}
    for case in study.cases:
        for name in CHEAP:
            if name in study.contenders and (case.name, name) not in done:
                yield case, name
    for case in sorted(study.cases, key=lambda one: -truth_helps(lines, one.name)):
        for name in study.contenders:
            if name not in CHEAP and (case.name, name) not in done:
                yield case, name


def truth_helps(lines: Sequence[Mapping[str, Any]], case: str) -> float:
    """Return by what share of the old policy's error the truth helps in a case; NaN-free: 0 where it is not known."""
    means = {one["contender"]: float(np.mean(one["errors"])) for one in lines if one["case"] == case}
    if "none" not in means or "truth" not in means:
        return 0.0
    return 1.0 - means["truth"] / means["none"]


# ---- one contender in one case ---------------------------------------------------------------------------------------


def _line(study: AdaptStudy, case: AdaptCase, contender: str, say: Say) -> dict[str, Any]:
    own, hidden = load_robot(), load_patch([dict(one) for one in case.effects])
    robot = EmulatedRobot(own, hidden, "mujoco", PHYSICS_STEP, case.parameters(own))
    progress = open_folder(study.out / "work" / case.name, study.asked(case), lambda text, share: None, 1)
    progress.save()
    work = {"none": lambda: (POLICY, {}), "truth": lambda: (_truth(progress, case, hidden, own), {})}
    work |= {"wide": lambda: (_wide(study, own), {}), "ours": lambda: _ours(progress, robot, own)}
    work |= {"calibrated": lambda: _calibrated(progress, robot, own)}
    policy, said = work[contender]()
    seeds = [FIRST_SEED + 1000 * case.copy + k for k in range(study.drives)]
    step = f"drives_{'none' if policy == POLICY else contender}"  # the old policy drives every episode once
    driven = episodes_of(progress, step, {"driven": policy}, robot, seeds)["driven"]
    return {
        "case": case.name,
        "kind": case.kind,
        "effects": [dict(one) for one in case.effects],
        "shared_law": case.shared,
        "contender": contender,
        "errors": errors_of(driven).tolist(),
        "stopped": [one.reason for one in driven if not one.whole],
        "driving_seconds": sum(one.seconds for one in driven),
        **said,
    }


def _train(progress: Progress, name: str, family: Family) -> str:
    """Train on from the old policy with a family, in a folder of its own; return the policy."""
    train_in(progress, progress.out / name, progress.out / f"{name}.yaml", family)
    return str(progress.out / name / "policy")


def _truth(progress: Progress, case: AdaptCase, hidden: Patch, own: Robot) -> str:
    """Return the policy that is trained on with the fault and the copy's own numbers, as exact as they are."""
    folder = progress.out / "truth_model"
    make_output_folder(folder)
    found = uncertainty_of(exact_result(case, own), hidden, task_randomization(ENVIRONMENT), own, folder)
    return _train(progress, "truth", found.training)


def exact_result(case: AdaptCase, own: Robot) -> Result:
    """Return what a gap result would say that knew everything."""
    true, nominal = case.parameters(own).values[0], Parameters.nominal(own).values[0]
    differs = np.flatnonzero(true != nominal)
    calibration = {ELEMENTS[k]: {"nominal": float(nominal[k]), "fitted": float(true[k]), "unit": "-"} for k in differs}
    effects = [
        {
            "name": one["name"],
            "where": list(one["where"]),
            "confidence": 1.0,
            "parameters": {name: {"value": value, "ci95": None, "unit": "-"} for name, value in one["parameters"].items()},
        }
        for one in case.effects
    ]
    return Result.model_validate(
        {
            "verdict": "effect_found",
            "effects": effects,
            "equivalent": [],
            "calibration": calibration,
            "localisation": {},
            "gap": None,
            "runs": {"fit": [], "heldout": []},
            "patch": "patch.yaml",
        }
    )


def _wide(study: AdaptStudy, own: Robot) -> str:
    """Return the policy that is trained once, with wider randomisation, for all cases."""
    asked = study.asked(study.cases[0]).model_copy(update={"seed": 0})
    progress = Progress(study.out / "work", asked)
    if (progress.out / "wide" / "policy").is_dir():
        return str(progress.out / "wide" / "policy")
    randomization = load_randomization("wide", own).config.model_dump(mode="json", exclude_none=True)
    return _train(progress, "wide", Family("wide", randomization))


def _ours(progress: Progress, robot: EmulatedRobot, own: Robot) -> tuple[str, dict[str, Any]]:
    decided, found = find_uncertainty(progress, robot, own)
    said: dict[str, Any] = {"verdict": "" if decided.result is None else decided.result.verdict}
    said |= {"found": [dict(one.content()) for one in found.patch.effects] if found is not None else []}
    said |= {"ended": decided.history.ended, "recording_seconds": progress.steps["runs"].driving + decided.history.seconds}
    policy, outcome = _trained(progress, found, own)
    return policy, said | outcome


def _calibrated(progress: Progress, robot: EmulatedRobot, own: Robot) -> tuple[str, dict[str, Any]]:
    """Return the policy that is adapted with calibrated numbers alone, from the same runs."""
    decided, _ = find_uncertainty(progress, robot, own)
    if decided.result is None or decided.result.verdict in (BAD_DATA, NOT_EXCITED):
        return POLICY, {"kept": "old"}
    folder = progress.out / "calibrated"
    inner = Progress(folder, progress.asked, progress.tell)
    result = calibration_alone(decided, progress.out / "runs")
    found = uncertainty_of(result, Patch(), task_randomization(ENVIRONMENT), own, inner.folder("model"))
    return _trained(inner, found, own)


def _trained(progress: Progress, found: Uncertainty | None, own: Robot) -> tuple[str, dict[str, Any]]:
    if found is None:
        return POLICY, {"kept": "old"}
    train_supervised(progress, found, own)
    numbers = accept_policy(progress, found, own).numbers
    return numbers["policy"], {"kept": numbers["kept"], "losses": numbers["losses"]}


def calibration_alone(decided: Decided, data: Path) -> Result:
    """Return a result with the calibration of the same runs without any effect."""
    assert decided.result is not None
    problem, _ = open_robot(data)
    assert problem is not None
    runs = decided.result.runs
    fitted = [k for k, name in enumerate(problem.runs) if name in runs.fit]
    scatter = SCATTER * problem.tempering
    found = widened(problem, fitted, fit(problem, fitted, nominal_model(problem), scatter=scatter, steps=problem.steps))
    calibration = {}
    for quantity, value, half in zip(problem.quantities, found.model.quantities, half_widths(problem, found), strict=False):
        interval = [value - half, value + half] if math.isfinite(half) else None
        known = {"nominal": quantity.nominal, "fitted": float(value), "unit": quantity.unit, "sigma": quantity.sigma}
        calibration[quantity.name] = known | {"ci95": interval}
    content = decided.result.model_dump(mode="json")
    content |= {"verdict": "nothing_missing", "effects": [], "evidence": [], "thresholds": [], "calibration": calibration}
    return Result.model_validate(content)
