"""The training loop: updates, learning curve, checkpoints, stopping in good order, resuming.

Every checkpoint starts new episodes with seeds made from the run's seed and the steps done. So a run that was killed and
resumed from a checkpoint continues exactly, bit for bit, as it would have without the interruption.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
import torch
from gymnasium import spaces
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule

from wlr_gym.base.files import make_output_folder
from wlr_gym.base.provenance import provenance, record_provenance, write_yaml
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.ppo import checkpoint
from wlr_gym.learning.ppo.asymmetric import AsymmetricPolicy
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.learning.ppo.curve import LearningCurve, Meter, losses
from wlr_gym.learning.ppo.policy import parse_settings, policy_keywords
from wlr_gym.learning.ppo.warm_start import imitate
from wlr_gym.policy import Training


def run_training(training: Training) -> Path:
    """Train and return the folder of the final policy.

    The run folder then holds ``config.yaml``, ``provenance.yaml``, ``learning_curve.csv``, ``tensorboard/``,
    ``checkpoints/step_.../`` (each a policy folder) and ``policy/``.

    Raises:
        InputError: bad settings.
        KeyboardInterrupt: after a checkpoint was saved; the message says how to resume.
        TrainingError: a loss, weight or observation is not finite; the message names the file with the state.
    """
    config = parse_settings(training.config)
    torch.set_num_threads(config.torch_threads)
    env = Sb3VecEnv(training.environment, config.num_envs, **config.environment)
    try:
        _record(training, config)
        return _train(training, config, env)
    finally:
        env.close()


def _record(training: Training, config: PpoConfig) -> None:
    if training.resume:
        write_yaml(training.folder / "provenance_resumed.yaml", provenance(config.seed))
        return
    make_output_folder(training.folder)  # only now: bad settings leave nothing behind
    settings = {"environment": training.environment, "agent": "ppo", "settings": config.model_dump(mode="json")}
    record_provenance(training.folder, settings, config.seed)


def learning_rate(config: PpoConfig) -> Callable[[float], float]:
    """Return the learning rate as a function of the share of the training that remains."""
    first, last = config.learning_rate, config.final_learning_rate
    if config.learning_rate_falls == "linearly":
        return LinearSchedule(first, last, end_fraction=1.0)
    return lambda remaining: last * (first / last) ** remaining


def make_model(env: Sb3VecEnv, config: PpoConfig) -> PPO:
    """Return an untrained Stable-Baselines3 PPO with the configured settings."""
    return PPO(
        "MlpPolicy" if isinstance(env.observation_space, spaces.Box) else AsymmetricPolicy,
        env,
        learning_rate=learning_rate(config),
        n_steps=config.steps_per_env,
        batch_size=config.batch_size,
        n_epochs=config.epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        ent_coef=config.entropy_coefficient,
        vf_coef=config.value_coefficient,
        max_grad_norm=config.max_gradient_norm,
        target_kl=config.target_kl,
        policy_kwargs=policy_keywords(config),
        seed=config.seed,
        device="cpu",
    )


def _train(training: Training, config: PpoConfig, env: Sb3VecEnv) -> Path:
    folder = training.folder
    model = make_model(env, config)
    start = checkpoint.newest(folder / "checkpoints") if training.resume else None
    if start is not None:
        checkpoint.restore(start, model)
    elif training.resume:
        print(f"{folder}: no checkpoint yet; training starts from the beginning", flush=True)
    begin_episodes(model, env, config.seed)
    if start is None and config.teacher is not None:
        imitate(model, env, config)
        begin_episodes(model, env, config.seed)
    curve = LearningCurve(folder / "learning_curve.csv", model.num_timesteps)
    meter = Meter(env.core, folder / "failure.npz")
    model.set_logger(configure(str(folder / "tensorboard"), ["tensorboard"]))
    model._setup_learn(config.total_steps - model.num_timesteps, callback=meter, reset_num_timesteps=False)
    began, first = time.monotonic(), model.num_timesteps

    def out_of_time() -> bool:
        return training.max_seconds is not None and time.monotonic() - began > training.max_seconds

    with StopRequest() as stop, _progress(training, config, first) as show:
        while model.num_timesteps < config.total_steps and not stop.requested and not out_of_time():
            before = model.num_timesteps
            env.set_progress(before)
            row = update(model, meter, config)
            seconds = time.monotonic() - began
            row |= {"seconds": seconds, "steps_per_second": (model.num_timesteps - first) / seconds}
            _log(model, curve, row)
            show(row)
            if model.num_timesteps // config.checkpoint_every > before // config.checkpoint_every:
                _save_checkpoint(training, config, env, model)
                begin_episodes(model, env, config.seed)
    if model.num_timesteps < config.total_steps:  # nothing is lost: --resume continues from here
        place = _save_checkpoint(training, config, env, model)
        if stop.requested:
            raise KeyboardInterrupt(f"interrupted; saved {place}; resume with: wlr train --resume {folder}")
    return checkpoint.save(folder / "policy", model, config, env.contract(), training.environment)


def begin_episodes(model: PPO, env: Sb3VecEnv, seed: int) -> None:
    """Start new episodes of all robots; seeds and the curriculum depend on the run's seed and the steps done only."""
    env.set_progress(model.num_timesteps)
    env.seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1, np.uint32)[0]))
    model._last_obs = env.reset()
    model._last_episode_starts = np.ones(env.num_envs, dtype=bool)


