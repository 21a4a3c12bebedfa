"""Robots in random states with random setpoints on a floor: whether every number stays finite."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np

from wlr_gym.base.errors import Interval
from wlr_gym.base.random import spawn_seeds
from wlr_gym.cli import OK
from wlr_gym.cli.options import JsonOption
from wlr_gym.cli.terminal import print_json
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, PlantState, standing_state
from wlr_gym.robot import FIRST_WHEEL, Robot, load_robot
from wlr_gym.robot.parameters import Parameters

#: Robots at once, and control ticks until they are thrown anew.
ROBOTS, TICKS = 64, 25


@dataclass(frozen=True)
class Fuzzed:
    """What happened.

    Attributes:
        substeps: of robots, in all.
        lost: how many robots had a number that is not finite. first: substeps before the first batch with one (None: none had).
        fastest: m/s, of any body.
    """

    substeps: int
    lost: int
    first: int | None
    fastest: float


def throw(robot: Robot, parameters: Parameters, rng: np.random.Generator) -> PlantState:
    """Return robots in any attitude near z = 0, with any speeds."""
    state, count = standing_state(robot, parameters), len(parameters)
    state.position[:, 0] = rng.uniform(-0.2, 3.0, count)
    state.position[:, 1] = rng.uniform(-0.3, 0.3, count)
    state.position[:, 2] += rng.uniform(-0.05, 0.1, count)
    tilt = rng.normal(size=(count, 4)) * [0.0, 1.0, 1.0, 1.0] * rng.choice([0.1, 1.0, 10.0], (count, 1)) + [1.0, 0.0, 0.0, 0.0]
    state.quaternion[:] = tilt / np.linalg.norm(tilt, axis=1, keepdims=True)
    state.linear_velocity_in_body[:] = rng.normal(size=(count, 3))
    state.angular_velocity_in_body[:] = 3.0 * rng.normal(size=(count, 3))
    state.joint_position[:, :FIRST_WHEEL] = rng.uniform(-3.2, 3.2, (count, FIRST_WHEEL))
    state.joint_velocity[:] = np.repeat([3.0, 20.0], 4) * rng.normal(size=(count, 8))
    state.reference_position[:] = state.joint_position
    return state


def fuzz(
    floor: str, substeps: int, seed: int = 0, backend: str = "gibbs_appell", precision: str = "float64", threads: int = 1
) -> Fuzzed:
    """Throw robots on to a floor, drive them by random setpoints, and again, for a number of substeps of all robots together.

    Args:
        floor: name or path.
        substeps: of all robots together, at least.
        seed: of everything that is drawn.
        backend, precision, threads: of the simulator.
    """
    robot = load_robot()
    options = PlantOptions(precision=precision, threads=threads)
    plant: Any = make_plant(backend, robot, ROBOTS, options)
    laid = load_floor(floor)
    done, lost, first, fastest = 0, 0, None, 0.0
    while done < substeps:
        rng = np.random.default_rng([seed, done])
        seeds = spawn_seeds(int(rng.integers(2**31)), ROBOTS)
        parameters = Parameters.nominal(robot, ROBOTS)
        laid.write(parameters, seeds)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = rng.uniform(0.0, 1.5, (ROBOTS, 1))
        state = throw(robot, parameters, rng)
        plant.reset(seeds, parameters, state=state)
        deepest = plant.contacts().depth.max(axis=1)
        state.position[:, 2] += np.maximum(deepest, 0.0) - rng.uniform(-0.05, 0.003, ROBOTS)
        plant.reset(seeds, parameters, state=state)
        for _ in range(TICKS):
            plant.step(np.hstack([rng.uniform(-3.2, 3.2, (ROBOTS, 4)), rng.uniform(-20.0, 20.0, (ROBOTS, 4))]))
            fastest = max(fastest, float(np.abs(plant.truth().linear_velocity_in_body).max()))
        count = int((~np.isfinite(plant.truth().values)).any(axis=1).sum())
        if count and first is None:
            first = done
        lost += count
        done += ROBOTS * TICKS * options.substeps
    return Fuzzed(done, lost, first, fastest)


@dataclass(frozen=True)
class FuzzOptions(JsonOption):
    floors: tuple[str, ...] = ("flat", "rough", "gravel", "kerbs", "ramps", "stairs")
    """Names or files."""
    substeps: Annotated[int, Interval(least=1)] = 100_000_000
    """Of robots, on every floor."""
    precision: str = "float64"
    """float64 or float32."""
    threads: Annotated[int, Interval(least=1)] = 1
    """Of the simulator."""
    seed: int = 0
    """Of everything that is drawn."""


def run(options: FuzzOptions) -> int:
    """Throw robots on to floors in random states; say how many were lost to numbers that are not finite."""
    found = {}
    for floor in options.floors:
        fuzzed = fuzz(floor, options.substeps, options.seed, precision=options.precision, threads=options.threads)
        found[floor] = asdict(fuzzed)
        place = "" if fuzzed.first is None else f", first in the batch after {fuzzed.first} substeps"
        if not options.json:
            print(f"{floor}: {fuzzed.substeps} substeps, {fuzzed.lost} robots lost{place}; {fuzzed.fastest:.0f} m/s at most")
    if options.json:
        print_json(found)
    return OK if not any(one["lost"] for one in found.values()) else 1
