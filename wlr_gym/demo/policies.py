"""The stages of the first worker: a policy learns for a minute; it, shipped policies and a controller drive on ice."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlr_gym.base.html import heading, table
from wlr_gym.demo.page import ENVIRONMENT, NOT_SHOWN, SHOWN, Demo, Section, Tell, drawn, filmed, paragraph
from wlr_gym.envs.tasks.task import having
from wlr_gym.gap.report.text import listed, plain, unit_of
from wlr_gym.learning.evaluation.card import MAIN, Card, rows
from wlr_gym.learning.evaluation.conditions import FIRST_SEED, Condition, play
from wlr_gym.learning.evaluation.subjects import Subject

if TYPE_CHECKING:
    from wlr_gym.learning.evaluation.metrics import Metric
    from wlr_gym.policy import TrainingProgress

LEARN_TITLE = "1. A policy learns"
REFERENCES = ("do_nothing", "pid")
#: The highest reward per second: both tracking terms of the task have weight 1.
BEST = 2.0


def train(demo: Demo, tell: Tell) -> Section:
    """Train PPO, draw its learning curve."""
    from wlr_gym.learning.curves import read_curve
    from wlr_gym.learning.evaluation.plots import learning_curve
    from wlr_gym.policy import Training, load_agent, load_agent_config

    def on_update(done: TrainingProgress) -> None:
        steps, reward = f"{done.steps / 1e6:.1f} of {demo.steps / 1e6:.1f} million steps", done.metrics["reward_per_second"]
        tell(f"training: {steps}, reward {reward:.2f} per second", 0.93 * done.steps / demo.steps)

    config = load_agent_config("ppo") | {"seed": demo.seed, "total_steps": demo.steps}
    tell("training: compiling the simulator", 0.0)
    load_agent("ppo").train(Training(ENVIRONMENT, demo.training, config, progress=False, on_update=on_update))
    tell("training: episodes of the new policy and of references", 0.93)
    references = {name: _play_alone(name, demo) for name in REFERENCES}
    reward = _play_alone(demo.training / "policy", demo)
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
        learning_curve(curve, references),
        demo.out / "learning_curve.png",
        "Left: reward per second of simulated time, over environment steps of all robots together; the references play whole "
        "episodes of the same task without exploring. Right: the terms of the reward that count most, "
        "and the sum of the others.",
    )
    return Section(LEARN_TITLE, headline, html, SHOWN if learnt else NOT_SHOWN, behind(reward, references))


def behind(reward: float, references: Mapping[str, float]) -> list[str]:
    """Return which references earn more than the new policy, in whole episodes."""
    better = [f"{name} ({value:.2f})" for name, value in references.items() if value > reward]
    said = f"in whole episodes, {listed(better)} gets more reward per second than the new policy ({reward:.2f})"
    return [said] if better else []


def _play_alone(source: str | Path, demo: Demo) -> float:
    """Return a policy's reward per second in whole episodes."""
    from wlr_gym.learning.evaluation.rollout import roll_out
    from wlr_gym.learning.evaluation.subjects import make_player

    core, policy = make_player(ENVIRONMENT, source, demo.episodes, {"precision": "float32"})
    with closing(core):
        rollout = roll_out(core, policy, FIRST_SEED + demo.seed)
    return float(rollout.reward[rollout.active].mean() / rollout.control_period)


# ---- on the same ice: the shipped policies, a classical controller and the new policy ---------------------------------


ICE_TITLE = "2. On ice"
OURS = "velocity_slip_aware"
BLIND = "velocity_blind"
NEW = "trained just now"
#: The robot as it is deployed.
NO_CAMERA = having(())
SHIPPED = (OURS, BLIND, "pid")
#: Metrics of the card that are shown.
SHOWN_METRICS = ("tracking_error", "velocity_error", "yaw_rate_error", "excess_slip", "success")
#: A policy that fails in more episodes than this, %, is not good.
_MANY = 10.0
#: Label of the second kind of floor; what the kinds are, for the page and in short.
SPLIT = "split"
FLOORS = {
    MAIN: "Ice everywhere: friction coefficient 0.05 to 0.2",
    SPLIT: "Split floor: one friction coefficient left of a line, another one right of it, each 0.05 to 0.9",
}
_WHERE = {MAIN: "on ice", SPLIT: "on split floors"}
#: The film: astride a line between two frictions, then a turn to the right.
SCHEDULE = "0:0.1,0; 4:0.1,-0.3"


