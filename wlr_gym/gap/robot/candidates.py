"""The effects that may be missing in the robot: every effect of the library at every place and set of places worth a name.

First guesses come from projecting the measured gap on simulated responses. A place's response serves every set that holds it,
so all sets cost no more than the single places. Effects that add to a number which calibration may move too (dry friction,
wheel radius, ...) need no probe of their own: they are the same response without the tolerance.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import CHANNELS
from wlr_gym.gap.problem import Candidate, Probe, Start, Tolerance, Unknown
from wlr_gym.gap.robot.quantities import REACH
from wlr_gym.physics.effects import EFFECTS, PatchEffect
from wlr_gym.robot import JOINTS, LEGS, WHEELS
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Sets of places that have a common cause, and how likely they are beside a single one.
_LEG_SETS = tuple(tuple(LEGS[k] for k in pick) for pick in ((0, 1), (2, 3), (0, 2), (1, 3), (0, 1, 2, 3)))
_WHEEL_SETS = tuple(tuple(WHEELS[k] for k in pick) for pick in ((0, 1), (2, 3), (0, 2), (1, 3), (0, 1, 2, 3)))
_OF_LEGS = (*((leg,) for leg in LEGS), *_LEG_SETS)
_OF_WHEELS = (*((wheel,) for wheel in WHEELS), *_WHEEL_SETS)
_OF_JOINTS = (*_OF_LEGS, *_OF_WHEELS, tuple(JOINTS))
#: Below this an effect is what any robot has; smaller values of it are calibration's.
LEAST = {("tyre_creep", "creep_speed"): 0.003}
#: Parameters that do not say how large an effect is.
NO_SIZE = ("stribeck_speed", "slip_speed", "order", "phase")
#: Periods per turn at which a ripple is looked for.
ORDERS = range(1, 65)
#: Periods that a joint must go through before a wave can be told from a bend.
PERIODS = 1.5
#: m; width of the strips of floor in which another friction is looked for.
STRIP = 0.15
#: Across, a patch has no end.
UNBOUNDED = {
    "y_min": EFFECTS["friction_patch"].parameters["y_min"].low,
    "y_max": EFFECTS["friction_patch"].parameters["y_max"].high,
}
#: Most strips; a longer floor gets wider ones.
MOST_STRIPS = 24


@dataclass(frozen=True)
class _Part:
    """One unknown of an effect that adds to a number which calibration may move too.

    Attributes:
        parameter: of the effect.
        quantities: the numbers it adds to.
        size: of a probe, where the robot's file gives those numbers no tolerance.
        scale: of the parameter per unit of the quantity.
    """

    parameter: str
    quantities: tuple[str, ...]
    size: float
    scale: float = 1.0


@dataclass
class _Lists:
    tolerances: Mapping[str, float]
    drifting: Set[str]
    probes: list[Probe]
    candidates: list[Candidate]

    def add_known(self, name: str, where: Sequence[str], parts: Sequence[_Part], mu: float = 0.6) -> None:
        """Add an effect of :class:`_Part` s: its first guess needs no probe where the numbers have tolerances."""
        neutral = {unknown.name: unknown.neutral for unknown in unknowns(name, mu)}
        directions, amounts, tolerances = [], [], []
        for part in parts:
            if all(quantity in self.tolerances for quantity in part.quantities):
                directions.append(part.quantities)
                amounts.append(part.scale * self.tolerances[part.quantities[0]])
                replaces = not isinstance(EFFECTS[name].parameters[part.parameter].neutral, float | int)
                met = None if self.drifting & {*part.quantities} else Tolerance(part.quantities, amounts[-1], REACH, replaces)
                tolerances.append(met)
            else:
                tolerances.append(None)
                changed = {**neutral, part.parameter: neutral[part.parameter] + part.size}
                directions.append((self.probe(name, where, changed, part.parameter),))
                amounts.append(part.size)
        middle = [neutral[part.parameter] for part in parts]

        def values(a: Array) -> tuple[float, ...]:
            return tuple(float(n + size * k) for n, size, k in zip(middle, amounts, a, strict=True))

        self.add(name, where, [Start(tuple(directions), values)], mu, tuple(tolerances))

    def probe(self, name: str, where: Sequence[str], parameters: dict[str, float], note: str = "") -> str:
        key = " ".join([name, *where, note]).strip()
        self.probes.append(Probe(key, (PatchEffect(name, tuple(where), parameters),)))
        return key

    def add(
        self,
        name: str,
        where: Sequence[str],
        starts: Iterable[Start],
        robot_mu: float = 0.6,
        tolerances: tuple[Tolerance | None, ...] = (),
    ) -> None:
        candidate = Candidate(name, tuple(where), unknowns(name, robot_mu), tuple(starts), tolerances=tolerances)
        self.candidates.append(candidate)


def unknowns(name: str, mu: float) -> tuple[Unknown, ...]:
    """Return the parameters of a library effect as unknowns; their plausible range is the effect's prior."""
    found = []
    for key, spec in EFFECTS[name].parameters.items():
        neutral = spec.neutral if isinstance(spec.neutral, float | int) else mu
        low, high = spec.prior
        low = max(low, LEAST.get((name, key), low))
        step = 0.05 * (high - low)
        found.append(Unknown(key, spec.unit, float(neutral), low, high, step, key not in NO_SIZE))
    return tuple(found)


