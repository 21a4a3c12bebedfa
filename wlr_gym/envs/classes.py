"""Classes behind the ids, made from a task's data when they are asked for: ``VelocityEnv``, ``VelocityVectorEnv``, ..."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config
from wlr_gym.envs.document import class_document
from wlr_gym.envs.registry import ENVIRONMENTS, enter, title_of
from wlr_gym.envs.single import WlrEnv
from wlr_gym.envs.tasks.task_config import read_task
from wlr_gym.envs.vector import WlrVectorEnv

_BASES = {"VectorEnv": WlrVectorEnv, "Env": WlrEnv}


def register_task(path: str | Path) -> str:
    """Register the task of a YAML file as an environment of this process, and return its id.

    The id is made of the file's ``name`` and of the last version in its ``history``: ``name: hill_climb`` gives
    ``WLR-HillClimb-v0``, and the classes ``HillClimbV0Env`` and ``HillClimbV0VectorEnv``. Gymnasium and every command that
    takes an id know it from then on.

    Raises:
        InputError: no such file, a fault in it, or an id that belongs to another task.
    """
    source = str(find_config("task", path).resolve())
    config = read_task(source)
    title, version = title_of(config.name), list(config.history)[-1]
    env_id = f"WLR-{title}-{version}"
    present = ENVIRONMENTS.get(env_id, (source,))[0]
    if present != source:
        raise InputError(f"{source}: '{env_id}' is the task '{present}' already; give it another name")
    enter(env_id, source, title + version.upper())  # each version has its own classes
    return env_id


def __getattr__(name: str) -> Any:
    for task, *entry_points in ENVIRONMENTS.values():
        if f"{__name__}:{name}" in entry_points:
            return _make_class(name, task)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


@cache
def _make_class(name: str, task: str) -> type:
    base = next(base for ending, base in _BASES.items() if name.endswith(ending))
    return type(name, (base,), {"__module__": __name__, "__doc__": class_document(task), "task_name": task})
