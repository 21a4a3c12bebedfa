"""Propose a map for a log: what names and types decide, and for all else a question with what the log shows of it.

Fields are found by name, and a unit is decided where the name states it. Other units, which way a joint counts, how a sensor is
mounted, what another clock says: no log shows that for certain, so the map asks it (``open``), and no run is made before it is
answered. Columns with the names of our own channels are those channels.
"""

from __future__ import annotations

import itertools
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import overlay
from wlr_gym.data.format import CAMERA, COLUMNS
from wlr_gym.data.logs.map import (
    GROUPS,
    NO_PROFILE,
    OPEN,
    LogMap,
    TopicClock,
    decided,
    effort_range,
    map_text,
    open_places,
    parse_map,
    units_of,
    words,
)
from wlr_gym.data.logs.readers import TABLE
from wlr_gym.data.logs.rows import pose_angle
from wlr_gym.data.logs.topics import Log, Topic
from wlr_gym.robot import JOINTS, LEGS, Robot
from wlr_gym.robot.parameter_table import XYZ

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
#: Ends of the field that is the x of a pose.
_PLACES = ("position.x", "translation.x")
#: Words of topics and fields whose pose is computed from wheels or an IMU.
_COMPUTED = {"imu", "gyro", "odom", "odometry"}


@dataclass(frozen=True)
class FieldCandidate:
    """A field that may be a channel: which, where, the joint's name in the log, and the unit that its name states."""

    column: str
    topic: str
    field: str
    joint: str | None = None
    unit: str | None = None


class _NameFacts(NamedTuple):
    """What a name says, None where nothing: corner (lf, ...), part (leg, wheel), quantity (pos, ...), whether a setpoint."""

    corner: str | None
    part: str | None
    quantity: str | None
    command: bool


def read_name(name: str) -> _NameFacts:
    """Return what a name of a field, joint or column says; ``leg_wheel_fl`` is a wheel on a leg."""
    found = words(name)
    is_wheel = any(word == "w" or word.startswith(_WHEEL) or word.endswith(_WHEEL) for word in found)
    is_leg = any(word.startswith(_LEG) or word.endswith(_LEG) for word in found)
    part = "wheel" if is_wheel else "leg" if is_leg else None
    quantity = next((kind for word in found for kind, known in _QUANTITIES.items() if word in known), None)
    return _NameFacts(_corner(found), part, quantity, any(word in _COMMAND for word in found))


def _corner(found: list[str]) -> str | None:
    for word in found:
        for part in ("", *_WHEEL, *_LEG):  # fl, flwheel, wheelfl
            if word.replace(part, "", 1) in _CORNERS:
                return _CORNERS[word.replace(part, "", 1)]
    said = set(found)
    end = "f" if said & _FRONT else "r" if said & _REAR else None
    side = "l" if said & _LEFT else "r" if said & _RIGHT else None
    if "r" in said:  # the one of right and rear that is not said otherwise
        side, end = side or "r", end or "r"
    return f"{side}{end}" if side and end else None


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
    begin = f"/{(namespace or '').strip('/')}/".replace("//", "/")  # /robot_10/imu is not in /robot_1
    topics = [topic for name, topic in log.topics.items() if f"/{name.strip('/')}/".startswith(begin)]
    if not topics:
        roots = ", ".join(dict.fromkeys(f"/{_root_and_rest(name)[0]}" for name in log.topics))
        raise InputError(f"{log.name}: namespace '{namespace}': no topic is in it; topics are in {roots}")
    found: dict[str, list[FieldCandidate]] = {}
    for topic in topics:
        for candidate in (*_joints(topic, robot, names or {}), *_vectors(topic), *_pose(topic), *_supply(topic)):
            found.setdefault(candidate.column, []).append(candidate)

    def rank(one: FieldCandidate) -> tuple[int, int]:
        channels = sum(any(other.topic == one.topic for other in candidates) for candidates in found.values())
        return -channels, -len(log.topics[one.topic].received)

    for column, candidates in found.items():
        found[column] = sorted(candidates, key=rank)
    _check_one_robot(log, found, namespace)
    return found


# ---- joints ----------------------------------------------------------------------------------------------------------


