"""A chip on an SPI bus of this computer (Linux, ``/dev/spidevB.C``), with pauses in between while it is selected."""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Sequence
from typing import Protocol

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.ports import lock

#: Clock (Hz) and mode of the PMW3901: clock high at rest, taken at its rising edge.
CLOCK = 2_000_000
MODE = 3
#: One part of an exchange (linux/spi/spidev.h): where to send from and receive to, bytes, clock, pause after it (us), bits.
_PART = struct.Struct("=QQIIHBBBBBx")
_WRITE_MODE = 0x40016B01
_WRITE_SPEED = 0x40046B04


class SpiBus(Protocol):
    """A selected chip. Failures are ``OSError``."""

    def exchange(self, parts: Sequence[bytes], pause: float) -> list[bytes]:
        """Send parts under one chip select, ``pause`` (s) between them; return what came back with each."""
        ...

    def close(self) -> None: ...


class SpiDevice:
    """A chip on an SPI bus.

    Args:
        path: device, such as ``/dev/spidev0.0``.

    Raises:
        InputError: it is not there, cannot be opened, or another program of this library has it.
    """

    def __init__(self, path: str) -> None:
        import fcntl

        self._ioctl = fcntl.ioctl
        try:
            self._descriptor = os.open(path, os.O_RDWR)
        except OSError as error:
            hint = "switch SPI on in the system's settings and join the group 'spi'"
            raise InputError(f"flow port {path}: cannot be opened: {error}; {hint}") from None
        try:
            lock(self._descriptor, path, "flow port")
            self._ioctl(self._descriptor, _WRITE_MODE, struct.pack("B", MODE))
            self._ioctl(self._descriptor, _WRITE_SPEED, struct.pack("I", CLOCK))
        except OSError as error:
            self.close()
            raise InputError(f"flow port {path}: is no SPI device: {error}") from None
        except InputError:
            self.close()
            raise

    def exchange(self, parts: Sequence[bytes], pause: float) -> list[bytes]:
        """Send parts under one chip select; see :class:`SpiBus`."""
        sent = [ctypes.create_string_buffer(part, len(part)) for part in parts]
        received = [ctypes.create_string_buffer(len(part)) for part in parts]
        message = bytearray()
        for k, part in enumerate(parts):
            after = round(pause * 1e6) if k + 1 < len(parts) else 0
            places = (ctypes.addressof(sent[k]), ctypes.addressof(received[k]))
            message += _PART.pack(*places, len(part), CLOCK, after, 8, 0, 0, 0, 0)
        self._ioctl(self._descriptor, 0x40006B00 | len(message) << 16, message)
        return [buffer.raw for buffer in received]

    def close(self) -> None:
        """Close the device."""
        os.close(self._descriptor)
