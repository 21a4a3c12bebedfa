"""Robots in random states with random setpoints on a floor: whether every number stays finite."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from wlr_gym.base.errors import InputError, Interval
from wlr_gym.base.files import write_json
from wlr_gym.base.random import spawn_seeds
from wlr_gym.base.settings import read_json
from wlr_gym.cli import OK
from wlr_gym.cli.options import JsonOption
from wlr_gym.cli.terminal import print_json
from wlr_gym.data.watch import truth_of
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, PlantState, standing_state
from wlr_gym.physics.plants.body import SPOTS, spots_at
from wlr_gym.physics.plants.contacts import CONTACTS, contacts_at
from wlr_gym.robot import FIRST_WHEEL, Robot, load_robot
from wlr_gym.robot.parameters import Parameters

#: Robots at once, and control ticks until they are thrown anew.
ROBOTS, TICKS = 64, 25
#: Batches.
KEPT_EVERY = 100


@dataclass(frozen=True)
class Fuzzed:
    """What happened.

    Attributes:
        substeps: of robots, in all; where the next batch begins.
        lost: how many robots had a number that is not finite. first: substeps before the first batch with one (None: none had).
        fastest: m/s, of any body.
    """

    substeps: int = 0
    lost: int = 0
    first: int | None = None
    fastest: float = 0.0


NOTHING = Fuzzed()


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
    floor: str,
    substeps: int,
    seed: int = 0,
    backend: str = "gibbs_appell",
    precision: str = "float64",
    threads: int = 1,
    *,
    so_far: Fuzzed = NOTHING,
    note: Callable[[Fuzzed], None] = lambda fuzzed: None,
) -> Fuzzed:
    """Throw robots on to a floor, drive them by random setpoints, and again, for a number of substeps of all robots together.

    Args:
        floor: name or path.
        substeps: of all robots together, at least.
        seed: of everything that is drawn.
        backend, precision, threads: of the simulator.
        so_far: what an earlier run of the same numbers came to, which goes on. note: is told after every batch.
    """
    robot = load_robot()
    options = PlantOptions(precision=precision, threads=threads)
    plant: Any = make_plant(backend, robot, ROBOTS, options)
    laid = load_floor(floor)
    found = so_far
    while found.substeps < substeps:
        rng = np.random.default_rng([seed, found.substeps])
        seeds = spawn_seeds(int(rng.integers(2**31)), ROBOTS)
        parameters = Parameters.nominal(robot, ROBOTS)
        laid.write(parameters, seeds)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = rng.uniform(0.0, 1.5, (ROBOTS, 1))
        state = throw(robot, parameters, rng)
        lift(robot, parameters, state)
        state.position[:, 2] -= rng.uniform(-0.05, 0.003, ROBOTS)
        plant.reset(seeds, parameters, state=state)
        fastest = found.fastest
        for _ in range(TICKS):
            plant.step(np.hstack([rng.uniform(-3.2, 3.2, (ROBOTS, 4)), rng.uniform(-20.0, 20.0, (ROBOTS, 4))]))
            fastest = max(fastest, float(np.abs(plant.truth().linear_velocity_in_body).max()))
        lost = int((~np.isfinite(plant.truth().values)).any(axis=1).sum())
        first = found.substeps if lost and found.first is None else found.first
        found = Fuzzed(found.substeps + ROBOTS * TICKS * options.substeps, found.lost + lost, first, fastest)
        note(found)
    return found


def lift(robot: Robot, parameters: Parameters, state: PlantState) -> None:
    """Raise robots until neither wheels nor bodies nor legs are in the floor. A kerb's face may show the way aside, not up."""
    for _ in range(20):
        wheels = contacts_at(robot, parameters, truth_of(state), np.zeros((ROBOTS, len(CONTACTS), 3))).depth.max(axis=1)
        others = spots_at(robot, parameters, truth_of(state), np.zeros((ROBOTS, len(SPOTS), 3))).depth.max(axis=1)
        deepest = np.maximum(wheels, others)
        state.position[:, 2] += np.maximum(deepest, 0.0)
        if (deepest <= 0.0).all():
            return


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
    out: Path | None = None
    """File of what was found so far: a run that names it goes on from there."""


def run(options: FuzzOptions) -> int:
    """Throw robots on to floors in random states; say how many were lost to numbers that are not finite."""
    kept = FuzzFile(options)
    for floor in options.floors:
        fuzzed = fuzz(
            floor, options.substeps, options.seed, precision=options.precision, threads=options.threads,
            so_far=kept.found.get(floor, NOTHING), note=functools.partial(kept.note, floor),
        )  # fmt: skip
        kept.write()
        place = "" if fuzzed.first is None else f", first in the batch after {fuzzed.first} substeps"
        if not options.json:
            print(f"{floor}: {fuzzed.substeps} substeps, {fuzzed.lost} robots lost{place}; {fuzzed.fastest:.0f} m/s at most")
    if options.json:
        print_json({floor: asdict(one) for floor, one in kept.found.items()})
    return OK if not any(one.lost for one in kept.found.values()) else 1


class FuzzFile:
    """What was found so far on every floor, kept in a file every :data:`KEPT_EVERY` batches where the options name one.

    Attributes:
        found: floor -> what happened there.
    """

    def __init__(self, options: FuzzOptions) -> None:
        self._out, self._batches = options.out, 0
        self._of = {"seed": options.seed, "precision": options.precision}
        self.found: dict[str, Fuzzed] = {}
        if self._out is not None and self._out.is_file():
            kept = read_json(self._out)
            if kept["of"] != self._of:
                raise InputError(f"{self._out}: was found with {kept['of']}: expected the same, or another file")
            self.found = {floor: Fuzzed(**one) for floor, one in kept["found"].items()}

    def note(self, floor: str, found: Fuzzed) -> None:
        """Take what was found on a floor so far."""
        self.found[floor], self._batches = found, self._batches + 1
        if self._batches % KEPT_EVERY == 0:
            self.write()

    def write(self) -> None:
        """Write the file."""
        if self._out is not None:
            write_json(self._out, {"of": self._of, "found": {floor: asdict(one) for floor, one in self.found.items()}})