def _joints(topic: Topic, robot: Robot, names: Mapping[str, str]) -> Iterator[FieldCandidate]:
    of_topic = read_name(topic.name)
    for field in topic.fields:
        if re.search(r"(pose|position|orientation|twist|transform|linear|angular)[\w.]*\.[xyzw]$", field):
            continue
        name = _bracket(field)
        facts = read_name(name or field)
        given = [joint for joint, known in names.items() if known == name]
        joint = given[0] if len(given) == 1 else _which(facts, of_topic, None if is_unnamed(topic, field) else name, robot)
        if joint is None or names.get(joint, "") not in field:  # the map has another name for this joint
            continue
        text = field.replace(f"[{name}]", " ").strip() if name else field
        outside = read_name(text)
        quantity = outside.quantity or facts.quantity or of_topic.quantity
        if outside.command or facts.command or of_topic.command:
            quantity = "cmd" if quantity in (None, "pos" if joint in LEGS else "vel") else None
        if quantity is not None:
            column = f"{quantity}_{joint}"
            unit = stated_unit(text, column) or stated_unit(name or "", column)
            yield FieldCandidate(column, topic.name, field, name, unit)


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


# ---- IMU, supply and pose ----------------------------------------------------------------------------------------------------


def _vectors(topic: Topic) -> Iterator[FieldCandidate]:
    if read_name(topic.name).command or (_says(topic.name, {"vel"}) and "Twist" in topic.kind):
        return
    found: dict[tuple[str, str], dict[str, str]] = {}  # what stands before and behind the axis -> axis -> field
    for field in topic.fields:
        if (parts := _split(field)) and not ("twist" in field and topic.kind.endswith("Odometry")):  # computed, not measured
            found.setdefault((parts[1], parts[3] or ""), {})[parts[2].lower()] = field
    for (stem, _), fields in found.items():
        stem = stem.rstrip("._[ ").lower()
        kind = next((kind for kind, known in _VECTORS.items() if _says(stem, known)), None) or _SHORT.get(stem)
        if kind is not None and len(fields) == len(XYZ):
            for axis, field in fields.items():
                yield FieldCandidate(f"{kind}_{axis}", topic.name, field, unit=stated_unit(field, f"{kind}_{axis}"))


def _supply(topic: Topic) -> Iterator[FieldCandidate]:
    for field in topic.fields:
        if (
            _says(topic.name if field == "data" else field, _VOLTAGE)
            and _bracket(field) is None
            and read_name(field).corner is None
        ):
            yield FieldCandidate("volt", topic.name, field, unit=stated_unit(field, "volt"))


def _pose(topic: Topic) -> Iterator[FieldCandidate]:
    """Yield what may be the body's measured pose: columns with our names, or the position and quaternion of a message.

    It is no setpoint, no joint's, no element of a list, and not computed from wheels.
    """
    if topic.name == TABLE:
        yield from (FieldCandidate(column, topic.name, column) for column in CAMERA[:3] if column in topic.fields)
    elif not topic.kind.endswith("Odometry") and not _of_other(topic.name) and not _says(topic.name, _COMPUTED):
        for field in (field for field in topic.fields if field.endswith(_PLACES) and "[" not in field and not _of_other(field)):
            stem = field.removesuffix("position.x").removesuffix("translation.x")
            turns = [turn for turn in (f"{stem}orientation", f"{stem}rotation") if f"{turn}.w" in topic.fields]
            if turns:
                yield from (FieldCandidate(f"cam_{axis}", topic.name, f"{field[:-1]}{axis}") for axis in XYZ)
                yield FieldCandidate("cam_yaw", topic.name, f"{turns[0]}.yaw")
                return


def _of_other(name: str) -> bool:
    """Whether a name is that of a setpoint, or of something at a corner of the robot."""
    facts = read_name(name)
    return facts.command or facts.corner is not None


def _split(field: str) -> re.Match[str] | None:
    """Split a name before and behind its axis; a letter that stands apart, as in ``velocity_x``, before one that does not."""
    end = r"([xyzXYZ])((?:\]|[_ \[(].*)?)"
    return re.fullmatch(rf"(.*[._\[ ]|){end}", field) or re.fullmatch(rf"(.*?){end}", field)


def _says(name: str, known: set[str]) -> bool:
    return any(word in known for word in words(name))


# ---- one robot only --------------------------------------------------------------------------------------------------


