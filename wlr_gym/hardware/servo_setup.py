"""New servos: find them at any baud rate, give them their id, registers and baud rate."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import Bus
from wlr_gym.hardware.dynamixel.bus import BusGroup
from wlr_gym.hardware.dynamixel.errors import NoAnswerError, RefusedError
from wlr_gym.hardware.dynamixel.tables import BAUD_RATES, load_table

#: bit/s of a servo out of the box.
FACTORY_RATE = 57600
#: s an answer may take: nothing is in a hurry here.
_PATIENCE = 0.05


class FoundServo(NamedTuple):
    """A servo that answered a scan."""

    id: int
    baud_rate: int
    model_number: int
    firmware: int

    def __str__(self) -> str:
        return f"id {self.id} at {self.baud_rate} bit/s: model {self.model_number}, firmware {self.firmware}"


def find_servos(name: str, port: str, baud_rates: Sequence[int] = BAUD_RATES) -> list[FoundServo]:
    """Search a bus, whatever the ids; about 0.8 s for each baud rate. Servos that share an id may hide each other.

    Args:
        name: of the bus, for messages.
        port: its device, not open.
        baud_rates: to search at.

    Raises:
        InputError: the port is not there, or cannot be opened at any speed.
    """
    found, failures = [], []
    for baud_rate in baud_rates:
        try:
            with BusGroup(name, port, baud_rate, {}) as group:
                found += [FoundServo(id, baud_rate, *answer) for id, answer in group.scan().items()]
        except InputError as error:  # the SDK does not know every speed the servos do
            failures.append(error)
    if len(failures) == len(baud_rates):
        raise failures[0]
    return found


def check_new_servo(found: list[FoundServo], bus: Bus, joint: str) -> FoundServo:
    """Return the one servo that is connected.

    Raises:
        InputError: none, several, or one of another model.
    """
    table = load_table(bus.model)
    if len(found) != 1:
        seen = "; ".join(map(str, found)) or "none"
        raise InputError(f"connect the servo of {joint} alone, with power, to {bus.port}; found: {seen}")
    if found[0].model_number != table.model_number:
        raise InputError(f"{joint} needs an {bus.model} (model {table.model_number}); found: {found[0]}")
    return found[0]


def set_up(name: str, bus: Bus, servo: FoundServo, id: int) -> None:
    """Write the EEPROM of a servo: what the hardware file says, its id, then its baud rate; and see that it answers there.

    Raises:
        InputError: its torque is on, or it does not answer as it should afterwards.
        NoAnswerError, RefusedError: it does not take a value.
    """
    table = load_table(bus.model)
    with BusGroup(name, bus.port, servo.baud_rate, {servo.id: table, id: table}, _PATIENCE) as group:
        if group.read(servo.id, "torque_enable"):
            raise InputError(f"servo {servo}: its torque is on; the EEPROM is locked until it is off")
        for item, count in bus.eeprom.items():
            group.write(servo.id, item, count)
        for now, item, count in ((servo.id, "id", id), (id, "baud_rate", BAUD_RATES.index(bus.baud_rate))):
            with contextlib.suppress(NoAnswerError, RefusedError):  # the answer may come under either id, at either speed
                group.write(now, item, count)
    with BusGroup(name, bus.port, bus.baud_rate, {id: table}, _PATIENCE) as group:
        try:
            group.ping(id)
            wrong = {item: count for item in bus.eeprom if (count := group.read(id, item)) != bus.eeprom[item]}
        except NoAnswerError:
            raise InputError(
                f"no answer from id {id} at {bus.baud_rate} bit/s after it was set up: wlr doctor --scan"
            ) from None
        if wrong:
            raise InputError(f"id {id} holds {wrong} after it was set up, expected {bus.eeprom}")
