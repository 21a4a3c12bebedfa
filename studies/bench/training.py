"""Speed of Stable-Baselines3's PPO on our batch, and the time it takes to learn, against the same on MuJoCo environments."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from studies.bench.measure import Contender, Measurement, Size, against_fastest, interleave, rate
from studies.bench.mujoco_loop import BACKEND, register_backend
from studies.bench.speed import ENVIRONMENT
from wlr_gym.base.errors import require_package

require_package("stable_baselines3", "train")

import gymnasium as gym  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv  # noqa: E402

from wlr_gym.envs import Sb3VecEnv  # noqa: E402
from wlr_gym.envs.tasks.task import read_task  # noqa: E402
from wlr_gym.policy import load_agent_config  # noqa: E402

EPOCHS = 4
#: Behind a peer's name.
ON_MUJOCO = " on MuJoCo"
#: Reward per second of simulated time, exploration included, from which the task counts as learnt: both tracking kernels are
#: beyond 0.93 then, where errors at the scales of the tracking error (0.02 m/s, 0.06 rad/s) would give 0.90 and 0.91.
SOLVED = 1.7
#: Frames over which it is averaged.
WINDOW = 16_384
#: Frames after which a run is given up.
MOST_FRAMES = 4_000_000
#: A peer is given up after so many times our wall time.
PATIENCE = 10.0
#: Settings with which each learnt fastest of those tried (docs/policies.md): many robots, few large minibatches; few robots,
#: more and smaller ones. ``samples`` are those of an update.
OUR_ROBOTS = 256
OURS = {"samples": 8192, "batch_size": 512, "learning_rate": 2e-3}
PEERS = {"samples": 1024, "batch_size": 128, "learning_rate": 1.5e-3}


def keywords() -> dict[str, Any]:
    """Return what both sides are made with: nothing random, and no slip observer, whose work is the same on both."""
    return {"randomization": "none", "task": load_agent_config("ppo_blind")["environment"]["task"]}


def make_mujoco_env() -> gym.Env:
    """Return the environment on the MuJoCo loop, in any process."""
    register_backend()
    return _WithClock(gym.make(f"wlr_gym:{ENVIRONMENT}", backend=BACKEND, **keywords()))


class _WithClock(gym.Wrapper):
    def processor_seconds(self) -> float:
        """Return what the process of this environment has used."""
        return time.process_time()


def measure_ppo(size: Size) -> list[Measurement]:
    """Frames per second of whole PPO updates (64x64 networks, one torch thread); ours as ``wlr train`` sets it up."""
    robots, workers = size(512, 16), (2,) if size.quick else (2, 8)
    with _vectors(robots, workers) as vectors:
        contenders = {name: _updates(vector, size, ours=name == "ours") for name, vector in vectors.items()}
        values = interleave(contenders, size.rounds, tell=size.tell)
    return [_against_peers("ppo", f"PPO frames, {robots} robots, float32", "1/s", values, 7.0)]


def measure_learning(size: Size) -> list[Measurement]:
    """Wall time in which PPO learns the task from nothing; every round has another seed, the same for all.

    A peer that has not learnt it in :data:`PATIENCE` times our wall time is given up; the ratio is a lower bound then.
    """
    robots = size(OUR_ROBOTS, 16)
    with _vectors(robots, (2,)) as vectors:
        for name, vector in vectors.items():
            _learner(vector, 0, size, ours=name == "ours").learn(vector.num_envs)  # compilation is not measured
        runs: dict[str, list[_Run]] = {name: [] for name in vectors}
        peers = [name for name in vectors if name != "ours"]
        for seed in range(size.rounds):
            ours = _learn(_learner(vectors["ours"], seed, size, ours=True), size, math.inf)
            runs["ours"].append(ours)
            for name in peers:
                runs[name].append(_learn(_learner(vectors[name], seed, size, ours=False), size, PATIENCE * ours.seconds))
    rates = {name: tuple(3600.0 / run.seconds for run in series) for name, series in runs.items()}
    rates["ours"] = tuple(rate if run.solved else 0.0 for rate, run in zip(rates["ours"], runs["ours"], strict=True))
    row = _against_peers("learning", f"times learnt (reward {SOLVED:g}/s), {robots} robots", "1/h", rates, 5.0)
    rows = [replace(row, at_least=any(not run.solved for run in runs[row.peer_name.removesuffix(ON_MUJOCO)]))]
    for name, series in runs.items():
        given_up = sum(not run.solved for run in series)
        who = f"{name}, not learnt in {given_up} of {len(series)}" if given_up else name
        rows += [
            Measurement("learning", f"wall time, {who}", "s", tuple(run.seconds for run in series)),
            Measurement("learning", f"processor time, {who}", "s", tuple(run.processor_seconds for run in series)),
            Measurement("learning", f"frames, {who}", "", tuple(float(run.frames) for run in series)),
        ]
    return rows


@contextmanager
def _vectors(robots: int, workers: tuple[int, ...]) -> Any:
    """Yield ours and its peers by name; one torch thread meanwhile."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    # Workers are forked first, while this process has a single thread; spawned ones would run the command line again.
    vectors: dict[str, VecEnv] = {
        f"SubprocVecEnv({n})": SubprocVecEnv([make_mujoco_env] * n, start_method="fork") for n in workers
    }
    vectors["DummyVecEnv(8)"] = DummyVecEnv([make_mujoco_env] * 8)
    vectors["ours"] = Sb3VecEnv(ENVIRONMENT, robots, seed=0, precision="float32", **keywords())
    try:
        yield vectors
    finally:
        for vector in vectors.values():
            vector.close()
        torch.set_num_threads(threads)


