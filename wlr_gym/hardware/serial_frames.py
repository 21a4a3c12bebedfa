"""Serial devices: bytes in and out, and the numbered frames in which a microcontroller sends what its sensors read.

Servo buses, IMU and optical-flow sensor stand on :class:`SerialDevice`: one program has it at a time, every failure is an
``OSError``, and no call waits longer than it is told. Sensors send frames of fixed size (:class:`FrameFormat`): two bytes of
sync, sequence number (u16), microseconds since the microcontroller's boot (u32), content, CRC-16 of all before it (polynomial
8005, as the servos use); little-endian, numbers wrap. :class:`FrameStream` reads them and tells when each was taken.

:data:`FORMATS` is the one description of the frames: readers and emulator use it, and ``firmware/header.py`` writes the
firmware's header from it. One line may carry all kinds. :data:`STATUS_REQUEST` has the board send a status frame.
"""

from __future__ import annotations

import errno
import os
import select
import struct
from collections.abc import Callable, Iterable
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple, Protocol

from wlr_gym.base.errors import InputError, require_package

try:
    import termios

    _FAILURES: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:  # not on Windows
    _FAILURES = (OSError,)

#: What a lock that is taken says, and a device that another program has opened for itself alone.
TAKEN = (errno.EWOULDBLOCK, errno.EBUSY)
#: Bytes taken at once, as systems give them; reads until a port must be empty (256 kB).
_CHUNK, _LARGEST_BACKLOG = 4096, 64
#: s since the port was last empty, up to which frames are hardly older than that: they relate the clocks.
_RECENT = 0.1
_CRC_SIZE = 2
_SYNC = b"\xa5"


class PortInUseError(InputError):
    """Another program has the port."""

    def __init__(self, path: str, name: str) -> None:
        super().__init__(f"{name} {path} is in use by another program: two readers would steal each other's answers")


def is_pseudo_terminal(path: str) -> bool:
    """Return whether a device is a terminal that a program serves, such as an emulated robot's (Linux, macOS)."""
    return str(Path(path).resolve()).startswith(("/dev/pts/", "/dev/ttys0"))


class Device(Protocol):
    """An open serial device: :class:`SerialDevice`, or an emulated one. Failures are ``OSError``."""

    def received(self) -> bytes: ...
    def wait(self, seconds: float) -> bytes: ...
    def write(self, data: bytes) -> int: ...
    def reset_input_buffer(self) -> None: ...
    def close(self) -> None: ...


class SerialDevice:
    """A serial port of this computer, for this program alone; locked before its speed is set and its input thrown away.

    Args:
        path: device.
        baud_rate: bit/s.
        name: for messages.

    Attributes:
        serial: pyserial's port.

    Raises:
        PortInUseError: another program has it.
        InputError: it is not there, or cannot be opened.
        MissingPackageError: pyserial is not installed.
    """

    def __init__(self, path: str, baud_rate: int, name: str = "port") -> None:
        require_package("serial", "robot")
        import serial

        try:
            self.serial: serial.Serial = serial.Serial(path, baud_rate, timeout=0, exclusive=True)
        except _FAILURES as error:
            number = getattr(error, "errno", None)
            if number in TAKEN:
                raise PortInUseError(path, name) from None
            reason = os.strerror(number) if number else str(error)  # pyserial says it twice, and the path with it
            hint = "" if Path(path).exists() else "; see wlr doctor"
            raise InputError(f"{name} {path}: cannot be opened: {reason}{hint}") from None

    def received(self) -> bytes:
        """Return all bytes that have come; does not wait."""
        parts = iter(partial(self.serial.read, _CHUNK), b"")
        return b"".join(islice(parts, _LARGEST_BACKLOG))

    def wait(self, seconds: float) -> bytes:
        """Return bytes as soon as there are some; none when the time is over."""
        number = self._number()
        if not select.select([number], [], [], seconds)[0]:
            return b""
        if data := os.read(number, _CHUNK):
            return data
        raise OSError("it is ready and has nothing: disconnected, or another program reads it")

    def write(self, data: bytes) -> int:
        """Send bytes, and return how many the device took; does not wait until it would take more.

        A full buffer is an ``OSError``, a nearly full one takes a part.
        """
        return os.write(self._number(), data)

    def reset_input_buffer(self) -> None:
        """Throw away what has come."""
        try:
            self.serial.reset_input_buffer()
        except _FAILURES as error:  # what termios raises is no OSError
            raise OSError(str(error)) from None

    def close(self) -> None:
        """Close it."""
        self.serial.close()

    def _number(self) -> int:
        if not self.serial.is_open:
            raise OSError("it was closed")
        return self.serial.fileno()


