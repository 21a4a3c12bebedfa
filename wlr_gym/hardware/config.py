"""How a robot is wired and mounted, what it may do, and what was measured on it: ``configs/hardware/*.yaml``.

:func:`check_fit` refuses a robot file and a hardware file that speak of other servos.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, ValidatorFunctionWrapHandler, field_validator, model_validator
from pydantic_core import PydanticCustomError

from wlr_gym.base.errors import InputError, check_name
from wlr_gym.base.paths import find_config, named_by, named_in
from wlr_gym.base.settings import SettingsModel, expected, parse_config, read_config
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, POSITION_MODE, VELOCITY_MODE, ControlTable, load_table
from wlr_gym.physics.servo import measures_current
from wlr_gym.robot import JOINTS, LEGS, Robot, Vector3

#: s: longest silence of the operator that may be allowed.
LONGEST_DEADMAN = 10.0
#: What the EEPROM of all servos must hold: directions and zeros stand in the hardware file, torque comes on when asked for.
FIXED_REGISTERS = {"drive_mode": 0, "homing_offset": 0, "startup_configuration": 0}
#: Relative difference of a count from its register's that is a rounding of the file.
SAME = 1e-3
#: Most servos on one shaft: a dual joint has two, of which one is on the bus, and its current is a share of the joint's.
MOST_SERVOS = 4


# ---- the safety limits ----


def _limit(default: float | None, unit: str, doc: str, *, le: float, **low: Any) -> Any:
    """Return the field of a limit; ``le`` is far above what anyone sets on purpose: a value beyond it has another unit."""
    return Field(default=default, le=le, description=doc, json_schema_extra={"unit": unit}, **low)


class SafetyLimits(SettingsModel):
    """Limits of a robot, SI units; the reasons stand in ``configs/hardware/nominal.yaml``."""

    leg_margin: float = _limit(0.05, "rad", "distance that leg setpoints keep from the robot file's limits", ge=0.0, le=0.5)
    leg_taper: float = _limit(0.1, "rad", "range before that margin in which leg setpoints slow down", gt=0.0, le=1.0)
    leg_speed: float = _limit(8.0, "rad/s", "largest rate of change of a leg setpoint", gt=0.0, le=20.0)
    leg_lead: float = _limit(0.45, "rad", "largest lead of a leg's setpoint over the leg", gt=0.0, le=1.6)
    wheel_speed: float = _limit(6.4, "rad/s", "largest wheel setpoint", gt=0.0, le=40.0)
    wheel_acceleration: float = _limit(200.0, "rad/s2", "largest rate of change of a wheel setpoint", gt=0.0, le=2000.0)
    load: float = _limit(0.7, "of stall torque", "torque that a motor may give for long", gt=0.0, le=1.0)
    load_time: float = _limit(1.0, "s", "time for which a motor may give more", gt=0.0, le=5.0)
    current: float = _limit(10.0, "A", "current of all motors together that may last", gt=0.0, le=100.0)
    current_time: float = _limit(0.5, "s", "time for which the current may be larger", gt=0.0, le=5.0)
    tilt: float = _limit(0.7, "rad", "largest lean of the body", gt=0.0, le=1.6)
    tilt_time: float = _limit(0.1, "s", "time that a larger lean must last before the robot stops", ge=0.0, le=2.0)
    tilt_horizon: float = _limit(0.2, "s", "time ahead for which the lean is predicted", ge=0.0, le=2.0)
    warm: float = _limit(62.0, "degC", "servo temperature from which wheels are slowed down", le=80.0)
    hot: float = _limit(68.0, "degC", "servo temperature at which the robot stops", le=80.0)
    low_voltage: float = _limit(10.2, "V", "least supply voltage that may last", gt=0.0, le=30.0)
    low_voltage_time: float = _limit(0.5, "s", "time for which the supply may be below it", ge=0.0, le=5.0)
    coast: float = _limit(0.06, "s", "time without an answer for which old setpoints hold", ge=0.0, le=1.0)
    silence: float = _limit(0.4, "s", "time without an answer after which torque goes off", gt=0.0, le=3.0)
    imu_silence: float = _limit(0.1, "s", "longest time without a reading of the IMU", gt=0.0, le=3.0)
    imu_frozen: float = _limit(0.1, "s", "longest time that the IMU may repeat exactly the same values", gt=0.0, le=3.0)
    jump_speed: float = _limit(
        1.5, "of no-load speed", "largest joint speed that is believed; more, twice, is a fault", ge=1.0, le=10.0
    )
    jump_noise: float = _limit(0.03, "rad", "sensor noise that is allowed on top of it", ge=0.0, le=0.5)
    frozen_leg: float = _limit(0.02, "rad", "way that a leg's motor has gone and its reading has not", gt=0.0, le=0.5)
    frozen_wheel: float = _limit(
        0.5, "rad", "way that a wheel's setpoint or motor has gone, and its reading not", gt=0.0, le=6.3
    )
    line_noise: float = _limit(
        0.01, "of no-load speed", "speed by which voltage and current may tell another one than the encoder", gt=0.0, le=0.5
    )
    leg_error: float = _limit(
        0.2, "rad", "distance of a leg from its setpoint, without coming nearer, that may last", gt=0.0, le=1.6
    )
    leg_error_time: float = _limit(0.3, "s", "time for which it may last", gt=0.0, le=5.0)
    wheel_error: float = _limit(2.0, "rad/s", "difference of a wheel's speed from its setpoint that may last", gt=0.0, le=10.0)
    wheel_error_time: float = _limit(0.5, "s", "time for which it may last", gt=0.0, le=5.0)
    late: int = _limit(5, "ticks", "consecutive ticks that may start more than a period late", ge=1, le=10_000)
    late_share: float = _limit(0.1, "of the ticks", "share in the last second that may start so late", gt=0.0, le=1.0)
    deadman: float | None = _limit(
        None, "s", "longest silence of the operator; None = no sign is needed", gt=0.0, le=LONGEST_DEADMAN
    )
    watchdog: float = _limit(0.2, "s", "silence on the line after which servos stop by themselves", ge=0.02, le=2.54)
    heartbeat: float = _limit(
        0.8, "s", "longest time between control steps; then the watchdog process kills this one", gt=0.0, le=10.0
    )
    patience: float = _limit(0.004, "s", "time that an answer may take beyond its time on the wire", gt=0.0, le=1.0)
    read_time: float = _limit(0.014, "s", "time that 99 of 100 reads of all joints may take at the start", gt=0.0, le=1.0)
    start_speed: float = _limit(1.0, "rad/s", "mean speed of the legs on the way to the start pose", gt=0.0, le=10.0)
    start_error: float = _limit(
        0.3, "rad", "largest distance of a leg from the start pose at the end of that way", gt=0.0, le=1.0
    )
    stop_time: float = _limit(0.6, "s", "time from the order to stop the wheels until torque goes off", ge=0.0, le=5.0)
    off_time: float = _limit(2.0, "s", "time to keep trying where servos do not confirm that torque is off", ge=0.0, le=10.0)

    @field_validator("*", mode="wrap")
    @classmethod
    def _refusals_tell_the_unit(cls, value: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        try:
            return check(value)
        except ValidationError as error:
            context = {"reason": expected(error.errors()[0]), "unit": unit_of(str(info.field_name))}
            raise PydanticCustomError("limit", "{reason} ({unit})", context) from None

    @model_validator(mode="after")
    def _limits_are_in_order(self) -> SafetyLimits:
        for low, high, why in (
            ("coast", "silence", ""),
            ("leg_error", "leg_lead", ", or it never shows"),
            ("watchdog", "heartbeat", ""),
            ("warm", "hot", ""),
        ):
            below, above = getattr(self, low), getattr(self, high)
            if not below < above:
                unit = unit_of(low)
                raise InputError(f"safety.{low} = {below:g} {unit}: expected below {high} = {above:g} {unit}{why}")
        return self


def unit_of(limit: str) -> str:
    """Return the unit of a limit."""
    extra = SafetyLimits.model_fields[limit].json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) else ""


# ---- what was measured ----


class MeasuredValue(SettingsModel):
    """One value that was measured on the robot."""

    value: float
    unit: str  #: SI unit; ``-`` is a pure number
    date: str  #: day it was measured


#: Joint or bus -> value.
MeasuredValues = dict[str, MeasuredValue]


def _measured(doc: str) -> Any:
    return Field(default_factory=dict, description=doc)


class Measured(SettingsModel):
    """What ``wlr commission`` measured on this robot, by joint or bus; docs/robot.md says how. For people and analyses."""

    adapter_latency: MeasuredValues = _measured("s of a ping beyond its bytes' time on the wire: median")
    adapter_jitter: MeasuredValues = _measured("s that 99 of 100 pings take at most beyond the median")
    answers_behind_ordinary: MeasuredValues = _measured("part of the servos that answer behind a silent one, ordinary read")
    answers_behind_fast: MeasuredValues = _measured("the same, fast read")
    wheel_follows_given: MeasuredValues = _measured("speed at torque-on, over a setpoint written before")
    wheel_follows_kept: MeasuredValues = _measured("speed at torque-on, over a setpoint left from before")
    leg_follows_given: MeasuredValues = _measured("way at torque-on, over the way to a setpoint written before")
    leg_follows_kept: MeasuredValues = _measured("way at torque-on, over the way to a setpoint left from before")
    watchdog_stop_time: MeasuredValues = _measured("s from the last packet until a wheel stands: its way over its speed")
    velocity_loop_time: MeasuredValues = _measured("s, time constant of a wheel's way to a new speed")
    integral_cycle: MeasuredValues = _measured("s, control cycle of the wheel's servo that this means")
    load_per_pwm: MeasuredValues = _measured("slope of Present Load over PWM of a free wheel: 0 = it is torque, 1 = it is PWM")
    running_load: MeasuredValues = _measured("load of a free wheel, or of a leg on its way, part of stall torque")
    stall_load: MeasuredValues = _measured("load of a held wheel or leg over PWM and supply")
    stall_current: MeasuredValues = _measured("A of a held wheel, at full voltage")
    joint_zero: MeasuredValues = _measured("rad that a leg reads when it hangs straight down, less pi/2")


# ---- wiring and mounting ----


class Bus(SettingsModel):
    """One electrical bus: serial port, servo model, joints on it, and what the servos' EEPROM must hold (counts).

    ``model`` is one that ships, such as ``XM540-W150-R``, or the path of a file with another's control table and data sheet,
    seen from the hardware file first; see :mod:`wlr_gym.hardware.dynamixel.tables`.
    """

    port: str
    model: str
    baud_rate: int
    joints: tuple[str, ...] = Field(min_length=1)
    eeprom: dict[str, int] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _is_possible(self) -> Bus:
        table = load_table(self.model)
        if self.baud_rate not in BAUD_RATES:
            raise ValueError(f"baud rate {self.baud_rate}; the servos know {', '.join(map(str, BAUD_RATES))}")
        outside = [name for name in self.eeprom if not table[name].in_eeprom]
        if outside:
            raise ValueError(f"{', '.join(outside)}: not in the EEPROM")
        return self


class ImuCalibration(SettingsModel):
    """Errors of an IMU and how it is mounted: mounting * scale * (measured - offset). ``wlr calibrate imu`` writes it."""

    gyro_bias: Vector3 = (0.0, 0.0, 0.0)  #: rad/s, sensor axes
    accel_offset: Vector3 = (0.0, 0.0, 0.0)  #: m/s2, sensor axes
    accel_scale: Vector3 = (1.0, 1.0, 1.0)  #: per sensor axis
    mounting: Vector3 = (0.0, 0.0, 0.0)  #: roll, pitch, yaw (rad) from sensor to body axes: Rz(yaw) Ry(pitch) Rx(roll)
    temperature: float | None = None  #: degC of the chip
    date: str | None = None  #: day it was made


class ImuPort(SettingsModel):
    """The IMU: frames from a microcontroller's serial port (``stream``), or the chip on this computer's I2C bus (``i2c``)."""

    port: str  #: serial device, or I2C bus (``/dev/i2c-1``)
    driver: Literal["stream", "i2c"] = "stream"
    baud_rate: int = Field(default=115200, gt=0)  #: of the stream, bit/s
    rate: float = Field(gt=0, le=1000)  #: readings per second
    gyro_range: Literal[250, 500, 1000, 2000] = 500  #: full scale, deg/s
    accel_range: Literal[2, 4, 8, 16] = 4  #: full scale, g
    address: Literal[0x68, 0x69] = 0x68  #: of the chip on I2C
    bandwidth: Literal[184, 94, 44, 21, 10, 5] = 44  #: Hz, of its filter; the microcontroller sets up its own
    calibration: ImuCalibration = ImuCalibration()

    @model_validator(mode="after")
    def _divides_the_sampling(self) -> ImuPort:
        divider = round(1000 / self.rate)
        if self.driver == "i2c" and not (divider <= 256 and abs(1000 / divider - self.rate) < 1e-3 * self.rate):
            raise ValueError(f"rate {self.rate:g}: on I2C expected 1000 Hz over a whole number up to 256, such as 200 or 100")
        return self


class FlowCalibration(SettingsModel):
    """How an optical-flow sensor is mounted, and how much it is off. ``wlr calibrate flow`` writes it."""

    scale: float = Field(default=1.0, gt=0.2, lt=5.0)  #: measured over true flow
    mount_yaw: float = Field(default=0.0, gt=-3.2, lt=3.2)  #: rad about body z, from body to sensor, beyond what ``axes`` says
    date: str | None = None  #: day it was made


FlowAxis = Literal["x", "-x", "y", "-y"]


class FlowPort(SettingsModel):
    """The optical-flow sensor: frames from a microcontroller's serial port. Its numbers stand in the robot's file."""

    port: str  #: serial device
    driver: Literal["stream"] = "stream"
    baud_rate: int = Field(default=115200, gt=0)  #: bit/s
    axes: tuple[FlowAxis, FlowAxis] = ("-y", "-x")  #: axes of the chip that count up as the robot drives along body +x and +y
    calibration: FlowCalibration = FlowCalibration()

    @model_validator(mode="after")
    def _axes_are_two(self) -> FlowPort:
        if self.axes[0][-1] == self.axes[1][-1]:
            raise ValueError(f"axes {list(self.axes)}: expected one of the chip's x and one of its y")
        return self


class Mounting(SettingsModel):
    """How a servo sits on its joint: count = zero + sign * angle / count size; ``zero`` is within the servo's turn."""

    sign: Literal[-1, 1] = 1
    zero: int = Field(0, ge=0)


