"""One emulated bus: who answers which instruction, in what order, and when the bytes reach the host."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
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
#: Status Return Level from which an instruction is answered; all others from 2.
_ANSWER_LEVEL: dict[int, int] = {Instruction.PING: 0, Instruction.READ: 1}


class Emission(NamedTuple):
    """Bytes that reach the host at ``time`` (s)."""

    time: float
    data: bytes


@dataclass(frozen=True)
class LineTiming:
    """How long things take on the line and in the adapter."""

    wire: bool = True  #: count 10 bits per byte at the line's baud rate, both ways, and the servos' Return Delay Time
    turnaround: float = 50e-6  #: s a servo needs to answer, on top of its Return Delay Time
    usb_latency: float = 0.001  #: s the adapter holds back a USB packet that is not full (FTDI default 0.016, advised 0.001)


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
            heard = [
                servo
                for servo in self.servos
                if servo.answers
                and baud_rate in (None, servo.baud_rate)
                and not self._faults.happens(now, "deaf", [servo.name, self.name])
            ]
            for servo in heard:
                servo.hear()
            emissions += self._send(self._answer(packet, heard), start, now, baud_rate)
        return emissions

    def forget(self) -> None:
        """Drop half-received instructions (the adapter was unplugged)."""
        self._parser.clear()

    def _wire_time(self, count: int, baud_rate: int | None) -> float:
        speed = baud_rate or self.servos[0].baud_rate
        return count * _BITS_PER_BYTE / speed if self.timing.wire else 0.0

    def _send(
        self, answers: Sequence[tuple[EmulatedServo, bytes]], start: float, now: float, baud_rate: int | None
    ) -> Iterator[Emission]:
        """Put answers on the wire one after the other; the adapter passes them on in USB packets."""
        held: list[tuple[float, bytes]] = []  # (delay by a fault, bytes) of the USB packet being filled
        late = self._faults.active(now, "late_answers", [self.name])
        latency = self.timing.usb_latency if late is None else late.value
        for k, (servo, raw) in enumerate(answers):
            waits = self.timing.wire and (k == 0 or raw.startswith(protocol.HEADER))
            pause = servo["return_delay_time"] * 2e-6 if waits else 0.0
            start += pause + self.timing.turnaround + self._wire_time(len(raw), baud_rate)
            arrived, delay = self._faults.mangle(now, raw, [servo.name, self.name])
            held.append((delay, arrived))
            if sum(len(data) for _, data in held) >= USB_PACKET:
                yield from (Emission(start + delay, data) for delay, data in held if data)
                held = []
        yield from (Emission(start + latency + delay, data) for delay, data in held if data)
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
            servo.is_worn = "eeprom_worn" in values
            shaft = servo.shaft
            shaft.strength = -1.0 if "motor_reversed" in values else values.get("slow_servo", 1.0)
            shaft.offset = values.get("encoder_jump", 0.0)
            backwards = -1.0 if "encoder_reversed" in values else 1.0
            shaft.gain = 0.0 if "encoder_frozen" in values else backwards * values.get("encoder_gain", 1.0)
            shaft.drift = values.get("encoder_drift", 0.0)
            shaft.stuck = round(values["current_stuck"]) if "current_stuck" in values else None

    # ---- who answers ----

    def _answer(self, packet: Packet, heard: list[EmulatedServo]) -> list[tuple[EmulatedServo, bytes]]:
        instruction, parameters = packet.instruction, packet.parameters
        address, length = _words(parameters)
        is_fast = instruction in (Instruction.FAST_SYNC_READ, Instruction.FAST_BULK_READ)
        match instruction:
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
                return _read_several([(id, address, length) for id in parameters[4:]], heard, is_fast)
            case Instruction.BULK_READ | Instruction.FAST_BULK_READ:
                whole = len(parameters) // _BULK.size * _BULK.size
                return _read_several(list(_BULK.iter_unpack(parameters[:whole])), heard, is_fast)
            case Instruction.SYNC_WRITE:
                starts = range(4, len(parameters) - length, length + 1)
                _write_several([(parameters[k], address, parameters[k + 1 : k + 1 + length]) for k in starts], heard)
                return []
            case Instruction.BULK_WRITE:
                _write_several(list(_bulk_parts(parameters)), heard)
                return []
        return self._answer_one(packet, heard)

    def _answer_one(self, packet: Packet, heard: list[EmulatedServo]) -> list[tuple[EmulatedServo, bytes]]:
        """Instructions to one servo, or to all of them at once (only a ping is then answered)."""
        answers = []
        for servo in sorted(heard, key=lambda servo: servo["id"]):
            own = servo["id"]
            if packet.id not in (own, BROADCAST):
                if packet.id == servo["secondary_id"] and packet.instruction == Instruction.WRITE:
                    _carry_out(servo, packet)
                continue
            alert, level = servo.alert, servo["status_return_level"]
            error, data = _carry_out(servo, packet)
            is_silent = packet.id == BROADCAST and packet.instruction != Instruction.PING
            if level >= _ANSWER_LEVEL.get(packet.instruction, 2) and not is_silent:
                raw = protocol.encode_status(own, error | alert, data)
                if answers and answers[-1][0]["id"] == own:  # two servos of one id speak at the same time: zeros win
                    raw = bytes(byte & other for byte, other in zip(answers.pop()[1], raw, strict=False))
                answers.append((servo, raw))
        return answers


def _carry_out(servo: EmulatedServo, packet: Packet) -> tuple[Error, bytes]:
    parameters = packet.parameters
    match packet.instruction:
        case Instruction.PING:
            return Error.NONE, protocol.word(servo.table.model_number) + bytes([servo.firmware])
        case Instruction.READ if len(parameters) == 4:
            return servo.read(*_words(parameters))
        case Instruction.WRITE if len(parameters) >= 3:
            return servo.write(_words(parameters)[0], parameters[2:]), b""
        case Instruction.READ | Instruction.WRITE:
            return Error.DATA_LENGTH, b""
        case Instruction.CLEAR:
            return servo.clear(parameters), b""
        case Instruction.REBOOT:
            servo.boot()
            return Error.NONE, b""
    return Error.INSTRUCTION, b""


def _read_several(
    asked: Sequence[tuple[int, int, int]], heard: list[EmulatedServo], fast: bool
) -> list[tuple[EmulatedServo, bytes]]:
    """Read (id, address, length) each. A servo waits for the one named before it, so a missing one silences all behind it."""
    by_id = {servo["id"]: servo for servo in heard}
    chain: list[tuple[EmulatedServo, Status]] = []
    for id, address, length in asked:
        servo = by_id.get(id)
        if servo is None or (fast and servo.firmware < FAST_READ_FIRMWARE):
            break
        error, data = servo.read(address, length)
        chain.append((servo, Status(id, error | servo.alert, data)))
    if not fast:
        return [(servo, protocol.encode_status(*status)) for servo, status in chain if servo["status_return_level"] >= 1]
    if sum(length + 4 for *_, length in asked) >= protocol.MAX_LENGTH:
        return []
    answered = [status._replace(data=status.data or bytes(asked[k][2])) for k, (_, status) in enumerate(chain)]
    missing = [Status(id, 0, bytes(length)) for id, _, length in asked[len(chain) :]]
    pieces = protocol.encode_fast_status(answered + missing)
    return [(servo, piece) for (servo, _), piece in zip(chain, pieces, strict=False)]


def _write_several(parts: list[tuple[int, int, bytes]], heard: list[EmulatedServo]) -> None:
    """Write (id, address, data) each. Nobody answers: what a servo refuses is lost without a word."""
    by_id = {servo["id"]: servo for servo in heard}
    for id, address, data in parts:
        if id in by_id:
            by_id[id].write(address, data)


# ---- parameters of the instructions ----

#: Of a bulk read, for each servo: id, address, length.
_BULK = struct.Struct("<BHH")


def _words(parameters: bytes) -> tuple[int, int]:
    return int.from_bytes(parameters[:2], "little"), int.from_bytes(parameters[2:4], "little")


def _bulk_parts(parameters: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Return id, address and data of each part of a bulk write; a rest is ignored."""
    while len(parameters) >= _BULK.size:
        id, address, length = _BULK.unpack_from(parameters)
        data, parameters = parameters[5 : 5 + length], parameters[5 + length :]
        if len(data) == length:
            yield id, address, data
