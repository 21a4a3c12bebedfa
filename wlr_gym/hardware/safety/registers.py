"""Registers of the servos that change what the robot does: looked at one by one, and repaired for who asks for it.

The EEPROM must hold what the hardware file's ``eeprom`` says, else the factory default (control tables, ROBOTIS e-manual). What
of the RAM matters, gains and profiles, is set before torque comes on and needs no look.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence

from wlr_gym.hardware.config import FIXED_REGISTERS, Bus
from wlr_gym.hardware.dynamixel.errors import NoAnswerError, RefusedError
from wlr_gym.hardware.dynamixel.tables import load_table
from wlr_gym.hardware.safety.check import Check
from wlr_gym.hardware.servos import Servos

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
    """Compare a servo's EEPROM with what it must hold; a check per item, by address.

    Raises:
        NoAnswerError, RefusedError, BusGoneError: see :class:`wlr_gym.hardware.dynamixel.bus.BusGroup`.
    """
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
    """Write the fixes of the checks that failed, and read them back; return the ones that are not mended.

    Raises:
        BusGoneError: a port is gone.
    """
    mended = [check for check in mendable(checks) if _is_mended(servos, check)]
    return [check for check in checks if not check.ok and check not in mended]


def _is_mended(servos: Servos, check: Check) -> bool:
    """Write a check's fix, and return whether the servo holds it."""
    assert check.fix is not None, "only what has a fix is mended"
    item, count = check.fix
    try:
        with contextlib.suppress(NoAnswerError):  # a servo with a low Status Return Level obeys without a word
            servos.set(check.where, item, count)
        return servos.get(check.where, item) == count
    except (NoAnswerError, RefusedError):
        return False
