"""Accuracy against speed of the engine and of MuJoCo: the same ten motions, many settings of both, one reference.

Says the ratios at equal error and at the defaults, as rows, as a table and as a picture.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from studies.bench.measure import Measurement, Size, interleave, rate, summary
from studies.bench.mujoco_loop import VIRTUAL_MASS_DIVISOR, Contact, ServoBatch, build_servo_model, servo_controls
from wlr_gym.base.plots import BLUE, GREEN, GREY, ORANGE, WINE, legend_below, new_figure, save, tidy
from wlr_gym.physics.model.dynamics import rotation_matrix
from wlr_gym.physics.plants.base import Plant, PlantOptions, PlantState, standing_state
from wlr_gym.physics.plants.gibbs_appell.plant import SWEEPS, GibbsAppellPlant
from wlr_gym.physics.plants.mujoco.plant import MujocoPlant
from wlr_gym.robot import CORNER_SIGNS, Robot, load_robot
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

#: Environment steps of a motion, and s of each.
TICKS, PERIOD = 100, PlantOptions().control_period
GRIP, ICE = 0.6, 0.15
#: s in which a setpoint moves to its next value: no jumps, so that no motor is at its voltage limit.
RAMP = 0.2


@dataclass(frozen=True)
class BenchMotion:
    """What one robot does on a level floor.

    Attributes:
        name: in words.
        friction: (4,) of the floor under each wheel.
        setpoints: (TICKS, 8) rad and rad/s.
        velocity: m/s of the body at the start, forward and to the left.
        distance: m to the end pose where a closed form says it (locked wheels, v^2/(2 mu g)), else None.
    """

    name: str
    friction: Array
    setpoints: Array
    velocity: tuple[float, float] = (0.0, 0.0)
    distance: float | None = None


def motions(robot: Robot, ticks: int = TICKS) -> list[BenchMotion]:
    """Return the ten motions, the same ones every time."""
    rng, still = np.random.default_rng(31), np.zeros(4)
    right = np.array([sign[1] < 0 for sign in CORNER_SIGNS])
    turn, arc = np.where(right, 4.0, -4.0), np.where(right, 5.0, 2.0)

    def drive(name: str, friction: Array | float, *wheels: Array, legs: bool = False) -> BenchMotion:
        speeds = np.array(wheels)
        angles = robot.home.leg_angle + rng.uniform(-0.3, 0.3, (len(wheels), 4)) * legs
        return BenchMotion(name, np.full(4, friction), ramps(np.hstack([angles, speeds]), robot.home.leg_angle, ticks))

    def slide(name: str, friction: float, velocity: tuple[float, float]) -> BenchMotion:
        distance = float(np.square(velocity).sum()) / (2.0 * friction * robot.gravity)
        return BenchMotion(name, np.full(4, friction), drive(name, friction, still).setpoints, velocity, distance)

    def commands(count: int = 5) -> list[Array]:
        return list(rng.uniform(-4.0, 5.0, (count, 4)))

    return [
        drive("wheel commands", GRIP, *commands()),
        drive("wheel and leg commands", GRIP, *commands(), legs=True),
        drive("skid turn", GRIP, turn),
        drive("arc", GRIP, arc),
        drive("braking", GRIP, np.full(4, 5.0), still),
        drive("wheel commands on a slippery floor", ICE, *commands()),
        drive("skid turn on a slippery floor", ICE, turn),
        drive("arc, one wheel on ice", np.array([GRIP, 0.05, GRIP, GRIP]), arc),
        slide("locked wheels slide forward", 0.07, (0.5, 0.0)),
        slide("locked wheels slide sideways", 0.3, (0.0, 0.8)),
    ]


def ramps(targets: Array, home: float, ticks: int) -> Array:
    """Return setpoints (ticks, 8) that reach each target in RAMP and hold it for an equal share of the time."""
    share = ticks * PERIOD / len(targets)
    starts = share * np.arange(len(targets))
    knots = np.stack([starts, starts + min(RAMP, 0.5 * share)], axis=1).ravel()
    before = np.vstack([np.r_[np.full(4, home), np.zeros(4)], targets[:-1]])
    values = np.stack([before, targets], axis=1).reshape(-1, 8)
    return np.stack([np.interp(PERIOD * np.arange(1, ticks + 1), knots, column) for column in values.T], axis=1)


def start(robot: Robot, chosen: list[BenchMotion]) -> tuple[Parameters, PlantState]:
    """Return parameters and start state of one robot per motion."""
    parameters = Parameters.nominal(robot, len(chosen))
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = np.array([motion.friction for motion in chosen])
    state = standing_state(robot, parameters)
    state.linear_velocity_in_body[:, :2] = [motion.velocity for motion in chosen]
    return parameters, state


def distance(first: Array, second: Array, hip: Array) -> Array:
    """Return how far apart two poses (N, 7: position, quaternion) put the robot: mean distance (N,) of its four hips, m."""
    corners = np.array([[x, y, 1.0] for x, y in CORNER_SIGNS]) * hip
    places = [pose[:, None, :3] + np.einsum("nij,kj->nki", rotation_matrix(pose[:, 3:7]), corners) for pose in (first, second)]
    return np.linalg.norm(places[0] - places[1], axis=2).mean(axis=1)


def is_upright(pose: Array) -> bool:
    """Whether every robot's pose (N, 7) is finite, within 20 degrees of level and at least 2 cm above the floor."""
    level = rotation_matrix(pose[:, 3:7])[:, 2, 2]
    return bool(np.isfinite(pose).all() and (level > np.cos(np.radians(20.0))).all() and (pose[:, 2] > 0.02).all())


