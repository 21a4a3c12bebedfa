"""``wlr doctor`` on the emulated robot: a good one passes; each fault is named first, with its remedy and exit code."""

import io
import json
import re
import sys
from functools import partial

import numpy as np
import pytest

from wlr_gym.base.errors import InputError, MissingPackageError
from wlr_gym.cli import doctor
from wlr_gym.cli.options import RobotOption
from wlr_gym.hardware import serial_frames
from wlr_gym.hardware.config import FlowPort, load_hardware, with_ports
from wlr_gym.robot import load_robot

pytest.importorskip("dynamixel_sdk")
pytest.importorskip("serial")
pytest.importorskip("termios")

from wlr_gym.hardware import servos as servo_setup
from wlr_gym.hardware.emulator import Machine, MachineOptions, Server
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.safety import preflight

ROBOT, HARDWARE = load_robot("emanual"), load_hardware()


@pytest.fixture
def machine(monkeypatch):
    machine = Machine(ROBOT, HARDWARE)
    monkeypatch.setattr(RobotOption, "link", lambda self: emulated_link(machine))
    return machine


def look(capsys, **options):
    code = doctor.run(doctor.DoctorOptions(emulated=True, **options))
    return code, capsys.readouterr().out


def test_a_good_robot_passes(machine, capsys):
    code, text = look(capsys)
    assert (code, text.splitlines()[-1]) == (0, "All 214 checks passed.")
    assert "8 of 8     supply" in text
    assert "bus speed: median 3.00 ms" in text
    assert "All 8" not in text
    assert doctor.run(doctor.DoctorOptions(emulated=True, json=True)) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found) == 214
    assert {entry["where"] for entry in found} >= {"legs", "imu", "wheel_rr", "robot"}


@pytest.mark.parametrize(
    ("fault", "first", "remedy"),
    [
        ("unplug wheels", "wheels, port: not there", "--port wheels=PATH"),
        ("unplug imu", "imu, port: not there", "--port imu=PATH"),
        ("dead leg_rr", "leg_rr, answer: none", "cable and adapter of bus legs"),
        ("overload leg_lf", "leg_lf, hardware error: overload", "reboot it"),
        ("sag value=3", "leg_lf, supply: 9.", "Charge the battery"),
        ("dead imu", "imu, readings: none", "baud rate"),
        ("imu_axis_dead value=5", "imu, axis: gyroscope z reads 0 counts", "supply and wires of the chip"),
        ("imu_axis_saturated value=0", "imu, axis: accelerometer x reads 32767 counts", "exchange it"),
    ],
)
def test_each_fault_is_named_first_with_its_remedy(machine, capsys, fault, first, remedy):
    machine.inject(fault)
    machine.step()
    code, text = look(capsys)
    assert code == 1
    where, what, found = re.split(", |: ", first)
    told = [line for line in text.splitlines() if line.startswith(f"FAULT   {where:10} {what}: {found}")]
    assert len(told) == 1
    assert remedy in told[0]
    assert "expected some" not in told[0]
    assert f"Look first at {where}, {what}: its line above" in text


def test_servos_without_fast_reads_are_a_warning(monkeypatch, capsys):
    machine = Machine(ROBOT, HARDWARE, MachineOptions(firmware=44))
    monkeypatch.setattr(RobotOption, "link", lambda self: emulated_link(machine))
    code, text = look(capsys)
    assert (code, "0 faults, 8 warnings in" in text) == (0, True)


def test_bus_speed_is_judged_by_the_hardware_files_read_time(machine, monkeypatch, capsys):
    safety = HARDWARE.safety.model_copy(update={"read_time": 0.002})
    hardware = HARDWARE.model_copy(update={"safety": safety})
    monkeypatch.setattr(RobotOption, "load", lambda self: (ROBOT, hardware))
    code, text = look(capsys)
    assert (code, "Look first at robot, bus speed:" in text, "expected p99 below 2 ms" in text) == (1, True, True)


