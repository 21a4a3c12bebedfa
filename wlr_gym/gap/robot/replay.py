"""Replay several runs under many settings of the model at once: one batch of robots, open loop within windows.

A four-wheeled robot under its own servos forgets where it started within a fraction of a second, with three exceptions. Its
pose and wheel angles are integrals. And the forces with which legs and wheels work against each other are statically
indeterminate: gear friction and tyres hold whatever history left there. So a run is simulated once per setting, from its start
to its end, and at the start of every window the pose, the leg angles and the tension of the wheels' controllers are put where
they were measured. All else (speeds, references, filters) is the simulation's own.

On the engine, the setpoints that arrive, the robots that move and the readings that are taken are one compiled loop that other
threads run beside: from Python a tick of 25 robots takes longer around the engine than in it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import typeof, types
from numpy.typing import NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import in_threads
from wlr_gym.base.snapshot import RowStore
from wlr_gym.data.format import CHANNELS
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.run_states import euler_angles, quaternion, rest_pose
from wlr_gym.data.runs import floor_of
from wlr_gym.gap.problem import Array
from wlr_gym.gap.robot.windows import CLOCK, Anchors, RunClock
from wlr_gym.physics.floor import lay_floor
from wlr_gym.physics.plants import drive, ground, make_plant
from wlr_gym.physics.plants.base import (
    SENSOR_LAYOUT,
    TRUTH_LAYOUT,
    Plant,
    PlantOptions,
    PlantState,
    Sensors,
    Truth,
    settle,
    standing_state,
)
from wlr_gym.physics.plants.forces import Force
from wlr_gym.physics.plants.gibbs_appell.kernel import WIDTH
from wlr_gym.physics.plants.gibbs_appell.plant import CompiledTick, GibbsAppellPlant
from wlr_gym.physics.plants.sensors import measure_rows, rotation
from wlr_gym.physics.plants.simulator import Simulator
from wlr_gym.physics.servo import reference_per_effort, reference_per_rate
from wlr_gym.robot import FIRST_WHEEL, LEG_SLICE, WHEEL_SLICE, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters

#: s; of the plant.
PHYSICS_STEP = 0.001
#: Simulators that are twice as fast with numbers whose rounding (0.05 sensor noises after windows of 2 s) does not matter here.
PRECISION = {"gibbs_appell": "float32"}
#: Passes over the friction rows per substep of the engine: twice as many move readings by 0.02 sensor noises (rms).
SWEEPS = 2
#: Counts of its encoder within which a leg stands.
STANDS = 1.5
#: s before an anchor, over which efforts of wheels are compared: what the spring of a controller holds is read off no jolt.
SPRING = 1.0
#: Robots simulated at once: what they read stays in the processor's cache.
MOST_ROBOTS = 512
#: Robots of a tile of the engine in single precision.
TILE = WIDTH["float32"]
#: Robots that a further thread is worth.
LEAST_ROBOTS = 12
#: Kernels that replay all robots, the faster first: each further one would be compiled, for longer than it saves.
KERNELS = ("without effects", "tyres and gears that yield", "all effects")


def replay_batch(
    robot: Robot,
    clocks: Sequence[RunClock],
    parameters: Parameters,
    backend: str = "gibbs_appell",
    forces: Sequence[Force] = (),
    constants: Array | None = None,
    with_truth: bool = False,
    threads: int = 1,
) -> list[Replays]:
    """Replay every run under every row of ``parameters``.

    Args:
        robot, clocks: the robot and the runs.
        parameters: (settings); the servo profile of the runs is already in them.
        backend, threads: the simulator, and worker threads; the result does not depend on these.
        forces: formula forces.
        constants: (settings, constants of all forces one after the other); None = the forces' own.
        with_truth: keep the columns of :data:`TRUTH` too.
    """
    order = sorted(range(len(clocks)), key=lambda r: -clocks[r].ticks)  # a run that is over need not be simulated any further
    longest_first = [clocks[r] for r in order]
    workers = threads if backend in PRECISION else 1  # others have threads of their own

    def replay_part(part: tuple[slice, slice]) -> list[Replays]:
        some, which = part
        own = None if constants is None or not forces else constants[some]
        chosen, followed = Parameters(parameters.values[some]), longest_first[which]
        return _replay_chunk(robot, followed, chosen, backend, forces, own, with_truth, 1 if workers > 1 else threads)

    parts = shared_out(len(parameters), len(clocks), workers)
    found = in_threads(workers, replay_part, parts)
    of_run: list[list[Replays]] = [[] for _ in clocks]
    for (_, which), replays in zip(parts, found, strict=True):
        for own, replay in zip(of_run[which], replays, strict=True):
            own.append(replay)
    joined = []
    for own in (of_run[r] for r in np.argsort(order)):
        if len(own) > 1:
            truths = [part.truth for part in own if part.truth is not None]
            own = [Replays(np.concatenate([part.values for part in own]), np.concatenate(truths) if truths else None)]
        joined += own
    return joined


def shared_out(settings: int, runs: int, workers: int) -> list[tuple[slice, slice]]:
    """Return which settings of which runs are replayed together: equal parts, at most :data:`MOST_ROBOTS` robots.

    Less than a tile of robots costs as much as a tile: few are not shared out, and runs are where that needs fewer tiles.
    """
    busy = max(1, min(workers, settings * runs // LEAST_ROBOTS))
    each = max(1, MOST_ROBOTS // runs)
    parts = busy * max(1, math.ceil(settings / (busy * each)))
    by_settings = [(part, slice(0, runs)) for part in _even(settings, parts)]
    by_runs = [(slice(0, settings), part) for part in _even(runs, busy)]
    return by_runs if parts == busy and _most_tiles(by_runs) < _most_tiles(by_settings) else by_settings


def _even(count: int, parts: int) -> list[slice]:
    edges = np.linspace(0, count, min(parts, count) + 1).round().astype(int)
    return [slice(first, last) for first, last in itertools.pairwise(edges.tolist())]


def _most_tiles(parts: Sequence[tuple[slice, slice]]) -> int:
    return max(math.ceil((some.stop - some.start) * (which.stop - which.start) / TILE) for some, which in parts)


def kernel_of(parameters: Parameters) -> str:
    """Return the leanest of :data:`KERNELS` that knows all effects of a batch."""
    found = drive.families(parameters) | ground.families(parameters)
    return KERNELS[0] if not found else KERNELS[1] if found == {"compliance"} else KERNELS[-1]


def _replay_chunk(
    robot: Robot,
    clocks: Sequence[RunClock],
    parameters: Parameters,
    backend: str,
    forces: Sequence[Force],
    constants: Array | None,
    with_truth: bool,
    threads: int,
) -> list[Replays]:
    settings, runs = len(parameters), len(clocks)
    run_of = np.repeat(np.arange(runs), settings)  # robots of one run lie side by side
    lanes = Parameters(np.tile(parameters.values, (runs, 1)))
    options = PlantOptions(CLOCK, PHYSICS_STEP, PRECISION.get(backend, "float64"), threads, sensor_noise=False)
    plant = make_plant(backend, robot, len(lanes), options, tuple(forces))
    assert isinstance(plant, Simulator)
    if isinstance(plant, GibbsAppellPlant):
        plant.sweeps = SWEEPS
    if forces or kernel_of(lanes) == KERNELS[-1]:
        plant.expect_all_effects()
    if constants is not None:
        plant.set_force_values(np.tile(constants, (runs, 1)))
    delay = lanes["command.delay"].copy()
    lanes["command.delay"] = 0.0
    setpoints = WrittenSetpoints(clocks, run_of, delay)
    plant.use_setpoints(setpoints)
    states = [_start(clock, robot, parameters) for clock in clocks]
    known = [name for name, value in vars(states[0]).items() if value is not None]
    first = PlantState(**{name: np.concatenate([getattr(state, name) for state in states]) for name in known})
    try:
        recorder = Recorder(clocks, settings, first, delay, with_truth)
        readings = plant.reset(parameters=lanes, state=first)
        recorder.start(readings)
        follow = follower(plant, setpoints.schedule, recorder, readings)
        last = POSE_TICKS * -(-max(clock.ticks for clock in clocks) // POSE_TICKS)  # the last pose is stored too
        ends = np.array([clock.ticks + POSE_TICKS for clock in clocks])
        anchors: dict[int, list[tuple[int, int]]] = {}  # tick -> which windows of which runs start there
        for r, clock in enumerate(clocks):
            for window, tick in enumerate(clock.anchors.tick.tolist()):
                anchors.setdefault(tick, []).append((r, window))
        torque_on: NDArray[np.bool_] | None = None
        stops = sorted({0, last, *(t for t in (*anchors, *recorder.torque, *ends.tolist()) if t < last)})
        for tick, until in itertools.pairwise(stops):
            if tick in ends:
                plant.keep_going(settings * int((ends > tick).sum()))
            for r, window in anchors.get(tick, ()):
                missing = recorder.missing_efforts(r, SPRING)
                readings = _anchor(plant, clocks[r], window, run_of == r, lanes, readings, missing)
                recorder.start_anew(r, tick, readings, plant.truth())
            torque_on = recorder.torque.get(tick, torque_on)
            follow(tick, until, torque_on)
        recorder.see(last, readings, plant.truth())
    finally:
        plant.close()
    return [recorder.result(r, Parameters(lanes.values[run_of == r])) for r in range(runs)]


def _anchor(
    plant: Simulator,
    clock: RunClock,
    window: int,
    mine: NDArray[np.bool_],
    lanes: Parameters,
    readings: Sensors,
    missing: Array,
) -> Sensors:
    """Put one run's robots where they were measured at the start of a window; legs that move stay where they are.

    The controllers of their wheels get the efforts (N, 4) that are ``missing``.
    """
    robot, anchors, state = plant.robot, clock.anchors, _standing_where_lost(plant, lanes)
    own = Parameters(lanes.values[mine])
    legs, references = state.joint_position[mine, LEG_SLICE], state.reference_position[mine]
    state.joint_position[mine, LEG_SLICE] = _standing_legs(robot, own, anchors, window, legs, references)
    state.reference_position[mine, WHEEL_SLICE] += missing * reference_per_effort(robot, own)[:, WHEEL_SLICE]
    if np.isfinite(anchors.pose[window]).all():
        _place(robot, state, clock, window, mine, lanes)
    kept = {name: readings[name][mine].copy() for name in ("joint_effort", "gyro", "accelerometer", "supply_voltage")}
    fresh = plant.reset(state=state, mask=mine)
    for name, values in kept.items():  # a reset has no torque and no acceleration yet
        fresh[name][mine] = values
    return fresh


def _standing_where_lost(plant: Simulator, lanes: Parameters) -> PlantState:
    """The state of all robots; those whose simulation broke down stand still, and what was recorded of them is not finite."""
    state = plant.mechanical_state()
    parts = {name: value for name, value in vars(state).items() if value is not None}
    lost = ~np.all([np.isfinite(value).reshape(len(lanes), -1).all(axis=1) for value in parts.values()], axis=0)
    if lost.any():
        standing = standing_state(plant.robot, lanes)
        for name, value in parts.items():
            instead = getattr(standing, name)
            value[lost] = 0.0 if instead is None else instead[lost]
    return state


def _standing_legs(robot: Robot, parameters: Parameters, anchors: Anchors, row: int, legs: Array, references: Array) -> Array:
    """Angles (N, 4) at an anchor: of legs that stand what their encoders and efforts say, of others ``legs``.

    A leg that has come to rest stands where dry friction just holds it. A count of its encoder is several sigma of its effort:
    put in the middle of the count, it would carry another load, or slide on. One that moves follows its servo.
    """
    reading = anchors.legs[row] - parameters["joint.zero_offset"]
    pull = anchors.effort[row] * reference_per_effort(robot, parameters)[:, LEG_SLICE]
    half = 0.5 * robot.sensors.encoder.position
    held = np.clip(references[:, LEG_SLICE] - pull, reading - half, reading + half)
    stands = anchors.swing[row] <= STANDS * robot.sensors.encoder.position
    return np.where(stands, np.where(np.isfinite(held), held, reading), legs)


def _place(robot: Robot, state: PlantState, clock: RunClock, window: int, mine: NDArray[np.bool_], lanes: Parameters) -> None:
    """Move robots to the measured pose: x, y and heading; height, pitch and roll stay, but on relief are those of the place."""
    delay = lanes["camera.delay"][mine][:, None]
    x, y, heading = (clock.anchors.pose[window] + clock.anchors.pose_rate[window] * delay).T
    mount, scale = lanes["camera.mount_yaw"][mine], lanes["camera.scale"][mine]
    cosine, sine = np.cos(mount) / scale, np.sin(mount) / scale
    _, pitch, roll = euler_angles(state.quaternion[mine])
    offset = rotation(heading, pitch, roll) @ np.asarray(clock.run.meta.marker_offset)
    state.position[mine, 0] = cosine * x - sine * y - offset[:, 0]
    state.position[mine, 1] = sine * x + cosine * y - offset[:, 1]
    state.quaternion[mine] = quaternion(heading, pitch, roll)
    placed = PlantState(**{name: value[mine] for name, value in vars(state).items() if value is not None})
    settle(robot, Parameters(lanes.values[mine]), placed)
    state.position[mine], state.quaternion[mine] = placed.position, placed.quaternion


def _start(clock: RunClock, robot: Robot, parameters: Parameters) -> PlantState:
    """State of every setting at the run's start: the measured one, moved by what a setting means for reading and height."""
    # of no setting: results do not depend on company
    base = lay_floor(floor_of(clock.run), profile_parameters(Parameters.nominal(robot), clock.run.meta.profile))
    parameters = Parameters(np.vstack([base.values, parameters.values]))
    count = len(parameters)
    measured = clock.measured_start(robot, base)
    state = PlantState(**{name: np.repeat(value, count, axis=0) for name, value in vars(measured).items() if value is not None})
    legs = base["joint.zero_offset"] - parameters["joint.zero_offset"]
    state.joint_position[:, LEG_SLICE] += legs
    state.reference_position[:, LEG_SLICE] += legs
    legs, references = state.joint_position[:, LEG_SLICE], state.reference_position
    state.joint_position[:, LEG_SLICE] = _standing_legs(robot, parameters, clock.start, 0, legs, references)
    background = standing_state(robot, parameters)
    height = background.position[:, 2] - background.position[:1, 2]
    bent, level = state.joint_position[:, LEG_SLICE], background.joint_position[:, LEG_SLICE]
    moved = rest_pose(parameters, bent) - rest_pose(parameters, level)
    state.position[:, 2] = measured.position[0, 2] + height + (moved - moved[:1])[:, 0]
    wheels, reference = state.joint_position[:, WHEEL_SLICE], state.reference_position[:, WHEEL_SLICE]
    rates = state.joint_velocity[:, WHEEL_SLICE] if not clock.lead else 0.0
    per_effort, own_effort = (reference_per_effort(robot, each)[:, WHEEL_SLICE] for each in (base, parameters))
    per_rate, own_rate = (reference_per_rate(robot, each)[:, WHEEL_SLICE] for each in (base, parameters))
    reference[...] = wheels + (reference - wheels - per_rate * rates) * own_effort / per_effort + own_rate * rates
    state.time = np.full(count, clock.begin - clock.t[0])
    settle(robot, parameters, state)
    return PlantState(**{name: value[1:] for name, value in vars(state).items() if value is not None})


