"""Which fields of a log may be which channels: by the types of messages and by names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.names import NameFacts, read_name, words
from wlr_gym.data.logs.topics import Log, Topic
from wlr_gym.robot import JOINTS, LEGS, Robot


@dataclass(frozen=True)
class FieldCandidate:
    """A field that may be a channel: which, where, the joint's name in the log, and the unit that its name says."""

    column: str
    topic: str
    field: str
    joint: str | None = None
    unit: str | None = None


#: Words of a stem whose x, y and z are a vector of the IMU.
_VECTORS = {
    "gyro": {"gyro", "gyroscope", "angular", "angvel", "omega", "rates"},
    "acc": {"acc", "accel", "acceleration", "accelerometer", "specific"},
}
#: One-letter stems of tables: gx, ax, wx.
_SHORT = {"g": "gyro", "w": "gyro", "a": "acc"}
_VOLTAGE = {"voltage", "volt", "volts", "vbat", "vbatt"}
_HEADING = {"yaw", "heading"}
#: Words that a pose's topic and heading do not have, and words one of which its x and y have, if any.
_NOT_POSE = {"rate", "vel", "velocity", "speed", "twist", "imu", "gyro"}
_PLACE = {
    "pos", "position", "pose", "place", "translation", "location", "cam", "camera", "mocap", "optitrack", "vicon", "qualisys",
    "tag", "apriltag", "aruco", "marker", "tracker", "body", "rigid", "base", "robot", "chassis", "trunk", "torso", "odom",
    "odometry", "world", "map", "floor", "ground", "truth", "gt", "state",
}  # fmt: skip
#: Packages whose types say what they hold, and those of their types that hold one pose.
_STANDARD = {
    "geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "tf2_msgs", "visualization_msgs", "foxglove", "foxglove_msgs",
}  # fmt: skip
_POSES = {
    "Pose", "Pose2D", "PoseStamped", "PoseWithCovariance", "PoseWithCovarianceStamped", "PoseInFrame", "Odometry", "Transform",
    "TransformStamped",
}  # fmt: skip
#: Words of topics with poses that are computed from wheels and not measured.
_ODOMETRY = {"odom", "odometry"}


def find_candidates(
    log: Log, robot: Robot, namespace: str | None = None, names: Mapping[str, str] | None = None
) -> dict[str, list[FieldCandidate]]:
    """Return column -> fields that may be it, the likeliest first.

    Args:
        log: all fields of all topics.
        robot: whose servos' numbers may be names.
        namespace: topics that do not begin with it are left out.
        names: name in the log -> joint, where it is known.

    Raises:
        InputError: the log holds two robots, or two joints of one name, or nothing in the namespace.
    """
    topics = [topic for name, topic in log.topics.items() if namespace is None or in_namespace(name, namespace)]
    if not topics:
        roots = ", ".join(dict.fromkeys(_root(name) for name in log.topics))
        raise InputError(f"{log.name}: namespace '{namespace}': no topic is in it; topics are in {roots}")
    found: dict[str, list[FieldCandidate]] = {}
    for topic in topics:
        for candidate in _of_topic(topic, robot, names or {}):
            found.setdefault(candidate.column, []).append(candidate)
    for candidates in found.values():
        candidates.sort(key=lambda one: _rank(log.topics[one.topic], found))
    _check_one_robot(log, found, namespace)
    return found


def _rank(topic: Topic, found: Mapping[str, list[FieldCandidate]]) -> tuple[bool, int, int]:
    """A pose that is measured before odometry, then the topic with more channels, then the one with more messages."""
    channels = sum(any(one.topic == topic.name for one in candidates) for candidates in found.values())
    return (_says(topic.name, _ODOMETRY) or "Odometry" in topic.kind, -channels, -len(topic.received))


def _of_topic(topic: Topic, robot: Robot, names: Mapping[str, str]) -> Iterator[FieldCandidate]:
    for field in topic.fields:
        if not _belongs_to_pose(field):
            yield from _joint(topic, field, robot, names)
    yield from _vectors(topic)
    yield from _pose(topic)
    for field in topic.fields:
        if _says(field, _VOLTAGE) and "[" not in field and read_name(field).corner is None:
            yield FieldCandidate("volt", topic.name, field, unit=read_name(field).unit)


# ---- joints ----------------------------------------------------------------------------------------------------------


