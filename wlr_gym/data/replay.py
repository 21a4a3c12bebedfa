"""Replay a measured run: write its commands to a plant and compare what the plant's sensors say with what was measured.

Two comparisons per run. *Full run*: from the measured start, open loop, to the end; small errors add up, as in any dead
reckoning. *Segments*: the run is cut into pieces of about a second, each started anew from the measured state, so that
drift does not swamp what is missing in the model. All segments of a run are one batch.

The plant ticks on its own clock (2 ms by default). A setpoint acts from the row it was written in until the next row's, at the
measured times, so jitter and lost control steps are replayed as they happened; simulated channels are interpolated to the rows'
times. Command delays shift the measured times of the setpoints, so a segment starts with the setpoints that were under way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_number
from wlr_gym.base.plots import BLUE, GREY, ORANGE, new_figure, save, tidy
from wlr_gym.data.format import ANGLES_OF_THE_BODY, CHANNELS, COLUMNS, COMMANDS, Profile
from wlr_gym.data.run_states import euler_angles, measured_state, start_state, starts_at_rest
from wlr_gym.data.runs import Run, Simulation, floor_of, robot_of, simulation_path
from wlr_gym.data.sensors import channel_noise, channels, sensed_columns
from wlr_gym.physics.effects import Patch, Source, apply_patch, load_patch
from wlr_gym.physics.floor import FloorSource, lay_floor
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import Plant, PlantOptions, PlantState, Sensors, Truth, settle
from wlr_gym.physics.plants.sensors import rotation
from wlr_gym.robot import LEG_SLICE, LEGS, WHEEL_SLICE, WHEELS, Robot
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

#: s; the plant's tick in a replay: the setpoints' times are kept to half of it.
CLOCK = 0.002
#: s; a segment, and a run that starts at rest, is simulated this long before it is compared: until the bounce of being set
#: down has died out.
LEAD = 0.1


@dataclass(frozen=True)
class ChannelError:
    """How far a replay is from one measured channel.

    Attributes:
        segment_rms, full_run_rms: root mean square error over the rows compared, in ``unit``.
        unit: SI unit.
        noise: one sigma of the sensor, quantisation included, in ``unit``.
    """

    segment_rms: float
    full_run_rms: float
    unit: str
    noise: float

    def as_dict(self) -> dict[str, float | str]:
        """Return the fields, and both errors in units of the sensor's noise."""
        return {
            **vars(self),
            "segment_in_noise_units": self.segment_rms / self.noise,
            "full_run_in_noise_units": self.full_run_rms / self.noise,
        }


@dataclass(frozen=True, eq=False)
class ReplayResult:
    """A run beside its replay. Arrays have one value per row of the run.

    Attributes:
        run: the measured run.
        full: simulated channels of the replay from start to end.
        segments: simulated channels of the re-anchored replay; NaN in the first rows, before the first lead is over.
        starts: rows at which the segments were anchored.
        errors: per channel.
        robot, clock, physics_step: what it was replayed with.
    """

    run: Run
    full: Mapping[str, Array]
    segments: Mapping[str, Array]
    starts: tuple[int, ...]
    errors: Mapping[str, ChannelError]
    robot: Robot
    clock: float
    physics_step: float


def profile_parameters(parameters: Parameters, profile: Profile) -> Parameters:
    """Return ``parameters`` with the servo profile of a run."""
    result = parameters.copy()
    result["servo.profile_velocity"][:, LEG_SLICE] = profile.leg_velocity
    result["servo.profile_acceleration"][:, LEG_SLICE] = profile.leg_acceleration
    result["servo.profile_acceleration"][:, WHEEL_SLICE] = profile.wheel_acceleration
    return result


