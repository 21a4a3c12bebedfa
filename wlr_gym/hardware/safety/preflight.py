"""Preflight: checks of ports, servos and IMU before anything moves, each with its remedy. Reads only."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.calibration import ACCEL_REST, GYRO_REST, motion
from wlr_gym.hardware.config import Hardware, ImuPort
from wlr_gym.hardware.dynamixel.errors import NoAnswerError, RefusedError, RestlessLineError
from wlr_gym.hardware.dynamixel.tables import ControlTable, load_table
from wlr_gym.hardware.imu.driver import Imu
from wlr_gym.hardware.imu.frames import STANDARD_GRAVITY
from wlr_gym.hardware.imu.reading import ImuGoneError
from wlr_gym.hardware.ports import PortInUseError
from wlr_gym.hardware.servos import Servos
from wlr_gym.robot import JOINTS, LEGS, Robot

if TYPE_CHECKING:
    from wlr_gym.hardware.timing import Clock

#: Oldest firmware that is driven.
FIRST_FIRMWARE = 42
#: Oldest firmware with fast reads.
FAST_READ_FIRMWARE = 45
#: degC at which a servo is too warm to start with: below the XL430's shutdown at 72 by enough for a run.
WARM = 60
#: Reads before the timed ones: the bus finds out whether its servos know fast reads.
_UNTIMED_READS = 5
#: s an IMU is looked at.
LOOK_TIME = 1.0
#: rad/s a calibrated gyroscope may read at rest.
LARGEST_RATE = 0.02
#: rad that gravity may be off the vertical.
LARGEST_TILT = math.radians(10.0)
#: Part that gravity's length may be off.
LARGEST_LENGTH_ERROR = 0.05


class Check(NamedTuple):
    """One thing that was looked at.

    Attributes:
        where: joint, bus, or ``robot``.
        what: name of the check.
        ok: as it should be.
        found, expected: in words.
        remedy: what to do about it.
        is_fatal: nothing may move while it is not ok; else a warning.
        fix: item and count to write (torque off) that would mend it; None = by hand.
    """

    where: str
    what: str
    ok: bool
    found: str
    expected: str
    remedy: str
    is_fatal: bool = True
    fix: tuple[str, int] | None = None

    def __str__(self) -> str:
        state = "ok" if self.ok else "FAULT" if self.is_fatal else "warning"
        text = f"{state:8}{self.where:10} {self.what}: {self.found}"
        return text if self.ok else f"{text}, expected {self.expected}. {self.remedy}"


@dataclass(frozen=True)
class _Rule:
    """An item that must hold a count; ``expected`` None: what the hardware file's ``eeprom`` says, else the default."""

    item: str
    expected: int | None
    reason: str
    is_fatal: bool = True


_RULES = (
    _Rule("operating_mode", None, "setpoints would be read as another quantity"),
    _Rule("drive_mode", 0, "direction and profile units belong in the hardware file, torque must not come on by itself"),
    _Rule(
        "homing_offset",
        0,
        "with an offset a watchdog stop may move the motor (DynamixelSDK #584); use the hardware file's zero",
    ),
    _Rule("startup_configuration", 0, "torque must not come on at power-up"),
    _Rule("shutdown", None, "overload, overheating and electrical shock must cut torque"),
    _Rule("temperature_limit", None, "the factory's limit protects the motor"),
    _Rule("status_return_level", 2, "refused writes would go unnoticed"),
    _Rule("return_delay_time", None, "each answer waits this long", is_fatal=False),
)


def open_ports(servos: Servos, imu: Imu, hardware: Hardware) -> list[Check]:
    """Open every port that can be opened, and say which could not: a check per port. Who called closes them."""
    checks = []
    ports = {name: (group.open, hardware.buses[name].port) for name, group in servos.groups.items()}
    for name, (open_port, path) in {**ports, "imu": (imu.open, hardware.imu.port)}.items():
        try:
            open_port()
            checks.append(Check(name, "port", True, path, "", ""))
        except PortInUseError as error:
            remedy = f"End that program first (fuser {path} names it); if it holds the robot up, hold the robot."
            checks.append(Check(name, "port", False, str(error), path, remedy))
        except InputError as error:
            if Path(path).exists():
                found, remedy = str(error), "Join the group it belongs to (ls -l), often dialout, and log in again."
            else:
                found, remedy = "not there", f"Plug the adapter in, or name its port with --port {name}=PATH; {_ports_here()}."
            checks.append(Check(name, "port", False, found, path, remedy))
    return checks


