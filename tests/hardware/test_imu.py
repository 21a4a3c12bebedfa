"""The IMU: the chip on an emulated I2C bus, frames, the stream on a pseudo-terminal and in memory; units and calibration."""

import os
import struct
import time
from dataclasses import replace

import numpy as np
import pytest
from hand_clock import HandClock, HandDevice
from pydantic import ValidationError

from wlr_gym.base.errors import InputError
from wlr_gym.hardware import calibration as calibrate
from wlr_gym.hardware.config import ImuCalibration, ImuPort, load_hardware, with_ports
from wlr_gym.hardware.imu import (
    IMU_FRAMES,
    STANDARD_GRAVITY,
    Conversion,
    ImuGoneError,
    ImuStream,
    Mpu6050,
    accel_per_count,
    gyro_per_count,
    make_imu,
    open_bus,
    to_counts,
)
from wlr_gym.hardware.safety.preflight import check_imu, open_ports
from wlr_gym.hardware.serial_frames import FrameParser, PortInUseError, StreamClock
from wlr_gym.hardware.servos import Servos
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import load_robot

G = STANDARD_GRAVITY
PORT = ImuPort(port="/dev/i2c-9", driver="i2c", rate=200.0)


class Chip:
    """MPU-6050 behind the three calls of smbus2: registers with their resets, sleep, ranges, data-ready flag, sampling."""

    def __init__(self, clock, identity=0x68):
        self.clock, self.identity = clock, identity
        self.angular_velocity, self.force, self.celsius = np.zeros(3), np.array([0.0, 0.0, G]), 25.0
        self.failures = 0
        self.closed = False
        self.blocks = []
        self.power_on()

    def power_on(self):
        self.memory = bytearray(128)
        self.memory[0x6B], self.memory[0x75] = 0x40, self.identity
        self.sampled = self.clock()

    def _sample(self):
        """Refresh the data registers if a sample fell due since the last look."""
        asleep = self.memory[0x6B] & 0x40
        filtered = 1 <= self.memory[0x1A] & 7 <= 6
        period = (1 + self.memory[0x19]) / (1000.0 if filtered else 8000.0)
        if asleep or self.clock() - self.sampled < period - 1e-9:
            return
        self.sampled = self.clock()
        gyro_range = (250, 500, 1000, 2000)[self.memory[0x1B] >> 3 & 3]
        accel_range = (2, 4, 8, 16)[self.memory[0x1C] >> 3 & 3]
        force = to_counts(self.force, accel_per_count(accel_range))
        rate = to_counts(self.angular_velocity, gyro_per_count(gyro_range))
        self.memory[0x3B:0x49] = struct.pack(">7h", *force, round((self.celsius - 36.53) * 340), *rate)
        if self.memory[0x38] & 1:
            self.memory[0x3A] |= 1

    def _fail(self, address):
        if self.failures > 0 or address != 0x68:
            self.failures -= 1
            raise OSError(121, "Remote I/O error")

    def write_byte_data(self, address, register, value):
        self._fail(address)
        if register == 0x6B and value & 0x80:
            self.power_on()
        elif register not in (0x75, 0x3A) and not 0x3B <= register <= 0x48:
            self.memory[register] = value

    def read_byte_data(self, address, register):
        return self.read_i2c_block_data(address, register, 1)[0]

    def read_i2c_block_data(self, address, register, length):
        assert length <= 32
        self._fail(address)
        self._sample()
        data = list(self.memory[register : register + length])
        self.blocks.append((register, length))
        if register <= 0x3A < register + length:
            self.memory[0x3A] = 0  # reading clears
        return data

    def close(self):
        self.closed = True


@pytest.fixture
def clock():
    return HandClock()


@pytest.fixture
def chip(clock):
    return Chip(clock)


def connect(chip, port=PORT):
    imu = Mpu6050(port, chip.clock, lambda path: chip, chip.clock.sleep)
    imu.open()
    chip.clock.now += 0.02
    return imu


