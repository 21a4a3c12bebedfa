"""Accuracy against speed of the engine and of MuJoCo: the same ten motions, many settings of both, one reference."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from studies.bench.measure import Size, interleave, summary
from studies.bench.motions import PERIOD, TICKS, BenchMotion, distance, is_upright, motions, start
from studies.bench.mujoco_loop import VIRTUAL_MASS_DIVISOR, Contact, ServoBatch, build_servo_model, servo_controls
from wlr_gym.physics.plants.base import Plant, PlantOptions
from wlr_gym.physics.plants.gibbs_appell.plant import SWEEPS, GibbsAppellPlant
from wlr_gym.physics.plants.mujoco.plant import MujocoPlant
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Cone = Literal["elliptic", "pyramidal"]
Integrator = Literal["Euler", "implicitfast"]

#: Robots that make each motion in the engine, whose speed depends on the size of the batch. MuJoCo's does not: one each.
COPIES = 32
#: s: the two steps of each side that are extrapolated to step zero.
ENGINE_LIMIT, MUJOCO_LIMIT = (2e-5, 1e-5), (1.25e-4, 6.25e-5)
ENGINE_STEPS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)
MUJOCO_STEPS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3, 1e-2)
Kind = tuple[Cone, Contact, Integrator]
#: The first is MuJoCo's default. Matched springs need an impratio with which pyramids are unstable.
KINDS: tuple[Kind, ...] = (
    ("pyramidal", "default", "Euler"), ("pyramidal", "stiff friction", "Euler"), ("elliptic", "default", "Euler"),
    ("elliptic", "stiff friction", "Euler"), ("elliptic", "matched", "implicitfast"), ("elliptic", "tuned", "implicitfast"),
    ("elliptic", "tuned", "Euler"),
)  # fmt: skip
#: MuJoCo's default, of its Newton solver.
ITERATIONS = 100


@dataclass(frozen=True)
class EngineSetting:
    """How the motions are simulated.

    Attributes:
        side: who simulates. step: s. precision: of its numbers.
        iterations: most of MuJoCo's solver per step; passes over the friction rows of the engine.
        contact: of ``mujoco_loop.CONTACTS``, and ``cone``, ``integrator``; the engine has laws of its own and an elliptic cone.
        call: ``step`` (plants, ``mujoco.batch``) or ``rollout`` (``mujoco.rollout``).
        threads: with more than one, speed is by the clock, else by processor time.
    """

    side: Literal["engine", "MuJoCo"]
    step: float
    precision: str = "float64"
    iterations: int = ITERATIONS
    contact: Contact | Literal["own"] = "default"
    cone: Cone = "pyramidal"
    integrator: Integrator = "Euler"
    call: Literal["step", "rollout"] = "step"
    threads: int = 1

    @property
    def is_usual(self) -> bool:
        """Whether passes or iterations are the default's."""
        return self.iterations == (SWEEPS if self.side == "engine" else ITERATIONS)

    @property
    def label(self) -> str:
        """What distinguishes it, in words."""
        parts = [f"{1e3 * self.step:g} ms"]
        if self.side == "MuJoCo":
            parts += [self.cone, f"{self.contact} contact", self.integrator]
        if not self.is_usual:
            parts.append(f"{self.iterations} {'passes' if self.side == 'engine' else 'iterations'}")
        if self.call == "rollout":
            parts.append("mujoco.rollout")
        if self.threads > 1:
            parts.append(f"{self.threads} threads, by the clock")
        return ", ".join(parts)