class SharedPorts:
    """Opens serial devices. Readers of one path share it, and each gets all its bytes: a board has one line for its sensors.

    Args:
        make_device: opens one: path, bit/s, name for messages.
    """

    def __init__(self, make_device: Callable[[str, int, str], Device] = SerialDevice) -> None:
        self._make_device = make_device
        self._shares: dict[str, list[SharedDevice]] = {}

    def __call__(self, path: str, baud_rate: int, name: str) -> Device:
        """Open a device, or join those who have it open."""
        shares = self._shares.setdefault(path, [])
        return SharedDevice(shares[0].device if shares else self._make_device(path, baud_rate, name), shares)


class SharedDevice:
    """One reader's share of a device; the last one that closes it closes the device."""

    def __init__(self, device: Device, shares: list[SharedDevice]) -> None:
        self.device, self._shares, self._buffer = device, shares, bytearray()
        shares.append(self)

    def received(self) -> bytes:
        """Return all bytes that have come since this reader asked last."""
        return self._take(self.device.received())

    def wait(self, seconds: float) -> bytes:
        """Return bytes as soon as there are some; none when the time is over."""
        return self._take(b"" if self._buffer else self.device.wait(seconds))

    def write(self, data: bytes) -> int:
        """Send bytes."""
        return self.device.write(data)

    def reset_input_buffer(self) -> None:
        """Throw away what has come for this reader."""
        self.received()

    def close(self) -> None:
        """Leave the device to the others."""
        self._shares.remove(self)
        if not self._shares:
            self.device.close()

    def _take(self, data: bytes) -> bytes:
        for share in self._shares:
            share._buffer += data
        taken = bytes(self._buffer)
        self._buffer.clear()
        return taken


# ---- frames ----


def _crc_entry(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1) ^ (0x8005 if value & 0x8000 else 0)
    return value & 0xFFFF


_CRC_TABLE = tuple(_crc_entry(byte) for byte in range(256))


def crc16(data: bytes, crc: int = 0) -> int:
    """Return the CRC-16 of ``data`` (polynomial 8005, start value 0, not reflected), continuing from ``crc``."""
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


class FrameFormat:
    """How the frames of one kind look.

    Args:
        sync: how a frame begins, two bytes, the first of which is that of all kinds.
        content: name -> type (as ``struct`` writes it) of what comes after sequence number and microseconds, in order; ``x`` is
            a byte of padding.

    Attributes:
        size: bytes of a frame.
        fields: name -> type of everything between sync and CRC.
    """

    def __init__(self, sync: bytes, content: dict[str, str]) -> None:
        self.sync = sync
        self.fields: dict[str, str] = {"sequence": "H", "microseconds": "I", **content}
        self._layout = struct.Struct("<2s" + "".join(self.fields.values()))
        self.size: int = self._layout.size + _CRC_SIZE

    def encode(self, numbers: Iterable[int]) -> bytes:
        """Return a frame as bytes: its sequence number and microseconds, wrapped, and its content."""
        sequence, microseconds, *content = numbers
        body = self._layout.pack(self.sync, sequence % 2**16, microseconds % 2**32, *content)
        return body + crc16(body).to_bytes(_CRC_SIZE, "little")

    def decode(self, raw: bytes) -> tuple[int, ...] | None:
        """Return sequence number, microseconds and content of a frame; None where its CRC is wrong."""
        body, crc = raw[:-_CRC_SIZE], raw[-_CRC_SIZE:]
        return self._layout.unpack(body)[1:] if crc16(body) == int.from_bytes(crc, "little") else None


