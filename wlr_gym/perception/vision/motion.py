"""Smooth signals with gaps and known noise: one alone, and a body's motion over camera, IMU and legs together.

One signal: Kalman filter, and Rauch, Tung and Striebel's smoother. The model is a constant acceleration with white jerk; how
much jerk is what makes the data most likely. A sample far off what the others say is left out.

A body's motion: one Kalman filter forwards, what comes later added backwards. Each of x, y, z, yaw, pitch and roll moves with
white jerk, as much as smoothing it alone finds. A frame measures all six, with its covariance; the legs measure changes of
height, pitch and roll. Gyroscope and accelerometer measure turn rates and the force on the body, with the noise that the slip
observer gives them: more where a reading changes and where legs move. Left open are bias, scale and mounting of the IMU and the
slope of the floor. The gyroscope's pitch rate is not used: legs and drives pitch the body in step with the log, whose samples
then add up to milliradians of no motion. Wheels measure nothing: their slip is what is wanted. It is part of the state, so its
covariance comes with it.

Legs: four wheels on a floor give height, pitch and roll, which a film alone tells badly. Only changes count. Left open are
constants (the plate on the body, tyres), the zeros of the legs, and the slope of the floor against the plane of its markers: on
a straight way it is a constant. No floor is quite flat, and tyres give way with their loads: the floor under each wheel wanders
up and down with the way that wheel and leg go. A wheel that is dragged goes as far as the others roll.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.compiled import compiled, inner_kernel
from wlr_gym.base.errors import InputError
from wlr_gym.data.run_states import rest_pose
from wlr_gym.data.runs import Run
from wlr_gym.perception.observer.observer import constants
from wlr_gym.perception.observer.slip_filter import leak_noise, rate_noise, shaking
from wlr_gym.perception.vision.tracking import Sample
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: log10 of the jerk's spectral density, in unit^2/s^5, that are tried.
_DENSITIES = np.arange(-6.0, 8.1, 0.5)
_OUTLYING = 100.0  # squared deviations from the prediction, in its variance
_MOST_REJECTED = 4  # in a row; then the signal has really jumped
#: What white jerk of density 1 adds to the covariance of value, rate and acceleration: these times these powers of the time.
_SHARES = 1 / np.array([[20.0, 8.0, 6.0], [8.0, 3.0, 2.0], [6.0, 2.0, 1.0]])
_POWERS = np.array([[5, 4, 3], [4, 3, 2], [3, 2, 1]])


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A signal at the requested times.

    Attributes:
        value, rate, acceleration: (K,).
        outliers: (T,) samples left out.
        density: spectral density of the jerk that was found, unit^2/s^5.
    """

    value: Array
    rate: Array
    acceleration: Array
    outliers: NDArray[np.bool_]
    density: float


def smooth(time: ArrayLike, values: ArrayLike, std: ArrayLike | float, at: ArrayLike, jump: float = math.inf) -> Smoothed:
    """Smooth one signal.

    Args:
        time: (T,) s, increasing. values: (T,), NaN = missing. std: (T,) or one number, 1 sigma of the noise.
        at: (K,) s, increasing: where the result is wanted.
        jump: a sample is an outlier only if it is also this far from its prediction.

    Raises:
        InputError: fewer than three samples.
    """
    time, values, at = (np.asarray(x, np.float64) for x in (time, values, at))
    known = np.isfinite(values)
    if known.sum() < 3:
        raise InputError(f"{int(known.sum())} samples; at least 3 are needed to smooth")
    t, z = time[known], values[known]
    variance = np.broadcast_to(np.asarray(std, np.float64), values.shape)[known] ** 2
    middle = z.mean()
    rejected, none, spreads = np.zeros(len(t), np.bool_), np.empty((0, 3)), np.empty((0, 3, 3))
    likelihood = [_filter(t, z - middle, variance, 10.0**q, jump, rejected, none, spreads) for q in _DENSITIES]
    density = 10.0 ** _DENSITIES[int(np.argmax(likelihood))]
    moments = np.concatenate([t, at])  # of samples, then of results
    order = np.argsort(moments, kind="stable")
    moments, places = moments[order], np.argsort(order, kind="stable")
    inputs = np.concatenate([z - middle, np.full(len(at), np.nan)])[order]
    noise = np.concatenate([variance, np.ones(len(at))])[order]
    count = len(moments)
    rejected, states, spreads = np.zeros(count, np.bool_), np.empty((count, 3)), np.empty((count, 3, 3))
    _filter(moments, inputs, noise, density, jump, rejected, states, spreads)
    _smooth_back(moments, density, states, spreads)
    rows, outliers = places[len(t) :], np.zeros(len(time), np.bool_)
    outliers[known] = rejected[places[: len(t)]]
    value, rate, acceleration = states[rows].T
    return Smoothed(value + middle, rate, acceleration, outliers, density)


