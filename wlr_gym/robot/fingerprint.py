"""Fingerprints of a robot: equal where a simulator reads equal numbers. Policy files carry them, and are refused elsewhere.

The canonical form is one line ``key = value`` per number, sorted, under a title with the version of the form. A number that has
its declared default is left out, so that a new field with a default changes the fingerprint of no robot that does not use it.
Not in it: name, bus addresses, order of joints (there is one only) and tolerances; nor what turns a motor's torque into its
current and into counts, which changes energy and the rounding of a sensor, but no motion: a policy from ``nominal`` fits
``emanual``; nor an optical-flow sensor: a policy that does not read one fits a robot that has it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from wlr_gym.robot.description import Robot

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
    lines = [f"{title} {HASH_FORM}", *sorted(_lines(model, ""))]
    return f"{HASH_FORM}-{hashlib.sha256(chr(10).join(lines).encode()).hexdigest()[:16]}"


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
