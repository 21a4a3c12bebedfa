"""Which data sets a blind test has: an endless, balanced sequence of hidden effects, pairs, strangers, nothing and bad data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from studies.bench.blind.copies import JOINTS, LEGS, WHEELS
from studies.bench.blind.truth import NAMED, STRANGE

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
    """

    name: str
    seed: int
    kind: str
    severity: float
    effects: tuple[Effect, ...]
    spoilt: str = ""
    runs: tuple[int, ...] = RUNS[8]
    camera: bool = True

    def as_dict(self) -> dict[str, Any]:
        """Return what is hidden as plain data: how it is recorded shows in the data."""
        told = {name: value for name, value in vars(self).items() if name not in ("runs", "camera")}
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


# --- severities -------------------------------------------------------------------------------------------------------


def _sign(rng: Draw) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _some(rng: Draw, names: tuple[str, ...]) -> list[str]:
    """One joint of its kind, an axle, or all."""
    kind = rng.choice(3, p=[0.55, 0.25, 0.2])
    if kind == 0:
        return [names[int(rng.integers(4))]]
    return list(names if kind == 2 else names[2 * int(rng.integers(2)) :][:2])


def _gears(leg: Callable[[float], Mapping[str, float]], wheel: Callable[[float], Mapping[str, float]]) -> Callable[..., Effect]:
    """An effect of gears: in legs or in wheels, whose sizes differ."""

    def make(name: str, severity: float, rng: Draw) -> Effect:
        in_legs = rng.random() < 0.5
        return _effect(name, _some(rng, LEGS if in_legs else WHEELS), (leg if in_legs else wheel)(severity))

    return make


def _effect(name: str, where: Sequence[str], parameters: Mapping[str, float]) -> Effect:
    return {"name": name, "where": list(where), "parameters": {key: float(f"{value:.5g}") for key, value in parameters.items()}}


def _fixed(place: str, numbers: Callable[[float, Draw], Mapping[str, float]]) -> Callable[..., Effect]:
    return lambda name, severity, rng: _effect(name, [place], numbers(severity, rng))


def _wheels(numbers: Callable[[float, Draw], Mapping[str, float]]) -> Callable[..., Effect]:
    return lambda name, severity, rng: _effect(name, _some(rng, WHEELS), numbers(severity, rng))


def _ripple(name: str, severity: float, rng: Draw) -> Effect:
    legs = rng.random() < 0.5
    size, order = (0.05, float(rng.integers(6, 13))) if legs else (0.012, float(rng.integers(2, 9)))
    numbers = {"amplitude": size * severity, "order": order, "phase": rng.uniform(-np.pi, np.pi)}
    return _effect(name, _some(rng, LEGS if legs else WHEELS), numbers)


