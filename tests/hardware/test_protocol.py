"""The packet codec against the specification's worked examples, the SDK's bytes, and random payloads."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wlr_gym.hardware.dynamixel import protocol
from wlr_gym.hardware.dynamixel.protocol import BROADCAST, Instruction, Packet, Parser, Status

#: (bytes built, bytes printed in the e-manual's Protocol 2.0 examples)
MANUAL = {
    "ping 1": (protocol.ping(1), "FF FF FD 00 01 03 00 01 19 4E"),
    "ping all": (protocol.ping(), "FF FF FD 00 FE 03 00 01 31 42"),
    "ping status": (protocol.encode_status(1, 0, b"\x06\x04\x26"), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    "read": (protocol.read(1, 132, 4), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    "write": (protocol.write(1, 116, b"\x00\x02\x00\x00"), "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    "write status": (protocol.encode_status(1, 0), "FF FF FD 00 01 04 00 55 00 A1 0C"),
    "reboot": (protocol.encode(1, Instruction.REBOOT), "FF FF FD 00 01 03 00 08 2F 4E"),
    "clear": (protocol.encode(1, Instruction.CLEAR, protocol.CLEAR_TURNS), "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC"),
    "sync read": (protocol.sync_read(132, 4, (1, 2)), "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA"),
    "sync write": (
        protocol.sync_write(116, {1: b"\x96\x00\x00\x00", 2: b"\xaa\x00\x00\x00"}),
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    "bulk read": (
        protocol.encode(BROADCAST, Instruction.BULK_READ, bytes.fromhex("01 90 00 02 00 02 92 00 01 00")),
        "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    ),
}


@pytest.mark.parametrize("name", MANUAL)
def test_manual_examples(name):
    built, printed = MANUAL[name]
    assert built.hex(" ").upper() == printed


# --- random payloads


def awkward_bytes(rng, count, longest):
    """Payloads over the bytes that make trouble: FF, FD, 00 and a few others."""
    alphabet = np.frombuffer(bytes([0xFF, 0xFF, 0xFF, 0xFD, 0xFD, 0x00, 0x55, 0x01, 0xFE]), np.uint8)
    lengths = rng.integers(0, longest, count)
    data = rng.choice(alphabet, lengths.sum())
    plain = rng.integers(0, 256, lengths.sum(), dtype=np.uint8)
    mixed = np.where(np.repeat(rng.random(count) < 0.7, lengths), data, plain).tobytes()
    ends = lengths.cumsum()
    return [mixed[end - length : end] for length, end in zip(lengths.tolist(), ends.tolist(), strict=True)]


def test_hundred_thousand_random_payloads_round_trip_in_one_stream():
    rng = np.random.default_rng(20)
    payloads = awkward_bytes(rng, 100_000, 14)
    ids = rng.integers(0, 253, len(payloads)).tolist()
    instructions = rng.integers(1, 256, len(payloads)).tolist()
    sent = [Packet(*triple) for triple in zip(ids, instructions, payloads, strict=True)]
    parser = Parser()
    received = []
    for start in range(0, len(sent), 50):
        received += parser.feed(b"".join(protocol.encode(*packet) for packet in sent[start : start + 50]))
    assert received == sent
    assert parser.crc_errors == 0


@given(st.binary(max_size=300), st.integers(0, 252), st.lists(st.integers(1, 9), min_size=1))
@settings(max_examples=200, deadline=None)
def test_any_cut_of_the_stream_gives_the_same_packets(payload, id, cuts):
    raw = protocol.encode(id, Instruction.WRITE, payload) + protocol.encode_status(id, 0x80, payload)
    parser = Parser()
    received = []
    start = turn = 0
    while start < len(raw):
        size = cuts[turn % len(cuts)]
        received += parser.feed(raw[start : start + size])
        start, turn = start + size, turn + 1
    assert received == [Packet(id, Instruction.WRITE, payload), Packet(id, Instruction.STATUS, b"\x80" + payload)]


def test_noise_truncation_and_bit_flips_cost_only_the_packets_they_hit():
    rng = np.random.default_rng(3)
    parser = Parser()
    expected, received = [], []
    for k, payload in enumerate(awkward_bytes(rng, 3000, 30)):
        raw = protocol.encode_status(k % 250, 0, payload)
        fate = k % 4
        if fate == 1:  # noise, with an unfinished header at its end
            raw = rng.integers(0, 256, 9, dtype=np.uint8).tobytes() + b"\xff\xff\xfd" + raw
        elif fate == 2:
            raw = raw[: rng.integers(1, len(raw) - 1)]
        elif fate == 3:
            raw = bytearray(raw)
            raw[rng.integers(0, len(raw))] ^= 1 << int(rng.integers(0, 8))
        if fate < 2:
            expected.append(Packet(k % 250, Instruction.STATUS, b"\0" + payload))
        received += parser.feed(bytes(raw))
        parser.clear()  # as after each exchange
    assert received == expected
    assert parser.crc_errors > 300


# --- fast reads


def test_fast_answers_split_again_and_carry_running_crcs():
    answers = [Status(2, 0, b"\xff\xff\xfd\x01"), Status(3, 0x80, b"\x00\x01\x02\x03")]
    pieces = protocol.encode_fast_status(answers)
    stream = b"".join(pieces)
    (packet,) = Parser().feed(stream)
    assert protocol.split_fast_status(packet, [4, 4]) == answers
    assert protocol.split_fast_status(packet, [4]) is None
    for end in (len(pieces[0]), len(stream)):
        assert protocol.crc16(stream[: end - 2]) == int.from_bytes(stream[end - 2 : end], "little")


def test_status_of_one_servo_is_told_from_other_packets():
    (status,) = Parser().feed(protocol.encode_status(9, 0x84, b"\x05"))
    answer = protocol.as_status(status)
    assert answer == Status(9, 0x84, b"\x05")
    assert answer is not None
    assert answer.alert
    assert answer.fault == protocol.Error.DATA_RANGE
    assert protocol.as_status(Packet(9, Instruction.READ, b"\0")) is None


# --- the SDK as oracle


class Recorder:
    """Stands in for the SDK's port: keeps what is written, gives back what is queued."""

    def __init__(self, reply=b""):
        self.is_using, self.written, self.reply = False, b"", bytearray(reply)

    def clearPort(self):  # noqa: N802
        pass

    def writePort(self, packet):  # noqa: N802
        self.written += bytes(packet)
        return len(packet)

    def readPort(self, length):  # noqa: N802
        data, self.reply = bytes(self.reply[:length]), self.reply[length:]
        return data

    def setPacketTimeout(self, length):  # noqa: N802
        pass

    def isPacketTimeout(self):  # noqa: N802
        return not self.reply