def _check_one_robot(log: Log, found: Mapping[str, list[FieldCandidate]], namespace: str | None) -> None:
    for joint in (joint for joint in JOINTS if f"pos_{joint}" in found):
        first, *others = found[f"pos_{joint}"]
        same = [one for one in others if one.topic == first.topic and one.field != first.field]
        if same:
            raise InputError(
                f"{log.name}: topic '{first.topic}': fields '{first.field}' and '{same[0].field}' are both the {joint}: "
                f"two robots in one topic, or two joints per leg? name the right one in the map: joints: {{{joint}: NAME}}"
            )
        topics = sorted({first.topic, *(one.topic for one in others)})
        rest = _root_and_rest(first.topic)[1]
        twins = [f"/{_root_and_rest(topic)[0]}" for topic in topics if _root_and_rest(topic)[1] == rest]
        if len(twins) > 1 and namespace is None:
            raise InputError(
                f"{log.name}: two robots: topics {', '.join(topics)} each have the {joint}; "
                f"say which in the map: namespace: {twins[0]}  (or {', '.join(twins[1:])})"
            )


def _root_and_rest(topic: str) -> tuple[str, str]:
    root, _, rest = topic.strip("/").partition("/")
    return root, rest


# ---- the proposal ----------------------------------------------------------------------------------------------------


Array = NDArray[np.float64]
Series = tuple[Array, Array]

#: Messages per topic that are looked at: 100 s of an IMU at 200 Hz.
MOST = 20_000
#: s from the start on that count as rest.
_START = 0.5
#: s; a topic that is delivered so much earlier or later than the joints may have another clock.
_LATE = 0.02
#: Share of headers not later than the one before, from which on they are no times; ns of a clock that began anew.
_NO_TIMES, _ANEW = 0.02, -1_000_000_000
#: Columns of a table that are listed where one is asked for.
_LISTED = 64
#: Parts of a proposal, each a question or a set of channels that are read alike.
_SETS = {
    **{f"{kind}_{part}": GROUPS[f"{kind}_{part}"] for kind in ("cmd", "pos", "vel", "eff") for part in ("leg", "wheel")},
    **{kind: GROUPS[kind] for kind in ("gyro", "acc")},
    "cam": ("cam_x", "cam_y"),
    "cam_yaw": ("cam_yaw",),
    "volt": ("volt",),
}
_NEEDED = ("cmd_leg", "cmd_wheel", "pos_leg", "pos_wheel")


@dataclass(frozen=True)
class MapLine:
    """A line of a proposed map: its section and entry, such as ``channels.vel_leg``, whether it asks, and why it is so."""

    place: str
    asks: bool
    why: str


@dataclass(frozen=True)
class Proposal:
    """A proposed map.

    Attributes:
        content: as a map file has it; ``open`` where it has to be decided.
        lines: what decides them, or what the log shows of them.
        unused: topics that it does not use.
    """

    content: dict[str, Any]
    lines: tuple[MapLine, ...]
    unused: tuple[str, ...]

    @property
    def open(self) -> list[str]:
        """Places that have to be decided, such as ``channels.vel_leg.unit``."""
        return open_places(self.content)

    @property
    def map(self) -> LogMap:
        """The map; one that is open in part is refused."""
        return parse_map(self.content, "map")

    @property
    def text(self) -> str:
        """The map file, above each open line what the log shows of it."""
        head = f"# Proposed by wlr import --suggest. Replace each '{OPEN}'; a run is made from a complete map only.\n"
        text = map_text(self.content, {line.place: line.why for line in self.lines if line.asks})
        return head + text if self.open else text


def propose(log: Log, robot: Robot, given: Mapping[str, Any] | None = None) -> Proposal:
    """Return a map for a log; what ``given`` says is taken as it is, its open lines are asked again.

    Args:
        log: all topics, all fields; the first :data:`MOST` messages of each are enough.
        robot: that the run is of.
        given: a map's content.

    Raises:
        InputError: two robots, two joints of one name, or nothing that is a channel.
    """
    known = decided(given or {})
    if "joints" in known:  # in the long form, so that what is not said of them is asked
        plain = {joint: {"name": str(one)} if isinstance(one, str | int) else one for joint, one in known["joints"].items()}
        known["joints"] = plain
    return _Proposer(log, robot, known).propose()