def read(imu):
    """Read ``imu``, which must have a reading."""
    reading = imu.read()
    assert reading is not None
    return reading


# ---- the chip ----


def test_the_chip_is_set_up_as_the_file_says(chip):
    connect(chip, PORT.model_copy(update={"gyro_range": 1000, "accel_range": 8, "bandwidth": 21, "rate": 100.0}))
    assert [chip.memory[register] for register in (0x6B, 0x1A, 0x19, 0x1B, 0x1C, 0x38)] == [1, 4, 9, 0x10, 0x10, 1]
    connect(chip)
    assert [chip.memory[register] for register in (0x6B, 0x1A, 0x19, 0x1B, 0x1C, 0x38)] == [1, 3, 4, 0x08, 0x08, 1]


@pytest.mark.parametrize("gyro_range", [250, 500, 1000, 2000])
@pytest.mark.parametrize("accel_range", [2, 4, 8, 16])
def test_si_values_at_every_range(chip, gyro_range, accel_range):
    imu = connect(chip, PORT.model_copy(update={"gyro_range": gyro_range, "accel_range": accel_range}))
    chip.angular_velocity, chip.force, chip.celsius = np.array([0.5, -1.0, 2.0]), np.array([-3.0, 5.0, 9.0]), 31.0
    chip.clock.now += 0.02
    reading = read(imu)
    np.testing.assert_allclose(reading.gyro, chip.angular_velocity, atol=gyro_per_count(gyro_range))
    np.testing.assert_allclose(reading.accelerometer, chip.force, atol=accel_per_count(accel_range))
    assert reading.temperature == pytest.approx(31.0, abs=0.01)
    assert reading.age == 0.0


def test_all_axes_come_in_one_burst(chip):
    imu = connect(chip)
    chip.blocks.clear()
    imu.read()
    assert chip.blocks == [(0x3A, 15)]


def test_one_bus_error_is_repeated_many_age_and_end(chip):
    imu = connect(chip)
    assert read(imu).age == 0.0
    chip.clock.now += 0.02
    chip.failures = 1
    assert read(imu).age == 0.0
    assert (imu.statistics.errors, imu.statistics.lost) == (1, 0)
    chip.failures = 4
    for tick in (1, 2):
        chip.clock.now += 0.02
        assert read(imu).age == pytest.approx(0.02 * tick)
    assert (imu.statistics.errors, imu.statistics.lost) == (5, 2)
    chip.failures = 10**6
    for _ in range(22):
        imu.read()
    with pytest.raises(ImuGoneError, match="0x68 on /dev/i2c-9 is gone"):
        imu.read()


def test_a_chip_that_fell_asleep_shows_as_age(chip):
    imu = connect(chip)
    reading = imu.read()
    chip.power_on()
    for _ in range(3):
        chip.clock.now += 0.02
        reading = imu.read()
    assert reading is not None
    assert reading.age == pytest.approx(0.06)
    assert reading.accelerometer[2] == pytest.approx(G, abs=0.01)  # the last good one, not the zeros of a sleeping chip
    assert imu.statistics.unchanged == 3


@pytest.mark.parametrize(
    ("identity", "words"),
    [(0x70, r"0x70 \(MPU-6500\)"), (0x00, "unknown chip"), (0x68, None)],
    ids=["relative", "none", "right"],
)
def test_another_chip_is_refused(clock, identity, words):
    chip = Chip(clock, identity)
    if words is None:
        connect(chip)
        return
    with pytest.raises(InputError, match=words):
        connect(chip)
    assert chip.closed


def test_nobody_at_the_address_and_a_stuck_register(clock, chip, monkeypatch):
    with pytest.raises(InputError, match="AD0"):
        connect(chip, PORT.model_copy(update={"address": 0x69}))
    chip = Chip(clock)
    write = chip.write_byte_data
    monkeypatch.setattr(chip, "write_byte_data", lambda a, r, v: None if r == 0x1A else write(a, r, v))
    with pytest.raises(InputError, match="register 0x1a reads 0x00 after 0x03 was written"):
        connect(chip)


