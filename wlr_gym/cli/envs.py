"""List the environments, or describe one: its actions, observations, commands, rewards, terminations, randomization."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.table import Table

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder
from wlr_gym.cli import OK
from wlr_gym.envs.registry import ENVIRONMENTS, task_source_of
from wlr_gym.envs.tasks import Randomization, Task, describe, describe_randomization, load_randomization
from wlr_gym.envs.tasks.task import build_task
from wlr_gym.envs.tasks.task_config import read_task
from wlr_gym.robot import load_robot

PICTURES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class EnvsOptions:
    env: tyro.conf.Positional[str | None] = None
    """Environment id to describe; without one all are listed."""
    randomization: str | None = None
    """What to draw: name in configs/randomization/, path, or a gap result (.json); default: the task's."""
    picture: Path | None = None
    """Picture of eight floors that the randomization draws (.png, .svg, .pdf)."""


def run(options: EnvsOptions) -> int:
    """Print the list or the description."""
    if options.env is not None:
        task = _task(options.env)
        randomization = load_randomization(options.randomization or task.config.randomization, task.robot)
        print(f"{options.env}\n\n{describe(task)}\n\n{describe_randomization(randomization.config)}")
        if options.picture is not None:
            _draw(options.picture, randomization)
        return OK
    if options.randomization is not None or options.picture is not None:
        raise InputError("name the environment too, such as: wlr envs WLR-Velocity-v0 --randomization wide")
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


def _draw(path: Path, randomization: Randomization) -> None:
    from wlr_gym.learning.evaluation.floor_plots import draw_floors

    if path.suffix not in PICTURES:
        raise InputError(f"--picture {path}: expected a file that ends in {', '.join(PICTURES)}")
    make_output_folder(path.parent, "--picture")
    draw_floors(path, [randomization])
    print(f"written: {path}")


def _task(env_id: str) -> Task:
    config = read_task(task_source_of(env_id))
    return build_task(config, load_robot(config.robot))