@dataclass(eq=False)
class _Proposer:
    """A log that is being looked at: ``chosen`` has the field of each column, ``clocks`` what is known of them."""

    log: Log
    robot: Robot
    known: dict[str, Any]

    def __post_init__(self) -> None:
        self.lines: list[MapLine] = []
        self.content: dict[str, Any] = defaultdict(dict)
        given = parse_map(self.known, "map")
        names = {joint: one.name for joint, one in given.joints.items()}
        found = find_candidates(self.log, self.robot, given.namespace, names)
        if len({one.topic for one in found.get("cam_x", ())}) > 1:  # which of them is the body's is for the user to say
            found = {column: fields for column, fields in found.items() if not column.startswith("cam")}
        self.mapped = {column for key in given.channels for column in GROUPS.get(key, (key,))}
        self.chosen = {column: fields[0] for column, fields in found.items() if column not in self.mapped}
        for column in ("eff_" + joint for joint in JOINTS):
            if column in self.chosen and not np.ptp(self.raw(column, TopicClock())[1]):
                del self.chosen[column]  # drivers that know no effort send zeros
        if not self.chosen and not self.mapped:
            topics = ", ".join(f"'{name}' ({topic.kind})" for name, topic in list(self.log.topics.items())[:12])
            raise InputError(f"{self.log.name}: nothing in it is known for a channel; topics: {topics}")
        exact = sum(one.field == column for column, one in self.chosen.items())
        self.ours = {column for column, one in self.chosen.items() if one.field == column and 2 * exact >= len(self.chosen)}
        self.topics = dict.fromkeys(
            [one.topic for one in self.chosen.values()] + [one.topic for one in given.channels.values()]
        )
        self.topics = [name for name in self.topics if name in self.log.topics]
        rows = self.chosen.get("pos_leg_lf") or next(
            (given.channels[k] for k in ("pos_leg", "pos") if k in given.channels), None
        )
        self.rows = given.rows or (rows.topic if rows else "")
        self.clocks = {name: given.use(name) for name in self.topics}
        self.names, self.templates = _joint_fields(self.chosen, {joint: one.name for joint, one in given.joints.items()})

    def propose(self) -> Proposal:
        self._clocks()
        self._rows()
        self._joints()
        for name, columns in _SETS.items():
            self._set(name, [column for column in columns if column in self.chosen])
        self._frames()
        if "profile" not in self.known.get("meta", {}):
            self.content["meta"]["profile"] = OPEN
            text = "the servos' profile: {wheel_acceleration: rad/s2, leg_velocity: rad/s, leg_acceleration: rad/s2}, {} = none"
            self.note("meta.profile", f"{text}. Without this line {NO_PROFILE.partition(': ')[2]}")
        order = ("time", "rows", "every", "joints", "channels", "frames", "clocks", "namespace", "meta")
        content = overlay({key: self.content[key] for key in order if self.content.get(key)}, self.known)
        unused = tuple(name for name in self.log.topics if name not in self.topics)
        lines = sorted(self.lines, key=lambda line: order.index(line.place.partition(".")[0]))
        return Proposal({key: content[key] for key in order if key in content}, tuple(lines), unused)

    def note(self, place: str, why: str, asks: bool = True) -> None:
        self.lines.append(MapLine(place, asks, why))

    # ---- what the log has -------------------------------------------------------------------------------------------

    def raw(self, column: str, clock: TopicClock | None = None) -> Series:
        """Return times (s) and values of a column's field, as the log has them; what is not finite is left out."""
        chosen = self.chosen[column]
        topic, clock = self.log.topics[chosen.topic], clock or self.clocks[chosen.topic]
        if chosen.field in topic.fields:
            at, values = topic.series(chosen.field, clock.use, self.log.name)
        else:
            at, values, _ = pose_angle(topic, chosen.field, clock.use, None, self.log.name)
        keep = np.isfinite(values)
        at, values = at[keep], values[keep]
        once = np.concatenate([[True], np.diff(at) > 0]) if len(at) else np.zeros(0, bool)
        origin = min(int(one.received[0]) for one in self.log.topics.values() if len(one.received))
        return np.asarray((at[once] - origin) * 1e-9 + clock.offset, np.float64), values[once]

    # ---- sections ---------------------------------------------------------------------------------------------------

    def _clocks(self) -> None:
        late = {name: _behind(self.log, name) for name in self.topics}
        base = late.get(self.rows) or 0.0
        for name in (one for one in self.topics if one not in self.known.get("clocks", {})):
            own = late[name]
            if own is None and self.log.topics[name].stamped is not None:
                self.clocks[name] = TopicClock(use="log")
                self.content["clocks"][name] = {"use": "log"}
                self.note(f"clocks.{name}", "its headers repeat or go back: they are no times", asks=False)
            elif own is not None and abs(apart := own - base) > _LATE:
                self.clocks[name] = TopicClock(offset=apart)
                self.content["clocks"][name] = OPEN
                shown = f"messages arrive {_ms(own)} after their header's time, the joints' {_ms(base)} (medians)"
                added = f"{{offset: S}} adds S ({apart:.3f} would make them arrive as the joints' do)"
                text = f"{{use: header}} trusts the headers, {{use: log}} the recorder's clock, {added}: {shown}"
                self.note(f"clocks.{name}", text)

    def _rows(self) -> None:
        if not self.rows or "pos_leg_lf" not in self.chosen:
            return
        self.content["rows"] = self.rows
        t, _ = self.raw("pos_leg_lf")
        rate = 1.0 / float(np.median(np.diff(t))) if len(t) > 1 else 50.0
        every = max(round(rate / 50.0), 1)
        if every > 1:
            self.content["every"] = every
        which = f"every {every}th" if every > 1 else "each"
        self.note("rows", f"topic '{self.rows}', {rate:.0f} messages a second; {which} makes a row", asks=False)

    def _joints(self) -> None:
        """Ask which way each joint counts, and a leg's angle where ours is 0; nothing of joints that are all in our names."""
        place = len(self.lines)
        for joint in JOINTS:
            columns = [column for column in self.chosen if column.partition("_")[2] == joint]
            said = self.known.get("joints", {}).get(joint, {})
            name = said.get("name", self.names.get(joint, joint))
            entry = {"name": name}
            wanted = ("sign", "zero") if joint in LEGS else ("sign",)
            asked = [key for key in wanted if key not in said] if not set(columns) <= self.ours else []
            if asked:
                entry |= dict.fromkeys(asked, OPEN)
                found = [f"{kind}_{joint}" for kind in ("pos", "cmd") if f"{kind}_{joint}" in self.chosen]
                shown = "; ".join(f"{column.partition('_')[0]} {_range(self.raw(column))}" for column in found)
                self.note(f"joints.{joint}", f"{shown}{self._follows(joint)}" or "no field of it is known")
            if asked or (joint in self.names and joint not in self.known.get("joints", {})):
                self.content["joints"][joint] = entry
        if len(self.lines) > place:
            legs = "of a leg 1 where the number grows as the wheel goes from the front over below to the back"
            zero = "zero: the log's angle (rad) where the leg points straight forward"
            text = f"sign: {legs}, of a wheel 1 where it grows as the wheel rolls forward, else -1. {zero}"
            self.lines.insert(place, MapLine("joints", True, text))

    def _set(self, name: str, columns: Sequence[str]) -> None:
        """Add the channels of a set, with their unit where it is decided, and ask it where it is not."""
        kind = name.partition("_")[0]
        missing = [
            column for column in _SETS[name] if name in _NEEDED and column not in self.chosen and column not in self.mapped
        ]
        for column in [name] if len(missing) == len(_SETS[name]) else missing:
            self.content["channels"][column] = {"topic": OPEN, "field": OPEN}
            self.note(f"channels.{column}", f"no field is known to be it{self._unnamed()}")
        if not columns:
            return
        entries = {column: {"topic": self.chosen[column].topic, "field": self._field(column)} for column in columns}
        first = entries[columns[0]]
        together = len(columns) == len(_SETS[name]) and "{" in first["field"] and all(one == first for one in entries.values())
        units = {column: self._unit(column) for column in columns}
        groups = {name: columns} if together and len(set(units.values())) == 1 else {column: [column] for column in columns}
        asked = []
        for key, members in groups.items():
            unit, entry = units[members[0]], dict(entries[members[0]])
            if unit != COLUMNS[members[0]].unit:
                entry["unit"] = unit
            self.content["channels"][key] = entry
            if OPEN in entry.values():
                asked.append((key, members))
        source = ", ".join(dict.fromkeys(self._source(column) for column in columns))
        count = f"{len(columns)} of {len(_SETS[name])} joints; " if kind in ("cmd", "pos", "vel", "eff") and missing else ""
        if not asked:
            by = "as in our own names" if set(columns) <= self.ours else f"in {', '.join(dict.fromkeys(units.values()))}"
            self.note(f"channels.{next(iter(groups))}", f"{count}{source}, {by}", asks=False)
            return
        key, members = asked[0]
        question = f"{', '.join(units_of(members[0]))}?"
        ranges = "; ".join(f"{column.partition('_')[2] or column} {_range(self.raw(column))}" for column in columns)
        if kind == "eff":
            stall, _ = effort_range(columns[0], self.robot)
            ranges += f"; A, mA and counts become N m by the robot's torque constants; the motor stalls at {stall:.3g} N m"
        self.note(f"channels.{key}", f"{question} {count}{source}; {ranges}")

    def _frames(self) -> None:
        given = self.known.get("frames", {})
        imu = [f"{kind}_{axis}" for kind in ("gyro", "acc") for axis in XYZ]
        have = [column for column in imu if column in self.chosen]
        if have and not set(have) <= self.ours and "imu" not in given:
            self.content["frames"]["imu"] = OPEN
            shown = ["the log's axes that our x (forward), y (left) and z (up) are: [x, y, z] where it is mounted so"]
            if "acc_x" in self.chosen:
                gravity = ", ".join(f"{np.median(self.raw(f'acc_{axis}')[1]):.3g}" for axis in XYZ)
                shown.append(f"acc reads {gravity} in the median (up is where it is positive)")
            if "gyro_x" in self.chosen:
                sizes = ", ".join(f"{np.std(self.raw(f'gyro_{axis}')[1]):.3g}" for axis in XYZ)
                shown.append(f"gyro varies by {sizes} (a robot that drives turns about up)")
            self.note("frames.imu", ". ".join(shown))
        if "cam_z" in self.chosen and "cam_x" in self.chosen and "cam" not in given:
            self.content["frames"]["cam"] = OPEN
            spread = [float(np.ptp(values)) if len(values) else 0.0 for _, values in map(self.raw, (f"cam_{a}" for a in XYZ))]
            shown = ", ".join(f"{axis} goes over {size:.3g}" for axis, size in zip(XYZ, spread, strict=True))
            text = "the pose's axes that our x, y and z (up) are: [x, y, z], or [x, -z, y] where its y points up"
            up = "the one that hardly changes points up"
            self.note("frames.cam", f"{text}. {shown}: {up}")
        others = [f"'{name}'" for name, topic in self.log.topics.items() if any(one.endswith(_PLACES) for one in topic.fields)]
        if others and "cam_x" not in self.chosen and not any(column.startswith("cam") for column in self.mapped):
            text = f"not proposed: which pose of {', '.join(others)} is the body's, measured, is not known; name it if one is"
            self.note("channels.cam", text, asks=False)

    # ---- what is decided --------------------------------------------------------------------------------------------

    def _unit(self, column: str) -> str:
        """Return the unit of a column's field: SI of our own columns and of quaternions, else as its name states, or open."""
        one = self.chosen[column]
        if column in self.ours or one.field not in self.log.topics[one.topic].fields:
            return COLUMNS[column].unit
        return one.unit or OPEN

    # ---- what is shown ----------------------------------------------------------------------------------------------

    def _source(self, column: str) -> str:
        one = self.chosen[column]
        kind = self.log.topics[one.topic].kind
        topic = "" if kind == one.topic else f"topic '{one.topic}' ({kind}), "
        return f"{topic}'{self._field(column)}'"

    def _follows(self, joint: str) -> str:
        """Return how a joint's motion goes with its command, in words: a leg's angle, a wheel's rate."""
        moved, asked = f"{'pos' if joint in LEGS else 'vel'}_{joint}", f"cmd_{joint}"
        if not {moved, asked} <= set(self.chosen):
            return ""
        (t, values), (at, goals) = self.raw(moved), self.raw(asked)
        if min(len(t), len(at)) < 2 or not np.ptp(values) or not np.ptp(goals := np.interp(t, at, goals)):
            return ""
        return f"; correlation with its command {np.corrcoef(values, goals)[0, 1]:.2f}"

    def _unnamed(self) -> str:
        """Return which lists have as many elements as a robot has joints of a kind, but no names; and a table's columns."""
        said = []
        for name, topic in self.log.topics.items():
            stems = sorted({field.rpartition("[")[0] for field in topic.fields if is_unnamed(topic, field)})
            long = [stem for stem in stems if f"{stem}[{len(LEGS) - 1}]" in topic.fields]
            said += [f"topic '{name}': {', '.join(long)}"] if long else []
        by_place = f"and suggest again: joints: {{{JOINTS[0]}: '0', ...}}"
        by_channel = "beside the joints' names: channels: {cmd_leg_lf: {topic: TOPIC, field: 'data[0]'}, ...}"
        hint = f"say which is which, by place, {by_channel if self.names else by_place}"
        text = f"; lists without names: {'; '.join(said)}; {hint}" if said else ""
        table = self.log.topics.get(TABLE)
        return text if table is None else f"{text}; the table has {', '.join(map(repr, list(table.fields)[:_LISTED]))}"

    # ---- fields as the map has them ---------------------------------------------------------------------------------

    def _field(self, column: str) -> str:
        """Return a field, the joint's name in it as ``{joint}``, where three differ in nothing else the axis as ``{axis}``."""
        one, kind = self.chosen[column], column.partition("_")[0]
        if column in self.templates:
            return self.templates[column]
        axes = "xy" if column in ("cam_x", "cam_y") else XYZ if kind in ("gyro", "acc") else ()
        fields = [self.chosen[f"{kind}_{axis}"].field for axis in axes if f"{kind}_{axis}" in self.chosen]
        for place in range(len(fields[0]) if len(fields) == len(axes) > 0 else 0):
            template = fields[0][:place] + "{axis}" + fields[0][place + 1 :]
            if [template.replace("{axis}", axis) for axis in axes] == fields:
                return template
        return one.field