class PadButtons(SettingsModel):
    """Buttons of the gamepad (``wlr deploy --gamepad``), counted as ``jstest`` does."""

    deadman: int = Field(default=4, ge=0)  #: the robot drives while it is held
    stop: int = Field(default=0, ge=0)  #: in good order
    motors_off: int = Field(default=1, ge=0)  #: at once

    @model_validator(mode="after")
    def _are_three(self) -> PadButtons:
        if len({self.deadman, self.stop, self.motors_off}) < 3:
            raise ValueError(f"deadman {self.deadman}, stop {self.stop}, motors_off {self.motors_off}: expected three buttons")
        return self


class Hardware(SettingsModel):
    """Wiring and mounting of a whole robot, as one ``configs/hardware/*.yaml`` describes it.

    ``robot`` is the robot file that holds its numbers: name in ``configs/robot/``, or path, seen from this file first; None =
    the one that is asked for.
    """

    name: str
    robot: str | None = None
    buses: dict[str, Bus]
    imu: ImuPort
    flow: FlowPort | None = None
    joints: dict[str, Mounting]
    gamepad: PadButtons = PadButtons()
    safety: SafetyLimits = SafetyLimits()
    measured: Measured = Measured()

    @property
    def port_names(self) -> tuple[str, ...]:
        """What has a port: buses, ``imu``, and ``flow`` where there is one."""
        return (*self.buses, "imu", *(["flow"] if self.flow is not None else []))

    @model_validator(mode="after")
    def _names_are_known(self) -> Hardware:
        for name in {"imu", "flow"} & set(self.buses):
            raise ValueError(f"buses.{name}: a sensor is called that; expected another name for the bus")
        if self.flow is not None and self.flow.port == self.imu.port and self.flow.baud_rate != self.imu.baud_rate:
            rates = f"{self.flow.baud_rate}, but imu has {self.imu.baud_rate}"
            raise ValueError(f"flow.baud_rate: {rates} on the same port; expected one speed")
        for name, values in self.measured:
            for place in values:
                check_name("joint or bus", place, (*JOINTS, *self.buses), f"measured.{name}")
        return self

    @model_validator(mode="after")
    def _every_joint_is_wired_once(self) -> Hardware:
        places = {f"buses.{name}.joints": bus.joints for name, bus in self.buses.items()} | {"joints": tuple(self.joints)}
        for where, joints in places.items():
            for joint in joints:
                check_name("joint", joint, JOINTS, where)
        wired = [joint for bus in self.buses.values() for joint in bus.joints]
        for joint in JOINTS:
            if wired.count(joint) != 1 or joint not in self.joints:
                found = f"{wired.count(joint)} times in buses, {int(joint in self.joints)} times in joints"
                raise InputError(f"{joint} is named {found}: they must name each of {', '.join(JOINTS)} once")
        return self

    @model_validator(mode="after")
    def _registers_are_those_of_the_setpoints(self) -> Hardware:
        for name, bus in self.buses.items():
            table = load_table(bus.model)
            for joint in bus.joints:
                mode = POSITION_MODE if joint in LEGS else VELOCITY_MODE  # in another one, setpoints would be another quantity
                for item, fixed in {"operating_mode": mode, **FIXED_REGISTERS}.items():
                    if (found := bus.eeprom.get(item, table[item].default)) != fixed:
                        where = f"buses.{name}.eeprom.{item}"
                        raise ValueError(f"{where} is {found}, expected {fixed}: {joint} is driven with that")
                if (zero := self.joints[joint].zero) >= table.counts.turn:
                    raise ValueError(f"joints.{joint}.zero = {zero}: expected 0 to {table.counts.turn - 1}")
        return self