def update(model: PPO, meter: Meter, config: PpoConfig) -> dict[str, float]:
    """Collect samples, improve the networks, and return the row of the learning curve."""
    assert model.env is not None
    try:
        model.collect_rollouts(model.env, meter, model.rollout_buffer, n_rollout_steps=config.steps_per_env)
        model._update_current_progress_remaining(model.num_timesteps, config.total_steps)
        model.train()
    except FloatingPointError as error:
        meter.fail(str(error))
    except ValueError:  # torch refuses a distribution that is not finite
        if _healthy(model):
            raise
    if not _healthy(model):
        meter.fail("a weight of the network, or its exploration noise, is not finite")
    return {"steps": model.num_timesteps, **meter.take(), **losses(model.logger.name_to_value)}


def _healthy(model: PPO) -> bool:
    noise = torch.exp(model.policy.get_parameter("log_std"))
    finite = all(bool(torch.isfinite(weights).all()) for weights in [*model.policy.parameters(), noise])
    return finite and bool((noise > 0).all())


def _log(model: PPO, curve: LearningCurve, row: dict[str, float]) -> None:
    curve.append(row)
    for name, value in row.items():
        if name != "steps":
            model.logger.record(f"{'reward' if name.startswith('term.') else 'training'}/{name.removeprefix('term.')}", value)
    model.logger.dump(step=model.num_timesteps)


def _save_checkpoint(training: Training, config: PpoConfig, env: Sb3VecEnv, model: PPO) -> Path:
    checkpoints = training.folder / "checkpoints"
    place = checkpoints / checkpoint.name_of(model.num_timesteps)
    checkpoint.save(place, model, config, env.contract(), training.environment)
    checkpoint.drop_old(checkpoints, config.keep_checkpoints)
    return place


class StopRequest:
    """Turns the first Ctrl-C into a request to stop after the present update; a second one interrupts at once."""

    def __init__(self) -> None:
        self.requested = False
        self._catching = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> StopRequest:
        if self._catching:
            self._previous = signal.signal(signal.SIGINT, self._take)
        return self

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True

    def __exit__(self, *_: object) -> None:
        if self._catching:
            signal.signal(signal.SIGINT, self._previous)


@contextmanager
def _progress(training: Training, config: PpoConfig, first: int) -> Iterator[Callable[[dict[str, float]], None]]:
    """Show a progress bar over the steps; yields a function that is given rows of the learning curve."""
    text = TextColumn("{task.fields[speed]:,.0f} steps/s, reward {task.fields[reward]:.3f}/s, slip {task.fields[slip]:.3f} m/s")
    columns = (TextColumn("training"), BarColumn(), TaskProgressColumn(), text, TimeRemainingColumn())
    with Progress(*columns, disable=not training.progress) as bar:
        task = bar.add_task("", total=config.total_steps, completed=first, speed=0.0, reward=0.0, slip=0.0)

        def show(row: dict[str, float]) -> None:
            speed, reward, slip = row["steps_per_second"], row["reward_per_second"], row["slip_speed"]
            bar.update(task, completed=row["steps"], speed=speed, reward=reward, slip=slip)

        yield show