@inner_kernel
def _predict(step: float, density: float, spread: Any) -> None:
    """Carry a covariance (3, 3) over a step of constant acceleration with white jerk of that density."""
    half = 0.5 * step * step
    for j in range(3):
        spread[0, j] += step * spread[1, j] + half * spread[2, j]
        spread[1, j] += step * spread[2, j]
    for i in range(3):
        spread[i, 0] += step * spread[i, 1] + half * spread[i, 2]
        spread[i, 1] += step * spread[i, 2]
    for i in range(3):
        for j in range(3):
            spread[i, j] += density * _SHARES[i, j] * step ** _POWERS[i, j]


@compiled
def _filter(
    time: Any, values: Any, variances: Any, density: float, jump: float, rejected: Any, states: Any, spreads: Any
) -> float:
    """Kalman filter; returns the log likelihood. Filtered states and covariances go to ``states``, ``spreads`` unless empty."""
    spread, half, state, gain = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3), np.empty(3)
    spread[0, 0], spread[1, 1], spread[2, 2] = 1e4, 1e2, 1e2
    likelihood, in_a_row = 0.0, 0
    for i in range(time.shape[0]):
        if i > 0 and time[i] > time[i - 1]:
            step = time[i] - time[i - 1]
            _predict(step, density, spread)
            state[0] += step * state[1] + 0.5 * step * step * state[2]
            state[1] += step * state[2]
        rejected[i] = False
        if not math.isnan(values[i]):
            total = spread[0, 0] + variances[i]
            error = values[i] - state[0]
            if error * error > _OUTLYING * total and abs(error) > jump and in_a_row < _MOST_REJECTED:
                rejected[i] = True
                in_a_row += 1
                likelihood -= 0.5 * (_OUTLYING + math.log(total))
            else:
                in_a_row = 0
                for k in range(3):  # Joseph's form: it stays positive however sure a sample is
                    gain[k] = spread[k, 0] / total
                    state[k] += gain[k] * error
                    for j in range(3):
                        half[k, j] = spread[k, j] - gain[k] * spread[0, j]
                for k in range(3):
                    for j in range(3):
                        spread[k, j] = half[k, j] - half[k, 0] * gain[j] + variances[i] * gain[k] * gain[j]
                likelihood -= 0.5 * (error * error / total + math.log(total))
        if states.shape[0] > 0:
            for k in range(3):
                states[i, k] = state[k]
                for j in range(3):
                    spreads[i, k, j] = spread[k, j]
    return likelihood


def _smooth_back(time: Array, density: float, states: Array, spreads: Array) -> None:
    """Rauch, Tung and Striebel: let filtered states (N, 3) hear of all later ones."""
    step, before = np.diff(time)[:, None, None], spreads[:-1]
    matrix = np.eye(3) + step * np.eye(3, k=1) + 0.5 * step**2 * np.eye(3, k=2)
    ahead = matrix @ before @ matrix.transpose(0, 2, 1) + density * _SHARES * step**_POWERS
    gain = np.linalg.solve(np.where(step > 0, ahead, np.eye(3)), matrix @ before).transpose(0, 2, 1)
    gain = np.where(step > 0, gain, np.eye(3))
    states[:-1] -= (gain @ matrix @ states[:-1, :, None])[..., 0]
    _add_later(gain, states)


