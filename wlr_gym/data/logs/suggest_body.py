"""Propose units and frames of poses and of the IMU, and the clocks of their topics, from the motion that all of them show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.data.check import integral
from wlr_gym.data.logs.align import Lag, find_lag
from wlr_gym.data.logs.map import FACTORS
from wlr_gym.data.logs.rows import pose_angle
from wlr_gym.data.logs.signals import (
    GUESS,
    LIKELY,
    SURE,
    BodyMotion,
    LogSignals,
    common_grid,
    likeness,
    over_windows,
    unit_of,
)
from wlr_gym.data.logs.suggest_joints import JointFindings, angle
from wlr_gym.robot import LEGS, WHEELS
from wlr_gym.robot.parameter_table import XYZ
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: s; poses are smoothed over this before they are differentiated.
_SMOOTH = 0.2
#: m/s: wheels whose sides differ by more turn the robot. rad/s: legs that are quicker move. s around either that do not count.
_TURN_SPEED, _SWING, _AROUND = 0.02, 0.05, 0.3
#: s; an IMU's clock that is off by more is moved before axes are looked for.
_ROUGH = 0.1
#: rad; a robot that drives is not tilted by so much.
_TILTED = 1.0
#: Units that gyroscopes read in.
_GYRO_UNITS = {unit: FACTORS["rad/s"][unit] for unit in ("rad/s", "deg/s")}
#: How much a gyroscope turns of what wheels or pose say: wheels slip in turns.
_AS_MUCH = (0.12, 3.0)
#: Readings show gravity that are 1 g within this share, and this share of that along one axis.
_GRAVITY_SHARE, _ALONG = 0.15, 0.8
#: Correlation from which on a turn or a push shows an axis and its sign, by how much it must beat the usual one, and how many
#: sigmas of chance it must be.
_CLEAR, _MARGIN, _SIGMAS = 0.5, 0.2, 4.0


@dataclass(frozen=True, eq=False)
class ImuFindings:
    """Units of ``gyro`` and ``acc``, and raw readings about the vertical and along the robot; None = not known."""

    units: dict[str, str]
    heading: Array | None
    pushed: Array | None


def smoothed(t: Array, values: Array) -> tuple[Array, Array, Array]:
    """Return a grid, and value and rate of a signal on it, averaged over :data:`_SMOOTH` seconds."""
    grid = np.arange(t[0] + _SMOOTH, t[-1] - _SMOOTH, 0.02)
    total = integral(t, values)
    half = 0.5 * _SMOOTH
    value = (np.interp(grid + half, t, total) - np.interp(grid - half, t, total)) / _SMOOTH
    rate = (np.interp(grid + half, t, values) - np.interp(grid - half, t, values)) / _SMOOTH
    return grid, value, rate


# ---- pose ------------------------------------------------------------------------------------------------------------


def find_pose(look: LogSignals) -> BodyMotion | None:
    """Return how the body moved by its pose, on the log's clocks; unit and frame go into ``look``. None = no pose."""
    if not look.has("cam_x", "cam_y", "cam_yaw"):
        return None
    if min(len(look.raw(f"cam_{axis}")[0]) for axis in ("x", "y", "yaw")) < 10:
        return None
    _upright(look)
    t, x = look.raw("cam_x")
    _, y = look.raw("cam_y")
    at, yaw = look.raw("cam_yaw")
    if len(t) != len(y):
        return None
    unit = look.chosen["cam_x"].unit or _length_unit(look, t, x, y)
    if _in_degrees(look, yaw):
        yaw = np.radians(yaw)
        look.chosen["cam_yaw"] = replace(look.chosen["cam_yaw"], unit="deg")
    for axis in ("x", "y"):
        look.chosen[f"cam_{axis}"] = replace(look.chosen[f"cam_{axis}"], unit=unit)
    scale = FACTORS["m"][unit]
    x, y = (
        values * (-1.0 if axis.startswith("-") else 1.0)
        for values, axis in zip((x, y), look.frames.get("cam", XYZ), strict=False)
    )
    heading = np.interp(t, at, np.unwrap(yaw))
    grid, _, vx = smoothed(t, x * scale)
    vy, turned = smoothed(t, y * scale)[2], smoothed(t, heading)[1]
    forward = integral(grid, vx * np.cos(turned) + vy * np.sin(turned))
    topic = look.chosen["cam_x"].topic
    by_name = look.log.topics[topic].kind.endswith(("PoseStamped", "Odometry")) or topic == "table"
    taken = ", ".join(look.chosen[f"cam_{axis}"].field for axis in ("x", "y", "yaw"))
    lost = len(look.lost(topic))
    left_out = f"; {lost} frames without a rotation left out" if lost else ""
    text = f"topic '{topic}': {taken}; in {unit} by how fast the robot can be{left_out}"
    look.note("cam", SURE if by_name else LIKELY, text)
    _said_tilt(look)
    if "odom" in topic.lower() or look.log.topics[topic].kind.endswith("Odometry"):
        text = f"topic '{topic}' may be computed from the wheels: then it is no measurement: take 'cam' out of the map"
        look.note("cam", GUESS, text)
    return BodyMotion(grid, forward, turned)


