"""The firmware's very binary on a simulated chip, and the product's readers on the other side of its serial line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated_board import FIRMWARE, SimulatedBoard, build

from wlr_gym.hardware.config import ImuPort
from wlr_gym.hardware.imu import ImuStream
from wlr_gym.hardware.safety.preflight import check_board
from wlr_gym.hardware.serial_frames import FIRMWARE_VERSION, FLOW_FRAMES, FrameParser, TimedFrame

FORCE, TURN = (1.0, -2.0, 9.0), (10.0, -20.0, 30.0)  # m/s2, deg/s
#: s from power to the first samples: the chip's reset takes 0.1.
START = 0.3


#: The MPU-6050's registers at 200 Hz, 500 deg/s, 4 g, 44 Hz, on the gyroscope's clock, with a pulse for new values.
IMU_REGISTERS = {0x19: 4, 0x1A: 3, 0x1B: 8, 0x1C: 8, 0x37: 0, 0x38: 1, 0x6B: 1}
TWBR = 0xB8  # of the ATmega328P
#: The PMW3901's list "performance optimization registers": register, value.
TUNING = bytes.fromhex(
    "7f00 61ad 7f03 4000 7f05 41b3 43f1 4514 5b32 5f34 7b08 7f06 441b 40bf 4e3f 7f08 6520 6a18 7f09 4faf 5f40 4880 4980 5777"
    "6078 6178 6208 6350 7f0a 4560 7f00 4d11 5580 741f 751f 4a78 4b78 4408 4550 64ff 651f 7f14 6567 6608 6370 7f15 4848 7f07"
    "410d 4314 4b0e 450f 4442 4c80 7f10 5b02 7f07 4041 7000 3244 7f07 4040 7f06 62f0 6300 7f0d 48c0 6fd5 7f00 5ba0 4ea8 5a50"
    "4080"
)


def collect(board: SimulatedBoard, stream: ImuStream, seconds: float, step: float = 0.02) -> list[TimedFrame]:
    """Let time pass, reading every ``step`` s, and return all frames."""
    frames = []
    for _ in range(round(seconds / step)):
        board.run(step)
        frames += stream.frames()
    return frames


def status(board: SimulatedBoard, stream: ImuStream) -> dict[str, int]:
    """Ask the board for its status."""
    stream.request_status()
    collect(board, stream, 0.1)
    assert stream.parser.status is not None
    return stream.parser.status


def sample_moments(board: SimulatedBoard, frames: list[TimedFrame], first: int = 0) -> np.ndarray:
    """Return when the samples in ``frames`` were taken: their temperature has their number, modulo 32768."""
    numbers = np.unwrap([frame.numbers[5] for frame in frames], period=32768).astype(int)
    return board.moments()[numbers + first]


def check_everything(folder: Path, tmp_path: Path) -> None:
    """A short run in which each sensor's values, rate, stamps and settings are as they must be."""
    with SimulatedBoard(folder, tmp_path) as board:
        board.set(**dict(zip(("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"), FORCE + TURN, strict=True)))
        board.set(flow_x=3.0, flow_y=-2.0)
        stream = board.imu()
        collect(board, stream, START)
        stream.read()
        frames = collect(board, stream, 1.0)
        assert len(frames) == pytest.approx(200, abs=5)
        assert stream.parser.lost == stream.parser.crc_errors == 0
        reading = stream._convert.reading(frames[-1].numbers[2:], 0.0)
        np.testing.assert_allclose(reading.accelerometer, FORCE, atol=0.003)
        np.testing.assert_allclose(np.rad2deg(reading.gyro), TURN, atol=0.02)
        stamps = np.array([frame.numbers[1] for frame in frames]) * 1e-6
        off = stamps - sample_moments(board, frames) + board.get("clock_start")
        assert abs(off).max() < 2e-5
        assert {at: int(board.command(f"register {at}")) for at in IMU_REGISTERS} == IMU_REGISTERS
        assert int(board.command(f"peek {TWBR}")) == 12  # 400 kHz
        found = status(board, stream)
        assert (found["version_major"], found["version_minor"]) == FIRMWARE_VERSION
        assert (found["imu_rate"], found["gyro_range"], found["accel_range"], found["bandwidth"]) == (200, 500, 4, 44)
        assert found["sensors"] == 3
        assert found["imu_identity"] == 0x68
        names = ("bus_errors", "bus_locks", "imu_restarts", "imu_missed", "flow_restarts", "line_full")
        assert {name: found[name] for name in names} == dict.fromkeys(names, 0)
        stream.close()
        flow = board.flow()
        for _ in range(5):
            board.run(0.02)
            flow.read()
        numbers = [frame.numbers for frame in flow.frames()]
        for _ in range(50):
            board.run(0.02)
            numbers += [frame.numbers for frame in flow.frames()]
        assert len(numbers) == pytest.approx(121, abs=3)
        assert {number[3:6] for number in numbers} == {(3, -2, 90)}
        intervals = np.array([number[2] for number in numbers])
        assert intervals.mean() == pytest.approx(1e6 / 121, rel=0.005)
        assert abs(intervals - 1e6 / 121).max() < 1700
        taken = board.moments(1)[np.array([number[6] for number in numbers]) - 1]
        late = np.array([number[1] for number in numbers]) * 1e-6 - taken
        assert np.ptp(late) < 1.7e-3  # asked every millisecond, after what the IMU takes
        assert flow.parser.lost == flow.parser.crc_errors == 0
        assert board.get("violations") == 0  # times and clock of the data sheet
        assert bytes.fromhex(board.command("writes")) == TUNING
        assert board.get("pause") >= 0.01
        board.set(flow_x=0, flow_y=0)
        still = []
        for _ in range(50):
            board.run(0.02)
            still += [frame.numbers[2] for frame in flow.frames()]
        assert np.mean(still[10:]) == pytest.approx(1e6 / 121, rel=0.005)


