"""What a robot can do by closed-form mechanics, and which of its numbers are odd. No simulator runs here."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Annotated, Literal, NamedTuple, get_args, get_type_hints

import numpy as np

from wlr_gym.robot import Robot, physical_faults
from wlr_gym.robot.description import Motor
from wlr_gym.robot.parameter_table import TABLE, range_in_words

__all__ = [
    "ENTRIES",
    "Capability",
    "RobotFinding",
    "Stance",
    "capability_of",
    "examine_robot",
    "stance_of",
    "stances",
    "unusual",
]


# ---- findings --------------------------------------------------------------------------------------------------------


Level = Literal["fault", "warning"]


@dataclass(frozen=True)
class RobotFinding:
    """A finding.

    Attributes:
        level: ``fault``: the robot cannot be simulated, stand, drive or turn; ``warning``: it can, but a number is odd.
        key: of the robot file, with dots.
        value: the number, in SI units; None: it stands in the text.
        unit: of it.
        text: what is odd about it, and what was expected.
    """

    level: Level
    key: str
    value: float | None
    unit: str
    text: str

    def __str__(self) -> str:
        unit = "" if self.unit in ("", "-") else f" {self.unit}"
        return self.text if self.value is None else f"{self.key} = {self.value:.6g}{unit}: {self.text}"


#: A finding that stands against using the robot, and one that is odd.
fault = partial(RobotFinding, "fault")
warning = partial(RobotFinding, "warning")


# ---- the robot at rest on a level floor with its legs at given angles ------------------------------------------------

# Front legs share one angle, rear legs another; the body pitches until all wheels touch the floor. Contacts are rigid.


@dataclass(frozen=True)
class Stance:
    """One pose.

    Attributes:
        front, rear: angles of the front and rear legs, rad.
        pitch: of the body, right-handed about +y (positive: nose down), rad.
        height: of the centre of mass of the whole robot above the floor, m.
        clearance: of the lowest corner of the body above the floor, m; below 0 the body lies on it.
        ahead, behind: distance along the floor from the centre of mass to the front and rear wheels' contacts, m; negative: the
            centre of mass is beyond them.
        left, right: the same across, m.
    """

    front: float
    rear: float
    pitch: float
    height: float
    clearance: float
    ahead: float
    behind: float
    left: float
    right: float

    @property
    def front_share(self) -> float:
        """Part of the weight that the front wheels carry; the rear wheels carry the rest."""
        return self.behind / (self.ahead + self.behind)

    @property
    def largest_wheel_share(self) -> float:
        """Part of the weight on the wheel that carries most."""
        across = max(self.left, self.right) / (self.left + self.right)
        return max(self.front_share, 1.0 - self.front_share) * across

    @property
    def smallest_wheel_share(self) -> float:
        """Part of the weight on the wheel that carries least; negative: the robot tips over."""
        across = min(self.left, self.right) / (self.left + self.right)
        along = min(self.front_share, 1.0 - self.front_share)
        return along * across if min(along, across) >= 0.0 else min(along, across)


def stance_of(robot: Robot, front: float, rear: float | None = None) -> Stance:
    """Return the pose with the legs at angles ``front`` and ``rear`` (rad); None: as the front ones."""
    rear = front if rear is None else rear
    hip, leg, wheel = robot.hip_position, robot.leg, robot.wheel
    leg_mass, wheel_mass = leg.mass or 0.0, wheel.mass or 0.0
    axles, legs = [], []
    for side, angle in ((1.0, front), (-1.0, rear)):
        direction = np.array([math.cos(angle), -math.sin(angle)])
        axles.append(np.array([side * hip.x, hip.z]) + leg.length * direction)
        legs.append(np.array([side * hip.x, hip.z]) + leg.com_along_leg * direction)
    x, y, z = robot.body.com_offset
    moment = robot.body.mass * np.array([x, z])
    for leg_com, axle in zip(legs, axles, strict=True):
        moment = moment + 2.0 * (leg_mass * leg_com + wheel_mass * axle)
    com = moment / robot.total_mass
    base = axles[0] - axles[1]
    span = float(np.hypot(*base))
    along = base / span if span else np.array([1.0, 0.0])
    up = np.array([-along[1], along[0]])
    behind = float((com - axles[1]) @ along)
    across = robot.body.mass * y / robot.total_mass
    corners = itertools.product(*((-size / 2, size / 2) for size in (robot.body.size[0], robot.body.size[2])))
    return Stance(
        front=front,
        rear=rear,
        pitch=math.atan2(along[1], along[0]),
        height=float((com - axles[1]) @ up) + wheel.radius,
        clearance=min(float((np.array(corner) - axles[1]) @ up) for corner in corners) + wheel.radius,
        ahead=span - behind,
        behind=behind,
        left=hip.y - across,
        right=hip.y + across,
    )


def stances(robot: Robot) -> list[Stance]:
    """Return the nine poses with front and rear legs at their lower limit, at home and at their upper limit."""
    angles = (robot.leg_limits[0], robot.home.leg_angle, robot.leg_limits[1])
    return [stance_of(robot, front, rear) for front, rear in itertools.product(angles, angles)]


def hip_torque(robot: Robot, angle: float, load: float) -> float:
    """Return the torque (N m) about a hip that holds its leg at an angle (rad) under a load (N) on its wheel.

    Leg and wheel hang on the hip; the floor's friction is 0.
    """
    leg, wheel = robot.leg, robot.wheel
    own = robot.gravity * ((leg.mass or 0.0) * leg.com_along_leg + (wheel.mass or 0.0) * leg.length)
    return abs(math.cos(angle)) * abs(load * leg.length - own)


# ---- how fast, how steep, how hard a robot drives, turns and stands --------------------------------------------------


@dataclass(frozen=True)
class Capability:
    """Numbers of a robot on its own floor, in its home pose unless something else is said; see :data:`ENTRIES`."""

    total_mass: Annotated[float, "kg", "body, legs and wheels"]
    com_height: Annotated[float, "m", "centre of mass above the floor"]
    wheelbase: Annotated[float, "m", "front to rear wheels"]
    track_width: Annotated[float, "m", "left to right wheels"]
    top_speed: Annotated[float, "m/s", "level floor, full supply, against gear friction"]
    acceleration_of_motors: Annotated[float, "m/s2", "from standstill, by the motors' stall torque"]
    acceleration_of_grip: Annotated[float, "m/s2", "by the floor's friction"]
    tipping_acceleration: Annotated[float, "m/s2", "at which the front wheels lift"]
    tipping_deceleration: Annotated[float, "m/s2", "at which the rear wheels lift"]
    climb_of_motors: Annotated[float, "rad", "steepest slope by the motors' stall torque"]
    climb_of_grip: Annotated[float, "rad", "steepest slope by the floor's friction"]
    tipping_uphill: Annotated[float, "rad", "slope, nose up, on which it tips over"]
    tipping_downhill: Annotated[float, "rad", "slope, nose down, on which it tips over"]
    tipping_sideways: Annotated[float, "rad", "slope across, on which it tips over"]
    turning_torque: Annotated[float, "N m", "of the most loaded wheel, to turn on the spot"]
    turning_rate: Annotated[float, "rad/s", "fastest turn on the spot; 0: the motors are too weak"]
    wheel_torque: Annotated[float, "N m", "stall torque of a wheel less gear friction"]
    holding_torque: Annotated[float, "N m", "of a leg at home, to carry the body"]
    holding_torque_at_limits: Annotated[float, "N m", "of a leg, the largest of nine poses at limits and home"]
    leg_torque: Annotated[float, "N m", "stall torque of a leg"]
    leg_sag: Annotated[float, "rad", "angle by which the position loop gives way under the largest holding torque"]
    smallest_wheel_share: Annotated[float, "-", "of the weight, on the least loaded wheel in nine poses at limits and home"]
    contact_sag: Annotated[float, "m", "of the wheels' contact springs under the weight"]


#: Name of a number of :class:`Capability` -> unit and meaning.
ENTRIES: dict[str, tuple[str, str]] = {
    name: get_args(hint)[1:] for name, hint in get_type_hints(Capability, include_extras=True).items()
}


def speed_at(motor: Motor, torque: float) -> float:
    """Return the speed (rad/s) at which a motor at full supply still gives ``torque`` (N m) beyond its friction; or 0."""
    left = motor.stall_torque - motor.coulomb_friction - torque
    return max(left, 0.0) / (motor.stall_torque / motor.no_load_speed + motor.viscous_friction)


def turning(robot: Robot, load: float) -> tuple[float, float]:
    """Return the torque (N m) of a wheel under ``load`` (N), and its path over the robot's angle (m/rad), turning on the spot.

    All wheels slip across, by x times the yaw rate; they must slip along, too, until the moments of friction balance. With the
    friction ellipse, force along N mu_x a/sqrt(1 + a^2) and across N mu_y/sqrt(1 + a^2), a = x mu_y/(y mu_x).
    """
    x, y = robot.hip_position.x, robot.hip_position.y
    mu_x, mu_y = robot.ground.mu_x, robot.ground.mu_y
    if min(mu_x, mu_y) <= 0.0:
        return 0.0, math.inf
    a = x * mu_y / (y * mu_x)
    force = load * mu_x * a / math.hypot(1.0, a)
    return force * robot.wheel.radius, y + x * a * mu_y / mu_x


def capability_of(robot: Robot) -> Capability:
    """Return what a robot can do. All its numbers must be there (:func:`wlr_gym.robot.physical_faults`)."""
    home, poses = stance_of(robot, robot.home.leg_angle), stances(robot)
    gravity, mass, radius = robot.gravity, robot.total_mass, robot.wheel.radius
    weight, motor = mass * gravity, robot.servo.wheel
    wheel_torque = motor.stall_torque - motor.coulomb_friction
    push = 4.0 * max(wheel_torque, 0.0) / radius
    moved = mass + 4.0 * (robot.wheel.spin_inertia + motor.armature) / radius**2
    torque, path = turning(robot, weight * home.largest_wheel_share)
    held = hip_torque(robot, home.front, weight * home.largest_wheel_share)
    held_at_limits = max(
        hip_torque(robot, angle, weight * share / 2.0)
        for pose in poses
        for angle, share in ((pose.front, pose.front_share), (pose.rear, 1.0 - pose.front_share))
    )
    stiffness = robot.servo.leg.kp * robot.servo.leg.stall_torque / robot.servo.supply_voltage
    return Capability(
        total_mass=mass,
        com_height=home.height,
        wheelbase=home.ahead + home.behind,
        track_width=home.left + home.right,
        top_speed=radius * speed_at(motor, 0.0),
        acceleration_of_motors=push / moved,
        acceleration_of_grip=robot.ground.mu_x * gravity,
        tipping_acceleration=gravity * home.behind / home.height,
        tipping_deceleration=gravity * home.ahead / home.height,
        climb_of_motors=math.asin(min(push / weight, 1.0)) if weight else math.pi / 2,
        climb_of_grip=math.atan(robot.ground.mu_x),
        tipping_uphill=math.atan2(home.behind, home.height),
        tipping_downhill=math.atan2(home.ahead, home.height),
        tipping_sideways=math.atan2(min(home.left, home.right), home.height),
        turning_torque=torque,
        turning_rate=radius * speed_at(motor, torque) / path,
        wheel_torque=wheel_torque,
        holding_torque=held,
        holding_torque_at_limits=held_at_limits,
        leg_torque=robot.servo.leg.stall_torque,
        leg_sag=held_at_limits / stiffness if stiffness else math.inf,
        smallest_wheel_share=min(pose.smallest_wheel_share for pose in poses),
        contact_sag=weight / (4.0 * robot.ground.normal_stiffness),
    )


# ---- numbers that are odd by themselves, or beside a neighbour: units, sizes, inertias; no mechanics -----------------


class Mistake(NamedTuple):
    """A unit that is written by mistake: how many SI units one of it is, and its name."""

    size: float
    unit: str


_LENGTH = (Mistake(1e-3, "mm"), Mistake(1e-2, "cm"))
_MASS = (Mistake(1e-3, "g"),)
_TORQUE = (Mistake(1e-3, "mN m"), Mistake(0.0980665, "kgf cm"))
_RATE = (Mistake(2.0 * math.pi / 60.0, "rpm"), Mistake(math.radians(1.0), "deg/s"))
_ANGLE = (Mistake(math.radians(1.0), "deg"),)
_VOLTAGE = (Mistake(1e-3, "mV"),)


class Usual(NamedTuple):
    """What a number of a robot of this kind usually is: bounds, unit, and units that it is mistaken for."""

    low: float
    high: float
    unit: str
    mistakes: tuple[Mistake, ...] = ()


#: Robots of half a kilogram to some hundred kilograms.
USUAL: dict[str, Usual] = {
    "gravity": Usual(1.0, 25.0, "m/s2", (Mistake(1e-3, "mm/s2"),)),
    "body.mass": Usual(0.2, 300.0, "kg", _MASS),
    "body.size": Usual(0.02, 2.5, "m", _LENGTH),
    "body.com_offset": Usual(-0.5, 0.5, "m", _LENGTH),
    "hip_position.x": Usual(0.03, 1.0, "m", _LENGTH),
    "hip_position.y": Usual(0.03, 1.0, "m", _LENGTH),
    "hip_position.z": Usual(-0.5, 0.5, "m", _LENGTH),
    "leg.length": Usual(0.02, 1.0, "m", _LENGTH),
    "leg.mass": Usual(0.005, 30.0, "kg", _MASS),
    "leg.com_along_leg": Usual(0.0, 1.0, "m", _LENGTH),
    "wheel.radius": Usual(0.01, 0.5, "m", _LENGTH),
    "wheel.width": Usual(0.003, 0.3, "m", _LENGTH),
    "wheel.mass": Usual(0.005, 30.0, "kg", _MASS),
    "leg_limits": Usual(-math.tau, math.tau, "rad", _ANGLE),
    "home.leg_angle": Usual(-math.tau, math.tau, "rad", _ANGLE),
    "servo.supply_voltage": Usual(3.0, 60.0, "V", _VOLTAGE),
    "servo.leg.stall_torque": Usual(0.2, 500.0, "N m", _TORQUE),
    "servo.wheel.stall_torque": Usual(0.05, 300.0, "N m", _TORQUE),
    "servo.leg.no_load_speed": Usual(0.5, 30.0, "rad/s", _RATE),
    "servo.wheel.no_load_speed": Usual(0.5, 150.0, "rad/s", _RATE),
    "ground.mu_x": Usual(0.02, 1.5, "-", (Mistake(1e-2, "%"),)),
    "ground.mu_y": Usual(0.02, 1.5, "-", (Mistake(1e-2, "%"),)),
    "ground.slip_compliance": Usual(0.0, 0.5, "-", (Mistake(1e-2, "%"),)),
    "ground.relaxation_length": Usual(1e-3, 0.05, "m", _LENGTH),
    "ground.slope": Usual(-0.6, 0.6, "rad", _ANGLE),
    "sensors.control_rate": Usual(10.0, 1000.0, "Hz", (Mistake(1e3, "kHz"),)),
    "sensors.encoder.position": Usual(1e-6, 0.1, "rad", _ANGLE),
    "sensors.encoder.velocity": Usual(0.0, 0.5, "rad/s", _RATE),
    "sensors.imu.gyro_noise": Usual(0.0, 0.1, "rad/s", (Mistake(math.radians(1.0), "deg/s"),)),
    "sensors.imu.accel_noise": Usual(0.0, 2.0, "m/s2", (Mistake(9.81e-3, "mg"),)),
    "sensors.camera.position_noise": Usual(0.0, 0.1, "m", _LENGTH),
}


def odd_numbers(robot: Robot) -> Iterator[RobotFinding]:
    """Yield what no simulator takes, then what is outside the usual, then what does not fit its neighbours."""
    yield from _outside_the_table(robot)
    for key in USUAL:
        yield from unusual(key, _stated(robot, key))
    yield from _masses(robot)
    yield from _inertias(robot)
    yield from _places(robot)


def _outside_the_table(robot: Robot) -> Iterator[RobotFinding]:
    for spec in TABLE:
        for source in dict.fromkeys(source for source in spec.sources if isinstance(source, str)):
            for value in _stated(robot, source):
                if not spec.low <= value <= spec.high:
                    hint = _mistaken(source, value)
                    text = f"is outside {range_in_words(spec.low, spec.high, spec.unit)}, what simulators take{hint}"
                    yield fault(source, value, spec.unit, text)


def _stated(robot: Robot, key: str) -> list[float]:
    """Return the numbers at a key of the robot file."""
    stated = attrgetter(key)(robot)
    return [value for value in (stated if isinstance(stated, tuple) else (stated,)) if value is not None]


def unusual(key: str, values: Sequence[float]) -> Iterator[RobotFinding]:
    """Yield which of the numbers at a key of the robot file are outside the usual."""
    usual = USUAL[key]
    unit = "" if usual.unit == "-" else f" {usual.unit}"
    for value in values:
        if not usual.low <= value <= usual.high:
            text = f"is unusual, expected {usual.low:.3g} to {usual.high:.3g}{unit}{_mistaken(key, value)}"
            yield warning(key, value, usual.unit, text)


def _mistaken(key: str, value: float) -> str:
    """Return the unit in which a number would be a usual one, in words; empty: none."""
    usual = USUAL.get(key)
    for size, unit in usual.mistakes if usual else ():
        if usual and usual.low <= value * size <= usual.high:
            return f"; in {unit}? {value:.6g} {unit} = {value * size:.4g} {usual.unit}"
        if usual and usual.low <= value / size <= usual.high and size in (1e-3, 1e-2):
            return f"; too small by {1 / size:.0f}? {value / size:.4g} {usual.unit} would be usual"
    return ""


def _masses(robot: Robot) -> Iterator[RobotFinding]:
    total = robot.total_mass
    for key, mass in (("leg.mass", robot.leg.mass), ("wheel.mass", robot.wheel.mass)):
        if mass is not None and mass < 1e-4 * total:
            text = f"next to no mass beside the {total:.4g} kg of the robot: expected {1e-4 * total:.2g} kg or more"
            yield warning(key, mass, "kg", text)
    if robot.body.mass < 0.1 * total:
        yield warning("body.mass", robot.body.mass, "kg", f"is less than a tenth of the {total:.4g} kg of the robot")


def _inertias(robot: Robot) -> Iterator[RobotFinding]:
    """Compare with bodies of that size; :func:`wlr_gym.robot.physical_faults` has the platform's lower bound."""
    leg, wheel, body = robot.leg, robot.wheel, robot.body
    x, y, z = body.size
    for axis, value, radius in zip("xyz", body.inertia, (math.hypot(y, z), math.hypot(x, z), math.hypot(x, y)), strict=True):
        yield from _moment(f"body.inertia {axis}", value, body.mass, 0.0, radius, f"a body of {x:g} x {y:g} x {z:g} m")
    rod = leg.length / math.sqrt(12.0)
    for axis, value in zip("xy", leg.inertia, strict=False):
        yield from _moment(f"leg.inertia {axis}", value, leg.mass, 0.2 * rod, leg.length, f"a leg of {leg.length:g} m")
    yield from _moment(
        "leg.inertia about its own axis", leg.inertia[2], leg.mass, 0.0, leg.length, f"a leg of {leg.length:g} m"
    )
    disc = f"a wheel of radius {wheel.radius:g} m"
    yield from _moment("wheel.spin_inertia", wheel.spin_inertia, wheel.mass, 0.3 * wheel.radius, wheel.radius, disc)
    across, reach = wheel.transverse_inertia, math.hypot(wheel.radius, wheel.width)
    yield from _moment("wheel.transverse_inertia", across, wheel.mass, 0.2 * wheel.radius, reach, disc)
    if across is not None and wheel.spin_inertia > 2.0 * across * (1.0 + 1e-9):
        text = f"is more than twice wheel.transverse_inertia, {across:.4g} kg m2: no rigid body has that"
        yield fault("wheel.spin_inertia", wheel.spin_inertia, "kg m2", text)


