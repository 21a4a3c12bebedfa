"""The peer of the measurements: the same robot on plain MuJoCo, as a knowledgeable user would drive it.

The servo law is expressed in MuJoCo's own actuators, so a control tick is a single call without Python in it.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
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
from wlr_gym.physics.plants.mujoco.mjcf import build_model
from wlr_gym.physics.plants.sensors import RAW_LAYOUT, SensorModel
from wlr_gym.robot import FIRST_WHEEL, JOINTS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import contact_slip_velocity

Array = NDArray[np.float64]

BACKEND = "mujoco_loop"


def register_backend() -> None:
    """Let environments of this process be made with ``backend="mujoco_loop"``."""
    plants.BACKENDS[BACKEND] = "wlr_gym.studies.bench.mujoco_loop:MujocoLoopPlant"


def build_servo_model(
    robot: Robot, parameters: Parameters, physics_step: float = 0.001, *, soft: bool = False
) -> mujoco.MjModel:
    """Return the robot with its servos as actuators; ``ctrl[:4]`` leg angles, ``ctrl[4:]`` and ``ctrl[8:]`` wheel speeds.

    Args:
        robot, parameters: the robot; row 0 is used. Servo profiles must be off.
        physics_step: s.
        soft: MuJoCo's default contact impedance and impratio instead of those that match the contact spring and stop
            creep. Less exact, and how most users leave it.
    """
    model = build_model(robot, parameters, physics_step=physics_step, extend=_add_servos(robot, parameters))
    if soft:
        model.opt.impratio = 1.0
        model.pair_solimp[:] = 0.9, 0.95, 0.001, 0.5, 2.0
        model.pair_solref[:] = 0.02, 1.0
        model.pair_solreffriction[:] = 0.0
    return model


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


class MujocoLoopPlant:
    """One robot on ``mj_step(nstep)``; see :class:`wlr_gym.physics.plants.base.Plant` for the contract.

    Enough for tasks, not a reference: sums over a tick (energy, slip displacement) are the last substep's rate times the
    control period, contact forces and friction torques are not filled in, all motors are always on, setpoints are not delayed.
    """

    capabilities: Capabilities = Capabilities(BACKEND, has_truth=True, can_set_state=True, real_time=False)
    soft = True

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
        self._model = build_servo_model(self.robot, self.parameters, self.options.physics_step, soft=self.soft)
        self._data = mujoco.MjData(self._model)
        constant, resistance = servo.motor_constants(
            self.parameters["servo.stall_torque"][0], self.parameters["servo.no_load_speed"][0], self.robot.servo.supply_voltage
        )
        self._back_emf = constant * constant / resistance
        self._inverse_constant = 1.0 / constant
        self._resistance = resistance

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
        mujoco.mj_resetData(self._model, self._data)
        self._put(standing_state(self.robot, self.parameters) if state is None else state)
        mujoco.mj_forward(self._model, self._data)
        self._look()
        self._sensors.reset(self._raw, self._readings.values, seeds, self.parameters, mask)
        return self._readings

    def set_parameters(self, parameters: Parameters, mask: NDArray[np.bool_] | None = None) -> None:
        """Change parameters in mid-run; the state stays."""
        state = self.mechanical_state()
        self.parameters = parameters.copy()
        self._build()
        self._put(state)

    def _put(self, state: PlantState) -> None:
        data = self._data
        data.qpos[:3], data.qpos[3:7], data.qpos[7:] = state.position[0], state.quaternion[0], state.joint_position[0, _MUJOCO]
        mujoco.mju_rotVecQuat(data.qvel[:3], state.linear_velocity_in_body[0], state.quaternion[0])
        data.qvel[3:6], data.qvel[6:] = state.angular_velocity_in_body[0], state.joint_velocity[0, _MUJOCO]
        data.act[:] = state.reference_position[0, WHEEL_SLICE]

    def mechanical_state(self) -> PlantState:
        """Return a copy of the mechanical and servo state."""
        truth = self._truth
        reference, speed = truth.joint_position.copy(), np.zeros((1, 8))
        reference[0, LEG_SLICE], reference[0, WHEEL_SLICE] = self._data.ctrl[LEG_SLICE], self._data.act
        speed[0, WHEEL_SLICE] = self._data.ctrl[WHEEL_SLICE]
        return PlantState(
            truth.position.copy(), truth.quaternion.copy(), truth.linear_velocity_in_body.copy(),
            truth.angular_velocity_in_body.copy(), truth.joint_position.copy(), truth.joint_velocity.copy(), reference, speed,
        )  # fmt: skip

    def step(self, setpoints: Array, torque_on: NDArray[np.bool_] | None = None) -> Sensors:
        """Advance one control tick with the servos as actuators."""
        row = check_setpoints(setpoints, 1)[0]
        self._data.ctrl[:8] = row
        self._data.ctrl[8:] = row[WHEEL_SLICE]
        mujoco.mj_step(self._model, self._data, nstep=self.options.substeps)
        self._look()
        self._sensors.measure(self._raw, self._readings.values)
        return self._readings

    def _look(self) -> None:
        """Fill truth and raw sensor signals from MuJoCo's state."""
        data, truth, row = self._data, self._truth, self._truth.values[0]
        pose, rates = data.qpos, data.qvel
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, pose[3:7])
        matrix = rotation.reshape(3, 3)
        angles, speeds = pose[7:][_CONTRACT], rates[6:][_CONTRACT]
        torque = data.qfrc_actuator[6:][_CONTRACT] - self._back_emf * speeds
        row[_PART["position"]] = pose[:3]
        row[_PART["quaternion"]] = pose[3:7]
        row[_PART["linear_velocity_in_body"]] = rates[:3] @ matrix
        row[_PART["angular_velocity_in_body"]] = rates[3:6]
        row[_PART["joint_position"]] = angles
        row[_PART["joint_velocity"]] = speeds
        row[_PART["motor_torque"]] = torque
        slip = contact_slip_velocity(
            self.parameters, truth.quaternion, truth.linear_velocity_in_body, truth.angular_velocity_in_body,
            truth.joint_position, truth.joint_velocity,
        ).reshape(8)  # fmt: skip
        period, current = self.options.control_period, torque * self._inverse_constant
        shaft_power = float(torque @ speeds)
        row[_PART["slip_velocity"]] = slip
        row[_PART["slip_displacement"]] = period * slip
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
