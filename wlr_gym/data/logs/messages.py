"""A run as messages of ROS 2: what is written to MCAP files and to rosbag2, and read back to the bit.

Every channel travels as float64 in a message of a type that Foxglove, PlotJuggler and ROS know, or, where those hold float32
or an attitude only, in one of two types of our own, whose definition is in the file as all others are. ``/wlr/run`` says which
columns the run has, and what stands beside it: ``meta.yaml`` and the record of the simulation.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.data.format import CAMERA, COLUMNS, FLOW, RunMeta
from wlr_gym.data.simulation_record import Simulation
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot, robot_content

Array = NDArray[np.float64]

RUN, JOINT_STATES, COMMANDS, IMU, SUPPLY, CAMERA_TOPIC, FLOW_TOPIC = (
    "/wlr/run", "/joint_states", "/joint_commands", "/imu", "/supply", "/camera", "/flow",
)  # fmt: skip
STRING, JOINT_STATE, IMU_TYPE = "std_msgs/msg/String", "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu"
#: Columns of the camera: its pose, and how old that is.
SEEN = (*CAMERA, "cam_age")
SUPPLY_TYPE, CAMERA_TYPE, FLOW_TYPE = "wlr_gym_msgs/msg/Supply", "wlr_gym_msgs/msg/Camera", "wlr_gym_msgs/msg/Flow"
#: Definitions of our own types: units as in docs/run_format.md.
OWN_TYPES = {
    SUPPLY_TYPE: "std_msgs/Header header\nfloat64 voltage",
    CAMERA_TYPE: "std_msgs/Header header\n" + "\n".join(f"float64 {name.removeprefix('cam_')}" for name in SEEN),
    FLOW_TYPE: "std_msgs/Header header\n" + "\n".join(f"float64 {name.removeprefix('flow_')}" for name in FLOW),
}
#: Frames: what the robot reads is in the body's, where it is stands in the floor's.
BODY, FLOOR = "body", "floor"
#: Version of this layout.
LAYOUT = 1
#: s; a header's seconds are 32 bits.
_LAST_SECOND = 2**31 - 1
_XYZ = "xyz"
_KINDS = (("position", "pos"), ("velocity", "vel"), ("effort", "eff"))


class Sent(NamedTuple):
    """A message to write: topic, type, ns, and its bytes (CDR)."""

    topic: str
    kind: str
    time: int
    data: bytes


@cache
def typestore() -> Any:
    """Return the types of ROS 2 and our own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for kind, text in OWN_TYPES.items():
        store.register(get_types_from_msg(text, kind))
    return store


@cache
def definition(kind: str) -> str:
    """Return the definition of a type, with those of the types in it."""
    return typestore().generate_msgdef(kind, ros_version=2)[0]


def make(kind: str, **fields: Any) -> Any:
    """Return a message of a type."""
    return typestore().types[kind](**fields)


def sent(topic: str, kind: str, time: int, message: Any) -> Sent:
    """Return a message as it is written."""
    return Sent(topic, kind, time, bytes(typestore().serialize_cdr(message, kind)))