def _ports_here(devices: Path = Path("/dev")) -> str:
    """Serial ports of this computer, those with stable names first."""
    named = sorted((devices / "serial" / "by-id").glob("*")) if (devices / "serial" / "by-id").is_dir() else []
    found = named or sorted([*devices.glob("ttyUSB*"), *devices.glob("ttyACM*")])
    return f"here are {', '.join(map(str, found))}" if found else "no USB serial port is here now"


def check_servos(servos: Servos, robot: Robot, hardware: Hardware, joints: Sequence[str] = JOINTS) -> list[Check]:
    """Look at every servo and return all checks, good and bad, in joint order.

    Args:
        servos: with the ports of ``joints`` open.
        robot, hardware: what they should be.
        joints: which to look at.

    Raises:
        BusGoneError: a port is gone.
    """
    return [check for joint in joints for check in _check_servo(servos, robot, hardware, joint)]


def _check_servo(servos: Servos, robot: Robot, hardware: Hardware, joint: str) -> Iterator[Check]:
    bus_name, bus = next((name, bus) for name, bus in hardware.buses.items() if joint in bus.joints)
    id, table = robot.dynamixel_ids[joint], load_table(bus.model)
    try:
        number, firmware = servos.ping(joint)
    except RestlessLineError:
        remedy = f"Are two ports swapped (an IMU's stream never ends)? Check wiring and termination of {bus_name} ({bus.port})."
        yield Check(joint, "answer", False, "none, the line is never quiet", f"one from id {id}", remedy)
        return
    except NoAnswerError:
        remedy = f"Check power, cable and adapter of bus {bus_name} ({bus.port}), and the servo's id and baud rate with a scan."
        yield Check(joint, "answer", False, "none", f"one from id {id} at {bus.baud_rate} bit/s", remedy)
        return
    yield Check(joint, "answer", True, f"id {id}", "", "")
    remedy = "The hardware file names another model than is mounted, or ids are swapped."
    yield Check(joint, "model", number == table.model_number, str(number), f"{table.model_number} ({bus.model})", remedy)
    if number != table.model_number:
        return
    yield Check(
        joint,
        "firmware",
        firmware >= FIRST_FIRMWARE,
        str(firmware),
        f"{FIRST_FIRMWARE} or newer",
        "Update it (Dynamixel Wizard).",
    )
    fast = f"{FAST_READ_FIRMWARE} or newer for fast reads"
    yield Check(joint, "fast reads", firmware >= FAST_READ_FIRMWARE, str(firmware), fast, "Update the firmware.", False)
    try:
        yield from _check_items(servos, bus.eeprom, joint, table)
        yield from _check_state(servos, joint)
    except (NoAnswerError, RefusedError) as error:
        yield Check(joint, "reading", False, str(error), "answers", "The line is bad: check cable, termination and ground.")


def _check_items(servos: Servos, eeprom: dict[str, int], joint: str, table: ControlTable) -> Iterator[Check]:
    for rule in _RULES:
        default = table[rule.item].default
        assert isinstance(default, int), "rules are about items with a default of their own"
        expected = eeprom.get(rule.item, default) if rule.expected is None else rule.expected
        found = servos.get(joint, rule.item)
        remedy = f"Write {rule.item} = {expected}: {rule.reason}."
        fix = (rule.item, expected)
        yield Check(joint, rule.item, found == expected, str(found), str(expected), remedy, rule.is_fatal, fix)


