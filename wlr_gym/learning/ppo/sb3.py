"""The private names of Stable-Baselines3 that training needs, each behind a public one: what a new version may break."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.utils.tensorboard import SummaryWriter

if TYPE_CHECKING:
    from stable_baselines3 import PPO


def begin_learning(model: PPO, steps: int, watcher: BaseCallback) -> None:
    """Prepare ``steps`` more environment steps, what was learnt before stays; ``watcher`` is told of each."""
    model._setup_learn(steps, callback=watcher, reset_num_timesteps=False)


def set_share_done(model: PPO, steps: int, total: int) -> None:
    """Let schedules be where ``steps`` of ``total`` put them."""
    model._update_current_progress_remaining(steps, total)


def last_observations(model: PPO) -> Any:
    """Return what the robots observe now: (N, D), or {group: (N, ...)}."""
    return model._last_obs


def episode_starts(model: PPO) -> NDArray[np.bool_]:
    """Return whose episode starts now, (N,)."""
    return np.asarray(model._last_episode_starts)


def go_on_from(model: PPO, observations: Any, starts: NDArray[np.bool_] | None = None) -> None:
    """Let the next update begin at ``observations``; ``starts`` (N,): whose episode starts there, None = as before."""
    model._last_obs = observations
    if starts is not None:
        model._last_episode_starts = starts


def updates_done(model: PPO) -> int:
    """Return the number of passes over samples so far."""
    return model._n_updates


def set_updates_done(model: PPO, updates: int) -> None:
    """Count passes from ``updates`` on."""
    model._n_updates = updates


class StepWatcher(BaseCallback):
    """Is called after every environment step of an update."""

    def on_robots_stepped(self) -> None:
        """Look at ``self.locals``: ``rewards``, ``dones``, ``infos``, ``new_obs`` and what else is being collected."""

    def _on_step(self) -> bool:
        self.on_robots_stepped()
        return True


class OpenPolicy(ActorCriticPolicy):
    """A policy that subclasses make the networks of."""

    def make_hidden_layers(self) -> Any:
        """Return the hidden layers of actor and critic."""
        super()._build_mlp_extractor()
        return self.mlp_extractor

    def add_layers(self) -> None:
        """Change networks that are made and initialised, before the optimiser gets their weights."""

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = self.make_hidden_layers()

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.add_layers()
        keywords: dict[str, Any] = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **keywords)


class EditedSamples:
    """Laid over a rollout buffer: each minibatch is edited before it is learnt from; sampling is as ever."""

    def edit(self, samples: Any) -> None:
        """Change ``observations`` and ``actions`` of the samples in place."""

    def _get_samples(self, batch_inds: NDArray[np.intp], env: Any = None) -> Any:
        samples = super()._get_samples(batch_inds, env)  # type: ignore[misc]
        self.edit(samples)
        return samples


class ResumedTensorBoard(TensorBoardOutputFormat):
    """TensorBoard's files; what an interrupted run wrote beyond ``steps`` is no longer shown."""

    def __init__(self, folder: Path, steps: int) -> None:
        self.writer = SummaryWriter(str(folder), purge_step=steps or None)
        self._is_closed = False
