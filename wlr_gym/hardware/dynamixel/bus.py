"""Servos on serial ports: reading and writing control table items by name, one bus group per port."""

from __future__ import annotations

import contextlib
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import TYPE_CHECKING

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.hardware.dynamixel import protocol
from wlr_gym.hardware.dynamixel.protocol import Error, NoAnswerError, RefusedError, RestlessLineError, Status
from wlr_gym.hardware.dynamixel.tables import ControlTable, Item

if TYPE_CHECKING:
    from wlr_gym.hardware.dynamixel.port import DynamixelPort


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
        self._take(inside, [item.address - self.address for item in inside])

    def _take(self, items: Sequence[Item], places: Iterable[int]) -> None:
        """Note the items, and at which byte of the block each begins."""
        self.names = tuple(item.name for item in items)
        pattern, end = "<", 0
        for item, place in zip(items, places, strict=True):
            letter = {1: "b", 2: "h", 4: "i"}[item.size]
            pattern += f"{place - end}x" + (letter if item.signed else letter.upper())
            end = place + item.size
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
        items = [table[name] for name in names]
        *starts, self.length = accumulate((item.size for item in items), initial=0)
        self.address = table["indirect_data_1"].address
        self._take(items, starts)
        places = [item.address + k for item in items for k in range(item.size)]
        self.pointers: bytes = struct.pack(f"<{len(places)}H", *places)


@dataclass(frozen=True)
class BlockReading:
    """What one servo answered to a block read."""

    counts: Mapping[str, int]  #: item -> count
    alert: bool  #: it has a hardware error (the counts are valid all the same)
    age: float = 0.0  #: s since the servo took the reading, from its own clock; 0 where the block holds no clock
    restarted: bool = False  #: its clock jumped: it was rebooted, or had no power


#: Part by which a servo's clock may run slow.
CLOCK_TOLERANCE = 0.02
#: Age at which a reading is stale, s.
STALE = 0.012
#: Age beyond which a reading is not late, but the servo's clock restarted, s.
LATEST = 1.0
#: Realtime Tick wraps at this many ms.
_TICKS = 32768


