"""What calibration may move in the robot, and what may be missing beyond it: every effect of the library, and formulas.

Calibration may move the numbers that the robot's file gives a tolerance, and the biases of its IMU (:func:`knobs`).

An effect is tried as its :class:`Search` says (:func:`robot_candidates`). One that adds to a number which calibration may move
too (dry friction, wheel radius, ...) needs no probe of its own: it is the same response without the tolerance.

Formulas are forces that no effect of the library describes, on single coordinates (:func:`formula_candidates`). Each is a sum
of terms with one constant per term, so that it vanishes with its constants and its response is linear in them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple

import numpy as np

from wlr_gym.data.format import CHANNELS
from wlr_gym.gap.problem import Array, Candidate, Probe, Quantity, Start, Tolerance, Unknown
from wlr_gym.physics.effects import EFFECTS, UNKNOWN_EFFECT, Effect, PatchEffect
from wlr_gym.physics.effects.effect import Guess, Known, Observed, Places, Search
from wlr_gym.physics.plants.simulator import most_damping
from wlr_gym.robot import CORNERS, JOINTS, LEGS, WHEELS, Robot
from wlr_gym.robot.parameter_table import SPECS, TABLE
from wlr_gym.robot.parameters import Parameters

#: Tolerances that move several numbers as one: a floor is one floor, a host's latency one latency.
SHARED = {"ground.mu": ("ground.mu_x", "ground.mu_y"), "command.delay": ("command.delay",)}
#: Numbers of the contact spring, of which the robot's file has a guess and no tolerance: one sigma, relative, all wheels alike.
#: A stiffness held too near to the guess makes the body heavier, and a payload is named.
GUESSED = {"ground.normal_stiffness": 0.3, "ground.normal_damping": 0.5}
#: Tolerances by which calibration may move a number; what needs more is a missing effect.
REACH = 2.5
#: The same of the biases of the IMU. They are drawn each time it is switched on: they get more room.
REACH_OF_BIAS = 4.0
#: What tyres and gears yield, all alike, of which no robot's file tells: one sigma from none, m/s, rad/s and a share. An effect
#: is what goes beyond.
YIELDS = {"ground.creep_speed": 0.001, "servo.creep_rate": 0.004, "ground.flattening": 0.3}
#: A leg's own inertia is a hundredth of its rotor's: no run shows it.
UNSEEN = ("leg.inertia",)


@dataclass(frozen=True)
class Knob:
    """A quantity, and the elements of the parameter table that it sets.

    Attributes:
        quantity: what is fitted.
        elements: what it sets.
        shares: of the quantity that each element gets; a robot's floor may grip less across than along.
    """

    quantity: Quantity
    elements: tuple[str, ...]
    shares: tuple[float, ...] = ()


#: Share of the contact damping that the physics step still resolves to which calibration may go.
RESOLVED = 0.8


def knobs(robot: Robot, physics_step: float) -> tuple[Knob, ...]:
    """Return what calibration may move, from the tolerances of a robot that is simulated with a physics step, s."""
    nominal = Parameters.nominal(robot)
    shared = [(key, [e for name in names for e in SPECS[name].elements]) for key, names in SHARED.items()]
    single = [(spec.tolerance, [e]) for spec in TABLE if spec.tolerance not in (*UNSEEN, *SHARED) for e in spec.elements]
    found: list[Knob] = []
    for key, elements in (*shared, *single):
        if key in robot.tolerances:
            first, value = elements[0], float(nominal[elements[0]][0])
            sigma = robot.tolerances[key].sigma(first, value)
            name = first if len(elements) == 1 else key
            shares = tuple(float(nominal[element][0]) / value if value else 1.0 for element in elements)
            found.append(Knob(_quantity(name, first.partition("[")[0], value, sigma), tuple(elements), shares))
    for name, share in GUESSED.items():
        value = float(nominal[name].mean())
        quantity = _quantity(name, name, value, share * value)
        if name == "ground.normal_damping":
            resolved = RESOLVED * most_damping(nominal, physics_step)
            quantity = replace(quantity, high=max(min(quantity.high, resolved), value))
        found.append(Knob(quantity, tuple(SPECS[name].elements)))
    found += [Knob(_quantity(name, name, 0.0, sigma), tuple(SPECS[name].elements)) for name, sigma in YIELDS.items()]
    imu = robot.sensors.imu
    for name, sigma in (("imu.gyro_bias", imu.gyro_bias), ("imu.accel_bias", imu.accel_bias)):
        elements = SPECS[name].elements
        found += [Knob(replace(_quantity(e, name, 0.0, sigma, REACH_OF_BIAS), drifts=True), (e,)) for e in elements]
    return tuple(knob for knob in found if knob.quantity.sigma > 0.0)  # what is known exactly does not move


def _quantity(name: str, parameter: str, nominal: float, sigma: float, reach: float = REACH) -> Quantity:
    spec = SPECS[parameter]
    low, high = max(spec.low, nominal - reach * sigma), min(spec.high, nominal + reach * sigma)
    return Quantity(name, spec.unit, nominal, sigma, low, high)


def write(knobs: Sequence[Knob], values: Array, parameters: Parameters) -> None:
    """Write quantities (settings, len(knobs)) into a batch of parameters."""
    for knob, column in zip(knobs, values.T, strict=True):
        for element, share in zip(knob.elements, knob.shares or [1.0] * len(knob.elements), strict=True):
            parameters[element] = column * share


# ---- effects of the library ------------------------------------------------------------------------------------------

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
    orders = {joint: order for joint in JOINTS if (order := wave_order(joint, measured, residuals)) is not None}
    # where the robot has been: by the model, since not all runs have a camera
    x = np.concatenate([values[:, CHANNELS.index("cam_x")] for values in simulated])
    reached = x[np.isfinite(x)]  # a simulation may break down
    travel = (float(reached.min()), float(reached.max())) if reached.size else (0.0, 0.0)
    library = _Library(Observed(parameters, orders, travel), tolerances, drifting)
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
        at_all = set(where) == set(effect.where)
        known = {name: number for name, number in search.known.items() if at_all or "{}" in number.quantity}
        if search.guesses is None:
            starts = [self._known_start(effect, where, known)]
        else:
            starts = [self._start(effect, where, guess) for guess in search.guesses(where, self.observed)]
        if not starts:
            return []
        own = None if search.coordinates is None else search.coordinates(where, self.observed)
        unknowns = self._unknowns(effect, search)
        if own is not None:
            unknowns = [Unknown(n, o.unit, o.neutral, o.low, o.high, o.step, o.is_size) for n, o in own.numbers.items()]
        tolerances = tuple(self._tolerance(effect, where, unknown.name, known) for unknown in unknowns) if known else ()
        numbers, ways = tuple(unknowns), tuple(starts)
        fixed = {name: self.observed.mean(number) for name, number in search.unseen.items()}
        whole = Candidate(
            effect.name,
            where,
            numbers,
            ways,
            fixed=fixed,
            unseen=tuple(fixed),
            tolerances=tolerances,
            surcharge=search.surcharge,
        )
        if own is not None:
            whole = replace(whole, fixed={**fixed, **own.fixed}, convert=own.parameters, within=own.within)
        return [whole, *(_component(whole, k) for k in range(len(unknowns)) if search.components)]

    def _unknowns(self, effect: Effect, search: Search) -> list[Unknown]:
        """The parameters of an effect; a fit may go :data:`BEYOND` their prior."""
        found = []
        for name, parameter in effect.parameters.items():
            if name in search.unseen:
                continue
            low, high = parameter.prior
            low = max(low, search.least.get(name, low))
            neutral, room = parameter.neutral_in(self.observed.parameters), BEYOND * (high - low) * parameter.is_size
            least = low if low == neutral else max(low - room, parameter.low, search.least.get(name, parameter.low))
            most = high if high == neutral else min(high + room, parameter.high)
            step = 0.05 * (high - low)
            found.append(Unknown(name, parameter.unit, neutral, low, high, step, parameter.is_size, least, most))
        return found

    def _known_start(self, effect: Effect, where: Places, known: Mapping[str, Known]) -> Start:
        """Start from responses to calibrated parameters: a tolerance each, or a probe where the robot's file gives none."""
        neutral = {name: effect.parameters[name].neutral_in(self.observed.parameters) for name in known}
        directions, amounts = [], []
        for name, number in known.items():
            quantities, scale = _quantities(number, where), number.scale(self.observed)
            step = max((number.step_at(place) for place in where), key=abs)
            if all(abs(step) < LARGER * scale * self.tolerances.get(quantity, 0.0) for quantity in quantities):
                directions.append(quantities)
                amounts.append(scale * self.tolerances[quantities[0]])
            else:
                changed = {**neutral, name: neutral[name] + step}
                directions.append(tuple(self._probe(PatchEffect(effect.name, (place,), changed)) for place in where))
                amounts.append(step)
        middle = tuple(neutral.values())

        def values(a: Array) -> tuple[float, ...]:
            return tuple(float(n + size * k) for n, size, k in zip(middle, amounts, a, strict=True))

        return Start(tuple(directions), values)

    def _start(self, effect: Effect, where: Places, guess: Guess) -> Start:
        directions = []
        for changes in guess.directions:
            pairs = itertools.product(changes, where)
            probes = (PatchEffect(c.effect or effect.name, (place,), c.parameters) for c, place in pairs)
            directions.append(tuple(map(self._probe, probes)))
        return Start(tuple(directions), guess.values)

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


