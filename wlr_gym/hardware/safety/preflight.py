"""Preflight: checks of ports, servos and sensors before anything moves, each with its remedy.

Looking writes nothing; :func:`mend` repairs registers for who asks for it. The servos' EEPROM must hold what the hardware
file's ``eeprom`` says, else the factory default (control tables, ROBOTIS e-manual). Gains and profiles, in RAM, are set before
torque comes on and need no look.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.calibration import ACCEL_REST, GYRO_REST, motion
from wlr_gym.hardware.camera.reading import CameraFile, CameraReader
from wlr_gym.hardware.config import FIXED_REGISTERS, Bus, FlowPort, Hardware, ImuPort
from wlr_gym.hardware.dynamixel.protocol import NoAnswerError, RefusedError, RestlessLineError
from wlr_gym.hardware.dynamixel.tables import error_names, load_table
from wlr_gym.hardware.flow import FlowStream
from wlr_gym.hardware.imu import COUNT_ENDS, IMU_AXES, RELATIVES, STANDARD_GRAVITY, Imu, ImuGoneError, ImuStream
from wlr_gym.hardware.safety.camera import LARGEST_AGE, LARGEST_SIGMA
from wlr_gym.hardware.serial_frames import FIRMWARE_VERSION, SENSORS, PortInUseError, is_pseudo_terminal
from wlr_gym.hardware.servos import JointMap, Servos
from wlr_gym.hardware.timing import Clock
from wlr_gym.robot import JOINTS, LEGS, Robot

#: Oldest firmware that is driven.
FIRST_FIRMWARE = 42
#: Oldest firmware with fast reads.
FAST_READ_FIRMWARE = 45
#: degC at which a servo is too warm to start with: below the XL430's shutdown at 72 by enough for a run.
WARM = 60
#: Reads before the timed ones: the bus finds out whether its servos know fast reads.
_UNTIMED_READS = 5
#: How an emulated robot does without real time.
STEPPED = "end other programs, or drive it in emulated time, where nothing is late: wlr deploy --emulated --stepped"
#: s a sensor is looked at; and between two readings of the IMU, and of the flow sensor.
_LOOK_TIME, _IMU_PERIOD, _FLOW_PERIOD = 1.0, 0.005, 0.02
#: rad/s: mean flow below which the floor is at rest: two counts per frame of 121 a second are 0.5.
FLOW_REST = 0.1
#: s from emptying the IMU's port until what comes is of now.
SETTLE_TIME = 0.05
#: s from opening the port until an Arduino's sensors send: its bootloader runs for 2. s the board's status may take.
BOOT_TIME, STATUS_TIME = 3.0, 0.3
#: rad/s a calibrated gyroscope may read at rest.
LARGEST_RATE = 0.02
#: rad that gravity may be off the vertical.
LARGEST_TILT = math.radians(10.0)
#: Part that gravity's length may be off.
LARGEST_LENGTH_ERROR = 0.05
#: s for which the camera is looked at, and between two looks.
_CAMERA_TIME, _CAMERA_PERIOD = 1.5, 0.005
#: Part of the frames asked for that must come, and of those with a floor that must show the robot.
_LEAST_RATE, _LEAST_POSES = 0.8, 0.8
#: Item of the EEPROM -> what another count does. Only items that some model has are looked at.
MEANING = {
    "return_delay_time": "each answer waits so long",
    "drive_mode": "it turns the direction round, gives profiles another unit, or lets a setpoint switch torque on",
    "operating_mode": "setpoints are read as another quantity",
    "secondary_id": "the servo also obeys what is written to that id",
    "homing_offset": "angles are off, and a watchdog stop may move the motor (DynamixelSDK #584)",
    "temperature_limit": "the motor is protected too late, or stops too early",
    "max_voltage_limit": "a good supply is reported as an error, or a bad one is not",
    "min_voltage_limit": "a good supply is reported as an error, or a bad one is not",
    "pwm_limit": "the motor gets a part of its voltage",
    "current_limit": "the motor gets a part of its current",
    "velocity_limit": "setpoints of speed are clipped, or refused",
    "max_position_limit": "setpoints are refused inside the leg's range, or taken outside it",
    "min_position_limit": "setpoints are refused inside the leg's range, or taken outside it",
    "startup_configuration": "torque or old setpoints come on with the power",
    "shutdown": "overload, overheating or electrical shock do not cut torque",
}
#: Items without a say in what the robot does, and those that a servo which answers has right.
IGNORED = ("id", "baud_rate", "protocol_type", "moving_threshold", *(f"external_port_mode_{k}" for k in (1, 2, 3)))
#: Items that no hardware file can ask for otherwise.
REQUIRED = ("operating_mode", *FIXED_REGISTERS)
#: Items that are only slow or inconvenient when they are wrong.
_WARNINGS = ("return_delay_time",)
#: Items in RAM that set how a motor moves: profiles, of which the default is none, and gains.
_TUNING = (
    *("profile_velocity", "profile_acceleration", "velocity_p_gain", "velocity_i_gain", "position_p_gain"),
    *("position_i_gain", "position_d_gain", "feedforward_1st_gain", "feedforward_2nd_gain"),
)
#: How to write it, for remedies.
REPAIR = "wlr doctor --mend writes it, and asks first"
#: Answers to everything.
_ANSWER_ALL = 2


class NotReadyError(RuntimeError):
    """The robot is not as it must be before it is driven; the message says what is wrong."""


class Check(NamedTuple):
    """One thing that was looked at."""

    where: str  #: joint, bus, or ``robot``
    what: str  #: name of the check
    ok: bool  #: as it should be
    found: str
    expected: str
    remedy: str  #: what to do about it
    is_fatal: bool = True  #: nothing may move while it is not ok; else a warning
    fix: tuple[str, int] | None = None  #: item and count to write (torque off) that would mend it; None = by hand

    def __str__(self) -> str:
        state = "ok" if self.ok else "FAULT" if self.is_fatal else "warning"
        text = f"{state:8}{self.where:10} {self.what}: {self.found}"
        return text if self.ok else f"{text}, expected {self.expected}. {self.remedy}"


# ---- ports ----


def open_ports(servos: Servos, imu: Imu, hardware: Hardware, flow: FlowStream | None = None) -> list[Check]:
    """Open every port that can be opened, and say which could not: a check per port. Who called closes them."""
    checks = []
    ports = {name: (group.open, hardware.buses[name].port) for name, group in servos.groups.items()}
    ports["imu"] = imu.open, hardware.imu.port
    if flow is not None and hardware.flow is not None:
        ports["flow"] = flow.open, hardware.flow.port
    for name, (open_port, path) in ports.items():
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
                found, remedy = "not there", _plug_in(name)
            checks.append(Check(name, "port", False, found, path, remedy))
    return checks


def require_ports(hardware: Hardware) -> None:
    """Raise :class:`InputError` where a port is not there: nobody needs to stand ready then."""
    for name, path in ({name: bus.port for name, bus in hardware.buses.items()} | {"imu": hardware.imu.port}).items():
        if not Path(path).exists():
            raise InputError(f"{name} port {path}: not there. {_plug_in(name)}")


def _plug_in(name: str, devices: Path = Path("/dev")) -> str:
    """What to do about a port that is not there, with the serial ports of this computer, those with stable names first."""
    named = sorted((devices / "serial" / "by-id").glob("*"))
    found = ", ".join(map(str, named or sorted([*devices.glob("ttyUSB*"), *devices.glob("ttyACM*")])))
    here = f"here are {found}" if found else "no USB serial port is here now"
    return f"Plug the adapter in, or name its port with --port {name}=PATH; {here}."


# ---- servos ----


def check_servos(servos: Servos, robot: Robot, hardware: Hardware, joints: Sequence[str] = JOINTS) -> list[Check]:
    """Look at the servos of some joints, whose ports are open, and return all checks, good and bad, in joint order."""
    return [check for joint in joints for check in _check_servo(servos, robot, hardware, joint)]


def _check_servo(servos: Servos, robot: Robot, hardware: Hardware, joint: str) -> Iterator[Check]:
    bus_name, bus = next((name, bus) for name, bus in hardware.buses.items() if joint in bus.joints)
    id, table = robot.dynamixel_ids[joint], load_table(bus.model)
    line = servos.groups[bus_name].statistics
    broken = line.crc_errors
    try:
        number, firmware = servos.ping(joint)
    except RestlessLineError:
        remedy = f"Are two ports swapped (an IMU's stream never ends)? Check wiring and termination of {bus_name} ({bus.port})."
        yield Check(joint, "answer", False, "none, the line is never quiet", f"one from id {id}", remedy)
        return
    except NoAnswerError:
        remedy = f"Check power, cable and adapter of bus {bus_name} ({bus.port}), and the servo's id and baud rate with a scan."
        found = "none"
        if broken := line.crc_errors - broken:
            found = f"{broken} broken packets"
            remedy = f"Is there a second servo with id {id}? Connect them one at a time. If not: {remedy}"
        yield Check(joint, "answer", False, found, f"one from id {id} at {bus.baud_rate} bit/s", remedy)
        return
    yield Check(joint, "answer", True, f"id {id}", "", "")
    remedy = "The hardware file names another model than is mounted, or ids are swapped."
    yield Check(joint, "model", number == table.model_number, str(number), f"{table.model_number} ({bus.model})", remedy)
    if number != table.model_number:
        return
    newer, remedy = f"{FIRST_FIRMWARE} or newer", "Update it (Dynamixel Wizard)."
    yield Check(joint, "firmware", firmware >= FIRST_FIRMWARE, str(firmware), newer, remedy)
    fast = f"{FAST_READ_FIRMWARE} or newer for fast reads"
    yield Check(joint, "fast reads", firmware >= FAST_READ_FIRMWARE, str(firmware), fast, "Update the firmware.", False)
    try:
        yield (answers := check_answers(servos, joint))
        if not answers.found.isdigit():
            return
        found = list(check_registers(servos, bus, bus_name, joint))
        yield from found
        if joint in LEGS and all(check.ok for check in found if check.what in REQUIRED):  # else its angle is another one
            yield check_leg(servos.joint_map, robot, hardware, joint, servos.get(joint, "present_position"))
        yield from _check_state(servos, hardware, bus, joint)
    except (NoAnswerError, RefusedError) as error:
        yield Check(joint, "reading", False, str(error), "answers", "The line is bad: check cable, termination and ground.")


def _check_state(servos: Servos, hardware: Hardware, bus: Bus, joint: str) -> Iterator[Check]:
    voltage = servos.get(joint, "present_input_voltage")
    low, high = expected_count(bus, "min_voltage_limit"), expected_count(bus, "max_voltage_limit")
    volt = load_table(bus.model).counts.voltage
    low = max(low, math.ceil(hardware.safety.low_voltage / volt - 1e-9))  # below it the run would stop at once
    expected = f"{low * volt:.1f} to {high * volt:.1f} V"
    remedy = "Charge the battery, or check supply and cables; power should be fed in on both sides of a long chain."
    yield Check(joint, "supply", low <= voltage <= high, f"{voltage * volt:.1f} V", expected, remedy)
    temperature = servos.get(joint, "present_temperature")
    yield Check(joint, "temperature", temperature < WARM, f"{temperature} degC", f"below {WARM} degC", "Let it cool down.")
    errors = error_names(servos.get(joint, "hardware_error_status"))
    remedy = "Find the cause, let the servo cool, then reboot it; the latch is there for a reason."
    yield Check(joint, "hardware error", not errors, ", ".join(errors) or "none", "none", remedy)
    latched = servos.get(joint, "bus_watchdog") < 0
    remedy = f"The line went silent in an earlier run, and setpoints are refused since: {REPAIR}."
    yield Check(joint, "watchdog", not latched, "latched" if latched else "clear", "clear", remedy, True, ("bus_watchdog", 0))
    on = bool(servos.get(joint, "torque_enable"))
    remedy = "Something else drives the robot, or a run ended badly. Switching off may drop it: hold it first."
    yield Check(joint, "torque", not on, "on" if on else "off", "off", remedy)


def check_leg(joint_map: JointMap, robot: Robot, hardware: Hardware, joint: str, count: int) -> Check:
    """Is a leg inside its range and its servo's turn? One that is not went past something: it is not driven back."""
    bus = next(bus for bus in hardware.buses.values() if joint in bus.joints)
    angle = float(joint_map.position(np.full(len(JOINTS), count))[JOINTS.index(joint)])
    low, high = expected_count(bus, "min_position_limit"), expected_count(bus, "max_position_limit")
    first, last = robot.leg_limits
    ends = [int(joint_map.setpoint_counts(np.full(len(JOINTS), end))[JOINTS.index(joint)]) for end in (first, last)]
    if not low <= min(ends) <= max(ends) <= high:
        found, expected = f"{min(ends)} to {max(ends)} counts", f"within {low} to {high}"
        remedy = "Sign or zero in the hardware file are wrong: wlr calibrate joints."
        return Check(joint, "range", False, found, expected, remedy)
    margin = hardware.safety.leg_margin  # a leg may rest on its stop
    ok = low <= count <= high and first - margin <= angle <= last + margin
    found, expected = f"{angle:.2f} rad ({count})", f"{first:g} to {last:g} rad, and {low} to {high} counts"
    remedy = (
        "It is not driven back through what it went past: turn it back by hand, torque is off. "
        "If it is where it should be, its zero is wrong: wlr calibrate joints."
    )
    return Check(joint, "position", ok, found, expected, remedy)


