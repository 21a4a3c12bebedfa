"""Keywords every environment takes, checked once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from wlr_gym.effects import Patch
from wlr_gym.errors import InputError, unknown_name
from wlr_gym.robot import WHEELS, Robot
from wlr_gym.tasks.randomization import RandomizationConfig

OBSERVATIONS = ("policy", "dict")

#: Keyword -> types it takes, in Python and in words.
_TYPES: dict[str, tuple[tuple[type, ...], str]] = {
    "backend": ((str,), "a name"),
    "robot": ((str, Path, Robot, type(None)), "a name, a path or a Robot"),
    "randomization": ((str, Path, Mapping, RandomizationConfig, type(None)), "a name, a path or a mapping"),
    "task": ((str, Path, Mapping, type(None)), "a name, a path or a mapping"),
    "effects": ((str, Path, list, tuple, Patch, type(None)), "a path or a list of effects"),
    "episode_length": ((Real, type(None)), "a time above 0 s"),
    "observation": ((str,), "a name"),
    "free_wheels": ((Iterable,), "a list of wheels, such as ['wheel_lf']"),
    "physics_step": ((Real,), "a time above 0 s"),
    "precision": ((str,), "a name"),
    "threads": ((Integral,), "a whole number of 1 or more"),
}


class RenderModeError(InputError, TypeError):
    """A render mode that does not exist. Also a TypeError: that is what Stable-Baselines3 probes for."""


@dataclass(frozen=True)
class Settings:
    """What ``gym.make("WLR-...", ...)`` accepts.

    Attributes:
        backend: which plant: ``gibbs_appell``.
        robot: name in ``configs/robot/``, path of a YAML file, or a :class:`wlr_gym.robot.Robot`; None = the task's.
        randomization: name in ``configs/randomization/`` (none, nominal, wide), path, or mapping; None = the task's.
        task: mapping laid over the task's file (``{"rewards": {"slip": {"weight": -2.0}}}``), or another task file.
        effects: patch laid over the randomised parameters: path of a YAML file, or a list of effects as mappings
            (``[{"name": "friction_level", "parameters": {"mu": 0.4}}]``, see :mod:`wlr_gym.effects`); None = no effects.
        episode_length: s until truncation; None = the task's.
        observation: ``policy`` (flat Box) or ``dict`` (``policy`` and ``privileged``, for asymmetric critics).
        free_wheels: wheels whose motors are off (they spin free, their actions are ignored).
        physics_step: s per physics substep.
        precision: ``float64`` or ``float32``.
        threads: worker threads of the plant for large batches; results do not depend on it.
    """

    backend: str = "gibbs_appell"
    robot: str | Path | Robot | None = None
    randomization: str | Path | Mapping[str, Any] | None = None
    task: str | Path | Mapping[str, Any] | None = None
    effects: str | Path | Sequence[Mapping[str, Any]] | Patch | None = None
    episode_length: float | None = None
    observation: str = "policy"
    free_wheels: Sequence[str] = ()
    physics_step: float = 0.001
    precision: str = "float64"
    threads: int = 1

    def __post_init__(self) -> None:
        for keyword, (types, expected) in _TYPES.items():
            value = getattr(self, keyword)
            if isinstance(value, bool) or not isinstance(value, types):
                raise InputError(f"{keyword} = {value!r}: expected {expected}")
        if self.observation not in OBSERVATIONS:
            raise unknown_name("observation", str(self.observation), OBSERVATIONS, "environment")
        if isinstance(self.free_wheels, str):
            raise InputError(f"free_wheels = {self.free_wheels!r}: expected a list of wheels, such as ['wheel_lf']")
        for wheel in self.free_wheels:
            if wheel not in WHEELS:
                raise unknown_name("wheel", str(wheel), WHEELS, "free_wheels")
        if self.episode_length is not None and not 0 < self.episode_length < float("inf"):
            raise InputError(f"episode_length = {self.episode_length!r}: expected a time above 0 s")


def read_settings(keywords: Mapping[str, Any]) -> Settings:
    """Return checked settings.

    Raises:
        InputError: unknown keyword (with the nearest valid one) or a bad value.
    """
    valid = [field.name for field in fields(Settings)]
    for keyword in keywords:
        if keyword not in valid:
            raise unknown_name("keyword", keyword, [*valid, "render_mode"], "environment")
    return Settings(**keywords)


def check_render_mode(render_mode: str | None) -> None:
    """Raise for any render mode but None: this version draws no pictures."""
    if render_mode is not None:
        raise RenderModeError(f"render_mode = {render_mode!r}: this version has no pictures; only None is valid")
