"""A run that is made up, and logs of it as other programs write them: other names, units, rates and clocks."""

import json
from pathlib import Path

import numpy as np
import pandas

from wlr_gym.data.format import COMMANDS
from wlr_gym.data.logs import suggest_map
from wlr_gym.data.logs.map import OPEN, LogMap, parse_map
from wlr_gym.data.logs.messages import header, make, nanoseconds, typestore
from wlr_gym.robot import JOINTS, LEGS, WHEELS, load_robot

NAMES = dict(zip(JOINTS, ("FL_hip", "FR_hip", "RL_hip", "RR_hip", "FL_wheel", "FR_wheel", "RL_wheel", "RR_wheel"), strict=True))
EPOCH = 1_760_000_000
RATE = 200
RADIUS, HALF_TRACK = load_robot().wheel.radius, load_robot().hip_position.y
IMU, POSE, BATTERY, STATE = (
    "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/BatteryState", "sensor_msgs/msg/JointState",
)  # fmt: skip


def made_up(seconds=30.0, seed=0):
    """Return a table of a robot that starts and stops, turns, and swings its legs, at RATE rows a second; 30 camera frames."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    speed = _smooth(0.12 * np.sign(np.sin(2 * np.pi * t / 6.0)) * (t < seconds / 2))
    rate = _smooth(0.4 * np.sign(np.sin(2 * np.pi * t / 5.0)) * (t >= seconds / 2))
    yaw, way = np.cumsum(rate) / RATE, np.cumsum(speed) / RATE
    legs = np.pi / 2 + _smooth(0.3 * np.sign(np.sin(2 * np.pi * t / 4.0)) * (t > 0.8 * seconds), 100)
    table = {"t": t}
    for leg in LEGS:
        table |= {f"cmd_{leg}": legs, f"pos_{leg}": legs - 0.01, f"vel_{leg}": np.gradient(legs, t)}
        table[f"eff_{leg}"] = 0.3 * np.gradient(legs, t) + 0.01 * rng.standard_normal(len(t))
    for wheel in WHEELS:
        side = 1.0 if wheel.endswith(("lf", "lr")) else -1.0
        angle = (way - side * HALF_TRACK * yaw * 2.0) / RADIUS  # in turns they slip
        table |= {f"cmd_{wheel}": np.gradient(angle, t), f"pos_{wheel}": angle, f"vel_{wheel}": np.gradient(angle, t)}
        table[f"eff_{wheel}"] = 0.05 * np.gradient(angle, t) + 0.005 * rng.standard_normal(len(t))
    gyro = {"x": 0.0 * t, "y": 0.0 * t, "z": rate}
    acc = {"x": np.gradient(speed, t), "y": speed * rate, "z": 9.81 + 0.0 * t}
    table |= {f"gyro_{axis}": one + 9e-4 * rng.standard_normal(len(t)) for axis, one in gyro.items()}
    table |= {f"acc_{axis}": one + 0.03 * rng.standard_normal(len(t)) for axis, one in acc.items()}
    place = np.cumsum(np.stack([speed * np.cos(yaw), speed * np.sin(yaw)]) / RATE, axis=1)
    frames = np.diff(np.floor(t * 30.0), prepend=-1.0) > 0
    for name, one, noise in (("cam_x", place[0], 1e-3), ("cam_y", place[1], 1e-3), ("cam_yaw", yaw, 5e-3)):
        table[name] = np.where(frames, one + noise * rng.standard_normal(len(t)), np.nan)
    table["volt"] = 12.0 + 0.03 * rng.standard_normal(len(t))
    return table


def _smooth(values, rows=60):
    kernel = np.convolve(np.ones(rows), np.ones(rows))
    return np.convolve(values, kernel / kernel.sum(), mode="same")


def rows_of(table, every=4):
    """Return the table at the joints' rate."""
    return {name: values[::every] for name, values in table.items()}


# ---- messages of ROS -------------------------------------------------------------------------------------------------


def ns(t):
    return nanoseconds(float(t), EPOCH)


def joint_state(time, names, position, velocity=(), effort=()):
    arrays = {"position": position, "velocity": velocity, "effort": effort}
    return make(
        STATE, header=header(time, ""), name=list(names), **{key: np.asarray(one, float) for key, one in arrays.items()}
    )