def _joint_fields(chosen: Mapping[str, FieldCandidate], known: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return joint -> its name in the log, and column -> field with that name as ``{joint}``, where all its fields have one.

    The name is ours, stands in brackets, or is what the fields of a set of joints differ in: ``fl`` of ``fl_hip_pos``.
    """
    ways: list[dict[str, tuple[str, str]]] = [{}, {}, {}]  # column -> name, template
    for columns in _SETS.values():
        found = {column: chosen[column] for column in columns if column in chosen and column.partition("_")[2] in JOINTS}
        fields = [one.field for one in found.values()]
        before = re.sub(r"[^\W_]+$", "", _common_start(fields))
        after = re.sub(r"^[^\W_]+", "", _common_start([field[::-1] for field in fields])[::-1])
        for column, one in found.items():
            label = column.partition("_")[2]
            if label in one.field:
                ways[0][column] = label, one.field.replace(label, "{joint}")
            if one.joint is not None:
                ways[1][column] = one.joint, one.field.replace(f"[{one.joint}]", "[{joint}]", 1)
            ways[2][column] = one.field[len(before) : len(one.field) - len(after)], f"{before}{{joint}}{after}"
    names, templates = {}, {}
    for joint in JOINTS:
        columns = [column for column in chosen if column.partition("_")[2] == joint]
        for way in ways:
            found = {way.get(column, ("", ""))[0] for column in columns}
            if len(found) == 1 and known.get(joint, min(found)) in found - {""}:
                names[joint] = min(found)
                templates |= {column: way[column][1] for column in columns}
                break
    return names, templates


def _common_start(texts: Sequence[str]) -> str:
    same = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*texts, strict=False))
    return "".join(letters[0] for letters in same)


def _behind(log: Log, name: str) -> float | None:
    """Return how far the recorder's clock is ahead of a topic's headers, s; None where they are no times."""
    topic = log.topics[name]
    if topic.stamped is None or len(topic.stamped) < 2:
        return None
    steps = np.diff(topic.stamped)
    if (steps <= 0).mean() > _NO_TIMES or steps.min() < _ANEW:
        return None
    return float(np.median(topic.received - topic.stamped)) * 1e-9


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.1f} ms" if abs(seconds) < 10.0 else f"{seconds:.3f} s"


def _range(series: Series) -> str:
    """Return from where to where values go, and where they are at the start, in words."""
    t, values = series
    if not len(t):
        return "has no values"
    start = float(np.median(values[t <= t[0] + _START]))
    return f"{values.min():.4g} to {values.max():.4g} ({start:.4g} at the start)"
