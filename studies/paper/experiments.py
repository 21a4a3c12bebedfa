"""The paper's two tests, and how to drive them: on a simulator, on a robot.

Commands as the servos take them: 80 velocity counts for the front wheels at 1 acceleration count, 15 velocity counts for the
legs; the rear wheels have no torque. Time 0 is when the commands are written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from studies.paper import printed, reduced
from studies.paper.quantities import PaperConstants, State
from wlr_gym.base.errors import check_name
from wlr_gym.data.excitations import Motion
from wlr_gym.data.format import Profile
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.run_states import euler_angles, standing_at
from wlr_gym.hardware.dynamixel.tables import load_table
from wlr_gym.physics.plants import SIMULATORS, make_plant
from wlr_gym.physics.plants.base import Plant, PlantOptions, Sensors
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import no_slip_error

Array = NDArray[np.float64]

TURNS = 4
#: rad/s, rad/s2, rad/s: 80, 1 and 15 register counts, the paper's commands: 18.32 rpm, 214.577 rev/min2, 3.435 rpm.
WHEEL_SPEED = load_table("XL430-W250-T").per_count("profile_velocity") * 80
WHEEL_ACCELERATION = load_table("XL430-W250-T").per_count("profile_acceleration")
LEG_SPEED = load_table("XM540-W150-R").per_count("profile_velocity") * 15
PROFILE = Profile(wheel_acceleration=WHEEL_ACCELERATION, leg_velocity=LEG_SPEED, leg_acceleration=0.0)
#: s: when the wheels must be told to stop to end after four turns (up and down ramps are alike), and when they stand.
STOP_TIME = 2 * math.pi * TURNS / WHEEL_SPEED
DURATION = STOP_TIME + WHEEL_SPEED / WHEEL_ACCELERATION
#: s per tick; s of rest before the commands, in which the robot settles on its gears, and after the wheels stopped.
PERIOD = 0.02
SETTLE = 1.0
AFTER = 1.0


@dataclass(frozen=True)
class PaperTest:
    """One test of the paper.

    Attributes:
        name, title: for files and headings.
        start, end: angles of front and rear legs, rad.
        figures: numbers of the paper's figures: rotation, speed, torque, body, path.
        error, lateral: what the paper reports: relative error of ignoring slip, lateral displacement in m.
        rear_driven: not as in the paper: the rear wheels are driven like the front ones.
    """

    name: str
    title: str
    start: tuple[float, float]
    end: tuple[float, float]
    figures: tuple[int, ...] = ()
    error: float = 0.0
    lateral: float = 0.0
    rear_driven: bool = False

    def motion(self) -> Motion:
        """Return the setpoints as they are written, NaN = no torque; the servos' profiles make the ramps."""
        times = PERIOD * np.arange(round((SETTLE + DURATION + AFTER) / PERIOD)) - SETTLE
        commanded = (times > -0.5 * PERIOD)[:, None]
        setpoints = np.full((len(times), 8), np.nan)
        setpoints[:, LEG_SLICE] = np.where(commanded, np.repeat(self.end, 2), np.repeat(self.start, 2))
        driven = slice(4, 8) if self.rear_driven else slice(4, 6)
        setpoints[:, driven] = np.where(commanded[:, 0] & (times < STOP_TIME - 0.5 * PERIOD), WHEEL_SPEED, 0.0)[:, None]
        return Motion(self.name, setpoints, PERIOD, PROFILE)


#: Leg angles.
_LOW, _HIGH = math.radians(30), math.radians(150)
TESTS: Mapping[str, PaperTest] = {
    "test_1": PaperTest("test_1", "first test: rear legs turn", (_LOW, _LOW), (_LOW, _HIGH), (7, 8, 9, 10, 11), 0.115, 0.011),
    "test_2": PaperTest(
        "test_2", "second test: all legs turn", (_LOW, _HIGH), (_HIGH, _LOW), (13, 14, 15, 16, 17), 0.05, 0.052
    ),
}


