"""The optical-flow sensor's chip, stream and readings, against a chip written from the data sheet; its calibration."""

import re
import struct
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml
from hand_clock import HandClock, HandDevice
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from wlr_gym.base.errors import InputError
from wlr_gym.hardware import flow as pmw3901
from wlr_gym.hardware.config import FlowCalibration, FlowPort, Hardware, check_fit, load_hardware, with_ports
from wlr_gym.hardware.flow import (
    FLOW_FRAMES,
    FROZEN,
    ChipPoller,
    CountedMotion,
    FlowConversion,
    FlowReader,
    FlowStream,
    Pmw3901,
)
from wlr_gym.hardware.flow_comparison import calibrate_flow
from wlr_gym.hardware.serial_frames import FrameParser
from wlr_gym.robot import JOINTS, load_robot

ROBOT = load_robot("flow")
SENSOR: Any = ROBOT.sensors.flow
PORT = FlowPort(port="/dev/spidev0.0", driver="spi", axes=("x", "y"))
STREAM = FlowPort(port="/dev/ttyACM1", axes=("x", "y"))


class Chip:
    """A PMW3901 as its data sheet has it: what it answers to, and what it demands of who asks."""

    def __init__(self, clock, *, identity=0x49, trimmed=0x73):
        self.clock, self.identity = clock, identity
        self.pages = {page: {} for page in range(256)}
        self.pages[0x0E].update({0x67: 0x80, 0x73: 0x00 if trimmed == 0x73 else 0x01, 0x70: 0x20, 0x71: 0x64})
        self.page = 0
        self.since_reset = None
        self.x = self.y = 0
        self.moved = False
        self.quality, self.shutter = 90, 0x0123
        self.free_at = 0.0
        self.is_set_up = False
        self.written = []
        self.closed = False
        self.fails = 0

    def exchange(self, parts, pause):
        if self.fails:
            self.fails -= 1
            raise OSError("no answer")
        assert self.clock() >= self.free_at - 1e-12, "asked before 45 us had passed since a write"
        address = parts[0][0]
        if address & 0x80:
            (message,) = parts
            assert len(message) == 2
            self._write(address & 0x7F, message[1])
            self.free_at = self.clock() + 45e-6
            return [bytes(2)]
        assert len(parts) == 2, "a read is the address, a pause, then clocks"
        assert pause >= 35e-6, "t_SRAD"
        return [b"\0", self._burst() if address == 0x16 else bytes([self._read(address)])]

    def _write(self, register, value):
        self.written.append((register, value))
        if (register, value) == (0x3A, 0x5A):
            assert self.clock() >= 100.0 + 0.04, "40 ms after power"
            self.since_reset, self.page, self.is_set_up = self.clock(), 0, False
            return
        assert self.since_reset is not None
        assert self.clock() >= self.since_reset + 1e-3, "1 ms after a reset"
        if register == 0x7F:
            self.page = value
        else:
            self.pages[self.page][register] = value
        self.is_set_up = (register, value) == (0x40, 0x80) and self.page == 0

    def _read(self, register):
        if self.page == 0 and register in (0x00, 0x5F):
            return self.identity if register == 0x00 else self.identity ^ 0xFF
        return self.pages[self.page].get(register, 0)

    def move(self, x, y):
        self.x, self.y, self.moved = self.x + x, self.y + y, True

    def _burst(self):
        assert self.is_set_up
        words = struct.pack("<hh", self.x, self.y)
        answer = bytes([0x80 if self.moved else 0, 0]) + words + bytes([self.quality, 1, 2, 3])
        self.x, self.y, self.moved = 0, 0, False
        return answer + bytes([self.shutter >> 8, self.shutter & 0xFF])

    def close(self):
        self.closed = True


def set_up_chip(**options):
    clock = HandClock(100.0)
    chip = Chip(clock, **options)
    driver = Pmw3901(chip, clock.sleep)
    driver.set_up("flow sensor")
    return clock, chip, driver


# ---- the chip -------------------------------------------------------------------------------------------------------


