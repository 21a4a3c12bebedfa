"""How the body stands by its legs: four wheels on a floor give height, pitch and roll, which a film alone tells badly.

Only changes count. Left open are constants (the plate on the body, tyres), the zeros of the legs, and the slope of the floor
against the plane of its markers: on a straight way it is a constant. No floor is quite flat, and tyres give way with their
loads: the floor under each wheel wanders up and down with the way that wheel and leg go.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.body_pose import rest_pose
from wlr_gym.perception.vision.alignment import repeated
from wlr_gym.perception.vision.tracking import Sample
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: m, 1 sigma by which the floor under a wheel is off a plane, after a way as long as the body.
UNEVEN = 0.0005
#: m, 1 sigma of the height of a wheel's axle, mean of _MEAN s: legs and tyres that spring.
_SHAKEN, _MEAN = 0.0003, 0.02
#: rad, 1 sigma of the zero of a leg whose robot file states none.
_ZERO = 0.01
#: 1 sigma of constants of height (m), pitch and roll (rad), and of the slopes.
_OPEN, _SLOPE = 0.02, 0.01
#: Sigmas by which a change may differ between film and legs; frames that are averaged; s over which changes are compared: those
#: of a step, and of a lift.
SIGMAS, _TOGETHER, _LAGS = 4.0, 5, (0.3, 1.0, 4.0)
#: Height, pitch and roll of a pose; how many numbers are left open: constants, floor under each wheel, slopes (x, y), zeros.
STANDING, _OPENS = [2, 4, 5], (3, 4, 2, 4)
OPEN, UNDER_WHEELS = sum(_OPENS), slice(3, 7)


@dataclass(frozen=True, eq=False)
class LegReadings:
    """What the legs say.

    Attributes:
        time: (K,) s. values: (K, 3) height, pitch, roll on a plane. by_wheel: (K, 3, 4) change with the floor under each wheel.
        by_zero: (K, 3, 4) with the legs' zeros. noise: (K, 3, 3) of a row. wander: (K, 4) m2/s, of the floor under each wheel.
        prior: (OPEN,) 1 sigma of what is left open.
    """

    time: Array
    values: Array
    by_wheel: Array
    by_zero: Array
    noise: Array
    wander: Array
    prior: Array

    def design(self, poses: Array) -> Array:
        """Derivatives (K, 3, OPEN) by what is left open, of bodies at ``poses`` (K, 6)."""
        x, y, c, s = poses[:, 0], poses[:, 1], np.cos(poses[:, 3]), np.sin(poses[:, 3])
        slopes = np.stack([x, y, -c, -s, -s, c], axis=1).reshape(-1, 3, 2)
        return np.concatenate([np.tile(np.eye(3), (len(x), 1, 1)), self.by_wheel, slopes, self.by_zero], axis=2)

    def at(self, time: Array) -> LegReadings:
        """What they say at other times, between the rows."""
        names = ("values", "by_wheel", "by_zero", "noise", "wander")
        return replace(self, time=time, **{name: _between(time, self.time, getattr(self, name)) for name in names})


def leg_readings(time: Array, joints: tuple[Array, Array], robot: Robot, parameters: Parameters) -> LegReadings:
    """What legs say by angles and rates (K, 8) of the joints, nominal zeros taken off."""
    legs, rate = joints[0][:, LEG_SLICE], joints[1]
    values = rest_pose(repeated(parameters, len(time)), legs)

    def change(wheel: Array, zero: Array) -> Array:
        moved = Parameters(parameters.values.copy())
        moved["wheel.radius"] = moved["wheel.radius"] + wheel  # as the floor under it
        return (rest_pose(repeated(moved, len(time)), legs + zero) - values) / 1e-5

    steps = 1e-5 * np.eye(4)
    by_wheel = np.stack([change(step, np.zeros(4)) for step in steps], axis=2)
    by_zero = np.stack([change(np.zeros(4), step) for step in steps], axis=2)
    length, period = 2 * float(parameters["hip.position"][0, 0]), float(np.median(np.diff(time)))
    noise = _SHAKEN**2 * _MEAN / period * by_wheel @ by_wheel.transpose(0, 2, 1)
    way = np.abs(rate[:, WHEEL_SLICE] * parameters["wheel.radius"]) + np.abs(rate[:, LEG_SLICE] * parameters["leg.length"])
    known = robot.tolerances.get("joint_zero")
    prior = np.repeat([_OPEN, UNEVEN, _SLOPE, _ZERO if known is None else known.legs], _OPENS)
    return LegReadings(time, values, by_wheel, by_zero, noise, way * UNEVEN**2 / length, prior)


def leg_findings(samples: Sequence[Sample], time: Array, legs: LegReadings) -> Iterator[str]:
    """How a film contradicts the legs, in words: by changes of height, pitch or roll that the model does not allow.

    Args:
        samples: of the film, without outliers. time: (F,) s of them, servo clock; those outside the legs' are not compared.
    """
    within = (time >= legs.time[0]) & (time <= legs.time[-1])
    seen = [(t, s) for t, s, fine in zip(time.tolist(), samples, within, strict=True) if fine and math.isfinite(s.pose[0])]
    if len(seen) <= _TOGETHER:
        return
    time, poses = np.array([t for t, _ in seen]), np.stack([sample.pose for _, sample in seen])
    variance = np.stack([np.diag(sample.covariance)[STANDING] for _, sample in seen])
    legs = legs.at(time)
    wandered = np.cumsum(np.diff(time, prepend=time[0])[:, None] * legs.wander, axis=0)
    variance = variance + np.diagonal(legs.noise, axis1=1, axis2=2) / _TOGETHER
    means = [_mean(a) for a in (time, poses[:, STANDING] - legs.values, legs.design(poses), wandered, variance)]
    steps = [max(_TOGETHER, round(lag / float(np.median(np.diff(time))))) for lag in _LAGS]
    changes = [_changes(step, legs.prior, *means) for step in steps if step < len(means[0])]
    for k, name, unit in ((0, "height", "mm"), (1, "pitch", "mrad"), (2, "roll", "mrad")):
        sigmas, size, when = max(change[k] for change in changes) if changes else (0.0, 0.0, 0.0)
        if sigmas > SIGMAS:
            yield (
                f"the {name} differs from what the legs say by {1e3 * size:.1f} {unit}, most at {when:.2f} s: a wheel off the "
                "floor, a floor that is not flat, or a marker that gives way; legs are not used"
            )


def _changes(
    step: int, prior: Array, time: Array, rest: Array, design: Array, wandered: Array, variance: Array
) -> list[tuple[float, float, float]]:
    """Of height, pitch and roll the largest change over this many frames: sigmas, size, time."""
    by_open = design[step:] - design[:-step]
    by_wheel = np.maximum(np.abs(design[step:]), np.abs(design[:-step]))[:, :, UNDER_WHEELS]
    allowed = variance[step:] + variance[:-step] + np.einsum("fki,i->fk", by_open**2, prior**2)
    allowed += np.einsum("fki,fi->fk", by_wheel**2, wandered[step:] - wandered[:-step])
    size = np.abs(rest[step:] - rest[:-step])
    sigmas, middle = size / np.sqrt(allowed), 0.5 * (time[step:] + time[:-step])
    return [(float(sigmas[i, k]), float(size[i, k]), float(middle[i])) for k, i in enumerate(np.argmax(sigmas, axis=0))]


def _mean(values: Array) -> Array:
    """Means of frames that follow each other."""
    total = np.cumsum(np.concatenate([np.zeros_like(values[:1]), values]), axis=0)
    return (total[_TOGETHER:] - total[:-_TOGETHER]) / _TOGETHER


def _between(at: Array, time: Array, rows: Array) -> Array:
    """Rows (K, ...) at other times, linear."""
    flat = [np.interp(at, time, column) for column in rows.reshape(len(time), -1).T]
    return np.stack(flat, axis=1).reshape(len(at), *rows.shape[1:])
