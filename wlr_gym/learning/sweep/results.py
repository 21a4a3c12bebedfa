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
from wlr_gym.base.text import counted, number, tally
from wlr_gym.learning.curves import METRICS, best_of, rows_of, wall_time
from wlr_gym.learning.sweep.plan import SweepPlan, Trial
from wlr_gym.learning.sweep.trial import is_complete

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


@dataclass(frozen=True)
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

    @classmethod
    def read(cls, trial: Trial, folder: Path, status: str = UNFINISHED, error: str = "") -> TrialResult:
        """Read a run folder; a training that has done all its steps is done."""
        curve, scores = rows_of(folder / "learning_curve.csv"), rows_of(folder / "held_out.csv")
        status = FAILED if error else DONE if is_complete(folder) else status
        return cls(trial, folder, status, error, scores, int(curve[-1]["steps"]) if curve else 0, wall_time(curve))

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
        row = {"name": one.trial.name, **one.trial.settings, "seed": one.trial.seed, "status": one.status}
        row |= {f"final_{name}": one.final.get(name, np.nan) for name in METRICS}
        row |= {f"best_{name}": one.best.get(name, np.nan) for name in (*METRICS, "steps")}
        row |= {"steps": one.steps, "seconds": one.seconds, "error": one.error, "folder": str(one.folder.relative_to(out))}
        rows.append(row)
    return pandas.DataFrame({name: _column([row[name] for row in rows]) for name in rows[0]})


def _column(values: Sequence[Any]) -> Sequence[Any]:
    """Return a setting's values as one column can hold them: numbers, words or truths (None is missing), all else as JSON."""
    given = [value for value in values if value is not None]
    kinds = {"number" if isinstance(value, int | float) and not isinstance(value, bool) else type(value) for value in given}
    return values if kinds in ({"number"}, {str}, {bool}) else [json.dumps(value) for value in values]


def write_results(plan: SweepPlan, results: Sequence[TrialResult], out: Path) -> None:
    """Write table and page: ``trials.parquet`` and ``sweep.html``."""
    frame = frame_of(results, out)
    replace_file(out / TABLE_FILE, lambda temporary: frame.to_parquet(temporary, index=False))
    write_text(out / PAGE_FILE, _page(plan, results, frame))


# ---- the page --------------------------------------------------------------------------------------------------------

_CAPTION = "Scores on the held-out episodes: mean over the seeds, band from the least to the largest. The best in colour."


def words(value: Any) -> str:
    """Return a setting or score, or several settings by name, as a page and a terminal show them."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {words(one)}" for name, one in value.items()) or "the settings as given"
    return number(value) if isinstance(value, float) else str(value)


def _page(plan: SweepPlan, results: Sequence[TrialResult], frame: DataFrame) -> str:
    """Return ``sweep.html``: one file with everything inside."""
    from wlr_gym.base.plots import png

    ranking, metric = summarise(results, plan.metric), plan.metric.replace("_", " ")
    failed = [(one.trial.name, one.error) for one in results if one.status == FAILED]
    sentence, parts = "No trial has scores yet.", [section("Failed", table(("trial", "error"), failed))]
    if ranking:
        best = ranking[0]
        ends = f"{number(min(best.values))} to {number(max(best.values))}, " if len(best.values) > 1 else ""
        seeds = f"{ends}{counted(len(best.values), 'seed')}"
        sentence = f"Best: {words(best.settings)}. {metric.capitalize()} {number(best.mean)} ({seeds})."
        rows = [
            [
                *(words(one.settings[name]) for name in plan.space),
                str(len(one.values)) if one.is_whole else one.results[0].status,
                *(number(value) for value in (one.mean, min(one.values), max(one.values))),
            ]
            for one in ranking
        ]
        play = f"wlr play --agent {shlex.quote(str(best.results[0].folder))}"
        parts += [
            section("Best settings", table([*plan.space, "seeds", metric, "least", "largest"], rows)),
            section("While they learn", pictures_of("curves", {"curves": png(curves(ranking, plan.metric))}, _CAPTION)),
            section("Use the best", commands([f"wlr evaluate {best.policies} --env {plan.environment}", play])),
        ]
    shown = frame.drop(columns=["name", "error", "folder"])
    trials = table(list(shown), [[words(cell) for cell in row] for row in shown.itertuples(index=False)])
    title, count = f"Sweep of {plan.environment}", tally(Counter(one.status for one in results))
    header = f"<header><h1>{escape(sentence)}</h1><p>{escape(f'{title}. Trials: {count}.')}</p></header>"
    every = section("All trials", folded(counted(len(results), "trial"), trials))
    return document(title, "#b03030" if failed or not ranking else "#2e7d32", [header, *parts, every])


def curves(ranking: Sequence[Summary], metric: str) -> Figure:
    """Draw the deciding metric over the steps: mean over the seeds, and a band from the least to the largest.

    The best settings have a colour each, best first; all others are grey.
    """
    import pandas

    from wlr_gym.base.plots import COLOURS, PALE, legend_below, log_axis, new_figure, tidy

    figure = new_figure(8.0, 4.6)
    axes = figure.subplots()
    for rank, summary in reversed(list(enumerate(ranking))):
        colour, label = (COLOURS[rank], words(summary.settings)) if rank < len(COLOURS) else (PALE, None)
        scores = pandas.DataFrame([row for one in summary.results for row in one.scores if row["steps"] > 0.0])
        if scores.empty:  # scored before the first update only
            continue
        over = scores.groupby("steps")[metric].agg(["mean", "min", "max"])
        steps = over.index.to_numpy() / 1e6
        axes.plot(steps, over["mean"], color=colour, label=label, marker="o", markersize=3)
        axes.fill_between(steps, over["min"], over["max"], color=colour, alpha=0.15, linewidth=0)
    axes.set(xlabel="environment steps (millions)", ylabel=metric.replace("_", " "))
    tidy(axes)
    if metric == "tracking_error" and axes.lines:
        axes.set_yscale("log")
        log_axis(axes.yaxis)
    legend_below(figure, columns=2)
    return figure
