"""What Foxglove and PlotJuggler need of an exported file, by others' readers: mcap, rosbags and, where it is, mcap_ros2."""

import xml.etree.ElementTree as ElementTree
from typing import Any

import numpy as np
import pytest
from foreign_logs import made_up, rows_of

from wlr_gym.data import read_run
from wlr_gym.data.logs import export_run
from wlr_gym.data.runs import write_run
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import JOINTS, LEGS, WHEELS, load_robot


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return read_run(write_run(tmp_path_factory.mktemp("run") / "run_01.csv", rows_of(made_up(3.0))))


@pytest.fixture(scope="module")
def path(run, tmp_path_factory):
    return export_run(run, tmp_path_factory.mktemp("mcap") / "a.mcap")


@pytest.fixture(scope="module")
def messages(path):
    """Topic -> (ns, message), decoded by the definitions that are in the file."""
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    found, stores = {}, {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if schema.id not in stores:
                stores[schema.id] = get_typestore(Stores.EMPTY)
                stores[schema.id].register(get_types_from_msg(schema.data.decode(), schema.name))
            store = stores[schema.id]
            found.setdefault(channel.topic, []).append((message.log_time, store.deserialize_cdr(message.data, schema.name)))
    return found


def test_profile_encodings_index_and_counts(path, messages):
    from mcap.reader import make_reader

    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        assert all(schema.encoding == "ros2msg" and schema.data for schema in summary.schemas.values())
        kinds = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
        assert kinds == {
            "/wlr/run": "std_msgs/msg/String", "/joint_states": "sensor_msgs/msg/JointState",
            "/joint_commands": "sensor_msgs/msg/JointState", "/imu": "sensor_msgs/msg/Imu",
            "/supply": "wlr_gym_msgs/msg/Supply", "/camera": "wlr_gym_msgs/msg/Camera",
            "/robot_description": "std_msgs/msg/String", "/pose": "geometry_msgs/msg/PoseStamped",
            "/tf": "tf2_msgs/msg/TFMessage", "/slip": "visualization_msgs/msg/MarkerArray",
        }  # fmt: skip
        statistics = summary.statistics
        assert statistics is not None
        assert statistics.message_count == sum(map(len, messages.values()))
        assert {summary.channels[place].topic: count for place, count in statistics.channel_message_counts.items()} == {
            topic: len(one) for topic, one in messages.items()
        }
        assert len(summary.chunk_indexes) == statistics.chunk_count > 0
        assert all(one.message_index_offsets for one in summary.chunk_indexes)
        begin, end = statistics.message_start_time, statistics.message_end_time
        assert (end - begin) * 1e-9 == pytest.approx(2.98)
        middle = (begin + end) // 2
        later = list(reader.iter_messages(topics=["/imu"], starting_at=middle))
        assert len(later) == pytest.approx(len(messages["/imu"]) / 2, abs=1)


def test_what_a_plot_shows_is_the_run(messages, run):
    stamps = [time for time, _ in messages["/joint_states"]]
    assert stamps == sorted(stamps)
    for time, message in messages["/joint_states"]:
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time
        assert message.name == list(JOINTS)
    for k, joint in enumerate(JOINTS):
        assert np.array_equal([message.position[k] for _, message in messages["/joint_states"]], run[f"pos_{joint}"])
    assert np.array_equal([message.angular_velocity.z for _, message in messages["/imu"]], run["gyro_z"])
    poses = [message.pose.position.x for _, message in messages["/pose"]]
    assert np.array_equal(poses, run["cam_x"][np.isfinite(run["cam_x"])])
    assert 2 * len(messages["/slip"]) == len(messages["/tf"]) > 60


def test_frames_make_one_tree_that_the_robots_links_are_in(messages):
    parents = {}
    for _, message in messages["/tf"]:
        for one in message.transforms:
            turn = one.transform.rotation
            assert np.linalg.norm([turn.w, turn.x, turn.y, turn.z]) == pytest.approx(1.0)
            assert parents.setdefault(one.child_frame_id, one.header.frame_id) == one.header.frame_id
    for frame in parents:
        for _ in parents:
            frame = parents.get(frame, frame)
        assert frame == "floor"
    robot = ElementTree.fromstring(messages["/robot_description"][0][1].data)
    assert {link.get("name") for link in robot.findall("link")} == set(parents) - {"body"}
    assert {joint.get("name") for joint in robot.findall("joint")} == set(JOINTS)
    shown = {message.header.frame_id for topic in ("/pose",) for _, message in messages[topic]}
    shown |= {marker.header.frame_id for _, message in messages["/slip"] for marker in message.markers}
    assert shown == {"floor"}


def of(element, tag, name):
    """Return an attribute of an element's child."""
    child = element.find(tag)
    assert child is not None
    return str(child.get(name))


def test_a_link_is_where_the_urdf_puts_it(messages, run):
    """By the origins and axes in the URDF itself: a joint's rotation about its axis, after its origin."""
    robot = ElementTree.fromstring(messages["/robot_description"][0][1].data)
    joints = {of(one, "child", "link"): one for one in robot.findall("joint")}
    time, message = next(one for one in messages["/tf"][40:] if len(one[1].transforms) > 1)
    row = [at for at, _ in messages["/joint_states"]].index(time)
    moved = {one.child_frame_id: one for one in message.transforms}
    for joint in (*LEGS, *WHEELS):
        one, described = moved[f"{joint}_link"], joints[f"{joint}_link"]
        assert of(described, "axis", "xyz") == "0 1 0"
        assert of(described, "parent", "link") == one.header.frame_id
        place = one.transform.translation
        assert np.allclose([place.x, place.y, place.z], [float(v) for v in of(described, "origin", "xyz").split()])
        turn, angle = one.transform.rotation, run[f"pos_{joint}"][row]
        assert 2 * np.arctan2(turn.y, turn.w) == pytest.approx(np.arctan2(np.sin(angle / 2), np.cos(angle / 2)) * 2)
    leg = moved["leg_lf_link"].transform.rotation
    down = rotation(np.zeros(1), np.array([2 * np.arctan2(leg.y, leg.w)]), np.zeros(1))[0] @ np.array([1.0, 0.0, 0.0])
    assert down[2] < -0.9  # legs stand about straight down
    assert load_robot().name == robot.get("name")


def test_rosbags_opens_the_bag_and_finds_all_topics(run, messages, tmp_path):
    from rosbags.highlevel import AnyReader

    bag = export_run(run, tmp_path / "bag", "rosbag2")
    with AnyReader([bag]) as reader:
        assert {topic: one.msgcount for topic, one in reader.topics.items()} == {
            topic: len(one) for topic, one in messages.items()
        }
        (connection,) = [one for one in reader.connections if one.topic == "/joint_states"]
        _, time, data = next(iter(reader.messages(connections=[connection])))
        message: Any = reader.deserialize(data, connection.msgtype)
        assert time == messages["/joint_states"][0][0]
        assert np.array_equal(message.position, messages["/joint_states"][0][1].position)


def test_foxgloves_own_reader_decodes_it(path, messages):
    reader = pytest.importorskip("mcap_ros2.reader", reason="needs mcap-ros2-support")
    count = dict.fromkeys(messages, 0)
    for message in reader.read_ros2_messages(str(path)):
        place = count[message.channel.topic]
        time, ours = messages[message.channel.topic][place]
        count[message.channel.topic] += 1
        assert message.log_time_ns == time
        if message.channel.topic == "/joint_states":
            assert list(message.ros_msg.position) == ours.position.tolist()
        if message.channel.topic == "/robot_description":
            assert message.ros_msg.data == ours.data
    assert count == {topic: len(one) for topic, one in messages.items()}
