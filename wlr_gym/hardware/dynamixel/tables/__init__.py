"""Control tables of the servos, as data: one YAML file per model, read into :class:`ControlTable`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.settings import read_yaml
from wlr_gym.physics.servo import REGISTER_UNITS

#: Below this address items live in the EEPROM: kept without power, locked while torque is on.
FIRST_RAM_ADDRESS = 64
#: Bytes of address space; reading beyond is an access error.
TABLE_SIZE = 662
#: Baud Rate register -> bits per second.
BAUD_RATES = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
# Values of Operating Mode.
CURRENT_MODE = 0
VELOCITY_MODE = 1
POSITION_MODE = 3
EXTENDED_POSITION_MODE = 4
CURRENT_POSITION_MODE = 5
PWM_MODE = 16
POSITION_MODES = (POSITION_MODE, EXTENDED_POSITION_MODE, CURRENT_POSITION_MODE)

# Bits of Hardware Error Status and Shutdown that the emulator sets.
INPUT_VOLTAGE = 0x01
OVERHEATING = 0x04
OVERLOAD = 0x20
#: Hardware Error Status and Shutdown bits.
HARDWARE_ERRORS = {
    INPUT_VOLTAGE: "input voltage",
    OVERHEATING: "overheating",
    0x08: "encoder",
    0x10: "electrical shock",
    OVERLOAD: "overload",
}

Bound = int | str | None


def error_names(bits: int) -> list[str]:
    """Return the names of the errors in Hardware Error Status."""
    return [name for bit, name in HARDWARE_ERRORS.items() if bits & bit]


@dataclass(frozen=True)
class Item:
    """One row of a control table.

    Attributes:
        name: spelled as in the e-manual, lower case with underscores.
        address, size: bytes.
        signed: two's complement.
        writable: False = read only.
        default: count after a reset; a string names the item it is copied from; None = the servo sets it.
        low, high: bounds of a write in counts; a string names the item that is the bound, with ``-`` for its negative.
        quantity: unit of a count: a row of ``servo.REGISTER_UNITS``, ``degC``, ``ms``, ``2us``; None = a plain number.
    """

    name: str
    address: int
    size: int
    signed: bool
    writable: bool
    default: Bound = None
    low: Bound = None
    high: Bound = None
    quantity: str | None = None

    @property
    def in_eeprom(self) -> bool:
        """Kept without power; locked while torque is on."""
        return self.address < FIRST_RAM_ADDRESS

    def encode(self, count: int) -> bytes:
        """Return ``count`` as the item's bytes.

        Raises:
            InputError: it does not fit.
        """
        try:
            return int(count).to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            raise InputError(f"{self.name} = {count} does not fit {self.size} bytes") from None

    def decode(self, data: bytes | bytearray) -> int:
        """Return the count in the item's bytes."""
        return int.from_bytes(data[: self.size], "little", signed=self.signed)


@dataclass(frozen=True)
class ControlTable:
    """Control table of one servo model.

    Attributes:
        model: name as in ``servo.REGISTER_UNITS``.
        model_number: what a ping answers.
        operating_modes: values Operating Mode takes.
        items: by name, in order of address.
    """

    model: str
    model_number: int
    operating_modes: tuple[int, ...]
    items: Mapping[str, Item]

    def __getitem__(self, name: str) -> Item:
        if name not in self.items:
            raise unknown_name("control table item", name, self.items, self.model)
        return self.items[name]

    def per_count(self, name: str) -> float:
        """Return the SI value of one count of item ``name``.

        Raises:
            InputError: unknown item, or one that is no physical quantity.
        """
        quantity = self[name].quantity
        if quantity is None or quantity not in REGISTER_UNITS[self.model]:
            raise InputError(f"{self.model} {name} has no SI unit")
        return REGISTER_UNITS[self.model][quantity].per_count

    def block(self, first: str, last: str) -> tuple[int, int]:
        """Return address and length of the block from item ``first`` to item ``last``."""
        start, end = self[first], self[last]
        return start.address, end.address + end.size - start.address


@cache
def load_table(model: str) -> ControlTable:
    """Load the control table of a servo model, for example ``XM540-W150-R``.

    Raises:
        InputError: unknown model; the message lists the known ones.
    """
    files = {read_yaml(path)["model"]: path for path in Path(__file__).parent.glob("*_*.yaml") if path.stem != "x_series"}
    if model not in files:
        raise unknown_name("servo model", model, files)
    data = read_yaml(files[model])
    series = read_yaml(files[model].with_name(data["series"] + ".yaml"))
    fixed: dict[str, dict[str, Any]] = {"model_number": {"default": data["model_number"]}}
    changed = data["changed"] | fixed
    rows = [_item(row, changed) for part in (series, data) for area in ("eeprom", "ram") for row in part.get(area, ())]
    rows += [item for block in series["indirect"] for item in _indirect(*block)]
    rows.sort(key=lambda item: item.address)
    return ControlTable(data["model"], data["model_number"], tuple(data["operating_modes"]), {item.name: item for item in rows})


def _item(row: list[Any], changed: Mapping[str, Mapping[str, Any]]) -> Item:
    address, kind, name, access, default, low, high, quantity = row
    item = Item(name, address, int(kind[1]), kind[0] == "i", access == "rw", default, low, high, quantity)
    return replace(item, **changed.get(name, {}))


def _indirect(number: int, address: int, data: int, count: int) -> Iterable[Item]:
    for k in range(count):
        pointer = (data + k, FIRST_RAM_ADDRESS, TABLE_SIZE - 1)
        yield Item(f"indirect_address_{number + k}", address + 2 * k, 2, False, True, *pointer)
        yield Item(f"indirect_data_{number + k}", data + k, 1, False, True, 0, 0, 255)