def _check_state(servos: Servos, joint: str) -> Iterator[Check]:
    voltage = servos.get(joint, "present_input_voltage")
    low, high = servos.get(joint, "min_voltage_limit"), servos.get(joint, "max_voltage_limit")
    remedy = "Charge the battery, or check supply and cables; power should be fed in on both sides of a long chain."
    yield Check(
        joint, "supply", low <= voltage <= high, f"{voltage / 10:.1f} V", f"{low / 10:.1f} to {high / 10:.1f} V", remedy
    )
    temperature = servos.get(joint, "present_temperature")
    yield Check(joint, "temperature", temperature < WARM, f"{temperature} degC", f"below {WARM} degC", "Let it cool down.")
    if joint in LEGS:
        place = servos.get(joint, "present_position")
        low, high = servos.get(joint, "min_position_limit"), servos.get(joint, "max_position_limit")
        remedy = "Turn the leg back by hand, or correct the servo's position limits: it would jump to them."
        yield Check(joint, "position", low <= place <= high, f"{place}", f"{low} to {high}", remedy)
    errors = servos.hardware_errors(joint)
    remedy = "Find the cause, let the servo cool, then reboot it; the latch is there for a reason."
    yield Check(joint, "hardware error", not errors, ", ".join(errors) or "none", "none", remedy)
    latched = servos.get(joint, "bus_watchdog") < 0
    remedy = "Write bus_watchdog = 0: the line went silent in an earlier run, setpoints are refused until then."
    yield Check(joint, "watchdog", not latched, "latched" if latched else "clear", "clear", remedy, True, ("bus_watchdog", 0))
    on = bool(servos.get(joint, "torque_enable"))
    remedy = "Something else drives the robot, or a run ended badly. Switching off may drop it: hold it first."
    yield Check(joint, "torque", not on, "on" if on else "off", "off", remedy)


def check_bus_speed(servos: Servos, reads: int, budget: float, now: Callable[[], float] = time.perf_counter) -> Check:
    """Time reads of all joints and compare the 99th percentile with the budget.

    Args:
        servos: with all ports open.
        reads: how many are timed.
        budget: s, the hardware file's ``read_time``.
        now: clock, s.

    Raises:
        BusGoneError: a port is gone.
    """
    for _ in range(_UNTIMED_READS):
        servos.read()
    times = np.empty(reads)
    lost = 0
    for k in range(reads):
        start = now()
        lost += int(8 - servos.read().answered.sum())
        times[k] = now() - start
    median, slow = (1e3 * np.percentile(times, [50, 99])).tolist()
    found = f"median {median:.2f} ms, p99 {slow:.2f} ms, {lost} of {8 * reads} answers lost"
    remedy = "Set the adapters' latency timer to 1 ms, raise the baud rate, set return_delay_time = 0, check the cables."
    ok = slow <= budget * 1e3 and lost <= 0.01 * 8 * reads
    return Check("robot", "bus speed", ok, found, f"p99 below {budget * 1e3:g} ms and 1 % lost", remedy)


def check_latency_timers(hardware: Hardware, system: Path = Path("/sys")) -> list[Check]:
    """Look at the latency timers of the buses' USB adapters (Linux, FTDI); no check for ports that have none.

    Args:
        hardware: its ports.
        system: where sysfs is.
    """
    checks = []
    for name, bus in hardware.buses.items():
        device = Path(bus.port).resolve().name
        setting = system / "bus" / "usb-serial" / "devices" / device / "latency_timer"
        if setting.is_file():
            found = setting.read_text().strip()
            remedy = f"echo 1 | sudo tee {setting}, or a udev rule with ATTR{{latency_timer}}=1."
            checks.append(Check(name, "latency timer", found == "1", f"{found} ms", "1 ms", remedy, is_fatal=False))
    return checks


class ImuSamples(NamedTuple):
    """Readings of an IMU over a while.

    Attributes:
        gyro, accelerometer: (T, 3) rad/s and m/s2.
        temperature: degC, mean; NaN without a sample.
        seconds: how long was listened.
    """

    gyro: NDArray[np.float64]
    accelerometer: NDArray[np.float64]
    temperature: float
    seconds: float


def sample_imu(imu: Imu, clock: Clock, seconds: float = LOOK_TIME, period: float = 0.005) -> ImuSamples:
    """Listen to an IMU and return each new reading once.

    Raises:
        ImuGoneError: its port is gone.
    """
    imu.read()  # what came before does not count
    seen, start = imu.statistics.readings, clock.now()
    rows: list[NDArray[np.float64]] = []
    for tick in range(1, round(seconds / period) + 1):
        clock.wait_until(start + tick * period)
        reading = imu.read()
        if reading is not None and imu.statistics.readings > seen:
            seen = imu.statistics.readings
            rows.append(np.concatenate([reading.gyro, reading.accelerometer, [reading.temperature]]))
    table = np.array(rows).reshape(-1, 7)
    temperature = float(table[:, 6].mean()) if rows else float("nan")
    return ImuSamples(table[:, :3], table[:, 3:6], temperature, clock.now() - start)


