"""How the body stands by its legs: four wheels on a floor give height, pitch and roll, which a film alone tells badly.

Only changes count. Left open are constants (the plate on the body, tyres), the zeros of the legs, and the slope of the floor
against the plane of its markers: on a straight way it is a constant. No floor is quite flat, and tyres give way with their
loads: the floor under each wheel wanders up and down with the way that wheel and leg go. A wheel that is dragged goes as far as
the others roll.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.body_pose import rest_pose
from wlr_gym.perception.vision.alignment import repeated
from wlr_gym.perception.vision.tracking import Sample
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: m, 1 sigma by which the floor under a wheel is off a plane, after a way as long as the body.
UNEVEN = 0.001
#: How many times a leg's own way counts: it shifts the loads.
_SPRINGY = 2.0
#: m, 1 sigma of the height of a wheel's axle, mean of _MEAN s: legs and tyres that spring.
_SHAKEN, _MEAN = 0.0003, 0.02
#: rad, 1 sigma of the zero of a leg whose robot file states none.
_ZERO = 0.01
#: 1 sigma of constants of height (m), pitch and roll (rad), and of the slopes.
_OPEN, _SLOPE = 0.02, 0.01
#: Sigmas by which legs may change a pose; share of its variance that they are taken to take off at least.
SIGMAS, _LEAST = 4.0, 0.1
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
    rolled = np.abs(rate[:, WHEEL_SLICE] * parameters["wheel.radius"])
    rolled = np.maximum(rolled, rolled.mean(axis=1, keepdims=True))
    way = rolled + _SPRINGY * np.abs(rate[:, LEG_SLICE] * parameters["leg.length"])
    known = robot.tolerances.get("joint_zero")
    prior = np.repeat([_OPEN, UNEVEN, _SLOPE, _ZERO if known is None else known.legs], _OPENS)
    return LegReadings(time, values, by_wheel, by_zero, noise, way * UNEVEN**2 / length, prior)


def leg_findings(
    time: Array, film: tuple[Array, Array], joined: tuple[Array, Array], samples: Sequence[Sample]
) -> Iterator[str]:
    """How a film contradicts the legs, in words: by height, pitch or roll that the legs change more than their model allows.

    Hausman's test: if that model holds, the variance of the change is what the legs take off the variance of the pose. Means
    over as many frames as the film is smoothed over are compared: where a drive starts with a jerk, that is too much.

    Args:
        time: (K,) s. film, joined: poses (K, 6) and their 1 sigma, smoothed without and with the legs. samples: of the film.
    """
    seen = [sample for sample in samples if math.isfinite(sample.pose[0])]
    noise = np.median([np.diag(sample.covariance) for sample in seen], axis=0)
    frames = float(np.median(np.diff([sample.time for sample in seen]))) / float(np.median(np.diff(time)))  # rows of one
    smoothed_over = frames * noise / np.median(film[1] ** 2, axis=0)
    smoothed_over[2] = max(smoothed_over[2], smoothed_over[4])  # the wheels tie the height to the pitch
    for k, name, unit in zip(STANDING, ("height", "pitch", "roll"), ("mm", "mrad", "mrad"), strict=True):
        rows = min(len(time), max(1, round(smoothed_over[k])))
        change, before, after, when = (
            np.convolve(values, np.full(rows, 1 / rows), mode="valid")
            for values in (joined[0][:, k] - film[0][:, k], film[1][:, k] ** 2, joined[1][:, k] ** 2, time)
        )
        sigmas = np.abs(change) / np.sqrt(np.maximum(before - after, _LEAST * before))
        worst = int(np.argmax(sigmas))
        if sigmas[worst] > SIGMAS:
            size = f"{1e3 * abs(change[worst]):.1f} {unit} ({sigmas[worst]:.0f} sigmas)"
            yield (
                f"the {name} differs from what the legs say, which would change it by {size}, most at {when[worst]:.2f} s: a "
                "wheel off the floor, a floor that is not flat, or a marker that gives way; legs are not used"
            )
