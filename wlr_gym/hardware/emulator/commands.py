"""Lines of text that an emulated robot takes: faults, ``clear``, ``faults``, ``status``, ``turn``, ``straighten``, ``help``."""

from __future__ import annotations

import numpy as np

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.hardware.dynamixel.tables import error_names
from wlr_gym.hardware.emulator.faults import FAULTS
from wlr_gym.hardware.emulator.machine import Machine


def run_command(machine: Machine, text: str) -> str:
    """Carry out one line of text and return the answer.

    Raises:
        InputError: it cannot be understood.
    """
    word, *rest = text.split() or ["help"]
    if word in FAULTS:
        return f"{machine.time:.3f} s: {machine.inject(text)}"
    if word == "clear":
        if rest and rest[0] not in FAULTS:
            raise unknown_name("fault", rest[0], FAULTS)
        machine.clear(rest[0] if rest else None)
        return "cleared"
    if word == "turn":
        return _turn(machine, text, rest)
    if word == "straighten":
        machine.straighten(" ".join(rest))
        return f"{rest[0]} hangs straight down"
    if word == "faults":
        return "\n".join(machine.faults.listing(machine.time)) or "no faults"
    if word == "status":
        return _status(machine)
    if word == "help":
        return _help()
    raise unknown_name("command", word, ["faults", "status", "help", "clear", "turn", "straighten", *FAULTS])


def _turn(machine: Machine, text: str, words: list[str]) -> str:
    try:
        joint, degrees = words
        angle = float(np.deg2rad(float(degrees)))
    except ValueError:
        raise InputError(f"'{text}': expected turn JOINT DEGREES") from None
    machine.turn(joint, angle)
    return f"{joint} turned by {degrees} deg"


def _status(machine: Machine) -> str:
    """One line per servo: torque, mode, position, velocity, supply, temperature, errors."""
    lines = [f"{machine.time:.3f} s"]
    for joint, servo in machine.servos.items():
        errors = ", ".join(error_names(servo["hardware_error_status"])) or "no error"
        power = "no power" if servo.dead else "torque on" if servo["torque_enable"] else "torque off"
        lines.append(
            f"{joint:9} id {servo['id']:3}  {power:10}  mode {servo['operating_mode']:2}"
            f"  position {servo['present_position']:6}  velocity {servo['present_velocity']:4}"
            f"  {servo['present_input_voltage'] / 10:4.1f} V  {servo['present_temperature']:3} degC  {errors}"
        )
    return "\n".join(lines)


def _help() -> str:
    lines = [
        "status | faults | clear [KIND] | turn JOINT DEGREES | straighten LEG | help",
        "KIND [WHERE ...] [probability=] [value=] [after=] [duration=]",
    ]
    for name, kind in FAULTS.items():
        value = f" (value: {kind.unit}, default {kind.value:g})" if kind.unit else ""
        lines.append(f"  {name:9} {kind.doc}{value}")
    return "\n".join(lines)