def robot_candidates(
    parameters: Parameters,
    tolerances: Mapping[str, float],
    measured: Sequence[Array],
    residuals: Sequence[Array],
    drifting: Set[str] = frozenset(),
) -> tuple[list[Probe], list[Candidate]]:
    """Return probes and candidates beyond a calibrated model.

    Args:
        parameters: (1) of the model.
        tolerances: of the quantities that calibration may move, by name.
        measured: (rows, signals) per run.
        residuals: of the model, (rows, signals) per run.
        drifting: names of the quantities that drift: no effect hides in their tolerance.
    """
    lists = _Lists(tolerances, drifting, [], [])
    mu = float(parameters["ground.mu_x"].mean())
    _friction_and_motors(lists)
    _backlash(lists)
    _ripple(lists, measured, residuals)
    _ground(lists, mu, float(parameters["wheel.radius"].mean()))
    _patch(lists, mu, measured)
    _loads(lists, float(parameters["body.mass"][0]))
    _sensors(lists)
    return lists.probes, lists.candidates


def _scaled(amount: float, neutral: float = 0.0) -> Callable[[Array], tuple[float, ...]]:
    return lambda amplitude: (neutral + amount * float(amplitude[0]),)


def _per_place(
    lists: _Lists,
    name: str,
    sets: Sequence[tuple[str, ...]],
    parameter: str,
    sizes: Sequence[float],
    neutral: float = 0.0,
    fixed: dict[str, float] | None = None,
    note: str = "",
) -> dict[tuple[str, ...], list[Start]]:
    """Probe every single place at every size; return the starts of every set."""
    singles = [places[0] for places in sets if len(places) == 1]
    starts: dict[tuple[str, ...], list[Start]] = {places: [] for places in sets}
    for size in sizes:
        label = f"{note} {size:g}".strip()
        keys = {s: lists.probe(name, (s,), {parameter: neutral + size, **(fixed or {})}, label) for s in singles}
        for places in sets:
            own = tuple(keys[place] for place in places if place in keys)
            starts[places].append(Start((own,), _scaled(size, neutral)))
    return starts


