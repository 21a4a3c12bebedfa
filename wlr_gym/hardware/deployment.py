"""Drive the real robot with a policy, or through a motion: torque is off before and after."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.loop import ControlLoop, StoppedError
from wlr_gym.hardware.operator import stop_on_request
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.robot import JOINTS, LEG_SLICE
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.data.excitations import Motion
    from wlr_gym.envs.core import Core
    from wlr_gym.policy import Policy

#: Times a policy is asked before the robot moves, so that whatever it compiles or allocates is there.
REHEARSALS = 20


@dataclass(frozen=True)
class DriveResult:
    """How a drive ended.

    Attributes:
        run: its log, whole or up to where it stopped; None where nothing was logged.
        reason: why it ended; of a motion: empty = at its end, in good order. Drive no other motion then.
        well: it ended at its end, or because somebody asked for it; and torque is confirmed off.
        ticks: control steps driven.
        statistics: of the control loop, with what the command limiter changed.
    """

    run: Path | None
    reason: str
    well: bool
    ticks: int
    statistics: dict[str, Any]


@dataclass(frozen=True)
class Deployment(DriveResult):
    """How a policy's drive ended; ``time is over`` when nothing happened.

    Attributes:
        inference: s that the policy took per step, (ticks,).
    """

    inference: NDArray[np.float64]


class DriveWatcher(Protocol):
    """Looks on while a policy drives."""

    def begin(self) -> None:
        """The robot stands where its episode begins."""

    def take(self, command: NDArray[np.float64]) -> str:
        """A control step is over in which the robot followed ``command`` (1, C); return why the run is to end, or nothing."""
        ...


def loop_of(core: Core) -> ControlLoop:
    """Return the control loop of a core that drives the real robot."""
    if not isinstance(core.plant, RobotPlant):
        raise InputError(f"backend '{core.settings.backend}' is no robot: expected 'dynamixel'")
    return core.plant.loop


def deploy(
    core: Core,
    policy: Policy,
    seed: int = 0,
    command: Mapping[str, float] | None = None,
    steer: Callable[[], Mapping[str, float]] | None = None,
    watcher: DriveWatcher | None = None,
) -> Deployment:
    """Bring the robot to its start pose and drive it until the episode is over or something stops it; torque is off then.

    Args:
        core: of one real robot; its episode length is how long it drives.
        policy: what drives it.
        seed: of the commands that are drawn.
        command: held instead of drawn ones.
        steer: asked in every control step for commands to follow from then on (a gamepad).
        watcher: looks on; may end the run.
    """
    loop = loop_of(core)
    core.seed(0, seed)
    policy.reset(core.everyone)
    for _ in range(REHEARSALS):
        policy.act(core.observation)
    policy.reset(core.everyone)
    inference: list[float] = []
    columns = [*(f"command_{name}" for name in core.task.commands), *(f"action_{joint}" for joint in JOINTS)]
    with _no_garbage_collection():
        try:
            held = {**(command or {}), **(steer() if steer else {})}
            core.begin_episodes(core.everyone, {"command": held} if held else None)
            if watcher is not None:
                watcher.begin()
            while not (core.terminated[0] or core.truncated[0]):
                start = time.perf_counter()
                action = policy.act(core.observation)
                inference.append(time.perf_counter() - start)
                row = np.concatenate([core.command[0], np.asarray(action, np.float64)[0]])
                loop.recorder.policy(columns, row)
                if steer is not None:
                    core.set_command(steer())
                followed = core.command.copy()
                core.step(action, core.everyone)
                if watcher is not None and (reason := watcher.take(followed)):
                    loop.stop(reason)
                    break
            loop.stop("time is over")
        except StoppedError:
            pass  # it is in the loop's reason
        finally:
            loop.stop("exception")
    return Deployment(loop.recorder.run, loop.reason, loop.ended_well, len(inference), loop.statistics(), np.array(inference))


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Collect now, and not again before it is over: a collection takes longer than a control step's slack."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def refuse_deadman(plant: RobotPlant) -> None:
    """Refuse a robot that waits for an operator's signs, where nobody gives any: it would only be held."""
    if (seconds := plant.loop.limits.deadman) is not None:
        raise InputError(
            f"safety.deadman = {seconds:g} s: there is no key or stick for an operator's sign: leave it empty, and give wlr "
            "deploy --deadman"
        )


def drive_robot(plant: RobotPlant, motion: Motion) -> DriveResult:
    """Go to the motion's first pose, drive it, stop; torque is off afterwards.

    Args:
        plant: the robot, torque off.
        motion: setpoints; NaN = that motor off. Its servo profile must be the plant's.
    """
    refuse_deadman(plant)
    loop, robot = plant.loop, plant.robot
    state = standing_state(robot, Parameters.nominal(robot))
    state.joint_position[0, LEG_SLICE] = motion.start(robot)[LEG_SLICE]
    reason, ticks = "", 0
    setpoints, torque_on = np.nan_to_num(motion.setpoints), np.isfinite(motion.setpoints)
    with stop_on_request(loop.operator):
        try:
            plant.reset(state=state)
            for tick in range(len(setpoints)):
                plant.step(setpoints[tick : tick + 1], torque_on[tick : tick + 1])
                ticks += 1
            loop.finish("the motion is over")
        except StoppedError as error:
            reason = str(error)
        finally:
            loop.stop("exception")
    return DriveResult(loop.recorder.run, reason, loop.ended_well, ticks, loop.statistics())
