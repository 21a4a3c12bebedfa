"""Adaptation from Python: what ``wlr adapt`` does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import alone_in
from wlr_gym.base.provenance import record_provenance
from wlr_gym.base.settings import parse_config, parse_options, read_yaml
from wlr_gym.data.excitations import excite
from wlr_gym.data.record import same_profile
from wlr_gym.envs.registry import task_name_of
from wlr_gym.gap.decision import Decided
from wlr_gym.learning.adaptation.driving import check_runs, drive_after, drive_before, record_runs
from wlr_gym.learning.adaptation.identification import find_gap, state_uncertainty
from wlr_gym.learning.adaptation.page import write_page
from wlr_gym.learning.adaptation.plan import EXCITATIONS, AdaptStep, Asked, Progress, Tell, open_folder
from wlr_gym.learning.adaptation.retraining import accept_policy, train_supervised
from wlr_gym.learning.adaptation.robots import AdaptedRobot, EmulatedRobot, RealRobot
from wlr_gym.learning.adaptation.uncertainty import Uncertainty
from wlr_gym.learning.evaluation.subjects import identity, read_subjects
from wlr_gym.physics.effects import Source, load_patch, save_patch
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
    robot_runs: str | Path | None = None,
    driven: AdaptedRobot | None = None,
    effects: Source = None,
    backend: str = "gibbs_appell",
    environment: str | None = None,
    robot: RobotSource | None = None,
    excitations: Sequence[str] = EXCITATIONS,
    budget_runs: int = 2,
    budget_seconds: float | None = None,
    drives: int = 6,
    drive_seconds: float = 10.0,
    steps: int = 7_500_000,
    learning_rate: float = 5e-4,
    episodes: int = 256,
    sensors: Sequence[str] = (),
    seed: int = 0,
    threads: int = 1,
    tell: Tell = lambda text, share: None,
) -> Adapted:
    """Adapt a policy to a robot, as ``wlr adapt`` does. Called again with the same arguments it resumes.

    Args:
        policy: that PPO trained: shipped, a file, or a policy or run folder.
        out: folder for all steps; new, empty, or of the same request.
        robot_runs: measured runs; None = they are recorded on the robot.
        driven: the robot; None = without ``robot_runs`` an emulated one that has ``effects``, with them none.
        effects: what the emulated robot has that its file does not say. backend: simulator behind it.
        environment: id; None = the one that the policy was trained in.
        robot: None = the policy's.
        excitations: of the first runs. budget_runs, budget_seconds: of further ones.
        drives, drive_seconds: episodes of the task before and after.
        steps, learning_rate: of the training. episodes: of each family in the acceptance test.
        sensors: which of camera and flow the robot has. seed: of everything random.
        threads: of the gap workflow and the acceptance test. tell: called with progress.

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
    check_simulator(backend, "--backend")
    if robot_runs is not None and patch:
        raise InputError("--effects: measured runs have what their robot has; they are for --emulated")
    if driven is None and robot_runs is None:
        driven = EmulatedRobot(own, patch, backend)
    if driven is not None and "camera" in sensors:
        raise InputError("--sensors camera: robots are driven without a camera here; give measured runs, or leave it out")
    same_profile([excite(name, seed, own) for name in excitations])
    given = {
        "policy": str(policy),
        "identity": identity(read_subjects([str(policy)])[0]),
        "environment": chosen,
        "robot_runs": None if robot_runs is None else str(Path(robot_runs).resolve()),
        "robot": _fitting(policy, chosen, own),
        "driven": "" if driven is None else "real" if isinstance(driven, RealRobot) else "emulated",
        "effects": [dict(one.content()) for one in patch.effects],
        "backend": backend,
        "excitations": tuple(excitations),
        "budget_runs": budget_runs,
        "budget_seconds": budget_seconds,
        "drives": drives,
        "drive_seconds": drive_seconds,
        "steps": steps,
        "learning_rate": learning_rate,
        "episodes": episodes,
        "sensors": tuple(sensors),
        "seed": seed,
    }
    asked = parse_options(Asked, given)
    if robot_runs is not None:
        if not Path(robot_runs).is_dir():
            raise InputError(f"--robot-runs {robot_runs}: no such folder; expected measured runs")
        check_runs(Path(robot_runs), own)  # before anything is written
    progress = open_folder(Path(out), asked, tell, threads)
    with alone_in(progress.out):
        if not progress.steps:
            record_provenance(progress.out, asked.model_dump(mode="json"), seed)
            save_patch(patch, progress.out / "hidden.yaml")
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