# ---- setpoints -------------------------------------------------------------------------------------------------------


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
        #: At which ticks motors are switched, and which are on from then on (robots, 8); nothing where all are always on.
        self.torque: dict[int, NDArray[np.bool_]] = {}
        if not all(clock.torque_on.all() for clock in clocks):
            now = (np.arange(ticks + POSE_TICKS) + 0.5) * CLOCK
            times = [np.searchsorted(clock.t - clock.begin, now, side="right") - 1 for clock in clocks]
            on = np.stack([clock.torque_on[np.maximum(r, 0)] for clock, r in zip(clocks, times, strict=True)], axis=1)
            changed = np.flatnonzero((on[1:] != on[:-1]).any(axis=(1, 2))) + 1
            self.torque = {tick: np.repeat(on[tick], settings, axis=0) for tick in [0, *changed.tolist()]}

    def start(self, readings: Sensors) -> None:
        """Count the wheel angles from where the robots stand."""
        self.tape.shift[...] = self._wheels - readings.joint_position[:, WHEEL_SLICE]

    def start_anew(self, r: int, tick: int, readings: Sensors, truth: Truth) -> None:
        """Count the wheel angles of one run on after an anchor; what was read before it says nothing about what follows."""
        mine = slice(r * self.settings, (r + 1) * self.settings)
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

    def see(self, tick: int, readings: Sensors, truth: Truth) -> None:
        """Take what is read at a tick; every tick must be seen."""
        take(tick, readings.values, truth.values, self.tape)

    def result(self, r: int, parameters: Parameters) -> Replays:
        """What was read of run ``r`` under every setting; ``parameters`` (settings) are its robots'."""
        tape = self.tape
        first, last = tape.begin[r], tape.begin[r + 1]
        rows, shape = slice(self.settings * first, self.settings * last), (self.settings, last - first, -1)
        offset = np.asarray(self.clocks[r].run.meta.marker_offset, np.float64)
        late = tape.place[None, first:last] - parameters["camera.delay"][:, None] / CLOCK
        places = np.maximum(late / POSE_TICKS, 0.0)
        mount, scale = parameters["camera.mount_yaw"], parameters["camera.scale"]
        values, mine = tape.values[rows].reshape(shape), slice(r * self.settings, (r + 1) * self.settings)
        _show(tape.poses[:, mine], offset, places, mount, scale, values[:, :, _CAMERA])
        return Replays(values, tape.truths[rows].reshape(shape) if self.with_truth else None)


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


