"""Compare two plants: same setpoints, same parameters, same start; where and when do they diverge, and by how much?

Differences are given in units of what the robot's own sensors resolve (:func:`resolutions`), so that a difference below one
could not be measured on the robot at all. With ``halve`` everything is repeated at half the physics step: a difference that
comes from the steps shrinks with them, and each plant's own step error tells whose it is; what stays is a difference between
the models.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name, check_number, unknown_name
from wlr_gym.base.plots import BLUE, GREEN, ORANGE, new_figure, save, text_colour, tidy
from wlr_gym.data.excitations import CONTROL_PERIOD, SETTLE, Motion
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.run_states import euler_angles, standing_at
from wlr_gym.data.sensors import channel_noise
from wlr_gym.physics.effects import EFFECTS, Patch, apply_patch, load_patch
from wlr_gym.physics.effects.patch import Source
from wlr_gym.physics.floor import FloorSource, lay_floor, load_floor
from wlr_gym.physics.plants import check_simulator, make_plant
from wlr_gym.physics.plants.base import PlantOptions, Sensors, Truth
from wlr_gym.robot import CORNER_SIGNS, LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS, Robot, load_robot
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ComparedSignal:
    """One compared signal.

    Attributes:
        unit: SI.
        resolution: what the robot's sensors resolve of it, in ``unit``.
        turns: an angle that may jump by a whole turn.
        shared: how wheels that all stick share a load, which rigid bodies leave open: each plant has an answer of its own,
            and it moves nothing. Their total force and moment are not open.
    """

    unit: str
    resolution: float
    turns: bool = False
    shared: bool = False


def _force(truth: Truth, axis: int) -> Array:
    """Of the floor on each wheel (rows, 4), N: along its heading (0), along its axle (1), normal (2)."""
    return truth.contact_force.reshape(-1, 4, 3)[:, :, axis]


def _friction_moment(truth: Truth, robot: Robot) -> Array:
    """Of all wheels about the body's vertical (rows,), N m."""
    signs, hip = np.array(CORNER_SIGNS), robot.hip_position
    x = signs[:, 0] * hip.x + robot.leg.length * np.cos(truth.joint_position[:, LEG_SLICE])
    return (x * _force(truth, 1) - signs[:, 1] * hip.y * _force(truth, 0)).sum(axis=1)


#: Signal -> SI unit, the noise that it is resolved to (a channel's, or one of :func:`resolutions`' own), and its values.
_SIGNALS: dict[str, tuple[str, str, Callable[[Sensors, Truth, Robot], Array]]] = {
    "pos_leg": ("rad", "pos_leg_lf", lambda s, t, robot: s.joint_position[:, LEG_SLICE]),
    "pos_wheel": ("rad", "pos_wheel_lf", lambda s, t, robot: s.joint_position[:, WHEEL_SLICE]),
    "vel_leg": ("rad/s", "vel_leg_lf", lambda s, t, robot: s.joint_velocity[:, LEG_SLICE]),
    "vel_wheel": ("rad/s", "vel_wheel_lf", lambda s, t, robot: s.joint_velocity[:, WHEEL_SLICE]),
    "eff_leg": ("N m", "eff_leg_lf", lambda s, t, robot: s.joint_effort[:, LEG_SLICE]),
    "eff_wheel": ("N m", "eff_wheel_lf", lambda s, t, robot: s.joint_effort[:, WHEEL_SLICE]),
    "gyro": ("rad/s", "gyro_x", lambda s, t, robot: s.gyro),
    "acc": ("m/s2", "acc_x", lambda s, t, robot: s.accelerometer),
    "cam_xy": ("m", "cam_x", lambda s, t, robot: s.camera_pose[:, :2]),
    "cam_yaw": ("rad", "cam_yaw", lambda s, t, robot: s.camera_pose[:, 2]),
    "volt": ("V", "volt", lambda s, t, robot: s.supply_voltage),
    "true_xy": ("m", "cam_x", lambda s, t, robot: t.position[:, :2]),
    "true_z": ("m", "cam_z", lambda s, t, robot: t.position[:, 2]),
    "true_yaw": ("rad", "cam_yaw", lambda s, t, robot: euler_angles(t.quaternion)[0]),
    "true_tilt": ("rad", "cam_pitch", lambda s, t, robot: np.stack(euler_angles(t.quaternion)[1:], axis=1)),
    "motor_torque_leg": ("N m", "eff_leg_lf", lambda s, t, robot: t.motor_torque[:, LEG_SLICE]),
    "motor_torque_wheel": ("N m", "eff_wheel_lf", lambda s, t, robot: t.motor_torque[:, WHEEL_SLICE]),
    "normal_force": ("N", "load", lambda s, t, robot: _force(t, 2)),
    "total_along": ("N", "tread", lambda s, t, robot: _force(t, 0).sum(axis=1)),
    "total_across": ("N", "tread", lambda s, t, robot: _force(t, 1).sum(axis=1)),
    "total_turn": ("N m", "turn", lambda s, t, robot: _friction_moment(t, robot)),
    "friction_along": ("N", "tread", lambda s, t, robot: _force(t, 0)),
    "friction_across": ("N", "tread", lambda s, t, robot: _force(t, 1)),
    "slip_along": ("m/s", "slip", lambda s, t, robot: t.slip_velocity[:, 0::2]),
    "slip_across": ("m/s", "slip", lambda s, t, robot: t.slip_velocity[:, 1::2]),
}
_TURNS, _SHARED = ("cam_yaw", "true_yaw"), ("friction_along", "friction_across")