def _joint(topic: Topic, field: str, robot: Robot, names: Mapping[str, str]) -> Iterator[FieldCandidate]:
    name = _bracket(field)
    facts, of_topic = read_name(name or field), read_name(topic.name)
    joint = names.get(name or "") or _which(facts, of_topic, None if is_unnamed(topic, field) else name, robot)
    known = joint is not None and joint in names.values() and name not in names
    if joint is None or known:  # the map names another one for this joint
        return
    outside = read_name(field.replace(f"[{name}]", " ") if name else field)
    quantity = outside.quantity or facts.quantity or of_topic.quantity
    command = outside.command or facts.command or of_topic.command
    wanted = "pos" if joint in LEGS else "vel"
    if command:
        if quantity in (None, wanted):
            yield FieldCandidate(f"cmd_{joint}", topic.name, field, name, outside.unit or facts.unit)
    elif quantity is not None:
        yield FieldCandidate(f"{quantity}_{joint}", topic.name, field, name, outside.unit or facts.unit)


def is_unnamed(topic: Topic, field: str) -> bool:
    """Whether a field is an element of a list without names: a number is its place then, and no servo's."""
    return bool(re.search(r"\[\d+\]$", field)) and f"{field[: field.rindex('[')]}[0]" in topic.fields


def _which(facts: NameFacts, of_topic: NameFacts, name: str | None, robot: Robot) -> str | None:
    """Return the joint that names say; a number alone is the servo's."""
    corner, part = facts.corner or of_topic.corner, facts.part or of_topic.part
    if corner and part:
        return f"{part}_{corner}"
    numbers = re.findall(r"\d+", name or "")
    servos = {number: joint for joint, number in robot.dynamixel_ids.items()}
    if corner is None and len(numbers) == 1 and _by_number(name or "") and int(numbers[0]) in servos:
        return servos[int(numbers[0])]
    return None


def _by_number(name: str) -> bool:
    return set(words(name)) - {"id", "dxl", "dynamixel", "servo", "motor"} == set(re.findall(r"\d+", name))


def _bracket(field: str) -> str | None:
    found = re.search(r"\[([^\]]*[A-Za-z][^\]]*|\d+)\]", field)
    return found.group(1) if found else None


def _belongs_to_pose(field: str) -> bool:
    return bool(re.search(r"(pose|position|orientation|twist|transform|linear|angular)[\w.]*\.[xyzw]$", field))


# ---- IMU and pose ----------------------------------------------------------------------------------------------------


def _vectors(topic: Topic) -> Iterator[FieldCandidate]:
    if read_name(topic.name).command or (_says(topic.name, {"vel"}) and "Twist" in topic.kind):
        return
    for field in topic.fields:
        if "twist" in field and topic.kind.endswith("Odometry"):
            continue  # computed, not measured
        stem, axis = _axis_of(field)
        kind = next((kind for kind, known in _VECTORS.items() if _says(stem, known)), None) or _SHORT.get(stem)
        if kind is not None and axis is not None and _has(topic, field, "xyz"):
            yield FieldCandidate(f"{kind}_{axis}", topic.name, field, unit=read_name(field.replace("rad", "")).unit)


def may_be_pose(field: str) -> bool:
    """Whether a field is an x of a position or translation, whatever is there."""
    return field.endswith(("position.x", "translation.x"))


