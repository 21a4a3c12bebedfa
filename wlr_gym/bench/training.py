"""Speed of Stable-Baselines3's PPO on our batch, against the same PPO on single environments on MuJoCo."""

from __future__ import annotations

from wlr_gym.bench.measure import Contender, Measurement, Size, against_fastest, interleave, rate
from wlr_gym.bench.mujoco_loop import BACKEND, register_backend
from wlr_gym.bench.speed import ENVIRONMENT
from wlr_gym.errors import require_package

require_package("stable_baselines3", "train")

import gymnasium as gym  # noqa: E402
import torch  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv  # noqa: E402

from wlr_gym.envs import Sb3VecEnv  # noqa: E402

EPOCHS = 4


def make_mujoco_env() -> gym.Env:
    """Return the environment on the MuJoCo loop, in any process."""
    register_backend()
    return gym.make(f"wlr_gym:{ENVIRONMENT}", randomization="none", backend=BACKEND)


def measure_ppo(size: Size) -> list[Measurement]:
    """Frames per second of whole PPO updates (64x64 networks, one torch thread); ours as ``wlr train`` sets it up."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    robots, workers = size(512, 16), (2,) if size.quick else (2, 8)
    # Workers are forked first, while this process has a single thread; spawned ones would run the command line again.
    vectors: dict[str, VecEnv] = {
        f"SubprocVecEnv({n})": SubprocVecEnv([make_mujoco_env] * n, start_method="fork") for n in workers
    }
    vectors["DummyVecEnv(8)"] = DummyVecEnv([make_mujoco_env] * 8)
    vectors["ours"] = Sb3VecEnv(ENVIRONMENT, robots, seed=0, randomization="none", precision="float32")
    try:
        contenders = {name: _updates(vector, size, ours=name == "ours") for name, vector in vectors.items()}
        values = interleave(contenders, size.rounds)
    finally:
        for vector in vectors.values():
            vector.close()
        torch.set_num_threads(threads)
    peers = {f"{name} on MuJoCo": series for name, series in values.items() if name != "ours"}
    return [against_fastest("ppo", f"PPO frames, {robots} robots, float32", "1/s", values["ours"], peers, 7.0)]


def _updates(vector: VecEnv, size: Size, *, ours: bool) -> Contender:
    """Batch sizes suit each: few large minibatches for our many robots, as many samples as a few robots give in 1-2 s."""
    steps = size(32 if ours else 2048 // vector.num_envs, 8)
    samples = steps * vector.num_envs
    batch_size = min(samples, 2048 if ours else 512)
    model = PPO("MlpPolicy", vector, n_steps=steps, batch_size=batch_size, n_epochs=EPOCHS, seed=0, device="cpu")
    frames = samples * size(4 if ours else 1, 1)

    def run() -> float:
        return rate(lambda: model.learn(frames, reset_num_timesteps=False), frames)

    return run