def compare(demo: Demo, tell: Tell) -> Section:
    """Play the same episodes with every policy, and film two of them."""
    tell("on ice", 0.0)
    card = _play(demo, tell)
    html = paragraph(
        f"{demo.episodes} episodes of 20 s each on each kind of floor: the same floors, robots, commands for all. No robot "
        f"has a camera, as the deployed one. {OURS} sees its slip (observer on wheels, legs and IMU); {BLIND} had the same "
        "training without the observer; pid is a tuned classical controller. A success keeps velocity and yaw rate within 5 % "
        "of the range of commands, rms over the episode. Excess slip: mean over wheels and time. Mean ± half of the 95 % "
        "confidence interval."
    )
    found = []
    for label, floor in FLOORS.items():
        headings, *body = rows(card.scores[label], _metrics(card), short=True)
        errors = {name: own["tracking_error"] for name, own in card.comparison[label].items()}
        others = [f"{name} by {e.mean:.0f} % (95 % interval {e.low:.0f} to {e.high:.0f})" for name, e in errors.items()]
        paired = f"Paired episode by episode, the tracking error of {OURS} is lower (minus: higher) than that of "
        html += heading(floor) + table(headings, body, range(2, len(headings))) + paragraph(f"{paired}{'; '.join(others)}.")
        blind = errors[BLIND]
        lower = f"{abs(blind.mean):.0f} % {'lower' if blind.mean > 0 else 'higher'}"
        found.append(f"{lower if blind.excludes_zero else 'not distinguishable'} {_WHERE[label]}")
    headline = f"The tracking error of a policy that observes its slip, against the same training without: {'; '.join(found)}."
    better = all(card.comparison[label][BLIND]["tracking_error"].low > 0.0 for label in FLOORS)
    return Section(ICE_TITLE, headline, html + _film(demo, tell), SHOWN if better else NOT_SHOWN, falls_short(card))


def _play(demo: Demo, tell: Tell) -> Card:
    subjects = [Subject(name, (name,)) for name in SHIPPED]
    if (demo.training / "policy").is_dir():
        subjects.append(Subject(NEW, (str(demo.training / "policy"),)))
    conditions = [  # precision as in training: the engine is compiled once
        Condition(label, {"randomization": floor, "precision": "float32", **NO_CAMERA}, episodes=demo.episodes)
        for label, floor in ((MAIN, "ice"), (SPLIT, "split"))
    ]
    done = 0.0

    def on_tick(text: str, share: float) -> None:
        nonlocal done
        done += share
        tell(f"on ice: {text.partition(':')[0]}", 0.5 * min(1.0, done))

    return Card(play(ENVIRONMENT, subjects, conditions, FIRST_SEED + demo.seed, on_tick))


def _metrics(card: Card) -> list[Metric]:
    return [metric for metric in card.metrics if metric.key in SHOWN_METRICS]


def falls_short(card: Card) -> list[str]:
    """Return where others beat the slip-aware policy, where it is no better than the blind one, and how often it fails.

    Better: the whole 95 % interval of the paired difference is.
    """
    said = []
    for label, where in _WHERE.items():
        for other, own in card.comparison[label].items():
            better = [metric for metric in _metrics(card) if own[metric.key].high < 0.0]
            said += [f"{where}, {other} has the better {_listed(card, label, (other, OURS), better)}"] if better else []
        blind = card.comparison[label][BLIND]
        if equal := [metric for metric in _metrics(card) if not blind[metric.key].excludes_zero]:
            names = _listed(card, label, (OURS, BLIND), equal)
            said.append(f"{where}, {OURS} is not measurably better than {BLIND} in {names}")
        failed = 100.0 - card.scores[label][OURS]["success"].mean
        said += [f"{where}, {OURS} fails in {failed:.0f} % of the episodes"] if failed > _MANY else []
    return said


def _listed(card: Card, label: str, policies: tuple[str, str], metrics: Iterable[Metric]) -> str:
    """Return metrics with the values of two policies: ``excess slip (0.0019 against 0.0043 m/s)``."""
    first, second = (card.scores[label][name] for name in policies)
    return listed(
        [
            f"{plain(one.key)} ({first[one.key].mean:.{one.digits}f} against {second[one.key].mean:.{one.digits}f}"
            f"{unit_of(one.unit)})"
            for one in metrics
        ]
    )


def _film(demo: Demo, tell: Tell) -> str:
    def watch(pictures: Iterable[Any], count: int) -> Iterator[Any]:
        for index, one in enumerate(pictures):
            tell(f"on ice: film, picture {index + 1} of {count}", 0.5 + 0.5 * index / count)
            yield one

    subjects, floor = [Subject(name, (name,)) for name in (OURS, "pid")], {"randomization": SPLIT, **NO_CAMERA}
    path = demo.out / "ice.webp"
    return filmed(path, demo, subjects, demo.film_seconds, floor, _CAPTION, schedule=SCHEDULE, watch=watch)


_CAPTION = (
    "The first split floor of the table, the same commands for both: drive on, after 4 s turn right as well. "
    "Arrows: where each wheel slips to, 0.1 m for 0.05 m/s; the redder, the faster. Pink: the path of the robot; dashed: the "
    "path that was commanded. Skid-steering needs slip; what counts is which robot follows. One scene; averages: the table."
)
