"""How the body stands by its legs: four wheels on a floor give height, pitch and roll, which a film alone tells badly.

Left open are constants (the plate on the body, tyres), the zeros of the legs, and the slope of the floor against the plane of
its markers. No floor is quite flat: what the legs say wanders with the way that the wheels go.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.body_pose import rest_pose
from wlr_gym.perception.vision.alignment import repeated
from wlr_gym.perception.vision.tracking import Sample, angles
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: m, 1 sigma by which the floor under a wheel is off a plane, after a way as long as the body; of a row: tyres that give way.
UNEVEN, _SHAKEN = 0.0005, 0.0003
#: rad, 1 sigma of the zero of a leg whose robot file states none.
_ZERO = 0.01
#: 1 sigma of constants of height (m), pitch and roll (rad), and of the slopes.
_OPEN, _SLOPE = 0.02, 0.01
#: rad, and sigmas of a frame, by which film and legs may differ; frames that are averaged.
TILT_ERROR, SIGMAS, _TOGETHER = 0.012, 6.0, 5
#: Height, pitch and roll of a pose; how many numbers are left open: three constants, two slopes (x, y), four zeros.
STANDING, OPEN = [2, 4, 5], 9


@dataclass(frozen=True, eq=False)
class Stance:
    """What the legs say.

    Attributes:
        time: (K,) s. values: (K, 3) height, pitch, roll on a plane. by_zero: (K, 3, 4) change with the legs' zeros.
        variance: (3,) of a row. wander: (K, 3) variance per s. prior: (OPEN,) 1 sigma of what is left open.
    """

    time: Array
    values: Array
    by_zero: Array
    variance: Array
    wander: Array
    prior: Array

    def design(self, rows: NDArray[np.int64], poses: Array) -> Array:
        """Derivatives (N, 3, OPEN) by what is left open, of bodies at ``poses`` (N, 6) with the legs of these rows."""
        x, y, c, s = poses[:, 0], poses[:, 1], np.cos(poses[:, 3]), np.sin(poses[:, 3])
        slopes = np.stack([x, y, -c, -s, -s, c], axis=1).reshape(-1, 3, 2)
        return np.concatenate([np.tile(np.eye(3), (len(x), 1, 1)), slopes, self.by_zero[rows]], axis=2)


def stance(time: Array, joints: tuple[Array, Array], robot: Robot, parameters: Parameters) -> Stance:
    """What legs say by angles and rates (K, 8) of the joints, nominal zeros taken off."""
    (angle, rate), batch = joints, repeated(parameters, len(time))
    legs, length, width = angle[:, LEG_SLICE], *(2 * float(side) for side in parameters["hip.position"][0, :2])
    values = rest_pose(batch, legs)
    by_zero = np.stack([(rest_pose(batch, legs + turn) - values) / 1e-5 for turn in 1e-5 * np.eye(4)], axis=2)
    of_wheel = np.array([0.5, 1 / length, 1 / width]) ** 2
    pace = np.abs(rate[:, WHEEL_SLICE] * parameters["wheel.radius"]).mean(axis=1, keepdims=True)
    known = robot.tolerances.get("joint_zero")
    prior = np.repeat([_OPEN, _SLOPE, _ZERO if known is None else known.legs], [3, 2, 4])
    return Stance(time, values, by_zero, _SHAKEN**2 * of_wheel, pace * UNEVEN**2 / length * of_wheel, prior)


def floor_slope(samples: Sequence[Sample], offset: float, legs: Stance) -> tuple[Array, list[str]]:
    """Slopes (2,) of the floor in its markers' frame; and how film and legs contradict each other, in words."""
    seen = [sample for sample in samples if math.isfinite(sample.pose[0])]
    time, poses = np.array([sample.time for sample in seen]) + offset, np.stack([sample.pose for sample in seen])
    rows = np.clip(np.searchsorted(legs.time, time), 0, len(legs.time) - 1)
    design, rest = legs.design(rows, poses), poses[:, STANDING] - legs.values[rows]
    std = np.sqrt(np.stack([np.diag(sample.covariance)[STANDING] for sample in seen]))
    rough = UNEVEN**2 / _SHAKEN**2 * legs.variance
    by_weight = design / (std**2 + rough)[:, :, None]
    information = np.einsum("fki,fkj->ij", by_weight, design) + np.diag(legs.prior**-2)
    found = np.linalg.solve(information, np.einsum("fki,fk->i", by_weight, rest))
    return found[3:5], list(_differences(time, (rest - design @ found)[:, 1:], np.median(std[:, 1:], axis=0)))


def _differences(time: Array, rest: Array, std: Array) -> Iterator[str]:
    """Say about which of pitch and roll (F, 2) too much is left."""
    for k, axis in enumerate(("pitch", "roll")):
        mean = np.abs(np.convolve(rest[:, k], np.full(_TOGETHER, 1 / _TOGETHER), mode="valid"))
        worst = int(np.argmax(mean))
        if mean[worst] > max(TILT_ERROR, SIGMAS * float(std[k])):
            yield (
                f"the {axis} differs from what the legs say by {1e3 * mean[worst]:.0f} mrad, most at "
                f"{time[worst + _TOGETHER // 2]:.2f} s: a wheel off the floor, a floor that is not flat, or a marker that "
                "gives way; legs are not used"
            )


def levelled(samples: Sequence[Sample], slope: Array) -> tuple[Sample, ...]:
    """The samples in a frame whose x-y plane is the floor: that of the markers turned by a small tilt."""
    up = np.array([-slope[0], -slope[1], 1.0])
    ahead = np.array([1.0, 0.0, slope[0]])
    axes = np.stack([ahead, np.cross(up, ahead), up])
    turn = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return tuple(_turned(sample, turn) if math.isfinite(sample.pose[0]) else sample for sample in samples)


def _turned(sample: Sample, turn: Array) -> Sample:
    attitude = turn @ rotation(*sample.pose[3:, None])[0]
    return replace(sample, pose=np.concatenate([turn @ sample.pose[:3], angles(attitude)]))
