"""Whether measured runs can be used, before anything is fitted: :data:`CHECKS`, one after the other, in seconds.

Thresholds come from the robot file, the resolution of its sensors and its kinematics; each stands with its reason before the
checks that use it. What is no run at all is refused when it is read (:mod:`wlr_gym.data.format`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.format import COMMANDS, find_leap, increments
from wlr_gym.data.runs import Run
from wlr_gym.gap.analysis import IntakeFinding
from wlr_gym.gap.problem import Array
from wlr_gym.physics import servo
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot
from wlr_gym.robot.description import Motor

# ---- a check ---------------------------------------------------------------------------------------------------------


class Sound(Enum):
    """A channel without the fault."""

    YES = "the run shows that the channel is right"
    UNDECIDED = "the run does not excite the channel enough to tell"


class ChannelFault(NamedTuple):
    """What is wrong with one channel of one run: the first row that shows it, None = the whole run, and what was seen."""

    row: int | None
    text: str


Outcome = ChannelFault | Sound

#: Channels that stand for the run as a whole: clock, setpoints, encoders.
WHOLE = ("t", "cmd", "pos")


class IntakeCheck(NamedTuple):
    """One check.

    Attributes:
        kind: of the findings.
        channels: that are looked at, one by one; of :data:`WHOLE` the run as a whole.
        look: (run, channel, robot) -> fault, or sound. It gets channels that the run has, with finite values.
        expected, remedy: what would be right, and what to do.
    """

    kind: str
    channels: tuple[str, ...]
    look: Callable[[Run, str, Robot], Outcome]
    expected: str
    remedy: str


_Outcomes: TypeAlias = dict[tuple[IntakeCheck, str], Outcome]


def findings_of(runs: Sequence[Run], checks: Sequence[IntakeCheck], robot: Robot) -> list[IntakeFinding]:
    """Return what the checks find, run by run.

    What stands at one place (a joint's encoder, its rate and effort) is not looked at further once a check has found a fault
    there: later checks compare with it, and the first fault counts. Nor is anything else of a run with a fault as a whole. A
    run in which a channel cannot be judged has the fault of the others if no run shows that the channel is right: a unit, a
    sign and a broken wire are the recording's, not the run's.
    """
    outcomes = [_of_one(run, checks, robot) for run in runs]
    found = []
    for run, outcome in zip(runs, outcomes, strict=True):
        told = set[str]()
        for (check, channel), seen in outcome.items():
            fault = _shared(runs, outcomes, check, channel) if seen is Sound.UNDECIDED else seen
            if channel not in told and isinstance(fault, ChannelFault):
                told.add(channel)
                time = None if fault.row is None else float(run["t"][fault.row] - run["t"][0])
                said = fault.text, True, time, check.expected, check.remedy
                found.append(IntakeFinding(run.name, channel, check.kind, *said))
    return found


def _shared(runs: Sequence[Run], outcomes: Sequence[_Outcomes], check: IntakeCheck, channel: str) -> ChannelFault | None:
    """The fault that a run which does not show it has like the others; None where one shows that the channel is right."""
    seen = [(run.name, outcome.get((check, channel))) for run, outcome in zip(runs, outcomes, strict=True)]
    faults = [name for name, one in seen if isinstance(one, ChannelFault)]
    if not faults or any(one is Sound.YES for _, one in seen):
        return None
    return ChannelFault(None, f"the run does not show whether it is right, and it is {check.kind} in {faults[0]}")


def _of_one(run: Run, checks: Sequence[IntakeCheck], robot: Robot) -> _Outcomes:
    """What each check finds in each channel of a run that is measured and in which no earlier check has found a fault."""
    outcomes: _Outcomes = {}
    bad: set[str] = set()
    for check in checks:
        for channel in check.channels:
            measured = channel in WHOLE or (channel in run and bool(np.isfinite(run[channel]).any()))
            if not measured or place(channel) in bad or bad.intersection(WHOLE):
                continue
            outcomes[check, channel] = check.look(run, channel, robot)
            if isinstance(outcomes[check, channel], ChannelFault):
                bad.add(place(channel))
    return outcomes


def place(channel: str) -> str:
    """Return the joint of a channel, or the channel itself."""
    joint = channel.partition("_")[2]
    return joint if joint in JOINTS else channel


def moving(run: Run) -> NDArray[np.bool_]:
    """Return in which rows (rows,) some joint's encoder reads another count than in the row before."""
    steps = np.stack([np.diff(run[f"pos_{joint}"], prepend=run[f"pos_{joint}"][0]) != 0.0 for joint in JOINTS])
    return np.any(steps, axis=0)


def correlation(a: Array, b: Array) -> tuple[float, float, float]:
    """Return the standard deviations of two series (rows,), and their correlation (0 where one is constant)."""
    a, b = a - a.mean(), b - b.mean()
    sizes = float(np.std(a)), float(np.std(b))
    return *sizes, float(a @ b) / (len(a) * sizes[0] * sizes[1]) if min(sizes) > 0.0 else 0.0


def rate_of(run: Run, joint: str) -> Array:
    """Return a joint's rate (rows,), rad/s: the servo's own reading, else the change of its angle."""
    name = f"vel_{joint}"
    if name in run and np.isfinite(run[name]).all():
        return run[name]
    return np.gradient(run[f"pos_{joint}"], run["t"])


# ---- the run as a whole ----------------------------------------------------------------------------------------------

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
RATE_SHOWN = 0.2
#: rad; legs that stay within this (13 counts) stand, and so do wheels that stay within 3.4 mm of travel.
LEG_STANDS, WHEEL_STANDS = 0.02, 0.1


def too_short(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a run is long enough for a window to be compared."""
    seconds = float(run["t"][-1] - run["t"][0])
    if seconds >= LEAST_SECONDS:
        return Sound.YES
    return ChannelFault(None, f"the run is {seconds:.2f} s long")


def clock_jumps(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether time steps where the motion does not, or the other way round.

    Angles go on by their rates times the true time between two rows. Where that says the usual period and the clock another
    step, the clock has jumped; where rows were lost both say the same.
    """
    steps = np.diff(run["t"])
    angles = np.stack([np.diff(run[f"pos_{joint}"]) for joint in JOINTS])
    rates = np.stack([0.5 * (rate[1:] + rate[:-1]) for rate in (rate_of(run, joint) for joint in JOINTS)])
    squares = np.sum(rates**2, axis=0)
    passed = np.sum(rates * angles, axis=0) / np.maximum(squares, 1e-12)  # s, by what the joints turn
    missed = np.max(np.abs(angles - rates * passed), axis=0)  # rad that it leaves unexplained
    late = (np.abs(passed - steps) > LATE) & (np.sqrt(squares) > SHOWS_TIME) & (missed < MISSED)
    late &= np.abs(passed - np.median(steps)) < LATE  # else rows were lost, in which the rates may have changed
    wrong = late | (steps > LONGEST_HOLE)
    if not wrong.any():
        return Sound.YES
    row = int(np.argmax(wrong))
    seen = f"in which the joints moved as in {1e3 * passed[row]:.0f} ms" if late[row] else "nothing between them"
    times = f" ({wrong.sum()} times in the run)" if wrong.sum() > 1 else ""
    return ChannelFault(row, f"{steps[row]:.3g} s from row {row} to the next, {seen}{times}")


def clock_rate(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the clock runs as fast as the servos' rates say; one joint alone would be its rate's fault."""
    slopes = []  # of a joint's turning over the integral of its rate
    for joint in JOINTS:
        if f"vel_{joint}" in run and np.ptp(run[f"pos_{joint}"]) > RATE_SHOWN:
            turned, measured = _turned(run, f"pos_{joint}", f"vel_{joint}")
            slopes.append(float(turned @ measured) / max(float(measured @ measured), 1e-12))
    if not slopes:
        return Sound.UNDECIDED
    rate = float(np.median(slopes))
    if not abs(rate - 1.0) > CLOCK_RATE:
        return Sound.YES
    return ChannelFault(0, f"by the servos' rates {rate:.2f} times as much time passes between rows as the clock says")


def _turned(run: Run, angle: str, rate: str) -> tuple[Array, Array]:
    """How far an angle turns by itself and by its rate, over half a second each, where the rate was measured."""
    rows = np.isfinite(run[rate])
    return increments(run["t"][rows], run[angle][rows], run[rate][rows])


def motors_off(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether no motor was on in the whole run."""
    if np.isfinite(np.stack([run[name] for name in COMMANDS])).any():
        return Sound.YES
    return ChannelFault(None, "no motor was on in the whole run: nothing to replay")


def stands_still(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether no joint moves: such a run shows nothing of the model, and as held-out run proves nothing."""
    for joint in JOINTS:
        if np.ptp(run[f"pos_{joint}"]) > (LEG_STANDS if joint in LEGS else WHEEL_STANDS):
            return Sound.YES
    text = f"no leg moves by more than {LEG_STANDS:g} rad and no wheel by more than {WHEEL_STANDS:g} rad in the whole run"
    return ChannelFault(None, text)


# ---- joints ----------------------------------------------------------------------------------------------------------

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


#: Rows over which a profile's ramp is compared, and ramps that are enough.
RAMP, LEAST_RAMPS = 5, 40
#: Upper tenth of the measured over the stated ramps that no profile allows: sound data have 0.44 to 0.91, and half the stated
#: acceleration up to 3.8.
BEYOND_PROFILE = 1.15


def wrapped(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether an angle starts anew after a turn: no joint gets half a turn further between rows so close together."""
    longest = TOO_QUICK * np.pi / _motor(robot, place(channel)).no_load_speed
    jumps = np.flatnonzero((np.abs(np.diff(run[channel])) > np.pi) & (np.diff(run["t"]) < longest))
    if not len(jumps):
        return Sound.YES
    row = int(jumps[0]) + 1
    text = f"jumps {len(jumps)} times, first by {run[channel][row] - run[channel][row - 1]:.3g} rad in row {row}"
    return ChannelFault(row, text)


def leaps(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a joint gets further between two rows than any motor of the robot can move it."""
    leap = find_leap({name: run[name] for name in ("t", *_POS)}, robot)
    return Sound.YES if leap is None else ChannelFault(*leap)


def against_profile(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether joints follow their setpoints faster than the servo profile in ``meta.yaml`` lets them.

    Slower ones tell nothing: a motor may be weak.
    """
    profile = run.meta.profile
    for joints, name, limit, unit in (
        (WHEELS, "wheel_acceleration", profile.wheel_acceleration, "rad/s2"),
        (LEGS, "leg_velocity", profile.leg_velocity, "rad/s"),
    ):
        shares = [_share_of_limit(run, joint, limit) for joint in joints] if limit > 0.0 else [np.zeros(0)]
        pooled = np.concatenate(shares)
        if len(pooled) >= LEAST_RAMPS and (share := float(np.quantile(pooled, 0.9))) > BEYOND_PROFILE:
            text = f"its setpoints are followed by up to {share * limit:.3g} {unit}; meta.yaml states {name} = {limit:g}"
            return ChannelFault(None, text)
    return Sound.UNDECIDED  # a fault of one run is then that of all: they share the profile


def _share_of_limit(run: Run, joint: str, limit: float) -> Array:
    """How fast a wheel's rate or a leg's angle changes over :data:`RAMP` rows, over the limit at which its profile changes.

    Rows without torque tell nothing: the floor may move a free wheel faster.
    """
    t, goals = run["t"], run[f"cmd_{joint}"].tolist()
    value = rate_of(run, joint) if joint in WHEELS else run[f"pos_{joint}"]
    reference = value.copy()
    for row, step in enumerate(np.diff(t).tolist()):
        if goals[row] == goals[row]:  # else torque off
            reference[row + 1] = reference[row] + min(max(goals[row] - reference[row], -limit * step), limit * step)
    moved, span = reference[RAMP:] - reference[:-RAMP], limit * (t[RAMP:] - t[:-RAMP])
    driven = np.lib.stride_tricks.sliding_window_view(np.isfinite(run[f"cmd_{joint}"]), RAMP)[:-1].all(1)
    ramp = driven & (np.abs(moved) > 0.99 * span)
    return np.sign(moved[ramp]) * (value[RAMP:] - value[:-RAMP])[ramp] / span[ramp]


def dead(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a joint shows nothing of what it is asked to do, in the whole run."""
    joint = place(channel)
    asked, shown = (_size(joint, motion) for motion in _motions(run, joint))
    if asked < ASKED:
        return Sound.YES if np.ptp(run[channel]) > 0.0 else Sound.UNDECIDED
    if shown >= SHOWN * asked or _sees(run, joint, robot, slice(None)):
        return Sound.YES
    return ChannelFault(_first_asked(run, joint), f"commanded to move by {asked:.2g} rad and shows {shown:.2g} rad")


def stuck(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether an encoder reads one and the same count while the controller pushes harder than any friction can hold.

    Or, of a leg, while its effort changes: that is gain times lag, so that an effort cannot change unless the angle does.
    """
    joint, t = place(channel), run["t"]
    held = np.diff(run[channel], prepend=np.nan) == 0.0
    pushed = np.abs(asked_torque(run, joint, robot)) > PUSHED * _motor(robot, joint).stall_torque
    faults = []
    for rows in _stretches(pushed & held):
        if t[rows][-1] - t[rows.start] > STUCK and not _sees(run, joint, robot, rows):
            faults.append((rows, "while its setpoint is elsewhere"))
    for rows in _stretches(held) if joint in LEGS else ():
        lag = _unseen_lag(run, joint, robot, rows)
        if lag > LEAST_COUNTS * robot.sensors.encoder.position:
            faults.append((rows, f"while its effort changes by what takes a lag of {1e3 * lag:.0f} mrad"))
    if not faults:
        return Sound.YES
    rows, meanwhile = faults[0]
    reads = f"reads {run[channel][rows.start]:.4g} rad for {t[rows][-1] - t[rows.start]:.2f} s"
    return ChannelFault(rows.start, f"{reads} {meanwhile}")


def _unseen_lag(run: Run, joint: str, robot: Robot, rows: slice) -> float:
    """Change of a leg's lag, rad, that a change of its effort takes beyond that of its setpoint; of 19 rows in 20."""
    effort = run[f"eff_{joint}"][rows] if f"eff_{joint}" in run else np.zeros(0)
    lag = run[f"cmd_{joint}"][rows] - run[f"pos_{joint}"][rows]
    if len(effort) < LEAST_HELD or not np.isfinite(effort).all() or not np.isfinite(lag).all():
        return 0.0
    motor = robot.servo.leg
    stiffness = motor.kp * motor.stall_torque / robot.servo.supply_voltage
    return float(np.ptp(np.quantile(effort, (0.025, 0.975)))) / stiffness - float(np.ptp(lag))


def mirrored(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a joint moves against its command."""
    joint = place(channel)
    asked, shown = _motions(run, joint)
    if _size(joint, asked) < ASKED:
        return Sound.UNDECIDED
    slope = float(asked @ shown / max(float(asked @ asked), 1e-12))
    if slope >= MIRRORED:
        return Sound.YES
    return ChannelFault(_first_asked(run, joint), f"moves against its command (ratio {slope:.2f})")


def rate_against_angle(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a servo's rate is against the turning of its angle, over half a second each."""
    angle = f"pos_{place(channel)}"
    if np.isfinite(run[channel]).sum() < LEAST_ROWS:
        return Sound.UNDECIDED
    turned, measured, together = correlation(*_turned(run, angle, channel))
    if min(turned, measured) < TURNED:
        return Sound.UNDECIDED
    if together > OPPOSITE:
        return Sound.YES
    text = f"turns against {angle} (correlation {together:.2f}): one of the two has the wrong sign"
    return ChannelFault(_largest(run, channel), text)


def _largest(run: Run, channel: str) -> int:
    """The row of a channel's largest reading."""
    return int(np.argmax(np.abs(np.nan_to_num(run[channel]))))


def without_signal(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a rate or effort never changes although its motor is on and its joint turns."""
    joint = place(channel)
    on = np.isfinite(run[f"cmd_{joint}"]) & np.isfinite(run[channel])
    if on.sum() < LEAST_ROWS or np.ptp(run[f"pos_{joint}"][on]) < ASKED:
        return Sound.UNDECIDED
    if np.ptp(run[channel][on]) > 0.0:
        return Sound.YES
    text = f"reads {run[channel][on][0]:g} throughout while the joint turns by {np.ptp(run[f'pos_{joint}'][on]):.2g} rad"
    return ChannelFault(int(np.argmax(on)), text)


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
    row = int(np.argmax(np.abs(np.where(rows, effort, 0.0))))
    return ChannelFault(row, f"pushes away from its goal (correlation with the lag {together:.2f})")


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
    return ChannelFault(row, text)


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
    return float(np.ptp(motion) if joint in LEGS and motion.size else np.abs(motion).sum())


def _first_asked(run: Run, joint: str) -> int:
    """First row whose setpoint asks the joint to move."""
    command = run[f"cmd_{joint}"]
    rest = command[np.isfinite(command)][0] if joint in LEGS else 0.0
    return int(np.argmax(np.abs(np.nan_to_num(command - rest)) > 0.0))


def _stretches(chosen: NDArray[np.bool_]) -> list[slice]:
    """Every unbroken run of chosen rows."""
    edges = np.flatnonzero(np.diff(chosen.astype(np.int8), prepend=0, append=0))
    return [slice(first, end) for first, end in edges.reshape(-1, 2).tolist()]


# ---- inertial sensors ------------------------------------------------------------------------------------------------

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
IMU_STUCK = 0.5

IMU = ("gyro_x", "gyro_y", "gyro_z", "acc_x", "acc_y", "acc_z")


def in_degrees(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the gyroscope is in degrees per second, by what else shows the turning, else by its noise at rest."""
    for name, angle in _references(run, channel, robot):
        turned, measured, together = _turning(run, channel, angle)
        if turned < LEAST_TURN or abs(together) < TOGETHER:
            continue
        if measured < IN_DEGREES * turned:
            return Sound.YES
        row, seen = (
            _largest(run, channel),
            f"turns {measured / turned:.0f} times as much as {name} (correlation {together:.2f})",
        )
        break
    else:
        changes = np.diff(run[channel])[~moving(run)[1:]]  # in rows in which nothing has moved since the row before
        changes = changes[np.isfinite(changes)]
        if len(changes) < LEAST_AT_REST:
            return Sound.UNDECIDED
        noise = float(np.median(np.abs(changes))) * NORMAL / math.sqrt(2.0) / robot.sensors.imu.gyro_noise
        if not NOISE_IN_DEGREES[0] < noise < NOISE_IN_DEGREES[1]:
            return Sound.YES if 0.0 < noise < IN_DEGREES else Sound.UNDECIDED
        row, seen = 0, f"its noise at rest is {noise:.0f} times the robot file's"
    return ChannelFault(row, f"{seen}: degrees per second?")


def _turning(run: Run, channel: str, angle: Array) -> tuple[float, float, float]:
    """How far an angle and a gyroscope turn in half a second (standard deviations, rad), and their correlation."""
    finite = np.isfinite(run[channel]) & np.isfinite(angle)
    if finite.sum() < LEAST_ROWS:
        return 0.0, 0.0, 0.0
    return correlation(*increments(run["t"][finite], np.unwrap(angle[finite]), run[channel][finite]))


def _references(run: Run, channel: str, robot: Robot) -> list[tuple[str, Array]]:
    """What else shows how far the body turned about an axis, the best first: names and angles (rows,), rad."""

    def measured(name: str) -> bool:
        return name in run and np.isfinite(run[name]).sum() >= LEAST_ROWS

    camera = {"gyro_z": "cam_yaw", "gyro_y": "cam_pitch"}.get(channel, "")
    found = [(camera, run[camera])] if measured(camera) else []
    if channel == "gyro_z":  # heading of a body whose wheels roll without slip: spins in the body's frame, legs included
        travel = {w: run[f"pos_{w}"] + run[f"pos_{leg}"] for w, leg in zip(WHEELS, LEGS, strict=True)}
        across = (travel["wheel_rf"] + travel["wheel_rr"]) - (travel["wheel_lf"] + travel["wheel_lr"])
        return [*found, ("the wheels", across * (robot.wheel.radius / (4.0 * robot.hip_position.y)))]
    across = "acc_y" if channel == "gyro_x" else "acc_x"
    if measured(across) and measured("acc_z"):
        tilt = np.arctan2(_averaged(run, across), _averaged(run, "acc_z"))
        found.append(("gravity in the accelerometer", tilt if channel == "gyro_x" else -tilt))
    return found


def _averaged(run: Run, channel: str) -> Array:
    """A channel (rows,) averaged over :data:`AVERAGED` seconds."""
    known = np.isfinite(run[channel])
    values = np.interp(run["t"], run["t"][known], run[channel][known])
    half = max(1, round(0.5 * AVERAGED / float(np.median(np.diff(run["t"])))))
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, np.full(2 * half + 1, 1.0 / (2 * half + 1)), mode="valid")


def gyro_against(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the gyroscope turns against the camera, or where that shows nothing against wheels or gravity."""
    for name, angle in _references(run, channel, robot):
        turned, measured, together = _turning(run, channel, angle)
        if min(turned, measured) < LEAST_TURN or abs(together) < TOGETHER:
            continue
        if together > OPPOSITE:
            return Sound.YES
        return ChannelFault(_largest(run, channel), f"turns against {name} (correlation {together:.2f})")
    return Sound.UNDECIDED


def upside_down(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether the accelerometer shows gravity itself, or its z axis points down."""
    middle = float(np.nanmedian(run[channel]))
    return Sound.YES if middle > UPSIDE_DOWN else ChannelFault(None, f"reads {middle:.1f} m/s2 (median)")


def imu_saturated(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether readings pile up, bit-equal, at a channel's extreme while the robot moves: its range ends there."""
    rows = np.isfinite(run[channel]) & moving(run)
    levels, counts = np.unique(run[channel][rows], return_counts=True)
    if len(levels) < AT_END:
        return Sound.YES
    for end, inside in ((0, slice(1, 6)), (-1, slice(-6, -1))):
        if counts[end] >= AT_END and counts[end] > PILED_UP * float(np.mean(counts[inside])):
            row = int(np.argmax(rows & (run[channel] == levels[end])))
            return ChannelFault(row, f"{counts[end]} rows at its extreme of {levels[end]:.4g}, bit for bit")
    return Sound.YES


def imu_without_signal(run: Run, channel: str, robot: Robot) -> Outcome:
    """Whether a sensor that has noise repeats one value while the robot moves.

    A simulation without noise may do so rightly: a run is left alone in which no inertial channel changes from row to row while
    nothing moves.
    """
    moves, reading = moving(run), run[channel]
    if (~moves).sum() >= LEAST_AT_REST:
        at_rest = [run[name][~moves & np.isfinite(run[name])] for name in IMU if name in run]
        if not any(len(np.unique(values)) > 0.5 * (~moves).sum() for values in at_rest):
            return Sound.UNDECIDED
    same = (np.diff(reading, prepend=np.nan) == 0.0) | ~np.isfinite(reading)
    rows = max(_stretches(same), key=lambda rows: rows.stop - rows.start, default=slice(0, 1))
    seconds = float(run["t"][rows.stop - 1] - run["t"][rows.start])
    if seconds < IMU_STUCK or not moves[rows].any() or np.isnan(reading[rows.start]):
        return Sound.YES
    return ChannelFault(rows.start, f"reads {reading[rows.start]:.4g} for {seconds:.2f} s while the robot moves")


# ---- all checks ------------------------------------------------------------------------------------------------------

_POS, _VEL, _EFF = (tuple(f"{kind}_{joint}" for joint in JOINTS) for kind in ("pos", "vel", "eff"))
_GYRO = ("gyro_z", "gyro_y", "gyro_x")
_DEAD = "an encoder that follows", "dead encoder, or the motor is not on: check its cable and its torque switch"
_CLOCK = "split the run there into two files, or record it again with a monotonic clock"
_MOVE = "switch the motors on and record motions made for it: wlr record --list"
_SIGN, _TURN = "check the sign in the hardware file", "turn the sign of the column"
_MOUNTED = "check the mounting in the hardware file, and the camera's axes"
_LEAVE_OUT = "leave the column out, or record it again"
#: In the order in which they are made: what a check compares with has been checked before.
CHECKS: tuple[IntakeCheck, ...] = (
    IntakeCheck("short", ("t",), too_short, f"at least {LEAST_SECONDS:g} s, better 15 to 25 s", "record a longer run"),
    IntakeCheck(
        "missing",
        ("cmd",),
        motors_off,
        "setpoints in the columns cmd_*",
        "record the setpoints; NaN is for motors that are off",
    ),
    IntakeCheck("still", ("pos",), stands_still, "a robot that drives or moves its legs", _MOVE),
    IntakeCheck("wrap", _POS, wrapped, "angles that go on past a turn", "numpy.unwrap mends it"),
    IntakeCheck("jump", ("pos",), leaps, "one recording, in one unit", "leave the run out, or split it there into two files"),
    IntakeCheck("clock", ("t",), clock_rate, "seconds", "write the time at which each row was read, in s"),
    IntakeCheck("clock", ("t",), clock_jumps, "a monotonic clock, rows 20 ms apart; single lost rows do no harm", _CLOCK),
    IntakeCheck("dead", _POS, dead, *_DEAD),
    IntakeCheck("mirrored", _POS, mirrored, "a ratio near 1", _SIGN),
    IntakeCheck("dead", _POS, stuck, *_DEAD),
    IntakeCheck(
        "profile", ("cmd",), against_profile, "the profile that was set", "correct profile in meta.yaml; {} where none was set"
    ),
    IntakeCheck("mirrored", _VEL, rate_against_angle, "a correlation near 1", _SIGN),
    IntakeCheck("dead", (*_VEL, *_EFF), without_signal, "readings that change with the motion", _LEAVE_OUT),
    IntakeCheck("mirrored", _EFF[:4], leg_effort_against, "a sign that goes with the leg's angle", _TURN),
    IntakeCheck("mirrored", _EFF[4:], wheel_effort_against, "positive where the motor drives the wheel forward", _TURN),
    IntakeCheck(
        "saturated",
        IMU,
        imu_saturated,
        "a range that the motion does not reach",
        "set a wider range of the sensor and record again",
    ),
    IntakeCheck("dead", IMU, imu_without_signal, "noise at least", f"{_LEAVE_OUT}: check the sensor's cable"),
    IntakeCheck(
        "mirrored", ("acc_z",), upside_down, "+9.8 at rest, the push of the floor", "check its mounting in the hardware file"
    ),
    IntakeCheck("units", _GYRO, in_degrees, "rad/s", "multiply by pi/180 = 0.017453"),
    IntakeCheck("mirrored", _GYRO, gyro_against, "a correlation near 1", _MOUNTED),
)
