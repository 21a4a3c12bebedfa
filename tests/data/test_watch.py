"""Runs as a page plays them: the measured robot, its ghost, and what a simulated run's own simulation knows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wlr_gym import cli
from wlr_gym.base.errors import InputError
from wlr_gym.data import Simulation, read_run, simulate_again
from wlr_gym.data.format import CHANNELS
from wlr_gym.data.replay import ReplayResult, replay
from wlr_gym.data.run_states import euler_angles, measured_state, rolled_poses, start_state
from wlr_gym.data.watch import RunRecording, film_length, open_recordings, replay_film, truth_of
from wlr_gym.physics.effects import load_patch
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.render.view import View
from wlr_gym.robot import LEGS, WHEELS, load_robot
from wlr_gym.robot.parameters import Parameters

# pyright: reportArgumentType=false, reportOptionalMemberAccess=false


RUN = Path(__file__).parent / "data" / "run_01.parquet"


def run_of(seconds=4.0, **columns):
    run = read_run(RUN)
    table = run.table[run.table["t"] <= run.table["t"].iloc[0] + seconds].assign(**columns)
    return replace(run, table=table)


def test_the_measured_robot_is_where_the_camera_and_the_encoders_say():
    run = run_of()
    recording = RunRecording(run, backend=None)
    frames = np.flatnonzero(np.isfinite(run["cam_x"]))
    for row in frames[[3, len(frames) // 2, -3]]:
        moment = recording.at(run["t"][row] - run["t"][0])
        assert np.allclose(moment.truth.position[0, :2], [run["cam_x"][row], run["cam_y"][row]], atol=0.01)
        assert np.allclose(moment.truth.joint_position[0, :4], [run[f"pos_{leg}"][row] for leg in LEGS], atol=0.01)
        assert moment.slip
        assert not moment.forces
    assert recording.ghost_at(1.0) is None
    assert recording.length == pytest.approx(4.0, abs=0.03)


def test_a_measured_robot_stands_on_the_floor_that_is_given():
    """On a ramp it is as steep, and slips by what its wheels turn more than they go."""
    ramp = {"pieces": [{"kind": "ramp", "at": [-2.0, 0.0], "slope": 0.2, "height": 1.0}]}
    level, steep = (RunRecording(run_of(), backend=None, floor=floor).at(2.0).truth for floor in ("flat", ramp))
    _, pitch, _ = euler_angles(steep.quaternion)
    assert pitch[0] == pytest.approx(-0.2, abs=0.02)
    assert steep.position[0, 2] - level.position[0, 2] == pytest.approx(0.2 * (2.0 + steep.position[0, 0]), rel=0.05)
    assert np.isfinite(steep.slip_velocity).all()
    assert steep.slip_velocity == pytest.approx(level.slip_velocity, abs=0.02)


def test_without_a_camera_it_moves_as_its_wheels_roll():
    run, robot = read_run(RUN), load_robot()
    t = np.arange(100) * 0.02
    columns = {name: np.zeros(100) for name in run.table.columns if not name.startswith("cam")}
    columns |= {
        "t": t,
        **{f"pos_{leg}": np.full(100, np.pi / 2) for leg in LEGS},
        **{f"pos_{wheel}": 2.0 * t for wheel in WHEELS},
    }
    columns["gyro_z"] = np.full(100, 0.5)
    poses = rolled_poses(replace(run, table=run.table.iloc[:0].reindex(range(100))[list(columns)].assign(**columns)), robot)
    radius = 2.0 * robot.wheel.radius / 0.5  # of the circle: speed over yaw rate
    yaw = 0.5 * t[-1]
    assert poses[-1, 2] == pytest.approx(yaw)
    assert np.allclose(poses[-1, :2], radius * np.array([np.sin(yaw), 1.0 - np.cos(yaw)]), atol=1e-4)


def test_where_no_frame_is_near_it_goes_on_from_the_last_one():
    run = run_of()
    hidden = np.where(run["t"] - run["t"][0] > 2.0, np.nan, 1.0)
    dark = run_of(**{f"cam_{name}": run[f"cam_{name}"] * hidden for name in ("x", "y", "yaw")})
    moments = [RunRecording(one, backend=None).at(2.6) for one in (run, dark)]
    places = [moment.truth.position[0, :2] for moment in moments]
    assert np.linalg.norm(places[1] - places[0]) < 0.05
    assert moments[0].slip
    assert not moments[1].slip


def test_the_ghost_is_the_replay():
    """Not anchored anew, it is the replay's full run, which begins to be simulated a little earlier."""
    run = run_of(2.0)
    recording = RunRecording(run, segment=np.inf)
    recording.wait()
    assert recording.ghost.done == len(run["t"])
    full = replay(run).full
    for name, bound in (("pos_leg_lf", 0.01), ("vel_wheel_rr", 0.15), ("cam_x", 0.01), ("cam_yaw", 0.02)):
        ghost = recording.ghost.channels[:, CHANNELS.index(name)]
        moved = max(np.nanmax(full[name]) - np.nanmin(full[name]), 1e-9)
        assert np.sqrt(np.mean((ghost - full[name])[25:] ** 2)) < bound, (name, moved)
    labels = [curve.label for curve in recording.curves("vel_wheel")]
    assert labels[:2] == ["vel_wheel_lf", "vel_wheel_lf, replayed"]
    assert "true contact_force" in recording.titles
    assert len(recording.curves("true contact_force")) == 12
    load = recording.ghost_at(1.9).truth.contact_force[0].reshape(4, 3)[:, 2].sum()
    assert 10.0 < load < 60.0


