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
    """

    def __init__(self, table: ControlTable, present: Mapping[str, Callable[[], int]], changed: Callable[[str], None]) -> None:
        self.table = table
        self.memory: bytearray = bytearray(TABLE_SIZE)
        self._present = present
        self._changed = changed
        items = table.items.values()
        self._places = {item.name: (item.address, item.address + item.size, item.signed) for item in items}
        self._at = {item.address + k: item for item in items for k in range(item.size)}
        self._pointers = {
            table[f"indirect_data_{k}"].address: table[f"indirect_address_{k}"]
            for k in range(1, 1 + sum(item.name.startswith("indirect_data") for item in items))
        }
        self._kept_up: dict[tuple[int, int], list[Item]] = {}

    # ---- by name ----

    def __getitem__(self, name: str) -> int:
        """Return the count an item holds now."""
        self._refresh(self.table[name])
        return self.get(name)

    def get(self, name: str) -> int:
        """Return the count an item was set to last."""
        start, stop, signed = self._places[name]
        return int.from_bytes(self.memory[start:stop], "little", signed=signed)

    def set(self, name: str, count: int) -> None:
        """Put a count into an item past all access rules.

        Raises:
            InputError: unknown item, or a count that does not fit.
        """
        item = self.table[name]
        self.memory[item.address : item.address + item.size] = item.encode(count)
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
        if not self._pointers.keys().isdisjoint(range(address, address + length)):
            runs = self._runs(address, length)
            return Error.NONE, b"".join(self._read_plain(place, size) for place, size in runs)
        return Error.NONE, self._read_plain(address, length)

    def _runs(self, address: int, length: int) -> list[tuple[int, int]]:
        """Return the neighbouring bytes, as (address, length), that a block with indirect data stands for."""
        runs: list[tuple[int, int]] = []
        for place in map(self._resolve, range(address, address + length)):
            if runs and sum(runs[-1]) == place:
                runs[-1] = runs[-1][0], runs[-1][1] + 1
            else:
                runs.append((place, 1))
        return runs

    def _read_plain(self, address: int, length: int) -> bytes:
        block = (address, length)
        if block not in self._kept_up:
            inside = {item.address: item for place in range(address, address + length) if (item := self._at.get(place))}
            self._kept_up[block] = [item for item in inside.values() if item.name in self._present]
        for item in self._kept_up[block]:
            self._refresh(item)
        return bytes(self.memory[address : address + length])

    def _refresh(self, item: Item) -> None:
        compute = self._present.get(item.name)
        if compute is not None:
            self.memory[item.address : item.address + item.size] = item.encode(compute())

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
