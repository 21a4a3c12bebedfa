"""What an effect is: data about it, and a function that writes it into the parameter table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.physics.effects.search import Search
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Values = Mapping[str, float]
Apply = Callable[[Parameters, Sequence[str], Values], None]

#: Order of application, whatever the order in a patch: levels of the whole floor, then of single wheels, then areas and what
#: is relative to a level, then factors, then what is added.
STAGES = ("level", "asymmetry", "area or ratio", "scale", "addition")


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    Attributes:
        unit, doc: SI unit ("-" = pure number); meaning.
        low, high: bounds; anything outside is refused.
        neutral: the value that changes nothing, or the name of the parameter whose nominal value changes nothing.
        prior: range a real robot may plausibly have: what a search for missing effects covers and randomisation may draw.
        severity: a clear, realistic case, for tests and demonstrations.
        optional: may be left out, and is then neutral.
        is_size: whether it says how large the effect is, not where it acts or over what it fades.
    """

    unit: str
    doc: str
    low: float
    high: float
    neutral: float | str
    prior: tuple[float, float]
    severity: float
    optional: bool = False
    is_size: bool = True

    def neutral_in(self, parameters: Parameters) -> float:
        """Return the value that changes nothing about a model with these parameters."""
        return float(parameters[self.neutral].mean()) if isinstance(self.neutral, str) else float(self.neutral)


@dataclass(frozen=True)
class Effect:
    """One effect of the library.

    Attributes:
        name: as in a patch file.
        doc: what is missing in the nominal model.
        equation: the law, with the effect's parameters by name.
        where: every place it can act on.
        parameters: its numbers by name.
        apply: writes it into a batch of parameters, in place.
        stage: its place in the order of application, of :data:`STAGES`.
        search: how measured runs are searched for it; None = they are not.
    """

    name: str
    doc: str
    equation: str
    where: tuple[str, ...]
    parameters: Mapping[str, EffectParameter]
    apply: Apply
    stage: str = "addition"
    search: Search | None = None

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise unknown_name("stage", self.stage, STAGES, f"effect '{self.name}'")


@dataclass(frozen=True)
class PatchEffect:
    """One effect of a patch.

    Attributes:
        name: of the library, or ``unknown_effect``.
        where: places it acts on.
        parameters: its numbers, SI; optional ones that are left out are neutral.
        formula, units: law of an unknown effect and the units of its parameters; empty for an effect of the library.
        place: where it was read, for messages; does not count in comparisons.
    """

    name: str
    where: tuple[str, ...]
    parameters: Mapping[str, float]
    formula: str = ""
    units: Mapping[str, str] = field(default_factory=dict)
    place: str = field(default="", compare=False)

    def content(self) -> dict[str, Any]:
        """Return the effect as plain YAML types."""
        content: dict[str, Any] = {"name": self.name, "where": list(self.where)}
        if self.formula:
            content["formula"] = self.formula
        content["parameters"] = dict(self.parameters)
        if self.units:
            content["units"] = dict(self.units)
        return content


# ---- the usual ways to write into the table --------------------------------------------------------------------------


def add(target: str, parameter: str) -> Apply:
    """Add the effect's parameter to ``target``, of the named joints or wheels where it has such elements."""
    return _on_each(target, parameter, lambda before, value: before + value)


def multiply(target: str, parameter: str) -> Apply:
    """Multiply ``target`` of the named joints or wheels by the effect's parameter."""
    return _on_each(target, parameter, lambda before, value: before * value)


def put(target: str, parameter: str) -> Apply:
    """Set ``target`` of the named joints or wheels to the effect's parameter."""
    return _on_each(target, parameter, lambda before, value: value)


def _on_each(target: str, parameter: str, change: Callable[[Array, float], Any]) -> Apply:
    def apply(parameters: Parameters, where: Sequence[str], values: Values) -> None:
        elements = [target] if parameters[target].ndim == 1 else [f"{target}[{place}]" for place in where]
        for element in elements:
            parameters[element] = change(parameters[element], _value(values, parameter))

    return apply


def add_vector(target: str, names: Sequence[str]) -> Apply:
    """Add the effect's parameters ``names`` to the elements of ``target``."""

    def apply(parameters: Parameters, where: Sequence[str], values: Values) -> None:
        parameters[target] += np.array([_value(values, name) for name in names])

    return apply


def together(*parts: Apply) -> Apply:
    """Do one after the other."""

    def apply(parameters: Parameters, where: Sequence[str], values: Values) -> None:
        for part in parts:
            part(parameters, where, values)

    return apply


def _value(values: Values, parameter: str) -> float:
    if parameter not in values:
        raise unknown_name("parameter of the effect", parameter, values)
    return values[parameter]


def add_shaped(size: str, size_target: str, shape: Mapping[str, str], what: str) -> Apply:
    """Add ``size`` to ``size_target`` and set the numbers that give it its shape (parameter -> target).

    Two of the same shape add up; two of different shape are more than the table holds.

    Raises:
        InputError: the place has one of another shape already.
    """

    def apply(parameters: Parameters, where: Sequence[str], values: Values) -> None:
        if values[size] == 0.0:
            return
        for place in where:
            present = parameters[f"{size_target}[{place}]"]
            for name, target in shape.items():
                element = parameters[f"{target}[{place}]"]
                if ((present != 0.0) & (element != values[name])).any():
                    raise InputError(f"{place} has a {what} of another {name} already, and the model holds one")
                element[...] = values[name]
            present += values[size]

    return apply


def xyz(
    unit: str, bound: float, prior: float, severity: Sequence[float], doc: str, *, is_size: bool = True
) -> dict[str, EffectParameter]:
    """Return three optional parameters x, y, z: bounds and prior symmetric about 0, docs ``{axis}`` filled in."""
    return {
        axis: EffectParameter(unit, doc.format(axis=axis), -bound, bound, 0.0, (-prior, prior), chosen, True, is_size)
        for axis, chosen in zip("xyz", severity, strict=True)
    }
