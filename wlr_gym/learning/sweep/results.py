"""What the run folders of a sweep hold: scores, steps, time; and the table of all trials."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.files import replace_file
from wlr_gym.base.provenance import CONFIG_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.learning.evaluation import read_curve
from wlr_gym.learning.ppo.held_out import best_of
from wlr_gym.learning.sweep.plan import METRICS, Trial

if TYPE_CHECKING:
    import pandas

TABLE_FILE = "trials.parquet"
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
        status: ``done``, ``failed``, ``stopped early`` (by the search) or ``unfinished``.
        scores: rows of ``held_out.csv``.
        steps: environment steps done.
        seconds: wall time of its updates.
        error: why it failed.
        folder: run folder.
    """

    trial: Trial
    status: str
    scores: Sequence[Scores]
    steps: int
    seconds: float
    error: str
    folder: Path

    @property
    def final(self) -> Scores:
        """Newest scores on the held-out episodes; empty before the first."""
        return self.scores[-1] if self.scores else {}

    @property
    def best(self) -> Scores:
        """Scores of the policy in ``best/``."""
        return best_of(self.scores)


def read_result(trial: Trial, folder: Path, status: str = UNFINISHED, error: str = "") -> TrialResult:
    """Return what the run folder of a trial says; ``status`` and ``error`` where it is not complete."""
    curve = read_curve(folder / "learning_curve.csv") if (folder / "learning_curve.csv").is_file() else []
    return TrialResult(
        trial,
        DONE if is_complete(folder) and not error else status,
        scores_of(folder),
        int(curve[-1]["steps"]) if curve else 0,
        _seconds(curve),
        error,
        folder,
    )


def _seconds(curve: Sequence[Mapping[str, float]]) -> float:
    """Return the time of all updates; the column starts anew wherever the training was resumed."""
    seconds = [row["seconds"] for row in curve]
    return sum(now - before if now > before else now for before, now in zip([0.0, *seconds], seconds, strict=False))


def scores_of(folder: Path) -> list[dict[str, float]]:
    """Return the held-out scores of a run folder, oldest first."""
    file = folder / "held_out.csv"
    return read_curve(file) if file.is_file() else []


def is_complete(folder: Path) -> bool:
    """Return whether a run folder holds a training that has done all its steps."""
    contract = folder / "policy" / "contract.json"
    if not contract.is_file() or not (folder / CONFIG_FILE).is_file():
        return False
    steps = json.loads(contract.read_text(encoding="utf-8")).get("training", {}).get("steps")
    total = read_yaml(folder / CONFIG_FILE)["settings"].get("total_steps")
    return steps is None or total is None or steps >= total


# ---- the table -------------------------------------------------------------------------------------------------------


def table(results: Sequence[TrialResult], out: Path) -> pandas.DataFrame:
    """Return one row per trial: name, its settings, seed, status, final and best held-out scores, steps, seconds, folder."""
    import pandas

    names = dict.fromkeys(name for one in results for name in one.trial.settings)
    columns = {name: _column([one.trial.settings.get(name) for one in results]) for name in names}
    rows = [
        {"name": one.trial.name, **{name: column[at] for name, column in columns.items()}, **_outcome(one, out)}
        for at, one in enumerate(results)
    ]
    return pandas.DataFrame(rows)


def write_table(results: Sequence[TrialResult], out: Path) -> None:
    """Write ``trials.parquet``.

    Raises:
        InputError: it cannot be written.
    """
    frame = table(results, out)
    replace_file(out / TABLE_FILE, lambda temporary: frame.to_parquet(temporary, index=False))


def stopped_early(out: Path) -> set[str]:
    """Return the names of the trials that the table of a sweep says were stopped early."""
    import pandas

    if not (out / TABLE_FILE).is_file():
        return set()
    frame = pandas.read_parquet(out / TABLE_FILE, columns=["name", "status"])
    return set(frame.loc[frame["status"] == STOPPED_EARLY, "name"])


def _outcome(one: TrialResult, out: Path) -> dict[str, Any]:
    row: dict[str, Any] = {"seed": one.trial.seed, "status": one.status}
    row |= {f"final_{name}": one.final.get(name, np.nan) for name in METRICS}
    row |= {f"best_{name}": one.best.get(name, np.nan) for name in METRICS}
    row |= {"best_steps": one.best.get("steps", np.nan), "steps": one.steps, "seconds": one.seconds}
    return row | {"error": one.error, "folder": str(one.folder.relative_to(out))}


def _column(values: Sequence[Any]) -> Sequence[Any]:
    """Return a setting's values as one column can hold them: numbers, words or truths (None is missing), all else as JSON."""
    given = [value for value in values if value is not None]
    kinds = {"number" if isinstance(value, int | float) and not isinstance(value, bool) else type(value) for value in given}
    return values if kinds in ({"number"}, {str}, {bool}) else [json.dumps(value) for value in values]


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


#: Numbers of which more than this many were tried are put into as many groups.
_GROUPS = 4


def importance(results: Sequence[TrialResult], metric: str) -> dict[str, float]:
    """Return the share of the variance of final scores that each setting explains alone (epsilon squared, 0 to 1).

    Epsilon squared is the correlation ratio less what chance gives; the rest is the seed and settings that act together. Only
    trials that were trained to their end count. Empty where there are too few of them.
    """
    ended = [one for one in results if one.status == DONE and np.isfinite(one.final.get(metric, np.nan))]
    scores = np.array([one.final[metric] for one in ended])
    names = list(dict.fromkeys(name for one in ended for name in one.trial.settings))
    if len(ended) < 3 or not scores.std() > 0.0:
        return {}
    shares = {name: _explained(_groups([one.trial.settings[name] for one in ended]), scores) for name in names}
    return dict(sorted(((name, share) for name, share in shares.items() if share is not None), key=lambda pair: -pair[1]))


def _groups(values: Sequence[Any]) -> np.ndarray:
    """Return the group of each value: itself, or its quarter where many numbers were tried."""
    if all(isinstance(value, int | float) for value in values):
        kinds, ranks = np.unique(values, return_inverse=True)
        return ranks if len(kinds) <= _GROUPS else ranks * _GROUPS // len(kinds)
    return np.unique([json.dumps(value) for value in values], return_inverse=True)[1]


def _explained(groups: np.ndarray, scores: np.ndarray) -> float | None:
    """Return epsilon squared of groups; None where it cannot be known."""
    count, kinds = len(scores), len(np.unique(groups))
    if not 1 < kinds < count:
        return None
    within = sum(((scores[groups == group] - scores[groups == group].mean()) ** 2).sum() for group in np.unique(groups))
    total = ((scores - scores.mean()) ** 2).sum()
    return float(max(0.0, 1.0 - within / (count - kinds) / (total / (count - 1))))