def resolutions(robot: Robot) -> dict[str, ComparedSignal]:
    """Return every compared signal with what the robot's sensors resolve of it: one sigma of noise and rounding.

    What no sensor measures directly is given what follows from one that does: forces along the floor from a wheel's effort
    over its radius, slip from its velocity reading times the radius, normal forces from the accelerometer times the mass.
    """
    noise = channel_noise(robot)
    tread = noise["eff_wheel_lf"] / robot.wheel.radius
    noise |= {
        "tread": tread, "turn": tread * robot.hip_position.y, "load": robot.total_mass * noise["acc_z"],
        "slip": noise["vel_wheel_lf"] * robot.wheel.radius,
    }  # fmt: skip
    return {
        name: ComparedSignal(unit, noise[kind], name in _TURNS, name in _SHARED) for name, (unit, kind, _) in _SIGNALS.items()
    }


# ---- plants, and what each of them does on the same motions ----------------------------------------------------------


@dataclass(frozen=True)
class ComparedPlant:
    """A plant and the numerical options it is run with.

    Attributes:
        backend: of :data:`wlr_gym.physics.plants.SIMULATORS`.
        physics_step: s.
        precision: ``float64`` or ``float32``.
    """

    backend: str
    physics_step: float = 0.001
    precision: str = "float64"

    @property
    def label(self) -> str:
        """Short name, with what is not usual: ``gibbs_appell, 0.5 ms``."""
        precision = "" if self.precision == "float64" else f", {self.precision}"
        return f"{self.backend}, {1e3 * self.physics_step:g} ms{precision}"

    @property
    def halved(self) -> ComparedPlant:
        """The same at half the step."""
        return replace(self, physics_step=0.5 * self.physics_step)


def parse_plant(text: str, physics_step: float = 0.001) -> ComparedPlant:
    """Read ``BACKEND`` or ``BACKEND:option=value,...`` with the options ``physics_step`` (s) and ``precision``."""
    backend, _, options = text.partition(":")
    check_simulator(backend, f"plant '{text}'")  # a real robot has no truth to compare, nor the guards of wlr record here
    plant = ComparedPlant(backend, physics_step)
    for option in filter(None, options.split(",")):
        name, _, value = option.partition("=")
        if name == "physics_step":
            try:
                plant = replace(plant, physics_step=float(value))
            except ValueError:
                raise InputError(f"plant '{text}': physics_step = {value!r}: expected a number of seconds") from None
        elif name == "precision":
            plant = replace(plant, precision=value)
        else:
            raise unknown_name("option", name, ("physics_step", "precision"), f"plant '{text}'")
    check_name("precision", plant.precision, ("float64", "float32"), f"plant '{text}'")
    PlantOptions(control_period=CONTROL_PERIOD, physics_step=plant.physics_step)
    return plant