def _friction_and_motors(lists: _Lists) -> None:
    for places in _OF_LEGS + _OF_WHEELS:
        leg = places[0] in LEGS
        for name, parameter, quantity, size in (
            ("coulomb_friction", "torque", "servo.coulomb_friction", 0.03 if leg else 0.01),
            ("viscous_friction", "coefficient", "servo.viscous_friction", 0.02 if leg else 0.004),
        ):
            lists.add_known(name, places, [_Part(parameter, tuple(f"{quantity}[{place}]" for place in places), size)])
    for places, starts in _per_place(lists, "load_dependent_friction", _OF_JOINTS, "ratio", [0.1]).items():
        lists.add("load_dependent_friction", places, starts)
    for places, starts in _per_place(lists, "weak_motor", _OF_JOINTS[:-1], "scale", [-0.1], 1.0).items():
        lists.add("weak_motor", places, starts)
    for places, starts in _per_place(lists, "command_delay", _OF_JOINTS, "delay", [0.015]).items():
        lists.add("command_delay", places, starts, tolerances=_beside_latency(lists) if set(places) == set(JOINTS) else ())
    for kind in (_OF_LEGS, _OF_WHEELS):
        found: dict[tuple[str, ...], list[Start]] = {places: [] for places in kind}
        for speed in (0.1, 1.0):
            amount = 0.1 if kind is _OF_LEGS else 0.02
            more = _per_place(
                lists,
                "stribeck_friction",
                kind,
                "extra_static_torque",
                [amount],
                0.0,
                {"stribeck_speed": speed},
                f"at {speed:g}",
            )
            for places in kind:
                found[places].append(Start(more[places][0].directions, lambda a, s=speed, t=amount: (t * float(a[0]), s)))
        for places in kind:
            lists.add("stribeck_friction", places, found[places])
    sag = lists.probe("supply_sag", ("body",), {"resistance": 0.2})
    lists.add("supply_sag", ("body",), [Start(((sag,),), _scaled(0.2))])


def _beside_latency(lists: _Lists) -> tuple[Tolerance, ...]:
    """What a delay of all joints adds to: the latency of a host, known so well."""
    name = "command.delay"
    return (Tolerance((name,), lists.tolerances[name], REACH),) if name in lists.tolerances else ()


def _backlash(lists: _Lists) -> None:
    for places, starts in _per_place(lists, "backlash", _OF_LEGS + _OF_WHEELS, "angle", [0.01, 0.03]).items():
        lists.add("backlash", places, starts)


def _ripple(lists: _Lists, measured: Sequence[Array], residuals: Sequence[Array]) -> None:
    """One candidate per joint, at the period that its own residuals show best."""
    for joint in JOINTS:
        order = ripple_order(joint, measured, residuals)
        if order is None:
            continue
        amount = 0.05 if joint in LEGS else 0.02
        keys = [
            lists.probe(
                "torque_ripple", (joint,), {"amplitude": amount, "order": order, "phase": phase}, f"{order:g} {phase:.2f}"
            )
            for phase in (0.0, math.pi / 2)
        ]

        def values(a: Array, amount: float = amount, order: float = order) -> tuple[float, ...]:
            return amount * float(a[0]), amount * float(a[1]), order

        bound = EFFECTS["torque_ripple"].parameters["amplitude"].prior[1]
        waves = tuple(Unknown(name, "N m", 0.0, -bound, bound, amount) for name in ("sine", "cosine"))
        period = Unknown("order", "-", order, order - 0.5, order + 0.5, 0.02, is_size=False)
        start = Start(((keys[0],), (keys[1],)), values)
        lists.candidates.append(Candidate("torque_ripple", (joint,), (*waves, period), (start,), convert=_ripple_parameters))


def ripple_order(joint: str, measured: Sequence[Array], residuals: Sequence[Array]) -> float | None:
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
            if known.sum() < 20:
                continue
            waves = np.exp(1j * np.outer(orders, seen[known, angle]))
            waves -= waves.mean(axis=1, keepdims=True)
            left = residual[known, column] - residual[known, column].mean()
            power += np.abs(waves @ left) ** 2 / np.maximum((np.abs(waves) ** 2).sum(axis=1), 1e-9)
    return float(orders[int(np.argmax(power))])


