"""The score card: every subject's scores with confidence intervals, and how the first one compares with the others.

As data (:class:`Card`), as tables of text, Markdown and JSON, and its episodes as a table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.files import replace_file, write_json, write_text
from wlr_gym.learning.evaluation.conditions import BLOCK, Results, Sweep
from wlr_gym.learning.evaluation.metrics import CONFIDENCE, Bootstrap, Estimate, Metric, Played, metrics_of, summarise
from wlr_gym.learning.evaluation.rollout import Rollout

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


# ---- text, Markdown, JSON --------------------------------------------------------------------------------------------

#: Version of ``card.json``.
FORMAT = 2
#: Beyond this a number is the quotient of something and next to nothing, such as the slip of a robot against one that rests.
LARGEST = 1000.0
#: Metrics that are shown for each training seed.
PER_SEED = ("tracking_error", "success", "excess_slip", "reward")
Table = list[list[str]]


def rows(scores: Mapping[str, Scores], metrics: Sequence[Metric], *, short: bool = False) -> Table:
    """Return a table as text: a header, then one row per metric with a column per subject.

    ``short`` gives half the width of the interval instead of its ends.
    """
    header = ["metric", "unit", *scores]
    return [header, *([m.key, m.unit, *(_value(m, own, short) for own in scores.values())] for m in metrics)]


def _value(metric: Metric, scores: Scores, short: bool) -> str:
    largest = math.inf if metric.key == "reward" else LARGEST  # a reward is no quotient
    return cell(scores[metric.key], metric.digits, short, largest)


def cell(estimate: Estimate, digits: int, short: bool = False, largest: float = LARGEST) -> str:
    """Return ``mean [low, high]``, or ``mean ± half``; ``-`` where there is nothing or nothing to compare with.

    The mean alone where it has no interval.
    """
    if not abs(estimate.mean) <= largest:
        return "-"
    if not math.isfinite(estimate.high - estimate.low):
        return _text(estimate.mean, digits)
    if short:
        return f"{_text(estimate.mean, digits)} ± {_text((estimate.high - estimate.low) / 2, digits)}"
    return f"{_text(estimate.mean, digits)} [{_text(estimate.low, digits)}, {_text(estimate.high, digits)}]"


def _text(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"  # no -0


def comparison_rows(card: Card, *, short: bool = False) -> Table:
    """Return how much better the first subject is than each baseline: a header, then one row per metric, and the score."""
    others = card.comparison[MAIN]
    table = [["better in", "unit", *others]]
    for metric in card.metrics:
        unit, digits = (metric.unit, metric.digits) if metric.key in BY_DIFFERENCE else ("%", 1)
        unit = "points" if unit == "%" and metric.key in BY_DIFFERENCE else unit
        table.append([metric.key, unit, *(_comparing(own[metric.key], digits, short) for own in others.values())])
    if card.share_of:
        shares = [cell(card.share_of[name], 1, short) if name in card.share_of else "-" for name in others]
        table.append(["score, % of the baseline's", "%", *shares])
    return table


def _comparing(estimate: Estimate, digits: int, short: bool) -> str:
    """A cell, in bold (of Markdown) where the interval excludes zero."""
    text = cell(estimate, digits, short)
    return f"**{text}**" if not short and text != "-" and estimate.excludes_zero else text


def sweep_rows(card: Card, index: int, *, short: bool = True) -> Table:
    """Return the tracking errors of a sweep: a header, then one row per point with a column per subject."""
    sweep = card.sweeps[index]
    digits = next(metric.digits for metric in card.metrics if metric.key == "tracking_error")
    body = [
        [point.label, *(cell(own["tracking_error"], digits, short) for own in card.scores[sweep.label(point)].values())]
        for point in sweep.points
    ]
    return [[sweep.axis, *card.names], *body]


def sweep_comparison_rows(card: Card, index: int) -> Table:
    """Return how much better the first subject tracks over a sweep, in %: one row per point with a column per baseline."""
    sweep = card.sweeps[index]
    body = [
        [point.label, *(_comparing(own["tracking_error"], 1, False) for own in card.comparison[sweep.label(point)].values())]
        for point in sweep.points
    ]
    return [[sweep.axis, *card.names[1:]], *body]


def transfer_rows(card: Card, *, short: bool = False) -> Table:
    """Return scores on both plants on the same floors: a header, then one row per subject."""
    keys = ("tracking_error", "success", "excess_slip")
    digits = {metric.key: metric.digits for metric in card.metrics}
    table = [["policy", "score kept (%)", *(f"{key}{plant}" for key in keys for plant in ("", ", other"))]]
    for name in card.names:
        kept = cell(card.kept[name], 1, short) if name in card.kept else "-"
        pairs = [(card.scores[label][name][key], digits[key]) for key in keys for label in (MAIN, OTHER_PLANT)]
        table.append([name, kept, *(cell(estimate, places, short) for estimate, places in pairs)])
    return table


def seed_rows(card: Card, name: str, *, short: bool = False) -> Table:
    """Return the scores of a subject's training seeds: a header, then one row per seed and those over all seeds."""
    seeds = card.seed_scores[name]
    metrics = [
        metric for metric in card.metrics if metric.key in PER_SEED and np.isfinite(card.scores[MAIN][name][metric.key].mean)
    ]

    def row(title: str, scores: Scores) -> list[str]:
        return [title, *(_value(m, scores, short) for m in metrics)]

    table = [["training seed", *(m.key if m.unit == "-" else f"{m.key} ({m.unit})" for m in metrics)]]
    table += [row(seed, scores) for seed, scores in seeds.scores.items()]
    table.append(row("mean", card.scores[MAIN][name]))
    if seeds.interquartile_mean:
        table.append(row("interquartile mean", seeds.interquartile_mean))
    table.append(["median", *(_text(seeds.median(m.key), m.digits) for m in metrics)])
    spreads = [seeds.spread(m.key) for m in metrics]
    table.append(["(max - min) / median", *(f"{spread:.0f} %" if spread <= LARGEST else "-" for spread in spreads)])
    return table


