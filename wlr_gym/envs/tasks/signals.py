"""Named signals that rewards, terminations, measures and computed observations are written with.

The same term runs on numpy arrays (one value per robot) and on trace nodes: only ``read`` differs.

Below them stands what several terms make of the signals: where the robot is, and what a task asks for beyond constant speeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlr_gym.base.errors import unknown_name
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.codegen import ops
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Layout
from wlr_gym.robot import CORNER_SIGNS, JOINTS, LEG_SLICE

Value = Any  # float, numpy array (N,) or trace node

#: Pose of the body origin where the episode began, floor frame: m, m, rad.
START = ("x", "y", "yaw")
#: Sensors that a robot may have or not: 1 or 0.
PRESENCE = ("camera", "flow")


class Signals:
    """Access to one control step's signals.

    Args:
        read: returns the value of one scalar signal, such as ``truth.position[x]``, ``command.yaw_rate``,
            ``estimate.yaw``, ``action[leg_lf]``, ``robot.leg.length``, ``time`` or ``task.control_period``.
    """

    def __init__(self, read: Callable[[str], Value]) -> None:
        self._read = read
        #: 1 where a termination term ended the episode in this step, else 0.
        self.terminated: Value = 0.0

    def sensors(self, channel: str) -> list[Value]:
        """Elements of a channel of ``SENSOR_LAYOUT``."""
        return self._channel(SENSOR_LAYOUT, "sensors", channel)

    def truth(self, channel: str) -> list[Value]:
        """Elements of a channel of ``TRUTH_LAYOUT``."""
        return self._channel(TRUTH_LAYOUT, "truth", channel)

    def estimate(self, channel: str) -> list[Value]:
        """Elements of a channel of ``ESTIMATE_LAYOUT``: what the slip observer makes of the sensors."""
        return self._channel(ESTIMATE_LAYOUT, "estimate", channel)

    @property
    def start(self) -> list[Value]:
        """Where the body origin was when the episode began: x, y (m) and yaw (rad) in the floor frame."""
        return [self._read(f"start[{name}]") for name in START]

    def is_present(self, sensor: str) -> Value:
        """Whether the robot has a sensor of :data:`PRESENCE`: 1 or 0."""
        return self._read(f"presence[{sensor}]")

    @property
    def time(self) -> Value:
        """Time since the episode began, s."""
        return self._read("time")

    def _channel(self, layout: Layout, source: str, channel: str) -> list[Value]:
        if channel not in layout.channels:
            raise unknown_name(f"channel of {source}", channel, layout.channels)
        return [self._read(f"{source}.{element}") for element in layout.channels[channel].elements]

    def command(self, name: str) -> Value:
        """Commanded value the robot should have followed in this step."""
        return self._read(f"command.{name}")

    @property
    def action(self) -> list[Value]:
        """This step's action, 8 elements in [-1, 1]."""
        return [self._read(f"action[{joint}]") for joint in JOINTS]

    @property
    def previous_action(self) -> list[Value]:
        """The action of the step before (zeros in the first)."""
        return [self._read(f"previous_action[{joint}]") for joint in JOINTS]

    def remembered(self, element: str) -> Value:
        """What a computed observation's element was in the step before; 0 at the start of an episode."""
        return self._read(f"remembered.{element}")

    def gain(self, name: str) -> Value:
        """A gain of the task's hand-written controller."""
        return self._read(f"controller.{name}")

    def task(self, name: str) -> Value:
        """A number of the task: ``action.leg_scale``."""
        return self._read(f"task.{name}")

    def robot(self, path: str) -> Value:
        """A number of the nominal robot by its dotted path: ``leg.length``."""
        return self._read(f"robot.{path}")

    @property
    def control_period(self) -> Value:
        """Length of a control step, s."""
        return self._read("task.control_period")


def signals_of(function: Callable[..., Any]) -> set[str]:
    """Return the names of the signals that a term's function reads."""
    names: set[str] = set()

    def read(name: str) -> np.float64:
        names.add(name)
        return np.float64(1.0)

    with np.errstate(all="ignore"):
        function(Signals(read))
    return names


def mean(values: list[Value]) -> Value:
    """Arithmetic mean of a list of signals."""
    return sum(values[1:], values[0]) * (1.0 / len(values))


def norm(x: Value, y: Value) -> Value:
    """Length of a plane vector."""
    return ops.sqrt(x * x + y * y)


# ---- where a robot is: the same terms run on its true state and on the slip observer's estimate ----------------------


@dataclass(frozen=True)
class PlanarPose:
    """Pose of the body origin. Frame: that of the episode's start (x ahead of the robot as it stood there).

    Attributes:
        x, y: m.
        yaw: rad.
    """

    x: Value
    y: Value
    yaw: Value


