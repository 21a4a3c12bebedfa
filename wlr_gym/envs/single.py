"""One robot as a ``gymnasium.Env``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Unpack

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle

from wlr_gym.base.snapshot import Snapshot
from wlr_gym.envs.actions import read_actions
from wlr_gym.envs.core import Core
from wlr_gym.envs.episodes import own_seed, read_seed
from wlr_gym.envs.infos import Infos, row_of
from wlr_gym.envs.methods import TaskMethods
from wlr_gym.envs.pictures import Pictures, check_render_mode, metadata
from wlr_gym.envs.settings import EnvironmentOptions, read_settings, task_of


# Gymnasium's ``spec`` is a plain attribute; this one completes what is written to it.
class WlrEnv(TaskMethods, gym.Env[Any, np.ndarray], EzPickle):  # pyright: ignore[reportIncompatibleVariableOverride]
    """One robot on a task.

    Args:
        render_mode: ``rgb_array``, ``human`` (a window) or None.
        definition: of the task, with the keys of a task file, where the class is of no task (``task`` is laid over it).
        **options: those of :class:`wlr_gym.envs.settings.EnvironmentOptions`.
    """

    task_name: ClassVar[str | None] = None
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        *,
        render_mode: str | None = None,
        definition: Mapping[str, Any] | None = None,
        **options: Unpack[EnvironmentOptions],
    ) -> None:
        EzPickle.__init__(self, render_mode=render_mode, definition=definition, **options)
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.core = Core(task_of(self.task_name, definition), read_settings(options), 1)
        self.metadata = metadata(self.core.task.config.control_period)
        self.pictures: Pictures = Pictures(self.core, render_mode)
        self._infos = Infos(self.core)
        self.observation_space = self.core.observation_space
        self.action_space = self.core.action_space
        self._everyone = self.core.everyone
        self._shape = self.core.action_space.shape
        self._rewards = self.core.task.rewards

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: whole number; starts a new, reproducible series of episodes. None continues the present series.
            options: ``command`` {name: value} held for the whole episode (the others are drawn); ``parameters`` {name or
                element: value} set after randomisation and effects.

        Raises:
            InputError: a seed or an option that is none.
        """
        super().reset(seed=None if seed is None else read_seed(seed))
        if seed is not None or not self.core.episodes.seeded[0]:
            self.core.seed(0, own_seed(self) if seed is None else seed)
        self.core.begin_episodes(self._everyone, options)
        self.pictures.after_step()
        return self.core.observations(0), row_of(self._infos.reset(), 0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1].
            gymnasium.error.ResetNeeded: before the first reset.
        """
        core = self.core
        done = core.step(read_actions(action, self._shape)[None], self._everyone)
        info: dict[str, Any] = {"reward_terms": dict(zip(self._rewards, core.scores.terms[0].tolist(), strict=True))}
        info |= {name: value[0] for name, value in self._infos.contact().items()}
        if self._infos.has_truth:
            info |= row_of(self._infos.truth(), 0)
        if core.robots.changed[0]:
            info |= row_of(self._infos.change(), 0)
        if done:
            info |= row_of(self._infos.episode(), 0)
        self.pictures.after_step()
        return core.observations(0), float(core.reward[0]), bool(core.terminated[0]), bool(core.truncated[0]), info

    def set_state(self, snapshot: Snapshot, rows: Any = None) -> Any:
        """Put the robot into the state of a snapshot of one robot and return its observation; see
        :meth:`wlr_gym.envs.methods.TaskMethods.set_state`."""
        super().set_state(snapshot, rows)
        return self.core.observations(0)

    def render(self) -> np.ndarray | None:
        """Return the picture (H, W, 3) of the robot with ``rgb_array``; show it with ``human``, which every step does itself.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            InputError: no OpenGL on this machine; the message says what to install or set.
        """
        if self.render_mode is None:
            return self.pictures.warn_without_mode()
        return self.pictures.show() if self.render_mode == "human" else self.pictures.frame(0)

    def close(self) -> None:
        """Release the plant and what pictures need."""
        self.pictures.close()
        self.core.close()
