"""A network on top of a controller: what it starts from, what of it is saved, and samples seen in the mirror."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ppo_runs import ENVIRONMENT, assert_same_weights, weights
from ppo_runs import train as train_plain

import wlr_gym
from wlr_gym.base.errors import InputError
from wlr_gym.learning.evaluation.rollout import make_core, seen_observations
from wlr_gym.policy import check_contract, export_policy, load_agent, load_policy, make_policy, read_contract
from wlr_gym.policy.onnx_file import open_policy

torch = pytest.importorskip("torch")

TASK = {"controller": {"steering": 1.6, "velocity_i": 6.0}, "observations": {"velocity_controller": {}}}
LAYERS = {
    "environment": {"episode_length": 0.2, "observation": "dict", "task": TASK},
    "normalise": True, "residual": [0.2, 0.5], "mirror": True, "desired_kl": 0.01, "total_steps": 1200, "learning_rate": 0.01,
}  # fmt: skip


def train(folder, *, resume=False, **changes):
    return train_plain(folder, resume=resume, **{**LAYERS, **changes})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of one uninterrupted run."""
    folder = tmp_path_factory.mktemp("layers") / "run"
    train(folder)
    return folder


@pytest.fixture(scope="module")
def core():
    core = make_core(ENVIRONMENT, 4, {"task": TASK})
    yield core
    core.close()


@pytest.fixture(scope="module")
def seen(core):
    policy = make_policy("pid", core.contract())
    return seen_observations(core, policy, 0.5)


def test_starts_as_the_controller(core, seen):
    settings = {"residual": 0.5, "normalise": True}
    untrained = load_agent("ppo").make_policy(core.contract(), settings)
    columns = [k for k, column in enumerate(core.task.policy) if column.term == "velocity_controller"][:8]
    np.testing.assert_array_equal(untrained.act(seen), seen[:, columns])


def test_policy_is_the_network_that_was_trained(run, core, seen):
    """Controller, normaliser and all: against Stable-Baselines3's own prediction, and written out by hand."""
    from stable_baselines3 import PPO

    actions = load_policy(run, core.contract()).act(seen)
    model = PPO.load(run / "policy" / "model.zip")
    observation = {"policy": seen, "privileged": np.zeros((len(seen), core.privileged.shape[1]), np.float32)}
    np.testing.assert_allclose(actions, model.predict(observation, deterministic=True)[0], atol=1e-6)
    columns = [k for k, column in enumerate(core.task.policy) if column.term == "velocity_controller"][:8]
    saved = {name: value.numpy().astype(np.float64) for name, value in weights(run / "policy").items()}
    net = "mlp_extractor.policy_net.hidden"
    hidden = np.clip((seen - saved[f"{net}.0.mean"]) / saved[f"{net}.0.deviation"], -10.0, 10.0)
    for layer in (0, 2):
        hidden = np.tanh(hidden @ saved[f"{net}.1.{layer}.weight"].T + saved[f"{net}.1.{layer}.bias"])
    added = hidden @ saved["action_net.last.weight"].T + saved["action_net.last.bias"]
    expected = np.clip(seen[:, columns] + np.repeat([0.2, 0.5], 4) * added, -1.0, 1.0)  # of legs and of wheels
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert np.abs(added).max() > 1e-3
    assert np.ptp(saved[f"{net}.0.deviation"]) > 0.01


def test_the_finished_policy_adds_a_share_of_what_was_learnt(run, core, seen, tmp_path):
    """The training is the same bit for bit; the policy's folder and file add less to the controller's action."""
    pytest.importorskip("onnxruntime")
    train(tmp_path / "run", residual_share=0.7)
    assert_same_weights(run / "policy", tmp_path / "run" / "policy")
    columns = [k for k, column in enumerate(core.task.policy) if column.term == "velocity_controller"][:8]
    whole, shared = (load_policy(folder, core.contract()).act(seen) for folder in (run, tmp_path / "run"))
    inside = (np.abs(whole) < 1.0) & (np.abs(shared) < 1.0)
    added = (whole - seen[:, columns])[inside]
    assert np.abs(added).max() > 1e-3
    np.testing.assert_allclose((shared - seen[:, columns])[inside], 0.7 * added, atol=1e-6)
    export_policy(tmp_path / "run", tmp_path / "policy.onnx", seen)
    np.testing.assert_allclose(open_policy(tmp_path / "policy.onnx")[0].act(seen), shared, atol=1e-5)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_start_from_a_policy_acts_as_it_does(core, seen, share, tmp_path):
    """Whatever share of its residual it acts with, and whatever the new one will act with."""
    train(tmp_path / "run", residual_share=0.7)
    more = wlr_gym.train(
        ENVIRONMENT,
        tmp_path / "more",
        init=tmp_path / "run",
        max_seconds=1e-9,
        settings={"total_steps": 1, "residual_share": share},
    )
    before, after = (load_policy(folder, core.contract()).act(seen) for folder in (tmp_path / "run", more))
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_file_answers_as_the_network(run, core, seen, tmp_path):
    pytest.importorskip("onnxruntime")
    export_policy(run, tmp_path / "policy.onnx", seen)
    policy, content = open_policy(tmp_path / "policy.onnx")
    np.testing.assert_allclose(policy.act(seen), load_policy(run, core.contract()).act(seen), atol=1e-5)
    check_contract(content["environment"], core.contract(), "file")