@dataclass(frozen=True, eq=False)
class Traces:
    """What one plant did: one row per control step from time 0 on, first axis ticks + 1, second axis motions.

    Attributes:
        plant, robot: the plant, and which robot.
        sensors: (ticks + 1, motions, SENSOR_LAYOUT.width) without noise. truth: likewise, TRUTH_LAYOUT.width.
    """

    plant: ComparedPlant
    robot: Robot
    sensors: Array
    truth: Array

    @cached_property
    def signals(self) -> dict[str, Array]:
        """Every signal of :func:`wlr_gym.data.comparison.resolutions`, each (ticks + 1, motions, elements)."""
        shape = self.sensors.shape[:2]
        sensors = Sensors(self.sensors.reshape(-1, self.sensors.shape[2]))
        truth = Truth(self.truth.reshape(-1, self.truth.shape[2]))
        return {name: values(sensors, truth, self.robot).reshape(*shape, -1) for name, (_, _, values) in _SIGNALS.items()}


def drive(
    plant: ComparedPlant,
    motions: Sequence[Motion],
    robot: Robot,
    parameters: Parameters | None = None,
    patch: Patch | None = None,
    threads: int = 1,
    tell: Callable[[float], None] = lambda share: None,
) -> Traces:
    """Drive all motions on one plant, one robot of a batch each; a shorter motion stays at its last setpoints.

    Args:
        plant: the plant.
        motions: of one period.
        robot: the robot.
        parameters: (1) physical parameters; None = nominal. Each motion's servo profile is written into them.
        patch: effects to add.
        threads: of the plant.
        tell: called with the share that is done.
    """
    import pandas

    patch = patch or Patch()
    one = Parameters.nominal(robot) if parameters is None else parameters
    rows = [apply_patch(patch, profile_parameters(one, motion.profile)).values for motion in motions]
    batch, count = Parameters(np.concatenate(rows)), len(motions)
    ticks = max(len(motion.setpoints) for motion in motions)
    goals = np.stack([np.pad(one.setpoints, ((0, ticks - len(one.setpoints)), (0, 0)), mode="edge") for one in motions], axis=1)
    torque_on = np.isfinite(goals)
    held = pandas.DataFrame(goals.reshape(ticks, -1)).ffill()  # a motor that is off keeps its last setpoint
    held = held.fillna(pandas.Series(np.tile(np.repeat([np.pi / 2, 0.0], 4), count)))
    setpoints = held.to_numpy().reshape(ticks, count, 8)
    options = PlantOptions(motions[0].period, plant.physics_step, plant.precision, threads, sensor_noise=False)
    sensors, truth = [], []
    with closing(make_plant(plant.backend, robot, count, options, patch.forces)) as simulator:
        readings = simulator.reset(np.arange(count, dtype=np.uint64), batch, state=standing_at(setpoints[0], robot, batch))
        for _ in range(round(SETTLE / motions[0].period)):
            readings = simulator.step(setpoints[0], torque_on[0])
        for tick in range(ticks + 1):
            sensors.append(readings.values.copy())
            truth.append(simulator.truth().values.copy())
            if tick % 50 == 0:
                tell(tick / ticks)
            if tick < ticks:
                readings = simulator.step(setpoints[tick], torque_on[tick])
    return Traces(plant, robot, np.array(sensors), np.array(truth))


# ---- their differences -----------------------------------------------------------------------------------------------


#: s; the pose is compared after this long (or at the end of a shorter motion).
HORIZON = 10.0
#: Target of the agreement of two plants: distance of the poses at the horizon over the travel (-), yaw (rad), rms torque (-).
BOUNDS = {"position": 0.02, "yaw": float(np.deg2rad(2.0)), "leg_torque": 0.05, "wheel_torque": 0.05}


@dataclass(frozen=True)
class Difference:
    """How far two plants are apart in one signal of one motion: over all its elements, and over time.

    Attributes:
        rms, largest: in ``unit``. resolution: one sensor's, in ``unit``.
        parted: s; when it first exceeded the threshold; None = never.
    """

    rms: float
    largest: float
    unit: str
    resolution: float
    parted: float | None

    @property
    def rms_in_noise(self) -> float:
        """Root mean square in units of the resolution."""
        return self.rms / self.resolution


