"""What a sweep has found: its trials' scores, the ranking of settings over their seeds, the table, the page."""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.files import replace_file, write_text
from wlr_gym.base.html import commands, document, folded, pictures_of, section, table
from wlr_gym.base.text import counted, duration, number, tally
from wlr_gym.learning.curves import METRICS, best_of, read_curve, wall_time
from wlr_gym.learning.sweep.plan import SweepPlan, Trial
from wlr_gym.learning.sweep.trial import is_complete, scores_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

TABLE_FILE = "trials.parquet"
PAGE_FILE = "sweep.html"
#: Status of a trial.
DONE = "done"
FAILED = "failed"
STOPPED_EARLY = "stopped early"
UNFINISHED = "unfinished"

Scores = Mapping[str, float]


@dataclass
class TrialResult:
    """What is known of a trial.

    Attributes:
        trial: its settings and seed.
        folder: run folder.
        status: ``done``, ``failed``, ``stopped early`` (by the search) or ``unfinished``.
        error: why it failed.
        scores: rows of ``held_out.csv``.
        steps: environment steps done.
        seconds: wall time of its updates.
    """

    trial: Trial
    folder: Path
    status: str = UNFINISHED
    error: str = ""
    scores: Sequence[Scores] = ()
    steps: int = 0
    seconds: float = 0.0

    def read(self) -> None:
        """Read the run folder; a training that has done all its steps is done."""
        file = self.folder / "learning_curve.csv"
        curve = read_curve(file) if file.is_file() else []
        self.seconds = wall_time(curve)
        self.steps = int(curve[-1]["steps"]) if curve else 0
        self.scores = scores_of(self.folder)
        if is_complete(self.folder) and not self.error:
            self.status = DONE

    @property
    def final(self) -> Scores:
        """Newest scores on the held-out episodes; empty before the first."""
        return self.scores[-1] if self.scores else {}

    @property
    def best(self) -> Scores:
        """Scores of the policy in ``best/``."""
        return best_of(self.scores)


@dataclass(frozen=True)
class Summary:
    """Settings over all their seeds.

    Attributes:
        settings: what the trials set.
        results: its trials that have scores.
        values: final score of each that was trained to its end; of those stopped early, where none was.
        is_whole: whether these were trained to their end.
    """

    settings: Mapping[str, Any]
    results: Sequence[TrialResult]
    values: Sequence[float]
    is_whole: bool

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return float(np.mean(self.values))

    @property
    def policies(self) -> str:
        """Its trainings as ``wlr evaluate`` takes them, quoted for a shell: all seeds as one column."""
        first = self.results[0]
        every = first.folder.with_name(first.trial.name.removesuffix(str(first.trial.seed)) + "*")
        return shlex.quote(str(first.folder if len(self.results) == 1 else every))


def summarise(results: Sequence[TrialResult], metric: str) -> list[Summary]:
    """Return all settings with scores, best first; those of which no trial was trained to its end come last."""
    groups: dict[str, list[TrialResult]] = {}
    for one in results:
        if np.isfinite(one.final.get(metric, np.nan)):
            groups.setdefault(one.trial.label, []).append(one)
    found = []
    for group in groups.values():
        ended = [one for one in group if one.status == DONE]
        values = [one.final[metric] for one in ended or group]
        found.append(Summary(group[0].trial.settings, group, values, bool(ended)))
    sign = 1.0 if METRICS[metric] else -1.0
    return sorted(found, key=lambda one: (not one.is_whole, sign * one.mean))


# ---- the table -------------------------------------------------------------------------------------------------------


def frame_of(results: Sequence[TrialResult], out: Path) -> DataFrame:
    """Return a row per trial: name, settings, seed, status, held-out scores, steps, seconds, error, folder in ``out``."""
    import pandas

    rows = []
    for one in results:
        row = {"name": one.trial.name, "seed": one.trial.seed, "status": one.status}
        row |= {f"final_{name}": one.final.get(name, np.nan) for name in METRICS}
        row |= {f"best_{name}": one.best.get(name, np.nan) for name in (*METRICS, "steps")}
        row |= {"steps": one.steps, "seconds": one.seconds, "error": one.error, "folder": str(one.folder.relative_to(out))}
        rows.append(row)
    frame = pandas.DataFrame(rows)
    settings = dict.fromkeys(name for one in results for name in one.trial.settings if name not in frame)
    for place, name in enumerate(settings, 1):
        frame.insert(place, name, _column([one.trial.settings.get(name) for one in results]))
    return frame


