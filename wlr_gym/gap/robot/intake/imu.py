"""Checks of the inertial sensors: unit, sign, mounting, range, life."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.check import increments
from wlr_gym.data.read import Run
from wlr_gym.gap.robot.intake.check import Array, ChannelFault, Outcome, Sound, correlation, moving
from wlr_gym.gap.robot.intake.joints import LEAST_ROWS, OPPOSITE
from wlr_gym.robot import LEGS, WHEELS, Robot

#: Turning by the gyroscope over turning by another sensor that means degrees per second: 57.3 against a true reference. Wheels
#: that slip in a turn show two to three times the turn, and accelerations more tilt than there is: 17 to 57. Sound: 0.2 to 1.
IN_DEGREES = 8.0
#: Correlation of the two from which on they tell of the same motion.
TOGETHER = 0.8
#: rad in half a second, one sigma, by which the reference must turn: wheels' rounding is 0.0003, the tilt's noise 0.0014.
LEAST_TURN = 0.004
#: Noise of the gyroscope at rest over the robot file's that means degrees per second: within a factor of four of 57. Below
#: :data:`IN_DEGREES` it is in rad/s; sound data have 0.5 to 1.1.
NOISE_IN_DEGREES = (15.0, 230.0)
#: s over which accelerations are averaged to show a tilt.
AVERAGED = 0.2
#: m/s2; the accelerometer's z reads about +9.8 at rest, so that half of all readings below this hang upside down.
UPSIDE_DOWN = -5.0
#: Rows at rest that show a sensor's noise.
LEAST_AT_REST = 15
#: Standard deviation of a normal variable over the median of its magnitude.
NORMAL = 1.4826
#: Rows at a channel's extreme that mean a range that ends there: noise repeats no value so often.
AT_END = 6
#: Rows there over rows at the levels next to it. A sensor of coarse resolution has fewer at its extreme than inside.
PILED_UP = 5.0
#: s for which a noisy sensor must repeat one value to be stuck.
STUCK = 0.5

IMU = ("gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z")


def in_degrees(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the gyroscope is in degrees per second, by what else shows the turning, else by its noise at rest."""
    for name, angle in _references(run, channel, robot):
        turned, measured, together = _turning(run, channel, angle)
        if turned < LEAST_TURN or abs(together) < TOGETHER:
            continue
        if measured < IN_DEGREES * turned:
            return Sound.YES
        text = f"turns {measured / turned:.0f} times as much as {name} (correlation {together:.2f})"
        return _degrees(int(np.argmax(np.abs(np.nan_to_num(run[channel])))), text)
    noise = _noise_at_rest(run, channel) / robot.sensors.imu.gyro_noise
    if 0.0 < noise < IN_DEGREES:
        return Sound.YES
    if NOISE_IN_DEGREES[0] < noise < NOISE_IN_DEGREES[1]:
        return _degrees(0, f"its noise at rest is {noise:.0f} times the robot file's")
    return Sound.UNDECIDED


def _degrees(row: int, text: str) -> ChannelFault:
    return ChannelFault(row, f"{text}: degrees per second?", "rad/s", "multiply by pi/180 = 0.017453")


def _turning(run: Run, channel: str, angle: Array) -> tuple[float, float, float]:
    """How far an angle and a gyroscope turn in half a second (standard deviations, rad), and their correlation."""
    finite = np.isfinite(run[channel]) & np.isfinite(angle)
    if finite.sum() < LEAST_ROWS:
        return 0.0, 0.0, 0.0
    return correlation(*increments(run["t"][finite], np.unwrap(angle[finite]), run[channel][finite]))


def _references(run: Run, channel: str, robot: Robot) -> list[tuple[str, Array]]:
    """What else shows how far the body turned about an axis, the best first: names and angles (rows,), rad."""
    camera = {"gyro_z": "cam_yaw", "gyro_y": "cam_pitch"}.get(channel, "")
    seen = [(camera, run[camera])] if camera in run and np.isfinite(run[camera]).sum() >= LEAST_ROWS else []
    return [*seen, *_references_on_board(run, channel, robot)]


def _references_on_board(run: Run, channel: str, robot: Robot) -> list[tuple[str, Array]]:
    if channel == "gyro_z":
        return [("the wheels", _yaw_of_wheels(run, robot))]
    across = "acc_y" if channel == "gyro_x" else "acc_x"
    if not all(name in run and np.isfinite(run[name]).sum() >= LEAST_ROWS for name in (across, "acc_z")):
        return []
    tilt = np.arctan2(_averaged(run, across), _averaged(run, "acc_z"))
    return [("gravity in the accelerometer", tilt if channel == "gyro_x" else -tilt)]


