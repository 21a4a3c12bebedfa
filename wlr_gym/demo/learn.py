"""First stage: train a policy for about a minute, beside two references."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wlr_gym.base.errors import InputError
from wlr_gym.demo.settings import ENVIRONMENT, Demo
from wlr_gym.demo.stage import NOT_SHOWN, SHOWN, Section, Tell, drawn, paragraph
from wlr_gym.gap.report.text import listed

if TYPE_CHECKING:
    from wlr_gym.learning.evaluation import Rollout

TITLE = "1. A policy learns"
REFERENCES = ("do_nothing", "pid")
#: The highest reward per second: both tracking terms of the task have weight 1.
BEST = 2.0
#: s between two looks at the learning curve.
_LOOK = 0.5


def train(demo: Demo, tell: Tell) -> Section:
    """Train PPO, draw its learning curve."""
    from wlr_gym.learning.evaluation import plots, read_curve
    from wlr_gym.policy import Training, load_agent, load_agent_config

    config = load_agent_config("ppo") | {"seed": demo.seed, "total_steps": demo.steps}
    tell("training: compiling the simulator", 0.0)
    with _watched(demo, tell):
        load_agent("ppo").train(Training(ENVIRONMENT, demo.training, config, progress=False))
    tell("training: episodes of the new policy and of references", 0.93)
    references = {name: _reward_per_second(_play(name, demo)) for name in REFERENCES}
    episodes = _play(demo.training / "policy", demo)
    curve = read_curve(demo.training / "learning_curve.csv")
    first, last = (row["reward_per_second"] for row in (curve[0], curve[-1]))
    robots, period = int(config["num_envs"]), 0.02
    hours = curve[-1]["steps"] * period / 3600.0
    learnt = last > first
    headline = (
        f"A new policy {'learnt from nothing' if learnt else 'was trained, and did not get better,'} in "
        f"{curve[-1]['steps'] / 1e6:.2g} million environment steps: reward {first:.2f} to {last:.2f} per second of at most "
        f"{BEST:g}."
    )
    html = paragraph(
        f"PPO (Stable-Baselines3) drives {robots} simulated robots at once, on floors from slippery to grippy, and is to "
        f"follow commands of forward velocity and yaw rate. It saw {hours:.1f} hours of driving, simulated on one core. It is "
        "one of the policies on ice below."
    )
    html += drawn(
        plots.learning_curve(curve, references),
        demo.out / "learning_curve.png",
        "Left: reward per second of simulated time, over environment steps of all robots together; the references play whole "
        "episodes of the same task without exploring. Right: the terms of the reward that count most, "
        "and the sum of the others.",
    )
    chosen = _liveliest(episodes)
    html += drawn(
        plots.episode(episodes, chosen, f"The new policy on a floor of friction {episodes.friction[chosen].mean():.2f}"),
        demo.out / "episode.png",
        "An episode of the new policy that it has not trained on, the one of the most driving and turning.",
    )
    return Section(TITLE, headline, html, SHOWN if learnt else NOT_SHOWN, behind(_reward_per_second(episodes), references))


def behind(reward: float, references: Mapping[str, float]) -> list[str]:
    """Return which references earn more than the new policy, in whole episodes."""
    better = [f"{name} ({value:.2f})" for name, value in references.items() if value > reward]
    said = f"in whole episodes, {listed(better)} gets more reward per second than the new policy ({reward:.2f})"
    return [said] if better else []


@contextmanager
def _watched(demo: Demo, tell: Tell) -> Iterator[None]:
    """Report the training's progress, by its learning curve, until it is over."""
    from wlr_gym.learning.evaluation import read_curve

    over = threading.Event()

    def watch() -> None:
        while not over.wait(_LOOK):
            try:
                done = read_curve(demo.training / "learning_curve.csv")[-1]
            except (InputError, IndexError):
                continue
            reward = f"reward {done['reward_per_second']:.2f} per second"
            said = f"training: {done['steps'] / 1e6:.1f} of {demo.steps / 1e6:.1f} million steps, {reward}"
            tell(said, 0.93 * done["steps"] / demo.steps)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _play(source: str | Path, demo: Demo) -> Rollout:
    from wlr_gym.learning.evaluation import FIRST_SEED, make_player, roll_out

    core, policy = make_player(ENVIRONMENT, source, demo.episodes, {"precision": "float32"})
    with closing(core):
        return roll_out(core, policy, FIRST_SEED + demo.seed)


def _reward_per_second(rollout: Rollout) -> float:
    return float(rollout.reward[rollout.active].mean() / rollout.control_period)


def _liveliest(rollout: Rollout) -> int:
    """Return the episode whose commands have the most driving and turning: the most to see."""
    largest = np.maximum(np.abs(rollout.command).max(axis=(0, 1)), 1e-9)
    effort = (np.abs(rollout.command) / largest).sum(axis=-1)
    return int(np.argmax(np.where(rollout.active, effort, 0.0).sum(axis=0)))