def _column(values: Sequence[Any]) -> Sequence[Any]:
    """Return a setting's values as one column can hold them: numbers, words or truths (None is missing), all else as JSON."""
    given = [value for value in values if value is not None]
    kinds = {"number" if isinstance(value, int | float) and not isinstance(value, bool) else type(value) for value in given}
    return values if kinds in ({"number"}, {str}, {bool}) else [json.dumps(value) for value in values]


def write_table(results: Sequence[TrialResult], out: Path) -> None:
    """Write ``trials.parquet``."""
    replace_file(out / TABLE_FILE, lambda temporary: frame_of(results, out).to_parquet(temporary, index=False))


def stopped_early(out: Path) -> set[str]:
    """Return the names of the trials that the table of a sweep says were stopped early."""
    import pandas

    if not (out / TABLE_FILE).is_file():
        return set()
    frame = pandas.read_parquet(out / TABLE_FILE, columns=["name", "status"])
    return set(frame.loc[frame["status"] == STOPPED_EARLY, "name"])


# ---- the page --------------------------------------------------------------------------------------------------------

#: Rows of the ranking that are shown at once.
_SHOWN = 10
_GOOD, _INCOMPLETE, _BAD = "#2e7d32", "#8a6d00", "#b03030"
_METRIC = {
    "tracking_error": "tracking error", "success": "success (%)", "excess_slip": "excess slip (m/s)", "reward": "reward",
}  # fmt: skip
_CAPTION = (
    "Scores on the held-out episodes over the training: mean over the seeds, band from the least to the largest. The best "
    "settings in colour, the others grey."
)
_OVERLAP = (
    "<p>The scores of the best two overlap from seed to seed: training-seed variance may have put them in this order. More "
    "seeds decide.</p>"
)


def write_page(plan: SweepPlan, results: Sequence[TrialResult], folder: Path) -> None:
    """Write ``sweep.html``, one file with everything inside."""
    from wlr_gym.base.plots import png

    ranking, count = summarise(results, plan.metric), Counter(one.status for one in results)
    colour = _BAD if count[FAILED] else _INCOMPLETE if count[UNFINISHED] or not ranking else _GOOD
    parts = [_header(plan, results, ranking, count)]
    if count[FAILED]:
        failed = [(one.trial.name, one.error) for one in results if one.status == FAILED]
        logs = '<p class="small">What a trial printed is in <code>logs/</code>. Resume the sweep to try them again.</p>'
        parts.append(section("Failed", table(("trial", "error"), failed), logs))
    if ranking:
        best, second = ranking[0], ranking[1:2]
        overlap = len(best.values) > 1 and any(min(one.values) <= max(best.values) for one in second)
        first, rest = _ranking(plan, ranking[:_SHOWN], best), _ranking(plan, ranking[_SHOWN:], best)
        parts += [
            section("Best settings", _OVERLAP if overlap else "", first, folded(f"{len(ranking) - _SHOWN} more", rest)),
            section("While they learn", pictures_of("curves", {"curves": png(curves(ranking, plan.metric))}, _CAPTION)),
            section("Use the best", "<p>Each trial is an ordinary run folder:</p>", commands([
                f"wlr evaluate {best.policies} --env {plan.environment}",
                f"wlr play --agent {shlex.quote(str(best.results[0].folder))}",
            ])),
        ]  # fmt: skip
    metric = _METRIC[plan.metric]
    shown = [*plan.space, "seed", "status", metric, f"best {metric}", "at step", "steps", "time"]
    rows = []
    for one in results:
        settings = [words(one.trial.settings.get(name)) for name in plan.space]
        scores = [number(found[plan.metric]) if found else "-" for found in (one.final, one.best)]
        step = f"{one.best['steps']:,.0f}" if one.best else "-"
        rows.append([*settings, str(one.trial.seed), one.status, *scores, step, f"{one.steps:,}", duration(one.seconds)])
    trials = table(shown, rows, range(len(plan.space) + 2, len(shown)))
    parts += [
        section("All trials", folded(counted(len(rows), "trial"), trials)),
        "<footer><p>The table of all trials: <code>trials.parquet</code>.</p></footer>",
    ]
    write_text(folder / PAGE_FILE, document(f"Sweep of {plan.environment}", colour, parts))


