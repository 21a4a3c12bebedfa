"""The peer of the measurements: the same robot on plain MuJoCo, as a knowledgeable user would drive it.

The servo law is expressed in MuJoCo's own actuators, so a control tick is a single call without Python in it.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.physics import plants, servo
from wlr_gym.physics.plants.base import (
    SENSOR_LAYOUT,
    TRUTH_LAYOUT,
    Capabilities,
    PlantOptions,
    PlantState,
    Sensors,
    Truth,
    check_setpoints,
    standing_state,
)
from wlr_gym.physics.plants.mujoco.mjcf import CONTACT_IMPEDANCE, build_model
from wlr_gym.physics.plants.mujoco.plant import GEAR_IMPEDANCE
from wlr_gym.physics.plants.sensors import RAW_LAYOUT, SensorModel
from wlr_gym.robot import FIRST_WHEEL, JOINTS, LEGS, WHEEL_SLICE, WHEELS, Robot, standing_height
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import contact_slip_velocity

Array = NDArray[np.float64]

BACKEND = "mujoco_loop"
Contact = Literal["default", "stiff friction", "matched", "tuned"]
#: What each contact setting is.
CONTACTS: dict[Contact, str] = {
    "default": "MuJoCo's default springs and friction",
    "stiff friction": "MuJoCo's default springs, impratio 100",
    "matched": "the engine's springs, impratio 1e5",
    "tuned": "matched, with the engine's contact point, stiffer gear friction and less virtual mass",
}
VIRTUAL_MASS_DIVISOR = 1e3


def register_backend() -> None:
    """Let environments of this process be made with ``backend="mujoco_loop"``."""
    plants.BACKENDS[BACKEND] = "studies.bench.mujoco_loop:MujocoLoopPlant"


def build_servo_model(
    robot: Robot,
    parameters: Parameters,
    physics_step: float = 0.001,
    contact: Contact = "default",
    extend: Callable[[mujoco.MjSpec], None] = lambda spec: None,
) -> mujoco.MjModel:
    """Return the robot with its servos as actuators; ``ctrl[:4]`` leg angles, ``ctrl[4:]`` and ``ctrl[8:]`` wheel speeds.

    Args:
        robot, parameters: the robot; row 0 is used. Servo profiles must be off.
        physics_step: s.
        contact: of :data:`CONTACTS`.
        extend: adds what else there is.
    """
    add_servos = _add_servos(robot, parameters)

    def add(spec: mujoco.MjSpec) -> None:
        add_servos(spec)
        extend(spec)

    model = build_model(robot, parameters, physics_step=physics_step, extend=add)
    if contact in ("default", "stiff friction"):
        model.opt.impratio = 1.0 if contact == "default" else 100.0
        model.pair_solimp[:] = 0.9, 0.95, 0.001, 0.5, 2.0
        model.pair_solref[:] = 0.02, 1.0
        model.pair_solreffriction[:] = 0.0
    if contact == "tuned":
        _tune(model, robot, parameters)
    return model


def _tune(model: mujoco.MjModel, robot: Robot, parameters: Parameters) -> None:
    """Matched springs, and what else MuJoCo allows towards Coulomb friction on the engine's contact point.

    The contact point of a sphere lies halfway into the overlap: the sphere is enlarged by the overlap at rest, and a negative
    margin takes it off again. Gear friction sticks within a step. Sliding friction is damped over one step, and 1000 times the
    apparent inverse mass makes the virtual mass of the impedance, which pushes a sliding wheel off the floor, as much smaller.
    """
    wheels = [model.body(name).id for name in WHEELS]
    radius = parameters["wheel.radius"][0]
    overlap = standing_height(robot, robot.home.leg_angle) - standing_state(robot, parameters).position[0, 2]
    model.geom_size[[model.geom(name).id for name in WHEELS], 0] = radius + overlap
    model.geom_rbound[[model.geom(name).id for name in WHEELS]] = radius + overlap
    model.pair_margin[:] = -overlap
    model.dof_solref[6:] = -1.0, -GEAR_IMPEDANCE / model.opt.timestep
    model.dof_solimp[6:, :2] = GEAR_IMPEDANCE
    model.body_invweight0[wheels] *= VIRTUAL_MASS_DIVISOR
    model.pair_solref[:] *= VIRTUAL_MASS_DIVISOR
    model.opt.impratio *= VIRTUAL_MASS_DIVISOR
    model.pair_solreffriction[:] = -1.0, -CONTACT_IMPEDANCE / model.opt.timestep


def _add_servos(robot: Robot, parameters: Parameters) -> Callable[[mujoco.MjSpec], None]:
    """Voltage law of :func:`wlr_gym.physics.servo.controller_voltage`: limited torque plus back-EMF as joint damping."""
    constant, resistance = servo.motor_constants(
        parameters["servo.stall_torque"][0], parameters["servo.no_load_speed"][0], robot.servo.supply_voltage
    )
    gain = constant / resistance
    limit = gain * parameters["servo.supply_voltage"][0]
    kp, kd = gain * servo.position_gains(parameters)[0], gain * parameters["servo.kd"][0]

    def add(spec: mujoco.MjSpec) -> None:
        for index, name in enumerate(JOINTS):
            joint = spec.joint(name)
            joint.damping[0] += gain[index] * constant[index]  # the others are of higher order in speed
            joint.actfrcrange = -limit[index], limit[index]
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
            is_leg = name in LEGS
            _add_actuator(spec, name, kp[index], [0.0, -kp[index], -kd[index] if is_leg else 0.0], integrates=not is_leg)
        for index, name in enumerate(WHEELS, FIRST_WHEEL):
            _add_actuator(spec, name, kd[index], [0.0, 0.0, -kd[index]], integrates=False)

    return add


def _add_actuator(spec: mujoco.MjSpec, joint: str, gain: float, bias: list[float], *, integrates: bool) -> None:
    dynamics = mujoco.mjtDyn.mjDYN_INTEGRATOR if integrates else mujoco.mjtDyn.mjDYN_NONE
    spec.add_actuator(
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        dyntype=dynamics,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[gain] + [0.0] * 9,
        biasprm=bias + [0.0] * 7,
    )


class ServoBatch:
    """Robots on bare ``mujoco.batch``: a control tick is one call.

    Args:
        model: of :func:`build_servo_model`.
        parameters: one robot per row; their friction is used, all else is the model's.
        threads: of MuJoCo.
    """

    def __init__(self, model: mujoco.MjModel, parameters: Parameters, threads: int = 1) -> None:
        self._batch = batch = Batch(model, len(parameters), threads)
        floors = model.npair // len(WHEELS)  # each with a pair for every wheel
        batch.expand("pair_friction")[:, :, :2] = np.tile(parameters["ground.mu_x"], (1, floors))[:, :, None]
        self.position, self.velocity = batch.bind("qpos"), batch.bind("qvel")
        self._control, self._activation = batch.bind("ctrl"), batch.bind("act")

    def reset(self, state: PlantState) -> None:
        """Start at home with the bodies at the heights and velocities of ``state`` (level, joints at rest)."""
        self._batch.reset()
        self.position[:, :3], self.velocity[:, :3] = state.position, state.linear_velocity_in_body
        self._activation[:] = 0.0

    def step(self, setpoints: Array, substeps: int) -> None:
        """Advance one control tick."""
        self._control[:] = servo_controls(setpoints)
        self._batch.step(nstep=substeps)


def servo_controls(setpoints: Array) -> Array:
    """Return ``ctrl`` (..., 12) of the servo model for setpoints (..., 8)."""
    return np.concatenate([setpoints, setpoints[..., WHEEL_SLICE]], axis=-1)


class MujocoLoopPlant:
    """One robot on ``mj_step(nstep)``; see :class:`wlr_gym.physics.plants.base.Plant` for the contract.

    Enough for tasks, not a reference: sums over a tick (energy, slip displacement) are the last substep's rate times the
    control period, contact forces and friction torques are not filled in, all motors are always on, setpoints are not delayed,
    parameters change at a reset only.
    """

    capabilities: Capabilities = Capabilities(BACKEND, has_truth=True, can_set_state=True, real_time=False)

    def __init__(self, robot: Robot, count: int = 1, options: PlantOptions | None = None) -> None:
        if count != 1:
            raise InputError(f"backend '{BACKEND}' drives one robot, not {count}")
        self.robot = robot
        self.options: PlantOptions = options or PlantOptions()
        self.parameters = Parameters.nominal(robot, 1)
        self._truth = Truth(np.zeros((1, TRUTH_LAYOUT.width)))
        self._raw = np.zeros((1, RAW_LAYOUT.width))
        self._readings = Sensors(np.zeros((1, SENSOR_LAYOUT.width)))
        self._sensors = SensorModel(robot, self.options, 1)
        self._corners = 0.5 * np.array(robot.body.size)
        self._build()

    @property
    def count(self) -> int:
        """Number of robots: 1."""
        return 1

    def _build(self) -> None:
        self._model = build_servo_model(self.robot, self.parameters, self.options.physics_step)
        self._data = mujoco.MjData(self._model)
        stall_torque, speed = (self.parameters[f"servo.{name}"][0] for name in ("stall_torque", "no_load_speed"))
        constant, self._resistance = servo.motor_constants(stall_torque, speed, self.robot.servo.supply_voltage)
        self._back_emf, self._inverse_constant = constant * constant / self._resistance, 1.0 / constant

    def reset(
        self,
        seeds: NDArray[np.uint64] | None = None,
        parameters: Parameters | None = None,
        mask: NDArray[np.bool_] | None = None,
        state: PlantState | None = None,
    ) -> Sensors:
        """Start anew; see :meth:`wlr_gym.physics.plants.base.Plant.reset`. Changed parameters build a new model."""
        if parameters is not None and not np.array_equal(parameters.values, self.parameters.values):
            self.parameters = parameters.copy()
            self._build()
        data, state = self._data, state or standing_state(self.robot, self.parameters)
        mujoco.mj_resetData(self._model, data)
        data.qpos[:3], data.qpos[3:7], data.qpos[7:] = state.position[0], state.quaternion[0], state.joint_position[0, _MUJOCO]
        mujoco.mju_rotVecQuat(data.qvel[:3], state.linear_velocity_in_body[0], state.quaternion[0])
        data.qvel[3:6], data.qvel[6:] = state.angular_velocity_in_body[0], state.joint_velocity[0, _MUJOCO]
        data.act[:] = state.reference_position[0, WHEEL_SLICE]
        mujoco.mj_forward(self._model, data)
        self._look()
        self._sensors.reset(self._raw, self._readings.values, seeds, self.parameters, mask)
        return self._readings

    def step(self, setpoints: Array, torque_on: NDArray[np.bool_] | None = None) -> Sensors:
        """Advance one control tick with the servos as actuators."""
        row = check_setpoints(setpoints, 1)[0]
        self._data.ctrl[:] = servo_controls(row)
        mujoco.mj_step(self._model, self._data, nstep=self.options.substeps)
        self._look()
        self._sensors.measure(self._raw, self._readings.values)
        return self._readings

    def _look(self) -> None:
        """Fill truth and raw sensor signals from MuJoCo's state."""
        data, truth, row = self._data, self._truth, self._truth.values[0]
        pose, rates, matrix = data.qpos, data.qvel, np.empty((3, 3))
        mujoco.mju_quat2Mat(matrix.reshape(9), pose[3:7])
        angles, speeds = pose[7:][_CONTRACT], rates[6:][_CONTRACT]
        torque = data.qfrc_actuator[6:][_CONTRACT] - self._back_emf * speeds
        row[_PART["position"]], row[_PART["quaternion"]] = pose[:3], pose[3:7]
        row[_PART["linear_velocity_in_body"]] = rates[:3] @ matrix
        row[_PART["angular_velocity_in_body"]] = rates[3:6]
        row[_PART["joint_position"]], row[_PART["joint_velocity"]], row[_PART["motor_torque"]] = angles, speeds, torque
        slip = contact_slip_velocity(
            self.parameters, truth.quaternion, truth.linear_velocity_in_body, truth.angular_velocity_in_body,
            truth.joint_position, truth.joint_velocity,
        ).reshape(8)  # fmt: skip
        period, current = self.options.control_period, torque * self._inverse_constant
        shaft_power = float(torque @ speeds)
        row[_PART["slip_velocity"]], row[_PART["slip_displacement"]] = slip, period * slip
        row[_PART["mechanical_energy"]] = period * shaft_power
        row[_PART["electrical_energy"]] = period * (shaft_power + float(self._resistance @ (current * current)))
        row[_PART["body_clearance"]] = pose[2] - np.abs(matrix[2]) @ self._corners
        raw = self._raw[0]
        raw[_RAW["joint_position"]], raw[_RAW["joint_velocity"]], raw[_RAW["joint_effort"]] = angles, speeds, torque
        raw[_RAW["gyro"]] = rates[3:6]
        raw[_RAW["accelerometer"]] = (data.qacc[:3] - self._model.opt.gravity) @ matrix
        raw[_RAW["supply_voltage"]] = self.robot.servo.supply_voltage
        raw[_RAW["height"]], raw[_RAW["quaternion"]] = pose[2], pose[3:7]
        raw[_RAW["pose"]] = pose[0], pose[1], np.arctan2(matrix[1, 0], matrix[0, 0])

    def truth(self) -> Truth:
        """Return the true state after the last step or reset; overwritten by the next step."""
        return self._truth

    def close(self) -> None:
        """Nothing to release."""


#: MuJoCo orders joints along the tree: leg, wheel, leg, wheel, ...
_CONTRACT = np.array([0, 2, 4, 6, 1, 3, 5, 7])
_MUJOCO = np.argsort(_CONTRACT)
_PART = TRUTH_LAYOUT.slices
_RAW = RAW_LAYOUT.slices