def _moment(key: str, value: float | None, mass: float | None, low: float, high: float, what: str) -> Iterator[RobotFinding]:
    """Compare a moment of inertia with a mass at distances ``low`` and ``high`` (m) from the axis."""
    if value is None or not mass:
        return
    least, most = mass * low**2, mass * high**2
    if not least <= value <= most:
        text = f"{mass:.4g} kg in {what} have {least:.2g} to {most:.2g} kg m2{_power_of_ten(value, least, most)}"
        yield warning(key, value, "kg m2", text)


def _power_of_ten(value: float, least: float, most: float) -> str:
    """Say by which power of 1000 a number is off, if that makes it right."""
    for factor in (1e3, 1e6, 1e9):
        for right, words in ((value * factor, "small"), (value / factor, "large")):
            if least <= right <= most:
                return f"; too {words} by {factor:.0f}? {right:.3g} would fit (g or mm in it?)"
    return ""


def _places(robot: Robot) -> Iterator[RobotFinding]:
    body, hip, leg = robot.body, robot.hip_position, robot.leg
    for axis, value, size in (("x", hip.x, body.size[0]), ("y", hip.y, body.size[1])):
        if value > size:
            yield warning(f"hip_position.{axis}", value, "m", f"hips are twice as far out as the body, {size / 2:.4g} m")
    top = body.size[2] / 2
    if abs(hip.z) > top:
        where = "above the top" if hip.z > 0 else "below the bottom"
        text = f"hips are {abs(hip.z) - top:.4g} m {where} of the body, which is from {-top:.4g} to {top:.4g} m"
        yield warning("hip_position.z", hip.z, "m", text)
    for axis, value, size in zip("xyz", body.com_offset, body.size, strict=True):
        if abs(value) > size / 2:
            yield warning(
                f"body.com_offset {axis}", value, "m", f"is outside the body: expected {-size / 2:.4g} to {size / 2:.4g} m"
            )
    if leg.com_along_leg > leg.length:
        yield warning("leg.com_along_leg", leg.com_along_leg, "m", f"is beyond the wheel: the leg is {leg.length:.4g} m long")