def words(value: Any) -> str:
    """Return a setting or score, or several settings by name, as a page and a terminal show them."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {words(one)}" for name, one in value.items()) or "the settings as given"
    return number(value) if isinstance(value, float) else str(value)


def _header(plan: SweepPlan, results: Sequence[TrialResult], ranking: Sequence[Summary], count: Mapping[str, int]) -> str:
    sentence = "No trial has scores yet."
    if ranking:
        best = ranking[0]
        ends = f"{number(min(best.values))} to {number(max(best.values))}, " if len(best.values) > 1 else ""
        seeds = f"{ends}{counted(len(best.values), 'seed')}"
        sentence = f"Best: {words(best.settings)}. {_METRIC[plan.metric].capitalize()} {number(best.mean)} ({seeds})."
    method = "" if plan.search is None else f", {plan.search.method} search"
    method += " with early stopping" if plan.search is not None and plan.search.early_stopping else ""
    took = f"{sum(one.steps for one in results) / 1e6:,.3g} million environment steps"
    took += f", {duration(sum(one.seconds for one in results))} of training"
    return (
        f'<header>\n<p class="label">{escape(f"Sweep of {plan.environment}")}</p>\n<h1>{escape(sentence)}</h1>\n'
        f'<p class="small">Agent {escape(plan.agent + method)}. Trials: {escape(tally(count))}; {took}, all together. Scores '
        "are of the held-out episodes, which no training has seen, at the end of each training.</p>\n</header>"
    )


def _ranking(plan: SweepPlan, ranking: Sequence[Summary], best: Summary) -> str:
    """Return settings with their scores as a table; the best are marked."""
    others = [name for name in _METRIC if name != plan.metric]
    headings = (*plan.space, "seeds", _METRIC[plan.metric], "least", "largest", *(_METRIC[name] for name in others))
    rows = []
    for one in ranking:
        ended = [result for result in one.results if result.status == DONE] or one.results
        means = (float(np.mean([result.final.get(name, np.nan) for result in ended])) for name in others)
        seeds = str(len(one.values)) if one.is_whole else one.results[0].status
        settings = (words(one.settings.get(name)) for name in plan.space)
        rows.append((*settings, seeds, *map(number, (one.mean, min(one.values), max(one.values), *means))))
    classes = ["selected" if one is best else "" for one in ranking]
    return table(headings, rows, range(len(plan.space), len(headings)), classes)


def curves(ranking: Sequence[Summary], metric: str) -> Figure:
    """Draw the deciding metric and success over the steps: mean over the seeds, and a band from the least to the largest.

    The best settings have a colour each, best first; all others are grey.
    """
    import pandas

    from wlr_gym.base.plots import COLOURS, PALE, legend_below, log_axis, new_figure, tidy

    scores = [pandas.concat([pandas.DataFrame(list(one.scores)) for one in summary.results]) for summary in ranking]
    shown = [name for name in dict.fromkeys((metric, "success", "reward")) if any(name in one for one in scores)][:2]
    figure = new_figure(10.0, 4.6)
    for axes, name in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        for rank in reversed(range(len(ranking))):
            best = rank < len(COLOURS)
            colour, label = (COLOURS[rank], words(ranking[rank].settings)) if best else (PALE, None)
            own = scores[rank].reindex(columns=["steps", name]).query("steps > 0").dropna()
            if own.empty:  # scored before the first update only
                continue
            over = own.groupby("steps")[name].agg(["mean", "min", "max"])
            steps = over.index.to_numpy() / 1e6
            axes.plot(steps, over["mean"], color=colour, label=label, marker="o", markersize=3, linewidth=1.6 if best else 1.0)
            axes.fill_between(steps, over["min"], over["max"], color=colour, alpha=0.15, linewidth=0)
        axes.set(xlabel="environment steps (millions)", ylabel=_METRIC[name])
        tidy(axes)
        if name == "success":
            axes.set_ylim(-2.0, 102.0)
        if name == "tracking_error" and axes.lines:
            axes.set_yscale("log")
            log_axis(axes.yaxis)
    legend_below(figure, columns=2)
    return figure