class TickClock:
    """Tells how old a reading is from the servo's Realtime Tick (ms, modulo 32768) and our clock.

    The freshest reading seen so far sets the offset between the two clocks; the offset is allowed to drift by
    ``CLOCK_TOLERANCE``, and may be short by what that reading waited for us. A late answer to an earlier request shows as age;
    Protocol 2.0 has nothing else to tell it by. Any other jump is a servo that restarted.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._time = self._waited = 0.0

    def age(self, tick: int, now: float, waited: float = 0.0) -> tuple[float, bool]:
        """Return the age (s) of a reading, and whether the servo's clock was found restarted.

        Args:
            tick: of the reading.
            now: s, when it was received.
            waited: s since it was asked for; an answer may have lain there for so long, where this program was not given time.
        """
        sample = tick - now * 1e3
        if self._offset is None:
            self._offset, self._time, self._waited = sample, now, waited
        ahead = (sample - self._offset + _TICKS / 2) % _TICKS - _TICKS / 2
        drift = CLOCK_TOLERANCE * (now - self._time) * 1e3
        age = max(0.0, -ahead - drift) * 1e-3
        latest = max(LATEST, waited + STALE)
        if STALE < age < latest:
            return age, False
        restarted = age >= latest or ahead > (STALE + self._waited) * 1e3 + drift
        if restarted or ahead > -drift:
            self._waited = waited
        self._offset, self._time = self._offset + (ahead if restarted else max(ahead, -drift)), now
        return (0.0 if restarted else age), restarted


#: s an answer may take beyond its bytes' time on the wire: adapter's latency timer (1 ms) twice, and the scheduler.
PATIENCE = 0.005
#: Data of a ping's answer: model number and firmware version.
_IDENTITY = struct.Struct("<HB")
#: ms until the first answer to a ping of all; ms that a servo waits for each id below its own before it answers.
_PING_START, _PING_SPACING = 16.0, 3.0
_ERROR_NAMES = {error.value: error.name.lower().replace("_", " ") + " error" for error in Error}


@dataclass
class Statistics:
    """What went over the bus since it was opened."""

    missing: Counter[int] = field(default_factory=Counter)  #: id -> answers that did not come
    alerts: Counter[int] = field(default_factory=Counter)  #: id -> answers that carried the alert bit
    stale: Counter[int] = field(default_factory=Counter)  #: id -> answers that were too old
    crc_errors: int = 0  #: packets with a wrong CRC
    discarded: int = 0  #: bytes thrown away because they belonged to an exchange that was given up
    fallbacks: int = 0  #: fast reads that were repeated as ordinary ones


class BusGroup:
    """Servos on one port. One thread owns it.

    Nothing here decides what is safe to send, and nothing retries but :meth:`torque_off`.

    Every exchange raises :class:`wlr_gym.hardware.dynamixel.protocol.BusGoneError` where the port is gone, and
    :class:`InputError` for an unknown id or item, or a count that does not fit. What asks one servo (ping, read, write, point)
    raises :class:`NoAnswerError` where it is silent, and :class:`RefusedError` where it refuses: values out of range, the
    EEPROM while torque is on. What asks all of them raises neither.

    Args:
        name: for messages.
        port: device path.
        baud_rate: bit/s.
        servos: id -> control table.
        patience: s an answer may take beyond its bytes' time on the wire.
        clock: s; what the servos' own clocks are compared with.
        make_port: (path, bit/s, patience) -> port; None = a serial port.

    Attributes:
        port: what the packets go through.
        fast: sync reads use the fast instruction; cleared for good when servos turn out not to know it.
        statistics: counts since the port was opened.
    """

    def __init__(
        self,
        name: str,
        port: str,
        baud_rate: int,
        servos: Mapping[int, ControlTable],
        patience: float = PATIENCE,
        clock: Callable[[], float] = time.monotonic,
        make_port: Callable[[str, int, float], DynamixelPort] | None = None,
    ) -> None:
        require_package("dynamixel_sdk", "robot")
        require_package("serial", "robot")
        from wlr_gym.hardware.dynamixel.port import DynamixelPort

        self.name = name
        self.servos: dict[int, ControlTable] = dict(servos)
        self.fast = True
        self.statistics: Statistics = Statistics()
        self.port: DynamixelPort = (make_port or DynamixelPort)(port, baud_rate, patience)
        self._clock = clock
        self._clocks = {id: TickClock() for id in servos}
        self._fast_failures = 0
        self._order = list(self.servos)
        self._asked: Block | None = None
        self._asked_at = 0.0

    def open(self) -> None:
        """Open the port; see :class:`wlr_gym.hardware.serial_frames.SerialDevice`."""
        self.port.openPort()

    def close(self) -> None:
        """Close the port; servos stay as they are."""
        self.port.closePort()

    def on_same_port(self, servos: Mapping[int, ControlTable]) -> BusGroup:
        """Return another group on the open port, for servos that are asked once in another order; use one at a time."""
        return BusGroup(self.name, "", 0, servos, clock=self._clock, make_port=lambda *_: self.port)

    def __enter__(self) -> BusGroup:
        self.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # ---- one servo ----

    def ping(self, id: int) -> tuple[int, int]:
        """Return model number and firmware version."""
        return _IDENTITY.unpack(self._ask(id, protocol.ping(id), _IDENTITY.size, "ping").data)

    def scan(self) -> dict[int, tuple[int, int]]:
        """Return id -> (model number, firmware) of every servo that answers; takes about 0.8 s."""
        port = self.port
        port.send_packet(protocol.ping(), is_answered=True)
        answer_time = (_IDENTITY.size + 11) * port.tx_time_per_byte + _PING_SPACING
        port.setPacketTimeoutMillis(protocol.MAX_ID * answer_time + _PING_START)
        found: dict[int, tuple[int, int]] = {}
        while (packet := port.next_answer()) is not None:
            status = protocol.as_status(packet)
            if status is not None and len(status.data) == _IDENTITY.size:
                found[status.id] = _IDENTITY.unpack(status.data)
        return dict(sorted(found.items()))

    def read(self, id: int, item: str) -> int:
        """Return the count an item holds."""
        row = self._table(id)[item]
        return row.decode(self._ask(id, protocol.read(id, row.address, row.size), row.size, f"read {item}").data)

    def write(self, id: int, item: str, count: int) -> None:
        """Write a count and have it acknowledged."""
        row = self._table(id)[item]
        self._ask(id, protocol.write(id, row.address, row.encode(count)), 0, f"write {item} = {count}")

    def point(self, id: int, block: IndirectBlock) -> None:
        """Make a servo's Indirect Data stand for the items of a block, and see that they do (else it counts as silent).

        A reboot undoes it.
        """
        address = self._table(id)["indirect_address_1"].address
        self._ask(id, protocol.write(id, address, block.pointers), 0, "write indirect addresses")
        raw = protocol.read(id, address, len(block.pointers))
        if self._ask(id, raw, len(block.pointers), "read indirect addresses").data != block.pointers:
            raise NoAnswerError(f"bus {self.name}, id {id}: the indirect addresses are not what was written")

    def _table(self, id: int) -> ControlTable:
        if id not in self.servos:
            raise InputError(f"bus {self.name}: no servo with id {id}; there are {', '.join(map(str, sorted(self.servos)))}")
        return self.servos[id]

    def _ask(self, id: int, raw: bytes, length: int, what: str) -> Status:
        status = self.port.exchange(raw, length)
        self._note_port()
        where = f"bus {self.name}, id {id}: {what}"
        if status is None:
            self.statistics.missing[id] += 1
            if not self.port.quiet:
                raise RestlessLineError(f"{where}: no answer, the line is never quiet: check wiring, are two ports swapped?")
            raise NoAnswerError(f"{where}: no answer")
        if status.alert:
            self.statistics.alerts[id] += 1
        if status.fault:
            raise RefusedError(f"{where}: refused ({_ERROR_NAMES.get(status.fault, status.fault)})")
        return status

    # ---- all servos ----

    def ask_all(self, block: Block) -> None:
        """Send the read of a block from every servo; :meth:`answers` collects. Several groups can be asked at once."""
        self._asked, self._asked_at = block, self._clock()
        count = len(self.servos)
        self.port.send_packet(protocol.sync_read(block.address, block.length, self._order, self.fast), is_answered=True)
        self.port.setPacketTimeout((block.length + 11) * count + 14 + count)

    def answers(self) -> dict[int, BlockReading]:
        """Return id -> reading of the servos that answered :meth:`ask_all`; who is missing, is missing.

        A fast read that brings nothing is repeated as an ordinary one; after three in a row only ordinary ones are tried.
        """
        block = self._asked
        assert block is not None, "ask_all comes first"
        wanted = dict.fromkeys(self.servos, block.length)
        found = self.port.collect(wanted)
        if self.fast and not found:
            self.statistics.fallbacks += 1
            self.fast = False
            self.ask_all(block)
            found = self.port.collect(wanted)
            self._fast_failures = self._fast_failures + 1 if found else 0
            self.fast = self._fast_failures < 3
        elif self.fast:
            self._fast_failures = 0
        self._note_port()
        now = self._clock()
        self.statistics.missing.update(self.servos.keys() - found.keys())
        if (silent := next((id for id in self._order if id not in found), None)) is not None:
            # The first servo that was silent is asked last from now on: those named behind it wait for its answer.
            self._order.remove(silent)
            self._order.append(silent)
        readings = {id: self._reading(block, status, now) for id, status in found.items()}
        oldest = now - self._asked_at + STALE  # an answer may have waited for us, but was not given before we asked
        for id in [id for id, reading in readings.items() if reading.age > oldest]:
            self.statistics.stale[id] += 1
            self.port.suspect = 1
            del readings[id]
        return readings

    def _reading(self, block: Block, status: Status, now: float) -> BlockReading:
        counts = block.decode(status.data)
        age, restarted = 0.0, False
        if "realtime_tick" in counts:
            age, restarted = self._clocks[status.id].age(counts["realtime_tick"], now, now - self._asked_at)
        if status.alert:
            self.statistics.alerts[status.id] += 1
        return BlockReading(counts, status.alert, age, restarted)

    def write_all(self, item: str, counts: Mapping[int, int]) -> None:
        """Write id -> count in one packet. Nobody acknowledges it, and a servo ignores a count out of range: clamp before."""
        data = {id: self._table(id)[item].encode(count) for id, count in counts.items()}
        row = self._table(next(iter(counts)))[item]
        self.port.send_packet(protocol.sync_write(row.address, data), is_answered=False)

    def torque_off(self, retries: int = 5, ids: Iterable[int] | None = None) -> set[int]:
        """Switch motors off, whatever happened before; return the ids that did not confirm it.

        First all at once without acknowledgement, then one by one until each has confirmed or ``retries`` are over.

        Args:
            retries: times that a servo is asked.
            ids: which; None = all.
        """
        left = set(self.servos if ids is None else ids)
        for _ in range(retries):
            if not left:
                break
            self.write_all("torque_enable", dict.fromkeys(left, 0))
            left = {id for id in left if not self._confirm_off(id)}
        return left

    def _confirm_off(self, id: int) -> bool:
        """Switch a motor off; return whether it says that it is. The acknowledgement may get lost: what is read counts."""
        with contextlib.suppress(NoAnswerError, RefusedError):
            self.write(id, "torque_enable", 0)
        try:
            return self.read(id, "torque_enable") == 0
        except (NoAnswerError, RefusedError):
            return False

    # ---- book-keeping ----

    def _note_port(self) -> None:
        self.statistics.crc_errors = self.port.parser.crc_errors
        self.statistics.discarded = self.port.discarded