@dataclass(frozen=True)
class EngineResult:
    """A setting, how far from the reference it ends, and how fast it is.

    Attributes:
        setting: what was run.
        error, worst: m, rms and largest over the motions of :func:`studies.bench.motions.distance`.
        upright: whether all robots were, at the end.
        speed: simulated seconds of a robot per second, one value per round.
    """

    setting: EngineSetting
    error: float
    worst: float
    upright: bool
    speed: tuple[float, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON types; errors that are not finite as None."""
        error, worst = (value if np.isfinite(value) else None for value in (self.error, self.worst))
        described = {**asdict(self.setting), "label": self.setting.label, "is_usual": self.setting.is_usual}
        return {**described, "error": error, "worst": worst, "upright": self.upright, "speed": summary(self.speed)}


@dataclass(frozen=True)
class Reference:
    """Final poses that neither side made alone: the mean of both limits.

    Attributes:
        pose: (N, 7) position and quaternion.
        disagreement: (N,) m between the two limits: nothing below half of it can be said.
        convergence: (N,) m between each limit and its finest step, the larger of both.
        closed_form: m by which the reference differs from the closed form, where a motion has one.
    """

    pose: Array
    disagreement: Array
    convergence: Array
    closed_form: dict[str, float]

    def as_dict(self) -> dict[str, Any]:
        """Return what is said about it."""
        return {
            "disagreement": {"median": float(np.median(self.disagreement)), "max": float(self.disagreement.max())},
            "convergence": {"median": float(np.median(self.convergence)), "max": float(self.convergence.max())},
            "closed_form": self.closed_form,
        }


@dataclass(frozen=True)
class EngineReport:
    """What the measurement found."""

    reference: Reference
    results: list[EngineResult]

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        return {"reference": self.reference.as_dict(), "settings": [result.as_dict() for result in self.results]}


def settings(*, quick: bool = False) -> list[EngineSetting]:
    """Return every setting that is run."""
    if quick:
        return [_own(1e-3), _own(1e-3, "float32"), _peer(1e-3, KINDS[0])]
    sweeps = [(step, SWEEPS) for step in ENGINE_STEPS] + [(1e-3, 2), (4e-3, 2), (4e-3, 8)]
    engine = [_own(step, precision, count) for precision in ("float64", "float32") for step, count in sweeps]
    # MuJoCo's springs, not the step, make the error of its default contacts; at 10 ms matched springs are unstable.
    steps = {kind: MUJOCO_STEPS[:-1] if kind[1] in ("matched", "tuned") else MUJOCO_STEPS[2:] for kind in KINDS}
    peers = [_peer(step, kind) for kind in KINDS for step in steps[kind]]
    fewer = [_peer(step, kind, iterations=3) for kind in (KINDS[0], KINDS[2], KINDS[5]) for step in (1e-3, 4e-3)]
    rollouts = [_peer(1e-3, KINDS[0], call="rollout", threads=threads) for threads in (1, 2)]
    threads = [_own(1e-3, precision, threads=2) for precision in ("float64", "float32")]
    return [*engine, *peers, *fewer, _peer(1e-3, KINDS[2], iterations=1), *rollouts, *threads]


def _own(step: float, precision: str = "float64", sweeps: int = SWEEPS, threads: int = 1) -> EngineSetting:
    return EngineSetting("engine", step, precision, sweeps, "own", "elliptic", threads=threads)


def _peer(step: float, kind: Kind, **others: Any) -> EngineSetting:
    cone, contact, integrator = kind
    return EngineSetting("MuJoCo", step, contact=contact, cone=cone, integrator=integrator, **others)


def measure_engine(size: Size) -> EngineReport:
    """Return the reference and all settings: accuracy once, speed in rounds that take the settings in turn."""
    chosen = motions(load_robot(), size(TICKS, 2))
    reference = make_reference(chosen, *(((2e-3, 1e-3),) * 2 if size.quick else (ENGINE_LIMIT, MUJOCO_LIMIT)))
    runs = {setting: prepare(setting, chosen, size(COPIES, 1)) for setting in settings(quick=size.quick)}
    poses = {setting: run()[0] for setting, run in runs.items()}
    first = 1.0 / (1 + size.rounds)  # share of the work up to here: about a round
    size.tell(first)
    speeds = interleave(
        {setting: lambda run=run: run()[1] for setting, run in runs.items()},
        size.rounds,
        warm_up=False,
        tell=lambda share: size.tell(first + (1.0 - first) * share),
    )
    return EngineReport(reference, [_result(setting, poses[setting], reference, speeds[setting]) for setting in runs])


def _result(setting: EngineSetting, pose: Array, reference: Reference, speed: tuple[float, ...]) -> EngineResult:
    apart = distance(pose, reference.pose, _hip())
    return EngineResult(setting, float(np.sqrt(np.mean(apart**2))), float(apart.max()), is_upright(pose), speed)


def _hip() -> Array:
    return Parameters.nominal(load_robot())["hip.position"][0]


# ---- reference ----


def make_reference(
    chosen: list[BenchMotion], engine: tuple[float, float] = ENGINE_LIMIT, peer: tuple[float, float] = MUJOCO_LIMIT
) -> Reference:
    """Return the mean of the limits of both simulators; both are of first order in the step, which is halved once."""
    options = [PlantOptions(physics_step=step, sensor_noise=False) for step in (*engine, *peer)]
    coarse, fine = (_drive(GibbsAppellPlant(load_robot(), len(chosen), one, sweeps=8), chosen) for one in options[:2])
    limits = []
    for one in options[2:]:
        plant = MujocoPlant(load_robot(), len(chosen), one)
        # less virtual mass at the contacts, whose push off the floor grows as the step shrinks
        plant._batch.divide_virtual_mass(VIRTUAL_MASS_DIVISOR)
        limits.append(_drive(plant, chosen))
    peer_coarse, peer_fine = limits
    ours, theirs = _extrapolated(coarse, fine), _extrapolated(peer_coarse, peer_fine)
    hip, pose = _hip(), _unit(0.5 * (ours + theirs))
    convergence = np.maximum(distance(fine, ours, hip), distance(peer_fine, theirs, hip))
    _, state = start(load_robot(), chosen)
    travel = np.linalg.norm((pose[:, :3] - state.position)[:, :2], axis=1)
    closed = {
        motion.name: float(way - motion.distance)
        for motion, way in zip(chosen, travel, strict=True)
        if motion.distance is not None
    }
    return Reference(pose, distance(ours, theirs, hip), convergence, closed)


def _extrapolated(coarse: Array, fine: Array) -> Array:
    return _unit(2.0 * fine - coarse)


def _unit(pose: Array) -> Array:
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    return pose


def _drive(plant: Plant, chosen: list[BenchMotion]) -> Array:
    """Return the poses (N, 7) at the end of the motions."""
    parameters, state = start(load_robot(), chosen)
    plant.reset(parameters=parameters, state=state)
    for row in _setpoints(chosen):
        plant.step(row)
    return _pose(plant)


def _setpoints(chosen: list[BenchMotion]) -> Array:
    return np.stack([motion.setpoints for motion in chosen], axis=1)


def _pose(plant: Plant) -> Array:
    return np.hstack([plant.truth().position, plant.truth().quaternion])


# ---- settings ----

#: Simulates the motions; returns the poses (N, 7) at their end, and simulated seconds of a robot per second.
Run = Callable[[], tuple[Array, float]]


def prepare(setting: EngineSetting, chosen: list[BenchMotion], copies: int) -> Run:
    """Return what runs the motions in a setting; ``copies`` robots make each in the engine."""
    if setting.side == "engine":
        return _engine_run(setting, chosen, copies)
    return _rollout_run(setting, chosen) if setting.call == "rollout" else _batch_run(setting, chosen)


def _timed(work: Callable[[], object], simulated: float, threads: int) -> float:
    clock = time.process_time if threads == 1 else time.perf_counter
    begin = clock()
    work()
    return simulated / (clock() - begin)


def _engine_run(setting: EngineSetting, chosen: list[BenchMotion], copies: int) -> Run:
    many, robot = chosen * copies, load_robot()
    options = PlantOptions(physics_step=setting.step, precision=setting.precision, threads=setting.threads, sensor_noise=False)
    plant = GibbsAppellPlant(robot, len(many), options, sweeps=setting.iterations)
    parameters, state = start(robot, many)
    setpoints = _setpoints(many)

    def drive() -> None:
        for row in setpoints:
            plant.step(row)

    def run() -> tuple[Array, float]:
        plant.reset(parameters=parameters, state=state)
        speed = _timed(drive, len(many) * len(setpoints) * PERIOD, setting.threads)
        return _pose(plant)[: len(chosen)], speed

    return run


def _model(setting: EngineSetting) -> mujoco.MjModel:
    robot = load_robot()
    assert setting.contact != "own"
    model = build_servo_model(robot, Parameters.nominal(robot), setting.step, setting.contact)
    model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{setting.cone.upper()}")
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{setting.integrator.upper()}")
    model.opt.iterations = setting.iterations
    return model


def _batch_run(setting: EngineSetting, chosen: list[BenchMotion]) -> Run:
    parameters, state = start(load_robot(), chosen)
    batch, setpoints = ServoBatch(_model(setting), parameters, setting.threads), _setpoints(chosen)
    substeps = round(PERIOD / setting.step)

    def drive() -> None:
        for row in setpoints:
            batch.step(row, substeps)

    def run() -> tuple[Array, float]:
        batch.reset(state)
        speed = _timed(drive, len(chosen) * len(setpoints) * PERIOD, setting.threads)
        return batch.position[:, :7].copy(), speed

    return run


def _rollout_run(setting: EngineSetting, chosen: list[BenchMotion]) -> Run:
    parameters, state = start(load_robot(), chosen)
    models = [_model(setting) for _ in chosen]
    for model, friction in zip(models, parameters["ground.mu_x"], strict=True):
        model.pair_friction[:, :2] = friction[:, None]
    kind, data = mujoco.mjtState.mjSTATE_FULLPHYSICS, mujoco.MjData(models[0])
    initial = np.zeros((len(chosen), mujoco.mj_stateSize(models[0], kind)))
    for row, place, velocity in zip(initial, state.position, state.linear_velocity_in_body, strict=True):
        mujoco.mj_resetData(models[0], data)
        data.qpos[:3], data.qvel[:3] = place, velocity
        mujoco.mj_getState(models[0], data, row, kind)
    controls = np.repeat(servo_controls(_setpoints(chosen)).swapaxes(0, 1), round(PERIOD / setting.step), axis=1)
    workers = [mujoco.MjData(models[0]) for _ in range(setting.threads)]
    states = np.zeros((len(chosen), controls.shape[1], initial.shape[1]))
    sensed = np.zeros((len(chosen), controls.shape[1], models[0].nsensordata))

    def run() -> tuple[Array, float]:
        with mujoco.rollout.Rollout(nthread=setting.threads if setting.threads > 1 else 0) as pool:

            def drive() -> None:
                pool.rollout(models, workers, initial, controls, state=states, sensordata=sensed)

            speed = _timed(drive, len(chosen) * controls.shape[1] * setting.step, setting.threads)
        return states[:, -1, 1:8].copy(), speed

    return run