# ---- settings and what came of them ----------------------------------------------------------------------------------


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

    def summary(self) -> dict[str, Any]:
        """Return what the report says of it."""
        limits = {"disagreement": self.disagreement, "convergence": self.convergence}
        said = {name: {"median": float(np.median(apart)), "max": float(apart.max())} for name, apart in limits.items()}
        return {"closed_form": self.closed_form, **said}


#: A setting in the report: its fields, and what came of it; plain JSON types.
Row = dict[str, Any]


def row_of(setting: EngineSetting, apart: Array, upright: bool, speed: Sequence[float]) -> Row:
    """Return a setting for the report; errors that are not finite as None.

    Args:
        setting: what was run.
        apart: (N,) m between reference and end of each motion, as of :func:`distance`.
        upright: whether all robots were, at the end.
        speed: simulated seconds of a robot per second, one value per round.
    """
    errors = {"error": float(np.sqrt(np.mean(apart**2))), "worst": float(apart.max())}
    row: Row = {**asdict(setting), "label": setting.label, "is_usual": setting.is_usual}
    row |= {name: value if np.isfinite(value) else None for name, value in errors.items()}
    return row | {"upright": upright, "speed": summary(speed)}


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


def measure_engine(size: Size) -> dict[str, Any]:
    """Return reference and all settings, as plain JSON types: accuracy once, speed in rounds that take the settings in turn."""
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
    rows = [
        row_of(setting, distance(pose, reference.pose, _hip()), is_upright(pose), speeds[setting])
        for setting, pose in poses.items()
    ]
    return {"reference": reference.summary(), "settings": rows}


def _hip() -> Array:
    return Parameters.nominal(load_robot())["hip.position"][0]


# ---- reference ----


def make_reference(
    chosen: list[BenchMotion], engine: tuple[float, float] = ENGINE_LIMIT, peer: tuple[float, float] = MUJOCO_LIMIT
) -> Reference:
    """Return the mean of the limits of both simulators; both are of first order in the step, which is halved once."""
    options = [PlantOptions(physics_step=step, sensor_noise=False) for step in (*engine, *peer)]
    plants: list[Plant] = [GibbsAppellPlant(load_robot(), len(chosen), one, sweeps=8) for one in options[:2]]
    for one in options[2:]:
        plant = MujocoPlant(load_robot(), len(chosen), one)
        # less virtual mass at the contacts, whose push off the floor grows as the step shrinks
        plant._batch.divide_virtual_mass(VIRTUAL_MASS_DIVISOR)
        plants.append(plant)
    coarse, fine, peer_coarse, peer_fine = (_drive(plant, chosen) for plant in plants)
    ours, theirs = _unit(2.0 * fine - coarse), _unit(2.0 * peer_fine - peer_coarse)
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


def _clock(threads: int) -> Callable[[], float]:
    """Processor time of one thread; of several the time that passes."""
    return time.process_time if threads == 1 else time.perf_counter


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
        speed = rate(drive, len(many) * len(setpoints) * PERIOD, _clock(setting.threads))
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
        speed = rate(drive, len(chosen) * len(setpoints) * PERIOD, _clock(setting.threads))
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

            speed = rate(drive, len(chosen) * controls.shape[1] * setting.step, _clock(setting.threads))
        return states[:, -1, 1:8].copy(), speed

    return run


