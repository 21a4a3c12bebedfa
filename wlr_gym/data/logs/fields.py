"""Which fields of a log may be which channels, and in which unit they are: what types of messages and names say.

Nothing here looks at a value. What names leave open is asked, see :mod:`wlr_gym.data.logs.suggest`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from wlr_gym.base.errors import InputError
from wlr_gym.data.logs.map import units_of, words
from wlr_gym.data.logs.topics import Log, Topic
from wlr_gym.robot import JOINTS, LEGS, Robot

# Words of joints and quantities.
_FRONT, _REAR = {"front", "fore", "f"}, {"rear", "back", "hind", "aft", "b", "h"}
_LEFT, _RIGHT = {"left", "l"}, {"right"}
#: Two letters that name a corner, in either order.
_CORNERS = {
    "lf": "lf", "fl": "lf", "rf": "rf", "fr": "rf", "lr": "lr", "rl": "lr", "lb": "lr", "bl": "lr", "lh": "lr", "hl": "lr",
    "rr": "rr", "rb": "rr", "br": "rr", "rh": "rr", "hr": "rr",
}  # fmt: skip
_WHEEL = ("wheel", "whl", "tire", "tyre", "drive", "roll")
_LEG = ("leg", "hip", "knee", "thigh", "shoulder", "swing", "arm", "limb", "susp", "lift")
_QUANTITIES = {
    "pos": {"pos", "position", "positions", "angle", "angles", "q", "theta", "encoder", "enc", "ang"},
    "vel": {"vel", "velocity", "velocities", "speed", "speeds", "dq", "qd", "omega", "rate", "w"},
    "eff": {"eff", "effort", "efforts", "torque", "tau", "current", "load", "trq"},
}
_COMMAND = {
    "cmd", "cmds", "command", "commands", "goal", "goals", "target", "targets", "setpoint", "setpoints", "ref", "reference",
    "desired", "des", "action", "trajectory", "request",
}  # fmt: skip
#: Units as names end with them, ``angle_deg``, ``speed [1/min]``, ``rate_deg_s``: in lower case.
_UNITS = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°"), "deg"), "rad": "rad", "counts": "count", "ticks": "count",
    **dict.fromkeys(("deg/s", "dps", "°/s"), "deg/s"), **dict.fromkeys(("rad/s", "rads", "radps"), "rad/s"),
    **dict.fromkeys(("rpm", "1/min", "u/min", "min-1"), "rpm"),
    "nm": "N m", "n m": "N m", "mnm": "mN m", "ncm": "N cm", "a": "A", "amps": "A", "ma": "mA",
    **dict.fromkeys(("m/s2", "m/s^2", "m/s²", "ms2"), "m/s2"), "g": "g", "mg": "mg",
    "m": "m", "cm": "cm", "mm": "mm", "v": "V", "mv": "mV",
}  # fmt: skip
#: Words of a stem whose x, y and z are a vector of the IMU, and one-letter stems of tables: gx, ax, wx.
_VECTORS = {
    "gyro": {"gyro", "gyroscope", "angular", "angvel", "omega", "rates"},
    "acc": {"acc", "accel", "acceleration", "accelerometer", "specific"},
}
_SHORT = {"g": "gyro", "w": "gyro", "a": "acc"}
_VOLTAGE = {"voltage", "volt", "volts", "vbat", "vbatt"}
_HEADING = {"yaw", "heading"}
#: Words that a measured pose's topic and heading do not have; words one of which its x and y have, if any.
_NOT_POSE = {"rate", "vel", "velocity", "speed", "twist", "imu", "gyro", "odom", "odometry"}
_PLACE = {
    "pos", "position", "pose", "place", "translation", "location", "cam", "camera", "mocap", "optitrack", "vicon", "qualisys",
    "tag", "apriltag", "aruco", "marker", "tracker", "body", "rigid", "base", "robot", "chassis", "trunk", "torso",
    "world", "map", "floor", "ground", "truth", "gt", "state",
}  # fmt: skip
#: Packages whose types say what they hold, and those of their types that hold one measured pose.
_STANDARD = {
    "geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "tf2_msgs", "visualization_msgs", "foxglove", "foxglove_msgs",
}  # fmt: skip
_POSES = {
    "Pose", "Pose2D", "PoseStamped", "PoseWithCovariance", "PoseWithCovarianceStamped", "PoseInFrame", "Transform",
    "TransformStamped",
}  # fmt: skip


@dataclass(frozen=True)
class FieldCandidate:
    """A field that may be a channel: which, where, the joint's name in the log, and the unit that its name states."""

    column: str
    topic: str
    field: str
    joint: str | None = None
    unit: str | None = None


