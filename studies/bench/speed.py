"""Speed of the environment, import and start, of the engine by batch size, and of the MuJoCo plant beside bare MuJoCo.

And the engine's convergence: the position after one second against a reference at 10 us.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import wlr_gym  # noqa: F401  (registers the environments)
from studies.bench.measure import Contender, Measurement, Size, against_fastest, interleave, rate
from studies.bench.mujoco_loop import BACKEND, ServoBatch, build_servo_model, register_backend
from wlr_gym.base.text import counted
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.physics.plants.gibbs_appell.plant import SWEEPS, GibbsAppellPlant
from wlr_gym.physics.plants.mujoco.plant import MujocoPlant
from wlr_gym.robot import LEG_SLICE, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

ENVIRONMENT = "WLR-Velocity-v0"
SUBSTEPS = PlantOptions().substeps
PRECISIONS = ("float32", "float64")
#: An overhead below 30 % of MuJoCo's own time.
LEAST_RATIO = 1.0 / 1.3
#: Live arrays of the state that a MuJoCo step reads, and of what the plant writes before it, beside those of the contacts.
_READ = ("qpos", "qvel", "warmstart", "applied", "armature", "gear_bound")
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
    contenders = {}
    for precision, threads, count in itertools.product(PRECISIONS, (1, 2), (1, 4) if size.quick else (1, 8, 64, 512, 4096)):
        ticks = size(max(5, 5_000 // count), 2)
        name = f"{count} robots, {precision}, {counted(threads, 'thread')}"
        contenders[name] = _plant("gibbs_appell", count, ticks, precision, threads)
    values = interleave(contenders, min(size.rounds, 3), tell=size.tell)
    return [Measurement("batch", name, "1/s", series) for name, series in values.items()]


def measure_mujoco(size: Size) -> list[Measurement]:
    """Substeps per second on one thread: the plant against the same MuJoCo steps alone, a servo model, and the engine."""
    count, ticks = size(256, 2), size(10, 1)
    contenders = {
        "MuJoCo plant": _plant("mujoco", count, ticks),
        "the same steps, MuJoCo alone": _steps_alone(count, ticks),
        "mujoco.batch, servo actuators": _servos(count, ticks),
        "engine": _plant("gibbs_appell", count, ticks),
    }
    values = interleave(contenders, size.rounds, tell=size.tell)
    plant, alone, servos, _ = contenders

    def row(what: str, ours: str, peer: str, bar: float | None) -> Measurement:
        text = f"{what}, substeps of 1 ms, {count} robots, 1 thread"
        return Measurement("mujoco", text, "1/s", values[ours], values[peer], peer, bar)

    pairs = (("plant", plant, alone, LEAST_RATIO), ("plant", plant, servos, LEAST_RATIO), ("engine", "engine", plant, None))
    return [row(*pair) for pair in pairs]


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
    live: list[Array] = [*(getattr(batch, name) for name in _READ), *batch.per_contact]
    states: list[list[Array]] = []
    for row in setpoints:
        plant.step(row)
        states.append([values.copy() for values in live])

    def drive() -> None:
        for state in states:
            for values, value in zip(live, state, strict=True):
                values[...] = value
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


# ---- convergence, without any timing ---------------------------------------------------------------------------------


CASES = {
    "skid": "legs at home, every wheel at its own constant speed, each with its own friction",
    "legs": "as skid, with every leg stepped to its own angle",
    "profile": "two such poses in turn every 0.3 s, with servo profiles",
    "drop": "as legs, from 10 mm above the floor",
    "random": "new random setpoints every tick",
}
STEPS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)


@dataclass(frozen=True)
class Deviation:
    """Distance (m) between body positions after the run: median, 90 % and worst of the robots.

    Attributes:
        case: of :data:`CASES`. quantity: ``step`` (s), against 10 us; ``sweeps`` (at 1 ms), against 300; ``precision``,
        float32 against float64.
    """

    case: str
    quantity: str
    value: float | str
    median: float
    percentile_90: float
    worst: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return asdict(self)


def measure_convergence(size: Size) -> list[Deviation]:
    """Return the deviations of all cases."""
    count, ticks = size(64, 2), size(50, 2)
    cases = ("drop",) if size.quick else tuple(CASES)
    return [deviation for case in cases for deviation in _case(case, count, ticks, size)]


def _case(case: str, count: int, ticks: int, size: Size) -> list[Deviation]:
    travel = partial(_travel, case, _goals(case, ticks, count))

    def deviation(quantity: str, value: float | str, difference: Array) -> Deviation:
        found = np.percentile(np.linalg.norm(difference, axis=1), (50, 90, 100))
        return Deviation(case, quantity, value, *found.tolist())

    reference = travel(1e-4 if size.quick else 1e-5, 8)
    exact = travel(1e-3, 300)
    rounding = travel(1e-3, SWEEPS, "float32") - travel(1e-3, SWEEPS)
    return [
        *(deviation("step", step, travel(step, SWEEPS) - reference) for step in STEPS),
        *(deviation("sweeps", sweeps, travel(1e-3, sweeps) - exact) for sweeps in (2, 3, 4, 6, 8)),
        deviation("precision", "float32", rounding),
    ]


def _goals(case: str, ticks: int, count: int) -> list[Array]:
    rng = np.random.default_rng(5)
    first, second = _pose(rng, count), _pose(rng, count)
    if case == "random":
        return [_pose(rng, count) for _ in range(ticks)]
    if case == "profile":
        return [first if (tick // 15) % 2 == 0 else second for tick in range(ticks)]
    if case == "skid":
        first[:, LEG_SLICE] = np.pi / 2
    return [first] * ticks


def _pose(rng: np.random.Generator, count: int) -> Array:
    return np.c_[np.pi / 2 + rng.uniform(-0.3, 0.3, (count, 4)), rng.uniform(-6.0, 6.0, (count, 4))]


def _travel(case: str, setpoints: list[Array], step: float, sweeps: int, precision: str = "float64") -> Array:
    """Return how far the body of every robot moved (N, 3)."""
    robot, count = load_robot(), len(setpoints[0])
    parameters = Parameters.nominal(robot, count)
    friction = np.random.default_rng(1).uniform(0.2, 0.9, (count, 4))
    parameters["ground.mu_x"], parameters["ground.mu_y"] = friction, friction
    if case == "profile":
        parameters["servo.profile_velocity"] = 2.0
        parameters["servo.profile_acceleration"] = np.repeat([15.0, 10.0], 4)
    state = standing_state(robot, parameters)
    if case == "drop":
        state.position[:, 2] += 0.01
    plant = GibbsAppellPlant(robot, count, PlantOptions(physics_step=step, precision=precision), sweeps=sweeps)
    plant.reset(parameters=parameters, state=state)
    start = plant.truth().position.copy()
    for row in setpoints:
        plant.step(row)
    return plant.truth().position - start