@dataclass(frozen=True)
class Agreement:
    """The figures that :data:`BOUNDS` bounds.

    Attributes:
        travel: m; path of the body origin up to the horizon. apart: m; distance of the positions there.
        position: apart over travel, or over one noise unit where the robot hardly moves. yaw: rad.
        leg_torque, wheel_torque: rms difference of the motors' torques over their own rms, or over the nominal dry friction of
            their gears where they stay below it: motors that hardly work have nothing to agree on.
    """

    travel: float
    apart: float
    position: float
    yaw: float
    leg_torque: float
    wheel_torque: float

    @property
    def broken(self) -> tuple[str, ...]:
        """Names of the bounds that are not kept."""
        return tuple(name for name, bound in BOUNDS.items() if not getattr(self, name) <= bound)


@dataclass(frozen=True)
class MotionComparison:
    """One motion on two plants.

    Attributes:
        motion: its name. agreement: the figures that are bounded. differences: by signal.
        first: the signal that diverges first, of those that are not open, and when, s; None where none does.
    """

    motion: str
    agreement: Agreement
    differences: Mapping[str, Difference]
    first: tuple[str, float] | None

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        sizes = {
            name: {**vars(one), "rms_in_noise_units": one.rms_in_noise, "largest_in_noise_units": one.largest / one.resolution}
            for name, one in self.differences.items()
        }
        agreement = {**vars(self.agreement), "broken": list(self.agreement.broken)}
        return {"motion": self.motion, "agreement": agreement, "parts_first_in": self.first, "differences": sizes}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two plants on a set of motions under one patch.

    Attributes:
        effects: what was added. threshold: in units of resolution, for ``parted``.
        motions, first, second: setpoints and traces. cases: one per motion. signals: what was compared.
        half: cases at half of both steps. own: each plant against itself at half its step. None without ``halve``.
    """

    effects: str
    threshold: float
    motions: tuple[Motion, ...]
    first: Traces
    second: Traces
    cases: tuple[MotionComparison, ...]
    signals: Mapping[str, ComparedSignal]
    half: tuple[MotionComparison, ...] | None = None
    own: tuple[tuple[MotionComparison, ...], tuple[MotionComparison, ...]] | None = None

    @property
    def labels(self) -> tuple[str, str]:
        """Of both plants."""
        return self.first.plant.label, self.second.plant.label

    @property
    def broken(self) -> bool:
        """Whether any motion breaks a bound; at half the steps where that was run."""
        return any(case.agreement.broken for case in self.half or self.cases)

    def as_dict(self) -> dict[str, Any]:
        """Return plain JSON types."""
        content: dict[str, Any] = {
            "effects": self.effects, "plants": [vars(traces.plant) for traces in (self.first, self.second)],
            "threshold": self.threshold, "cases": [case.as_dict() for case in self.cases],
        }  # fmt: skip
        if self.half and self.own:
            content["half_step"] = [case.as_dict() for case in self.half]
            content["own_step_error"] = [[case.as_dict() for case in cases] for cases in self.own]
        return content


def compare(
    motions: Sequence[Motion],
    plants: tuple[ComparedPlant, ComparedPlant],
    robot: Robot | None = None,
    parameters: Parameters | None = None,
    effects: Source = None,
    threshold: float = 5.0,
    halve: bool = False,
    threads: int = 1,
    tell: Callable[[str, float], None] = lambda doing, share: None,
    floor: FloorSource = None,
) -> Comparison:
    """Drive the same motions on two plants and compare all they show.

    Args:
        motions: what to drive (:func:`wlr_gym.data.excitations.excite`, :func:`wlr_gym.data.record.motion_of`), all of one
            period.
        plants: the two.
        robot: None = nominal.
        parameters: (1) physical parameters; None = the robot's nominal ones.
        effects: patch to add.
        threshold: two signals have diverged when they differ by more than this many units of resolution.
        halve: repeat at half of both steps.
        threads: of each plant.
        tell: called with what is being done and the share that is done.
        floor: that both drive on, as ``floor=`` of an environment; what of it is drawn, is drawn by seed 0.

    Raises:
        InputError: no motions or of different periods, a threshold that is not positive, an unknown effect.
    """
    if not motions:
        raise InputError("nothing to compare: expected at least one motion")
    if len({motion.period for motion in motions}) > 1:
        raise InputError("the motions have different periods; expected one")
    check_number("threshold", threshold, "units of sensor noise", above=0.0)
    robot, patch = robot or load_robot(), load_patch(effects)
    signals = resolutions(robot)
    parameters = Parameters.nominal(robot) if parameters is None else parameters
    parameters = lay_floor(load_floor(floor, robot).drawn(), parameters)

    driven = [*plants, *(plant.halved for plant in plants if halve)]

    def traces(k: int) -> Traces:
        def told(share: float) -> None:
            tell(f"driving {driven[k].label}", (k + share) / len(driven))

        return drive(driven[k], motions, robot, parameters, patch, threads, told)

    def between(a: Traces, b: Traces) -> tuple[MotionComparison, ...]:
        return tuple(_case(motion, k, a, b, signals, robot, threshold) for k, motion in enumerate(motions))

    first, second, *halves = map(traces, range(len(driven)))
    cases = between(first, second)
    half, own = None, None
    if halve:
        half, own = between(*halves), (between(first, halves[0]), between(second, halves[1]))
    return Comparison(patch.summary(), threshold, tuple(motions), first, second, cases, signals, half, own)


def difference(first: Traces, second: Traces, name: str, signal: ComparedSignal, motion: Motion, index: int) -> Array:
    """Return second minus first of one signal over one motion, (ticks + 1, elements)."""
    a, b = (traces.signals[name][: len(motion.setpoints) + 1, index] for traces in (first, second))
    return np.angle(np.exp(1j * (b - a))) if signal.turns else b - a


def _case(
    motion: Motion, k: int, a: Traces, b: Traces, signals: Mapping[str, ComparedSignal], robot: Robot, threshold: float
) -> MotionComparison:
    errors = {name: difference(a, b, name, signal, motion, k) for name, signal in signals.items()}
    differences = {}
    for name, signal in signals.items():
        size = np.abs(errors[name])
        beyond = (size > threshold * signal.resolution).any(axis=1)
        parted = float(np.argmax(beyond) * motion.period) if beyond.any() else None
        differences[name] = Difference(_rms(size), float(size.max()), signal.unit, signal.resolution, parted)
    parted = [(one.parted, name) for name, one in differences.items() if one.parted is not None and not signals[name].shared]
    rows = len(motion.setpoints) + 1
    horizon = min(round(HORIZON / motion.period), rows - 1)
    path = a.signals["true_xy"][: horizon + 1, k]
    travel = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    apart = float(np.linalg.norm(b.signals["true_xy"][horizon, k] - path[-1]))
    yaw = float(np.abs(errors["true_yaw"][horizon, 0]))
    torques = []
    for kind in ("leg", "wheel"):
        error, own = _rms(errors[f"motor_torque_{kind}"]), _rms(a.signals[f"motor_torque_{kind}"][:rows, k])
        beside = max(own, getattr(robot.servo, kind).coulomb_friction)
        torques.append(error / beside if beside > 0.0 else 0.0 if error == 0.0 else float("inf"))
    agreement = Agreement(travel, apart, apart / max(travel, signals["true_xy"].resolution), yaw, *torques)
    return MotionComparison(motion.name, agreement, differences, min(parted)[::-1] if parted else None)


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def severe_patch(name: str) -> Patch:
    """Return one effect of the library at its default severity; of joints and wheels it acts on one of each kind.

    Which: the right front leg, the left rear wheel: nothing a symmetric mistake could hide behind.

    Raises:
        InputError: no such effect.
    """
    check_name("effect", name, EFFECTS)
    effect = EFFECTS[name]
    chosen = [place for place in effect.where if place in (LEGS[1], WHEELS[2])]
    values = {parameter: spec.severity for parameter, spec in effect.parameters.items()}
    return load_patch({"name": name, "where": chosen or list(effect.where), "parameters": values})


# ---- report: tables for screen and Markdown --------------------------------------------------------------------------


@dataclass(frozen=True)
class ReportTable:
    """A table of strings: title, headings, rows; the first column holds names."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def markdown(self) -> str:
        """Return it as Markdown."""
        lines = [self.headings, tuple("---" if k == 0 else "--:" for k in range(len(self.headings))), *self.rows]
        return "\n".join([f"**{self.title}**", "", *(f"| {' | '.join(line)} |" for line in lines)])