def _said_tilt(look: LogSignals) -> None:
    """Say where a quaternion lays the robot on its side or back: no run begins so."""
    chosen = look.chosen["cam_yaw"]
    topic = look.log.topics[chosen.topic]
    if chosen.field in topic.fields:
        return
    field = f"{chosen.field.rpartition('.')[0]}.tilt"
    use = look.clock(chosen.topic).use
    tilt = float(np.median(pose_angle(topic, field, use, look.frames.get("cam"), look.log.name)[1]))
    if tilt > _TILTED:
        text = f"its quaternion tilts the robot by {np.degrees(tilt):.0f} deg in the median: are its parts in another order"
        look.note("cam_yaw", GUESS, f"topic '{chosen.topic}': {text} (x, y, z, w against w, x, y, z), or is its z not up?")


def _in_degrees(look: LogSignals, yaw: Array) -> bool:
    """Whether a heading of its own is in degrees: its name says so, or it goes beyond a turn and jumps at most by one."""
    chosen = look.chosen["cam_yaw"]
    if chosen.unit is not None or chosen.field.endswith(".yaw"):
        return chosen.unit == "deg"
    return float(np.quantile(np.abs(yaw), 0.95)) > 2.2 * np.pi and float(np.abs(np.diff(yaw)).max()) > 0.2


def _length_unit(look: LogSignals, t: Array, x: Array, y: Array) -> str:
    """Return the unit in which the robot is as fast as its wheels allow, at most."""
    wheel = look.robot.servo.wheel
    fastest = wheel.no_load_speed * look.robot.wheel.radius
    vx, vy = smoothed(t, x)[2], smoothed(t, y)[2]
    speed = float(np.quantile(np.hypot(vx, vy), 0.95))
    units = FACTORS["m"]
    return "m" if speed < 4.0 * fastest else "cm" if 0.3 * fastest < speed * units["cm"] < 2.0 * fastest else "mm"


def _upright(look: LogSignals) -> None:
    """Find out which axis of a pose points up: the one that hardly changes while the robot drives."""
    if not look.has("cam_z") or "cam" in look.given.frames:
        return
    spread = [float(np.ptp(look.raw(f"cam_{axis}")[1])) for axis in XYZ]
    still = int(np.argmin(spread))
    if still == 2 or spread[still] > 0.3 * spread[2]:
        return
    look.frames["cam"] = ("x", "-z", "y") if still == 1 else ("y", "z", "x")
    names = {axis: look.chosen[f"cam_{axis}"] for axis in XYZ}
    for axis, of_log in zip(XYZ, look.frames["cam"], strict=True):
        look.chosen[f"cam_{axis}"] = names[of_log[-1]]
    look.note("frames.cam", LIKELY, f"its {XYZ[still]} axis hardly moves: it points up")


# ---- wheels ----------------------------------------------------------------------------------------------------------


