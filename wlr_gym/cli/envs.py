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
from wlr_gym.envs.tasks import Randomization, describe, describe_randomization, load_randomization, load_task
from wlr_gym.envs.tasks.describe import describe_scaling
from wlr_gym.envs.tasks.task_config import read_task

PICTURES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class EnvsOptions:
    env: tyro.conf.Positional[str | None] = None
    """Environment id to describe; without one all are listed."""
    robot: str | None = None
    """Robot that the numbers are for: name in configs/robot/ or path; default: the task's."""
    randomization: str | None = None
    """What to draw: name in configs/randomization/, path, or a gap result (.json); default: the task's."""
    picture: Path | None = None
    """Picture of eight floors that the randomization draws (.png, .svg, .pdf)."""


def run(options: EnvsOptions) -> int:
    """Print the list or the description."""
    if options.env is not None:
        task = load_task(task_source_of(options.env), options.robot)
        randomization = load_randomization(options.randomization or task.config.randomization, task.robot)
        texts = [options.env, describe(task), describe_randomization(randomization.config)]
        if options.robot is not None:
            texts.append(describe_scaling(read_task(task_source_of(options.env)), task.robot))
        print("\n\n".join(texts))
        if options.picture is not None:
            _draw(options.picture, randomization)
        return OK
    if any(value is not None for value in (options.robot, options.randomization, options.picture)):
        raise InputError("name the environment too, such as: wlr envs WLR-Velocity-v0 --randomization wide")
    table = Table("id", "action", "observation", "control", "episode", "commands", box=None)
    for env_id in ENVIRONMENTS:
        task = load_task(task_source_of(env_id))
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