def load_hardware(source: str | Path | Hardware = "nominal") -> Hardware:
    """Load a hardware description by config name or path.

    Raises:
        InputError: unreadable file, unknown or missing key, a joint wired twice or not at all, an impossible baud rate.
    """
    if isinstance(source, Hardware):
        return source
    data, where = read_config("hardware", source)
    if isinstance(data, dict) and "hip_position" in data:
        raise InputError(
            f"{where}: a robot file; expected a hardware file (buses, joints, imu); a robot file goes with --robot"
        )
    buses = data.get("buses") if isinstance(data, dict) else None
    for bus in buses.values() if isinstance(buses, dict) else ():
        if isinstance(bus, dict) and str(bus.get("model", "")).endswith((".yaml", ".yml")):
            bus["model"] = str(named_in(where, bus["model"]))
    hardware = parse_config(Hardware, data, where)
    if hardware.robot is None:
        return hardware
    robot = named_in(where, hardware.robot)
    with named_by(where, "robot"):
        find_config("robot", robot)
    return hardware.model_copy(update={"robot": str(robot)})


def with_ports(hardware: Hardware, ports: dict[str, str]) -> Hardware:
    """Return the same hardware on other ports: bus name, ``imu`` or ``flow`` -> path.

    Raises:
        InputError: a name that is no bus.
    """
    changed: dict[str, Any] = {"buses": dict(hardware.buses)}
    if "imu" in ports and hardware.flow is not None and hardware.flow.port == hardware.imu.port:
        ports = {"flow": ports["imu"], **ports}  # both are on one board
    for name, port in ports.items():
        check_name("port", name, hardware.port_names)
        if name in hardware.buses:
            changed["buses"][name] = hardware.buses[name].model_copy(update={"port": port})
        else:
            changed[name] = getattr(hardware, name).model_copy(update={"port": port})
    return hardware.model_copy(update=changed)


