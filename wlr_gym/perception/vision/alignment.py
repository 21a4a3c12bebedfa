"""Find what the camera's clock reads when the servos' clock reads zero: the offset between both, from motion both have seen.

Four things are measured by both: yaw (camera) and the integral of the gyroscope's z rate; pitch and that of its y rate; the
height of the body and what the leg angles say about it; the distance driven and what wheels and legs say about it. Each pair is
compared as angle or length, not as a rate, so nothing is differentiated. Slow differences are projected out first: drift of
the gyroscope, and what slip and tyres that give way do to distance and pitch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.run_states import quaternion, rest_pose
from wlr_gym.data.runs import Run
from wlr_gym.perception.vision.motion import repeated, smooth
from wlr_gym.robot import JOINTS, LEG_SLICE, Robot
from wlr_gym.robot.parameters import Parameters
from wlr_gym.robot.slip import accumulate, contact_slip_velocity

Array = NDArray[np.float64]

SEARCH = 1.0  # s; the offset is looked for within this
LARGEST_STD = 0.004  # s; an offset less certain than this is refused
#: s; of turns and heights, differences with a longer period are drift of the gyroscope and not of the clocks.
_DRIFT = 40.0
_SLIP = 5.0  # s; of the distance driven, differences with a longer period are slip
_GRID = 0.005  # s
#: Share of a sensor's readings that must be there; most missing ones in a row with which the gyroscope tells the clocks.
_SHARE, _HOLES = 0.9, 4
_LATENCY = 1e-3  # s; the delays inside IMU and camera are known no better
_DISTANCE = "distance"
_START_SLIP = 1e-4  # m; a wheel that starts later than the body looks like a clock that is late
_ROLLS = 20.0  # a wheel that rolls explains the distance this many times better than nothing
_DISTINCT = 0.1  # s; a second minimum this far off
_TURN = 0.02  # rad rms; a turn seen by the camera that the gyroscope must explain
_SAME_TURN = 10.0  # the part of it that stays unexplained is at most one over this


@dataclass(frozen=True)
class Alignment:
    """Offset between the clocks: servo time = camera time + ``offset``.

    Attributes:
        offset, std: s.
        parts: per signal that took part: its own offset and 1 sigma, s.
    """

    offset: float
    std: float
    parts: dict[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class _Pair:
    """One quantity as the camera saw it, (F,), and a function of servo time that gives it up to drifts slower than ``slowest``,
    a scale, and any multiple of a ``nuisance``."""

    name: str
    seen: Array
    servo: Callable[[Array], Array]
    slowest: float
    free_scale: bool = False
    nuisance: Callable[[Array], Array] | None = None

    def residual(self, at: Array, project: Callable[[Array], Array]) -> Array:
        """What servo time ``at`` does not explain, of what is not ``project``-ed out."""
        seen, servo = project(self.seen), project(self.servo(at))
        free = [servo] if self.free_scale else []
        if self.nuisance is not None:
            free.append(project(self.nuisance(at)))
        error = seen if self.free_scale else seen - servo
        for column in np.linalg.qr(np.stack(free, axis=1))[0].T if free else ():
            error = error - column * (column @ error)
        return error

    def costs(self, time: Array, grid: Array, project: Callable[[Array], Array]) -> Array:
        """Squares of the residuals at each offset of a grid, summed."""
        return np.array([np.sum(self.residual(time + offset, project) ** 2) for offset in grid])


def align(time: Array, poses: Array, run: Run, robot: Robot, parameters: Parameters, around: float = 0.0) -> Alignment:
    """Find the offset between the camera's clock and the run's.

    Args:
        time: (F,) s, camera clock. poses: (F, 6) x, y, z, yaw, pitch, roll of the body; NaN rows = no pose.
        run: encoders, and gyroscope if there is one. robot: its IMU bandwidth delays the gyroscope. parameters: (1).
        around: s; the offset is looked for within :data:`SEARCH` of it.

    Raises:
        InputError: too few poses in common, no motion that fixes the offset to :data:`LARGEST_STD`, or turns that camera and
            gyroscope saw differently at every offset tried.
    """
    known = np.isfinite(poses).all(axis=1)
    time, poses = time[known], poses[known]
    for spare in (SEARCH, 0.0):  # frames that lie in the run at every offset, or at the middle one
        inside = (time + around - spare > run["t"][0]) & (time + around + spare < run["t"][-1])
        if inside.sum() >= 30:
            break
    else:
        raise InputError(
            f"{run.path}: only {int(inside.sum())} frames with a pose fall into the run, 30 are needed; does the video belong "
            "to it? (--offset says by how much the clocks differ)"
        )
    time, poses = time[inside], poses[inside]
    grid = around + np.arange(-SEARCH, SEARCH + 1e-9, _GRID)
    useful: dict[str, tuple[Array, float, float]] = {}
    for pair in _pairs(time, poses, run, robot, parameters, around):
        project = without_slow(time, pair.slowest)
        curve = pair.costs(time, grid, project)
        if pair.name == "yaw" and _contradicts(project(pair.seen), curve):
            raise InputError(
                f"{run.path}: camera and gyroscope do not see the same turns with clocks {grid[0]:+.1f} to {grid[-1]:+.1f} s "
                "apart; does the video belong to the run? If the clocks differ by more, give --around; if it is slow motion or "
                "a time lapse, the rate at which it was filmed (--rate)"
            )
        found = _weighted(pair, curve, time, grid, project)
        if found is not None and found[2] < 5 * LARGEST_STD:
            useful[pair.name] = found
    refuse = f"{run.path}: the clocks cannot be aligned: "
    if not useful:
        raise InputError(refuse + "no motion that camera and servos both see (a start, a stop, a turn, a leg that moves); "
                         "film one, or give --offset; clocks more than 1 s apart need --around")  # fmt: skip
    _, sharpest, least = min(useful.values(), key=lambda part: part[2])  # what contradicts it is left out
    useful = {name: part for name, part in useful.items() if abs(part[1] - sharpest) < 4 * math.hypot(part[2], least)}
    costs = np.sum([cost for cost, _, _ in useful.values()], axis=0)
    best = int(np.argmin(costs))
    if not 0 < best < len(grid) - 1:
        raise InputError(refuse + f"the best offset lies at the edge of the search, {grid[best]:+.2f} s; give --around")
    offset, std = _vertex(grid, costs, best)
    far = np.abs(grid - offset) > _DISTINCT
    if costs[far].min() - costs[best] < 9.0:
        raise InputError(
            refuse + f"offsets {offset:+.3f} and {grid[far][np.argmin(costs[far])]:+.3f} s fit alike; give --offset"
        )
    if std > LARGEST_STD:
        raise InputError(refuse + f"too little motion: the offset is known to {1e3 * std:.1f} ms only; give --offset")
    return Alignment(offset, math.hypot(std, _LATENCY), {name: part[1:] for name, part in useful.items()})


def _contradicts(seen: Array, curve: Array) -> bool:
    """Whether a plain turn (rad) is explained at no offset, or best at the edge of the search."""
    plain = float(seen @ seen) > _TURN**2 * len(seen)
    return plain and (curve.min() > seen @ seen / _SAME_TURN**2 or int(np.argmin(curve)) in (0, len(curve) - 1))


def _weighted(
    pair: _Pair, curve: Array, time: Array, grid: Array, project: Callable[[Array], Array]
) -> tuple[Array, float, float] | None:
    """Cost in units of its noise, neighbouring residuals that err alike counted once; own offset, 1 sigma. None = useless."""
    best = int(np.argmin(curve))
    residual = pair.residual(time + grid[best], project)
    size = float(residual @ residual)
    moved = project(pair.seen)
    least = _ROLLS if pair.name == _DISTANCE else 2.0
    if size <= 0 or moved @ moved < least**2 * size or not 0 < best < len(grid) - 1:
        return None
    if moved @ project(pair.servo(time + grid[best])) <= 0:  # the free scale would be negative: another motion
        return None
    alike = 1.0  # neighbours that share one error: 1 + twice the autocorrelation until it first falls below 0.05
    for lag in range(1, len(residual) // 3):
        share = float(residual[lag:] @ residual[:-lag]) / size
        if share < 0.05:
            break
        alike += 2 * share
    cost = (curve - curve[best]) / (size / max(1, len(time) - 1) * alike)
    offset, std = _vertex(grid, cost, best)
    if pair.name == _DISTANCE:
        fastest = float(np.abs(np.gradient(pair.seen, time)).max())
        wider = math.hypot(std, _START_SLIP / max(fastest, 1e-9))
        cost, std = cost * (std / wider) ** 2, wider
    return cost, offset, std


def _vertex(grid: Array, costs: Array, best: int) -> tuple[float, float]:
    """Minimum, and 1 sigma by the curvature, of a parabola through five points around the best."""
    near = slice(max(0, best - 2), min(len(grid), best + 3))
    a, b, _ = np.polyfit(grid[near] - grid[best], costs[near], 2)
    return float(grid[best] - (b / (2 * a) if a > 0 else 0.0)), 1 / math.sqrt(max(a, 5e-13))


def without_slow(time: Array, slowest: float) -> Callable[[Array], Array]:
    """Return a function that takes everything with a longer period (s) out of a signal sampled at ``time``."""
    phase = (time - time[0]) / max(time[-1] - time[0], 1e-9)
    count = 1 + int(2 * (time[-1] - time[0]) / slowest)
    slow = np.stack([np.ones_like(phase), phase, *[np.cos(math.pi * k * phase) for k in range(1, count)]], axis=1)
    basis = np.linalg.qr(slow)[0]
    return lambda signal: signal - basis @ (basis.T @ signal)


def _pairs(time: Array, poses: Array, run: Run, robot: Robot, parameters: Parameters, around: float) -> list[_Pair]:
    t = run["t"]
    joints = joint_signals(run, t, robot)
    legs = joints[0][:, LEG_SLICE] - parameters["joint.zero_offset"]
    rest = rest_pose(parameters, legs)
    sag = _sag(legs, parameters)
    pairs = [
        _Pair("height", poses[:, 2], _between(t, rest[:, 0]), _DRIFT, free_scale=True, nuisance=_between(t, sag[0])),
        _Pair("pitch of the legs", poses[:, 4], _between(t, rest[:, 1]), _DRIFT, nuisance=_between(t, sag[1])),
    ]
    delay = 1 / (2 * math.pi * robot.sensors.imu.bandwidth)  # of a first-order low-pass
    for axis, column, name in (("z", 3, "yaw"), ("y", 4, "pitch")):
        if (rate := readings(run, f"gyro_{axis}", _HOLES)) is not None:
            angle = accumulate(rate, t)
            seen = np.unwrap(poses[:, column])
            pairs.append(_Pair(name, seen, _between(t - delay, angle), _DRIFT))
    return [*pairs, _rolling_pair(time + around, poses, run, joints, rest, parameters)]


def _rolling_pair(
    time: Array, poses: Array, run: Run, joints: tuple[Array, Array], rest: Array, parameters: Parameters
) -> _Pair:
    """Distance driven along the heading, by the camera and by the wheel that slips least: the one that explains it best."""
    yaw = smooth(time, np.unwrap(poses[:, 3]), 1e-4, time).value
    steps, heading = np.diff(poses[:, :2], axis=0), 0.5 * (yaw[1:] + yaw[:-1])
    driven = np.concatenate([[0.0], np.cumsum(steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading))])
    # how fast the body goes along its heading if a wheel does not slip; its turn rates from legs and gyroscope
    t, count = run["t"], len(rest)
    turning = np.zeros((count, 3))
    turning[:, 1] = np.gradient(rest[:, 1], t)
    if (rate := readings(run, "gyro_z", _HOLES)) is not None:
        turning[:, 2] = rate
    attitude = quaternion(np.zeros(count), rest[:, 1], rest[:, 2])
    slip = contact_slip_velocity(repeated(parameters, count), attitude, np.zeros((count, 3)), turning, *joints)
    ways = accumulate(-slip[:, :, 0], t).T
    pairs = [_Pair(_DISTANCE, driven, _between(t, way), _SLIP, free_scale=True) for way in ways]
    project, shifts = without_slow(time, _SLIP), np.arange(-SEARCH, SEARCH, 4 * _GRID)
    return min(pairs, key=lambda pair: pair.costs(time, shifts, project).min())


def _sag(legs: Array, parameters: Parameters) -> tuple[Array, Array]:
    """Shapes (K,) of how far body height and pitch give way under its weight as the legs move the wheels' load about.

    Springs under front and rear wheels at x_f and x_r carry the weight by the lever rule; how soft they are is left open.
    """
    reach = parameters["leg.length"][0] * np.cos(legs)
    front = parameters["hip.position"][0, 0] + reach[:, :2].mean(axis=1)
    rear = -parameters["hip.position"][0, 0] + reach[:, 2:].mean(axis=1)
    base = np.maximum(front - rear, 0.05)
    return (front**2 + rear**2) / base**2, (front + rear) / base**2


def joint_signals(run: Run, at: Array, robot: Robot) -> tuple[Array, Array]:
    """Joint angles and rates (K, 8) at times on the servo clock, smoothed from the encoders."""
    std = max(robot.sensors.encoder.position, 1e-6) / math.sqrt(12)
    found = [smooth(run["t"], run[f"pos_{joint}"], std, at) for joint in JOINTS]
    return np.stack([f.value for f in found], axis=1), np.stack([f.rate for f in found], axis=1)


def readings(run: Run, name: str, longest: float = math.inf) -> Array | None:
    """A column (T,) of a run, missing numbers interpolated; None where it is absent, or too many are missing.

    Args:
        run: with it or without. name: of the column. longest: most that may be missing in a row.
    """
    if name not in run or (fine := np.isfinite(run[name])).mean() < _SHARE:
        return None
    if np.diff(np.flatnonzero([True, *fine, True])).max() > longest + 1:
        return None
    return np.interp(run["t"], run["t"][fine], run[name][fine])


def _between(t: Array, values: Array) -> Callable[[Array], Array]:
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(t, values)
    return lambda at: spline(np.clip(at, t[0], t[-1]))