@dataclass(frozen=True, eq=False)
class Record:
    """What N robots did: one row per recorded tick, time 0 = the commands. SI; NaN where a robot does not know.

    Attributes:
        model: which. test: which. time: (T,).
        joint_position, joint_velocity: (T, N, 8), wheels relative to their leg, zero at time 0.
        torque: (T, N, 8) motor torque at the output shaft before gear friction; of a robot its effort reading.
        position: (T, N, 3) body origin: x and y from where it was at time 0, height above the floor.
        attitude: (T, N, 3) yaw, pitch (nose down +), roll. velocity: (T, N, 3) of the origin in the yaw frame.
        yaw_rate: (T, N). slip: (T, N, 4, 2) slip velocity along and across; slip_path: its integral.
        force: (T, N, 4, 3) of the floor on each wheel: along, across, normal.
    """

    model: str
    test: PaperTest
    time: Array
    joint_position: Array
    joint_velocity: Array
    torque: Array
    position: Array
    attitude: Array
    velocity: Array
    yaw_rate: Array
    slip: Array
    slip_path: Array
    force: Array

    @property
    def end(self) -> Array:
        """Last x, y (N, 2), m."""
        return self.position[-1, :, :2]


def no_slip_travel(robot: Robot, record: Record, encoder_on_leg: bool) -> Array:
    """Return how far the front wheels would have moved the body without slip, (T, N), m, from encoders and legs: (3).

    Args:
        robot: whose lengths.
        record: the motion.
        encoder_on_leg: True: the wheel angle is relative to the leg, as the servo reads it. False: as (3) is printed, which
            takes it for the absolute one.
    """
    c = reduced.constants_of(Parameters.nominal(robot))
    joints = record.joint_position
    front, rear = joints[:, :, :2].mean(axis=2), joints[:, :, 2:4].mean(axis=2)
    p = reduced.posture(c, front, rear)
    reach = c.l_x / 2 * np.cos(p.pitch) + c.l * np.cos(p.f)
    turned = joints[:, :, 4:6].mean(axis=2) + (p.f if encoder_on_leg else 0.0)
    start = int(np.argmin(np.abs(record.time)))
    return c.a * (turned - turned[start]) - (reach - reach[start])


def error_of_ignoring_slip(robot: Robot, record: Record) -> Array:
    """Return the paper's measure (N,): 1 - travel/no-slip travel at the end; positive = falls short."""
    return no_slip_error(record.end[:, 0], no_slip_travel(robot, record, True)[-1])


# ---- driving ---------------------------------------------------------------------------------------------------------


def drive(
    model: str,
    test: PaperTest,
    robot: Robot,
    parameters: Parameters | None = None,
    physics_step: float = 0.001,
    every: int = 1,
    threads: int = 1,
    precision: str = "float64",
) -> Record:
    """Drive one test, N robots at once.

    Args:
        model: a simulator.
        test: of :data:`TESTS`. robot: the robot.
        parameters: (N); None = one nominal robot. The test's servo profile is written into them.
        physics_step: s.
        every: record every so many control ticks.
        threads, precision: of the simulator.

    Raises:
        InputError: unknown model.
    """
    parameters = profile_parameters(Parameters.nominal(robot) if parameters is None else parameters, PROFILE)
    check_name("backend", model, SIMULATORS)
    options = PlantOptions(PERIOD, physics_step, precision, threads, sensor_noise=False)
    with closing(make_plant(model, robot, len(parameters), options)) as plant:
        return drive_plant(plant, test, parameters, every)