def tables(comparison: Comparison) -> list[ReportTable]:
    """Return the tables of one comparison: agreement, differences by signal, and what becomes of them at half the steps."""

    def sizes(cases: Sequence[MotionComparison], name: str) -> list[float]:
        return [case.differences[name].rms_in_noise for case in cases]

    first, second = comparison.labels
    found = [_agreement_table(f"Agreement, {second} against {first}; effects: {comparison.effects}", comparison.cases)]
    if comparison.half:
        found.append(_agreement_table("The same at half of both steps", comparison.half))
    title = "Rms difference in units of sensor noise; *: how wheels that stick share a load is open"
    headings, rows = ("signal", "unit", "noise", *(case.motion for case in comparison.cases)), []
    for name, signal in comparison.signals.items():
        cells = map(_noise, sizes(comparison.cases, name))
        rows.append((_starred(comparison, name), signal.unit, f"{signal.resolution:.2g}", *cells))
    found.append(ReportTable(title, headings, tuple(rows)))
    if comparison.half and comparison.own:
        title = "Does it shrink with the step? All motions, rms in units of sensor noise"
        headings, rows = ("signal", "apart", "at half the steps", *(f"own step of {one}" for one in comparison.labels)), []
        for name in comparison.signals:
            sets = (sizes(cases, name) for cases in (comparison.cases, comparison.half, *comparison.own))
            rows.append((_starred(comparison, name), *(_noise(_rms(np.array(one))) for one in sets)))
        found.append(ReportTable(title, headings, tuple(rows)))
    return found


