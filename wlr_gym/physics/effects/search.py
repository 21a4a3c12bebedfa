"""What a search for a missing effect must know of it: where to look, where to start, which motion shows it.

A first guess comes from projecting the measured gap on simulated responses to small changes of the model. A place's response
serves every set that holds it, so all sets cost no more than the single places.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wlr_gym.robot import LEGS, WHEELS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
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