def markdown(card: Card, pictures: Mapping[str, str] | None = None) -> str:
    """Return the card as Markdown. ``pictures``: name -> file, linked where they belong."""
    shown = dict(pictures or {})
    ours = card.names[0]

    def picture(name: str, text: str) -> list[str]:
        return [f"![{text}]({shown[name]})", ""] if name in shown else []

    lines = [f"# Score card: {ours}", "", *(f"- {name}: {value}" for name, value in card.conditions.items()), ""]
    lines += [*_table(rows(card.scores[MAIN], card.metrics)), ""]
    over = "training seeds and episodes" if card.training_seeds else "blocks and episodes"
    lines += [f"Mean over episodes [{CONFIDENCE:.0%} bootstrap interval over {over}]; `-` where nothing moved.", ""]
    lines += _training_seeds(card)
    if len(card.names) > 1:
        lines += [f"## {ours} against the others, on the same episodes", ""]
        how = "is better (positive) or worse, paired episode by episode; bold: the interval excludes 0."
        lines += [f"By how much {ours} {how}", ""]
        lines += [*_table(comparison_rows(card)), "", *picture("improvement", "Paired improvements")]
    lines += picture("pareto", "Tracking error against slip, 95 % intervals")
    for index, sweep in enumerate(card.sweeps):
        lines += [f"## Sweep: {sweep.name}", "", f"{sweep.doc[0].upper()}{sweep.doc[1:]}. Tracking error:", ""]
        lines += [*_table(sweep_rows(card, index, short=False)), ""]
        if len(card.names) > 1:
            lines += [f"By how much {ours} is better in it (%), paired:", ""]
            lines += [*_table(sweep_comparison_rows(card, index)), ""]
        lines += picture(f"sweep_{sweep.name}", f"Sweep: {sweep.name}")
    if OTHER_PLANT in card.results:
        lines += ["## On the other plant", "", "The same floors, robots and commands in the other simulator.", ""]
        lines += [*_table(transfer_rows(card)), ""]
    if "spectrum" in shown:
        lines += ["## Spectrum of the action", "", *picture("spectrum", "Spectrum of the action")]
    if card.identities:
        lines += ["## Who played", "", "SHA-256 of the policy file or of an agent's settings:", ""]
        lines += [*(f"- {name}: `{identity}`" for name, identity in card.identities.items()), ""]
    lines += ["## Meaning of the rows", ""]
    lines += [f"- `{m.key}` ({m.unit}, {'less' if m.less_is_better else 'more'} is better): {m.doc}" for m in card.metrics]
    lines += ["- score: reward above that of doing nothing on the same episodes"]
    return "\n".join(lines) + "\n"


