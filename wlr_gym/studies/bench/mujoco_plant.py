"""Speed of the MuJoCo plant: what servos, sensors and truth cost on top of MuJoCo, and how it compares with the engine."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.physics.plants.mujoco.plant import MujocoPlant
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.studies.bench.measure import Contender, Measurement, Size, interleave, rate
from wlr_gym.studies.bench.mujoco_loop import ServoBatch, build_servo_model
from wlr_gym.studies.bench.speed import SUBSTEPS, random_setpoints, substeps

Array = NDArray[np.float64]

#: An overhead below 30 % of MuJoCo's own time.
LEAST_RATIO = 1.0 / 1.3
#: Live arrays that the plant writes before a MuJoCo step, and the state that the step reads.
_INPUTS = ("applied", "armature", "gear_bound", "pair_friction", "pair_margin", "geom_size", "geom_pos", "geom_quat")
_STATE = ("qpos", "qvel", "warmstart")


def measure_mujoco(size: Size) -> list[Measurement]:
    """Substeps per second on one thread: the plant against the same MuJoCo steps alone, a servo model, and the engine."""
    count, ticks = size(256, 2), size(10, 1)
    contenders = {
        "plant": _plant("mujoco", count, ticks),
        "alone": _steps_alone(count, ticks),
        "servos": _servos(count, ticks),
        "engine": _plant("gibbs_appell", count, ticks),
    }
    values = interleave(contenders, size.rounds, tell=size.tell)
    what = f"substeps of 1 ms, {count} robots, 1 thread"
    return [
        Measurement(
            "mujoco", f"plant, {what}", "1/s", values["plant"], values["alone"], "the same steps, MuJoCo alone", LEAST_RATIO
        ),
        Measurement(
            "mujoco", f"plant, {what}", "1/s", values["plant"], values["servos"], "mujoco.batch, servo actuators", LEAST_RATIO
        ),
        Measurement("mujoco", f"engine, {what}", "1/s", values["engine"], values["plant"], "MuJoCo plant"),
    ]


def _plant(backend: str, count: int, ticks: int) -> Contender:
    plant = make_plant(backend, load_robot(), count)
    return substeps(plant.step, plant.reset, count, ticks)


def _servos(count: int, ticks: int) -> Contender:
    robot = load_robot()
    parameters = Parameters.nominal(robot, count)
    batch = ServoBatch(build_servo_model(robot, parameters, contact="matched"), parameters)
    state = standing_state(robot, parameters)
    return substeps(partial(batch.step, substeps=SUBSTEPS), partial(batch.reset, state), count, ticks)


def _steps_alone(count: int, ticks: int) -> Contender:
    """Bare ``Batch.step`` on the plant's own model: a tick starts from a state of the plant's drive and keeps its forces."""
    plant, setpoints = MujocoPlant(load_robot(), count), random_setpoints(ticks, count)
    batch = plant._batch  # the peer is what the plant is made of
    states: list[list[Array]] = []
    for row in setpoints:
        plant.step(row)
        states.append([getattr(batch, name).copy() for name in (*_STATE, *_INPUTS)])

    def drive() -> None:
        for state in states:
            for name, value in zip((*_STATE, *_INPUTS), state, strict=True):
                getattr(batch, name)[...] = value
            for _ in range(SUBSTEPS):
                batch.step()

    return lambda: rate(drive, count * ticks * SUBSTEPS)
