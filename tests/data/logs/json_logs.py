"""A second writer of logs, unlike foreign_logs.py in everything: JSON in MCAP, its own words, units, axes and clocks.

Joints are a list of objects in degrees, rpm and mA, the right side mirrored, legs 0 where they hang. The IMU lies on its side
and counts from its own start, in deg/s and mg. Motion capture has y up, mm, and a clock that is behind.
"""

import json
from pathlib import Path

import numpy as np

from wlr_gym.physics.servo import current_law
from wlr_gym.robot import JOINTS, load_robot

WORDS = {"lf": "front_left", "rf": "front_right", "lr": "rear_left", "rr": "rear_right"}
EPOCH, UPTIME, BEHIND = 1_700_000_000.0, 4321.5, 0.08
#: Axes of the IMU that our x, y and z are.
IMU = ("z", "-x", "-y")


def name_of(joint):
    part, _, corner = joint.partition("_")
    return f"{'hip' if part == 'leg' else 'drive'}_{WORDS[corner]}"


def sign_of(joint):
    return -1.0 if joint.endswith(("rf", "rr")) else 1.0


def stamp(t):
    return {"sec": int(t), "nsec": round((t - int(t)) * 1e9)}


def _of_log(vector):
    """Return a vector in our axes as the IMU has it."""
    found = {}
    for ours, axis in zip(vector, IMU, strict=True):
        found[axis[-1]] = float(-ours if axis.startswith("-") else ours)
    return found


def messages(table):
    """Yield (s received, topic, content)."""
    torque = current_law(load_robot()).torque_constant
    for k, t in enumerate(table["t"]):
        if k % 4 == 0:
            joints, goals = [], []
            for place, joint in enumerate(JOINTS):
                zero = np.pi / 2 if joint.startswith("leg") else 0.0
                sign, at = sign_of(joint), table[f"pos_{joint}"][k] - zero
                joints.append(
                    {
                        "name": name_of(joint),
                        "angle_deg": sign * np.degrees(at),
                        "speed_rpm": sign * table[f"vel_{joint}"][k] * 30 / np.pi,
                        "current_ma": sign * 1e3 * table[f"eff_{joint}"][k] / torque[place],
                    }
                )
                goal = table[f"cmd_{joint}"][k] - zero
                one = (
                    {"target_deg": sign * np.degrees(goal)}
                    if joint.startswith("leg")
                    else {"target_rpm": sign * goal * 30 / np.pi}
                )
                goals.append({"name": name_of(joint)} | one)
            yield t + 0.001, "driver/state", {"header": {"stamp": stamp(EPOCH + t)}, "joints": joints[::-1]}
            yield t + 0.002, "driver/request", {"header": {"stamp": stamp(EPOCH + t + 0.0005)}, "joints": goals}
        gyro = _of_log([np.degrees(table[f"gyro_{axis}"][k]) for axis in "xyz"])
        acc = _of_log([table[f"acc_{axis}"][k] / 9.80665e-3 for axis in "xyz"])
        yield t + 0.003, "imu", {"header": {"stamp": stamp(UPTIME + t)}, "gyro": gyro, "accel": acc}
        if np.isfinite(table["cam_x"][k]):
            yaw = table["cam_yaw"][k]
            place = {"x": 1e3 * table["cam_x"][k], "y": 180.0, "z": -1e3 * table["cam_y"][k]}
            turn = {"w": np.cos(yaw / 2), "x": 0.0, "y": np.sin(yaw / 2), "z": 0.0}
            pose = {"position": place, "orientation": turn}
            yield t + 0.012, "optitrack", {"header": {"stamp": stamp(EPOCH + t - BEHIND)}, "pose": pose}
        if k % 100 == 0:
            yield t, "power", {"vbat_mv": 1e3 * table["volt"][k]}


def write_json_mcap(path, table):
    from mcap.writer import Writer

    channels = {}
    with Path(path).open("wb") as file:
        writer = Writer(file)
        writer.start()
        for t, topic, content in sorted(messages(table), key=lambda one: one[0]):
            if topic not in channels:
                schema = writer.register_schema(f"lab.{topic}", "jsonschema", b'{"type": "object"}')
                channels[topic] = writer.register_channel(topic, "json", schema)
            time = round((EPOCH + t) * 1e9)
            writer.add_message(channels[topic], time, json.dumps(content).encode(), time)
        writer.finish()
    return Path(path)
