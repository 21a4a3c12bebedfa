"""Keywords every environment takes, checked once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypedDict

from wlr_gym.base.errors import InputError, nearest, unknown_name
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.physics.effects import Patch, Source
from wlr_gym.physics.plants import REAL
from wlr_gym.physics.plants.base import RobotOptions, read_robot_options
from wlr_gym.render.view import View, read_view
from wlr_gym.robot import WHEELS, Robot, RobotSource

OBSERVATIONS = ("policy", "dict")

#: Keyword -> types it takes, in Python and in words.
_TYPES: dict[str, tuple[tuple[type, ...], str]] = {
    "backend": ((str,), "a name"),
    "robot": ((str, Path, Mapping, Robot, type(None)), "a name, a path, a mapping or a Robot"),
    "randomization": ((str, Path, Mapping, RandomizationConfig, type(None)), "a name, a path or a mapping"),
    "task": ((str, Path, Mapping, type(None)), "a name, a path or a mapping"),
    "effects": ((str, Path, Mapping, list, tuple, Patch, type(None)), "a name, a path, a mapping or a list of these"),
    "episode_length": ((Real, type(None)), "a time above 0 s"),
    "observation": ((str,), "a name"),
    "free_wheels": ((Iterable,), "a list of wheels, such as ['wheel_lf']"),
    "physics_step": ((Real,), "a time above 0 s"),
    "precision": ((str,), "a name"),
    "threads": ((Integral,), "a whole number of 1 or more"),
    "truth_info": ((bool,), "True or False"),
    "view": ((Mapping, View, type(None)), "a mapping"),
    "hardware": ((str, Path, Mapping, RobotOptions, type(None)), "a name, a path or a mapping"),
}


class EnvironmentOptions(TypedDict, total=False):
    """What ``gym.make("WLR-...", ...)``, ``gym.make_vec`` and the environment classes accept.

    Attributes:
        backend: which plant: ``gibbs_appell`` or ``mujoco``, or ``dynamixel``: the real robot, see ``docs/driving.md``.
        plant: the same as ``backend``, for callers whose own interface takes that word (TorchRL).
        robot: name in ``configs/robot/``, path of a YAML file, its content, or a :class:`wlr_gym.robot.Robot`;
            None = the task's, of a real robot the one that its hardware file names. The task's numbers follow it by the rules
            of its file (``scaling``).
        randomization: name in ``configs/randomization/`` (``docs/randomization.md``), path of such a file or of a gap result
            (``.json``), or mapping; None = the task's.
        task: mapping laid over the task's file (``{"rewards": {"slip": {"weight": -2.0}}}``), or another task file. Its key
            ``fed_as`` names a task file of which only what a policy is fed holds.
        effects: what is added after randomisation: path of a patch file or name of one in ``configs/effects/``, an effect as a
            mapping (``{"name": "friction_level", "parameters": {"mu": 0.4}}``), or a list of any of these; None = nothing.
            See ``docs/effects.md``.
        episode_length: s until truncation; None = the task's.
        observation: ``policy`` (flat Box) or ``dict`` (``policy`` and ``privileged``, for asymmetric critics).
        free_wheels: wheels whose motors are off (they spin free, their actions are ignored).
        physics_step: s per physics substep.
        precision: ``float64`` or ``float32``.
        threads: worker threads of the plant for large batches; results do not depend on it.
        truth_info: put true pose, velocities and the command into ``info["truth"]`` at every reset and step (simulators only).
        view: what pictures show (with ``render_mode``): mapping of ``size`` (width, height), ``camera`` (follow, chase, side,
            top), ``friction``, ``slip``, ``forces``, ``text`` (True or False), see :class:`wlr_gym.render.View`.
        hardware: of the real robot: name in ``configs/hardware/``, path of such a file, or mapping of the fields of
            :class:`wlr_gym.physics.plants.base.RobotOptions` (``{"emulated": True}``).
    """

    backend: str
    plant: str
    robot: RobotSource | None
    randomization: str | Path | Mapping[str, Any] | None
    task: str | Path | Mapping[str, Any] | None
    effects: Source
    episode_length: float | None
    observation: str
    free_wheels: Sequence[str]
    physics_step: float
    precision: str
    threads: int
    truth_info: bool
    view: Mapping[str, Any] | View | None
    hardware: str | Path | Mapping[str, Any] | RobotOptions | None


@dataclass(frozen=True)
class Settings:
    """Checked :class:`EnvironmentOptions` with their defaults."""

    backend: str = "gibbs_appell"
    robot: RobotSource | None = None
    randomization: str | Path | Mapping[str, Any] | None = None
    task: str | Path | Mapping[str, Any] | None = None
    effects: Source = None
    episode_length: float | None = None
    observation: str = "policy"
    free_wheels: Sequence[str] = ()
    physics_step: float = 0.001
    precision: str = "float64"
    threads: int = 1
    truth_info: bool = False
    view: Mapping[str, Any] | View | None = None
    hardware: str | Path | Mapping[str, Any] | RobotOptions | None = None

    def __post_init__(self) -> None:
        for keyword, (types, expected) in _TYPES.items():
            value = getattr(self, keyword)
            if (isinstance(value, bool) and bool not in types) or not isinstance(value, types):
                raise InputError(f"{keyword} = {value!r}: expected {expected}")
        if self.observation not in OBSERVATIONS:
            raise unknown_name("observation", str(self.observation), OBSERVATIONS, "environment")
        if isinstance(self.free_wheels, str):
            raise InputError(f"free_wheels = {self.free_wheels!r}: expected a list of wheels, such as ['wheel_lf']")
        object.__setattr__(self, "free_wheels", tuple(self.free_wheels))  # an iterator can be read once
        for wheel in self.free_wheels:
            if wheel not in WHEELS:
                raise unknown_name("wheel", str(wheel), WHEELS, "free_wheels")
        if self.episode_length is not None and not 0 < self.episode_length < float("inf"):
            raise InputError(f"episode_length = {self.episode_length!r}: expected a time above 0 s")
        if self.view is not None and read_view(self.view).path:
            raise InputError("view: path = True: only films show a path (wlr play --video FILE --path), no environment does")
        if self.is_real:
            self._check_real()
        elif self.hardware is not None:
            raise InputError(f"hardware = {self.hardware!r}: only for backend 'dynamixel', not '{self.backend}'")

    def _check_real(self) -> None:
        """Refuse what only a simulator can do."""
        read_robot_options(self.hardware)
        if self.observation == "dict":
            raise InputError("observation = 'dict': a real robot has no privileged observation")
        for keyword, harmful in (
            ("randomization", self.randomization not in (None, "none")),
            ("effects", self.effects),
            ("truth_info", self.truth_info),
        ):
            if harmful:
                raise InputError(
                    f"{keyword} = {getattr(self, keyword)!r}: a real robot is what it is; only a simulator takes that"
                )

    @property
    def is_real(self) -> bool:
        """Whether the plant is a real robot."""
        return self.backend in REAL

    @property
    def has_camera(self) -> bool:
        """Whether there is a camera above a real robot."""
        options = self.robot_options
        return options is not None and options.camera is not None

    @property
    def robot_options(self) -> RobotOptions | None:
        """Which real robot; None for simulators."""
        return read_robot_options(self.hardware) if self.is_real else None

    @property
    def picture_view(self) -> View:
        """What pictures show."""
        return read_view(self.view)


#: What is no keyword of an environment -> where it belongs.
_ELSEWHERE = {
    "num_envs": "; several at once: gymnasium.make_vec(ID, num_envs=4)",
    "seed": "; it goes to env.reset(seed=3)",
    "sensors": '; it is of the task: task={"sensors": {"camera": 1.0}}',
}


class UnknownOptionError(InputError, TypeError):
    """An option that does not exist. Also a TypeError, worded as Python words it: that is what other libraries probe for."""


def read_settings(options: Mapping[str, Any]) -> Settings:
    """Return checked settings.

    Raises:
        InputError: unknown option (with the nearest valid one) or a bad value.
    """
    valid = [*EnvironmentOptions.__annotations__, "render_mode"]
    for option in options:
        if option not in valid:
            hint = _ELSEWHERE.get(option) or nearest(option, valid)
            raise UnknownOptionError(
                f"environment: got an unexpected keyword argument '{option}'{hint}; valid: {', '.join(valid)}"
            )
    given = dict(options)
    if "plant" in given:
        plant = given.pop("plant")
        if given.setdefault("backend", plant) != plant:
            raise InputError(f"plant = {plant!r} and backend = {given['backend']!r}: two words for one thing, give one")
    return Settings(**given)


def task_of(own: str | None, definition: Mapping[str, Any] | None) -> str | Mapping[str, Any]:
    """Return the task of an environment class, or the one that it is given.

    Raises:
        InputError: neither, or both.
    """
    if (own is None) == (definition is None):
        raise InputError("definition: expected the task's content where the class has no task of its own, and only there")
    if definition is not None and not isinstance(definition, Mapping):
        raise InputError(f"definition = {definition!r}: expected the task's content, a mapping with the keys of a task file")
    return own or dict(definition or {})
