"""Keywords every environment takes, checked once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from wlr_gym.base.errors import InputError, check_name, nearest
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.physics.effects import Source
from wlr_gym.physics.floor import FloorSource
from wlr_gym.physics.plants import REAL
from wlr_gym.physics.plants.base import RobotOptions, read_robot_options
from wlr_gym.render.view import View, read_view
from wlr_gym.robot import WHEELS, RobotSource

OBSERVATIONS = ("policy", "dict")


@dataclass(frozen=True)
class EnvironmentOptions:
    """What ``gym.make("WLR-...", ...)``, ``gym.make_vec`` and the environment classes accept, checked.

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
        floor: name in ``configs/floor/``, path of such a file, or mapping (``docs/floors.md``); None = the task's. What it
            states, randomisation does not change.
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

    backend: Annotated[str, "a name"] = "gibbs_appell"
    plant: Annotated[str | None, "a name"] = None
    robot: Annotated[RobotSource | None, "a name, a path, a mapping or a Robot"] = None
    randomization: Annotated[str | Path | Mapping[str, Any] | RandomizationConfig | None, "a name, a path or a mapping"] = None
    task: Annotated[str | Path | Mapping[str, Any] | None, "a name, a path or a mapping"] = None
    floor: Annotated[FloorSource, "a name, a path, a mapping or a Floor"] = None
    effects: Annotated[Source, "a name, a path, a mapping or a list of these"] = None
    episode_length: Annotated[float | None, "a time above 0 s"] = None
    observation: Annotated[str, "a name"] = "policy"
    free_wheels: Annotated[Iterable[str], "a list of wheels, such as ['wheel_lf']"] = ()
    physics_step: Annotated[float, "a time above 0 s"] = 0.001
    precision: Annotated[str, "a name"] = "float64"
    threads: Annotated[int, "a whole number of 1 or more"] = 1
    truth_info: Annotated[bool, "True or False"] = False
    view: Annotated[Mapping[str, Any] | View | None, "a mapping"] = None
    hardware: Annotated[str | Path | Mapping[str, Any] | RobotOptions | None, "a name, a path or a mapping"] = None

    def __post_init__(self) -> None:
        for keyword, (types, expected) in _types().items():
            value = getattr(self, keyword)
            if (isinstance(value, bool) and bool not in types) or not isinstance(value, types):
                raise InputError(f"{keyword} = {value!r}: expected {expected}")
        check_name("observation", self.observation, OBSERVATIONS, "environment")
        if isinstance(self.free_wheels, str):
            raise InputError(f"free_wheels = {self.free_wheels!r}: expected a list of wheels, such as ['wheel_lf']")
        object.__setattr__(self, "free_wheels", tuple(self.free_wheels))  # an iterator can be read once
        if self.plant is not None and self.backend != type(self).backend:  # both are given
            _require_one_backend(self.plant, self.backend)
        object.__setattr__(self, "backend", self.plant or self.backend)
        object.__setattr__(self, "plant", None)
        for wheel in self.free_wheels:
            check_name("wheel", wheel, WHEELS, "free_wheels")
        if self.episode_length is not None and not 0 < self.episode_length < float("inf"):
            raise InputError(f"episode_length = {self.episode_length!r}: expected a time above 0 s")
        if self.view is not None and read_view(self.view).path:
            raise InputError("view: path = True: only films show a path (wlr play --video FILE --path), no environment does")
        if self.is_real:
            self._check_real()
        elif self.hardware is not None:
            raise InputError(f"hardware = {self.hardware!r}: only for backend 'dynamixel', not '{self.backend}'")

    def keys(self) -> list[str]:
        """Return the keywords that are given, so that ``gym.make(ID, **options)`` takes an instance."""
        return [one.name for one in fields(self) if getattr(self, one.name) != one.default]

    def __getitem__(self, keyword: str) -> Any:
        """Return the value of a keyword."""
        return getattr(self, keyword)

    def _check_real(self) -> None:
        """Refuse what only a simulator can do."""
        read_robot_options(self.hardware)
        if self.observation == "dict":
            raise InputError("observation = 'dict': a real robot has no privileged observation")
        for keyword, harmful in (
            ("randomization", self.randomization not in (None, "none")),
            ("floor", self.floor not in (None, "flat")),
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


@cache
def _types() -> dict[str, tuple[tuple[type, ...], str]]:
    """Return keyword -> the types it takes, and these in words."""
    wider = {float: Real, int: Integral}
    found = {}
    for keyword, hint in get_type_hints(EnvironmentOptions, include_extras=True).items():
        annotated, words = get_args(hint)
        parts = get_args(annotated) if isinstance(annotated, UnionType) else (annotated,)
        found[keyword] = tuple(wider.get(part, get_origin(part) or part) for part in parts), words
    return found


#: What is no keyword of an environment -> where it belongs.
_ELSEWHERE = {
    "num_envs": "; several at once: gymnasium.make_vec(ID, num_envs=4)",
    "seed": "; it goes to env.reset(seed=3)",
    "sensors": '; it is of the task: task={"sensors": {"camera": 1.0}}',
}


class UnknownOptionError(InputError, TypeError):
    """An option that does not exist. Also a TypeError, worded as Python words it: that is what other libraries probe for."""


def read_settings(options: Mapping[str, Any]) -> EnvironmentOptions:
    """Return checked settings."""
    valid = [*EnvironmentOptions.__annotations__, "render_mode"]
    for option in options:
        if option not in valid:
            hint = _ELSEWHERE.get(option) or nearest(option, valid)
            raise UnknownOptionError(
                f"environment: got an unexpected keyword argument '{option}'{hint}; valid: {', '.join(valid)}"
            )
    if options.get("plant") is not None and "backend" in options:
        _require_one_backend(options["plant"], options["backend"])
    return EnvironmentOptions(**options)


def _require_one_backend(plant: str, backend: str) -> None:
    if plant != backend:
        raise InputError(f"plant = {plant!r} and backend = {backend!r}: two words for one thing, give one")


def task_of(own: str | None, definition: Mapping[str, Any] | None) -> str | Mapping[str, Any]:
    """Return the task of an environment class, or the one that it is given."""
    if (own is None) == (definition is None):
        raise InputError("definition: expected the task's content where the class has no task of its own, and only there")
    if definition is not None and not isinstance(definition, Mapping):
        raise InputError(f"definition = {definition!r}: expected the task's content, a mapping with the keys of a task file")
    return own or dict(definition or {})