def _agreement_table(title: str, cases: Sequence[MotionComparison]) -> ReportTable:
    """Return the figures that :data:`BOUNDS` bounds, one row per case; ``!`` marks a broken bound."""
    headings = (
        "motion", "travel m", f"apart after {HORIZON:g} s mm", "% of travel", "yaw deg", "leg torque %", "wheel torque %",
        "diverges first in", "at s",
    )  # fmt: skip
    rows = []
    for case in cases:
        found, (first, time) = case.agreement, case.first or ("never", None)
        figures = _figures({bound: getattr(found, bound) for bound in BOUNDS})
        at = "-" if time is None else f"{time:.2f}"
        rows.append((case.motion, f"{found.travel:.2f}", f"{1e3 * found.apart:.2f}", *figures, first, at))
    return ReportTable(title, headings, tuple(rows))


def summary_table(comparisons: Sequence[Comparison]) -> ReportTable:
    """Return one row per comparison: its worst figures over all motions, and the motions that break a bound."""
    headings = (
        "effects", "apart mm", "% of travel", "yaw deg", "leg torque %", "wheel torque %", "largest signal", "broken by"
    )  # fmt: skip
    rows = []
    for comparison in comparisons:
        cases = comparison.half or comparison.cases
        worst = {name: max(getattr(case.agreement, name) for case in cases) for name in ("apart", *BOUNDS)}
        signals = [name for name, signal in comparison.signals.items() if not signal.shared]
        size, signal = max((case.differences[name].rms_in_noise, name) for case in cases for name in signals)
        broken = ", ".join(case.motion for case in cases if case.agreement.broken) or "-"
        figures = _figures(worst)
        rows.append((comparison.effects, f"{1e3 * worst['apart']:.2f}", *figures, f"{signal} {_noise(size)}", broken))
    step = " at half of both steps" if comparisons[0].half else ""
    return ReportTable(f"Worst of all motions{step}", headings, tuple(rows))


def _figures(values: dict[str, float]) -> tuple[str, ...]:
    scale = {"position": 100.0, "yaw": 180 / np.pi, "leg_torque": 100.0, "wheel_torque": 100.0}
    return tuple(f"{scale[name] * values[name]:.2f}{'' if values[name] <= bound else ' !'}" for name, bound in BOUNDS.items())


def _starred(comparison: Comparison, name: str) -> str:
    """Name of a signal; with a star where rigid bodies do not determine it."""
    return f"{name} *" if comparison.signals[name].shared else name


def _noise(value: float) -> str:
    return f"{value:.2f}" if value < 10.0 else f"{value:.0f}"


def markdown(comparisons: Sequence[Comparison], heading: str) -> str:
    """Return the whole report."""
    parts = [f"# {heading}", "How to read this: docs/compare.md."]
    if len(comparisons) > 1:
        parts.append(summary_table(comparisons).markdown())
    for comparison in comparisons:
        parts += [f"## Effects: {comparison.effects}", *(table.markdown() for table in tables(comparison))]
    return "\n\n".join(parts) + "\n"


# ---- figures ---------------------------------------------------------------------------------------------------------