@compiled
def _add_later(gain: Any, states: Any) -> None:
    for n in range(gain.shape[0] - 1, -1, -1):
        for i in range(3):
            for j in range(3):
                states[n, i] += gain[n, i, j] * states[n + 1, j]


# --- what legs say ------------------------------------------------------------------------------------------------------


#: m, 1 sigma by which the floor under a wheel is off a plane, after a way as long as the body.
UNEVEN = 0.001
_SPRINGY = 2.0  # how many times a leg's own way counts: it shifts the loads
#: m, 1 sigma of the height of a wheel's axle, mean of _MEAN s: legs and tyres that spring.
_SHAKEN, _MEAN = 0.0003, 0.02
_ZERO = 0.01  # rad, 1 sigma of the zero of a leg whose robot file states none
#: 1 sigma of constants of height (m), pitch and roll (rad), and of the slopes.
_CONSTANT_STD, _SLOPE_STD = 0.02, 0.01
#: Sigmas by which legs may change a pose; share of its variance that they are taken to take off at least.
SIGMAS, _LEAST = 4.0, 0.1
#: Height, pitch and roll of a pose; how many numbers are left open: constants, floor under each wheel, slopes (x, y), zeros.
STANDING, _OPENS = [2, 4, 5], (3, 4, 2, 4)
OPEN, UNDER_WHEELS = sum(_OPENS), slice(3, 7)


@dataclass(frozen=True, eq=False)
class LegReadings:
    """What the legs say.

    Attributes:
        values: (K, 3) height, pitch, roll on a plane. by_wheel: (K, 3, 4) change with the floor under each wheel.
        by_zero: (K, 3, 4) with the legs' zeros. noise: (K, 3, 3) of a row. wander: (K, 4) m2/s, of the floor under each wheel.
        prior: (OPEN,) 1 sigma of what is left open.
    """

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
    by_wheel, by_zero = np.empty((len(time), 3, 4)), np.empty((len(time), 3, 4))
    for k, step in enumerate(1e-5 * np.eye(4)):
        raised = Parameters(parameters.values.copy())
        raised["wheel.radius"] = raised["wheel.radius"] + step  # as the floor under it
        by_wheel[:, :, k] = (rest_pose(repeated(raised, len(time)), legs) - values) / 1e-5
        by_zero[:, :, k] = (rest_pose(repeated(parameters, len(time)), legs + step) - values) / 1e-5
    length, period = 2 * float(parameters["hip.position"][0, 0]), float(np.median(np.diff(time)))
    noise = _SHAKEN**2 * _MEAN / period * by_wheel @ by_wheel.transpose(0, 2, 1)
    rolled = np.abs(rate[:, WHEEL_SLICE] * parameters["wheel.radius"])
    rolled = np.maximum(rolled, rolled.mean(axis=1, keepdims=True))
    way = rolled + _SPRINGY * np.abs(rate[:, LEG_SLICE] * parameters["leg.length"])
    known = robot.tolerances.get("joint_zero")
    prior = np.repeat([_CONSTANT_STD, UNEVEN, _SLOPE_STD, _ZERO if known is None else known.legs], _OPENS)
    return LegReadings(values, by_wheel, by_zero, noise, way * UNEVEN**2 / length, prior)


def repeated(parameters: Parameters, count: int) -> Parameters:
    """The parameters of one robot as a batch of ``count``."""
    return Parameters(np.repeat(parameters.values, count, axis=0))


