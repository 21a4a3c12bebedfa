"""A run as messages of ROS 2: written to MCAP files and rosbag2, whole or while it goes on, and read back to the bit.

Every channel travels as float64 in a message of a type that Foxglove, PlotJuggler and ROS know, or, where those hold float32
or an attitude only, in one of two types of our own, whose definition is in the file as all others are. ``/wlr/run`` says which
columns the run has, and what stands beside it: ``meta.yaml`` and the record of the simulation.
"""

from __future__ import annotations

import json
import math
import queue
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import replace_file
from wlr_gym.base.settings import parse_config
from wlr_gym.base.text import row_words
from wlr_gym.data.format import CAMERA, COLUMNS, COMMANDS, FLOW, RunMeta
from wlr_gym.data.logs.readers import quiet, read_logs
from wlr_gym.data.logs.topics import LOG, Share
from wlr_gym.data.run_states import euler_angles, has_camera, measured_state, quaternion, slip_of
from wlr_gym.data.runs import Run, Simulation, floor_of, is_shipped, own_robot, robot_of
from wlr_gym.physics.floor import lay_floor
from wlr_gym.physics.plants.base import settle, standing_state
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import (
    CORNER_NAMES,
    CORNER_SIGNS,
    CORNERS,
    JOINTS,
    LEG_SLICE,
    LEGS,
    WHEEL_SLICE,
    WHEELS,
    Robot,
    load_robot,
    robot_content,
)
from wlr_gym.robot.interchange.urdf import urdf_text
from wlr_gym.robot.parameter_table import XYZ
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

