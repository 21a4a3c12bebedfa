"""Bags as they come from robots: merged, restarted, renamed, without names. They come in right, or what is odd is said."""

import copy

import numpy as np
import pytest
from foreign_logs import (
    NAMES,
    POSE,
    imu,
    joint_state,
    lab_map,
    made_up,
    ns,
    pose,
    rows_of,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_run, write_run
from wlr_gym.data.logs import export_run, import_log, suggest_map
from wlr_gym.data.logs.map import TopicClock
from wlr_gym.data.logs.messages import definition, make, typestore
from wlr_gym.data.logs.topics import numbers
from wlr_gym.robot import JOINTS, LEGS


@pytest.fixture(scope="module")
def right(messages, known, tmp_path_factory):
    folder = tmp_path_factory.mktemp("right")
    (imported,) = import_log(write_mcap(folder / "a.mcap", messages), folder / "runs", known)
    return read_run(imported.path)


def of_topic(messages, topic):
    return [message for _, name, _, message in messages if name == topic]


def check_right(imported, right):
    run = read_run(imported.path)
    assert all(np.array_equal(run[name], right[name], equal_nan=True) for name in map(str, right.table.columns))


@pytest.mark.parametrize("write", [write_mcap, write_rosbag2, write_rosbag1])
def test_a_bag_without_a_message_is_refused(tmp_path, write):
    """Whatever a folder is called: ``a.bag`` may be one of rosbag2."""
    with pytest.raises(InputError, match=r"a.\w+: no message that can be read"):
        suggest_map(write(tmp_path / ("a.mcap" if write is write_mcap else "a.bag"), []))


def write_channels(path, messages):
    """With a channel for each topic and type."""
    from mcap.writer import Writer

    channels = {}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for time, topic, kind, message in messages:
            if (topic, kind) not in channels:
                schema = writer.register_schema(kind, "ros2msg", definition(kind).encode())
                channels[topic, kind] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic, kind], time, bytes(typestore().serialize_cdr(message, kind)), time)
        writer.finish()
    return path


def test_two_types_on_one_topic_are_kept_apart_and_said(messages, known, right, tmp_path):
    poses = [(time, "/xsens/data", POSE, pose(time, 9.0, 9.0, 0.0)) for time, *_ in messages[::40]]
    path = write_channels(tmp_path / "a.mcap", sorted([*poses, *messages], key=lambda one: one[0]))
    found = lab_map(path)
    second = "/xsens/data (sensor_msgs/msg/Imu)"
    assert found.channels["gyro"].topic == second
    assert "cam" not in found.channels
    (imported,) = import_log(path, tmp_path / "runs", found)
    assert f"two types on one topic: the second is '{second}'" in imported.notes
    run = read_run(imported.path)
    assert np.allclose(run["gyro_z"], right["gyro_z"])


def test_a_file_in_another_order_than_time_is_sorted(messages, known, right, tmp_path):
    order = np.random.default_rng(0).permutation(len(messages))
    path = write_mcap(tmp_path / "a.mcap", [messages[k] for k in order])
    assert lab_map(path) == known
    (imported,) = import_log(path, tmp_path / "runs", known)
    check_right(imported, right)


def test_headers_that_go_back_are_said(messages, known, tmp_path):
    changed = copy.deepcopy(messages)
    for message in of_topic(changed, "/chassis/joints")[200:203]:
        stamp = message.header.stamp
        message.header.stamp = make("builtin_interfaces/msg/Time", sec=stamp.sec - 1, nanosec=stamp.nanosec + 1)
    path = write_mcap(tmp_path / "a.mcap", changed)
    with pytest.raises(InputError, match=r"jumps by .* its times go back 1 times, by up to 0.98 s") as error:
        import_log(path, tmp_path / "runs", known)
    assert "column 'pos_" in str(error.value)
    by_log = known.model_copy(update={"clocks": {**known.clocks, "/chassis/joints": TopicClock(use="log")}})
    assert import_log(path, tmp_path / "runs", by_log)


def test_a_clock_that_began_anew_is_not_used(messages, known, tmp_path):
    changed = copy.deepcopy(messages)
    readings = of_topic(changed, "/xsens/data")
    for message, first in zip(readings[800:], readings[:800], strict=True):
        message.header.stamp = first.header.stamp
    path = write_mcap(tmp_path / "a.mcap", changed)
    found = lab_map(path)
    assert found.clocks["/xsens/data"].use == "log"
    (imported,) = import_log(path, tmp_path / "runs", known)
    assert any("a clock that began anew mixes two recordings: 'use: log'" in note for note in imported.notes)


