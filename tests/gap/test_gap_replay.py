"""Replays of runs that the engine itself made: what went in must come out."""

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from engine_runs import META, ROBOT, abrupt, free_rear_wheels, nominal, posture_and_turns, record, spaced

from wlr_gym.data import RunMeta
from wlr_gym.data.format import CHANNELS
from wlr_gym.data.sensors import channel_noise
from wlr_gym.gap.estimation import nominal_model
from wlr_gym.gap.robot import replay as simulate
from wlr_gym.gap.robot.problem import RobotProblem
from wlr_gym.gap.robot.replay import TRUTH, WrittenSetpoints, replay_batch
from wlr_gym.gap.robot.windows import CLOCK, RunClock, anchored_residuals
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT
from wlr_gym.robot import JOINTS
from wlr_gym.robot.parameters import Parameters

NOISE = np.array([channel_noise(ROBOT)[name] for name in CHANNELS])
RESISTANCE = {"name": "rolling_resistance", "where": ["wheel_lf", "wheel_lr"], "parameters": {"coefficient": 0.1}}


def measured(run):
    return np.stack([run[name] for name in CHANNELS], axis=1)


def columns(kind, joints):
    return [CHANNELS.index(f"{kind}_{joint}") for joint in joints]


def errors(run, values, clock=None):
    """Residuals (rows, channels) of the first setting, and their RMS (channels), in noise units."""
    found = anchored_residuals(run["t"], measured(run), values, NOISE, (clock or RunClock(run)).windows)[0]
    return found, np.sqrt(np.nanmean(found**2, axis=0))


def worst(run, replays, kinds=("",)):
    """Largest RMS residual of a channel, in noise units."""
    _, rms = errors(run, replays.values)
    return max(rms[k] for k, name in enumerate(CHANNELS) if name.startswith(kinds))


def replayed(run, parameters=None, clock=None, **options):
    return replay_batch(ROBOT, [clock or RunClock(run)], nominal() if parameters is None else parameters, **options)[0]


def same(one, other):
    """Whether two replays agree to the bit."""
    alike = one.truth is other.truth is None or np.array_equal(one.truth, other.truth)
    return np.array_equal(one.values, other.values) and alike


@pytest.fixture(scope="module")
def run():
    return record(posture_and_turns, spaced(4.0))


@pytest.fixture(scope="module")
def other():
    return record(free_rear_wheels, spaced(3.0), [RESISTANCE])


def several(count):
    rng = np.random.default_rng(0)
    table = Parameters(np.repeat(nominal().values, count, axis=0))
    table["body.mass"] *= 1 + 0.05 * rng.standard_normal((count, 1)).reshape(np.shape(table["body.mass"]))
    table["servo.kp"] *= 1 + 0.05 * rng.standard_normal((count, 8))
    table["command.delay"] += 0.003 * np.arange(count)[:, None]
    table["camera.delay"] += 0.004 * np.arange(count)
    return table


def test_own_run_comes_back_exactly(run):
    assert worst(run, replayed(run)) < 0.5


def test_own_run_comes_back_to_sensor_noise():
    noisy = record(posture_and_turns, spaced(4.0), noise=5, tick=0.001)
    _, rms = errors(noisy, replayed(noisy).values)
    assert np.sqrt(np.mean(rms**2)) < 1.25
    assert rms.max() < 2.5


@pytest.mark.slow
def test_model_that_lacks_the_effect_does_not_come_back():
    short = record(posture_and_turns, spaced(3.0), [RESISTANCE])
    assert worst(short, replayed(short, nominal([RESISTANCE]))) < 0.5
    assert worst(short, replayed(short), ("eff_wheel",)) > 3.0


def test_torque_off_is_replayed():
    free = record(free_rear_wheels, spaced(4.0))
    assert worst(free, replayed(free)) < 0.5
    kept_on = record(posture_and_turns, spaced(4.0))
    assert worst(free, replayed(kept_on), ("vel_wheel",)) > 3.0


def test_company_and_order_do_not_change_a_bit(run, other):
    table = several(3)
    clocks = [RunClock(run), RunClock(other)]
    together = replay_batch(ROBOT, clocks, table)
    turned = replay_batch(ROBOT, clocks[::-1], Parameters(table.values[::-1]))
    alone = replay_batch(ROBOT, clocks[1:], Parameters(table.values[2:]))[0]
    assert np.array_equal(together[0].values, turned[1].values[::-1])
    assert np.array_equal(together[1].values, turned[0].values[::-1])
    assert np.array_equal(together[1].values[2:], alone.values)
    assert np.max(np.abs(together[0].values[0] - together[0].values[1]) / NOISE) > 1.0


