"""Checks of joints: encoders that are dead, stuck, wrapped or mirrored; rates and efforts of the wrong sign."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.check import increments
from wlr_gym.data.read import Run
from wlr_gym.gap.robot.intake.check import Array, ChannelFault, Outcome, Sound, correlation, place, rate_of
from wlr_gym.physics import servo
from wlr_gym.robot import LEGS, Robot
from wlr_gym.robot.description import Motor

#: Rows that a correlation needs.
LEAST_ROWS = 100
#: Share of the time of half a turn at no-load speed in which no joint gets half a turn further, be it dragged.
TOO_QUICK = 0.5
#: rad; a joint that is asked to move more than this ...
ASKED = 0.2
#: ... and moves less than this share of it is dead.
SHOWN = 0.02
#: s for which an encoder that is stuck reads one and the same count; no delay or profile holds a joint so long.
STUCK = 0.3
#: Share of the stall torque that the controller asks for meanwhile: 3.6 N m of a leg, 0.75 N m of a wheel, more than any
#: friction of gears or floor.
PUSHED = 0.5
#: Encoder counts of lag that a leg's effort must change by without the encoder: 12 mrad, 0.4 N m; sound data reach 2.
LEAST_COUNTS = 8
#: Rows for which a leg's encoder is held, for its effort to tell: the noise of the effort is 0.3 mrad of lag.
LEAST_HELD = 25
#: Measured effort over what the controller asks for, from which on the servo does see its joint held: the joint is blocked or
#: its motor limp, which is no fault of the data.
SEES = 0.5
#: Ratio of measured to commanded wheel motion that means a turned sign.
MIRRORED = -0.5
#: rad in half a second by which an angle and its rate both must turn, one sigma.
TURNED = 0.02
#: Correlation of a rate with its angle's turning that means a turned sign.
OPPOSITE = -0.8
#: Mean product of a leg's effort and its lag behind the goal, over the product of their rms, that means a turned sign of the
#: effort. A servo pushes towards its goal: with the right sign 0.99 in the median, and 0.10 with 0.35 N m of dry friction.
PUSHES_AWAY = -0.5
#: Partial correlation of a wheel's effort with the voltage its controller asks for, beside its rate, below which the effort
#: does not answer the controller. With the right sign 0.95 to 1.00 on all data at hand.
ANSWERS = 0.5
#: V, rms, of that voltage beside what goes with the rate: less is the noise of the rates.
ASKED_VOLTAGE = 0.1


def wrapped(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether an angle starts anew after a turn: no joint gets half a turn further between rows so close together."""
    longest = TOO_QUICK * np.pi / _motor(robot, place(channel)).no_load_speed
    jumps = np.flatnonzero((np.abs(np.diff(run[channel])) > np.pi) & (np.diff(run["t"]) < longest))
    if not len(jumps):
        return Sound.YES
    row = int(jumps[0]) + 1
    text = f"jumps {len(jumps)} times, first by {run[channel][row] - run[channel][row - 1]:.3g} rad in row {row}"
    return ChannelFault(row, text, "angles that go on past a turn", "numpy.unwrap mends it")


