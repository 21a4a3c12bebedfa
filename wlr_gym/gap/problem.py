"""What the workflow knows of a system: parameters to calibrate, effects that may be missing, and a simulator.

The steps of the workflow (estimation, selection, validation) use only a :class:`Problem`. The robot is one
(:mod:`wlr_gym.gap.robot`), a servo on a test rig another (:mod:`wlr_gym.gap.rig`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.effects import EFFECTS, EffectParameter, PatchEffect

Array = NDArray[np.float64]
#: s; length of a block of rows, longer than residuals depend on each other.
BLOCK = 2.0


@dataclass(frozen=True)
class Quantity:
    """A calibrated (nuisance) parameter of the model: calibration may move it within its tolerance.

    Attributes:
        name: of the parameter, ``servo.kp[leg_lf]``.
        unit: SI unit.
        nominal: value in the model.
        sigma: tolerance, one standard deviation, in ``unit``.
        low, high: how far calibration may move it: a few tolerances, within what the simulator accepts.
        drifts: whether it differs each time the system is switched on, as a sensor's bias: it conceals no missing effect.
    """

    name: str
    unit: str
    nominal: float
    sigma: float
    low: float
    high: float
    drifts: bool = False


@dataclass(frozen=True)
class Unknown:
    """One parameter of a candidate effect.

    Attributes:
        name: as in the effect vocabulary, ``coefficient``.
        unit: SI unit.
        neutral: value at which the effect vanishes.
        low, high: range that a system may plausibly have: a prior.
        step: for finite differences.
        is_size: whether it says how large the effect is (at neutral it vanishes), not where it is or over what it fades.
        least, most: how far a fit may go; a prior is no wall. None = ``low``, ``high``.
    """

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    step: float
    is_size: bool = True
    least: float | None = None
    most: float | None = None

    @property
    def bounds(self) -> tuple[float, float]:
        """How far a fit may go."""
        return self.low if self.least is None else self.least, self.high if self.most is None else self.most


@dataclass(frozen=True)
class Probe:
    """An elementary change of the model, whose response is simulated once and serves many candidates.

    Attributes:
        key: unique name, ``coulomb_friction leg_rf``.
        effects: what is added to the calibrated model.
    """

    key: str
    effects: tuple[PatchEffect, ...]


@dataclass(frozen=True)
class Start:
    """One way to a first guess of a candidate: the measured gap is projected on the responses to probes.

    Attributes:
        directions: one tuple of probe keys, or of names of quantities, per direction; the responses in a tuple are added up.
            The response to a quantity is that to one tolerance.
        values: from the amplitudes found (1 = the probe itself) to values of the candidate's unknowns.
    """

    directions: tuple[tuple[str, ...], ...]
    values: Callable[[Array], tuple[float, ...]]


@dataclass(frozen=True)
class Tolerance:
    """How an unknown of an effect meets calibrated parameters.

    Attributes:
        quantities: their names.
        size: one tolerance of theirs, in the unknown's unit.
        reach: tolerances by which calibration may move them: what goes farther is an effect. 0 = any size is one.
        replaces: whether the unknown takes their place; otherwise it adds to them.
    """

    quantities: tuple[str, ...]
    size: float
    reach: float
    replaces: bool = False


@dataclass(frozen=True)
class Candidate:
    """An effect that may be missing, at one place or set of places.

    Attributes:
        name: of the effect vocabulary.
        where: joints, wheels, ``body``, ``ground`` or ``sensor``.
        unknowns: its parameters, in the order of all value tuples.
        starts: ways to a first guess; the best one is used.
        formula, units: of an effect that the library does not hold; empty otherwise.
        doc: what is missing without it, where the library's effect of this name is not meant; empty = it is.
        fixed: parameters of the effect that are not fitted.
        unseen: those of them that a system has and its runs hardly show.
        convert: from fitted values to the effect's parameters, where the data are more nearly linear in other numbers (mass and
            moments of a load, not its place); None = they are the same.
        tolerances: per unknown, the calibrated parameters it meets; empty = it meets none.
        within: brings values back to where the effect is plausible, where ranges of single unknowns do not say it (a load's
            moments, whose range grows with its mass); None = the ranges say it.
        surcharge: by how much more than others it must improve the fit.
    """

    name: str
    where: tuple[str, ...]
    unknowns: tuple[Unknown, ...]
    starts: tuple[Start, ...]
    formula: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)
    unseen: tuple[str, ...] = ()
    convert: Callable[[Sequence[float]], Mapping[str, float]] | None = None
    tolerances: tuple[Tolerance | None, ...] = ()
    within: Callable[[Sequence[float]], tuple[float, ...]] | None = None
    doc: str = ""
    surcharge: float = 0.0

    @property
    def label(self) -> str:
        """Short text: ``coulomb_friction leg_rf``."""
        return " ".join([self.name, *self.where, self.formula]).strip()

    @property
    def law(self) -> str:
        """What tells it from other effects, wherever they act: its name, and the formula of one without a name."""
        return self.name + self.formula

    @property
    def vocabulary(self) -> Mapping[str, EffectParameter]:
        """The parameters of the library's effect of this name; none where it is not meant."""
        return EFFECTS[self.name].parameters if self.name in EFFECTS and not self.doc else {}

    def kept(self, values: Sequence[float]) -> tuple[float, ...]:
        """Return the values brought into the plausible range."""
        ranged = tuple(float(np.clip(v, *u.bounds)) for v, u in zip(values, self.unknowns, strict=True))
        return ranged if self.within is None else self.within(ranged)

    def probed(self, start: Start) -> tuple[float, ...]:
        """Return the values of the unknowns in a start's own probes, within the plausible range."""
        return self.kept(start.values(np.ones(len(start.directions))))

    @property
    def replaced(self) -> set[str]:
        """Names of the calibrated parameters that the effect replaces."""
        return {name for met in self.tolerances if met is not None and met.replaces for name in met.quantities}

    def parameters(self, values: Sequence[float]) -> dict[str, float]:
        """Return the effect's fitted parameters by name."""
        if self.convert is not None:
            return dict(self.convert(values))
        return {unknown.name: float(value) for unknown, value in zip(self.unknowns, values, strict=True)}

    def effect(self, values: Sequence[float]) -> PatchEffect:
        """Return the effect with these values of its unknowns."""
        return PatchEffect(self.name, self.where, {**self.parameters(values), **self.fixed}, self.formula, self.units)


