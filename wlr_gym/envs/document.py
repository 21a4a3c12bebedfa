"""Documentation of an environment, made from the data it runs on."""

from __future__ import annotations

import inspect

from wlr_gym.envs.settings import Settings
from wlr_gym.envs.tasks.describe import describe
from wlr_gym.envs.tasks.task import build_task
from wlr_gym.envs.tasks.task_config import read_task
from wlr_gym.robot import load_robot

_INFO = """**Info** ``reset``: ``randomization`` {parameter element: value}. ``step``: ``reward_terms`` {term: weighted value},
``slip_velocity`` (4, 2) m/s along each wheel's heading and axle, ``effective_friction`` (4, 2) along them; in an episode's
last step also ``episode_reward_terms`` {term: sum}; where randomisation changed parameters within the episode also
``randomization`` {element: new value}. Reset options: ``command`` {name: value} held for the episode,
``parameters`` {name or element: value} set after randomisation."""


def class_document(task_name: str) -> str:
    """Return the class documentation of an environment: summary, tables, keywords, version history."""
    config = read_task(task_name)
    tables = describe(build_task(config, load_robot(config.robot)))
    keywords = (inspect.getdoc(Settings) or "").partition("Attributes:\n")[2]
    versions = "\n".join(f"- {version}: {change}" for version, change in config.history.items())
    parts = (config.summary.strip(), tables, _INFO, "**Keywords**", inspect.cleandoc(keywords), "**Version history**", versions)
    return "\n\n".join(parts) + "\n"
