"""Preflight: checks of ports, servos and IMU before anything moves, each with its remedy. Reads only."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.calibration import ACCEL_REST, GYRO_REST, motion
from wlr_gym.hardware.config import Bus, FlowPort, Hardware, ImuPort
from wlr_gym.hardware.dynamixel.errors import NoAnswerError, RefusedError, RestlessLineError
from wlr_gym.hardware.dynamixel.tables import error_names, load_table
from wlr_gym.hardware.flow.driver import Flow
from wlr_gym.hardware.imu.driver import Imu
from wlr_gym.hardware.imu.frames import STANDARD_GRAVITY
from wlr_gym.hardware.imu.reading import ImuGoneError
from wlr_gym.hardware.ports import PortInUseError, is_pseudo_terminal
from wlr_gym.hardware.safety.check import Check
from wlr_gym.hardware.safety.registers import REPAIR, REQUIRED, check_answers, check_registers, expected_count
from wlr_gym.hardware.servos import JointMap, Servos
from wlr_gym.hardware.timing import processor_share
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
#: Share of a processor below which the computer is busy with other programs.
_OWN_SHARE = 0.9
#: How an emulated robot does without real time.
STEPPED = "end other programs, or drive it in emulated time, where nothing is late: wlr deploy --emulated --stepped"
#: s a sensor is looked at; and between two readings of the IMU, and of the flow sensor.
_LOOK_TIME, _IMU_PERIOD, _FLOW_PERIOD = 1.0, 0.005, 0.02
#: rad/s: mean flow below which the floor is at rest: two counts per frame of 121 a second are 0.5.
FLOW_REST = 0.1
#: s from emptying the IMU's port until what comes is of now.
SETTLE_TIME = 0.05
#: rad/s a calibrated gyroscope may read at rest.
LARGEST_RATE = 0.02
#: rad that gravity may be off the vertical.
LARGEST_TILT = math.radians(10.0)
#: Part that gravity's length may be off.
LARGEST_LENGTH_ERROR = 0.05


def open_ports(servos: Servos, imu: Imu, hardware: Hardware, flow: Flow | None = None) -> list[Check]:
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


def _plug_in(name: str) -> str:
    return f"Plug the adapter in, or name its port with --port {name}=PATH; {_ports_here()}."


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
    ok = slow <= budget * 1e3 and lost <= 0.01 * 8 * reads
    remedy = "" if ok else _speed_remedy(servos, now)
    return Check("robot", "bus speed", ok, found, f"p99 below {budget * 1e3:g} ms and 1 % lost", remedy)


def _speed_remedy(servos: Servos, now: Callable[[], float]) -> str:
    """Return what to do about a slow bus: it may be the computer that is slow."""
    share = processor_share(now)
    busy = f"a program that never waits gets {share:.0%} of a processor"
    if any(map(is_pseudo_terminal, servos.ports.values())):
        return f"This computer is too busy, or too slow, for an emulated robot in real time ({busy}): {STEPPED}."
    if share < _OWN_SHARE:
        return f"This computer is too busy to drive a robot ({busy}): end other programs, or use another computer."
    return "Set the adapters' latency timer to 1 ms, raise the baud rate, set return_delay_time = 0, check the cables."


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


def sample_imu(imu: Imu, clock: Clock, seconds: float = _LOOK_TIME) -> ImuSamples:
    """Listen to an IMU and return each new reading once.

    Raises:
        ImuGoneError: its port is gone.
    """
    imu.read()  # what came before does not count
    seen, start = imu.statistics.readings, clock.now()
    rows: list[NDArray[np.float64]] = []
    for tick in range(1, round(seconds / _IMU_PERIOD) + 1):
        clock.wait_until(start + tick * _IMU_PERIOD)
        reading = imu.read()
        if reading is not None and imu.statistics.readings > seen:
            seen = imu.statistics.readings
            rows.append(np.concatenate([reading.gyro, reading.accelerometer, [reading.temperature]]))
    table = np.array(rows).reshape(-1, 7)
    temperature = float(table[:, 6].mean()) if rows else float("nan")
    return ImuSamples(table[:, :3], table[:, 3:6], temperature, clock.now() - start)


def check_imu(imu: Imu, port: ImuPort, clock: Clock) -> list[Check]:
    """Listen to the IMU of a robot that stands still on a level floor.

    Args:
        imu: open.
        port: what it should be.
        clock: what it is timed by.
    """
    try:
        imu.read()  # what piled up does not count ...
        clock.wait_until(clock.now() + SETTLE_TIME)
        imu.read()  # ... nor what was thrown away behind it
        before = imu.statistics.readings, imu.statistics.lost, imu.statistics.errors
        samples = sample_imu(imu, clock)
    except ImuGoneError as error:
        return [Check("imu", "readings", False, str(error), "readings", "Plug it in again, check its cable.")]
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


def check_flow(flow: Flow, port: FlowPort, clock: Clock) -> list[Check]:
    """Listen to the optical-flow sensor of a robot that stands still on its floor.

    Args:
        flow: open.
        port: what it should be.
        clock: what it is timed by.
    """
    flow.read()  # what came before does not count
    before = flow.statistics.lost, flow.statistics.errors
    start, count = clock.now(), round(_LOOK_TIME / _FLOW_PERIOD)
    readings = []
    for tick in range(1, count + 1):
        clock.wait_until(start + tick * _FLOW_PERIOD)
        readings.append(flow.read())
    good = [reading for reading in readings if reading.is_new]
    trouble = next((reading.trouble for reading in reversed(readings) if reading.trouble), "")
    remedy = "Give it light and a floor with texture, 80 mm or more below it; check its supply, port and wiring."
    found = f"{len(good)} of {count}" + (f", {trouble}" if trouble else "")
    checks = [Check("flow", "readings", len(good) >= 0.9 * count, found, "a valid one in 9 of 10 control steps", remedy, False)]
    if not good:
        return checks
    quality = float(np.mean([reading.quality for reading in good]))
    checks.append(Check("flow", "quality", quality > 0.15, f"{quality:.2f}", "above 0.15", remedy, False))
    drift = float(np.linalg.norm(np.mean([reading.flow for reading in good], axis=0)))
    remedy = "Keep the robot still and look again; else something moves in its view."
    checks.append(Check("flow", "rest", drift < FLOW_REST, f"{drift:.3f} rad/s", f"below {FLOW_REST:g} rad/s", remedy, False))
    lost, errors = flow.statistics.lost - before[0], flow.statistics.errors - before[1]
    remedy = "Shorten the cable, keep it away from the motors' supply, check ground."
    checks.append(
        Check("flow", "losses", lost + errors <= 0.02 * count, f"{lost} lost, {errors} broken", "2 % or less", remedy, False)
    )
    calibrate = "Drive or push it straight on while you record, then run wlr calibrate flow."
    is_done = port.calibration.date is not None
    checks.append(Check("flow", "calibration", is_done, port.calibration.date or "never", "a date", calibrate, False))
    return checks


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
