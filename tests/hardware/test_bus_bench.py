"""``wlr bench --only bus``: both contenders read the same values from the same answers, and every row is there."""

import pytest

from wlr_gym.bench.measure import Size
from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.robot import load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from wlr_gym.bench import bus
from wlr_gym.hardware.servos import Servos


def test_both_read_the_same():
    robot, hardware = load_robot(), load_hardware()
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


def test_every_row_is_measured():
    rows = bus.measure_bus(Size(rounds=2, quick=True))
    assert [row.unit for row in rows] == ["1/s", "1/s", "us", "us", "us"]
    assert all(value > 0.0 for row in rows for value in row.ours)
    assert rows[0].peer is not None
    assert "GroupSyncRead" in rows[0].peer_name
