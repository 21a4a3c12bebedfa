"""The control tables against the SDK's own model files, and their own rules."""

import importlib.util
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.hardware.config import check_fit, load_hardware
from wlr_gym.hardware.dynamixel.protocol import Error
from wlr_gym.hardware.dynamixel.tables import INPUT_VOLTAGE, TABLE_SIZE, load_table, shipped_tables
from wlr_gym.hardware.emulator.servo import EmulatedServo
from wlr_gym.hardware.servos import JointMap
from wlr_gym.robot import load_robot

MODELS = {
    "XM540-W150-R": "xm540_w150",
    "XL430-W250-T": "xl430_w250",
    "XM430-W350-R": "xm430_w350",
    "XH540-W150-R": "xh540_w150",
    "XH540-V150-R": "xh540_v150",
    "XH540-V270-R": "xh540_v270",
}
#: Written down from the e-manual's pages a second time, apart from the tables: model number, supply range (V), Velocity and
#: Current Limit (counts), gains after a reset (Velocity I, Velocity P, Position P), stall torque (N m), no-load speed (rpm) and
#: stall current (A) at the recommended supply (V).
E_MANUAL = {
    "XM540-W150-R": (1130, (9.5, 16.0), 230, 2047, (1920, 100, 800), (7.3, 53, 4.4, 12.0)),
    "XL430-W250-T": (1060, (6.0, 14.0), 265, None, (1000, 100, 640), (1.5, 61, 1.4, 12.0)),
    "XM430-W350-R": (1020, (9.5, 16.0), 200, 1193, (1920, 100, 800), (4.1, 46, 2.3, 12.0)),
    "XH540-W150-R": (1110, (9.5, 16.0), 300, 2047, (1920, 100, 800), (7.1, 70, 4.9, 12.0)),
    "XH540-V150-R": (1150, (11.0, 30.0), 230, 1188, (1920, 100, 800), (6.4, 60, 2.4, 24.0)),
    "XH540-V270-R": (1140, (11.0, 30.0), 128, 2047, (1920, 100, 800), (9.2, 34, 2.4, 24.0)),
}
ROBOT_24_V = Path(__file__).resolve().parents[2] / "examples" / "own_robot" / "robot.yaml"
#: Names that differ between the SDK's model files and the e-manual's tables.
RENAMED = {
    "secondary(shadow) id": "secondary_id",
    "indirect address write": "indirect_address_1",
    "indirect data write": "indirect_data_1",
    "indirect address read": "indirect_address_29",
    "indirect data read": "indirect_data_29",
}


def sdk_rows(stem):
    """(address, size, name) as the SDK's model file has them."""
    spec = importlib.util.find_spec("dynamixel_easy_sdk")
    if spec is None or spec.origin is None:
        pytest.skip("dynamixel-sdk is not installed")
    text = (Path(spec.origin).parent / "control_table" / f"{stem}.model").read_text(encoding="utf-8")
    rows = text.partition("[control table]")[2].splitlines()[2:]
    for address, size, name in (row.split("\t") for row in rows if row.strip()):
        lowered = name.strip().lower()
        yield int(address), int(size), RENAMED.get(lowered, lowered.replace(" ", "_"))


@pytest.mark.parametrize("model", MODELS)
def test_addresses_and_sizes_are_those_of_the_sdk(model):
    table = load_table(model)
    rows = list(sdk_rows(MODELS[model]))
    assert len(rows) >= 55
    for address, size, name in rows:
        assert (table[name].address, table[name].size) == (address, size), name
    known = {name for *_, name in rows} | {"startup_configuration", "backup_ready"}  # newer than the model files
    assert {name for name in table.items if not name.startswith("indirect")} <= known


@pytest.mark.parametrize("model", MODELS)
def test_items_do_not_overlap_and_bounds_name_items(model):
    table = load_table(model)
    items = list(table.items.values())
    for before, after in pairwise(items):
        assert before.address + before.size <= after.address, (before, after)
    assert items[-1].address + items[-1].size == TABLE_SIZE
    for item in items:
        for bound in (item.default, item.low, item.high):
            assert not isinstance(bound, str) or bound.lstrip("-") in table.items
        assert item.quantity in {*table.units, None, "degC", "ms", "2us"}, item
        if isinstance(item.default, int):
            assert item.decode(item.encode(item.default)) == item.default
        if item.writable and item.name != "operating_mode":
            assert item.low is not None
            assert item.high is not None
    assert sum(name.startswith("indirect_address") for name in table.items) == 56


def test_every_model_that_ships_is_compared():
    assert set(shipped_tables()) == set(MODELS) == set(E_MANUAL)