@dataclass(frozen=True)
class _NameFacts:
    """What a name says, None where nothing: corner (lf, ...), part (leg, wheel), quantity (pos, ...), whether a setpoint."""

    corner: str | None
    part: str | None
    quantity: str | None
    command: bool


def read_name(name: str) -> _NameFacts:
    """Return what a name of a field, joint or column says."""
    found = words(name)
    quantity = next((kind for word in found for kind, known in _QUANTITIES.items() if word in known), None)
    return _NameFacts(_corner(found), _part(found), quantity, any(word in _COMMAND for word in found))


def _corner(found: list[str]) -> str | None:
    for word in found:
        if word in _CORNERS:
            return _CORNERS[word]
        for part in (*_WHEEL, *_LEG):  # flwheel, wheelfl
            rest = word.replace(part, "", 1)
            if rest != word and rest in _CORNERS:
                return _CORNERS[rest]
    said = set(found)
    end = "f" if said & _FRONT else "r" if said & _REAR else None
    side = "l" if said & _LEFT else "r" if said & _RIGHT else None
    if "r" in said:  # the one of right and rear that is not said otherwise
        side, end = side or "r", end or "r"
    return f"{side}{end}" if side and end else None


def _part(found: list[str]) -> str | None:
    """Return leg or wheel, by the word that comes last: ``leg_wheel_fl`` is a wheel on a leg."""
    part = None
    for word in found:
        if word.startswith(_WHEEL) or word.endswith(_WHEEL) or word == "w":
            part = "wheel"
        elif word.startswith(_LEG) or word.endswith(_LEG):
            part = part or "leg"
    return part


def stated_unit(name: str, column: str) -> str | None:
    """Return the unit that the end of a field's name states, if it is one of the column's: ``angle [°]``, ``speed_deg_s``."""
    parts = re.split(r"[\s_.]+", name.lower().strip())
    bracket = re.search(r"[\[(]([^\])]+)[\])]$", name.lower().strip())
    ends = [bracket.group(1).strip() if bracket else "", "/".join(parts[-2:]), parts[-1], *words(name)[-1:]]
    return next((_UNITS[end] for end in ends if _UNITS.get(end, "") in units_of(column)), None)


def find_candidates(
    log: Log, robot: Robot, namespace: str | None = None, names: Mapping[str, str] | None = None
) -> dict[str, list[FieldCandidate]]:
    """Return column -> fields that may be it, the likeliest first: of the topic with more channels, then more messages.

    Args:
        log: all fields of all topics.
        robot: whose servos' numbers may be names.
        namespace: topics that do not begin with it are left out.
        names: joint -> name in the log, where it is known.

    Raises:
        InputError: the log holds two robots, or two joints of one name, or nothing in the namespace.
    """
    topics = [topic for name, topic in log.topics.items() if namespace is None or _in_namespace(name, namespace)]
    if not topics:
        roots = ", ".join(dict.fromkeys(_root(name) for name in log.topics))
        raise InputError(f"{log.name}: namespace '{namespace}': no topic is in it; topics are in {roots}")
    found: dict[str, list[FieldCandidate]] = {}
    for topic in topics:
        for candidate in _of_topic(topic, robot, names or {}):
            found.setdefault(candidate.column, []).append(candidate)

    def rank(one: FieldCandidate) -> tuple[int, int]:
        channels = sum(any(other.topic == one.topic for other in candidates) for candidates in found.values())
        return -channels, -len(log.topics[one.topic].received)

    for column, candidates in found.items():
        found[column] = sorted(candidates, key=rank)
    _check_one_robot(log, found, namespace)
    return found


def _of_topic(topic: Topic, robot: Robot, names: Mapping[str, str]) -> Iterator[FieldCandidate]:
    for field in topic.fields:
        if not re.search(r"(pose|position|orientation|twist|transform|linear|angular)[\w.]*\.[xyzw]$", field):
            yield from _joint(topic, field, robot, names)
    yield from _vectors(topic)
    yield from _pose(topic)
    for field in topic.fields:
        if _says(field, _VOLTAGE) and _bracket(field) is None and read_name(field).corner is None:
            yield FieldCandidate("volt", topic.name, field, unit=stated_unit(field, "volt"))


