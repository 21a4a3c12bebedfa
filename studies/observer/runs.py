"""Simulated runs with sensors and truth, and how well an observer does on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.random import generator, spawn_seeds
from wlr_gym.envs.tasks.randomization import DRIFT_PERIOD, load_randomization
from wlr_gym.perception.observer import ESTIMATE_LAYOUT, SlipObserver
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Layout, PlantOptions
from wlr_gym.robot import CORNER_SIGNS, Robot, load_robot

Array = NDArray[np.float64]
PERIOD = 0.02


@dataclass(frozen=True)
class Runs:
    """N robots over T + 1 ticks: sensors and truth (T + 1, N, width)."""

    robot: Robot
    sensors: Array
    truth: Array

    def sensed(self, name: str) -> Array:
        """A sensor channel, (T + 1, N, ...)."""
        return channel(SENSOR_LAYOUT, self.sensors, name)

    def true(self, name: str) -> Array:
        """A channel of the truth, (T + 1, N, ...)."""
        return channel(TRUTH_LAYOUT, self.truth, name)


def channel(layout: Layout, values: Array, name: str) -> Array:
    """A channel of values laid out so."""
    columns = values[..., layout.slices[name]]
    return columns if layout.channels[name].labels else columns[..., 0]


def held(draw, rng: np.random.Generator, ticks: int, count: int, shortest: float, longest: float) -> Array:
    """Values (T, N, K) that jump: ``draw(n)`` gives (n, K), held between ``shortest`` and ``longest`` seconds."""
    values, until = draw(count), np.zeros(count)
    out = np.empty((ticks, *values.shape))
    for tick in range(ticks):
        due = np.flatnonzero(until <= tick)
        values[due] = draw(len(due))
        until[due] = tick + rng.uniform(shortest, longest, len(due)) / PERIOD
        out[tick] = values
    return out


def commanded_setpoints(robot: Robot, ticks: int, count: int, rng: np.random.Generator) -> Array:
    """Drive as a task asks: forward +-0.1 m/s and a skid turn of +-0.3 rad/s, held 2 to 5 s, at times standing."""

    def draw(n: int) -> Array:
        return rng.uniform(-1.0, 1.0, (n, 2)) * (0.1, 0.3) * (rng.random((n, 1)) > 0.15)

    command = held(draw, rng, ticks, count, 2.0, 5.0)
    left = robot.hip_position.y * np.array([y for _, y in CORNER_SIGNS])
    setpoints = np.full((ticks, count, 8), robot.home.leg_angle)
    setpoints[..., 4:] = (command[..., :1] - 1.8 * command[..., 1:] * left) / robot.wheel.radius
    return setpoints


def excited_setpoints(robot: Robot, ticks: int, count: int, rng: np.random.Generator) -> Array:
    """Shake every joint on its own: legs swing by up to 0.4 rad, wheels jump between +-5 rad/s."""
    setpoints = np.empty((ticks, count, 8))
    time = PERIOD * np.arange(ticks)[:, None, None]
    size, rate, phase = rng.uniform(0, 0.4, (count, 4)), rng.uniform(0.2, 3.0, (count, 4)), rng.uniform(0, 6.3, (count, 4))
    setpoints[..., :4] = robot.home.leg_angle + size * (np.sin(rate * time + phase))
    setpoints[..., 4:] = held(lambda n: rng.uniform(-5.0, 5.0, (n, 4)), rng, ticks, count, 0.3, 1.5)
    return setpoints


def climbing_setpoints(robot: Robot, ticks: int, count: int, rng: np.random.Generator) -> Array:
    """Drive straight ahead at 0.03 to 0.1 m/s, reached within half a second, for two thirds of the time; then hold."""
    time = PERIOD * np.arange(ticks)[:, None, None]
    speed = rng.uniform(0.03, 0.1, (count, 1)) * np.minimum(time / 0.5, 1.0) * (time < time[-1] * 2.0 / 3.0)
    setpoints = np.full((ticks, count, 8), robot.home.leg_angle)
    setpoints[..., 4:] = speed / robot.wheel.radius
    return setpoints


#: Floors that no task has: friction drawn anew, all over the floor, every 1.5 to 3 s.
FLOORS = {
    "changing": {
        "name": "changing",
        "base": "slippery",
        "events": {"floor_friction": {"when": "interval", "interval": [1.5, 3.0]}},
    }
}
DRIVES = {"climb": climbing_setpoints, "commands": commanded_setpoints, "excitation": excited_setpoints}
#: Floors and drives, and policies and floors, that the observer is trained and measured with.
DRIVEN = [(floor, drive) for floor in ("nominal", "wide", "split", "ice", "patches") for drive in ("commands", "excitation")]
DRIVEN += [("slope", "climb"), ("slippery", "commands"), ("changing", "commands")]
PLAYED = [(p, f) for p in ("velocity_blind", "velocity_slip_aware") for f in ("slippery", "ice", "split")]


def simulate(
    backend: str,
    floor: str,
    drive: str,
    count: int,
    seconds: float,
    seed: int = 0,
    robot: Robot | None = None,
    **parameters: float,
) -> Runs:
    """Drive ``count`` robots drawn from a randomisation; ``parameters``: elements set after it, '.' written as '__'."""
    robot = robot or load_robot("nominal")
    randomization = load_randomization(FLOORS.get(floor, floor), robot)
    plant = make_plant(backend, robot, count, PlantOptions(control_period=PERIOD))
    ticks, seeds = round(seconds / PERIOD), spawn_seeds(seed, count, "observed")
    occurrences = np.zeros((count, len(randomization.intervals)), np.int64)
    strike = randomization.next_strike(seeds, occurrences, PERIOD)
    setpoints = DRIVES[drive](robot, ticks, count, generator(seed, "goals", drive))

    def draw(tick: int):
        drawn = randomization.parameters(seeds, seeds, occurrences, np.full(count, tick * PERIOD))
        for name, value in parameters.items():
            drawn[name.replace("__", ".")] = value
        return drawn

    drawn = draw(0)
    sensors = [plant.reset(seeds, drawn, state=randomization.state(drawn, seeds)).values.copy()]
    truth = [plant.truth().values.copy()]
    for tick in range(ticks):
        sensors.append(plant.step(setpoints[tick]).values.copy())
        truth.append(plant.truth().values.copy())
        due = strike <= tick + 1
        occurrences[due] += 1
        if due.any():
            strike = np.where(due, tick + 1 + randomization.next_strike(seeds, occurrences, PERIOD), strike)
        if due.any() or (randomization.drifts and tick % round(DRIFT_PERIOD / PERIOD) == 0):
            plant.set_parameters(draw(tick + 1))
    plant.close()
    return Runs(robot, np.array(sensors), np.array(truth))


def play(policy: str, floor: str, count: int, seconds: float, seed: int = 0, backend: str = "gibbs_appell") -> Runs:
    """Let a shipped policy drive ``count`` robots drawn from a randomisation; it sees what its task has it see."""
    from wlr_gym.learning.evaluation.rollout import start_episodes
    from wlr_gym.learning.evaluation.subjects import make_player

    core, agent = make_player("WLR-Velocity-v0", policy, count, {"randomization": floor, "backend": backend})
    start_episodes(core, agent, 1000 * seed)
    sensors, truth = [core.sensors.values.copy()], [core.plant.truth().values.copy()]
    for _ in range(round(seconds / PERIOD)):
        core.step(agent.act(core.observation), core.everyone)
        sensors.append(core.sensors.values.copy())
        truth.append(core.plant.truth().values.copy())
    core.close()
    return Runs(load_robot("nominal"), np.array(sensors), np.array(truth))


def changed(runs: Runs, change: Callable[[Array], None]) -> Runs:
    """The same runs with other readings."""
    sensors = runs.sensors.copy()
    change(sensors)
    return Runs(runs.robot, sensors, runs.truth)


def without_flow(runs: Runs) -> Runs:
    """The same runs of robots without a flow sensor."""
    return changed(runs, lambda s: s.__setitem__((..., SENSOR_LAYOUT.slices["flow_is_new"]), 0.0))


def observe(runs: Runs, camera: bool, kind: Any = SlipObserver) -> Array:
    """Return an observer's estimates (T + 1, N, ESTIMATE_LAYOUT.width); ``kind``: its class."""
    count = runs.sensors.shape[1]
    observer, everyone = kind(runs.robot, PERIOD, count, camera), np.ones(count, bool)
    observer.reset(everyone, runs.sensors[0])
    out = [observer.values.copy()]
    for readings in runs.sensors[1:]:
        observer.update(everyone, readings)
        out.append(observer.values.copy())
    return np.array(out)


def estimated(values: Array, name: str) -> Array:
    """A channel of the estimates, (T + 1, N, ...)."""
    return channel(ESTIMATE_LAYOUT, values, name)


def slip_in_truth_order(values: Array) -> Array:
    """Slip velocities (T + 1, N, 8) as (T + 1, N, 4, 2)."""
    return values.reshape(*values.shape[:2], 4, 2)


def plain_odometry(runs: Runs) -> Array:
    """Velocity (T + 1, N, 2) as the wheels' encoders alone tell it: their mean ahead, none to the side."""
    forward = runs.robot.wheel.radius * runs.sensed("joint_velocity")[..., 4:].mean(axis=-1)
    return np.stack([forward, np.zeros_like(forward)], axis=-1)