# ---- registers of the servos that change what the robot does ----


def reset_tuning(servos: Servos, joint: str) -> None:
    """Set a joint's gains and profiles to their defaults, as after a reboot: no profile."""
    for item in _TUNING:
        default = servos.table(joint)[item].default
        assert isinstance(default, int)
        servos.set(joint, item, default)


def expected_count(bus: Bus, item: str) -> int:
    """Return what an EEPROM item of a bus's servos must hold: the hardware file's count, else the factory default."""
    default = load_table(bus.model)[item].default
    assert isinstance(default, int), "only items with a default of their own are looked at"
    return bus.eeprom.get(item, default)


def check_answers(servos: Servos, joint: str) -> Check:
    """Look at Status Return Level of a servo that answered a ping: does it answer reads and writes too?"""
    item = "status_return_level"
    try:
        found = str(level := servos.get(joint, item))
    except NoAnswerError:
        found, level = "no answer to reads", None
    remedy = f"Refused writes would go unnoticed: {REPAIR}. If it does not help, the line is bad: check cable and ground."
    return Check(joint, item, level == _ANSWER_ALL, found, str(_ANSWER_ALL), remedy, True, (item, _ANSWER_ALL))


def check_registers(servos: Servos, bus: Bus, bus_name: str, joint: str) -> Iterator[Check]:
    """Compare a servo's EEPROM with what it must hold; a check per item, by address."""
    for item in (name for name in load_table(bus.model).items if name in MEANING):
        expected, found = expected_count(bus, item), servos.get(joint, item)
        if found != expected:
            found = servos.get(joint, item)  # a late answer to another question looks like this, once
        remedy = f"Else {MEANING[item]}: {REPAIR}."
        if item not in REQUIRED:
            remedy += f" If {found} is meant, give it in buses.{bus_name}.eeprom of the hardware file."
        is_fatal = item not in _WARNINGS
        yield Check(joint, item, found == expected, str(found), str(expected), remedy, is_fatal, (item, expected))