def _training_seeds(card: Card) -> list[str]:
    lines = []
    for name, seeds in card.seed_scores.items():
        said = (
            f"{len(seeds.scores)} trainings of one recipe; median seed: {seeds.median_seed}. The interval of one seed is over "
        )
        said += "episodes alone; that over all seeds contains training-seed variance."
        lines += [f"## Training seeds of {name}", "", said, "", *_table(seed_rows(card, name)), ""]
    single = [name for name in card.names if name not in card.training_seeds]
    if lines and single:
        lines += [f"One policy each, intervals without training-seed variance of theirs: {', '.join(single)}.", ""]
    return lines


def _table(table: Table) -> list[str]:
    header, *body = table
    return [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}", *(f"| {' | '.join(row)} |" for row in body)]


def content(card: Card) -> dict[str, Any]:
    """Return the card as plain types: what ``card.json`` holds."""
    power = {name: [_plain(density) for density in played.power] for name, played in card.main.items()}
    document: dict[str, Any] = {
        "format": FORMAT,
        "conditions": dict(card.conditions),
        "identities": dict(card.identities),
        "metrics": {m.key: {"unit": m.unit, "less_is_better": m.less_is_better, "doc": m.doc} for m in card.metrics},
        **_policies(card, MAIN),
        "score_in_percent_of": _plain(card.share_of),
        "sweeps": {
            sweep.name: [{"at": point.label, **_policies(card, sweep.label(point))} for point in sweep.points]
            for sweep in card.sweeps
        },
        "spectrum": {"frequency": card.main[card.names[0]].frequency.tolist(), "power": power},
    }
    if OTHER_PLANT in card.results:
        document["other_plant"] = {**_policies(card, OTHER_PLANT), "score_kept": _plain(card.kept)}
    if card.training_seeds:
        document["training_seeds"] = {
            name: {
                "scores": _plain(seeds.scores),
                "interquartile_mean": _plain(seeds.interquartile_mean),
                "median_seed": seeds.median_seed,
                "spread_in_percent_of_median": _plain({metric.key: seeds.spread(metric.key) for metric in card.metrics}),
            }
            for name, seeds in card.seed_scores.items()
        }
    return document


def _policies(card: Card, label: str) -> dict[str, Any]:
    return {"policies": _plain(card.scores[label]), "better_than": _plain(card.comparison[label])}


def _plain(value: Any) -> Any:
    """Return estimates, in mappings or alone, and numbers as plain types; None for what is not finite."""
    if isinstance(value, Mapping):
        return {key: _plain(own) for key, own in value.items()}
    if isinstance(value, Estimate):
        return _plain(vars(value))
    return float(value) if np.isfinite(value) else None


def write_card(folder: Path, card: Card, pictures: Mapping[str, str] | None = None) -> None:
    """Write ``card.md`` and ``card.json`` into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "card.md", markdown(card, pictures))
    write_json(folder / "card.json", content(card))


def write_episodes(path: Path, card: Card, first_seed: int) -> None:
    """Write one row per condition, subject, training seed and episode as Parquet: seeds and the episode's own metrics."""
    import pandas

    frames = []
    for label, subjects in card.results.items():
        for name, played in subjects.items():
            count, blocks, episodes = played.pairs["success"].shape[:3]
            seeds = first_seed + BLOCK * np.arange(blocks)[:, None] + np.arange(episodes)
            table = {"condition": label, "policy": name, "seed": np.tile(seeds.ravel(), count)}
            if card.training_seeds:
                table["training_seed"] = np.repeat(card.training_seeds.get(name, ("",) * count), blocks * episodes)
            with np.errstate(divide="ignore", invalid="ignore"):
                table |= {key: (pairs[..., 0] / pairs[..., 1]).ravel() for key, pairs in played.pairs.items()}
            frames.append(pandas.DataFrame(table))
    replace_file(path, lambda temporary: pandas.concat(frames, ignore_index=True).to_parquet(temporary, index=False))
