"""A system of one's own for the gap workflow, from one Python file: state equation, tolerances, laws to try, columns.

The file defines ``RIG``, a :class:`Rig`; docs/own_rig.md goes through one, and ``examples/linear_axis.py`` is one. Its
equation is compiled and integrated by Runge-Kutta, order four; its runs are a folder of CSV or Parquet tables with its
columns.
"""

from __future__ import annotations

import functools
import importlib.util
import itertools
import keyword
import math
import re
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numba import NumbaError, njit
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_file, check_folder, check_name, check_number, nearest
from wlr_gym.base.paths import as_path
from wlr_gym.base.random import generator
from wlr_gym.base.text import row_words
from wlr_gym.gap.analysis import IntakeFinding, few_runs
from wlr_gym.gap.problem import MeasuredSignal, Quantity, Setting, since_reversal
from wlr_gym.gap.rig.problem import RigLaw, RigProblem, smoothed_state
from wlr_gym.physics.codegen.expression import finite_number
from wlr_gym.physics.effects import EffectParameter, PatchEffect

__all__ = ["EffectParameter", "MeasuredSignal", "Quantity", "Rig", "RigLaw"]

Array = NDArray[np.float64]

#: Before the name of a column, for a state that is its rate.
RATE_OF = "rate of "
#: The clock of a run, s.
CLOCK = "t"
#: Rows of a run, at least.
LEAST_ROWS = 20
#: Table files by their endings.
_READERS = {".csv": pd.read_csv, ".parquet": pd.read_parquet}
#: Noise units beyond which a residual counts no more in the gap's numbers.
CAP = 50.0
#: Step of finite differences in a state, as a share of its scatter, and at least.
STATE_STEP = 1e-3
LEAST_STATE_STEP = 1e-9
#: Spans of the readings by which a simulation from the first row on may leave their mean.
FARTHEST = 10.0

#: Field of a rig -> what it is, what it holds, and both in words.
_KINDS: Mapping[str, tuple[type, Any, str]] = {
    "states": (Mapping, str, "a mapping from names to texts"),
    "inputs": (Mapping, str, "a mapping from names to units"),
    "laws": (Mapping, RigLaw, "a mapping from names to RigLaw"),
    "columns": (Sequence, MeasuredSignal, "a tuple of MeasuredSignal"),
    "parameters": (Sequence, Quantity, "a tuple of Quantity"),
    "windows": (Sequence, float | int, "a tuple of lengths in s"),
}


@dataclass(frozen=True, eq=False)
class Rig:
    """A system: how it moves, how well its numbers are known, what may be missing, what is measured.

    ``change`` and ``readings`` are compiled with numba. They get three named tuples: states ``x``, inputs ``u``, and ``p``, all
    numbers: parameters, and those of the laws, which change nothing at their neutral values. Functions that they call need
    ``numba.njit``.

    Attributes:
        name: one word; where its effects act.
        change: (x, u, p) -> rates of the states, a tuple in their order, SI units per s.
        readings: (x, u, p) -> what each measured column would read, a tuple in their order.
        states: name -> how it is known where a window begins: a column, ``rate of`` a column, or "" for 0.
        inputs: columns that drive it, and their units; a row's value holds until the next row.
        columns: what is measured; ``noise`` is one sigma, rounding included.
        parameters: what calibration may move, each within its tolerance ``sigma``.
        laws: what may be missing, by name.
        step: s, of the integration, at most.
        windows: s after which a replay starts again from what was measured: short ones show fast errors, long ones slow ones.
        disagreement: share by which equation and system may differ on how large an effect is; widens intervals.
    """

    name: str
    change: Callable[[Any, Any, Any], tuple[float, ...]]
    readings: Callable[[Any, Any, Any], tuple[float, ...]]
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    columns: tuple[MeasuredSignal, ...]
    parameters: tuple[Quantity, ...]
    laws: Mapping[str, RigLaw]
    step: float = 1e-3
    windows: tuple[float, ...] = (0.2, 1.0)
    disagreement: float = 0.02

    @property
    def numbers(self) -> dict[str, float]:
        """All numbers of the model as its file says: parameters, then neutral values of the laws' parameters."""
        neutral = {name: one.neutral for law in self.laws.values() for name, one in law.parameters.items()}
        return {one.name: one.nominal for one in self.parameters} | {name: float(value) for name, value in neutral.items()}