# ---- report: ratios, table, picture ----------------------------------------------------------------------------------


#: m: errors at which the fastest setting of each side is compared. The first two
#: are met where the contacts are nearly those of Coulomb, the last by MuJoCo's default contact.
LEVELS = (1e-4, 5e-4, 2e-3, 2.5e-2)
#: m: up to this error MuJoCo's setting counts as comparable.
COMPARABLE = 1e-3
COMPARABLE_BARS = {"float64": 50.0, "float32": 100.0}
UNIT = "x real time"
AT_DEFAULTS = "both at 1 ms, MuJoCo's defaults"
#: What is compared at 1 ms: in words, how MuJoCo is called, threads, bars.
STANDARD = ((AT_DEFAULTS, "step", 1, {"float64": 30.0, "float32": 60.0}), ("both at 1 ms, 2 threads", "rollout", 2, {}))


def level_name(level: float) -> str:
    """Return what a level is called."""
    return f"error at most {1e3 * level:g} mm"


def pairs(rows: Sequence[Row]) -> list[Measurement]:
    """Return the ratios of speed: at equal error, at MuJoCo's defaults and equal step, and with two threads."""
    found: list[Measurement] = []
    for precision in ("float64", "float32"):
        ours = [one for one in rows if one["side"] == "engine" and one["precision"] == precision]
        peers = [one for one in rows if one["side"] == "MuJoCo"]
        for level in LEVELS:
            bar = COMPARABLE_BARS[precision] if level < COMPARABLE else None
            found += _pair(f"{precision}, {level_name(level)}", _fastest(ours, level), _fastest(peers, level), bar)
        for what, call, threads, bar in STANDARD:
            standard = _standard(ours, "step", threads), _standard(peers, call, threads)
            found += _pair(f"{precision}, {what}", *standard, bar.get(precision))
    return found


def _pair(what: str, ours: Row | None, peer: Row | None, bar: float | None) -> list[Measurement]:
    if ours is None or peer is None:
        return []
    text = f"{what}: {ours['label']} ({_millimetres(ours['error'])})"
    name = f"MuJoCo {peer['label']} ({_millimetres(peer['error'])})"
    speed, other = (tuple(one["speed"]["values"]) for one in (ours, peer))
    return [Measurement("engine", text, UNIT, speed, other, name, bar)]


def _fastest(rows: Iterable[Row], level: float) -> Row | None:
    """Return the fastest on one thread that stays upright with an error of at most ``level``."""
    fit = [one for one in rows if one["upright"] and one["threads"] == 1 and one["error"] <= level]
    return max(fit, key=lambda one: one["speed"]["median"], default=None)


def _standard(rows: Iterable[Row], call: str, threads: int) -> Row | None:
    """Return the setting of 1 ms with everything else at its default."""
    for one in rows:
        usual = one["is_usual"] and (one["side"] == "engine" or (one["cone"], one["contact"], one["integrator"]) == KINDS[0])
        if usual and (one["step"], one["call"], one["threads"]) == (1e-3, call, threads):
            return one
    return None


def _millimetres(value: float | None) -> str:
    return "lost" if value is None else f"{1e3 * value:.3g} mm" if value < 0.1 else f"{1e3 * value:.0f} mm"


def reference_text(report: dict[str, Any]) -> str:
    """Return what the errors are against, and how far that is known; ``report`` is that of :func:`measure_engine`."""
    reference = report["reference"]
    apart, rest = reference["disagreement"], reference["convergence"]
    closed = "; ".join(f"{name}: {1e3 * value:+.2f} mm" for name, value in reference["closed_form"].items())
    return (
        f"The limits of both simulators differ by {1e6 * apart['median']:.2g} µm (median) and {1e6 * apart['max']:.2g} µm "
        f"(largest) and lie {1e6 * rest['max']:.2g} µm at most beyond the finest step. Distance driven, reference minus the "
        f"closed form of a rigid robot: {closed}. Not measured, for want of a GPU: MuJoCo Warp, MJX, Isaac Sim, Genesis."
    )


