"""The effects that may be missing in the robot: every effect of the library, as its :class:`Search` says.

An effect that adds to a number which calibration may move too (dry friction, wheel radius, ...) needs no probe of its own: it
is the same response without the tolerance.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.problem import Candidate, Probe, Start, Tolerance, Unknown
from wlr_gym.gap.robot.observed import observe
from wlr_gym.gap.robot.quantities import REACH
from wlr_gym.physics.effects import EFFECTS, Effect, PatchEffect
from wlr_gym.physics.effects.effect import Change, Coordinates, Guess, Known, Observed, Places, Search
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: A prior is no wall: a size is sought so far beyond it too, in its width, where the simulator accepts it.
BEYOND = 3.0
#: A probe so many times larger than a tolerance is simulated on its own: the response to the tolerance would be lost in
#: rounding, and in what sticks and slips otherwise.
LARGER = 8.0


def robot_candidates(
    parameters: Parameters,
    tolerances: Mapping[str, float],
    measured: Sequence[Array],
    simulated: Sequence[Array],
    residuals: Sequence[Array],
    drifting: Set[str] = frozenset(),
) -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates beyond a calibrated model.

    Args:
        parameters: (1) of the model.
        tolerances: of the quantities that calibration may move, by name.
        measured: (rows, signals) per run.
        simulated: the same by the model.
        residuals: of the model, (rows, signals) per run.
        drifting: names of the quantities that drift: no effect hides in their tolerance.
    """
    library = _Library(observe(parameters, measured, simulated, residuals), tolerances, drifting)
    found = [own for effect, search, where in _searches() for own in library.candidates(effect, search, where)]
    return list(library.probes.values()), found


def shown_by() -> Mapping[str, str]:
    """Return the motion of :mod:`wlr_gym.data.excitations` that shows each effect best."""
    return {name: effect.search.shown_by for name, effect in EFFECTS.items() if effect.search is not None}


def _searches() -> Iterator[tuple[Effect, Search, Places]]:
    """Every effect at every set of places; effects that start from calibrated parameters take turns at each place."""
    sought = ((effect, effect.search) for effect in EFFECTS.values() if effect.search is not None)
    for _, alike in itertools.groupby(sought, lambda one: one[1].places if one[1].guesses is None else one[0].name):
        group = list(alike)
        for where in group[0][1].places:
            yield from ((effect, search, where) for effect, search in group)


