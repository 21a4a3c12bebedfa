"""The measurement of the bus: both contenders read the same values from the same answers, and every row is there."""

import pytest

from studies.bench.measure import Size
from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.robot import load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from studies.bench import bus
from wlr_gym.hardware.servos import Servos


def test_both_read_the_same():
    robot, hardware = load_robot("emanual"), load_hardware()
    with bus._answering(robot, hardware) as ports:
        wired = with_ports(hardware, ports)
        with Servos(robot, wired, 1.0, lambda: 0.0) as servos:
            ours = servos.read()
        assert ours.answered.all()
        for name, joints in (("legs", slice(0, 4)), ("wheels", slice(4, 8))):
            theirs = bus._SdkBus(robot, wired, name)
            rows = theirs.read()
            theirs.port.closePort()
            signs = [wired.joints[joint].sign for joint in wired.buses[name].joints]
            zeros = [wired.joints[joint].zero * theirs.wanted[2][1] for joint in wired.buses[name].joints]
            angles = [sign * (row[2] - zero) for sign, zero, row in zip(signs, zeros, rows, strict=True)]
            assert ours.position[joints].tolist() == pytest.approx(angles, abs=1e-9)


@pytest.mark.slow
def test_every_row_is_measured(monkeypatch):
    """The drive in emulated time, so that it does not depend on this computer: nothing is late there."""
    monkeypatch.setattr(bus, "_DRIVE", bus._DRIVE.replace('"--emulated"', '"--emulated", "--stepped"'))
    *rows, missed, late, sent = bus.measure_bus(Size(rounds=1, quick=True))
    assert [row.unit for row in rows] == ["1/s", "1/s", "us", "us", "us"]
    assert all(value > 0.0 for row in rows for value in row.ours)
    assert rows[0].peer is not None
    assert "GroupSyncRead" in rows[0].peer_name
    assert (missed.ours, late.ours, sent.ours) == ((0.0,), (0.0,), (0.0,))
    assert missed.met
    assert late.met


def test_a_tick_missed_in_any_round_counts(monkeypatch):
    """Three rounds of five miss none, so that their median is none."""
    drives = iter([0, 0, 0, 7, 40])
    rest = {"jitter": {"p99": 1.0}, "latency": {"p99": 1.0}}
    monkeypatch.setattr(bus, "drive_in_real_time", lambda seconds, words: {"missed": next(drives), **rest})
    missed, late, sent = bus._measure_deadlines(Size(rounds=5))
    assert missed.ours == (47.0,)
    assert not missed.met
    assert late.ours == sent.ours == (1000.0,) * 5


def test_a_drive_that_hangs_is_ended(monkeypatch):
    monkeypatch.setattr(bus, "_DRIVE", "import time; time.sleep(600)")
    monkeypatch.setattr(bus, "_GRACE", 0.0)
    with pytest.raises(RuntimeError, match="not driven to the end within 1 s"):
        bus.drive_in_real_time(1, ["pid"])


@pytest.mark.slow
def test_a_drive_that_does_not_end_well_is_no_measurement():
    with pytest.raises(RuntimeError, match="--seconds 0: expected more than 0"):
        bus.drive_in_real_time(0, ["pid"])
