"""Training by others: rl-zoo3's command and SBX, a few thousand steps each."""

import subprocess
import sys

import pytest

SETTINGS = "{name}:\n  n_envs: 2\n  n_timesteps: 2000\n  policy: MlpPolicy\n  n_steps: 256\n  batch_size: 64\n  n_epochs: 1\n"


def test_rl_zoo(env_id, tmp_path):
    pytest.importorskip("rl_zoo3", reason="rl-zoo3 is not installed: see tests/clients/conftest.py")
    package, _, name = env_id.rpartition(":")
    (tmp_path / "settings.yaml").write_text(SETTINGS.format(name=name))
    command = [sys.executable, "-m", "rl_zoo3.train", "--algo", "ppo", "--env", name, "--gym-packages", package]
    command += ["-conf", "settings.yaml", "-f", "logs", "--seed", "1", "--eval-freq", "1000", "--eval-episodes", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert list((tmp_path / "logs").rglob("*.zip"))


@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_sbx(env_id, algorithm):
    sbx = pytest.importorskip("sbx", reason="SBX is not installed: see tests/clients/conftest.py")
    import gymnasium as gym

    from wlr_gym import Sb3VecEnv

    spec = gym.make(env_id).spec
    assert spec is not None
    env = Sb3VecEnv(spec, 2)
    options = {"n_steps": 128, "n_epochs": 1} if algorithm == "PPO" else {"learning_starts": 200}
    model = getattr(sbx, algorithm)("MlpPolicy", env, seed=0, **options)
    model.learn(600)
    assert model.predict(env.reset())[0].shape == (2, 8)
