"""The robot that a policy is adapted to, emulated or real; episodes that it drives; and the steps in which it does."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_json
from wlr_gym.base.random import generator
from wlr_gym.base.text import quoted
from wlr_gym.data.excitations import Motion, excite
from wlr_gym.data.format import RunMeta
from wlr_gym.data.record import meta_of
from wlr_gym.data.runs import Run, read_dataset, read_run, robot_of, run_files
from wlr_gym.envs.core import make_task, measured_truth
from wlr_gym.envs.registry import task_source_of
from wlr_gym.envs.settings import read_settings
from wlr_gym.envs.tasks.compiled_terms import Scores, compile_scores
from wlr_gym.envs.tasks.signals import yaw_of
from wlr_gym.envs.tasks.task import scales_of, tracking_error
from wlr_gym.gap.decision import Recorded
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.deployment import Deployment, deploy, drive_robot, refuse_deadman
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link, with_flow_port
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.operator import STOP_KEYS, STOP_SIGNALS, stop_on_request
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.learning.adaptation.state import AdaptStep, Asked, Progress
from wlr_gym.learning.evaluation.metrics import Bootstrap, Estimate
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.learning.evaluation.scoring import evaluate
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.effects import Patch, apply_patch
from wlr_gym.physics.floor import Floor, floor_noted, lay_floor, load_floor
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import TRUTH_LAYOUT, PlantOptions, RobotOptions, settle, standing_state
from wlr_gym.policy import environment_for, make_policy
from wlr_gym.robot import Robot, robot_hash
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.envs.tasks.task import Task

#: s of emulated time per tick of an emulated robot.
TICK = 0.002


@dataclass(frozen=True, eq=False)
class EmulatedRobot:
    """An emulated robot, servos and command limiter included, on a simulator that need not be the one of the training.

    Attributes:
        robot: its file. hidden: what it has that the file does not say.
        floor: that it drives on, nothing left to be drawn; None = a plane. The logs have it.
        backend, physics_step: simulator behind it, and its step (s).
        copy: parameters of the copy before what is hidden is added; None = nominal.
    """

    robot: Robot
    hidden: Patch = field(default_factory=Patch)
    backend: str = "gibbs_appell"
    physics_step: float = 0.001
    copy: Parameters | None = None
    floor: Floor | None = None

    def start(self, log: Path | None, seed: int, meta: RunMeta | None = None) -> tuple[RobotPlant, Any]:
        """Return the robot standing with a heading that the seed draws, torque off, and the simulator behind it."""
        own = self.copy.copy() if self.copy is not None else Parameters.nominal(self.robot)
        floor = self.floor or load_floor(None)
        parameters = apply_patch(self.hidden, lay_floor(floor, own))
        state = standing_state(self.robot, parameters)
        yaw = generator(seed, "adaptation", "heading").uniform(-np.pi, np.pi)
        state.quaternion[0] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        settle(self.robot, parameters, state)
        hardware = with_flow_port(self.robot, load_hardware("nominal"))
        options = PlantOptions(control_period=TICK, physics_step=self.physics_step)
        plant = make_plant(self.backend, self.robot, 1, options, self.hidden.forces)
        machine = Machine(
            self.robot,
            hardware,
            MachineOptions(timing=NO_TIME, tick=TICK, seed=seed),
            plant=plant,
            parameters=parameters,
            state=state,
        )
        logged = RobotOptions(log=log, floor=floor_noted(floor))
        driven = RobotPlant(self.robot, 1, PlantOptions(), logged, link=emulated_link(machine), meta=meta)
        return driven, machine.plant


@dataclass(frozen=True, eq=False)
class RealRobot:
    """A robot on its ports.

    Attributes:
        robot: its file. hardware: wiring and mounting. ports: other ones than the file's.
        ask: called with what the robot is about to do, before every drive; raises where it may not.
    """

    robot: Robot
    hardware: str = "nominal"
    ports: Mapping[str, str] = field(default_factory=dict)
    ask: Callable[[str], None] = lambda text: None

    def start(self, log: Path | None, seed: int, meta: RunMeta | None = None) -> tuple[RobotPlant, Any]:
        """Ask, and return the robot, torque off; it has no truth."""
        self.ask("The robot will stand up and drive.")
        options = RobotOptions(hardware=self.hardware, ports=self.ports, log=log)
        return RobotPlant(self.robot, 1, PlantOptions(), options, meta=meta), None


AdaptedRobot = EmulatedRobot | RealRobot


def excite_robot(robot: AdaptedRobot, motion: Motion, data: Path, seed: int = 0) -> Recorded:
    """Drive a motion and leave its run in ``data``.

    Raises:
        KeyboardInterrupt: somebody stopped the drive; its run is removed.
    """
    with closing(robot.start(data, seed, meta_of(motion, robot.robot))[0]) as plant:
        drive = drive_robot(plant, motion)
    if interrupted(drive.reason):
        if drive.run is not None:
            drive.run.unlink(missing_ok=True)
        raise KeyboardInterrupt(drive.reason)
    return Recorded(drive.run, drive.reason)


def interrupted(reason: str) -> bool:
    """Whether a drive ended because a signal or a key asked for it."""
    return any(name in reason for name in (*STOP_SIGNALS, *STOP_KEYS))


# ---- an episode, scored by the measures that its task has in simulation ----------------------------------------------


Array = NDArray[np.float64]

#: Why an episode ended that was driven to its end.
WHOLE = "time is over"
#: The same of one in which it fell.
FELL = "it fell"


@dataclass(frozen=True)
class RobotEpisode:
    """How an episode went.

    Attributes:
        seed: of its commands.
        tracking_error: as in evaluations; a fall or a stop by the supervision adds 10.
        measures: rms of each measure, SI units.
        seconds: driven.
        reason: why it ended.
    """

    seed: int
    tracking_error: float
    measures: Mapping[str, float]
    seconds: float
    reason: str

    @property
    def whole(self) -> bool:
        """Whether it was driven to its end."""
        return self.reason == WHOLE


def drive_episode(environment: str, policy: str, robot: AdaptedRobot, seed: int, seconds: float) -> RobotEpisode:
    """Drive one episode; torque is off afterwards. Commands are those of a simulated episode of the same seed.

    An emulated robot is scored by its true motion, a real one by what the slip observer and the gyro say of it.

    Args:
        environment: id. policy: its source. robot: what is driven.
        seed: of the commands. seconds: of the episode.

    Raises:
        InputError: a policy that does not fit, or without a slip observer on a real robot; ports that cannot be opened.
    """
    keywords = {"backend": "dynamixel", "hardware": RobotOptions(emulated=True), "episode_length": seconds}
    core = make_core(environment, 1, environment_for(policy, keywords))
    core.plant.close()
    plant, truth = robot.start(None, seed)
    core.plant = plant
    try:
        refuse_deadman(plant)
        if truth is None and core.observer is None:
            raise InputError(f"policy '{policy}': it has no slip observer, which is what tells how a real robot moves")
        whole = make_task(task_source_of(environment), read_settings(environment_for(policy, {})))  # with all measures
        score = _Score(whole, core, truth)
        with stop_on_request(plant.loop.operator):
            driven = deploy(core, make_policy(policy, core.contract()), seed, watcher=score)
    finally:
        core.close()
    return score.episode(seed, driven)


class _Score:
    """The measures of an episode on a robot, by the kernel that scores simulated ones."""

    def __init__(self, task: Task, core: Core, truth: Any) -> None:
        self._task, self._core, self._true = task, core, truth
        self._kernel = compile_scores(task)
        self._scores = Scores.zeros(task, 1)
        self._start = np.zeros_like(core.start)
        self._ticks = 0

    def begin(self) -> None:
        """Note where the episode starts."""
        now = self._truth()
        self._start[0, :2] = TRUTH_LAYOUT.view(now, "position")[0, :2]
        self._start[0, 2] = yaw_of(*TRUTH_LAYOUT.view(now, "quaternion").T)[0]

    def take(self, command: Array) -> str:
        """Score a control step; say so where a termination of the task ends the episode."""
        core, task = self._core, self._task
        estimate = np.zeros((1, ESTIMATE_LAYOUT.width)) if core.observer is None else core.observer.values
        clock = np.array([[(self._ticks + 1) * task.config.control_period]])
        signals = (
            core.sensors.values, estimate, self._truth(), command, core.action, core.actions.previous, self._start, clock,
            core.presence, core.computed,
        )  # fmt: skip
        self._kernel.run(core.everyone, signals, self._kernel.numbers, tuple(self._scores))
        self._ticks += 1
        return FELL if (self._scores.over > 0.0).any() else ""

    def _truth(self) -> Array:
        if self._true is not None:
            return self._true.truth().values.copy()
        observer = self._core.observer
        assert observer is not None
        found = measured_truth(self._core.sensors)
        for channel in ("position", "linear_velocity_in_body"):
            found[:, TRUTH_LAYOUT.slices[channel]][:, :2] = ESTIMATE_LAYOUT.view(observer.values, channel)
        half = 0.5 * ESTIMATE_LAYOUT.view(observer.values, "yaw")
        TRUTH_LAYOUT.view(found, "quaternion")[:, [0, 3]] = np.stack([np.cos(half), np.sin(half)], axis=-1)
        return np.nan_to_num(found)

    def episode(self, seed: int, driven: Deployment) -> RobotEpisode:
        """Return how it went."""
        reason = driven.reason
        task, ticks = self._task, max(1, self._ticks)
        rms = np.sqrt(self._scores.squares[0] / ticks)
        measures = {name: float(value) for name, value in zip(task.measures, rms, strict=True)}
        largest = dict(zip(task.measures, self._scores.largest[0], strict=True))
        scales = scales_of(task.config)
        errors = {(name, kind): np.array([measures[name] if kind == "rms" else largest[name]]) for name, kind in scales}
        error = float(tracking_error(scales, errors, np.array([reason != WHOLE]))[0])
        return RobotEpisode(seed, error, measures, ticks * task.config.control_period, reason)


# ---- steps: the task before, the excitations, and the task again, old policy beside new ------------------------------

#: Seeds of the episodes before and after: no episode is driven twice, and none is met in training or acceptance.
BEFORE, AFTER = 300_000, 400_000
#: s; shorter runs say nothing.
SHORTEST = 3.0
_NO_ROBOT = "No robot to drive: measured runs were given."


def drive_before(progress: Progress, robot: AdaptedRobot | None) -> AdaptStep:
    """Drive the task with the old policy; in simulation the same commands on the model as its file has it."""
    asked = progress.asked
    if robot is None:
        return AdaptStep(outcome="left out", said=(_NO_ROBOT,))
    seeds = seeds_of(BEFORE, asked)
    driven = episodes_of(progress, "before", {"old": asked.policy}, robot, seeds)["old"]
    model = on_the_model(progress, seeds)
    errors = errors_of(driven)
    lost = paired(errors, np.full(len(errors), model))
    said = f"Tracking error on the robot {errors.mean():.3f}, of the model as its file has it {model:.3f}."
    return AdaptStep(
        said=(said, *stops(driven)),
        driving=sum(one.seconds for one in driven),
        command=_deploy_command(asked.policy, progress, seeds[0]),
        numbers={"old": errors.tolist(), "model": model, "lost_percent": 100.0 * (errors.mean() / model - 1.0)}
        | {"lost_ci95": [-lost.high, -lost.low]},
    )


def drive_after(progress: Progress, robot: AdaptedRobot | None, kept: str) -> AdaptStep:
    """Drive fresh episodes with the old policy and the kept one, in turns."""
    asked = progress.asked
    if robot is None:
        return AdaptStep(outcome="left out", said=(_NO_ROBOT, f"To drive it: wlr deploy {quoted(kept)}"))
    if kept == asked.policy:
        return AdaptStep(outcome="left out", said=("The old policy is kept: there is nothing new to drive.",))
    seeds = seeds_of(AFTER, asked)
    driven = episodes_of(progress, "after", {"old": asked.policy, "new": kept}, robot, seeds)
    old, new = errors_of(driven["old"]), errors_of(driven["new"])
    model, gain = on_the_model(progress, seeds), paired(new, old)
    regained = 100.0 * (old.mean() - new.mean()) / (old.mean() - model) if old.mean() > model else float("nan")
    said = f"Tracking error on fresh episodes {old.mean():.3f} with the old policy, {new.mean():.3f} with the new one: "
    said += f"{gain.mean:.0f} % [{gain.low:.0f}, {gain.high:.0f}] better."
    return AdaptStep(
        said=(said, *stops([*driven["old"], *driven["new"]])),
        driving=sum(one.seconds for both in driven.values() for one in both),
        command=_deploy_command(kept, progress, seeds[0]),
        numbers={"old": old.tolist(), "new": new.tolist(), "model": model, "better_percent": gain.mean}
        | {"better_ci95": [gain.low, gain.high], "regained_percent": regained if np.isfinite(regained) else None},
    )


def record_runs(progress: Progress, robot: AdaptedRobot | None, own: Robot) -> AdaptStep:
    """Drive the excitations, or check the runs that were given."""
    asked = progress.asked
    if asked.robot_runs is not None:
        return check_runs(Path(asked.robot_runs), own)
    assert robot is not None
    folder = progress.folder("runs")
    noted = folder / "driven.json"
    done: dict[str, Any] = json.loads(noted.read_text(encoding="utf-8")) if noted.is_file() else {}
    for path in run_files(folder):  # that of a drive that was killed is not noted
        if path.name not in {one["run"] for one in done.values()}:
            path.unlink()
    for number, name in enumerate(asked.excitations):
        if name in done:
            continue
        progress.tell(f"robot: {name}", number / len(asked.excitations))
        recorded = excite_robot(robot, excite(name, asked.seed, own), folder, asked.seed + number)
        seconds, kept = 0.0, ""
        if recorded.run is not None:
            seconds = _seconds(read_run(recorded.run))
            if seconds < SHORTEST:
                recorded.run.unlink()
            else:
                kept = recorded.run.name
        done[name] = {"run": kept, "seconds": seconds, "stopped": recorded.reason}
        write_json(noted, done)
    stopped = [f"The supervision stopped '{name}': {one['stopped']}" for name, one in done.items() if one["stopped"]]
    kept = [name for name, one in done.items() if one["run"]]
    return AdaptStep(
        said=(f"{len(kept)} of {len(done)} excitations left a run: {', '.join(kept) or 'none'}.", *stopped),
        driving=sum(one["seconds"] for one in done.values()),
        command=f"wlr record --excitation {' '.join(asked.excitations)} --out {quoted(folder)}{_emulated_words(progress)}",
    )


def check_runs(folder: Path, own: Robot) -> AdaptStep:
    """Read the runs that were given; errors as of :func:`record_runs`."""
    runs = read_dataset(folder).runs
    for run in runs:
        measured = robot_of(run)
        if robot_hash(measured) != robot_hash(own):
            raise InputError(
                f"{run.path}: of robot '{measured.name}' ({robot_hash(measured)}), and the policy is made for '{own.name}' "
                f"({robot_hash(own)}); expected runs of the policy's robot"
            )
    seconds = sum(map(_seconds, runs))
    return AdaptStep(said=(f"{len(runs)} measured runs were given, {seconds:.0f} s in all.",), driving=seconds)


def _seconds(run: Run) -> float:
    return float(run["t"][-1] - run["t"][0])


# ---- episodes of a step ----------------------------------------------------------------------------------------------


def seeds_of(first: int, asked: Asked) -> list[int]:
    """Return the seeds of the episodes that are driven, from ``BEFORE`` or ``AFTER`` on."""
    return [first + 1000 * asked.seed + k for k in range(asked.drives)]


def episodes_of(
    progress: Progress, step: str, policies: Mapping[str, str], robot: AdaptedRobot, seeds: Sequence[int]
) -> dict[str, list[RobotEpisode]]:
    """Drive episodes with policies in turns; those that the step's folder has are not driven again.

    Raises:
        KeyboardInterrupt: somebody stopped the robot.
    """
    asked, path = progress.asked, progress.folder(step) / "episodes.json"
    content = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    done = {name: [RobotEpisode(**one) for one in content.get(name, [])] for name in policies}
    total = len(seeds) * len(policies)
    for seed in seeds:
        for name, policy in policies.items():
            if seed in [one.seed for one in done[name]]:
                continue
            progress.tell(f"robot: episode {seed} with the {name} policy", sum(map(len, done.values())) / total)
            episode = drive_episode(asked.environment, policy, robot, seed, asked.drive_seconds)
            if interrupted(episode.reason):
                raise KeyboardInterrupt(episode.reason)
            done[name].append(episode)
            write_json(path, {key: [asdict(one) for one in several] for key, several in done.items()})
    return done


def on_the_model(progress: Progress, seeds: Sequence[int]) -> float:
    """Return the old policy's tracking error in simulation, on the robot as its file has it, with the same commands."""
    asked = progress.asked
    card = evaluate(
        asked.policy,
        asked.environment,
        baselines=(),
        episodes=len(seeds),
        seed=seeds[0],
        randomization="none",
        floor=asked.floor,
        sensors=asked.sensors,
    )
    return float(card.scores["main"][card.names[0]]["tracking_error"].mean)