# ---- robot and wiring together ----


def require_leg_range(hardware: Hardware, robot: Robot, where: object) -> None:
    """Raise :class:`InputError` where ``leg_margin`` at both ends leaves nothing of a robot's ``leg_limits``."""
    low, high = robot.leg_limits
    margin, largest = hardware.safety.leg_margin, (high - low) / 2.0
    if not margin < largest:
        raise InputError(
            f"{where}: safety.leg_margin = {margin:g} rad: expected below {largest:g} rad: twice it must leave a range within "
            f"leg_limits, {low:g} to {high:g} rad, of robot '{robot.name}'"
        )


def check_fit(robot: Robot, hardware: Hardware) -> None:
    """Refuse a robot whose servos' numbers are not those of the models that it is wired with.

    Raises:
        InputError: names the first difference: supply voltage, encoder counts, what the servo reports of its torque, or a
            sensor that only one of them has.
    """
    if hardware.flow is not None and robot.sensors.flow is None:
        raise InputError(
            f"hardware '{hardware.name}' has an optical-flow sensor, robot '{robot.name}' has not: its file needs a section "
            "sensors.flow, as in configs/robot/flow.yaml"
        )
    for name, bus in hardware.buses.items():
        table = load_table(bus.model)
        for joint in bus.joints:
            problem = _problem(robot, table, joint)
            if problem:
                raise InputError(
                    f"robot '{robot.name}' on hardware '{hardware.name}', bus '{name}', {joint}: {problem}: name the hardware "
                    "file of this robot (--hardware), or mend one of the two"
                )


