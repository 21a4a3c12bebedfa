"""Propose a map for a log: which fields are which channels, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import parse_config
from wlr_gym.data.format import CAMERA, COLUMNS
from wlr_gym.data.logs.candidates import FieldCandidate, find_candidates, is_unnamed, may_be_pose
from wlr_gym.data.logs.clocks import set_clocks
from wlr_gym.data.logs.map import GROUPS, NO_PROFILE, ChannelSource, JointSource, LogMap, combine
from wlr_gym.data.logs.signals import GUESS, SURE, LogSignals, Reason, roughly_one_clock
from wlr_gym.data.logs.suggest_body import find_imu, find_pose, wheel_motion
from wlr_gym.data.logs.suggest_joints import JointFindings, find_joints
from wlr_gym.data.logs.suggest_wheels import find_sides
from wlr_gym.data.logs.topics import Log
from wlr_gym.robot import JOINTS, LEGS, Robot
from wlr_gym.robot.parameter_table import XYZ

#: Messages per topic that are looked at: 100 s of an IMU at 200 Hz.
MOST = 20_000
#: s; motions that are shorter show nothing.
_SHORTEST = 1.0


@dataclass(frozen=True)
class Proposal:
    """A proposed map, why it is as it is, and the topics that it does not use."""

    map: LogMap
    reasons: tuple[Reason, ...]
    unused: tuple[str, ...]


def propose(log: Log, robot: Robot, given: Mapping[str, Any] | None = None) -> Proposal:
    """Return a map for a log; what ``given`` says is taken as it is.

    Names and types say which field is which channel. Units, signs, axes and clocks come from comparing motions: wheels
    against the pose, rates against angles, the gyroscope against wheels, the accelerometer against gravity.

    Args:
        log: all topics, all fields; the first :data:`MOST` messages of each are enough.
        robot: that the run is of.
        given: a map file as it is written.

    Raises:
        InputError: two robots, two joints of one name, nothing that is a channel, or less than 1 s.
    """
    given = dict(given or {})
    known = parse_config(LogMap, given, "map")
    look = _look(log, robot, known)
    _unnamed(look)
    _no_pose(look)
    _other_names(look)
    body = find_pose(look)
    joints = find_joints(look, body)
    if body is None:
        find_sides(look, joints)
    wheels = wheel_motion(look, joints)
    imu = find_imu(look, body, wheels)
    set_clocks(look, body, wheels, imu.heading, imu.pushed)
    units = dict(imu.units)
    _voltage(look, units)
    if not known.meta.states_profile:
        look.note("meta.profile", GUESS, NO_PROFILE)
    proposed = LogMap.model_validate(_content(look, joints, units))
    used = {one.topic for one in look.chosen.values()}
    unused = tuple(name for name in log.topics if name not in used)
    return Proposal(combine(proposed, given), tuple(look.reasons), unused)


def _look(log: Log, robot: Robot, known: LogMap) -> LogSignals:
    names = {joint.name: label for label, joint in known.joints.items()}
    candidates = find_candidates(log, robot, known.namespace, names)
    chosen = {column: found[0] for column, found in candidates.items()}
    if not chosen:
        topics = ", ".join(f"'{name}' ({topic.kind})" for name, topic in list(log.topics.items())[:12])
        raise InputError(f"{log.name}: nothing in it is known for a channel; topics: {topics}")
    for column in ("cam_z", "cam_pitch"):
        if column in chosen and ("cam_x" not in chosen or chosen[column].topic != chosen["cam_x"].topic):
            del chosen[column]
    topics = sorted({one.topic for one in chosen.values()})
    _leave_out_short(log, chosen)
    rows = known.rows or (chosen["pos_leg_lf"].topic if "pos_leg_lf" in chosen else topics[0])
    clocks = roughly_one_clock(log, topics, known.clocks, rows)
    return LogSignals(log, robot, chosen, known, clocks, frames=dict(known.frames))


def _unnamed(look: LogSignals) -> None:
    """Say which lists have as many elements as a robot has joints of a kind, but no names."""
    for name, topic in look.log.topics.items():
        stems = {field.rpartition("[")[0] for field in topic.fields if is_unnamed(topic, field)}
        long = [stem for stem in sorted(stems) if any(f"{stem}[{len(LEGS) - 1}]" == field for field in topic.fields)]
        if long and not any(one.topic == name and one.column.partition("_")[2] in JOINTS for one in look.chosen.values()):
            text = f"topic '{name}': {', '.join(long)} have no names: say in the map which is which, by place"
            look.note("joints", GUESS, f"{text}: joints: {{{JOINTS[0]}: '0', ...}}")


def _no_pose(look: LogSignals) -> None:
    """Say which topics have poses, where none of them is known to be the body's."""
    others = [f"'{name}'" for name, topic in look.log.topics.items() if any(map(may_be_pose, topic.fields))]
    if others and not look.has("cam_x") and not any(key.startswith("cam") for key in look.given.channels):
        text = f"not proposed: the poses of {', '.join(others)} are not known to be the body's; name one in the map if it is"
        look.note("cam", GUESS, text)


def _other_names(look: LogSignals) -> None:
    """Say which fields are taken for a channel of another name, where most have the very names of our channels."""
    others = [one for column, one in look.chosen.items() if one.field != column]
    for one in others if 2 * len(others) < len(look.chosen) else ():
        text = f"'{one.field}' of topic '{one.topic}' is taken for it; most others have the very names of our channels"
        look.note(one.column, GUESS, text)