def _against_peers(name: str, what: str, unit: str, values: Mapping[str, tuple[float, ...]], bar: float) -> Measurement:
    peers = {f"{peer}{ON_MUJOCO}": series for peer, series in values.items() if peer != "ours"}
    return against_fastest(name, what, unit, values["ours"], peers, bar)


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


def _learner(vector: VecEnv, seed: int, size: Size, *, ours: bool) -> PPO:
    """The PPO of ``wlr train``, with the batch and learning rate that suit the number of robots."""
    settings: dict[str, Any] = dict(OURS if ours else PEERS)
    steps = size(settings.pop("samples") // vector.num_envs, 8)
    settings["batch_size"] = min(settings["batch_size"], steps * vector.num_envs)
    policy = {"net_arch": [64, 64], "log_std_init": -1.0}
    settings |= {"n_steps": steps, "n_epochs": EPOCHS, "gamma": 0.97, "policy_kwargs": policy, "seed": seed}
    return PPO("MlpPolicy", vector, device="cpu", **settings)


@dataclass(frozen=True)
class _Run:
    """What a training took until the task was learnt, or until it was given up. Processor time is that of all processes."""

    solved: bool
    seconds: float
    processor_seconds: float
    frames: int


def _learn(model: PPO, size: Size, most_seconds: float) -> _Run:
    assert model.env is not None
    watch = _Solved(size(MOST_FRAMES, 1), most_seconds)
    processor, start = _processor_seconds(model.env), time.perf_counter()
    model.learn(10 * MOST_FRAMES, callback=watch)
    seconds = time.perf_counter() - start
    return _Run(watch.solved, seconds, _processor_seconds(model.env) - processor, model.num_timesteps)


def _processor_seconds(vector: VecEnv) -> float:
    """Return what this process and the workers of a ``SubprocVecEnv`` have used."""
    workers = vector.env_method("processor_seconds") if isinstance(vector, SubprocVecEnv) else []
    return time.process_time() + sum(workers)


class _Solved(BaseCallback):
    """Ends the training when the newest frames' mean reward reaches :data:`SOLVED`, or after ``most`` frames or seconds."""

    def __init__(self, most: int, most_seconds: float = math.inf) -> None:
        super().__init__()
        self.most = most
        self._end = time.perf_counter() + most_seconds
        self._goal = SOLVED * read_task("velocity").control_period
        self.solved = False
        self._rewards: list[float] = []

    def _on_step(self) -> bool:
        self._rewards.append(float(np.mean(self.locals["rewards"])))
        ticks = max(1, WINDOW // self.training_env.num_envs)
        newest = self._rewards[-ticks:]
        self.solved = len(newest) == ticks and float(np.mean(newest)) >= self._goal
        return not self.solved and self.num_timesteps < self.most and time.perf_counter() < self._end