def check_imu(imu: Imu, port: ImuPort, clock: Clock, seconds: float = LOOK_TIME) -> list[Check]:
    """Listen to the IMU of a robot that stands still on a level floor.

    Args:
        imu: open.
        port: what it should be.
        clock: what it is timed by.
        seconds: for how long.
    """
    try:
        imu.read()
        before = imu.statistics.readings, imu.statistics.lost, imu.statistics.errors
        samples = sample_imu(imu, clock, seconds)
    except ImuGoneError as error:
        return [Check("imu", "readings", False, str(error), "some", "Plug it in again, check its cable.")]
    if not len(samples.gyro):
        remedy = "Check its supply, its port and baud rate; a microcontroller must run the firmware that sends the frames."
        return [Check("imu", "readings", False, "none", f"{port.rate:g} a second", remedy)]
    count, lost, errors = (
        now - then
        for now, then in zip((imu.statistics.readings, imu.statistics.lost, imu.statistics.errors), before, strict=True)
    )
    checks = [Check("imu", "readings", True, f"{count}, at {samples.temperature:.0f} degC", "", "")]
    if port.driver == "stream":
        rate = (count + lost) / samples.seconds
        remedy = "Write the rate the microcontroller sends at into the hardware file, or raise its baud rate."
        near = abs(rate - port.rate) <= 0.1 * port.rate
        checks.append(Check("imu", "rate", near, f"{rate:.0f} Hz", f"{port.rate:g} Hz within 10 %", remedy, False))
    remedy = "Shorten the cable, keep it away from the motors' supply, check ground."
    found = f"{lost} lost, {errors} broken of {count + lost}"
    checks.append(Check("imu", "losses", lost + errors <= 0.01 * (count + lost), found, "1 % or less", remedy, False))
    return checks + _check_rest(samples)


def _check_rest(samples: ImuSamples) -> list[Check]:
    moved = motion(samples.gyro) / GYRO_REST, motion(samples.accelerometer) / ACCEL_REST
    if len(samples.gyro) < 2 or max(moved) > 1.0:
        remedy = "Keep the robot still and look again."
        return [Check("imu", "rest", False, "it moves", "a robot that stands still", remedy, False)]
    bias = float(np.linalg.norm(samples.gyro.mean(axis=0)))
    force = samples.accelerometer.mean(axis=0)
    length = float(np.linalg.norm(force))
    tilt = math.acos(min(1.0, max(-1.0, float(force[2]) / length))) if length > 0.0 else math.pi
    calibrate = "Run wlr calibrate imu"
    right, level = abs(length / STANDARD_GRAVITY - 1.0) < LARGEST_LENGTH_ERROR, f"{math.degrees(LARGEST_TILT):g} deg"
    gravity = f"{STANDARD_GRAVITY:.2f} within {LARGEST_LENGTH_ERROR:.0%}"
    scale = f"{calibrate} --poses 6; is accel_range the sensor's?"
    stand = "Stand the robot on a level floor; if it does, the sensor is mounted otherwise: wlr calibrate imu --mounting."
    return [
        Check("imu", "rest", True, "still", "", ""),
        Check("imu", "gyroscope", bias < LARGEST_RATE, f"{bias:.3f} rad/s", f"below {LARGEST_RATE:g}", f"{calibrate}.", False),
        Check("imu", "gravity", right, f"{length:.2f} m/s2", gravity, scale, False),
        Check("imu", "level", tilt < LARGEST_TILT, f"{math.degrees(tilt):.1f} deg", f"below {level}", stand),
    ]


def mend(servos: Servos, checks: Iterable[Check]) -> list[Check]:
    """Write the fixes of the checks that failed; return the ones that could not be mended.

    A servo whose torque is on is left alone: its EEPROM is locked, and what holds it might let go.

    Raises:
        BusGoneError: a port is gone.
    """
    left = []
    checks = list(checks)
    is_on = {check.where for check in checks if check.what == "torque" and not check.ok}
    for check in checks:
        if check.ok:
            continue
        try:
            if check.fix is None or check.where in is_on:
                left.append(check)
            else:
                servos.set(check.where, *check.fix)
        except (NoAnswerError, RefusedError):
            left.append(check)
    return left