def load_rig(path: str | Path) -> Rig:
    """Load the ``RIG`` of a Python file; running the file is running its code.

    Raises:
        InputError: no such file, one that does not run or has no ``RIG``, or a rig that contradicts itself, with what and why.
    """
    path = as_path(path)
    check_file(path)
    spec = importlib.util.spec_from_file_location(f"wlr_gym_rig_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses and pickles of the file look themselves up
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise InputError(f"{path}: does not run: {type(error).__name__}: {error}") from error
    rig = getattr(module, "RIG", None)
    if not isinstance(rig, Rig):
        raise InputError(f"{path}: RIG = {rig!r}: expected a wlr_gym.gap.rig.own.Rig")
    check_rig(rig, str(path))
    return rig


def check_rig(rig: Rig, place: str) -> None:
    """Refuse a rig that contradicts itself.

    Raises:
        InputError: naming ``place``, field, value and what was expected.
    """
    for field, (whole, part, expected) in _KINDS.items():
        value = getattr(rig, field)
        parts = value.values() if isinstance(value, Mapping) else value
        _check(isinstance(value, whole) and all(isinstance(one, part) for one in parts), f"{place}: {field}", value, expected)
    columns = [column.name for column in rig.columns]
    numbers = [one.name for one in rig.parameters] + [name for law in rig.laws.values() for name in law.parameters]
    lists = {"states": list(rig.states), "inputs": list(rig.inputs), "columns": columns, "parameters and laws": numbers}
    for what, names in lists.items():
        where = f"{place}: {what}"
        _check(bool(names), where, names, "one name or more")
        for name in names:
            right = name.isidentifier() and not name.startswith("_") and not keyword.iskeyword(name)
            _check(right, where, name, "a name of letters, digits and _, without _ in front, that Python does not use itself")
            _check(names.count(name) == 1, where, name, "every name once")
    if shared := {CLOCK, *rig.inputs} & {*columns}:
        raise InputError(f"{place}: columns: '{min(shared)}' is an input or the clock: expected another name")
    for state, source in rig.states.items():
        if source:
            check_name("column", source.removeprefix(RATE_OF), columns, f"{place}: states: {state}")
    for column in rig.columns:
        check_number(f"{place}: columns: {column.name}: noise", column.noise, column.unit, above=0.0)
    for one in rig.parameters:
        check_number(f"{place}: parameters: {one.name}: sigma", one.sigma, one.unit, above=0.0)
        ends = one.low, one.nominal, one.high
        inside = all(isinstance(end, float | int) for end in ends) and one.low <= one.nominal <= one.high
        _check(inside, f"{place}: parameters: {one.name}: nominal", one.nominal, f"a number in {one.low} to {one.high}")
    for law_name, law in rig.laws.items():
        where, sizes = f"{place}: laws: {law_name}", [one for one in law.parameters.values() if one.is_size]
        _check(bool(sizes), f"{where}: parameters", list(law.parameters), "one that says how large it is")
        for name, one in law.parameters.items():
            _check_law_number(one, f"{where}: {name}")
    check_number(f"{place}: disagreement", rig.disagreement, least=0.0)
    check_number(f"{place}: step", rig.step, "s", above=0.0)
    right = bool(rig.windows) and all(length > 0.0 for length in rig.windows)
    _check(right, f"{place}: windows", rig.windows, "lengths above 0")


def _check_law_number(one: EffectParameter, place: str) -> None:
    (low, high), neutral = one.prior, one.neutral
    _check(finite_number(neutral) is not None, f"{place}: neutral", neutral, "a number")
    _check(low < high, f"{place}: prior", one.prior, "a low and a high end")
    _check(low <= one.severity <= high, f"{place}: severity", one.severity, f"a number in the prior, {low:g} to {high:g}")
    if one.is_size:
        _check(one.severity != neutral, f"{place}: severity", one.severity, f"another number than neutral, {neutral!r}")


def _check(right: bool, place: str, value: object, expected: str) -> None:
    if not right:
        raise InputError(f"{place} = {value!r}: expected {expected}")


# ---- its runs --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RigRun:
    """One run: name, times (rows,) s, inputs (rows, inputs), measured columns (rows, columns), NaN where not measured."""

    name: str
    t: Array
    inputs: Array
    measured: Array


def read_rig_runs(folder: str | Path, rig: Rig) -> list[RigRun]:
    """Read every table of a folder, in the order of their names.

    Raises:
        InputError: no folder, no tables, a column missing, or values that cannot be: naming file, column and row.
    """
    folder = as_path(folder)
    check_folder(folder)
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _READERS)
    if not paths:
        raise InputError(f"{folder}: holds no *.csv or *.parquet: expected runs of '{rig.name}', one file each")
    for before, after in itertools.pairwise(paths):
        if before.stem == after.stem:
            raise InputError(f"{folder}: {before.name} and {after.name} are the same run; keep one of them")
    return [_run(path, rig) for path in paths]