# ---- the examination: impossible numbers first; then what the robot cannot do, by mechanics --------------------------


#: Of the weight; a wheel that carries less is said.
LEAST_SHARE = 0.02
#: rad; a slope of 10 %, which a robot is expected to climb by its motors.
GENTLE_SLOPE = 0.1
#: rad/s; a slower turn on the spot is said.
SLOWEST_TURN = 0.05
#: Part of a leg's stall torque that it may give for long.
LASTING_SHARE = 0.5
#: rad; legs that give way by more under the weight are said.
LARGEST_SAG = 0.2
#: rad; a position error that already asks for the whole supply: a gain in counts of a register.
SHARPEST_LOOP = 0.03
#: s; how long a motor alone takes to reach its speed.
SPIN_UP = (1e-4, 0.5)
#: Damping ratio of the body on its contact springs.
DAMPING_RATIO = (0.02, 3.0)


def examine_robot(robot: Robot) -> list[RobotFinding]:
    """Return all findings, faults first.

    Args:
        robot: loaded with ``check=False``: what :func:`wlr_gym.robot.load_robot` refuses is found here too.
    """
    impossible = [fault(text.partition(" ")[0], None, "", text) for text in physical_faults(robot)]
    found = [*impossible, *odd_numbers(robot)]
    for name, motor in (("leg", robot.servo.leg), ("wheel", robot.servo.wheel)):
        found += _motor(f"servo.{name}", motor, robot.servo.supply_voltage)
    if not any(" is missing" in one.text for one in impossible):
        found += _mechanics(robot, capability_of(robot))
    return sorted(found, key=lambda one: one.level)


