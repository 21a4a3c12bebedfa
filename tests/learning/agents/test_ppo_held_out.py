"""Scores on held-out episodes while training, and starts from trained policies."""

import json
import os
import pickle
import random
import signal
from typing import Any

import numba
import numpy as np
import pytest
from ppo_runs import ENVIRONMENT, SETTINGS, assert_same_weights, curve, train, weights

import wlr_gym
from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.learning.curves import read_curve
from wlr_gym.learning.evaluation.rollout import make_core, measures_of
from wlr_gym.policy import Training, export_policy, load_agent, read_contract

torch = pytest.importorskip("torch")

SCORED: dict[str, Any] = {"evaluate_every": 128, "evaluation_episodes": 3}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of a run that is scored at its start, twice on the way, and at its end."""
    folder = tmp_path_factory.mktemp("held_out") / "run"
    train(folder, **SCORED)
    return folder


def test_scores_are_those_of_an_evaluation_of_the_same_episodes(run):
    """``wlr evaluate`` of the final policy on the held-out seeds: another core, another loading of the weights."""
    from wlr_gym.learning.ppo.training import FIRST_SEED

    rows = read_curve(run / "held_out.csv")
    assert [row["steps"] for row in rows] == [0, 128, 256, 384]
    card = wlr_gym.evaluate(run / "policy", ENVIRONMENT, baselines=(), episodes=3, seed=FIRST_SEED)
    scores = card.scores["main"][card.names[0]]
    for name in ("tracking_error", "success", "excess_slip", "reward"):
        assert rows[-1][name] == pytest.approx(scores[name].mean, rel=1e-9, abs=1e-9)
    assert read_contract(run / "policy")["training"]["held_out"]["tracking_error"] == rows[-1]["tracking_error"]


@pytest.mark.parametrize("most", [1e9, 1e-12])
def test_own_measures_and_limits_of_a_training_are_scored(most):
    from wlr_gym.learning.ppo.policy import parse_settings
    from wlr_gym.learning.ppo.training import HeldOutEpisodes

    task = {
        "measures": {"heading_error": {}},
        "success": {"velocity_error": {"rms": 1e9}, "yaw_rate_error": {"rms": 1e9}, "heading_error": {"max": most}},
    }
    core = HeldOutEpisodes(ENVIRONMENT, parse_settings({**SETTINGS, **SCORED, "environment": {"task": task}})).core
    found = {measure.name: measure for measure in measures_of(core)}
    assert found["heading_error"].max == most
    core.close()


def test_the_best_policy_is_kept(run):
    rows = read_curve(run / "held_out.csv")
    best = min(rows, key=lambda row: row["tracking_error"])
    training = read_contract(run / "best")["training"]
    assert (training["steps"], training["held_out"]["tracking_error"]) == (best["steps"], best["tracking_error"])


def test_scoring_changes_nothing_of_the_training(run, tmp_path):
    unscored = train(tmp_path / "run")
    assert curve(tmp_path / "run") == curve(run)
    assert_same_weights(unscored, run / "policy")


@pytest.mark.slow
def test_scores_go_on_after_a_resume(run, tmp_path):
    folder = tmp_path / "run"
    settings = SETTINGS | SCORED
    request = Training(ENVIRONMENT, folder, settings, progress=False, on_update=lambda progress: 1 // (progress.steps - 192))
    with pytest.raises(ZeroDivisionError):
        load_agent("ppo").train(request)
    wlr_gym.resume_training(folder)
    assert (folder / "held_out.csv").read_text() == (run / "held_out.csv").read_text()
    assert_same_weights(folder / "best", run / "best")


def numba_threads():
    """Numba's own threads, where they were started; starting them, or just counting them, changes those of torch."""
    try:
        numba.threading_layer()  # pyright: ignore[reportPrivateImportUsage]
    except ValueError:
        return None
    return numba.get_num_threads()


def global_state():
    """What all code of a process shares and an evaluation must leave alone."""
    return {
        "random": random.getstate(),
        "numpy.random": pickle.dumps(np.random.get_state()),  # noqa: NPY002
        "numpy errors": np.geterr(),
        "torch generator": torch.get_rng_state().tolist(),
        "torch threads": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "torch modes": (torch.is_grad_enabled(), torch.get_default_dtype(), torch.are_deterministic_algorithms_enabled()),
        "numba threads": numba_threads(),
        "environment": dict(os.environ),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)],
    }


def test_evaluation_touches_no_global_state(run):
    before = global_state()
    wlr_gym.evaluate(run / "policy", ENVIRONMENT, episodes=2, threads=2)
    assert global_state() == before