def test_a_bus_that_is_not_there():
    pytest.importorskip("smbus2")
    with pytest.raises(InputError, match="join the group 'i2c'"):
        make_imu(PORT).open()


@pytest.mark.parametrize("rate", [300.0, 3.0, 999.0])
def test_rates_the_chip_cannot_do_are_refused(rate):
    with pytest.raises(ValidationError, match="1000 Hz over a whole number"):
        ImuPort(port="x", driver="i2c", rate=rate)
    assert ImuPort(port="x", rate=rate).rate == rate


# ---- frames and units ----


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


# ---- the stream ----


def frame(stamp, sequence=0, gyro=(0, 0, 0)):
    return IMU_FRAMES.encode((sequence, round(stamp * 1e6), 0, 0, 8192, -2220, *gyro))


@pytest.fixture
def memory():
    return HandDevice()


@pytest.fixture
def stream(clock, memory):
    stream = ImuStream(ImuPort(port="x", rate=200.0), clock, lambda *port: memory)
    stream.open()
    return stream


def test_newest_frame_wins_and_losses_are_counted(clock, memory, stream):
    assert stream.read() is None
    memory.data = frame(1.0, 1) + frame(1.005, 2)[:9] + b"noise" + frame(1.010, 3) + frame(1.015, 4, (100, 0, 0))
    reading = stream.read()
    assert reading.gyro[0] == pytest.approx(100 * gyro_per_count(500))
    assert reading.accelerometer[2] == pytest.approx(G, abs=1e-3)
    assert (stream.statistics.readings, stream.statistics.lost) == (3, 1)
    clock.now += 0.5
    assert stream.read().age == pytest.approx(0.5)


def test_what_piled_up_before_is_thrown_away(memory, stream):
    memory.data = frame(1.0)
    stream.open()
    assert stream.read() is None


def test_age_is_told_from_the_microcontrollers_clock_over_its_turn(clock, memory, stream):
    start = 2**32 * 1e-6 - 1.0  # turns after a second
    for tick in range(200):
        clock.now = 0.02 * tick
        memory.data = frame(start + clock.now, tick)
        assert stream.read().age == pytest.approx(0.0, abs=1e-4)
    clock.now += 0.3
    memory.data = frame(start + clock.now - 0.25, 200)  # 0.25 s in some buffer
    assert stream.read().age == pytest.approx(0.25, abs=0.01)
    assert stream.statistics.restarts == 0
    clock.now += 0.02
    memory.data = frame(0.004, 201)
    assert stream.read().age == 0.0
    assert stream.statistics.restarts == 1


def frames(begin, end):
    """Frames at 200 Hz, stamped 100 s ahead of the computer's clock."""
    return b"".join(frame(100.0 + k / 200, k % 65536) for k in range(round(begin * 200), round(end * 200)))


def test_a_backlog_is_read_to_its_end(clock, memory, stream):
    memory.data, clock.now = frames(0.0, 0.02), 0.02
    assert stream.read().age == 0.0
    memory.data, clock.now = frames(0.02, 3.5), 3.5  # 16.7 kB
    assert stream.read().age < 0.005
    assert memory.data == b""
    assert (stream.statistics.readings, stream.statistics.restarts, stream.statistics.lost) == (700, 0, 0)


def test_a_backlog_that_was_cut_off_tells_its_age(clock, memory, stream):
    """The system kept the oldest 0.85 s and threw the rest away."""
    memory.data, clock.now = frames(0.0, 0.02), 0.02
    stream.read()
    for now in (3.5, 6.0):
        memory.data, clock.now = frames(now - 2.5, now - 2.5 + 0.85), now
        assert stream.read().age == pytest.approx(1.65, abs=0.13)
    clock.now += 0.02
    memory.data = frames(6.0, 6.02)
    assert stream.read().age == 0.0
    assert stream.statistics.restarts == 0