def test_an_anchored_ghost_stays_at_the_measured_robot():
    run = run_of(3.0)
    patch = load_patch({"effects": [{"name": "camera_misalignment", "parameters": {"yaw": 0.0, "scale": 1.0}}]})
    recording = RunRecording(run, patch=patch, segment=1.0)
    recording.wait()
    t = run["t"] - run["t"][0]
    row = int(np.searchsorted(t, 1.0))
    at, ghost = recording.at(t[row]), recording.ghost_at(t[row])
    assert np.allclose(ghost.truth.position[0, :2], at.truth.position[0, :2], atol=0.005)
    assert np.allclose(ghost.truth.joint_position[0, :4], at.truth.joint_position[0, :4], atol=0.01)


def test_of_a_simulated_run_the_truth_is_shown():
    run = run_of(1.2)
    robot = load_robot()
    start = {
        name: value[0].tolist()
        for name, value in vars(start_state(run, robot, Parameters.nominal(robot))).items()
        if value is not None
    }
    record = Simulation(
        backend="gibbs_appell", control_period=0.02, physics_step=0.001, precision="float64", sensor_noise=False, seed=1,
        parameters={"ground.mu_x[wheel_lf]": 0.3}, start=start,
    )  # fmt: skip
    short = replace(run, simulation=record)
    recording = RunRecording(short, backend=None)
    recording.wait()
    moment = recording.at(1.0)
    assert moment.slip
    assert moment.forces
    again = simulate_again(short, robot)
    assert moment.truth.joint_position[0, 0] == pytest.approx(again["pos_leg_lf"][recording._row(1.0)], abs=1e-9)
    assert moment.parameters["ground.mu_x"][0, 0] == 0.3
    assert "as simulated" in recording.lines(1.0)[0]


def test_what_cannot_be_replayed_is_refused_before_a_page_opens():
    run = run_of()
    with pytest.raises(InputError, match="no_such_robot"):
        open_recordings([run], "no_such_robot", "gibbs_appell", load_patch(None), 10.0)
    with pytest.raises(InputError, match="too short"):
        open_recordings([run_of(0.1)], None, None, load_patch(None), 10.0)
    assert start_state(run, load_robot(), RunRecording(run, backend=None)._model) is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view"], "expected runs (CSV or Parquet)"),
        (["view", str(RUN), "--segment", "0"], "--segment 0: expected more than 0 s"),
        (["view", str(RUN), "--backend", "dynamixel"], "a ghost needs a simulator"),
        (
            ["view", str(RUN), "--backend", "mujoko"],
            "unknown backend 'mujoko' (did you mean 'mujoco'?); valid: gibbs_appell, mujoco\n",
        ),
        (["view", "nowhere.parquet"], "nowhere.parquet"),
        (["view", str(RUN), "--seconds", "-1"], "--seconds -1"),
    ],
)
def test_bad_options_of_view_are_refused(arguments, message, capsys):
    assert cli.main(arguments) == 2
    assert message in "".join(capsys.readouterr())


# ---- films ------------------------------------------------------------------------------------------------------------


SMALL = View(size=(96, 64), text=False, friction=False, slip=False)


def result_of(full):
    """A replay of the run's first second that came out as ``full`` says."""
    run = read_run(RUN)
    table = run.table.iloc[:50]
    short = type(run)(table, run.meta, run.path)
    measured = {name: short[name] for name in CHANNELS if name in short}
    return ReplayResult(short, {**measured, **full(measured)}, {}, (0,), {}, load_robot(), 0.002, 0.001)


def test_a_perfect_simulation_looks_like_the_run(graphics):
    result = result_of(lambda measured: {})
    pictures = list(replay_film(result, Parameters.nominal(result.robot), "gibbs_appell", SMALL))
    assert len(pictures) == film_length(result.run) == 13
    for picture in pictures:
        body = picture[-64:]
        assert np.array_equal(body[:, :96], body[:, -96:])
    assert not np.array_equal(pictures[0], pictures[-1]) or np.ptp(result.run["pos_wheel_lf"]) < 1e-3


def test_a_wrong_simulation_does_not(graphics):
    result = result_of(lambda measured: {"cam_yaw": measured["cam_yaw"] + 0.5})
    picture = next(iter(replay_film(result, Parameters.nominal(result.robot), "gibbs_appell", SMALL)))[-64:].astype(int)
    assert (np.abs(picture[:, :96] - picture[:, -96:]).sum(axis=2) > 60).mean() > 0.02


def test_a_drifting_simulation_is_seen_to_drift(graphics):
    """0.2 m to the right of the measured one, in the picture too: the camera stays with the measured robot."""
    result = result_of(lambda measured: {"cam_x": measured["cam_x"] + 0.2})
    top = View(size=(96, 64), camera="top", text=False, friction=False, slip=False)
    picture = next(iter(replay_film(result, Parameters.nominal(result.robot), "gibbs_appell", top)))[-64:]
    left, right = (np.nonzero((side.max(axis=2) < 70).any(axis=0))[0].mean() for side in (picture[:, :96], picture[:, -96:]))
    assert 6 < right - left < 20


def test_pose_and_joints_are_the_measured_ones():
    run = read_run(RUN)
    times = run["t"][[20, 200]]
    many = Parameters.nominal(load_robot(), 2)
    truth = truth_of(measured_state(run, times, standing_state(load_robot(), many), many))
    known = np.isfinite(run["cam_x"])
    for channel, values in (("cam_x", truth.position[:, 0]), ("cam_yaw", euler_angles(truth.quaternion)[0])):
        assert np.allclose(values, np.interp(times, run["t"][known], run[channel][known]), atol=0.02)
    assert np.allclose(truth.joint_position[:, 0], run["pos_leg_lf"][[20, 200]], atol=0.01)
    assert np.allclose(truth.position[:, 2], 0.169, atol=0.02)
    assert not truth.slip_velocity.any()
