"""Devices that one program at a time may use: servo buses and IMU. Imports pyserial only when a port is opened."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import TYPE_CHECKING

from wlr_gym.base.errors import InputError, require_package

if TYPE_CHECKING:
    import serial

try:
    import fcntl
    import termios

    #: What a port that fails raises; pyserial's own exceptions are OSErrors.
    FAILURES: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:  # not on Windows
    fcntl = None
    FAILURES = (OSError,)

#: What a lock that is taken says, and a device that another program has opened for itself alone.
_TAKEN = (errno.EWOULDBLOCK, errno.EBUSY)


class PortInUseError(InputError):
    """Another program has the port."""


def open_serial(path: str, baud_rate: int, name: str = "port") -> serial.Serial:
    """Open a serial port for this program alone; locked before its speed is set and its input thrown away.

    Args:
        path: device.
        baud_rate: bit/s.
        name: for messages.

    Raises:
        PortInUseError: another program has it.
        InputError: it is not there, or cannot be opened.
        MissingPackageError: pyserial is not installed.
    """
    require_package("serial", "robot")
    import serial

    try:
        return serial.Serial(path, baud_rate, timeout=0, exclusive=True)
    except FAILURES as error:
        if getattr(error, "errno", None) in _TAKEN:
            raise _in_use(path, name) from None
        hint = "" if Path(path).exists() else "; see wlr doctor"
        raise InputError(f"{name} {path}: cannot be opened: {_reason(error)}{hint}") from None


def _reason(error: Exception) -> str:
    """Return what the system says; pyserial says it twice, and the path with it."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error)


def lock(descriptor: int, path: str, name: str = "port") -> None:
    """Keep other programs of this library off a device until it is closed or its process ends (not on Windows).

    Raises:
        PortInUseError: another program has it.
    """
    if fcntl is None:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _TAKEN:
            raise _in_use(path, name) from None


def is_pseudo_terminal(path: str) -> bool:
    """Return whether a device is a terminal that a program serves, such as an emulated robot's (Linux, macOS)."""
    device = str(Path(path).resolve())
    return device.startswith(("/dev/pts/", "/dev/ttys0"))


def _in_use(path: str, name: str) -> PortInUseError:
    return PortInUseError(f"{name} {path} is in use by another program: two readers would steal each other's answers")
