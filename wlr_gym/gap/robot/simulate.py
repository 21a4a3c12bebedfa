"""Replay several runs under many settings of the model at once: one batch of robots, open loop within windows.

A four-wheeled robot under its own servos forgets where it started within a fraction of a second, with three exceptions. Its
pose and wheel angles are integrals. And the forces with which legs and wheels work against each other are statically
indeterminate: gear friction and tyres hold whatever history left there. So a run is simulated once per setting, from its start
to its end, and at the start of every window the pose, the leg angles and the tension of the wheels' controllers are put where
they were measured. All else (speeds, references, filters) is the simulation's own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.jobs import in_threads
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.run_states import euler_angles, quaternion, rest_pose
from wlr_gym.gap.problem import Array
from wlr_gym.gap.robot.replay_loop import POSE_TICKS, Recorder, Replays, WrittenSetpoints, follower
from wlr_gym.gap.robot.windows import CLOCK, Anchors, RunClock
from wlr_gym.physics.plants import drive, ground, make_plant
from wlr_gym.physics.plants.base import PlantOptions, PlantState, Sensors, standing_state
from wlr_gym.physics.plants.forces import Force
from wlr_gym.physics.plants.gibbs_appell.kernel import WIDTH
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.physics.plants.simulator import Simulator
from wlr_gym.physics.servo import reference_per_effort, reference_per_rate
from wlr_gym.robot import LEG_SLICE, WHEEL_SLICE, Robot
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
        robot: the robot.
        clocks: the runs.
        parameters: (settings); the servo profile of the runs is already in them.
        backend: the simulator.
        forces: formula forces.
        constants: (settings, constants of all forces one after the other); None = the forces' own.
        with_truth: keep the columns of :data:`wlr_gym.gap.robot.replay_loop.TRUTH` too.
        threads: worker threads; the result does not depend on it.
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
    return [_joined(of_run[r]) for r in np.argsort(order)]


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


def _joined(parts: Sequence[Replays]) -> Replays:
    """One run's replays under all settings."""
    if len(parts) == 1:
        return parts[0]
    truths = [part.truth for part in parts if part.truth is not None]
    return Replays(np.concatenate([part.values for part in parts]), np.concatenate(truths) if truths else None)


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
        anchors, ends = _anchors_by_tick(clocks), np.array([clock.ticks + POSE_TICKS for clock in clocks])
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


def _anchors_by_tick(clocks: Sequence[RunClock]) -> dict[int, list[tuple[int, int]]]:
    """Which windows of which runs start at which tick."""
    found: dict[int, list[tuple[int, int]]] = {}
    for r, clock in enumerate(clocks):
        for window, tick in enumerate(clock.anchors.tick.tolist()):
            found.setdefault(tick, []).append((r, window))
    return found


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
        _place(state, clock, window, mine, lanes)
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


def _start(clock: RunClock, robot: Robot, parameters: Parameters) -> PlantState:
    """State of every setting at the run's start: the measured one, moved by what a setting means for reading and height."""
    # of no setting: results do not depend on company
    base = profile_parameters(Parameters.nominal(robot), clock.run.meta.profile)
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
    return PlantState(**{name: value[1:] for name, value in vars(state).items() if value is not None})
