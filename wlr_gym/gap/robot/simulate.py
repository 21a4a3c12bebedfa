"""Replay several runs under many settings of the model at once: one batch of robots, open loop within windows.

A four-wheeled robot under its own servos forgets where it started within a fraction of a second, with three exceptions. Its
pose and wheel angles are integrals. And the forces with which legs and wheels work against each other are statically
indeterminate: gear friction and tyres hold whatever history left there. So a run is simulated once per setting, from its start
to its end, and at the start of every window the pose, the leg angles and the tension of the wheels' controllers are put where
they were measured. All else (speeds, references, filters) is the simulation's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wlr_gym.gap.robot.windows import WINDOW, window_rows
from wlr_gym.parameters import Parameters
from wlr_gym.plants import make_plant
from wlr_gym.plants.base import PlantOptions, PlantState, Sensors, Truth, standing_state
from wlr_gym.plants.forces import Force
from wlr_gym.plants.sensors import rotation
from wlr_gym.plants.simulator import Simulator
from wlr_gym.robot import LEGS, WHEELS, Robot
from wlr_gym.runs.anchor import (
    CAMERA_WINDOW,
    JOINT_WINDOW,
    euler_angles,
    has_camera,
    local_fit,
    quaternion,
    rest_pose,
    start_state,
    starts_at_rest,
    unwrapped,
)
from wlr_gym.runs.format import CHANNELS, COMMANDS
from wlr_gym.runs.read import Run
from wlr_gym.runs.replay import held_goals, profile_parameters
from wlr_gym.servo import motor_constants

Array = NDArray[np.float64]

#: s; the plant's tick, and its physics step.
CLOCK = 0.004
PHYSICS_STEP = 0.001
#: Simulators that are twice as fast with numbers whose rounding (0.05 sensor noises after windows of 2 s) does not matter here.
PRECISION = {"gibbs_appell": "float32"}
#: s; the robot stands this long before the first row.
LEAD = 0.3
#: Ticks between two stored poses, from which the camera's are interpolated.
POSE_TICKS = 3
#: Robots simulated at once: more need more memory and are no faster.
MOST_ROBOTS = 1024
DIRECT = tuple(name for name in CHANNELS if not name.startswith("cam_"))
CAMERA = tuple(name for name in CHANNELS if name.startswith("cam_"))
#: Of DIRECT, the leading columns of joint positions and speeds.
_MOVED = 16
#: Truth channels that residuals are mapped over.
TRUTH = ("joint_position", "joint_velocity", "motor_torque", "contact_force", "slip_velocity", "position")


@dataclass(frozen=True, eq=False)
class Replays:
    """One run under every setting.

    Attributes:
        values: (settings, rows, len(CHANNELS)) what the sensors would have read.
        truth: (settings, rows, columns) of :data:`TRUTH`, or None.
    """

    values: Array
    truth: Array | None = None


@dataclass(frozen=True, eq=False)
class Anchors:
    """What was measured at the start of each window: values and rates, one row per window.

    Attributes:
        tick: of the plant's clock.
        legs: (W, 4) leg readings, rad.
        effort: (W, 4) wheel efforts, N m; NaN where not measured or the motor is off.
        pose, pose_rate: (W, 3) what the camera shows (x, y, heading), and its rate; NaN where not measured.
    """

    tick: NDArray[np.intp]
    legs: Array
    effort: Array
    pose: Array
    pose_rate: Array


class RunClock:
    """When the goals of one run arrive at the servos, where its rows lie on the plant's clock, and its windows."""

    def __init__(self, run: Run, window: float = WINDOW) -> None:
        self.run = run
        self.windows = window_rows(run["t"], window)
        self.t = run["t"]
        commands = np.stack([run[name] for name in COMMANDS], axis=1)
        self.goals = held_goals(run)
        self.torque_on = np.isfinite(commands)
        self.begin = self.t[0] - (LEAD if starts_at_rest(run) else 0.0)
        self.ticks = int(np.ceil((self.t[-1] - self.begin) / CLOCK)) + 1
        self.anchors = self._anchors([window.start for window in self.windows[1:]])

    def _anchors(self, rows: list[int]) -> Anchors:
        run, times = self.run, self.t[rows]
        legs = [local_fit(self.t, run[f"pos_{joint}"], times, JOINT_WINDOW)[0] for joint in LEGS]
        effort = np.full((4, len(rows)), np.nan)
        for k, wheel in enumerate(WHEELS):
            if np.isfinite(run[f"eff_{wheel}"]).sum() > 2 if f"eff_{wheel}" in run else False:
                effort[k] = local_fit(self.t, run[f"eff_{wheel}"], times, JOINT_WINDOW)[0]
        effort[~self.torque_on[rows, 4:].T] = np.nan
        pose = np.full((2, 3, len(rows)), np.nan)
        if has_camera(run):
            fits = [local_fit(self.t, unwrapped(run[f"cam_{name}"]), times, CAMERA_WINDOW) for name in ("x", "y", "yaw")]
            pose = np.stack(fits, axis=1)
        tick = np.floor((times - self.begin) / CLOCK + 1e-9).astype(int)
        return Anchors(tick, np.transpose(legs), effort.T, pose[0].T, pose[1].T)


