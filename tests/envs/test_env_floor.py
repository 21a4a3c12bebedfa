"""Environments on a floor: how it is named, what a seed draws of it, what is refused, what says on which floor one drives."""

from __future__ import annotations

import json
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium.utils.env_checker import check_env
from velocity import ID, make, make_vec, uniform

from wlr_gym.base.errors import InputError
from wlr_gym.data import read_run
from wlr_gym.data.replay import simulate_again
from wlr_gym.data.runs import floor_of
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.evaluation.episode_recorder import EpisodeRecorder
from wlr_gym.physics.floor import load_floor
from wlr_gym.robot import load_robot

ROBOT = load_robot()
#: A kerb that a robot which drives straight on reaches within two seconds.
STEP: dict[str, Any] = {
    "name": "step",
    "pieces": [{"kind": "kerb", "at": [0.3, 0.0], "height": 0.01}],
    "randomise": {"pieces.0.height": [0.005, 0.015]},
}
ON_STEP: dict[str, Any] = {"floor": STEP, "randomization": "none", "episode_length": 3.0}


def drive(env: Any, steps: int, wheels: float = 1.0) -> np.ndarray:
    """Drive straight on with the legs at home; returns every observation."""
    count = getattr(env, "num_envs", 1)
    actions = np.tile(np.repeat([0.0, wheels], 4).astype(np.float32), (count, 1))
    return np.array([env.step(actions if hasattr(env, "num_envs") else actions[0])[0] for _ in range(steps)])


# ---- how it is named -------------------------------------------------------------------------------------------------


def test_name_file_mapping_and_floor_are_one(tmp_path):
    (tmp_path / "stairs.yaml").write_text(yaml.safe_dump(load_floor("stairs").content()))
    sources = ["stairs", tmp_path / "stairs.yaml", load_floor("stairs").content(), load_floor("stairs")]
    drawn = []
    for floor in sources:
        env = make(floor=floor, randomization="none")
        env.reset(seed=4)
        drawn.append(env.core.parameters["piece.height"].tolist())
    assert drawn[0][0][3] > 0.0
    assert drawn == [drawn[0]] * 4


def test_the_task_may_name_it():
    env = make(task={"floor": "stairs"}, randomization="none")
    assert env.core.floor == load_floor("stairs")
    assert make(task={"floor": "stairs"}, floor="flat", randomization="none").core.floor is None


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"floor": "stair"}, r"unknown floor config 'stair' \(did you mean 'stairs'\?\)"),
        ({"floor": 3}, "floor = 3: expected a name, a path, a mapping or a Floor"),
        ({"floor": {"pieces": [{"kind": "kerb", "at": [0.1, 0.0], "height": 0.02}]}}, "piece 1: it lies from 0.1 to"),
        ({"floor": {"base": {"kind": "bumps", "height": 0.1, "spacing": 0.1}}}, "curvature reaches 25 1/m"),
        ({"floor": "kerbs", "backend": "dynamixel", "hardware": {"emulated": True}}, "a real robot is what it is"),
        (
            {"floor": {"friction": {"mu": 0.4}}, "randomization": "nominal"},
            "floor 'floor': friction.mu, and randomization 'nominal': event 'floor_friction': both state ground.mu_x",
        ),
        (
            {
                "floor": {"name": "patched", "friction": {"patches": [{"mu": 0.4}]}},
                "randomization": {"events": {"spot": uniform("patch.mu[patch_1]", 0.1, 0.2, area={})}},
            },
            r"floor 'patched': friction.patches, .*event 'spot': both state patch.mu\[patch_1\]",
        ),
        (
            {"floor": "kerbs", "randomization": {"events": {"up": uniform("piece.height[piece_2]", 0.5, 1.5, "scale")}}},
            r"floor 'kerbs': pieces, .*event 'up': both state piece.height\[piece_2\]",
        ),
    ],
)
def test_floors_that_are_refused(keywords, words):
    with pytest.raises(InputError, match=words):
        make(**keywords)