def test_robots_are_shared_out_evenly_where_a_thread_is_worth_it():
    all_runs = slice(0, 5)
    assert simulate.shared_out(5, 6, 2) == [(slice(0, 5), slice(0, 3)), (slice(0, 5), slice(3, 6))]  # a tile each
    assert simulate.shared_out(1, 5, 2) == [(slice(0, 1), all_runs)]
    assert simulate.shared_out(200, 5, 1) == [(slice(0, 100), all_runs), (slice(100, 200), all_runs)]
    assert simulate.shared_out(220, 5, 3) == [
        (slice(first, last), all_runs) for first, last in ((0, 73), (73, 147), (147, 220))
    ]
    most = simulate.MOST_ROBOTS + 1
    assert simulate.shared_out(3, most, 1) == [(slice(k, k + 1), slice(0, most)) for k in range(3)]


def test_threads_share_the_settings(other, monkeypatch):
    """Each part is replayed in a thread of its own: the kernels let go of Python's lock."""
    threads, whole = set(), simulate._replay_chunk
    both = threading.Barrier(2, timeout=60.0)

    def seen(*arguments):
        both.wait()
        threads.add(threading.get_ident())
        return whole(*arguments)

    monkeypatch.setattr(simulate, "LEAST_ROBOTS", 2)
    monkeypatch.setattr(simulate, "_replay_chunk", seen)
    replay_batch(ROBOT, [RunClock(other)], several(4), threads=2)
    assert len(threads) == 2


def test_the_compiled_loop_does_what_steps_from_python_do(run, other, monkeypatch):
    """Two runs of different length and with other windows, motors that are off for a while, the truth."""
    clocks, table = [RunClock(run, window=0.3), RunClock(other)], several(3)
    compiled = replay_batch(ROBOT, clocks, table, with_truth=True)
    monkeypatch.setattr(simulate, "follower", lambda plant, _, *reading: simulate.stepper(plant, *reading))
    stepped = replay_batch(ROBOT, clocks, table, with_truth=True)
    assert all(map(same, compiled, stepped))
    assert compiled[0].truth is not None


def test_chunks_and_threads_do_not_change_a_bit(other, monkeypatch):
    table, clock = several(4), RunClock(other)
    whole = replay_batch(ROBOT, [clock], table, with_truth=True)[0]
    monkeypatch.setattr(simulate, "LEAST_ROBOTS", 2)
    threaded = replay_batch(ROBOT, [clock], table, threads=2)[0]
    monkeypatch.setattr(simulate, "MOST_ROBOTS", 3)
    assert np.array_equal(whole.values, threaded.values)
    assert same(whole, replay_batch(ROBOT, [clock], table, with_truth=True)[0])


def test_threads_share_the_runs_where_there_are_few_settings(run, other, monkeypatch):
    clocks, table = [RunClock(run, window=0.3), RunClock(other)], several(3)
    whole = replay_batch(ROBOT, clocks, table)
    monkeypatch.setattr(simulate, "LEAST_ROBOTS", 2)
    monkeypatch.setattr(simulate, "TILE", 3)
    assert simulate.shared_out(3, 2, 2) == [(slice(0, 3), slice(0, 1)), (slice(0, 3), slice(1, 2))]
    assert all(map(same, whole, replay_batch(ROBOT, clocks, table, threads=2)))


def test_channels_begin_as_the_sensors_do():
    """The recorder copies by position."""
    kinds = {"joint_position": "pos", "joint_velocity": "vel", "joint_effort": "eff", "gyro": "gyro", "accelerometer": "acc"}
    labels = [f"{short}_{label}" for name, short in kinds.items() for label in SENSOR_LAYOUT.channels[name].labels]
    assert tuple(labels) == CHANNELS[: len(labels)]
    assert list(SENSOR_LAYOUT.channels)[: len(kinds)] == list(kinds)


@pytest.mark.parametrize("threads", [1, 2])
def test_runs_of_different_length_are_each_as_alone(threads):
    """More robots than one thread's tiles; the shorter run comes first, is over first, and its robots are left behind."""
    clocks = [RunClock(record(posture_and_turns, spaced(seconds))) for seconds in (0.4, 0.8)]
    table = Parameters(np.tile(several(4).values, (35, 1)))
    together = replay_batch(ROBOT, clocks, table, with_truth=True, threads=threads)
    for clock, replays in zip(clocks, together, strict=True):
        assert replays.truth is not None
        last = simulate.Replays(replays.values[-20:], replays.truth[-20:])
        assert same(last, replay_batch(ROBOT, [clock], Parameters(table.values[-20:]), with_truth=True)[0])