class WrittenGoals:
    """Goals that arrive at their measured times, each joint's late by its own ``command.delay``."""

    def __init__(self, clocks: Sequence[RunClock], run_of: NDArray[np.intp], delay: Array) -> None:
        rows = [len(clock.t) for clock in clocks]
        start = np.concatenate([[0], np.cumsum([n + 1 for n in rows])])[:-1]
        self._times = np.concatenate([np.append(clock.t - clock.begin, np.inf) for clock in clocks])
        self._goals = np.concatenate([np.vstack([clock.goals, clock.goals[-1:]]) for clock in clocks])
        self._row = np.repeat(start[run_of][:, None], 8, axis=1)
        self._delay = delay
        self._joint = np.arange(8)[None, :]
        self._tick = 0

    def reset(self, rows: NDArray[np.intp], state: PlantState, parameters: Parameters) -> None:
        """Nothing: the goals are given."""

    def set_delays(self, rows: NDArray[np.intp], parameters: Parameters) -> None:
        """Nothing: the delays are given."""

    def push(self, goals: Array) -> tuple[Array, Array, Array]:
        """Return the newer goals, the older goals and the time between (s) of the present tick; see GoalHistory."""
        now = self._tick * CLOCK
        self._tick += 1
        due = self._times[self._row + 1] + self._delay - now
        arrives = due < CLOCK
        older = self._goals[self._row, self._joint]
        self._row += arrives
        newer = self._goals[self._row, self._joint]
        return newer, older, np.where(arrives, np.maximum(due, 0.0), 0.0)


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
        robot: the robot.
        clocks: the runs.
        parameters: (settings); the servo profile of the runs is already in them.
        backend: the simulator.
        forces: formula forces.
        constants: (settings, constants of all forces one after the other); None = the forces' own.
        with_truth: keep the columns of :data:`TRUTH` too.
        threads: worker threads; the result does not depend on it.
    """
    settings = len(parameters)
    chunk = max(1, MOST_ROBOTS // len(clocks))
    parts = [
        _replay_chunk(
            robot,
            clocks,
            Parameters(parameters.values[k : k + chunk]),
            backend,
            forces,
            None if constants is None or not forces else constants[k : k + chunk],
            with_truth,
            threads,
        )
        for k in range(0, settings, chunk)
    ]
    return [
        Replays(
            np.concatenate([part[r].values for part in parts]),
            np.concatenate([part[r].truth for part in parts]) if with_truth else None,  # type: ignore[arg-type]
        )
        for r in range(len(clocks))
    ]


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
    plant.expect_all_effects()
    if constants is not None:
        plant.set_force_values(np.tile(constants, (runs, 1)))
    delay = lanes["command.delay"].copy()
    lanes["command.delay"] = 0.0
    plant.use_goals(WrittenGoals(clocks, run_of, delay))
    first = _join([_start(clock.run, robot, parameters) for clock in clocks])
    try:
        recorder = _Recorder(clocks, settings, first, delay, with_truth)
        readings = plant.reset(parameters=lanes, state=first)
        recorder.start(readings)
        ticks = POSE_TICKS * -(-max(clock.ticks for clock in clocks) // POSE_TICKS)  # the last pose is stored too
        anchors = _anchors_by_tick(clocks)
        for tick in range(ticks):
            for r, window in anchors.get(tick, ()):
                readings = _anchor(plant, clocks[r], window, run_of == r, lanes, readings)
                recorder.start_anew(r, tick, readings, plant.truth())
            recorder.see(tick, readings, plant.truth())
            readings = plant.step(recorder.idle_goals, recorder.torque_on(tick))
        recorder.see(ticks, readings, plant.truth())
    finally:
        plant.close()
    return [recorder.result(r, Parameters(lanes.values[run_of == r])) for r in range(runs)]


def _anchors_by_tick(clocks: Sequence[RunClock]) -> dict[int, list[tuple[int, int]]]:
    """Which windows of which runs start at which tick."""
    found: dict[int, list[tuple[int, int]]] = {}
    for r, clock in enumerate(clocks):
        for window, tick in enumerate(clock.anchors.tick.tolist()):
            found.setdefault(tick, []).append((r, window))
    return found


def _anchor(
    plant: Simulator, clock: RunClock, window: int, mine: NDArray[np.bool_], lanes: Parameters, readings: Sensors
) -> Sensors:
    """Put one run's robots where they were measured at the start of a window."""
    anchors, state = clock.anchors, plant.get_state()
    legs = anchors.legs[window] - lanes["joint.zero_offset"][mine]
    state.joint_position[mine, :4] = legs
    missing = np.nan_to_num(anchors.effort[window] - readings.joint_effort[mine, 4:])
    state.reference_position[mine, 4:] += missing * _tension_per_effort(plant.robot, lanes, mine)
    if np.isfinite(anchors.pose[window]).all():
        _place(state, clock, window, mine, lanes)
    kept = {name: readings[name][mine].copy() for name in ("joint_effort", "gyro", "accelerometer", "supply_voltage")}
    fresh = plant.reset(state=state, mask=mine)
    for name, values in kept.items():  # a reset has no torque and no acceleration yet
        fresh[name][mine] = values
    return fresh


