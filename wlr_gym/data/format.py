"""The measured-run format as data (columns with unit, meaning and sensor noise, the ``meta.yaml`` model), and its checks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.base.settings import SettingsModel
from wlr_gym.base.text import row_words
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot, Vector3
from wlr_gym.robot.parameter_table import XYZ

#: File suffixes a run may have.
SUFFIXES = (".csv", ".parquet")
META_FILE = "meta.yaml"
#: Robot of the runs of a folder, where it is none that ships.
ROBOT_FILE = "robot.yaml"


@dataclass(frozen=True)
class Column:
    """One column of a run.

    Attributes:
        name: as in the file's header.
        group: columns of one kind share it (``pos_leg``, ``gyro``, ``cam_xy``); limits and tables go by group.
        unit: SI unit.
        doc: meaning.
        required: a run without it is refused.
        may_be_nan: single values may be missing by design.
        noisy: carries analogue noise well above its resolution, so that exactly repeated values are suspicious.
    """

    name: str
    group: str
    unit: str
    doc: str
    required: bool = False
    may_be_nan: bool = False
    noisy: bool = False


def _joint_columns(kind: str, unit: tuple[str, str], doc: str, **flags: bool) -> list[Column]:
    """One column per joint; ``unit`` holds the unit for legs and for wheels."""
    legs = [Column(f"{kind}_{leg}", f"{kind}_leg", unit[0], doc, **flags) for leg in LEGS]
    return legs + [Column(f"{kind}_{wheel}", f"{kind}_wheel", unit[1], doc, **flags) for wheel in WHEELS]


_NO_READING, _NO_FRAME = "NaN without a new valid reading", "NaN without a new frame"
_MARKER = "marker's centre (`marker_offset` in meta.yaml; default: the body's origin)"

_TABLE: list[Column] = [
    Column(
        "t", "t", "s", "host clock when the row's sensors were read; strictly increasing, nominally 20 ms apart", required=True
    ),
    *_joint_columns(
        "cmd",
        ("rad", "rad/s"),
        "setpoint sent to the servo in this control step, after the row's sensors were read; NaN = torque off (free-spinning)",
        required=True,
        may_be_nan=True,
    ),
    *_joint_columns(
        "pos", ("rad", "rad"), "encoder; wheels unwrapped, relative to their leg, zero at the run's start", required=True
    ),
    *_joint_columns("vel", ("rad/s", "rad/s"), "the servo's own velocity reading"),
    *_joint_columns(
        "eff",
        ("N m", "N m"),
        "motor torque estimate: current (legs) or load (wheels) times the nominal torque constant at the output shaft, "
        "before gear friction",
    ),
    *[Column(f"gyro_{axis}", "gyro", "rad/s", "angular velocity, body frame", noisy=True) for axis in XYZ],
    *[Column(f"acc_{axis}", "acc", "m/s2", "specific force, body frame (+9.81 on z at rest)", noisy=True) for axis in XYZ],
    *[
        Column(name, "cam_xy", "m", f"vision position of the {_MARKER} in the floor frame; {_NO_FRAME}", may_be_nan=True)
        for name in ("cam_x", "cam_y")
    ],
    Column("cam_yaw", "cam_yaw", "rad", f"vision heading in the floor frame; {_NO_FRAME}", may_be_nan=True),
    Column("cam_z", "cam_z", "m", f"vision height of the {_MARKER}; {_NO_FRAME}", may_be_nan=True),
    Column("cam_pitch", "cam_pitch", "rad", f"vision pitch, nose down positive; {_NO_FRAME}", may_be_nan=True),
    Column("volt", "volt", "V", "supply voltage"),
    Column("cam_age", "cam_age", "s", "age of the last vision pose when the row's sensors were read; live cameras only"),
    *[
        Column(f"flow_{axis}", "flow", "rad/s", f"optical flow along body {axis}, {law}; {_NO_READING}", may_be_nan=True)
        for axis, law in (("x", "v_x/h - w_y"), ("y", "v_y/h + w_x"))
    ],
    Column("flow_quality", "flow_quality", "-", f"surface quality of the flow sensor, 0 to 1; {_NO_READING}", may_be_nan=True),
    Column("flow_age", "flow_age", "s", "time since the interval of the last valid flow reading ended"),
]

#: All columns by name, in the order files are written.
COLUMNS: dict[str, Column] = {column.name: column for column in _TABLE}
REQUIRED = tuple(name for name, column in COLUMNS.items() if column.required)
COMMANDS = tuple(f"cmd_{joint}" for joint in JOINTS)
#: Of an optical-flow sensor, where there is one.
FLOW = ("flow_x", "flow_y", "flow_quality", "flow_age")
#: What the robot measured and a replay predicts: everything but clocks, commands and optical flow.
CHANNELS = tuple(name for name in COLUMNS if name not in ("t", "cam_age", *COMMANDS, *FLOW))
CAMERA = ("cam_x", "cam_y", "cam_yaw", "cam_z", "cam_pitch")
ANGLES_OF_THE_BODY = ("cam_yaw", "cam_pitch")


class Profile(SettingsModel):
    """Servo profile registers: 0 = no profile, step references."""

    wheel_acceleration: float = Field(default=0.0, ge=0)
    leg_velocity: float = Field(default=0.0, ge=0)
    leg_acceleration: float = Field(default=0.0, ge=0)


class RunMeta(SettingsModel):
    """What ``meta.yaml`` says about the runs beside it.

    Attributes:
        robot: path of a robot file (relative to the meta file) or name of a robot.
        robot_hash: fingerprint of the robot in that file when the runs were recorded; None = not noted.
        profile: servo profile, rad/s2 and rad/s.
        ground: what the operator noted about the floor.
        floor: relief and friction of the floor: path of a floor's file (relative to the meta file), name in ``configs/floor/``,
            or its content; None = a plane.
        marker_offset: marker centre in the body frame, m.
        notes: free text.
    """

    robot: str | None = None
    robot_hash: str | None = None
    profile: Profile = Profile()
    ground: str | None = None
    floor: str | dict[str, Any] | None = None
    marker_offset: Vector3 = (0.0, 0.0, 0.0)
    notes: str | None = None

    @property
    def states_profile(self) -> bool:
        """Whether the servo profile was given; where not, it is assumed that there is none."""
        return "profile" in self.model_fields_set

    def content(self) -> dict[str, Any]:
        """Return what a file says of it: all but what was not given."""
        return self.model_dump(mode="json", exclude_none=True, exclude=None if self.states_profile else {"profile"})


# ---- what a run must be (else it is refused) and what is odd about one (reported, not refused) -----------------------

# Rows count from 0, as in the table. Limits on magnitudes sit far outside what the robot can do and far inside what the wrong
# unit gives, and look at medians or quantiles, so that a single bad sample is no "unit mistake".


Array = NDArray[np.float64]
Table = Mapping[str, Array]

#: Nominal time between rows, s.
NOMINAL_PERIOD = 0.02
_GAP = 1.5  # a step of the clock longer than this many usual ones is a gap
_STUCK_ROWS = 25  # half a second of bit-equal readings from a noisy sensor
_CLIPPED_ROWS = 4
_SECTION, _LEAST = 100, 20  # rows that are judged by themselves, for units that change in mid-run, and values in them
_SAME_MOTION = 0.8  # correlation of an angle's turns and its rate's
_SHOWN = 0.05  # rad, rms over windows: a section in which one of the two turns this far shows their ratio
_APART = 3.0  # ratio from which on one of the two has another unit; sound sections have 0.87 to 1.05
_QUICK, _SPREAD = 2.0, 0.05  # of the no-load speed, and rad: steps above are none of the motor's; sound runs reach 0.95
_STILL = 0.02  # rad; windows that turn less show the offset of a gyroscope that nobody calibrated
_OLDEST = 0.25  # s: readings repeated for so long are old ones; for longer, those of a robot at rest
_MOVED = 0.1  # rad or rad/s: a joint that was asked to move this far must show it
_WINDOW = 0.5  # s: long enough for a turn to stand out of the camera's noise
_DEGREES = 180 / math.pi


@dataclass(frozen=True)
class Finding:
    """Something odd that does not stop the work.

    Attributes:
        kind: ``gap``, ``rate``, ``duplicate``, ``constant``, ``clipped`` or ``missing``.
        column: the column it is about.
        rows: the rows where it starts.
        message: what, how often and where, in words.
    """

    kind: str
    column: str
    rows: tuple[int, ...]
    message: str


class _UnitLimit(NamedTuple):
    """``quantile`` of the magnitudes of a group above ``limit`` can only be ``looks_like``; ``rate`` tests time derivatives."""

    group: str
    quantile: float
    limit: float
    looks_like: str
    rate: bool = False


#: Rates of servos, by how much larger they then are: one value does not tell which.
_SERVO_RATE = "degrees per second (57.3 times) or rpm (9.55 times)"

_UNIT_LIMITS = (
    _UnitLimit("cmd_leg", 0.5, 2 * math.pi, "degrees"),
    _UnitLimit("pos_leg", 0.5, 2 * math.pi, "degrees"),
    _UnitLimit("cmd_wheel", 1.0, 25.0, _SERVO_RATE),  # the goal register ends at 1023 x 0.229 rpm = 24.5 rad/s
    _UnitLimit("vel_leg", 0.95, 25.0, _SERVO_RATE),
    _UnitLimit("vel_wheel", 0.95, 25.0, _SERVO_RATE),
    _UnitLimit("gyro", 0.95, 25.0, "degrees per second"),
    _UnitLimit("flow", 0.95, 25.0, "degrees per second"),
    _UnitLimit("cam_xy", 0.8, 5.0, "millimetres", rate=True),
    _UnitLimit("cam_yaw", 0.8, 25.0, "degrees", rate=True),
    _UnitLimit("cam_pitch", 0.9, math.pi / 2, "degrees"),
    _UnitLimit("cam_z", 0.5, 2.0, "millimetres"),
    _UnitLimit("eff_leg", 0.95, 50.0, "mA or mN m"),
    _UnitLimit("eff_wheel", 0.95, 50.0, "mA or mN m"),
    _UnitLimit("volt", 0.5, 100.0, "millivolts"),
)


class ImpossibleError(InputError):
    """A recording that cannot be true; what comes before ``row`` may be."""

    def __init__(self, text: str, row: int) -> None:
        super().__init__(text)
        self.row = row


def check_names(names: Sequence[str], where: str) -> None:
    """Refuse unknown, repeated and missing column names.

    Raises:
        InputError: naming the column, and for an unknown one the nearest valid name.
    """
    unknown = [name for name in names if name not in COLUMNS]
    if unknown:
        raise InputError(f"{where}: unknown column '{unknown[0]}'{nearest(unknown[0], COLUMNS)}; valid: {', '.join(COLUMNS)}")
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise InputError(f"{where}: column '{repeated[0]}' occurs twice")
    missing = [name for name in REQUIRED if name not in names]
    if missing:
        raise InputError(f"{where}: missing required column{'s' if len(missing) > 1 else ''} {', '.join(map(repr, missing))}")


def check_table(table: Table, where: str) -> list[Finding]:
    """Refuse a table that is not a run; return what is odd about one that is.

    Args:
        table: columns by name, each (rows,), float64.
        where: file name for the messages.

    Raises:
        InputError: missing, unknown or unequally long columns, clock not strictly increasing, infinities, missing values
            where there must be one, or a unit mistake; the message names file, row and column.
    """
    check_names(list(table), where)
    _check_values(table, where)
    _check_clock(table["t"], where)
    _check_magnitudes(table, where)
    pairs = [(f"vel_{joint}", f"pos_{joint}") for joint in JOINTS] + [(f"cmd_{wheel}", f"pos_{wheel}") for wheel in WHEELS]
    for rate, angle in [*pairs, ("gyro_z", "cam_yaw"), ("gyro_y", "cam_pitch")]:
        if rate in table and angle in table:
            _check_pair(table, rate, angle, where)
    return [*_gaps(table["t"]), *_missing(table), *_duplicates(table), *_constant(table), *_clipped(table)]


# --- refusals ---------------------------------------------------------------------------------------------------------


def _check_values(table: Table, where: str) -> None:
    rows = len(table["t"])
    for name, values in table.items():
        if np.ndim(values) != 1 or len(values) != rows:
            raise InputError(f"{where}: column '{name}' has shape {np.shape(values)}, 't' has {rows} rows")
    if rows < 2:
        raise InputError(f"{where}: {rows} row{'s' if rows != 1 else ''}; a run has at least 2")
    for name, values in table.items():
        infinite, nan = np.isinf(values), np.isnan(values)
        if infinite.any():
            row = int(np.argmax(infinite))
            text = f"{where}: {row_words(where, row)}, column '{name}': {values[row]:g}; expected a finite number"
            raise ImpossibleError(text, row)
        if nan.any() and COLUMNS[name].required and not COLUMNS[name].may_be_nan:
            place = f"{where}: {row_words(where, int(np.argmax(nan)))}, column '{name}'"
            raise InputError(f"{place}: no value, but this column must have one")


def _check_clock(t: Array, where: str) -> None:
    back = np.diff(t) <= 0
    if back.any():
        row = int(np.argmax(back)) + 1
        raise InputError(
            f"{where}: {row_words(where, row)}, column 't': {t[row]:.6f} s does not come after {t[row - 1]:.6f} s; "
            "t must increase: split the run where a clock was set back, or record it again with a monotonic clock"
        )
    period = float(np.median(np.diff(t)))
    if period > 1.0:
        raise InputError(
            f"{where}: {row_words(where, 1)}, column 't': rows are {period:g} s apart, expected {NOMINAL_PERIOD:g} s; "
            "looks like milliseconds"
        )


def _parts(rows: NDArray[np.intp]) -> list[tuple[int, NDArray[np.intp]]]:
    """Return what of a channel's values, which are in ``rows``, is judged together: all of them, and each section's places.

    With each comes the row up to which the run may be true if they are not: in a section fewer wrong values do not show.
    """
    if not len(rows):
        return []
    edges = np.arange(_SECTION, rows[-1] + 1 - _SECTION // 2, _SECTION)
    parts = np.split(np.arange(len(rows)), np.searchsorted(rows, edges))
    kept = [(int(start), part) for start, part in zip([0, *edges], parts, strict=True) if len(part) >= _LEAST]
    return [(0, np.arange(len(rows))), *((max(start - _SECTION, 0), part) for start, part in kept)]


def _check_magnitudes(table: Table, where: str) -> None:
    for limit in _UNIT_LIMITS:
        for name in (name for name in table if COLUMNS[name].group == limit.group):
            rows = np.flatnonzero(np.isfinite(table[name]))
            values = table[name][rows]
            if limit.rate:
                values, rows = np.diff(values) / np.diff(table["t"][rows]), rows[1:]
            for first, part in _parts(rows):
                if np.quantile(np.abs(values[part]), limit.quantile) > limit.limit:
                    row = int(rows[part[np.argmax(np.abs(values[part]) > limit.limit)]])
                    raise _unit_mistake(where, row, name, table[name][row], limit.looks_like, first)
    if {"acc_x", "acc_y", "acc_z"} <= set(table):
        norm = np.sqrt(table["acc_x"] ** 2 + table["acc_y"] ** 2 + table["acc_z"] ** 2)
        rows = np.flatnonzero(np.isfinite(norm))
        for first, part in _parts(rows):
            typical, row = float(np.median(norm[rows[part]])), int(rows[part[0]])
            if 0 < typical < 2.0 or typical > 50.0:
                looks_like = "multiples of g" if typical < 2.0 else "mm/s2 or cm/s2"
                raise _unit_mistake(where, row, "acc_z", table["acc_z"][row], looks_like, first)


def _unit_mistake(where: str, row: int, name: str, value: float, looks_like: str, first: int = 0) -> ImpossibleError:
    place = f"{where}: {row_words(where, row)}, column '{name}'"
    return ImpossibleError(f"{place}: {value:g}; expected {COLUMNS[name].unit}, looks like {looks_like}", first)


def _check_pair(table: Table, rate: str, angle: str, where: str) -> None:
    """Compare a rate with the turn of its angle: 57 times too much or too little is degrees for radians."""
    rows = np.flatnonzero(np.isfinite(table[angle]) & np.isfinite(table[rate]))
    if len(rows) < 20:
        return
    turned, measured = increments(table["t"][rows], table[angle][rows], table[rate][rows])
    wrong = None
    if not rate.startswith("cmd"):
        still = np.abs(turned) < _STILL
        bias = np.median(measured[still]) if rate.startswith("gyro") and still.sum() >= _LEAST else 0.0
        wrong = _wrong_section(turned, measured - bias, rows[: len(turned)])
    ratio, correlation, _ = _compare(turned, measured)
    if correlation >= _SAME_MOTION and not (wrong and wrong[1]):
        if _DEGREES / 2 < ratio < 2 * _DEGREES:
            row = int(rows[np.argmax(np.abs(table[rate][rows]))])
            looks_like = f"degrees per second ({ratio:.0f} times the rate of '{angle}')"
            raise _unit_mistake(where, row, rate, table[rate][row], looks_like)
        if _DEGREES / 2 < 1 / ratio < 2 * _DEGREES:
            row = int(rows[np.argmax(np.abs(table[angle][rows]))])
            looks_like = f"degrees (it turns {1 / ratio:.0f} times faster than '{rate}')"
            raise _unit_mistake(where, row, angle, table[angle][row], looks_like)
    if wrong:
        row, first, ratio = wrong
        text = f"column '{rate}': from here on {ratio:.3g} times the rate of '{angle}': the unit of one is wrong, or changes"
        raise ImpossibleError(f"{where}: {row_words(where, row)}, {text}", first)


def _wrong_section(turned: Array, measured: Array, rows: NDArray[np.intp]) -> tuple[int, int, float] | None:
    """Return the first row of a section in which an angle and its rate do not go together, and their ratio.

    Between them stands the row up to which they may: 0 where no section before shows that they did.
    """
    agreed = False
    for first, part in _parts(rows)[1:]:
        ratio, correlation, size = _compare(turned[part], measured[part])
        if correlation < _SAME_MOTION or size < _SHOWN:
            continue
        if not 1 / _APART < ratio < _APART:
            return int(rows[part[0]]), first if agreed else 0, ratio
        agreed = True
    return None


def _compare(turned: Array, measured: Array) -> tuple[float, float, float]:
    """Return the ratio of two series of turns, their correlation (0 where one shows none), and the larger rms, rad."""
    energies, product = (float(turned @ turned), float(measured @ measured)), float(turned @ measured)
    if min(energies) == 0.0 or product == 0.0:
        return 1.0, 0.0, 0.0
    return product / energies[0], product / math.sqrt(energies[0] * energies[1]), math.sqrt(max(energies) / len(turned))


def check_speeds(table: Table, robot: Robot, where: str) -> None:
    """Refuse a run with a step that :func:`find_leap` finds: :class:`ImpossibleError` with its row."""
    if leap := find_leap(table, robot):
        raise ImpossibleError(f"{where}: {row_words(where, leap[0])}, {leap[1]}", leap[0])


def find_leap(table: Table, robot: Robot) -> tuple[int, str] | None:
    """Return the first row to which a joint moves as no motor of the robot can, with column and speed in words.

    Two recordings in one, units that change and angles that start anew after a turn show as such steps.
    """
    steps, found = np.diff(table["t"]), []
    steps = np.maximum(steps, np.median(steps))  # times of single rows may be late
    repeated = np.all([np.diff(table[f"pos_{joint}"]) == 0.0 for joint in JOINTS], axis=0)
    since = steps.copy()  # s since a joint was last read anew
    for row in np.flatnonzero(repeated[:-1]):
        since[row + 1] += since[row]
    steps = np.where(since < _OLDEST, since, steps)
    for joint in JOINTS:
        top = (robot.servo.leg if joint in LEGS else robot.servo.wheel).no_load_speed
        moved = np.abs(np.diff(table[f"pos_{joint}"]))
        rows = np.flatnonzero(moved > _QUICK * top * steps + _SPREAD)
        if len(rows):
            speed, times = moved[rows[0]] / steps[rows[0]], f" ({len(rows)} times in the run)" if len(rows) > 1 else ""
            seen = f"column 'pos_{joint}': jumps by {moved[rows[0]]:.3g} rad, at {speed:.3g} rad/s{times}"
            text = f"{seen}; the motor of robot '{robot.name}' reaches {top:.3g} rad/s"
            found.append((int(rows[0]) + 1, f"{text}: two recordings in one, units that change, or another robot (--robot)?"))
    return min(found, default=None)


def increments(t: Array, angle: Array, rate: Array) -> tuple[Array, Array]:
    """Return how far ``angle`` and the integral of ``rate`` went over every window of :data:`_WINDOW` seconds."""
    starts = t[t <= t[-1] - _WINDOW]
    turned, measured = (np.interp(starts + _WINDOW, t, one) - np.interp(starts, t, one) for one in (angle, integral(t, rate)))
    return turned, measured


def integral(t: Array, rate: Array) -> Array:
    """Return the running integral of a rate (T,), by trapezia; 0 at first."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))])