def leg_findings(time: Array, film: SmoothedMotion, joined: SmoothedMotion, samples: Sequence[Sample]) -> Iterator[str]:
    """How a film contradicts the legs, in words: by height, pitch or roll that the legs change more than their model allows.

    Hausman's test: if that model holds, the variance of the change is what the legs take off the variance of the pose. Means
    over as many frames as the film is smoothed over are compared: where a drive starts with a jerk, that is too much.

    Args:
        time: (K,) s. film, joined: smoothed without and with the legs. samples: of the film.
    """
    seen = [sample for sample in samples if math.isfinite(sample.pose[0])]
    noise = np.median([np.diag(sample.covariance) for sample in seen], axis=0)
    frames = float(np.median(np.diff([sample.time for sample in seen]))) / float(np.median(np.diff(time)))  # rows of one
    smoothed_over = frames * noise / np.median(film.value_std**2, axis=0)
    smoothed_over[2] = max(smoothed_over[2], smoothed_over[4])  # the wheels tie the height to the pitch
    for k, name, unit in zip(STANDING, ("height", "pitch", "roll"), ("mm", "mrad", "mrad"), strict=True):
        rows = min(len(time), max(1, round(smoothed_over[k])))
        change, before, after, when = (
            np.convolve(values, np.full(rows, 1 / rows), mode="valid")
            for values in (joined.value[:, k] - film.value[:, k], film.value_std[:, k] ** 2, joined.value_std[:, k] ** 2, time)
        )
        sigmas = np.abs(change) / np.sqrt(np.maximum(before - after, _LEAST * before))
        worst = int(np.argmax(sigmas))
        if sigmas[worst] > SIGMAS:
            size = f"{1e3 * abs(change[worst]):.1f} {unit} ({sigmas[worst]:.0f} sigmas)"
            yield (
                f"the {name} differs from what the legs say, which would change it by {size}, most at {when[worst]:.2f} s: a "
                "wheel off the floor, a floor that is not flat, or a marker that gives way; legs are not used"
            )


# --- the smoother -----------------------------------------------------------------------------------------------------


# Where the state's elements stand; those of the IMU per axis, the slope along x and y of the floor.
_VALUE, _RATE, _ACCELERATION = slice(0, 6), slice(6, 12), slice(12, 18)
_GYRO_BIAS, _GYRO_SCALE, _MOUNT, _LEAK, _SLOPE = slice(18, 21), slice(21, 24), slice(24, 27), slice(27, 30), slice(30, 32)
_OPEN = slice(32, 32 + OPEN)
_FIRST_SLIP = 32 + OPEN
_SIZE = _FIRST_SLIP + 8
_SLIP = slice(_FIRST_SLIP, _SIZE)
_ANGLES, _MOTION = slice(3, 6), slice(0, 12)
#: 1 sigma before anything is seen, about what the single smoothers found (m, rad), and of the IMU.
_PRIOR = (
    (_VALUE, 0.01), (_RATE, 0.3), (_ACCELERATION, 5.0), (_GYRO_BIAS, 0.02), (_GYRO_SCALE, 0.02), (_MOUNT, 0.03), (_LEAK, 0.3),
    (_SLOPE, 0.02),
)  # fmt: skip
#: How much noisier the IMU of a robot that drives is taken for than that of one at rest.
_DRIVING = 2.0
_GYRO_WANDER = 1e-5  # rad/s per root second: walk of the gyroscope's bias
_GATE = 36.0  # squared normalised innovation beyond which an IMU reading counts for less
_STEP = 1e-5  # of derivatives
#: Where poses follow each other by more than this many frames, the film does not tell how the body moves: it may then gain a
#: rate (m/s, rad/s) of this size in a second.
_GAP, _GAINED = 3.0, np.array([1.0, 1.0, 0.05, 1.5, 0.03, 0.03])
_PITCH_RATE = 1  # place of the gyroscope's y
#: Deviations from its neighbours (m, rad) from which on a pose can be an outlier.
_JUMP = (0.01, 0.01, 0.01, 0.03, 0.05, 0.05)