def _ground(lists: _Lists, mu: float, radius: float) -> None:
    lists.add_known("friction_level", ("ground",), [_Part("mu", ("ground.mu",), -0.1)], mu)
    less = -0.25 * mu
    singles = {w: lists.probe("friction_asymmetry", (w,), {"mu": mu + less}) for w in WHEELS}
    for places in _OF_WHEELS[:-1]:
        keys = tuple(singles[place] for place in places)
        lists.add("friction_asymmetry", places, [Start((keys,), _scaled(less, mu))], mu)
    ratio = lists.probe("friction_anisotropy", ("ground",), {"ratio": 0.8})
    lists.add("friction_anisotropy", ("ground",), [Start(((ratio,),), _scaled(-0.2, 1.0))])
    starts = []
    for speed in (0.05, 0.3):
        key = lists.probe("slip_weakening", ("ground",), {"mu_k": 0.8 * mu, "slip_speed": speed}, f"{speed:g}")
        starts.append(Start(((key,),), lambda a, s=speed: (mu * (1 - 0.2 * float(a[0])), s)))
    lists.add("slip_weakening", ("ground",), starts, mu)
    for name, parameter, size in (("rolling_resistance", "coefficient", 0.02), ("tyre_creep", "creep_speed", 0.02)):
        for places, found in _per_place(lists, name, _OF_WHEELS, parameter, [size]).items():
            lists.add(name, places, found)
    for places in _OF_WHEELS:
        quantities = tuple(f"wheel.radius[{place}]" for place in places)
        lists.add_known("wheel_radius_error", places, [_Part("scale", quantities, 0.01, 1.0 / radius)])
    slopes = [_Part(axis, (f"ground.slope[{axis}]",), 0.01) for axis in ("pitch", "roll")]
    lists.add_known("floor_slope", ("ground",), slopes)


def _patch(lists: _Lists, mu: float, measured: Sequence[Array]) -> None:
    """Strips of floor across x: a patch starts as the best run of neighbouring strips."""
    x = CHANNELS.index("cam_x")
    reached = np.concatenate([seen[np.isfinite(seen[:, x]), x] for seen in measured])
    if reached.size == 0 or np.ptp(reached) < STRIP:
        return
    low, high = reached.min() - 0.2, reached.max() + 0.2
    edges = np.linspace(low, high, min(MOST_STRIPS, math.ceil((high - low) / STRIP)) + 1)
    less = -0.25 * mu
    keys = [
        lists.probe("friction_patch", ("ground",), {"mu": mu + less, "x_min": a, "x_max": b, **UNBOUNDED}, f"{a:.2f}")
        for a, b in itertools.pairwise(edges)
    ]
    found = []
    for first in range(len(keys)):
        for last in range(first, min(len(keys), first + 12)):
            a, b = float(edges[first]), float(edges[last + 1])
            middle, width = 0.5 * (a + b), b - a
            found.append(Start((tuple(keys[first : last + 1]),), lambda w, m=middle, d=width: (mu + less * float(w[0]), m, d)))
    level = next(unknown for unknown in unknowns("friction_patch", mu) if unknown.name == "mu")
    middle = Unknown("x_middle", "m", 0.0, low - 10.0, high + 10.0, 0.02, is_size=False)
    width = Unknown("x_width", "m", 0.0, 0.02, high - low + 10.0, 0.02, is_size=False)
    lists.candidates.append(
        Candidate("friction_patch", ("ground",), (level, middle, width), tuple(found), fixed=UNBOUNDED, convert=_area)
    )


def _area(values: Sequence[float]) -> dict[str, float]:
    """Coefficient and edges of a patch from its coefficient, middle and width."""
    mu, middle, width = map(float, values)
    return {"mu": mu, "x_min": middle - 0.5 * width, "x_max": middle + 0.5 * width}


def _loads(lists: _Lists, body_mass: float) -> None:
    mass = 0.15
    keys = [lists.probe("payload", ("body",), {"mass": mass, "x": 0.0, "y": 0.0, "z": 0.0}, "centre")]
    for axis in "xyz":
        place = {"x": 0.0, "y": 0.0, "z": 0.0, axis: 0.1}
        keys.append(lists.probe("payload", ("body",), {"mass": mass, **place}, axis))

    arm = 0.1 * mass
    lists.candidates.append(
        Candidate(
            "payload",
            ("body",),
            (
                Unknown("mass", "kg", 0.0, 0.0, 2.0, 0.1),
                *(Unknown(f"moment_{axis}", "kg m", 0.0, -0.2, 0.2, 0.01) for axis in "xyz"),
            ),
            (
                Start(
                    tuple((key,) for key in keys),
                    lambda a: (max(mass * float(a.sum()), 0.0), *(float(v) for v in arm * a[1:])),
                ),
            ),
            convert=_load,
            within=_carried,
            tolerances=_beside_body(lists, body_mass),
        )
    )
    lists.add_known("com_offset", ("body",), [_Part(axis, (f"body.com_offset[{axis}]",), 0.005) for axis in "xyz"])
    force = 0.5
    pulls = [
        lists.probe("external_force", ("body",), {"fx": fx, "fy": fy}, f"{fx:g} {fy:g}")
        for fx, fy in ((force, 0.0), (0.0, force))
    ]
    lists.add(
        "external_force", ("body",), [Start(tuple((key,) for key in pulls), lambda a: tuple(float(v) for v in force * a))]
    )
    spring = lists.probe("tether", ("body",), {"stiffness": 1.0, "x": 0.0, "y": 0.0})

    lists.candidates.append(
        Candidate(
            "tether",
            ("body",),
            (
                Unknown("stiffness", "N/m", 0.0, 0.0, 20.0, 0.5),
                *(Unknown(f"pull_{axis}", "N", 0.0, -20.0, 20.0, 0.2) for axis in "xy"),
            ),
            (
                Start(
                    ((spring,), *((key,) for key in pulls)),
                    lambda a: (max(float(a[0]), 0.0), *(float(v) for v in force * a[1:])),
                ),
            ),
            convert=_tether,
        )
    )