#: Panels of a motion's figure: signals drawn together.
_PANELS = (
    ("true_xy",), ("true_yaw", "true_tilt"), ("pos_leg",), ("vel_wheel",), ("motor_torque_leg",), ("motor_torque_wheel",),
    ("normal_force",), ("total_along", "total_across"), ("total_turn",), ("slip_along", "slip_across"), ("gyro",),
    ("friction_across",),
)  # fmt: skip


def save_motion_plot(comparison: Comparison, index: int, path: Path) -> Path:
    """Write one motion's figure: both plants over each other, and below each panel their difference in noise units."""
    columns = 3
    rows = -(-len(_PANELS) // columns)
    figure = new_figure(6.0 * columns, 3.3 * rows)
    outer = figure.add_gridspec(rows, columns)
    for number, names in enumerate(_PANELS):
        inner = outer[number // columns, number % columns].subgridspec(2, 1, height_ratios=(2, 1), hspace=0.05)
        above = figure.add_subplot(inner[0])
        below = figure.add_subplot(inner[1], sharex=above)
        _draw_panel(comparison, index, names, above, below)
        if number >= len(_PANELS) - columns:
            below.set_xlabel("time (s)", fontsize=9)
    handles = [figure.axes[0].plot([], [], color=colour)[0] for colour in (BLUE, ORANGE)]
    figure.legend(handles, comparison.labels, loc="outside upper right", ncols=2, frameon=False)
    figure.suptitle(f"{comparison.motions[index].name}, effects: {comparison.effects}", fontsize=13)
    return save(figure, path)


def _draw_panel(comparison: Comparison, index: int, names: Sequence[str], above: Axes, below: Axes) -> None:
    motion = comparison.motions[index]
    t = motion.period * np.arange(len(motion.setpoints) + 1)
    for name, signal in ((name, comparison.signals[name]) for name in names):
        for traces, colour, style in ((comparison.first, BLUE, "-"), (comparison.second, ORANGE, "--")):
            values = traces.signals[name][: len(t), index]
            above.plot(t, np.unwrap(values, axis=0) if signal.turns else values, style, color=colour, linewidth=0.9)
        error = np.abs(difference(comparison.first, comparison.second, name, signal, motion, index))
        below.plot(t, np.maximum(error.max(axis=1) / signal.resolution, 1e-3), linewidth=0.9, color="#444444")
    below.axhline(comparison.threshold, color=GREEN, linewidth=0.8)
    below.set_yscale("log")
    below.set_ylim(1e-3, max(1e2, below.get_ylim()[1]))
    below.set_ylabel("noise units", fontsize=8)
    above.set_title(", ".join(f"{name} ({comparison.signals[name].unit})" for name in names), fontsize=9)
    above.tick_params(labelbottom=False)
    for axes in (above, below):
        tidy(axes)
        axes.margins(x=0.01)


def save_map(comparison: Comparison, path: Path) -> Path:
    """Write the map of all differences: signals by motions, rms in noise units."""
    from matplotlib.colors import LogNorm

    names = list(comparison.signals)
    values = np.array([[case.differences[name].rms_in_noise for case in comparison.cases] for name in names])
    figure = new_figure(2.2 + 0.56 * len(comparison.cases), 1.5 + 0.21 * len(names))
    axes = figure.subplots()
    image = axes.imshow(np.maximum(values, 1e-2), norm=LogNorm(1e-2, 1e2), cmap="RdYlBu_r", aspect="auto")
    motions = [case.motion for case in comparison.cases]
    axes.set_xticks(range(len(motions)), motions, rotation=40, ha="right", fontsize=8)
    axes.set_yticks(range(len(names)), [_starred(comparison, name) for name in names], fontsize=8)
    colours = image.to_rgba(np.maximum(values, 1e-2))
    for row, column in np.ndindex(*values.shape):
        colour = text_colour(colours[row, column].tolist())
        axes.text(column, row, _noise(float(values[row, column])), ha="center", va="center", fontsize=7, color=colour)
    first, second = comparison.labels
    axes.set_title(f"{second} minus {first}\nrms in units of sensor noise; effects: {comparison.effects}", fontsize=10)
    axes.set_xlabel("motion", fontsize=9)
    axes.set_ylabel("signal", fontsize=9)
    figure.colorbar(image, ax=axes, shrink=0.8, format="%g", label="rms difference (1 = sensor noise)")
    return save(figure, path)
