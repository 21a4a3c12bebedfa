"""List the environments, or describe one: its actions, observations, commands, rewards, terminations, randomization."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.text import Text

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import make_output_folder, refuse_existing, require_ending
from wlr_gym.cli import OK
from wlr_gym.cli.options import ForceOption, JsonOption
from wlr_gym.cli.terminal import print_json, print_table
from wlr_gym.envs.registry import ENVIRONMENTS, task_source_of
from wlr_gym.envs.tasks import Randomization, Task, load_randomization, load_task
from wlr_gym.envs.tasks.describe import DescriptionPart, randomization_section, scaling_sections, task_sections
from wlr_gym.envs.tasks.task import read_task

PICTURES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class EnvsOptions(JsonOption, ForceOption):
    env: tyro.conf.Positional[str | None] = None
    """Environment id to describe; without one all are listed."""
    robot: str | None = None
    """Robot that the numbers are for: robot file, or name in configs/robot/; default: the task's."""
    randomization: str | None = None
    """What to draw: name in configs/randomization/, path, or a gap result (.json); default: the task's."""
    picture: Path | None = None
    """Picture of eight floors that the randomization draws (.png, .svg, .pdf)."""


def run(options: EnvsOptions) -> int:
    """Print the list or the description."""
    if options.env is not None:
        _describe(options.env, options)
    elif given := [name for name in ("robot", "randomization", "picture") if getattr(options, name) is not None]:
        words = f"--{given[0]} {getattr(options, given[0])}"
        raise InputError(f"{words}: name the environment too: wlr envs WLR-Velocity-v0 {words}")
    else:
        _list(options)
    return OK


def _list(options: EnvsOptions) -> None:
    tasks = {env_id: load_task(task_source_of(env_id)) for env_id in ENVIRONMENTS}
    summaries = [_summary(env_id, task) for env_id, task in tasks.items()]
    if options.json:
        print_json(summaries)
        return
    rows = [
        (one["id"], f"Box({one['action']})", f"Box({one['observation']})", f"{1 / one['control_period']:g} Hz",
         f"{one['episode_length']:g} s", _about(tasks[one["id"]])) for one in summaries
    ]  # fmt: skip
    print_table(Console(), ("id", "action", "observation", "control", "episode", "what it asks for"), rows)
    print("one of them, with all its numbers: wlr envs ID")


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


def _about(task: Task) -> str:
    return " ".join(task.config.summary.partition("\n\n")[0].split())


def _describe(env_id: str, options: EnvsOptions) -> None:
    written = task_source_of(env_id)
    task = load_task(written, options.robot)
    randomization = load_randomization(options.randomization or task.config.randomization, task.robot)
    if options.picture is not None:
        _draw(options.picture, randomization, options.force)
    if options.json:
        own = {"task": task.config.model_dump(mode="json"), "randomization": randomization.config.model_dump(mode="json")}
        print_json(_summary(env_id, task) | {"robot": task.robot.name} | own)
        return
    sections = [DescriptionPart(env_id, _about(task)), *task_sections(task), randomization_section(randomization.config)]
    if options.robot is not None:
        sections += scaling_sections(read_task(written), task.robot)
    console = Console()
    for section in sections:
        console.print(Text.assemble((section.title, "bold"), ": ", section.sentence), end="\n\n")
        if section.rows:
            print_table(console, section.headings, [[cell.replace("``", "") for cell in row] for row in section.rows])
    console.print(Text("in a program: env.unwrapped.contract() (as data), .describe() (this text)"))


def _draw(path: Path, randomization: Randomization, force: bool) -> None:
    from wlr_gym.learning.evaluation.plots import draw_floors

    require_ending(path, PICTURES, "--picture")
    refuse_existing(path, force, "--picture")
    make_output_folder(path.parent, "--picture")
    draw_floors(path, [randomization])
    print(f"written: {path}")