def mendable(checks: Iterable[Check]) -> list[Check]:
    """Return the checks that failed and whose fix can be written.

    A servo whose torque is on is left alone: its EEPROM is locked, and what holds it might let go.
    """
    wrong = [check for check in checks if not check.ok]
    is_on = {check.where for check in wrong if check.what == "torque"}
    return [check for check in wrong if check.fix is not None and check.where not in is_on]


def mend(servos: Servos, checks: Sequence[Check]) -> list[Check]:
    """Write the fixes of the checks that failed, and read them back; return the ones that are not mended."""
    mended = []
    for check in mendable(checks):
        assert check.fix is not None
        item, count = check.fix
        with contextlib.suppress(NoAnswerError, RefusedError):
            with contextlib.suppress(NoAnswerError):  # a servo with a low Status Return Level obeys without a word
                servos.set(check.where, item, count)
            if servos.get(check.where, item) == count:
                mended.append(check)
    return [check for check in checks if not check.ok and check not in mended]


# ---- the line ----


def check_bus_speed(servos: Servos, reads: int, budget: float, now: Callable[[], float] = time.perf_counter) -> Check:
    """Time reads of all joints by a clock (s) and compare the 99th percentile with the budget (s)."""
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
    ok = slow <= budget * 1e3 and lost <= 0.01 * 8 * reads
    remedy = "Set the adapters' latency timer to 1 ms, raise the baud rate, set return_delay_time = 0, check the cables."
    remedy += " End other programs: a busy computer is as slow."
    if any(map(is_pseudo_terminal, servos.ports.values())):
        remedy = f"This computer is too busy, or too slow, for an emulated robot in real time: {STEPPED}."
    return Check("robot", "bus speed", ok, found, f"p99 below {budget * 1e3:g} ms and 1 % lost", "" if ok else remedy)