@dataclass(frozen=True, eq=False)
class ImuReadings:
    """What the IMU read.

    Attributes:
        time: (T,) s of the motion that it shows. values: (T, 6) gyroscope, accelerometer; NaN = none. variance: (T, 6).
        leak_wander: (T,) variance per s of the accelerometer's bias. gravity: m/s2.
    """

    time: Array
    values: Array
    variance: Array
    leak_wander: Array
    gravity: float


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """Motion at the run's rows.

    Attributes:
        value, rate, acceleration: (K, 6). value_std: 1 sigma.
        velocity_variance: (K, 8) of what slips. slip_covariance: (K, 8, 8) of it accumulated from the first row.
        outliers: (F,) samples left out.
    """

    value: Array
    rate: Array
    acceleration: Array
    value_std: Array
    velocity_variance: Array
    slip_covariance: Array
    outliers: NDArray[np.bool_]


def imu_readings(run: Run, legs: Array, robot: Robot) -> ImuReadings:
    """What a run's IMU read, and its variance. ``legs``: (T,) rad/s, rms of their rates."""
    t = run["t"]
    values = np.full((len(t), 6), np.nan)
    for k, name in enumerate(f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in "xyz"):
        if name in run:
            values[:, k] = run[name]
    step = float(np.median(np.diff(t)))
    known = constants(robot, step, camera=True).view(np.recarray)[0]
    changed = np.nan_to_num(np.abs(np.diff(values, axis=0, prepend=values[:1])))
    changed[:-1] = np.maximum(changed[:-1], changed[1:])
    legs = legs[:, None]  # the formulas uncompiled: once per run
    gyro = rate_noise.py_func(known, changed[:, :3])
    force = known["accel_noise"] ** 2 + shaking.py_func(known, changed[:, 3:], legs**2)
    time, variance = t - known["lag"] * step, _DRIVING**2 * np.concatenate([gyro, force], axis=1)
    values[:, _PITCH_RATE] = np.nan
    return ImuReadings(time, values, variance, leak_noise.py_func(known, legs[:, 0] ** 2), float(known["gravity"]))


