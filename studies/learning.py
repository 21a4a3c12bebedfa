"""The result tables of docs/policies.md: kept in docs/data/learning.json, from trained seeds of each recipe.

``python -m studies.learning TASK POLICIES BLIND`` scores the seeds of a task's slip-aware recipe (a folder or pattern of run
folders) and of its blind one beside the hand-written controllers, as ``wlr evaluate`` does, row by row, and takes the numbers
over. An interrupted scoring goes on where it stopped. .ci/docs/tables.py has the tables.
"""

from __future__ import annotations

import datetime
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wlr_gym.base.files import write_json
from wlr_gym.base.provenance import git_commit
from wlr_gym.learning.evaluation.card import Card
from wlr_gym.learning.evaluation.metrics import Estimate
from wlr_gym.learning.evaluation.scoring import evaluate
from wlr_gym.learning.evaluation.subjects import identity, read_subjects

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs" / "data" / "learning.json"
EPISODES = 256
CONTROLLERS = ("slip_compensating", "pid")
#: Policies are named so in data and tables.
OURS, BLIND = "ours", "blind"
LATE = {
    "name": "slippery, 40 ms late",
    "base": "slippery",
    "events": {"command_delay": {"distribution": "uniform", "operation": "set", "low": 0.04, "high": 0.04}},
}
#: Task -> sensors that a robot has ("none", "camera" or "flow"), and floors.
ROWS: Mapping[str, tuple[tuple[str, Any], ...]] = {
    "velocity": (
        *(("none", floors) for floors in ("slippery", "ice", "split", "patches", "nominal", "wide", "stripes", "ribbed")),
        *(("camera", floors) for floors in ("slippery", "ice", "split", "patches", "wide", LATE)),
        ("flow", "slippery"),
    ),
    "path": (
        *(("none", floors) for floors in ("slippery", "split")),
        *(("camera", floors) for floors in ("slippery", "nominal", "split", "ice")),
        ("flow", "slippery"),
    ),
    "posture": tuple((sensors, floors) for sensors in ("camera", "none") for floors in ("asymmetric", "nominal")),
    "slope": (("none", "slope"), ("camera", "slope")),
}
_OTHERS = (BLIND, *CONTROLLERS)
HEADER = ("robot has", "floors", "tracking error", "median seed, spread", "success (%)", "slip (mm/s)")
HEADER += (*(f"`{name}`: error, better (%)" for name in _OTHERS), *(f"slips less than `{name}` (%)" for name in _OTHERS))


# ---- scoring ---------------------------------------------------------------------------------------------------------


def score(task: str, ours: str, blind: str) -> None:
    """Score what is not scored yet of a task; every row is written when it is done."""
    data = read_data()
    policies = [identity(one) for one in read_subjects([f"{OURS}={ours}", f"{BLIND}={blind}"])]
    if data.get(task, {}).get("policies") != policies:
        data[task] = {"policies": policies, "commit": git_commit(), "date": str(datetime.date.today()), "rows": []}
    rows = data[task]["rows"]
    there = {(row["sensors"], row["floors"]) for row in rows}
    for sensors, floors in ROWS[task]:
        if (sensors, _name(floors)) in there:
            continue
        card = evaluate(
            f"{OURS}={ours}",
            f"WLR-{task.title()}-v0",
            baselines=[f"{BLIND}={blind}", *CONTROLLERS],
            episodes=EPISODES,
            randomization=floors,
            sensors=() if sensors == "none" else (sensors,),
            robot="flow" if sensors == "flow" else None,
            precision="float32",
        )
        rows.append(row_of(card, sensors, _name(floors)))
        write_json(DATA, data)
        print(" | ".join(cells(rows[-1])), flush=True)


def _name(floors: Any) -> str:
    return floors if isinstance(floors, str) else floors["name"]


def row_of(card: Card, sensors: str, floors: str) -> dict[str, Any]:
    """Return the numbers of a row."""
    scores, better, seeds = card.scores["main"], card.comparison["main"], card.seed_scores
    row: dict[str, Any] = {"sensors": sensors, "floors": floors}
    row |= {key: interval(scores[OURS][key]) for key in ("tracking_error", "success", "slip_speed")}
    if OURS in seeds:
        row |= {"median": seeds[OURS].median("tracking_error"), "spread": seeds[OURS].spread("tracking_error")}
    row["others"] = {
        name: {
            "tracking_error": scores[name]["tracking_error"].mean,
            "slip_speed": scores[name]["slip_speed"].mean,
            "better": interval(better[name]["tracking_error"]),
            "slips_less": interval(better[name]["slip_speed"]),
        }
        for name in _OTHERS
    }
    return row


def interval(estimate: Estimate) -> list[float]:
    """Return mean, low and high."""
    return [estimate.mean, estimate.low, estimate.high]


# ---- tables ----------------------------------------------------------------------------------------------------------


def table(task: str) -> list[list[str]]:
    """Return the rows of the table of a task."""
    return [cells(row) for row in read_data()[task]["rows"]]


def cells(row: Mapping[str, Any]) -> list[str]:
    """Return the cells of a row."""
    error, low, high = row["tracking_error"]
    others = row["others"]
    spread = f"{row['median']:.3f}, {row['spread']:.0f} %" if "median" in row else "-"
    found = ["neither" if row["sensors"] == "none" else row["sensors"], row["floors"]]
    found += [f"**{error:.3f} [{low:.3f}, {high:.3f}]**", spread]
    found += [f"{row['success'][0]:.0f}", f"{1000 * row['slip_speed'][0]:.1f}"]
    found += [f"{others[name]['tracking_error']:.3f}, {percent(others[name]['better'])}" for name in _OTHERS]
    return found + [percent(others[name]["slips_less"]) for name in _OTHERS]


def percent(numbers: list[float]) -> str:
    """Return mean, low and high as text."""
    mean, low, high = (f"{value:.0f}".replace("-", "\N{MINUS SIGN}") for value in numbers)
    return f"{mean} [{low}, {high}]"


def read_data(file: Path = DATA) -> dict[str, Any]:
    """Return what is kept in a file, nothing where there is none; here: task -> SHA-256 of the policies, commit, date, rows."""
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


if __name__ == "__main__":
    score(*sys.argv[1:])
