"""The optical-flow sensor's stream and readings; its calibration."""

import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml
from hand_clock import HandClock, HandDevice

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import FlowCalibration, FlowPort, Hardware, check_fit, load_hardware, with_ports
from wlr_gym.hardware.flow import FLOW_FRAMES, FROZEN, FlowConversion, FlowStream
from wlr_gym.hardware.flow_comparison import calibrate_flow
from wlr_gym.hardware.serial_frames import FrameParser
from wlr_gym.robot import JOINTS, load_robot

ROBOT = load_robot("flow")
SENSOR: Any = ROBOT.sensors.flow
PORT = FlowPort(port="/dev/ttyACM1", axes=("x", "y"))

# ---- the stream -----------------------------------------------------------------------------------------------------


def frame(sequence, x=5, y=-2, interval=8264, quality=88):
    return (sequence, (sequence * 8264) % 2**32, interval, x, y, quality, 0x0400)


def test_a_frame_is_twenty_bytes_and_reads_back():
    raw = FLOW_FRAMES.encode(frame(7, x=-32768, y=32767))
    assert len(raw) == FLOW_FRAMES.size == 20
    assert raw[:2] == b"\xa5\xf1"
    assert FrameParser(FLOW_FRAMES, repeats=False).feed(raw) == [frame(7, x=-32768, y=32767)]


def stream_and_pipe():
    clock, pipe = HandClock(100.0), HandDevice()
    stream = FlowStream(PORT, SENSOR, clock, cast(Any, lambda *port: pipe))
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


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"quality": 10}, "poor texture: surface quality 10 of 255, expected 25 or more"),
        ({"x": 40}, "too fast: 10.1 rad/s, the sensor measures up to 7.4"),
        ({"interval": 0}, "interval: 0.0 ms between two frames, expected up to 100"),
    ],
)
def test_what_is_not_valid_is_held_back_with_its_reason(changes, reason):
    clock, pipe, stream = stream_and_pipe()
    pipe.data = FLOW_FRAMES.encode(frame(1))
    assert stream.read().is_new
    clock.now += 0.008264
    pipe.data = FLOW_FRAMES.encode(frame(2, **changes))
    bad = stream.read()
    assert (bad.is_new, bad.quality, bad.trouble) == (False, 0.0, reason)
    clock.now += 2 * 0.008264
    pipe.data = FLOW_FRAMES.encode(frame(3, **changes)) + FLOW_FRAMES.encode(frame(4, x=7))
    assert stream.read().flow[0] == pytest.approx(7 * SENSOR.count / 8264e-6)


def test_counts_that_never_change_are_frozen_and_a_floor_at_rest_is_not():
    for x, frozen in ((5, True), (0, False)):
        clock, pipe, stream = stream_and_pipe()
        readings = []
        for k in range(FROZEN + 5):
            clock.now += 0.008264
            pipe.data = FLOW_FRAMES.encode(frame(k, x=x, y=0))
            readings.append(stream.read())
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
    with pytest.raises(InputError, match="unknown port 'flow'; valid: imu, legs, wheels"):
        with_ports(load_hardware("nominal"), {"flow": "x"})
    with pytest.raises(ValueError, match=r"expected one of the chip's x and one of its y"):
        hardware_with(axes=["x", "-x"])
    with pytest.raises(ValueError, match="driver"):  # the chip on this computer's own bus: not read any more
        hardware_with(driver="spi")


def test_the_pages_hardware_file_is_read():
    page = (Path(__file__).parents[2] / "docs" / "camera.md").read_text(encoding="utf-8")
    flow = hardware_with(**yaml.safe_load(re.findall("```yaml\n(.*?)```", page, re.S)[2])["flow"]).flow
    assert flow is not None
    assert (flow.port, flow.axes) == ("/dev/ttyACM1", ("-y", "-x"))


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