def _quantities(number: Known, where: Places) -> tuple[str, ...]:
    return tuple(dict.fromkeys(number.quantity.format(place) for place in where))


# ---- what is read off the runs ---------------------------------------------------------------------------------------

#: Periods per turn at which a wave is looked for.
ORDERS = range(1, 65)
#: Periods that a joint must go through before a wave can be told from a bend.
PERIODS = 1.5
#: Fewer rows show no wave.
LEAST_ROWS = 20


def wave_order(joint: str, measured: Sequence[Array], residuals: Sequence[Array]) -> float | None:
    """Return the number of periods per turn that explains most of a joint's residuals of speed and effort.

    Only of those of which the joint has gone through :data:`PERIODS` in some run: part of a wave is any bend. None where it has
    hardly moved.
    """
    angle = CHANNELS.index(f"pos_{joint}")
    covered = max(
        (float(np.ptp(seen[known, angle])) for seen in measured if (known := np.isfinite(seen[:, angle])).any()), default=0
    )
    least = 2.0 * math.pi * PERIODS / max(covered, 1e-9)
    orders = [order for order in ORDERS if order >= least]
    if not orders:
        return None
    power = np.zeros(len(orders))
    for name in (f"vel_{joint}", f"eff_{joint}"):
        column = CHANNELS.index(name)
        for seen, residual in zip(measured, residuals, strict=True):
            known = np.isfinite(residual[:, column]) & np.isfinite(seen[:, angle])
            if known.sum() < LEAST_ROWS:
                continue
            waves = np.exp(1j * np.outer(orders, seen[known, angle]))
            waves -= waves.mean(axis=1, keepdims=True)
            left = residual[known, column] - residual[known, column].mean()
            power += np.abs(waves @ left) ** 2 / np.maximum((np.abs(waves) ** 2).sum(axis=1), 1e-9)
    return float(orders[int(np.argmax(power))])