def test_randomisation_of_what_the_floor_leaves_open_stays():
    on_step, flat = (make_vec(3, floor=floor, randomization="nominal") for floor in (STEP, "flat"))
    for env in (on_step, flat):
        env.reset(seed=3)
    for name in ("ground.mu_x", "body.mass", "ground.slope"):
        np.testing.assert_array_equal(on_step.core.parameters[name], flat.core.parameters[name])
    assert (on_step.core.parameters["piece.height"][:, 0] > 0.0).all()


# ---- what a seed draws -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_the_same_seed_is_the_same_floor_and_motion_alone_and_in_a_batch(backend):
    batch = make_vec(3, backend=backend, **ON_STEP)
    batch.reset(seed=[5, 6, 7])
    heights = batch.core.parameters["piece.height"][:, 0]
    assert len(set(heights.tolist())) == 3
    assert ((heights >= 0.005) & (heights <= 0.015)).all()
    together = drive(batch, 100)
    alone = make(backend=backend, **ON_STEP)
    alone.reset(seed=6)
    assert alone.core.parameters["piece.height"][0, 0] == heights[1]
    np.testing.assert_array_equal(drive(alone, 100), together[:, 1])
    assert batch.core.plant.truth().position[:, 2].min() > 0.05
    assert np.ptp(together[:, 1], axis=0).max() > 0.0


def test_every_episode_draws_its_floor():
    env = make(**ON_STEP)
    drawn = []
    env.reset(seed=2)
    for _ in range(3):
        drawn.append(float(env.core.parameters["piece.height"][0, 0]))
        env.reset()
    assert len(set(drawn)) == 3
    env.reset(seed=2)
    assert float(env.core.parameters["piece.height"][0, 0]) == drawn[0]


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_the_wheels_climb_the_kerb(backend):
    env = make(backend=backend, truth_info=True, **{**ON_STEP, "floor": {**STEP, "randomise": {}}, "episode_length": 9.0})
    _, info = env.reset(seed=1)
    before = info["truth"]["position"][2]
    drive(env, 300)
    *_, info = env.step(np.zeros(8, np.float32))
    assert info["truth"]["position"][2] - before == pytest.approx(0.01, abs=1e-3)


# ---- interfaces, files and snapshots ---------------------------------------------------------------------------------


def test_the_checker_of_gymnasium_has_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(**ON_STEP), skip_render_check=True)


def test_the_checker_of_stable_baselines3_has_no_warning():
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(make(**ON_STEP).unwrapped, warn=True)


def test_the_contract_says_on_which_floor():
    assert make(**ON_STEP).contract()["floor"] == STEP
    assert "floor" not in make(randomization="none").contract()
    json.dumps(make(floor="kerbs").contract(), allow_nan=False)


def test_a_recorded_episode_says_its_floor_and_is_simulated_again(tmp_path):
    env = make(**ON_STEP)
    env.reset(seed=8)
    recorder = EpisodeRecorder(env.core)
    for _ in range(60):
        env.step(np.repeat([0.0, 1.0], 4).astype(np.float32))
        recorder.note()
    run = read_run(recorder.save(tmp_path / "run_01.parquet"))
    assert run.meta.floor == STEP
    height = float(env.core.parameters["piece.height"][0, 0])
    assert floor_of(run).content()["pieces"][0]["height"] == height
    assert floor_of(run, "flat").is_flat
    again = simulate_again(run, ROBOT)
    np.testing.assert_array_equal(again["gyro_y"], run["gyro_y"])


def test_snapshots_do_not_move_between_floors():
    first, same, other = (make(**{**ON_STEP, "floor": floor}) for floor in (STEP, STEP, "stairs"))
    for env in (first, same, other):
        env.reset(seed=1)
    drive(first, 20)
    snapshot = first.get_state()
    same.set_state(snapshot)
    np.testing.assert_array_equal(drive(first, 20), drive(same, 20))
    with pytest.raises(InputError, match="floor"):
        other.set_state(snapshot)


def test_all_interfaces_take_it():
    batch = Sb3VecEnv(ID, 2, seed=5, **ON_STEP)
    batch.reset()
    vector: Any = gym.make_vec(ID, num_envs=2, **ON_STEP)
    vector.reset(seed=5)
    heights = [env.core.parameters["piece.height"][:, 0].tolist() for env in (batch, vector.unwrapped)]
    assert heights[0] == heights[1]
    assert heights[0][0] != heights[0][1]