def test_a_tilted_robot_and_a_lossy_imu(machine, capsys):
    machine.inject("drop imu probability=0.1")
    code, text = look(capsys)
    assert (code, "Look first at imu, losses:" in text) == (0, True)
    assert "0 faults, 1 warning in" in text
    machine.clear()

    def tilted(setpoints, torque):
        sensors = machine.coupling.sensors
        sensors.accelerometer[0] = np.array([3.0, 0.0, 9.3]) + 0.02 * (machine.ticks // 5 % 2)
        sensors.gyro[0] = 0.001 * (machine.ticks // 5 % 2)
        return sensors

    machine.plant.step = tilted
    code, text = look(capsys)
    assert (code, "Look first at imu, level:" in text) == (1, True)
    assert "wlr calibrate imu --mounting" in text


def test_an_eeprom_that_keeps_nothing_is_called_that(machine, capsys, monkeypatch):
    machine.servos["leg_lr"].set("return_delay_time", 250)
    machine.inject("eeprom_worn leg_lr")
    machine.step()
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    code, text = look(capsys, mend=True)
    assert code == 0  # it is only slow
    assert "mended: 0, left: 1" in text
    assert "leg_lr: return_delay_time was written and did not stick" in text


def test_mending_asks_writes_registers_and_looks_again(machine, capsys, monkeypatch):
    machine.servos["leg_lr"].set("return_delay_time", 250)
    machine.servos["wheel_rf"].set("drive_mode", 1)
    code, text = look(capsys)
    assert (code, "1 fault, 1 warning in" in text) == (1, True)
    assert "wheel_rf   drive_mode: 1, expected 0" in text
    assert "Look first at wheel_rf, drive_mode:" in text
    assert "2 registers can be written, after a question: wlr doctor --emulated --mend" in text
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    with pytest.raises(InputError, match="nobody there to write it"):
        look(capsys, mend=True)
    assert machine.servos["leg_lr"]["return_delay_time"] == 250
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    code, text = look(capsys, mend=True)
    assert code == 0
    assert "leg_lr: return_delay_time, now 250, will be 0\nwheel_rf: drive_mode, now 1, will be 0" in text
    assert "Nothing moves. Write it? Enter to write it" in text
    assert "mended: 2, left: 0" in text
    assert machine.servos["leg_lr"]["return_delay_time"] == 0


def test_verbose_lists_every_joint(machine, capsys):
    assert len(look(capsys, verbose=True)[1].splitlines()) == 215


@pytest.mark.slow
def test_on_ports_with_a_scan(capsys, monkeypatch):
    machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, sensor_noise=False))
    machine.servos["wheel_lf"].set("id", 42)
    rates = (1_000_000, 4_500_000)  # each takes a second; the SDK does not know the last
    monkeypatch.setattr(servo_setup, "find_servos", partial(servo_setup.find_servos, baud_rates=rates))
    with Server(machine, real_time=False) as server:
        ports = tuple(f"{name}={path}" for name, path in server.ports.items())
        code = doctor.run(doctor.DoctorOptions(port=ports, scan=True))
    text = capsys.readouterr().out
    assert (code, "Look first at wheel_lf, answer:" in text) == (1, True)
    assert "wheels: id 42 at 1000000 bit/s: model 1060, firmware 45" in text
    assert text.count(" at 1000000 bit/s: model") == 8


def test_what_cannot_be_asked_for():
    with pytest.raises(InputError, match="--scan: the emulated robot"):
        doctor.run(doctor.DoctorOptions(emulated=True, scan=True))
    with pytest.raises(InputError, match="--port legs: expected name=value, such as legs=/dev/ttyUSB1"):
        doctor.run(doctor.DoctorOptions(port=("legs",)))
    with pytest.raises(InputError, match="one or the other"):
        doctor.run(doctor.DoctorOptions(port=("legs=/dev/x",), emulated=True))
    with pytest.raises(InputError, match="unknown port 'leg'"):
        doctor.run(doctor.DoctorOptions(port=("leg=/dev/x",)))


