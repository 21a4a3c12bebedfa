"""What the data sets of a blind test hide: the laws as numbers for the simulator, and the sequence of the sets.

The sequence is endless and balanced: effects of the vocabulary, pairs, strange laws that are in no library, nothing, bad data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.bench.blind.copies import JOINTS, LEGS, WHEELS

Array = NDArray[np.float64]


@dataclass
class Hidden:
    """Numbers of every law, neutral at first. SI units; joints in the order of ``JOINTS``, wheels and legs lf, rf, lr, rr."""

    coulomb: Array = field(default_factory=lambda: np.zeros(8))
    viscous: Array = field(default_factory=lambda: np.zeros(8))
    stick_extra: Array = field(default_factory=lambda: np.zeros(8))
    stick_speed: Array = field(default_factory=lambda: np.ones(8))
    load_ratio: Array = field(default_factory=lambda: np.zeros(8))
    play: Array = field(default_factory=lambda: np.zeros(8))
    ripple: Array = field(default_factory=lambda: np.zeros((3, 8)))  # amplitude, order, phase
    motor_scale: Array = field(default_factory=lambda: np.ones(8))
    supply_resistance: float = 0.0
    delay: Array = field(default_factory=lambda: np.zeros(8))
    zero: Array = field(default_factory=lambda: np.zeros(4))
    wheel_mu: Array = field(default_factory=lambda: np.full(4, np.nan))  # instead of the floor's own
    mu_ratio: float = 1.0
    patch: Array = field(default_factory=lambda: np.array([np.nan, 0.0, 0.0, 0.0, 0.0]))  # mu, x and y limits
    weak_slip: Array = field(default_factory=lambda: np.array([np.nan, 1.0]))  # mu_k, speed
    creep_speed: Array = field(default_factory=lambda: np.zeros(4))
    bristles: Array = field(default_factory=lambda: np.stack([np.zeros(4), np.ones(4)]))  # slip per friction over load, m
    rolling: Array = field(default_factory=lambda: np.zeros(4))
    radius_scale: Array = field(default_factory=lambda: np.ones(4))
    payload: Array = field(default_factory=lambda: np.zeros(4))  # kg, x, y, z
    com: Array = field(default_factory=lambda: np.zeros(3))
    slope: Array = field(default_factory=lambda: np.zeros(2))
    force: Array = field(default_factory=lambda: np.zeros(2))
    tether: Array = field(default_factory=lambda: np.zeros(3))  # N/m, x, y
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))
    imu: Array = field(default_factory=lambda: np.zeros(3))  # roll, pitch, yaw
    camera_yaw: float = 0.0
    camera_scale: float = 1.0
    camera_delay: float = 0.0
    # laws that no library names
    leg_spring: Array = field(default_factory=lambda: np.zeros((2, 4)))  # N m/rad, rest angle
    drag: float = 0.0  # N s2/m2 along the body's x
    cross_ratio: Array = field(default_factory=lambda: np.zeros(2))  # front and rear axle
    pull: Array = field(default_factory=lambda: np.zeros(3))  # N along the floor's x, Hz, phase
    out_of_round: Array = field(default_factory=lambda: np.zeros(4))  # share of the radius
    elastic: Array = field(default_factory=lambda: np.zeros((2, 4)))  # Dahl hysteresis in the legs: N m, N m/rad
    veer: float = 0.0  # N s/m: sideways force per forward speed


def _each(joints: Sequence[str], names: Sequence[str]) -> list[int]:
    return [names.index(joint) for joint in joints]


Numbers = Mapping[str, float]
#: Writes an effect's places and numbers into those of the simulator.
Law = Callable[[Hidden, list[str], Numbers], None]


def _at(field_name: str, parameter: str, names: Sequence[str] = JOINTS, *, add: bool = True) -> Law:
    """Write one parameter into the places' elements of a field."""

    def write(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
        values = getattr(hidden, field_name)
        places = _each(where, names)
        values[places] = numbers[parameter] + (values[places] if add else 0.0)

    return write


def _times(field_name: str, parameter: str, names: Sequence[str]) -> Law:
    def write(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
        getattr(hidden, field_name)[_each(where, names)] *= numbers[parameter]

    return write


def _vector(field_name: str, *parameters: str) -> Law:
    def write(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
        setattr(hidden, field_name, np.array([numbers.get(name, 0.0) for name in parameters]))

    return write


def _scalar(field_name: str, parameter: str) -> Law:
    return lambda hidden, where, numbers: setattr(hidden, field_name, float(numbers[parameter]))


def _stribeck(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
    places = _each(where, JOINTS)
    hidden.stick_extra[places] = numbers["extra_static_torque"]
    hidden.stick_speed[places] = numbers["stribeck_speed"]


def _write_ripple(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
    for place in _each(where, JOINTS):
        hidden.ripple[:, place] = numbers["amplitude"], numbers["order"], numbers.get("phase", 0.0)


def _level(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
    hidden.wheel_mu[:] = numbers["mu"]


def _write_patch(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
    far = 1e6
    hidden.patch = np.array(
        [numbers["mu"], numbers["x_min"], numbers["x_max"], numbers.get("y_min", -far), numbers.get("y_max", far)]
    )


def _write_camera(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
    hidden.camera_yaw, hidden.camera_scale = numbers.get("yaw", 0.0), numbers.get("scale", 1.0)


def _both_rows(field_name: str, first: str, second: str, names: Sequence[str] = LEGS) -> Law:
    def write(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
        getattr(hidden, field_name)[:, _each(where, names)] = np.array([[numbers[first]], [numbers[second]]])

    return write


def _cross(hidden: Hidden, where: list[str], numbers: Numbers) -> None:
    for axle in range(2):
        if WHEELS[2 * axle] in where:
            hidden.cross_ratio[axle] = numbers["ratio"]


def hide(effects: Sequence[Mapping[str, Any]]) -> Hidden:
    """Translate effects, ``{name, where, parameters}``, into the numbers of their laws.

    Raises:
        KeyError: a name that is in no table.
    """
    hidden = Hidden()
    for effect in sorted(effects, key=lambda one: one["name"] != "friction_level"):  # a level is below what single wheels have
        law, _ = _EVERY[effect["name"]]
        law(hidden, list(effect["where"]), effect["parameters"])
    return hidden


# ---- which sets a blind test has -------------------------------------------------------------------------------------


#: In units of what tolerances and noise hide.
SEVERITIES = (0.5, 1.0, 2.0, 4.0)
#: The first seed of sets that are scored; smaller ones are for tuning.
FIRST_SCORED_SEED = 12000
#: Sets of the cycle below; the sets after them are :data:`FURTHER_NULLS` without an effect, for the bound on false alarms.
SETS = 240
FURTHER_NULLS = 160
#: Kinds of sets in the order they come round; any stretch of the sequence is a fair sample.
CYCLE = (
    "effect", "parameters", "effect", "pair", "effect", "none",
    "effect", "stranger", "effect", "parameters", "effect", "bad",
    "effect", "none", "effect", "parameters", "effect", "pair",
    "effect", "parameters", "effect", "stranger", "none", "parameters",
)  # fmt: skip
BAD = ("wrong_unit", "mis_ordered", "nan_ridden", "flipped_sign", "stuck_encoder", "too_short", "too_few", "motionless")

#: Kinds of runs of a set by how many there are, and how often: most have all eight, some what a shorter session records.
RUNS = {8: tuple(range(8)), 6: (0, 1, 2, 4, 5, 7), 4: (0, 1, 2, 7)}
RUNS_SHARE = {8: 0.6, 6: 0.25, 4: 0.15}
#: Share of the sets that a camera has seen.
CAMERA_SHARE = 0.5
#: Effects of the camera itself: it is there.
OF_CAMERA = ("camera_misalignment", "camera_delay")

Draw = np.random.Generator
Effect = dict[str, Any]
#: Draws an effect of a name at a severity.
Drawn = Callable[[str, float, Draw], Effect]
#: Draws its numbers at a severity.
Numbered = Callable[[float, Draw], Numbers]


@dataclass(frozen=True)
class BlindCase:
    """One data set of a blind test.

    Attributes:
        name: of its folder; says nothing.
        seed: of everything drawn in it.
        kind: ``none`` (the nominal robot), ``parameters`` (a copy within tolerances), ``effect``, ``pair``, ``stranger`` (a law
            that no library names), ``bad`` (spoilt data).
        severity: 0 where nothing is hidden.
        effects: what is hidden.
        spoilt: how, for ``bad``.
        runs: which of the eight kinds of runs it has.
        camera: whether one has seen it.
        bumps: rms height of its floor, m; None = drawn, see :func:`studies.bench.blind.copies.yielding`.
    """

    name: str
    seed: int
    kind: str
    severity: float
    effects: tuple[Effect, ...]
    spoilt: str = ""
    runs: tuple[int, ...] = RUNS[8]
    camera: bool = True
    bumps: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return what is hidden as plain data: how it is recorded shows in the data."""
        told = {name: value for name, value in vars(self).items() if name not in ("runs", "camera", "bumps")}
        return {**told, "effects": [dict(effect) for effect in self.effects]}


def case(index: int, first_seed: int = FIRST_SCORED_SEED) -> BlindCase:
    """Return number ``index`` of the sequence: :data:`SETS` that go round :data:`CYCLE`, then nulls."""
    seed = first_seed + index
    if index >= SETS:
        kind, count = ("none", "parameters")[index % 2], index
    else:
        kind = CYCLE[index % len(CYCLE)]
        before = sum(other == kind for other in CYCLE[: index % len(CYCLE)])
        count = (index // len(CYCLE)) * CYCLE.count(kind) + before  # how many of this kind came before
    rng = np.random.default_rng([seed, 4])
    severity, effects, spoilt = 0.0, (), ""
    if kind == "effect":
        name, severity = _grid(count, list(NAMED))
        effects = (named(name, severity, rng),)
    elif kind == "pair":
        severity, effects = 2.0, _pair(rng)
    elif kind == "stranger":
        severity = (2.0, 4.0)[count // len(STRANGE) % 2]
        effects = (strange(list(STRANGE)[count % len(STRANGE)], severity, rng),)
    elif kind == "bad":
        spoilt = BAD[count % len(BAD)]
    return BlindCase(f"set_{seed:04d}", seed, kind, severity, effects, spoilt, *_recorded(seed, effects))


#: The first seed of sets about tyres.
FIRST_TYRE_SEED = 20000
#: Sets about tyres: two of three are without an effect.
TYRE_SETS = 90
#: Severities of the elastic treads among them, in turn.
TYRE_SEVERITIES = (2.0, 1.0, 2.0, 3.0)
#: m, rms; height of the floor under all of them.
TYRE_BUMPS = 1e-4


def tyre_case(index: int, first_seed: int = FIRST_TYRE_SEED) -> BlindCase:
    """Return number ``index`` of the sets about tyres: elastic treads, and robots without any effect on the same floor."""
    seed, kind = first_seed + index, ("effect", "parameters", "none")[index % 3]
    severity = TYRE_SEVERITIES[index // 3 % len(TYRE_SEVERITIES)] if kind == "effect" else 0.0
    effects = (named("tyre_brush", severity, np.random.default_rng([seed, 4])),) if severity else ()
    return BlindCase(f"set_{seed:04d}", seed, kind, severity, effects, "", *_recorded(seed, effects), TYRE_BUMPS)


def _recorded(seed: int, effects: Sequence[Effect]) -> tuple[tuple[int, ...], bool]:
    """Which kinds of runs a set has, and whether with a camera."""
    rng = np.random.default_rng([seed, 6])
    count = int(rng.choice(list(RUNS_SHARE), p=list(RUNS_SHARE.values())))
    camera = bool(rng.random() < CAMERA_SHARE)
    return RUNS[count], camera or any(effect["name"] in OF_CAMERA for effect in effects)


def _grid(count: int, names: list[str]) -> tuple[str, float]:
    """Walk effects and severities so that neither repeats before the other has gone round."""
    order = np.random.default_rng(5).permutation(len(names))
    lap, place = divmod(count, len(names))
    return names[order[place]], SEVERITIES[(lap + place) % len(SEVERITIES)]


def _pair(rng: Draw) -> tuple[Effect, ...]:
    """Two effects of different names, each clear on its own."""
    first, second = rng.choice(list(NAMED), size=2, replace=False)
    return named(str(first), 2.0, rng), named(str(second), 2.0, rng)


# ---- severities ------------------------------------------------------------------------------------------------------


def _sign(rng: Draw) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _some(rng: Draw, names: tuple[str, ...]) -> list[str]:
    """One joint of its kind, an axle, or all."""
    kind = rng.choice(3, p=[0.55, 0.25, 0.2])
    if kind == 0:
        return [names[int(rng.integers(4))]]
    return list(names if kind == 2 else names[2 * int(rng.integers(2)) :][:2])


def _gears(leg: Callable[[float], Mapping[str, float]], wheel: Callable[[float], Mapping[str, float]]) -> Drawn:
    """An effect of gears: in legs or in wheels, whose sizes differ."""

    def make(name: str, severity: float, rng: Draw) -> Effect:
        in_legs = rng.random() < 0.5
        return _effect(name, _some(rng, LEGS if in_legs else WHEELS), (leg if in_legs else wheel)(severity))

    return make


def _effect(name: str, where: Sequence[str], parameters: Mapping[str, float]) -> Effect:
    return {"name": name, "where": list(where), "parameters": {key: float(f"{value:.5g}") for key, value in parameters.items()}}


def _fixed(place: str, numbers: Numbered) -> Drawn:
    return lambda name, severity, rng: _effect(name, [place], numbers(severity, rng))


def _wheels(numbers: Numbered) -> Drawn:
    return lambda name, severity, rng: _effect(name, _some(rng, WHEELS), numbers(severity, rng))


def _one(names: Sequence[str], numbers: Numbered) -> Drawn:
    return lambda name, severity, rng: _effect(name, [names[int(rng.integers(4))]], numbers(severity, rng))


def _direction(size: float, *names: str, **others: float) -> Numbered:
    """Two components of a vector of this size whose direction is drawn."""
    return lambda severity, rng: dict(zip(names, _around(rng, size * severity), strict=True)) | others


def _some_axes(size: float, most: int, *names: str) -> Numbered:
    """One axis or more, each with a sign of its own."""

    def numbers(severity: float, rng: Draw) -> Numbers:
        axes = rng.choice(names, size=int(rng.integers(1, most + 1)), replace=False)
        return {str(axis): _sign(rng) * size * severity for axis in sorted(axes)}

    return numbers


def _ripple(name: str, severity: float, rng: Draw) -> Effect:
    legs = rng.random() < 0.5
    size, order = (0.05, float(rng.integers(6, 13))) if legs else (0.012, float(rng.integers(2, 9)))
    numbers = {"amplitude": size * severity, "order": order, "phase": rng.uniform(-np.pi, np.pi)}
    return _effect(name, _some(rng, LEGS if legs else WHEELS), numbers)


def _delay(name: str, severity: float, rng: Draw) -> Effect:
    where = (JOINTS, WHEELS, LEGS)[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
    return _effect(name, where, {"delay": 0.015 * severity})


def _asymmetry(name: str, severity: float, rng: Draw) -> Effect:
    """One wheel, an axle or a side; all four would be a level."""
    groups = [[wheel] for wheel in WHEELS] + [list(WHEELS[:2]), list(WHEELS[2:]), list(WHEELS[::2]), list(WHEELS[1::2])]
    return _effect(name, groups[int(rng.integers(len(groups)))], {"mu": 0.6 / (1 + 0.35 * severity)})


def _patch(severity: float, rng: Draw) -> Numbers:
    start, side = rng.uniform(0.1, 0.25), _sign(rng)
    edges = sorted((side * start, side * (start + rng.uniform(0.4, 0.8))))
    return {"mu": 0.6 / (1 + 0.5 * severity), "x_min": edges[0], "x_max": edges[1]}


def _payload(severity: float, rng: Draw) -> Numbers:
    x, y, z = rng.uniform([-0.12, -0.1, 0.02], [0.12, 0.1, 0.1])
    return {"mass": 0.15 * severity, "x": x, "y": y, "z": z}


def _around(rng: Draw, size: float) -> tuple[float, float]:
    angle = rng.uniform(-np.pi, np.pi)
    return size * np.cos(angle), size * np.sin(angle)


def _tether(severity: float, rng: Draw) -> Numbers:
    x, y = _around(rng, rng.uniform(0.2, 0.6))
    return {"stiffness": 0.6 * severity, "x": x, "y": y}


def _camera(severity: float, rng: Draw) -> Numbers:
    if rng.random() < 0.5:
        return {"yaw": _sign(rng) * 0.0262 * severity}
    return {"scale": 1 + _sign(rng) * 0.015 * severity}


def _brush(severity: float, rng: Draw) -> Numbers:
    """Rubber at severity 1; the way over which it builds friction up is a few millimetres, whatever it is made of."""
    return {"slip_compliance": 0.05 * severity, "relaxation_length": rng.uniform(0.004, 0.006)}


#: Effects of the vocabulary: what each does in the simulator, and how it is drawn. Severity 1 is three tolerances or somewhat
#: more where a tolerance hides it (by definition what 2.5 tolerances explain is no effect; of a vector the larger part has as
#: much), else what the noise hides.
NAMED: Mapping[str, tuple[Law, Drawn]] = {
    "coulomb_friction": (_at("coulomb", "torque"), _gears(lambda s: {"torque": 0.08 * s}, lambda s: {"torque": 0.025 * s})),
    "viscous_friction": (
        _at("viscous", "coefficient"),
        _gears(lambda s: {"coefficient": 0.04 * s}, lambda s: {"coefficient": 0.008 * s}),
    ),
    "stribeck_friction": (
        _stribeck,
        _gears(
            lambda s: {"extra_static_torque": 0.08 * s, "stribeck_speed": 0.1},
            lambda s: {"extra_static_torque": 0.025 * s, "stribeck_speed": 0.5},
        ),
    ),
    "load_dependent_friction": (
        _at("load_ratio", "ratio"),
        _gears(lambda s: {"ratio": 0.08 * s}, lambda s: {"ratio": 0.09 * s}),
    ),
    "backlash": (_at("play", "angle"), _gears(lambda s: {"angle": 0.008 * s}, lambda s: {"angle": 0.012 * s})),
    "torque_ripple": (_write_ripple, _ripple),
    "weak_motor": (
        _times("motor_scale", "scale", JOINTS),
        _gears(lambda s: {"scale": 1 - 0.15 * s}, lambda s: {"scale": 1 - 0.15 * s}),
    ),
    "supply_sag": (_scalar("supply_resistance", "resistance"), _fixed("body", lambda s, _: {"resistance": 0.08 * s})),
    "command_delay": (_at("delay", "delay"), _delay),
    "joint_zero_offset": (_at("zero", "angle", LEGS), _one(LEGS, lambda s, rng: {"angle": _sign(rng) * 0.0262 * s})),
    "friction_level": (_level, _fixed("ground", lambda s, _: {"mu": 0.6 / (1 + 0.45 * s)})),
    "friction_asymmetry": (_at("wheel_mu", "mu", WHEELS, add=False), _asymmetry),
    "friction_anisotropy": (_scalar("mu_ratio", "ratio"), _fixed("ground", lambda s, _: {"ratio": 1 / (1 + 0.25 * s)})),
    "friction_patch": (_write_patch, _fixed("ground", _patch)),
    "slip_weakening": (
        _vector("weak_slip", "mu_k", "slip_speed"),
        _fixed("ground", lambda s, _: {"mu_k": 0.6 / (1 + 0.3 * s), "slip_speed": 0.05}),
    ),
    "tyre_creep": (_at("creep_speed", "creep_speed", WHEELS, add=False), _wheels(lambda s, _: {"creep_speed": 0.008 * s})),
    "rolling_resistance": (_at("rolling", "coefficient", WHEELS), _wheels(lambda s, _: {"coefficient": 0.03 * s})),
    "wheel_radius_error": (
        _times("radius_scale", "scale", WHEELS),
        _one(WHEELS, lambda s, rng: {"scale": 1 + _sign(rng) * 0.015 * s}),
    ),
    "payload": (_vector("payload", "mass", "x", "y", "z"), _fixed("body", _payload)),
    "com_offset": (_vector("com", "x", "y", "z"), _fixed("body", _direction(0.0128, "x", "y", z=0.0))),
    "floor_slope": (_vector("slope", "pitch", "roll"), _fixed("ground", _direction(0.0149, "pitch", "roll"))),
    "external_force": (_vector("force", "fx", "fy"), _fixed("body", _direction(0.3, "fx", "fy"))),
    "tether": (_vector("tether", "stiffness", "x", "y"), _fixed("body", _tether)),
    "gyro_bias": (_vector("gyro_bias", "x", "y", "z"), _fixed("sensor", _some_axes(0.003, 3, "x", "y", "z"))),
    "imu_misalignment": (_vector("imu", "roll", "pitch", "yaw"), _fixed("sensor", _some_axes(0.02, 2, "roll", "pitch", "yaw"))),
    "camera_misalignment": (_write_camera, _fixed("sensor", _camera)),
    "camera_delay": (_scalar("camera_delay", "delay"), _fixed("sensor", lambda s, _: {"delay": 0.03 * s})),
}


#: Effects that the cycle of :func:`case` does not have: it would draw other sets with them.
LATER: Mapping[str, tuple[Law, Drawn]] = {
    "tyre_brush": (_both_rows("bristles", "slip_compliance", "relaxation_length", WHEELS), _wheels(_brush)),
}


def _axle(name: str, severity: float, rng: Draw) -> Effect:
    return _effect(name, list(WHEELS[2 * int(rng.integers(2)) :][:2]), {"ratio": 0.1 * severity})


def _pull(severity: float, rng: Draw) -> Numbers:
    return {"amplitude": 0.8 * severity, "frequency": rng.uniform(0.4, 1.2), "phase": rng.uniform(-np.pi, np.pi)}


#: Laws that no library names, likewise.
STRANGE: Mapping[str, tuple[Law, Drawn]] = {
    "leg_spring": (_both_rows("leg_spring", "stiffness", "rest"), _one(LEGS, lambda s, _: {"stiffness": 0.2 * s, "rest": 1.2})),
    "body_drag": (_scalar("drag", "coefficient"), _fixed("body", lambda s, _: {"coefficient": 25.0 * s})),
    "cross_friction": (_cross, _axle),
    "periodic_pull": (_vector("pull", "amplitude", "frequency", "phase"), _fixed("body", _pull)),
    "out_of_round": (
        _at("out_of_round", "share", WHEELS),
        _one(WHEELS, lambda s, _: {"share": 0.015 * s}),
    ),
    "elastic_hysteresis": (
        _both_rows("elastic", "torque", "stiffness"),
        _one(LEGS, lambda s, _: {"torque": 0.1 * s, "stiffness": 1.0 * s}),
    ),
    "veer": (_scalar("veer", "coefficient"), _fixed("body", lambda s, _: {"coefficient": 4.0 * s})),
}


_EVERY = {**NAMED, **LATER, **STRANGE}


def named(name: str, severity: float, rng: Draw) -> Effect:
    """Draw an effect of the vocabulary at a severity: its place, its signs, its parameters."""
    return _EVERY[name][1](name, severity, rng)


def strange(name: str, severity: float, rng: Draw) -> Effect:
    """Draw a law that no library names."""
    return _EVERY[name][1](name, severity, rng)