def header(time: int, frame: str) -> Any:
    """Return the header of a message at ``time`` (ns)."""
    stamp = make("builtin_interfaces/msg/Time", sec=time // 1_000_000_000, nanosec=time % 1_000_000_000)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


# ---- times -----------------------------------------------------------------------------------------------------------


def clock_offset(first: float) -> int:
    """Return whole seconds that bring a clock into a header's range: 0 for all usual ones."""
    return 0 if 0.0 <= first < _LAST_SECOND - 1e6 else -math.floor(first)


def nanoseconds(t: float, offset: int = 0) -> int:
    """Return a time (s) in ns, to the nearest."""
    whole = math.floor(t)
    return (whole + offset) * 1_000_000_000 + round((t - whole) * 1e9)


def seconds(time: int, offset: int = 0) -> float:
    """Return a time (ns) in s: what :func:`nanoseconds` was given, to 1 ns."""
    return (time // 1_000_000_000 - offset) + (time % 1_000_000_000) / 1e9


# ---- a run, row by row -----------------------------------------------------------------------------------------------


def run_message(
    columns: Sequence[str],
    time: int,
    offset: int,
    meta: RunMeta,
    simulation: Simulation | None = None,
    name: str = "run",
    robot: Robot | None = None,
) -> Sent:
    """Return the message that a run begins with; ``robot`` travels by its content, where none that ships is meant."""
    content = {
        "layout": LAYOUT,
        "name": name,
        "columns": list(columns),
        "clock_offset": offset,
        "meta": meta.content(),
        "simulation": simulation.model_dump(mode="json") if simulation else None,
    } | ({} if robot is None else {"robot": robot_content(robot)})
    return sent(RUN, STRING, time, make(STRING, data=json.dumps(content)))


def row_messages(row: Mapping[str, float], time: int) -> Iterator[Sent]:
    """Yield the messages of one row; channels that it does not have are NaN or not sent."""
    yield sent(JOINT_STATES, JOINT_STATE, time, _joint_state(row, time))
    yield sent(COMMANDS, JOINT_STATE, time, _commands(row, time))
    if any(f"{kind}_{axis}" in row for kind in ("gyro", "acc") for axis in _XYZ):
        yield sent(IMU, IMU_TYPE, time, _imu(row, time))
    if "volt" in row:
        yield sent(SUPPLY, SUPPLY_TYPE, time, make(SUPPLY_TYPE, header=header(time, BODY), voltage=row["volt"]))
    frame = {name.removeprefix("cam_"): row.get(name, math.nan) for name in SEEN}
    if not all(map(math.isnan, frame.values())):
        yield sent(CAMERA_TOPIC, CAMERA_TYPE, time, make(CAMERA_TYPE, header=header(time, FLOOR), **frame))
    flow = {name.removeprefix("flow_"): row.get(name, math.nan) for name in FLOW}
    if not all(map(math.isnan, flow.values())):
        yield sent(FLOW_TOPIC, FLOW_TYPE, time, make(FLOW_TYPE, header=header(time, BODY), **flow))


def _joint_state(row: Mapping[str, float], time: int) -> Any:
    fields = {field: _values(row, [f"{kind}_{joint}" for joint in JOINTS]) for field, kind in _KINDS}
    return make(JOINT_STATE, header=header(time, BODY), name=list(JOINTS), **fields)


def _commands(row: Mapping[str, float], time: int) -> Any:
    """Legs are commanded in position, wheels in velocity; NaN = torque off."""
    legs, wheels = (np.array([row[f"cmd_{joint}"] for joint in joints]) for joints in (LEGS, WHEELS))
    none = np.full(len(LEGS), np.nan)
    position, velocity = np.concatenate([legs, none]), np.concatenate([none, wheels])
    empty = np.zeros(0)
    return make(JOINT_STATE, header=header(time, BODY), name=list(JOINTS), position=position, velocity=velocity, effort=empty)


def _imu(row: Mapping[str, float], time: int) -> Any:
    """A first covariance of -1 means that the message does not hold that quantity."""
    unknown = np.array([-1.0, *[0.0] * 8])
    vectors = {kind: _values(row, [f"{kind}_{axis}" for axis in _XYZ]) for kind in ("gyro", "acc")}
    known = {kind: np.zeros(9) if np.isfinite(values).any() else unknown for kind, values in vectors.items()}
    vector = {
        kind: make("geometry_msgs/msg/Vector3", **dict(zip(_XYZ, map(float, v), strict=True))) for kind, v in vectors.items()
    }
    return make(
        IMU_TYPE,
        header=header(time, BODY),
        orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=unknown,
        angular_velocity=vector["gyro"],
        angular_velocity_covariance=known["gyro"],
        linear_acceleration=vector["acc"],
        linear_acceleration_covariance=known["acc"],
    )


def _values(row: Mapping[str, float], names: Sequence[str]) -> Array:
    return np.array([row.get(name, math.nan) for name in names], np.float64)


# ---- back ------------------------------------------------------------------------------------------------------------

#: Column -> where it travels: topic and field.
PLACES: dict[str, tuple[str, str]] = (
    {f"{kind}_{joint}": (JOINT_STATES, f"{field}[{joint}]") for field, kind in _KINDS for joint in JOINTS}
    | {f"cmd_{joint}": (COMMANDS, f"position[{joint}]") for joint in LEGS}
    | {f"cmd_{joint}": (COMMANDS, f"velocity[{joint}]") for joint in WHEELS}
    | {f"gyro_{axis}": (IMU, f"angular_velocity.{axis}") for axis in _XYZ}
    | {f"acc_{axis}": (IMU, f"linear_acceleration.{axis}") for axis in _XYZ}
    | {name: (CAMERA_TOPIC, name.removeprefix("cam_")) for name in SEEN}
    | {name: (FLOW_TOPIC, name.removeprefix("flow_")) for name in FLOW}
    | {"volt": (SUPPLY, "voltage")}
)


def read_content(text: str, where: str) -> dict[str, Any]:
    """Return what the message on ``/wlr/run`` says.

    Raises:
        InputError: it is broken, or of a later version.
    """
    try:
        content = json.loads(text)
        layout, columns = content["layout"], content["columns"]
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{where}: topic '{RUN}' does not say what the run holds") from None
    if layout != LAYOUT or not set(columns) <= set(COLUMNS):
        raise InputError(f"{where}: topic '{RUN}': layout {layout}: written by another version; this one reads {LAYOUT}")
    return content