def test_a_first_backlog_is_of_unknown_age(clock, memory, stream):
    """Nobody has read since the port was opened: the newest may be as old as that."""
    memory.data, clock.now = frames(0.0, 0.85), 3.5
    assert stream.read() is None
    memory.data, clock.now = frames(3.5, 3.52), 3.52
    assert stream.read().age == 0.0
    assert stream.statistics.restarts == 0


class Feed:
    """A clock with which frames come at 200 Hz into a port that keeps 16 kB of what nobody reads, and throws the rest away."""

    def __init__(self, clock, memory):
        self.clock, self.memory, self.sent = clock, memory, 0

    def now(self):
        return self.clock.now

    def wait_until(self, moment):
        while (self.sent + 1) / 200 <= moment + 1e-9:
            self.sent += 1
            if len(self.memory.data) < 16384:
                still = (self.sent % 2, 0, 0)
                self.memory.data += frame(100.0 + self.sent / 200, self.sent % 65536, still)
        self.clock.now = max(self.clock.now, moment)


@pytest.mark.parametrize("unread", [0.0, 1.0, 3.5, 9.0])
def test_the_doctor_sees_the_true_rate_whatever_piled_up(clock, memory, stream, unread):
    feed = Feed(clock, memory)
    feed.wait_until(unread)
    checks = {check.what: check for check in check_imu(stream, ImuPort(port="x", rate=200.0), feed)}
    assert 196 <= float(checks["rate"].found.split()[0]) <= 204
    assert checks["losses"].found.startswith("0 lost")
    del checks["axis"]  # the feed moves one axis only
    assert all(check.ok for check in checks.values()), list(map(str, checks.values()))


def test_a_microcontroller_that_restarts_while_nobody_reads(clock, memory, stream):
    memory.data, clock.now = frames(0.0, 0.02), 0.02
    stream.read()
    memory.data, clock.now = frames(0.02, 0.4) + frame(0.1, 0) + frame(0.105, 1), 2.0
    assert stream.read() is None
    memory.data, clock.now = frame(0.125, 5), 2.02
    assert stream.read().age == 0.0
    assert stream.statistics.restarts == 1


def test_a_frame_that_comes_again_and_again_ages(clock, memory, stream):
    for clock.now in (0.0, 0.02, 0.2):
        memory.data = frame(1.0, 7)
        reading = stream.read()
    assert reading.age == pytest.approx(0.2, abs=0.01)
    assert stream.statistics.lost == 0


@pytest.mark.parametrize("error", [-0.01, 0.0, 0.01])
def test_clocks_may_drift_and_arrival_may_jitter(error):
    rng = np.random.default_rng(3)
    ages, frames = [], StreamClock()
    for tick in range(9000):  # three minutes
        now = 0.02 * tick
        delay = 0.001 + 0.004 * rng.random()
        age, restarted = frames.age(round((now - delay) * (1 + error) * 1e6) % 2**32, now)
        assert not restarted
        assert age is not None
        ages.append((age, delay))
    age, delay = np.array(ages[100:]).T
    assert np.abs(age - (delay - 0.001)).max() < 0.004


def test_a_port_that_goes_away(memory, stream):
    memory.gone = True
    with pytest.raises(ImuGoneError, match="IMU port x is gone"):
        stream.read()
    stream.close()
    with pytest.raises(ImuGoneError, match="not open"):
        stream.read()


def test_a_port_that_is_not_there():
    pytest.importorskip("serial")
    with pytest.raises(InputError, match=r"no_such_port: cannot be opened"):
        make_imu(ImuPort(port="/dev/no_such_port", rate=200.0)).open()


