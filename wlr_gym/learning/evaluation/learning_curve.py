"""Learning curves: ``learning_curve.csv`` of a run folder, one row per update of the agent."""

from __future__ import annotations

import csv
from pathlib import Path

from wlr_gym.base.errors import InputError


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