@dataclass
class _Library:
    """Makes candidates, and collects the probes that their starts need by key."""

    observed: Observed
    tolerances: Mapping[str, float]
    drifting: Set[str]
    probes: dict[str, Probe] = field(default_factory=dict)

    def candidates(self, effect: Effect, search: Search, where: Places) -> list[Candidate]:
        """Return an effect at a set of places, and each component of a vector alone; none where these runs cannot show it."""
        whole = self._candidate(effect, search, where)
        if whole is None:
            return []
        return [whole, *(_component(whole, k) for k in range(len(whole.unknowns)) if search.components)]

    def _candidate(self, effect: Effect, search: Search, where: Places) -> Candidate | None:
        """Return an effect at a set of places; None where these runs cannot show it."""
        at_all = set(where) == set(effect.where)
        known = {name: number for name, number in search.known.items() if at_all or "{}" in number.quantity}
        if search.guesses is None:
            starts: tuple[Start, ...] = (self._known_start(effect, where, known),)
        else:
            starts = tuple(self._start(effect, where, guess) for guess in search.guesses(where, self.observed))
        if not starts:
            return None
        own = None if search.coordinates is None else search.coordinates(where, self.observed)
        unknowns = self._unknowns(effect, search) if own is None else _fitted(own)
        tolerances = tuple(self._tolerance(effect, where, unknown.name, known) for unknown in unknowns) if known else ()
        candidate = Candidate(effect.name, where, unknowns, starts, tolerances=tolerances, surcharge=search.surcharge)
        if own is None:
            return candidate
        return replace(candidate, fixed=own.fixed, convert=own.parameters, within=own.within)

    def _unknowns(self, effect: Effect, search: Search) -> tuple[Unknown, ...]:
        """The parameters of an effect; a fit may go :data:`BEYOND` their prior."""
        found = []
        for name, parameter in effect.parameters.items():
            low, high = parameter.prior
            low = max(low, search.least.get(name, low))
            neutral, room = parameter.neutral_in(self.observed.parameters), BEYOND * (high - low) * parameter.is_size
            least = low if low == neutral else max(low - room, parameter.low, search.least.get(name, parameter.low))
            most = high if high == neutral else min(high + room, parameter.high)
            step = 0.05 * (high - low)
            found.append(Unknown(name, parameter.unit, neutral, low, high, step, parameter.is_size, least, most))
        return tuple(found)

    def _known_start(self, effect: Effect, where: Places, known: Mapping[str, Known]) -> Start:
        """Start from responses to calibrated parameters: a tolerance each, or a probe where the robot's file gives none."""
        neutral = {name: effect.parameters[name].neutral_in(self.observed.parameters) for name in known}
        directions, amounts = [], []
        for name, number in known.items():
            quantities = _quantities(number, where)
            step = max((number.step_at(place) for place in where), key=abs)
            if all(
                abs(step) < LARGER * number.scale(self.observed) * self.tolerances.get(quantity, 0.0) for quantity in quantities
            ):
                directions.append(quantities)
                amounts.append(number.scale(self.observed) * self.tolerances[quantities[0]])
            else:
                changed = {**neutral, name: neutral[name] + step}
                directions.append(tuple(self._probe(PatchEffect(effect.name, (place,), changed)) for place in where))
                amounts.append(step)
        middle = tuple(neutral.values())
        return Start(
            tuple(directions), lambda a: tuple(float(n + size * k) for n, size, k in zip(middle, amounts, a, strict=True))
        )

    def _start(self, effect: Effect, where: Places, guess: Guess) -> Start:
        def response(changes: Sequence[Change]) -> tuple[str, ...]:
            pairs = itertools.product(changes, where)
            return tuple(self._probe(PatchEffect(c.effect or effect.name, (place,), c.parameters)) for c, place in pairs)

        return Start(tuple(map(response, guess.directions)), guess.values)

    def _probe(self, change: PatchEffect) -> str:
        numbers = (f"{name} {value:g}" for name, value in change.parameters.items())
        key = " ".join([change.name, *change.where, *numbers])
        self.probes.setdefault(key, Probe(key, (change,)))
        return key

    def _tolerance(self, effect: Effect, where: Places, unknown: str, known: Mapping[str, Known]) -> Tolerance | None:
        """How an unknown meets numbers that calibration may move; it takes the place of one whose value is its neutral."""
        quantities = _quantities(known[unknown], where) if unknown in known else ()
        if not quantities or self.drifting & {*quantities} or not all(name in self.tolerances for name in quantities):
            return None
        number = known[unknown]
        size = number.scale(self.observed) * self.tolerances[quantities[0]]
        replaces = unknown in effect.parameters and isinstance(effect.parameters[unknown].neutral, str)
        return Tolerance(quantities, size, 0.0 if number.any_size else REACH, replaces)


def _component(whole: Candidate, k: int) -> Candidate:
    """One component of an effect that is a vector, alone; direction ``k`` of each start moves it."""

    def start(own: Start) -> Start:
        one = np.eye(len(own.directions))[k]
        return Start((own.directions[k],), lambda a: (own.values(float(a[0]) * one)[k],))

    starts = tuple(start(own) for own in whole.starts)
    return replace(whole, unknowns=(whole.unknowns[k],), starts=starts, tolerances=whole.tolerances[k : k + 1])


def _fitted(coordinates: Coordinates) -> tuple[Unknown, ...]:
    numbers = coordinates.numbers.items()
    return tuple(Unknown(name, one.unit, one.neutral, one.low, one.high, one.step, one.is_size) for name, one in numbers)


def _quantities(number: Known, where: Places) -> tuple[str, ...]:
    return tuple(dict.fromkeys(number.quantity.format(place) for place in where))