def test_ports_that_are_there_are_named(tmp_path):
    assert "no USB serial port" in preflight._plug_in("legs", tmp_path)
    (tmp_path / "ttyUSB3").touch()
    assert preflight._plug_in("legs", tmp_path).endswith("ttyUSB3.")
    (tmp_path / "serial/by-id").mkdir(parents=True)
    (tmp_path / "serial/by-id/usb-U2D2").touch()
    assert preflight._plug_in("legs", tmp_path).endswith("by-id/usb-U2D2.")


def write_policy(folder, **changes):
    from wlr_gym.learning.evaluation.rollout import make_core
    from wlr_gym.policy.file import write_contract

    core = make_core("WLR-Velocity-v0", 1, {})
    contract = core.contract() | changes
    core.close()
    write_contract(folder, "pid", {}, contract, {"environment": "WLR-Velocity-v0"})


def test_a_policy_that_fits_and_one_that_does_not(machine, capsys, tmp_path):
    write_policy(tmp_path)
    code, text = look(capsys, policy=tmp_path)
    assert (code, "policy     contract: pid, velocity" in text) == (0, True)
    write_policy(tmp_path, control_period=0.01)
    code, text = look(capsys, policy=tmp_path)
    assert code == 1
    assert "Look first at policy, contract:" in text
    assert "control_period is 0.01 in the policy, 0.02" in text
    with pytest.raises(InputError, match="is no policy"):
        look(capsys, policy=tmp_path / "nowhere")


@pytest.mark.parametrize(("policy", "ok"), [("velocity_slip_aware", True), ("path_slip_aware", False)])
def test_a_policy_trained_mostly_with_a_camera_is_warned_of(policy, ok):
    pytest.importorskip("onnxruntime")
    camera = doctor.check_policy(policy, "nominal")[-1]
    assert (camera.what, camera.ok) == ("camera", ok)


@pytest.mark.parametrize("emulated", [False, True])
def test_an_absent_sdk_is_named_with_its_extra(monkeypatch, emulated):
    monkeypatch.setitem(sys.modules, "dynamixel_sdk", None)
    for name in ("dynamixel.port", "emulator.link"):
        monkeypatch.delitem(sys.modules, f"wlr_gym.hardware.{name}", raising=False)
    with pytest.raises(MissingPackageError, match=r"dynamixel_sdk.*wlr-gym\[robot\]"):
        RobotOption(emulated=emulated).link()


def test_the_board_of_the_imu_tells_its_settings(machine, capsys, monkeypatch):
    def status(self, port):
        return serial_frames.STATUS_FRAMES.encode({**good, "gyro_range": 250, "bus_locks": 2}.values())

    good = dict.fromkeys(serial_frames.STATUS_FRAMES.fields, 0)
    good |= {"version_major": 1, "sensors": 1, "imu_rate": 200, "accel_range": 4, "bandwidth": 44}
    monkeypatch.setattr(Machine, "_board_status", status)
    code, text = look(capsys)
    assert code == 1
    assert re.search(r"FAULT +imu +settings: 200 Hz, 250 deg/s, 4 g, 44 Hz bandwidth, expected 200 Hz, 500 deg/s", text)
    assert "2 bus locks" in text
    monkeypatch.setattr(Machine, "_board_status", lambda self, port: b"")
    code, text = look(capsys)
    assert code == 0
    assert re.search(r"warning +imu +board: it does not say", text)


def test_both_sensors_on_one_board(monkeypatch, capsys):
    hardware = HARDWARE.model_copy(update={"flow": FlowPort(port=HARDWARE.imu.port)})
    machine = Machine(load_robot("flow"), hardware)
    monkeypatch.setattr(RobotOption, "link", lambda self: emulated_link(machine))
    monkeypatch.setattr(RobotOption, "load", lambda self: (machine.robot, hardware))
    code, text = look(capsys, verbose=True)
    assert code == 0, text
    assert re.search(r"flow +readings: 5\d of 50", text), text
    assert re.search(r"flow +losses: 0 lost, 0 broken", text)
    assert machine.sensors == ("imu",)
    moved = with_ports(hardware, {"imu": "/dev/other"})
    assert moved.flow is not None
    assert moved.flow.port == "/dev/other"