def check_latency_timers(hardware: Hardware, system: Path = Path("/sys")) -> list[Check]:
    """Look at the latency timers of the buses' USB adapters (Linux, FTDI; sysfs); no check for ports that have none."""
    checks = []
    for name, bus in hardware.buses.items():
        device = Path(bus.port).resolve().name
        setting = system / "bus" / "usb-serial" / "devices" / device / "latency_timer"
        if setting.is_file():
            found = setting.read_text().strip()
            remedy = f"echo 1 | sudo tee {setting}, or a udev rule with ATTR{{latency_timer}}=1."
            checks.append(Check(name, "latency timer", found == "1", f"{found} ms", "1 ms", remedy, is_fatal=False))
    return checks


# ---- sensors ----


class ImuSamples(NamedTuple):
    """Readings of an IMU over a while."""

    gyro: NDArray[np.float64]  #: (T, 3) rad/s
    accelerometer: NDArray[np.float64]  #: (T, 3) m/s2
    temperature: float  #: degC, mean; NaN without a sample
    seconds: float  #: for which was listened
    counts: NDArray[np.float64]  #: (T, 6) of the chip's axes: :data:`wlr_gym.hardware.imu.IMU_AXES`


def sample_imu(imu: Imu, clock: Clock, seconds: float = _LOOK_TIME) -> ImuSamples:
    """Listen to an IMU and return each new reading once."""
    imu.read()  # what came before does not count
    seen, start = imu.statistics.readings, clock.now()
    rows: list[NDArray[np.float64]] = []
    for tick in range(1, round(seconds / _IMU_PERIOD) + 1):
        clock.wait_until(start + tick * _IMU_PERIOD)
        reading = imu.read()
        if reading is not None and imu.statistics.readings > seen:
            seen = imu.statistics.readings
            rows.append(np.concatenate([reading.gyro, reading.accelerometer, [reading.temperature], reading.counts]))
    table = np.array(rows).reshape(-1, 13)
    temperature = float(table[:, 6].mean()) if rows else float("nan")
    return ImuSamples(table[:, :3], table[:, 3:6], temperature, clock.now() - start, table[:, 7:])


