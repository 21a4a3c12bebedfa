"""What a log's topics and fields mean: units of logs, the map from fields to the channels of a run as data, and its file.

A map may hold lines that are still :data:`OPEN`, as proposed ones do; a run is made from a complete map only.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field, field_validator

from wlr_gym.base.errors import InputError, check_name, unknown_name
from wlr_gym.base.settings import SettingsModel, parse_config, read_yaml
from wlr_gym.data.format import CAMERA, COLUMNS, RunMeta
from wlr_gym.data.runs import names_file
from wlr_gym.physics.servo import current_law, effort_counts
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot

_TURN = 2.0 * math.pi
_RPM = _TURN / 60.0
_G = 9.80665

#: SI unit -> unit -> factor. ``count`` is a count of a Dynamixel register of the X series; see :func:`factor`.
FACTORS: dict[str, dict[str, float]] = {
    "rad": {"rad": 1.0, "deg": math.radians(1.0), "turn": _TURN, "count": _TURN / 4096},
    "rad/s": {
        "rad/s": 1.0, "deg/s": math.radians(1.0), "rpm": _RPM, "turn/s": _TURN, "count": 0.229 * _RPM,
    },
    "N m": {"N m": 1.0, "mN m": 1e-3, "N cm": 1e-2},
    "m/s2": {"m/s2": 1.0, "g": _G, "mg": _G * 1e-3},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "s": {"s": 1.0, "ms": 1e-3},
    "V": {"V": 1.0, "mV": 1e-3},
}  # fmt: skip
#: Currents mean a torque by the robot's nominal torque constants; a count is one of Present Current (legs), Load (wheels).
CURRENTS = ("A", "mA", "count")
#: Efforts that are often larger than so many stall torques are in another unit.
_STALLS = 2.0
#: rad; a joint that moved by more shows its friction.
_MOVED = 0.5


def words(name: str) -> list[str]:
    """Return the words of a name in lower case: ``FL_hipPos2`` is fl, hip, pos, 2."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]


def units_of(column: str) -> Iterable[str]:
    """Return the units that a column may be in, in a log."""
    unit = COLUMNS[column].unit
    return [*FACTORS.get(unit, ()), *(CURRENTS if unit == "N m" else ())]


def is_effort(column: str) -> bool:
    """Whether a column is an effort."""
    return column.startswith("eff_")


def effort_range(column: str, robot: Robot) -> tuple[float, float]:
    """Return the stall torque behind an effort column, and one count of its register, N m."""
    joint = JOINTS.index(column.removeprefix("eff_"))
    motor = robot.servo.leg if joint < len(LEGS) else robot.servo.wheel
    return motor.stall_torque, float(effort_counts(robot)[joint])


def check_effort(column: str, table: Mapping[str, NDArray[np.float64]], unit: str, robot: Robot, where: str) -> None:
    """Refuse efforts that the robot's motor cannot have, and those in small units that its register would not show.

    The table is in SI units; ``unit`` is the one that the log is said to have them in.
    """
    stall, count = effort_range(column, robot)
    sizes, moved = np.nan_to_num(np.abs(table[column])), np.ptp(table[column.replace("eff", "pos")])
    row = int(np.argmax(sizes))
    text = f"{where}: row {row}, column '{column}': {table[column][row]:.3g} N m; expected"
    if np.quantile(sizes, 0.95) > _STALLS * stall:
        hint = "looks like mA, mN m or counts of a register, or another robot (--robot)"
        raise InputError(f"{text} up to {stall:g}, the stall torque of robot '{robot.name}'; {hint}")
    if unit in ("mA", "mN m") and 0.0 < sizes[row] < count and moved > _MOVED:
        raise InputError(f"{text} more than {count:.2g}, one count of robot '{robot.name}'; looks like A or N m")


