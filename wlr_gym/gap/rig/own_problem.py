"""Runs of a system of one's own as a :class:`wlr_gym.gap.problem.Problem`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import unknown_name
from wlr_gym.base.random import generator
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.problem import Candidate, MeasuredSignal, Probe, Quantity, Range, Setting, Start, Unknown, since_reversal
from wlr_gym.gap.rig.open import LEAST_RUNS, rig_patch
from wlr_gym.gap.rig.own import RATE_OF, Rig, RigLaw
from wlr_gym.gap.rig.own_kernel import CompiledRig
from wlr_gym.gap.rig.own_runs import RigRun, read_rig_runs
from wlr_gym.gap.rig.problem import with_lost
from wlr_gym.gap.rig.replay import smoothed_state
from wlr_gym.physics.effects import EffectParameter, Patch, PatchEffect, Source

Array = NDArray[np.float64]

#: Noise units beyond which a residual counts no more in the gap's numbers.
CAP = 50.0
#: Step of finite differences in a state, as a share of its scatter, and at least.
STATE_STEP = 1e-3
LEAST_STATE_STEP = 1e-9
#: Steps of finite differences per plausible range.
STEPS_PER_RANGE = 50.0
#: Spans of the readings by which a simulation from the first row on may leave their mean.
FARTHEST = 10.0


def open_own_rig(
    data: str | Path, rig: Rig, known: Sequence[PatchEffect] = ()
) -> tuple[OwnRigProblem | None, list[IntakeFinding]]:
    """Return the problem, and what was noticed about the data; None where there are too few runs.

    Raises:
        InputError: files that are no runs of the rig, or equations that cannot be compiled.
    """
    runs = read_rig_runs(data, rig)
    if len(runs) < LEAST_RUNS:
        text = f"{len(runs)} runs: record {LEAST_RUNS} or more, two to fit and one to hold out"
        return None, [IntakeFinding("", "", "few_runs", text, fatal=True)]
    return OwnRigProblem(runs, CompiledRig(rig), known), []


class OwnRigProblem:
    """Runs of a system of one's own, and its simulator; see :class:`wlr_gym.gap.problem.Problem`.

    Every run is replayed once per window length, and each measured column is a signal of each. Where a window begins is known
    with the noise of the columns only: what a change of its first state would explain is taken out of its residuals.

    Args:
        runs: of one system.
        compiled: its equations.
        known: laws that are in the model from the start.
    """

    cap, steps, tempering, threads, thorough, misfit = CAP, 20, 1.0, 1, True, math.inf
    held_out: tuple[str, ...] = ()
    turning: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType({})
    motions: Mapping[str, str] = MappingProxyType({})

    def __init__(self, runs: Sequence[RigRun], compiled: CompiledRig, known: Sequence[PatchEffect] = ()) -> None:
        rig = compiled.rig
        self.rig: Rig = rig
        self.disagreement: float = rig.disagreement
        self.known: tuple[PatchEffect, ...] = tuple(known)
        self.runs: tuple[str, ...] = tuple(run.name for run in runs)
        self.quantities: tuple[Quantity, ...] = rig.parameters
        self.signals: tuple[MeasuredSignal, ...] = tuple(
            replace(column, name=f"{column.name}_within_{length:g}s", place=rig.name)
            for length in rig.windows
            for column in rig.columns
        )
        lengths = " and ".join(f"{length:g} s" for length in rig.windows)
        self.metric: str = (
            f"RMS over columns of measured minus replayed, in units of sensor noise ({CAP:g} at most per reading), "
            f"windows of {lengths}"
        )
        self._noise = np.array([signal.noise for signal in self.signals])
        self._runs, self._compiled = tuple(runs), compiled
        self._begun = [np.stack([_state(run, rig, name) for name in rig.states], axis=1) for run in runs]
        self._first_states = [self._window_bases(run) for run in range(len(runs))]

    def times(self, run: int) -> Array:
        """Return the times (rows,) of a run, s."""
        return self._runs[run].t

    def measured(self, run: int) -> Array:
        """Return what was measured (rows, signals), SI: the same for every window length."""
        return np.tile(self._runs[run].measured, len(self.rig.windows))

    def simulate(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Return what the columns would have read: (settings, rows, signals) per run, SI."""
        values = [self._values(setting) for setting in settings]
        return [np.stack([self._replayed(one, run) for one in values]) for run in runs]

    def _replayed(self, values: dict[str, float], run: int) -> Array:
        return np.concatenate([self._simulated(values, run, length) for length in self.rig.windows], axis=1)

    def _simulated(
        self, values: dict[str, float], run: int, length: float, with_states: bool = False, shift: Array | None = None
    ) -> Array:
        """One replay (rows, columns) that begins anew after every ``length`` s, with states (states) shifted there."""
        one, begun = self._runs[run], self._begun[run]
        starts = np.full(len(one.t), -1)
        first = [window.start for window in _windows(one.t, length)]
        starts[first] = first
        begun = begun if shift is None else begun + shift
        return self._compiled.simulate(values, one.t, one.inputs, starts, begun, with_states)

    def _window_bases(self, run: int) -> list[tuple[slice, slice, Array]]:
        """Windows of a run, their signals, and an orthonormal basis (rows x signals, states) of what its first state changes.

        Of the model as the file says, in noise units; rows without a reading are 0.
        """
        values = self.rig.numbers | {name: float(v) for effect in self.known for name, v in effect.parameters.items()}
        steps = STATE_STEP * self._begun[run].std(axis=0) + LEAST_STATE_STEP
        missing, found = np.isnan(self._runs[run].measured), []
        noise = np.array([column.noise for column in self.rig.columns])
        for k, length in enumerate(self.rig.windows):
            plain = self._simulated(values, run, length)
            moved = [self._simulated(values, run, length, shift=step) for step in np.diag(steps)]
            changes = np.stack([(one - plain) / noise for one in moved], axis=2)
            changes = np.where(missing[:, :, None] | ~np.isfinite(changes), 0.0, changes)
            columns = slice(k * len(noise), (k + 1) * len(noise))
            found += [(window, columns, _basis(changes[window])) for window in _windows(self._runs[run].t, length)]
        return found

    def _values(self, setting: Setting) -> dict[str, float]:
        values = self.rig.numbers
        values |= {one.name: float(value) for one, value in zip(self.quantities, setting.quantities, strict=True)}
        for effect in (*self.known, *setting.effects):
            if effect.name not in self.rig.laws:
                raise unknown_name(f"law of '{self.rig.name}'", effect.name, self.rig.laws)
            values |= {name: float(value) for name, value in effect.parameters.items()}
        return values

    def remade(self, setting: Setting, runs: Sequence[int], count: int) -> Iterator[list[Array]]:
        """Replay runs that a model itself would have made; see :meth:`wlr_gym.gap.problem.Problem.remade`.

        An unstable system, without the feedback that held it, runs away from what was measured: then every window is made from
        where it began, and replayed from what noise makes of that.
        """
        values = self._values(setting)
        clean = [self._simulated(values, run, math.inf) for run in runs]
        stays = all(self._stays(run, one) for run, one in zip(runs, clean, strict=True))
        noise = np.array([column.noise for column in self.rig.columns])
        draws = [generator(run, "gap", "floor") for run in runs]
        for _ in range(count):
            drawn = [noise * rng.standard_normal(one.shape) for one, rng in zip(clean, draws, strict=True)]
            if not stays:
                yield [self._remade_windows(values, run, own) for run, own in zip(runs, drawn, strict=True)]
                continue
            read = zip(runs, clean, drawn, strict=True)
            made = [replace(self._runs[run], measured=one + own) for run, one, own in read]
            twin = OwnRigProblem(made, self._compiled, self.known)
            yield [residual[0] for residual in twin.residuals([setting], range(len(made)))]

    def _stays(self, run: int, simulated: Array) -> bool:
        """Whether a simulation from the first row on (rows, columns) stays near what was measured."""
        measured = self._runs[run].measured
        spans = np.nanmax(measured, axis=0) - np.nanmin(measured, axis=0)
        noise = np.array([column.noise for column in self.rig.columns])
        away = np.abs(simulated - np.nanmean(measured, axis=0))
        return bool(np.isfinite(simulated).all() and (away <= FARTHEST * (spans + noise)).all())

    def _remade_windows(self, values: dict[str, float], run: int, drawn: Array) -> Array:
        """Residuals (rows, signals) of windows that the model itself made, each from its first state; ``drawn``: noise."""
        noisy = replace(self._runs[run], measured=drawn)
        shift = np.stack([_state(noisy, self.rig, name) for name in self.rig.states], axis=1)
        made, replayed = (
            np.concatenate([self._simulated(values, run, length, shift=own) for length in self.rig.windows], axis=1)
            for own in (None, shift)
        )
        found = (made + np.tile(drawn, len(self.rig.windows)) - replayed) / self._noise
        found[np.isnan(self.measured(run))] = np.nan
        return self._without_first_states(run, found[None])[0]

    def residuals(self, settings: Sequence[Setting], runs: Sequence[int]) -> list[Array]:
        """Replay runs under every setting; see :meth:`wlr_gym.gap.problem.Problem.residuals`."""
        return [self._residuals(run, simulated) for run, simulated in zip(runs, self.simulate(settings, runs), strict=True)]

    def _residuals(self, run: int, simulated: Array) -> Array:
        """Of one run; a setting whose simulation broke down is as far from the data as can be."""
        measured = self.measured(run)
        return with_lost(self._without_first_states(run, (measured - simulated) / self._noise), measured, simulated)

    def _without_first_states(self, run: int, found: Array) -> Array:
        """Take out of residuals (settings, rows, signals), in place, what changes of the windows' first states explain."""
        for rows, columns, basis in self._first_states[run]:
            part = found[:, rows, columns]
            flat = np.nan_to_num(part).reshape(len(part), -1)
            found[:, rows, columns] = part - (flat @ basis @ basis.T).reshape(part.shape)
        return found

    def candidates(
        self, setting: Setting, residuals: Sequence[Array], runs: Sequence[int]
    ) -> tuple[list[Probe], list[Candidate]]:
        """Return the laws to try beyond ``setting``, and the probes of their first guesses."""
        present = {effect.name for effect in (*self.known, *setting.effects)}
        pairs = [_candidate(self.rig, name, law) for name, law in self.rig.laws.items() if name not in present]
        return [probe for probes, _ in pairs for probe in probes], [candidate for _, candidate in pairs]

    def reach(self, effect: PatchEffect, setting: Setting, runs: Sequence[int]) -> Mapping[str, Range]:
        """Nothing: no formula is tried."""
        return {}

    def features(self, setting: Setting, runs: Sequence[int]) -> list[Mapping[str, Array]]:
        """Return states, inputs and time (rows,), over which residuals are mapped."""
        values, found = self._values(setting), []
        for run in runs:
            one = self._runs[run]
            states = self._simulated(values, run, max(self.rig.windows), with_states=True)[:, len(self.rig.columns) :]
            columns = dict(zip(self.rig.states, states.T, strict=True)) | dict(zip(self.rig.inputs, one.inputs.T, strict=True))
            rates = [name for name, source in self.rig.states.items() if source.startswith(RATE_OF)]
            columns |= {f"time since reversal of {name} [s]": since_reversal(one.t, columns[name]) for name in rates}
            found.append({**columns, "time [s]": one.t - one.t[0]})
        return found