RUN, JOINT_STATES, JOINT_COMMANDS, IMU, SUPPLY, CAMERA_TOPIC, FLOW_TOPIC = (
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
_KINDS = (("position", "pos"), ("velocity", "vel"), ("effort", "eff"))
#: What fields that are no numbers hold where nothing is said of them.
_NOTHING = {"string": "", "bool": False}


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
    """Return a message of a type; mappings become the messages in it, and what is not given is zero or empty."""
    store = typestore()
    return store.types[kind](**{name: _field(of, fields.get(name)) for name, (_, of) in store.fielddefs[kind][1]})


def _field(of: Any, given: Any) -> Any:
    """Return a field's value; it is of a type (its name), of a plain kind (name, length), or a list (what of, count)."""
    if isinstance(of, str):
        return make(of, **(given or {})) if given is None or isinstance(given, Mapping) else given
    what, count = of
    if isinstance(what, str):
        return _NOTHING.get(what, 0.0 if what.startswith("float") else 0) if given is None else given
    _, element = what
    if isinstance(element, str):
        return [_field(element, one) for one in given or ()]
    if given is None:
        return [] if element[0] == "string" else np.zeros(count, element[0])
    return given


def sent(topic: str, kind: str, time: int, **fields: Any) -> Sent:
    """Return a message as it is written; fields as of :func:`make`."""
    return Sent(topic, kind, time, bytes(typestore().serialize_cdr(make(kind, **fields), kind)))


def header(time: int, frame: str) -> dict[str, Any]:
    """Return the header of a message at ``time`` (ns)."""
    return {"stamp": {"sec": time // 1_000_000_000, "nanosec": time % 1_000_000_000}, "frame_id": frame}


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
    return sent(RUN, STRING, time, data=json.dumps(content))


def row_messages(row: Mapping[str, float], time: int) -> Iterator[Sent]:
    """Yield the messages of one row; channels that it does not have are NaN or not sent."""
    of_body, of_floor = header(time, BODY), header(time, FLOOR)
    states = {field: _values(row, [f"{kind}_{joint}" for joint in JOINTS]) for field, kind in _KINDS}
    yield sent(JOINT_STATES, JOINT_STATE, time, header=of_body, name=list(JOINTS), **states)
    # Legs are commanded in position, wheels in velocity; NaN = torque off.
    commands, none = np.array([row[f"cmd_{joint}"] for joint in JOINTS]), np.full(len(LEGS), np.nan)
    setpoints = {
        "position": np.concatenate([commands[LEG_SLICE], none]),
        "velocity": np.concatenate([none, commands[WHEEL_SLICE]]),
    }
    yield sent(JOINT_COMMANDS, JOINT_STATE, time, header=of_body, name=list(JOINTS), **setpoints)
    if any(f"{kind}_{axis}" in row for kind in ("gyro", "acc") for axis in XYZ):
        yield sent(IMU, IMU_TYPE, time, header=of_body, **_imu(row))
    if "volt" in row:
        yield sent(SUPPLY, SUPPLY_TYPE, time, header=of_body, voltage=row["volt"])
    frame = {name.removeprefix("cam_"): row.get(name, math.nan) for name in SEEN}
    if not all(map(math.isnan, frame.values())):
        yield sent(CAMERA_TOPIC, CAMERA_TYPE, time, header=of_floor, **frame)
    flow = {name.removeprefix("flow_"): row.get(name, math.nan) for name in FLOW}
    if not all(map(math.isnan, flow.values())):
        yield sent(FLOW_TOPIC, FLOW_TYPE, time, header=of_body, **flow)


def _imu(row: Mapping[str, float]) -> dict[str, Any]:
    """A first covariance of -1 means that the message does not hold that quantity."""
    unknown = np.array([-1.0, *[0.0] * 8])
    fields = {"orientation": {"w": 1.0}, "orientation_covariance": unknown}
    for name, kind in (("angular_velocity", "gyro"), ("linear_acceleration", "acc")):
        values = _values(row, [f"{kind}_{axis}" for axis in XYZ])
        fields[name] = _vector(values)
        fields[f"{name}_covariance"] = np.zeros(9) if np.isfinite(values).any() else unknown
    return fields


def _vector(values: Iterable[float]) -> dict[str, float]:
    return dict(zip(XYZ, map(float, values), strict=True))


def _values(row: Mapping[str, float], names: Sequence[str]) -> Array:
    return np.array([row.get(name, math.nan) for name in names], np.float64)


# ---- what is shown beside the channels, and not read back ------------------------------------------------------------


POSE, TRANSFORMS, SLIP, DESCRIPTION = "/pose", "/tf", "/slip", "/robot_description"
#: Link of the URDF that is the body.
BASE = "base_link"
POSE_TYPE, TRANSFORM_TYPE, MARKER_TYPE = (
    "geometry_msgs/msg/PoseStamped",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/MarkerArray",
)
#: Markers and transforms per second.
RATE = 12.5
#: m of arrow per m/s of slip, and its shaft, m.
_LENGTH, _SHAFT = 1.0, 0.012


def display_messages(run: Run, times: list[int]) -> dict[int, list[Sent]]:
    """Return what is shown by the row's time (ns).

    ``/robot_description`` is the robot as URDF, and ``/tf`` has where its links are, by the joints' angles. With a camera's
    pose, ``/pose`` is what it saw, frame by frame; and where the body is (``/tf``), and the slip velocity of each wheel's
    contact point over the floor (``/slip``), come from the smoothed motion of camera, encoders and gyroscope. All but ``/pose``
    are sent :data:`RATE` times a second.
    """
    shown: dict[int, list[Sent]] = {}
    if has_camera(run):
        for row in np.flatnonzero(np.isfinite(run["cam_x"]) & np.isfinite(run["cam_yaw"])):
            shown.setdefault(times[row], []).append(_camera_pose(run, int(row), times[row]))
    if not all(np.isfinite(run[f"pos_{joint}"]).all() for joint in JOINTS):
        return shown  # no run that a reader takes: its channels go out all the same
    step = max(round(1.0 / RATE / float(np.median(np.diff(run["t"])))), 1)
    rows = np.arange(0, len(times), step)
    robot = robot_of(run)
    shown.setdefault(times[0], []).append(sent(DESCRIPTION, STRING, times[0], data=urdf_text(robot)))
    motion = _motion(run, robot, rows, [times[row] for row in rows]) if has_camera(run) else [[] for _ in rows]
    angles = np.stack([run[f"pos_{joint}"][rows] for joint in JOINTS], axis=1)
    for row, moved, links in zip(rows, motion, _links(robot, angles, [times[row] for row in rows]), strict=True):
        shown.setdefault(times[row], []).extend([links, *moved])
    return shown


def _links(robot: Robot, angles: Array, times: list[int]) -> Iterator[Sent]:
    """Yield where the links of the URDF are: body, then each leg at its hip and its wheel at the leg's end, turned about y."""
    numbers = Parameters.nominal(robot)
    hips = numbers["hip.position"][0] * np.array([(*sign, 1.0) for sign in CORNER_SIGNS])
    length = numbers["leg.length"][0]
    level = np.array([1.0, 0.0, 0.0, 0.0])
    turns = np.stack([np.cos(angles / 2), 0 * angles, np.sin(angles / 2), 0 * angles], axis=-1)
    for time, turn in zip(times, turns, strict=True):
        links = [_transform(time, BODY, BASE, np.zeros(3), level)]
        for corner, (leg, wheel) in enumerate(zip(LEGS, WHEELS, strict=True)):
            links.append(_transform(time, BASE, f"{leg}_link", hips[corner], turn[corner]))
            end = np.array([length[corner], 0.0, 0.0])
            links.append(_transform(time, f"{leg}_link", f"{wheel}_link", end, turn[len(LEGS) + corner]))
        yield _transforms(time, links)


def _camera_pose(run: Run, row: int, time: int) -> Sent:
    z, pitch = (float(run[name][row]) if name in run else 0.0 for name in ("cam_z", "cam_pitch"))
    turn = quaternion(run["cam_yaw"][[row]], np.nan_to_num([pitch]), np.zeros(1))[0]
    place = (run["cam_x"][row], run["cam_y"][row], np.nan_to_num(z))
    pose = {"position": _vector(place), "orientation": _quaternion(turn)}
    return sent(POSE, POSE_TYPE, time, header=header(time, FLOOR), pose=pose)


def _motion(run: Run, robot: Robot, rows: NDArray[np.intp], times: list[int]) -> list[list[Sent]]:
    on_floor = lay_floor(floor_of(run), Parameters.nominal(robot))
    many = Parameters(np.repeat(on_floor.values, len(rows), axis=0))
    state = measured_state(run, run["t"][rows], standing_state(robot, many), many)
    settle(robot, many, state)
    slip = slip_of(robot, many, state)
    yaw, _, _ = euler_angles(state.quaternion)
    legs, level = state.joint_position[:, LEG_SLICE], rotation(yaw, np.zeros_like(yaw), np.zeros_like(yaw))
    along = np.stack([np.cos(legs), np.zeros_like(legs), -np.sin(legs)], axis=-1) * many["leg.length"][:, :, None]
    hips = many["hip.position"][:, None, :] * np.array([(*sign, 1.0) for sign in CORNER_SIGNS])
    feet = state.position[:, None, :2] + np.einsum("nij,nwj->nwi", level, hips + along)[..., :2]  # where they touch the floor
    headings = np.stack([np.stack([np.cos(yaw), np.sin(yaw)], -1), np.stack([-np.sin(yaw), np.cos(yaw)], -1)], axis=1)
    over_floor = np.einsum("nwk,nkj->nwj", slip, headings)
    return [
        [_transforms(time, [_transform(time, FLOOR, BODY, position, turn)]), _markers(time, foot, arrow)]
        for time, position, turn, foot, arrow in zip(times, state.position, state.quaternion, feet, over_floor, strict=True)
    ]


def _quaternion(turn: Array) -> dict[str, float]:
    return dict(zip("wxyz", map(float, turn), strict=True))


def _transform(time: int, frame: str, child: str, position: Array, turn: Array) -> dict[str, Any]:
    moved = {"translation": _vector(position), "rotation": _quaternion(turn)}
    return {"header": header(time, frame), "child_frame_id": child, "transform": moved}


def _transforms(time: int, transforms: list[dict[str, Any]]) -> Sent:
    return sent(TRANSFORMS, TRANSFORM_TYPE, time, transforms=transforms)


def _markers(time: int, feet: Array, velocities: Array) -> Sent:
    """Return an arrow of each wheel's slip, from where it touches the floor."""
    markers = []
    for corner, (foot, velocity) in enumerate(zip(feet, velocities, strict=True)):
        markers.append({
            "header": header(time, FLOOR), "ns": f"slip of {CORNER_NAMES[CORNERS[corner]]} wheel", "id": corner,
            "pose": {"orientation": {"w": 1.0}}, "scale": {"x": _SHAFT, "y": 2 * _SHAFT},
            "color": {"r": 0.9, "g": 0.1, "b": 0.1, "a": 1.0}, "texture": {"header": header(time, FLOOR)},
            "points": [_vector((*place, 0.005)) for place in (foot, foot + _LENGTH * velocity)],
        })  # fmt: skip
    return sent(SLIP, MARKER_TYPE, time, markers=markers)


# ---- a run as a file -------------------------------------------------------------------------------------------------


#: Formats by name, and the suffix of what is written.
FORMATS = {"mcap": ".mcap", "rosbag2": ".bag2"}


class McapSink:
    """Writes messages of ROS 2 into an MCAP file.

    Args:
        file: open for writing, binary.

    Attributes:
        writer: of the package ``mcap``: ``flush`` it, and what has come so far can be read; ``finish`` it at the end.
    """

    def __init__(self, file: IO[bytes]) -> None:
        require_package("mcap", "logs")
        require_package("rosbags", "logs")
        from mcap.writer import Writer

        self.writer = Writer(file)
        self.writer.start(profile="ros2", library="wlr_gym")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(self, message: Sent) -> None:
        """Write a message; a topic's first one writes its definition, too."""
        topic, kind, time, data = message
        if kind not in self._schemas:
            self._schemas[kind] = self.writer.register_schema(kind, "ros2msg", definition(kind).encode())
        if topic not in self._channels:
            qos = {"offered_qos_profiles": ""}
            self._channels[topic] = self.writer.register_channel(topic, "cdr", self._schemas[kind], qos)
        self.writer.add_message(self._channels[topic], time, data, time)


def export_run(run: Run, path: Path, form: str = "mcap") -> Path:
    """Write a run, with poses and markers of slip where it has a camera's pose; return ``path``.

    Args:
        run: a run.
        path: the file, or for ``rosbag2`` the folder, of the bag.
        form: one of :data:`FORMATS`.

    Raises:
        InputError: another format, a bag that is there already, rows less than 1 ns apart, or no room for it.
    """
    if form not in FORMATS:
        raise InputError(f"format '{form}': expected {' or '.join(FORMATS)}")
    if form == "rosbag2":
        _write_rosbag(path, run)
        return path

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            sink = McapSink(file)
            for message in messages_of(run):
                sink.add(message)
            sink.writer.finish()

    replace_file(path, write)
    return path


def messages_of(run: Run) -> Iterator[Sent]:
    """Yield a run's messages in the order of time; rows less than 1 ns apart are refused."""
    offset = clock_offset(float(run["t"][0]))
    times = [nanoseconds(t, offset) for t in run["t"].tolist()]
    close = np.flatnonzero(np.diff(np.array(times, np.int64)) <= 0)
    if len(close):
        raise InputError(f"{run.path}: {row_words(run.path, close[0] + 1)}, column 't': less than 1 ns after the row before")
    columns = [str(name) for name in run.table.columns]
    robot = own_robot(run.meta, run.path.parent)
    yield run_message(columns, times[0], offset, run.meta, run.simulation, run.name, robot)
    shown = display_messages(run, times)
    names = [name for name in columns if name != "t"]
    values = np.stack([run[name] for name in names], axis=1).tolist()
    for at, row in zip(times, values, strict=True):
        yield from row_messages(dict(zip(names, row, strict=True)), at)
        yield from shown.get(at, ())


def _write_rosbag(path: Path, run: Run) -> None:
    """A folder cannot be replaced in one step: the bag is made beside its place and moved there when complete."""
    if path.exists():
        raise InputError(f"{path}: is there already; a bag is written to a new folder")
    require_package("rosbags", "logs")
    from rosbags.rosbag2 import Writer

    connections: dict[str, Any] = {}
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-") as made:
            bag = Path(made) / path.name
            with Writer(bag, version=8) as writer:
                for message in messages_of(run):
                    if message.topic not in connections:
                        connections[message.topic] = writer.add_connection(message.topic, message.kind, typestore=typestore())
                    writer.write(connections[message.topic], message.time, message.data)
            shutil.move(bag, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


# ---- while a run goes on, without holding up what makes it -----------------------------------------------------------


#: Rows that may wait to be written: 20 s at 50 Hz. Beyond, rows are left out: whoever makes them never waits.
WAITING = 1000
#: s between two flushes: of a process that is killed, all before the last one can be read.
FLUSH = 0.5
#: s after which the writing thread gives way to the one that drives the robot; Python's own choice is 5 ms.
SWITCH = 0.0005
#: s that the rest may take to be written at the end.
_LAST = 10.0


class McapStream:
    """Writes rows into an MCAP file, in a thread of its own. Use as a context manager.

    Args:
        path: a new file.
        columns: names of the channels of each row, without ``t``.
        meta: of the run.
        robot: whose run it is.

    Attributes:
        left_out: rows that came while too many waited.
        trouble: why nothing is written any more; empty = all is well.

    Raises:
        InputError: the file is there, or cannot be made.
    """

    def __init__(self, path: Path, columns: Sequence[str], meta: RunMeta, robot: Robot | None = None) -> None:
        self.path, self.columns, self.meta = path, tuple(columns), meta
        self._robot = None if robot is None or is_shipped(robot) else robot
        self.left_out = 0
        self.trouble = ""
        self._offset: int | None = None
        self._rows: queue.Queue[tuple[float, list[float]]] = queue.Queue(WAITING)
        self._over = threading.Event()
        self._flushed = monotonic()
        require_package("rosbags", "logs")
        run = run_message(columns, 0, 0, meta)  # what first messages compile and look up is done now, not while it drives
        for message in (run, *row_messages(dict.fromkeys((*COMMANDS, *columns), 0.0), 0)):
            definition(message.kind)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except FileExistsError:
            raise InputError(f"{path}: is there already; a stream goes into a new file") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        self._sink = McapSink(self._file)
        self._thread = threading.Thread(target=self._work, name="mcap", daemon=True)

    def __enter__(self) -> McapStream:
        self._thread.start()
        self._switch = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        sys.setswitchinterval(self._switch)
        self._over.set()  # no word in the queue: it may be full, and nobody left to empty it
        self._thread.join(_LAST)
        if self._thread.is_alive():
            self.trouble = f"{self.path}: not all is written after {_LAST:g} s"

    def add(self, t: float, values: Sequence[float]) -> None:
        """Hand over a row: time (s), and a value per channel. Never waits."""
        try:
            self._rows.put_nowait((t, list(values)))
        except queue.Full:
            self.left_out += 1

    def _work(self) -> None:
        try:
            while True:
                over = self._over.is_set()  # asked first: what came before is in the queue
                try:
                    self._write(*self._rows.get(timeout=0.05))
                except queue.Empty:
                    if over:
                        break
            self._sink.writer.finish()
        except Exception as error:  # whatever it is, it stops no robot
            self.trouble = f"{self.path}: {error or type(error).__name__}"
        finally:
            self._file.close()
            if self._offset is None:  # no row came: there is no run
                self.path.unlink(missing_ok=True)

    def _write(self, t: float, values: Sequence[float]) -> None:
        if self._offset is None:
            self._offset = offset = clock_offset(t)
            columns, begin = ["t", *self.columns], nanoseconds(t, offset)
            self._sink.add(run_message(columns, begin, offset, self.meta, name=self.path.stem, robot=self._robot))
        for message in row_messages(dict(zip(self.columns, values, strict=True)), nanoseconds(t, self._offset)):
            self._sink.add(message)
        if monotonic() - self._flushed > FLUSH:
            self._sink.writer.flush()
            self._flushed = monotonic()


# ---- reading back: channels to the bit, times to 1 ns ----------------------------------------------------------------


#: Column -> where it travels: topic and field.
PLACES: dict[str, tuple[str, str]] = (
    {f"{kind}_{joint}": (JOINT_STATES, f"{field}[{joint}]") for field, kind in _KINDS for joint in JOINTS}
    | {f"cmd_{joint}": (JOINT_COMMANDS, f"position[{joint}]") for joint in LEGS}
    | {f"cmd_{joint}": (JOINT_COMMANDS, f"velocity[{joint}]") for joint in WHEELS}
    | {f"gyro_{axis}": (IMU, f"angular_velocity.{axis}") for axis in XYZ}
    | {f"acc_{axis}": (IMU, f"linear_acceleration.{axis}") for axis in XYZ}
    | {name: (CAMERA_TOPIC, name.removeprefix("cam_")) for name in SEEN}
    | {name: (FLOW_TOPIC, name.removeprefix("flow_")) for name in FLOW}
    | {"volt": (SUPPLY, "voltage")}
)


@dataclass(frozen=True, eq=False)
class ExportedRun:
    """A run as it was exported.

    Attributes:
        table: columns by name, (rows,).
        meta, simulation: what stood beside it.
        robot: whose run it is, where it travelled by content.
        notes: what is odd about the file.
    """

    table: dict[str, Array]
    meta: RunMeta
    simulation: Simulation | None
    robot: Robot | None
    notes: tuple[str, ...]


def read_exported(path: str | Path, tell: Share = quiet) -> ExportedRun:
    """Read a run back from an MCAP file or a rosbag2 of :func:`wlr_gym.data.logs.messages.export_run`.

    Raises:
        InputError: no such file, or another program's.
    """
    fields: dict[str, set[str]] = {RUN: set()}
    for topic, field in PLACES.values():
        fields.setdefault(topic, set()).add(field)
    (log,) = read_logs(path, fields, tell=tell)
    if RUN not in log.topics or not log.topics[RUN].text:
        raise InputError(f"{path}: no message on '{RUN}': another program's log; import it with a map")
    try:
        content = json.loads(log.topics[RUN].text)
        layout, columns = content["layout"], content["columns"]
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{log.name}: topic '{RUN}' does not say what the run holds") from None
    if layout != LAYOUT or not set(columns) <= set(COLUMNS):
        raise InputError(f"{log.name}: topic '{RUN}': layout {layout}: written by another version; this one reads {LAYOUT}")
    if JOINT_STATES not in log.topics:
        raise InputError(f"{log.name}: no message on '{JOINT_STATES}': the run has no row")
    times = log.topics[JOINT_STATES].clock(LOG)
    table = {"t": np.array([seconds(int(time), content["clock_offset"]) for time in times])}
    for column in (name for name in columns if name != "t"):
        topic, field = PLACES[column]
        table[column] = np.full(len(times), np.nan)
        if topic in log.topics and field in log.topics[topic].fields:
            at, found = log.topics[topic].series(field, LOG, log.name)
            rows = np.minimum(np.searchsorted(times, at), len(times) - 1)
            mine = times[rows] == at  # of a file that was cut off, a row may lack some of its messages
            table[column][rows[mine]] = found[mine]
    meta = parse_config(RunMeta, content["meta"], f"{log.name}, topic '{RUN}', meta")
    record = content["simulation"]
    simulation = parse_config(Simulation, record, f"{log.name}, topic '{RUN}', simulation") if record else None
    robot = load_robot(content["robot"]) if content.get("robot") else None
    return ExportedRun(table, meta, simulation, robot, log.notes)
