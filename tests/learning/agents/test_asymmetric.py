"""A critic that sees more than the actor: what each sees, and that training with it is as reproducible as without."""

import shutil
from typing import Any

import numpy as np
import pytest
from ppo_runs import ENVIRONMENT, assert_same_weights, curve, weights
from ppo_runs import train as train_plain

from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import load_agent, load_policy, read_contract

torch = pytest.importorskip("torch")


SEES_MORE = {"episode_length": 0.2, "observation": "dict"}


def train(folder, *, resume=False, **changes):
    return train_plain(folder, resume=resume, **{"environment": SEES_MORE, **changes})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of one uninterrupted run."""
    folder = tmp_path_factory.mktemp("asymmetric") / "run"
    train(folder)
    return folder


@pytest.fixture(scope="module")
def core():
    core = make_core(ENVIRONMENT, 4, {"observation": "dict"})
    yield core
    core.close()


def test_actor_sees_the_policy_group_only_and_the_critic_both(core):
    load_agent("ppo")
    from wlr_gym.learning.ppo.networks import AsymmetricPolicy

    network = AsymmetricPolicy(core.observation_space, core.action_space, lambda _: 1e-3, net_arch=[16])
    generator = torch.Generator().manual_seed(0)
    sizes = {group: space.shape[0] for group, space in core.observation_space.spaces.items()}
    seen: Any = {group: torch.rand(5, size, generator=generator) for group, size in sizes.items()}
    other = seen | {"privileged": seen["privileged"] + 1.0}
    assert torch.equal(network._predict(seen, deterministic=True), network._predict(other, deterministic=True))
    assert not torch.equal(network.predict_values(seen), network.predict_values(other))
    other = seen | {"policy": seen["policy"] + 1.0}
    assert not torch.equal(network._predict(seen, deterministic=True), network._predict(other, deterministic=True))
    assert not torch.equal(network.predict_values(seen), network.predict_values(other))
    actions, values, chance = network.forward(seen, deterministic=True)
    again, same_chance, _ = network.evaluate_actions(seen, actions)
    torch.testing.assert_close(again, values)
    torch.testing.assert_close(same_chance, chance)


def test_trained_policy_is_fed_the_policy_group(run, core):
    policy = load_policy(run, core.contract())
    readings = np.random.default_rng(0).normal(0, 1, (4, core.observation.shape[1])).astype(np.float32)
    actions = policy.act(readings)
    assert actions.shape == (4, 8)
    saved = weights(run / "policy")
    hidden = torch.as_tensor(readings)
    for layer in (0, 2):
        name = f"mlp_extractor.policy_net.{layer}"
        hidden = torch.tanh(hidden @ saved[f"{name}.weight"].T + saved[f"{name}.bias"])
    expected = hidden @ saved["action_net.weight"].T + saved["action_net.bias"]
    np.testing.assert_allclose(actions, expected.clamp(-1, 1).numpy(), atol=1e-6)
    assert saved["mlp_extractor.value_net.0.weight"].shape[1] == readings.shape[1] + core.privileged.shape[1]


def test_same_seed_gives_the_same_run_bit_for_bit(run, tmp_path):
    again = train(tmp_path / "again")
    assert curve(tmp_path / "again") == curve(run)
    assert_same_weights(again, run / "policy")


def test_resumed_run_ends_the_same(run, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(run, folder)
    for late in sorted(folder.glob("checkpoints/step_*"))[1:]:
        shutil.rmtree(late)
    resumed = train(folder, resume=True)
    assert curve(folder) == curve(run)
    assert_same_weights(resumed, run / "policy")
    assert read_contract(resumed)["training"]["steps"] == 384


def test_reading_that_is_not_finite_in_the_privileged_group_stops_the_run(tmp_path, monkeypatch):
    from wlr_gym.envs import Sb3VecEnv

    step = Sb3VecEnv.step_wait

    def broken(env):
        observations, *rest = step(env)
        observations["privileged"][3, 0] = np.nan
        return observations, *rest

    monkeypatch.setattr(Sb3VecEnv, "step_wait", broken)
    with pytest.raises(RuntimeError, match="an observation or reward is not finite"):
        train(tmp_path / "nan")
