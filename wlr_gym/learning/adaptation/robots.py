"""The robot that a policy is adapted to: an emulated one in emulated time, or a real one on its ports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym.base.random import generator
from wlr_gym.data.excitations import Motion
from wlr_gym.data.format import RunMeta
from wlr_gym.data.record import meta_of
from wlr_gym.gap.decision import Recorded
from wlr_gym.hardware.config import load_hardware
from wlr_gym.hardware.deployment import drive_robot
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link, with_flow_port
from wlr_gym.hardware.emulator.machine import Machine, MachineOptions
from wlr_gym.hardware.operator import STOP_KEYS, STOP_SIGNALS
from wlr_gym.hardware.plant import RobotPlant
from wlr_gym.physics.effects import Patch, apply_patch
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, RobotOptions, standing_state
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

#: s of emulated time per tick of an emulated robot.
TICK = 0.002


@dataclass(frozen=True, eq=False)
class EmulatedRobot:
    """An emulated robot, servos and command limiter included, on a simulator that need not be the one of the training.

    Attributes:
        robot: its file. hidden: what it has that the file does not say.
        backend, physics_step: simulator behind it, and its step (s).
        copy: parameters of the copy before what is hidden is added; None = nominal.
    """

    robot: Robot
    hidden: Patch = field(default_factory=Patch)
    backend: str = "gibbs_appell"
    physics_step: float = 0.001
    copy: Parameters | None = None

    def start(self, log: Path | None, seed: int, meta: RunMeta | None = None) -> tuple[RobotPlant, Any]:
        """Return the robot standing with a heading that the seed draws, torque off, and the simulator behind it."""
        own = self.copy.copy() if self.copy is not None else Parameters.nominal(self.robot)
        parameters = apply_patch(self.hidden, own)
        state = standing_state(self.robot, parameters)
        yaw = generator(seed, "adaptation", "heading").uniform(-np.pi, np.pi)
        state.quaternion[0] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
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
        driven = RobotPlant(self.robot, 1, PlantOptions(), RobotOptions(log=log), link=emulated_link(machine), meta=meta)
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