def factor(column: str, unit: str | None, robot: Robot, where: str) -> float:
    """Return what one ``unit`` of a column is in SI units, a count as the robot's encoders count; None = it is in SI units."""
    si = COLUMNS[column].unit
    if unit is None:
        return 1.0
    encoder = robot.sensors.encoder
    of_encoder = {"rad": encoder.position, "rad/s": encoder.velocity}.get(si, 0.0)
    if unit == "count" and of_encoder > 0.0:
        return of_encoder
    if unit in FACTORS.get(si, ()):
        return FACTORS[si][unit]
    if si not in FACTORS:
        raise InputError(f"{where}: channel '{column}': unit '{unit}': expected none, it is a number from 0 to 1")
    if si != "N m" or unit not in CURRENTS:
        raise unknown_name("unit", unit, units_of(column), f"{where}: channel '{column}'")
    joint = JOINTS.index(column.removeprefix("eff_"))
    if unit == "count":
        return float(effort_counts(robot)[joint])
    return float(current_law(robot).torque_constant[joint]) * (1e-3 if unit == "mA" else 1.0)


# ---- the map ---------------------------------------------------------------------------------------------------------

_KINDS = ("cmd", "pos", "vel", "eff")
#: Names that stand for several channels.
GROUPS: dict[str, tuple[str, ...]] = {
    **{kind: tuple(f"{kind}_{joint}" for joint in JOINTS) for kind in _KINDS},
    **{f"{kind}_leg": tuple(f"{kind}_{leg}" for leg in LEGS) for kind in _KINDS},
    **{f"{kind}_wheel": tuple(f"{kind}_{wheel}" for wheel in WHEELS) for kind in _KINDS},
    **{kind: tuple(f"{kind}_{axis}" for axis in "xyz") for kind in ("gyro", "acc")},
    "cam": CAMERA[:3],
}
#: Value of what a map does not decide yet.
OPEN = "open"
#: Axes of a frame, as one of the log's.
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


class ChannelSource(SettingsModel):
    """Where a channel, or several, comes from: value = sign * (what the log says, in SI units - zero).

    Attributes:
        topic: of the log.
        field: of its messages; ``{joint}`` stands for the joint's name in the log, ``{axis}`` for x, y or z. Of a quaternion
            ``.yaw``, ``.pitch`` and ``.roll`` can be taken: ``pose.orientation.yaw``.
        unit: of the log; None = SI.
        sign: -1 = counts the other way.
        zero: what the log says where the channel is 0, in SI units.
        take: how a row gets its value: ``interpolate`` between the samples before and after it, ``hold`` the last one
            (of setpoints: the one that holds in the middle of the row's step), ``nearest``, or ``frames``: only rows next to a
            sample get one. None = ``hold`` for setpoints and voltage, ``frames`` for the camera, else ``interpolate``. What has
            a sample at the row's own time is taken as it is.
    """

    topic: str
    field: str
    unit: str | None = None
    sign: Literal[1, -1] = 1
    zero: float = 0.0
    take: Literal["interpolate", "hold", "nearest", "frames"] | None = None


class JointSource(SettingsModel):
    """A joint in the log: its name, which way it counts, and its angle (rad) where ours is 0."""

    name: str
    sign: Literal[1, -1] = 1
    zero: float = 0.0


#: Said where a map is proposed or used that leaves the servo profile open.
NO_PROFILE = (
    "the map does not state the servo profile (meta.profile): none is assumed, and wlr gap takes that as true; a profile that "
    "was set then looks like a command delay or a slow servo"
)


class TopicClock(SettingsModel):
    """When a topic's messages were measured: by their ``header`` or as the ``log`` received them, and s to add to that."""

    use: Literal["header", "log"] = "header"
    offset: float = 0.0