def test_truth_comes_on_the_rows(run):
    replays = replayed(run, with_truth=True)
    assert replays.truth is not None
    assert replays.truth.shape == (1, len(run["t"]), sum(len(TRUTH_LAYOUT.channels[name].elements) for name in TRUTH))
    speed = replays.truth[0][:, 8 + 4]  # joint_velocity[wheel_lf]
    assert speed == pytest.approx(run["vel_wheel_lf"], abs=0.1)


@pytest.mark.parametrize("offset", [0.00125, 0.00275])
def test_goals_off_the_grid_act_at_their_own_time(offset):
    """Rows between two ticks, the run from a clock of 0.25 ms. Within a physics step a ramp may begin early, no more."""
    fine = record(abrupt, spaced(0.8, offset=offset), tick=0.00025)
    ahead = (replayed(fine).values[0] - measured(fine))[24:38] / META.profile.wheel_acceleration
    assert np.abs(ahead[:, columns("vel", JOINTS[4:])].mean(axis=0)).max() < 0.65 * simulate.PHYSICS_STEP


def test_goal_of_a_row_does_not_show_in_its_own_reading():
    """Sensors are read before setpoints are written, whenever that falls between two ticks."""
    step = RunMeta()
    jumping = record(abrupt, spaced(0.9, offset=0.001), tick=0.00025, meta=step)
    found = replayed(jumping, nominal(meta=step)).values[0]
    jumps = np.flatnonzero(np.diff(jumping["cmd_wheel_lf"]) != 0.0) + 1
    velocity = CHANNELS.index("vel_wheel_lf")
    size = np.abs(np.diff(measured(jumping)[:, velocity])).max()
    assert np.abs((found - measured(jumping))[jumps, velocity]).max() < 0.02 * size


def test_command_delay_is_the_plants_own():
    delayed = record(abrupt, spaced(2.0), command__delay=0.013)
    table = nominal()
    table["command.delay"] = 0.013
    assert worst(delayed, replayed(delayed, table), ("pos", "vel", "eff")) < 1.0
    assert worst(delayed, replayed(delayed), ("vel_wheel",)) > 3.0


def test_camera_delay_turn_and_scale():
    changes: dict[str, Any] = {"camera__delay": 0.06, "camera__mount_yaw": 0.2, "camera__scale": 1.05}
    shown = record(posture_and_turns, spaced(4.0), **changes)
    table = nominal()
    for key, value in changes.items():
        table[key.replace("__", ".")] = value
    assert worst(shown, replayed(shown, table), ("cam",)) < 0.5
    assert worst(shown, replayed(shown), ("cam_x",)) > 1.0


def test_windows_start_where_the_robot_was_measured():
    """A model that drifts: the pose is put back at every window, in what the camera shows of it too."""
    radius = {"name": "wheel_radius_error", "where": ["wheel_lf", "wheel_lr"], "parameters": {"scale": 1.05}}
    drifting = record(posture_and_turns, spaced(6.0), [radius])
    clock = RunClock(drifting)
    replays = replay_batch(ROBOT, [clock], nominal())[0].values[0]
    seen = measured(drifting)
    x, y = CHANNELS.index("cam_x"), CHANNELS.index("cam_y")
    gap = np.hypot(replays[:, x] - seen[:, x], replays[:, y] - seen[:, y])
    assert len(clock.windows) == 3
    for before, window in zip(clock.windows, clock.windows[1:], strict=False):
        drift = gap[before][-5:].max()
        settled = window.start + 5  # frames of the first tenth of a second are older than the window
        assert gap[settled] < 0.4 * drift


def test_standing_legs_are_put_back_within_half_a_count():
    """In a model whose legs give way."""
    stood, soft = record(abrupt, spaced(6.0)), nominal()
    soft["servo.kp"][:, :4] *= 0.3
    off = np.abs(replayed(stood, soft).values[0] - measured(stood))[:, columns("pos", JOINTS[:4])]
    for window in RunClock(stood).windows[1:]:
        assert off[window.start - 1].min() > 0.005
        assert off[window.start].max() < 0.51 * ROBOT.sensors.encoder.position


@pytest.mark.parametrize("window", [2.0, 0.3])
def test_a_window_begins_with_the_loads_that_were_measured(window):
    """Standing legs truly stand within a count (1.5 mrad) of their encoders; wheels are driven by jolts, which tell no load."""
    exact, noisy = record(abrupt, spaced(6.0)), record(abrupt, spaced(6.0), noise=5)
    clock = RunClock(noisy, window=window)
    values = replayed(noisy, clock=clock).values
    assert np.abs(values[0] - measured(exact))[:, columns("pos", JOINTS[:4])].max() < 5e-4
    _, rms = errors(noisy, values, clock)
    assert rms[columns("eff", JOINTS[:4])].max() < 1.3
    assert rms[columns("pos", JOINTS[4:])].max() < 1.2


