"""All eight servos in SI units on the emulator: units, signs and zeros against the plant's own sensors; losses; torque-off."""

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.hardware.dynamixel.tables import error_names
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.physics.servo import effort_counts
from wlr_gym.robot import JOINTS, load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from wlr_gym.hardware.servos import JointMap, Servos

ROBOT = load_robot("emanual")
HARDWARE = load_hardware()
SETPOINTS = np.array([1.3, 1.4, 1.7, 1.8, 2.0, -2.0, 1.5, 3.0])


@pytest.fixture
def server():
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME))
    with Server(machine, real_time=False) as server:
        yield server


def connect(server, patience=0.15):
    return Servos(ROBOT, with_ports(HARDWARE, server.ports), patience, lambda: server.machine.time)


@pytest.fixture
def servos(server):
    with connect(server) as servos:
        yield servos


def test_all_ports_open_or_none(server, tmp_path):
    servos = Servos(ROBOT, with_ports(HARDWARE, {**server.ports, "wheels": str(tmp_path / "none")}))
    with pytest.raises(InputError, match="none: cannot be opened"):
        servos.open()
    assert not servos.groups["legs"].port.is_open


def drive(servos):
    """Torque on and setpoints; reading something afterwards makes sure that the unacknowledged setpoints have arrived."""
    for joint in JOINTS:
        servos.set(joint, "torque_enable", 1)
    servos.write_setpoints(SETPOINTS)
    servos.read()


def test_readings_are_the_plants_own_sensors(server, servos):
    """Counts, signs and zeros cancel: SI values equal what the plant's sensor model read, to the last count."""
    drive(servos)
    server.advance(0.4)
    readings, sensors = servos.read(), server.machine.coupling.sensors
    np.testing.assert_allclose(readings.position[:4], sensors.joint_position[0, :4], atol=1e-9)
    turned = readings.position[4:] - sensors.joint_position[0, 4:]
    np.testing.assert_allclose(turned, np.rint(turned / (2 * np.pi)) * 2 * np.pi, atol=1e-9)  # whole turns apart
    np.testing.assert_allclose(readings.velocity, sensors.joint_velocity[0], atol=1e-6)
    np.testing.assert_allclose(readings.effort, sensors.joint_effort[0], atol=1e-9)
    assert readings.answered.all()
    assert not readings.alert.any()
    assert not readings.restarted.any()
    assert np.abs(readings.velocity[4:]).min() > 0.5


def test_setpoints_go_where_they_should(server, servos):
    drive(servos)
    server.advance(1.5)
    truth = server.machine.plant.truth()
    np.testing.assert_allclose(truth.joint_position[0, :4], SETPOINTS[:4], atol=0.06)  # the gain leaves that under load
    assert (np.sign(truth.joint_velocity[0, 4:]) == np.sign(SETPOINTS[4:])).all()


def test_counts_and_si_values_are_inverse():
    joint_map = JointMap(ROBOT, HARDWARE)
    counts = joint_map.setpoint_counts(SETPOINTS)
    assert counts.tolist() == [1871, 2159, 2132, 1899, 83, 83, 63, -125]
    np.testing.assert_allclose(joint_map.position(counts)[:4], SETPOINTS[:4], atol=0.5 * 2 * np.pi / 4096)
    np.testing.assert_allclose(joint_map.velocity(counts)[4:], SETPOINTS[4:], atol=0.5 * 0.023981)
    np.testing.assert_allclose(
        joint_map.effort(np.ones(8), np.zeros(8)), [s * e for s, e in zip([1, -1] * 4, effort_counts(ROBOT), strict=True)]
    )


def test_straight_down_is_the_middle_of_the_servo():
    joint_map = JointMap(ROBOT, HARDWARE)
    assert joint_map.setpoint_counts([np.pi / 2] * 4 + [0.0] * 4).tolist() == [2048] * 4 + [0] * 4


@pytest.mark.parametrize(
    ("setpoints", "words"),
    [
        ([1.0] * 7, r"shape \(7,\)"),
        ([1.0, np.nan] + [0.0] * 6, "setpoint of leg_rf is nan"),
        ([1.0] * 7 + [np.inf], "wheel_rr is inf"),
    ],
)
def test_setpoints_that_are_none(servos, setpoints, words):
    with pytest.raises(InputError, match=words):
        servos.write_setpoints(setpoints)


def test_health_and_errors(server, servos):
    server.machine.inject("overload wheel_rf duration=0.003")
    server.machine.inject("overheat leg_lr value=20 duration=1")
    server.advance(1.0)
    voltage, temperature = servos.read_health()
    np.testing.assert_allclose(voltage, 12.0, atol=0.2)
    assert temperature[2] > 40 > temperature[0]
    assert servos.read().alert.tolist() == [joint == "wheel_rf" for joint in JOINTS]
    assert error_names(servos.get("wheel_rf", "hardware_error_status")) == ["overload"]
    assert error_names(servos.get("leg_lf", "hardware_error_status")) == []


def test_a_missing_answer_is_nan_and_flagged(server):
    server.machine.inject("drop leg_rf")
    server.machine.inject("drop wheels")
    with connect(server, patience=0.03) as servos:
        for group in servos.groups.values():
            group.fast = False
        readings = servos.read()
    assert readings.answered.tolist() == [True, False, True, True, False, False, False, False]
    assert np.isnan(readings.position).tolist() == (~readings.answered).tolist()


def test_a_bus_that_keeps_us_waiting_costs_the_other_one_nothing(server):
    """The legs' time-out is longer than the wheels' answers may take: those lie in the buffer by then."""
    server.machine.inject("drop legs")
    with connect(server, patience=0.1) as servos:
        for _ in range(3):
            assert servos.read().answered.tolist() == [False] * 4 + [True] * 4


def test_a_brownout_shows_as_a_restart(server, servos):
    servos.read()
    server.advance(3.0)  # long on, so that its clock is far from a fresh one
    servos.read()
    server.command("brownout wheel_lf")
    server.advance(0.5)
    assert servos.read().restarted.tolist() == [joint == "wheel_lf" for joint in JOINTS]
    server.advance(0.02)
    assert not servos.read().restarted.any()


def test_torque_off_of_one_bus_does_not_need_the_other(server, servos):
    for joint in JOINTS:
        servos.set(joint, "torque_enable", 1)
    server.command("unplug legs")
    server.advance(0.002)
    assert servos.torque_off() == list(JOINTS[:4])
    assert not any(server.machine.servos[joint]["torque_enable"] for joint in JOINTS[4:])


def test_unknown_joint(servos):
    with pytest.raises(InputError, match="no joint 'leg'"):
        servos.get("leg", "led")
