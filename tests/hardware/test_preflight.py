"""Preflight checks on the emulator: a good robot passes all; each fault fails its check alone and names a remedy."""

import pytest

from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.robot import JOINTS, load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from wlr_gym.hardware.safety import preflight
from wlr_gym.hardware.servos import Servos

ROBOT = load_robot()
HARDWARE = load_hardware()


@pytest.fixture
def server():
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, sensor_noise=False))
    with Server(machine, real_time=False) as server:
        yield server


@pytest.fixture
def servos(server):
    with Servos(ROBOT, with_ports(HARDWARE, server.ports), 0.15, lambda: server.machine.time) as servos:
        yield servos


def failed(servos):
    return [check for check in preflight.check_servos(servos, ROBOT, HARDWARE) if not check.ok]


def test_a_good_robot_passes(servos):
    found = preflight.check_servos(servos, ROBOT, HARDWARE)
    assert [str(check) for check in found if not check.ok] == []
    assert len(found) == 8 * 17 + 4  # legs: position too


@pytest.mark.parametrize(
    ("item", "count", "is_fatal", "mendable"),
    [
        ("operating_mode", 4, True, True),
        ("drive_mode", 1, True, True),
        ("homing_offset", 5, True, True),
        ("startup_configuration", 1, True, True),
        ("shutdown", 0, True, True),
        ("temperature_limit", 100, True, True),
        ("status_return_level", 1, True, None),
        ("return_delay_time", 250, False, True),
        ("bus_watchdog", -1, True, True),
        ("torque_enable", 1, True, False),
        ("model_number", 1020, True, False),
        ("hardware_error_status", 32, True, False),
    ],
)
def test_each_fault_is_found_alone_and_mended_where_it_can_be(server, servos, item, count, is_fatal, mendable):
    servo = server.machine.servos["wheel_lr"]
    if item == "model_number":
        object.__setattr__(servo, "table", type(servo.table)("XL430-W250-T", count, (1,), servo.table.items))
    else:
        servo.set(item, count)
    (check,) = failed(servos)
    assert (check.where, check.is_fatal) == ("wheel_lr", is_fatal)
    assert check.remedy.endswith(".")
    assert ("FAULT" if is_fatal else "warning") in str(check)
    if mendable is not None:
        assert preflight.mend(servos, [check]) == ([] if mendable else [check])
        assert (failed(servos) == []) == mendable


def test_a_silent_servo(server, servos):
    server.machine.inject("dead leg_rr")
    server.machine.step()
    (check,) = failed(servos)
    assert (check.where, check.what, check.found) == ("leg_rr", "answer", "none")
    assert "bus legs" in check.remedy


def test_supply_and_temperature(server, servos):
    server.machine.inject("sag value=3")
    server.machine.inject("overheat wheel_lf value=400 duration=0.1")
    server.advance(0.12)
    found = failed(servos)
    assert {(c.where, c.what) for c in found if c.what == "supply"} == {(joint, "supply") for joint in JOINTS[:4]}
    assert [c.where for c in found if c.what == "temperature"] == ["wheel_lf"]
    assert {c.what for c in found} == {"supply", "temperature", "hardware error"}


def test_eeprom_stays_locked_under_torque(server, servos):
    servo = server.machine.servos["leg_lf"]
    servo.set("return_delay_time", 100)
    servo.set("torque_enable", 1)
    left = preflight.mend(servos, failed(servos))
    assert {check.what for check in left} == {"torque", "return_delay_time"}


def test_old_firmware_warns_and_very_old_fails():
    for firmware, words in ((44, {"fast reads"}), (40, {"fast reads", "firmware"})):
        machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, firmware=firmware, sensor_noise=False))
        with Server(machine, real_time=False) as server, Servos(ROBOT, with_ports(HARDWARE, server.ports), 0.15) as servos:
            assert {check.what for check in failed(servos)} == words


def test_bus_speed_names_losses(server, servos):
    assert preflight.check_bus_speed(servos, reads=20, budget=1.0).ok
    for group in servos.groups.values():
        group.fast = False
    server.machine.inject("drop leg_lf")
    check = preflight.check_bus_speed(servos, reads=3, budget=9.0)
    assert not check.ok
    assert "3 of 24 answers lost" in check.found


def test_latency_timer(tmp_path):
    setting = tmp_path / "bus/usb-serial/devices/ttyUSB0/latency_timer"
    setting.parent.mkdir(parents=True)
    for value, ok in (("16", False), ("1", True)):
        setting.write_text(value + "\n")
        (check,) = preflight.check_latency_timers(HARDWARE, tmp_path)  # the wheels' port has no such file
        assert (check.where, check.ok) == ("legs", ok)
