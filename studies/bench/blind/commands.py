"""Eight kinds of runs: what the operator's script writes to the servos, as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DOWN = np.pi / 2
#: Half the span of leg angles that a run may ask for, around straight down.
REACH = 1.12
#: Corners, in the order left front, right front, left rear, right rear.
FRONT = slice(0, 2)
REAR = slice(2, 4)
LEFT = slice(0, 4, 2)
RIGHT = slice(1, 4, 2)
NAMES = (
    "straight, accelerating and braking",
    "posture sweeps while driving",
    "skid turns, arcs and spins in place",
    "S-curves",
    "stop-and-go with reversals",
    "rear legs turning, front wheels driven, rear wheels free",
    "front and rear legs turning, front wheels driven, rear wheels free",
    "band-limited random commands",
)


@dataclass(frozen=True)
class BlindScript:
    """Setpoints over time.

    Attributes:
        duration: s.
        setpoints: times (n,) -> setpoints (n, 8), rad for legs, rad/s for wheels, NaN = torque off.
    """

    duration: float
    setpoints: Callable[[Array], Array]


@dataclass(frozen=True)
class Geometry:
    """What the operator knows of the robot: leg length and wheel radius, m."""

    leg_length: float
    radius: float


def scripts(rng: np.random.Generator, geometry: Geometry) -> list[BlindScript]:
    """Draw the eight runs in the order of ``NAMES``."""
    rear_legs, all_legs = partial(turning, both=False), partial(turning, both=True)
    makers = (straight, posture, skid, curves, stop_and_go, rear_legs, all_legs, random_band)
    return [maker(rng, geometry) for maker in makers]


def _stance(rng: np.random.Generator, width: float = 0.5) -> Array:
    """Front and rear legs at mirrored angles about straight down, (4,)."""
    half = rng.uniform(-0.08, width)
    return DOWN + np.array([-half, -half, half, half])


def _steps(edges: Array, values: Array) -> Callable[[Array], Array]:
    """Piecewise constant rows: ``values[k]`` from ``edges[k]`` on."""
    return lambda t: values[np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(values) - 1)]


def _phases(rng: np.random.Generator, rows: list[Array], hold: tuple[float, float], rest: tuple[float, float]) -> tuple:
    """Return the end and the step function of a second's rest, each row for a while (zeros: rests), and a second's rest."""
    edges, values, now = [0.0], [np.zeros(4)], 1.0
    for row in rows:
        edges.append(now)
        values.append(np.asarray(row, dtype=float))
        now += rng.uniform(*(hold if np.any(row) else rest))
    edges.append(now)
    values.append(np.zeros(4))
    return now + 1.0, _steps(np.array(edges), np.array(values))


def _with_legs(legs: Array, wheels: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda t: np.concatenate([np.broadcast_to(legs, (len(t), 4)), wheels(t)], axis=1)


def straight(rng: np.random.Generator, geometry: Geometry) -> BlindScript:
    """Forward and backward at several speeds, resting between."""
    speeds = rng.uniform(1.0, 5.5, 5) * np.where(rng.permutation(5) % 2, 1, -1)
    rows = [row for speed in speeds for row in (np.full(4, speed), np.zeros(4))][:-1]
    end, wheels = _phases(rng, rows, (2.0, 3.2), (0.6, 1.1))
    return BlindScript(end, _with_legs(_stance(rng), wheels))


def skid(rng: np.random.Generator, geometry: Geometry) -> BlindScript:
    """Spins in place, turns about one side, arcs."""
    rows = []
    for kind in rng.permutation([0, 0, 0, 1, 1, 2, 2]):
        fast, turn = rng.uniform(2.5, 5.0), rng.choice([-1, 1])
        left, right = {0: (-fast, fast), 1: (0.0, fast), 2: (0.35 * fast, fast)}[int(kind)]
        left, right = (left, right) if turn > 0 else (right, left)
        rows += [rng.choice([-1, 1]) * np.array([left, right, left, right]), np.zeros(4)]
    end, wheels = _phases(rng, rows[:-1], (2.0, 2.9), (0.3, 0.6))
    return BlindScript(end, _with_legs(_stance(rng, 0.1), wheels))


def curves(rng: np.random.Generator, geometry: Geometry) -> BlindScript:
    """Weaving left and right at constant speed."""
    mean, swing, period = rng.uniform(2.4, 3.4), rng.uniform(1.0, 1.8), rng.uniform(4.5, 7.0)
    direction, end, sides = rng.choice([-1, 1]), rng.uniform(16.5, 19.0), np.array([1, -1, 1, -1])

    def wheels(t: Array) -> Array:
        envelope = np.clip(np.minimum((t - 1) / 0.5, (end - 1 - t) / 0.5), 0, 1)
        wave = np.sin(2 * np.pi * (t - 1) / period)
        return direction * (envelope[:, None] * (mean + swing * wave[:, None] * sides))

    return BlindScript(end, _with_legs(_stance(rng, 0.3), wheels))


def stop_and_go(rng: np.random.Generator, geometry: Geometry) -> BlindScript:
    """Random speeds for random times, straight, with stops and reversals."""
    rows: list[Array] = []
    for _ in range(rng.integers(12, 15)):
        previous = rows[-1][0] if rows else 0.0
        sign = -1.0 if (previous > 0) ^ (rng.random() < 0.45) else 1.0
        stop = previous != 0 and rng.random() < 0.35
        rows.append(np.zeros(4) if stop else np.full(4, sign * rng.uniform(2.0, 5.2)))
    end, wheels = _phases(rng, rows, (0.7, 1.8), (0.3, 0.7))
    return BlindScript(end, _with_legs(_stance(rng), wheels))


def posture(rng: np.random.Generator, geometry: Geometry) -> BlindScript:
    """Front, rear and all legs swing while the robot drives; the wheels turn along so that nothing has to slip."""
    speed, start = rng.choice([-1, 1]) * rng.uniform(1.2, 2.0), _stance(rng, 0.1)
    knots, angles = [0.0, 1.5], [start, start]
    for group in (0, 1, 2, 0, 1, 2)[: rng.integers(5, 7)]:
        target = start.copy()
        swing = rng.choice([-1, 1]) * rng.uniform(0.3, 0.5)
        for legs, sign in ((FRONT, 1.0), (REAR, -1.0 if rng.random() < 0.7 else 1.0)):
            if group == 2 or (group == 0) == (legs is FRONT):
                target[legs] += sign * swing
        ramp, hold = abs(swing) / rng.uniform(0.5, 0.8), rng.uniform(0.1, 0.5)
        for extra, row in ((ramp, target), (hold, target), (ramp, start), (hold, start)):
            knots.append(knots[-1] + extra)
            angles.append(row)
    table, rows = np.array(knots), np.array(angles)
    end = knots[-1] + 2.0
    turn_back = rng.uniform(0.4, 0.6) * end

    def setpoints(t: Array) -> Array:
        legs = np.stack([np.interp(t, table, rows[:, k]) for k in range(4)], axis=1)
        rates = (np.stack([np.interp(t + 1e-3, table, rows[:, k]) for k in range(4)], axis=1) - legs) / 1e-3
        drive = np.interp(t, [1.0, 1.5, turn_back, turn_back + 0.3, end - 1.5, end - 1.0], [0, speed, speed, -speed, -speed, 0])
        travel = -geometry.leg_length * np.sin(legs) * rates / geometry.radius
        return np.concatenate([legs, drive[:, None] + travel - rates], axis=1)

    return BlindScript(end, setpoints)


def turning(rng: np.random.Generator, geometry: Geometry, both: bool) -> BlindScript:
    """Rear legs, or all against each other, turn from one end of their range to the other; rear wheels free."""
    low, high = DOWN - rng.uniform(0.95, 1.06), DOWN + rng.uniform(0.95, 1.06)
    speed, turning, ramp = rng.uniform(1.4, 2.2), rng.uniform(5.0, 6.5), rng.uniform(4.0, 5.0)
    end = rng.uniform(17.5, 19.0)
    rear = (high, low) if both else (low, high)

    def setpoints(t: Array) -> Array:
        share = np.clip((t - 1) / turning, 0, 1)
        front_angle = low + (high - low) * share if both else np.full(len(t), low)
        rear_angle = rear[0] + (rear[1] - rear[0]) * share
        drive = np.where(t < end - 1.5, speed * np.clip((t - 1) / ramp, 0, 1), 0.0)
        free = np.full(len(t), np.nan)
        return np.stack([front_angle, front_angle, rear_angle, rear_angle, drive, drive, free, free], axis=1)

    return BlindScript(end, setpoints)


def random_band(rng: np.random.Generator, geometry: Geometry) -> BlindScript:
    """Sums of sines: wheels left and right apart, legs of an axle nearly together."""
    end, stance = rng.uniform(20.0, 23.0), _stance(rng, 0.35)
    wheel_waves = _waves(rng, 2, (0.1, 0.6), 2.4)
    leg_waves, own_waves = _waves(rng, 2, (0.08, 0.35), 0.17), _waves(rng, 4, (0.08, 0.35), 0.02)

    def setpoints(t: Array) -> Array:
        envelope = np.clip(np.minimum(t - 1, end - 1 - t), 0, 1)[:, None]
        axle = leg_waves(t)[:, [0, 0, 1, 1]]
        legs = np.clip(stance + envelope * (axle + own_waves(t)), DOWN - REACH, DOWN + REACH)
        wheels = np.clip(envelope * wheel_waves(t)[:, [0, 1, 0, 1]], -5.6, 5.6)
        return np.concatenate([legs, wheels], axis=1)

    return BlindScript(end, setpoints)


def _waves(rng: np.random.Generator, count: int, band: tuple[float, float], rms: float) -> Callable[[Array], Array]:
    frequency, phase = rng.uniform(*band, (7, count)), rng.uniform(0, 2 * np.pi, (7, count))
    amplitude = rms * np.sqrt(2 / 7)
    return lambda t: amplitude * np.sin(2 * np.pi * frequency * t[:, None, None] + phase).sum(axis=1)