def dead(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a joint shows nothing of what it is asked to do, in the whole run."""
    joint = place(channel)
    asked, shown = _motions(run, joint)
    if not len(asked) or _size(joint, asked) < ASKED:
        return Sound.YES if np.ptp(run[channel]) > 0.0 else Sound.UNDECIDED
    if _size(joint, shown) >= SHOWN * _size(joint, asked) or _sees(run, joint, robot, slice(None)):
        return Sound.YES
    text = f"commanded to move by {_size(joint, asked):.2g} rad and shows {_size(joint, shown):.2g} rad"
    return ChannelFault(_first_asked(run, joint), text, *_FOLLOWS)


_FOLLOWS = "an encoder that follows", "dead encoder, or the motor is not on: check its cable and its torque switch"


def stuck(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether an encoder reads one and the same count while the controller pushes harder than any friction can hold.

    Or, of a leg, while its effort changes: that is gain times lag, so that an effort cannot change unless the angle does.
    """
    joint = place(channel)
    held = np.diff(run[channel], prepend=np.nan) == 0.0
    pushed = np.abs(asked_torque(run, joint, robot)) > PUSHED * _motor(robot, joint).stall_torque
    for start, end in _stretches(pushed & held):
        rows = slice(start, end)
        if run["t"][end - 1] - run["t"][start] > STUCK and not _sees(run, joint, robot, rows):
            return ChannelFault(start, f"{_reads(run, channel, start, end)} while its setpoint is elsewhere", *_FOLLOWS)
    for start, end in _stretches(held) if joint in LEGS else ():
        lag = _unseen_lag(run, joint, robot, slice(start, end))
        if lag > LEAST_COUNTS * robot.sensors.encoder.position:
            text = f"{_reads(run, channel, start, end)} while its effort changes by what takes a lag of {1e3 * lag:.0f} mrad"
            return ChannelFault(start, text, *_FOLLOWS)
    return Sound.YES


def _reads(run: Run, channel: str, start: int, end: int) -> str:
    return f"reads {run[channel][start]:.4g} rad for {run['t'][end - 1] - run['t'][start]:.2f} s"


def _unseen_lag(run: Run, joint: str, robot: Robot, rows: slice) -> float:
    """Change of a leg's lag, rad, that a change of its effort takes beyond that of its setpoint; of 19 rows in 20."""
    effort = run[f"eff_{joint}"][rows] if f"eff_{joint}" in run else np.zeros(0)
    lag = run[f"cmd_{joint}"][rows] - run[f"pos_{joint}"][rows]
    if len(effort) < LEAST_HELD or not np.isfinite(effort).all() or not np.isfinite(lag).all():
        return 0.0
    motor, supply = robot.servo.leg, robot.servo.supply_voltage
    stiffness = motor.kp * motor.stall_torque / supply
    return float(np.ptp(np.quantile(effort, (0.025, 0.975)))) / stiffness - float(np.ptp(lag))


def mirrored(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a joint moves against its command."""
    joint = place(channel)
    asked, shown = _motions(run, joint)
    if not len(asked) or _size(joint, asked) < ASKED:
        return Sound.UNDECIDED
    slope = float(asked @ shown / max(float(asked @ asked), 1e-12))
    if slope >= MIRRORED:
        return Sound.YES
    text = f"moves against its command (ratio {slope:.2f})"
    return ChannelFault(_first_asked(run, joint), text, "a ratio near 1", "check the sign in the hardware file")


def rate_against_angle(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a servo's rate is against the turning of its angle, over half a second each."""
    angle = f"pos_{place(channel)}"
    rows = np.isfinite(run[channel])
    if rows.sum() < LEAST_ROWS:
        return Sound.UNDECIDED
    turned, measured, together = correlation(*increments(run["t"][rows], run[angle][rows], run[channel][rows]))
    if min(turned, measured) < TURNED:
        return Sound.UNDECIDED
    if together > OPPOSITE:
        return Sound.YES
    text = f"turns against {angle} (correlation {together:.2f}): one of the two has the wrong sign"
    row = int(np.argmax(np.abs(np.nan_to_num(run[channel]))))
    return ChannelFault(row, text, "a correlation near 1", "check the sign in the hardware file")


def without_signal(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a rate or effort never changes although its motor is on and its joint turns."""
    joint = place(channel)
    on = np.isfinite(run[f"cmd_{joint}"]) & np.isfinite(run[channel])
    if on.sum() < LEAST_ROWS or np.ptp(run[f"pos_{joint}"][on]) < ASKED:
        return Sound.UNDECIDED
    if np.ptp(run[channel][on]) > 0.0:
        return Sound.YES
    text = f"reads {run[channel][on][0]:g} throughout while the joint turns by {np.ptp(run[f'pos_{joint}'][on]):.2g} rad"
    return ChannelFault(
        int(np.argmax(on)), text, "readings that change with the motion", "leave the column out, or record it again"
    )


def leg_effort_against(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a leg's effort points away from its goal."""
    lag, effort = run[f"cmd_{place(channel)}"] - run[f"pos_{place(channel)}"], run[channel]
    rows = np.isfinite(lag) & np.isfinite(effort)
    size = float(np.linalg.norm(lag[rows]) * np.linalg.norm(effort[rows]))
    if rows.sum() < LEAST_ROWS or size == 0.0:
        return Sound.UNDECIDED
    together = float(lag[rows] @ effort[rows]) / size
    if together >= PUSHES_AWAY:
        return Sound.YES if together > -PUSHES_AWAY else Sound.UNDECIDED
    text = f"pushes away from its goal (correlation with the lag {together:.2f})"
    row = int(np.argmax(np.abs(np.where(rows, effort, 0.0))))
    return ChannelFault(row, text, "a sign that goes with the leg's angle", "turn the sign of the column")


def wheel_effort_against(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a wheel's effort is against the voltage that its controller asks for.

    effort = (K/R) (voltage - K rate), and the voltage follows from setpoint, rate and angle. Effort times rate shows no sign:
    a wheel that is a little larger than the others is dragged by them, and brakes for whole runs.
    """
    joint = place(channel)
    voltage, rate, effort = wheel_voltage(run, joint, robot), rate_of(run, joint), run[channel]
    rows = np.isfinite(voltage) & np.isfinite(effort) & np.isfinite(rate)
    if rows.sum() < LEAST_ROWS:
        return Sound.UNDECIDED
    known = np.stack([rate[rows], np.ones(rows.sum())], axis=1)
    beside = [values - known @ np.linalg.lstsq(known, values, rcond=None)[0] for values in (voltage[rows], effort[rows])]
    asked, _, together = correlation(*beside)
    if asked < ASKED_VOLTAGE or abs(together) < ANSWERS:
        return Sound.UNDECIDED
    if together > 0.0:
        return Sound.YES
    text = f"is against the voltage that the wheel's controller asks for (correlation {together:.2f})"
    row = int(np.flatnonzero(rows)[np.argmax(np.abs(beside[1]))])
    return ChannelFault(row, text, "positive where the motor drives the wheel forward", "turn the sign of the column")


# ---- what the servo asks for -----------------------------------------------------------------------------------------


def asked_torque(run: Run, joint: str, robot: Robot) -> Array:
    """Motor torque (rows,), N m, that the servo's law asks for by the joint's own readings; NaN while it is off."""
    motor, supply = _motor(robot, joint), robot.servo.supply_voltage
    constant, resistance = servo.motor_constants(motor.stall_torque, motor.no_load_speed, supply)
    rate = np.gradient(run[f"pos_{joint}"], run["t"])
    if joint in LEGS:
        voltage = np.clip(motor.kp * (run[f"cmd_{joint}"] - run[f"pos_{joint}"]), -supply, supply)
    else:
        voltage = wheel_voltage(run, joint, robot)
    return servo.motor_torque(constant, resistance, voltage, rate)


def wheel_voltage(run: Run, wheel: str, robot: Robot) -> Array:
    """Voltage (rows,), V, that a wheel's controller asks for: its profile and its integral, from row to row; NaN while off."""
    motor, supply = robot.servo.wheel, robot.servo.supply_voltage
    _, acceleration = servo.profile_limits([0.0] * 8, [run.meta.profile.wheel_acceleration] * 8)
    limit = float(acceleration[-1])
    steps, goals = np.diff(run["t"]).tolist(), run[f"cmd_{wheel}"].tolist()
    angles, rates = run[f"pos_{wheel}"].tolist(), rate_of(run, wheel).tolist()
    voltage = np.full(len(angles), np.nan)
    reference = None
    for row, (step, goal) in enumerate(zip(steps, goals, strict=False)):
        if goal != goal:  # torque off
            reference = None
            continue
        position, velocity = reference or (angles[row], rates[row])
        position, velocity, _, _ = servo.wheel_profile_step(
            position, velocity, goal, limit, step, angles[row], motor.kp, supply
        )
        reference = float(position), float(velocity)
        voltage[row + 1] = servo.controller_voltage(motor.kp, motor.kd, *reference, angles[row + 1], rates[row + 1], supply)
    return voltage


def _sees(run: Run, joint: str, robot: Robot, rows: slice) -> bool:
    """Whether the measured effort is what the servo's law asks for by these readings: then the servo saw the same."""
    if f"eff_{joint}" not in run:
        return False
    asked, effort = asked_torque(run, joint, robot)[rows], run[f"eff_{joint}"][rows]
    both = np.isfinite(asked) & np.isfinite(effort)
    return bool(asked[both] @ effort[both] > SEES * (asked[both] @ asked[both]) > 0.0)


def _motor(robot: Robot, joint: str) -> Motor:
    return robot.servo.leg if joint in LEGS else robot.servo.wheel


def _motions(run: Run, joint: str) -> tuple[Array, Array]:
    """How a joint was asked to move and moved while on: a wheel from row to row, a leg about its mean, rad."""
    command, position = run[f"cmd_{joint}"], run[f"pos_{joint}"]
    on = np.isfinite(command) & np.isfinite(position)
    if on.sum() < LEAST_ROWS // 2:
        return np.zeros(0), np.zeros(0)
    if joint in LEGS:
        return command[on] - command[on].mean(), position[on] - position[on].mean()
    return command[on][:-1] * np.diff(run["t"][on]), np.diff(position[on])


def _size(joint: str, motion: Array) -> float:
    return float(np.ptp(motion) if joint in LEGS else np.abs(motion).sum())


def _first_asked(run: Run, joint: str) -> int:
    """First row whose setpoint asks the joint to move."""
    command = run[f"cmd_{joint}"]
    rest = command[np.isfinite(command)][0] if joint in LEGS else 0.0
    return int(np.argmax(np.abs(np.nan_to_num(command - rest)) > 0.0))


def _stretches(chosen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First row and end of every run of chosen rows."""
    edges = np.flatnonzero(np.diff(chosen.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