def wheel_motion(look: LogSignals, found: JointFindings) -> BodyMotion | None:
    """Return how the body would have moved without slip, by its wheels; None where not all of them are known."""
    if not look.has(*(f"pos_{wheel}" for wheel in WHEELS)):
        return None
    nominal = Parameters.nominal(look.robot)
    radius, track = float(nominal["wheel.radius"][0, 0]), 2.0 * float(nominal["hip.position"][0, 1])
    tracks = [angle(look, found, wheel) for wheel in WHEELS]
    t = tracks[0][0]
    way = {wheel: radius * np.interp(t, *pair) for wheel, pair in zip(WHEELS, tracks, strict=True)}
    left = 0.5 * (way["wheel_lf"] + way["wheel_lr"])
    right = 0.5 * (way["wheel_rf"] + way["wheel_rr"])
    return BodyMotion(t, 0.5 * (left + right), (right - left) / track, _straight(look, found, t, right - left))


def _straight(look: LogSignals, found: JointFindings, t: Array, difference: Array) -> Array:
    """Return 1 where neither the wheels turn the robot nor its legs move, nor have just done so, else 0."""
    moving = np.abs(np.gradient(difference, t)) > _TURN_SPEED
    for leg in (one for one in LEGS if look.has(f"pos_{one}")):
        at, values = angle(look, found, leg)
        grid, _, rate = smoothed(at, values)
        moving |= np.interp(t, grid, np.abs(rate)) > _SWING
    step = float(np.median(np.diff(t)))
    around = np.ones(2 * max(round(_AROUND / step), 1) + 1)
    return (np.convolve(moving, around, mode="same") < 0.5).astype(np.float64)


# ---- IMU -------------------------------------------------------------------------------------------------------------


def find_imu(look: LogSignals, body: BodyMotion | None, wheels: BodyMotion | None) -> ImuFindings:
    """Return units of gyroscope and accelerometer, and what they read about the vertical and along the robot.

    Axes and, roughly, the clock go into ``look``.
    """
    units: dict[str, str] = {}
    up = _upward(look, units)
    yaw = _yaw_axis(look, body, wheels, units, up)
    if "imu" not in look.given.frames:
        _axes(look, up, yaw, body, wheels)
    x, _, z = look.frames.get("imu", XYZ)
    heading = _along(look, "gyro", z) if yaw is not None else None
    pushed = _along(look, "acc", x) if up is not None else None
    return ImuFindings(units, heading, pushed)


def _along(look: LogSignals, kind: str, axis: str) -> Array:
    _, values = look.raw(f"{kind}_{axis[-1]}")
    return -values if axis.startswith("-") else values


def upward_axis(look: LogSignals) -> str | None:
    """Return the accelerometer's axis that reads +g in the median, such as ``-z``; None where none clearly does."""
    if not look.has("acc_x", "acc_y", "acc_z"):
        return None
    mean, _, g = _gravity(look)
    return _pointing_up(mean, g)


def _pointing_up(mean: Array, g: float) -> str | None:
    """Return the axis along which readings (3,) that are so many g long show gravity; None where none clearly does."""
    axis = int(np.argmax(np.abs(mean)))
    if abs(g - 1.0) > _GRAVITY_SHARE or abs(mean[axis]) < _ALONG * np.linalg.norm(mean):
        return None
    return f"{'-' if mean[axis] < 0 else ''}{XYZ[axis]}"


def _gravity(look: LogSignals) -> tuple[Array, str, float]:
    """Return what the accelerometer reads in the median (3,), its unit, by its name or by g, and how many g that is."""
    mean = np.array([float(np.median(look.raw(f"acc_{axis}")[1])) for axis in XYZ])
    length, named = float(np.linalg.norm(mean)), look.chosen["acc_x"].unit
    units = {unit: factor for unit, factor in FACTORS["m/s2"].items() if named not in FACTORS["m/s2"] or unit == named}
    unit, g = unit_of(max(length, 1e-9) / 9.81, units)
    if named is None and abs(g - 1.0) > _GRAVITY_SHARE:
        return mean, "m/s2", length / 9.81
    return mean, unit, g


