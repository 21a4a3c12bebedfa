"""List the environments, or describe one: its actions, observations, commands, rewards, terminations, randomization."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, refuse_existing
from wlr_gym.cli import OK
from wlr_gym.cli.options import ForceOption, JsonOption
from wlr_gym.cli.results import print_json
from wlr_gym.cli.tables import print_table
from wlr_gym.envs.registry import ENVIRONMENTS, task_source_of
from wlr_gym.envs.tasks import Randomization, Task, describe, describe_randomization, load_randomization, load_task
from wlr_gym.envs.tasks.describe import describe_scaling
from wlr_gym.envs.tasks.task_config import read_task

PICTURES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class EnvsOptions(JsonOption, ForceOption):
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
        if options.picture is not None:
            _draw(options.picture, randomization, options.force)
        if options.json:
            print_json(_content(options.env, task, randomization))
        else:
            print("\n\n".join(texts))
        return OK
    if any(value is not None for value in (options.robot, options.randomization, options.picture)):
        raise InputError("name the environment too, such as: wlr envs WLR-Velocity-v0 --randomization wide")
    found = [_summary(env_id, load_task(task_source_of(env_id))) for env_id in ENVIRONMENTS]
    if options.json:
        print_json(found)
        return OK
    rows = [
        (one["id"], f"Box({one['action']})", f"Box({one['observation']})", f"{1 / one['control_period']:g} Hz",
         f"{one['episode_length']:g} s") for one in found
    ]  # fmt: skip
    print_table(Console(), ("id", "action", "observation", "control", "episode"), rows)
    return OK


def _summary(env_id: str, task: Task) -> dict[str, Any]:
    """Return what the list says of an environment: sizes, s, names of the commands."""
    config = task.config
    return {
        "id": env_id,
        "action": len(task.actions),
        "observation": len(task.policy),
        "control_period": config.control_period,
        "episode_length": config.episode_length,
        "commands": list(task.commands),
    }


def _content(env_id: str, task: Task, randomization: Randomization) -> dict[str, Any]:
    own = {"task": task.config.model_dump(mode="json"), "randomization": randomization.config.model_dump(mode="json")}
    return _summary(env_id, task) | {"robot": task.robot.name} | own


def _draw(path: Path, randomization: Randomization, force: bool) -> None:
    from wlr_gym.learning.evaluation.floor_plots import draw_floors

    if path.suffix not in PICTURES:
        raise InputError(f"--picture {path}: expected a file that ends in {', '.join(PICTURES)}")
    refuse_existing(path, force, "--picture")
    make_output_folder(path.parent, "--picture")
    draw_floors(path, [randomization])
    print(f"written: {path}")
