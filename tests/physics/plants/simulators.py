"""What the tests of all plants share: every plant as one entry, and ways to drive it."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wlr_gym.base.random import spawn_seeds
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Plant, PlantOptions, RobotOptions, Sensors
from wlr_gym.physics.plants.sensors import SensorModel
from wlr_gym.robot import Robot, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
QUIET = PlantOptions(sensor_noise=False)
COUNT = 9


@dataclass(frozen=True)
class Entry:
    """A plant under test: how to make it, and what it can do (mirrors its ``capabilities``).

    Attributes:
        make: count, options -> plant.
        has_truth, can_set_state: simulators; a real robot or its emulator has neither, and skips the tests that need them.
        most: robots it can hold; None = any number.
    """

    make: Callable[[int, PlantOptions], Plant]
    has_truth: bool = True
    can_set_state: bool = True
    most: int | None = None


def _backend(name: str) -> Entry:
    return Entry(lambda count, options: make_plant(name, ROBOT, count, options))


def _emulated_robot() -> Entry:
    """The real robot's plant on the emulated robot, in emulated time."""
    hardware = RobotOptions(emulated=True)
    return Entry(lambda count, options: make_plant("dynamixel", ROBOT, count, options, hardware=hardware), False, False, most=1)


#: Every plant the conformance suite runs on. A new plant joins by one entry.
PLANTS = {name: _backend(name) for name in ("gibbs_appell", "mujoco")}
if importlib.util.find_spec("dynamixel_sdk") and importlib.util.find_spec("serial"):
    PLANTS["dynamixel"] = _emulated_robot()
SIMULATORS = [name for name, entry in PLANTS.items() if entry.has_truth and entry.can_set_state]


def parameters_for(count: int = COUNT, edit: Callable[[Parameters], None] | None = None) -> Parameters:
    """Robots that differ in friction."""
    parameters = Parameters.nominal(ROBOT, count)
    parameters["ground.mu_x"] = np.linspace(0.2, 0.9, count)[:, None]
    parameters["ground.mu_y"] = np.linspace(0.8, 0.3, count)[:, None]
    if edit is not None:
        edit(parameters)
    return parameters


def make(
    name: str, count: int = COUNT, edit: Callable[[Parameters], None] | None = None, options: PlantOptions = QUIET
) -> Plant:
    """Return the named plant with :func:`parameters_for`, reset with seeds 0, 1, ..."""
    plant = PLANTS[name].make(count, options)
    plant.reset(seeds=np.arange(count, dtype=np.uint64), parameters=parameters_for(count, edit))
    return plant


def setpoints_for(tick: int, count: int = COUNT) -> np.ndarray:
    """Random setpoints that depend on the tick alone, so that a run can be taken up anywhere."""
    rng = np.random.default_rng(100 + tick)
    return np.hstack([rng.uniform(1.1, 2.0, (count, 4)), rng.uniform(-5, 5, (count, 4))])


def run(plant: Plant, first: int, last: int) -> np.ndarray:
    """Step through :func:`setpoints_for`; return a copy of the last truth matrix."""
    for tick in range(first, last):
        plant.step(setpoints_for(tick, plant.count))
    return plant.truth().values.copy()


def hold(plant: Plant, setpoints: np.ndarray, ticks: int, torque_on: np.ndarray | None = None) -> Sensors:
    """Step with the same setpoints; return the last readings."""
    for _ in range(ticks - 1):
        plant.step(setpoints, torque_on)
    return plant.step(setpoints, torque_on)


def home(count: int) -> np.ndarray:
    """Setpoints that keep the robot standing with its legs straight down."""
    return np.tile(np.concatenate([np.full(4, np.pi / 2), np.zeros(4)]), (count, 1))


def random_parameters(count: int, seed: int = 3) -> Parameters:
    """Robots that differ from each other; row i depends on i alone. Some have effects, some have none."""
    parameters = Parameters.nominal(ROBOT, count)
    for row in range(count):
        rng = np.random.default_rng([seed, row])
        parameters["ground.mu_x"][row] = rng.uniform(0.2, 0.9, 4)
        parameters["ground.mu_y"][row] = rng.uniform(0.2, 0.9, 4)
        parameters["body.com_offset"][row] = rng.uniform(-0.01, 0.01, 3)
        parameters["wheel.radius"][row] *= rng.uniform(0.98, 1.02, 4)
        parameters["command.delay"][row] = rng.uniform(0.0, 0.03)
        parameters["payload.mass"][row] = rng.uniform(0.0, 0.5)
        if row % 3 == 1:
            parameters["ground.rolling_resistance"][row] = rng.uniform(0.0, 0.03)
        if row % 3 == 2:
            parameters["servo.viscous_friction"][row] = rng.uniform(0.0, 0.02)
    return parameters


def random_setpoints(count: int, ticks: int, seed: int = 4) -> np.ndarray:
    """Setpoints (ticks, count, 8); column i depends on i alone."""
    rows = [np.random.default_rng([seed, row]) for row in range(count)]
    low, high = np.repeat([1.2, -5.0], 4), np.repeat([1.9, 5.0], 4)
    return np.stack([rng.uniform(low, high, (ticks, 8)) for rng in rows], axis=1)


def rollout(
    name: str, parameters: Parameters, setpoints: np.ndarray, seeds: np.ndarray, precision: str = "float64", threads: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Truth and sensor matrices (ticks, N, columns), with sensor noise."""
    plant = PLANTS[name].make(len(parameters), PlantOptions(precision=precision, threads=threads))
    plant.reset(seeds=seeds, parameters=parameters)
    truth, sensors = [], []
    for tick in setpoints:
        sensors.append(plant.step(tick).values.copy())
        truth.append(plant.truth().values.copy())
    plant.close()
    return np.array(truth), np.array(sensors)


def read(raws: np.ndarray, parameters=None, seeds=None, options: PlantOptions = QUIET, robot: Robot = ROBOT) -> np.ndarray:
    """What sensors read (ticks, N, columns) of raw signals (ticks, N, columns), the first at the reset."""
    count = raws.shape[1]
    model, out = SensorModel(robot, options, count), np.zeros((count, SENSOR_LAYOUT.width))
    parameters = Parameters.nominal(robot, count) if parameters is None else parameters
    model.reset(raws[0], out, spawn_seeds(0, count) if seeds is None else seeds, parameters)
    readings = [out.copy()]
    for raw in raws[1:]:
        model.measure(raw, out)
        readings.append(out.copy())
    return np.array(readings)


def channel(readings: np.ndarray, name: str) -> np.ndarray:
    """A channel of readings."""
    return readings[..., SENSOR_LAYOUT.slices[name]]
