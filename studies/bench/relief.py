"""Cost of relief: the engine on every floor against a level one, and against MuJoCo with boxes for the same kerbs."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray

from studies.bench.measure import Contender, Measurement, Size, interleave
from studies.bench.mujoco_loop import ServoBatch, build_servo_model
from studies.bench.speed import PRECISIONS, SUBSTEPS, substeps
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
#: Least speed of the engine on kerbs over that of MuJoCo, which has them as boxes.
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


def _boxes(size: Size) -> list[Measurement]:
    """Robots spread along the kerbs, so that some of them are on edges; MuJoCo's wheels are spheres that touch boxes."""
    robot, count, ticks = load_robot(), size(64, 2), size(20, 1)
    parameters = Parameters.nominal(robot, count)
    for number, (foot, height, length) in enumerate(KERBS, 1):
        for name, value in (("x", foot), ("height", height), ("length", length)):
            parameters[f"piece.{name}[piece_{number}]"] = value
    state = standing_state(robot, parameters)
    state.position[:, 0] = np.linspace(0.0, 3.0, count)
    state.position[:, 2] += KERBS[-1][1]
    batch = ServoBatch(_model_with_boxes(robot, parameters), parameters)
    contenders = {
        "MuJoCo with boxes": substeps(partial(batch.step, substeps=SUBSTEPS), partial(batch.reset, state), count, ticks)
    }
    for precision in PRECISIONS:
        plant = make_plant("gibbs_appell", robot, count, PlantOptions(precision=precision))
        contenders[precision] = substeps(plant.step, partial(plant.reset, parameters=parameters, state=state), count, ticks)
    values = interleave(contenders, size.rounds, tell=size.tell)
    peer, *ours = contenders
    return [
        Measurement("relief", f"kerbs, {count} robots, {one}, 1 thread", "1/s", values[one], values[peer], peer, LEAST)
        for one in ours
    ]


def _model_with_boxes(robot: Robot, parameters: Parameters) -> mujoco.MjModel:
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

    return build_servo_model(robot, parameters, extend=add)