def replay(
    run: Run,
    backend: str = "gibbs_appell",
    robot: Robot | str | Path | None = None,
    parameters: Parameters | None = None,
    effects: Source = None,
    segment: float = 1.0,
    clock: float = CLOCK,
    physics_step: float = 0.001,
    floor: FloorSource = None,
) -> ReplayResult:
    """Replay one run and compare.

    Args:
        run: the run, with its meta data.
        backend: a simulator of :data:`wlr_gym.physics.plants.BACKENDS`.
        robot: None = the one the run's meta data name.
        parameters: (1) physical parameters; None = nominal. The run's servo profile is written into them.
        effects: patch to add: to the parameters, and formulas to the plant.
        segment: s between anchors.
        clock: s per tick of the plant.
        physics_step: s per physics step.
        floor: as ``floor=`` of an environment; None = the one that the run's meta data say.

    Raises:
        InputError: unknown backend, robot, floor or effect, a segment shorter than its lead, a run shorter than half a segment.
    """
    patch = load_patch(effects)
    robot, parameters = prepare(run, robot, parameters, patch, segment, floor)
    t = run["t"]
    starts = segment_starts(t, segment)
    options = PlantOptions(control_period=clock, physics_step=physics_step, sensor_noise=False)

    first = start_state(run, robot, parameters)
    begin = t[:1] - (LEAD if starts_at_rest(run) else 0.0)
    plant = make_plant(backend, robot, 1, options, patch.forces)
    full, passed = _simulate(run, plant, parameters, first, begin, t[-1] - begin[0], t[starts])
    many = Parameters(np.repeat(parameters.values, len(starts), axis=0))
    anchors = measured_state(run, t[starts], passed, many)
    settle(robot, many, anchors)
    ends = np.append(t[starts[1:]] + LEAD, t[-1])
    duration = float(np.max(ends - t[starts]))
    plant = make_plant(backend, robot, len(starts), options, patch.forces)
    pieces, _ = _simulate(run, plant, many, anchors, t[starts], duration)
    full_rows = {name: full.at(0, name, t) for name in CHANNELS if name in run}
    segment_rows = {name: np.full(len(t), np.nan) for name in full_rows}
    for k, start in enumerate(starts):  # each from its lead on, until the lead of the next is over
        rows = np.flatnonzero((t > t[start] + LEAD) & (t <= ends[k]))
        for name, values in segment_rows.items():
            values[rows] = pieces.at(k, name, t[rows])
    errors = channel_errors(run, full_rows, segment_rows, channel_noise(robot))
    return ReplayResult(run, full_rows, segment_rows, tuple(map(int, starts)), errors, robot, clock, physics_step)


def prepare(
    run: Run,
    robot: Robot | str | Path | None = None,
    parameters: Parameters | None = None,
    effects: Source = None,
    segment: float = 1.0,
    floor: FloorSource = None,
) -> tuple[Robot, Parameters]:
    """Check what :func:`replay` is given, without simulating; return the robot and its patched parameters on the floor."""
    check_number("segment", segment, "s", above=LEAD)
    robot = robot_of(run, robot)
    parameters = Parameters.nominal(robot) if parameters is None else parameters
    parameters = lay_floor(floor_of(run, floor, robot), profile_parameters(parameters, run.meta.profile))
    parameters = apply_patch(load_patch(effects), parameters)
    t = run["t"]
    if t[-1] - t[0] < 0.5 * segment:
        raise InputError(f"{run.path}: {t[-1] - t[0]:.2f} s long: too short for segments of {segment:g} s")
    return robot, parameters


def segment_starts(t: Array, segment: float) -> NDArray[np.intp]:
    """Return the rows nearest to whole multiples of ``segment``; a rest shorter than half of one joins the last."""
    count = max(1, int((t[-1] - t[0]) / segment + 0.5))
    return np.unique(np.searchsorted(t, t[0] + segment * np.arange(count) - 1e-9))


# ---- simulation ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Traces:
    """Simulated channels on the plant's clock: values (ticks + 1, robots, channels), clocks (robots) start at ``begin``."""

    begin: Array
    clock: float
    values: Array
    camera_delay: float

    def at(self, robot: int, name: str, times: Array) -> Array:
        """Return one channel of one robot at the run's ``times``; what the camera shows is ``camera_delay`` old."""
        delay = self.camera_delay if name.startswith("cam_") else 0.0
        ticks = self.begin[robot] + self.clock * np.arange(len(self.values))
        return np.interp(times - delay, ticks, self.values[:, robot, CHANNELS.index(name)])