@dataclass(frozen=True, eq=False)
class Setting:
    """One model to simulate: values of the problem's quantities, and effects added to it."""

    quantities: Array
    effects: tuple[PatchEffect, ...] = ()


@dataclass(frozen=True)
class MeasuredSignal:
    """One measured channel.

    Attributes:
        name: column of the run.
        unit: SI unit.
        noise: one sigma of the sensor, quantisation included.
        group: channels of one kind share it, for tables and pictures.
        place: joint, ``body`` or ``sensor`` that it tells of.
    """

    name: str
    unit: str
    noise: float
    group: str
    place: str = "body"


@dataclass(frozen=True)
class Range:
    """Lowest and highest value of a quantity."""

    low: float
    high: float
    unit: str


class Problem(Protocol):
    """A system, its measured runs, and a simulator of it; a class that derives from it takes over what it does not set.

    Attributes:
        runs: names.
        signals: measured channels.
        quantities: what calibration may move.
        metric: what the gap's numbers are, in words.
        cap: noise units beyond which a residual counts no more in the gap's numbers.
        steps: Gauss-Newton steps of a fit, at most.
        tempering: weight of the prior against the likelihood. A simulator's error is the same in all runs, so that they agree
            on it: the likelihood counts so many times less than the scatter of the runs would allow, the prior so many times
            more. 1 = the simulator is exact.
        disagreement: share by which a simulator and the system may differ on how large an effect is; widens intervals.
        threads: how many share each piece of work; no result depends on it.
        thorough: runs cost next to nothing: every candidate is fitted in full, not only the shortlist.
        motions: effect -> name of the motion that shows it best, for advice on what to record; may be empty.
        misfit: error of the fitted runs, or of one held-out run, in noise floors, from which on something is missing even if no
            effect explains it; infinite where no simulator's own errors are known.
        held_out: names of the runs to hold out, where the problem knows better than a general rule; else empty.
        turning: joints without end, whose angle alone changes nothing: name -> its feature, and the signals that would show it.
    """

    metric: str
    cap: float
    steps: int
    tempering: float = 1.0
    disagreement: float = 0.0
    threads: int = 1
    thorough: bool = False
    misfit: float = math.inf
    motions: Mapping[str, str] = MappingProxyType({})
    held_out: tuple[str, ...] = ()
    turning: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType({})
    runs: tuple[str, ...]
    signals: tuple[MeasuredSignal, ...]
    quantities: tuple[Quantity, ...]

    def times(self, run: int) -> Array:
        """Return the times (rows,) of the rows of a run, s."""
        ...

    def measured(self, run: int) -> Array:
        """Return what was measured (rows, signals), SI; NaN where not."""
        ...

    def simulate(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Return what the sensors would have read: (len(settings), rows, signals) per run, SI."""
        ...

    def remade(self, setting: Setting, runs: Sequence[int], count: int) -> Iterator[list[Array]]:
        """Make data sets that a model itself would have recorded with these sensors, and replay them with it.

        Args:
            setting: the model.
            runs: which runs are made anew, with the commands of the measured ones.
            count: how many sets; the k-th is the same however many there are, on any number of threads.

        Yields:
            The residuals of one set, as :meth:`residuals` of this one setting: (rows, len(signals)) per run. Nothing where the
            simulation of a whole run, which nothing leads back to what was measured, breaks down.
        """
        ...

    def residuals(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Replay runs under every setting.

        Returns:
            One array (len(settings), rows, len(signals)) per run: (measured - simulated) / noise, NaN where not measured. What
            no model can be asked to reproduce (the pose a window starts from) is taken out.
        """
        ...

    def candidates(
        self, setting: Setting, residuals: Sequence[Array], runs: Sequence[int]
    ) -> tuple[list[Probe], list[Candidate]]:
        """Return the effects to try beyond ``setting``, and the probes their first guesses need.

        Args:
            setting: the calibrated model, with the effects found so far.
            residuals: of it, one (rows, signals) per run of ``runs``: where a candidate's shape is read off the data (period of
                a ripple).
            runs: which runs those are.
        """
        ...

    def reach(self, effect: PatchEffect, setting: Setting, runs: Sequence[int]) -> Mapping[str, Range]:
        """Return over which range of each feature a formula was tried: of what it reads, in replays of runs."""
        ...

    def features(self, setting: Setting, runs: Sequence[int]) -> list[Mapping[str, Array]]:
        """Return simulated quantities (rows,) that residuals are mapped over: speeds, loads, slip, place."""
        ...


def since_reversal(time: Array, rate: Array) -> Array:
    """Return the seconds (rows,) since a rate last changed its sign, or since the start: what systems map residuals over."""
    turned = np.concatenate([[True], np.diff(np.sign(rate)) != 0])
    return time - np.maximum.accumulate(np.where(turned, time, -np.inf))


def blocks(time: Array) -> list[slice]:
    """Cut the rows at these times (rows,) into blocks of about :data:`BLOCK` seconds."""
    inner = np.linspace(time[0], time[-1], max(1, round(float(time[-1] - time[0]) / BLOCK)) + 1)[1:-1]
    return [slice(first, last) for first, last in itertools.pairwise((0, *np.searchsorted(time, inner).tolist(), len(time)))]
