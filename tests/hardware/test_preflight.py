"""Preflight checks on the emulator: a good robot passes all; each fault fails its check alone and names a remedy."""

import dataclasses

import pytest

from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.hardware.dynamixel.tables import load_table
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.robot import JOINTS, load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from wlr_gym.hardware.safety import preflight
from wlr_gym.hardware.servos import Servos

ROBOT = load_robot("emanual")
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


@pytest.fixture
def rig():
    """An emulated robot in emulated time, and its servos."""
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, sensor_noise=False))
    link = emulated_link(machine)
    link.open()
    yield machine, link.servos
    link.close()


def failed(servos):
    return [check for check in preflight.check_servos(servos, ROBOT, HARDWARE) if not check.ok]


def test_a_good_robot_passes(servos):
    found = preflight.check_servos(servos, ROBOT, HARDWARE)
    assert [str(check) for check in found if not check.ok] == []
    assert len(found) == 8 * 24 + 4 * 2  # legs: current limit and position too


@pytest.mark.parametrize(
    ("item", "count"),
    [("torque_enable", 1), ("model_number", 1020), ("hardware_error_status", 32)],
)
def test_each_fault_is_found_alone_and_not_mended(server, servos, item, count):
    servo = server.machine.servos["wheel_lr"]
    if item == "model_number":
        servo.table = dataclasses.replace(servo.table, model_number=count)
    else:
        servo.set(item, count)
    (check,) = failed(servos)
    assert (check.where, check.is_fatal) == ("wheel_lr", True)
    assert check.remedy.endswith(".")
    assert "FAULT" in str(check)
    assert preflight.mend(servos, [check]) == [check]
    assert failed(servos) == [check]


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["leg_lf", "leg_rr"])
def test_a_silent_servo_is_named_and_no_other_one(server, servos, joint):
    server.machine.inject(f"dead {joint}")
    server.machine.step()
    (check,) = failed(servos)
    assert (check.where, check.what, check.found) == (joint, "answer", "none")
    assert "bus legs" in check.remedy
    read = [servos.read().answered.tolist() for _ in range(3)]
    assert read[1] == read[2] == [other != joint for other in JOINTS]


def test_supply_and_temperature(server, servos):
    server.machine.inject("sag value=3")
    server.machine.inject("overheat wheel_lf value=400 duration=0.1")
    server.advance(0.12)
    found = failed(servos)
    assert {(c.where, c.what) for c in found if c.what == "supply"} == {(joint, "supply") for joint in JOINTS}
    assert [c.where for c in found if c.what == "temperature"] == ["wheel_lf"]
    assert {c.what for c in found} == {"supply", "temperature", "hardware error"}


#: Joint, item, altered count: every item of both models, each beyond what the factory and the hardware file say.
ALTERED = [
    *(("leg_rf", *item) for item in (
        ("return_delay_time", 250), ("drive_mode", 1), ("drive_mode", 4), ("drive_mode", 8), ("operating_mode", 4),
        ("operating_mode", 5), ("secondary_id", 1), ("homing_offset", 5), ("temperature_limit", 100),
        ("max_voltage_limit", 130), ("min_voltage_limit", 110), ("pwm_limit", 200), ("current_limit", 100),
        ("velocity_limit", 50), ("max_position_limit", 3500), ("min_position_limit", 2000), ("startup_configuration", 1),
        ("startup_configuration", 2), ("shutdown", 0), ("status_return_level", 0), ("status_return_level", 1),
        ("bus_watchdog", -1),
    )),
    *(("wheel_lr", *item) for item in (
        ("return_delay_time", 20), ("drive_mode", 5), ("operating_mode", 16), ("secondary_id", 8), ("homing_offset", -700),
        ("temperature_limit", 60), ("max_voltage_limit", 125), ("min_voltage_limit", 105), ("pwm_limit", 884),
        ("velocity_limit", 264), ("max_position_limit", 2048), ("min_position_limit", 1), ("startup_configuration", 3),
        ("shutdown", 53), ("status_return_level", 1), ("bus_watchdog", -1),
    )),
]  # fmt: skip


@pytest.mark.parametrize(("joint", "item", "count"), ALTERED)
def test_each_altered_register_is_named_alone_and_mended(rig, joint, item, count):
    machine, servos = rig
    before = machine.servos[joint][item]
    machine.servos[joint].set(item, count)
    (check,) = failed(servos)
    named = {"bus_watchdog": ("watchdog", "latched", "clear")}.get(item, (item, str(count), str(before)))
    found = "no answer to reads" if (item, count) == ("status_return_level", 0) else named[1]
    assert (check.where, check.what, check.found, check.expected) == (joint, named[0], found, named[2])
    assert check.is_fatal == (item != "return_delay_time")
    assert "wlr doctor --mend" in check.remedy
    assert preflight.mend(servos, [check]) == []
    assert machine.servos[joint][item] == before
    assert failed(servos) == []


def test_no_register_of_either_model_is_forgotten():
    for bus, joint in (("legs", "leg_rf"), ("wheels", "wheel_lr")):
        items = load_table(HARDWARE.buses[bus].model).items.values()
        writable = {item.name for item in items if item.in_eeprom and item.writable}
        assert writable - set(preflight.IGNORED) == {name for name in preflight.MEANING if name in writable}
        assert {item for where, item, _ in ALTERED if where == joint} >= writable - set(preflight.IGNORED)
    assert len(ALTERED) >= 30


def test_what_the_hardware_file_asks_for_is_expected(rig):
    machine, servos = rig
    legs = HARDWARE.buses["legs"]
    bus = legs.model_copy(update={"eeprom": {**legs.eeprom, "pwm_limit": 600}})
    hardware = HARDWARE.model_copy(update={"buses": {**HARDWARE.buses, "legs": bus}})
    found = [check for check in preflight.check_servos(servos, ROBOT, hardware) if not check.ok]
    assert [(check.where, check.found, check.expected) for check in found] == [(leg, "885", "600") for leg in JOINTS[:4]]
    assert preflight.mend(servos, found) == []
    assert machine.servos["leg_rr"]["pwm_limit"] == 600


def test_a_servo_that_answers_no_reads_is_not_called_a_bad_line(rig):
    machine, servos = rig
    machine.servos["wheel_rf"].set("status_return_level", 0)
    machine.servos["wheel_rf"].set("pwm_limit", 100)
    (check,) = failed(servos)  # the other one is seen once this one is mended
    assert (check.what, check.found) == ("status_return_level", "no answer to reads")
    assert preflight.mend(servos, [check]) == []
    assert [check.what for check in failed(servos)] == ["pwm_limit"]


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


@pytest.mark.slow
def test_bus_speed_names_losses(server, servos):
    assert preflight.check_bus_speed(servos, reads=20, budget=1.0).ok
    for group in servos.groups.values():
        group.fast = False
    server.machine.inject("drop leg_lf")
    check = preflight.check_bus_speed(servos, reads=3, budget=9.0)
    assert not check.ok
    assert "3 of 24 answers lost" in check.found
    assert "wlr deploy --emulated --stepped" in check.remedy  # a robot on pseudo-terminals has no cables
    assert "cables" not in check.remedy


def test_latency_timer(tmp_path):
    setting = tmp_path / "bus/usb-serial/devices/ttyUSB0/latency_timer"
    setting.parent.mkdir(parents=True)
    for value, ok in (("16", False), ("1", True)):
        setting.write_text(value + "\n")
        (check,) = preflight.check_latency_timers(HARDWARE, tmp_path)  # the wheels' port has no such file
        assert (check.where, check.ok) == ("legs", ok)