def drive_plant(plant: Plant, test: PaperTest, parameters: Parameters, every: int = 1) -> Record:
    """Drive one test on a plant that is there, from the test's posture (a robot moves its legs there in its reset).

    A robot shows what it can measure: effort for torque, the camera for the pose; its slip and floor forces are NaN.
    """
    setpoints = test.motion().setpoints
    torque_on = np.isfinite(setpoints)
    count = plant.count
    state = standing_at(np.tile(setpoints[0], (count, 1)), plant.robot, parameters)
    seeds = np.arange(count, dtype=np.uint64)
    readings = plant.reset(seeds=seeds, parameters=parameters if plant.capabilities.can_set_state else None, state=state)
    look = _look_at_truth if plant.capabilities.has_truth else _look_at_sensors
    slip_path = np.zeros((count, 8))
    rows, seen = [look(plant, readings, slip_path)], readings.camera_is_new > 0.0
    for tick, (goal, on) in enumerate(zip(setpoints, torque_on, strict=True)):
        asked = np.where(on, goal, np.where(np.arange(8) < 4, np.pi / 2, 0.0))
        readings = plant.step(np.tile(asked, (count, 1)), np.tile(on, (count, 1)))
        seen = seen | (readings.camera_is_new > 0.0)
        if plant.capabilities.has_truth:
            slip_path = slip_path + plant.truth().slip_displacement
        if (tick + 1) % every == 0:
            rows.append(look(plant, readings, slip_path))
    record = _record(plant.capabilities.name, test, rows, every)
    if not plant.capabilities.has_truth:  # a robot without a camera does not know where it is
        record.position[:, ~seen], record.attitude[:, ~seen] = np.nan, np.nan
    return record


Row = dict[str, Array]


def _look_at_truth(plant: Plant, readings: Sensors, slip_path: Array) -> Row:
    truth = plant.truth()
    yaw, pitch, roll = euler_angles(truth.quaternion)
    v, w = truth.linear_velocity_in_body, truth.angular_velocity_in_body
    return {
        "joint_position": truth.joint_position + np.pad(plant.parameters["joint.zero_offset"], ((0, 0), (0, 4))),
        "joint_velocity": truth.joint_velocity.copy(),
        "torque": truth.motor_torque.copy(),
        "position": truth.position.copy(),
        "attitude": np.stack([yaw, pitch, roll], axis=1),
        "velocity": np.einsum("nij,nj->ni", rotation(np.zeros_like(yaw), pitch, roll), v),
        "yaw_rate": (np.sin(roll) * w[:, 1] + np.cos(roll) * w[:, 2]) / np.cos(pitch),
        "slip": truth.slip_velocity.reshape(-1, 4, 2).copy(),
        "slip_path": slip_path.reshape(-1, 4, 2),
        "force": truth.contact_force.reshape(-1, 4, 3).copy(),
    }


def _look_at_sensors(plant: Plant, readings: Sensors, slip_path: Array) -> Row:
    x, y, yaw = readings.camera_pose.T
    unknown = np.full((plant.count, 4, 3), np.nan)
    return {
        "joint_position": readings.joint_position.copy(),
        "joint_velocity": readings.joint_velocity.copy(),
        "torque": readings.joint_effort.copy(),
        "position": np.stack([x, y, unknown[:, 0, 0]], axis=1),
        "attitude": np.stack([yaw, *unknown[:, 0, :2].T], axis=1),
        "velocity": unknown[:, 0],
        "yaw_rate": readings.gyro[:, 2].copy(),
        "slip": unknown[:, :, :2],
        "slip_path": unknown[:, :, :2],
        "force": unknown,
    }


def _record(model: str, test: PaperTest, rows: list[Row], every: int) -> Record:
    found = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    time = np.asarray(PERIOD * every * np.arange(len(rows)) - SETTLE, dtype=np.float64)
    start = int(np.argmin(np.abs(time)))
    found["joint_position"][:, :, WHEEL_SLICE] -= found["joint_position"][start, :, WHEEL_SLICE]
    found["position"][:, :, :2] -= found["position"][start, :, :2]
    found["slip_path"] = found["slip_path"] - found["slip_path"][start]
    found["attitude"][:, :, 0] = np.unwrap(found["attitude"][:, :, 0], axis=0)
    return Record(model, test, time, **found)


def drive_both(model: str, robot: Robot, parameters: Parameters | None = None) -> dict[str, Record]:
    """Drive both tests on one model; see :func:`drive`."""
    return {name: drive(model, test, robot, parameters) for name, test in TESTS.items()}


def select(record: Record, robots: NDArray[np.intp]) -> Record:
    """Return a record of some of its robots only."""
    arrays = {
        name: value[:, robots] for name, value in vars(record).items() if isinstance(value, np.ndarray) and value.ndim > 1
    }
    return replace(record, **arrays)