def sdk_bytes(instruction, id, parameters):
    sdk = pytest.importorskip("dynamixel_sdk")
    port = Recorder()
    packet = [0] * (10 + len(parameters))
    packet[4:8] = [id, (len(parameters) + 3) & 0xFF, (len(parameters) + 3) >> 8, instruction]
    packet[8 : 8 + len(parameters)] = parameters
    sdk.Protocol2PacketHandler().txPacket(port, packet)
    return port.written


def test_same_bytes_as_the_sdk_wherever_nothing_needs_stuffing():
    rng = np.random.default_rng(5)
    compared = 0
    for payload in awkward_bytes(rng, 3000, 24):
        instruction = int(rng.integers(1, 256))
        if b"\xff\xff\xfd" in bytes([instruction]) + payload:
            continue
        assert protocol.encode(17, instruction, payload) == sdk_bytes(instruction, 17, payload)
        compared += 1
    assert compared > 2000


def test_the_sdk_loses_stuffing_and_we_do_not():
    """A servo would reject what dynamixel-sdk 4.1 sends: why the codec is our own."""
    data = b"\x74\x00\xff\xff\xfd\xff"
    sent = sdk_bytes(Instruction.WRITE, 1, data)
    assert Parser().feed(sent) == []
    assert Parser().feed(protocol.encode(1, Instruction.WRITE, data)) == [Packet(1, Instruction.WRITE, data)]