@pytest.mark.parametrize("model", MODELS)
def test_numbers_are_those_of_the_e_manual(model):
    number, supply, velocity, current, gains, (torque, speed, stall, volt) = E_MANUAL[model]
    table = load_table(model)
    assert (table.model, table.model_number, table["model_number"].default) == (model, number, number)
    assert table.voltage_range() == pytest.approx(supply)
    assert table["velocity_limit"].default == velocity
    assert ("current_limit" in table.items) == (current is not None) == (table.effort == "present_current")
    if current is not None:
        assert (table["current_limit"].default, table["current_limit"].high) == (current, current)
    assert tuple(table[f"{name}_gain"].default for name in ("velocity_i", "velocity_p", "position_p")) == gains
    sheet = table.data_sheet
    assert (sheet.stall_torque, sheet.no_load_rpm, sheet.stall_current, sheet.voltage) == (torque, speed, stall, volt)
    assert sheet.no_load_speed == pytest.approx(speed * math.pi / 30)
    assert table.units["position"] == pytest.approx(2 * math.pi / 4096)
    assert table.units["current"] * 372 == pytest.approx(1.0, abs=2e-3)
    assert table.units["profile_acceleration"] == pytest.approx(0.374508, abs=1e-6)


def test_gains_of_the_tables_are_those_of_the_robot_files():
    """Two sources of the same numbers: the control tables' defaults at the robots' supply, and the robot files."""
    nominal, large = load_robot(), load_robot(ROBOT_24_V)
    for robot, leg, wheel in ((nominal, "XM540-W150-R", "XL430-W250-T"), (large, "XH540-V270-R", "XH540-V150-R")):
        legs, wheels = (load_table(model).at(robot.servo.supply_voltage) for model in (leg, wheel))
        wanted = (
            (legs, "position_p_gain", robot.servo.leg.kp),
            (wheels, "velocity_i_gain", robot.servo.wheel.kp),
            (wheels, "velocity_p_gain", robot.servo.wheel.kd),
        )
        for table, name, gain in wanted:
            default = table[name].default
            assert isinstance(default, int)
            assert default * table.per_count(name) == pytest.approx(gain, rel=1e-3)
        assert legs.per_count("present_position") == pytest.approx(robot.sensors.encoder.position, rel=1e-9)


def test_pwm_is_a_part_of_the_supply():
    at_12, at_24 = (load_table("XM540-W150-R").at(volt) for volt in (12.0, 24.0))
    assert at_24.per_count("position_p_gain") == pytest.approx(2 * at_12.per_count("position_p_gain"))
    assert at_24.per_count("present_velocity") == at_12.per_count("present_velocity")


def own_servo(folder, **changes):
    """A servo of one's own: the file of one that ships, with changes."""
    import wlr_gym.hardware.dynamixel.tables as tables

    content = yaml.safe_load((Path(tables.__file__).parent / "xm540_w150.yaml").read_text(encoding="utf-8"))
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump(content | {"model": "MINE-1"} | changes), encoding="utf-8")
    return path


def test_a_servo_of_ones_own_is_a_file(tmp_path):
    path = own_servo(tmp_path, counts={"turn": 16384, "full_pwm": 2009})
    table = load_table(str(path))
    assert table.model == "MINE-1"
    assert table.per_count("present_position") == pytest.approx(2 * math.pi / 16384)
    assert table.extended_range == 256 * 16384 - 1
    assert table.per_count("position_p_gain") == pytest.approx(12 / 2009 / 128 / (2 * math.pi / 16384))
    hardware = load_hardware().model_dump(mode="json") | {"name": "mine", "robot": None}
    hardware["buses"]["legs"]["model"] = "mine.yaml"
    (tmp_path / "hardware.yaml").write_text(yaml.safe_dump(hardware))
    loaded = load_hardware(tmp_path / "hardware.yaml")
    with pytest.raises(InputError, match=r"leg_lf: sensors\.encoder\.position is 0\.00153398, a count of MINE-1 is 0\.000383"):
        check_fit(load_robot(), loaded)


