"""Ten motions of two seconds on which engine and MuJoCo are compared, and the distance between two final poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.model.dynamics import rotation_matrix
from wlr_gym.physics.plants.base import PlantOptions, PlantState, standing_state
from wlr_gym.robot import CORNER_SIGNS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Environment steps of a motion, and s of each.
TICKS, PERIOD = 100, PlantOptions().control_period
GRIP, ICE = 0.6, 0.15
#: s in which a setpoint moves to its next value: no jumps, so that no motor is at its voltage limit.
RAMP = 0.2


@dataclass(frozen=True)
class BenchMotion:
    """What one robot does on a level floor.

    Attributes:
        name: in words.
        friction: (4,) of the floor under each wheel.
        setpoints: (TICKS, 8) rad and rad/s.
        velocity: m/s of the body at the start, forward and to the left.
        distance: m to the end pose where a closed form says it (locked wheels, v^2/(2 mu g)), else None.
    """

    name: str
    friction: Array
    setpoints: Array
    velocity: tuple[float, float] = (0.0, 0.0)
    distance: float | None = None


def motions(robot: Robot, ticks: int = TICKS) -> list[BenchMotion]:
    """Return the ten motions, the same ones every time."""
    rng, still = np.random.default_rng(31), np.zeros(4)
    right = np.array([sign[1] < 0 for sign in CORNER_SIGNS])
    turn, arc = np.where(right, 4.0, -4.0), np.where(right, 5.0, 2.0)

    def drive(name: str, friction: Array | float, *wheels: Array, legs: bool = False) -> BenchMotion:
        speeds = np.array(wheels)
        angles = robot.home.leg_angle + rng.uniform(-0.3, 0.3, (len(wheels), 4)) * legs
        return BenchMotion(name, np.full(4, friction), _ramps(np.hstack([angles, speeds]), robot.home.leg_angle, ticks))

    def slide(name: str, friction: float, velocity: tuple[float, float]) -> BenchMotion:
        distance = float(np.square(velocity).sum()) / (2.0 * friction * robot.gravity)
        return BenchMotion(name, np.full(4, friction), drive(name, friction, still).setpoints, velocity, distance)

    def commands(count: int = 5) -> list[Array]:
        return list(rng.uniform(-4.0, 5.0, (count, 4)))

    return [
        drive("wheel commands", GRIP, *commands()),
        drive("wheel and leg commands", GRIP, *commands(), legs=True),
        drive("skid turn", GRIP, turn),
        drive("arc", GRIP, arc),
        drive("braking", GRIP, np.full(4, 5.0), still),
        drive("wheel commands on a slippery floor", ICE, *commands()),
        drive("skid turn on a slippery floor", ICE, turn),
        drive("arc, one wheel on ice", np.array([GRIP, 0.05, GRIP, GRIP]), arc),
        slide("locked wheels slide forward", 0.07, (0.5, 0.0)),
        slide("locked wheels slide sideways", 0.3, (0.0, 0.8)),
    ]


def _ramps(targets: Array, home: float, ticks: int) -> Array:
    """Return setpoints (ticks, 8) that reach each target in RAMP and hold it for an equal share of the time."""
    share = ticks * PERIOD / len(targets)
    starts = share * np.arange(len(targets))
    knots = np.stack([starts, starts + min(RAMP, 0.5 * share)], axis=1).ravel()
    before = np.vstack([np.r_[np.full(4, home), np.zeros(4)], targets[:-1]])
    values = np.stack([before, targets], axis=1).reshape(-1, 8)
    return np.stack([np.interp(PERIOD * np.arange(1, ticks + 1), knots, column) for column in values.T], axis=1)


def start(robot: Robot, chosen: list[BenchMotion]) -> tuple[Parameters, PlantState]:
    """Return parameters and start state of one robot per motion."""
    parameters = Parameters.nominal(robot, len(chosen))
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = np.array([motion.friction for motion in chosen])
    state = standing_state(robot, parameters)
    state.linear_velocity_in_body[:, :2] = [motion.velocity for motion in chosen]
    return parameters, state


def distance(first: Array, second: Array, hip: Array) -> Array:
    """Return how far apart two poses (N, 7: position, quaternion) put the robot: mean distance (N,) of its four hips, m."""
    corners = np.array([[x, y, 1.0] for x, y in CORNER_SIGNS]) * hip
    places = [pose[:, None, :3] + np.einsum("nij,kj->nki", rotation_matrix(pose[:, 3:7]), corners) for pose in (first, second)]
    return np.linalg.norm(places[0] - places[1], axis=2).mean(axis=1)


def is_upright(pose: Array) -> bool:
    """Whether every robot's pose (N, 7) is finite, within 20 degrees of level and at least 2 cm above the floor."""
    level = rotation_matrix(pose[:, 3:7])[:, 2, 2]
    return bool(np.isfinite(pose).all() and (level > np.cos(np.radians(20.0))).all() and (pose[:, 2] > 0.02).all())
