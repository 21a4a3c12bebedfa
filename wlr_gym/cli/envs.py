"""List the environments, or describe one: its actions, observations, commands, rewards and terminations."""

from __future__ import annotations

from dataclasses import dataclass

import tyro
from rich.console import Console
from rich.table import Table

from wlr_gym.cli import OK
from wlr_gym.envs.registry import ENVIRONMENTS, task_name_of
from wlr_gym.robot import load_robot
from wlr_gym.tasks import Task, describe
from wlr_gym.tasks.task import build_task, read_task


@dataclass(frozen=True)
class Options:
    env: tyro.conf.Positional[str | None] = None
    """Environment id to describe; without one all are listed."""


def run(options: Options) -> int:
    """Print the list or the description."""
    if options.env is not None:
        print(f"{options.env}\n\n{describe(_task(options.env))}")
        return OK
    table = Table("id", "action", "observation", "control", "episode", "commands", box=None)
    for env_id in ENVIRONMENTS:
        task = _task(env_id)
        config = task.config
        table.add_row(
            env_id, f"Box({len(task.actions)})", f"Box({len(task.policy)})", f"{1 / config.control_period:g} Hz",
            f"{config.episode_length:g} s", ", ".join(task.commands),
        )  # fmt: skip
    Console().print(table)
    return OK


def _task(env_id: str) -> Task:
    config = read_task(task_name_of(env_id))
    return build_task(config, load_robot(config.robot))
