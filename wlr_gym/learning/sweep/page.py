"""The page of a sweep: one HTML file with everything inside."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym import __version__
from wlr_gym.base.files import write_text
from wlr_gym.base.html import commands, document, folded, pictures_of, section, table
from wlr_gym.base.plots import COLOURS, png
from wlr_gym.base.text import duration, number
from wlr_gym.learning.sweep import figures
from wlr_gym.learning.sweep.plan import SweepPlan
from wlr_gym.learning.sweep.results import (
    DONE,
    FAILED,
    STOPPED_EARLY,
    UNFINISHED,
    Summary,
    TrialResult,
    importance,
    summarise,
)

PAGE_FILE = "sweep.html"
#: Rows of the ranking that are shown at once.
_SHOWN = 10
_GOOD, _INCOMPLETE, _BAD = "#2e7d32", "#8a6d00", "#b03030"
_METRIC = {
    "tracking_error": "tracking error", "success": "success (%)", "excess_slip": "excess slip (m/s)", "reward": "reward",
}  # fmt: skip


def write_page(plan: SweepPlan, results: Sequence[TrialResult], folder: Path) -> None:
    """Write ``sweep.html``.

    Raises:
        InputError: it cannot be written.
    """
    write_text(folder / PAGE_FILE, page(plan, results))


def page(plan: SweepPlan, results: Sequence[TrialResult]) -> str:
    """Return the page."""
    ranking = summarise(results, plan.metric)
    count = {status: sum(one.status == status for one in results) for status in (DONE, STOPPED_EARLY, FAILED, UNFINISHED)}
    colour = _BAD if count[FAILED] else _INCOMPLETE if count[UNFINISHED] or not ranking else _GOOD
    title = f"Sweep of {plan.environment}"
    body = [
        _header(plan, ranking, title),
        _tiles(results, ranking, plan.metric, count),
        _failures(results),
        _best(plan, ranking),
        _curves(plan, ranking),
        _importance(plan, results),
        _use(plan, ranking),
        _trials(plan, results),
        f"<footer><p>wlr_gym {escape(__version__)}; the table of all trials: <code>trials.parquet</code>.</p></footer>",
    ]
    return document(title, colour, body)


def name_of(settings: Mapping[str, Any]) -> str:
    """Return settings in words."""
    return ", ".join(f"{name} {_value(value)}" for name, value in settings.items()) or "the settings as given"


def _value(value: Any) -> str:
    return number(value) if isinstance(value, float) else str(value)


def _header(plan: SweepPlan, ranking: Sequence[Summary], title: str) -> str:
    sentence = "No trial has scores yet."
    if ranking:
        best = ranking[0]
        sentence = f"Best: {name_of(best.settings)}. {_METRIC[plan.metric].capitalize()} {_mean(best)}."
    method = ""
    if plan.search is not None:
        method = f", {plan.search.method} search" + (" with early stopping" if plan.search.early_stopping else "")
    return (
        f'<header>\n<p class="label">{escape(title)}</p>\n<h1>{escape(sentence)}</h1>\n<p class="small">Agent '
        f"{escape(plan.agent + method)}; scores are of the held-out episodes, which no training has seen, at the end of each "
        "training.</p>\n</header>"
    )


def _mean(one: Summary) -> str:
    if len(one.values) == 1:
        return f"{number(one.mean)} (one seed)"
    return f"{number(one.mean)} ({number(min(one.values))} to {number(max(one.values))}, {len(one.values)} seeds)"


def _tiles(results: Sequence[TrialResult], ranking: Sequence[Summary], metric: str, count: Mapping[str, int]) -> str:
    tiles = [(str(number_of), f"trials {status}") for status, number_of in count.items() if number_of]
    variances = [np.var(one.values, ddof=1) for one in ranking if one.is_whole and len(one.values) > 1]
    if variances:
        tiles.append((number(float(np.sqrt(np.mean(variances))), 2), f"{_METRIC[metric]}: standard deviation over seeds"))
    tiles.append((f"{sum(one.steps for one in results) / 1e6:,.3g} million", "environment steps"))
    tiles.append((duration(sum(one.seconds for one in results)), "of training, all trials together"))
    items = "".join(f"<li><b>{escape(value)}</b>{escape(text)}</li>" for value, text in tiles)
    return f'<ul class="figures">{items}</ul>'


def _failures(results: Sequence[TrialResult]) -> str:
    rows = [(one.trial.name, one.error) for one in results if one.status == FAILED]
    logs = '<p class="small">What a trial printed is in <code>logs/</code>. Resume the sweep to try them again.</p>'
    return section("Failed", table(("trial", "error"), rows), logs) if rows else ""


def _best(plan: SweepPlan, ranking: Sequence[Summary]) -> str:
    names = list(plan.space)
    headings = (*names, "seeds", _METRIC[plan.metric], "least", "largest", *(_METRIC[name] for name in _others(plan)))
    rows = [_ranking_row(plan, one, names) for one in ranking]
    numeric = set(range(len(names), len(headings)))
    note = ""
    if len(ranking) > 1 and len(ranking[0].values) > 1 and min(ranking[1].values) <= max(ranking[0].values):
        note = (
            "<p>The scores of the best two overlap from seed to seed: training-seed variance may have put them in this order. "
            "More seeds decide.</p>"
        )
    rest = folded(f"{len(rows) - _SHOWN} more", table(headings, rows[_SHOWN:], numeric)) if len(rows) > _SHOWN else ""
    first = rows[:_SHOWN]
    classes = ["selected" if one is rows[0] else "" for one in first]
    return section("Best settings", note, table(headings, first, numeric, classes), rest)


def _others(plan: SweepPlan) -> list[str]:
    return [name for name in _METRIC if name != plan.metric]


def _ranking_row(plan: SweepPlan, one: Summary, names: Sequence[str]) -> tuple[str, ...]:
    ended = [result for result in one.results if result.status == DONE] or one.results
    others = (float(np.mean([result.final.get(name, np.nan) for result in ended])) for name in _others(plan))
    seeds = str(len(one.values)) if one.is_whole else one.results[0].status
    figures_of = (number(one.mean), number(min(one.values)), number(max(one.values)))
    return (*(_value(one.settings.get(name)) for name in names), seeds, *figures_of, *map(number, others))


def _curves(plan: SweepPlan, ranking: Sequence[Summary]) -> str:
    if not ranking:
        return ""
    names = [name_of(one.settings) for one in ranking]
    picture = {"curves": png(figures.curves(ranking, names, plan.metric))}
    caption = (
        "Scores on the held-out episodes over the training: mean over the seeds, band from the least to the largest. "
        f"The best {min(len(COLOURS), len(ranking))} settings in colour, the others grey."
    )
    return section("While they learn", pictures_of("curves", picture, caption))


def _importance(plan: SweepPlan, results: Sequence[TrialResult]) -> str:
    shares = importance(results, plan.metric)
    if not shares:
        return ""
    ended = [one for one in results if one.status == DONE]
    picture = {"effects": png(figures.effects(ended, shares, plan.metric))}
    left = max(0.0, 1.0 - sum(shares.values()))
    text = (
        f"<p>Share of the variance of the final {escape(_METRIC[plan.metric])} between trials that each setting explains alone "
        f"(epsilon squared: the correlation ratio less what chance gives). What is left, {100 * left:.0f} %, is the seed, and "
        "settings that act together.</p>"
    )
    rows = [(name, f"{100 * share:.0f} %") for name, share in shares.items()]
    caption = "Each point a trial that was trained to its end; dashes are means."
    return section("What matters", text, table(("setting", "share"), rows, {1}), pictures_of("effects", picture, caption))


def _use(plan: SweepPlan, ranking: Sequence[Summary]) -> str:
    if not ranking:
        return ""
    best = ranking[0]
    lines = [
        f"wlr evaluate {best.policies} --env {plan.environment}",
        f"wlr play --agent {shlex.quote(str(best.results[0].folder))}",
    ]
    return section("Use the best", "<p>Each trial is an ordinary run folder:</p>", commands(lines))


def _trials(plan: SweepPlan, results: Sequence[TrialResult]) -> str:
    headings = (*plan.space, "seed", "status", _METRIC[plan.metric], "best", "at steps", "steps", "time")
    rows = [
        (
            *(_value(one.trial.settings.get(name)) for name in plan.space),
            str(one.trial.seed),
            one.status,
            number(one.final.get(plan.metric, np.nan)),
            number(one.best.get(plan.metric, np.nan)),
            f"{one.best['steps']:,.0f}" if one.best else "-",
            f"{one.steps:,}",
            duration(one.seconds),
        )
        for one in results
    ]
    first = len(plan.space)
    return section("All trials", folded(f"{len(rows)} trials", table(headings, rows, {first, *range(first + 2, first + 7)})))
