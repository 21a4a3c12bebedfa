"""What must be true of servos and buses before anything moves: a list of checks, each with its remedy. Reads only."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wlr_gym.hardware.bus import NoAnswerError, RefusedError
from wlr_gym.hardware.config import Hardware
from wlr_gym.hardware.servos import Servos
from wlr_gym.hardware.tables import ControlTable, load_table
from wlr_gym.robot import JOINTS, Robot

FIRST_FIRMWARE, FAST_READ_FIRMWARE = 42, 45
#: degC at which a servo is too warm to start with: below the XL430's shutdown at 72 by enough for a run.
WARM = 60
#: Reads of all joints that are timed, and how long 99 of 100 may take at 50 Hz (s): a control period must hold a retry.
READS, BUDGET = 200, 0.010


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
    _Rule("operating_mode", None, "goals would be read as another quantity"),
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


def check_servos(servos: Servos, robot: Robot, hardware: Hardware) -> list[Check]:
    """Look at every servo and return all checks, good and bad, in joint order.

    Raises:
        BusGoneError: a port is gone.
    """
    return [check for joint in JOINTS for check in _check_servo(servos, robot, hardware, joint)]


def _check_servo(servos: Servos, robot: Robot, hardware: Hardware, joint: str) -> Iterator[Check]:
    bus_name, bus = next((name, bus) for name, bus in hardware.buses.items() if joint in bus.joints)
    id, table = robot.dynamixel_ids[joint], load_table(bus.model)
    try:
        number, firmware = servos.groups[bus_name].ping(id)
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
    errors = servos.hardware_errors(joint)
    remedy = "Find the cause, let the servo cool, then reboot it; the latch is there for a reason."
    yield Check(joint, "hardware error", not errors, ", ".join(errors) or "none", "none", remedy)
    latched = servos.get(joint, "bus_watchdog") < 0
    remedy = "Write bus_watchdog = 0: the line went silent in an earlier run, goals are refused until then."
    yield Check(joint, "watchdog", not latched, "latched" if latched else "clear", "clear", remedy, True, ("bus_watchdog", 0))
    on = bool(servos.get(joint, "torque_enable"))
    remedy = "Something else drives the robot, or a run ended badly. Switching off may drop it: hold it first."
    yield Check(joint, "torque", not on, "on" if on else "off", "off", remedy)
    voltage = servos.get(joint, "present_input_voltage")
    low, high = servos.get(joint, "min_voltage_limit"), servos.get(joint, "max_voltage_limit")
    remedy = "Charge the battery, or check supply and cables; power should be fed in on both sides of a long chain."
    yield Check(
        joint, "supply", low <= voltage <= high, f"{voltage / 10:.1f} V", f"{low / 10:.1f} to {high / 10:.1f} V", remedy
    )
    temperature = servos.get(joint, "present_temperature")
    yield Check(joint, "temperature", temperature < WARM, f"{temperature} degC", f"below {WARM} degC", "Let it cool down.")


def check_bus_speed(servos: Servos, reads: int = READS, budget: float = BUDGET) -> Check:
    """Time reads of all joints and compare the 99th percentile with the budget (s).

    Raises:
        BusGoneError: a port is gone.
    """
    times = np.empty(reads)
    lost = 0
    for k in range(reads):
        start = time.perf_counter()
        lost += int(8 - servos.read().answered.sum())
        times[k] = time.perf_counter() - start
    median, slow = np.percentile(times, [50, 99]) * 1e3
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


def mend(servos: Servos, checks: Iterable[Check]) -> list[Check]:
    """Write the fixes of the checks that failed; return the ones that could not be mended.

    The EEPROM is locked while torque is on; switch it off first.

    Raises:
        BusGoneError: a port is gone.
    """
    left = []
    for check in checks:
        if check.ok:
            continue
        try:
            if check.fix is None:
                left.append(check)
            else:
                servos.set(check.where, *check.fix)
        except (NoAnswerError, RefusedError):
            left.append(check)
    return left
