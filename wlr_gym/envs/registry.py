"""Environment ids. Light: imported by ``import wlr_gym``; the classes load when an environment is made."""

from __future__ import annotations

from wlr_gym.base.errors import unknown_name

#: id -> (task: name in ``configs/task/`` or path, class of the single and of the vector environment).
ENVIRONMENTS: dict[str, tuple[str, str, str]] = {}


def title_of(task_name: str) -> str:
    """Return the name of a task as ids and classes spell it: ``hill_climb`` is ``HillClimb``."""
    return "".join(word.capitalize() for word in task_name.split("_"))


def task_name_of(env_id: str) -> str:
    """Return the task behind an environment id: a name in ``configs/task/`` or the path of a task file."""
    name = env_id.rpartition(":")[2]
    if name not in ENVIRONMENTS:
        raise unknown_name("environment", env_id, ENVIRONMENTS)
    return ENVIRONMENTS[name][0]


def enter(env_id: str, task: str, title: str) -> None:
    """Enter an id into Gymnasium's registry and :data:`ENVIRONMENTS`; no other id has classes of this ``title``."""
    import gymnasium

    single, vector = f"wlr_gym.envs.classes:{title}Env", f"wlr_gym.envs.classes:{title}VectorEnv"
    if env_id not in gymnasium.registry:
        gymnasium.register(env_id, entry_point=single, vector_entry_point=vector)
    ENVIRONMENTS[env_id] = (task, single, vector)


def register_environments() -> None:
    """Register the shipped tasks; a test compares the versions with the history in their files."""
    for name in ("velocity", "path", "posture", "slope"):
        enter(f"WLR-{title_of(name)}-v0", name, title_of(name))
