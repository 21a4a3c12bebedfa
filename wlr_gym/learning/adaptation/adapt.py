"""Adaptation from Python: what ``wlr adapt`` does."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, check_folder, require_package
from wlr_gym.base.files import alone_in
from wlr_gym.base.paths import as_path
from wlr_gym.base.provenance import record_provenance, write_yaml
from wlr_gym.base.settings import parse_config, parse_options, read_yaml
from wlr_gym.base.text import quoted
from wlr_gym.data.excitations import excite
from wlr_gym.data.record import same_profile
from wlr_gym.data.runs import run_files
from wlr_gym.envs.registry import task_name_of, task_source_of
from wlr_gym.envs.tasks.task import read_task
from wlr_gym.gap.analysis import BAD_DATA, NOT_EXCITED
from wlr_gym.gap.decision import Budget, Decided, Recorded, decide
from wlr_gym.gap.report.result import PATCH_FILE
from wlr_gym.learning.adaptation.driving import (
    AdaptedRobot,
    EmulatedRobot,
    RealRobot,
    check_runs,
    drive_after,
    drive_before,
    excite_robot,
    record_runs,
)
from wlr_gym.learning.adaptation.retraining import accept_policy, train_supervised
from wlr_gym.learning.adaptation.state import AdaptStep, Asked, Progress, Tell, open_folder, write_page
from wlr_gym.learning.adaptation.uncertainty import Uncertainty, uncertainty_of
from wlr_gym.learning.evaluation.subjects import identity, read_subjects
from wlr_gym.physics.effects import Source, load_patch, save_patch
from wlr_gym.physics.floor import FloorSource, floor_noted, load_floor
from wlr_gym.physics.plants import check_simulator
from wlr_gym.policy import agent_names, make_policy, policy_environment, trained_environment
from wlr_gym.robot import Robot, RobotSource, load_robot


@dataclass(frozen=True)
class Adapted:
    """How an adaptation ended.

    Attributes:
        policy: the one that is kept: the new one as a file, or the old one as it was given.
        is_new: whether it is the new one.
        steps: what each step found.
        page: ``adapt.html``; ``adapt.json`` beside it has the numbers.
    """

    policy: str
    is_new: bool
    steps: dict[str, AdaptStep]
    page: Path


def adapt(
    policy: str | Path,
    out: str | Path,
    *,
    driven: AdaptedRobot | None = None,
    robot_runs: str | Path | None = None,
    effects: Source = None,
    floor: FloorSource = None,
    environment: str | None = None,
    robot: RobotSource | None = None,
    threads: int = 1,
    tell: Tell = lambda text, share: None,
    **asked: Any,
) -> Adapted:
    """Adapt a policy to a robot, as ``wlr adapt`` does. Called again with the same arguments it resumes.

    Args:
        policy: that PPO trained: shipped, a file, or a policy or run folder.
        out: folder for all steps; new, empty, or of the same request.
        driven: the robot; None = without ``robot_runs`` an emulated one that has ``effects``, with them none.
        robot_runs: measured runs; None = they are recorded on the robot.
        effects: what the emulated robot has that its file does not say.
        floor: that the emulated robot drives on, drawn once by ``seed``, and that the new policy is trained and tested on;
            None = a plane, and the task's.
        environment: id; None = the one that the policy was trained in.
        robot: None = the policy's.
        threads: of the gap workflow and the acceptance test. tell: called with progress.
        asked: further fields of :class:`wlr_gym.learning.adaptation.state.Asked`: ``backend`` of the emulated robot,
            ``excitations``, ``budget_runs``, ``budget_seconds``, ``drives``, ``drive_seconds``, ``steps``, ``learning_rate``,
            ``episodes``, ``sensors`` and ``seed``.

    Raises:
        InputError: bad input of any step, before anything is driven where that can be known; another process works in ``out``.
        KeyboardInterrupt: interrupted; the same call resumes.
    """
    require_package("torch", "train")
    require_package("onnxscript", "export")
    if not environment and str(policy) in agent_names():
        raise InputError(f"'{policy}' is an agent: expected a policy that PPO trained, such as velocity_slip_aware")
    chosen = environment or trained_environment(policy) or "WLR-Velocity-v0"
    own = load_robot(robot if robot is not None else policy_environment(policy).get("robot") or "nominal")
    patch = load_patch(effects)
    if robot_runs is not None and patch:
        raise InputError("--effects: measured runs have what their robot has; they are for --emulated")
    on = None if floor is None else load_floor(floor, own).drawn(int(asked.get("seed", 0)))
    is_driven = driven is not None or robot_runs is None
    request = parse_options(Asked, {
        **asked,
        "policy": str(policy),
        "identity": identity(read_subjects([str(policy)])[0]),
        "environment": chosen,
        "robot_runs": None if robot_runs is None else str(as_path(robot_runs).resolve()),
        "robot": _fitting(policy, chosen, own),
        "driven": ("real" if isinstance(driven, RealRobot) else "emulated") if is_driven else "",
        "effects": [dict(one.content()) for one in patch.effects],
        "floor": None if on is None else floor_noted(on),
    })  # fmt: skip
    check_simulator(request.backend, "--backend")
    if is_driven and "camera" in request.sensors:
        raise InputError("--sensors camera: robots are driven without a camera here; give measured runs, or leave it out")
    same_profile([excite(name, request.seed, own) for name in request.excitations])
    if robot_runs is not None:
        check_folder(as_path(robot_runs), "--robot-runs")
        check_runs(as_path(robot_runs), own)  # before anything is written
    elif driven is None:
        driven = EmulatedRobot(own, patch, request.backend, floor=on)
    with alone_in(as_path(out)):
        progress = open_folder(as_path(out), request, tell, threads)
        if not progress.steps:
            record_provenance(progress.out, request.model_dump(mode="json"), request.seed)
            save_patch(patch, progress.out / "hidden.yaml")
            if request.floor is not None:
                write_yaml(progress.out / "floor.yaml", request.floor)
            progress.save()
        return run_steps(progress, driven, own)


def _fitting(policy: str | Path, environment: str, own: Robot) -> str:
    """Return the robot's fingerprint; refuse a policy that does not fit the environment, before anything is driven."""
    from wlr_gym.learning.evaluation.rollout import make_core
    from wlr_gym.learning.ppo.policy import contract_to_start_from
    from wlr_gym.policy import environment_for
    from wlr_gym.robot import robot_hash

    contract_to_start_from(policy)
    trained = trained_environment(policy)
    if trained is not None and task_name_of(trained) != task_name_of(environment):
        raise InputError(f"--env {environment}: '{policy}' was made for another environment, {trained}; leave --env out")
    with closing(make_core(environment, 1, environment_for(policy, {"robot": own}))) as core:
        make_policy(str(policy), core.contract())
    return robot_hash(own)