def test_joints_in_another_order_in_each_message(messages, known, right, tmp_path):
    rng, changed = np.random.default_rng(0), copy.deepcopy(messages)
    for message in [one for topic in ("/chassis/joints", "/chassis/target") for one in of_topic(changed, topic)]:
        order = rng.permutation(len(message.name))
        message.name = [message.name[k] for k in order]
        for field in ("position", "velocity", "effort"):
            values = getattr(message, field)
            setattr(message, field, values[order] if len(values) else values)
    (imported,) = import_log(write_mcap(tmp_path / "a.mcap", changed), tmp_path / "runs", known)
    check_right(imported, right)


def test_joints_without_names_are_no_servos_and_go_by_place(messages, right, tmp_path):
    changed = copy.deepcopy(messages)
    for topic in ("/chassis/joints", "/chassis/target"):
        for message in of_topic(changed, topic):
            message.name = []
    path = write_mcap(tmp_path / "a.mcap", changed)
    found = suggest_map(path)
    assert {"channels.pos_leg.topic", "channels.cmd_wheel.field"} <= set(found.open)
    (said,) = [line.why for line in found.lines if line.place == "channels.pos_leg"]
    assert "topic '/chassis/joints': effort, position, velocity" in said
    assert "say which is which, by place, and suggest again: joints: {leg_lf: '0', ...}" in said
    by_place = {joint: str(k) for k, joint in enumerate(reversed(JOINTS))}
    (imported,) = import_log(path, tmp_path / "runs", lab_map(path, {"joints": by_place}))
    assert np.allclose(read_run(imported.path)["pos_leg_rf"], right["pos_leg_rf"])


@pytest.mark.parametrize("namespace", ["/robot_1", "robot_1/"])
def test_a_namespace_is_a_whole_word(messages, known, tmp_path, namespace):
    both = [
        (time, f"/robot_{robot}{topic}", kind, message)
        for time, topic, kind, message in messages
        for robot in (10, 1)
        if (robot, topic) != (1, "/power")
    ]
    path = write_mcap(tmp_path / "a.mcap", both)
    found = lab_map(path, {"namespace": namespace})
    assert {source.topic.split("/")[1] for source in found.channels.values()} == {"robot_1"}
    with pytest.raises(InputError, match="namespace '/robot_2': no topic is in it; topics are in /robot_10, /robot_1"):
        suggest_map(path, {"namespace": "/robot_2"})


def test_lists_with_headers_of_their_own_and_wheels_beside_legs(messages, known, right, tmp_path):
    """Legs and wheels of two drivers, each a topic with its own names; the wheels' come later and in rpm."""
    split = []
    for time, topic, kind, message in messages:
        if topic not in ("/chassis/joints", "/chassis/target"):
            split.append((time, topic, kind, message))
            continue
        for part, wanted in (("legs", LEGS), ("wheels", JOINTS[4:])):
            places = [message.name.index(NAMES[joint]) for joint in wanted]
            scale = 1.0 / 6.0 if part == "wheels" else 1.0
            velocity, effort = (values[places] if len(values) else values for values in (message.velocity, message.effort))
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            names = [message.name[k] for k in places]
            one = joint_state(stamp, names, message.position[places], velocity * scale, effort)
            split.append((time, f"/{part}{topic.removeprefix('/chassis')}", kind, one))
    path = write_mcap(tmp_path / "a.mcap", split)
    found = lab_map(path, vel_wheel="rpm")
    (imported,) = import_log(path, tmp_path / "runs", found)
    run = read_run(imported.path)
    for joint in JOINTS:
        assert np.allclose(run[f"vel_{joint}"], right[f"vel_{joint}"]), joint


def test_setpoints_of_a_trajectory_go_by_the_names_beside_its_points_or_by_place(messages, right, tmp_path):
    kind, changed = "trajectory_msgs/msg/JointTrajectory", []
    for time, topic, of_log, message in messages:
        if topic == "/chassis/target":
            lists = {name: getattr(message, of) for name, of in (("positions", "position"), ("velocities", "velocity"))}
            of_log, message = kind, make(kind, header=message.header, joint_names=list(message.name), points=[lists])
        changed.append((time, topic, of_log, message))
    path = write_mcap(tmp_path / "a.mcap", changed)
    found = lab_map(path)
    assert found.channels["cmd_leg"].field == "points[0].positions[{joint}]"
    (imported,) = import_log(path, tmp_path / "runs", found)
    check_right(imported, right)
    places = {
        f"cmd_{joint}": f"points[0].{('velocities', 'positions')[joint in LEGS]}[{k}]" for k, joint in enumerate(JOINTS[::-1])
    }
    by_place = {name: found.channels["cmd_leg" if "leg" in name else "cmd_wheel"].model_copy(update={"field": field})
        for name, field in places.items()}  # fmt: skip
    channels = {key: one for key, one in found.channels.items() if not key.startswith("cmd")} | by_place
    (imported,) = import_log(path, tmp_path / "places", found.model_copy(update={"channels": channels}))
    check_right(imported, right)