class LogMap(SettingsModel):
    """What a log's topics and fields mean.

    Attributes:
        rows: topic whose messages make the rows; None = that of the legs' positions.
        every: of them, every so manieth makes a row.
        joints: joint -> its name in the log, with sign and zero where they differ.
        channels: channel, or group of channels (``pos``, ``pos_leg``, ``gyro``, ``cam``, ...) -> source; the narrower wins.
        frames: ``imu`` or ``cam`` -> the axes of the log that our x, y and z are, such as ``[-y, x, z]``.
        clocks: topic -> its clock.
        namespace: topics that do not begin with it are another robot's.
        time: column of a table's times; None = by its name.
        meta: for ``meta.yaml``.
    """

    rows: str | None = None
    every: int = Field(default=1, ge=1)
    joints: dict[str, JointSource] = Field(default_factory=dict)
    channels: dict[str, ChannelSource] = Field(default_factory=dict)
    frames: dict[str, tuple[Axis, Axis, Axis]] = Field(default_factory=dict)
    clocks: dict[str, TopicClock] = Field(default_factory=dict)
    namespace: str | None = None
    time: str | None = None
    meta: RunMeta = RunMeta()

    @field_validator("joints", mode="before")
    @classmethod
    def _plain_names(cls, value: Any) -> Any:
        if not isinstance(value, Mapping):
            return value
        for joint in value:
            check_name("joint", joint, JOINTS)
        return {joint: {"name": one} if isinstance(one, str | int) else one for joint, one in value.items()}

    @field_validator("channels")
    @classmethod
    def _known_channels(cls, value: dict[str, ChannelSource]) -> dict[str, ChannelSource]:
        for channel in value:
            check_name("channel", channel, (*(name for name in COLUMNS if name != "t"), *GROUPS))
        return value

    @field_validator("frames")
    @classmethod
    def _right_handed(cls, value: dict[str, tuple[Axis, Axis, Axis]]) -> dict[str, tuple[Axis, Axis, Axis]]:
        for name, axes in value.items():
            check_name("frame", name, ("imu", "cam"))
            order, flipped = "".join(axis[-1] for axis in axes), sum(axis.startswith("-") for axis in axes) % 2 == 1
            if sorted(order) != ["x", "y", "z"] or (order in ("xyz", "yzx", "zxy")) == flipped:
                raise InputError(f"frames.{name} = {list(axes)}: expected x, y and z once each, right-handed")
        return value

    def use(self, topic: str) -> TopicClock:
        """Return the clock of a topic."""
        return self.clocks.get(topic, TopicClock())


def open_places(data: Any, place: str = "") -> list[str]:
    """Return what is still open in a map's content, as ``channels.vel.unit``."""
    if isinstance(data, Mapping):
        return [found for key, value in data.items() for found in open_places(value, f"{place}.{key}".lstrip("."))]
    return [place] if data == OPEN else []