def _tension_per_effort(robot: Robot, lanes: Parameters, mine: NDArray[np.bool_]) -> Array:
    """Change of a wheel's reference (rad) that changes its reported effort by 1 N m."""
    nominal = robot.servo.supply_voltage
    constant, _ = motor_constants(robot.servo.wheel.stall_torque, robot.servo.wheel.no_load_speed, nominal)
    _, resistance = motor_constants(lanes["servo.stall_torque"][mine, 4:], lanes["servo.no_load_speed"][mine, 4:], nominal)
    return resistance / constant / np.maximum(lanes["servo.kp"][mine, 4:], 1e-9)


def _place(state: PlantState, clock: RunClock, window: int, mine: NDArray[np.bool_], lanes: Parameters) -> None:
    """Move robots to the measured pose: x, y and heading; height, pitch and roll stay."""
    delay = lanes["camera.delay"][mine][:, None]
    x, y, heading = (clock.anchors.pose[window] + clock.anchors.pose_rate[window] * delay).T
    mount, scale = lanes["camera.mount_yaw"][mine], lanes["camera.scale"][mine]
    cosine, sine = np.cos(mount) / scale, np.sin(mount) / scale
    _, pitch, roll = euler_angles(state.quaternion[mine])
    offset = rotation(heading, pitch, roll) @ np.asarray(clock.run.meta.marker_offset)
    state.position[mine, 0] = cosine * x - sine * y - offset[:, 0]
    state.position[mine, 1] = sine * x + cosine * y - offset[:, 1]
    state.quaternion[mine] = quaternion(heading, pitch, roll)


