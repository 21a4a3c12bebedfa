"""Scores while training: fixed episodes that neither training nor ``wlr evaluate`` has, and the best policy so far."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from wlr_gym.learning.evaluation.metrics import summarise
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.learning.ppo.policy import PpoPolicy
from wlr_gym.policy import fed_environment

if TYPE_CHECKING:
    from stable_baselines3 import PPO

#: Seed of the first held-out episode; those of ``wlr evaluate`` lie above: its scores owe nothing to the choice of the best.
FIRST_SEED = 90_000
#: Keywords of the training's environment that say which robot and plant are scored.
SAME = ("backend", "plant", "robot", "effects", "precision", "control_period", "free_wheels", "threads")
#: Metrics of a score card that are kept, in order.
METRICS = ("tracking_error", "success", "excess_slip", "reward")


class HeldOutEpisodes:
    """The task as it is scored, with its own randomisation, commands and length, on the robot and plant of the training.

    Args:
        environment: id.
        config: of the training.
    """

    def __init__(self, environment: str, config: PpoConfig) -> None:
        same = {name: config.environment[name] for name in SAME if name in config.environment}
        self.core = make_core(environment, config.evaluation_episodes, same | fed_environment(config.environment))

    def score(self, model: PPO) -> dict[str, float]:
        """Return :data:`METRICS` of the present policy, means over the episodes; the training notices nothing."""
        played = summarise([roll_out(self.core, PpoPolicy(model.policy), FIRST_SEED)])
        sums = {name: played.pairs[name].sum(axis=(0, 1, 2)) for name in METRICS}
        return {name: float(total / count) for name, (total, count) in sums.items() if count > 0.0}

    def close(self) -> None:
        """Release the plant."""
        self.core.close()


def best_of(rows: Iterable[Mapping[str, float]]) -> Mapping[str, float]:
    """Return the best scores; empty where there are none."""
    best: Mapping[str, float] = {}
    for row in rows:
        best = row if is_better(row, best) else best
    return best


def is_better(scores: Mapping[str, float], best: Mapping[str, float]) -> bool:
    """Return whether scores are the best so far: by tracking error, by reward where the task has no limits."""
    if not best:
        return True
    if "tracking_error" in scores:
        return scores["tracking_error"] < best["tracking_error"]
    return scores["reward"] > best["reward"]
