"""Environments as Gymnasium knows them: :class:`WlrEnv` (one robot), :class:`WlrVectorEnv` (a batch), and those that ship.

Below are first what all interfaces share, that of Stable-Baselines3 (``sb3.py``) included: their further methods, what they
say in ``info``, and pictures.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, registry
from gymnasium.error import ResetNeeded
from gymnasium.utils import EzPickle
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, nearest
from wlr_gym.base.snapshot import Snapshot
from wlr_gym.envs.core import OPTIONS, Core, Snapshots, read_options
from wlr_gym.envs.episodes import Mask, own_seed, read_seed
from wlr_gym.envs.observation import read_actions
from wlr_gym.envs.settings import read_settings, task_of
from wlr_gym.envs.tasks.task import limits_of, scales_of, succeeded, tracking_error
from wlr_gym.physics.plants.base import Truth
from wlr_gym.physics.plants.contacts import contacts_of_plant
from wlr_gym.render.view import has_display, require_display
from wlr_gym.robot.parameters import Parameters

if TYPE_CHECKING:
    from wlr_gym.render import Scene, Viewer


class TaskMethods:
    """Commands and descriptions, for a class that holds a ``core``."""

    core: Core
    pictures: Pictures
    metadata: dict[str, Any]
    _infos: Infos
    _spec: EnvSpec | None = None

    def _open(self, task: str | Mapping[str, Any], options: Mapping[str, Any], count: int, render_mode: str | None) -> None:
        """Make the core of ``count`` robots, and what shows and tells of it."""
        check_render_mode(render_mode)
        self.render_mode = render_mode
        self.core = Core(task, read_settings(options), count)
        self.metadata = metadata(self.core.task.config.control_period)
        self.pictures, self._infos = Pictures(self.core, render_mode), Infos(self.core)
        name = f"{type(self).__module__}:{type(self).__name__}" if getattr(self, "task_name", None) else ""
        self.spec = next((spec for spec in registry.values() if name in (spec.entry_point, spec.vector_entry_point)), None)
        if self._spec is not None:  # that of a shipped class; gym.make lays its own over it
            self._spec.kwargs = dict(options)

    @cached_property
    def _snapshots(self) -> Snapshots:
        return Snapshots(self.core)

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made this environment from. ``max_episode_steps`` is the environment's own limit, which depends on
        its options; what is registered has none, so that no ``TimeLimit`` is laid over it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = copy.deepcopy(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = self.core.limit

    def set_command(self, **values: float) -> None:
        """Command all robots from the next step on, until their episodes end: ``set_command(linear_velocity_x=0.1)``. Commands
        that are not named are drawn as before.

        Raises:
            InputError: unknown command, or a value without meaning or beyond what the robot can do.
            gymnasium.error.ResetNeeded: before the first reset.
        """
        self.core.set_command(values)

    def set_progress(self, steps: float) -> None:
        """Say how many environment steps, of all robots together, a training has done, for the task's curriculum."""
        self.core.set_progress(steps)

    def get_state(self, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Snapshot:
        """Return a snapshot: everything that decides what comes next, for planning, debugging and exact resumption.

        It holds physics with warm starts, delays, sensors with their noise counters, the slip observer, commands,
        randomisation, observation history, rewards and the episode. Not in it: ``set_progress``, and pictures.

        Args:
            rows: numbers of robots, or a mask (N,); None = all.

        Raises:
            InputError: not robots of this batch, or a plant whose state cannot be set (a real robot).
            gymnasium.error.ResetNeeded: before the first reset.
        """
        return self._snapshots.take(rows)

    def set_state(self, snapshot: Snapshot, rows: int | Sequence[int] | NDArray[Any] | None = None) -> Any:
        """Put robots into the state of a snapshot. From there the same actions give the same bits, whatever the batch.

        Args:
            snapshot: of one robot, for all of ``rows``, or of one for each. It may come from a batch of another size, with the
                same task, robot, randomisation, effects, backend, precision and steps.
            rows: numbers of robots, or a mask (N,); None = all. Others stay as they are.

        Returns:
            The observations of all robots of the batch.

        Raises:
            InputError: a snapshot that does not fit (names the first difference), or a plant whose state cannot be set (a real
                robot); nothing has changed then.
        """
        self._snapshots.put(snapshot, rows)
        return self.core.observations()

    def describe(self) -> str:
        """Return the task's tables as text."""
        return self.core.describe()

    def contract(self) -> dict[str, Any]:
        """Return what a policy must be fed and what its output means."""
        return self.core.contract()


# ---- info: what environments say beside observation and reward, batched; fresh objects every time --------------------


Array = NDArray[np.float64]

#: Channels of the truth in ``info["truth"]``; units and frames: :data:`wlr_gym.physics.plants.base.TRUTH_LAYOUT`.
TRUTH = ("position", "quaternion", "linear_velocity_in_body", "angular_velocity_in_body")


class Infos:
    """Infos of the robots of a core: {key: {name: (N,)}} or {key: (N, ...)}.

    Attributes:
        has_truth: ``truth()`` says something, because users asked for it.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._limits, self._scales = limits_of(core.task.config), scales_of(core.task.config)
        self.has_truth: bool = core.settings.truth_info

    def step(self) -> dict[str, Any]:
        """Return the last step's ``reward_terms`` {name: (N,)}, ``slip_velocity`` (N, 4, 2) m/s along each wheel's heading
        and axle, ``effective_friction`` (N, 4, 2) along them, and ``truth``. A real robot knows its measured reward terms
        only."""
        core = self._core
        terms = dict(zip(core.task.rewards, core.scores.terms.T.copy(), strict=True))
        return {"reward_terms": terms, **self.contact(), **self.truth()}

    def contact(self) -> dict[str, Any]:
        """Return ``slip_velocity`` and ``effective_friction`` (N, 4, 2); nothing on a real robot."""
        core = self._core
        if not core.plant.capabilities.has_truth:
            return {}
        truth, shape = core.plant.truth(), (core.count, 4, 2)
        return {name: truth[name].reshape(shape).copy() for name in ("slip_velocity", "effective_friction")}

    def truth(self) -> dict[str, Any]:
        """Return ``truth``, where it was asked for: pose, velocities and ``command`` {name: (N,)} for the next step."""
        if not self.has_truth:
            return {}
        core = self._core
        found: dict[str, Any] = {name: core.plant.truth()[name].copy() for name in TRUTH}
        return {"truth": found | {"command": dict(zip(core.task.commands, core.command.T.copy(), strict=True))}}

    def episode(self) -> dict[str, Any]:
        """Return ``episode_reward_terms`` {name: (N,)}, sums over the episode so far, and ``episode_measures`` {name: (N,)}:
        the task's measures over it as score cards state them (rms; ``_max``: largest magnitude, where that is limited), and
        ``tracking_error`` and ``success`` (0 or 1) where the task has limits."""
        core = self._core
        sums = dict(zip(core.task.rewards, core.scores.sums.T.copy(), strict=True))
        errors = self.errors()
        limited = {which: error for which, error in errors.items() if which[1] == "rms" or which in self._limits}
        measures = {name if kind == "rms" else f"{name}_{kind}": error for (name, kind), error in limited.items()}
        if self._limits:
            measures["tracking_error"] = tracking_error(self._scales, errors, core.terminated)
            measures["success"] = succeeded(self._limits, errors, core.terminated).astype(np.float64)
        return {"episode_reward_terms": sums, "episode_measures": measures}

    def errors(self) -> dict[tuple[str, str], Array]:
        """Return the measures over the episode so far: (measure, ``rms`` or ``max``) -> (N,), SI units."""
        core = self._core
        rms = np.sqrt(core.scores.squares / np.maximum(core.episodes.steps, 1)[:, None])
        errors = {(name, "rms"): rms[:, k] for k, name in enumerate(core.task.measures)}
        return errors | {(name, "max"): core.scores.largest[:, k].copy() for k, name in enumerate(core.task.measures)}

    def tracking_error(self) -> Array:
        """Return the tracking error (N,) of the episode so far."""
        return tracking_error(self._scales, self.errors(), self._core.terminated)

    def succeeded(self) -> NDArray[np.bool_]:
        """Return whether the episode so far (N,) is a success."""
        return succeeded(self._limits, self.errors(), self._core.terminated)

    def reset(self) -> dict[str, Any]:
        """Return ``randomization`` {element: (N,)}, the present values of all parameters that randomisation changes, and
        ``truth``."""
        randomization = self._core.randomization
        return {**self._samples(randomization.elements, randomization.columns), **self.truth()}

    def change(self) -> dict[str, Any]:
        """Return ``randomization`` {element: (N,)}: the present values of those that also change within an episode."""
        randomization = self._core.randomization
        return self._samples(randomization.timed_elements, randomization.timed_columns)

    def _samples(self, elements: tuple[str, ...], columns: NDArray[np.int64]) -> dict[str, Any]:
        values = self._core.parameters.values[:, columns].T.copy()
        return {"randomization": dict(zip(elements, values, strict=True))}


def row_of(found: Any, row: int) -> Any:
    """Return one robot's part of an info: numbers as floats, in dicts too."""
    if isinstance(found, dict):
        return {key: row_of(value, row) for key, value in found.items()}
    value = found[row]
    return value.copy() if np.ndim(value) else float(value)


# ---- pictures, or a window -------------------------------------------------------------------------------------------


Picture = NDArray[np.uint8]

RENDER_MODES = ("human", "rgb_array")


class RenderModeError(InputError, TypeError):
    """A render mode that does not exist. Also a TypeError: that is what Stable-Baselines3 probes for."""


def check_render_mode(render_mode: str | None) -> None:
    """Refuse a render mode that does not exist, or a window where there is no display."""
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise RenderModeError(f"render_mode = {render_mode!r}: expected None, 'human' or 'rgb_array'")
    if render_mode == "human":
        require_display()


def metadata(control_period: float) -> dict[str, Any]:
    """Return an environment's metadata: the render modes that work on this machine, and pictures per second."""
    modes = [mode for mode in RENDER_MODES if mode != "human" or has_display()]
    return {"render_modes": modes, "render_fps": round(1.0 / control_period)}


class Pictures:
    """Draws the robots of a core. Nothing is opened before the first picture.

    Args:
        core: whose plant's truth is drawn, whatever the plant.
        render_mode: None, ``human`` or ``rgb_array``.
    """

    def __init__(self, core: Core, render_mode: str | None) -> None:
        if render_mode is not None and not core.plant.capabilities.has_truth:
            raise InputError(f"render_mode = {render_mode!r}: where a real robot stands is not known; look at it")
        self.core = core
        self.render_mode = render_mode
        self._scene: Scene | None = None
        self._viewer: Viewer | None = None

    def after_step(self) -> None:
        """Show the present state where there is a window."""
        if self.render_mode == "human":
            self.show()

    def warn_without_mode(self) -> None:
        """Say, as Gymnasium's own environments do, that there is no render mode."""
        gym.logger.warn("render() without a render mode shows nothing: make the environment with render_mode='rgb_array'")

    def frame(self, row: int) -> Picture:
        """Return the picture of one robot, (H, W, 3) uint8."""
        self.core.episodes.require_begun("render()")
        if self._scene is None:
            from wlr_gym.render import Scene

            self._scene = Scene(self.core.task.robot, self.core.settings.picture_view)
        return self._scene.draw(*self._shown(), row, contacts=contacts_of_plant(self.core.plant), **self._texts(row))

    def show(self) -> None:
        """Show the first robot in a window, in real time. Once the user has closed it, nothing happens."""
        self.core.episodes.require_begun("render()")
        if self._viewer is None:
            from wlr_gym.render import Viewer

            self._viewer = Viewer(self.core.task.robot, self.core.settings.picture_view)
        period = self.core.task.config.control_period
        contacts = contacts_of_plant(self.core.plant)
        self._viewer.show(*self._shown(), period=period, contacts=contacts, **self._texts(0))

    def close(self) -> None:
        """Close the window and give OpenGL back."""
        for drawer in (self._scene, self._viewer):
            if drawer is not None:
                drawer.close()

    def _shown(self) -> tuple[Truth, Parameters]:
        return self.core.plant.truth(), self.core.parameters

    def _texts(self, row: int) -> dict[str, Any]:
        core = self.core
        command = dict(zip(core.task.commands, core.command[row].tolist(), strict=True))
        return {"time": float(core.time[row]), "command": command}


# ---- one robot -------------------------------------------------------------------------------------------------------


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
        **options: Any,
    ) -> None:
        EzPickle.__init__(self, render_mode=render_mode, definition=definition, **options)
        self._open(task_of(self.task_name, definition), options, 1, render_mode)
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
        :meth:`wlr_gym.envs.interfaces.TaskMethods.set_state`."""
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


# ---- a batch of robots -----------------------------------------------------------------------------------------------


# Gymnasium's ``spec`` is a plain attribute; this one completes what is written to it.
class WlrVectorEnv(TaskMethods, VectorEnv[Any, Any, Any], EzPickle):  # pyright: ignore[reportIncompatibleVariableOverride]
    """N robots on a task, bit-identical to N single environments with seeds ``seed + i``.

    Args:
        num_envs: N.
        autoreset_mode: ``NextStep`` (default), ``SameStep`` or ``Disabled``, as text or ``gymnasium.vector.AutoresetMode``.
        max_episode_steps: truncate after so many control steps, if that is before the task's own limit.
        render_mode: ``rgb_array`` (``render()`` returns one picture per robot), ``human`` (a window with the first robot)
            or None.
        definition: as in :class:`wlr_gym.envs.interfaces.WlrEnv`.
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
        **options: Any,
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
        self.autoreset_mode: AutoresetMode = _read_mode(autoreset_mode)
        self._open(task_of(self.task_name, definition), options, num_envs, render_mode)
        self.metadata["autoreset_mode"] = self.autoreset_mode
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

    # ---- the rest: as of Gymnasium's own vector environments ----

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute, the same for all robots."""
        return (getattr(self, name),) * self.num_envs

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute for all robots; of a list or tuple with one value for each, all must be equal."""
        if isinstance(values, list | tuple):
            if len(values) != self.num_envs or any(value != values[0] for value in values):
                raise InputError(f"set_attr('{name}'): one value is shared by all {self.num_envs} robots, got {values!r}")
            values = values[0]
        setattr(self, name, values)

    def call(self, name: str, *arguments: Any, **keywords: Any) -> tuple[Any, ...]:
        """Call a method of the batch once, or read an attribute; the result stands for every robot."""
        found = getattr(self, name)
        return ((found(*arguments, **keywords) if callable(found) else found),) * self.num_envs

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


