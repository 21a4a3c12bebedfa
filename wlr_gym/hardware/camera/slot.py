"""One piece of shared memory that always holds the newest packet: the writer never waits, and neither does the reader."""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

_COUNT = struct.Struct("<Q")
#: Times a packet is read that is being written meanwhile.
_TRIES = 3


class Slot:
    """A packet of a fixed size in a file that two processes map into their memory. One writes, one reads.

    The count before the packet is odd while it is written (a sequence lock); what a packet is worth, its own checksum says.

    Args:
        path: of the file. size: bytes of a packet.
        create: make the file, with zeros; else it must be there.
    """

    def __init__(self, path: Path, size: int, *, create: bool = False) -> None:
        if create:
            path.write_bytes(bytes(_COUNT.size + size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _COUNT.size + size)
        self._size = size

    def write(self, packet: bytes) -> None:
        """Put a packet in place of the last one."""
        memory = self._memory
        (count,) = _COUNT.unpack_from(memory)
        _COUNT.pack_into(memory, 0, count + 1)
        memory[_COUNT.size : _COUNT.size + self._size] = packet
        _COUNT.pack_into(memory, 0, count + 2)

    def read(self) -> bytes | None:
        """Return the newest packet; None where it is being written all the time."""
        memory = self._memory
        for _ in range(_TRIES):
            (before,) = _COUNT.unpack_from(memory)
            packet = memory[_COUNT.size : _COUNT.size + self._size]
            (after,) = _COUNT.unpack_from(memory)
            if before == after and before % 2 == 0:
                return packet
        return None

    @property
    def count(self) -> int:
        """Twice the number of packets written so far; odd while one is being written."""
        return _COUNT.unpack_from(self._memory)[0]

    def close(self) -> None:
        """Unmap the file."""
        self._memory.close()