def check_troubles(folder: Path, tmp_path: Path) -> None:
    """A bus that hangs, a line that is full, a chip with only half of the identity."""
    with SimulatedBoard(folder, tmp_path) as board:
        stream = board.imu()
        collect(board, stream, START)
        board.set(hang_clocks=7)
        collect(board, stream, 0.1)
        assert status(board, stream)["bus_locks"] == board.get("stops") == 1
        for _ in range(16):
            stream.request_status()
        collect(board, stream, 0.3)
        assert status(board, stream)["line_full"] > 0
        assert stream.parser.crc_errors == 0
        board.set(inverse=0)
        collect(board, stream, 0.3)
        assert status(board, stream)["sensors"] == 1


def test_header_is_that_of_readers_and_emulator():
    words = [sys.executable, "-c", "import header; assert header.HEADER.read_text() == header.header()"]
    subprocess.run(words, cwd=FIRMWARE, check=True)


def test_values_rate_stamps_settings(default_build, tmp_path):
    check_everything(default_build, tmp_path)


#: What is broken -> file, text, replacement.
MUTATIONS = {
    "first register of the burst": ("mpu6050.c", "VALUES = 0x3B", "VALUES = 0x3D"),
    "register of the divider": ("mpu6050.c", "DIVIDER = 0x19", "DIVIDER = 0x18"),
    "range of the gyroscope": ("mpu6050.c", "GYRO_RANGE == 500 ? 1", "GYRO_RANGE == 500 ? 2"),
    "no wait after the reset": ("mpu6050.c", "#define RESET_TIME 100000L", "#define RESET_TIME 10L"),
    "byte order of the IMU": ("mpu6050.c", "raw[2 * k] << 8 | raw[2 * k + 1]", "raw[2 * k + 1] << 8 | raw[2 * k]"),
    "no checksum": ("board.c", "memcpy(bytes + size - 2, &crc, 2);", "(void)crc;"),
    "polynomial of the checksum": ("board.c", "0x8005", "0x1021"),
    "clock": ("board.c", "(count >> 1)", "count"),
    "register of the motion": ("pmw3901.c", "BURST = 0x16", "BURST = 0x17"),
    "byte order of the flow": ("pmw3901.c", "raw[3] << 8 | raw[2]", "raw[2] << 8 | raw[3]"),
    "one of the tuning registers": ("pmw3901.c", "0x48, 0xC0, 0x6F", "0x48, 0xC1, 0x6F"),
    "time from address to data": ("pmw3901.c", "_delay_us(35); /* t_SRAD */", "_delay_us(5);"),
    "speed of SPI": ("pmw3901.c", " | _BV(SPR0)", ""),
    "bandwidth": ("mpu6050.c", "BANDWIDTH == 44 ? 3", "BANDWIDTH == 44 ? 4"),
    "clock of the IMU": ("mpu6050.c", "{POWER_1, 0x01}", "{POWER_1, 0x00}"),
    "speed of the two-wire bus": ("mpu6050.c", "400000L - 16", "800000L - 16"),
    "speed of the line": ("board.c", "UBRR0 = DIVISOR - 1", "UBRR0 = DIVISOR"),
    "edge of the stamp": ("board.c", "_BV(ICNC1) | _BV(ICES1)", "_BV(ICNC1)"),
    "time from clock to NCS": ("pmw3901.c", "_delay_us(35); /* t_SCLK-NCS */", "_delay_us(1);"),
    "another of the tuning registers": ("pmw3901.c", "0x65, 0x67", "0x65, 0x66"),
    "pause in the tuning": ("pmw3901.c", "PAUSE, 10,", "PAUSE, 0,"),
    "period of the flow": ("pmw3901.c", "PERIOD 8264", "PERIOD 8000"),
}
#: As above, for what only trouble shows.
TROUBLES = {
    "no stop on a freed bus": ("mpu6050.c", "DDRC |= _BV(4); /* stop", "/* stop"),
    "dropped frames are not counted": ("board.c", "board.line_full++;", ""),
    "a full line is overwritten": ("board.c", "(uint8_t)(tail - head - 1) < size", "size == 0"),
    "inverse identity": ("pmw3901.c", " && read_register(INVERSE) == (uint8_t)~IDENTITY", ""),
}