def test_a_stream_in_use_is_refused_and_the_doctor_says_what_to_do(tmp_path):
    """Who looks at a robot that drives must not take its readings."""
    pytest.importorskip("termios")
    ours, theirs = os.openpty()
    hardware = with_ports(load_hardware(), {name: os.ttyname(theirs) for name in ("legs", "imu")})
    try:
        first, other = ImuStream(hardware.imu), ImuStream(hardware.imu)
        first.open()
        with pytest.raises(PortInUseError, match=r"IMU port .* is in use by another program"):
            other.open()
        servos = Servos(load_robot("emanual"), with_ports(hardware, {"wheels": str(tmp_path / "none")}))
        found = {check.where: check for check in open_ports(servos, other, hardware)}
        first.close()
        assert {where: "End that program first" in check.remedy for where, check in found.items()} == {
            "legs": True, "wheels": False, "imu": True,
        }  # fmt: skip
        other.open()
        other.close()
    finally:
        os.close(ours)
        os.close(theirs)


def test_a_chip_in_use_is_refused(tmp_path, monkeypatch):
    smbus2 = pytest.importorskip("smbus2")

    class Bus:
        def __init__(self, path):
            self.fd = os.open(path, os.O_RDWR | os.O_CREAT)

        def close(self):
            os.close(self.fd)

    monkeypatch.setattr(smbus2, "SMBus", Bus)
    path = str(tmp_path / "i2c-1")
    first = open_bus(path)
    with pytest.raises(PortInUseError, match=r"IMU bus .*i2c-1 is in use by another program"):
        open_bus(path)
    first.close()
    open_bus(path).close()


def test_on_the_emulated_robots_port():
    pytest.importorskip("serial")
    pytest.importorskip("termios")
    from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
    from wlr_gym.hardware.emulator.line import NO_TIME
    from wlr_gym.robot import load_robot

    machine = Machine(load_robot("emanual"), load_hardware(), MachineOptions(timing=NO_TIME, sensor_noise=False))
    with Server(machine, real_time=False) as server:
        port = with_ports(machine.hardware, server.ports).imu
        imu = make_imu(port, lambda: machine.time)
        imu.open()
        server.advance(0.5)
        end = time.monotonic() + 5.0
        while imu.statistics.readings < 100 and time.monotonic() < end:  # the system passes bytes on when it likes
            imu.read()
        server.advance(0.02)
        while (reading := imu.read()) is None and time.monotonic() < end:
            pass
        assert reading is not None
        assert reading.age < 0.025
        np.testing.assert_allclose(reading.accelerometer, [0.0, 0.0, 9.81], atol=0.02)
        np.testing.assert_allclose(reading.gyro, 0.0, atol=0.01)
        assert imu.statistics.readings >= 100
        server.command("unplug imu")
        server.advance(0.01)
        with pytest.raises(ImuGoneError):
            imu.read()
        imu.close()


# ---- calibration ----

TRUE = ImuCalibration(
    gyro_bias=(0.02, -0.1, 0.05), accel_offset=(0.3, -0.2, 0.7), accel_scale=(1.02, 0.99, 0.97), mounting=(0.05, -0.1, 1.6)
)
SIDES = np.vstack([np.eye(3), -np.eye(3)])


def to_body(known=TRUE):
    roll, pitch, yaw = (np.array([angle]) for angle in known.mounting)
    return rotation(yaw, pitch, roll)[0]


def measured(force_in_body, known=TRUE):
    return to_body(known).T @ np.asarray(force_in_body) / np.array(known.accel_scale) + np.array(known.accel_offset)


def pose(accelerometer, gyro=TRUE.gyro_bias):
    return calibrate.RestPose(np.array(gyro), np.array(accelerometer), 30.0)


def test_conversion_takes_the_errors_off_and_turns_into_the_body():
    port = ImuPort(port="x", rate=200.0, calibration=TRUE)
    force, rate = np.array([1.0, -2.0, 9.0]), np.array([0.3, 0.2, -0.4])
    counts = to_counts(measured(force), accel_per_count(4))
    gyro = to_counts(to_body().T @ rate + np.array(TRUE.gyro_bias), gyro_per_count(500))
    reading = Conversion(port).reading((*counts, 0, *gyro), 0.0)
    np.testing.assert_allclose(reading.accelerometer, force, atol=3e-3)
    np.testing.assert_allclose(reading.gyro, rate, atol=1e-3)
    assert Conversion(port).counts(force, rate) == (counts, gyro)