def test_what_is_wrong_in_a_servo_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"mine\.yaml: unknown series 'x_serie'.*did you mean 'x_series'"):
        load_table(str(own_servo(tmp_path, series="x_serie")))
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(InputError, match=r"counts: unknown key 'turns' .did you mean 'turn'"):
        load_table(str(own_servo(other, counts={"turns": 4096})))
    (tmp_path / "empty.yaml").write_text("model: X\n")
    with pytest.raises(InputError, match=r"empty\.yaml: 'model_number' is missing"):
        load_table(str(tmp_path / "empty.yaml"))


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ("servo.supply_voltage", 24.0, r"bus 'legs', leg_lf: servo\.supply_voltage is 24 V, XM540-W150-R takes 9\.5 to 16 V"),
        ("sensors.encoder.position", 0.01, r"sensors\.encoder\.position is 0\.01, a count of XM540-W150-R is 0\.00153"),
        ("servo.wheel.current_count", 2.69e-3, "servo.wheel reports counts of current_count, XL430-W250-T measures no current"),
        ("servo.leg.load_count", 1e-3, "servo.leg reports counts of load_count, XM540-W150-R measures its current"),
        ("servo.leg.current_count", 4e-3, r"servo\.leg\.current_count is 0\.004 A, a count of XM540-W150-R is 0\.00269 A"),
    ],
)
def test_a_robot_with_other_servos_than_its_wiring_is_refused(place, value, message):
    content = load_robot().model_dump(mode="json")
    *parents, last = place.split(".")
    group = content
    for key in parents:
        group = group[key]
    group[last] = value
    with pytest.raises(InputError, match=message):
        check_fit(load_robot(content), load_hardware())
    check_fit(load_robot(), load_hardware())


def test_unknown_names_are_told_the_nearest():
    with pytest.raises(InputError, match="did you mean 'goal_position'"):
        load_table("XM540-W150-R")["goal_postion"]
    with pytest.raises(InputError, match="did you mean 'XL430-W250-T'"):
        load_table("XL430-W250")
    with pytest.raises(InputError, match="unknown servo model"):
        load_table("XM540")
    with pytest.raises(InputError, match="has no SI unit"):
        load_table("XL430-W250-T").per_count("led")


def test_counts_that_do_not_fit_are_refused():
    table = load_table("XM540-W150-R")
    assert table["goal_position"].encode(-1) == b"\xff\xff\xff\xff"
    assert table["goal_position"].decode(b"\xff\xff\xff\xff") == -1
    assert table.block("realtime_tick", "present_position") == (120, 16)
    with pytest.raises(InputError, match="goal_pwm = 40000"):
        table["goal_pwm"].encode(40000)


def test_an_emulated_servo_of_24_v_measures_its_supply():
    servo = EmulatedServo("leg", load_table("XH540-V270-R"), {})
    assert servo["present_input_voltage"] == 240
    servo.advance(0.01)
    assert servo["hardware_error_status"] == 0
    servo.shaft.voltage = 10.0  # of a 12 V battery
    servo.advance(0.01)
    assert servo["hardware_error_status"] == INPUT_VOLTAGE
    servo.shaft.output = lambda: (0, 0.5)
    assert servo["present_pwm"] == round(0.5 * 885)


def test_an_emulated_servo_counts_as_its_file_says(tmp_path):
    table = load_table(str(own_servo(tmp_path, counts={"turn": 16384, "full_pwm": 2009})))
    servo = EmulatedServo("leg", table, {"operating_mode": 4})
    servo.shaft.position = 2.5 * math.pi
    servo.shaft.output = lambda: (0, -1.0)
    assert servo["present_position"] == round(1.25 * 16384)
    assert servo["present_pwm"] == -2009
    write = table["goal_position"]
    assert servo.write(write.address, write.encode(table.extended_range)) == Error.NONE
    assert servo.write(write.address, write.encode(table.extended_range + 1)) == Error.DATA_RANGE


def test_counts_of_a_robot_are_those_of_its_servos(tmp_path):
    own_servo(tmp_path, counts={"turn": 16384, "full_pwm": 2009})
    hardware: dict[str, Any] = load_hardware().model_dump(mode="json") | {"robot": None}
    hardware["buses"]["legs"]["model"] = "mine.yaml"
    hardware["joints"]["leg_lf"]["zero"] = 8192
    (tmp_path / "hardware.yaml").write_text(yaml.safe_dump(hardware))
    joints = JointMap(load_robot(), load_hardware(tmp_path / "hardware.yaml"))
    counts = joints.setpoint_counts([math.pi / 4, *[0.0] * 7])
    assert counts[0] == 8192 + 2048
    assert joints.position(counts)[0] == pytest.approx(math.pi / 4)
    assert joints.voltage_share([2009, 0, 0, 0, 885, 0, 0, 0])[[0, 4]] == pytest.approx([1.0, 1.0])
    hardware["joints"]["leg_lf"]["zero"] = 16384
    (tmp_path / "hardware.yaml").write_text(yaml.safe_dump(hardware))
    with pytest.raises(InputError, match=r"joints\.leg_lf\.zero = 16384: expected 0 to 16383"):
        load_hardware(tmp_path / "hardware.yaml")