def errors_of(episodes: Sequence[RobotEpisode]) -> Array:
    """Return the tracking errors (N,)."""
    return np.array([one.tracking_error for one in episodes])


def paired(ours: Array, theirs: Array) -> Estimate:
    """Return by how much ours is better, % of theirs, with its interval over the episodes."""
    return Bootstrap(1, len(ours)).reduction(_pairs(ours), _pairs(theirs))


def share_regained(old: Array, new: Array, best: Array) -> Estimate:
    """Return (old - new) / (old - best), %, with its interval over the episodes."""
    pairs = [_pairs(errors) for errors in (old, old, new, best)]
    return Bootstrap(1, len(old)).share(*pairs, subjects=(0, 0, 1, 2))


def _pairs(errors: Array) -> Array:
    return np.stack([errors, np.ones(len(errors))], axis=1)[None]


def stops(episodes: Sequence[RobotEpisode]) -> tuple[str, ...]:
    """Return why episodes ended early, in sentences."""
    return tuple(f"Episode {one.seed} ended after {one.seconds:.1f} s: {one.reason}." for one in episodes if not one.whole)


def _deploy_command(policy: str, progress: Progress, seed: int) -> str:
    asked = progress.asked
    stepped = " --stepped" if asked.driven == "emulated" else ""
    return f"wlr deploy {quoted(policy)}{_emulated_words(progress)}{stepped} --seconds {asked.drive_seconds:g} --seed {seed}"


def _emulated_words(progress: Progress) -> str:
    asked = progress.asked
    if asked.driven != "emulated":
        return ""
    words = [" --emulated"]
    words += [f"--effects {progress.out / 'hidden.yaml'}"] if asked.effects else []
    words += [f"--floor {progress.out / 'floor.yaml'}"] if asked.floor is not None else []
    return " ".join(words)