# --- findings ---------------------------------------------------------------------------------------------------------


def _gaps(t: Array) -> Iterable[Finding]:
    steps = np.diff(t)
    period = float(np.median(steps))
    if abs(period / NOMINAL_PERIOD - 1) > 0.1:
        yield Finding("rate", "t", (0,), f"rows are {1e3 * period:.1f} ms apart, nominally {1e3 * NOMINAL_PERIOD:.0f} ms")
    rows = np.flatnonzero(steps > _GAP * period)
    if len(rows):
        lost = int(np.sum(np.round(steps[rows] / period) - 1))
        longest = int(rows[np.argmax(steps[rows])])
        where = f"the longest, after row {longest}, takes {1e3 * steps[longest]:.0f} ms"
        message = f"{len(rows)} gaps, about {lost} rows lost; {where}"
        yield Finding("gap", "t", tuple(map(int, rows)), message)


def _missing(table: Table) -> Iterable[Finding]:
    for name in (name for name in (*CHANNELS, *FLOW) if name in table):
        nan = np.isnan(table[name])
        if nan.all():
            yield Finding("missing", name, (0,), "no values at all")
        elif nan.any() and not COLUMNS[name].may_be_nan:
            rows = np.flatnonzero(nan)
            yield Finding("missing", name, tuple(map(int, rows)), f"{len(rows)} values missing, the first in row {rows[0]}")


