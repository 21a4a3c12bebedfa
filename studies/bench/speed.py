"""Speed of the environment, import and start, of the engine by batch size, and of the MuJoCo plant beside bare MuJoCo."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import wlr_gym  # noqa: F401  (registers the environments)
from studies.bench.measure import Contender, Measurement, Size, against_fastest, interleave, rate
from studies.bench.mujoco_loop import BACKEND, ServoBatch, build_servo_model, register_backend
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.physics.plants.mujoco.plant import MujocoPlant
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

ENVIRONMENT = "WLR-Velocity-v0"
SUBSTEPS = PlantOptions().substeps
PRECISIONS = ("float32", "float64")
#: An overhead below 30 % of MuJoCo's own time.
LEAST_RATIO = 1.0 / 1.3
#: Live arrays that the plant writes before a MuJoCo step, and the state that the step reads.
_INPUTS = ("applied", "armature", "gear_bound", "pair_friction", "pair_margin", "geom_size", "geom_pos", "geom_quat")
_STATE = ("qpos", "qvel", "warmstart")
START = (
    "import gymnasium, wlr_gym; env = gymnasium.make('{}'); env.reset(seed=0); env.step(env.action_space.sample()); env.close()"
)


def random_setpoints(ticks: int, count: int) -> Array:
    """Return setpoints (ticks, count, 8) that keep legs and wheels busy: new ones every tenth tick."""
    rng = np.random.default_rng(0)
    draws = -(-ticks // 10)
    legs, wheels = np.pi / 2 + rng.uniform(-0.3, 0.3, (draws, count, 4)), rng.uniform(-6.0, 6.0, (draws, count, 4))
    return np.repeat(np.concatenate([legs, wheels], axis=2), 10, axis=0)[:ticks]


def substeps(step: Callable[[Array], object], reset: Callable[[], object], count: int, ticks: int) -> Contender:
    """Return what measures the substeps per second of robots: a reset, then so many control ticks of random setpoints."""
    setpoints = random_setpoints(ticks, count)

    def drive() -> None:
        for row in setpoints:
            step(row)

    def run() -> float:
        reset()
        return rate(drive, count * ticks * SUBSTEPS)

    return run


def measure_env_step(size: Size) -> list[Measurement]:
    """``env.step`` of one robot; the peer is the same environment on a plain MuJoCo loop."""
    register_backend()
    ours = gym.make(ENVIRONMENT, randomization="none")
    peer = gym.make(ENVIRONMENT, randomization="none", backend=BACKEND)
    steps = size(400, 5)
    values = interleave({"ours": _stepping(ours, steps), "MuJoCo loop": _stepping(peer, steps)}, size.rounds, tell=size.tell)
    ours.close()
    peer.close()
    peers = {"same env on mj_step(nstep=20)": values["MuJoCo loop"]}
    return [against_fastest("env_step", "env.step of one robot, float64", "1/s", values["ours"], peers, 5.0)]


def _stepping(env: gym.Env, steps: int) -> Contender:
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (steps, 8)).astype(np.float32)
    env.reset(seed=0)

    def run() -> float:
        start, resetting = time.perf_counter(), 0.0
        for action in actions:
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                ended = time.perf_counter()
                env.reset()
                resetting += time.perf_counter() - ended
        return steps / (time.perf_counter() - start - resetting)

    return run


def measure_batch(size: Size) -> list[Measurement]:
    """Substeps per second by batch size, precision and threads; for information."""
    counts: Sequence[int] = (1, 4) if size.quick else (1, 8, 64, 512, 4096)
    cases = [(count, precision, threads) for precision in PRECISIONS for threads in (1, 2) for count in counts]
    ticks = {count: max(5, 5_000 // count) if not size.quick else 2 for count in counts}
    contenders = {
        f"{count} robots, {precision}, {threads} thread{'s' * (threads > 1)}": _plant(
            "gibbs_appell", count, ticks[count], precision, threads
        )
        for count, precision, threads in cases
    }
    values = interleave(contenders, min(size.rounds, 3), tell=size.tell)
    return [Measurement("batch", name, "1/s", series) for name, series in values.items()]


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


def _plant(backend: str, count: int, ticks: int, precision: str = "float64", threads: int = 1) -> Contender:
    plant = make_plant(backend, load_robot(), count, PlantOptions(precision=precision, threads=threads))
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


def measure_import(size: Size) -> list[Measurement]:
    """Time of ``import wlr_gym`` beyond that of Python itself."""
    values = interleave({"import": _process("import wlr_gym"), "bare": _process("pass")}, size.rounds, tell=size.tell)
    extra = tuple(a - b for a, b in zip(values["import"], values["bare"], strict=True))
    return [Measurement("import", "import wlr_gym, beyond bare Python", "s", extra, bar=0.3)]


def measure_start(size: Size) -> list[Measurement]:
    """Whole process: Python, imports, ``gym.make``, reset, first step, exit; compiled code is cached by the first run."""
    values = interleave({"start": _process(START.format(ENVIRONMENT))}, size.rounds, tell=size.tell)
    return [Measurement("start", "second start: process, imports, gym.make, reset, first step", "s", values["start"], bar=2.0)]


def _process(code: str) -> Callable[[], float]:
    # Python's own compiled files count like the kernels: with this variable every start would compile the sources anew.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}

    def run() -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True, env=environment)
        return time.perf_counter() - start

    return run