# ---- joints ----------------------------------------------------------------------------------------------------------


def _joint(topic: Topic, field: str, robot: Robot, names: Mapping[str, str]) -> Iterator[FieldCandidate]:
    name = _bracket(field)
    facts, of_topic = read_name(name or field), read_name(topic.name)
    given = [joint for joint, known in names.items() if known == name]
    joint = given[0] if len(given) == 1 else _which(facts, of_topic, None if is_unnamed(topic, field) else name, robot)
    if joint is None or names.get(joint, "") not in field:  # the map has another name for this joint
        return
    text = field.replace(f"[{name}]", " ").strip() if name else field
    outside = read_name(text)
    quantity = outside.quantity or facts.quantity or of_topic.quantity
    if outside.command or facts.command or of_topic.command:
        quantity = "cmd" if quantity in (None, "pos" if joint in LEGS else "vel") else None
    if quantity is not None:
        column = f"{quantity}_{joint}"
        yield FieldCandidate(column, topic.name, field, name, stated_unit(text, column) or stated_unit(name or "", column))


def is_unnamed(topic: Topic, field: str) -> bool:
    """Whether a field is an element of a list without names: a number is its place then, and no servo's."""
    return bool(re.search(r"\[\d+\]$", field)) and f"{field[: field.rindex('[')]}[0]" in topic.fields


def _which(facts: _NameFacts, of_topic: _NameFacts, name: str | None, robot: Robot) -> str | None:
    """Return the joint that names say; a number alone, as in ``dxl_8``, is the servo's."""
    corner, part = facts.corner or of_topic.corner, facts.part or of_topic.part
    if corner and part:
        return f"{part}_{corner}"
    numbers = re.findall(r"\d+", name or "")
    others = set(words(name or "")) - {"id", "dxl", "dynamixel", "servo", "motor", *numbers}
    if corner is None and len(numbers) == 1 and not others:
        return next((joint for joint, number in robot.dynamixel_ids.items() if number == int(numbers[0])), None)
    return None


def _bracket(field: str) -> str | None:
    """Return the name or place in a field's last brackets; a unit is none."""
    found = re.findall(r"(?<! )\[([^\]]*[A-Za-z][^\]]*|\d+)\]", field)
    return found[-1] if found and (len(found[-1]) == 1 or found[-1].lower() not in _UNITS) else None


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
            yield FieldCandidate(f"{kind}_{axis}", topic.name, field, unit=stated_unit(field, f"{kind}_{axis}"))


def may_be_pose(field: str) -> bool:
    """Whether a field is an x of a position or translation, whatever is there."""
    return field.endswith(("position.x", "translation.x"))


def _pose(topic: Topic) -> Iterator[FieldCandidate]:
    """Yield what may be the body's pose: no setpoint, no joint's, no element of a list, and not computed from wheels."""
    kind = re.split(r"[/.]", topic.kind)
    if kind[-1] == "Odometry" or (kind[0] in _STANDARD and kind[-1] not in _POSES):
        return
    if _of_other(topic.name) or _says(topic.name, _NOT_POSE):
        return
    for field in topic.fields:
        if may_be_pose(field) and "[" not in field and not _of_other(field):
            stem = field.removesuffix("position.x").removesuffix("translation.x")
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
        heading = min(headings, key=lambda one: words(one)[0] != words(places[0])[0])
        for column, field in (("cam_x", places[0]), ("cam_y", _other(places[0], "y")), ("cam_yaw", heading)):
            yield FieldCandidate(column, topic.name, field, unit=stated_unit(field, column))


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
        candidates = found.get(f"pos_{joint}", [])
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


def _in_namespace(topic: str, namespace: str) -> bool:
    """Whether a topic is in a namespace: ``/robot_10/imu`` is not in ``/robot_1``."""
    return f"/{topic.strip('/')}/".startswith(f"/{namespace.strip('/')}/")


def _root(topic: str) -> str:
    return "/" + topic.strip("/").split("/")[0]


def _tail(topic: str) -> str:
    return "/".join(topic.strip("/").split("/")[1:])