def _simulate(
    run: Run,
    plant: Plant,
    parameters: Parameters,
    state: PlantState,
    begin: Array,
    duration: float,
    passing: Array | None = None,
) -> tuple[_Traces, PlantState]:
    """Run the batch from ``state`` for ``duration``, robot i with the setpoints from time ``begin[i]`` on.

    Returns:
        The traces, and the states (of robot 0, one per time) at the times ``passing``.
    """
    clock = plant.options.control_period
    ticks = int(np.ceil(duration / clock))
    setpoints, torque_on = tick_setpoints(run, parameters, begin, ticks, clock)
    parameters = parameters.copy()
    parameters["command.delay"] = 0.0  # the setpoints come delayed
    snapshots = np.array([] if passing is None else np.rint((passing - begin[0]) / clock), dtype=int).tolist()
    states: list[PlantState] = []
    wheels = state.joint_position[:, WHEEL_SLICE]
    offset = np.asarray(run.meta.marker_offset)
    values = np.empty((ticks + 1, plant.count, len(CHANNELS)))
    with closing(plant):
        sensors = plant.reset(parameters=parameters, state=replace(state, time=begin - run["t"][0]))
        first_reading = sensors.joint_position[:, WHEEL_SLICE].copy()
        for tick in range(ticks + 1):
            states += [plant.mechanical_state() for _ in range(snapshots.count(tick))]
            values[tick] = readings(sensors, plant.truth(), wheels - first_reading, offset)
            if tick < ticks:
                sensors = plant.step(setpoints[tick], torque_on[tick])
    camera_frame(values, parameters)
    return _Traces(begin, clock, values, float(parameters["camera.delay"][0])), _stacked(states)


def tick_setpoints(run: Run, parameters: Parameters, begin: Array, ticks: int, clock: float) -> tuple[Array, NDArray[np.bool_]]:
    """Setpoints (ticks, robots, 8) and torque switches on the plant's clock: each row's holds until the next row's.

    Setpoints are delayed, switching the torque is not: as in :class:`wlr_gym.physics.plants.simulator.SetpointHistory`.
    """
    commands = np.stack([run[name] for name in COMMANDS], axis=1)
    written = held_setpoints(run)
    now = begin + clock * (np.arange(ticks)[:, None] + 0.5)  # nearest tick, on average neither early nor late

    def row(time: Array) -> NDArray[np.intp]:
        return np.maximum(np.searchsorted(run["t"], time, side="right") - 1, 0)

    torque_on = np.isfinite(commands[row(now)])
    setpoints = np.stack([written[row(now - parameters["command.delay"][:, j]), j] for j in range(8)], axis=2)
    return setpoints, torque_on


def held_setpoints(run: Run) -> Array:
    """Setpoints (rows, 8) that the servos hold: a motor that is off gets no new one, so it keeps the one before.

    Before its first setpoint a joint has that one; a joint without any stays: a leg at its first measured angle, a wheel at
    speed 0.
    """
    import pandas

    commands = pandas.DataFrame({name: run[name] for name in COMMANDS}).ffill().bfill().to_numpy()
    stay = np.zeros(8)
    for joint, leg in enumerate(LEGS):
        angles = run[f"pos_{leg}"]
        stay[joint] = next(iter(angles[np.isfinite(angles)]), 0.0)
    return np.where(np.isnan(commands), stay, commands)


def readings(sensors: Sensors, truth: Truth, wheel_shift: Array, marker_offset: Array) -> Array:
    """One row of every channel (robots, len(CHANNELS)); wheel angles count on from their anchor. Camera: see below."""
    joints = [sensors.joint_position, sensors.joint_velocity, sensors.joint_effort]
    joints[0] = joints[0] + np.hstack([np.zeros_like(wheel_shift), wheel_shift])
    yaw, pitch, roll = euler_angles(truth.quaternion)
    marker = truth.position + rotation(yaw, pitch, roll) @ marker_offset
    camera = [marker[:, 0], marker[:, 1], yaw, marker[:, 2], pitch]
    return np.column_stack([*joints, sensors.gyro, sensors.accelerometer, *camera, sensors.supply_voltage])


