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
from wlr_gym.base.text import duration, number, tally
from wlr_gym.learning.curves import METRICS, best_of, read_curve
from wlr_gym.learning.sweep.plan import SweepPlan, Trial
from wlr_gym.learning.sweep.trial import is_complete, scores_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
        clock = [row["seconds"] for row in curve]  # starts anew wherever the training was resumed
        self.seconds = sum(now - before if now > before else now for before, now in zip([0.0, *clock], clock, strict=False))
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


# ---- settings over seeds ---------------------------------------------------------------------------------------------


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


def write_table(results: Sequence[TrialResult], out: Path) -> None:
    """Write ``trials.parquet``: per trial its name, settings, seed, status, held-out scores, steps, seconds, error, folder.

    Raises:
        InputError: it cannot be written.
    """
    import pandas

    names = dict.fromkeys(name for one in results for name in one.trial.settings)
    columns: dict[str, Sequence[Any]] = {"name": [one.trial.name for one in results]}
    columns |= {name: _column([one.trial.settings.get(name) for one in results]) for name in names}
    columns |= {"seed": [one.trial.seed for one in results], "status": [one.status for one in results]}
    columns |= {f"final_{name}": [one.final.get(name, np.nan) for one in results] for name in METRICS}
    columns |= {f"best_{name}": [one.best.get(name, np.nan) for one in results] for name in (*METRICS, "steps")}
    columns |= {name: [getattr(one, name) for one in results] for name in ("steps", "seconds", "error")}
    columns |= {"folder": [str(one.folder.relative_to(out)) for one in results]}
    frame = pandas.DataFrame(columns)
    replace_file(out / TABLE_FILE, lambda temporary: frame.to_parquet(temporary, index=False))


def _column(values: Sequence[Any]) -> Sequence[Any]:
    """Return a setting's values as one column can hold them: numbers, words or truths (None is missing), all else as JSON."""
    given = [value for value in values if value is not None]
    kinds = {"number" if isinstance(value, int | float) and not isinstance(value, bool) else type(value) for value in given}
    return values if kinds in ({"number"}, {str}, {bool}) else [json.dumps(value) for value in values]


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


def write_page(plan: SweepPlan, results: Sequence[TrialResult], folder: Path) -> None:
    """Write ``sweep.html``, one file with everything inside.

    Raises:
        InputError: it cannot be written.
    """
    ranking, title = summarise(results, plan.metric), f"Sweep of {plan.environment}"
    count = Counter(one.status for one in results)
    colour = _BAD if count[FAILED] else _INCOMPLETE if count[UNFINISHED] or not ranking else _GOOD
    failed = [(one.trial.name, one.error) for one in results if one.status == FAILED]
    logs = '<p class="small">What a trial printed is in <code>logs/</code>. Resume the sweep to try them again.</p>'
    parts = [
        _header(plan, results, ranking, title, count),
        section("Failed", table(("trial", "error"), failed), logs) if failed else "",
        *(_found(plan, ranking) if ranking else []),
        _trials(plan, results),
        "<footer><p>The table of all trials: <code>trials.parquet</code>.</p></footer>",
    ]
    write_text(folder / PAGE_FILE, document(title, colour, parts))


def name_of(settings: Mapping[str, Any]) -> str:
    """Return settings in words."""
    return ", ".join(f"{name} {_value(value)}" for name, value in settings.items()) or "the settings as given"


def _value(value: Any) -> str:
    return number(value) if isinstance(value, float) else str(value)


def _header(
    plan: SweepPlan, results: Sequence[TrialResult], ranking: Sequence[Summary], title: str, count: Mapping[str, int]
) -> str:
    sentence = "No trial has scores yet."
    if ranking:
        best = ranking[0]
        seeds = f"{number(min(best.values))} to {number(max(best.values))}, {len(best.values)} seeds"
        spread = seeds if len(best.values) > 1 else "one seed"
        sentence = f"Best: {name_of(best.settings)}. {_METRIC[plan.metric].capitalize()} {number(best.mean)} ({spread})."
    method = ""
    if plan.search is not None:
        method = f", {plan.search.method} search" + (" with early stopping" if plan.search.early_stopping else "")
    took = f"{sum(one.steps for one in results) / 1e6:,.3g} million environment steps"
    took += f", {duration(sum(one.seconds for one in results))} of training"
    return (
        f'<header>\n<p class="label">{escape(title)}</p>\n<h1>{escape(sentence)}</h1>\n<p class="small">Agent '
        f"{escape(plan.agent + method)}. Trials: {escape(tally(count))}; {took}, all together. Scores are of the held-out "
        "episodes, which no training has seen, at the end of each training.</p>\n</header>"
    )


