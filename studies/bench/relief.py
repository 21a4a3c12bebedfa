"""Cost of relief: the engine on every floor against a level one, and against MuJoCo with boxes for the same kerbs."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from studies.bench.engine import PERIOD, UNIT, distance, ramps
from studies.bench.measure import Contender, Measurement, Size, interleave, rate
from studies.bench.mujoco_loop import ServoBatch, build_servo_model
from studies.bench.speed import PRECISIONS, substeps
from wlr_gym.base.random import spawn_seeds
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot import WHEELS, Robot, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

FLOORS = ("rough", "gravel", "kerbs", "ramps", "stairs")
ROBOTS = 512
#: Largest time of a step on relief over that of one on a level floor.
MOST = 2.2
#: Least speed of the engine on kerbs over that of MuJoCo, which has them as boxes, at equal error.
LEAST = 30.0
#: Kerbs of both: foot, height and length of their tops, m.
KERBS = ((0.6, 0.01, 0.3), (1.5, 0.015, 0.4), (2.4, 0.02, 1.0))


def measure_relief(size: Size) -> list[Measurement]:
    """Substeps per second of a batch on one thread."""
    return [*_floors(size), *_boxes(size)]


def _floors(size: Size) -> list[Measurement]:
    count, ticks = size(ROBOTS, 2), size(20, 1)
    rows = []
    for precision in PRECISIONS:
        floors = ("flat", *(FLOORS[:1] if size.quick else FLOORS))
        values = interleave({floor: _plant(floor, count, ticks, precision) for floor in floors}, size.rounds, tell=size.tell)
        text = f"{count} robots, {precision}, 1 thread"
        rows += [
            Measurement("relief", f"{floor}, {text}", "1/s", values[floor], values["flat"], "flat", 1.0 / MOST)
            for floor in floors[1:]
        ]
    return rows


def _laid(robot: Robot, floor: str, count: int) -> Parameters:
    parameters = Parameters.nominal(robot, count)
    load_floor(floor).write(parameters, spawn_seeds(0, count))
    return parameters


def _plant(floor: str, count: int, ticks: int, precision: str) -> Contender:
    robot = load_robot()
    plant = make_plant("gibbs_appell", robot, count, PlantOptions(precision=precision))
    parameters = _laid(robot, floor, count)
    state = standing_state(robot, parameters)
    return substeps(plant.step, partial(plant.reset, parameters=parameters, state=state), count, ticks)


# ---- against MuJoCo --------------------------------------------------------------------------------------------------

PEER = "MuJoCo with boxes"
#: s: steps of each side with the same error, of about 0.5 mm and less; of both alike; and the one that errors are taken from.
#: (MuJoCo's springs are its defaults. With the engine's its errors at kerbs are larger: 1.4 mm at 0.25 ms.)
EQUAL_ERROR, EQUAL_STEP, FINEST = {"ours": 4e-3, PEER: 5e-4}, {"ours": 1e-3, PEER: 1e-3}, 1e-4

#: Drives the robots; returns their poses (T, N, 7) and simulated seconds of a robot per second.
Drive = Callable[[], tuple[Array, float]]


def _boxes(size: Size) -> list[Measurement]:
    """Robots driven along kerbs, at equal errors and at equal steps; MuJoCo's wheels are spheres that touch boxes.

    An error is how far apart the hips are (root of the mean square over robots and time) from where the same side's finest step
    has them: what the two sides call a kerb is not the same to that accuracy.
    """
    scene = _Scene(size(64, 2), size(100, 2))
    finest = {side: _driven(scene, side, FINEST)()[0] for side in (*PRECISIONS, PEER)}
    rows = []
    for what, steps, bar in (("equal error", EQUAL_ERROR, LEAST), ("equal step", EQUAL_STEP, None)):
        step = {side: steps.get(side, steps["ours"]) for side in finest}
        drives = {side: _driven(scene, side, step[side]) for side in finest}
        error = {side: _apart(drives[side]()[0], finest[side]) for side in finest}
        speed = interleave(
            {side: lambda drive=drive: drive()[1] for side, drive in drives.items()}, size.rounds, tell=size.tell
        )
        label = {side: f"{1e3 * step[side]:g} ms, error {1e3 * error[side]:.2g} mm" for side in finest}
        rows += [
            Measurement(
                "relief", f"kerbs, {what}: {side}, 1 thread, {label[side]}", UNIT, speed[side], speed[PEER],
                f"{PEER}, {label[PEER]}", bar,
            )
            for side in PRECISIONS
        ]  # fmt: skip
    return rows


class _Scene:
    """Robots spread before kerbs and on them, and what their wheels are told."""

    def __init__(self, count: int, ticks: int) -> None:
        self.robot = load_robot()
        self.parameters = Parameters.nominal(self.robot, count)
        for number, (foot, height, length) in enumerate(KERBS, 1):
            for name, value in (("x", foot), ("height", height), ("length", length)):
                self.parameters[f"piece.{name}[piece_{number}]"] = value
        self.state = standing_state(self.robot, self.parameters)
        self.state.position[:, 0] = np.linspace(-0.1, 0.3, count)
        home, rng = self.robot.home.leg_angle, np.random.default_rng(1)
        speeds = rng.uniform(2.0, 9.0, (count, 3, 1)) * np.ones(4)
        driven = [ramps(np.hstack([np.full((3, 4), home), row]), home, ticks) for row in speeds]
        self.setpoints = np.stack(driven, axis=1)


def _driven(scene: _Scene, side: str, step: float) -> Drive:
    robots = _in_mujoco(scene, step) if side == PEER else _in_the_engine(scene, side, step)

    def drive() -> tuple[Array, float]:
        robots.reset()
        poses = np.zeros((len(scene.setpoints), len(scene.parameters), 7))

        def work() -> None:
            for kept, row in zip(poses, scene.setpoints, strict=True):
                robots.step(row)
                kept[:] = robots.pose()

        return poses, rate(work, len(scene.parameters) * len(poses) * PERIOD)

    return drive


class _Robots(NamedTuple):
    """Robots of one side: how to start anew, advance by a control step, and tell their poses (N, 7)."""

    reset: Callable[[], object]
    step: Callable[[Array], object]
    pose: Callable[[], Array]


def _in_mujoco(scene: _Scene, step: float) -> _Robots:
    batch = ServoBatch(_model_with_boxes(scene.robot, scene.parameters, step), scene.parameters)
    reset, advance = partial(batch.reset, scene.state), partial(batch.step, substeps=round(PERIOD / step))
    return _Robots(reset, advance, lambda: batch.position[:, :7])


def _in_the_engine(scene: _Scene, precision: str, step: float) -> _Robots:
    options = PlantOptions(physics_step=step, precision=precision)
    plant = make_plant("gibbs_appell", scene.robot, len(scene.parameters), options)
    reset = partial(plant.reset, parameters=scene.parameters, state=scene.state)
    return _Robots(reset, plant.step, lambda: np.hstack([plant.truth().position, plant.truth().quaternion]))


def _apart(poses: Array, finest: Array) -> float:
    hip = Parameters.nominal(load_robot())["hip.position"][0]
    return float(np.sqrt(np.mean([distance(*pair, hip) ** 2 for pair in zip(poses, finest, strict=True)])))


def _model_with_boxes(robot: Robot, parameters: Parameters, step: float) -> mujoco.MjModel:
    """Return the servo model on a floor with a box for every kerb, which touches every wheel."""

    def add(spec: mujoco.MjSpec) -> None:
        for number, (foot, height, length) in enumerate(KERBS, 1):
            name, half = f"kerb_{number}", [0.5 * length, 5.0, 0.5 * height]
            box = mujoco.mjtGeom.mjGEOM_BOX
            spec.worldbody.add_geom(
                name=name, type=box, size=half, pos=[foot + 0.5 * length, 0.0, 0.5 * height], contype=0, conaffinity=0
            )
            for wheel in WHEELS:
                spec.add_pair(geomname1=name, geomname2=wheel, condim=3)

    return build_servo_model(robot, parameters, step, extend=add)