def camera_frame(values: Array, parameters: Parameters) -> None:
    """Turn x and y into the camera's floor frame and make yaw continuous, in place.

    The camera channels come from the true pose, not from the plant's own camera: frames of a simulated camera would fall on
    other times than the measured ones.
    """
    x, y, yaw = (CHANNELS.index(name) for name in ("cam_x", "cam_y", "cam_yaw"))
    mount, scale = parameters["camera.mount_yaw"], parameters["camera.scale"]
    cosine, sine = scale * np.cos(mount), scale * np.sin(mount)
    values[:, :, x], values[:, :, y] = (
        cosine * values[:, :, x] + sine * values[:, :, y],
        cosine * values[:, :, y] - sine * values[:, :, x],
    )
    values[:, :, yaw] = np.unwrap(values[:, :, yaw], axis=0)


def _stacked(states: list[PlantState]) -> PlantState:
    if not states:
        return PlantState(*(np.zeros((0, size)) for size in (3, 4, 3, 3, 8, 8, 8, 8)))
    known = [name for name, value in vars(states[0]).items() if value is not None]
    return PlantState(**{name: np.concatenate([getattr(state, name) for state in states]) for name in known})


# ---- comparison ------------------------------------------------------------------------------------------------------


def channel_errors(
    run: Run, full: Mapping[str, Array], segments: Mapping[str, Array], noise: Mapping[str, float]
) -> dict[str, ChannelError]:
    """Return how far both comparisons are from each channel of the run; a channel without a row in common is left out."""
    errors = {}
    for name in full:
        if np.isfinite(run[name] + segments[name]).any():
            gaps = (difference(name, run[name], simulated[name]) for simulated in (segments, full))
            segment, whole = (float(np.sqrt(np.nanmean(gap**2))) for gap in gaps)
            errors[name] = ChannelError(segment, whole, COLUMNS[name].unit, noise[name])
    return errors


def difference(name: str, measured: Array, simulated: Array) -> Array:
    """Return measured minus simulated; angles of the body within half a turn."""
    error = measured - simulated
    return np.angle(np.exp(1j * error)) if name in ANGLES_OF_THE_BODY else error


# ---- row by row: the ghost that a page shows beside the measured robot -----------------------------------------------


#: s around an anchor whose samples are looked at.
_AROUND = 1.0


def replayed_rows(
    run: Run, robot: Robot, parameters: Parameters, backend: str, patch: Patch | None, segment: float
) -> Iterator[tuple[Parameters, Truth, Array]]:
    """Yield parameters (1), truth (1) and the channels :data:`wlr_gym.data.format.CHANNELS` of a replay at each row of the run.

    As in :func:`wlr_gym.data.replay.replay` the plant ticks on a clock of its own, and each row's setpoint acts from that row's
    time on; every ``segment`` s the plant starts anew from the measured state, at once and not as one batch.

    Args:
        run: the run.
        robot, parameters: (1) that it is replayed with, see :func:`wlr_gym.data.replay.prepare`.
        backend: a simulator.
        patch: formulas that act in the plant; None = none.
        segment: s; inf = only the beginning is measured.
    """
    t, offset = run["t"], np.asarray(run.meta.marker_offset)
    ticks = np.rint((t - t[0]) / CLOCK).astype(int)
    setpoints, torque_on = tick_setpoints(run, parameters, t[:1], int(ticks[-1]), CLOCK)
    undelayed = parameters.copy()
    undelayed["command.delay"] = 0.0  # the setpoints come delayed
    state, begin = start_state(run, robot, parameters), 0
    options = PlantOptions(control_period=CLOCK, sensor_noise=False)
    with closing(make_plant(backend, robot, 1, options, patch.forces if patch else ())) as plant:
        sensors = plant.reset(parameters=undelayed, state=replace(state, time=np.zeros(1)))
        shift = state.joint_position[:, WHEEL_SLICE] - sensors.joint_position[:, WHEEL_SLICE]
        for row in range(len(t)):
            for tick in range(ticks[row - 1] if row else 0, ticks[row]):
                sensors = plant.step(setpoints[tick], torque_on[tick])
            if t[row] - t[begin] >= segment:
                begin = row
                first, last = np.searchsorted(t, [t[row] - _AROUND, t[row] + _AROUND])
                near = replace(run, table=run.table.iloc[int(first) : int(last)])
                state = measured_state(near, t[row : row + 1], plant.mechanical_state(), parameters)
                settle(robot, parameters, state)
                sensors = plant.reset(parameters=undelayed, state=replace(state, time=t[row : row + 1] - t[0]))
                shift = state.joint_position[:, WHEEL_SLICE] - sensors.joint_position[:, WHEEL_SLICE]
            truth = plant.truth()
            channels = readings(sensors, truth, shift, offset)[None]
            camera_frame(channels, parameters)
            yield parameters, truth, channels[0, 0]