def test_two_imus_the_better_known_is_taken_and_the_other_said(messages, tmp_path):
    second = [
        (time, "/camera/imu", "sensor_msgs/msg/Imu", imu(ns(1e-9 * time - 1.76e9), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)))
        for time, topic, *_ in messages
        if topic == "/power"
    ]
    found = suggest_map(write_mcap(tmp_path / "a.mcap", sorted([*messages, *second], key=lambda one: one[0])))
    assert found.content["channels"]["gyro"]["topic"] == "/xsens/data"
    assert "/camera/imu" in found.unused


def test_poses_of_other_things_are_not_taken_for_the_bodys(tmp_path):
    """An exported run without a camera has poses of its links; a goal and a marker are no measurement either."""
    table = {name: values for name, values in rows_of(made_up(6.0)).items() if not name.startswith("cam")}
    run = read_run(write_run(tmp_path / "run_01.csv", table))
    found = suggest_map(export_run(run, tmp_path / "run_01.mcap"))
    assert not [key for key in found.content["channels"] if key.startswith("cam")]
    assert "cam" not in found.content["frames"]
    (said,) = [one for one in found.lines if one.place == "channels.cam"]
    assert said.why.startswith("not proposed: which pose of '/tf' is the body's")


@pytest.mark.parametrize("topic", ["/goal_pose", "/wheel_lf/pose", "/odom/pose"])
def test_a_setpoint_a_wheels_pose_or_a_computed_one_is_not_the_bodys(messages, tmp_path, topic):
    renamed = [(time, topic if name == "/mocap/base" else name, kind, message) for time, name, kind, message in messages]
    found = suggest_map(write_mcap(tmp_path / "a.mcap", renamed))
    assert "cam" not in found.content["channels"]
    assert any(f"'{topic}'" in one.why for one in found.lines if one.place == "channels.cam")


def test_of_several_poses_none_is_taken(messages, tmp_path):
    again = [(time, "/mocap/tool", kind, message) for time, name, kind, message in messages if name == "/mocap/base"]
    found = suggest_map(write_mcap(tmp_path / "a.mcap", sorted([*messages, *again], key=lambda one: one[0])))
    assert "cam" not in found.content["channels"]
    assert any("'/mocap/base', '/mocap/tool'" in one.why for one in found.lines if one.place == "channels.cam")


def test_a_voltage_of_a_plain_number_is_known_by_its_topic(messages, tmp_path):
    changed = [one for one in messages if one[1] != "/power"]
    for k in range(8):
        kind = "std_msgs/msg/Float32"
        changed.append((messages[0][0] + k * 10**9, "/vbat", kind, make(kind, data=12.0 - 0.1 * k)))
    log = write_mcap(tmp_path / "a.mcap", sorted(changed, key=lambda one: one[0]))
    known = lab_map(log)
    assert (known.channels["volt"].topic, known.channels["volt"].field) == ("/vbat", "data")
    (imported,) = import_log(log, tmp_path / "runs", known)
    run = read_run(imported.path)
    assert np.isfinite(run["volt"]).all()
    assert len(np.unique(run["volt"])) == 8  # held: no value that was not measured
    assert run["t"][-1] > 7.9  # and no row is lost after the last of it


def test_states_of_ros2_control_go_by_joint_and_interface():
    states = [{"interface_names": ["position", "velocity"], "values": [float(k), 0.5]} for k in range(2)]
    found = dict(numbers({"header": {}, "joint_names": ["FL_hip", "FR_hip"], "interface_values": states}))
    assert found == {
        "interface_values.position[FL_hip]": 0.0, "interface_values.velocity[FL_hip]": 0.5,
        "interface_values.position[FR_hip]": 1.0, "interface_values.velocity[FR_hip]": 0.5,
    }  # fmt: skip


def test_names_of_a_trajectory_stand_beside_its_points():
    points = [{"positions": [0.1, 0.2], "velocities": []}]
    found = dict(numbers({"joint_names": ["FL_hip", "FR_hip"], "points": points}))
    assert found["points[0].positions[FL_hip]"] == 0.1
    assert found["points[0].positions[FR_hip]"] == 0.2


def test_a_list_without_names_beside_named_joints_is_asked_channel_by_channel(messages, tmp_path):
    kind = "std_msgs/msg/Float64MultiArray"
    changed = [
        (time, topic, kind, make(kind, data=np.zeros(8))) if topic == "/chassis/target" else (time, topic, of, message)
        for time, topic, of, message in messages
    ]
    found = suggest_map(write_mcap(tmp_path / "a.mcap", changed))
    (said,) = [line.why for line in found.lines if line.place == "channels.cmd_leg"]
    assert "topic '/chassis/target': data" in said
    assert "channels: {cmd_leg_lf: {topic: TOPIC, field: 'data[0]'}, ...}" in said
