"""A rig as a :class:`wlr_gym.gap.problem.Problem`: windows, residuals, first guesses and patches, whatever simulates it.

:class:`RigProblem` is what all rigs share; how a model is simulated is its subclasses' to say: a system of one's own
(:mod:`wlr_gym.gap.rig.own`), and one servo that swings a pendulum (:mod:`wlr_gym.gap.rig.pendulum`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.problem import Candidate, MeasuredSignal, Probe, Quantity, Range, Setting, Start, Unknown
from wlr_gym.physics.effects import EffectParameter, Patch, PatchEffect, Source, load_patch
from wlr_gym.physics.effects.effect import Change, Guess

Array = NDArray[np.float64]

#: Noise units that every residual of a simulation that broke down counts: more than two turns of a servo.
LOST = 1e4
#: Steps of finite differences per plausible range.
STEPS_PER_RANGE = 50.0
#: Rows on either side through which a cubic is laid to find a value and its rate at a row.
HALF_WINDOW = 4


@dataclass(frozen=True)
class RigLaw:
    """A law that may be missing.

    Attributes:
        doc: what is missing without it, and its formula; empty = as the effect of its name in the library.
        parameters: as of an effect of the library: ``prior`` is the plausible range, ``severity`` what is tried first.
        guesses: ways to a first guess, several where its response is not linear; none = one change by ``severity`` for each
            parameter that says how large it is.
        refines: law that must be in the model before this one is looked for; empty = none.
    """

    doc: str
    parameters: Mapping[str, EffectParameter]
    guesses: tuple[Guess, ...] = ()
    refines: str = ""

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """What is fitted: its parameters, within their priors."""
        found = []
        for name, one in self.parameters.items():
            low, high = one.prior
            step = (high - low) / STEPS_PER_RANGE
            found.append(Unknown(name, one.unit, float(one.neutral), low, high, step, one.is_size))
        return tuple(found)


class MeasuredRun(Protocol):
    """One run of a rig: its file's name, times (rows,) in s, and columns (rows, columns) in SI, NaN where not measured."""

    @property
    def name(self) -> str: ...

    @property
    def t(self) -> Array: ...

    @property
    def measured(self) -> Array: ...