_LIGHT = "Give it light and a floor with texture, 80 mm or more below it; check its supply, port and wiring."
#: Counters of the board's status.
_BOARD_FAULTS = ("bus_errors", "bus_locks", "imu_restarts", "imu_missed", "flow_restarts", "line_full")
_CABLE = "Shorten the cable, keep it away from the motors' supply, check ground."
#: Sensor -> check -> what to do where it fails.
_REMEDIES = {
    "imu": {
        "readings": "Check its supply, its port and baud rate; a microcontroller must run the firmware that sends the frames.",
        "rate": "Write the rate the microcontroller sends at into the hardware file, or raise its baud rate.",
        "losses": _CABLE,
        "axis": "It measures nothing: check supply and wires of the chip, power it off and on, else exchange it.",
        "rest": "Keep the robot still and look again.",
        "gyroscope": "Run wlr calibrate imu.",
        "gravity": "Run wlr calibrate imu --poses 6; is accel_range the sensor's?",
        "level": "Stand the robot on a level floor; if it does, the sensor is mounted otherwise: wlr calibrate imu --mounting.",
    },
    "flow": {
        "readings": _LIGHT,
        "quality": _LIGHT,
        "rest": "Keep the robot still and look again; else something moves in its view.",
        "losses": _CABLE,
        "calibration": "Drive or push it straight on while you record, then run wlr calibrate flow.",
    },
    "camera": {
        "frames": "Check its plug.",
        "rate": "Lower the resolution or the exposure time, or write the rate that comes into the camera's file (rate).",
        "shutter": "Calibrate from a video of a moving board, or write its readout (s; 0 = global shutter) into that file.",
        "floor": "Are all floor markers in the picture, flat, lit, and where the floor's file says?",
        "robot": "Is the robot in the picture, its plate on, and its markers as the body's file says?",
        "age": "Use USB 3, fewer pixels, a shorter exposure; find out who else uses the computer.",
        "accuracy": "Bring the camera nearer, use more pixels, focus it, or print larger markers.",
    },
}


