"""Environment ids. Light: imported by ``import wlr_gym``; the classes load when an environment is made."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name

#: id -> task: name in ``configs/task/`` or path.
ENVIRONMENTS: dict[str, str] = {}


def title_of(task_name: str) -> str:
    """Return the name of a task as ids and classes spell it: ``hill_climb`` is ``HillClimb``."""
    return "".join(word.capitalize() for word in task_name.split("_"))


def plain_id(env_id: str) -> str:
    """Return an id without the module before it, which is imported: ``my_tasks:WLR-Climb-v0``, as for ``gym.make``."""
    if not isinstance(env_id, str):
        raise InputError(f"environment {env_id!r}: expected an id, such as {next(iter(ENVIRONMENTS))}")
    module, colon, name = env_id.rpartition(":")
    if colon and name not in ENVIRONMENTS:
        try:
            importlib.import_module(module)
        except InputError:
            raise
        except (ModuleNotFoundError, TypeError, ValueError) as error:
            raise InputError(f"environment '{env_id}': expected a module of Python before the colon: {error}") from None
    return name


def task_name_of(env_id: str) -> str:
    """Return the task behind an environment id: a name in ``configs/task/`` or the path of a task file.

    Raises:
        InputError: no such id in this process, nor in the module before it (``my_tasks:WLR-Climb-v0``), which is imported.
    """
    name = plain_id(env_id)
    if name not in ENVIRONMENTS:
        error = unknown_name("environment", env_id, ENVIRONMENTS)
        raise InputError(f"{error}; a task of your own is known once this process registered it (wlr --import MODULE)")
    return ENVIRONMENTS[name]


def task_source_of(env_id: str) -> str | dict[str, Any]:
    """Return the task behind an environment id: a name in ``configs/task/``, or the whole content of a registered task."""
    import gymnasium

    task = task_name_of(env_id)
    return gymnasium.registry[plain_id(env_id)].kwargs.get("definition", task)


def register_environments() -> None:
    """Register the shipped tasks; a test compares the versions with the history in their files."""
    for name in ("velocity", "path", "posture", "slope"):
        title = title_of(name)
        enter(f"WLR-{title}-v0", name, f"wlr_gym.envs.interfaces:{title}Env", f"wlr_gym.envs.interfaces:{title}VectorEnv")


def enter(env_id: str, task: str, single: str, vector: str, **keywords: Any) -> None:
    """Enter an id into Gymnasium's registry and :data:`ENVIRONMENTS`, with the classes' places and keywords.

    A task that is entered again is what its keywords say now.
    """
    import gymnasium

    if env_id in gymnasium.registry and gymnasium.registry[env_id].kwargs != keywords:
        del gymnasium.registry[env_id]
    if env_id not in gymnasium.registry:
        gymnasium.register(env_id, entry_point=single, vector_entry_point=vector, kwargs=keywords)
    ENVIRONMENTS[env_id] = task


# ---- tasks of users --------------------------------------------------------------------------------------------------


def register_task(path: str | Path) -> str:
    """Register the task of a YAML file as an environment of this process, and return its id.

    The id is made of the file's ``name`` and of the last version in its ``history``: ``name: hill_climb`` gives
    ``WLR-HillClimb-v0``. Gymnasium and every command that takes an id know it from then on. The spec of such an environment
    holds the whole task: ``gym.make(spec)`` works in a process that never saw the file, such as a worker of
    ``AsyncVectorEnv`` or Ray. Terms of your own (rewards, observations) are code: there their module must be imported first.
    Robot and randomisation files of your own that the task names are named by their absolute paths: another machine needs them
    too (or give a ``Robot`` as ``robot=`` and a mapping as ``randomization=``).

    Args:
        path: of the file, or the name of one in ``configs/task/``.

    Raises:
        InputError: no such file, a fault in it, or an id that belongs to another task.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"register_task({path!r}): expected the path of a task file")
    from wlr_gym.base.paths import find_config
    from wlr_gym.envs.tasks.task import read_task

    source = str(find_config("task", path).resolve())
    config = read_task(source)
    env_id = f"WLR-{title_of(config.name)}-{list(config.history)[-1]}"
    present = ENVIRONMENTS.get(env_id, source)
    if present != source:
        raise InputError(f"{source}: '{env_id}' is the task '{present}' already; give it another name")
    definition = config.model_dump(mode="json", exclude_none=True)  # so that a spec works where neither id nor file is known
    enter(env_id, source, "wlr_gym.envs.interfaces:WlrEnv", "wlr_gym.envs.interfaces:WlrVectorEnv", definition=definition)
    return env_id
