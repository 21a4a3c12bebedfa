"""A simulated run carries what was sampled: simulated again, it is the same run."""

from typing import Any

import gymnasium as gym
import numpy as np
import pandas
import pytest

import wlr_gym  # noqa: F401
from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.data import convert, read_dataset, read_run, simulate_again, simulated_parameters, write_run
from wlr_gym.data.sensors import SENSED
from wlr_gym.learning.evaluation.episode_recorder import EpisodeRecorder
from wlr_gym.robot.parameters import Parameters

EVENTS = {
    "push": {
        "parameters": ["external_force"], "distribution": "uniform", "operation": "set", "low": -3.0, "high": 3.0,
        "per": "element", "when": "interval", "interval": [0.1, 0.4],
    },
    "drift": {
        "parameters": ["ground.mu_x", "ground.mu_y"], "distribution": "uniform", "operation": "scale", "low": 0.5, "high": 1.5,
        "when": "drift", "interval": [0.5, 1.0],
    },
}  # fmt: skip
OTHERWISE = {**EVENTS, "friction_anisotropy": None}
RANDOM = {"base": "wide", "events": OTHERWISE}
#: The engine need not be compiled in float32 for rolling resistance too.
FLOAT32 = {"precision": "float32", "randomization": {"base": "wide", "events": {**OTHERWISE, "rolling_resistance": None}}}
KEYWORDS = {"randomization": RANDOM, "episode_length": 2.0, "effects": [{"name": "gyro_bias", "parameters": {"x": 0.02}}]}


def record(path, count=3, robot=1, steps=60, **keywords) -> Any:
    env: Any = gym.make_vec("WLR-Velocity-v0", num_envs=count, **{**KEYWORDS, **keywords})
    env.reset(seed=5)
    recorder = EpisodeRecorder(env.core, robot)
    for action in np.random.default_rng(0).uniform(-1, 1, (steps, count, 8)).astype(np.float32):
        env.step(action)
        recorder.note()
    assert recorder.save(path) == path
    return env


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
@pytest.mark.parametrize("keywords", [{}, {"free_wheels": ["wheel_lr"], **FLOAT32}])
def test_a_recorded_episode_simulates_again_bit_for_bit(tmp_path, suffix, keywords):
    env = record(tmp_path / f"run_01{suffix}", **keywords)
    run = read_run(tmp_path / f"run_01{suffix}")
    assert run.simulation is not None
    assert len(run.simulation.changes) >= 5
    again = simulate_again(run, env.core.task.robot)
    assert set(again) == set(SENSED)
    for name, values in again.items():
        assert np.array_equal(values, run[name], equal_nan=True), name
    assert np.isnan(run["cam_x"]).any()
    assert np.isnan(run["cmd_wheel_lr"]).all() == bool(keywords)


def test_without_what_was_sampled_it_is_another_run(tmp_path):
    env = record(tmp_path / "run_01.parquet")
    run = read_run(tmp_path / "run_01.parquet")
    assert run.simulation is not None
    robot = env.core.task.robot
    sampled = simulated_parameters(run, robot)
    assert sampled["imu.gyro_bias[x]"][0] == run.simulation.parameters["imu.gyro_bias[x]"]
    nominal = Parameters.nominal(robot)
    assert {name for name in run.simulation.parameters if sampled[name][0] == nominal[name][0]} == set()
    object.__setattr__(run, "simulation", run.simulation.model_copy(update={"changes": ()}))
    assert not np.array_equal(simulate_again(run, robot)["gyro_z"], run["gyro_z"])


def test_the_log_ends_with_the_episode(tmp_path):
    record(tmp_path / "run_01.parquet", steps=150, autoreset_mode="SameStep")
    run = read_run(tmp_path / "run_01.parquet")
    assert len(run["t"]) <= 100


def test_the_record_follows_the_run(tmp_path):
    source = tmp_path / "run_01.parquet"
    record(source)
    convert(source, tmp_path / "csv" / "run_01.csv")
    assert read_run(tmp_path / "csv" / "run_01.csv").simulation == read_run(source).simulation
    run = read_run(source)
    write_run(source, run.table)
    measured = read_run(source)
    assert measured.simulation is None
    with pytest.raises(InputError, match=r"no run_01\.simulation\.yaml beside it"):
        simulate_again(measured, None)  # type: ignore[arg-type]


def test_a_recorder_starts_at_a_reset():
    env: Any = gym.make("WLR-Velocity-v0").unwrapped
    with pytest.raises(InputError, match="right after a reset"):
        EpisodeRecorder(env.core)
    env.reset(seed=0)
    env.step(np.zeros(8, np.float32))
    with pytest.raises(InputError, match="right after a reset"):
        EpisodeRecorder(env.core)


def test_evaluate_logs_what_was_drawn(tmp_path, capsys):
    command = ["evaluate", "do_nothing", "--baselines", "--no-progress", "--episodes", "3", "--seed", "7"]
    command += ["--randomization", "ice"]
    assert main([*command, "--out", str(tmp_path), "--record", "2"]) == 0
    samples = pandas.read_csv(tmp_path / "samples.csv")
    env: Any = gym.make_vec("WLR-Velocity-v0", num_envs=3, randomization="ice")
    _, info = env.reset(seed=7)
    assert samples["seed"].tolist() == [7, 8, 9]
    assert set(samples) == {"seed", *(name for name in info["randomization"] if not name.startswith("_"))}
    assert samples["ground.mu_x[wheel_lf]"].tolist() == info["randomization"]["ground.mu_x[wheel_lf]"].tolist()
    data = read_dataset(tmp_path / "runs")
    assert [run.name for run in data.runs] == ["run_01", "run_02"]
    run = data.runs[1]
    assert run.simulation is not None
    assert run.simulation.parameters["ground.mu_x[wheel_lf]"] == samples["ground.mu_x[wheel_lf]"][1]
    again = simulate_again(run, env.core.task.robot)
    assert np.array_equal(again["cam_x"], run["cam_x"], equal_nan=True)
    assert main([*command, "--record", "2"]) == 2
    assert "--out for the runs" in capsys.readouterr().err