#: The MPU-6050's burst in its own counts; degC = temperature/340 + 36.53.
IMU_FRAMES = FrameFormat(
    b"\xa5\x5a", dict.fromkeys(("accel_x", "accel_y", "accel_z", "temperature", "gyro_x", "gyro_y", "gyro_z"), "h")
)
#: What the PMW3901 counted in ``interval`` us that end at the stamp; quality is its SQUAL.
FLOW_FRAMES = FrameFormat(b"\xa5\xf1", {"interval": "H", "x": "h", "y": "h", "quality": "B", "zero": "x", "shutter": "H"})
#: Version, settings, and counters (modulo 65536) of the board.
STATUS_FRAMES = FrameFormat(
    b"\xa5\xc3",
    {
        "version_major": "B",
        "version_minor": "B",
        "reset_cause": "B",  # the ATmega328P's MCUSR
        "sensors": "B",  # bits of SENSORS: what is there and set up
        "imu_rate": "H",  # Hz
        "gyro_range": "H",  # deg/s
        "accel_range": "B",  # g
        "bandwidth": "B",  # Hz
        "baud_rate": "I",
        "imu_identity": "B",  # WHO_AM_I as it was answered last; 0 = nobody did
        "bus_errors": "H",  # transfers of the two-wire bus that failed
        "bus_locks": "H",  # times the bus was held, and freed
        "imu_restarts": "H",  # times the IMU had gone
        "imu_missed": "H",  # samples that were not read before the next
        "flow_restarts": "H",  # times the flow sensor had gone
        "line_full": "H",  # frames that found no room in the buffer of the line
    },
)
FORMATS = {"imu": IMU_FRAMES, "flow": FLOW_FRAMES, "status": STATUS_FRAMES}
#: Sensor -> its bit in the status frame.
SENSORS = {"imu": 1, "flow": 2}
#: What the host sends to get a status frame.
STATUS_REQUEST = b"\xa5?"
#: Of the firmware; another major number speaks another language.
FIRMWARE_VERSION = (1, 0)
_BY_SYNC = {format.sync[1]: format for format in FORMATS.values()}


class FrameParser:
    """Finds whole frames of one kind in a stream, and counts by their sequence numbers (modulo 65536) what is missing.

    Noise costs no more than the frames it hits.

    Args:
        format: of the frames.
        repeats: hand on a frame that is the last one again.

    Attributes:
        lost: frames missing between the received ones.
        crc_errors: frames dropped because their CRC was wrong.
        status: the last status frame's fields; None = there was none.
    """

    def __init__(self, format: FrameFormat, *, repeats: bool = True) -> None:
        self._format, self._repeats = format, repeats
        self._buffer = bytearray()
        self._last: int | None = None
        self.lost = self.crc_errors = 0
        self.status: dict[str, int] | None = None

    def feed(self, data: bytes) -> list[tuple[int, ...]]:
        """Take bytes; return the frames they complete: sequence number, microseconds, content."""
        buffer, place, frames = self._buffer, 0, []
        buffer += data
        while (place := _first(buffer, place)) + 1 < len(buffer):
            format = _BY_SYNC.get(buffer[place + 1])
            if format is not None and len(buffer) < place + format.size:
                break
            frame = None if format is None else format.decode(bytes(buffer[place : place + format.size]))
            if format is None or frame is None:
                self.crc_errors += format is self._format
                place += 1
                continue
            place += format.size
            if format is self._format and self._is_wanted(frame[0]):
                frames.append(frame)
            elif format is STATUS_FRAMES:
                self.status = dict(zip(format.fields, frame, strict=True))
        del buffer[:place]
        return frames

    def _is_wanted(self, sequence: int) -> bool:
        """Count what is missing before a frame; return whether to hand it on."""
        last, self._last = self._last, sequence
        if sequence == last:
            return self._repeats
        self.lost += 0 if last is None else (sequence - last - 1) % 65536
        return True


def _first(buffer: bytearray, place: int) -> int:
    """Return where the next frame may begin, from ``place`` on; the end where none does."""
    found = buffer.find(_SYNC, place)
    return len(buffer) if found < 0 else found


