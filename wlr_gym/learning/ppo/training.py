"""The training loop: updates, stopping in good order, resuming.

A checkpoint holds the learner and a snapshot of all robots. So a run that was killed or stopped, and resumed from a checkpoint,
continues exactly, bit for bit, as it would have without the interruption.
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
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule

from wlr_gym.base.files import make_output_folder
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import provenance, record_provenance, write_yaml
from wlr_gym.envs import Sb3VecEnv
from wlr_gym.learning.ppo import checkpoint
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.learning.ppo.curve import Meter, losses
from wlr_gym.learning.ppo.mirror import MirroredBuffer, MirroredDictBuffer, set_mirror
from wlr_gym.learning.ppo.policy import parse_settings, policy_class, policy_keywords, with_network_of
from wlr_gym.learning.ppo.training_log import TrainingLog
from wlr_gym.learning.ppo.warm_start import gather_scales, imitate, start_from
from wlr_gym.policy import Training, TrainingProgress

#: Factor by which an adapting learning rate changes after an update, and where it stays.
RATE_STEP, LOWEST_RATE, HIGHEST_RATE = 1.5, 1e-5, 1e-2


def run_training(training: Training) -> Path:
    """Train and return the folder of the final policy.

    The run folder then holds ``config.yaml``, ``provenance.yaml``, ``learning_curve.csv``, ``held_out.csv``, ``tensorboard/``,
    ``checkpoints/step_.../`` (each a policy folder), ``best/`` (the policy that did best on the held-out episodes) and
    ``policy/``.

    Raises:
        InputError: bad settings, or a policy to start from that does not fit.
        KeyboardInterrupt: stopped by Ctrl-C or SIGTERM, after a checkpoint was saved; the message says how to resume.
        TrainingError: a loss, weight or observation is not finite; the message names the file with the state.
        Exception: what ``on_update`` raised, after a checkpoint was saved.
    """
    config = parse_settings(training.config)
    start = checkpoint.newest(training.folder / "checkpoints") if training.resume else None
    if training.init is not None and start is None:  # a checkpoint has all of it: the policy may be gone
        config = with_network_of(config, training.init)
    env = Sb3VecEnv(training.environment, config.num_envs, **config.environment)
    try:
        with torch_threads(config.torch_threads):
            model = make_model(env, config)
            if start is not None:
                checkpoint.restore(start, model, env)
            else:
                _begin(training, config, env, model)
            _record(training, config)
            return _train(training, config, env, model)
    finally:
        env.close()


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use so many threads, and as many as before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _begin(training: Training, config: PpoConfig, env: Sb3VecEnv, model: PPO) -> None:
    if training.resume:
        print(f"{training.folder}: no checkpoint yet; training starts from the beginning", flush=True)
    begin_episodes(model, env, config.seed)
    if config.normalise and training.init is None:
        gather_scales(model, env)
        begin_episodes(model, env, config.seed)
    if training.init is not None:
        start_from(model, env, config, training.init)
    elif config.teacher is not None:
        imitate(model, env, config)
    else:
        return
    begin_episodes(model, env, config.seed)


def _record(training: Training, config: PpoConfig) -> None:
    if training.resume:
        write_yaml(training.folder / "provenance_resumed.yaml", provenance(config.seed))
        return
    make_output_folder(training.folder)  # only now: bad settings leave nothing behind
    settings = {"environment": training.environment, "agent": "ppo", "settings": config.model_dump(mode="json")}
    if training.init is not None:
        settings["init"] = str(training.init)
    record_provenance(training.folder, settings, config.seed)


def learning_rate(config: PpoConfig) -> Callable[[float], float]:
    """Return the learning rate as a function of the share of the training that remains."""
    first, last = config.learning_rate, config.final_learning_rate
    if config.learning_rate_falls == "linearly":
        return LinearSchedule(first, last, end_fraction=1.0)
    return lambda remaining: last * (first / last) ** remaining


def make_model(env: Sb3VecEnv, config: PpoConfig) -> PPO:
    """Return an untrained Stable-Baselines3 PPO with the configured settings."""
    asymmetric = isinstance(env.observation_space, spaces.Dict)
    model = PPO(
        policy_class(config, asymmetric=asymmetric),
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
        policy_kwargs=policy_keywords(config, env.contract()),
        seed=config.seed,
        device="cpu",
        rollout_buffer_class=(MirroredDictBuffer if asymmetric else MirroredBuffer) if config.mirror else None,
    )
    with torch.no_grad():
        model.policy.get_parameter("log_std").copy_(torch.tensor(config.initial_log_stds()))
    if config.mirror:
        set_mirror(model.rollout_buffer, env)
    return model


def _train(training: Training, config: PpoConfig, env: Sb3VecEnv, model: PPO) -> Path:
    with StopRequest() as stop:  # before the first file: who sees one and presses Ctrl-C finds a checkpoint
        log = TrainingLog(training, config, env, model)
        try:
            meter = Meter(env.core, training.folder / "failure.npz")
            model._setup_learn(config.total_steps - model.num_timesteps, callback=meter, reset_num_timesteps=False)
            with _progress(training, config, model.num_timesteps) as show:
                if not log.scores:
                    log.score()
                _updates(log, meter, stop, show)
            place = log.save_checkpoint()
            if stop.requested:
                raise KeyboardInterrupt(f"interrupted; saved {place}; resume with: wlr train --resume {training.folder}")
            if model.num_timesteps >= config.total_steps:
                log.score()
            return log.save_policy()
        finally:
            log.close()


def _updates(log: TrainingLog, meter: Meter, stop: StopRequest, show: Callable[[TrainingProgress], None]) -> None:
    """Update until the steps or the time are over, or somebody asks to stop."""
    training, config, model = log.training, log.config, log.model
    began, first = time.monotonic(), model.num_timesteps
    stopped = False
    while model.num_timesteps < config.total_steps and not (stop.requested or stopped):
        if training.max_seconds is not None and time.monotonic() - began > training.max_seconds:
            return
        before = model.num_timesteps
        log.env.set_progress(before)
        row = update(model, meter, config)
        seconds = time.monotonic() - began
        row |= {"seconds": seconds, "steps_per_second": (model.num_timesteps - first) / seconds}
        log.update(row)
        if config.evaluate_every and crossed(config.evaluate_every, before, model.num_timesteps):
            log.score()
        if crossed(config.checkpoint_every, before, model.num_timesteps):
            log.save_checkpoint()
        progress = TrainingProgress(training.folder, model.num_timesteps, config.total_steps, row, log.scores)
        show(progress)
        if training.on_update is not None:
            try:
                training.on_update(progress)
            except BaseException:
                log.save_checkpoint()
                raise
            stopped = progress.stop_requested


def crossed(every: int, before: int, now: int) -> bool:
    """Return whether a multiple of ``every`` steps was reached."""
    return now // every > before // every


def begin_episodes(model: PPO, env: Sb3VecEnv, seed: int) -> None:
    """Start new episodes of all robots; seeds and the curriculum depend on the run's seed and the steps done only.

    These episodes end evenly over the length of one. Otherwise all robots start anew in the same update, a start is in one
    update of some thirty, and each update unlearns it.
    """
    env.set_progress(model.num_timesteps)
    env.seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1, np.uint32)[0]))
    model._last_obs = env.reset()
    env.core.episodes.sooner[:] = np.arange(env.num_envs) * env.core.limit // env.num_envs
    model._last_episode_starts = np.ones(env.num_envs, dtype=bool)


def update(model: PPO, meter: Meter, config: PpoConfig) -> dict[str, float]:
    """Collect samples, improve the networks, and return the row of the learning curve."""
    assert model.env is not None
    try:
        model.collect_rollouts(model.env, meter, model.rollout_buffer, n_rollout_steps=config.steps_per_env)
        schedule = config.schedule_steps or config.total_steps
        model._update_current_progress_remaining(min(model.num_timesteps, schedule), schedule)
        if config.desired_kl is not None:  # the rate is the optimiser's own, which checkpoints keep
            model.lr_schedule = ConstantSchedule(model.policy.optimizer.param_groups[0]["lr"])
        model.train()
        if config.desired_kl is not None:
            adapt_rate(model, config.desired_kl)
    except FloatingPointError as error:
        meter.fail(str(error))
    except ValueError:  # torch refuses a distribution that is not finite
        if _healthy(model):
            raise
    if not _healthy(model):
        meter.fail("a weight of the network, or its exploration noise, is not finite")
    return {"steps": model.num_timesteps, **meter.take(), **losses(model.logger.name_to_value)}


def adapt_rate(model: PPO, desired_kl: float) -> None:
    """Change the learning rate by how far the update moved the policy (Schulman et al. 2017, section 4, for the rate)."""
    divergence = model.logger.name_to_value["train/approx_kl"]
    group = model.policy.optimizer.param_groups[0]
    if divergence > 2.0 * desired_kl:
        group["lr"] = max(group["lr"] / RATE_STEP, LOWEST_RATE)
    elif divergence < 0.5 * desired_kl:
        group["lr"] = min(group["lr"] * RATE_STEP, HIGHEST_RATE)


def _healthy(model: PPO) -> bool:
    noise = torch.exp(model.policy.get_parameter("log_std"))
    finite = all(bool(torch.isfinite(weights).all()) for weights in [*model.policy.parameters(), noise])
    return finite and bool((noise > 0).all())


class StopRequest:
    """Turns the first Ctrl-C or SIGTERM into a request to stop after the present update; a second one interrupts at once."""

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self.requested = False
        self._catching = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> StopRequest:
        if self._catching:
            self._previous = {number: signal.signal(number, self._take) for number in self.SIGNALS}
        return self

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True

    def __exit__(self, *_: object) -> None:
        if self._catching:
            for number, handler in self._previous.items():
                signal.signal(number, handler)


@contextmanager
def _progress(training: Training, config: PpoConfig, first: int) -> Iterator[Callable[[TrainingProgress], None]]:
    """Show a progress bar over the steps from the first on; yields a function that is told how far the training is."""
    with progress(Console(), shown=training.progress) as tell:

        def show(progress: TrainingProgress) -> None:
            row, held_out = progress.metrics, progress.held_out
            score = f"reward {row['reward_per_second']:.3f}/s"
            if "tracking_error" in held_out:
                score = f"held-out error {held_out['tracking_error']:.3f}"
            share = (progress.steps - first) / (config.total_steps - first)
            tell("", f"training: {score}, {row['steps_per_second']:,.0f} steps/s", share)

        yield show