class _Recorder:
    """Readings at the rows' times, on a straight line through two ticks; poses on a coarser clock, for the camera's delay."""

    def __init__(self, clocks: Sequence[RunClock], settings: int, first: PlantState, delay: Array, with_truth: bool) -> None:
        self._soonest = delay.min(axis=1)
        self.clocks, self.settings, self.with_truth = clocks, settings, with_truth
        count = settings * len(clocks)
        self.idle_goals = np.zeros((count, 8))
        self._wheels = first.joint_position[:, 4:]
        self._rows = [np.zeros((settings, len(clock.t), len(DIRECT))) for clock in clocks]
        self._truths = [np.zeros((settings, len(clock.t), 0)) for clock in clocks]
        self._place = [(clock.t - clock.begin) / CLOCK for clock in clocks]
        self._next = [0] * len(clocks)
        ticks = max(clock.ticks for clock in clocks) + 2
        self._poses = np.zeros((ticks // POSE_TICKS + 2, count, len(CAMERA)))
        self._last: Array | None = None
        self._before_last: Array | None = None
        self._anchored = [-1] * len(clocks)
        self._torque = [clock.torque_on for clock in clocks]
        self._always_on = all(on.all() for on in self._torque)
        now = (np.arange(ticks + POSE_TICKS) + 0.5) * CLOCK
        last = [np.searchsorted(clock.t - clock.begin, now, side="right") - 1 for clock in clocks]
        self._torque_row = np.maximum(last, 0).T.tolist()
        self._offsets = np.repeat([clock.run.meta.marker_offset for clock in clocks], settings, axis=0)

    def start(self, readings: Sensors) -> None:
        """Count the wheel angles from where the robots stand."""
        self._shift = self._wheels - readings.joint_position[:, 4:]

    def start_anew(self, r: int, tick: int, readings: Sensors, truth: Truth) -> None:
        """Count the wheel angles of one run on after an anchor; what was read before it says nothing about what follows."""
        mine = slice(r * self.settings, (r + 1) * self.settings)
        self._shift[mine] = truth.joint_position[mine, 4:] - readings.joint_position[mine, 4:]
        self._anchored[r] = tick

    def torque_on(self, tick: int) -> NDArray[np.bool_] | None:
        """Switching the torque is not delayed."""
        if self._always_on:
            return None
        return np.repeat([on[row] for on, row in zip(self._torque, self._torque_row[tick], strict=True)], self.settings, axis=0)

    def see(self, tick: int, readings: Sensors, truth: Truth) -> None:
        if tick % POSE_TICKS == 0:
            self._poses[tick // POSE_TICKS] = _poses(truth, self._offsets)
        wanted = [
            r
            for r, place in enumerate(self._place)
            if self._next[r] < len(place) and tick - 1 <= place[self._next[r]] <= tick + 2
        ]
        if not wanted:
            self._last = self._before_last = None
            return
        present = _direct(readings, self._shift)
        seen = np.concatenate([truth[name] for name in TRUTH], axis=1) if self.with_truth else None
        for r in wanted:
            self._take(r, tick, present, seen)
        self._before_last, self._last = self._last, present

    def _take(self, r: int, tick: int, present: Array, seen: Array | None) -> None:
        place, mine = self._place[r], slice(r * self.settings, (r + 1) * self.settings)
        while self._next[r] < len(place) and place[self._next[r]] <= tick:
            row = self._next[r]
            self._rows[r][:, row] = self._at(place[row] - (tick - 1), r, tick, mine, present)
            if seen is not None:
                if not self._truths[r].shape[2]:
                    self._truths[r] = np.zeros((self.settings, len(place), seen.shape[1]))
                self._truths[r][:, row] = seen[mine]
            self._next[r] += 1

    def _at(self, share: float, r: int, tick: int, mine: slice, present: Array) -> Array:
        """Readings between the last tick and this one.

        A row's own goal acts after its reading: where it would act before this tick, the line is that of the two ticks before.
        """
        if self._last is None or share > 1.0 - 1e-9:
            return present[mine]
        last = self._last[mine]
        between = last + share * (present[mine] - last)
        if self._anchored[r] >= tick - 1:  # what the anchor kept of motors and IMU is the model's before it
            return np.hstack([between[:, :_MOVED], present[mine][:, _MOVED:]])
        if self._before_last is None:
            return between
        in_time = self._soonest[mine] >= (1.0 - share) * CLOCK
        return np.where(in_time[:, None], between, last + share * (last - self._before_last[mine]))

    def result(self, r: int, parameters: Parameters) -> Replays:
        mine = slice(r * self.settings, (r + 1) * self.settings)
        values = np.zeros((*self._rows[r].shape[:2], len(CHANNELS)))
        values[:, :, [CHANNELS.index(name) for name in DIRECT]] = self._rows[r]
        poses = _interpolated(self._poses[:, mine], self._place[r][None, :] - parameters["camera.delay"][:, None] / CLOCK)
        _turn(poses, parameters)
        values[:, :, [CHANNELS.index(name) for name in CAMERA]] = poses
        return Replays(values, self._truths[r] if self.with_truth else None)


def _direct(readings: Sensors, shift: Array) -> Array:
    position = readings.joint_position + np.hstack([np.zeros_like(shift), shift])
    groups = (position, readings.joint_velocity, readings.joint_effort, readings.gyro, readings.accelerometer)
    return np.column_stack([*groups, readings.supply_voltage])


def _poses(truth: Truth, offsets: Array) -> Array:
    yaw, pitch, roll = euler_angles(truth.quaternion)
    marker = truth.position + np.einsum("nij,nj->ni", rotation(yaw, pitch, roll), offsets)
    return np.column_stack([marker[:, 0], marker[:, 1], yaw, marker[:, 2], pitch])


def _interpolated(poses: Array, places: Array) -> Array:
    """Interpolate stored poses (times, settings, 5) at ``places`` (settings, rows) in ticks."""
    poses[:, :, 2] = np.unwrap(poses[:, :, 2], axis=0)
    places = np.maximum(places / POSE_TICKS, 0.0)
    before = np.minimum(places.astype(int), len(poses) - 2)
    share = (places - before)[:, :, None]
    settings = np.arange(poses.shape[1])[:, None]
    return (1 - share) * poses[before, settings] + share * poses[before + 1, settings]


def _turn(poses: Array, parameters: Parameters) -> None:
    """From the floor frame into the camera's, in place."""
    mount, scale = parameters["camera.mount_yaw"][:, None], parameters["camera.scale"][:, None]
    cosine, sine = scale * np.cos(mount), scale * np.sin(mount)
    x, y = poses[:, :, 0].copy(), poses[:, :, 1].copy()
    poses[:, :, 0], poses[:, :, 1] = cosine * x + sine * y, cosine * y - sine * x


def _start(run: Run, robot: Robot, parameters: Parameters) -> PlantState:
    """State of every setting at the run's start: the measured one, moved by what a setting means for reading and height."""
    base = profile_parameters(Parameters.nominal(robot), run.meta.profile)  # of no setting: results do not depend on company
    parameters = Parameters(np.vstack([base.values, parameters.values]))
    count = len(parameters)
    measured = start_state(run, robot, base)
    state = PlantState(**{name: np.repeat(value, count, axis=0) for name, value in vars(measured).items() if value is not None})
    legs = base["joint.zero_offset"] - parameters["joint.zero_offset"]
    state.joint_position[:, :4] += legs
    state.reference_position[:, :4] += legs
    background = standing_state(robot, parameters)
    height = background.position[:, 2] - background.position[:1, 2]
    moved = rest_pose(parameters, state.joint_position[:, :4]) - rest_pose(parameters, background.joint_position[:, :4])
    state.position[:, 2] = measured.position[0, 2] + height + (moved - moved[:1])[:, 0]
    tension = state.reference_position[:, 4:] - state.joint_position[:, 4:]
    kp = parameters["servo.kp"][:, 4:]
    state.reference_position[:, 4:] = state.joint_position[:, 4:] + tension * base["servo.kp"][:, 4:] / np.maximum(kp, 1e-9)
    return PlantState(**{name: value[1:] for name, value in vars(state).items() if value is not None})


def _join(states: Sequence[PlantState]) -> PlantState:
    known = [name for name, value in vars(states[0]).items() if value is not None]
    return PlantState(**{name: np.concatenate([getattr(state, name) for state in states]) for name in known})
