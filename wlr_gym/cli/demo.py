"""The main job end to end: train PPO, evaluate it against baselines on floors of random friction, draw the pictures."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from wlr_gym.cli import OK
from wlr_gym.cli.evaluate import print_card, progress
from wlr_gym.cli.options import EffectsOption
from wlr_gym.cli.train import add_effects
from wlr_gym.envs.core import make_task
from wlr_gym.envs.registry import task_name_of
from wlr_gym.envs.settings import read_settings
from wlr_gym.errors import InputError, require_package
from wlr_gym.evaluation import (
    FIRST_SEED,
    MAIN,
    Card,
    Condition,
    Rollout,
    Subject,
    play,
    read_curve,
    read_subjects,
    work,
    write_card,
)
from wlr_gym.files import make_output_folder
from wlr_gym.policy import Training, load_agent, load_agent_config
from wlr_gym.provenance import PROVENANCE_FILE, record_provenance

ENVIRONMENT = "WLR-Velocity-v0"
BASELINES = ("do_nothing", "untrained", "pid")
EPISODES = 64
FILES = ("run/policy", "card.md", "card.json", "learning_curve.png", "episode.png")
#: More than the usual training time; a slow machine stops here, with a policy that has learnt less.
MAX_TRAINING_SECONDS = 120.0


@dataclass(frozen=True)
class Options(EffectsOption):
    out: Path = Path("out/demo")
    """Folder for the policy, the score card and the pictures; a demo already in it is replaced."""
    steps: int | None = None
    """Control ticks to train for, all robots together; default: that of configs/agent/ppo.yaml."""
    episodes: int = EPISODES
    """Episodes per policy in the evaluation."""
    seed: int = 0
    """Seed of the training."""
    progress: bool = True
    """Show progress bars."""


def run(options: Options) -> int:
    """Train, evaluate, draw, and name the files."""
    require_package("torch", "train")
    require_package("stable_baselines3", "train")
    options.patch()  # a bad one is refused before anything is written
    make_output_folder(options.out)
    began = time.monotonic()
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"[bold]1/3 train[/] PPO on {ENVIRONMENT}: follow commands of forward velocity and yaw rate")
    policy = _train(options)
    console.print(f"[bold]2/3 evaluate[/] {options.episodes} new episodes on floors of random friction, the same for all")
    rollouts = _evaluate(options, policy)
    console.print("[bold]3/3 draw[/] learning curve and an episode")
    _draw(options.out, rollouts)
    console.print(f"done in {time.monotonic() - began:.0f} s; in {options.out}: {', '.join(FILES)}")
    return OK


def _train(options: Options) -> Path:
    config = load_agent_config("ppo") | {"seed": options.seed}
    if options.steps is not None:
        config["total_steps"] = options.steps
    add_effects(config, options.patch())
    _clear(options.out / "run")
    record_provenance(options.out, {"environment": ENVIRONMENT, "agent": "ppo", "settings": config}, options.seed)
    training = Training(ENVIRONMENT, options.out / "run", config, max_seconds=MAX_TRAINING_SECONDS, progress=options.progress)
    return load_agent("ppo").train(training)


def _evaluate(options: Options, policy: Path) -> dict[str, Rollout]:
    patch = options.patch()
    keywords = {"precision": "float32", "effects": patch}  # precision as in training: the engine is compiled once
    condition = Condition(MAIN, keywords, episodes=options.episodes)
    subjects = [Subject("PPO", (str(policy),)), *read_subjects(BASELINES)]
    rollouts: dict[str, Rollout] = {}

    def watch(condition: Condition, subject: Subject, block: int, rollout: Rollout) -> None:
        rollouts[subject.name] = rollout

    ticks = make_task(task_name_of(ENVIRONMENT), read_settings(keywords)).episode_ticks
    with progress(work([condition], subjects, ticks), options.progress) as tell:
        results = play(ENVIRONMENT, subjects, [condition], tell=tell, watch=watch)
    said = {"environment": ENVIRONMENT, "episodes": options.episodes, "first seed": FIRST_SEED, "effects": patch.summary()}
    card = Card(results, conditions=said)
    print_card(card)
    write_card(options.out, card)
    return rollouts


def _draw(folder: Path, rollouts: Mapping[str, Rollout]) -> None:
    from wlr_gym.evaluation import plots

    curve = read_curve(folder / "run" / "learning_curve.csv")
    references = {name: reward_per_second(rollouts[name]) for name in BASELINES}
    plots.save(plots.learning_curve(curve, references), folder / "learning_curve.png")
    trained = rollouts["PPO"]
    chosen = liveliest(trained)
    title = f"Trained policy, episode of seed {trained.seeds[chosen]}, friction {trained.friction[chosen].mean():.2f}"
    plots.save(plots.episode(trained, chosen, title), folder / "episode.png")


def reward_per_second(rollout: Rollout) -> float:
    """Return the mean reward per second over all episodes."""
    return float(rollout.reward[rollout.active].mean() / rollout.control_period)


def liveliest(rollout: Rollout) -> int:
    """Return the episode that was asked for the most driving and turning: the most to see."""
    largest = np.maximum(np.abs(rollout.command).max(axis=(0, 1)), 1e-9)
    effort = (np.abs(rollout.command) / largest).sum(axis=-1)
    return int(np.argmax(np.where(rollout.active, effort, 0.0).sum(axis=0)))


def _clear(folder: Path) -> None:
    """Remove the run of an earlier demo; anything else that is in the way is refused."""
    if folder.exists() and not (folder / PROVENANCE_FILE).is_file():
        raise InputError(f"{folder}: in the way, and not the run of an earlier demo; give another --out")
    shutil.rmtree(folder, ignore_errors=True)
