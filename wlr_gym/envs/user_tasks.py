"""Tasks of users, registered from their files."""

from __future__ import annotations

from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config
from wlr_gym.envs.registry import ENVIRONMENTS, enter, title_of
from wlr_gym.envs.tasks.task_config import read_task


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
    source = str(find_config("task", path).resolve())
    config = read_task(source)
    env_id = f"WLR-{title_of(config.name)}-{list(config.history)[-1]}"
    present = ENVIRONMENTS.get(env_id, source)
    if present != source:
        raise InputError(f"{source}: '{env_id}' is the task '{present}' already; give it another name")
    definition = config.model_dump(mode="json", exclude_none=True)  # so that a spec works where neither id nor file is known
    enter(env_id, source, "wlr_gym.envs.single:WlrEnv", "wlr_gym.envs.vector:WlrVectorEnv", definition=definition)
    return env_id
