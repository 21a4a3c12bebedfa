import numpy as np
import pytest

ID = "WLR-Velocity-v0"


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Run folder of a PPO policy whose actions use the whole range and beyond."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from wlr_gym.policy import Training, load_agent

    folder = tmp_path_factory.mktemp("trained") / "run"
    settings = {"total_steps": 64, "num_envs": 8, "steps_per_env": 8, "batch_size": 32, "environment": {"episode_length": 0.2}}
    load_agent("ppo").train(Training(ID, folder, settings, progress=False))
    model = PPO.load(folder / "policy" / "model.zip", device="cpu")
    model.policy.get_parameter("action_net.weight").data *= 200.0
    model.save(folder / "policy" / "model.zip")
    return folder


@pytest.fixture(scope="session")
def exported(trained, tmp_path_factory):
    """That policy as a file."""
    pytest.importorskip("onnx")
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    from wlr_gym.policy import contract_of, export_policy

    path = tmp_path_factory.mktemp("exported") / "policy.onnx"
    export_policy(trained, path, observations(contract_of(trained)["environment"], 16, seed=7), {"seconds": 1.5})
    return path


def observations(environment, count, seed=0):
    width = len(environment["observation"])
    return np.random.default_rng(seed).normal(0.0, 1.0, (count, width)).astype(np.float32)
