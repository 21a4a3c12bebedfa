"""Score a policy or agent over many episodes, played as one batch, against baselines on the same seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from wlr_gym.cli import OK
from wlr_gym.errors import InputError
from wlr_gym.evaluation import Card, Rollout, make_core, roll_out, rows, score, write_card
from wlr_gym.files import make_output_folder
from wlr_gym.policy import make_policy
from wlr_gym.provenance import record_provenance


@dataclass(frozen=True)
class Options:
    policy: tyro.conf.Positional[str]
    """Policy folder, run folder, or name of an agent."""
    env: str = "WLR-Velocity-v0"
    """Environment id; see: wlr envs."""
    baselines: tuple[str, ...] = ("do_nothing", "proportional")
    """Policies or agents to compare with, on the same episodes."""
    episodes: int = 64
    """Number of episodes."""
    seed: int = 0
    """Seed of the first episode; the others count up from it."""
    randomization: str | None = None
    """Name in configs/randomization/ or path; default: the task's."""
    robot: str | None = None
    """Name in configs/robot/ or path; default: the task's."""
    out: Path | None = None
    """Folder for card.md and card.json; default: only print."""
    progress: bool = True
    """Show a progress bar."""


def run(options: Options) -> int:
    """Play, print the card, write it."""
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: expected 0 or more")
    if options.out is not None:
        make_output_folder(options.out)
    keywords = {"randomization": options.randomization, "robot": options.robot}
    subjects = list(dict.fromkeys([options.policy, *options.baselines]))
    rollouts = play(options.env, subjects, options.episodes, options.seed, keywords, options.progress)
    cards = {name: score(rollout) for name, rollout in rollouts.items()}
    print_cards(cards)
    if options.out is not None:
        conditions = {
            "environment": options.env, "episodes": options.episodes, "first seed": options.seed,
            "randomization": options.randomization or "the task's", "robot": options.robot or "the task's",
        }  # fmt: skip
        settings = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(options).items()}
        record_provenance(options.out, settings, options.seed)
        write_card(options.out, cards, conditions)
        print(f"written: {options.out / 'card.md'}, {options.out / 'card.json'}")
    return OK


def play(
    environment: str, subjects: Sequence[str | Path], episodes: int, seed: int, keywords: Mapping[str, Any], progress: bool
) -> dict[str, Rollout]:
    """Return subject -> its episodes; every subject gets the same ones.

    Raises:
        InputError: unknown environment, agent or keyword, or a policy that does not fit the environment.
    """
    core = make_core(environment, episodes, keywords)
    try:
        policies = {str(subject): make_policy(subject, core.contract()) for subject in subjects}
        rollouts: dict[str, Rollout] = {}
        with Progress(transient=True, disable=not progress) as bar:
            for name, policy in policies.items():
                task = bar.add_task(f"evaluating {name}", total=core.limit)
                rollouts[name] = roll_out(core, policy, seed, lambda task=task: bar.advance(task))
    finally:
        core.close()
    return rollouts


def print_cards(cards: Mapping[str, Card]) -> None:
    """Print score cards side by side."""
    header, *body = rows(cards, short=True)
    table = Table(*header, box=None, title="mean over episodes ± half of the 95 % confidence interval", title_justify="left")
    for row in body:
        table.add_row(*row)
    console = Console()
    console.width = max(console.width, 26 + 18 * len(cards))  # rather a wide line than a cut number
    console.print(table)
