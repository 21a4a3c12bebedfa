"""What an effect is: data about it, a function that writes it into the parameter table, and how runs are searched for it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.robot import LEGS, WHEELS
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
        optional: may be left out, and is then neutral: the number, or whatever the robot has.
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

    @property
    def has_default(self) -> bool:
        """Whether it may be left out and then has a number."""
        return self.optional and not isinstance(self.neutral, str)

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

    @property
    def order(self) -> int:
        """Place of its stage in the order of application."""
        return STAGES.index(self.stage)

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise unknown_name("stage", self.stage, STAGES, f"effect '{self.name}'")


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


def put_given(target: str, parameter: str) -> Apply:
    """The same, where the effect says something of the parameter."""
    whole = put(target, parameter)
    return lambda parameters, where, values: whole(parameters, where, values) if parameter in values else None


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


# ---- how a search looks for an effect that is missing ----------------------------------------------------------------

# A first guess comes from projecting the measured gap on simulated responses to small changes of the model. A place's response
# serves every set that holds it, so all sets cost no more than the single places.


Places = tuple[str, ...]


def _alone_and_together(names: Places) -> tuple[Places, ...]:
    sets = ((0, 1), (2, 3), (0, 2), (1, 3), (0, 1, 2, 3))
    return (*((name,) for name in names), *(tuple(names[k] for k in chosen) for chosen in sets))


#: Every leg (wheel), and those that may have a common cause: front, rear, left, right, all.
LEG_SETS = _alone_and_together(LEGS)
WHEEL_SETS = _alone_and_together(WHEELS)
JOINT_SETS = LEG_SETS + WHEEL_SETS


@dataclass(frozen=True)
class Observed:
    """What a search may read off the model and the runs.

    Attributes:
        parameters: (1) of the model.
        orders: per joint that has moved, the periods per turn of the wave that explains most of its residuals.
        travel: m; least and greatest x of the floor that was reached.
    """

    parameters: Parameters
    orders: Mapping[str, float]
    travel: tuple[float, float]

    def mean(self, name: str) -> float:
        """Return the mean of a parameter over its elements."""
        return float(self.parameters[name].mean())


@dataclass(frozen=True)
class Known:
    """A number that calibration may move too, and to which an unknown of the effect adds.

    Attributes:
        quantity: its name; ``{}`` is each place of the effect. Without ``{}`` it is one number of all places, and only an
            effect at all of them adds to it.
        step: change of the unknown in a simulated response, where the robot's file gives the number no tolerance.
        wheel_step: the same at a wheel, where that differs.
        scale: of the unknown per unit of the number.
        any_size: every size is an effect, also one within what calibration may move.
    """

    quantity: str
    step: float = 0.0
    wheel_step: float | None = None
    scale: Callable[[Observed], float] = lambda observed: 1.0
    any_size: bool = False

    def step_at(self, place: str) -> float:
        """Return the change of the unknown at a place."""
        return self.step if self.wheel_step is None or place not in WHEELS else self.wheel_step


@dataclass(frozen=True)
class Change:
    """A small change of the model, at each place singly.

    Attributes:
        parameters: of the effect.
        effect: name of another effect, whose response serves; empty = the effect itself.
    """

    parameters: Mapping[str, float]
    effect: str = ""


@dataclass(frozen=True)
class Guess:
    """One way to a first guess.

    Attributes:
        directions: the changes per amplitude; the responses to those of one direction are added up.
        values: from the amplitudes found (1 = the change itself) to values of what is fitted.
    """

    directions: tuple[tuple[Change, ...], ...]
    values: Callable[[Array], tuple[float, ...]]


@dataclass(frozen=True)
class Coordinate:
    """A number that is fitted in place of parameters; the attributes are those of an effect's parameter, and ``step`` its
    finite difference."""

    unit: str
    neutral: float
    low: float
    high: float
    step: float
    is_size: bool = True


@dataclass(frozen=True)
class Coordinates:
    """Numbers in which measured data are more nearly linear than in the parameters themselves, fitted in their place.

    Attributes:
        numbers: by name, in the order of all values.
        parameters: from their values to the effect's parameters.
        fixed: parameters that are not fitted.
        within: brings values back to where the effect is plausible, where ranges of single numbers do not say it.
    """

    numbers: Mapping[str, Coordinate]
    parameters: Callable[[Sequence[float]], Mapping[str, float]]
    fixed: Mapping[str, float] = field(default_factory=dict)
    within: Callable[[Sequence[float]], tuple[float, ...]] | None = None


@dataclass(frozen=True)
class Search:
    """How an effect is looked for in measured runs.

    Attributes:
        relation: the relation of the model that it changes, in words; ``{}`` is its place.
        shown_by: motion of :mod:`wlr_gym.data.excitations` that shows it best.
        places: sets of places at which it is tried.
        guesses: ways to a first guess at one of ``places``; none = these runs cannot show it. Left out: its first guess comes
            from the numbers in ``known``, which then are one per parameter.
        known: the number that each unknown adds to, where there is one.
        coordinates: what is fitted at one of ``places``; None = the parameters themselves.
        least: below these values of its parameters the effect is what any robot has, and calibration's.
        unseen: parameters that runs hardly show, and the number of the model that each gets: it is not fitted, and a result
            says so.
        relation_of_all: the relation, where it acts at all its places; empty = none in particular.
        one_per_place: beside another one of its kind at the same place no fit could move it.
        components: of its parameters one alone may be missing.
        surcharge: by how much more than others it must improve a fit (fall of minus two log posterior), where something that
            every robot meets resembles it.
    """

    relation: str
    shown_by: str
    places: tuple[Places, ...]
    guesses: Callable[[Places, Observed], Iterable[Guess]] | None = None
    known: Mapping[str, Known] = field(default_factory=dict)
    coordinates: Callable[[Places, Observed], Coordinates] | None = None
    least: Mapping[str, float] = field(default_factory=dict)
    unseen: Mapping[str, str] = field(default_factory=dict)
    relation_of_all: str = ""
    one_per_place: bool = False
    components: bool = False
    surcharge: float = 0.0


def steps(parameter: str, *sizes: float, neutral: float = 0.0) -> Callable[[Places, Observed], list[Guess]]:
    """Return guesses of an effect of one parameter, from changes of these sizes: several where its response is not linear."""
    return lambda where, observed: [one_step(parameter, size, neutral) for size in sizes]


def one_step(parameter: str, size: float, neutral: float) -> Guess:
    """Return a guess of an effect of one parameter, from a change of this size."""
    return Guess(((Change({parameter: neutral + size}),),), lambda a: (neutral + size * float(a[0]),))


def along(size: float, *changes: Mapping[str, float]) -> Guess:
    """Return a guess of a vector: one change of ``size`` per element, all elements neutral at 0."""
    return Guess(tuple((Change(change),) for change in changes), lambda a: tuple(float(v) for v in size * a))