def test_power_up_writes_what_the_data_sheet_says_in_its_order():
    _, chip, _ = set_up_chip()
    assert chip.written[0] == (0x3A, 0x5A)
    assert chip.is_set_up
    assert len(chip.written) == 1 + 5 + 1 + 5 + 6 + 59 + 14
    assert chip.pages[0x0E][0x48] == 0x04  # bit 7 of 0x67
    assert (chip.pages[0x0E][0x70], chip.pages[0x0E][0x71]) == (0x20 + 0x0B, 0x64 * 45 // 100)
    assert chip.pages[0x05][0x41] == 0xB3
    assert chip.pages[0x0D][0x6F] == 0xD5


def test_a_chip_that_is_trimmed_otherwise_keeps_its_gains():
    _, chip, _ = set_up_chip(trimmed=0)
    assert (chip.pages[0x0E][0x70], chip.pages[0x0E][0x71]) == (0x20, 0x64)


def test_another_chip_is_refused():
    with pytest.raises(InputError, match=r"Product_ID is 0x47 and its inverse 0xb8, expected 0x49 and 0xb6"):
        set_up_chip(identity=0x47)


def test_burst_holds_signed_counts_quality_and_shutter():
    _, chip, driver = set_up_chip()
    chip.move(-300, 7)
    assert driver.motion() == (True, -300, 7, 90, 0x0123)
    assert driver.motion() == (False, 0, 0, 90, 0x0123)


def polled(chip_of=Chip, **options):
    """A poller whose thread stands still: the test polls."""
    clock = HandClock(100.0)
    chip = chip_of(clock, **options)
    poller = ChipPoller(PORT, SENSOR, clock, lambda path: chip, clock.sleep)
    poller._bus, poller._chip = chip, Pmw3901(chip, clock.sleep)
    poller._chip.set_up("flow sensor")
    poller._frame_at = clock()
    return clock, chip, poller


def test_readings_are_over_the_frames_own_time_whatever_the_control_steps_cut():
    clock, chip, poller = polled()
    start, frame, readings = clock.now, 0, []
    for poll in range(1, 600):
        clock.now = start + poll / (2.5 * SENSOR.rate)
        if clock.now - start >= (frame + 1) / SENSOR.rate:
            frame += 1
            chip.move(11, -4)
            chip.quality = 90 + frame % 2
        poller.poll()
        if poll % 6 == 0:  # 50.4 Hz: two or three frames
            readings.append(poller.read())
    flow = np.array([reading.flow for reading in readings if reading.is_new])[3:]
    assert len(flow) > 90
    np.testing.assert_allclose(flow, np.tile(np.array([11, -4]) * SENSOR.count * SENSOR.rate, (len(flow), 1)), rtol=1e-9)


def test_a_floor_at_rest_reads_zero_and_is_new():
    clock, _, poller = polled()
    readings = []
    for _ in range(20):
        for _ in range(6):
            clock.now += 1 / (2.5 * SENSOR.rate)
            poller.poll()
        readings.append(poller.read())
    assert all(reading.is_new and not reading.flow.any() for reading in readings)


def test_a_line_that_is_disturbed_is_tried_again_and_a_dead_one_is_said():
    clock, chip, poller = polled()
    chip.fails = 5
    for _ in range(10):
        clock.now += 0.004
        poller.poll()
    assert poller.read().is_new
    assert poller.statistics.lost == 5
    chip.fails = 10**6
    for _ in range(pmw3901.PATIENCE):
        clock.now += 0.004
        poller.poll()
    reading = poller.read()
    assert not reading.is_new
    assert reading.trouble.startswith("no port: /dev/spidev0.0 is gone")


def test_the_thread_polls_and_ends_with_the_sensor():
    chip = Chip(time.monotonic)
    chip.since_reset, chip._write = (
        0.0,
        lambda register, value: setattr(chip, "is_set_up", True),
    )  # real time: no 40 ms of 100 s
    poller = ChipPoller(PORT, SENSOR, time.monotonic, lambda path: chip)
    poller.open()
    try:
        end = time.monotonic() + 5.0
        while not poller.read().is_new and time.monotonic() < end:
            chip.move(1, 0)
            time.sleep(0.005)
        assert poller.statistics.readings > 0
    finally:
        poller.close()
    assert chip.closed
    assert "is not open" in poller.read().trouble


# ---- the stream -----------------------------------------------------------------------------------------------------


def frame(sequence, x=5, y=-2, interval=8264, quality=88):
    return (sequence, (sequence * 8264) % 2**32, interval, x, y, quality, 0x0400)


def test_a_frame_is_twenty_bytes_and_reads_back():
    raw = FLOW_FRAMES.encode(frame(7, x=-32768, y=32767))
    assert len(raw) == FLOW_FRAMES.size == 20
    assert raw[:2] == b"\xa5\xf1"
    assert FrameParser(FLOW_FRAMES, repeats=False).feed(raw) == [frame(7, x=-32768, y=32767)]


@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(st.binary(max_size=60), st.integers(0, 19), st.integers(0, 159), st.lists(st.integers(1, 9), max_size=8))
def test_noise_costs_no_more_than_the_frames_it_hits(noise, cut, bit, sizes):
    good = [frame(k) for k in range(1, 7)]
    raws = [FLOW_FRAMES.encode(one) for one in good]
    broken = bytearray(raws[2])
    broken[bit // 8] ^= 1 << bit % 8
    stream = noise + raws[0] + raws[1] + bytes(broken) + raws[3][:cut] + noise + raws[4] + raws[5]
    parser, found = FrameParser(FLOW_FRAMES, repeats=False), []
    for size in [*sizes, 7] * (len(stream) + 1):
        found += parser.feed(stream[:size])
        stream = stream[size:]
        if not stream:
            break
    found += parser.feed(bytes(3 * FLOW_FRAMES.size))
    assert {1, 2, 5, 6} <= {one[0] for one in found} | {None} or b"\xa5\xf1" in noise
    assert all(one in good for one in found)


def stream_and_pipe():
    clock, pipe = HandClock(100.0), HandDevice()
    stream = FlowStream(STREAM, SENSOR, clock, cast(Any, lambda *port: pipe))
    stream.open()
    return clock, pipe, stream


def test_stream_gives_the_mean_over_what_came_and_ages_between():
    clock, pipe, stream = stream_and_pipe()
    pipe.data = FLOW_FRAMES.encode(frame(1, x=10)) + FLOW_FRAMES.encode(frame(2, x=20))
    first = stream.read()
    np.testing.assert_allclose(first.flow, np.array([15, -2]) * SENSOR.count / 8264e-6)
    assert first.is_new
    assert first.quality == pytest.approx(88 / 255)
    clock.now += 0.02
    held = stream.read()
    assert not held.is_new
    assert not held.trouble  # one control step without a frame is none
    assert held.age == pytest.approx(first.age + 0.02)
    np.testing.assert_array_equal(held.flow, first.flow)
    clock.now += 0.2
    assert stream.read().trouble == "silent: no frame for 0.2 s"
    pipe.gone = True
    gone = stream.read()
    assert gone.trouble.startswith("no port: /dev/ttyACM1 is gone")
    assert gone.quality == 0.0
    assert stream.statistics.refused == {"silent": 1, "no port": 1}


def test_stream_counts_lost_frames_once():
    _, pipe, stream = stream_and_pipe()
    pipe.data = b"".join(FLOW_FRAMES.encode(frame(k)) for k in (1, 2, 2, 5))
    assert stream.read().is_new
    assert stream.statistics.lost == 2


# ---- readings -------------------------------------------------------------------------------------------------------


def motion(**changes):
    return replace(CountedMotion(5, -2, 1 / 121, 90, 0x0400, 10.0), **changes)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"quality": 10}, "poor texture: surface quality 10 of 255, expected 25 or more"),
        ({"x": 40}, "too fast: 10.1 rad/s, the sensor measures up to 7.4"),
        ({"interval": 0.0}, "interval: 0.0 ms between two frames, expected up to 100"),
    ],
)
def test_what_is_not_valid_is_held_back_with_its_reason(changes, reason):
    reader = FlowReader(PORT, SENSOR, 9.9)
    assert reader.read([motion()], 10.0).is_new
    bad = reader.read([motion(**changes)], 10.02)
    assert (bad.is_new, bad.quality, bad.trouble) == (False, 0.0, reason)
    mixed = reader.read([motion(**changes), motion(end=10.03, x=7)], 10.04)
    assert mixed.flow[0] == pytest.approx(7 * SENSOR.count * 121)


