"""What is wrong with a log is said: the file, the topic, the field."""

import re
import sqlite3

import numpy as np
import pytest
from foreign_logs import (
    NAMES,
    RATE,
    joint_state,
    lab_frame,
    lab_map,
    lab_messages,
    made_up,
    ns,
    rows_of,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_run
from wlr_gym.data.format import COLUMNS
from wlr_gym.data.logs import import_log, read_logs, suggest_map
from wlr_gym.data.logs.map import factor
from wlr_gym.physics.servo import current_law
from wlr_gym.robot import JOINTS, load_robot


def test_no_such_file(tmp_path):
    with pytest.raises(InputError, match=r"none.mcap: no such file or folder; expected an .mcap"):
        list(read_logs(tmp_path / "none.mcap"))
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match=r"a.txt: '.txt' files are not read"):
        list(read_logs(tmp_path / "a.txt"))
    (tmp_path / "b.mcap").touch()
    with pytest.raises(InputError, match=r"b.mcap: empty file"):
        list(read_logs(tmp_path / "b.mcap"))


@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "a.bag", "a.parquet"])
def test_noise_is_no_log(tmp_path, name):
    (tmp_path / name).write_bytes(np.random.default_rng(0).bytes(5000))
    words = " rosbag1: it does not begin with #ROSBAG V" if name == "a.bag" else ""
    with pytest.raises(InputError, match=rf"{name}: cannot be read as{words}"):
        list(read_logs(tmp_path / name))


def test_an_mcap_file_that_is_cut_off_is_read_up_to_there(mcap, answered, tmp_path):
    whole = mcap.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (imported,) = import_log(tmp_path / "cut.mcap", tmp_path / "runs", answered)
    assert "cut off or broken near byte" in imported.notes[0]
    assert imported.path.is_file()


def test_a_broken_chunk_is_left_out(mcap, answered, tmp_path):
    whole = bytearray(mcap.read_bytes())
    place = len(whole) // 4
    whole[place : place + 40] = b"\xff" * 40
    (tmp_path / "broken.mcap").write_bytes(whole)
    (imported,) = import_log(tmp_path / "broken.mcap", tmp_path / "runs", answered)
    assert any("broken" in note for note in imported.notes)


def test_a_rosbag1_that_is_cut_off(tmp_path):
    bag = write_rosbag1(tmp_path / "a.bag", lab_messages(made_up(3.0)))
    bag.write_bytes(bag.read_bytes()[:-2000])
    with pytest.raises(InputError, match=r"a.bag: cannot be read as rosbag1"):
        list(read_logs(bag))


def test_a_rosbag2_that_is_cut_off(messages, tmp_path):
    bag = write_rosbag2(tmp_path / "b", messages)
    (file,) = bag.glob("*.db3")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    try:
        (log,) = read_logs(bag)
    except InputError as error:
        assert "b: cannot be read as rosbag2" in str(error)  # noqa: PT017
    else:
        assert "broken after" in log.notes[0]


def test_a_bag_without_its_file(messages, tmp_path):
    bag = write_rosbag2(tmp_path / "b", messages, "mcap")
    next(bag.glob("*.mcap")).unlink()
    with pytest.raises(InputError, match=r"metadata.yaml names b.mcap, which is not there"):
        list(read_logs(bag))


def test_a_topic_or_field_that_is_not_there(mcap, answered, tmp_path):
    wrong = {**answered, "channels": {**answered["channels"], "volt": {"topic": "/powr", "field": "voltage"}}}
    with pytest.raises(InputError, match=r"lab.mcap: unknown topic '/powr' \(did you mean '/power'\?\)"):
        import_log(mcap, tmp_path / "runs", wrong)
    wrong = {**answered, "channels": {**answered["channels"], "volt": {"topic": "/power", "field": "volts"}}}
    with pytest.raises(InputError, match=r"lab.mcap: channel 'volt': topic '/power': unknown field 'volts'"):
        import_log(mcap, tmp_path / "runs", wrong)
    assert not list((tmp_path / "runs").glob("run_*"))


