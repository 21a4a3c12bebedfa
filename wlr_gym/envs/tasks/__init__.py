"""Tasks as data: terms, randomisation and their checks. An environment (``wlr_gym.envs``) runs them on a plant."""

from wlr_gym.envs.tasks.describe import contract, describe
from wlr_gym.envs.tasks.randomization import Randomization, load_randomization
from wlr_gym.envs.tasks.task import Task, TaskConfig, load_task

__all__ = [
    "Randomization",
    "Task",
    "TaskConfig",
    "contract",
    "describe",
    "load_randomization",
    "load_task",
]
