"""Control table of one emulated servo as bytes, with its access rules and indirect addresses."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from wlr_gym.hardware.dynamixel.protocol import Error
from wlr_gym.hardware.dynamixel.tables import POSITION_MODE, TABLE_SIZE, ControlTable, Item

GOAL_REGISTERS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")


class Registers:
    """Items of a control table.

    Args:
        table: of the servo's model.
        present: item -> works out its count; done when the item is read.
        changed: called with an item's name after its count was set.

    Attributes:
        memory: the bytes.
        get: item -> the count it was set to last.
    """

    def __init__(self, table: ControlTable, present: Mapping[str, Callable[[], int]], changed: Callable[[str], None]) -> None:
        self.table = table
        self.memory: bytearray = bytearray(TABLE_SIZE)
        self._present = present
        self._changed = changed
        items = table.items.values()
        self._counts = dict.fromkeys(table.items, 0)  # of items that are set; set alone writes it
        self.get: Callable[[str], int] = self._counts.__getitem__
        self._at = {item.address + k: item for item in items for k in range(item.size)}
        self._pointers = {
            table[f"indirect_data_{k}"].address: table[f"indirect_address_{k}"]
            for k in range(1, 1 + sum(item.name.startswith("indirect_data") for item in items))
        }
        self._plans: dict[tuple[int, int], tuple[list[Item], list[int]]] = {}  # while no pointer is written

    # ---- by name ----

    def __getitem__(self, name: str) -> int:
        """Return the count an item holds now."""
        item = self.table[name]
        return self._refresh(item) if name in self._present else self.get(name)

    def set(self, name: str, count: int) -> None:
        """Put a count into an item past all access rules.

        Raises:
            InputError: unknown item, or a count that does not fit.
        """
        item = self.table[name]
        self.memory[item.address : item.address + item.size] = item.encode(count)
        self._counts[name] = int(count)
        if name.startswith("indirect_address"):
            self._plans.clear()
        self._changed(name)

    def load_defaults(self, in_eeprom: bool) -> None:
        """Set the items of the EEPROM, or of the RAM, to their defaults."""
        items = [item for item in self.table.items.values() if item.in_eeprom == in_eeprom]
        for item in items:  # plain defaults first: the others copy them
            self.set(item.name, item.default if isinstance(item.default, int) else 0)
        for item in items:
            if isinstance(item.default, str):
                self.set(item.name, self.get(item.default))

    # ---- by address ----

    def read(self, address: int, length: int) -> tuple[Error, bytes]:
        """Return ``length`` bytes from ``address``; gaps read as 0."""
        if length == 0 or address + length > TABLE_SIZE:
            return Error.ACCESS, b""
        block = (address, length)
        if block not in self._plans:
            self._plans[block] = self._plan(*block)
        kept_up, places = self._plans[block]
        for item in kept_up:
            self._refresh(item)
        return Error.NONE, bytes([self.memory[place] for place in places])

    def _plan(self, address: int, length: int) -> tuple[list[Item], list[int]]:
        """Return the items to work out before a block is read, and the addresses of the bytes that it stands for."""
        places = [self._resolve(place) for place in range(address, address + length)]
        inside = [item for place in places if (item := self._at.get(place)) and item.name in self._present]
        return list(dict.fromkeys(inside)), places

    def _refresh(self, item: Item) -> int:
        """Work an item out that the servo keeps up to date; return its count."""
        count = self._present[item.name]()
        self.memory[item.address : item.address + item.size] = item.encode(count)
        return count

    def _resolve(self, address: int) -> int:
        """Follow an Indirect Data byte to the byte it stands for."""
        pointer = self._pointers.get(address)
        return address if pointer is None else self.get(pointer.name)

    def check_write(self, address: int, data: bytes) -> tuple[Error, list[tuple[Item, int]]]:
        """Split a write into items with their new counts, and check each; nothing is written."""
        changes: list[tuple[Item, int]] = []
        place = 0
        while place < len(data):
            item = self._at.get(self._resolve(address + place)) if address + place < TABLE_SIZE else None
            if item is None:
                return Error.ACCESS, []
            targets = [self._resolve(address + place + k) for k in range(min(item.size, len(data) - place))]
            if targets != list(range(item.address, item.address + item.size)):
                return Error.DATA_LENGTH, []
            count = item.decode(data[place:])
            error = self._check(item, count)
            if error != Error.NONE:
                return error, []
            changes.append((item, count))
            place += item.size
        return (Error.NONE, changes) if data else (Error.DATA_LENGTH, [])

    def _check(self, item: Item, count: int) -> Error:
        if not item.writable or (item.in_eeprom and self.get("torque_enable")):
            return Error.ACCESS
        latched = self.get("bus_watchdog") < 0
        if latched and (item.name in GOAL_REGISTERS or (item.name == "bus_watchdog" and count != 0)):
            return Error.DATA_RANGE
        if item.name == "operating_mode":
            return Error.NONE if count in self.table.operating_modes else Error.DATA_RANGE
        if item.name == "goal_position" and self.get("operating_mode") != POSITION_MODE:
            return Error.NONE if abs(count) <= self.table.extended_range else Error.DATA_RANGE
        if not self._bound(item.low) <= count <= self._bound(item.high):
            return Error.DATA_LIMIT if isinstance(item.high, str) else Error.DATA_RANGE
        return Error.NONE

    def _bound(self, bound: int | str | None) -> int:
        if isinstance(bound, str):
            return -self.get(bound[1:]) if bound.startswith("-") else self.get(bound)
        assert bound is not None, "every writable item has bounds"
        return bound