def true_pose(signals: Signals) -> PlanarPose:
    """What the simulator knows."""
    x, y, _ = signals.truth("position")
    x0, y0, yaw0 = signals.start
    cos, sin = ops.cos(yaw0), ops.sin(yaw0)
    return PlanarPose(
        x=cos * (x - x0) + sin * (y - y0),
        y=cos * (y - y0) - sin * (x - x0),
        yaw=wrapped(yaw_of(*signals.truth("quaternion")) - yaw0),
    )


def estimated_pose(signals: Signals) -> PlanarPose:
    """What the slip observer makes of the sensors."""
    x, y = signals.estimate("position")
    (yaw,) = signals.estimate("yaw")
    return PlanarPose(x, y, yaw)


def yaw_of(w: Value, x: Value, y: Value, z: Value) -> Value:
    """Heading of the body's x axis in the floor frame, rad, of a quaternion from body to floor frame."""
    return ops.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def wrapped(angle: Value) -> Value:
    """The same angle in (-pi, pi]."""
    return ops.arctan2(ops.sin(angle), ops.cos(angle))


# ---- paths, leg angles that change with time, climbing and holding ---------------------------------------------------

# Everything is a closed function of the held commands, the time and the pose, so nothing is stored from step to step.


#: m along the path from the robot to where its curvature is previewed.
PREVIEW = (0.0, 0.1, 0.2)
#: Newton steps to the nearest point of an S-curve.
NEWTON_STEPS = 4
#: m along an S-curve from one point to the next, where its length is added up.
LENGTH_STEP = 0.005
#: s in which the legs go from home to the first posture.
POSTURE_READY = 3.0
#: s at which the sweep to the second posture begins.
SWEEP_BEGINS = 4.0
#: m/s2 on a slope: less than what is left 1.5 degrees below the friction limit, g sin 1.5 = 0.26.
CLIMB_RAMP = 0.1


@dataclass(frozen=True)
class PathError:
    """Where the robot is against its path.

    Attributes:
        lateral: distance from the path, positive to its left, m.
        heading: body's x axis against the path's direction, positive to the left, in (-pi, pi], rad.
        curvature: of the path at the distances :data:`PREVIEW` ahead of its nearest point, positive to the left, 1/m.
    """

    lateral: Value
    heading: Value
    curvature: tuple[Value, ...]


def error_from_path(signals: Signals, pose: PlanarPose) -> PathError:
    """Return the error from the commanded path: a line, an S-curve or a circle.

    The path begins ``path_offset`` to the left of where the robot stood at the start, turned left by ``path_heading``.
    ``path_shape`` below 1 is a line, below 2 an S-curve, above a circle of ``path_curvature``; the S-curve
    y = A (1 - cos k x), k = 2 pi/``path_wavelength``, has that curvature at its start: A = curvature/k^2.
    """
    shape, bend = signals.command("path_shape"), signals.command("path_curvature")
    turn = signals.command("path_heading")
    cos, sin = ops.cos(turn), ops.sin(turn)
    away = pose.y - signals.command("path_offset")
    x, y = cos * pose.x + sin * away, cos * away - sin * pose.x
    is_circle, is_curve = shape - 2.0, shape - 1.0
    circle = _circle(x, y, ops.where_positive(is_circle, bend, 0.0))  # a line is a circle without curvature
    curve = _s_curve(x, y, bend, 2.0 * math.pi / signals.command("path_wavelength"))

    def chosen(of_circle: Value, of_curve: Value) -> Value:
        return ops.where_positive(is_circle, of_circle, ops.where_positive(is_curve, of_curve, of_circle))

    lateral, direction = (chosen(a, b) for a, b in zip(circle[:2], curve[:2], strict=True))
    curvature = tuple(chosen(a, b) for a, b in zip(circle[2], curve[2], strict=True))
    return PathError(lateral, wrapped(pose.yaw - turn - direction), curvature)


def path_point(command: Mapping[str, float], way: float) -> tuple[float, float]:
    """Return the point (x, y) of the path of :func:`error_from_path` at a distance from its beginning along it, m.

    Args:
        command: name -> value of the path's commands.
        way: distance, m.
    """
    shape, bend = command["path_shape"], command["path_curvature"]
    if 1.0 < shape <= 2.0:
        x, y = _s_curve_point(way, bend, 2.0 * math.pi / command["path_wavelength"])
    else:
        bend = bend if shape > 2.0 else 0.0
        half = 0.5 * bend * way  # of the angle: chord and its direction
        chord = way * float(np.sinc(half / math.pi))
        x, y = chord * math.cos(half), chord * math.sin(half)
    cos, sin = math.cos(command["path_heading"]), math.sin(command["path_heading"])
    return cos * x - sin * y, sin * x + cos * y + command["path_offset"]