def test_six_positions_by_hand_give_offset_and_scale():
    rng = np.random.default_rng(1)
    poses = []
    for side in SIDES:
        tilted = side + rng.uniform(-0.15, 0.15, 3)  # nobody holds it exactly
        poses.append(pose(measured(G * tilted / np.linalg.norm(tilted))))
    offset, scale = calibrate.six_positions(poses)
    np.testing.assert_allclose(offset, TRUE.accel_offset, atol=2e-5)
    np.testing.assert_allclose(scale, TRUE.accel_scale, atol=2e-6)


def test_poses_that_tell_nothing_are_refused():
    with pytest.raises(InputError, match="5 poses, expected 6"):
        calibrate.six_positions([pose(measured(G * side)) for side in SIDES[:5]])
    with pytest.raises(InputError, match="too alike"):
        calibrate.six_positions([pose(measured(G * side)) for side in [*SIDES[:3], *SIDES[:3]]])
    wild = TRUE.model_copy(update={"accel_scale": (1.3, 1.0, 1.0)})
    with pytest.raises(InputError, match="no healthy chip"):
        calibrate.six_positions([pose(measured(G * side, wild)) for side in SIDES])


@pytest.mark.parametrize("turn", [0.0, 1.6, -3.0])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.05, -0.1), (3.1, 0.3), (0.0, np.pi / 2)])
def test_mounting_from_two_poses(tilt, turn):
    known = ImuCalibration(mounting=(*tilt, turn))
    nose_down = np.array([-np.sin(0.3), 0.0, np.cos(0.3)]) * G
    found = calibrate.mounting(measured([0, 0, G], known), measured(nose_down, known))
    np.testing.assert_allclose(to_body(ImuCalibration(mounting=found)), to_body(known), atol=1e-9)


def test_mounting_needs_a_tilt():
    with pytest.raises(InputError, match=r"tilted by 5\.0 deg only"):
        calibrate.mounting(np.array([0, 0, G]), G * np.array([-np.sin(np.deg2rad(5)), 0, np.cos(np.deg2rad(5))]))


def test_offset_of_a_level_robot():
    known = replace_offset(TRUE)
    offset = calibrate.level_offset(pose(measured([0, 0, G])), known, to_body())
    np.testing.assert_allclose(offset, TRUE.accel_offset, atol=1e-3)
    with pytest.raises(InputError, match="level floor"):
        calibrate.level_offset(pose(measured([0.25 * G, 0, 0.97 * G])), known, to_body())


def replace_offset(known):
    return known.model_copy(update={"accel_offset": (0.0, 0.0, 0.0)})


def samples(count=400, seed=0):
    rng = np.random.default_rng(seed)
    return 0.0015 * rng.standard_normal((count, 3)) + TRUE.gyro_bias, 0.04 * rng.standard_normal((count, 3)) + [0, 0, G]


def test_rest_is_told_from_motion():
    gyro, force = samples()
    found = calibrate.rest_pose(gyro, force, 31.0)
    np.testing.assert_allclose(calibrate.gyro_bias(found), TRUE.gyro_bias, atol=4e-4)
    swaying = 0.05 * np.sin(np.linspace(0, 9, 400))[:, None]
    turning = np.linspace(0, 0.05, 400)[:, None]
    for moved in (gyro + swaying, gyro + turning):
        with pytest.raises(InputError, match="was moved: the gyroscope"):
            calibrate.rest_pose(moved, force, 31.0)
    with pytest.raises(InputError, match="was moved: the accelerometer"):
        calibrate.rest_pose(gyro, force + 20 * swaying, 31.0)
    with pytest.raises(InputError, match="30 readings of the IMU, expected 50"):
        calibrate.rest_pose(gyro[:30], force[:30], 31.0)
    with pytest.raises(InputError, match="is gyro_range right"):
        calibrate.gyro_bias(replace(found, gyro=np.array([0.5, 0, 0])))