def _sensor_check(where: str, what: str, ok: bool, found: str, expected: str, is_fatal: bool = False) -> Check:
    return Check(where, what, bool(ok), found, expected, _REMEDIES[where.partition(" ")[0]][what], is_fatal)


def check_imu(imu: Imu, port: ImuPort, clock: Clock) -> list[Check]:
    """Listen to the IMU, which is open, of a robot that stands still on a level floor."""
    try:
        end = clock.now() + BOOT_TIME
        while imu.read() is None and clock.now() < end:  # what piled up does not count ...
            clock.wait_until(clock.now() + SETTLE_TIME)
        clock.wait_until(clock.now() + SETTLE_TIME)
        imu.read()  # ... nor what was thrown away behind it
        before = replace(imu.statistics)
        samples = sample_imu(imu, clock)
    except ImuGoneError as error:
        return [Check("imu", "readings", False, str(error), "readings", "Plug it in again, check its cable.")]
    if not len(samples.gyro):
        return [_sensor_check("imu", "readings", False, "none", f"{port.rate:g} a second", True)]
    now = imu.statistics
    count, lost, errors = now.readings - before.readings, now.lost - before.lost, now.errors - before.errors
    checks = [Check("imu", "readings", True, f"{count}, at {samples.temperature:.0f} degC", "", "")]
    if port.driver == "stream":
        rate = (count + lost) / samples.seconds
        near = abs(rate - port.rate) <= 0.1 * port.rate
        checks.append(_sensor_check("imu", "rate", near, f"{rate:.0f} Hz", f"{port.rate:g} Hz within 10 %"))
    found, few = f"{lost} lost, {errors} broken of {count + lost}", lost + errors <= 0.01 * (count + lost)
    checks.append(_sensor_check("imu", "losses", few, found, "1 % or less"))
    checks += _check_axes(samples.counts)
    if len(samples.gyro) < 2 or motion(samples.gyro) > GYRO_REST or motion(samples.accelerometer) > ACCEL_REST:
        return [*checks, _sensor_check("imu", "rest", False, "it moves", "a robot that stands still")]
    bias, force = float(np.linalg.norm(samples.gyro.mean(axis=0))), samples.accelerometer.mean(axis=0)
    length = float(np.linalg.norm(force))
    tilt = math.acos(min(1.0, max(-1.0, float(force[2]) / length))) if length > 0.0 else math.pi
    right, gravity = abs(length / STANDARD_GRAVITY - 1.0) < LARGEST_LENGTH_ERROR, f"{STANDARD_GRAVITY:.2f}"
    level = f"below {math.degrees(LARGEST_TILT):g} deg"
    return [
        *checks,
        Check("imu", "rest", True, "still", "", ""),
        _sensor_check("imu", "gyroscope", bias < LARGEST_RATE, f"{bias:.3f} rad/s", f"below {LARGEST_RATE:g}"),
        _sensor_check("imu", "gravity", right, f"{length:.2f} m/s2", f"{gravity} within {LARGEST_LENGTH_ERROR:.0%}"),
        _sensor_check("imu", "level", tilt < LARGEST_TILT, f"{math.degrees(tilt):.1f} deg", level, True),
    ]