def settings_table(report: dict[str, Any]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and rows: error and speed of every setting; ``report`` as for :func:`reference_text`."""
    rows = []
    for one in report["settings"]:
        errors = [_millimetres(one[key]) if one["upright"] else "falls" for key in ("error", "worst")]
        speed = "{median:.4g} [{min:.4g}..{max:.4g}]".format(**one["speed"])
        rows.append((one["side"], one["label"], one["precision"], *errors, speed))
    return ("side", "setting", "precision", "error, rms", "worst", "x real time"), rows


_ERROR = "rms error: mean distance of the four hips from the reference after a motion of 2 s, rms over ten motions (mm)"
_HOW_TO_READ = "Numbers: step in ms. Crosses: another number of passes (p; usual: 4) or iterations (i; usual: 100)"
#: Colour of an engine's precision and of a contact of MuJoCo.
_COLOURS = {"float64": BLUE, "float32": ORANGE, "default": "black", "stiff friction": GREY, "matched": WINE, "tuned": GREEN}


def save_picture(report: dict[str, Any], path: Path) -> None:
    """Write error against speed of every setting on one thread as a PNG; ``report`` as for :func:`reference_text`."""
    figure = new_figure(9.5, 6.6)
    axes = figure.subplots()
    axes.set(xscale="log", yscale="log", xlabel=_ERROR)
    axes.set_ylabel("simulated seconds of a robot per second of one core")
    shown = [one for one in report["settings"] if one["upright"] and one["threads"] == 1 and one["call"] == "step"]
    for precision in ("float64", "float32"):
        rows = [one for one in shown if one["side"] == "engine" and one["precision"] == precision]
        _draw(axes, rows, f"engine, {precision}", _COLOURS[precision], "o")
    drawn: set[str] = set()
    for cone, contact, integrator in KINDS:
        kind = {"side": "MuJoCo", "cone": cone, "contact": contact, "integrator": integrator}
        rows = [one for one in shown if all(one[name] == value for name, value in kind.items())]
        label = f"MuJoCo: {contact}, {cone}, {integrator}"
        _draw(axes, rows, label, _COLOURS[contact], "s", is_second=contact in drawn)
        drawn.add(contact)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
    _draw_pair(axes, shown)
    axes.set_title(_HOW_TO_READ, fontsize=9, loc="left")
    tidy(axes)
    legend_below(figure, columns=3)
    save(figure, path)


def _point(one: dict[str, Any]) -> tuple[float, float]:
    return 1e3 * one["error"], one["speed"]["median"]


def _draw(axes: Axes, rows: list[dict[str, Any]], label: str, colour: str, marker: str, *, is_second: bool = False) -> None:
    """Draw a curve over the step, and crosses for settings with another number of passes or iterations, with their numbers.

    The second curve of one colour is dashed with open markers. Its steps are those of the first and carry no numbers.
    """
    line: dict[str, Any] = {"marker": marker, "label": label}
    if is_second:
        line |= {"linestyle": "--", "markerfacecolor": "white"}
    crosses: dict[str, Any] = {"marker": "x", "linestyle": "none"}
    for usual, style in ((True, line), (False, crosses)):
        chosen = [one for one in rows if one["is_usual"] == usual]
        if chosen:
            axes.plot(*zip(*map(_point, chosen), strict=True), color=colour, markersize=5, linewidth=1.2, **style)
        for one in chosen if not (is_second and usual) else ():
            text = f"{1e3 * one['step']:g}"
            if not usual:
                text += f", {one['iterations']}{'p' if one['side'] == 'engine' else 'i'}"
            axes.annotate(text, _point(one), (6, -3), textcoords="offset points", fontsize=7.5, color=colour, va="center")


def _draw_pair(axes: Axes, shown: Sequence[dict[str, Any]]) -> None:
    """Ring the fastest float64 setting of each side within the smallest level, and say how much faster the engine is."""
    fit = [one for one in shown if one["precision"] == "float64" and one["error"] <= LEVELS[0]]
    sides = [[one for one in fit if one["side"] == side] for side in ("engine", "MuJoCo")]
    if not all(sides):
        return
    ours, peer = (max(rows, key=lambda one: one["speed"]["median"]) for rows in sides)
    ratio = np.median(np.divide(ours["speed"]["values"], peer["speed"]["values"]))
    for one in (ours, peer):
        axes.plot(*_point(one), "o", markersize=11, markerfacecolor="none", markeredgecolor="black")
    ends = {"arrowstyle": "<->", "shrinkA": 9, "shrinkB": 9}
    axes.annotate("", _point(ours), _point(peer), arrowprops=ends)
    text = f"rings: {level_name(LEVELS[0])}\n{ratio:.0f} times as fast\n\nengine: {ours['label']}\nMuJoCo: {peer['label']}"
    middle = 1e3 * peer["error"], float(np.sqrt(ours["speed"]["median"] * peer["speed"]["median"]))
    axes.annotate(text, middle, (8, 0), textcoords="offset points", va="center", fontsize=9)