# ---- inverse dynamics driven by measured motion and slip -------------------------------------------------------------
#
# Body motion comes from vision and IMU, joints from the encoders, slip from vision: here from a record of a plant. Nothing is
# integrated. The printed equations answer with the inconsistency of the data; the right ones with torques and forces.


#: Ticks to each side that rates are averaged over before they are differentiated: +-60 ms.
_SMOOTH = 3


@dataclass(frozen=True, eq=False)
class FromMeasurement:
    """Torques from one robot's record, both ways. Rows as in the record.

    Attributes:
        right: the corrected inverse dynamics. leg_torque_printed: (T, 2) (19) and (20), both motors of an axle.
        wheel_torque_printed: (T, 4) (21)-(24), lf, rf, lr, rr.
    """

    right: reduced.InverseDynamics
    leg_torque_printed: Array
    wheel_torque_printed: Array


def inverse_from_record(robot: Robot, record: Record, rear_drag: float | None = None) -> FromMeasurement:
    """Return what the measured motion of a record's first robot says about its torques.

    Args:
        robot: whose masses and lengths.
        record: with pose, velocity and slip (a simulator's, or of vision).
        rear_drag: N m, dry friction in the gear of a rear wheel; None = the robot's nominal one.
    """
    drag = robot.servo.wheel.coulomb_friction if rear_drag is None else rear_drag
    c = reduced.constants_of(Parameters.nominal(robot))
    joints, rates = record.joint_position[:, 0], record.joint_velocity[:, 0]
    pitch = record.attitude[:, 0, 1]
    v = record.velocity[:, 0]
    period = float(record.time[1] - record.time[0])
    u = np.column_stack([v[:, 0], v[:, 1], record.yaw_rate[:, 0], v[:, 2], np.gradient(pitch, period),
                         rates[:, :2].mean(axis=1), rates[:, 2:4].mean(axis=1), rates[:, 4:]])  # fmt: skip
    u = _smoothed(u)
    u_dot = np.gradient(u, period, axis=0)
    slip_dot = np.gradient(_smoothed(record.slip[:, 0].reshape(-1, 8)), period, axis=0).reshape(-1, 4, 2)
    front, rear = joints[:, :2].mean(axis=1), joints[:, 2:4].mean(axis=1)
    right = reduced.inverse_dynamics(c, front, rear, pitch, u, u_dot, -drag * np.tanh(u[:, 9:] / 0.01))
    x_s_d = {wheel: record.slip[:, 0, k, 0] for wheel, k in reduced.ORDER.items()}
    x_s_dd = {wheel: slip_dot[:, k, 0] for wheel, k in reduced.ORDER.items()}
    found = printed.forces_as_used(c, reduced.state_of(front, rear, pitch, u, u_dot, x_s_d=x_s_d, x_s_dd=x_s_dd))
    wheels = found["tau_theta"]
    return FromMeasurement(
        right,
        np.column_stack([found["tau_alpha"], found["tau_beta"]]),
        np.column_stack([wheels[wheel] for wheel in reduced.ORDER]),
    )


def _smoothed(values: Array) -> Array:
    """Moving average over the neighbouring ticks; ends repeated."""
    padded = np.pad(values, ((_SMOOTH, _SMOOTH), (0, 0)), mode="edge")
    return np.stack([padded[k : k + len(values)] for k in range(2 * _SMOOTH + 1)]).mean(axis=0)


# ---- both tests without slip -----------------------------------------------------------------------------------------
#
# Both tests as they are commanded: what a simulation "with a consistent slip coefficient" of 0 shows. Front wheels follow their
# trapezoid to four turns, legs turn at constant speed between short ramps, rear wheels roll along. Nothing is simulated: motion
# is given, torques and floor forces follow by inverse dynamics, from the paper's equations as printed or from the right ones.


#: s; the legs' speed is reached, and left, in this time: a rectangular profile on a real leg.
LEG_RAMP = 0.1
_TICK = 0.002


