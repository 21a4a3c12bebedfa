"""Drive the real robot through a motion, through the command limiter, with a log in the measured-run format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.data.excitations import Motion
from wlr_gym.data.record import start_setpoints
from wlr_gym.hardware.loop import StoppedError
from wlr_gym.hardware.operator import stop_on_request
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.robot import LEG_SLICE
from wlr_gym.robot.parameters import Parameters


@dataclass(frozen=True)
class DriveResult:
    """How a drive ended.

    Attributes:
        run: its log, whole or up to where it stopped; None where nothing was logged.
        reason: why it stopped early, or not in good order; empty = neither. Drive no other motion then.
        well: it ended at the motion's end, or because somebody asked for it; and torque is confirmed off.
        ticks: control steps driven.
        statistics: of the control loop, with what the command limiter changed.
    """

    run: Path | None
    reason: str
    well: bool
    ticks: int
    statistics: dict[str, Any]


def refuse_deadman(plant: RobotPlant) -> None:
    """Refuse a robot that waits for an operator's signs, where nobody gives any: it would only be held.

    Raises:
        InputError: it does.
    """
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

    Raises:
        InputError: the robot waits for an operator's signs, which nobody gives here.
    """
    refuse_deadman(plant)
    loop, robot = plant.loop, plant.robot
    state = standing_state(robot, Parameters.nominal(robot))
    state.joint_position[0, LEG_SLICE] = start_setpoints(motion, robot)[LEG_SLICE]
    reason, ticks = "", 0
    torque_on = np.isfinite(motion.setpoints)
    setpoints = np.nan_to_num(motion.setpoints)
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
