"""How a robot is wired and mounted, loaded from ``configs/hardware/*.yaml``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import SettingsModel, parse_config, read_config
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, load_table
from wlr_gym.hardware.limits import SafetyLimits
from wlr_gym.robot import JOINTS, LEGS, Vector3

#: Operating mode of the legs. Setpoints are written for these modes; in another one they would be another quantity.
POSITION_MODE = 3
#: Operating mode of the wheels.
VELOCITY_MODE = 1


class Bus(SettingsModel):
    """One electrical bus: serial port, servo model, joints on it, and what the servos' EEPROM must hold (counts)."""

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


class Mounting(SettingsModel):
    """How a servo sits on its joint: count = zero + sign * angle / count size."""

    sign: Literal[-1, 1] = 1
    zero: int = Field(0, ge=0, le=4095)


class Hardware(SettingsModel):
    """Wiring and mounting of a whole robot, as one ``configs/hardware/*.yaml`` describes it."""

    name: str
    buses: dict[str, Bus]
    imu: ImuPort
    joints: dict[str, Mounting]
    safety: SafetyLimits = SafetyLimits()

    @model_validator(mode="after")
    def _every_joint_is_wired_once(self) -> Hardware:
        wired = [joint for bus in self.buses.values() for joint in bus.joints]
        if sorted(wired) != sorted(JOINTS) or set(self.joints) != set(JOINTS):
            raise ValueError(f"buses and joints must name each of {', '.join(JOINTS)} once")
        return self

    @model_validator(mode="after")
    def _modes_are_those_of_the_setpoints(self) -> Hardware:
        for name, bus in self.buses.items():
            found = bus.eeprom.get("operating_mode", load_table(bus.model)["operating_mode"].default)
            for joint in bus.joints:
                expected = POSITION_MODE if joint in LEGS else VELOCITY_MODE
                if found != expected:
                    raise ValueError(
                        f"buses.{name}.eeprom.operating_mode is {found}, expected {expected}: {joint} is driven in that mode"
                    )
        return self


def load_hardware(source: str | Path | Hardware = "nominal") -> Hardware:
    """Load a hardware description by config name or path.

    Raises:
        InputError: unreadable file, unknown or missing key, a joint wired twice or not at all, an impossible baud rate.
    """
    if isinstance(source, Hardware):
        return source
    return parse_config(Hardware, *read_config("hardware", source))


def with_ports(hardware: Hardware, ports: dict[str, str]) -> Hardware:
    """Return the same hardware on other ports: bus name or ``imu`` -> path.

    Raises:
        InputError: a name that is no bus.
    """
    unknown = set(ports) - set(hardware.buses) - {"imu"}
    if unknown:
        raise InputError(f"no bus '{sorted(unknown)[0]}'; the buses are {', '.join([*hardware.buses, 'imu'])}")
    buses = {name: bus.model_copy(update={"port": ports.get(name, bus.port)}) for name, bus in hardware.buses.items()}
    imu = hardware.imu.model_copy(update={"port": ports.get("imu", hardware.imu.port)})
    return hardware.model_copy(update={"buses": buses, "imu": imu})