def _check_axes(counts: NDArray[np.float64]) -> Iterator[Check]:
    """Does every axis move its last bits, inside its range? One that does not measures nothing."""
    for axis, column in zip(IMU_AXES, counts.T, strict=True):
        at_end, spread = bool(np.isin(column, COUNT_ENDS).any()), float(np.ptp(column))
        found = f"{column[-1]:.0f} counts, {'the end of its range' if at_end else f'noise of {spread:.0f}'}"
        if at_end or spread == 0.0:
            yield _sensor_check("imu", "axis", False, f"{axis} reads {found}", "noise, inside the range", True)


def board_status(imu: ImuStream, clock: Clock) -> dict[str, int] | None:
    """Ask an IMU's board, which is open, for its status; None = it does not answer."""
    try:
        imu.request_status()
    except ConnectionError as error:
        raise ImuGoneError(f"IMU port {imu.path} is {error}") from None
    end = clock.now() + STATUS_TIME
    while imu.parser.status is None and clock.now() < end:
        clock.wait_until(clock.now() + _IMU_PERIOD)
        imu.read()
    return imu.parser.status


def check_board(imu: ImuStream, port: ImuPort, clock: Clock) -> list[Check]:
    """Ask the microcontroller of the IMU, which is open, for its firmware, settings and faults."""
    flash, version = "Flash it: docs/build.md.", ".".join(map(str, FIRMWARE_VERSION))
    try:
        status = board_status(imu, clock)
    except ImuGoneError as error:
        return [Check("imu", "board", False, str(error), version, "Plug it in again, check its cable.")]
    if status is None:
        return [Check("imu", "board", False, "it does not say", version, flash, is_fatal=False)]
    found = f"{status['version_major']}.{status['version_minor']}"
    checks = [Check("imu", "board", status["version_major"] == FIRMWARE_VERSION[0], found, version, flash, is_fatal=False)]
    if not status["sensors"] & SENSORS["imu"]:
        identity = status["imu_identity"]
        name = f"{identity:#04x} ({RELATIVES.get(identity, 'another chip')})" if identity else "nobody answers"
        checks.append(
            Check("imu", "chip", False, name, "an MPU-6050 (0x68)", "Check its wiring (SDA, SCL, INT), supply, chip.")
        )
    units = {"rate": "Hz", "gyro_range": "deg/s", "accel_range": "g", "bandwidth": "Hz bandwidth"}
    has = {name: status["imu_rate" if name == "rate" else name] for name in units}
    told, asked = (", ".join(f"{values[name]:g} {units[name]}" for name in units) for values in (has, port.model_dump()))
    remedy = "Write what the board says into the hardware file (imu), or flash it with the file's settings."
    checks.append(Check("imu", "settings", told == asked, told, asked, remedy))
    faults = {name.replace("_", " "): status[name] for name in _BOARD_FAULTS if status[name]}
    listed = ", ".join(f"{count} {name}" for name, count in faults.items()) or "none"
    return [*checks, Check("imu", "board faults", not faults, listed, "none since its reset", _CABLE, is_fatal=False)]