def test_counts_that_never_change_are_frozen_and_a_floor_at_rest_is_not():
    for x, frozen in ((5, True), (0, False)):
        reader = FlowReader(PORT, SENSOR, 0.0)
        readings = [reader.read([motion(x=x, y=0, end=k / 50)], k / 50) for k in range(FROZEN + 5)]
        assert readings[-1].trouble.startswith("frozen") == frozen
        assert readings[FROZEN - 1].is_new


@pytest.mark.parametrize("axes", [("x", "y"), ("-y", "-x"), ("y", "x"), ("-x", "y")])
def test_axes_scale_and_mounting_are_taken_off(axes):
    port = PORT.model_copy(update={"axes": axes})
    chip = FlowConversion(port, SENSOR)
    calibrated = FlowConversion(port.model_copy(update={"calibration": FlowCalibration(scale=1.1, mount_yaw=0.3)}), SENSOR)
    true = np.array([2.0, -0.7])
    c, s = np.cos(0.3), np.sin(0.3)
    counts = chip.counts(1.1 * np.array([[c, s], [-s, c]]) @ true, 1.0)
    np.testing.assert_allclose(calibrated.flow(*counts, 1.0), true, atol=2 * SENSOR.count)


# ---- the hardware file ----------------------------------------------------------------------------------------------


def hardware_with(**flow):
    content = load_hardware("nominal").model_dump(mode="json")
    return Hardware.model_validate({**content, "flow": {"port": "/dev/ttyACM1", **flow}})


