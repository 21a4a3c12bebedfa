"""The numbers of a training over its steps: ``learning_curve.csv``, a row per update, and ``held_out.csv``, a row per score."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import replace_file

#: Metric of the held-out episodes -> whether less of it is better.
METRICS = {"tracking_error": True, "success": False, "excess_slip": True, "reward": False}


def read_curve(path: Path) -> list[dict[str, float]]:
    """Read a learning curve; a last line cut short by a crash is left out.

    Raises:
        InputError: absent, or a cell that is no number.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            table = [row for row in csv.DictReader(file) if all(row.values())]
        return [{key: float(value) for key, value in row.items()} for row in table]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: not a learning curve: {error}") from None


def rows_of(path: Path) -> list[dict[str, float]]:
    """Return the rows of a curve, oldest first; none before there is a file."""
    return read_curve(path) if path.is_file() else []


def wall_time(curve: Iterable[Mapping[str, float]]) -> float:
    """Return the time a run took, s, by the ``seconds`` of its rows: a clock that starts anew each time the run is resumed."""
    clock = [row["seconds"] for row in curve]
    return sum(now for now, later in pairwise([*clock, 0.0]) if later < now)


class CurveFile:
    """A CSV file of numbers over steps (``learning_curve.csv``, ``held_out.csv``); each row is written at once.

    Args:
        path: of the file; rows beyond ``steps``, which a resumed run repeats, are dropped, the others stay as they are.
        steps: environment steps done so far.
    """

    def __init__(self, path: Path, steps: int) -> None:
        self.path = path
        kept = ""
        if path.is_file():
            count = sum(row["steps"] <= steps for row in read_curve(path))
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
            kept = "".join(lines[: count + 1]) if count else ""
        replace_file(path, lambda temporary: temporary.write_text(kept, encoding="utf-8"))

    def append(self, row: Mapping[str, float]) -> None:
        """Add a row."""
        with self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(row))
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow(row)


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
