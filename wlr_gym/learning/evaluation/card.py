"""The score card: every subject's scores with confidence intervals, and how the first one compares with the others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.learning.evaluation.conditions import Results
from wlr_gym.learning.evaluation.metrics import Metric, Played, metrics_of, summarise
from wlr_gym.learning.evaluation.rollout import Rollout
from wlr_gym.learning.evaluation.statistics import Bootstrap, Estimate
from wlr_gym.learning.evaluation.sweeps import Sweep

Array = NDArray[np.float64]
Scores = dict[str, Estimate]

#: Label of the condition that the tables and comparisons are about.
MAIN = "main"
#: Label of the same condition on the other plant.
OTHER_PLANT = "other plant"
#: The subject that scores are counted from, if it plays.
IDLE = "do_nothing"
#: Training seeds from which the interquartile mean is not the mean.
FEWEST = 4
#: Metrics that are compared by their difference: a share of 0 %, or of a reward with an arbitrary zero, says nothing.
BY_DIFFERENCE = ("success", "within_scales", "falls", "reward")


@cache
def bootstrap(blocks: int, episodes: int) -> Bootstrap:
    """Return the resamples for so many episodes: always the same ones."""
    return Bootstrap(blocks, episodes)


def _bootstrap(played: Played) -> Bootstrap:
    return bootstrap(*played.pairs["success"].shape[1:3])


def scores_of(played: Played) -> Scores:
    """Return metric -> estimate, mean over training seeds."""
    resampling = _bootstrap(played)
    return {m.key: _possible(resampling.mean(played.pairs[m.key], m.quantile), m) for m in metrics_of(played.measures)}


def _possible(estimate: Estimate, metric: Metric) -> Estimate:
    """Return an estimate without the part of its interval that cannot be: few training seeds that differ give wide ones."""
    low = estimate.low if metric.key == "reward" else max(estimate.low, min(0.0, estimate.mean))
    return Estimate(estimate.mean, low, min(estimate.high, 100.0) if metric.unit == "%" else estimate.high)


def score(rollout: Rollout) -> Scores:
    """Return metric -> estimate of one block of episodes."""
    return scores_of(summarise([rollout]))


def compare(ours: Played, theirs: Played, metrics: Sequence[Metric]) -> Scores:
    """Return metric -> how much better ours is, paired episode by episode: positive is better.

    In % of theirs; metrics in ``BY_DIFFERENCE`` in their own unit.
    """
    resampling = _bootstrap(ours)
    better: Scores = {}
    for metric in metrics:
        a, b = ours.pairs[metric.key], theirs.pairs[metric.key]
        if metric.key in BY_DIFFERENCE:
            better[metric.key] = resampling.difference(*((b, a) if metric.less_is_better else (a, b)))
        else:
            better[metric.key] = resampling.reduction(a, b, metric.quantile)
    return better


@dataclass(frozen=True)
class SeedScores:
    """Scores of the training seeds of a recipe.

    Attributes:
        scores: training seed -> metric -> estimate; the interval is over episodes alone.
        interquartile_mean: metric -> estimate, its interval over training seeds and episodes; empty below ``FEWEST`` seeds.
    """

    scores: Mapping[str, Scores]
    interquartile_mean: Scores

    @property
    def median_seed(self) -> str:
        """Training seed in the middle by tracking error (reward where the task has no limits); of two, the better one."""
        by_error = {seed: own["tracking_error"].mean for seed, own in self.scores.items()}
        if np.isnan(list(by_error.values())).any():
            by_error = {seed: -own["reward"].mean for seed, own in self.scores.items()}
        return sorted(by_error, key=lambda seed: by_error[seed])[(len(by_error) - 1) // 2]

    def median(self, key: str) -> float:
        """Return the median of a metric over training seeds."""
        return float(np.median([own[key].mean for own in self.scores.values()]))

    def spread(self, key: str) -> float:
        """Return largest minus smallest score over the magnitude of the median, %; NaN where that is zero."""
        values = [own[key].mean for own in self.scores.values()]
        middle = abs(self.median(key))
        return float(100.0 * (max(values) - min(values)) / middle) if middle > 0.0 else np.nan


def seed_scores(played: Played, seeds: Sequence[str]) -> SeedScores:
    """Return the scores of each training seed of a subject."""
    resampling = _bootstrap(played)
    pairs = played.pairs
    scores = {
        seed: scores_of(replace(played, pairs={key: own[index : index + 1] for key, own in pairs.items()}))
        for index, seed in enumerate(seeds)
    }
    metrics = metrics_of(played.measures) if len(seeds) >= FEWEST else ()
    return SeedScores(scores, {m.key: resampling.interquartile_mean(pairs[m.key], m.quantile) for m in metrics})


@dataclass(frozen=True)
class Card:
    """Everything that was played and what it was played for.

    Attributes:
        results: condition -> subject -> what is kept. Conditions: ``MAIN``, perhaps ``OTHER_PLANT``, and those of the sweeps.
        sweeps: which were played.
        conditions: what to say about how it was played.
        training_seeds: subject -> training seed of each of its policies, where there are several.
        identities: subject -> what identifies it; see :func:`wlr_gym.learning.evaluation.subjects.identity`.
    """

    results: Results
    sweeps: tuple[Sweep, ...] = ()
    conditions: Mapping[str, Any] = field(default_factory=dict)
    identities: Mapping[str, str] = field(default_factory=dict)
    training_seeds: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def main(self) -> dict[str, Played]:
        """Subject -> what is kept of the main condition."""
        return self.results[MAIN]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the subjects; the first is the one the card is about."""
        return tuple(self.main)

    @cached_property
    def metrics(self) -> tuple[Metric, ...]:
        """Rows of the card."""
        return metrics_of(self.main[self.names[0]].measures)

    @cached_property
    def scores(self) -> dict[str, dict[str, Scores]]:
        """Condition -> subject -> metric -> estimate."""
        return {
            label: {name: scores_of(played) for name, played in subjects.items()} for label, subjects in self.results.items()
        }

    @cached_property
    def comparison(self) -> dict[str, dict[str, Scores]]:
        """Condition -> baseline -> metric -> how much better the first subject is; see :func:`compare`."""
        ours, *others = self.names
        return {
            label: {name: compare(subjects[ours], subjects[name], self.metrics) for name in others}
            for label, subjects in self.results.items()
        }

    @cached_property
    def share_of(self) -> dict[str, Estimate]:
        """Baseline -> the first subject's score in % of the baseline's; a score is the reward above doing nothing's."""
        ours, *others = self.names
        if IDLE not in others:
            return {}
        idle = self.main[IDLE].pairs["reward"]
        resampling = _bootstrap(self.main[ours])
        reward = {name: played.pairs["reward"] for name, played in self.main.items()}
        subjects = (0, 1, 2, 2)
        return {
            name: resampling.share(reward[ours], reward[name], idle, idle, subjects=subjects) for name in others if name != IDLE
        }

    @cached_property
    def kept(self) -> dict[str, Estimate]:
        """Subject -> what it keeps of its score on the other plant, %."""
        other = self.results.get(OTHER_PLANT, {})
        if IDLE not in other:
            return {}
        blocks, episodes = other[IDLE].pairs["reward"].shape[1:3]
        there = {name: played.pairs["reward"] for name, played in other.items()}
        here = {name: played.pairs["reward"][:, :blocks, :episodes] for name, played in self.main.items()}
        resampling, subjects = bootstrap(blocks, episodes), (0, 0, 2, 2)
        return {
            name: resampling.share(there[name], here[name], there[IDLE], here[IDLE], subjects=subjects)
            for name in self.names
            if name != IDLE
        }

    @cached_property
    def seed_scores(self) -> dict[str, SeedScores]:
        """Subject -> scores of each of its training seeds, where there are several."""
        return {name: seed_scores(self.main[name], seeds) for name, seeds in self.training_seeds.items()}