def _s_curve_point(way: float, bend: float, k: float) -> tuple[float, float]:
    amplitude = bend / (k * k)
    ahead = np.linspace(0.0, way, 2 + int(abs(way) / LENGTH_STEP))  # the curve is no shorter than its x
    y = amplitude * (1.0 - np.cos(k * ahead))
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(ahead), np.diff(y)))])
    x = float(np.interp(way, length, ahead))
    return x, amplitude * (1.0 - math.cos(k * x))


def _circle(x: Value, y: Value, bend: Value) -> tuple[Value, Value, list[Value]]:
    """Distance, direction and curvature of a circle through the origin, tangent to x; without a division by its curvature."""
    along, across = bend * x, 1.0 - bend * y
    lateral = (2.0 * y - bend * (x * x + y * y)) / (1.0 + ops.sqrt(along * along + across * across))
    return lateral, ops.arctan2(along, across), [bend for _ in PREVIEW]


def _s_curve(x: Value, y: Value, bend: Value, k: Value) -> tuple[Value, Value, list[Value]]:
    """Distance, direction and curvature of y = A (1 - cos k x) at its point nearest to (x, y)."""
    amplitude = bend / (k * k)
    nearest = x
    for _ in range(NEWTON_STEPS):
        sin, cos = ops.sin_cos(k * nearest)
        slope, gap = amplitude * k * sin, amplitude * (1.0 - cos) - y
        change = 1.0 + slope * slope + gap * (bend * cos)
        nearest = nearest - (nearest - x + gap * slope) / ops.maximum(change, 0.5)
    sin, cos = ops.sin_cos(k * nearest)
    slope = amplitude * k * sin
    stretch = ops.sqrt(1.0 + slope * slope)
    lateral = (y - amplitude * (1.0 - cos) - slope * (x - nearest)) / stretch
    curvature = [_s_curvature(nearest + distance / stretch, bend, k, amplitude) for distance in PREVIEW]
    return lateral, ops.arctan2(slope, 1.0), curvature


def _s_curvature(x: Value, bend: Value, k: Value, amplitude: Value) -> Value:
    sin, cos = ops.sin_cos(k * x)
    slope = amplitude * k * sin
    stretch = 1.0 + slope * slope
    return bend * cos / (stretch * ops.sqrt(stretch))


def leg_references(signals: Signals) -> list[tuple[Value, Value]]:
    """Return angle (rad) and rate (rad/s) asked of each leg, in joint order.

    From home to ``front_leg_first`` and ``rear_leg_first`` within :data:`POSTURE_READY`; from :data:`SWEEP_BEGINS` on to
    ``..._second`` at ``leg_rate``, and there they stay.
    """
    front, rear = _leg_reference(signals, "front"), _leg_reference(signals, "rear")
    return [front if ahead > 0 else rear for ahead, _ in CORNER_SIGNS]


def _leg_reference(signals: Signals, axle: str) -> tuple[Value, Value]:
    home, rate, time = signals.robot("home.leg_angle"), signals.command("leg_rate"), signals.time
    first, second = signals.command(f"{axle}_leg_first"), signals.command(f"{axle}_leg_second")
    getting_ready = (first - home) * (1.0 / POSTURE_READY)
    way = second - first
    swept = ops.clip(rate * (time - SWEEP_BEGINS), 0.0, ops.absolute(way))
    angle = home + getting_ready * ops.minimum(time, POSTURE_READY) + ops.sign(way) * swept
    sweeping = ops.where_positive(swept, ops.where_positive(ops.absolute(way) - swept, ops.sign(way) * rate, 0.0), 0.0)
    return angle, ops.where_positive(POSTURE_READY - time, getting_ready, sweeping)


def leg_errors(signals: Signals) -> list[Value]:
    """Return the true leg angles minus those asked for, rad."""
    angles = signals.truth("joint_position")[LEG_SLICE]
    return [angle - asked for angle, (asked, _) in zip(angles, leg_references(signals), strict=True)]


def climb_speed(signals: Signals) -> Value:
    """Return the forward speed asked for on a slope, m/s: ``climb_speed`` until ``climb_time``, then 0; no faster than
    :data:`CLIMB_RAMP` allows."""
    speed, time = signals.command("climb_speed"), signals.time
    rising, falling = CLIMB_RAMP * time, speed - CLIMB_RAMP * (time - signals.command("climb_time"))
    return ops.clip(ops.minimum(rising, falling), 0.0, speed)