def _upward(look: LogSignals, units: dict[str, str]) -> str | None:
    """Return the accelerometer's axis that reads +g at rest; its unit by g."""
    if not look.has("acc_x", "acc_y", "acc_z"):
        return None
    mean, units["acc"], g = _gravity(look)
    up = _pointing_up(mean, g)
    where = f"along its {up}" if up else "along none of its axes as gravity would be: which one points up is not decided"
    text = f"topic '{look.chosen['acc_x'].topic}', in {units['acc']}: reads {g:.3f} g in the median, {where}"
    look.note("acc", SURE if up else GUESS, text)
    return up


def _yaw_axis(
    look: LogSignals, body: BodyMotion | None, wheels: BodyMotion | None, units: dict[str, str], up: str | None
) -> str | None:
    """Return the gyroscope's axis that turns as the robot does, its unit by how fast; sets the topic's clock.

    Where turns do not show another axis or sign clearly, they are those that point up by gravity.
    """
    if not look.has("gyro_x", "gyro_y", "gyro_z"):
        return None
    units["gyro"] = look.chosen["gyro_x"].unit if look.chosen["gyro_x"].unit in FACTORS["rad/s"] else "rad/s"
    topic = look.chosen["gyro_x"].topic
    reference = wheels or body
    if reference is None:
        look.note("gyro", GUESS, f"topic '{topic}', in {units['gyro']}: no wheels and no pose to compare with")
        return None
    by = "the wheels" if wheels else "the pose"
    lags = {axis: lag_of_gyro(look, axis, reference) for axis in XYZ}
    known = {axis: lag for axis, lag in lags.items() if lag is not None}
    if not known:
        look.note(
            "gyro", GUESS, f"topic '{topic}', in {units['gyro']}: too short, or none of its axes turns about as much as {by}"
        )
        return None
    axis = max(known, key=lambda one: abs(known[one].correlation) + _MARGIN * (up is not None and one == up[-1]))
    lag = known[axis]
    is_clear = lag.believable and abs(lag.correlation) - lag.opposite > _MARGIN
    if topic not in look.given.clocks and is_clear and abs(lag.seconds) > _ROUGH:
        clock = look.clock(topic)
        look.clocks[topic] = clock.model_copy(update={"offset": clock.offset + lag.seconds})
    if abs(lag.correlation) < 0.6:
        text = f"its turning does not go with {by} (correlation {abs(lag.correlation):.2f}): neither unit nor axis shows"
        look.note("gyro", GUESS, f"topic '{topic}', in {units['gyro']}: {text}")
        return None
    if look.chosen["gyro_x"].unit is None:
        units["gyro"] = _gyro_unit(look, axis, body or reference)
    sure = GUESS if not look.sided else SURE if abs(lag.correlation) > 0.9 else LIKELY
    is_clear = is_clear and look.sided
    name = f"{'-' if lag.correlation < 0 else ''}{axis}"
    if not is_clear:
        name = up if up is not None and up[-1] == axis else axis
    text = f"topic '{topic}', in {units['gyro']}; its {name} turns with {by} (correlation {abs(lag.correlation):.2f})"
    text += "" if look.sided else ", whose signs are not known"
    text += "" if is_clear else "; which way round is not decided by it"
    look.note("gyro", sure if is_clear else GUESS, text)
    return name


def lag_of_gyro(look: LogSignals, axis: str, reference: BodyMotion) -> Lag | None:
    """Return how an axis of the gyroscope lags behind a heading; None where it does not turn about as much, in any unit."""
    t, rate = look.raw(f"gyro_{axis}")
    if len(t) < 2 or not _turns_as_much(t, rate, reference):
        return None
    return find_lag(t, integral(t, rate), reference.t, reference.heading)


def _turns_as_much(t: Array, rate: Array, reference: BodyMotion) -> bool:
    """Whether a raw rate turns about as much as a heading: noise goes with anything, by chance."""
    grid = common_grid(t, reference.t)
    if len(grid) < 2:
        return False
    sizes = [float(np.std(over_windows(*one, grid))) for one in ((t, integral(t, rate)), (reference.t, reference.heading))]
    return sizes[1] > 0.0 and any(_AS_MUCH[0] < one * sizes[0] / sizes[1] < _AS_MUCH[1] for one in _GYRO_UNITS.values())


