"""Setpoints that bring out what a robot is made of: motions to drive on the real robot, and on simulators to compare them.

Every excitation is a function of a seed, starts and ends at rest, keeps the legs within their limits and the wheels below
their no-load speed, and needs up to 2 m of floor in front of the robot or behind it. :data:`EXCITATIONS` says what each is
good for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name, check_number
from wlr_gym.base.random import generator
from wlr_gym.data.format import Profile
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot, load_robot

Array = NDArray[np.float64]

#: s between the setpoints of a motion.
CONTROL_PERIOD = 0.02
#: s at the first setpoints before a motion: until the bounce of being set down has died out.
SETTLE = 0.5
#: s of rest before and after every motion.
REST = 1.0
#: What a careful operator writes into the servos' profile registers.
GENTLE = Profile(wheel_acceleration=11.2, leg_velocity=1.44, leg_acceleration=15.0)
#: rad/s; fastest wheel setpoint, 14 % below the no-load speed.
TOP_SPEED = 5.5
#: rad; leg setpoints stay this far off the leg limits.
LEG_MARGIN = 0.1
#: Share of the profile's acceleration that a chirp's legs ask for at most, for profiles down to half as fast. Beyond all of it
#: a profile lags by an amount that depends on the last per cent of its law: two simulators of one robot part by 20 mrad.
CHIRP_ACCELERATION = 0.5
_DOWN = np.pi / 2


@dataclass(frozen=True, eq=False)
class Motion:
    """Setpoints over time.

    Attributes:
        name: of the excitation, or of the run it was taken from.
        setpoints: (ticks, 8) leg angles, rad, and wheel speeds, rad/s, held for one control period each; NaN = torque off.
        period: s per tick.
        profile: the servos' profile registers.
    """

    name: str
    setpoints: Array
    period: float
    profile: Profile = GENTLE

    @property
    def duration(self) -> float:
        """Length in s."""
        return len(self.setpoints) * self.period

    def travel(self, wheel_radius: float) -> Array:
        """Return the way rolled after each tick (ticks,), m, forward positive: without slip, motors that are off left out."""
        wheels = self.setpoints[:, WHEEL_SLICE]
        driven = np.isfinite(wheels).sum(axis=1)
        return wheel_radius * self.period * np.cumsum(np.nansum(wheels, axis=1) / np.maximum(driven, 1))

    def start(self, robot: Robot) -> Array:
        """Return the setpoints (8,) it starts from: a leg without one at home, wheels at rest."""
        setpoints = self.setpoints[0].copy()
        setpoints[WHEEL_SLICE] = 0.0
        return np.where(np.isnan(setpoints), robot.home.leg_angle, setpoints)

    def cut(self, seconds: float | None) -> Motion:
        """Return its first ``seconds``; None = all of it."""
        return self if seconds is None else replace(self, setpoints=self.setpoints[: max(1, round(seconds / self.period))])


#: Setpoints at any times (T,) -> (T, 8), and their length in s without the rests.
Course = tuple[Callable[[Array], NDArray[np.floating]], float]


@dataclass(frozen=True)
class Excitation:
    """One kind of motion.

    Attributes:
        doc: what the robot does. shows: which properties leave a trace in it.
        draw: makes a course; every number that may vary comes from the generator.
        profile: servo profile it is driven with.
    """

    doc: str
    shows: str
    draw: Callable[[np.random.Generator, Robot], Course]
    profile: Profile = GENTLE


def excite(
    name: str, seed: int = 0, robot: Robot | None = None, period: float = CONTROL_PERIOD, seconds: float | None = None
) -> Motion:
    """Return one motion of :data:`EXCITATIONS`.

    Args:
        name: of the excitation; every one has its own random stream.
        seed: another seed is another motion of the same kind.
        robot: whose leg limits and lengths; None = nominal.
        period: s per control step.
        seconds: cut it off after this long; None = all of it.

    Raises:
        InputError: unknown name, negative seed, or a period or length that is not positive.
    """
    check_name("excitation", name, EXCITATIONS)
    check_number("period", period, "s", above=0.0)
    if seconds is not None:
        check_number("seconds", seconds, "s", above=0.0)
    if seed < 0:
        raise InputError(f"seed = {seed}: expected 0 or more")
    excitation, robot = EXCITATIONS[name], robot or load_robot()
    course, length = excitation.draw(generator(seed, "excitation", name), robot)
    t: Array = period * np.arange(round((length + 2 * REST) / period), dtype=np.float64)
    own: Array = np.clip(t - REST, 0.0, length)
    setpoints = np.asarray(course(own), dtype=np.float64)
    setpoints[(t < REST) | (t > REST + length), WHEEL_SLICE] *= 0.0  # NaN stays NaN
    low, high = robot.leg_limits
    setpoints[:, LEG_SLICE] = np.clip(setpoints[:, LEG_SLICE], low + LEG_MARGIN, high - LEG_MARGIN)
    setpoints[:, WHEEL_SLICE] = np.clip(setpoints[:, WHEEL_SLICE], -TOP_SPEED, TOP_SPEED)
    return Motion(name, setpoints, period, excitation.profile).cut(seconds)


# ---- building blocks -------------------------------------------------------------------------------------------------


def _holds(pieces: Iterable[tuple[float, Sequence[float] | Array]]) -> Course:
    """Rows of eight setpoints, each held for its seconds."""
    seconds, rows = zip(*pieces, strict=True)
    ends, table = np.cumsum(seconds), np.array(rows)
    return lambda t: table[np.minimum(np.searchsorted(ends, t, side="right"), len(table) - 1)], float(ends[-1])


def _posture(front: float, rear: float, left: float = 0.0, right: float = 0.0) -> Array:
    return np.array([front, front, rear, rear, left, right, left, right])


def _crouch(rng: np.random.Generator) -> tuple[float, float]:
    """Front and rear leg angles of a stable stance, feet apart by up to half a leg."""
    spread = rng.uniform(0.1, 0.5)
    return _DOWN - spread + rng.uniform(-0.06, 0.06), _DOWN + spread + rng.uniform(-0.06, 0.06)


def _alternating(rng: np.random.Generator, count: int) -> Array:
    return rng.choice([-1.0, 1.0]) * (-1.0) ** np.arange(count)


def _band(rng: np.random.Generator, highest: float, waves: int = 8) -> Callable[[Array], Array]:
    """Random function of time with frequencies from 0.05 Hz to ``highest``, mostly within +-1."""
    frequency, phase = rng.uniform(0.05, highest, waves), rng.uniform(0, 2 * np.pi, waves)
    return lambda t: np.sin(2 * np.pi * np.multiply.outer(t, frequency) + phase).sum(axis=1) / np.sqrt(waves)


def _fade(t: Array, length: float, edge: float = 1.0) -> Array:
    """Rise from 0 to 1 and fall back, smoothly, over ``edge`` s at both ends."""
    inside = np.clip(np.minimum(t, length - t) / edge, 0.0, 1.0)
    return inside**2 * (3 - 2 * inside)


# ---- the kinds -------------------------------------------------------------------------------------------------------


def _straight(rng: np.random.Generator, robot: Robot) -> Course:
    front, rear = _crouch(rng)
    pieces = []
    for sign in _alternating(rng, 5):
        speed = sign * rng.uniform(1.0, 5.4)
        pieces += [(rng.uniform(2.0, 3.0), _posture(front, rear, speed, speed)), (rng.uniform(0.5, 0.9), _posture(front, rear))]
    return _holds(pieces)


def _posture_sweep(rng: np.random.Generator, robot: Robot) -> Course:
    """Legs swing one way and the other, the axles together or one alone, while the body drives on.

    A wheel's speed relative to its leg is what keeps its tread rolling: (v - l sin(angle) rate)/a - rate.
    """
    rate, pause, ramp = rng.uniform(0.55, 0.75), 0.25, 0.5
    middle = np.array([_DOWN - 0.03, _DOWN + 0.03])
    speed = rng.choice([-1.0, 1.0]) * rng.uniform(1.4, 1.7)
    together, apart, front, rear = [1.0, 1.0], [1.0, -1.0], [1.0, 0.0], [0.0, 1.0]
    times, angles = [0.0, ramp], [middle, middle]
    for direction in rng.permutation([together, apart, front, rear]):
        swing = rng.uniform(0.3, 0.62) * _alternating(rng, 2)
        for target in (*(middle + direction * amplitude for amplitude in swing), middle):
            arrival = times[-1] + float(np.max(np.abs(target - angles[-1]))) / rate
            times += [arrival, arrival + pause]
            angles += [target, target]
    length = times[-1] + ramp
    table = np.array(angles)
    reach = robot.leg.length / robot.wheel.radius

    def course(t: Array) -> Array:
        legs = np.stack([np.interp(t, times, table[:, axle]) for axle in (0, 1)], axis=1)
        piece = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        rates = np.diff(table, axis=0)[piece] / np.diff(times)[piece][:, None]
        rates[t >= times[-1]] = 0.0
        drive = speed * np.clip(np.minimum(t, length - t) / ramp, 0.0, 1.0)
        wheels = drive[:, None] - (reach * np.sin(legs) + 1.0) * rates
        return np.concatenate([np.repeat(legs, 2, axis=1), np.repeat(wheels, 2, axis=1)], axis=1)

    return course, length


def _turns(rng: np.random.Generator, robot: Robot) -> Course:
    front, rear = _crouch(rng) if rng.random() < 0.5 else (_DOWN, _DOWN)
    spin, arc, pivot = (1.0, -1.0), (1.0, 0.25), (1.0, 0.0)
    pieces = []
    for kind in rng.permutation([spin, arc, pivot, spin, arc, pivot, spin]):
        fastest = 4.5 if kind[1] < 0.0 else 5.4
        left, right = rng.permutation(rng.choice([-1.0, 1.0]) * rng.uniform(2.5, fastest) * kind)
        pieces += [(rng.uniform(2.0, 2.8), _posture(front, rear, left, right)), (0.5, _posture(front, rear))]
    return _holds(pieces)


def _s_curve(rng: np.random.Generator, robot: Robot) -> Course:
    front, rear = _crouch(rng)
    mean, swing, frequency, length = rng.uniform(2.9, 3.4), rng.uniform(1.3, 2.1), rng.uniform(0.15, 0.17), 16.0

    def course(t: Array) -> Array:
        turn = swing * np.sin(2 * np.pi * frequency * t + 0.5)
        ramp = np.clip(np.minimum(t, length - t) / 0.5, 0.0, 1.0)
        left, right = ramp * (mean + turn), ramp * (mean - turn)
        return np.stack([*np.repeat([[front], [rear]], 2, axis=0) * np.ones_like(t), left, right, left, right], axis=1)

    return course, length


def _stop_and_go(rng: np.random.Generator, robot: Robot) -> Course:
    front, rear = _crouch(rng)
    pieces = []
    for _ in range(16):
        speed = 0.0 if rng.random() < 0.25 else rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 5.3)
        pieces.append((rng.uniform(0.4, 1.4), _posture(front, rear, speed, speed)))
    return _holds(pieces)


def _swing_over(rng: np.random.Generator, robot: Robot, *, turning_front: bool) -> Course:
    """Legs turn slowly from one side to the other while the front wheels pull and the rear wheels are free."""
    margin, speed = rng.uniform(0.53, 0.6), rng.uniform(1.85, 2.05)
    turned = (np.pi - 2 * margin) / rng.uniform(0.33, 0.38)
    rear = (np.pi - margin, margin) if turning_front else (margin, np.pi - margin)
    front = (margin, np.pi - margin) if turning_front else (margin, margin)
    up = rng.uniform(4.6, 5.2)

    length = 15.5
    times = np.array([0.0, min(up, turned), max(up, turned), length])
    share = np.minimum(times / turned, 1.0)
    legs = [pair[0] + share * (pair[1] - pair[0]) for pair in (front, rear)]
    pull = speed * np.minimum(times / up, 1.0)
    columns = [legs[0], legs[0], legs[1], legs[1], pull, pull, *[np.full(4, np.nan)] * 2]
    return lambda t: np.stack([np.interp(t, times, column) for column in columns], axis=1), length


def _random(rng: np.random.Generator, robot: Robot) -> Course:
    front, rear = _crouch(rng)
    length = 18.0
    axle = [_band(rng, 0.35) for _ in range(2)]
    roll = [_band(rng, 0.6) for _ in range(2)]
    side = [_band(rng, 0.75) for _ in range(3)]

    def course(t: Array) -> Array:
        fade = _fade(t, length)
        legs = [middle + fade * 0.22 * wave(t) for middle, wave in ((front, axle[0]), (rear, axle[1]))]
        lean = [fade * 0.02 * wave(t) for wave in roll]
        left, right = (fade * (2.0 * side[0](t) + 1.6 * wave(t)) for wave in side[1:])
        return np.stack(
            [legs[0] + lean[0], legs[0] - lean[0], legs[1] + lean[1], legs[1] - lean[1], left, right, left, right], axis=1
        )

    return course, length


def _chirp(rng: np.random.Generator, robot: Robot) -> Course:
    """Wheels first, left against right for the second half of them, then the legs, each from slow to fast.

    The legs' sine gets smaller as it gets faster, so that their profile follows it.
    """
    front, rear = _crouch(rng)
    length, low, high = 6.0, 0.3, 5.0
    signs = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1]])
    amplitudes = (rng.uniform(2.5, 3.5), rng.uniform(2.5, 3.5), rng.uniform(0.05, 0.08))
    fastest = CHIRP_ACCELERATION * GENTLE.leg_acceleration

    def course(t: Array) -> Array:
        setpoints = np.tile(_posture(front, rear), (len(t), 1))
        for part, (sign, amplitude) in enumerate(zip(signs, amplitudes, strict=True)):
            own = np.clip(t - part * length, 0.0, length)
            omega = 2 * np.pi * low * (high / low) ** (own / length)
            phase = (omega - 2 * np.pi * low) * length / np.log(high / low)
            columns = LEG_SLICE if part == 2 else WHEEL_SLICE
            size = np.minimum(amplitude, fastest / omega**2) if part == 2 else amplitude
            wave = size * np.sin(phase) * _fade(own, length, 0.3)
            setpoints[:, columns] += np.multiply.outer(wave, sign)
        return setpoints

    return course, len(signs) * length


def _steps(rng: np.random.Generator, robot: Robot) -> Course:
    front, rear = _crouch(rng)
    pieces = []
    for _ in range(24):
        wheels = rng.uniform(-1.5, 1.5) + rng.uniform(-3.0, 3.0, 4)
        pieces.append((rng.uniform(0.3, 0.7), _posture(front, rear) + np.append(rng.uniform(-0.25, 0.25, 4), wheels)))
    return _holds([*pieces, (0.3, _posture(front, rear))])


#: Every excitation by name. The first eight are the runs a measured data set is made of.
EXCITATIONS: dict[str, Excitation] = {
    "straight": Excitation(
        "forth and back at five speeds, stops between", "wheel radius, rolling resistance, wheel servos, mass", _straight
    ),
    "posture": Excitation(
        "legs swing together and by axles while the body drives on", "leg servos, gear friction, leg geometry", _posture_sweep
    ),
    "turns": Excitation("spins in place, arcs and pivots", "friction of each wheel, yaw inertia, slip", _turns),
    "s_curve": Excitation("forward, left and right wheels in slow counterphase", "slip while driving, track width", _s_curve),
    "stop_and_go": Excitation(
        "abrupt changes of speed and reversals", "delays, wheel inertia and friction, backlash of the wheels", _stop_and_go
    ),
    "rear_legs": Excitation(
        "rear legs turn slowly from front to back, rear wheels free",
        "load on the legs, centre of mass",
        partial(_swing_over, turning_front=False),
    ),
    "all_legs": Excitation(
        "all legs turn slowly to the other side, rear wheels free",
        "load on the legs, zero offsets, geometry",
        partial(_swing_over, turning_front=True),
    ),
    "random": Excitation("band-limited random setpoints of both axles and sides", "everything at once", _random),
    "chirp": Excitation(
        "sines from 0.3 to 5 Hz: wheels together, left against right, front legs against rear legs",
        "bandwidth of servos and body, delays, tyre stiffness",
        _chirp,
    ),
    "steps": Excitation(
        "new random setpoint for every joint each half second, no profile: motors saturate",
        "torque limits, supply, impacts, unequal wheels",
        _steps,
        Profile(),
    ),
}