def smooth_motion(
    samples: Sequence[Sample],
    time: Array,
    rows: Array,
    slipping: Callable[[Array, Array], Array],
    imu: ImuReadings | None,
    legs: LegReadings | None = None,
) -> SmoothedMotion:
    """Smooth a body's motion.

    Args:
        samples: of the film. time: (F,) s of them, servo clock. rows: (K,) s, where the motion is wanted.
        slipping: slip velocities (K, 4, 2) for values and rates (K, 6) at the rows.
        imu: None = the camera alone. legs: what they say at the rows; None = nothing.
    """
    poses, std, outliers = _signals(samples, time)
    kept = np.isfinite(poses[:, 0]) & ~outliers
    first, last = time[kept][[0, -1]]
    inside = np.flatnonzero((imu.time > first) & (imu.time < last)) if imu is not None else np.zeros(0, np.int64)
    moments = np.concatenate([time[kept], rows, imu.time[inside] if imu is not None else []])
    order = np.argsort(moments, kind="stable")
    moments = moments[order]
    frames, shown, read = np.split(np.argsort(order, kind="stable"), np.cumsum([kept.sum(), len(rows)]))
    near = _each_alone(poses, std, outliers, time, moments)
    at = np.zeros((len(moments), _SIZE))  # near enough to be linear about
    for part, name in ((_VALUE, "value"), (_RATE, "rate"), (_ACCELERATION, "acceleration")):
        at[:, part] = np.stack([getattr(signal, name) for signal in near], axis=1)

    seen = _Measurements(len(moments))
    seen.add_frames(frames, poses[kept], np.stack([sample.covariance for sample in samples])[kept])
    last_row = np.searchsorted(shown, np.arange(len(moments)), side="right")
    wander, spread = np.zeros((len(moments), _SIZE)), np.zeros(_SIZE)
    for part, std in _PRIOR:
        spread[part] = std**2
    if imu is not None:
        seen.add_imu(read, imu, inside, at[read])
        wander[:, _GYRO_BIAS], wander[:, _LEAK] = _GYRO_WANDER**2, np.interp(moments, imu.time, imu.leak_wander)[:, None]
    if legs is not None:
        seen.add_legs(shown, legs, at[shown])
        nearest = np.clip(last_row - 1, 0, len(rows) - 1)
        wander[:, _OPEN][:, UNDER_WHEELS], spread[_OPEN] = legs.wander[nearest], legs.prior**2
    slope = _derivatives(lambda x: slipping(x[:, _VALUE], x[:, _RATE]).reshape(-1, 8), at[shown], _MOTION.stop)
    slope = slope[:, :, _MOTION]
    slipping_since = np.concatenate([np.zeros_like(slope[:1]), slope])  # nothing before the first row
    density = np.tile([signal.density for signal in near], (len(moments), 1))
    steps = np.diff(time[kept])
    before = np.clip(np.searchsorted(time[kept], moments) - 1, 0, len(steps) - 1)
    unseen = steps[before] > _GAP * np.median(steps)  # in a gap of the frames with a pose, or at its end
    density[unseen] = np.maximum(density[unseen], 3 * _GAINED**2)
    states, covariance = _smoothed(
        moments, shown, density, wander, slipping_since, last_row, seen, at[0], np.diag(spread)
    )  # fmt: skip
    return SmoothedMotion(
        value=states[:, _VALUE],
        rate=states[:, _RATE],
        acceleration=states[:, _ACCELERATION],
        value_std=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, _VALUE]),
        velocity_variance=np.einsum("kij,kjl,kil->ki", slope, covariance[:, _MOTION, _MOTION], slope),
        slip_covariance=covariance[:, _SLIP, _SLIP].copy(),  # the rest is 25 times as large
        outliers=outliers,
    )


def without_outliers(samples: Sequence[Sample], time: Array) -> list[Sample]:
    """The samples that do not contradict their neighbours."""
    outliers = _signals(samples, time)[2]
    return [sample for sample, wrong in zip(samples, outliers, strict=True) if not wrong]


def smoothed_poses(samples: Sequence[Sample], time: Array, at: Array) -> list[Smoothed]:
    """Each of the six coordinates alone at the times ``at`` (K,), without outliers."""
    return _each_alone(*_signals(samples, time), time, at)


def _each_alone(poses: Array, std: Array, outliers: NDArray[np.bool_], time: Array, at: Array) -> list[Smoothed]:
    kept = np.where(outliers[:, None], np.nan, poses)
    return [smooth(time, kept[:, k], std[:, k], at) for k in range(6)]


