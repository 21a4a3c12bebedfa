"""Environment ids. Light: imported by ``import wlr_gym``; the classes load when an environment is made."""

from __future__ import annotations

from wlr_gym.errors import unknown_name

#: id -> (task, class of the single and of the vector environment).
ENVIRONMENTS: dict[str, tuple[str, str, str]] = {
    f"WLR-{name.capitalize()}-v0": (
        name,
        f"wlr_gym.envs.{name}:{name.capitalize()}Env",
        f"wlr_gym.envs.{name}:{name.capitalize()}VectorEnv",
    )
    for name in ("velocity", "path", "posture", "slope")
}


def task_name_of(env_id: str) -> str:
    """Return the name of the task behind an environment id."""
    name = env_id.rpartition(":")[2]
    if name not in ENVIRONMENTS:
        raise unknown_name("environment", env_id, ENVIRONMENTS)
    return ENVIRONMENTS[name][0]


def register_environments() -> None:
    """Enter all ids into Gymnasium's registry."""
    import gymnasium

    for env_id, (_, single, vector) in ENVIRONMENTS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point=single, vector_entry_point=vector)