def run_steps(progress: Progress, robot: AdaptedRobot | None, own: Robot) -> Adapted:
    """Do the steps that are not done, and write the page."""
    _step(progress, "before", lambda: drive_before(progress, robot))
    _, found = find_uncertainty(progress, robot, own)
    kept = progress.asked.policy
    if found is None:
        for name in ("training", "acceptance"):
            _step(progress, name, lambda: AdaptStep(outcome="left out", said=("There is nothing to train on.",)))
    else:
        _step(progress, "training", lambda: train_supervised(progress, found, own))
        _step(progress, "acceptance", lambda: accept_policy(progress, found, own))
        kept = str(progress.steps["acceptance"].numbers["policy"])
    _step(progress, "after", lambda: drive_after(progress, robot, kept))
    page = write_page(progress, kept)
    return Adapted(kept, kept != progress.asked.policy, dict(progress.steps), page)


def find_uncertainty(progress: Progress, robot: AdaptedRobot | None, own: Robot) -> tuple[Decided, Uncertainty | None]:
    """Do the steps from the runs to what the result states; None where it states nothing."""
    _step(progress, "runs", lambda: record_runs(progress, robot, own))
    _step(progress, "gap", lambda: find_gap(progress, robot))
    decided = _decided(progress)
    with progress.clock("model"):  # quick, and so made again where the step is done
        record, found = state_uncertainty(progress, decided, own)
    _step(progress, "model", lambda: record)
    return decided, found


def _step(progress: Progress, name: str, work: Callable[[], AdaptStep]) -> None:
    """Do a step that is not done yet; Ctrl-C leaves what it has."""
    if name in progress.steps:
        return
    progress.tell(name, 0.0)
    with progress.clock(name):
        found = work()
    progress.note(name, found)


def _decided(progress: Progress) -> Decided:
    """Return what the gap step has found, from its files."""
    from wlr_gym.gap.decision import HISTORY_FILE, History
    from wlr_gym.gap.report.result import RESULT_FILE, read_result

    path = progress.out / "gap" / HISTORY_FILE
    folder = Path(progress.steps["gap"].numbers["folder"])
    result = read_result(folder / RESULT_FILE) if (folder / RESULT_FILE).is_file() else None
    return Decided(parse_config(History, read_yaml(path), str(path)), result, folder)


# ---- steps that find out: the gap workflow, and what its result states -----------------------------------------------


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
    record_by = f" --record emulated --hidden {progress.out / 'hidden.yaml'}" if asked.driven == "emulated" else ""
    return AdaptStep(
        said=tuple(said),
        driving=history.seconds,
        command=f"wlr gap {quoted(data)} --out {quoted(progress.out / 'gap')} --until-decided --budget-runs {runs}{record_by}",
        numbers={
            "verdict": "" if result is None else result.verdict,
            "effects": [] if result is None else [one.name for one in result.effects],
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
    command = f"wlr envs {progress.asked.environment} --randomization {quoted(folder / 'randomization.yaml')}"
    numbers = {"effects": patch.content()["effects"], "families": [one.name for one in found.families]}
    return AdaptStep(said=found.said, command=command, numbers=numbers), found


def task_randomization(environment: str) -> str | Mapping[str, Any]:
    """Return the randomisation of a task's own."""
    return read_task(task_source_of(environment)).randomization