def _signals(samples: Sequence[Sample], time: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Poses (F, 6) with a continuous yaw, their 1 sigma, and which are outliers."""
    poses, std = np.stack([s.pose for s in samples]), np.sqrt(np.stack([np.diag(s.covariance) for s in samples]))
    known = np.isfinite(poses[:, 3])
    poses[known, 3] = np.unwrap(poses[known, 3])
    alone = [smooth(time, poses[:, k], std[:, k], time[:1], _JUMP[k]) for k in range(6)]
    return poses, std, np.any([signal.outliers for signal in alone], axis=0)


class _Measurements:
    """What is measured at each of the moments, at most six numbers, linear in the state.

    Attributes:
        count: (M,) numbers. design: (M, 6, _SIZE). values: (M, 6). noise: (M, 6, 6).
        gate: (M,) squared normalised innovation from which on they count for less.
    """

    def __init__(self, moments: int) -> None:
        self.count, self.gate = np.zeros(moments, np.int64), np.full(moments, _GATE)
        self.design, self.values = np.zeros((moments, 6, _SIZE)), np.zeros((moments, 6))
        self.noise = np.tile(np.eye(6), (moments, 1, 1))

    def add_frames(self, at: NDArray[np.int64], poses: Array, covariances: Array) -> None:
        self.design[at, :, _VALUE], self.values[at], self.noise[at] = np.eye(6), poses, covariances
        self.count[at], self.gate[at] = 6, math.inf

    def add_imu(self, at: NDArray[np.int64], imu: ImuReadings, rows: NDArray[np.int64], states: Array) -> None:
        """Add rows of the IMU's readings, their finite numbers, linear about the states (., _SIZE)."""
        expected = _expected(states, imu.gravity)
        design = _derivatives(lambda x: _expected(x, imu.gravity), states, _FIRST_SLIP)
        values = imu.values[rows] - expected + np.einsum("kij,kj->ki", design, states)
        for i, k in enumerate(at):
            fine = np.flatnonzero(np.isfinite(values[i]))
            self.count[k] = m = len(fine)
            self.design[k, :m], self.values[k, :m] = design[i, fine], values[i, fine]
            self.noise[k, range(m), range(m)] = imu.variance[rows[i], fine]

    def add_legs(self, at: NDArray[np.int64], legs: LegReadings, states: Array) -> None:
        self.count[at], self.gate[at] = 3, math.inf  # legs that contradict the film are to show: see leg_findings
        self.values[at, :3], self.noise[at, :3, :3] = legs.values, legs.noise
        self.design[at[:, None], range(3), STANDING] = 1.0
        self.design[at, :3, _OPEN] = -legs.design(states)


def body_rates(pitch: Array, roll: Array, rates: Array) -> Array:
    """Angular velocity in the body frame (K, 3) from rates of yaw, pitch, roll (K, 3)."""
    yaw_rate, pitch_rate, roll_rate = rates.T
    x = roll_rate - yaw_rate * np.sin(pitch)
    y = pitch_rate * np.cos(roll) + yaw_rate * np.cos(pitch) * np.sin(roll)
    z = yaw_rate * np.cos(pitch) * np.cos(roll) - pitch_rate * np.sin(roll)
    return np.stack([x, y, z], axis=1)


def _expected(states: Array, gravity: float) -> Array:
    """What the IMU reads, (K, 6), in states (K, _SIZE)."""
    yaw, pitch, roll = states[:, _ANGLES].T
    turning = body_rates(pitch, roll, states[:, _RATE][:, _ANGLES])
    force = states[:, _ACCELERATION][:, :3] + gravity * np.column_stack([states[:, _SLOPE], np.ones(len(states))])
    force = np.einsum("kji,kj->ki", rotation(yaw, pitch, roll), force)
    mount = states[:, _MOUNT]
    turning, force = turning + np.cross(turning, mount), force + np.cross(force, mount)
    return np.concatenate([turning * (1 + states[:, _GYRO_SCALE]) + states[:, _GYRO_BIAS], force + states[:, _LEAK]], axis=1)


def _derivatives(function: Callable[[Array], Array], at: Array, columns: int) -> Array:
    """Derivatives (K, M, _SIZE) of a function (K, M) of states (K, _SIZE), which depends on the first ``columns`` of them."""
    result = np.zeros((*function(at).shape, _SIZE))
    for column in range(columns):
        change = _STEP * (np.arange(_SIZE) == column)
        result[:, :, column] = (function(at + change) - function(at - change)) / (2 * _STEP)
    return result


def _transition(step: float, slope: Array) -> Array:
    """The change of the state over a step; slip goes on with the ``slope`` (8, 12) of its velocity."""
    matrix = np.eye(_SIZE)
    of_value, of_rate = slope[:, :6], slope[:, 6:]
    matrix[_VALUE, _RATE] = matrix[_RATE, _ACCELERATION] = step * np.eye(6)
    matrix[_VALUE, _ACCELERATION] = 0.5 * step**2 * np.eye(6)
    matrix[_SLIP, _VALUE] = step * of_value
    matrix[_SLIP, _RATE] = 0.5 * step**2 * of_value + step * of_rate
    matrix[_SLIP, _ACCELERATION] = step**3 / 6 * of_value + 0.5 * step**2 * of_rate
    return matrix


def _unsteadiness(step: float, density: Array, wander: Array, slope: Array) -> Array:
    """The noise of that change."""
    noise, of_rate = np.diag(step * wander), slope[:, 6:]
    apart = np.array([
        [step**5 / 20, step**4 / 8, step**3 / 6], [step**4 / 8, step**3 / 3, step**2 / 2], [step**3 / 6, step**2 / 2, step]
    ])  # fmt: skip
    moved = of_rate * density  # what the body is moved by, it slips by
    noise[:18, :18] = (apart[:, None, :, None] * np.diag(density)[:, None, :]).reshape(18, 18)
    noise[_SLIP, _SLIP] += apart[0, 0] * moved @ of_rate.T
    noise[_SLIP, :18] = (apart[0][:, None] * moved[:, None, :]).reshape(8, 18)
    noise[:18, _SLIP] = noise[_SLIP, :18].T
    return noise


def _smoothed(
    time: Array, shown: NDArray[np.int64], density: Array, wander: Array, slope: Array, row: NDArray[np.int64],
    measured: _Measurements, start: Array, spread: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """States and covariances at the moments ``shown``.

    Backwards by Bryson and Frazier's equations: what later measurements say is carried as a gradient and its variance, so no
    covariance is inverted, and slip, which is certain at first, may be a state.
    """
    total = len(time)
    states, spreads = np.empty((len(shown), _SIZE)), np.empty((len(shown), _SIZE, _SIZE))
    gains, weights, errors = np.zeros((total, _SIZE, 6)), np.zeros((total, 6, 6)), np.zeros((total, 6))
    count, design, seen, noise, gate = measured.count, measured.design, measured.values, measured.noise, measured.gate
    x, p, k = start.copy(), spread.copy(), 0
    for i in range(total):
        if i > 0:
            step, own = time[i] - time[i - 1], slope[row[i - 1]]
            matrix = _transition(step, own)
            x = matrix @ x
            p = matrix @ p @ matrix.T + _unsteadiness(step, density[i], wander[i], own)
        if k < len(shown) and shown[k] == i:
            states[k], spreads[k] = x, p
            k += 1
        m = count[i]
        if m == 0:
            continue
        h = design[i, :m]
        error = seen[i, :m] - h @ x
        seen_by = p @ h.T
        weight = np.linalg.inv(h @ seen_by + noise[i, :m, :m])
        weight /= max(1.0, error @ weight @ error / gate[i])
        gain = seen_by @ weight
        x = x + gain @ error
        p = p - gain @ seen_by.T
        p = 0.5 * (p + p.T)
        gains[i, :, :m], weights[i, :m, :m], errors[i, :m] = gain, weight, error
    gradient, lent, k = np.zeros(_SIZE), np.zeros((_SIZE, _SIZE)), len(shown) - 1
    for i in range(total - 1, -1, -1):
        m = count[i]
        if m > 0:
            h, gain, weight = design[i, :m], gains[i, :, :m], weights[i, :m, :m]
            gradient = gradient - h.T @ (gain.T @ gradient + weight @ errors[i, :m])
            kept = np.eye(_SIZE) - gain @ h
            lent = kept.T @ lent @ kept + h.T @ weight @ h
        if k >= 0 and shown[k] == i:
            p = spreads[k].copy()
            states[k] -= p @ gradient
            spreads[k] = p - p @ lent @ p
            k -= 1
        if i > 0:
            matrix = _transition(time[i] - time[i - 1], slope[row[i - 1]])
            gradient = matrix.T @ gradient
            lent = matrix.T @ lent @ matrix
            lent = 0.5 * (lent + lent.T)
    return states, spreads