def check_flow(flow: FlowStream, port: FlowPort, clock: Clock) -> list[Check]:
    """Listen to the optical-flow sensor, which is open, of a robot that stands still on its floor."""
    flow.read()  # what came before does not count
    before = replace(flow.statistics)
    start, count = clock.now(), round(_LOOK_TIME / _FLOW_PERIOD)
    readings = []
    for tick in range(1, count + 1):
        clock.wait_until(start + tick * _FLOW_PERIOD)
        readings.append(flow.read())
    good = [reading for reading in readings if reading.is_new]
    trouble = next((f", {reading.trouble}" for reading in reversed(readings) if reading.trouble), "")
    found, often = f"{len(good)} of {count}{trouble}", len(good) >= 0.9 * count
    checks = [_sensor_check("flow", "readings", often, found, "a valid one in 9 of 10 control steps")]
    if not good:
        return checks
    quality = float(np.mean([reading.quality for reading in good]))
    drift = float(np.linalg.norm(np.mean([reading.flow for reading in good], axis=0)))
    lost, errors = flow.statistics.lost - before.lost, flow.statistics.errors - before.errors
    few, date = lost + errors <= 0.02 * count, port.calibration.date
    return [
        *checks,
        _sensor_check("flow", "quality", quality > 0.15, f"{quality:.2f}", "above 0.15"),
        _sensor_check("flow", "rest", drift < FLOW_REST, f"{drift:.3f} rad/s", f"below {FLOW_REST:g} rad/s"),
        _sensor_check("flow", "losses", few, f"{lost} lost, {errors} broken", "2 % or less"),
        _sensor_check("flow", "calibration", date is not None, date or "never", "a date"),
    ]


def check_camera(camera: CameraReader, file: CameraFile, clock: Clock) -> list[Check]:
    """Return the checks of a camera, which is opened for them; closing the link closes it.

    Only a camera without frames is a fault; a robot drives without poses.
    """
    from wlr_gym.perception.vision.tracking import MEANINGS, NO_FLOOR  # a robot without a camera does without the finder

    where = f"camera {file.name}"
    try:
        camera.open()
    except InputError as error:
        remedy = "Check its plug, number and user group."
        return [Check(where, "frames", False, str(error), "a camera that gives frames", remedy)]
    readings, end = [], clock.now() + _CAMERA_TIME
    while clock.now() < end:
        if (reading := camera.read(clock.now())) is not None:
            readings.append(reading)
        clock.wait_until(clock.now() + _CAMERA_PERIOD)
    checks = [_sensor_check(where, "frames", bool(readings), f"{len(readings)} in {_CAMERA_TIME:g} s", "frames", True)]
    if not readings:
        return checks
    rate, age = len(readings) / _CAMERA_TIME, float(np.median([reading.found - reading.time for reading in readings]))
    stamps = f" (dated by {dated})" if (dated := getattr(camera, "stamps", "")) else ""
    oldest, readout = LARGEST_AGE / 2, file.doubt or f"readout {1e3 * (file.calibration.readout or 0.0):g} ms"
    located = [reading for reading in readings if reading.reason != MEANINGS[NO_FLOOR]]
    checks += [
        _sensor_check(where, "rate", rate >= _LEAST_RATE * file.rate, f"{rate:.1f} per second", f"{file.rate:g}"),
        _sensor_check(where, "age", age < oldest, f"{1e3 * age:.0f} ms{stamps}", f"< {1e3 * oldest:.0f} ms"),
        _sensor_check(where, "shutter", not file.doubt, readout, "its readout"),
        _sensor_check(where, "floor", bool(located), "found" if located else MEANINGS[NO_FLOOR], "its markers found"),
    ]
    if not located:
        return checks
    seen = [reading for reading in located if not reading.reason]
    lost = Counter(reading.reason for reading in located if reading.reason)
    found = f"in {len(seen)} of {len(located)} frames" + "".join(f"; {why}: {count}" for why, count in lost.most_common())
    checks.append(_sensor_check(where, "robot", len(seen) >= _LEAST_POSES * len(located), found, "seen in all"))
    if seen:
        x, y, _, yaw, *_ = np.sqrt(np.median([np.diag(reading.covariance) for reading in seen], axis=0)).tolist()
        is_sharp = max(x, y) < LARGEST_SIGMA[0] / 2 and yaw < LARGEST_SIGMA[1] / 2
        found = f"{1e3 * max(x, y):.2f} mm, {yaw:.4f} rad (1 sigma)"
        expected = f"{500 * LARGEST_SIGMA[0]:g} mm, {LARGEST_SIGMA[1] / 2:g} rad"
        checks.append(_sensor_check(where, "accuracy", is_sharp, found, expected))
    return checks