def test_scoring_while_training_touches_no_global_state():
    """Nor is the network left in another mode."""
    from wlr_gym.envs import Sb3VecEnv
    from wlr_gym.learning.ppo.policy import parse_settings
    from wlr_gym.learning.ppo.training import HeldOutEpisodes, make_model

    config = parse_settings(SETTINGS | SCORED)
    env = Sb3VecEnv(ENVIRONMENT, config.num_envs, **config.environment)
    model = make_model(env, config)
    model.policy.set_training_mode(True)
    before = global_state()
    episodes = HeldOutEpisodes(ENVIRONMENT, config)
    assert episodes.score(model)
    episodes.close()
    assert global_state() == before
    assert model.policy.training
    env.close()


def test_training_gives_torch_its_threads_back(tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        train(tmp_path / "run", total_steps=64)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_a_start_from_a_run_is_that_run_to_the_bit(run, tmp_path):
    policy = wlr_gym.train(ENVIRONMENT, tmp_path / "more", init=run, settings={"total_steps": 1}, max_seconds=1e-9)
    assert_same_weights(policy, run / "policy")
    settings = read_contract(policy)["config"]
    assert settings["learning_rate"] == settings["final_learning_rate"] == 1e-4


def exported(run, file):
    core = make_core(ENVIRONMENT, 4, {})
    export_policy(run, file, core.observation.copy())
    core.close()
    return file


def test_a_start_from_a_file_is_that_run_to_the_bit(run, tmp_path):
    """A policy file holds critic and exploration noise too."""
    file = exported(run, tmp_path / "policy.onnx")
    policy = wlr_gym.train(ENVIRONMENT, tmp_path / "more", init=file, settings={"total_steps": 1}, max_seconds=1e-9)
    assert_same_weights(policy, run / "policy")


def test_a_start_from_a_file_without_a_critic_acts_like_it(run, tmp_path):
    """The critic is fitted first: its steps count, the actor stays, and the noise is small."""
    import onnx

    from wlr_gym.learning.ppo.policy import LOG_STD
    from wlr_gym.policy.onnx_file import CONTRACT_KEY, seal

    file = exported(run, tmp_path / "policy.onnx")
    model = onnx.load(file)
    content = json.loads({one.key: one.value for one in model.metadata_props}[CONTRACT_KEY])
    acting_only = [one for one in model.graph.initializer if not one.name.startswith("learner.")]
    assert len(acting_only) < len(model.graph.initializer)
    del model.graph.initializer[:]
    model.graph.initializer.extend(acting_only)
    file.write_bytes(seal(model.SerializeToString(), content))
    policy = wlr_gym.train(ENVIRONMENT, tmp_path / "more", init=file, settings={"total_steps": 1}, max_seconds=1e-9)
    first, second = weights(run / "policy"), weights(policy)
    acting = [name for name in first if name.startswith(("mlp_extractor.policy_net", "action_net"))]
    assert all(torch.equal(first[name], second[name]) for name in acting)
    assert not torch.equal(first["value_net.weight"], second["value_net.weight"])
    assert second["log_std"].tolist() == pytest.approx([LOG_STD] * 8)
    assert read_contract(policy)["training"]["steps"] > 0


def test_a_policy_of_other_observations_is_refused_and_leaves_nothing(run, tmp_path, capsys):
    with pytest.raises(InputError, match="observation"):
        wlr_gym.train("WLR-Path-v0", tmp_path / "path", init=run)
    assert not (tmp_path / "path").exists()
    assert main(["train", "--init", "velocity_blnd", "--out", str(tmp_path / "x")]) == 2
    assert "did you mean 'velocity_blind'" in capsys.readouterr().err


def test_a_finished_run_can_be_extended(run, tmp_path):
    """The rate stays where it ended; until there the run is the one it was."""
    import shutil

    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    with pytest.raises(InputError, match="expected more than the 384 steps"):
        wlr_gym.resume_training(folder, total_steps=384)
    policy = wlr_gym.resume_training(folder, total_steps=512)
    assert [row["steps"] for row in curve(folder)] == [64.0 * k for k in range(1, 9)]
    assert curve(folder)[:6] == curve(run)
    settings = read_contract(policy)["config"]
    assert (settings["total_steps"], settings["schedule_steps"]) == (512, 384)


def test_a_core_for_scores_is_the_task_as_it_is_scored():
    """Training's own randomisation and episode length do not reach it."""
    from wlr_gym.learning.ppo.policy import PpoConfig
    from wlr_gym.learning.ppo.training import HeldOutEpisodes

    fields = {"environment": {"randomization": "none", "episode_length": 0.2, "precision": "float32"}, "evaluation_episodes": 2}
    episodes = HeldOutEpisodes(ENVIRONMENT, PpoConfig.model_validate(fields))
    plain = make_core(ENVIRONMENT, 2, {"precision": "float32"})
    assert episodes.core.randomization.config == plain.randomization.config
    assert episodes.core.limit == plain.limit
    episodes.close()
    plain.close()