def _problem(robot: Robot, table: ControlTable, joint: str) -> str:
    """Return what does not fit; empty where all does."""
    is_leg = joint in LEGS
    group, motor = ("leg", robot.servo.leg) if is_leg else ("wheel", robot.servo.wheel)
    low, high = table.voltage_range()
    if not low <= robot.servo.supply_voltage <= high:
        return f"servo.supply_voltage is {robot.servo.supply_voltage:g} V, {table.model} takes {low:g} to {high:g} V"
    for key in ("position", "velocity"):
        stated, count = getattr(robot.sensors.encoder, key), table.per_count(f"present_{key}")
        if stated > 0.0 and not math.isclose(stated, count, rel_tol=SAME):  # 0: an ideal one
            return f"sensors.encoder.{key} is {stated:g}, a count of {table.model} is {count:g}"
    has_current = measures_current(robot)[0 if is_leg else 1]
    if has_current != (table.effort == "present_current"):
        said, has = ("current_count", "no current") if has_current else ("load_count", "its current")
        return f"servo.{group} reports counts of {said}, {table.model} measures {has}"
    if motor.current_count is not None:
        servos = motor.current_count / table.counts.current
        if not (1 <= round(servos) <= MOST_SERVOS and math.isclose(servos, round(servos), rel_tol=SAME)):
            here = f"a count of {table.model} is {table.counts.current:g} A"
            return f"servo.{group}.current_count is {motor.current_count:g} A, {here}"
    return ""
