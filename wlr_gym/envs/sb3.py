"""A batch of robots as a Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.envs.episodes import Mask, read_seed
from wlr_gym.envs.interfaces import TaskMethods, row_of, seed_robots
from wlr_gym.envs.registry import task_name_of

require_package("stable_baselines3", "train")

from stable_baselines3.common.vec_env import VecEnv  # noqa: E402

#: Robots in a picture of a batch.
TILES = 16


class Sb3VecEnv(TaskMethods, VecEnv, EzPickle):
    """N robots for Stable-Baselines3, without the loop of ``DummyVecEnv``; bit-identical to it with the same seeds.

    An ended episode is followed by the next in the same step. Its info then holds ``terminal_observation``,
    ``TimeLimit.truncated``, ``episode`` (return ``r``, length ``l`` and time ``t``, as of SB3's ``Monitor``),
    ``episode_reward_terms`` and ``episode_measures``; others are empty, to be cheap (present values of all robots
    are in ``core``: ``reward``, ``measures``, ``plant.truth()``), but for ``randomization`` when it changed, and ``truth`` with
    ``truth_info=True``.

    Args:
        env_id: id such as ``WLR-Velocity-v0``, or the spec of an environment.
        num_envs: N.
        seed: robot i gets seed + i at the first reset; None = fresh entropy.
        max_episode_steps: truncate after so many control steps, if that is before the task's own limit; None = as the spec
            says, -1 = the task's own limit only.
        render_mode: ``rgb_array`` (``render()`` returns the first robots as tiles of one picture), ``human`` (a window with the
            first robot) or None (that of the spec, if it has one).
        **options: those of :class:`wlr_gym.envs.settings.EnvironmentOptions`.
    """

    def __init__(
        self,
        env_id: str | EnvSpec,
        num_envs: int,
        *,
        seed: int | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        spec = _spec_of(env_id)
        given = dict(spec.kwargs)
        definition, its_mode = given.pop("definition", None), given.pop("render_mode", None)
        render_mode = its_mode if render_mode is None else render_mode
        steps = spec.max_episode_steps if max_episode_steps is None else max_episode_steps
        EzPickle.__init__(self, spec, num_envs, seed=seed, max_episode_steps=steps, render_mode=render_mode, **options)
        self._open(definition or task_name_of(spec.id), given | options, num_envs, render_mode)
        self.core.shorten(steps)
        self.spec, shown = spec, self.metadata
        super().__init__(self.core.count, self.core.observation_space, self.core.action_space)
        self.metadata = shown
        self._actions: Any = None
        self._began = time.monotonic()
        if seed is not None:
            self.seed(seed)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Give robot i the seed ``seed + i`` from the next reset on; None draws one."""
        return super().seed(None if seed is None else read_seed(seed))

    def reset(self) -> Any:
        """Start new episodes with the seeds and options given before."""
        seed_robots(self.core, self._seeds, self.core.everyone, lambda: secrets.randbits(64))
        plain = np.array([not options for options in self._options])
        if plain.any():
            self.core.begin_episodes(plain)
        for row in np.flatnonzero(~plain).tolist():
            self.core.begin_episodes(np.arange(self.num_envs) == row, self._options[row])
        self._reset_seeds()
        self._reset_options()
        self._keep_reset_infos(self.core.everyone)
        self.pictures.after_step()
        return self.core.observations()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], Mask, list[dict[str, Any]]]:
        """Advance one control step.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1].
            gymnasium.error.ResetNeeded: before the first reset.
        """
        core = self.core
        any_done = core.step(self._actions, core.everyone)
        reward = core.reward.astype(np.float32)
        infos = self._rows(self._infos.truth(), core.everyone)
        if core.robots.changed.any():
            for info, more in zip(infos, self._rows(self._infos.change(), core.robots.changed), strict=True):
                info |= more
        done = core.terminated | core.truncated
        if any_done:
            since = round(time.monotonic() - self._began, 6)
            for row, more in enumerate(self._rows(self._infos.episode(), done)):
                if done[row]:
                    limit = bool(core.truncated[row] and not core.terminated[row])
                    infos[row] |= {"terminal_observation": core.observations(row), "TimeLimit.truncated": limit, **more}
                    total, steps = float(core.scores.sums[row].sum()), int(core.episodes.steps[row])
                    infos[row]["episode"] = {"r": total, "l": steps, "t": since}
            core.begin_episodes(done)
            self._keep_reset_infos(done)
        self.pictures.after_step()
        return core.observations(), reward, done, infos

    def _keep_reset_infos(self, mask: Mask) -> None:
        infos = self._rows(self._infos.reset(), mask)
        for row in np.flatnonzero(mask).tolist():
            self.reset_infos[row] = infos[row]

    @staticmethod
    def _rows(info: dict[str, Any], mask: Mask) -> list[dict[str, Any]]:
        """Infos of all robots, empty for those outside the mask and where nothing is said."""
        return [row_of(info, row) if info and said else {} for row, said in enumerate(mask.tolist())]

    def render(self, mode: str | None = None) -> NDArray[np.uint8] | None:
        """Return the first robots as tiles of one picture with ``rgb_array``; show the first robot with ``human``.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            InputError: no OpenGL on this machine; the message says what to install or set.
        """
        return self.pictures.show() if self.render_mode == "human" else super().render(mode)

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return the pictures (H, W, 3) of the first :data:`TILES` robots."""
        return [self.pictures.frame(row) for row in range(min(self.num_envs, TILES))]

    def close(self) -> None:
        """Release the plant and what pictures need."""
        self.pictures.close()
        self.core.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute, the same for all robots."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute for all robots."""
        self._require_everyone(attr_name, "set", indices)
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once; the result stands for every robot."""
        self._require_everyone(method_name, "call", indices)
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result] * self.num_envs

    def _require_everyone(self, name: str, verb: str, indices: int | Iterable[int] | None) -> None:
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise InputError(f"'{name}' is shared by all robots: {verb} it without indices")

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False for every robot: there are no single environments to wrap."""
        return [False] * len(list(self._get_indices(indices)))


def _spec_of(environment: Any) -> EnvSpec:
    """Return the spec of an id, which may begin with the module that registers it, or the spec itself."""
    if isinstance(environment, EnvSpec):
        return environment
    if not isinstance(environment, str):
        raise InputError(f"env_id = {environment!r}: expected an id, such as WLR-Velocity-v0, or the spec of an environment")
    task_name_of(environment)
    return gym.spec(environment.rpartition(":")[2])