# ---- a run repeated on a robot: the same comparison ------------------------------------------------------------------


def compare_repeat(measured: Run, repeated: Run, robot: Robot | str | Path | None = None, segment: float = 1.0) -> ReplayResult:
    """Compare a run with a repetition of it, channel by channel, from the first row of both on.

    A robot cannot be put back to where it was at the start of each segment; what drifts in a log of joints and IMU are the
    wheels' angles, and those count anew from each segment's start. Both runs carry sensor noise, so a perfect repetition
    shows 1.4 noise units. Rows beyond the end of the repetition are not compared.

    Args:
        measured: the run whose setpoints were driven again.
        repeated: what was logged then.
        robot: whose sensors' noise; None = the one the run's meta data name.
        segment: s.
    """
    robot, _ = prepare(measured, robot, segment=segment)
    t = measured["t"]
    starts = segment_starts(t, segment)
    own = repeated["t"] - repeated["t"][0]
    full, pieces = {}, {}
    for name in CHANNELS:
        if name not in measured or name not in repeated:
            continue
        known = np.isfinite(repeated[name])
        if not known.any():
            continue
        full[name] = np.interp(t - t[0], own[known], repeated[name][known], right=np.nan)
        full[name][t - t[0] > own[-1]] = np.nan
        pieces[name] = full[name].copy()
        if name in {f"pos_{joint}" for joint in WHEELS}:  # they begin where the measured ones do
            for begin, end in zip(starts, [*starts[1:], len(t)], strict=True):
                pieces[name][begin:end] += measured[name][begin] - full[name][begin]
    errors = channel_errors(measured, full, pieces, channel_noise(robot))
    return ReplayResult(measured, full, pieces, tuple(map(int, starts)), errors, robot, float(np.median(np.diff(own))), 0.0)


# ---- a simulated run once more, from its record, bit for bit ---------------------------------------------------------


def simulated_parameters(run: Run, robot: Robot) -> Parameters:
    """Return the parameters (1 robot) that a simulated run began with.

    Raises:
        InputError: no record beside the run, or a parameter that is unknown or out of bounds.
    """
    parameters = Parameters.nominal(robot)
    _set(parameters, _record_of(run).parameters)
    return parameters


def simulate_again(run: Run, robot: Robot) -> dict[str, Array]:
    """Simulate a run as it was: same plant, start, noise, parameters and setpoints; same bits on the same kind of machine.

    Args:
        run: a run with its record.
        robot: the robot it is of.

    Returns:
        The channels of the robot's sensors, each (rows,).

    Raises:
        InputError: no record beside the run, or one that does not fit the table or the plant.
    """
    rows = [values for _, _, values in simulated_rows(run, robot)]
    return dict(zip(sensed_columns(robot), np.array(rows).T, strict=True))