class StreamClock:
    """Tells how old a frame is from the microcontroller's microseconds (modulo 2^32) and our clock.

    The frame that came soonest after its stamp sets the offset between the clocks, so ages are short by at most what that one
    took: at a poll, up to one frame period. The microcontroller's clock may be wrong by ``drift`` (a ceramic resonator is by
    0.5 %, an RC oscillator by 2 %). A clock that goes back, or that is ahead of ours by more than ``jump``, restarted.
    """

    drift: float = 0.02  #: part by which the microcontroller's clock may be wrong
    jump: float = 0.1  #: s
    _turn = 2**32 * 1e-6  #: s after which the clock wraps

    def __init__(self) -> None:
        self._offset: float | None = None
        self._time = 0.0
        self._last = 0

    def age(self, microseconds: int, now: float, *, is_recent: bool = True) -> tuple[float | None, bool]:
        """Return the age (s) of a frame that is here at ``now`` (s), and whether the microcontroller restarted.

        Args:
            microseconds: the frame's stamp.
            now: s.
            is_recent: the port was empty a moment ago, so the frame is hardly older. Only such a frame can relate the clocks:
                in a backlog nobody knows how old the newest is. The age is None while they are not related.
        """
        sample = microseconds * 1e-6 - now
        if self._offset is None:
            return self._relate(microseconds, now, is_recent), False
        ahead = (sample - self._offset + self._turn / 2) % self._turn - self._turn / 2
        drift = self.drift * (now - self._time)
        is_back = (microseconds - self._last) % 2**32 > 2**31
        if is_back or ahead > self.jump + drift:
            return self._relate(microseconds, now, is_recent), True
        self._last = microseconds
        if ahead > -drift:
            self._offset, self._time = self._offset + ahead, now
        return max(0.0, -ahead - drift), False

    def _relate(self, microseconds: int, now: float, is_recent: bool) -> float | None:
        self._last, self._time = microseconds, now
        self._offset = microseconds * 1e-6 - now if is_recent else None
        return 0.0 if is_recent else None


class TimedFrame(NamedTuple):
    """A frame's numbers, and when it was taken, s of our clock; None = nobody knows."""

    numbers: tuple[int, ...]
    time: float | None


class FrameStream:
    """The frames of a microcontroller on a serial port. One thread owns it.

    Args:
        format: of its frames.
        path, baud_rate: of the port.
        name: of the port, for messages.
        clock: s; what ages are told by.
        make_device: opens the port; the emulator in memory puts its own here.
        repeats: see :class:`FrameParser`.

    Attributes:
        path: of the port.
        parser: counts what is lost and broken.
        restarts: times the microcontroller's clock began anew.
    """

    def __init__(
        self,
        format: FrameFormat,
        path: str,
        baud_rate: int,
        name: str,
        clock: Callable[[], float],
        make_device: Callable[[str, int, str], Device],
        *,
        repeats: bool = True,
    ) -> None:
        self.path, self._baud_rate, self._name = path, baud_rate, name
        self._clock, self._make_device = clock, make_device
        self._make_parser = partial(FrameParser, format, repeats=repeats)
        self._device: Device | None = None
        self._begin()

    def _begin(self) -> None:
        """Count from now; what a sensor's own stream counts, it adds here."""
        self.parser = self._make_parser()
        self._stream_clock = StreamClock()
        self.restarts = 0
        self._emptied_at = self._clock()

    def open(self) -> None:
        """Open the port (see :class:`SerialDevice`) and throw away what piled up in it; counts begin anew."""
        self._device = self._make_device(self.path, self._baud_rate, self._name)
        self._device.reset_input_buffer()
        self._begin()

    def close(self) -> None:
        """Close the port."""
        if self._device is not None:
            self._device.close()
            self._device = None

    def request_status(self) -> None:
        """Ask the board for its status, which :attr:`FrameParser.status` has once it came.

        Raises:
            ConnectionError: the port is not open, or is gone.
        """
        if self._device is None:
            raise ConnectionError("not open")
        self.parser.status = None
        try:
            self._device.write(STATUS_REQUEST)
        except OSError as error:
            raise ConnectionError(f"gone: {error}") from None

    def frames(self) -> list[TimedFrame]:
        """Return the frames that have come since the last call; does not wait.

        Raises:
            ConnectionError: the port is not open, or is gone.
        """
        if self._device is None:
            raise ConnectionError("not open")
        try:
            frames = self.parser.feed(self._device.received())
        except OSError as error:
            raise ConnectionError(f"gone: {error}") from None
        now = self._clock()
        is_recent, self._emptied_at = now - self._emptied_at <= _RECENT, now
        if not frames:
            return []
        last = frames[-1][1]
        age, restarted = self._stream_clock.age(last, now, is_recent=is_recent)
        self.restarts += restarted
        if age is None:  # a backlog: nobody knows how old it is
            return [TimedFrame(frame, None) for frame in frames]
        return [TimedFrame(frame, now - age - ((last - frame[1]) % 2**32) * 1e-6) for frame in frames]
