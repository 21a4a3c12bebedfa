"""The robot as a Plant: ``backend="dynamixel"``. One robot, in real time, without truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_number
from wlr_gym.base.snapshot import Snapshot
from wlr_gym.data.format import RunMeta
from wlr_gym.hardware.camera.reading import load_camera_file
from wlr_gym.hardware.config import LONGEST_DEADMAN, Hardware, load_hardware, require_leg_range, with_ports
from wlr_gym.hardware.link import Link, serial_link
from wlr_gym.hardware.loop import ControlLoop
from wlr_gym.physics.plants.base import Capabilities, PlantOptions, PlantState, RobotOptions, Sensors, Truth
from wlr_gym.robot import JOINTS, LEG_SLICE, Robot
from wlr_gym.robot.parameter_table import ELEMENTS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Elements that say what is connected: whatever is asked for, a robot has what it has.
_IS_CONNECTED = np.array([element in ("camera.present", "flow.present") for element in ELEMENTS])


class RobotPlant:
    """One robot behind the command limiter; see :class:`wlr_gym.physics.plants.base.Plant`.

    Making it moves nothing. ``reset`` (or the first ``step``) makes the preflight checks, switches torque on and brings the
    robot to its start pose; ``close`` stops it and switches torque off. A robot that the safety rules have stopped raises
    :class:`wlr_gym.hardware.loop.StoppedError`.

    Args:
        robot: its numbers. count: 1. options: ``control_period``; the rest is for simulators.
        hardware: which robot, how it is connected. link: connections to use instead of those it names.
        meta: of the log; its profile is the servos'. None = robot's name, no profile.

    Attributes:
        loop: the control loop.

    Raises:
        InputError: more than one robot, a bad hardware file, or a deadman that would never act.
    """

    def __init__(
        self,
        robot: Robot,
        count: int,
        options: PlantOptions | None = None,
        hardware: RobotOptions | None = None,
        link: Link | None = None,
        meta: RunMeta | None = None,
    ) -> None:
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count != 1:
            raise InputError(f"number of robots is {count!r}, expected 1: there is one robot on the ports")
        self.robot, self.count = robot, 1
        self.options: PlantOptions = options or PlantOptions()
        self.parameters: Parameters = Parameters.nominal(robot, 1)
        chosen = hardware or RobotOptions()
        if chosen.floor is not None:
            chosen = replace(chosen, floor=_noted_floor(chosen, robot))
        self.capabilities: Capabilities = Capabilities("dynamixel", has_truth=False, can_set_state=False, real_time=True)
        description = with_ports(load_hardware(chosen.hardware), dict(chosen.ports))
        require_leg_range(description, robot, chosen.hardware)
        if chosen.deadman is not None:
            check_number("deadman", chosen.deadman, "s", above=0.0, most=LONGEST_DEADMAN)
            safety = description.safety.model_copy(update={"deadman": chosen.deadman})
            description = description.model_copy(update={"safety": safety})
        if link is None:
            link = link_of(robot, description, chosen, self.options.sensor_noise)
        self.parameters["flow.present"] = link.flow is not None
        self.parameters["camera.present"] = link.camera is not None
        self.loop: ControlLoop = ControlLoop(robot, description, link, self.options.control_period, chosen, meta)

    def reset(
        self,
        seeds: NDArray[np.uint64] | None = None,
        parameters: Parameters | None = None,
        mask: NDArray[np.bool_] | None = None,
        state: PlantState | None = None,
    ) -> Sensors:
        """Bring the robot to its start pose and return what it reads there; wheel angles count from here.

        Args:
            seeds: not used: the world draws. parameters: must be the robot file's. mask: (1,) False leaves the robot alone.
            state: its leg angles are the start pose; where the robot stands is where it stands. None = home.

        Raises:
            StoppedError: a preflight check failed, or the robot had to stop.
        """
        if parameters is not None:
            self.set_parameters(parameters)
        if mask is None or np.asarray(mask).all():
            self.loop.start(None if state is None else state.joint_position[0, LEG_SLICE])
        return self.loop.sensors()

    def step(self, setpoints: Array, torque_on: NDArray[np.bool_] | None = None) -> Sensors:
        """Send setpoints through the command limiter, wait for the deadline, read. What are no numbers stops the robot.

        Raises:
            StoppedError: the robot has stopped, and torque is off.
        """
        if self.loop.status is None:
            self.reset()
        shape = np.shape(setpoints)
        if shape != (1, len(JOINTS)) or (torque_on is not None and np.shape(torque_on) != shape):
            raise InputError(f"setpoints have shape {shape}, expected (1, {len(JOINTS)}), and torque_on the same")
        self.loop.tick(np.asarray(setpoints)[0], None if torque_on is None else np.asarray(torque_on)[0])
        return self.loop.sensors()

    def set_parameters(self, parameters: Parameters, mask: NDArray[np.bool_] | None = None) -> None:
        """Refuse whatever differs from the robot file."""
        if len(parameters) != 1:
            raise InputError(f"parameters hold {len(parameters)} robots, the plant 1")
        different = np.flatnonzero((parameters.values[0] != self.parameters.values[0]) & ~_IS_CONNECTED)
        if len(different):
            raise InputError(
                f"{ELEMENTS[different[0]]}: parameters of a real robot cannot be set (no randomisation, no effects)"
            )

    def truth(self) -> Truth:
        """Refuse: a robot knows its sensors only."""
        raise InputError("backend 'dynamixel': a real robot has no truth, only sensors")

    def mechanical_state(self) -> PlantState:
        """Refuse: a robot knows its sensors only."""
        raise InputError("backend 'dynamixel': the state of a real robot is not known")

    def get_state(self, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Snapshot:
        """Refuse: a robot knows its sensors only."""
        raise InputError("backend 'dynamixel': a real robot cannot be saved and set back; simulators can")

    def set_state(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Sensors:
        """Refuse: a robot is where it is."""
        raise InputError("backend 'dynamixel': a real robot cannot be saved and set back; simulators can")

    def close(self) -> None:
        """Stop the robot, switch torque off, close the ports."""
        self.loop.close()


def link_of(robot: Robot, hardware: Hardware, options: RobotOptions, sensor_noise: bool = True) -> Link:
    """Return connections to the robot that the options describe, closed; ``sensor_noise``: of an emulated one."""
    camera = None if options.camera is None else load_camera_file(options.camera)
    if not options.emulated:
        return serial_link(robot, hardware, camera, options.poses)
    from wlr_gym.hardware.emulator.link import emulated_robot  # with the simulators, which a real robot does not need

    own = {name: getattr(options, name) for name in ("effects", "floor", "seed")}
    return emulated_robot(robot, hardware, sensor_noise=sensor_noise, camera=camera, **own)


def _noted_floor(options: RobotOptions, robot: Robot) -> dict[str, Any] | None:
    """Return the content of the floor under a robot; an emulated robot's is drawn, a real one is what it is."""
    from wlr_gym.physics.floor import floor_noted, load_floor

    floor = load_floor(options.floor, robot)
    if floor.randomise and not options.emulated:
        raise InputError(f"floor '{floor.name}': randomise: the floor under a real robot is one: give its numbers")
    return floor_noted(floor.drawn(options.seed))