@compiled
def _store(readings: Any, shift: Any, out: Any) -> None:
    """Copy the readings of a tick (robots, SENSOR_LAYOUT.width) as channels but the camera's (robots, len(CHANNELS)).

    Wheel angles are counted from where robots stood: ``shift`` (robots, 4) rad is added.
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
        first, settings: of the run's robots, and how many there are.
        out, apart: where the first setting's row is written; the next one's ``apart`` rows further on.
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


@compiled
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


@compiled
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

#: First tick, last tick, which motors are on (robots, 8); None = all.
Follow: TypeAlias = Callable[[int, int, NDArray[np.bool_] | None], None]


def follower(plant: Plant, schedule: Schedule, recorder: Recorder, readings: Sensors) -> Follow:
    """Return what moves a batch from a tick to another and records what is read before each.

    ``plant`` follows the setpoints of ``schedule`` and overwrites ``readings``.
    """
    if not isinstance(plant, GibbsAppellPlant):
        return stepper(plant, recorder, readings)
    loop = _loop(*plant.compiled_tick(), schedule, recorder.tape)

    def go(first: int, last: int, torque_on: NDArray[np.bool_] | None) -> None:
        function, batch = plant.compiled_tick()  # fewer robots, where runs are over
        batch.torque_on[...] = 1.0 if torque_on is None else torque_on
        loop(function, batch, schedule, recorder.tape, first, last)

    return go


def stepper(plant: Plant, recorder: Recorder, readings: Sensors) -> Follow:
    """Return the same for any plant, step by step from Python."""
    idle = np.zeros((plant.count, 8))

    def go(first: int, last: int, torque_on: NDArray[np.bool_] | None) -> None:
        for tick in range(first, last):
            recorder.see(tick, readings, plant.truth())
            plant.step(idle, torque_on)

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
    """The loop for arguments of these types: one for all engine functions, which are called by their address."""
    arguments = (types.FunctionType(signature), batch, schedule, tape, types.int64, types.int64)
    return compiled(_ticks, signatures=[types.void(*arguments)])


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
