"""The training loop: updates, stopping in good order, resuming; and what a training writes.

A checkpoint holds the learner and a snapshot of all robots. So a run that was killed or stopped, and resumed from a checkpoint,
continues exactly, bit for bit, as it would have without the interruption.
"""

from __future__ import annotations

import math
import pickle
import random
import shutil
import signal
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from rich.console import Console
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule

from wlr_gym.base.errors import InputError
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import provenance, record_provenance, write_yaml
from wlr_gym.base.text import quoted
from wlr_gym.envs.core import Core
from wlr_gym.envs.sb3 import Sb3VecEnv
from wlr_gym.learning.curves import METRICS, CurveFile, best_of, is_better, read_curve
from wlr_gym.learning.evaluation.metrics import summarise
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.learning.ppo import networks
from wlr_gym.learning.ppo.policy import (
    MODEL_FILE,
    PpoConfig,
    PpoPolicy,
    each_joint,
    network_kind,
    parse_settings,
    with_network_of,
)
from wlr_gym.physics.floor import FloorFriction, load_floor
from wlr_gym.policy import Training, TrainingProgress, fed_environment, read_contract, write_contract

#: Control steps over which observations are gathered for their scales.
GATHERED = 100
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
        TrainingError: a loss, weight or observation is not finite.
        Exception: what ``on_update`` raised, after a checkpoint was saved.
    """
    config = parse_settings(training.config)
    checkpoints = sorted((training.folder / CHECKPOINTS).glob("step_*")) if training.resume else []
    if training.init is not None and not checkpoints:  # a checkpoint has all of it: the policy may be gone
        config = with_network_of(config, training.init)
    threads = torch.get_num_threads()
    env = Sb3VecEnv(training.environment, config.num_envs, **config.environment)
    try:
        torch.set_num_threads(config.torch_threads)
        model = make_model(env, config)
        if checkpoints:
            restore_checkpoint(checkpoints[-1], model, env)
        else:
            _begin(training, config, env, model)
        if training.resume:
            write_yaml(training.folder / "provenance_resumed.yaml", provenance(config.seed))
        else:
            settings = {"environment": training.environment, "agent": "ppo", "settings": config.model_dump(mode="json")}
            settings |= {} if training.init is None else {"init": str(training.init)}
            record_provenance(training.folder, settings, config.seed)
        return _train(training, config, env, model)
    finally:
        torch.set_num_threads(threads)
        env.close()


def _begin(training: Training, config: PpoConfig, env: Sb3VecEnv, model: PPO) -> None:
    if training.resume:
        print(f"{training.folder}: no checkpoint yet; training starts from the beginning", flush=True)
    begin_episodes(model, env, config.seed)
    if config.normalise and training.init is None:
        gather_scales(model, env)
        begin_episodes(model, env, config.seed)
    if training.init is None and config.teacher is None:
        return
    from wlr_gym.learning.ppo.warm_start import imitate, start_from

    if training.init is not None:
        start_from(model, env, config, training.init)
    else:
        imitate(model, env, config)
    begin_episodes(model, env, config.seed)


def gather_scales(model: PPO, env: Sb3VecEnv) -> None:
    """Let the untrained policy drive, and normalise observations by their mean and deviation there; the steps count."""
    groups = []
    for _ in range(GATHERED):
        seen = networks.last_observations(model)
        groups.append(networks.grouped(seen))
        actions, _ = model.predict(seen, deterministic=False)
        networks.go_on_from(model, env.step(np.clip(actions, -1.0, 1.0))[0])
    rows = {name: torch.as_tensor(np.concatenate([one[name] for one in groups])) for name in groups[0]}
    for normaliser in networks.normalisers(model.policy):
        wide = normaliser.mean.shape[0] > rows["policy"].shape[1]
        normaliser.take(torch.cat(list(rows.values()), dim=1) if wide else rows["policy"])
    model.num_timesteps += GATHERED * env.num_envs


def learning_rate(config: PpoConfig) -> Callable[[float], float]:
    """Return the learning rate as a function of the share of the training that remains."""
    first, last = config.learning_rate, config.final_learning_rate
    if config.learning_rate_falls == "linearly":
        return LinearSchedule(first, last, end_fraction=1.0)
    return lambda remaining: last * (first / last) ** remaining


def make_model(env: Sb3VecEnv, config: PpoConfig) -> PPO:
    """Return an untrained Stable-Baselines3 PPO with the configured settings."""
    asymmetric = isinstance(env.observation_space, spaces.Dict)
    mirrored = networks.MirroredDictBuffer if asymmetric else networks.MirroredBuffer
    kind, keywords = network_kind(config, env.contract(), asymmetric=asymmetric)
    model = PPO(
        kind,
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
        policy_kwargs=keywords,
        seed=config.seed,
        device="cpu",
        rollout_buffer_class=mirrored if config.mirror else None,
    )
    with torch.no_grad():
        model.policy.get_parameter("log_std").copy_(torch.tensor(each_joint(config.initial_log_std)))
    if config.mirror:
        networks.set_mirror(model.rollout_buffer, env)
    return model


def _train(training: Training, config: PpoConfig, env: Sb3VecEnv, model: PPO) -> Path:
    with (
        StopRequest() as stop,  # before the first file: who sees one and presses Ctrl-C finds a checkpoint
        closing(TrainingLog(training, config, env, model)) as log,
    ):
        meter = Meter(env.core)
        networks.begin_learning(model, config.total_steps - model.num_timesteps, meter)
        with progress(Console(), shown=training.progress) as tell:
            if not log.scores:
                log.score()
            _updates(log, meter, stop, partial(tell, ""))
        place = log.save_checkpoint()
        if stop.requested:
            raise KeyboardInterrupt(f"interrupted; saved {place}; resume with: wlr train --resume {quoted(training.folder)}")
        if model.num_timesteps >= config.total_steps:
            log.score()
        return log.save(training.folder / "policy")


def _updates(log: TrainingLog, meter: Meter, stop: StopRequest, tell: Callable[[str, float], object]) -> None:
    """Update until the steps or the time are over, or somebody asks to stop."""
    training, config, model = log.training, log.config, log.model
    began, first = time.monotonic(), model.num_timesteps
    while model.num_timesteps < config.total_steps and not stop.requested:
        if training.max_seconds is not None and time.monotonic() - began > training.max_seconds:
            return
        before = model.num_timesteps
        log.env.set_progress(before)
        row = update(model, meter, config)
        seconds, now = time.monotonic() - began, model.num_timesteps
        row |= {"seconds": seconds, "steps_per_second": (now - first) / seconds}
        log.update(row)
        if config.evaluate_every and now // config.evaluate_every > before // config.evaluate_every:
            log.score()
        if now // config.checkpoint_every > before // config.checkpoint_every:
            log.save_checkpoint()
        done = TrainingProgress(training.folder, now, config.total_steps, row, log.scores)
        score = f"reward {row['reward_per_second']:.3f}/s"
        if "tracking_error" in log.scores:
            score = f"held-out error {log.scores['tracking_error']:.3f}"
        tell(f"training: {score}, {row['steps_per_second']:,.0f} steps/s", (now - first) / (config.total_steps - first))
        if training.on_update is not None:
            try:
                training.on_update(done)
            except BaseException:
                log.save_checkpoint()
                raise
            if done.stop_requested:
                return


def begin_episodes(model: PPO, env: Sb3VecEnv, seed: int) -> None:
    """Start new episodes of all robots; seeds and the curriculum depend on the run's seed and the steps done only.

    These episodes end evenly over the length of one. Otherwise all robots start anew in the same update, a start is in one
    update of some thirty, and each update unlearns it.
    """
    env.set_progress(model.num_timesteps)
    env.seed(int(np.random.SeedSequence([seed, model.num_timesteps]).generate_state(1, np.uint32)[0]))
    networks.go_on_from(model, env.reset(), np.ones(env.num_envs, bool))
    env.core.episodes.sooner[:] = np.arange(env.num_envs) * env.core.limit // env.num_envs


def update(model: PPO, meter: Meter, config: PpoConfig) -> dict[str, float]:
    """Collect samples, improve the networks, and return the row of the learning curve."""
    assert model.env is not None
    reason = ""
    try:
        model.collect_rollouts(model.env, meter, model.rollout_buffer, n_rollout_steps=config.steps_per_env)
        schedule = config.schedule_steps or config.total_steps
        networks.set_share_done(model, min(model.num_timesteps, schedule), schedule)
        if config.desired_kl is not None:  # the rate is the optimiser's own, which checkpoints keep
            model.lr_schedule = ConstantSchedule(model.policy.optimizer.param_groups[0]["lr"])
        model.train()
        if config.desired_kl is not None:
            adapt_rate(model, config.desired_kl)
    except FloatingPointError as error:
        reason = str(error)
    except ValueError:  # torch refuses a distribution that is not finite
        if _healthy(model):
            raise
    if not reason and not _healthy(model):
        reason = "a weight of the network, or its exploration noise, is not finite"
    if reason:
        raise TrainingError(f"{reason} after {model.num_timesteps} steps")
    logged = model.logger.name_to_value
    losses = {name: float(logged.get(f"train/{name}", math.nan)) for name in LOSSES}
    return {"steps": model.num_timesteps, **meter.take(), **losses}


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


# ---- what an update measures -----------------------------------------------------------------------------------------


class TrainingError(RuntimeError):
    """Training met a number that is not finite; the same seed meets it again, also from the newest checkpoint."""


class Meter(networks.StepWatcher):
    """Watches every environment step of an update: sums up what the learning curve shows and stops at non-finite numbers."""

    def __init__(self, core: Core) -> None:
        super().__init__()
        self.core = core
        self._clear()

    def _clear(self) -> None:
        self._ticks, self._robots, self._reward, self._slip = 0, 0, 0.0, 0.0
        self._terms = np.zeros(len(self.core.task.rewards))
        self._episodes, self._falls = 0, 0

    def on_robots_stepped(self) -> None:
        """Add up a step."""
        rewards, dones = self.locals["rewards"], self.locals["dones"]
        if not all(np.isfinite(array).all() for array in (rewards, *networks.grouped(self.locals["new_obs"]).values())):
            raise TrainingError(f"an observation or reward is not finite after {self.num_timesteps} steps")
        going_on = ~dones
        slip = self.core.plant.truth()["slip_velocity"].reshape(-1, 4, 2)
        self._ticks += 1
        self._reward += float(rewards.mean(dtype=np.float64))
        self._robots += int(going_on.sum())
        self._terms += self.core.scores.terms[going_on].sum(axis=0)
        self._slip += float(np.sqrt((slip * slip).sum(axis=-1)).mean(axis=-1)[going_on].sum())
        for row in np.flatnonzero(dones):
            self._episodes += 1
            self._falls += not self.locals["infos"][row]["TimeLimit.truncated"]

    def take(self) -> dict[str, float]:
        """Return the means since the last call, rewards per second; terms and slip over robots whose episode continued."""
        period = self.core.task.config.control_period
        terms = self._terms / max(self._robots, 1) / period
        means = {"reward_per_second": self._reward / max(self._ticks, 1) / period}
        means |= {f"term.{name}": float(value) for name, value in zip(self.core.task.rewards, terms, strict=True)}
        means |= {"slip_speed": self._slip / max(self._robots, 1), "episodes": self._episodes, "falls": self._falls}
        self._clear()
        return means


# ---- what a training writes ------------------------------------------------------------------------------------------


CURVE_FILE = "learning_curve.csv"
SCORES_FILE = "held_out.csv"
BEST, CHECKPOINTS = "best", "checkpoints"
#: Of an update, as Stable-Baselines3 records them.
LOSSES = ("policy_gradient_loss", "value_loss", "approx_kl", "explained_variance", "std")


class TrainingLog:
    """Writes the run folder of one training; a resumed one goes on in the same files.

    Args:
        training, config, env, model: what is being trained; ``model`` is where the run (re)starts.

    Attributes:
        training, config, env, model: as given.
        scores: newest row of ``held_out.csv``; empty before the first.
        best: that of the policy in ``best/``.
    """

    def __init__(self, training: Training, config: PpoConfig, env: Sb3VecEnv, model: PPO) -> None:
        self.training, self.config, self.env, self.model = training, config, env, model
        folder, steps = training.folder, model.num_timesteps
        self._curve = CurveFile(folder / CURVE_FILE, steps)
        self._scores = CurveFile(folder / SCORES_FILE, steps) if config.evaluate_every else None
        rows = read_curve(folder / SCORES_FILE) if self._scores else []
        self.scores: Mapping[str, float] = rows[-1] if rows else {}
        self.best: Mapping[str, float] = best_of(rows)
        self._episodes = HeldOutEpisodes(training.environment, config) if config.evaluate_every else None
        model.set_logger(Logger(str(folder), [networks.ResumedTensorBoard(folder / "tensorboard", steps)]))

    def close(self) -> None:
        """Release the plant of the held-out episodes; the files are complete at any time."""
        self.model.logger.close()
        if self._episodes is not None:
            self._episodes.close()

    def update(self, row: Mapping[str, float]) -> None:
        """Write what an update measured."""
        self._curve.append(row)
        for name, value in row.items():
            if name != "steps" and name not in LOSSES:  # Stable-Baselines3 records the losses itself
                group = "reward" if name.startswith("term.") else "training"
                self.model.logger.record(f"{group}/{name.removeprefix('term.')}", value)
        self.model.logger.dump(step=self.model.num_timesteps)

    def score(self) -> None:
        """Score the present policy on the held-out episodes, once per step count; keep it where it is the best so far."""
        steps = self.model.num_timesteps
        if self._episodes is None or self._scores is None or self.scores.get("steps") == steps:
            return
        self.scores = {"steps": steps, **self._episodes.score(self.model)}
        self._scores.append(self.scores)
        for name, value in self.scores.items():
            if name != "steps":
                self.model.logger.record(f"held_out/{name}", value)
        self.model.logger.dump(step=steps)
        if is_better(self.scores, self.best):
            self.best = self.scores
            self.save(self.training.folder / BEST)

    def save_checkpoint(self) -> Path:
        """Write a checkpoint that the training can be resumed from; drop the oldest."""
        checkpoints = self.training.folder / CHECKPOINTS
        place = self.save(checkpoints / f"step_{self.model.num_timesteps:012d}", to_resume=True)  # names sort by steps
        for old in sorted(checkpoints.glob("step_*"))[: -self.config.keep_checkpoints]:
            shutil.rmtree(old)
        return place

    def save(self, place: Path, *, to_resume: bool = False) -> Path:
        """Write the present policy into a folder; see :func:`write_policy`."""
        notes = {"environment": self.training.environment}
        if self.scores.get("steps") == self.model.num_timesteps:
            notes |= {"held_out": {name: value for name, value in self.scores.items() if name != "steps"}}
        return write_policy(place, self.model, self.config, self.env, notes, to_resume=to_resume)


#: Seed of the first held-out episode; those of ``wlr evaluate`` lie above: its scores owe nothing to the choice of the best.
FIRST_SEED = 90_000
#: Keywords of the training's environment that say which robot and plant are scored.
SAME = ("backend", "plant", "robot", "floor", "effects", "precision", "control_period", "free_wheels", "threads")


class HeldOutEpisodes:
    """Fixed episodes that neither training nor ``wlr evaluate`` has: the task as it is scored, with its own
    randomisation, commands and length, on the robot, floor and plant of the training, by the training's own measures and limits
    of success where it has some. Where the floor states friction, which
    the task would draw, the randomisation is the training's.

    Args:
        environment: id.
        config: of the training.
    """

    def __init__(self, environment: str, config: PpoConfig) -> None:
        states_friction = load_floor(config.environment.get("floor")).friction != FloorFriction()
        kept = (*SAME, "randomization") if states_friction else SAME
        same = {name: config.environment[name] for name in kept if name in config.environment}
        task = config.environment.get("task")
        own = {key: task[key] for key in ("measures", "success") if key in task} if isinstance(task, Mapping) else {}
        fed = fed_environment(config.environment)
        fed |= {"task": {**fed.get("task", {}), **own}} if own else {}
        self.core = make_core(environment, config.evaluation_episodes, same | fed)

    def score(self, model: PPO) -> dict[str, float]:
        """Return :data:`METRICS` of the present policy, means over the episodes; the training notices nothing."""
        played = summarise([roll_out(self.core, PpoPolicy(model.policy), FIRST_SEED)])
        sums = {name: played.pairs[name].sum(axis=(0, 1, 2)) for name in METRICS}
        return {name: float(total / count) for name, (total, count) in sums.items() if count > 0.0}

    def close(self) -> None:
        """Release the plant."""
        self.core.close()


# ---- checkpoints -----------------------------------------------------------------------------------------------------


RANDOM_FILE = "random_state.pt"
ROBOTS_FILE = "robots.pkl"


def write_policy(
    folder: Path, model: PPO, config: PpoConfig, env: Sb3VecEnv, notes: Mapping[str, Any], *, to_resume: bool = False
) -> Path:
    """Write weights, optimiser, contract and step count into ``folder``, in one step, replacing what is there.

    Args:
        folder: of the policy or checkpoint.
        model, config, env: what trains.
        notes: what the contract says of the training besides: its environment's id, scores.
        to_resume: also write random state and robots, so that :func:`restore_checkpoint` goes on from there. Robots of a
            plant whose state cannot be set begin new episodes.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir()
    model.save(temporary / MODEL_FILE)
    if to_resume:
        torch.save(random_state(), temporary / RANDOM_FILE)
        can_set_state = env.core.plant.capabilities.can_set_state
        robots = (env.get_state() if can_set_state else None, networks.episode_starts(model))
        (temporary / ROBOTS_FILE).write_bytes(pickle.dumps(robots))
    noise = float(model.policy.get_parameter("log_std").detach().mean())
    done = {"steps": model.num_timesteps, "updates": networks.updates_done(model)}
    training = {**done, "seed": config.seed, "log_std": noise, **notes}
    write_contract(temporary, "ppo", config.model_dump(mode="json"), env.contract(), training)
    shutil.rmtree(folder, ignore_errors=True)
    temporary.replace(folder)
    return folder


