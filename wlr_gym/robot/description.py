"""The robot's numbers, loaded from ``configs/robot/*.yaml``. SI units and radians; frames as in REP-103.

Joint order everywhere (actions, observations, logs): the four legs, then the four wheels, each lf, rf, lr, rr
(left/right, front/rear). Leg angle: right-handed about body +y of the vector hip -> wheel centre, 0 forward, pi/2
straight down. Wheel angle: right-handed about body +y, relative to its leg; positive rolls forward.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import (
    BaseModel,
    Field,
    SerializerFunctionWrapHandler,
    field_serializer,
    field_validator,
    model_serializer,
    model_validator,
)

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.settings import SettingsModel, layers_of, overlay, parse_config, read_config
from wlr_gym.robot.parameter_table import JOINTS, KEYS, TABLE, ParameterTolerance, range_in_words, read_tolerances, spec_of

Vector3 = tuple[float, float, float]


# ---- sensors: what a robot can measure, and how badly ----------------------------------------------------------------


class Encoder(SettingsModel):
    """One register count of position (rad) and velocity (rad/s)."""

    position: float = Field(ge=0)
    velocity: float = Field(ge=0)


class EffortSensor(SettingsModel):
    """1 sigma noise of the torque estimate (N m)."""

    leg_noise: float = Field(ge=0)
    wheel_noise: float = Field(ge=0)


class ImuSensor(SettingsModel):
    """Bandwidth (Hz), noise per 50 Hz sample and constant bias, 1 sigma (rad/s, m/s2)."""

    bandwidth: float = Field(gt=0)
    gyro_noise: float = Field(ge=0)
    accel_noise: float = Field(ge=0)
    gyro_bias: float = Field(ge=0)
    accel_bias: float = Field(ge=0)


class CameraSensor(SettingsModel):
    """Frame rate (Hz) and 1 sigma noise of the floor pose (m, rad)."""

    rate: float = Field(gt=0)
    position_noise: float = Field(ge=0)
    yaw_noise: float = Field(ge=0)


class FlowSensor(SettingsModel):
    """Optical-flow sensor that looks along body -z. Numbers: data sheet of the PixArt PMW3901MB unless marked [chosen].

    Attributes:
        position: of its lens in the body frame (m).
        field_of_view: full angle (rad), seen by a row of ``pixels``.
        counts_per_pixel: counts of motion per pixel of shift; not in the data sheet, found by others on the chip.
        rate: frames per second.
        noise: 1 sigma of one frame's counts at rest on good texture [chosen]; frames are independent.
        speed_noise: further 1 sigma, share of the frame's counts [chosen].
        quality, quality_noise: surface quality on good texture, share of the register's range, and its 1 sigma [chosen].
        least_quality: below it a reading is not valid: 0x19 of 255.
        least_height: shortest distance to the floor at which it works (m).
        greatest_rate: fastest turn of the floor that it measures (rad/s).
    """

    position: Vector3
    field_of_view: float = Field(0.733, gt=0, lt=3.0)
    pixels: int = Field(35, ge=1)
    counts_per_pixel: float = Field(10.0, gt=0)
    rate: float = Field(121.0, gt=0)
    noise: float = Field(0.65, ge=0)
    speed_noise: float = Field(0.03, ge=0)
    quality: float = Field(0.35, gt=0, le=1)
    quality_noise: float = Field(0.03, ge=0)
    least_quality: float = Field(0.098, ge=0, le=1)
    least_height: float = Field(0.08, ge=0)
    greatest_rate: float = Field(7.4, gt=0)

    @property
    def count(self) -> float:
        """One count of motion (rad)."""
        return self.field_of_view / self.pixels / self.counts_per_pixel


class SensorSet(SettingsModel):
    """What the robot can measure, and how badly; ``volt_count`` is one register count of the supply (V).

    ``flow`` is an optical-flow sensor, where one is fitted.
    """

    control_rate: float = Field(gt=0)
    encoder: Encoder
    effort: EffortSensor
    volt_noise: float = Field(ge=0)
    volt_count: float = Field(0.1, ge=0)
    imu: ImuSensor
    camera: CameraSensor
    flow: FlowSensor | None = None

    @property
    def flow_noise(self) -> float:
        """1 sigma of an optical-flow reading of one control period, at rest on good texture (rad/s); 0 without a sensor."""
        return 0.0 if self.flow is None else self.flow.noise * self.flow.count * (self.flow.rate * self.control_rate) ** 0.5

    @property
    def has_flow(self) -> float:
        """1 where an optical-flow sensor is fitted, else 0."""
        return 0.0 if self.flow is None else 1.0

    @model_serializer(mode="wrap")
    def _without_what_is_not_fitted(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content = write(self)
        return content if self.flow is not None else {key: value for key, value in content.items() if key != "flow"}


# ---- the robot -------------------------------------------------------------------------------------------------------


class Body(SettingsModel):
    """The platform: mass (kg), size (m), principal inertia about its centre of mass (kg m2), centre of mass (m)."""

    mass: float = Field(gt=0)
    size: Vector3
    inertia: tuple[float | None, float | None, float | None]
    com_offset: Vector3 = (0.0, 0.0, 0.0)


class HipPosition(SettingsModel):
    """Distance of the hips from the body origin along x and y (m, both signs occur), and their common z."""

    x: float = Field(gt=0)
    y: float = Field(gt=0)
    z: float = 0.0


class Leg(SettingsModel):
    """One leg: length hip to wheel centre (m), mass (kg), centre of mass from the hip (m), inertia (kg m2)
    about its own centre of mass, straight down: about x, about y, about its own axis."""

    length: float = Field(gt=0)
    mass: float | None = Field(gt=0)
    com_along_leg: float = Field(ge=0)
    inertia: tuple[float | None, float | None, float | None]


class Wheel(SettingsModel):
    """One wheel: radius, width (m), mass (kg), inertia about the axle and across it (kg m2)."""

    radius: float = Field(gt=0)
    width: float = Field(gt=0)
    mass: float | None = Field(gt=0)
    spin_inertia: float = Field(gt=0)
    transverse_inertia: float | None = Field(gt=0)


#: A: far above the stall current of any servo; a value beyond it has another unit.
LARGEST_CURRENT = 100.0


class Motor(SettingsModel):
    """One servo at its output shaft; torque, speed and currents at the nominal supply voltage (source: ROBOTIS e-manual).

    Torque and speed are the ends of the torque-speed line. Currents (A) at the same two ends say how current becomes torque;
    without them the constant is that of the back-EMF (:func:`wlr_gym.physics.servo.current_law`). What the servo reports of its
    torque: counts of ``current_count`` (A), or, where it measures no current, of ``load_count`` (share of the stall torque);
    without either as the nominal robot's servos do.
    """

    stall_torque: float = Field(gt=0)
    no_load_speed: float = Field(gt=0)
    stall_current: float | None = Field(None, gt=0)
    no_load_current: float | None = Field(None, ge=0)
    current_count: float | None = Field(None, gt=0)
    load_count: float | None = Field(None, gt=0)
    kp: float = Field(ge=0)
    kd: float = Field(ge=0)
    armature: float = Field(gt=0)
    coulomb_friction: float = Field(ge=0)
    gear_stiffness: float = Field(gt=0)
    viscous_friction: float = Field(ge=0)


class Servo(SettingsModel):
    """Supply voltage (V), the two servo types, and the time (s) between two steps of the wheels' velocity-loop integral.

    The wheels' ``kp`` holds for a cycle of 1 ms.
    """

    supply_voltage: float = Field(gt=0)
    leg: Motor
    wheel: Motor
    integral_cycle: float = Field(1e-3, gt=0)

    @model_validator(mode="after")
    def _currents_are_possible(self) -> Servo:
        for name, motor in (("leg", self.leg), ("wheel", self.wheel)):
            _check_currents(f"servo.{name}", motor, self.supply_voltage)
            if motor.current_count is not None and motor.load_count is not None:
                raise InputError(f"servo.{name}: current_count and load_count: a servo reports one of the two")
        return self


def _check_currents(where: str, motor: Motor, supply: float) -> None:
    """Refuse one current without the other, a current in mA, and a motor that would give more power than it takes.

    With torque T (1 - w/w0) and current Is (1 - w/w0) + I0 w/w0 at the full supply V, and both in proportion at others, the
    shaft never gets more than the supply gives if  T w0 <= V (sqrt(Is) + sqrt(I0))^2.
    """
    stall, idle = motor.stall_current, motor.no_load_current
    if stall is None and idle is None:
        return
    if stall is None or idle is None:
        there, missing = ("no_load_current", "stall_current") if stall is None else ("stall_current", "no_load_current")
        raise InputError(f"{where}.{there}: expected {missing} beside it: both or none")
    if stall > LARGEST_CURRENT:
        raise InputError(f"{where}.stall_current = {stall:g} A: expected {LARGEST_CURRENT:g} A at most; is it in mA?")
    if idle >= stall:
        raise InputError(f"{where}.no_load_current = {idle:g} A: expected less than stall_current, {stall:g} A")
    shaft, most = motor.stall_torque * motor.no_load_speed, supply * (math.sqrt(stall) + math.sqrt(idle)) ** 2
    if shaft > most:
        raise InputError(
            f"{where}.stall_current = {stall:g} A: the motor would give more power than it takes; with no_load_current = "
            f"{idle:g} A expected at least {max(math.sqrt(shaft / supply) - math.sqrt(idle), 0.0) ** 2:.3g} A"
        )


class Ground(SettingsModel):
    """Floor and tyres: friction along heading and axle, slope along x (rad), contact stiffness (N/m) and damping (N s/m).

    A tyre may have an elastic tread: slip per friction over load (0 = rigid), the way over which friction builds up (m), and
    damping along the floor (N s/m).
    """

    mu_x: float = Field(ge=0)
    mu_y: float = Field(ge=0)
    slope: float = 0.0
    normal_stiffness: float = Field(gt=0)
    normal_damping: float = Field(ge=0)
    slip_compliance: float = Field(0.0, ge=0, le=5)
    relaxation_length: float = Field(0.005, ge=5e-4, le=0.1)
    tread_damping: float = Field(5.0, ge=0, le=100)


class Home(SettingsModel):
    """The pose every episode starts from."""

    leg_angle: float


class Robot(SettingsModel):
    """A whole robot, as one ``configs/robot/*.yaml`` describes it.

    Legs, wheels and their servos are alike but for ``individual``: element of the parameter table -> its value, such as
    ``leg.length[leg_lf]: 0.13``. Simulators follow them; what a robot knows of itself (slip observer, controllers) goes by the
    numbers that all share.
    """

    name: str
    gravity: float = Field(ge=0)
    body: Body
    hip_position: HipPosition
    leg: Leg
    wheel: Wheel
    joints: tuple[str, ...]
    dynamixel_ids: dict[str, int]
    home: Home
    leg_limits: tuple[float, float]
    servo: Servo
    ground: Ground
    sensors: SensorSet
    individual: dict[str, float] = Field(default_factory=dict)
    tolerances: dict[str, ParameterTolerance] = Field(default_factory=dict)

    @field_validator("tolerances", mode="before")
    @classmethod
    def _tolerances_are_read(cls, stated: Any) -> dict[str, ParameterTolerance]:
        return read_tolerances(stated)

    @model_validator(mode="after")
    def _tolerances_are_relative_to_something(self) -> Robot:
        for key, tolerance in self.tolerances.items():
            values = [value for row in KEYS[key] for value in row.nominal(self)]
            if tolerance.unit is None and max(tolerance.legs, tolerance.wheels) > 0.0 and all(value == 0.0 for value in values):
                raise InputError(f"tolerances.{key} = '{tolerance}': is relative to 0: expected an amount with its unit")
        return self

    @field_serializer("tolerances")
    def _tolerances_as_written(self, tolerances: dict[str, ParameterTolerance]) -> dict[str, str]:
        return {key: str(tolerance) for key, tolerance in tolerances.items()}

    @field_validator("individual")
    @classmethod
    def _single_numbers_are_known(cls, individual: dict[str, float]) -> dict[str, float]:
        valid = [element for spec in TABLE if spec.may_differ for element in spec.elements]
        for element, value in individual.items():
            if element not in valid:
                raise unknown_name("number of a single leg, wheel or servo", element, valid, "individual")
            spec = spec_of(element)
            if not spec.low <= value <= spec.high:
                raise InputError(f"individual.{element} = {value:g}: expected {range_in_words(spec.low, spec.high, spec.unit)}")
        return individual

    @field_validator("leg_limits")
    @classmethod
    def _limits_are_ordered(cls, limits: tuple[float, float]) -> tuple[float, float]:
        if not limits[0] < limits[1]:
            raise ValueError("the lower limit must be below the upper one")
        return limits

    @field_validator("dynamixel_ids")
    @classmethod
    def _every_joint_has_its_own_id(cls, ids: dict[str, int]) -> dict[str, int]:
        if set(ids) != set(JOINTS) or len(set(ids.values())) != len(JOINTS):
            raise ValueError(f"expected one id of its own for each of {', '.join(JOINTS)}")
        if not all(0 <= number <= 252 for number in ids.values()):
            raise ValueError("Dynamixel ids are 0 to 252")
        return ids

    @property
    def total_mass(self) -> float:
        """Mass of body, legs and wheels (kg)."""
        return self.body.mass + 4 * ((self.leg.mass or 0.0) + (self.wheel.mass or 0.0))


def physical_faults(robot: Robot) -> list[str]:
    """Return why ``robot`` cannot be simulated: missing numbers and inertias no rigid body of that size can have.

    A body's inertia is bounded below by plausibility (5 % of a uniform box of the given size: all mass within a fifth
    of the half-width) and by the triangle inequality. Paper audit, Table I: I_Gy and I_Gz are 1000 times too small.
    """
    optional = {
        **{f"body.inertia {axis}": value for axis, value in zip("xyz", robot.body.inertia, strict=True)},
        "leg.mass": robot.leg.mass,
        **{f"leg.inertia {axis}": value for axis, value in zip("xyz", robot.leg.inertia, strict=True)},
        "wheel.mass": robot.wheel.mass,
        "wheel.transverse_inertia": robot.wheel.transverse_inertia,
    }
    faults = [f"{key} is missing" for key, value in optional.items() if value is None]
    x, y, z = robot.body.size
    box = [robot.body.mass / 12 * s for s in (y * y + z * z, x * x + z * z, x * x + y * y)]
    for axis, value, uniform in zip("xyz", robot.body.inertia, box, strict=True):
        if value is not None and value < 0.05 * uniform:
            more = f", {uniform / value:.0f} times more" if value > 0.0 else ""
            faults.append(
                f"body.inertia {axis} = {value:g} kg m2 is impossible for {robot.body.mass:g} kg in a body of {x:g} x {y:g} x "
                f"{z:g} m: a uniform box has {uniform:.4g}{more}"
            )
    for name, inertia in (("body.inertia", robot.body.inertia), ("leg.inertia", robot.leg.inertia)):
        values = [float(value) for value in inertia if value is not None]
        if len(values) == len(inertia) and (min(values) <= 0 or 2 * max(values) > sum(values) * (1 + 1e-9)):
            faults.append(f"{name} = {values} breaks the triangle inequality every rigid body obeys")
    if not robot.leg_limits[0] <= robot.home.leg_angle <= robot.leg_limits[1]:
        faults.append(f"home.leg_angle = {robot.home.leg_angle:g} rad is outside leg_limits {list(robot.leg_limits)}")
    if robot.joints != JOINTS:
        faults.append(f"joints must be {list(JOINTS)} in this order, not {list(robot.joints)}")
    return faults


#: Name in ``configs/robot/``, path of a YAML file, content of such a file, or a :class:`Robot`.
RobotSource = str | Path | Mapping[str, Any] | Robot


def load_robot(source: RobotSource = "nominal", *, check: bool = True) -> Robot:
    """Load a robot by config name, path or content.

    Args:
        source: see :data:`RobotSource`; a :class:`Robot` is returned as it is.
        check: refuse a robot that no rigid body can be (see :func:`physical_faults`).

    Raises:
        InputError: unreadable file, unknown or missing key, value of the wrong kind, or a physically impossible robot.
    """
    robot = source if isinstance(source, Robot) else _read(source)
    faults = physical_faults(robot) if check else []
    if faults:
        raise InputError(f"robot '{robot.name}' cannot be simulated: " + "; ".join(faults))
    return robot


def robot_content(source: RobotSource) -> dict[str, Any]:
    """Return a robot as plain JSON types, which :func:`load_robot` takes: how it travels in run folders and contracts.

    Every number is in it, those of its bases and defaults too.
    """
    return load_robot(source).model_dump(mode="json")


def _read(source: str | Path | Mapping[str, Any]) -> Robot:
    """Read a robot's file or content, laid over its bases. The name is its own: another robot has another one."""
    top = (dict(source), "robot") if isinstance(source, Mapping) else read_config("robot", source)
    layers = layers_of("robot", top)
    for content, where in layers:
        if isinstance(content, Mapping) and "buses" in content:
            raise InputError(f"{where}: a hardware file; expected a robot file; a hardware file goes with --hardware")
    data, where = layers[0]
    robot = parse_config(Robot, data, where)  # what is wrong in a base is said with its own name
    for changes, where in layers[1:]:
        data = overlay({key: value for key, value in data.items() if key != "name"}, changes)
        robot = parse_config(Robot, data, where)
    return robot


def standing_height(robot: Robot, leg_angle: float) -> float:
    """Height of the body origin above a level floor with all legs at ``leg_angle``, contacts unloaded (m)."""
    return robot.leg.length * math.sin(leg_angle) + robot.wheel.radius - robot.hip_position.z


# ---- fingerprints: equal where a simulator reads equal numbers; policy files carry them ------------------------------

# The canonical form is one line ``key = value`` per number, sorted, under a title with the version of the form. A number that
# has its declared default is left out, so that a new field with a default changes the fingerprint of no robot that does not
# use it. Not in it: name, bus addresses, order of joints (there is one only) and tolerances; nor what turns a motor's torque
# into its current and into counts, which changes energy and the rounding of a sensor, but no motion: a policy from
# ``nominal`` fits ``emanual``; nor an optical-flow sensor: a policy that does not read one fits a robot that has it.


#: Of the canonical form; a fingerprint begins with it.
HASH_FORM = "2"
#: Keys of a robot file that no motion depends on.
NOT_MOVING = ("name", "joints", "dynamixel_ids", "tolerances", "sensors.flow")
#: Keys of a motor that no motion depends on.
CURRENTS = ("stall_current", "no_load_current", "current_count", "load_count")


def robot_hash(robot: Robot) -> str:
    """Return the fingerprint of the numbers of a robot that a simulator reads."""
    return _fingerprint("robot", robot)


def servo_hash(robot: Robot) -> str:
    """Return the fingerprint of the numbers of a robot's servos."""
    return _fingerprint("servo", robot.servo)


def _fingerprint(title: str, model: BaseModel) -> str:
    text = "\n".join([f"{title} {HASH_FORM}", *sorted(_lines(model, ""))])
    return f"{HASH_FORM}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _lines(model: BaseModel, above: str) -> Iterator[str]:
    """Yield ``key = value`` of what differs from its default; the keys of ``above`` come before."""
    for name, field in type(model).model_fields.items():
        value: Any = getattr(model, name)
        if above + name in NOT_MOVING or name in CURRENTS or value == field.get_default(call_default_factory=True):
            continue
        if isinstance(value, BaseModel):
            yield from _lines(value, f"{above}{name}.")
        elif isinstance(value, dict):
            yield from (f"{above}{name}.{key} = {value[key]!r}" for key in value)
        else:
            yield f"{above}{name} = {value!r}"