@dataclass(frozen=True, eq=False)
class IdealMotion:
    """One test without slip, one row per time. SI.

    Attributes:
        test, constants, time: which, of which robot, (T,) from the commands on.
        front, rear: (T,) leg angles. wheels: (T, 4) wheel angles relative to their legs, lf, rf, lr, rr.
        posture: pitch and height. x: (T,) travel of G. u, u_dot: (T, 11) as in :mod:`studies.paper.reduced`.
    """

    test: PaperTest
    constants: PaperConstants
    time: Array
    front: Array
    rear: Array
    wheels: Array
    posture: reduced.Posture
    x: Array
    u: Array
    u_dot: Array

    def inverse_dynamics(self, rear_drag: float = 0.0) -> reduced.InverseDynamics:
        """Return the torques and floor forces, with the right equations.

        Args:
            rear_drag: N m, dry friction in the gear of each free rear wheel.
        """
        spin = self.u[:, 9:]
        drag = -rear_drag * np.tanh(spin / 1e-3)
        return reduced.inverse_dynamics(self.constants, self.front, self.rear, self.posture.pitch, self.u, self.u_dot, drag)

    def state(self) -> State:
        """Return the motion in the paper's symbols: its slip is 0."""
        return reduced.state_of(self.front, self.rear, self.posture.pitch, self.u, self.u_dot)


def ideal_motion(test: PaperTest, constants: PaperConstants | None = None) -> IdealMotion:
    """Return one test without slip, of a robot with these constants; None = the paper's."""
    c = constants or PaperConstants()
    time = np.arange(-0.2, DURATION + 0.5, _TICK)
    front, front_rate = _leg(time, test.start[0], test.end[0])
    rear, rear_rate = _leg(time, test.start[1], test.end[1])
    turned, spin = _trapezoid(time, WHEEL_SPEED, WHEEL_SPEED / WHEEL_ACCELERATION, STOP_TIME)
    p = reduced.posture(c, front, rear)
    u9 = np.zeros((len(time), 9))
    u9[:, 3], u9[:, 4], u9[:, 5:7] = front_rate, rear_rate, spin[:, None]
    b, _ = reduced.reduction(c, p, u9)
    j_x = reduced.contact_rows(c, p, np.full((len(time), 4), c.a))[0] @ b
    u9[:, 0] = -np.einsum("tk,tk->t", j_x[:, 0], u9)
    u9[:, 7:] = np.einsum("twk,tk->tw", j_x[:, 2:], u9) / c.a
    u = np.einsum("tij,tj->ti", b, u9)
    wheels = np.stack([turned, turned, *(_integral(u9[:, k]) for k in (7, 8))], axis=1)
    x = _integral(u[:, 0])
    start = int(np.argmin(np.abs(time)))
    u_dot = np.gradient(u, _TICK, axis=0)
    return IdealMotion(test, c, time, front, rear, wheels - wheels[start], p, x - x[start], u, u_dot)


def _trapezoid(time: Array, speed: float, ramp: float, stop: float) -> tuple[Array, Array]:
    """Way and rate of a profile from 0 s on: up to a speed within ``ramp`` s, from ``stop`` s on down again."""
    acceleration = speed / ramp
    up, down = np.clip(time, 0.0, ramp), np.clip(time - stop, 0.0, ramp)
    steady = np.clip(time - ramp, 0.0, stop - ramp)
    way = acceleration * up**2 / 2 + speed * (steady + down) - acceleration * down**2 / 2
    return way, acceleration * (up - down)


def _leg(time: Array, start: float, end: float) -> tuple[Array, Array]:
    """Angle and rate of a leg: constant speed between two ramps, as long as a rectangular profile plus one ramp."""
    if start == end:
        return np.full_like(time, start), np.zeros_like(time)
    angle, rate = _trapezoid(time, LEG_SPEED, LEG_RAMP, abs(end - start) / LEG_SPEED)
    way = np.sign(end - start)
    return start + way * angle, way * rate


def _integral(rate: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(0.5 * _TICK * (rate[1:] + rate[:-1]))])
