"""One compiled loop replays a batch tick by tick: recorded setpoints arrive at the servos, robots move, readings are taken.

On the engine all of it is one compiled loop that other threads run beside: from Python a tick of 25 robots takes longer
around the engine than in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import njit, typeof, types
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.data.format import CHANNELS
from wlr_gym.gap.problem import Array
from wlr_gym.gap.robot.windows import CLOCK, RunClock
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Plant, PlantState, Sensors, Truth
from wlr_gym.physics.plants.gibbs_appell.plant import CompiledTick, GibbsAppellPlant
from wlr_gym.physics.plants.sensors import measure_rows
from wlr_gym.robot import FIRST_WHEEL, WHEEL_SLICE, WHEELS
from wlr_gym.robot.parameters import Parameters


class Schedule(NamedTuple):
    """Setpoints of runs, and where a batch is in them.

    Attributes:
        times: (rows of all runs, one more of each that never arrives) when setpoints were written, s.
        goals: (the same rows, 8) the setpoints.
        delay: (robots, 8) s; how much later each joint has them.
        rows: (robots, 8) which one each joint has.
        newer, older, wait: (robots, 8) of the present tick: the two setpoints and the time between, s.
    """

    times: Array
    goals: Array
    delay: Array
    rows: NDArray[np.int64]
    newer: Array
    older: Array
    wait: Array


class WrittenSetpoints:
    """Setpoints that arrive at their measured times, each joint's late by its own ``command.delay``."""

    given = True

    def __init__(self, clocks: Sequence[RunClock], run_of: NDArray[np.intp], delay: Array) -> None:
        rows = [len(clock.t) for clock in clocks]
        start = np.concatenate([[0], np.cumsum([n + 1 for n in rows])])[:-1]
        times = np.concatenate([np.append(clock.t - clock.begin, np.inf) for clock in clocks])
        goals = np.concatenate([np.vstack([clock.setpoints, clock.setpoints[-1:]]) for clock in clocks])
        buffers = (np.zeros(delay.shape) for _ in range(3))
        self.schedule: Schedule = Schedule(times, goals, delay, np.repeat(start[run_of][:, None], 8, axis=1), *buffers)
        self._tick = 0

    def reset(self, rows: NDArray[np.intp], state: PlantState, parameters: Parameters) -> None:
        """Nothing: the setpoints are given."""

    def set_delays(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Nothing: the delays are given."""

    def stores(self) -> dict[str, RowStore]:
        """Refuse: the setpoints are those of a recorded run."""
        raise InputError("a plant that follows recorded setpoints cannot be saved and set back")

    def push(self, setpoints: Array) -> tuple[Array, Array, Array]:
        """Return the newer setpoints, the older setpoints and the time between (s) of the present tick; see SetpointHistory.

        The next call overwrites them.
        """
        arrive(self._tick * CLOCK, self.schedule)
        self._tick += 1
        return self.schedule.newer, self.schedule.older, self.schedule.wait


@compiled
def arrive(now: Any, schedule: Any) -> None:
    """Fill the setpoints of the tick that begins at ``now`` (s) and move the rows on to those that have arrived."""
    rows, goals = schedule.rows, schedule.goals
    for i in range(len(rows)):
        for j in range(8):
            schedule.older[i, j] = goals[rows[i, j], j]
            due = schedule.times[rows[i, j] + 1] + schedule.delay[i, j] - now
            schedule.wait[i, j] = 0.0
            if due < CLOCK:
                rows[i, j] += 1
                schedule.wait[i, j] = max(due, 0.0)
            schedule.newer[i, j] = goals[rows[i, j], j]


# ---- what is read ----------------------------------------------------------------------------------------------------

#: Ticks between two stored poses, from which the camera's are interpolated.
POSE_TICKS = 3
#: Truth channels that residuals are mapped over.
TRUTH = (
    "joint_position",
    "joint_velocity",
    "motor_torque",
    "contact_force",
    "slip_velocity",
    "position",
    "quaternion",
    "linear_velocity_in_body",
    "angular_velocity_in_body",
)
#: Channels begin as the sensors do: joint positions and speeds, then what only motors and IMU know; the camera follows.
_MOVED = SENSOR_LAYOUT.slices["joint_velocity"].stop
_READ = SENSOR_LAYOUT.slices["accelerometer"].stop
_SENSED_VOLT = SENSOR_LAYOUT.slices["supply_voltage"].start
_VOLT = CHANNELS.index("volt")
_EFFORTS = slice(CHANNELS.index(f"eff_{WHEELS[0]}"), CHANNELS.index(f"eff_{WHEELS[-1]}") + 1)
_CAMERA = slice(CHANNELS.index("cam_x"), CHANNELS.index("cam_pitch") + 1)
#: The leading columns of the truth layout: position and quaternion.
_POSE = TRUTH_LAYOUT.slices["quaternion"].stop


@dataclass(frozen=True, eq=False)
class Replays:
    """One run under every setting.

    Attributes:
        values: (settings, rows, len(CHANNELS)) what the sensors would have read.
        truth: (settings, rows, columns) of :data:`TRUTH`, or None.
    """

    values: Array
    truth: Array | None = None


class Tape(NamedTuple):
    """What a batch's readings are written into; all runs' rows one after the other, so that compiled code can reach them.

    Attributes:
        recent: (3, robots, len(CHANNELS)) readings of the last three ticks, by tick modulo 3.
        shift: (robots, 4) rad, added to the wheel angles.
        poses: (times, robots, 7) positions and quaternions, every :data:`POSE_TICKS` ticks.
        place: (rows of all runs) when each row is read, in ticks.
        begin: (runs + 1) first row of each run.
        next_row: (runs) the row of each run that is read next.
        anchored: (runs) tick of the last anchor.
        soonest: (robots) s; the soonest that a goal acts after its row.
        values: (settings times rows of all runs, len(CHANNELS)) what was read, run by run, setting by setting.
        truth_columns: columns of the truth that are kept.
        truths: the same as ``values`` of these.
    """

    recent: Array
    shift: Array
    poses: Array
    place: Array
    begin: NDArray[np.int64]
    next_row: NDArray[np.int64]
    anchored: NDArray[np.int64]
    soonest: Array
    values: Array
    truth_columns: NDArray[np.int64]
    truths: Array


class Recorder:
    """Readings at the rows' times, on a straight line through two ticks; poses on a coarser clock, for the camera's delay."""

    def __init__(self, clocks: Sequence[RunClock], settings: int, first: PlantState, delay: Array, with_truth: bool) -> None:
        self.clocks, self.settings, self.with_truth = clocks, settings, with_truth
        count = settings * len(clocks)
        self._wheels = first.joint_position[:, WHEEL_SLICE]
        ticks = max(clock.ticks for clock in clocks) + 2
        rows = [len(clock.t) for clock in clocks]
        every = np.arange(TRUTH_LAYOUT.width)
        columns = np.concatenate([every[TRUTH_LAYOUT.slices[name] if with_truth else slice(0)] for name in TRUTH])
        self.tape: Tape = Tape(
            recent=np.zeros((3, count, len(CHANNELS))),
            shift=np.zeros((count, 4)),
            poses=np.zeros((ticks // POSE_TICKS + 2, count, _POSE)),
            place=np.concatenate([(clock.t - clock.begin) / CLOCK for clock in clocks]),
            begin=np.cumsum([0, *rows]),
            next_row=np.zeros(len(clocks), np.int64),
            anchored=np.full(len(clocks), -1),
            soonest=delay.min(axis=1),
            values=np.zeros((settings * sum(rows), len(CHANNELS))),
            truth_columns=columns,
            truths=np.zeros((settings * sum(rows) if with_truth else 0, len(columns))),
        )
        self.torque: Mapping[int, NDArray[np.bool_]] = _torque_changes(clocks, ticks + POSE_TICKS, settings)

    def start(self, readings: Sensors) -> None:
        """Count the wheel angles from where the robots stand."""
        self.tape.shift[...] = self._wheels - readings.joint_position[:, WHEEL_SLICE]

    def start_anew(self, r: int, tick: int, readings: Sensors, truth: Truth) -> None:
        """Count the wheel angles of one run on after an anchor; what was read before it says nothing about what follows."""
        mine = self._mine(r)
        self.tape.shift[mine] = truth.joint_position[mine, WHEEL_SLICE] - readings.joint_position[mine, WHEEL_SLICE]
        self.tape.anchored[r] = tick

    def missing_efforts(self, r: int, horizon: float) -> Array:
        """Return measured less read efforts of the wheels (settings, 4), N m: means over the last ``horizon`` (s) of a run so
        far, since its last anchor; 0 where none was measured."""
        clock, tape = self.clocks[r], self.tape
        begin, end, last = tape.begin[r], tape.begin[r + 1], int(tape.next_row[r])
        anchor = int(np.searchsorted(tape.place[begin:end], tape.anchored[r]))
        first = max(anchor, int(np.searchsorted(clock.t[:last], clock.t[last] - horizon)))
        read = tape.values[self.settings * begin : self.settings * end].reshape(self.settings, end - begin, -1)
        missing = clock.efforts[first:last, WHEEL_SLICE] - read[:, first:last, _EFFORTS]
        known = np.isfinite(missing)
        return np.where(known, missing, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)

    def _mine(self, r: int) -> slice:
        return slice(r * self.settings, (r + 1) * self.settings)

    def see(self, tick: int, readings: Sensors, truth: Truth) -> None:
        """Take what is read at a tick; every tick must be seen."""
        take(tick, readings.values, truth.values, self.tape)

    def result(self, r: int, parameters: Parameters) -> Replays:
        """What was read of run ``r`` under every setting; ``parameters`` (settings) are its robots'."""
        tape = self.tape
        first, last = tape.begin[r], tape.begin[r + 1]
        mine, shape = slice(self.settings * first, self.settings * last), (self.settings, last - first, -1)
        offset = np.asarray(self.clocks[r].run.meta.marker_offset, np.float64)
        late = tape.place[None, first:last] - parameters["camera.delay"][:, None] / CLOCK
        places = np.maximum(late / POSE_TICKS, 0.0)
        mount, scale = parameters["camera.mount_yaw"], parameters["camera.scale"]
        values = tape.values[mine].reshape(shape)
        _show(tape.poses[:, self._mine(r)], offset, places, mount, scale, values[:, :, _CAMERA])
        return Replays(values, tape.truths[mine].reshape(shape) if self.with_truth else None)


def _torque_changes(clocks: Sequence[RunClock], ticks: int, settings: int) -> dict[int, NDArray[np.bool_]]:
    """At which ticks motors are switched, and which are on from then on (robots, 8); nothing where all are always on."""
    if all(clock.torque_on.all() for clock in clocks):
        return {}
    now = (np.arange(ticks) + 0.5) * CLOCK
    rows = [np.maximum(np.searchsorted(clock.t - clock.begin, now, side="right") - 1, 0) for clock in clocks]
    on = np.stack([clock.torque_on[row] for clock, row in zip(clocks, rows, strict=True)], axis=1)
    changed = np.flatnonzero((on[1:] != on[:-1]).any(axis=(1, 2))) + 1
    return {tick: np.repeat(on[tick], settings, axis=0) for tick in [0, *changed.tolist()]}


@compiled
def take(tick: Any, readings: Any, truth: Any, tape: Any) -> None:
    """Write what is read at a tick (robots, SENSOR_LAYOUT.width) onto a tape; see :class:`Tape`."""
    if tick % POSE_TICKS == 0:
        tape.poses[tick // POSE_TICKS] = truth[:, :_POSE]
    _store(readings, tape.shift, tape.recent[tick % 3])
    runs = len(tape.next_row)
    settings = len(tape.shift) // runs
    for r in range(runs):
        first, rows = tape.begin[r], tape.begin[r + 1] - tape.begin[r]
        while tape.next_row[r] < rows and tape.place[first + tape.next_row[r]] <= tick:
            row = tape.next_row[r]
            _read_row(
                tick, tape.place[first + row], r * settings, settings, settings * first + row, rows, tape.anchored[r], tape
            )
            for i in range(settings if len(tape.truth_columns) else 0):
                for k in range(len(tape.truth_columns)):
                    tape.truths[settings * first + i * rows + row, k] = truth[r * settings + i, tape.truth_columns[k]]
            tape.next_row[r] += 1


@njit(cache=True, nogil=True)
def _store(readings: Any, shift: Any, out: Any) -> None:
    """Copy the readings of a tick (robots, SENSOR_LAYOUT.width) as channels, wheel angles counted from where robots stood.

    Args:
        readings: of all robots.
        shift: (robots, 4) rad, added to the wheel angles.
        out: (robots, len(CHANNELS)), filled but for the camera.
    """
    for i in range(len(out)):
        for c in range(_READ):
            out[i, c] = readings[i, c]
        for k in range(4):
            out[i, FIRST_WHEEL + k] += shift[i, k]
        out[i, _VOLT] = readings[i, _SENSED_VOLT]


@compiled
def _read_row(tick: Any, place: Any, first: Any, settings: Any, out: Any, apart: Any, anchored: Any, tape: Any) -> None:
    """Write one row of a run: readings of this tick, or on a line through the last one and this one.

    A row's own goal acts after its reading: where it would act before this tick, the line is that of the two ticks before.
    What an anchor kept of motors and IMU is the model's before it: there only angles and speeds are on a line.

    Args:
        tick: of the clock.
        place: of the row, in ticks.
        first: of the run's robots.
        settings: how many there are.
        out: where the first setting's row is written; the next one's ``apart`` rows further on.
        apart: rows of the run.
        anchored: tick of the run's last anchor.
        tape: what is written into.
    """
    share = place - (tick - 1)
    here = tick == 0 or share > 1.0 - 1e-9
    only_moved = anchored >= tick - 1
    early = np.inf if only_moved or tick == 1 else (1.0 - share) * CLOCK  # a goal that acts sooner acts before this tick
    for i in range(settings):
        robot = first + i
        now, last, before = tape.recent[tick % 3, robot], tape.recent[(tick - 1) % 3, robot], tape.recent[(tick - 2) % 3, robot]
        row = tape.values[out + i * apart]
        ahead = early < np.inf and tape.soonest[robot] < early
        for c in range(len(row)):
            if here or (only_moved and c >= _MOVED):
                row[c] = now[c]
            elif ahead:
                row[c] = last[c] + share * (last[c] - before[c])
            else:
                row[c] = last[c] + share * (now[c] - last[c])


@njit(cache=True, nogil=True)
def _show(stored: Any, offset: Any, places: Any, mount: Any, scale: Any, out: Any) -> None:
    """Fill what the camera shows of the marker: x, y, heading, z and pitch (settings, rows, 5).

    Args:
        stored: (times, settings, 7) positions and quaternions of the body.
        offset: of the marker in the body frame, m.
        places: (settings, rows) where the rows lie among the times: whole numbers are times.
        mount, scale: (settings) heading of the camera, rad, and its scale.
        out: filled.
    """
    times = len(stored)
    poses = np.zeros((times, 5))
    for i in range(len(out)):
        for k in range(times):
            _pose(stored[k, i], offset, poses[k])
            if k > 0:  # the heading goes on where it was
                turn = poses[k, 2] - poses[k - 1, 2]
                poses[k, 2] -= 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
        cosine, sine = scale[i] * np.cos(mount[i]), scale[i] * np.sin(mount[i])
        for row in range(out.shape[1]):
            before = min(int(places[i, row]), times - 2)
            share = places[i, row] - before
            for c in range(5):
                out[i, row, c] = (1.0 - share) * poses[before, c] + share * poses[before + 1, c]
            x, y = out[i, row, 0], out[i, row, 1]  # from the floor frame into the camera's
            out[i, row, 0], out[i, row, 1] = cosine * x + sine * y, cosine * y - sine * x


@njit(cache=True, nogil=True)
def _pose(stored: Any, offset: Any, out: Any) -> None:
    """x, y, heading, z and pitch (5) of the marker of one body."""
    w, x, y, z = stored[3], stored[4], stored[5], stored[6]
    a, b, c = offset[0], offset[1], offset[2]
    out[0] = stored[0] + (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c
    out[1] = stored[1] + 2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c
    out[3] = stored[2] + 2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c
    out[2] = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    out[4] = np.arcsin(min(max(2 * (w * y - x * z), -1.0), 1.0))


# ---- the loop --------------------------------------------------------------------------------------------------------

#: First tick, last tick, which motors are on.
Follow: TypeAlias = Callable[[int, int, NDArray[np.bool_] | None], None]


def follower(plant: Plant, schedule: Schedule, recorder: Recorder, readings: Sensors) -> Follow:
    """Return what moves a batch from a tick to another and records what is read before each.

    Args:
        plant: the robots; its setpoints are those of ``schedule``.
        schedule: the setpoints.
        recorder: what takes the readings.
        readings: of the plant, which it overwrites.

    Returns:
        Function of first and last tick, and (robots, 8) which motors are on; None = all.
    """
    if not isinstance(plant, GibbsAppellPlant):
        idle = np.zeros((plant.count, 8))

        def step(first: int, last: int, torque_on: NDArray[np.bool_] | None) -> None:
            for tick in range(first, last):
                recorder.see(tick, readings, plant.truth())
                plant.step(idle, torque_on)

        return step
    loop = _loop(*plant.compiled_tick(), schedule, recorder.tape)

    def go(first: int, last: int, torque_on: NDArray[np.bool_] | None) -> None:
        function, batch = plant.compiled_tick()  # fewer robots, where runs are over
        batch.torque_on[...] = 1.0 if torque_on is None else torque_on
        loop(function, batch, schedule, recorder.tape, first, last)

    return go


def _loop(function: Any, batch: CompiledTick, schedule: Schedule, tape: Tape) -> Any:
    """The compiled loop, and the engine's function compiled for its arguments."""
    moved = (batch.lanes, batch.constants, schedule.newer, schedule.older, schedule.wait, batch.torque_on)
    moved = (*moved, batch.formula_values, batch.memory, batch.truth, batch.raw, 0, batch.tiles, batch.robots, batch.step)
    signature = types.void(*(typeof(argument) for argument in (*moved, batch.substeps, batch.sweeps)))
    function.compile(signature.args)
    return _compiled(signature, typeof(batch), typeof(schedule), typeof(tape))


@cache
def _compiled(signature: Any, batch: Any, schedule: Any, tape: Any) -> Any:
    """The loop for arguments of these types: one for all engine functions, which are called by their address.

    numba keeps it with the sensor model compiled in (``measure_rows``), and looks at this file only to tell whether it is old.
    """
    arguments = (types.FunctionType(signature), batch, schedule, tape, types.int64, types.int64)
    return compiled(_ticks, types.void(*arguments))


def _ticks(function: Any, batch: Any, schedule: Any, tape: Any, first: int, last: int) -> None:
    moved = min(batch.tiles * batch.width, batch.robots)
    for tick in range(first, last):
        take(tick, batch.readings, batch.truth, tape)
        arrive(tick * CLOCK, schedule)
        if batch.has_formulas:
            for i in range(batch.robots):
                batch.memory[i // batch.width, 0, i % batch.width] = batch.time[i]
        function(
            batch.lanes,
            batch.constants,
            schedule.newer,
            schedule.older,
            schedule.wait,
            batch.torque_on,
            batch.formula_values,
            batch.memory,
            batch.truth,
            batch.raw,
            0,
            batch.tiles,
            batch.robots,
            batch.step,
            batch.substeps,
            batch.sweeps,
        )
        measure_rows(batch.raw, batch.seeds, batch.ticks, batch.settings, batch.states, batch.readings, 0, moved)
        for i in range(batch.robots):
            batch.time[i] += batch.period