def _yaw_of_wheels(run: Run, robot: Robot) -> Array:
    """Heading (rows,), rad, of a body whose wheels roll without slip: spins in the body's frame, legs included."""
    travel = {w: run[f"pos_{w}"] + run[f"pos_{leg}"] for w, leg in zip(WHEELS, LEGS, strict=True)}
    right = travel["wheel_rf"] + travel["wheel_rr"]
    left = travel["wheel_lf"] + travel["wheel_lr"]
    return (right - left) * (robot.wheel.radius / (4.0 * robot.hip_position.y))


def _averaged(run: Run, channel: str) -> Array:
    """A channel (rows,) averaged over :data:`AVERAGED` seconds."""
    known = np.isfinite(run[channel])
    values = np.interp(run["t"], run["t"][known], run[channel][known])
    half = max(1, round(0.5 * AVERAGED / float(np.median(np.diff(run["t"])))))
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), mode="valid")


def _noise_at_rest(run: Run, channel: str) -> float:
    """Noise (one sigma), from rows in which nothing has moved since the row before; NaN where they are too few."""
    changes = np.diff(run[channel])[~moving(run)[1:]]
    changes = changes[np.isfinite(changes)]
    return float(np.median(np.abs(changes))) * NORMAL / math.sqrt(2.0) if len(changes) >= LEAST_AT_REST else math.nan


def gyro_against(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the gyroscope turns against the camera, or where that shows nothing against wheels or gravity."""
    remedy = "check the mounting in the hardware file, and the camera's axes"
    for name, angle in _references(run, channel, robot):
        turned, measured, together = _turning(run, channel, angle)
        if min(turned, measured) < LEAST_TURN or abs(together) < TOGETHER:
            continue
        if together > OPPOSITE:
            return Sound.YES
        text = f"turns against {name} (correlation {together:.2f})"
        return ChannelFault(int(np.argmax(np.abs(np.nan_to_num(run[channel])))), text, "a correlation near 1", remedy)
    return Sound.UNDECIDED


def upside_down(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the accelerometer shows gravity itself, or its z axis points down."""
    middle = float(np.nanmedian(run[channel]))
    if middle > UPSIDE_DOWN:
        return Sound.YES
    expected = "+9.8 at rest, the push of the floor"
    return ChannelFault(None, f"reads {middle:.1f} m/s2 (median)", expected, "check its mounting in the hardware file")


def saturated(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether readings pile up, bit-equal, at a channel's extreme while the robot moves: its range ends there."""
    rows = np.isfinite(run[channel]) & moving(run)
    levels, counts = np.unique(run[channel][rows], return_counts=True)
    if len(levels) < AT_END:
        return Sound.YES
    for end, inside in ((0, slice(1, 6)), (-1, slice(-6, -1))):
        if counts[end] >= AT_END and counts[end] > PILED_UP * float(np.mean(counts[inside])):
            text = f"{counts[end]} rows at its extreme of {levels[end]:.4g}, bit for bit"
            row = int(np.argmax(rows & (run[channel] == levels[end])))
            return ChannelFault(
                row, text, "a range that the motion does not reach", "set a wider range of the sensor and record again"
            )
    return Sound.YES


def without_signal(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a sensor that has noise repeats one value while the robot moves.

    A simulation without noise may do so rightly: a run whose other channels repeat themselves at rest is left alone.
    """
    if not _has_noise(run):
        return Sound.UNDECIDED
    same = (np.diff(run[channel], prepend=np.nan) == 0.0) | ~np.isfinite(run[channel])
    first, longest = _longest(same)
    seconds = float(run["t"][first + longest - 1] - run["t"][first]) if longest else 0.0
    if seconds < STUCK or not moving(run)[first : first + longest].any() or np.isnan(run[channel][first]):
        return Sound.YES
    text = f"reads {run[channel][first]:.4g} for {seconds:.2f} s while the robot moves"
    return ChannelFault(first, text, "noise at least", "leave the column out, or record it again: check the sensor's cable")


def _has_noise(run: Run) -> bool:
    """Whether any inertial channel changes from row to row while nothing moves; yes where something always moves."""
    still = ~moving(run)
    if still.sum() < LEAST_AT_REST:
        return True
    names = [name for name in IMU if name in run]
    return any(len(np.unique(run[name][still][np.isfinite(run[name][still])])) > 0.5 * still.sum() for name in names)


def _longest(chosen: NDArray[np.bool_]) -> tuple[int, int]:
    """First row and length of the longest stretch of chosen rows."""
    edges = np.flatnonzero(np.diff(chosen.astype(np.int8), prepend=0, append=0))
    if not len(edges):
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    return int(edges[::2][np.argmax(lengths)]), int(lengths.max())
