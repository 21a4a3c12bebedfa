"""Drives with known slip for the vision bench: the Gibbs-Appell engine drives, the renderer films, the run is written."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from studies.bench.vision_scenes import shown_robot
from wlr_gym.data.format import COMMANDS, Profile, RunMeta
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.runs import Run
from wlr_gym.data.sensors import SENSED, channels
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.scene import Facet, Look, Renderer, ScenePose, plate_facet
from wlr_gym.perception.vision.tracking import VideoFrame
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot import LEG_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: s, period of the truth's clock.
TICK = 0.002
#: Period of the run, in ticks of that clock.
ROW = 10
#: rad/s, rad/s2, rad/s: registers 80, 1 and 15 of the paper's servos; four turns of the driven wheels.
PAPER_SPEED = 1.918474
PAPER_ACCELERATION = 0.374508
PAPER_LEG_SPEED = 0.359712
#: s at rest before the motion.
_REST = 1.0
_SETTLING = 1.0  # s before the log starts: legs and tyres take the weight
#: What is logged of the sensors: joints and IMU, which come first.
_LOGGED = SENSED[: SENSED.index("cam_x")]


@dataclass(frozen=True, eq=False)
class FilmedDrive:
    """A drive and its truth.

    Attributes:
        name: of it. run: what the robot logged (50 Hz).
        time: (T,) s, servo clock, every :data:`TICK`. position: (T, 3). rotation: (T, 3, 3). legs: (T, 4).
        slip: (T, 4, 2) m, true slip displacement of every wheel, accumulated.
    """

    name: str
    run: Run
    robot: Robot
    time: Array
    position: Array
    rotation: Array
    legs: Array
    slip: Array


def paper_test(number: int, robot: Robot) -> FilmedDrive:
    """The paper's first or second test: front wheels drive four turns, rear wheels run free, legs sweep 120 degrees.

    Rear gear friction and floor are chosen so that it slips; the left rear gear is stiffer, so that it drifts sideways.
    """
    low, high = math.radians(30), math.radians(150)
    start = [low] * 4 if number == 1 else [low, low, high, high]
    end = [low, low, high, high] if number == 1 else [high, high, low, low]
    profile = Profile(wheel_acceleration=PAPER_ACCELERATION, leg_velocity=PAPER_LEG_SPEED)
    parameters = profile_parameters(Parameters.nominal(robot), profile)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.3
    parameters["servo.coulomb_friction"][:, 6:] = 0.07, 0.03
    ramp = PAPER_SPEED / PAPER_ACCELERATION
    stop = _REST + (8 * math.pi - PAPER_SPEED * ramp) / PAPER_SPEED + ramp

    def setpoints(t: float) -> tuple[list[float], list[float]]:
        moving = _REST <= t < stop
        return (end if t >= _REST else start), [PAPER_SPEED * moving] * 2 + [0.0, 0.0]

    free = np.array([True] * 6 + [False] * 2)
    return _drive(f"paper test {number}", robot, parameters, start, setpoints, stop + ramp + 0.5, free, -0.55)


def skid_turn(robot: Robot) -> FilmedDrive:
    """Forward, a turn on the spot with the wheels against each other, forward again; the legs move all the time."""
    parameters = Parameters.nominal(robot)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.4

    def setpoints(t: float) -> tuple[list[float], list[float]]:
        sweep = math.pi / 2 + 0.35 * math.sin(1.5 * max(0.0, t - _REST))
        left, right = (4.0, 4.0) if _REST <= t < 3.2 or 5.6 <= t < 7.8 else (-3.5, 3.5) if 3.2 <= t < 5.6 else (0.0, 0.0)
        return [sweep, sweep, sweep, sweep], [left, right, left, right]

    return _drive("skid turn", robot, parameters, [math.pi / 2] * 4, setpoints, 8.5, np.ones(8, bool), -0.3)


def lab_drive(robot: Robot, speed: float, spin: float, friction: float, seconds: float = 5.4) -> FilmedDrive:
    """Forward, a turn on the spot, forward again, rest, all within 5 s; the legs move.

    Args:
        robot: it. speed: m/s of the wheels' rims. spin: the turn's share of that. friction: of the floor. seconds: of the run.
    """
    parameters = Parameters.nominal(robot)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = friction
    pace = speed / float(parameters["wheel.radius"].mean())

    def setpoints(t: float) -> tuple[list[float], list[float]]:
        sweep = math.pi / 2 + 0.25 * math.sin(2.0 * min(max(0.0, t - 0.6), math.pi))
        left, right = (1.0, 1.0) if 0.6 <= t < 1.9 or 3.3 <= t < 4.4 else (-spin, spin) if 1.9 <= t < 3.3 else (0.0, 0.0)
        return [sweep] * 4, [pace * left, pace * right] * 2

    return _drive("lab drive", robot, parameters, [math.pi / 2] * 4, setpoints, seconds, np.ones(8, bool), -0.15)


def _drive(
    name: str,
    robot: Robot,
    parameters: Parameters,
    legs: list[float],
    setpoints: Callable[[float], tuple[list[float], list[float]]],
    duration: float,
    torque_on: NDArray[np.bool_],
    x: float,
) -> FilmedDrive:
    import pandas
    from scipy.spatial.transform import Rotation

    plant = make_plant("gibbs_appell", robot, 1, PlantOptions(control_period=TICK, physics_step=0.001))
    state = standing_state(robot, parameters, legs[0])  # sin is the same for all legs, so the body is level
    state.joint_position[:, LEG_SLICE] = legs
    state.reference_position[:, LEG_SLICE] = legs
    state.position[:, 0] = x
    sensors = plant.reset(np.array([7], np.uint64), parameters, state=state)
    for _ in range(int(_SETTLING / TICK)):
        leg_setpoints, wheel_setpoints = setpoints(0.0)
        sensors = plant.step(np.array([[*leg_setpoints, *wheel_setpoints]]), torque_on[None])
    count = int(duration / TICK)
    rows: list[list[float]] = []
    truths, slips = [], np.zeros((count + 1, 4, 2))
    for tick in range(count + 1):
        time = tick * TICK
        leg_setpoints, wheel_setpoints = setpoints(time - time % (ROW * TICK) if tick % ROW else time)
        goal = np.array([[*leg_setpoints, *wheel_setpoints]])
        truth = plant.truth()
        truths.append(np.concatenate([truth.position[0], truth.quaternion[0], truth.joint_position[0, LEG_SLICE]]))
        if tick > 0:
            slips[tick] = slips[tick - 1] + truth.slip_displacement[0].reshape(4, 2)
        if tick % ROW == 0:
            rows.append([time, *np.where(torque_on, goal[0], np.nan), *channels(sensors, 0)[: len(_LOGGED)]])
        sensors = plant.step(goal, torque_on[None])
    plant.close()
    found = np.array(truths)
    table = pandas.DataFrame(rows, columns=["t", *COMMANDS, *_LOGGED])
    run = Run(table, RunMeta(robot=robot.name), Path(f"{name.replace(' ', '_')}.parquet"))
    time = np.asarray(TICK * np.arange(count + 1), np.float64)
    turns = Rotation.from_quat(found[:, 3:7], scalar_first=True).as_matrix()
    return FilmedDrive(name, run, robot, time, found[:, :3], turns, found[:, 7:], slips)


def film(
    drive: FilmedDrive,
    renderer: Renderer,
    body: Target,
    look: Look,
    offset: float,
    rate: float = 30.0,
    exposure: float = 0.005,
    phase: float = 0.011,
    seed: int = 0,
    occluder: Callable[[float], list[Facet]] | None = None,
) -> Iterator[VideoFrame]:
    """Film a drive.

    Args:
        drive: what happens. renderer: camera and floor. body: markers on the robot. look: light, blur, noise.
        offset: s; servo time = the frame's time + offset. rate: Hz. exposure: s, around a frame's time. phase: s.
        occluder: facets (floor frame) that hide something at a servo time.
    """
    instants = 4
    shifts = exposure * ((np.arange(instants) + 0.5) / instants - 0.5)
    for index in range(int((drive.time[-1] - 2 * phase) * rate)):
        time = phase + index / rate
        shown = [shown_robot(drive.robot, plate_facet(body), pose_at(drive, time + shift)) for shift in shifts]
        moving = [[*robot, *(occluder(time) if occluder else [])] for robot in shown]
        yield VideoFrame(index, time - offset, renderer.frame(moving, look, seed + index))


def pose_at(drive: FilmedDrive, time: float) -> ScenePose:
    """True pose of the body at a servo time: linear between ticks."""
    from scipy.spatial.transform import Rotation, Slerp

    k = min(int(time / TICK), len(drive.time) - 2)
    part = (time - drive.time[k]) / TICK
    turn = Slerp([0, 1], Rotation.from_matrix(drive.rotation[k : k + 2]))(part).as_matrix()
    position, legs = ((1 - part) * a[k] + part * a[k + 1] for a in (drive.position, drive.legs))
    return ScenePose(position, turn, legs)


def true_slip(drive: FilmedDrive, at: Array) -> Array:
    """(K, 4, 2) m, true accumulated slip from the first of the times on."""
    flat = drive.slip.reshape(len(drive.time), 8)
    values = np.stack([np.interp(at, drive.time, column) for column in flat.T], axis=1).reshape(-1, 4, 2)
    return values - values[0]