# ---- the shipped tasks; a task of your own needs no class: see register_task -----------------------------------------

# Each takes the keywords of wlr_gym.envs.settings.EnvironmentOptions. What a task is at length, and its versions, stands in its
# file, configs/task/NAME.yaml; ``describe()`` prints the tables of what it observes, rewards and measures, ``wlr envs ID`` and
# docs/environments.md show them. Vector classes name Gymnasium's class among their bases a second time: skrl recognises an
# environment by its direct bases.


# pyright: reportIncompatibleVariableOverride=false


class VelocityEnv(WlrEnv):
    """Follow commands of forward velocity and yaw rate that change a few times within an episode."""

    task_name = "velocity"


class VelocityVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`VelocityEnv`."""

    task_name = "velocity"


class PathEnv(WlrEnv):
    """Follow a line, an S-curve or a circle on the floor at a commanded speed, with the least lateral error."""

    task_name = "path"


class PathVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`PathEnv`."""

    task_name = "path"


class PostureEnv(WlrEnv):
    """Drive straight on while the legs sweep from one posture to another: the two tests of the paper as a task."""

    task_name = "posture"


class PostureVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`PostureEnv`."""

    task_name = "posture"


class SlopeEnv(WlrEnv):
    """Climb a slope at a commanded speed, straight on, then hold."""

    task_name = "slope"


class SlopeVectorEnv(WlrVectorEnv, VectorEnv):
    """A batch of robots on the task of :class:`SlopeEnv`."""

    task_name = "slope"