def _mechanics(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    if stance_of(robot, robot.home.leg_angle).clearance <= 0.0:
        sine = math.sin(robot.home.leg_angle) * robot.leg.length
        text = f"wheels are {robot.leg.length:.4g} m x sin = {sine:.4g} m below the hips: the body lies on the floor"
        yield fault("home.leg_angle", robot.home.leg_angle, "rad", text)
        return
    yield from _tipping(robot, can)
    yield from _driving(robot, can)
    yield from _turning(robot, can)
    yield from _holding(robot, can)
    yield from _leg_extremes(robot)
    yield from _contact(robot, can)


def _tipping(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    """Static margin, then acceleration that motors and floor can give against the one that tips it over."""
    home = stance_of(robot, robot.home.leg_angle)
    names = {"ahead": "forward", "behind": "backward", "left": "to the left", "right": "to the right"}
    for name, words in names.items():
        margin = getattr(home, name)
        if margin <= 0.0:
            key = "body.com_offset" + (" x" if name in ("ahead", "behind") else " y")
            value = robot.body.com_offset[0 if name in ("ahead", "behind") else 1]
            yield fault(key, value, "m", f"tips over {words}: centre of mass {-margin:.4g} m beyond the wheels' contacts")
            return
    slope = min(can.tipping_uphill, can.tipping_downhill, can.tipping_sideways)
    if slope < 0.35:
        text = f"tips over on a slope of {math.degrees(slope):.3g} deg: centre of mass {can.com_height:.4g} m above the floor"
        nearest = min(home.ahead, home.behind, home.left, home.right)
        yield warning("tipping", slope, "rad", f"{text}, nearest contacts {nearest:.4g} m aside")
    most = min(can.acceleration_of_motors, can.acceleration_of_grip)
    for limit, words in ((can.tipping_acceleration, "accelerating"), (can.tipping_deceleration, "braking")):
        if limit < most:
            text = f"tips over when {words} with it: motors and floor give {most:.3g} m/s2"
            yield warning(f"tipping_{'ac' if words[0] == 'a' else 'de'}celeration", limit, "m/s2", text)


def _driving(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    key = "servo.wheel.stall_torque"
    torque = robot.servo.wheel.stall_torque
    if can.wheel_torque <= 0.0:
        return  # said of the motor
    slope = abs(robot.ground.slope)
    if slope > min(can.climb_of_motors, can.climb_of_grip):
        weaker = "motors" if can.climb_of_motors < can.climb_of_grip else "grip"
        text = f"cannot hold on its own slope: {weaker} allow {min(can.climb_of_motors, can.climb_of_grip):.3g} rad"
        yield fault("ground.slope", robot.ground.slope, "rad", text)
    if can.climb_of_motors < GENTLE_SLOPE:
        text = (
            f"motors too weak for {can.total_mass:.4g} kg: four wheels of {robot.wheel.radius:g} m climb "
            f"{can.climb_of_motors:.3g} rad ({math.degrees(can.climb_of_motors):.2g} deg) and accelerate "
            f"with {can.acceleration_of_motors:.2g} m/s2"
        )
        yield warning(key, torque, "N m", text)
    if not 0.02 <= can.top_speed <= 20.0:
        text = f"top speed {can.top_speed:.3g} m/s with wheels of {robot.wheel.radius:g} m: expected 0.02 to 20 m/s"
        yield warning("servo.wheel.no_load_speed", robot.servo.wheel.no_load_speed, "rad/s", text)


def _turning(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    if can.wheel_torque <= 0.0 or min(robot.ground.mu_x, robot.ground.mu_y) <= 0.0:
        return
    grip = f"friction {robot.ground.mu_x:g} along, {robot.ground.mu_y:g} across"
    shape = f"hips at x = {robot.hip_position.x:g} m, y = {robot.hip_position.y:g} m"
    if can.turning_torque >= can.wheel_torque:
        text = f"cannot turn on its floor: the skid moment asks {can.turning_torque:.3g} N m of a wheel ({grip}; {shape})"
        yield fault("servo.wheel.stall_torque", robot.servo.wheel.stall_torque, "N m", text)
    elif can.turning_rate < SLOWEST_TURN:
        text = f"turns on the spot at {can.turning_rate:.2g} rad/s at most ({grip}; {shape}): expected {SLOWEST_TURN:g} or more"
        yield warning("servo.wheel.no_load_speed", robot.servo.wheel.no_load_speed, "rad/s", text)


def _holding(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    key, torque = "servo.leg.stall_torque", robot.servo.leg.stall_torque
    if can.holding_torque > torque:
        text = f"cannot stand: {can.total_mass:.4g} kg ask {can.holding_torque:.3g} N m of a leg at home"
        yield fault(key, torque, "N m", text)
    elif can.holding_torque_at_limits > torque:
        text = f"cannot hold {can.total_mass:.4g} kg at the leg limits: asks {can.holding_torque_at_limits:.3g} N m of a leg"
        yield warning(key, torque, "N m", text)
    elif can.holding_torque_at_limits > LASTING_SHARE * torque:
        share = can.holding_torque_at_limits / torque
        asked = f"{can.total_mass:.4g} kg ask {can.holding_torque_at_limits:.3g} N m of a leg at its limits"
        text = f"{asked}, {share:.0%} of it: the motor gets hot"
        yield warning(key, torque, "N m", text)
    if can.leg_sag > LARGEST_SAG:
        load = f"{can.holding_torque_at_limits:.3g} N m"
        text = f"legs give way by {can.leg_sag:.3g} rad under {load}: expected {LARGEST_SAG:g} rad or less"
        yield warning("servo.leg.kp", robot.servo.leg.kp, "V/rad", text)


def _leg_extremes(robot: Robot) -> Iterator[RobotFinding]:
    length = robot.leg.length
    nearest = 2.0 * robot.hip_position.x - length * (_most(robot, 1.0) + _most(robot, -1.0))
    if nearest < 2.0 * robot.wheel.radius:
        words = "cross" if nearest < 0 else "touch"
        apart = f"front and rear axles are {nearest:.4g} m apart, wheels need {2 * robot.wheel.radius:.4g} m"
        low, high = robot.leg_limits
        text = f"legs {words}: at the limits [{low:.3g}, {high:.3g}] rad {apart}"
        yield warning("leg.length", length, "m", text)
    for pose in stances(robot):
        where = f"with front legs at {pose.front:.3g} and rear legs at {pose.rear:.3g} rad"
        if pose.front == pose.rear and pose.clearance < 0.0:
            yield warning("leg_limits", pose.front, "rad", f"body {-pose.clearance:.3g} m in the floor {where}")
        elif pose.ahead + pose.behind > 0.0 and pose.smallest_wheel_share < LEAST_SHARE:
            words = "tips over" if pose.smallest_wheel_share < 0.0 else "a wheel is unloaded"
            text = f"{words} {where}: the least loaded wheel carries {100 * pose.smallest_wheel_share:.2g} % of the weight"
            yield warning("leg_limits", pose.front, "rad", text)


def _most(robot: Robot, sign: float) -> float:
    """Largest of sign x cos over the leg limits."""
    low, high = robot.leg_limits
    middle = 0.0 if sign > 0 else math.pi
    inside = any(low <= middle + turn * math.tau <= high for turn in (-1, 0, 1))
    return 1.0 if inside else max(sign * math.cos(low), sign * math.cos(high))


def _contact(robot: Robot, can: Capability) -> Iterator[RobotFinding]:
    ground = robot.ground
    if can.contact_sag > 0.25 * robot.wheel.radius:
        text = f"the weight presses the wheels {can.contact_sag:.3g} m into the floor; their radius is {robot.wheel.radius:g} m"
        yield warning("ground.normal_stiffness", ground.normal_stiffness, "N/m", text)
    ratio = ground.normal_damping / math.sqrt(ground.normal_stiffness * can.total_mass)
    if not DAMPING_RATIO[0] <= ratio <= DAMPING_RATIO[1]:
        low, high = DAMPING_RATIO
        text = f"damping ratio {ratio:.3g} of {can.total_mass:.4g} kg on four wheels: expected {low:g} to {high:g}"
        yield warning("ground.normal_damping", ground.normal_damping, "N s/m", text)


# ---- motors ----------------------------------------------------------------------------------------------------------


def _motor(where: str, motor: Motor, supply: float) -> Iterator[RobotFinding]:
    friction, torque = motor.coulomb_friction, motor.stall_torque
    if friction >= torque:
        text = f"does not move: its gear friction is not less than its stall torque, {torque:.4g} N m"
        yield fault(f"{where}.coulomb_friction", friction, "N m", text)
    elif friction > 0.5 * torque:
        text = f"is {friction / torque:.0%} of the stall torque, {torque:.4g} N m"
        yield warning(f"{where}.coulomb_friction", friction, "N m", text)
    if motor.viscous_friction > torque / motor.no_load_speed:
        text = f"halves the speed and more: {speed_at(motor, 0.0):.3g} of {motor.no_load_speed:.3g} rad/s are left"
        yield warning(f"{where}.viscous_friction", motor.viscous_friction, "N m s/rad", text)
    spin_up = motor.armature * motor.no_load_speed / torque
    if not SPIN_UP[0] <= spin_up <= SPIN_UP[1]:
        text = f"the motor alone takes {spin_up:.2g} s to reach its speed: expected {SPIN_UP[0]:g} to {SPIN_UP[1]:g} s"
        yield warning(f"{where}.armature", motor.armature, "kg m2", text)
    if motor.kp > 0.0 and supply / motor.kp < SHARPEST_LOOP:
        text = f"an error of {supply / motor.kp:.2g} rad asks for the whole {supply:g} V: is it in counts of a register?"
        yield warning(f"{where}.kp", motor.kp, "V/rad", text)
    if motor.kd * motor.no_load_speed > 20.0 * supply:
        text = f"an error of {supply / motor.kd:.2g} rad/s asks for the whole {supply:g} V: is it in counts of a register?"
        yield warning(f"{where}.kd", motor.kd, "V s/rad", text)
    if motor.kp == 0.0 and (where.endswith("leg") or motor.kd == 0.0):
        yield fault(f"{where}.kp", motor.kp, "V/rad", "no gain: the servo follows no setpoint")