def _found(plan: SweepPlan, ranking: Sequence[Summary]) -> list[str]:
    """Return the ranking, the curves, and how to use the best."""
    from wlr_gym.base.plots import png

    others = [name for name in _METRIC if name != plan.metric]
    headings = (*plan.space, "seeds", _METRIC[plan.metric], "least", "largest", *(_METRIC[name] for name in others))
    rows = []
    for one in ranking:
        ended = [result for result in one.results if result.status == DONE] or one.results
        scores = (one.mean, min(one.values), max(one.values))
        scores += tuple(float(np.mean([result.final.get(name, np.nan) for result in ended])) for name in others)
        seeds = str(len(one.values)) if one.is_whole else one.results[0].status
        rows.append((*(_value(one.settings.get(name)) for name in plan.space), seeds, *map(number, scores)))
    numeric, best = range(len(plan.space), len(headings)), ranking[0]
    note = ""
    if len(ranking) > 1 and len(best.values) > 1 and min(ranking[1].values) <= max(best.values):
        note = (
            "<p>The scores of the best two overlap from seed to seed: training-seed variance may have put them in this order. "
            "More seeds decide.</p>"
        )
    rest = folded(f"{len(rows) - _SHOWN} more", table(headings, rows[_SHOWN:], numeric)) if len(rows) > _SHOWN else ""
    classes = ["selected", *[""] * (len(rows[:_SHOWN]) - 1)]
    caption = (
        "Scores on the held-out episodes over the training: mean over the seeds, band from the least to the largest. "
        "The best settings in colour, the others grey."
    )
    lines = [
        f"wlr evaluate {best.policies} --env {plan.environment}",
        f"wlr play --agent {shlex.quote(str(best.results[0].folder))}",
    ]
    return [
        section("Best settings", note, table(headings, rows[:_SHOWN], numeric, classes), rest),
        section("While they learn", pictures_of("curves", {"curves": png(curves(ranking, plan.metric))}, caption)),
        section("Use the best", "<p>Each trial is an ordinary run folder:</p>", commands(lines)),
    ]


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


def curves(ranking: Sequence[Summary], metric: str) -> Figure:
    """Draw the deciding metric and success over the steps: mean over the seeds, and a band from the least to the largest.

    The best settings have a colour each, best first; all others are grey.
    """
    from wlr_gym.base.plots import COLOURS, PALE, new_figure, tidy

    figure = new_figure(10.0, 4.6)
    scored = {name for summary in ranking for one in summary.results for name in one.final}
    shown = [metric, *(name for name in ("success", "reward") if name != metric and name in scored)][:2]
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, name in zip(panels, shown, strict=True):
        for rank in reversed(range(len(ranking))):
            _draw_curve(axes, ranking[rank], name, COLOURS[rank] if rank < len(COLOURS) else PALE, rank < len(COLOURS))
        axes.set(xlabel="environment steps (millions)", ylabel=_METRIC[name])
        tidy(axes)
        if name == "success":
            axes.set_ylim(-2.0, 102.0)
        if name == "tracking_error":
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter("{x:g}")
            axes.tick_params(axis="y", which="minor", labelsize=7)
    handles, labels = panels[0].get_legend_handles_labels()
    columns = 2 if len(labels) > 2 else 1
    figure.legend(handles[::-1], labels[::-1], loc="outside lower center", ncols=columns, fontsize=8)
    return figure


def _draw_curve(axes: Axes, summary: Summary, metric: str, colour: str, named: bool) -> None:
    """Draw the scores of settings at the steps at which their seeds were scored."""
    seeds = [{row["steps"]: row[metric] for row in one.scores if row["steps"] > 0 and metric in row} for one in summary.results]
    steps = sorted({step for row in seeds for step in row})
    if not steps:
        return
    scores, x = np.array([[row.get(step, np.nan) for step in steps] for row in seeds]), np.array(steps) / 1e6
    style: dict[str, Any] = {"label": name_of(summary.settings), "linewidth": 1.6} if named else {"linewidth": 1.0}
    axes.plot(x, np.nanmean(scores, axis=0), color=colour, marker="o", markersize=3, **style)
    if len(scores) > 1:
        axes.fill_between(x, np.nanmin(scores, axis=0), np.nanmax(scores, axis=0), color=colour, alpha=0.15, linewidth=0)