def restore_checkpoint(folder: Path, model: PPO, env: Sb3VecEnv) -> None:
    """Put weights, optimiser, step count, random state and robots of a checkpoint into ``model`` and ``env``.

    Raises:
        InputError: the checkpoint cannot be read.
    """
    training = read_contract(folder)["training"]
    try:
        model.set_parameters(str(folder / MODEL_FILE), exact_match=True, device="cpu")
        state = torch.load(folder / RANDOM_FILE, weights_only=True)
        snapshot, starts = pickle.loads((folder / ROBOTS_FILE).read_bytes())  # as trusted as the model's own file
    except Exception as error:  # zip, pickle and torch each raise their own kinds for a broken file
        raise InputError(f"{folder}: not a readable checkpoint: {error}") from None
    model.num_timesteps = training["steps"]
    networks.set_updates_done(model, training["updates"])
    networks.go_on_from(model, env.reset(), np.ones(env.num_envs, bool))
    if snapshot is not None:
        networks.go_on_from(model, env.set_state(snapshot), starts)
    set_random_state(state)


def random_state() -> dict[str, Any]:
    """Return the state of the global generators of torch, numpy and Python."""
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)  # noqa: NPY002 - minibatches use it
    numpy_state = (str(name), torch.from_numpy(np.asarray(keys, dtype=np.int64)), int(position), int(has_gauss), float(gauss))
    return {"torch": torch.get_rng_state(), "numpy": numpy_state, "python": random.getstate()}


def set_random_state(state: dict[str, Any]) -> None:
    """Set the global generators to a saved state."""
    name, keys, position, has_gauss, gauss = state["numpy"]
    torch.set_rng_state(state["torch"])
    np.random.set_state((name, keys.numpy().astype(np.uint32), position, has_gauss, gauss))  # noqa: NPY002
    version, words, gauss_next = state["python"]
    random.setstate((version, tuple(words), gauss_next))


# ---- Ctrl-C ----------------------------------------------------------------------------------------------------------


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
