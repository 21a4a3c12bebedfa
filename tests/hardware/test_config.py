"""The hardware file: what it says of the nominal robot, and what is refused."""

import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config
from wlr_gym.hardware.config import SafetyLimits, load_hardware, require_leg_range, unit_of, with_ports
from wlr_gym.robot import LEGS, WHEELS, load_robot


def test_nominal_robot_has_two_buses():
    hardware = load_hardware()
    assert hardware.buses["legs"].joints == LEGS
    assert hardware.buses["wheels"].joints == WHEELS
    assert hardware.buses["legs"].model == "XM540-W150-R"
    assert load_hardware(hardware) is hardware


def edited(tmp_path, edit):
    data = yaml.safe_load(find_config("hardware", "nominal").read_text(encoding="utf-8"))
    edit(data)
    path = tmp_path / "hardware.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda d: d["buses"]["legs"].update(baud_rate=123), "baud rate 123; the servos know 9600"),
        (lambda d: d["buses"]["legs"].update(model="XM540-W150"), "did you mean 'XM540-W150-R'"),
        (lambda d: d["buses"]["legs"]["joints"].pop(), "must name each of leg_lf"),
        (lambda d: d["buses"]["wheels"]["joints"].append("leg_lf"), "must name each of leg_lf"),
        (lambda d: d["joints"].pop("leg_lf"), "must name each of leg_lf"),
        (lambda d: d["joints"]["leg_lf"].update(sign=2), "joints.leg_lf.sign"),
        (lambda d: d["buses"]["legs"]["eeprom"].update(led=1), "led: not in the EEPROM"),
        (
            lambda d: d["buses"]["legs"]["eeprom"].update(operating_mode=16),
            r"yaml: .*legs.eeprom.operating_mode is 16, expected 3",
        ),
        (
            lambda d: d["buses"]["wheels"]["eeprom"].pop("operating_mode"),
            r"yaml: .*eeprom.operating_mode is 3, expected 1",
        ),
        (
            lambda d: d["buses"]["legs"]["eeprom"].update(drive_mode=1),
            r"yaml: .*legs.eeprom.drive_mode is 1, expected 0: leg_lf",
        ),
        (lambda d: d["buses"]["legs"].update(prot="x"), "did you mean 'port'"),
        (lambda d: d["imu"].update(gyro_range=300), "imu.gyro_range"),
        (
            lambda d: d["joints"].update(leg_fl=d["joints"].pop("leg_lf")),
            r"yaml: joints: unknown joint 'leg_fl' \(did you mean 'leg_lf'\?\)",
        ),
        (
            lambda d: d["buses"]["legs"]["joints"].append("wheel_fr"),
            r"buses.legs.joints: .*'wheel_fr' \(did you mean 'wheel_rf'",
        ),
        (lambda d: d["buses"].update(imu=d["buses"].pop("legs")), r"buses.imu: a sensor is called that"),
        (lambda d: d["safety"].update(warm=70), r"yaml: safety.warm = 70 degC: expected below hot = 68 degC$"),
        (lambda d: d["safety"].update(leg_error=0.6), r"yaml: safety.leg_error = 0.6 rad: expected below leg_lead = 0.45 rad"),
        (lambda d: d["safety"].update(leg_margin=3), r"yaml: safety.leg_margin = 3: expected 0.5 or less \(rad\)$"),
        (lambda d: d["safety"].update(load_time="long"), r"load_time = 'long': expected a number \(s\)$"),
    ],
)
def test_refusals(tmp_path, edit, words):
    with pytest.raises(InputError, match=words):
        load_hardware(edited(tmp_path, edit))


def test_other_ports():
    hardware = with_ports(load_hardware(), {"legs": "/dev/here", "imu": "/dev/there"})
    assert (hardware.buses["legs"].port, hardware.imu.port) == ("/dev/here", "/dev/there")
    assert hardware.buses["wheels"] == load_hardware().buses["wheels"]
    with pytest.raises(InputError, match=r"unknown port 'leg' \(did you mean 'legs'\?\); valid: imu, legs, wheels"):
        with_ports(hardware, {"leg": "x"})


@pytest.mark.parametrize("name", SafetyLimits.model_fields)
def test_no_limit_is_without_upper_bound(tmp_path, name):
    words = rf"safety\.{name} = 100000: expected [0-9.]+ or less \({unit_of(name)}\)$"
    assert unit_of(name)
    with pytest.raises(InputError, match=words):
        load_hardware(edited(tmp_path, lambda data: data["safety"].update({name: 100000})))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("silence", 400), ("current", 10000), ("hot", 154), ("leg_error_time", 300), ("tilt_time", 100), ("imu_silence", 100),
        ("heartbeat", 800), ("start_error", 17), ("frozen_leg", 1.7), ("start_speed", 57), ("stop_time", 600),
    ],
)  # fmt: skip
def test_limits_in_another_unit_are_refused(tmp_path, name, value):
    with pytest.raises(InputError, match=rf"safety\.{name} = {value}: expected [0-9.]+ or less"):
        load_hardware(edited(tmp_path, lambda data: data["safety"].update({name: value})))


def test_a_margin_that_leaves_nothing_of_a_robots_leg_range_is_refused():
    hardware, robot = load_hardware(), load_robot("emanual")
    require_leg_range(hardware, robot, "here.yaml")
    narrow = robot.model_copy(update={"leg_limits": (1.55, 1.65)})
    with pytest.raises(
        InputError, match=r"here.yaml: safety.leg_margin = 0.05 rad: expected below 0.05 rad: .* 1.55 to 1.65 rad"
    ):
        require_leg_range(hardware, narrow, "here.yaml")