def _pose(topic: Topic) -> Iterator[FieldCandidate]:
    """Yield what may be the body's pose: no setpoint, no joint's, and no element of a list."""
    kind = re.split(r"[/.]", topic.kind)
    if kind[0] in _STANDARD and kind[-1] not in _POSES:
        return
    if _of_other(topic.name) or _says(topic.name, _NOT_POSE):
        return
    for field in topic.fields:
        if may_be_pose(field) and "[" not in field and not _of_other(field):
            stem = field[: -len("position.x")] if field.endswith("position.x") else field[: -len("translation.x")]
            turn = f"{stem}orientation" if f"{stem}orientation.w" in topic.fields else f"{stem}rotation"
            if f"{turn}.w" in topic.fields:
                yield from (FieldCandidate(f"cam_{axis}", topic.name, f"{field[:-1]}{axis}") for axis in "xyz")
                yield FieldCandidate("cam_yaw", topic.name, f"{turn}.yaw")
                return
    turns = [field[:-1] for field in topic.fields if field.endswith("w") and _has(topic, f"{field[:-1]}x", "xyz")]
    named = [field for field in topic.fields if _says(field, _HEADING) or re.fullmatch(r"(.*\.)?theta", field)]
    headings = [
        field
        for field in [*named, *(f"{turn.rstrip('._')}.yaw" for turn in turns)]
        if not _says(field, _NOT_POSE) and not _of_other(field)
    ]
    places = [
        field
        for field in topic.fields
        if _is_place(field) and _has(topic, field, "xy") and field[:-1] not in turns and not _of_other(field)
    ]
    if headings and places:
        x = places[0]
        headings.sort(key=lambda one: words(one)[0] != words(x)[0])
        yield FieldCandidate("cam_x", topic.name, x, unit=read_name(x).unit)
        yield FieldCandidate("cam_y", topic.name, _other(x, "y"), unit=read_name(x).unit)
        yield FieldCandidate("cam_yaw", topic.name, headings[0], unit=read_name(headings[0]).unit)


def _of_other(name: str) -> bool:
    """Whether a name is that of a setpoint, or of something at a corner of the robot."""
    facts = read_name(name)
    return facts.command or facts.corner is not None


def _is_place(field: str) -> bool:
    """Whether a name is ``x`` or, as ``pose.x`` or ``cam_x``, the x of a place."""
    stem, axis = _axis_of(_bracket(field) or field)
    return axis == "x" and (not stem or _says(stem, _PLACE)) and not _says(stem, _NOT_POSE)


def _axis_of(field: str) -> tuple[str, str | None]:
    """Return the name without its axis, and the axis: of ``gyro_x``, ``imu.acc.y``, ``gz``, ``x``, ``acc_x_mg``."""
    found = _split(field)
    return (found.group(1).rstrip("._[ ").lower(), found.group(2).lower()) if found else (field.lower(), None)


def _other(field: str, axis: str) -> str:
    """Return a field's name with another axis."""
    found = _split(field)
    if not found:
        return field
    letter = axis.upper() if found.group(2).isupper() else axis
    return f"{found.group(1)}{letter}{found.group(3)}"


def _split(field: str) -> re.Match[str] | None:
    """Split a name before and behind its axis; a letter that stands apart, as in ``velocity_x``, before one that does not."""
    end = r"([xyzXYZ])((?:\]|[_ \[(].*)?)"
    return re.fullmatch(rf"(.*[._\[ ]|){end}", field) or re.fullmatch(rf"(.*?){end}", field)


def _has(topic: Topic, field: str, axes: Iterable[str]) -> bool:
    return all(_other(field, axis) in topic.fields for axis in axes)


def _says(name: str, known: set[str]) -> bool:
    return any(word in known for word in words(name))


# ---- one robot only --------------------------------------------------------------------------------------------------


def _check_one_robot(log: Log, found: Mapping[str, list[FieldCandidate]], namespace: str | None) -> None:
    for joint in JOINTS:
        column = f"pos_{joint}"
        candidates = found.get(column, [])
        for first in candidates[:1]:
            same = [one for one in candidates if one.topic == first.topic and one.field != first.field]
            if same:
                raise InputError(
                    f"{log.name}: topic '{first.topic}': fields '{first.field}' and '{same[0].field}' are both the {joint}: "
                    f"two robots in one topic, or two joints per leg? name the right one in the map: joints: {{{joint}: NAME}}"
                )
        twins = sorted({_root(one.topic) for one in candidates if _tail(one.topic) == _tail(candidates[0].topic)})
        if len(twins) > 1 and namespace is None:
            raise InputError(
                f"{log.name}: two robots: topics {', '.join(sorted({one.topic for one in candidates}))} each have the {joint}; "
                f"say which in the map: namespace: {twins[0]}  (or {', '.join(twins[1:])})"
            )


def in_namespace(topic: str, namespace: str) -> bool:
    """Whether a topic is in a namespace: ``/robot_10/imu`` is not in ``/robot_1``."""
    return f"/{topic.strip('/')}/".startswith(f"/{namespace.strip('/')}/")


def _root(topic: str) -> str:
    return "/" + topic.strip("/").split("/")[0]


def _tail(topic: str) -> str:
    return "/".join(topic.strip("/").split("/")[1:])