def test_a_wrong_unit_is_said_with_topic_and_field(mcap, answered, tmp_path):
    wrong = {
        **answered,
        "channels": {**answered["channels"], "pos_leg": {"topic": "/chassis/joints", "field": "position[{joint}]"}},
    }
    message = (
        r"lab.mcap: row \d+, column 'pos_leg_lf': .* looks like degrees \(from topic '/chassis/joints', field 'position\[FL_h"
    )
    with pytest.raises(InputError, match=message):
        import_log(mcap, tmp_path / "runs", wrong)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"chanels": {}}, r"unknown key 'chanels' \(did you mean 'channels'\?\)"),
        ({"channels": {"pos_lg": {"topic": "a", "field": "b"}}}, r"unknown channel 'pos_lg' \(did you mean 'pos_leg'\?\)"),
        ({"joints": {"leg_fl": "a"}}, r"unknown joint 'leg_fl'"),
        ({"channels": {"pos": {"topic": "a", "field": "b", "unit": "degrees"}}}, r"unknown unit 'degrees'"),
        ({"frames": {"imu": ["x", "y", "-z"]}}, r"expected x, y and z once each, right-handed"),
    ],
)
def test_a_broken_map(mcap, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        import_log(mcap, tmp_path / "runs", change)


def test_mixed_units_are_said(tmp_path):
    table = made_up(6.0)
    messages = []
    for k in range(0, len(table["t"]), 4):
        position = [table[f"pos_{joint}"][k] for joint in JOINTS]
        position[0] = np.degrees(position[0])
        message = joint_state(ns(table["t"][k]), NAMES.values(), position)
        messages.append((ns(table["t"][k]), "/joints", "sensor_msgs/msg/JointState", message))
    found = suggest_map(write_mcap(tmp_path / "mixed.mcap", messages))
    (said,) = [line for line in found.lines if line.place == "channels.pos_leg"]
    assert said.asks
    assert re.search(r"leg_lf 89\.\d+ to \d+.*; leg_rf 1\.\d+ to \d", said.why)


def test_two_robots_in_one_bag(messages, tmp_path):
    both = [(time, f"/{robot}{topic}", kind, message) for time, topic, kind, message in messages for robot in ("alpha", "beta")]
    bag = write_mcap(tmp_path / "two.mcap", both)
    with pytest.raises(
        InputError, match=r"two.mcap: two robots: topics .*say which in the map: namespace: /alpha  \(or /beta\)"
    ):
        suggest_map(bag)
    found = lab_map(bag, {"namespace": "/beta"})
    assert {source.topic for source in found.channels.values()} == {
        "/beta/chassis/joints", "/beta/chassis/target", "/beta/xsens/data", "/beta/mocap/base", "/beta/power",
    }  # fmt: skip


def test_two_robots_in_one_topic(tmp_path):
    table, messages = made_up(3.0), []
    for k in range(0, 2 * RATE, 4):
        names = [f"{robot}_{NAMES[joint]}" for robot in ("r1", "r2") for joint in JOINTS]
        values = [table[f"pos_{joint}"][k] for joint in JOINTS] * 2
        message = joint_state(ns(table["t"][k]), names, values)
        messages.append((ns(table["t"][k]), "/joints", "sensor_msgs/msg/JointState", message))
    with pytest.raises(
        InputError, match=r"topic '/joints': fields 'position\[r1_FL_hip\]' and .* are both the leg_lf: two robots"
    ):
        suggest_map(write_mcap(tmp_path / "two.mcap", messages))


def test_a_type_without_a_definition_is_left_out_and_said(messages, tmp_path):
    bag = write_rosbag2(tmp_path / "b", messages)
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as base:
        base.execute("UPDATE topics SET type = 'lab_msgs/msg/Power' WHERE name = '/power'")
        base.execute("DELETE FROM message_definitions")
    text = (bag / "metadata.yaml").read_text().replace("sensor_msgs/msg/BatteryState", "lab_msgs/msg/Power")
    (bag / "metadata.yaml").write_text(text)
    (log,) = read_logs(bag)
    assert "/power" not in log.topics
    assert "/xsens/data" in log.topics  # of a type that ROS comes with
    assert any("topic '/power': type 'lab_msgs/msg/Power': the file does not define it" in note for note in log.notes)


@pytest.mark.parametrize(
    ("topic", "kind", "message"),
    [("target", "cmd", "the setpoints that drove the robot"), ("joints", "pos", "the joints' angles")],
)
def test_what_every_run_needs_is_asked_and_a_map_without_it_is_refused(messages, answered, tmp_path, topic, kind, message):
    bag = write_mcap(tmp_path / "a.mcap", [one for one in messages if one[1] != f"/chassis/{topic}"])
    assert {f"channels.{kind}_{part}.topic" for part in ("leg", "wheel")} <= set(suggest_map(bag).open)
    less = {**answered, "channels": {key: one for key, one in answered["channels"].items() if not key.startswith(kind)}}
    with pytest.raises(InputError, match=rf"a.mcap: no source for {kind}_leg_lf, .*: {message}"):
        import_log(bag, tmp_path / "runs", less)


def test_a_log_is_imported_once(mcap, answered, tmp_path):
    import_log(mcap, tmp_path / "runs", answered)
    with pytest.raises(InputError, match=r"run_01 comes from it already"):
        import_log(mcap, tmp_path / "runs", answered)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda frame: frame.drop(columns="time_ms"), "no column of times"),
        (lambda frame: frame.assign(time_ms=frame["time_ms"][::-1].to_numpy()), "row 1, column 'time_ms': times must increase"),
        (lambda frame: frame[:1], "1 rows; a recording has at least 2"),
    ],
)
def test_broken_tables(tmp_path, change, message):
    change(lab_frame(made_up(3.0))).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=message):
        list(read_logs(tmp_path / "a.csv"))