def test_hardware_file_names_the_sensor_and_the_robot_must_have_one():
    hardware = with_ports(hardware_with(), {"flow": "/dev/ttyACM7"})
    assert hardware.flow is not None
    assert hardware.flow.port == "/dev/ttyACM7"
    check_fit(ROBOT, hardware)
    with pytest.raises(InputError, match=r"its file needs a section sensors\.flow"):
        check_fit(load_robot("emanual"), hardware)
    with pytest.raises(InputError, match="no bus 'flow'; the buses are legs, wheels, imu"):
        with_ports(load_hardware("nominal"), {"flow": "x"})
    with pytest.raises(ValueError, match=r"expected one of the chip's x and one of its y"):
        hardware_with(axes=["x", "-x"])


def test_the_pages_hardware_files_are_read():
    page = (Path(__file__).parents[2] / "docs" / "camera.md").read_text(encoding="utf-8")
    lines = re.findall("```yaml\n(.*?)```", page, re.S)[2].splitlines()
    stream, chip = (hardware_with(**yaml.safe_load(line)["flow"]).flow for line in lines)
    assert stream is not None
    assert chip is not None
    assert (stream.driver, chip.driver) == ("stream", "spi")


# ---- calibration ----------------------------------------------------------------------------------------------------


class Table(dict):
    path = ""


def straight_run(scale=1.0, yaw=0.0, slip=1.0, noise=0.1, speed=0.25, seconds=6.0, lateral=0.0):
    """A run of a level robot that drives on, stops, and drives back."""
    rng = np.random.default_rng(4)
    t = 0.02 * np.arange(round(seconds / 0.02))
    v = np.where(t < 0.5 * seconds, speed, -0.6 * speed)
    h = 0.134
    c, s = np.cos(yaw), np.sin(yaw)
    true = np.stack([v * slip, lateral * v], axis=1) / h
    flow = scale * true @ np.array([[c, -s], [s, c]]) + noise * rng.normal(size=true.shape)
    table = {"t": t, "flow_x": flow[:, 0], "flow_y": flow[:, 1]}
    table |= {f"gyro_{axis}": np.zeros(len(t)) for axis in "xyz"}
    table |= {f"pos_{joint}": np.full(len(t), np.pi / 2) for joint in JOINTS}
    table |= {f"vel_{joint}": v / 0.034 if "wheel" in joint else np.zeros(len(t)) for joint in JOINTS}

    run: Any = Table(table)
    run.path = "run_01.csv"
    return run


def test_calibration_finds_scale_and_mounting_within_what_it_says():
    fit = calibrate_flow(straight_run(scale=1.12, yaw=0.2), ROBOT, FlowCalibration())
    assert abs(fit.calibration.scale - 1.12) < 4 * fit.scale_sigma < 0.03
    assert abs(fit.calibration.mount_yaw - 0.2) < 4 * fit.yaw_sigma < 0.03
    again = calibrate_flow(straight_run(scale=1.12 / 1.05, yaw=0.2 - 0.15), ROBOT, FlowCalibration(scale=1.05, mount_yaw=0.15))
    assert again.calibration.scale == pytest.approx(1.12, abs=0.02)  # what the run's own calibration took off is in it
    assert again.calibration.mount_yaw == pytest.approx(0.2, abs=0.02)


def test_a_tape_measure_is_believed_instead_of_slipping_wheels():
    run = straight_run(slip=0.8, seconds=6.0)
    for joint in JOINTS:
        run[f"vel_{joint}"] = np.abs(run[f"vel_{joint}"])
    run["flow_x"] = np.abs(run["flow_x"])
    rolled = 0.02 * 0.034 * run["vel_wheel_lf"].sum()
    assert calibrate_flow(run, ROBOT, FlowCalibration()).calibration.scale == pytest.approx(0.8, abs=0.02)
    assert calibrate_flow(run, ROBOT, FlowCalibration(), 0.8 * rolled).calibration.scale == pytest.approx(1.0, abs=0.02)
    with pytest.raises(InputError, match="in the same direction"):
        calibrate_flow(run, ROBOT, FlowCalibration(), -1.0)


def test_calibration_refuses_what_tells_nothing():
    with pytest.raises(InputError, match=r"expected 0\.5 or more"):
        calibrate_flow(straight_run(speed=0.01), ROBOT, FlowCalibration())
    with pytest.raises(InputError, match=r"are sensors\.flow and the port's axes right"):
        calibrate_flow(straight_run(scale=0.1), ROBOT, FlowCalibration())
    run = straight_run()
    run["flow_x"][: len(run["flow_x"]) * 2 // 3] = np.nan
    with pytest.raises(InputError, match="valid flow in 33 % of the rows"):
        calibrate_flow(run, ROBOT, FlowCalibration())
    del run["flow_y"]
    with pytest.raises(InputError, match="column 'flow_y' is missing"):
        calibrate_flow(run, ROBOT, FlowCalibration())