def simulated_rows(run: Run, robot: Robot) -> Iterator[tuple[Parameters, Truth, Array]]:
    """Yield what :func:`simulate_again` knows at each row of a run: parameters (1), truth (1), readings."""
    record = _record_of(run)
    names = ("control_period", "physics_step", "precision", "sensor_noise")
    options = PlantOptions(**{name: getattr(record, name) for name in names})
    setpoints = np.stack([run[name] for name in COMMANDS], axis=1)
    parameters, columns = simulated_parameters(run, robot), sensed_columns(robot)
    changes = {change.row: change.parameters for change in record.changes}
    try:
        start = PlantState(**{name: np.array([value]) for name, value in record.start.items()})
    except TypeError as error:
        raise InputError(f"{simulation_path(run.path)}: start: {error}") from None
    with closing(make_plant(record.backend, robot, 1, options, load_patch(record.formulas).forces)) as plant:
        sensors = plant.reset(np.array([record.seed], np.uint64), parameters, state=start)
        for row, wanted in enumerate(setpoints):
            yield parameters, plant.truth(), channels(sensors, 0, columns)
            if row in changes:
                _set(parameters, changes[row])
                plant.set_parameters(parameters)
            torque_on = np.isfinite(wanted)
            sensors = plant.step(np.nan_to_num(wanted)[None], None if torque_on.all() else torque_on[None])


def _record_of(run: Run) -> Simulation:
    if run.simulation is None:
        raise InputError(f"{run.path}: no {simulation_path(run.path).name} beside it: not a simulated run, or not a whole one")
    return run.simulation


def _set(parameters: Parameters, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        parameters[name] = value
    parameters.validate()


# ---- plots: measured, full run, segments -----------------------------------------------------------------------------


_JOINTS = [[f"{kind}_{joint}" for joint in joints] for joints in (LEGS, WHEELS) for kind in ("pos", "vel", "eff")]
_BODY = [
    ["gyro_x", "gyro_y", "gyro_z"],
    ["acc_x", "acc_y", "acc_z"],
    ["cam_x", "cam_y", "cam_yaw"],
    ["cam_z", "cam_pitch", "volt"],
]
_CALM = 6.0  # noise units; flat channels are not blown up beyond this


def save_plots(result: ReplayResult, folder: Path) -> list[Path]:
    """Write ``<run>_joints.png`` and ``<run>_body.png``, where there is something to show, and return their paths."""
    paths = []
    for part, names in (("joints", _JOINTS), ("body", _BODY)):
        grid = [row for row in names if any(name in result.errors for name in row)]
        if grid:
            figure = _figure(result, grid, f"{result.run.name}: {part}, measured and replayed")
            paths.append(save(figure, folder / f"{result.run.name}_{part}.png"))
    return paths


def _figure(result: ReplayResult, grid: list[list[str]], title: str) -> Figure:
    figure = new_figure(5.2 * len(grid[0]), 2.1 * len(grid) + 0.9)
    panels = figure.subplots(len(grid), len(grid[0]), squeeze=False, sharex=True)
    for axes, name in zip(panels.flat, (name for row in grid for name in row), strict=True):
        if name in result.errors:
            _draw(axes, result, name)
        else:
            axes.set_axis_off()
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    handles, labels = next(axes for axes in panels.flat if axes.has_data()).get_legend_handles_labels()
    figure.suptitle(title, fontsize=13)
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    return figure


def _draw(axes: Axes, result: ReplayResult, name: str) -> None:
    run, error = result.run, result.errors[name]
    t = run["t"]
    known = np.isfinite(run[name])
    style: dict[str, Any] = (
        {"marker": ".", "markersize": 2.5, "linestyle": ""} if COLUMNS[name].may_be_nan else {"linewidth": 2.2}
    )
    axes.plot(t[known], run[name][known], color=GREY, label="measured", **style)
    axes.plot(t, result.full[name], color=ORANGE, linewidth=0.9, label="full run")
    pieces = result.segments[name].copy()
    pieces[list(result.starts)] = np.nan  # lift the pen between segments
    axes.plot(t, pieces, color=BLUE, linewidth=0.9, label="segments")
    low, high = axes.get_ylim()
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    if half < _CALM * error.noise:
        axes.set_ylim(middle - _CALM * error.noise, middle + _CALM * error.noise)
    ratio = error.segment_rms / error.noise
    axes.set_title(f"{name}: segment error {error.segment_rms:.2g} {error.unit} = {ratio:.1f} x noise", fontsize=9)
    axes.set_ylabel(error.unit)
    tidy(axes)
    axes.margins(x=0.01)
