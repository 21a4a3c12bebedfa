"""One emulated bus: who answers which instruction, in what order, and when the bytes reach the host."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from wlr_gym.hardware.dynamixel import protocol
from wlr_gym.hardware.dynamixel.protocol import BROADCAST, Error, Instruction, Packet, Parser, Status
from wlr_gym.hardware.dynamixel.tables import OVERLOAD
from wlr_gym.hardware.emulator.faults import FaultBoard
from wlr_gym.hardware.emulator.servo import EmulatedServo

#: First firmware that knows fast reads.
FAST_READ_FIRMWARE = 45
#: Payload of one USB packet of the adapter: full ones are sent at once, the rest waits for the latency timer.
USB_PACKET = 62
_BITS_PER_BYTE = 10
_WRITES = (Instruction.WRITE, Instruction.REG_WRITE)
#: Status Return Level from which an instruction is answered; all others from 2.
_ANSWER_LEVEL: dict[int, int] = {Instruction.PING: 0, Instruction.READ: 1}


class Emission(NamedTuple):
    """Bytes that reach the host at ``time`` (s)."""

    time: float
    data: bytes


@dataclass(frozen=True)
class LineTiming:
    """How long things take on the line and in the adapter.

    Attributes:
        wire: count 10 bits per byte at the line's baud rate, both ways, and the servos' Return Delay Time.
        turnaround: s a servo needs to answer, on top of its Return Delay Time.
        usb_latency: s the adapter holds back a USB packet that is not full (latency timer: FTDI default 0.016, advised 0.001).
    """

    wire: bool = True
    turnaround: float = 50e-6
    usb_latency: float = 0.001


#: No time at all, for tests that step the emulator.
NO_TIME = LineTiming(wire=False, turnaround=0.0, usb_latency=0.0)


class BusLine:
    """Servos on one bus.

    Args:
        name: bus name.
        servos: on it.
        faults: shared with the rest of the robot.
        timing: see :class:`LineTiming`.
    """

    def __init__(self, name: str, servos: Sequence[EmulatedServo], faults: FaultBoard, timing: LineTiming) -> None:
        self.name = name
        self.servos: list[EmulatedServo] = list(servos)
        self.timing = timing
        self._faults = faults
        self._parser = Parser()
        self._busy_until = 0.0
        self._simple: dict[int, Callable[[EmulatedServo, bytes], tuple[Error, bytes]]] = {
            Instruction.PING: _ping,
            Instruction.READ: _read,
            Instruction.WRITE: lambda servo, data: (_write(servo.write, data), b""),
            Instruction.REG_WRITE: lambda servo, data: (_write(servo.register, data), b""),
            Instruction.ACTION: lambda servo, data: (servo.action(), b""),
            Instruction.CLEAR: lambda servo, data: (servo.clear(data), b""),
        }

    def receive(self, data: bytes, now: float, baud_rate: int | None = None) -> list[Emission]:
        """Take bytes the host sent; return what comes back and when.

        Args:
            data: as written by the host.
            now: s, when they were written.
            baud_rate: of the host's port; servos set to another one hear nothing. None = not known: all hear.
        """
        emissions = []
        if self._faults.happens(now, "echo", [self.name]):
            emissions.append(Emission(now + self._wire_time(len(data), baud_rate), data))
        for packet in self._parser.feed(data):
            size = len(packet.parameters) + 10
            start = max(now, self._busy_until) + self._wire_time(size, baud_rate)
            heard = [servo for servo in self.servos if self._hears(servo, baud_rate, now)]
            for servo in heard:
                servo.hear()
            emissions += self._send(self._answer(packet, heard), start, now, baud_rate)
        return emissions

    def forget(self) -> None:
        """Drop half-received instructions (the adapter was unplugged)."""
        self._parser.clear()

    def _hears(self, servo: EmulatedServo, baud_rate: int | None, now: float) -> bool:
        right_speed = baud_rate is None or servo.baud_rate == baud_rate
        return servo.answers and right_speed and not self._faults.happens(now, "deaf", [servo.name, self.name])

    def _wire_time(self, count: int, baud_rate: int | None) -> float:
        speed = baud_rate or self.servos[0].baud_rate
        return count * _BITS_PER_BYTE / speed if self.timing.wire else 0.0

    def _send(
        self, answers: Sequence[tuple[EmulatedServo, bytes]], start: float, now: float, baud_rate: int | None
    ) -> Iterator[Emission]:
        """Put answers on the wire one after the other; the adapter passes them on in USB packets."""
        held: list[tuple[float, bytes]] = []  # (delay by a fault, bytes) of the USB packet being filled
        for k, (servo, raw) in enumerate(answers):
            waits = self.timing.wire and (k == 0 or raw.startswith(protocol.HEADER))
            pause = servo.return_delay if waits else 0.0
            start += pause + self.timing.turnaround + self._wire_time(len(raw), baud_rate)
            arrived, delay = self._faults.mangle(now, raw, [servo.name, self.name])
            held.append((delay, arrived))
            if sum(len(data) for _, data in held) >= USB_PACKET:
                yield from (Emission(start + delay, data) for delay, data in held if data)
                held = []
        yield from (Emission(start + self.timing.usb_latency + delay, data) for delay, data in held if data)
        self._busy_until = start

    def apply_faults(self, now: float) -> None:
        """Let the faults that hold now act on the servos."""
        for servo in self.servos:
            values = self._faults.values(now, (servo.name, self.name))
            unpowered = "dead" in values or "brownout" in values
            if servo.dead and not unpowered:
                servo.boot()
            servo.set_power(not unpowered)
            servo.heating_rate = values.get("overheat", 0.0)
            if unpowered:
                continue
            if "overload" in values:
                servo.raise_error(OVERLOAD)
            if "reboot_matching_tick" in values:
                servo.boot(keep_clock=True)
            if "torque_lost" in values:
                servo.write(servo.table["torque_enable"].address, b"\0")
            if "limit_changed" in values:
                servo.set("goal_pwm", round(values["limit_changed"]))
            servo.shaft.strength = values.get("slow_servo", 1.0)
            servo.shaft.offset = values.get("encoder_jump", 0.0)
            servo.shaft.is_frozen = "encoder_frozen" in values

    # ---- who answers ----

    def _answer(self, packet: Packet, heard: list[EmulatedServo]) -> list[tuple[EmulatedServo, bytes]]:
        instruction, parameters = packet.instruction, packet.parameters
        if instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
            address, length = _words(parameters)
            asked = [(id, address, length) for id in parameters[4:]]
            return self._read_several(asked, heard, instruction == Instruction.FAST_SYNC_READ)
        if instruction in (Instruction.BULK_READ, Instruction.FAST_BULK_READ):
            asked = [(part[0], *_words(part[1:])) for part in _parts(parameters, 5)]
            return self._read_several(asked, heard, instruction == Instruction.FAST_BULK_READ)
        if instruction == Instruction.SYNC_WRITE:
            address, length = _words(parameters)
            _write_several([(part[0], address, part[1:]) for part in _parts(parameters[4:], length + 1)], heard)
            return []
        if instruction == Instruction.BULK_WRITE:
            _write_several(list(_bulk_parts(parameters)), heard)
            return []
        return self._answer_one(packet, heard)

    def _answer_one(self, packet: Packet, heard: list[EmulatedServo]) -> list[tuple[EmulatedServo, bytes]]:
        """Instructions to one servo, or to all of them at once (only a ping is then answered)."""
        answers = []
        for servo in sorted(heard, key=lambda servo: servo.id):
            own = servo.id
            if packet.id not in (own, BROADCAST):
                if packet.id == servo["secondary_id"] and packet.instruction in _WRITES:
                    self._carry_out(servo, packet)
                continue
            alert = servo.alert
            level = servo["status_return_level"]
            error, data = self._carry_out(servo, packet)
            silent = packet.id == BROADCAST and packet.instruction != Instruction.PING
            if level >= _ANSWER_LEVEL.get(packet.instruction, 2) and not silent:
                answers.append((servo, protocol.encode_status(own, error | alert, data)))
        return answers

    def _carry_out(self, servo: EmulatedServo, packet: Packet) -> tuple[Error, bytes]:
        instruction, parameters = packet.instruction, packet.parameters
        if instruction == Instruction.REBOOT:
            servo.boot()
            return Error.NONE, b""
        if instruction == Instruction.FACTORY_RESET:
            keep = parameters[0] if parameters else 0
            refused = packet.id == BROADCAST and keep == 0xFF
            return (Error.RESULT_FAIL if refused else servo.factory_reset(keep)), b""
        act = self._simple.get(instruction)
        return act(servo, parameters) if act is not None else (Error.INSTRUCTION, b"")

    def _read_several(
        self, asked: list[tuple[int, int, int]], heard: list[EmulatedServo], fast: bool
    ) -> list[tuple[EmulatedServo, bytes]]:
        """Each servo waits for the one named before it, so a missing one silences all behind it."""
        by_id = {servo.id: servo for servo in heard}
        chain: list[tuple[EmulatedServo, Status]] = []
        for id, address, length in asked:
            servo = by_id.get(id)
            if servo is None or (fast and servo.firmware < FAST_READ_FIRMWARE):
                break
            error, data = servo.read(address, length)
            chain.append((servo, Status(id, error | servo.alert, data)))
        if not fast:
            answering = ((servo, status) for servo, status in chain if servo["status_return_level"] >= 1)
            return [(servo, protocol.encode_status(*status)) for servo, status in answering]
        if sum(length + 4 for *_, length in asked) >= protocol.MAX_LENGTH:
            return []
        answered = [status._replace(data=status.data or bytes(asked[k][2])) for k, (_, status) in enumerate(chain)]
        missing = [Status(id, 0, bytes(length)) for id, _, length in asked[len(chain) :]]
        pieces = protocol.encode_fast_status(answered + missing)
        return [(servo, piece) for (servo, _), piece in zip(chain, pieces, strict=False)]


# ---- parameters of the instructions ----


def _words(parameters: bytes) -> tuple[int, int]:
    return int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")


def _parts(parameters: bytes, size: int) -> Iterator[bytes]:
    """Whole parts of ``size`` bytes; a rest is ignored."""
    for start in range(0, len(parameters) - size + 1, size):
        yield parameters[start : start + size]


def _bulk_parts(parameters: bytes) -> Iterator[tuple[int, int, bytes]]:
    while len(parameters) >= 5:
        address, length = _words(parameters[1:])
        if len(parameters) < 5 + length:
            return
        yield parameters[0], address, parameters[5 : 5 + length]
        parameters = parameters[5 + length :]


def _write_several(parts: list[tuple[int, int, bytes]], heard: list[EmulatedServo]) -> None:
    """Sync and bulk writes are never answered: what a servo refuses is lost without a word."""
    by_id = {servo.id: servo for servo in heard}
    for id, address, data in parts:
        if id in by_id:
            by_id[id].write(address, data)


def _ping(servo: EmulatedServo, parameters: bytes) -> tuple[Error, bytes]:
    return Error.NONE, protocol.word(servo.table.model_number) + bytes([servo.firmware])


def _read(servo: EmulatedServo, parameters: bytes) -> tuple[Error, bytes]:
    return servo.read(*_words(parameters)) if len(parameters) == 4 else (Error.DATA_LENGTH, b"")


def _write(act: Callable[[int, bytes], Error], parameters: bytes) -> Error:
    if len(parameters) < 3:
        return Error.DATA_LENGTH
    return act(int.from_bytes(parameters[:2], "little"), parameters[2:])