def test_other_encodings_are_said(tmp_path):
    from mcap.writer import Writer

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("lab.Wheels", "jsonschema", b"{}")
        places = {
            "json": writer.register_channel("/wheels", "json", schema),
            "pb": writer.register_channel("/pb", "protobuf", schema),
        }
        for k in range(3):
            writer.add_message(places["json"], k, b'{"header": {"stamp": {"sec": 1, "nsec": 5}}, "speed": [1, 2.5]}', k)
            writer.add_message(places["pb"], k, b"\x00", k)
        writer.finish()
    (log,) = read_logs(tmp_path / "a.mcap")
    assert log.topics["/wheels"].fields["speed[1]"][1].tolist() == [2.5] * 3
    assert log.topics["/wheels"].stamped is not None
    assert any("topic '/pb': messages in 'protobuf' are not read" in note for note in log.notes)


# ---- efforts: a unit that is wrong or open is refused or asked, whoever the robot is ---------------------------------------


UNITS = {"A": 1.0, "mA": 1e-3}


def written(tmp_path, unit, name="current", wheels_only=False):
    """Return a table with the efforts as currents, or as torques in a unit, and the torques (rows,) of each joint."""
    table = rows_of(made_up(8.0))
    torques = {joint: 0.03 * np.tanh(table[f"vel_{joint}"]) + 0.003 for joint in JOINTS}
    constants = dict(zip(JOINTS, current_law(load_robot()).torque_constant, strict=True))
    frame = lab_frame(made_up(8.0))
    for joint in JOINTS[4:] if wheels_only else JOINTS:
        size = UNITS[unit] * constants[joint] if unit in UNITS else {"N m": 1.0, "mN m": 1e-3}[unit]
        frame[f"{NAMES[joint].lower()}_{name}"] = torques[joint] / size
    frame.to_csv(tmp_path / "a.csv", index=False)
    return tmp_path / "a.csv", torques


def read_as(log, unit, name="current"):
    """Return the proposed map with another unit of the efforts."""
    known = lab_map(log, eff="N m" if name == "effort" else "A").model_dump()
    efforts = {f"eff_{joint}": f"{NAMES[joint].lower()}_{name}" for joint in JOINTS[4:]}
    known["channels"] |= {key: {"topic": "table", "field": one, "unit": unit} for key, one in efforts.items()}
    return known


@pytest.mark.parametrize("unit", UNITS)
def test_a_current_comes_in_as_a_torque(tmp_path, unit):
    log, torques = written(tmp_path, unit)
    known = lab_map(log, eff=unit)
    (imported,) = import_log(log, tmp_path / "runs", known)
    run = read_run(imported.path)
    for joint in JOINTS:
        assert np.allclose(run[f"eff_{joint}"], torques[joint][: len(run["t"])], rtol=1e-6)
    (note,) = [note for note in imported.notes if note.startswith("efforts")]
    assert note == f"efforts in {unit} become N m by the torque constants of 'wlr-nominal': name your robot (--robot)"
    (named,) = import_log(log, tmp_path / "named", known, robot="nominal")
    assert not [note for note in named.notes if note.startswith("efforts")]


@pytest.mark.parametrize("robot", [None, "nominal"])
@pytest.mark.parametrize(
    ("unit", "name", "read", "message"),
    [
        ("mA", "effort", "N m", r"a.csv: row \d+, column 'eff_wheel_lf': -?\d\S+ N m; expected up to 1.5, the stall torque of"),
        ("mN m", "effort", "N m", "column 'eff_wheel_lf': .*; looks like mA, mN m or counts of a register"),
        ("A", "current", "mA", r"column 'eff_wheel_lf': \S+ N m; expected more than 0.0015, one count of robot 'wlr-nominal'"),
        ("N m", "effort", "mN m", "looks like A or N m .from topic 'table', field 'fl_wheel_effort', read as mN m: check its"),
        ("mA", "current", None, "'eff_wheel_lf': field 'fl_wheel_current' is a current: expected its unit: A, mA or count"),
    ],
)  # fmt: skip
def test_a_unit_that_makes_no_sense_is_refused(tmp_path, robot, unit, name, read, message):
    log, _ = written(tmp_path, unit, name, wheels_only=True)
    with pytest.raises(InputError, match=message):
        import_log(log, tmp_path / "runs", read_as(log, read, name), robot=robot)
    assert not (tmp_path / "runs").exists()


def test_every_channel_has_units_or_says_that_it_has_none():
    robot = load_robot()
    assert all(factor(column, one.unit, robot, "map") == 1.0 for column, one in COLUMNS.items() if one.unit != "-")
    assert factor("cam_age", "ms", robot, "map") == factor("flow_age", "ms", robot, "map") == 1e-3
    with pytest.raises(InputError, match=r"^map: channel 'flow_quality': unit 'ms': expected none"):
        factor("flow_quality", "ms", robot, "map")


def test_a_unit_of_efforts_is_asked_with_their_size(tmp_path):
    log, _ = written(tmp_path, "mA", "effort")
    found = suggest_map(log)
    assert {f"channels.eff_{part}.unit" for part in ("leg", "wheel")} <= set(found.open)
    (said,) = [line.why for line in found.lines if line.place == "channels.eff_wheel"]
    assert "the motor stalls at 1.5 N m" in said
    assert "A, mA and counts become N m by the robot's torque constants" in said