@pytest.mark.parametrize("lost", ["mlp_extractor.policy_net.hidden.0.mean", "action_net.last.bias"])
def test_weights_that_are_missing_are_missed(run, core, lost, tmp_path):
    import shutil

    from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file

    folder = tmp_path / "policy"
    shutil.copytree(run / "policy", folder)
    data, parameters, _ = load_from_zip_file(folder / "model.zip", device="cpu")
    del parameters["policy"][lost]  # type: ignore[attr-defined]
    save_to_zip_file(folder / "model.zip", data, parameters)
    with pytest.raises(InputError, match=lost.rpartition(".")[0]):
        load_policy(folder, core.contract())


def test_another_gain_is_another_environment(run):
    other = make_core(ENVIRONMENT, 1, {"task": {**TASK, "controller": {"steering": 1.5, "velocity_i": 6.0}}})
    with pytest.raises(InputError, match=r"controller\.steering"):
        check_contract(read_contract(run / "policy")["environment"], other.contract(), "policy")
    other.close()


def test_needs_a_controller():
    core = make_core(ENVIRONMENT, 1, {})
    with pytest.raises(InputError, match=r"observations.velocity_controller"):
        load_agent("ppo").make_policy(core.contract(), {"residual": 0.5})
    core.close()


def test_resumes_bit_for_bit(run, tmp_path):
    train(tmp_path / "run", total_steps=1000)
    resumed = train(tmp_path / "run", resume=True)
    assert_same_weights(resumed, run / "policy")


def test_mirror_image_is_what_a_mirrored_robot_sees():
    """Two robots of one batch, one the other's mirror image in state, command and action: seen, after each step, the same."""
    from wlr_gym.envs.tasks.describe import column_name
    from wlr_gym.learning.ppo.networks import mirror_of

    level = {"randomization": {"name": "none", "base": "none", "sensor_noise": False}, "observation": "dict"}
    warped = {"controller": {**TASK["controller"], "warp": 0.05, "turn_lead": 0.1, "warp_rise": 90.0}}
    task = warped | {"observations": {"velocity_controller": {}, "velocity_memory": {}}}
    core = make_core(ENVIRONMENT, 2, {"task": task, **level})
    columns = {"policy": core.task.policy, "privileged": core.task.privileged}
    mirrors = {group: mirror_of([column_name(column) for column in some]) for group, some in columns.items()}
    of_action = mirror_of([column.joint for column in core.task.actions])
    for row, side in enumerate((1.0, -1.0)):
        core.seed(row, 0)
        only = np.arange(2) == row
        core.begin_episodes(only, {"command": {"linear_velocity_x": 0.08, "yaw_rate": 0.2 * side}})
    generator = np.random.default_rng(0)
    action = np.zeros((1, 8), np.float32)
    moved = np.zeros(core.observation.shape[1])
    for _ in range(60):
        action = np.clip(action + generator.normal(0, 0.15, (1, 8)).astype(np.float32), -1, 1)
        core.step(np.concatenate([action, of_action.of(action)]), core.everyone)
        for group, seen in {"policy": core.observation, "privileged": core.privileged}.items():
            np.testing.assert_allclose(mirrors[group].of(seen[:1]), seen[1:], atol=2e-3, err_msg=group)
        moved = np.maximum(moved, np.abs(core.observation[0] - core.observation[1]))
    core.close()
    assert np.sum(moved > 0.05) > 30


def test_every_other_sample_is_mirrored(core):
    from stable_baselines3 import PPO

    from wlr_gym.envs import Sb3VecEnv
    from wlr_gym.learning.ppo.policy import parse_settings
    from wlr_gym.learning.ppo.training import make_model

    env = Sb3VecEnv(ENVIRONMENT, 4, task=TASK)
    config = parse_settings({"num_envs": 4, "steps_per_env": 4, "batch_size": 16, "mirror": True})
    buffer: Any = make_model(env, config).rollout_buffer
    plain = PPO("MlpPolicy", env, n_steps=4, batch_size=16).rollout_buffer
    for some in (buffer, plain):
        some.observations[:] = np.arange(some.observations.size).reshape(some.observations.shape)
        some.actions[:] = np.arange(some.actions.size).reshape(some.actions.shape)
        some.full = True
    batches = []
    for some in (buffer, plain):
        np.random.seed(0)  # noqa: NPY002 - minibatches use it
        batches.append(next(iter(some.get(16))))
    seen, straight = batches
    env.close()
    assert torch.equal(seen.observations[::2], straight.observations[::2])
    mirror = buffer.mirrors["policy"]
    np.testing.assert_array_equal(seen.observations[1::2].numpy(), mirror.of(straight.observations[1::2].numpy()))
    np.testing.assert_array_equal(seen.actions[1::2].numpy(), buffer.action_mirror.of(straight.actions[1::2].numpy()))


def test_unknown_mirror_image_is_refused():
    from wlr_gym.learning.ppo.networks import mirror_of

    with pytest.raises(InputError, match=r"mirror image of observation 'my_term\[north\]'"):
        mirror_of(["gyro[x]", "my_term[north]"])
