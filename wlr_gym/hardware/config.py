"""How a robot is wired and mounted, loaded from ``configs/hardware/*.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from wlr_gym.base.errors import InputError, nearest, unknown_name
from wlr_gym.base.paths import find_config, named_by, named_in
from wlr_gym.base.settings import SettingsModel, parse_config, read_config
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, POSITION_MODE, VELOCITY_MODE, load_table
from wlr_gym.hardware.limits import SafetyLimits
from wlr_gym.hardware.measured import Measured
from wlr_gym.robot import JOINTS, LEGS, Robot, Vector3

#: What the EEPROM of all servos must hold: directions and zeros stand in the hardware file, torque comes on when asked for.
FIXED_REGISTERS = {"drive_mode": 0, "homing_offset": 0, "startup_configuration": 0}


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
    """Errors of an IMU and how it is mounted: mounting * scale * (measured - offset). ``wlr calibrate imu`` writes it.

    Attributes:
        gyro_bias, accel_offset: rad/s, m/s2, sensor axes.
        accel_scale: per sensor axis.
        mounting: roll, pitch, yaw (rad) that turn sensor axes into body axes: Rz(yaw) Ry(pitch) Rx(roll).
        temperature, date: degC of the chip, and day it was made.
    """

    gyro_bias: Vector3 = (0.0, 0.0, 0.0)
    accel_offset: Vector3 = (0.0, 0.0, 0.0)
    accel_scale: Vector3 = (1.0, 1.0, 1.0)
    mounting: Vector3 = (0.0, 0.0, 0.0)
    temperature: float | None = None
    date: str | None = None


class ImuPort(SettingsModel):
    """The IMU: frames from a microcontroller's serial port (``stream``), or the chip on this computer's I2C bus (``i2c``).

    Attributes:
        port: serial device, or I2C bus (``/dev/i2c-1``).
        baud_rate: of the stream, bit/s.
        rate: readings per second.
        gyro_range, accel_range: full scale, deg/s and g.
        address, bandwidth: of the chip on I2C: address, filter (Hz). The microcontroller sets up its own.
    """

    port: str
    driver: Literal["stream", "i2c"] = "stream"
    baud_rate: int = Field(default=115200, gt=0)
    rate: float = Field(gt=0, le=1000)
    gyro_range: Literal[250, 500, 1000, 2000] = 500
    accel_range: Literal[2, 4, 8, 16] = 4
    address: Literal[0x68, 0x69] = 0x68
    bandwidth: Literal[184, 94, 44, 21, 10, 5] = 44
    calibration: ImuCalibration = ImuCalibration()

    @model_validator(mode="after")
    def _divides_the_sampling(self) -> ImuPort:
        divider = round(1000 / self.rate)
        if self.driver == "i2c" and not (divider <= 256 and abs(1000 / divider - self.rate) < 1e-3 * self.rate):
            raise ValueError(f"rate {self.rate:g}: on I2C expected 1000 Hz over a whole number up to 256, such as 200 or 100")
        return self


class FlowCalibration(SettingsModel):
    """How an optical-flow sensor is mounted, and how much it is off. ``wlr calibrate flow`` writes it.

    Attributes:
        scale: measured over true flow.
        mount_yaw: rotation about body z from body to sensor (rad), beyond what ``axes`` says.
        date: day it was made.
    """

    scale: float = Field(default=1.0, gt=0.2, lt=5.0)
    mount_yaw: float = Field(default=0.0, gt=-3.2, lt=3.2)
    date: str | None = None


FlowAxis = Literal["x", "-x", "y", "-y"]


class FlowPort(SettingsModel):
    """The optical-flow sensor: frames from a microcontroller's serial port (``stream``), or the chip on SPI (``spi``).

    Its numbers stand in the robot's file (``sensors.flow``).

    Attributes:
        port: serial device, or SPI device (``/dev/spidev0.0``).
        baud_rate: of the stream, bit/s.
        axes: which of the chip's axes count up when the robot drives along body +x, and along body +y.
    """

    port: str
    driver: Literal["stream", "spi"] = "stream"
    baud_rate: int = Field(default=115200, gt=0)
    axes: tuple[FlowAxis, FlowAxis] = ("-y", "-x")
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
    """Buttons of the gamepad (``wlr deploy --gamepad``), counted as ``jstest`` does.

    Attributes:
        deadman: the robot drives while it is held.
        stop: stops in good order.
        motors_off: at once.
    """

    deadman: int = Field(default=4, ge=0)
    stop: int = Field(default=0, ge=0)
    motors_off: int = Field(default=1, ge=0)

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
    def _what_was_measured_is_of_this_robot(self) -> Hardware:
        for name in Measured.model_fields:
            for place in getattr(self.measured, name):
                if place not in (*JOINTS, *self.buses):
                    raise unknown_name("joint or bus", place, (*JOINTS, *self.buses), f"measured.{name}")
        return self

    @model_validator(mode="after")
    def _every_joint_is_wired_once(self) -> Hardware:
        places = {f"buses.{name}.joints": bus.joints for name, bus in self.buses.items()} | {"joints": tuple(self.joints)}
        for where, joint in ((where, joint) for where, joints in places.items() for joint in joints):
            if joint not in JOINTS:
                raise unknown_name("joint", joint, JOINTS, where)
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
            turn = table.counts.turn
            for joint in bus.joints:
                mode = POSITION_MODE if joint in LEGS else VELOCITY_MODE  # in another one, setpoints would be another quantity
                for item, expected in {"operating_mode": mode, **FIXED_REGISTERS}.items():
                    if (found := bus.eeprom.get(item, table[item].default)) != expected:
                        where = f"buses.{name}.eeprom.{item}"
                        raise ValueError(f"{where} is {found}, expected {expected}: {joint} is driven with that")
                if self.joints[joint].zero >= turn:
                    raise ValueError(f"joints.{joint}.zero = {self.joints[joint].zero}: expected 0 to {turn - 1}")
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
    data = _with_servo_files(data, where)
    hardware = parse_config(Hardware, data, where)
    if hardware.robot is None:
        return hardware
    robot = named_in(where, hardware.robot)
    with named_by(where, "robot"):
        find_config("robot", robot)
    return hardware.model_copy(update={"robot": str(robot)})


def require_leg_range(hardware: Hardware, robot: Robot, where: object) -> None:
    """Raise :class:`InputError` where ``leg_margin`` at both ends leaves nothing of a robot's ``leg_limits``."""
    low, high = robot.leg_limits
    margin, largest = hardware.safety.leg_margin, (high - low) / 2.0
    if not margin < largest:
        raise InputError(
            f"{where}: safety.leg_margin = {margin:g} rad: expected below {largest:g} rad: twice it must leave a range within "
            f"leg_limits, {low:g} to {high:g} rad, of robot '{robot.name}'"
        )