def _beside_body(lists: _Lists, body_mass: float) -> tuple[Tolerance | None, ...]:
    """What a load's mass and moments add to: a body weighed and balanced so well. Any load counts as an effect."""
    sizes = {"body.mass": 1.0, **{f"body.com_offset[{axis}]": body_mass for axis in "xyz"}}
    return tuple(
        Tolerance((name,), scale * lists.tolerances[name], reach=0.0) if name in lists.tolerances else None
        for name, scale in sizes.items()
    )


def _carried(values: Sequence[float]) -> tuple[float, ...]:
    """Mass and moments of a load that is carried no farther out than plausible."""
    mass = float(values[0])
    ranges = (EFFECTS["payload"].parameters[axis].prior for axis in "xyz")
    return mass, *(float(np.clip(m, mass * low, mass * high)) for m, (low, high) in zip(values[1:], ranges, strict=True))


def _load(values: Sequence[float]) -> dict[str, float]:
    """Mass and place of a load from its mass and moments; none is carried farther out than plausible."""
    mass = max(float(values[0]), 1e-6)
    places = {}
    for axis, moment in zip("xyz", values[1:], strict=True):
        low, high = EFFECTS["payload"].parameters[axis].prior
        places[axis] = float(np.clip(moment / mass, low, high))
    return {"mass": mass, **places}


def _tether(values: Sequence[float]) -> dict[str, float]:
    """Stiffness and anchor from stiffness and the pull at the floor's origin."""
    stiffness = max(float(values[0]), 1e-6)
    return {
        "stiffness": stiffness,
        **{axis: float(np.clip(pull / stiffness, -1e3, 1e3)) for axis, pull in zip("xy", values[1:], strict=True)},
    }


def _ripple_parameters(values: Sequence[float]) -> dict[str, float]:
    """Amplitude and phase from the two waves a ripple is made of."""
    sine, cosine, order = map(float, values)
    return {"amplitude": math.hypot(sine, cosine), "order": order, "phase": math.atan2(cosine, sine)}


def _sensors(lists: _Lists) -> None:
    for places in _OF_LEGS:
        quantities = tuple(f"joint.zero_offset[{place}]" for place in places)
        lists.add_known("joint_zero_offset", places, [_Part("angle", quantities, 0.01)])
    lists.add_known("gyro_bias", ("sensor",), [_Part(axis, (f"imu.gyro_bias[{axis}]",), 0.005) for axis in "xyz"])
    turn = 0.03
    keys = [
        lists.probe("imu_misalignment", ("sensor",), {**dict.fromkeys(("roll", "pitch", "yaw"), 0.0), axis: turn}, axis)
        for axis in ("roll", "pitch", "yaw")
    ]
    lists.add(
        "imu_misalignment",
        ("sensor",),
        [Start(tuple((key,) for key in keys), lambda a: tuple(float(v) for v in turn * a))],
    )
    yaw = _Part("yaw", ("camera.mount_yaw",), 0.02)
    lists.add_known("camera_misalignment", ("sensor",), [yaw, _Part("scale", ("camera.scale",), 0.02)])
    lists.add_known("camera_delay", ("sensor",), [_Part("delay", ("camera.delay",), 0.01)])