# ---- formulas --------------------------------------------------------------------------------------------------------


class Law(NamedTuple):
    """A formula and where it may act.

    Attributes:
        formula, where: as a formula effect has them.
        terms: its constants that are fitted, each linear in the force.
        fixed: name, unit and value of constants that are not.
    """

    formula: str
    terms: tuple[Unknown, ...]
    where: tuple[str, ...]
    fixed: tuple[tuple[str, str, float], ...] = ()


def term(name: str, unit: str, probe: float, bound: float) -> Unknown:
    """One constant of a formula, the size it is probed with, and its plausible range (either sign)."""
    return Unknown(name, unit, 0.0, -bound, bound, 0.5 * probe)


def _other(name: str) -> str:
    """The same joint on the other side."""
    return name[:-2] + {"l": "r", "r": "l"}[name[-2]] + name[-1]


def _coupled(kind: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Places of a coupling between the two sides: a joint, or both of an axle."""
    return (*((one,) for one in kind), kind[:2], kind[2:])


def _driven(torque: str, places: tuple[str, ...], bound: float, slope: float) -> Law:
    """Dry friction that grows with the torque of another motor than the joint's own; full from a rate of about 2 / slope.

    An explicit force must be soft: bound x torque x slope x step / inertia below 2. Wheels have 3e-4 kg m2 and up to 0.1 N m,
    their legs up to 1.3.
    """
    return Law(f"-r * abs({torque}) * tanh(s * rate)", (term("r", "-", 0.1 * bound, bound),), places, (("s", "s/rad", slope),))


_LAWS: tuple[Law, ...] = (
    *(Law("c - k * angle", (term("c", "N m", 0.1, 3.0), term("k", "N m/rad", 0.2, 5.0)), (leg,)) for leg in LEGS),
    *(Law("c - f * wind_up", (term("c", "N m", 0.1, 3.0), term("f", "N m", 0.1, 2.0)), (leg,)) for leg in LEGS),
    *(Law("a * cos(angle) + b * sin(angle)", (term("a", "N m", 0.1, 3.0), term("b", "N m", 0.1, 3.0)), (leg,)) for leg in LEGS),
    *(Law("-d * rate * abs(rate)", (term("d", "N m s2/rad2", 0.1, 3.0),), (leg,)) for leg in LEGS),
    *(Law("c", (term("c", "N m", 0.02, 0.5),), (wheel,)) for wheel in WHEELS),
    *(Law("-d * rate * abs(rate)", (term("d", "N m s2/rad2", 0.002, 0.1),), (wheel,)) for wheel in WHEELS),
    *(Law(f"-k * leg_rate_{_other(leg)[4:]}", (term("k", "N m s/rad", 0.05, 3.0),), (leg,)) for leg in LEGS),
    *(Law(f"-k * wheel_rate_{_other(wheel)[6:]}", (term("k", "N m s/rad", 0.004, 0.2),), (wheel,)) for wheel in WHEELS),
    *(_driven("leg_torque_opposite", places, 1.0, 20.0) for places in _coupled(LEGS)),
    *(_driven("wheel_torque_opposite", places, 0.8, 6.0) for places in _coupled(WHEELS)),
    *(_driven("wheel_torque", (leg,), 1.0, 20.0) for leg in LEGS),
    *(_driven("leg_torque", (wheel,), 0.2, 2.0) for wheel in WHEELS),
    *(
        Law(
            f"a * sin(wheel_angle_{corner}) + b * cos(wheel_angle_{corner})",
            (term("a", "N m", 0.3, 20.0), term("b", "N m", 0.3, 20.0)),
            (f"body_torque_{axis}",),
        )
        for corner in CORNERS
        for axis in ("roll", "pitch")
    ),
    Law("-d * velocity_x", (term("d", "N s/m", 2.0, 50.0),), ("body_force_x",)),
    Law("-d * velocity_x * abs(velocity_x)", (term("d", "N s2/m2", 10.0, 200.0),), ("body_force_x",)),
    Law("-d * yaw_rate", (term("d", "N s/rad", 0.5, 20.0),), ("body_force_x",)),
    Law("-d * velocity_y", (term("d", "N s/m", 4.0, 100.0),), ("body_force_y",)),
    Law("-d * velocity_x", (term("d", "N s/m", 2.0, 50.0),), ("body_force_y",)),
    Law("-d * yaw_rate", (term("d", "N s/rad", 0.5, 20.0),), ("body_force_y",)),
    Law("-d * yaw_rate", (term("d", "N m s/rad", 0.2, 5.0),), ("body_torque_yaw",)),
    Law("-d * yaw_rate * abs(yaw_rate)", (term("d", "N m s2/rad2", 0.4, 10.0),), ("body_torque_yaw",)),
    Law("-d * velocity_x", (term("d", "N s", 0.4, 10.0),), ("body_torque_yaw",)),
    Law("-d * velocity_y", (term("d", "N s", 0.8, 20.0),), ("body_torque_yaw",)),
)


def _wave(place: str, unit: str, size: float, bound: float) -> Law:
    """A push or twist that comes and goes with time."""
    return Law("a * sin(w * time) + b * cos(w * time)", (term("a", unit, size, bound), term("b", unit, size, bound)), (place,))


_WAVES = (
    _wave("floor_force_x", "N", 0.5, 20.0),
    _wave("floor_force_y", "N", 0.5, 20.0),
    _wave("body_torque_yaw", "N m", 0.05, 2.0),
)
#: Hz; where a wave is looked for.
WAVE_FREQUENCIES = np.arange(0.2, 5.0, 0.01)
#: Hz; the neighbourhood it must stand out of.
NEIGHBOURHOOD = 0.5
#: Channels that a push or a twist of the body moves.
_SHAKEN = [
    CHANNELS.index(name)
    for name in CHANNELS
    if name.startswith(("eff_wheel", "vel_wheel", "gyro_z", "acc_x", "acc_y", "cam_x", "cam_y", "cam_yaw"))
]


def formula_candidates(times: Sequence[Array] = (), residuals: Sequence[Array] = ()) -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates of all formulas.

    Args:
        times: (rows,) per run, s since its first row; none = no formula of time.
        residuals: (rows, channels) per run, of the model without them: what frequency a wave in time has.
    """
    offered = [_offered(law) for law in _LAWS]
    if times:
        rate = 2.0 * np.pi * wave_frequency(times, residuals)
        beat = Unknown("w", "rad/s", rate, rate - 0.4, rate + 0.4, 0.02, is_size=False)
        offered += [_offered(law, (beat,)) for law in _WAVES]
    return [probe for probes, _ in offered for probe in probes], [candidate for _, candidate in offered]


def _offered(law: Law, shape: tuple[Unknown, ...] = ()) -> tuple[list[Probe], Candidate]:
    """A law's probes and candidate; ``shape``: unknowns in which it is not linear, probed where they begin."""
    unknowns = (*law.terms, *shape)
    units = {one.name: one.unit for one in unknowns} | {name: unit for name, unit, _ in law.fixed}
    fixed = {name: value for name, _, value in law.fixed}
    neutral = {one.name: one.neutral for one in unknowns}
    sizes = {one.name: 2.0 * one.step for one in law.terms}  # of the probes
    probes = []
    for name, size in sizes.items():
        effect = PatchEffect(UNKNOWN_EFFECT, law.where, neutral | fixed | {name: size}, law.formula, units)
        probes.append(Probe(" ".join([UNKNOWN_EFFECT, *law.where, law.formula, name]), (effect,)))

    def values(amplitude: Array) -> tuple[float, ...]:
        found = [float(size * a) for size, a in zip(sizes.values(), amplitude, strict=True)]
        return (*found, *(one.neutral for one in shape))

    start = Start(tuple((probe.key,) for probe in probes), values)
    return probes, Candidate(UNKNOWN_EFFECT, law.where, unknowns, (start,), law.formula, units, fixed)


@cache
def tried_effects() -> tuple[PatchEffect, ...]:
    """Return one effect of every formula that is tried, waves included."""
    nowhere = np.zeros((0, len(CHANNELS)))
    _, candidates = formula_candidates([np.zeros(0)], [nowhere])
    return tuple(candidate.effect([unknown.neutral for unknown in candidate.unknowns]) for candidate in candidates)


def wave_frequency(times: Sequence[Array], residuals: Sequence[Array]) -> float:
    """Return the frequency (Hz) that stands out most in what is left, at the same phase since the start of every run.

    Of the power over the median of its neighbourhood: what a model lacks is largest at low frequencies anyway.
    """
    totals, rows = np.zeros((len(_SHAKEN), len(WAVE_FREQUENCIES)), complex), np.zeros(len(_SHAKEN))
    for t, residual in zip(times, residuals, strict=True):
        turn = np.exp(-2j * np.pi * np.outer(WAVE_FREQUENCIES, t))
        for k, c in enumerate(_SHAKEN):
            known = np.isfinite(residual[:, c])
            if known.any():
                totals[k] += turn[:, known] @ (residual[known, c] - residual[known, c].mean())
                rows[k] += known.sum()
    power = (np.abs(totals) ** 2 / np.maximum(rows, 1)[:, None]).sum(axis=0)
    near = round(NEIGHBOURHOOD / (WAVE_FREQUENCIES[1] - WAVE_FREQUENCIES[0]))
    background = [np.median(power[max(k - near, 0) : k + near + 1]) for k in range(len(power))]
    return float(WAVE_FREQUENCIES[int(np.argmax(power / np.maximum(background, 1e-12)))])