def _with_servo_files(data: Any, where: str) -> Any:
    """Return a hardware file's content with servo models that are files named by their place."""
    if not isinstance(data, dict) or not isinstance(data.get("buses"), dict):
        return data
    buses = {
        name: {**bus, "model": str(named_in(where, bus["model"]))}
        if isinstance(bus, dict) and str(bus.get("model", "")).endswith((".yaml", ".yml"))
        else bus
        for name, bus in data["buses"].items()
    }
    return {**data, "buses": buses}


def with_ports(hardware: Hardware, ports: dict[str, str]) -> Hardware:
    """Return the same hardware on other ports: bus name, ``imu`` or ``flow`` -> path.

    Raises:
        InputError: a name that is no bus.
    """
    if unknown := set(ports) - {*hardware.port_names}:
        name = sorted(unknown)[0]
        raise InputError(f"no bus '{name}'{nearest(name, hardware.port_names)}; the buses are {', '.join(hardware.port_names)}")
    buses = {name: bus.model_copy(update={"port": ports.get(name, bus.port)}) for name, bus in hardware.buses.items()}
    imu = hardware.imu.model_copy(update={"port": ports.get("imu", hardware.imu.port)})
    flow = None if hardware.flow is None else hardware.flow.model_copy(update={"port": ports.get("flow", hardware.flow.port)})
    return hardware.model_copy(update={"buses": buses, "imu": imu, "flow": flow})
