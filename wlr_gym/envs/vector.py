"""A batch of robots as a ``gymnasium.vector.VectorEnv``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Unpack

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.envs.core import OPTIONS, Core, Mask, read_options
from wlr_gym.envs.episodes import own_seed, read_seed
from wlr_gym.envs.infos import Infos
from wlr_gym.envs.methods import TaskMethods
from wlr_gym.envs.pictures import Pictures, check_render_mode, metadata
from wlr_gym.envs.settings import EnvironmentOptions, read_settings, task_of


# Gymnasium's ``spec`` is a plain attribute; this one completes what is written to it.
class WlrVectorEnv(TaskMethods, VectorEnv[Any, Any, Any], EzPickle):  # pyright: ignore[reportIncompatibleVariableOverride]
    """N robots on a task, bit-identical to N single environments with seeds ``seed + i``.

    Args:
        num_envs: N.
        autoreset_mode: ``NextStep`` (default), ``SameStep`` or ``Disabled``, as text or ``gymnasium.vector.AutoresetMode``.
        max_episode_steps: truncate after so many control steps, if that is before the task's own limit.
        render_mode: ``rgb_array`` (``render()`` returns one picture per robot), ``human`` (a window with the first robot)
            or None.
        definition: as in :class:`wlr_gym.envs.single.WlrEnv`.
        **options: those of :class:`wlr_gym.envs.settings.EnvironmentOptions`.
    """

    task_name: ClassVar[str | None] = None

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        definition: Mapping[str, Any] | None = None,
        **options: Unpack[EnvironmentOptions],
    ) -> None:
        EzPickle.__init__(
            self,
            num_envs,
            autoreset_mode=autoreset_mode,
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,
            definition=definition,
            **options,
        )
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.autoreset_mode: AutoresetMode = _read_mode(autoreset_mode)
        self.core = Core(task_of(self.task_name, definition), read_settings(options), num_envs)
        self.metadata = {**metadata(self.core.task.config.control_period), "autoreset_mode": self.autoreset_mode}
        self.pictures: Pictures = Pictures(self.core, render_mode)
        self._infos = Infos(self.core)
        self.num_envs = self.core.count
        self.core.shorten(max_episode_steps)
        self.single_observation_space = self.core.observation_space
        self.single_action_space = self.core.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    # ---- reset ----

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: one number s (robot i gets s + i), or one number or None per robot. None continues the present series;
                without a seed before, as if it were ``np_random_seed``, or drawn from ``np_random`` where that was set.
            options: as in the single environment, alike for all robots that begin, and ``reset_mask`` (N,) bool: only these.

        Raises:
            InputError: an option, a mask or a seed that is none.
        """
        given = dict(read_options(options, (*OPTIONS, "reset_mask")))
        mask = _read_mask(given.pop("reset_mask", None), self.num_envs)
        seeds = _read_seeds(seed, self.num_envs)
        if isinstance(seed, (int, np.integer)):
            super().reset(seed=int(seed))
        seed_robots(self.core, seeds, mask, lambda: own_seed(self))
        self.core.begin_episodes(mask, given)
        self.pictures.after_step()
        return self.core.observations(), _masked(self._infos.reset(), mask)

    # ---- step ----

    def step(self, actions: Any) -> tuple[Any, NDArray[np.float64], Mask, Mask, dict[str, Any]]:
        """Advance all robots one control step; an ended episode is followed by the next as ``autoreset_mode`` says.

        ``SameStep`` hands out the last observation and info of ended episodes as ``final_obs`` and ``final_info``.

        Raises:
            InputError: wrong shape, or an action that is not finite or out of [-1, 1].
            gymnasium.error.ResetNeeded: before the first reset, or (``Disabled``) on an ended episode.
        """
        core = self.core
        waiting = core.terminated | core.truncated
        if self.autoreset_mode is AutoresetMode.DISABLED and waiting.any():
            raise ResetNeeded(
                f"the episode of robot {int(np.argmax(waiting))} is over: reset it with options={{'reset_mask': ...}}"
            )
        active = ~waiting
        any_done = core.step(actions, active)
        reward, terminated, truncated = core.reward.copy(), core.terminated & active, core.truncated & active
        over = terminated | truncated
        if any_done and self.autoreset_mode is AutoresetMode.SAME_STEP:
            return self._restart_now(reward, terminated, truncated, over)
        infos = _masked(self._infos.step(), active) | self._changes()
        if any_done:
            infos |= _masked(self._infos.episode(), over)
        if waiting.any():
            core.begin_episodes(waiting)
            _merge(infos, _masked(self._infos.reset(), waiting))
        self.pictures.after_step()
        return core.observations(), reward, terminated, truncated, infos

    def _restart_now(
        self, reward: NDArray[np.float64], terminated: Mask, truncated: Mask, over: Mask
    ) -> tuple[Any, NDArray[np.float64], Mask, Mask, dict[str, Any]]:
        core, changes = self.core, self._changes()
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(over).tolist():
            final[row] = core.observations(row)
        infos = {} if over.all() else _masked(self._infos.step(), ~over)
        infos["final_obs"], infos["_final_obs"] = final, over.copy()
        infos["final_info"] = _masked(self._infos.step() | self._infos.episode(), over)
        infos["_final_info"] = over.copy()
        core.begin_episodes(over)
        _merge(infos, _masked(self._infos.reset(), over))
        _merge(infos, changes)
        self.pictures.after_step()
        return core.observations(), reward, terminated, truncated, infos

    def _changes(self) -> dict[str, Any]:
        """Info of the robots whose parameters changed within their episode."""
        return _masked(self._infos.change(), self.core.robots.changed) if self.core.robots.changed.any() else {}

    # ---- the rest ----

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return one picture (H, W, 3) per robot with ``rgb_array``; show the first robot with ``human``.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            InputError: no OpenGL on this machine; the message says what to install or set.
        """
        if self.render_mode is None:
            return self.pictures.warn_without_mode()
        if self.render_mode == "human":
            return self.pictures.show()
        return tuple(self.pictures.frame(row) for row in range(self.num_envs))

    def close_extras(self, **_: Any) -> None:
        """Release the plant and what pictures need."""
        self.pictures.close()
        self.core.close()


def seed_robots(core: Core, seeds: Sequence[int | None], mask: Mask, first: Callable[[], int]) -> None:
    """Seed the robots in ``mask``: with the given number, robot i with ``first()`` + i if it never had one, else not at all."""
    rows = np.flatnonzero(mask).tolist()
    start = 0 if all(seeds[row] is not None or core.episodes.seeded[row] for row in rows) else first()
    for row in rows:
        given = seeds[row]
        if given is not None:
            core.seed(row, given)
        elif not core.episodes.seeded[row]:
            core.seed(row, (start + row) % 2**128)


def _read_seeds(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    if seed is None:
        return [None] * count
    seeds = list(seed) if np.iterable(seed) else [read_seed(seed) + i for i in range(count)]
    if len(seeds) != count:
        raise InputError(f"{len(seeds)} seeds for {count} robots")
    return [None if value is None else read_seed(value) for value in seeds]


def _read_mask(given: Any, count: int) -> Mask:
    if given is None:
        return np.ones(count, bool)
    mask = np.asarray(given)
    if mask.shape != (count,) or mask.dtype != np.bool_ or not mask.any():
        raise InputError(
            f"reset_mask: expected ({count},) booleans of which at least one is True, got {mask.dtype} {mask.shape}"
        )
    return mask


def _read_mode(mode: str | AutoresetMode) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    valid = {name: member for member in AutoresetMode for name in (member.value, member.name)}
    if mode not in valid:
        raise InputError(
            f"autoreset_mode = {mode!r}{nearest(str(mode), valid)}; valid: {', '.join(m.value for m in AutoresetMode)}"
        )
    return valid[mode]


def _masked(values: dict[str, Any], mask: Mask) -> dict[str, Any]:
    """Add to every key the mask of robots it holds for, in nested dicts too (Gymnasium's info convention)."""
    own = mask.copy()
    result: dict[str, Any] = {}
    for key, value in values.items():
        result[key] = _masked(value, own) if isinstance(value, dict) else value
        result[f"_{key}"] = own
    return result


def _merge(infos: dict[str, Any], others: dict[str, Any]) -> None:
    """Add infos of other robots, taken at the same time, in place: a key in both holds for the robots of both masks."""
    for key, value in others.items():
        if key not in infos:
            infos[key] = value
        elif isinstance(value, dict):
            _merge(infos[key], value)
        elif key.startswith("_"):
            infos[key] = infos[key] | value
        else:
            mask = others[f"_{key}"]
            infos[key] = np.where(mask.reshape(-1, *[1] * (value.ndim - 1)), value, infos[key])