@pytest.mark.parametrize("period", [0.02, 0.1])
def test_a_leg_that_moves_does_not_stand(period):
    """At rows 0.1 s apart, too."""
    clock = RunClock(record(posture_and_turns, spaced(6.0, period)))
    assert clock.anchors.swing.max() > 5 * ROBOT.sensors.encoder.position


def test_a_window_begins_with_the_springs_that_the_efforts_before_it_showed():
    """Wheels that seem to work against each other at the start, and jolt: the mean error of the last second is the springs'."""
    true = record(abrupt, spaced(4.0))
    table = true.table.copy()
    for wheel, push in zip(JOINTS[4:], (0.15, -0.15, -0.15, 0.15), strict=True):
        table.loc[table["t"] <= 0.2, f"eff_{wheel}"] += push
    clock = RunClock(replace(true, table=table))
    error = (replayed(true, clock=clock).values[0] - measured(true))[:, columns("eff", JOINTS[4:])]
    first = clock.windows[1].start
    before, after = (np.abs(error[rows].mean(axis=0)) for rows in (slice(first - 10, first), slice(first, first + 10)))
    assert before.min() > 0.08
    assert after.max() < 0.2 * before.min()


def test_a_run_that_begins_in_motion_is_compared_once_motors_and_imu_read():
    whole = record(posture_and_turns, spaced(4.0))
    moving = replace(whole, table=whole.table.iloc[60:].reset_index(drop=True))
    problem = RobotProblem([whole, moving])
    for r, is_known in ((0, True), (1, False)):
        (found,) = problem.residuals([nominal_model(problem).setting], [r])
        first = {name: bool(np.isfinite(found[0, 0, c])) for c, name in enumerate(CHANNELS)}
        assert first["eff_leg_lf"] is first["gyro_z"] is first["volt"] is is_known
        assert first["pos_leg_lf"]
        assert first["vel_wheel_lf"]
        speeds = found[0, :, columns("vel", JOINTS[4:])]
        assert np.nanmax(np.abs(speeds)) < (1.0 if is_known else 20.0)  # 340 without the back-EMF in the controllers' springs


def test_a_window_does_not_show_the_drift_before_it():
    """Neither its first row nor frames that were exposed before it began."""
    radius = {"name": "wheel_radius_error", "where": ["wheel_lf", "wheel_lr"], "parameters": {"scale": 1.05}}
    drifting = record(posture_and_turns, spaced(6.0), [radius], camera__delay=0.05)
    clock, table = RunClock(drifting), nominal()
    table["camera.delay"] = 0.05
    found, _ = errors(drifting, replayed(drifting, table).values)
    for name in ("cam_x", "cam_yaw"):
        size = np.abs(found[:, CHANNELS.index(name)])
        for window in clock.windows[1:]:
            first, rest = size[window.start : window.start + 6], size[window.start + 6 : window.stop]
            assert not (first > 2 * np.nanmax(rest)).any()


def test_wheels_count_on_after_a_window(run):
    values = replayed(run).values[0]
    jumps = np.diff(values[:, columns("pos", JOINTS[4:])], axis=0) - 0.02 * values[1:, columns("vel", JOINTS[4:])]
    assert np.abs(jumps).max() < 0.05


def test_other_simulator_replays_too():
    short = record(posture_and_turns, spaced(2.5))
    own, others = worst(short, replayed(short)), worst(short, replayed(short, backend="mujoco"), ("vel", "gyro", "cam"))
    assert own < 0.5
    assert others < 12.0


def test_zero_offset_moves_the_reading_not_the_robot(run):
    table = nominal()
    table["joint.zero_offset"] = np.array([0.02, 0.0, 0.0, 0.0])
    moved, plain = replayed(run, table).values[0], replayed(run).values[0]
    leg = CHANNELS.index("pos_leg_lf")
    assert moved[:20, leg] == pytest.approx(plain[:20, leg], abs=0.005)


def test_written_goals_arrive_at_their_times(run):
    clock = RunClock(run)
    delay = np.zeros((2, 8))
    delay[1] = 2.55 * CLOCK
    clock.setpoints[1] += 1.0
    setpoints = WrittenSetpoints([clock], np.array([0, 0]), delay)
    arrived = np.full(2, np.nan)
    for tick in range(round((clock.t[1] - clock.begin) / CLOCK) + 5):
        newer, older, wait = setpoints.push(np.zeros((2, 8)))
        for k in np.flatnonzero((newer != older).any(axis=1) & np.isnan(arrived)):
            assert newer[k] == pytest.approx(clock.setpoints[1])
            assert older[k] == pytest.approx(clock.setpoints[0])
            arrived[k] = tick * CLOCK + wait[k, 0]
    assert arrived == pytest.approx(clock.t[1] - clock.begin + delay[:, 0], abs=1e-9)
