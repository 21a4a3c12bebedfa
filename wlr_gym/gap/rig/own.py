"""A system of one's own for the gap workflow, from one Python file: state equation, tolerances, laws to try, columns.

The file defines ``RIG``, a :class:`Rig`; docs/own_rig.md goes through one, and ``examples/linear_axis.py`` is one.
"""

from __future__ import annotations

import importlib.util
import keyword
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.gap.problem import MeasuredSignal, Quantity
from wlr_gym.physics.codegen.expression import finite_number
from wlr_gym.physics.effects.effect import EffectParameter

__all__ = ["EffectParameter", "MeasuredSignal", "Quantity", "Rig", "RigLaw"]

#: Before the name of a column, for a state that is its rate.
RATE_OF = "rate of "
#: The clock of a run, s.
CLOCK = "t"


@dataclass(frozen=True)
class RigLaw:
    """A law that may be missing.

    Attributes:
        doc: what is missing without it, and its formula.
        parameters: as of an effect of the library: ``prior`` is the plausible range, ``severity`` what is tried first.
    """

    doc: str
    parameters: Mapping[str, EffectParameter]


#: Field of a rig -> what it is, what it holds, and both in words.
_KINDS: Mapping[str, tuple[type, Any, str]] = {
    "states": (Mapping, str, "a mapping from names to texts"),
    "inputs": (Mapping, str, "a mapping from names to units"),
    "laws": (Mapping, RigLaw, "a mapping from names to RigLaw"),
    "columns": (Sequence, MeasuredSignal, "a tuple of MeasuredSignal"),
    "parameters": (Sequence, Quantity, "a tuple of Quantity"),
    "windows": (Sequence, float | int, "a tuple of lengths in s"),
}


@dataclass(frozen=True)
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
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a Python file that defines RIG")
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
    _check_kinds(rig, place)
    columns = [column.name for column in rig.columns]
    laws = [name for law in rig.laws.values() for name in law.parameters]
    numbers = [*(one.name for one in rig.parameters), *laws]
    lists = {"states": list(rig.states), "inputs": list(rig.inputs), "columns": columns, "parameters and laws": numbers}
    for what, names in lists.items():
        _check_names(names, f"{place}: {what}")
    if shared := {CLOCK, *rig.inputs} & {*columns}:
        raise InputError(f"{place}: columns: '{min(shared)}' is an input or the clock: expected another name")
    for state, source in rig.states.items():
        if source and source.removeprefix(RATE_OF) not in columns:
            raise unknown_name("column", source.removeprefix(RATE_OF), columns, f"{place}: states: {state}")
    for column in rig.columns:
        _check_positive(column.noise, f"{place}: columns: {column.name}: noise")
    for one in rig.parameters:
        _check_positive(one.sigma, f"{place}: parameters: {one.name}: sigma")
        ends = one.low, one.nominal, one.high
        inside = all(isinstance(end, float | int) for end in ends) and one.low <= one.nominal <= one.high
        _check(inside, f"{place}: parameters: {one.name}: nominal", one.nominal, f"a number in {one.low} to {one.high}")
    for law_name, law in rig.laws.items():
        sizes = [one for one in law.parameters.values() if one.is_size]
        _check(bool(sizes), f"{place}: laws: {law_name}: parameters", list(law.parameters), "one that says how large it is")
        for name, one in law.parameters.items():
            _check_law_number(one, f"{place}: laws: {law_name}: {name}")
    known = finite_number(rig.disagreement)
    _check(known is not None and known >= 0.0, f"{place}: disagreement", rig.disagreement, "a number of 0 or more")
    _check_positive(rig.step, f"{place}: step")
    right = bool(rig.windows) and all(length > 0.0 for length in rig.windows)
    _check(right, f"{place}: windows", rig.windows, "lengths above 0")


def _check_kinds(rig: Rig, place: str) -> None:
    for field, (whole, part, expected) in _KINDS.items():
        value = getattr(rig, field)
        parts = value.values() if isinstance(value, Mapping) else value
        _check(isinstance(value, whole) and all(isinstance(one, part) for one in parts), f"{place}: {field}", value, expected)


def _check_names(names: Sequence[str], place: str) -> None:
    _check(bool(names), place, names, "one name or more")
    for name in names:
        right = name.isidentifier() and not name.startswith("_") and not keyword.iskeyword(name)
        _check(right, place, name, "a name of letters, digits and _, without _ in front, that Python does not use itself")
        _check(names.count(name) == 1, place, name, "every name once")


def _check_law_number(one: EffectParameter, place: str) -> None:
    (low, high), neutral = one.prior, one.neutral
    _check(finite_number(neutral) is not None, f"{place}: neutral", neutral, "a number")
    _check(low < high, f"{place}: prior", one.prior, "a low and a high end")
    _check(low <= one.severity <= high, f"{place}: severity", one.severity, f"a number in the prior, {low:g} to {high:g}")
    if one.is_size:
        _check(one.severity != neutral, f"{place}: severity", one.severity, f"another number than neutral, {neutral!r}")


def _check_positive(value: object, place: str) -> None:
    number = finite_number(value)
    _check(number is not None and number > 0.0, place, value, "a number above 0")


def _check(right: bool, place: str, value: object, expected: str) -> None:
    if not right:
        raise InputError(f"{place} = {value!r}: expected {expected}")