def vector(values):
    return dict(zip("xyz", map(float, values), strict=True))


def turn(yaw):
    return {"z": float(np.sin(yaw / 2)), "w": float(np.cos(yaw / 2))}


def imu(time, gyro, acc):
    readings = {"angular_velocity": vector(gyro), "linear_acceleration": vector(acc)}
    return make(IMU, header=header(time, "imu"), orientation=turn(0.0), **readings)


def pose(time, x, y, yaw):
    return make(POSE, header=header(time, "map"), pose={"position": vector((x, y, 0.2)), "orientation": turn(yaw)})


def lab_messages(table, offset=0.037, imu_axes=((0, 1), (1, 1), (2, 1)), names=NAMES, seed=0):
    """Return (ns received, topic, type, message): degrees, other names, an IMU at 200 Hz whose clock is ``offset`` s ahead."""
    rng, out = np.random.default_rng(seed), []
    order = list(names)[::-1]
    for k, t in enumerate(table["t"]):
        if k % 4 == 0:
            position, velocity = (np.degrees([table[f"{kind}_{joint}"][k] for joint in order]) for kind in ("pos", "vel"))
            efforts = [table[f"eff_{joint}"][k] for joint in order]
            message = joint_state(ns(t), [names[joint] for joint in order], position, velocity, efforts)
            out.append((ns(t + 0.002 * rng.random()), "/chassis/joints", STATE, message))
            goals = np.degrees([table[f"cmd_{joint}"][k] for joint in order])
            is_leg = np.array([joint in LEGS for joint in order])
            late = t + 0.001
            message = joint_state(
                ns(late), [names[joint] for joint in order], np.where(is_leg, goals, np.nan), np.where(is_leg, np.nan, goals)
            )
            out.append((ns(late + 0.002 * rng.random()), "/chassis/target", STATE, message))
        gyro, acc = ([table[f"{kind}_{axis}"][k] for axis in "xyz"] for kind in ("gyro", "acc"))
        gyro, acc = ([sign * one[place] for place, sign in imu_axes] for one in (gyro, acc))
        out.append((ns(t + 0.004 * rng.random()), "/xsens/data", IMU, imu(ns(t + offset), np.degrees(gyro), acc)))
        if np.isfinite(table["cam_x"][k]):
            message = pose(ns(t), table["cam_x"][k], table["cam_y"][k], table["cam_yaw"][k])
            out.append((ns(t + 0.01 + 0.004 * rng.random()), "/mocap/base", POSE, message))
        if k % 40 == 0:
            out.append((ns(t), "/power", BATTERY, make(BATTERY, header=header(ns(t), ""), voltage=float(table["volt"][k]))))
    return sorted(out, key=lambda one: one[0])


#: Units of the laboratory's bags, and of its tables, where names do not state them.
_UNITS = {"pos": "deg", "vel": "deg/s", "cmd_leg": "deg", "cmd_wheel": "deg/s", "eff": "N m", "gyro": "deg/s",
          "acc": "m/s2", "cam": "m", "volt": "V"}  # fmt: skip
_OF_TABLES = {"pos": "rad", "vel": "rad/s", "cmd_leg": "rad", "cmd_wheel": "rad/s", "gyro": "rad/s", "acc": "g"}


def lab_map(log, given=None, **units) -> LogMap:
    """Return the map that is proposed for a log of the laboratory, its questions answered, but not that for the profile."""
    content = suggest_map(log, given).content
    for key, entry in content["channels"].items():
        known = {**_UNITS, **(_OF_TABLES if entry["topic"] == "table" else {}), **units}
        if entry.get("unit") == OPEN:
            name = max((one for one in known if key.startswith(one)), key=len)
            entry["unit"] = known[name]
    for joint, entry in content.get("joints", {}).items():
        answers = {"sign": 1, "zero": 0.0}
        content["joints"][joint] = {key: answers[key] if one == OPEN else one for key, one in entry.items()}
    for frame, axes in content.get("frames", {}).items():
        content["frames"][frame] = ["x", "y", "z"] if axes == OPEN else axes
    for topic, clock in content.get("clocks", {}).items():
        content["clocks"][topic] = {"offset": -0.037} if clock == OPEN else clock
    if content.get("meta", {}).get("profile") == OPEN:
        del content["meta"]["profile"]
    return parse_map(content, "map")