def decided(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a map's content without its open lines: of channels only whole ones, of joints what is said of them."""
    found = {key: decided(value) if isinstance(value, Mapping) else value for key, value in data.items() if value != OPEN}
    if isinstance(channels := data.get("channels"), Mapping):
        found["channels"] = {name: one for name, one in channels.items() if not open_places(one, name)}
    if isinstance(joints := found.get("joints"), Mapping):
        found["joints"] = {joint: one for joint, one in joints.items() if not isinstance(one, Mapping) or "name" in one}
    return found


def parse_map(data: Mapping[str, Any], where: str) -> LogMap:
    """Return a map from its content.

    Raises:
        InputError: no map, or one with open lines; the message names them.
    """
    parse_config(LogMap, decided(data), where)
    if places := open_places(data):
        hint = "decide them (wlr import LOG --suggest writes a map that says what the log shows of each)"
        raise InputError(f"{where}: still open: {', '.join(places)}; {hint}")
    return parse_config(LogMap, data, where)


def read_map(path: str | Path) -> dict[str, Any]:
    """Read a map file as it is written, open lines included; a robot file's path goes on from here, not from the map.

    Raises:
        InputError: no YAML, an unknown key, a value of the wrong kind; the message names the nearest valid name.
    """
    data: dict[str, Any] = read_yaml(path) or {}
    robot = parse_config(LogMap, decided(data) if isinstance(data, Mapping) else data, str(path)).meta.robot
    if robot is not None and names_file(robot):
        data["meta"]["robot"] = str(Path(path).parent / robot)
    return data


def content(found: LogMap) -> dict[str, Any]:
    """Return what a map file says: all that is not as it would be without it."""
    said = found.model_dump(mode="json", exclude_defaults=True)
    if found.meta.states_profile:  # also where it says that there is none
        said.setdefault("meta", {}).setdefault("profile", found.meta.profile.model_dump(mode="json"))
    return said


def map_text(data: Mapping[str, Any], remarks: Mapping[str, str] | None = None) -> str:
    """Return the text of a map file.

    Args:
        data: its content.
        remarks: what stands above a line, by section and entry, as ``channels.vel``.
    """
    lines, remarks = [], remarks or {}

    def dumped(entry: Mapping[str, Any], indent: str) -> list[str]:
        style = None if isinstance(next(iter(entry.values())), Mapping | list | tuple) else False
        text = yaml.safe_dump(dict(entry), sort_keys=False, default_flow_style=style, width=140, allow_unicode=True)
        return textwrap.indent(text, indent).splitlines()

    def remark(place: str, indent: str) -> list[str]:
        return textwrap.wrap(remarks.get(place, ""), 120, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}#   ")

    for key, value in data.items():
        lines += remark(key, "")
        if not isinstance(value, Mapping):
            lines += dumped({key: value}, "")
            continue
        lines.append(f"{key}:")
        for name, entry in value.items():
            lines += [*remark(f"{key}.{name}", "  "), *dumped({name: entry}, "  ")]
    return "\n".join([*lines, ""])


# ---- what it means for each channel ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Resolved:
    """Where one channel comes from.

    Attributes:
        column: channel.
        topic, field: of the log.
        factor, sign, zero: value = sign * (factor * field - zero).
        unit: of the log, for messages.
        take: how rows get their values.
    """

    column: str
    topic: str
    field: str
    factor: float
    sign: int
    zero: float
    unit: str
    take: str


def resolve(found: LogMap, robot: Robot, where: str) -> dict[str, Resolved]:
    """Return column -> where it comes from, for every channel of the map."""
    resolved = {}
    for column in COLUMNS:
        keys = [column, *sorted((name for name, members in GROUPS.items() if column in members), key=len, reverse=True)]
        key = next((name for name in keys if name in found.channels), None)
        if key is not None:
            resolved[column] = _resolve(found, column, found.channels[key], robot, where)
    return resolved


def _resolve(found: LogMap, column: str, source: ChannelSource, robot: Robot, where: str) -> Resolved:
    kind, _, label = column.partition("_")
    field, sign, zero = source.field, source.sign, source.zero
    if kind == "eff" and source.unit is None and "current" in words(field):
        raise InputError(f"{where}: channel '{column}': field '{field}' is a current: expected its unit: A, mA or count")
    if label in JOINTS:
        joint = found.joints.get(label)
        if "{joint}" in field and joint is None:
            raise InputError(f"{where}: channel '{column}': joints.{label} is missing: its name in the log")
        if joint is not None:
            field = field.replace("{joint}", joint.name)
            sign *= joint.sign
            zero += joint.zero if kind in ("pos", "cmd") and label in LEGS else 0.0
    elif kind in ("gyro", "acc") or column in ("cam_x", "cam_y", "cam_z"):
        axes = found.frames.get("cam" if kind == "cam" else "imu", ("x", "y", "z"))
        axis = axes["xyz".index(label)]
        sign *= -1 if axis.startswith("-") and "{axis}" in field else 1
        field = field.replace("{axis}", axis[-1])
    elif "{axis}" in field:  # heading and pitch come from the quaternion beside the position
        field = field.replace("position.{axis}", f"orientation.{label}").replace("{axis}", label)
    take = source.take or ("hold" if kind in ("cmd", "volt") else "frames" if kind == "cam" else "interpolate")
    angle_of_pose = column in ("cam_yaw", "cam_pitch") and source.unit in ("mm", "cm", "m")
    unit = None if angle_of_pose else source.unit
    size = factor(column, unit, robot, where)
    return Resolved(column, source.topic, field, size, sign, zero, unit or COLUMNS[column].unit, take)