def _duplicates(table: Table) -> Iterable[Finding]:
    """Camera frames delivered twice, and rows whose noisy sensors all repeat the row before."""
    camera = [name for name in CAMERA if name in table and np.isfinite(table[name]).any()]
    noisy = [name for name in table if COLUMNS[name].noisy or COLUMNS[name].group.startswith("eff")]
    kinds = (("camera frames", camera), ("rows", noisy if any(COLUMNS[name].noisy for name in noisy) else []))
    for what, names in kinds:
        if not names:
            continue
        values = np.stack([table[name] for name in names], axis=1)
        rows = np.flatnonzero(np.isfinite(values).all(axis=1))
        repeated = rows[1:][(np.diff(values[rows], axis=0) == 0).all(axis=1)]
        if len(repeated) and len(repeated) < len(rows) - 1:  # all equal is a dead channel, reported as such
            message = f"{len(repeated)} duplicate {what}: bit-equal to the one before, the first in row {repeated[0]}"
            yield Finding("duplicate", names[0], tuple(map(int, repeated)), message)


def _constant(table: Table) -> Iterable[Finding]:
    for name in (name for name in CHANNELS if name in table):
        values = table[name][np.isfinite(table[name])]
        if len(values) < 10:
            continue
        if np.ptp(values) == 0 and _should_vary(table, name):
            yield Finding("constant", name, (0,), f"{values[0]:g} {COLUMNS[name].unit} throughout: a dead channel?")
        elif COLUMNS[name].noisy:
            stuck = [(row, length) for row, length in _plateaus(table[name]) if length >= _STUCK_ROWS]
            if stuck:
                row, length = max(stuck, key=lambda plateau: plateau[1])
                message = f"stuck {len(stuck)} times; the longest, from row {row}, for {length} rows at {table[name][row]:g}"
                yield Finding("constant", name, tuple(row for row, _ in stuck), message)


