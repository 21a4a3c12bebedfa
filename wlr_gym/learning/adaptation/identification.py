"""Steps that find out: the gap workflow, and what its result states."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wlr_gym.data.read import run_files
from wlr_gym.envs.registry import task_source_of
from wlr_gym.envs.tasks.task import read_task
from wlr_gym.gap.analysis import BAD_DATA, NOT_EXCITED
from wlr_gym.gap.decision import Budget, Decided, Recorded, decide
from wlr_gym.gap.report.result import PATCH_FILE
from wlr_gym.learning.adaptation.plan import AdaptStep, Progress
from wlr_gym.learning.adaptation.robots import AdaptedRobot, excite_robot
from wlr_gym.learning.adaptation.uncertainty import Uncertainty, uncertainty_of
from wlr_gym.physics.effects import load_patch
from wlr_gym.robot import Robot


def find_gap(progress: Progress, robot: AdaptedRobot | None) -> AdaptStep:
    """Find what the model lacks, with further runs where there is a robot to drive."""
    asked = progress.asked
    data = Path(asked.robot_runs) if asked.robot_runs is not None else progress.out / "runs"
    runs = asked.budget_runs if robot is not None else 0
    budget = Budget(runs, math.inf if asked.budget_seconds is None else asked.budget_seconds)

    def record(motion: Any, folder: Path) -> Recorded:
        assert robot is not None
        return excite_robot(robot, motion, folder, asked.seed + 100 + len(run_files(folder)))

    decided = decide(data, progress.out / "gap", record, budget, threads=progress.threads, tell=progress.tell)
    history, result = decided.history, decided.result
    said = [f"Ended: {history.ended}, after {len(history.driven)} further runs."]
    if result is None:
        said.append("There are too few usable runs for an analysis.")
    else:
        said.insert(0, result.summary or result.verdict)
    names = [one.name for one in result.effects] if result is not None else []
    return AdaptStep(
        said=tuple(said),
        driving=history.seconds,
        command=f"wlr gap {data} --out {progress.out / 'gap'} --until-decided --budget-runs {runs}"
        + (f" --record emulated --hidden {progress.out / 'hidden.yaml'}" if asked.driven == "emulated" else ""),
        numbers={
            "verdict": "" if result is None else result.verdict,
            "effects": names,
            "ended": history.ended,
            "folder": str(decided.folder),
        },
    )


def state_uncertainty(progress: Progress, decided: Decided, own: Robot) -> tuple[AdaptStep, Uncertainty | None]:
    """Return what the result states, as patch and randomisation; None where it states nothing."""
    folder, result = progress.folder("model"), decided.result
    if result is None or result.verdict in (BAD_DATA, NOT_EXCITED) or not (result.calibration or result.effects):
        why = "There is no result." if result is None else f"The verdict is '{result.verdict}': there are no numbers to take."
        return AdaptStep(outcome="left out", said=(why, "The old policy is kept.")), None
    patch = load_patch(decided.folder / PATCH_FILE)
    found = uncertainty_of(result, patch, task_randomization(progress.asked.environment), own, folder)
    command = f"wlr envs {progress.asked.environment} --randomization {folder / 'randomization.yaml'}"
    numbers = {"effects": patch.content()["effects"], "families": [one.name for one in found.families]}
    return AdaptStep(said=found.said, command=command, numbers=numbers), found


def task_randomization(environment: str) -> str | Mapping[str, Any]:
    """Return the randomisation of a task's own."""
    return read_task(task_source_of(environment)).randomization