def _gyro_unit(look: LogSignals, axis: str, reference: BodyMotion) -> str:
    t, rate = look.raw(f"gyro_{axis}")
    grid = common_grid(t, reference.t)
    same = likeness(over_windows(t, integral(t, rate), grid), over_windows(reference.t, reference.heading, grid))
    return unit_of(same.ratio, _GYRO_UNITS)[0] if same is not None else "rad/s"


def _axes(look: LogSignals, up: str | None, yaw: str | None, body: BodyMotion | None, wheels: BodyMotion | None) -> None:
    """Set the IMU's axes: up by gravity and by how it turns, forward by how it is pushed."""
    z = yaw or up
    if z is None:
        if look.has("gyro_x") or look.has("acc_x"):
            look.note("frames.imu", GUESS, "as the body's: neither gravity nor turns decide it; check the mounting")
        return
    if up is not None and yaw is not None and up.strip("-") != yaw.strip("-"):
        look.note("frames.imu", GUESS, f"gravity is along {up}, yet the robot turns about {yaw}: check the mounting")
        return
    if up is not None and yaw is not None and up != yaw:
        text = f"the accelerometer reads gravity itself (along {up}) and not the floor's push: its sign is turned"
        look.note("acc.sign", LIKELY, text)
        look.acc_sign = -1
    forward, is_clear = _forward_axis(look, z, body, wheels)
    axes = _complete(forward, z)
    by = "forward by how it is pushed" if is_clear else "how it is pushed does not decide which axis points forward"
    if axes == XYZ:
        look.note("frames.imu", SURE if is_clear else LIKELY, f"as the body's, x forward, z up; {by}")
        return
    look.frames["imu"] = axes
    if yaw is None and z.startswith("-"):
        by += "; the turns do not decide whether it is mounted upside down or its accelerometer reads gravity itself"
    sure = LIKELY if is_clear and yaw is not None else GUESS
    look.note("frames.imu", sure, f"our x, y, z are its {', '.join(axes)}; {by}")


def _forward_axis(look: LogSignals, z: str, body: BodyMotion | None, wheels: BodyMotion | None) -> tuple[str, bool]:
    """Return the axis along which the robot is pushed when it speeds up, and whether that is clear; if not, the usual axis."""
    others = [axis for axis in XYZ if axis != z.strip("-")]
    usual = "x" if "x" in others else others[0]
    motion = wheels or body
    if motion is None or not look.has("acc_x", "acc_y", "acc_z"):
        return usual, False
    grid, _, speed = smoothed(motion.t, motion.forward)
    if len(grid) < 2:
        return usual, False
    pushed = np.gradient(speed, grid)
    found = dict.fromkeys(others, 0.0)
    for axis in others:
        t, values = look.raw(f"acc_{axis}")
        at, mean, _ = smoothed(t, values * look.acc_sign)
        same = likeness(np.interp(grid, at, mean - mean.mean()), pushed - pushed.mean())
        found[axis] = 0.0 if same is None else same.correlation
    best = max(found, key=lambda axis: abs(found[axis]))
    name = f"{'-' if found[best] < 0 else ''}{best}"
    chance = _SIGMAS / np.sqrt((grid[-1] - grid[0]) / _SMOOTH)
    is_clear = abs(found[best]) > max(_CLEAR, chance) and (name == usual or abs(found[best]) - found[usual] > _MARGIN)
    is_clear = is_clear and (look.sided or name != f"-{usual}")  # wheels that count backwards look alike
    return (name, True) if is_clear else (usual, False)


def _complete(x: str, z: str) -> tuple[str, str, str]:
    """Return the axes with y = z cross x."""
    vectors = []
    for axis in (z, x):
        vector = np.zeros(3)
        vector[XYZ.index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
        vectors.append(vector)
    y = np.cross(*vectors)
    place = int(np.argmax(np.abs(y)))
    return (x, f"{'-' if y[place] < 0 else ''}{XYZ[place]}", z)