def _windows(t: Array, length: float) -> list[slice]:
    """Cut a run's rows into windows."""
    window = np.floor((t - t[0]) / length + 1e-9)
    edges = [*np.flatnonzero(np.diff(window, prepend=-1.0)).tolist(), len(t)]
    return [slice(first, last) for first, last in itertools.pairwise(edges)]


def _basis(changes: Array) -> Array:
    """Orthonormal basis (rows x columns, at most states) of changes (rows, columns, states); none where nothing changes."""
    left, sizes, _ = np.linalg.svd(changes.reshape(-1, changes.shape[-1]), full_matrices=False)
    return left[:, sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)]


def _state(run: RigRun, rig: Rig, name: str) -> Array:
    """What a state was (rows,), as far as it was measured: a cubic through the rows around each."""
    source = rig.states[name]
    if not source:
        return np.zeros(len(run.t))
    column = [one.name for one in rig.columns].index(source.removeprefix(RATE_OF))
    values = run.measured[:, column]
    known = np.isfinite(values)
    level, rate = smoothed_state(run.t, np.interp(run.t, run.t[known], values[known]))
    return rate if source.startswith(RATE_OF) else level


def _candidate(rig: Rig, name: str, law: RigLaw) -> tuple[list[Probe], Candidate]:
    """A law with one probe for each number that says how large it is; the others are where they are clear."""
    neutral = {key: rig.numbers[key] for key in law.parameters}
    sizes = [key for key, one in law.parameters.items() if one.is_size]
    shape = {key: one.severity for key, one in law.parameters.items() if not one.is_size}
    probes = [
        Probe(f"{name} {size}", (PatchEffect(name, (rig.name,), {**neutral, **shape, size: law.parameters[size].severity}),))
        for size in sizes
    ]

    def values(amplitudes: Array) -> tuple[float, ...]:
        grown = {
            size: neutral[size] + float(amplitude) * (law.parameters[size].severity - neutral[size])
            for size, amplitude in zip(sizes, amplitudes, strict=True)
        }
        return tuple({**neutral, **shape, **grown}.values())

    start = Start(tuple((probe.key,) for probe in probes), values)
    unknowns = tuple(_unknown(key, one, neutral[key]) for key, one in law.parameters.items())
    return probes, Candidate(name, (rig.name,), unknowns, (start,), doc=law.doc)


def _unknown(name: str, one: EffectParameter, neutral: float) -> Unknown:
    low, high = one.prior
    return Unknown(name, one.unit, neutral, low, high, (high - low) / STEPS_PER_RANGE, one.is_size)


def own_patch(source: Source, rig: Rig) -> Patch:
    """Load a patch of the rig, as its analyses write it; see :func:`wlr_gym.gap.rig.open.rig_patch`."""
    return rig_patch(source, rig.laws, rig.name)
