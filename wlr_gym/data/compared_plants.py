"""Plants that are compared, and what each of them does on the same motions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.data.body_pose import euler_angles
from wlr_gym.data.excitations import CONTROL_PERIOD, Motion
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.run_states import standing_at
from wlr_gym.physics.effects import Patch, apply_patch
from wlr_gym.physics.plants import check_simulator, make_plant
from wlr_gym.physics.plants.base import PlantOptions, Sensors, Truth
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: s at the first setpoints before time 0, not compared: until the bounce of being set down has died out.
SETTLE = 0.5


@dataclass(frozen=True)
class ComparedPlant:
    """A plant and the numerical options it is run with.

    Attributes:
        backend: of :data:`wlr_gym.physics.plants.SIMULATORS`.
        physics_step: s.
        precision: ``float64`` or ``float32``.
    """

    backend: str
    physics_step: float = 0.001
    precision: str = "float64"

    @property
    def label(self) -> str:
        """Short name, with what is not usual: ``gibbs_appell, 0.5 ms``."""
        precision = "" if self.precision == "float64" else f", {self.precision}"
        return f"{self.backend}, {1e3 * self.physics_step:g} ms{precision}"

    @property
    def halved(self) -> ComparedPlant:
        """The same at half the step."""
        return replace(self, physics_step=0.5 * self.physics_step)


def parse_plant(text: str, physics_step: float = 0.001) -> ComparedPlant:
    """Read ``BACKEND`` or ``BACKEND:option=value,...`` with the options ``physics_step`` (s) and ``precision``.

    Raises:
        InputError: unknown backend or option, a step that does not divide the control period, an unknown precision.
    """
    backend, _, options = text.partition(":")
    check_simulator(backend, f"plant '{text}'")  # a real robot has no truth to compare, nor the guards of wlr record here
    plant = ComparedPlant(backend, physics_step)
    for option in filter(None, options.split(",")):
        name, _, value = option.partition("=")
        if name == "physics_step":
            try:
                plant = replace(plant, physics_step=float(value))
            except ValueError:
                raise InputError(f"plant '{text}': physics_step = {value!r}: expected a number of seconds") from None
        elif name == "precision":
            plant = replace(plant, precision=value)
        else:
            raise unknown_name("option", name, ("physics_step", "precision"), f"plant '{text}'")
    if plant.precision not in (precisions := ("float64", "float32")):
        raise unknown_name("precision", plant.precision, precisions, f"plant '{text}'")
    PlantOptions(control_period=CONTROL_PERIOD, physics_step=plant.physics_step)
    return plant


@dataclass(frozen=True, eq=False)
class Traces:
    """What one plant did: one row per control step from time 0 on, first axis ticks + 1, second axis motions.

    Attributes:
        plant, robot: the plant, and which robot.
        sensors: (ticks + 1, motions, SENSOR_LAYOUT.width) without noise. truth: likewise, TRUTH_LAYOUT.width.
    """

    plant: ComparedPlant
    robot: Robot
    sensors: Array
    truth: Array

    @cached_property
    def signals(self) -> dict[str, Array]:
        """Every signal of :func:`wlr_gym.data.compared_signals.resolutions`, each (ticks + 1, motions, elements)."""
        shape = self.sensors.shape[:2]
        sensors = Sensors(self.sensors.reshape(-1, self.sensors.shape[2]))
        truth = Truth(self.truth.reshape(-1, self.truth.shape[2]))
        yaw, pitch, roll = euler_angles(truth.quaternion)
        force, slip = truth.contact_force.reshape(-1, 4, 3), truth.slip_velocity.reshape(-1, 4, 2)
        signs, hip = np.array(CORNER_SIGNS), self.robot.hip_position
        x, y = signs[:, 0] * hip.x + self.robot.leg.length * np.cos(truth.joint_position[:, LEG_SLICE]), signs[:, 1] * hip.y
        flat = {
            "pos_leg": sensors.joint_position[:, LEG_SLICE],
            "pos_wheel": sensors.joint_position[:, WHEEL_SLICE],
            "vel_leg": sensors.joint_velocity[:, LEG_SLICE],
            "vel_wheel": sensors.joint_velocity[:, WHEEL_SLICE],
            "eff_leg": sensors.joint_effort[:, LEG_SLICE],
            "eff_wheel": sensors.joint_effort[:, WHEEL_SLICE],
            "gyro": sensors.gyro,
            "acc": sensors.accelerometer,
            "cam_xy": sensors.camera_pose[:, :2],
            "cam_yaw": sensors.camera_pose[:, 2:],
            "volt": sensors.supply_voltage[:, None],
            "true_xy": truth.position[:, :2],
            "true_z": truth.position[:, 2:],
            "true_yaw": yaw[:, None],
            "true_tilt": np.stack([pitch, roll], axis=1),
            "motor_torque_leg": truth.motor_torque[:, LEG_SLICE],
            "motor_torque_wheel": truth.motor_torque[:, WHEEL_SLICE],
            "normal_force": force[:, :, 2],
            "total_along": force[:, :, 0].sum(axis=1, keepdims=True),
            "total_across": force[:, :, 1].sum(axis=1, keepdims=True),
            "total_turn": (x * force[:, :, 1] - y * force[:, :, 0]).sum(axis=1, keepdims=True),
            "friction_along": force[:, :, 0],
            "friction_across": force[:, :, 1],
            "slip_along": slip[:, :, 0],
            "slip_across": slip[:, :, 1],
        }
        return {name: values.reshape(*shape, -1) for name, values in flat.items()}


def drive(
    plant: ComparedPlant,
    motions: Sequence[Motion],
    robot: Robot,
    parameters: Parameters | None = None,
    patch: Patch | None = None,
    threads: int = 1,
    tell: Callable[[float], None] = lambda share: None,
) -> Traces:
    """Drive all motions on one plant, one robot of a batch each; a shorter motion stays at its last setpoints.

    Args:
        plant: the plant.
        motions: of one period.
        robot: the robot.
        parameters: (1) physical parameters; None = nominal. Each motion's servo profile is written into them.
        patch: effects to add.
        threads: of the plant.
        tell: called with the share that is done.
    """
    patch = patch or Patch()
    one = Parameters.nominal(robot) if parameters is None else parameters
    rows = [apply_patch(patch, profile_parameters(one, motion.profile)).values for motion in motions]
    batch = Parameters(np.concatenate(rows))
    setpoints, torque_on = _setpoints(motions)
    options = PlantOptions(motions[0].period, plant.physics_step, plant.precision, threads, sensor_noise=False)
    simulator = make_plant(plant.backend, robot, len(motions), options, patch.forces)
    sensors, truth = [], []
    try:
        readings = simulator.reset(
            np.arange(len(motions), dtype=np.uint64), batch, state=standing_at(setpoints[0], robot, batch)
        )
        for _ in range(round(SETTLE / motions[0].period)):
            readings = simulator.step(setpoints[0], torque_on[0])
        for tick in range(len(setpoints) + 1):
            sensors.append(readings.values.copy())
            truth.append(simulator.truth().values.copy())
            if tick % 50 == 0:
                tell(tick / len(setpoints))
            if tick < len(setpoints):
                readings = simulator.step(setpoints[tick], torque_on[tick])
    finally:
        simulator.close()
    return Traces(plant, robot, np.array(sensors), np.array(truth))


def _setpoints(motions: Sequence[Motion]) -> tuple[Array, NDArray[np.bool_]]:
    """Setpoints (ticks, motions, 8) and torque switches; a motor that is off keeps its last setpoint."""
    ticks = max(len(motion.setpoints) for motion in motions)
    setpoints = np.stack([np.pad(m.setpoints, ((0, ticks - len(m.setpoints)), (0, 0)), mode="edge") for m in motions], axis=1)
    torque_on = np.isfinite(setpoints)
    for tick in range(1, ticks):
        setpoints[tick] = np.where(torque_on[tick], setpoints[tick], setpoints[tick - 1])
    setpoints[..., LEG_SLICE] = np.where(np.isnan(setpoints[..., LEG_SLICE]), np.pi / 2, setpoints[..., LEG_SLICE])
    return np.nan_to_num(setpoints), torque_on
