"""The hardware file: what it says of the nominal robot, and what is refused."""

import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config
from wlr_gym.hardware.config import load_hardware, with_ports
from wlr_gym.robot import LEGS, WHEELS


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
    ],
)
def test_refusals(tmp_path, edit, words):
    with pytest.raises(InputError, match=words):
        load_hardware(edited(tmp_path, edit))


def test_other_ports():
    hardware = with_ports(load_hardware(), {"legs": "/dev/here", "imu": "/dev/there"})
    assert (hardware.buses["legs"].port, hardware.imu.port) == ("/dev/here", "/dev/there")
    assert hardware.buses["wheels"] == load_hardware().buses["wheels"]
    with pytest.raises(InputError, match="no bus 'leg'"):
        with_ports(hardware, {"leg": "x"})
