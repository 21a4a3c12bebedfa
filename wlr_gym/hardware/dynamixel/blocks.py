"""Items of a control table that are read together: neighbours, or from anywhere through Indirect Data."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from wlr_gym.hardware.dynamixel.tables import ControlTable, Item


class Block:
    """Neighbouring items of a control table that are read together.

    Attributes:
        address, length: of the block, bytes.
        names: of its items.

    Args:
        table: of the servos.
        first, last: names of the first and the last item.
    """

    def __init__(self, table: ControlTable, first: str, last: str) -> None:
        self.address, self.length = table.block(first, last)
        inside = [item for item in table.items.values() if self.address <= item.address < self.address + self.length]
        self.names: tuple[str, ...] = tuple(item.name for item in inside)
        pattern, place = "<", self.address
        for item in inside:
            pattern += f"{item.address - place}x" + _letter(item)
            place = item.address + item.size
        self._struct = struct.Struct(pattern)

    def decode(self, data: bytes) -> dict[str, int]:
        """Return item -> count."""
        return dict(zip(self.names, self._struct.unpack(data), strict=True))


class IndirectBlock(Block):
    """Items from anywhere in a control table that are read together, through the Indirect Data that stand for them.

    Args:
        table: of the servos.
        names: of the items; 28 bytes at most.

    Attributes:
        pointers: what the Indirect Addresses must hold, from the first on.
    """

    def __init__(self, table: ControlTable, names: Iterable[str]) -> None:
        self.names = tuple(names)
        items = [table[name] for name in self.names]
        self.address = table["indirect_data_1"].address
        self.length = sum(item.size for item in items)
        places = [item.address + k for item in items for k in range(item.size)]
        self.pointers: bytes = struct.pack(f"<{len(places)}H", *places)
        self._struct = struct.Struct("<" + "".join(_letter(item) for item in items))


def _letter(item: Item) -> str:
    letter = {1: "b", 2: "h", 4: "i"}[item.size]
    return letter if item.signed else letter.upper()


@dataclass(frozen=True)
class BlockReading:
    """What one servo answered to a block read.

    Attributes:
        counts: item -> count.
        alert: it has a hardware error (the counts are valid all the same).
        age: s since the servo took the reading, from its own clock; 0 where the block holds no clock.
        restarted: its clock jumped: it was rebooted, or had no power.
    """

    counts: Mapping[str, int]
    alert: bool
    age: float = 0.0
    restarted: bool = False
