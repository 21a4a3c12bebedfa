"""One robot as a ``gymnasium.Env``."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle

from wlr_gym.envs.actions import read_actions
from wlr_gym.envs.core import Core
from wlr_gym.envs.episodes import read_seed
from wlr_gym.envs.methods import TaskMethods
from wlr_gym.envs.pictures import Pictures, check_render_mode, metadata
from wlr_gym.envs.settings import read_settings


class WlrEnv(TaskMethods, gym.Env[Any, np.ndarray], EzPickle):
    """One robot on a task. Subclasses name the task; keywords are those of :class:`wlr_gym.envs.settings.Settings`."""

    task_name: ClassVar[str]
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(self, *, render_mode: str | None = None, **keywords: Any) -> None:
        EzPickle.__init__(self, render_mode=render_mode, **keywords)
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.core = Core(self.task_name, read_settings(keywords), 1)
        self.metadata = metadata(self.core.task.config.control_period)
        self.pictures = Pictures(self.core, render_mode)
        self.observation_space = self.core.observation_space
        self.action_space = self.core.action_space
        self._everyone = self.core.everyone
        self._shape = self.core.action_space.shape
        self._rewards = self.core.task.rewards

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: whole number; starts a new, reproducible series of episodes. None continues the present series.
            options: ``command`` {name: value} held for the whole episode; ``parameters`` {name or element: value} set
                after randomisation and effects.

        Raises:
            InputError: a seed or an option that is none.
        """
        super().reset(seed=None if seed is None else read_seed(seed))
        if seed is not None or not self.core.episodes.seeded[0]:
            self.core.seed(0, self.np_random_seed % 2**64 if seed is None else seed)  # -1 where the user set np_random
        self.core.begin_episodes(self._everyone, options)
        self.pictures.after_step()
        return self.core.observation_of(0), _first_rows(self.core.reset_info())

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance one control step.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1].
            gymnasium.error.ResetNeeded: before the first reset.
        """
        core = self.core
        done = core.step(read_actions(action, self._shape)[None], self._everyone)
        info: dict[str, Any] = {"reward_terms": dict(zip(self._rewards, core.scores.terms[0].tolist(), strict=True))}
        info |= {name: value[0] for name, value in core.contact_info().items()}
        if core.robots.changed[0]:
            info |= _first_rows(core.change_info())
        if done:
            info |= _first_rows(core.episode_info())
        self.pictures.after_step()
        return core.observation_of(0), float(core.reward[0]), bool(core.terminated[0]), bool(core.truncated[0]), info

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


def _first_rows(batched: dict[str, Any]) -> dict[str, Any]:
    """Turn the core's {key: {name: (1,)}} into {key: {name: float}}."""
    return {key: {name: float(value[0]) for name, value in group.items()} for key, group in batched.items()}
