"""Without a pose: which way the wheels of each side count, from how the gyroscope turns."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

from wlr_gym.data.logs.signals import GUESS, LIKELY, LogSignals
from wlr_gym.data.logs.suggest_body import lag_of_gyro, upward_axis, wheel_motion
from wlr_gym.data.logs.suggest_joints import JointFindings, is_given
from wlr_gym.robot import WHEELS
from wlr_gym.robot.parameter_table import XYZ

#: Correlation from which on wheels and gyroscope turn alike, and by how much one reading of the sides must beat the other.
_ALIKE, _MARGIN = 0.8, 0.2
_SIDES = {"left": ("wheel_lf", "wheel_lr"), "right": ("wheel_rf", "wheel_rr")}


@dataclass(frozen=True)
class _Reading:
    """Signs of the left and the right wheels, and how the gyroscope then turns with them, about which of its axes.

    ``is_clear``: at another lag it does not turn against them nearly as much.
    """

    left: int
    right: int
    correlation: float
    axis: str
    is_clear: bool


def find_sides(look: LogSignals, found: JointFindings) -> None:
    """Set the signs of the wheels as the gyroscope turns; where it does not show them, ``look.sided`` becomes False.

    Two readings are told apart by how well they go with the gyroscope: sides that count alike, or against each other. Which of
    the two signs a reading has as a whole, gravity shows: it says which way is up. A gyroscope that half a period later turns
    the other way as much shows neither.
    """
    if not look.has(*(f"pos_{wheel}" for wheel in WHEELS)) or any(is_given(look, wheel) for wheel in WHEELS):
        return
    readings = _readings(look, found)
    alike, opposed = (
        max((abs(one.correlation) for one in readings if one.left * one.right == k), default=0.0) for k in (1, -1)
    )
    text = f"turns with the gyroscope by {alike:.2f} where the sides count alike, by {opposed:.2f} where they do not"
    if max(alike, opposed) < _ALIKE or abs(alike - opposed) < _MARGIN:
        look.sided = False
        shown = f"no pose, and the gyroscope does not show it ({text})" if readings else "no pose and no gyroscope that turns"
        look.note("joints.wheel_*.sign", GUESS, f"left as in the log: {shown}; check that forward counts up on both sides")
        return
    fitting = [one for one in readings if one.left * one.right == (1 if alike > opposed else -1)]
    upward = upward_axis(look)
    if not fitting[0].is_clear:
        upward = None
    best = next((one for one in fitting if upward is not None and _turns_up(one, upward)), fitting[0])
    for side, sign in (("left", best.left), ("right", best.right)):
        for wheel in _SIDES[side]:
            found.joint_sign[wheel] = sign * found.joint_sign.get(wheel, 1)
    sure, by = (GUESS, "is not shown") if upward is None else (LIKELY, f"by gravity along {upward}")
    ways = f"left {best.left:+d}, right {best.right:+d}"
    look.note("joints.wheel_*.sign", sure, f"{ways}: no pose; {text}; which way as a whole, {by}")


def _readings(look: LogSignals, found: JointFindings) -> list[_Reading]:
    """Return the readings that wheels and gyroscope cover together long enough, those that change nothing first."""
    readings = []
    for left, right in product((1, -1), repeat=2):
        tried = JointFindings(found.unit, found.sign, dict(found.joint_sign), found.joint_zero)
        for wheel in WHEELS:
            tried.joint_sign[wheel] = found.joint_sign.get(wheel, 1) * (left if wheel in _SIDES["left"] else right)
        motion = wheel_motion(look, tried)
        assert motion is not None
        for axis in XYZ if look.has("gyro_x", "gyro_y", "gyro_z") else ():
            lag = lag_of_gyro(look, axis, motion)
            if lag is not None:
                is_clear = abs(lag.correlation) - lag.opposite > _MARGIN
                readings.append(_Reading(left, right, lag.correlation, axis, is_clear))
    return sorted(readings, key=lambda one: -abs(one.correlation))


def _turns_up(reading: _Reading, upward: str) -> bool:
    """Whether the gyroscope turns about the axis that points up, and the same way round."""
    return reading.axis == upward[-1] and (reading.correlation > 0) == (not upward.startswith("-"))
