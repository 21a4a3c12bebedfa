"""Films of measured runs: drawn where the run says the robot was."""

from pathlib import Path

import numpy as np

from wlr_gym.data import read_run
from wlr_gym.data.format import CHANNELS
from wlr_gym.data.replay import ReplayResult
from wlr_gym.data.run_states import euler_angles, measured_state
from wlr_gym.data.watch import film_length, replay_film, truth_of
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.render.view import View
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

RUN = Path(__file__).parent / "data" / "run_01.parquet"
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
