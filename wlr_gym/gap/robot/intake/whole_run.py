"""Checks of a run as a whole: long enough, a clock that fits the motion, motors on, something moves."""

from __future__ import annotations

import numpy as np

from wlr_gym.data.check import increments
from wlr_gym.data.format import COMMANDS
from wlr_gym.data.read import Run
from wlr_gym.gap.robot.intake.check import Array, ChannelFault, Outcome, Sound, rate_of
from wlr_gym.robot import JOINTS, LEGS, Robot

#: s; shorter runs hold no window to compare.
LEAST_SECONDS = 3.0
#: s without a row. Of what was written to the servos meanwhile nothing is known, and the replay would hold the setpoints from
#: before: a robot goes 0.2 m in this time.
LONGEST_HOLE = 1.0
#: rad/s, root of the sum of squares over the joints, from which on angles show how much time has passed: at this speed the
#: encoders' rounding (0.4 mrad) is 2 ms.
SHOWS_TIME = 0.5
#: s that a row's time may differ from what the angles say. Encoders and their rates agree to 1.4 ms on all data at hand,
#: backlash of 35 mrad to 3.5; a logger that stamps rows late is off by some ms.
LATE = 0.030
#: rad by which every single joint may differ from where its rate leads, for a step of the clock to be called a jump.
MISSED = 0.03
#: Share by which the clock may run faster or slower than the servos' rates say.
CLOCK_RATE = 0.2
#: rad that a joint must turn to show its rate.
TURNED = 0.2
#: rad; legs that stay within this (13 counts) stand, and so do wheels that stay within 3.4 mm of travel.
LEG_STANDS, WHEEL_STANDS = 0.02, 0.1


def too_short(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a run is long enough for a window to be compared."""
    seconds = float(run["t"][-1] - run["t"][0])
    if seconds >= LEAST_SECONDS:
        return Sound.YES
    expected = f"at least {LEAST_SECONDS:g} s, better 15 to 25 s"
    return ChannelFault(None, f"the run is {seconds:.2f} s long", expected, "record a longer run")


def clock_jumps(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether time steps where the motion does not, or the other way round.

    Angles go on by their rates times the true time between two rows. Where that says the usual period and the clock another
    step, the clock has jumped; where rows were lost both say the same.
    """
    time = run["t"]
    steps = np.diff(time)
    passed, missed, speed = _time_by_angles(run)
    late = (np.abs(passed - steps) > LATE) & (speed > SHOWS_TIME) & (missed < MISSED)
    late &= np.abs(passed - np.median(steps)) < LATE  # else rows were lost, in which the rates may have changed
    hole = steps > LONGEST_HOLE
    if not (late | hole).any():
        return Sound.YES
    row = int(np.argmax(late | hole))
    step, count = f"{steps[row]:.3g} s from row {row} to the next", int((late | hole).sum())
    text = (
        f"{step}, in which the joints moved as in {1e3 * passed[row]:.0f} ms" if late[row] else f"{step}, nothing between them"
    )
    text = f"{text} ({count} times in the run)" if count > 1 else text
    expected = "a monotonic clock, rows 20 ms apart; single lost rows do no harm"
    return ChannelFault(row, text, expected, "split the run there into two files, or record it again with a monotonic clock")


def clock_rate(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the clock runs as fast as the servos' rates say; one joint alone would be its rate's fault."""
    turning = [joint for joint in JOINTS if f"vel_{joint}" in run and np.ptp(run[f"pos_{joint}"]) > TURNED]
    if not turning:
        return Sound.UNDECIDED
    rate = float(np.median([_angle_over_rate(run, joint) for joint in turning]))
    if not abs(rate - 1.0) > CLOCK_RATE:
        return Sound.YES
    text = f"by the servos' rates {rate:.2f} times as much time passes between rows as the clock says"
    return ChannelFault(0, text, "seconds", "write the time at which each row was read, in s")


def _angle_over_rate(run: Run, joint: str) -> float:
    """Slope of a joint's turning over the integral of its rate, over half a second each."""
    rate = run[f"vel_{joint}"]
    rows = np.isfinite(rate)
    turned, measured = increments(run["t"][rows], run[f"pos_{joint}"][rows], rate[rows])
    return float(turned @ measured) / max(float(measured @ measured), 1e-12)


def _time_by_angles(run: Run) -> tuple[Array, Array, Array]:
    """Time between rows (rows - 1,) by what the joints turn, s; the largest angle it leaves unexplained, rad; speed, rad/s."""
    angles = np.stack([np.diff(run[f"pos_{joint}"]) for joint in JOINTS])
    rates = np.stack([0.5 * (rate[1:] + rate[:-1]) for rate in (rate_of(run, joint) for joint in JOINTS)])
    squares = np.sum(rates**2, axis=0)
    passed = np.sum(rates * angles, axis=0) / np.maximum(squares, 1e-12)
    return passed, np.max(np.abs(angles - rates * passed), axis=0), np.sqrt(squares)


def motors_off(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether no motor was on in the whole run."""
    if np.isfinite(np.stack([run[name] for name in COMMANDS])).any():
        return Sound.YES
    text = "no motor was on in the whole run: nothing to replay"
    return ChannelFault(None, text, "setpoints in the columns cmd_*", "record the setpoints; NaN is for motors that are off")


def stands_still(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether no joint moves: such a run shows nothing of the model, and as held-out run proves nothing."""
    for joint in JOINTS:
        if np.ptp(run[f"pos_{joint}"]) > (LEG_STANDS if joint in LEGS else WHEEL_STANDS):
            return Sound.YES
    text = f"no leg moves by more than {LEG_STANDS:g} rad and no wheel by more than {WHEEL_STANDS:g} rad in the whole run"
    expected = "a robot that drives or moves its legs"
    return ChannelFault(None, text, expected, "switch the motors on and record motions made for it: wlr record --list")
