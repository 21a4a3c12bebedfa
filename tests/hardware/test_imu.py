"""Frames of the IMU stream: round trip, noise, losses, units."""

import numpy as np
import pytest

from wlr_gym.hardware.imu import (
    IMU_FRAMES,
    STANDARD_GRAVITY,
    accel_per_count,
    gyro_per_count,
    to_counts,
)
from wlr_gym.hardware.serial_frames import FrameParser


def random_frames(count, seed=1):
    rng = np.random.default_rng(seed)
    for k in range(count):
        numbers = rng.integers(-32768, 32768, 7).tolist()
        yield ((65500 + k) % 65536, int(rng.integers(2**32)), *numbers)


def test_round_trip_whole_and_in_pieces():
    frames = list(random_frames(500))
    stream = b"".join(map(IMU_FRAMES.encode, frames))
    for size in (len(stream), 1, 7, 24, 100):
        parser = FrameParser(IMU_FRAMES)
        pieces = [stream[start : start + size] for start in range(0, len(stream), size)]
        assert [frame for piece in pieces for frame in parser.feed(piece)] == frames
        assert (parser.crc_errors, parser.lost) == (0, 0)
    assert len(IMU_FRAMES.encode(frames[0])) == IMU_FRAMES.size == 24


def test_noise_and_losses_cost_only_the_frames_they_hit():
    rng = np.random.default_rng(2)
    frames = list(random_frames(400))
    parser, received, expected = FrameParser(IMU_FRAMES), [], []
    for k, frame in enumerate(frames):
        raw = bytearray(IMU_FRAMES.encode(frame))
        if k % 5 == 1:
            raw = bytearray(rng.bytes(11)) + raw
        elif k % 5 == 2:
            raw[int(rng.integers(24))] ^= 1 << int(rng.integers(8))
        elif k % 5 == 3:
            raw = raw[: int(rng.integers(24))]
        if k % 5 not in (2, 3):
            expected.append(frame)
        received += parser.feed(bytes(raw))
    missed = [frame for frame in expected if frame not in received]
    assert [frame for frame in received if frame not in expected] == []
    assert len(missed) <= 0.05 * len(expected)  # a false start in the noise may swallow the frame behind it
    assert parser.lost >= 155


def test_endless_noise_does_not_pile_up():
    parser = FrameParser(IMU_FRAMES)
    for _ in range(50):
        assert parser.feed(b"\x11" * 1000) == []
    assert len(parser._buffer) <= 2 * IMU_FRAMES.size


def test_units_of_the_data_sheet():
    assert to_counts([0.0, 0.0, STANDARD_GRAVITY], accel_per_count(4)) == (0, 0, 8192)
    assert to_counts(np.deg2rad([65.5, 0, -65.5]), gyro_per_count(500)) == (4293, 0, -4293)
    assert to_counts([1e9, -1e9, 0], gyro_per_count(250)) == (32767, -32768, 0)
    assert gyro_per_count(500) == pytest.approx(np.deg2rad(1 / 65.5), rel=1e-3)