def _leave_out_short(log: Log, chosen: dict[str, FieldCandidate]) -> None:
    """Leave out motions that are too short to be compared; refuse those of the joints."""
    for column, one in list(chosen.items()):
        received = log.topics[one.topic].received
        seconds = float(np.ptp(received)) * 1e-9 if len(received) else 0.0
        if seconds >= _SHORTEST or column.startswith(("cmd_", "volt")):
            continue
        if column.startswith("pos_"):
            text = f"{seconds:.2f} s are too short to be looked at, expected {_SHORTEST:g} s: give a map (--map)"
            raise InputError(f"{log.name}: topic '{one.topic}': {text}")
        del chosen[column]


def _voltage(look: LogSignals, units: dict[str, str]) -> None:
    if not look.has("volt"):
        return
    middle = float(np.median(look.raw("volt")[1]))
    units["volt"] = look.chosen["volt"].unit or ("mV" if middle > 100.0 else "V")
    sure = SURE if 5.0 < middle * (1e-3 if units["volt"] == "mV" else 1.0) < 30.0 else GUESS
    look.note("volt", sure, f"topic '{look.chosen['volt'].topic}', in {units['volt']}: {middle:.4g} in the median")


# ---- the map ---------------------------------------------------------------------------------------------------------


def _content(look: LogSignals, found: JointFindings, units: Mapping[str, str]) -> dict[str, Any]:
    names = _joint_names(look)
    channels = dict(_channels(look, found, units, names))
    joints = {
        joint: JointSource(
            name=names.get(joint, joint),
            sign=_sign(found.joint_sign.get(joint, 1)),
            zero=round(found.joint_zero.get(joint, 0.0), 6),
        )
        for joint in JOINTS
        if joint in names or joint in found.joint_zero or found.joint_sign.get(joint, 1) < 0
    }
    used = {source.topic for source in channels.values()}
    clocks = {name: one for name, one in look.clocks.items() if name in used and (one.offset or one.use != "header")}
    rows = channels["pos_leg_lf"].topic if "pos_leg_lf" in channels else None
    return {
        "rows": rows,
        "every": _every(look, rows),
        "joints": {joint: one.model_dump(exclude_defaults=True) for joint, one in joints.items()},
        "channels": {name: one.model_dump(exclude_defaults=True) for name, one in _grouped(channels).items()},
        "frames": {name: tuple(look.frames[name]) for name in ("cam", "imu") if name in look.frames},
        "clocks": {name: one.model_dump() for name, one in clocks.items()},
    }


def _every(look: LogSignals, rows: str | None) -> int:
    """Return of how many messages one makes a row, so that there are about 50 a second."""
    if rows is None or len(look.log.topics[rows].received) < 3:
        return 1
    t, _ = look.raw("pos_leg_lf")
    rate = 1.0 / float(np.median(np.diff(t)))
    every = max(round(rate / 50.0), 1)
    which = f"every {every}th" if every > 1 else "each"
    look.note("rows", SURE, f"topic '{rows}', {rate:.0f} messages a second; {which} makes a row")
    return every


def _joint_names(look: LogSignals) -> dict[str, str]:
    """Return the joints' names where all fields of a joint have the same one."""
    names: dict[str, set[str | None]] = {}
    for column, one in look.chosen.items():
        label = column.partition("_")[2]
        if label in JOINTS:
            names.setdefault(label, set()).add(one.joint)
    return {joint: str(next(iter(found))) for joint, found in names.items() if len(found) == 1 and None not in found}


def _channels(
    look: LogSignals, found: JointFindings, units: Mapping[str, str], names: Mapping[str, str]
) -> Iterator[tuple[str, ChannelSource]]:
    for column, one in look.chosen.items():
        kind, _, label = column.partition("_")
        if column in ("cam_z", "cam_pitch"):
            continue  # where the marker sits above the body is not known
        field, sign, unit = one.field, 1, one.unit
        if label in JOINTS:
            unit, sign = found.unit[column], found.sign.get(column, 1)
            if label in names and one.joint is not None:
                field = field.replace(one.joint, "{joint}")
        elif kind in ("gyro", "acc") and label in XYZ:
            unit = units.get(kind)
            field = _axis_field(look, kind)
            sign = look.acc_sign if kind == "acc" else 1
        elif column == "volt":
            unit = units.get("volt")
        elif column in CAMERA and column != "cam_yaw":
            field = _pose_field(field)
        si = COLUMNS[column].unit
        yield column, ChannelSource(topic=one.topic, field=field, unit=None if unit == si else unit, sign=_sign(sign))


def _axis_field(look: LogSignals, kind: str) -> str:
    """Return a field with its axis as ``{axis}``, where the three differ in nothing else."""
    fields = [look.chosen[f"{kind}_{axis}"].field for axis in XYZ]
    for place in range(len(fields[0])):
        template = fields[0][:place] + "{axis}" + fields[0][place + 1 :]
        if [template.replace("{axis}", axis) for axis in XYZ] == fields:
            return template
    return fields[0]


def _pose_field(field: str) -> str:
    """Return a field of a pose with its axis as ``{axis}``, where it is one of a vector."""
    ends = tuple(f"{vector}.{axis}" for vector in ("position", "translation") for axis in XYZ)
    return f"{field[:-1]}{{axis}}" if field.endswith(ends) else field


def _grouped(channels: Mapping[str, ChannelSource]) -> dict[str, ChannelSource]:
    """Return the channels with one entry for those that come from the same place in the same way."""
    left, grouped = dict(channels), {}
    for group, members in GROUPS.items():
        first = left.get(members[0])
        if first is not None and "{" in first.field and all(left.get(name) == first for name in members):
            grouped[group] = first
            left = {name: source for name, source in left.items() if name not in members}
    return grouped | left


def _sign(value: int) -> Any:
    return -1 if value < 0 else 1
