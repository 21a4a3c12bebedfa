"""Climbs of a kerb by a fixed script, in either simulator: straight on, by two poses of the legs, one wheel at a time.

No feedback but one distance; positions and speeds of the servos alone. What a policy that climbs is held against.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.physics.model.dynamics import rotation_matrix
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, settle, standing_state
from wlr_gym.physics.plants.simulator import Simulator
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, Robot
from wlr_gym.robot.parameter_table import ELEMENTS, spec_of
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Names of legs, and of several.
LEGS = {"lf": [0], "rf": [1], "lr": [2], "rr": [3], "front": [0, 1], "rear": [2, 3], "all": [0, 1, 2, 3]}
#: Where the kerb's face is, m.
KERB = 0.35
#: How far ahead of its hip a wheel stands in the first of two poses, and behind it in the second (m).
REACH = 0.11
#: How fast legs turn from the first to the second (rad/s).
LEG_SPEED = 1.5

#: One move: legs to angles (degrees), way to drive (m; None: until the rear wheels are REAR_GAP before the face), duration (s).
Move = tuple[Mapping[str, float], float | None, float]
REAR_GAP = 0.06
ONE_BY_ONE_START = (70.0, 70.0, 30.0, 30.0)
#: A wheel is lifted, driven over the edge and put down; the body leans on the other three.
ONE_BY_ONE: tuple[Move, ...] = (
    ({"lf": 20.5}, 0.0, 1.0),
    ({}, 0.055, 1.5),
    ({"rear": 45.0}, 0.0, 1.0),
    ({"lf": 40.0}, 0.0, 1.0),
    ({}, -0.02, 0.8),
    ({"rf": 20.5}, 0.0, 1.2),
    ({}, 0.05, 1.5),
    ({"rf": 40.0}, 0.0, 1.0),
    ({}, 0.08, 1.5),
    ({"front": 150.0, "rear": 70.0}, 0.17, 4.0),
    ({}, None, 2.5),
    ({"lr": 20.5}, 0.0, 1.0),
    ({}, 0.072, 1.8),
    ({"lr": 40.0}, 0.005, 1.2),
    ({}, -0.01, 0.8),
    ({"rr": 20.5}, 0.0, 1.2),
    ({}, 0.06, 1.5),
    ({"rr": 40.0}, 0.0, 1.0),
    ({}, 0.08, 1.5),
    ({"all": 90.0}, 0.10, 2.0),
)


#: Changes the parameters of robots in place.
Edit = Callable[[Parameters], None]


def nothing(parameters: Parameters) -> None:
    """Change nothing."""


class Climber:
    """A batch of robots before one kerb each.

    Attributes:
        plant: that simulates them.
        height: of the kerbs (N,), m.
        load: largest motor torque so far (8,), N m.
    """

    def __init__(
        self,
        backend: str,
        robot: Robot,
        height: ArrayLike,
        friction: ArrayLike,
        legs: ArrayLike = 90.0,
        gap: float = 0.065,
        edge_radius: float = 0.001,
        edit: Edit = nothing,
        physics_step: float = 1e-3,
    ) -> None:
        """Put robots before kerbs.

        Args:
            backend: simulator.
            robot: theirs.
            height: of the kerbs, (N,) or one, m.
            friction: between wheels and floor, (N,) or one.
            legs: their angles at the start, degrees.
            gap: between the front wheels and the face, m.
            edge_radius: of the kerbs, m.
            edit: changes the parameters of the robots.
            physics_step: of the simulator, s.
        """
        self.robot = robot
        self.height, friction = np.broadcast_arrays(np.atleast_1d(height).astype(float), friction)
        count = len(self.height)
        parameters = Parameters.nominal(robot, count)
        edit(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = np.reshape(friction, (-1, 1))
        parameters["piece.x[piece_1]"], parameters["piece.height[piece_1]"] = KERB, self.height
        parameters["piece.edge_radius[piece_1]"] = edge_radius
        angle = np.broadcast_to(np.radians(legs), 4)
        state = standing_state(robot, parameters)
        state.joint_position[:, LEG_SLICE] = state.reference_position[:, LEG_SLICE] = angle
        reach = robot.hip_position.x + robot.leg.length * float(np.cos(angle[:2]).max())
        state.position[:, 0] = KERB - gap - robot.wheel.radius - reach
        settle(robot, parameters, state)
        plant = make_plant(backend, robot, count, PlantOptions(physics_step=physics_step, sensor_noise=False))
        assert isinstance(plant, Simulator)
        self.plant = plant
        plant.reset(parameters=parameters, state=state)
        self.load = np.zeros(8)
        self._setpoints = np.concatenate([np.tile(angle, (count, 1)), np.zeros((count, 4))], axis=1)
        self._period = plant.options.control_period
        self.hold(0.4)

    def hold(self, seconds: float) -> None:
        """Keep the present setpoints."""
        for _ in range(round(seconds / self._period)):
            self._step()

    def _step(self) -> None:
        self.plant.step(self._setpoints)
        self.load = np.maximum(self.load, np.abs(self.plant.truth().motor_torque).max(axis=0))

    def wheels(self) -> Array:
        """Return the centres of the wheels (N, 4, 3), m."""
        truth, robot = self.plant.truth(), self.robot
        angle, signs = truth.joint_position[:, LEG_SLICE], np.array(CORNER_SIGNS)
        hip = np.array([robot.hip_position.x, robot.hip_position.y]) * signs
        x, z = hip[:, 0] + robot.leg.length * np.cos(angle), robot.hip_position.z - robot.leg.length * np.sin(angle)
        arm = np.stack([x, np.broadcast_to(hip[:, 1], x.shape), z], axis=2)
        return truth.position[:, None] + np.einsum("nij,nkj->nki", rotation_matrix(truth.quaternion), arm)

    def is_up(self) -> Flags:
        """Return which wheels (N, 4) stand on the kerb."""
        wheels = self.wheels()
        high = wheels[:, :, 2] > self.height[:, None] + self.robot.wheel.radius - 0.006
        return high & (wheels[:, :, 0] > KERB - 0.002)

    def move(self, legs: Mapping[str, float], way: ArrayLike, seconds: float) -> None:
        """Turn legs to angles (degrees) and drive a way (m), smoothly; wheels roll along with the swing of their legs."""
        start = self._setpoints[:, LEG_SLICE].copy()
        end = start.copy()
        for name, angle in legs.items():
            end[:, LEGS[name]] = np.radians(angle)
        ticks = round(seconds / self._period)
        share = np.linspace(0.0, 1.0, ticks + 1)
        share = share * share * (3.0 - 2.0 * share)
        for now, rise in zip(share[1:], np.diff(share) / self._period, strict=True):
            angle, rate = start + (end - start) * now, (end - start) * rise
            speed = np.reshape(way, (-1, 1)) * rise
            self._setpoints[:, LEG_SLICE] = angle
            forward = speed - self.robot.leg.length * np.sin(angle) * rate
            self._setpoints[:, 4:] = forward / self.robot.wheel.radius - rate
            self._step()
        self._setpoints[:, 4:] = 0.0

    def drive_over(self, speed: float, seconds: float, then: float) -> Flags:
        """Drive at a wheel speed (rad/s); once both front wheels are up, turn all legs to an angle (degrees).

        Returns:
            Who (N,) stood on top, with the rear wheels 30 mm over the edge.
        """
        over = np.zeros(len(self.height), bool)
        front_is_up = over.copy()
        angle, most = self._setpoints[:, LEG_SLICE], LEG_SPEED * self._period
        self._setpoints[:, 4:] = speed
        for _ in range(round(seconds / self._period)):
            front_is_up |= self.is_up()[:, :2].all(axis=1)
            angle[front_is_up] += np.clip(np.radians(then) - angle[front_is_up], -most, most)
            self._step()
            over |= self.is_up().all(axis=1) & (self.wheels()[:, 2:, 0].min(axis=1) > KERB + 0.03)
        return over


def climb_straight(
    backend: str,
    robot: Robot,
    height: ArrayLike,
    friction: ArrayLike,
    edge_radius: float = 0.001,
    edit: Edit = nothing,
    physics_step: float = 1e-3,
) -> Flags:
    """Return which kerbs (N,) robots climb at 0.05 m/s with straight, still legs."""
    climber = Climber(backend, robot, height, friction, 90.0, 0.004, edge_radius, edit, physics_step)
    return climber.drive_over(0.05 / robot.wheel.radius, 11.0, then=90.0)


def climb_by_two_poses(
    backend: str,
    robot: Robot,
    height: ArrayLike,
    friction: ArrayLike,
    edit: Edit = nothing,
    seconds: float = 12.0,
    reach: float = REACH,
) -> Flags:
    """Return which kerbs (N,) robots climb at 0.1 m/s with their wheels ``reach`` (m) ahead of the hips, then behind them."""
    ahead = float(np.degrees(np.arccos(reach / robot.leg.length)))
    climber = Climber(backend, robot, height, friction, legs=ahead, gap=0.03, edit=edit)
    return climber.drive_over(0.1 / robot.wheel.radius, seconds, then=180.0 - ahead)


def climb_one_by_one(
    backend: str, robot: Robot, height: ArrayLike, friction: ArrayLike, edit: Edit = nothing
) -> tuple[Flags, Array]:
    """Return which kerbs (N,) robots climb with one wheel at a time, in 29 s, and the largest motor torques (8,), N m."""
    climber = Climber(backend, robot, height, friction, legs=ONE_BY_ONE_START, edit=edit)
    for legs, way, seconds in ONE_BY_ONE:
        rear_gap = KERB - climber.wheels()[:, 2:, 0].max(axis=1) - robot.wheel.radius
        climber.move(legs, rear_gap - REAR_GAP if way is None else way, seconds)
    climber.hold(0.3)
    return np.all(climber.is_up(), axis=1), climber.load


def perturb(robot: Robot, seed: int) -> Edit:
    """Return what draws copies of a robot within its tolerances, cut at two sigma."""

    def edit(parameters: Parameters) -> None:
        rng = np.random.default_rng(seed)
        for element in ELEMENTS:
            spec = spec_of(element)
            stated = robot.tolerances.get(spec.tolerance)
            if stated is None:
                continue
            sigma = stated.sigma(element, 1.0) * (np.abs(parameters[element]) if stated.unit is None else 1.0)
            draw = np.clip(rng.standard_normal(len(parameters)), -2.0, 2.0)
            parameters[element] = np.clip(parameters[element] + sigma * draw, spec.low, spec.high)

    return edit