def test_troubles(default_build, tmp_path):
    check_troubles(default_build, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("what", [*MUTATIONS, *TROUBLES])
def test_broken_firmware_is_caught(what, default_build, tmp_path):
    name, text, replacement = (MUTATIONS | TROUBLES)[what]
    source = tmp_path / "source"
    shutil.copytree(FIRMWARE, source, ignore=shutil.ignore_patterns("build", "*.md", "__pycache__"))
    file = source / "wlr_board" / name
    assert file.read_text().count(text) == 1
    file.write_text(file.read_text().replace(text, replacement))
    folder = build(tmp_path / "built", source)
    with pytest.raises(AssertionError):
        (check_everything if what in MUTATIONS else check_troubles)(folder, tmp_path)


@pytest.mark.parametrize(
    "setting", [{"GYRO_RANGE": 400}, {"ACCEL_RANGE": 3}, {"BANDWIDTH": 42}, {"BAUD_RATE": 230400}, {"IMU_RATE": 300}]
)
def test_settings_the_chips_do_not_have_are_refused(setting, default_build, tmp_path):
    with pytest.raises(AssertionError, match=f"{next(iter(setting))}: expected|{next(iter(setting))}: the board"):
        build(tmp_path, **setting)


def test_500_hz(fast_build, tmp_path):
    with SimulatedBoard(fast_build, tmp_path) as board:
        board.set(flow_x=2.0, imu_ppm=8000.0)
        stream = board.imu(500000)
        collect(board, stream, START)
        frames = collect(board, stream, 2.0)
        assert len(frames) == pytest.approx(1008, abs=5)
        assert stream.parser.lost == 0
        found = status(board, stream)
        assert (found["imu_rate"], found["baud_rate"]) == (500, 500000)
        assert found["imu_missed"] == found["line_full"] == 0


def test_a_reader_at_another_speed_gets_nothing(board):
    stream = board.imu(57600)
    assert collect(board, stream, 1.0) == []


@pytest.mark.parametrize("ppm", [-5000.0, 5000.0])
def test_stamps_of_a_clock_that_drifts(board, ppm):
    board.set(board_ppm=ppm, imu_ppm=-7000.0)
    stream = board.imu()
    collect(board, stream, START)
    frames = collect(board, stream, 5.0)
    true = sample_moments(board, frames)
    stamps = np.array([frame.numbers[1] for frame in frames]) * 1e-6
    line = np.polyfit(true, stamps, 1)
    assert line[0] == pytest.approx(1 + ppm * 1e-6, abs=1e-6)
    assert abs(np.polyval(line, true) - stamps).max() < 1e-5
    # what the reader says of when it was, from when it came: a frame's way is 2 ms, a look comes every 20
    late = np.array([frame.time for frame in frames]) - true
    assert late.min() > -0.001
    assert late.max() < 0.03


def test_the_clock_wraps(board, default_build):
    listing = subprocess.run(["avr-nm", str(default_build / "wlr_board.elf")], capture_output=True, text=True, check=True)
    place = next(line.split()[0] for line in listing.stdout.splitlines() if line.endswith(" turns"))
    stream = board.imu()
    collect(board, stream, START)
    board.command(f"poke 0x{int(place, 16) & 0xFFFF:x} {2**17 - 40}")  # of 32768 us: 1.3 s before the turn
    collect(board, stream, 0.5)
    restarts = stream.restarts
    frames = collect(board, stream, 2.0)
    assert frames[0].numbers[1] > 2**31 > frames[-1].numbers[1]
    assert stream.restarts == restarts
    assert stream.parser.lost == 0
    stamps = np.unwrap(np.array([frame.numbers[1] for frame in frames], float), period=2**32) * 1e-6
    assert np.ptp(stamps - sample_moments(board, frames)) < 1e-5


@pytest.mark.parametrize("build_name", ["default_build", "fast_build"])
def test_a_line_that_loses_and_tears_costs_only_the_frames_it_hits(build_name, request, tmp_path):
    baud_rate = 115200 if build_name == "default_build" else 500000
    with SimulatedBoard(request.getfixturevalue(build_name), tmp_path) as board:
        stream = board.imu(baud_rate)
        board.set(accel_x=1.0)
        collect(board, stream, START)
        board.set(drop=0.0005, flip=0.0005)
        frames = collect(board, stream, 5.0, step=0.0137)  # whole frames end anywhere in what is read
        hits = board.get("hit")
        assert hits > 20
        assert 0 < stream.parser.lost <= hits
        assert len({frame.numbers[2] for frame in frames}) == 1
        assert (np.diff(np.unwrap([frame.numbers[5] for frame in frames], period=32768)) >= 1).all()


def test_a_locked_bus_is_freed_and_counted(board):
    stream = board.imu()
    collect(board, stream, START)
    board.set(hang_clocks=7)
    collect(board, stream, 0.1)
    found = status(board, stream)
    assert found["bus_locks"] == 1
    assert stream.parser.lost <= 1
    board.set(hold=1)  # a short circuit: nothing frees it
    flow = len(collect_flow_beside(board, stream, 0.5))
    assert flow == pytest.approx(60, abs=3)
    board.set(hold=0)
    collect(board, stream, 0.4)
    assert len(collect(board, stream, 0.5)) == pytest.approx(100, abs=2)
    assert status(board, stream)["bus_locks"] > 2


def collect_flow_beside(board: SimulatedBoard, stream: ImuStream, seconds: float) -> list[tuple[int, ...]]:
    """Return the frames of the flow sensor that come on the line the IMU's reader has open."""
    parser, frames = FrameParser(FLOW_FRAMES), []
    assert stream._device is not None
    for _ in range(round(seconds / 0.02)):
        board.run(0.02)
        frames += parser.feed(stream._device.received())
    return frames


def test_an_imu_that_vanishes_and_returns(board):
    stream = board.imu()
    collect(board, stream, START)
    board.set(imu=0)
    collect(board, stream, 0.5)
    assert collect(board, stream, 0.1) == []
    assert status(board, stream)["sensors"] == 2
    board.set(imu=1)
    collect(board, stream, 0.4)
    assert len(collect(board, stream, 0.5)) == pytest.approx(100, abs=2)
    found = status(board, stream)
    assert found["imu_restarts"] == 1
    assert found["sensors"] == 3


@pytest.mark.parametrize("floating", [0, 255])
def test_a_flow_sensor_that_vanishes_and_returns(board, floating):
    board.set(flow_x=4.0, floating=floating)
    stream = board.flow()
    for _ in range(30):
        board.run(0.02)
        stream.read()
    assert stream.read().quality == 0.0  # nothing new within no time
    board.run(0.02)
    assert stream.read().is_new
    board.set(flow=0)
    for _ in range(10):
        board.run(0.02)
        stream.read()
    board.run(0.02)
    assert not stream.read().is_new
    board.set(flow=1)
    for _ in range(20):
        board.run(0.02)
        stream.read()
    board.run(0.02)
    reading = stream.read()
    assert reading.is_new
    assert reading.quality == pytest.approx(90 / 255)  # it was tuned anew


@pytest.mark.parametrize(("absent", "bits", "rate"), [("imu", 2, 0), ("flow", 1, 200)])
def test_a_sensor_that_was_never_there(board, absent, bits, rate):
    board.set(**{absent: 0})
    stream = board.imu()
    collect(board, stream, START)
    assert len(collect(board, stream, 1.0)) == pytest.approx(rate, abs=2)
    found = status(board, stream)
    assert (found["sensors"], found["bus_errors"]) == (bits, 0)


def test_a_brownout_is_a_restart(board):
    stream = board.imu()
    collect(board, stream, 1.0)
    stream.read()
    board.command("reset 4")
    collect(board, stream, 0.5)
    assert stream.restarts == 1
    assert len(collect(board, stream, 0.5)) == pytest.approx(100, abs=2)
    assert status(board, stream)["reset_cause"] == 4


ARDUINO = Path("/usr/share/arduino/hardware/arduino/avr")


def test_the_same_folder_as_an_arduino_sketch(default_build, tmp_path):
    if not ARDUINO.exists():
        pytest.skip("firmware: not installed: arduino-core-avr")
    folder, sketch, core = tmp_path / "sketch", FIRMWARE / "wlr_board", ARDUINO / "cores/arduino"
    shutil.copytree(default_build, folder)
    flags = ["-mmcu=atmega328p", "-DF_CPU=16000000L", "-DARDUINO=10819", "-Os", "-w", f"-I{core}", f"-I{sketch}"]
    flags += [f"-I{ARDUINO}/variants/{name}" for name in ("eightanaloginputs", "standard")]
    flags += ["-DDECIMAL_DIG=__DECIMAL_DIG__"]  # which Debian's avr-gcc 5 lacks in C++

    def compiled(path: Path, *more: str) -> str:
        done = folder / f"{path.name}.o"
        compiler = ["avr-gcc"] if path.suffix in (".c", ".S") else ["avr-g++", "-std=gnu++11", "-x", "c++"]
        subprocess.run([*compiler, *flags, *more, "-c", str(path), "-o", str(done)], check=True)
        return str(done)

    # as the Arduino IDE does: the sketch's files, and the core as a library
    ours = [compiled(sketch / "wlr_board.ino", "-include", "Arduino.h"), *(compiled(path) for path in sketch.glob("*.c"))]
    theirs = [compiled(path) for path in core.iterdir() if path.suffix in (".c", ".cpp", ".S")]
    subprocess.run(["avr-ar", "rcs", str(folder / "core.a"), *theirs], check=True)
    words = ["avr-gcc", "-mmcu=atmega328p", "-o", str(folder / "wlr_board.elf"), *ours, str(folder / "core.a")]
    subprocess.run(words, check=True)
    check_everything(folder, tmp_path)


@pytest.mark.slow
def test_hours(default_build, tmp_path):
    """Six minutes of emulated time, or FIRMWARE_HOURS; 24 take as long as an evening."""
    hours = float(os.environ.get("FIRMWARE_HOURS", "0.1"))
    with SimulatedBoard(default_build, tmp_path) as board:
        board.set(board_ppm=1200.0, imu_ppm=3000.0, flow_x=1.3, flow_y=-0.4)
        stream = board.imu()
        collect(board, stream, START)
        numbers = np.concatenate(
            [[frame.numbers[1:6:4] for frame in collect(board, stream, 10.0, step=0.1)] for _ in range(round(360 * hours))]
        )
        found = status(board, stream)
        assert stream.parser.lost == stream.parser.crc_errors == stream.restarts == 0
        assert found["imu_missed"] == found["line_full"] == found["bus_errors"] == found["flow_restarts"] == 0
        assert len(numbers) == pytest.approx(3600 * hours * 200 * 1.003, rel=1e-3)
        true = board.moments()[np.unwrap(numbers[:, 1], period=32768)]
        stamps = np.unwrap(numbers[:, 0], period=2**32) * 1e-6
        errors = stamps - np.polyval(np.polyfit(true, stamps, 1), true)
        print(f"{len(numbers)} frames, stamps off by {abs(errors).max() * 1e6:.1f} us at most")
        assert abs(errors).max() < 1e-4


def test_the_doctor_reads_the_board(tmp_path, board):
    """The check that ``wlr doctor`` and ``wlr calibrate imu`` make, on a board with other settings and after a locked bus."""
    stream = board.imu()
    collect(board, stream, START)
    board.set(hang_clocks=7)
    collect(board, stream, 0.1)
    port = ImuPort(port=board.path, rate=200.0, gyro_range=250)
    checks = {check.what: check for check in check_board(stream, port, BoardClock(board))}
    assert checks["board"].ok
    assert not checks["settings"].ok
    assert (checks["settings"].found, checks["settings"].is_fatal) == ("200 Hz, 500 deg/s, 4 g, 44 Hz bandwidth", True)
    assert checks["board faults"].found == "1 bus errors, 1 bus locks"
    board.set(imu=0)
    collect(board, stream, 1.0)
    checks = {check.what: check for check in check_board(stream, port, BoardClock(board))}
    assert checks["chip"].found == "nobody answers"


class BoardClock:
    """Time of the simulated board, which passes while somebody waits."""

    def __init__(self, board: SimulatedBoard) -> None:
        self._board = board
        self.now = board.clock

    def wait_until(self, moment: float) -> None:
        """Let time pass."""
        self._board.run(max(moment - self._board.time, 0.0))