def _run(path: Path, rig: Rig) -> RigRun:
    def refuse(name: str, wrong: Any, expected: Callable[[int], str]) -> None:
        """Refuse the first row of a column that is wrong (rows,)."""
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputError(f"{path}: column '{name}', {row_words(path, row)}: expected {expected(row)}")

    try:
        table = _READERS[path.suffix.lower()](path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a table: {error}") from error
    columns = [column.name for column in rig.columns]
    for name in (CLOCK, *rig.inputs, *columns):
        if name not in table:
            raise InputError(f"{path}: has no column '{name}'{nearest(name, list(table))}")
        if not pd.api.types.is_numeric_dtype(table[name].dtype):
            raise InputError(f"{path}: column '{name}' holds {table[name].dtype}: expected numbers")
    if len(table) < LEAST_ROWS:
        raise InputError(f"{path}: {len(table)} rows: expected {LEAST_ROWS} or more")
    for name in (CLOCK, *rig.inputs):
        refuse(name, ~np.isfinite(table[name]), lambda _: "a finite number, as it drives the simulation")
    t, inputs, measured = (table[names].to_numpy(np.float64) for names in (CLOCK, list(rig.inputs), columns))
    falls = np.diff(t, prepend=-np.inf) <= 0.0
    refuse(CLOCK, falls, lambda row: f"times that rise, got {t[row]:g} after {t[row - 1]:g}")
    for name, values in zip(columns, measured.T, strict=True):
        refuse(name, np.isinf(values), lambda _: "a finite number, got an infinite one")
        if not np.isfinite(values).any():
            raise InputError(f"{path}: column '{name}' holds no number")
    return RigRun(path.stem, t, inputs, measured)


# ---- its equation compiled -------------------------------------------------------------------------------------------

#: What numba colours its messages with.
COLOURS = r"\x1b\[[0-9;]*m"

_DRIVER = """
def simulate(p, t, inputs, starts, begun, step, out):
    for i in range(len(t)):
        if starts[i] >= 0:
            {begin}
        u = U({inputs})
        {read} = readings(X({states}), u, p)
        {write}
        if i + 1 == len(t):
            break
        count = max(1, int(math.ceil((t[i + 1] - t[i]) / step - 1e-9)))
        h = (t[i + 1] - t[i]) / count
        for _ in range(count):
            {rates_1} = change(X({states}), u, p)
            {rates_2} = change(X({middle_1}), u, p)
            {rates_3} = change(X({middle_2}), u, p)
            {rates_4} = change(X({end}), u, p)
            {advance}
"""


def simulate(
    rig: Rig, values: dict[str, float], t: Array, inputs: Array, starts: NDArray[np.int64], begun: Array
) -> tuple[Array, Array]:
    """Return what the columns would read (rows, columns), and the states (rows, states).

    Args:
        rig: its equations; they are compiled when they are first used.
        values: all numbers by name.
        t: (rows,) s.
        inputs: (rows, inputs).
        starts: (rows,) row of ``begun`` to begin from, or -1; the first must not be -1.
        begun: (k, states).

    Raises:
        InputError: equations that cannot be compiled, with numba's reason.
    """
    count = len(rig.columns)
    out = np.empty((len(t), count + len(rig.states)))
    numbers, compiled = _compiled(rig)
    try:
        compiled(numbers(**values), t, inputs, starts, begun, rig.step, out)
    except NumbaError as error:
        reason = " ".join(re.sub(COLOURS, "", str(error)).split())
        sizes = f"change ({len(rig.states)} rates) or readings ({count} columns)"
        raise InputError(f"rig '{rig.name}': {sizes} cannot be compiled: {reason}") from error
    return out[:, :count], out[:, count:]


@functools.cache
def _compiled(rig: Rig) -> tuple[Callable[..., Any], Callable[..., None]]:
    """Return the named tuple of a rig's numbers, and its driver."""
    size, read = range(len(rig.states)), range(len(rig.columns))

    def listed(text: str, numbers: range = size, between: str = ", ") -> str:
        return between.join(text.format(k=k) for k in numbers)

    source = _DRIVER.format(
        begin=listed("s{k} = begun[starts[i], {k}]", between="; "),
        inputs=listed("inputs[i, {k}]", range(len(rig.inputs))),
        states=listed("s{k}"),
        read=listed("r{k}", read) + ",",
        write="; ".join([listed("out[i, {k}] = r{k}", read, "; "), *(f"out[i, {len(read) + k}] = s{k}" for k in size)]),
        middle_1=listed("s{k} + 0.5 * h * a{k}"),
        middle_2=listed("s{k} + 0.5 * h * b{k}"),
        end=listed("s{k} + h * c{k}"),
        advance=listed("s{k} += h / 6.0 * (a{k} + 2.0 * b{k} + 2.0 * c{k} + d{k})", between="; "),
        **{f"rates_{n}": listed(f"{letter}{{k}}") + "," for n, letter in enumerate("abcd", 1)},
    )
    scope: dict[str, Any] = {
        "math": math,
        "X": namedtuple("x", list(rig.states)),
        "U": namedtuple("u", list(rig.inputs)),
        "change": njit(rig.change),
        "readings": njit(rig.readings),
    }
    exec(compile(source, f"<rig {rig.name}>", "exec"), scope)  # the driver above, and names that were checked
    driver: Any = njit(scope["simulate"])
    return namedtuple("p", list(rig.numbers)), driver


# ---- the problem -----------------------------------------------------------------------------------------------------


def open_own_rig(
    data: str | Path, rig: Rig, known: Sequence[PatchEffect] = ()
) -> tuple[OwnRigProblem | None, list[IntakeFinding]]:
    """Return the problem, and what was noticed about the data; None where there are too few runs.

    Raises:
        InputError: files that are no runs of the rig, or equations that cannot be compiled.
    """
    runs = read_rig_runs(data, rig)
    too_few = few_runs(len(runs), len(runs), "record more")
    return (None, too_few) if too_few else (OwnRigProblem(runs, rig, known), [])


class OwnRigProblem(RigProblem):
    """Runs of a system of one's own, and its simulator; see :class:`wlr_gym.gap.rig.problem.RigProblem`.

    Where a window begins is known with the noise of the columns only: what a change of its first state would explain is taken
    out of its residuals.

    Args:
        runs: of one system.
        rig: its equations.
        known: laws that are in the model from the start.
    """

    cap = CAP

    def __init__(self, runs: Sequence[RigRun], rig: Rig, known: Sequence[PatchEffect] = ()) -> None:
        super().__init__(rig.name, runs, rig.columns, rig.parameters, rig.laws, rig.windows, known)
        self.rig: Rig = rig
        self.disagreement: float = rig.disagreement
        lengths = " and ".join(f"{length:g} s" for length in rig.windows)
        self.metric: str = (
            f"RMS over columns of measured minus replayed, in units of sensor noise ({CAP:g} at most per reading), "
            f"windows of {lengths}"
        )
        self._noise = np.array([column.noise for column in rig.columns])
        self._runs = tuple(runs)
        self._begun = [np.stack([_state(run, rig, name) for name in rig.states], axis=1) for run in runs]
        self._first_states = [self._window_bases(run) for run in range(len(runs))]

    def replayed(self, settings: Sequence[Setting], run: int, length: float) -> Array:
        """Return what the columns would have read (settings, rows, columns), begun anew after every ``length`` s."""
        return np.stack([self._simulated(self._values(setting), run, length)[0] for setting in settings])

    def _values(self, setting: Setting) -> dict[str, float]:
        values = self.rig.numbers
        values |= {one.name: float(value) for one, value in zip(self.quantities, setting.quantities, strict=True)}
        for effect in (*self.known, *setting.effects):
            check_name(f"law of '{self.rig.name}'", effect.name, self.rig.laws)
            values |= {name: float(value) for name, value in effect.parameters.items()}
        return values

    def _simulated(self, values: dict[str, float], run: int, length: float, shift: Array | float = 0.0) -> tuple[Array, Array]:
        """One replay that begins anew after every ``length`` s, with states (states) shifted there; see :func:`simulate`."""
        one = self._runs[run]
        starts = np.full(len(one.t), -1)
        first = [window.start for window in _windows(one.t, length)]
        starts[first] = first
        return simulate(self.rig, values, one.t, one.inputs, starts, self._begun[run] + shift)

    def _window_bases(self, run: int) -> list[tuple[slice, slice, Array]]:
        """Windows of a run, their signals, and an orthonormal basis (rows x signals, states) of what its first state changes.

        Of the model as the file says, in noise units; rows without a reading are 0.
        """
        values = self.rig.numbers | {name: float(v) for effect in self.known for name, v in effect.parameters.items()}
        steps = STATE_STEP * self._begun[run].std(axis=0) + LEAST_STATE_STEP
        missing, found, count = np.isnan(self._runs[run].measured), [], len(self._noise)
        for k, length in enumerate(self.windows):
            plain = self._simulated(values, run, length)[0]
            moved = [self._simulated(values, run, length, step)[0] for step in np.diag(steps)]
            changes = np.stack([(one - plain) / self._noise for one in moved], axis=2)
            changes = np.where(missing[:, :, None] | ~np.isfinite(changes), 0.0, changes)
            for rows in _windows(self._runs[run].t, length):
                left, sizes, _ = np.linalg.svd(changes[rows].reshape(-1, len(steps)), full_matrices=False)
                basis = left[:, sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)]
                found.append((rows, slice(k * count, (k + 1) * count), basis))
        return found

    def without_first_states(self, run: int, residuals: Array) -> Array:
        """Take out of residuals (settings, rows, signals), in place, what changes of the windows' first states explain."""
        for rows, columns, basis in self._first_states[run]:
            part = residuals[:, rows, columns]
            flat = np.nan_to_num(part).reshape(len(part), -1)
            residuals[:, rows, columns] = part - (flat @ basis @ basis.T).reshape(part.shape)
        return residuals

    def remade(self, setting: Setting, runs: Sequence[int], count: int) -> Iterator[list[Array]]:
        """Replay runs that a model itself would have made; see :meth:`wlr_gym.gap.problem.Problem.remade`.

        An unstable system, without the feedback that held it, runs away from what was measured: then every window is made from
        where it began, and replayed from what noise makes of that.
        """
        values = self._values(setting)
        clean = [self._simulated(values, run, math.inf)[0] for run in runs]
        stays = True
        for run, simulated in zip(runs, clean, strict=True):
            measured = self._runs[run].measured
            spans = np.nanmax(measured, axis=0) - np.nanmin(measured, axis=0)
            away = np.abs(simulated - np.nanmean(measured, axis=0))
            stays &= bool((away <= FARTHEST * (spans + self._noise)).all())  # what is not finite does not
        draws = [generator(run, "gap", "floor") for run in runs]
        for _ in range(count):
            drawn = [self._noise * rng.standard_normal(one.shape) for one, rng in zip(clean, draws, strict=True)]
            if not stays:
                yield [self._remade_windows(values, run, own) for run, own in zip(runs, drawn, strict=True)]
                continue
            read = zip(runs, clean, drawn, strict=True)
            made = [replace(self._runs[run], measured=one + own) for run, one, own in read]
            twin = OwnRigProblem(made, self.rig, self.known)
            yield [residual[0] for residual in twin.residuals([setting], range(len(made)))]

    def _remade_windows(self, values: dict[str, float], run: int, drawn: Array) -> Array:
        """Residuals (rows, signals) of windows that the model itself made, each from its first state; ``drawn``: noise."""
        noisy = replace(self._runs[run], measured=drawn)
        shift = np.stack([_state(noisy, self.rig, name) for name in self.rig.states], axis=1)
        made, replayed = (
            np.concatenate([self._simulated(values, run, length, own)[0] for length in self.windows], axis=1)
            for own in (0.0, shift)
        )
        count = len(self.windows)
        found = (made + np.tile(drawn, count) - replayed) / np.tile(self._noise, count)
        found[np.isnan(self.measured(run))] = np.nan
        return self.without_first_states(run, found[None])[0]

    def features(self, setting: Setting, runs: Sequence[int]) -> list[Mapping[str, Array]]:
        """Return states, inputs and time (rows,), over which residuals are mapped."""
        values, found = self._values(setting), []
        for run in runs:
            one = self._runs[run]
            _, states = self._simulated(values, run, max(self.windows))
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