class RigProblem(ABC):
    """Runs of one rig, and a simulator of it; see :class:`wlr_gym.gap.problem.Problem`.

    Every run is replayed once per window length, and each measured column is a signal of each.

    Args:
        name: of the place where its effects act.
        runs: of one rig.
        columns: what is measured.
        quantities: what calibration may move.
        laws: that may be missing.
        windows: s after which a replay starts again from what was measured; infinite = one replay of the whole run.
        known: effects that are in the model from the start.

    Attributes:
        held_out: names of the runs to hold out where the user names none.
        in_model: names of laws that are numbers of the model.
    """

    metric: str
    in_model: Set[str] = frozenset()
    #: A replay costs milliseconds, and what sticks answers far from linearly: every hypothesis is worth a whole fit.
    thorough = True
    steps, tempering, threads, misfit, disagreement, cap = 20, 1.0, 1, math.inf, 0.0, LOST
    held_out: tuple[str, ...] = ()
    turning: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType({})
    motions: Mapping[str, str] = MappingProxyType({})

    def __init__(
        self,
        name: str,
        runs: Sequence[MeasuredRun],
        columns: Sequence[MeasuredSignal],
        quantities: Sequence[Quantity],
        laws: Mapping[str, RigLaw],
        windows: Sequence[float],
        known: Sequence[PatchEffect] = (),
    ) -> None:
        self.name, self.laws = name, laws
        self.known: tuple[PatchEffect, ...] = tuple(known)
        self.windows: tuple[float, ...] = tuple(windows)
        self.runs: tuple[str, ...] = tuple(run.name for run in runs)
        self.quantities: tuple[Quantity, ...] = tuple(quantities)
        self.signals: tuple[MeasuredSignal, ...] = tuple(
            replace(column, name=column.name if math.isinf(length) else f"{column.name}_within_{length:g}s", place=name)
            for length in windows
            for column in columns
        )
        self._all_runs: Sequence[MeasuredRun] = runs

    @abstractmethod
    def replayed(self, settings: Sequence[Setting], run: int, length: float) -> Array:
        """Return what the columns would have read (settings, rows, columns), begun anew after every ``length`` s."""

    @abstractmethod
    def remade(self, setting: Setting, runs: Sequence[int], count: int) -> Iterator[list[Array]]:
        """Replay runs that a model itself would have made; see :meth:`wlr_gym.gap.problem.Problem.remade`."""

    @abstractmethod
    def features(self, setting: Setting, runs: Sequence[int]) -> list[Mapping[str, Array]]:
        """Return what residuals are mapped over, (rows,) each."""

    def times(self, run: int) -> Array:
        """Return the times (rows,) of a run, s."""
        return self._all_runs[run].t

    def measured(self, run: int) -> Array:
        """Return what was measured (rows, signals), SI: the same for every window length."""
        return np.tile(self._all_runs[run].measured, len(self.windows))

    def simulate(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Return what the columns would have read: (settings, rows, signals) per run, SI."""
        return [np.concatenate([self.replayed(settings, run, one) for one in self.windows], axis=2) for run in runs]

    def residuals(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Replay runs under every setting; see :meth:`wlr_gym.gap.problem.Problem.residuals`.

        A setting whose simulation broke down is as far from the data as can be.
        """
        noise, found = np.array([signal.noise for signal in self.signals]), []
        for run, simulated in zip(runs, self.simulate(settings, runs), strict=True):
            measured = self.measured(run)
            left = self.without_first_states(run, (measured - simulated) / noise)
            left[~np.isfinite(simulated).all(axis=(1, 2))] = np.where(np.isfinite(measured), LOST, np.nan)
            found.append(left)
        return found

    def without_first_states(self, run: int, residuals: Array) -> Array:
        """Take out of residuals (settings, rows, signals), in place, what errors of windows' first states explain: nothing."""
        return residuals

    def candidates(
        self, setting: Setting, residuals: Sequence[Array], runs: Sequence[int]
    ) -> tuple[list[Probe], list[Candidate]]:
        """Return the laws to try beyond ``setting``, and the probes of their first guesses."""
        present = {effect.name for effect in (*self.known, *setting.effects)}
        return law_candidates(self.laws, self.name, present | self.in_model)

    def reach(self, effect: PatchEffect, setting: Setting, runs: Sequence[int]) -> Mapping[str, Range]:
        """Return over which range of each feature a formula was tried: none is."""
        return {}


def smoothed_state(time: Array, values: Array) -> tuple[Array, Array]:
    """Return a column and its rate at every row (rows,), from a cubic through the rows around it."""
    count = len(time)
    first = np.clip(np.arange(count) - HALF_WINDOW, 0, count - 2 * HALF_WINDOW - 1)
    rows = first[:, None] + np.arange(2 * HALF_WINDOW + 1)
    scale = time[rows[:, -1]] - time[rows[:, 0]]
    powers = ((time[rows] - time[:, None]) / scale[:, None])[:, :, None] ** np.arange(4)
    turned = powers.transpose(0, 2, 1)
    fitted = np.linalg.solve(turned @ powers, turned @ values[rows][:, :, None])[:, :, 0]
    return np.asarray(fitted[:, 0], np.float64), np.asarray(fitted[:, 1] / scale, np.float64)


# ---- what may be missing ---------------------------------------------------------------------------------------------


def law_candidates(laws: Mapping[str, RigLaw], place: str, present: Set[str]) -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates of laws, but for those that are ``present`` already.

    What refines another law is offered once that is there.
    """
    probes: dict[str, Probe] = {}

    def probe(name: str, change: Change) -> str:
        key = " ".join([name, *(f"{parameter} {value:g}" for parameter, value in change.parameters.items())])
        probes[key] = Probe(key, (PatchEffect(name, (place,), change.parameters),))
        return key

    candidates = []
    for name, law in laws.items():
        if name not in present and (not law.refines or law.refines in present):
            starts = tuple(
                Start(tuple(tuple(probe(name, change) for change in changes) for changes in guess.directions), guess.values)
                for guess in law.guesses or (_guess(law),)
            )
            candidates.append(Candidate(name, (place,), law.unknowns, starts, doc=law.doc))
    return list(probes.values()), candidates


def _guess(law: RigLaw) -> Guess:
    """One change for each number that says how large the law is; the others are where they are clear."""
    neutral = {key: float(one.neutral) for key, one in law.parameters.items()}
    sizes = {key: one.severity for key, one in law.parameters.items() if one.is_size}
    shape = {key: one.severity for key, one in law.parameters.items() if not one.is_size}

    def values(amplitudes: Array) -> tuple[float, ...]:
        pairs = zip(sizes.items(), amplitudes, strict=True)
        grown = {key: neutral[key] + float(amplitude) * (severe - neutral[key]) for (key, severe), amplitude in pairs}
        return tuple({**neutral, **shape, **grown}.values())

    return Guess(tuple((Change({**neutral, **shape, key: severe}),) for key, severe in sizes.items()), values)


# ---- patches ---------------------------------------------------------------------------------------------------------


class _LawAt(NamedTuple):
    """A law of a rig as patch files have it: where it acts, and its parameters."""

    where: tuple[str, ...]
    parameters: Mapping[str, EffectParameter]


def rig_patch(source: Source, laws: Mapping[str, RigLaw], joint: str) -> Patch:
    """Load a patch of a rig, as its analyses write it; see :func:`wlr_gym.physics.effects.load_patch`.

    Args:
        source: as there.
        laws: what the rig knows.
        joint: the one place where they act.
    """
    return load_patch(source, {name: _LawAt((joint,), law.parameters) for name, law in laws.items()})
