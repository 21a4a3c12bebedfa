"""Compare two plants: same setpoints, same parameters, same start; where and when do they diverge, and by how much?

Differences are given in units of what the robot's own sensors resolve (:func:`resolutions`), so that a difference below one
could not be measured on the robot at all. With ``halve`` everything is repeated at half the physics step: a difference that
comes from the steps shrinks with them, and each plant's own step error tells whose it is; what stays is a difference between
the models.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.data.compared_plants import ComparedPlant, Traces, drive
from wlr_gym.data.compared_signals import ComparedSignal, resolutions
from wlr_gym.data.excitations import Motion
from wlr_gym.physics.effects import EFFECTS, Patch, load_patch
from wlr_gym.physics.effects.patch import Source
from wlr_gym.robot import LEGS, WHEELS, Robot, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

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

    def as_dict(self) -> dict[str, Any]:
        """Return the fields, and both sizes in units of the resolution."""
        return {**vars(self), "rms_in_noise_units": self.rms_in_noise, "largest_in_noise_units": self.largest / self.resolution}


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

    def as_dict(self) -> dict[str, Any]:
        """Return the figures and the broken bounds."""
        return {**vars(self), "broken": list(self.broken)}


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
        return {
            "motion": self.motion, "agreement": self.agreement.as_dict(), "parts_first_in": self.first,
            "differences": {name: difference.as_dict() for name, difference in self.differences.items()},
        }  # fmt: skip


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

    Raises:
        InputError: no motions or of different periods, a threshold that is not positive, an unknown effect.
    """
    if not motions:
        raise InputError("nothing to compare: expected at least one motion")
    if len({motion.period for motion in motions}) > 1:
        raise InputError("the motions have different periods; expected one")
    if not threshold > 0.0:
        raise InputError(f"threshold = {threshold:g}: expected more than 0 units of sensor noise")
    robot, patch = robot or load_robot(), load_patch(effects)
    signals = resolutions(robot)

    driven = [*plants, *(plant.halved for plant in plants if halve)]

    def traces(k: int) -> Traces:
        doing = f"driving {driven[k].label}"
        return drive(
            driven[k], motions, robot, parameters, patch, threads, lambda share: tell(doing, (k + share) / len(driven))
        )

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
    differences = {}
    for name, signal in signals.items():
        error = np.abs(difference(a, b, name, signal, motion, k))
        beyond = (error > threshold * signal.resolution).any(axis=1)
        parted = float(np.argmax(beyond) * motion.period) if beyond.any() else None
        differences[name] = Difference(_rms(error), float(error.max()), signal.unit, signal.resolution, parted)
    parted = [
        (found.parted, name) for name, found in differences.items() if found.parted is not None and not signals[name].shared
    ]
    first = min(parted)[::-1] if parted else None
    return MotionComparison(motion.name, _agreement(motion, k, a, b, signals, robot), differences, first)


def _agreement(motion: Motion, k: int, a: Traces, b: Traces, signals: Mapping[str, ComparedSignal], robot: Robot) -> Agreement:
    rows = len(motion.setpoints) + 1
    horizon = min(round(HORIZON / motion.period), rows - 1)
    path = a.signals["true_xy"][: horizon + 1, k]
    travel = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    apart = float(np.linalg.norm(b.signals["true_xy"][horizon, k] - path[-1]))
    yaw = float(np.abs(difference(a, b, "true_yaw", signals["true_yaw"], motion, k)[horizon, 0]))
    torque = {}
    for kind in ("leg", "wheel"):
        own, other = (traces.signals[f"motor_torque_{kind}"][:rows, k] for traces in (a, b))
        torque[f"{kind}_torque"] = _ratio(_rms(other - own), max(_rms(own), getattr(robot.servo, kind).coulomb_friction))
    return Agreement(travel, apart, apart / max(travel, signals["true_xy"].resolution), yaw, **torque)


def _ratio(a: float, b: float) -> float:
    return a / b if b > 0.0 else 0.0 if a == 0.0 else float("inf")


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def severe_patch(name: str) -> Patch:
    """Return one effect of the library at its default severity; of joints and wheels it acts on one of each kind.

    Which: the right front leg, the left rear wheel: nothing a symmetric mistake could hide behind.

    Raises:
        InputError: no such effect.
    """
    if name not in EFFECTS:
        raise unknown_name("effect", name, EFFECTS)
    effect = EFFECTS[name]
    chosen = [place for place in effect.where if place in (LEGS[1], WHEELS[2])]
    values = {parameter: spec.severity for parameter, spec in effect.parameters.items()}
    return load_patch({"name": name, "where": chosen or list(effect.where), "parameters": values})
