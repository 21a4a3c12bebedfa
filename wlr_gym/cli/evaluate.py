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
from wlr_gym.cli.options import EffectsOption
from wlr_gym.errors import InputError
from wlr_gym.evaluation import Card, Rollout, make_core, record_episodes, roll_out, rows, score, write_card, write_samples
from wlr_gym.files import make_output_folder
from wlr_gym.policy import make_policy
from wlr_gym.provenance import record_provenance
from wlr_gym.render.video import check_video


@dataclass(frozen=True)
class Options(EffectsOption):
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
    backend: str = "gibbs_appell"
    """Simulator: gibbs_appell or mujoco."""
    randomization: str | None = None
    """Name in configs/randomization/, path, or a gap result (.json); default: the task's."""
    robot: str | None = None
    """Name in configs/robot/ or path; default: the task's."""
    out: Path | None = None
    """Folder for card.md, card.json and samples.csv (what randomization drew); default: only print."""
    record: int = 0
    """Write so many of the policy's episodes as runs into the folder OUT/runs."""
    video: Path | None = None
    """Film (.webp, .gif, .png, .mp4) of the first episode: the policy, beside the first baseline where there is one."""
    video_seconds: float = 10.0
    """Length of the film."""
    progress: bool = True
    """Show a progress bar."""


def run(options: Options) -> int:
    """Play, print the card, write it."""
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: expected 0 or more")
    if not 0 <= options.record <= options.episodes or (options.record and options.out is None):
        raise InputError(f"--record {options.record}: expected 0 to {options.episodes} (--episodes), and --out for the runs")
    patch = options.patch()
    if options.video is not None:
        check_video(options.video)
        if not 0 < options.video_seconds < float("inf"):
            raise InputError(f"--video-seconds {options.video_seconds:g}: expected more than 0")
    if options.out is not None:
        make_output_folder(options.out)
    keywords = {"backend": options.backend, "randomization": options.randomization, "robot": options.robot, "effects": patch}
    subjects = list(dict.fromkeys([options.policy, *options.baselines]))
    rollouts = play(options.env, subjects, options.episodes, options.seed, keywords, options.progress)
    cards = {name: score(rollout) for name, rollout in rollouts.items()}
    print_cards(cards)
    if options.out is not None:
        conditions = {
            "environment": options.env, "backend": options.backend, "episodes": options.episodes, "first seed": options.seed,
            "randomization": options.randomization or "the task's", "robot": options.robot or "the task's",
            "effects": patch.summary(),
        }  # fmt: skip
        settings = {key: str(value) if isinstance(value, Path) else value for key, value in asdict(options).items()}
        record_provenance(options.out, settings | {"effects": patch.content()["effects"]}, options.seed)
        write_card(options.out, cards, conditions)
        write_samples(options.out / "samples.csv", rollouts[options.policy])
        print(f"written: {', '.join(str(options.out / name) for name in ('card.md', 'card.json', 'samples.csv'))}")
        if options.record:
            _record(options, options.out / "runs", keywords)
    if options.video is not None:
        _film(options, options.video, subjects[:2], keywords)
    return OK


def _record(options: Options, folder: Path, keywords: Mapping[str, Any]) -> None:
    """Write the first episodes of the policy as runs."""
    core = make_core(options.env, options.record, keywords)
    try:
        written = record_episodes(core, make_policy(options.policy, core.contract()), folder, options.seed)
    finally:
        core.close()
    print(f"written: {len(written)} runs in {folder}")


def _film(options: Options, path: Path, subjects: Sequence[str], keywords: Mapping[str, Any]) -> None:
    """Write the first episode of up to two subjects, side by side."""
    from wlr_gym.evaluation.film import film, film_length
    from wlr_gym.render import side_by_side, write_video

    cores = [make_core(options.env, 1, keywords) for _ in subjects]
    try:
        count, _, fps = film_length(cores[0], options.video_seconds)
        films = [
            film(core, make_policy(subject, core.contract()), options.seed, options.video_seconds)
            for core, subject in zip(cores, subjects, strict=True)
        ]
        pictures = side_by_side(films[0], films[1], (subjects[0], subjects[1])) if len(films) == 2 else films[0]
        with Progress(transient=True, disable=not options.progress) as bar:
            write_video(path, bar.track(pictures, count, description="drawing"), fps, count)
    finally:
        for core in cores:
            core.close()
    print(f"written: {path}")


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