def _should_vary(table: Table, name: str) -> bool:
    """A joint at rest may read the same count throughout; one that was moved may not, and noise never does."""
    kind, _, joint = name.partition("_")
    if joint not in JOINTS or kind == "eff":
        return True
    command, position = table[f"cmd_{joint}"], table[f"pos_{joint}"]
    asked = np.ptp(command[np.isfinite(command)]) if np.isfinite(command).any() else 0.0
    return bool(max(asked, np.ptp(position)) > _MOVED)


def _clipped(table: Table) -> Iterable[Finding]:
    """Readings that pile up, bit-equal, at a channel's extreme; noise alone puts fewer there than next to it."""
    for name in (name for name in table if COLUMNS[name].noisy or COLUMNS[name].group.startswith("eff")):
        values = table[name]
        levels, counts = np.unique(values[np.isfinite(values)], return_counts=True)
        if len(levels) < 10:
            continue
        for end, inner in ((0, 1), (-1, -2)):
            longest = max((length for row, length in _plateaus(values) if values[row] == levels[end]), default=0)
            if longest >= _CLIPPED_ROWS and counts[end] > 2 * counts[inner] and levels[end] != 0.0:
                rows = np.flatnonzero(values == levels[end])
                message = f"{len(rows)} rows clipped at {levels[end]:g} {COLUMNS[name].unit}, the first row {rows[0]}"
                yield Finding("clipped", name, tuple(map(int, rows)), message)


def _plateaus(values: Array) -> list[tuple[int, int]]:
    """Return first row and length of every stretch of bit-equal values."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(values) != 0) + 1, [len(values)]])
    return [(int(start), int(end - start)) for start, end in pairwise(starts)]