def write_rosbag2(path, messages, storage="sqlite3"):
    from rosbags.rosbag2 import StoragePlugin, Writer

    connections = {}
    with Writer(path, version=8, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        for time, topic, kind, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
            writer.write(connections[topic], time, typestore().serialize_cdr(message, kind))
    return Path(path)


def write_rosbag1(path, messages):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, connections = get_typestore(Stores.ROS1_NOETIC), {}
    with Writer(path) as writer:
        for time, topic, kind, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], time, store.serialize_ros1(_noetic(message, store), kind))
    return Path(path)


def _noetic(message, store):
    """ROS 1's headers count their messages."""
    fields = {"seq": 0, "stamp": message.header.stamp, "frame_id": message.header.frame_id}
    message.header = store.types["std_msgs/msg/Header"](**fields)
    return message


def write_mcap(path, messages, compression=None, chunk=64 * 1024):
    """With the writer of the package mcap, definitions as ros2msg."""
    from mcap.writer import CompressionType, Writer

    channels = {}
    with Path(path).open("wb") as file:
        writer = Writer(file, chunk_size=chunk, compression=compression or CompressionType.ZSTD)
        writer.start(profile="ros2", library="test")
        for time, topic, kind, message in messages:
            if topic not in channels:
                text, _ = typestore().generate_msgdef(kind, ros_version=2)
                channels[topic] = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", text.encode()))
            writer.add_message(channels[topic], time, bytes(typestore().serialize_cdr(message, kind)), time)
        writer.finish()
    return Path(path)


# ---- tables ----------------------------------------------------------------------------------------------------------


def lab_frame(table):
    """Return a table with names and units as a laboratory's own logger writes them: ms, degrees, rpm, mA."""
    rows = rows_of(table)
    frame = {"time_ms": np.round(1e3 * rows["t"], 6)}
    for joint in JOINTS:
        name = NAMES[joint].lower()
        frame[f"{name}_pos_deg"] = np.degrees(rows[f"pos_{joint}"])
        frame[f"{name}_speed_rpm"] = rows[f"vel_{joint}"] * 30.0 / np.pi
        goal = rows[f"cmd_{joint}"]
        frame[f"{name}_goal" + ("_deg" if joint in LEGS else "_rpm")] = (
            np.degrees(goal) if joint in LEGS else goal * 30.0 / np.pi
        )
    frame |= {f"g{axis}": rows[f"gyro_{axis}"] for axis in "xyz"} | {
        f"a{axis}": rows[f"acc_{axis}"] / 9.80665 for axis in "xyz"
    }
    return pandas.DataFrame(frame | {"vbat_mv": 1e3 * rows["volt"], "comment": "ok"})


def write_lerobot(folder, table):
    """Version 3: two episodes, state and action as lists with names in meta/info.json."""
    rows = rows_of(table)
    state = [f"{kind}_{joint}" for kind in ("pos", "vel") for joint in JOINTS]
    labels = [f"{NAMES[joint]}.{kind}" for kind in ("pos", "vel") for joint in JOINTS]
    count = len(rows["t"]) // 2
    index = np.arange(2 * count)
    frame = pandas.DataFrame(
        {
            "observation.state": list(np.stack([rows[name][: 2 * count] for name in state], axis=1).astype(np.float32)),
            "action": list(np.stack([rows[name][: 2 * count] for name in COMMANDS], axis=1).astype(np.float32)),
            "timestamp": (0.02 * (index % count)).astype(np.float32),
            "frame_index": index % count,
            "episode_index": index // count,
            "index": index,
            "task_index": 0 * index,
        }
    )
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    frame.to_parquet(folder / "data" / "chunk-000" / "file-000.parquet")
    features = {
        "observation.state": {"dtype": "float32", "shape": [len(state)], "names": labels},
        "action": {"dtype": "float32", "shape": [8], "names": {"motors": [NAMES[joint] for joint in JOINTS]}},
        "observation.images.top": {"dtype": "video", "shape": [3, 96, 96], "names": ["c", "h", "w"]},
    }
    info = {"codebase_version": "v3.0", "fps": 50, "total_episodes": 2, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    return folder