def _delay(name: str, severity: float, rng: Draw) -> Effect:
    where = (JOINTS, WHEELS, LEGS)[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
    return _effect(name, where, {"delay": 0.015 * severity})


def _zero(name: str, severity: float, rng: Draw) -> Effect:
    return _effect(name, [LEGS[int(rng.integers(4))]], {"angle": _sign(rng) * 0.0262 * severity})


def _asymmetry(name: str, severity: float, rng: Draw) -> Effect:
    """One wheel, an axle or a side; all four would be a level."""
    groups = [[wheel] for wheel in WHEELS] + [list(WHEELS[:2]), list(WHEELS[2:]), list(WHEELS[::2]), list(WHEELS[1::2])]
    return _effect(name, groups[int(rng.integers(len(groups)))], {"mu": 0.6 / (1 + 0.35 * severity)})


def _radius(name: str, severity: float, rng: Draw) -> Effect:
    return _effect(name, [WHEELS[int(rng.integers(4))]], {"scale": 1 + _sign(rng) * 0.015 * severity})


def _patch(severity: float, rng: Draw) -> Mapping[str, float]:
    start, side = rng.uniform(0.1, 0.25), _sign(rng)
    edges = sorted((side * start, side * (start + rng.uniform(0.4, 0.8))))
    return {"mu": 0.6 / (1 + 0.5 * severity), "x_min": edges[0], "x_max": edges[1]}


def _payload(severity: float, rng: Draw) -> Mapping[str, float]:
    x, y, z = rng.uniform([-0.12, -0.1, 0.02], [0.12, 0.1, 0.1])
    return {"mass": 0.15 * severity, "x": x, "y": y, "z": z}


def _around(rng: Draw, size: float) -> tuple[float, float]:
    angle = rng.uniform(-np.pi, np.pi)
    return size * np.cos(angle), size * np.sin(angle)


def _centre(severity: float, rng: Draw) -> Mapping[str, float]:
    x, y = _around(rng, 0.0128 * severity)
    return {"x": x, "y": y, "z": 0.0}


def _slope(severity: float, rng: Draw) -> Mapping[str, float]:
    pitch, roll = _around(rng, 0.0149 * severity)
    return {"pitch": pitch, "roll": roll}


def _wind(severity: float, rng: Draw) -> Mapping[str, float]:
    x, y = _around(rng, 0.3 * severity)
    return {"fx": x, "fy": y}


def _tether(severity: float, rng: Draw) -> Mapping[str, float]:
    x, y = _around(rng, rng.uniform(0.2, 0.6))
    return {"stiffness": 0.6 * severity, "x": x, "y": y}


def _gyro(severity: float, rng: Draw) -> Mapping[str, float]:
    axes = rng.choice(["x", "y", "z"], size=int(rng.integers(1, 4)), replace=False)
    return {str(axis): _sign(rng) * 0.003 * severity for axis in sorted(axes)}


def _imu(severity: float, rng: Draw) -> Mapping[str, float]:
    axes = rng.choice(["roll", "pitch", "yaw"], size=int(rng.integers(1, 3)), replace=False)
    return {str(axis): _sign(rng) * 0.02 * severity for axis in sorted(axes)}


def _camera(severity: float, rng: Draw) -> Mapping[str, float]:
    if rng.random() < 0.5:
        return {"yaw": _sign(rng) * 0.0262 * severity}
    return {"scale": 1 + _sign(rng) * 0.015 * severity}


#: How much of each effect is severity 1: three tolerances or somewhat more where a tolerance hides it (by definition what 2.5
#: tolerances explain is no effect; of a vector the larger part has as much), else what the noise hides.
_NAMED: Mapping[str, Callable[..., Effect]] = {
    "coulomb_friction": _gears(lambda s: {"torque": 0.08 * s}, lambda s: {"torque": 0.025 * s}),
    "viscous_friction": _gears(lambda s: {"coefficient": 0.04 * s}, lambda s: {"coefficient": 0.008 * s}),
    "stribeck_friction": _gears(
        lambda s: {"extra_static_torque": 0.08 * s, "stribeck_speed": 0.1},
        lambda s: {"extra_static_torque": 0.025 * s, "stribeck_speed": 0.5},
    ),
    "load_dependent_friction": _gears(lambda s: {"ratio": 0.08 * s}, lambda s: {"ratio": 0.09 * s}),
    "backlash": _gears(lambda s: {"angle": 0.008 * s}, lambda s: {"angle": 0.012 * s}),
    "torque_ripple": _ripple,
    "weak_motor": _gears(lambda s: {"scale": 1 - 0.15 * s}, lambda s: {"scale": 1 - 0.15 * s}),
    "supply_sag": _fixed("body", lambda s, _: {"resistance": 0.08 * s}),
    "command_delay": _delay,
    "joint_zero_offset": _zero,
    "friction_level": _fixed("ground", lambda s, _: {"mu": 0.6 / (1 + 0.45 * s)}),
    "friction_asymmetry": _asymmetry,
    "friction_anisotropy": _fixed("ground", lambda s, _: {"ratio": 1 / (1 + 0.25 * s)}),
    "friction_patch": _fixed("ground", _patch),
    "slip_weakening": _fixed("ground", lambda s, _: {"mu_k": 0.6 / (1 + 0.3 * s), "slip_speed": 0.05}),
    "tyre_creep": _wheels(lambda s, _: {"creep_speed": 0.008 * s}),
    "rolling_resistance": _wheels(lambda s, _: {"coefficient": 0.03 * s}),
    "wheel_radius_error": _radius,
    "payload": _fixed("body", _payload),
    "com_offset": _fixed("body", _centre),
    "floor_slope": _fixed("ground", _slope),
    "external_force": _fixed("body", _wind),
    "tether": _fixed("body", _tether),
    "gyro_bias": _fixed("sensor", _gyro),
    "imu_misalignment": _fixed("sensor", _imu),
    "camera_misalignment": _fixed("sensor", _camera),
    "camera_delay": _fixed("sensor", lambda s, _: {"delay": 0.03 * s}),
}


def _one_leg(numbers: Callable[[float], Mapping[str, float]]) -> Callable[..., Effect]:
    return lambda name, severity, rng: _effect(name, [LEGS[int(rng.integers(4))]], numbers(severity))


def _axle(name: str, severity: float, rng: Draw) -> Effect:
    return _effect(name, list(WHEELS[2 * int(rng.integers(2)) :][:2]), {"ratio": 0.1 * severity})


def _pull(severity: float, rng: Draw) -> Mapping[str, float]:
    return {"amplitude": 0.8 * severity, "frequency": rng.uniform(0.4, 1.2), "phase": rng.uniform(-np.pi, np.pi)}


_STRANGE: Mapping[str, Callable[..., Effect]] = {
    "leg_spring": _one_leg(lambda s: {"stiffness": 0.2 * s, "rest": 1.2}),
    "body_drag": _fixed("body", lambda s, _: {"coefficient": 25.0 * s}),
    "cross_friction": _axle,
    "periodic_pull": _fixed("body", _pull),
    "out_of_round": lambda name, severity, rng: _effect(name, [WHEELS[int(rng.integers(4))]], {"share": 0.015 * severity}),
    "elastic_hysteresis": _one_leg(lambda s: {"torque": 0.1 * s, "stiffness": 1.0 * s}),
    "veer": _fixed("body", lambda s, _: {"coefficient": 4.0 * s}),
}


def named(name: str, severity: float, rng: Draw) -> Effect:
    """Draw an effect of the vocabulary at a severity: its place, its signs, its parameters."""
    return _NAMED[name](name, severity, rng)


def strange(name: str, severity: float, rng: Draw) -> Effect:
    """Draw a law that no library names."""
    return _STRANGE[name](name, severity, rng)
