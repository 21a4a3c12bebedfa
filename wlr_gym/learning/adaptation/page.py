"""The page of an adaptation, ``adapt.html``, and its numbers, ``adapt.json``."""

from __future__ import annotations

import math
from html import escape
from pathlib import Path
from typing import Any

from wlr_gym.base.files import write_json, write_text
from wlr_gym.base.html import commands, document, section, table
from wlr_gym.base.text import duration
from wlr_gym.learning.adaptation.plan import STEPS, AdaptStep, Progress
from wlr_gym.learning.evaluation.acceptance import COLUMNS

PAGE_FILE, NUMBERS_FILE = "adapt.html", "adapt.json"
FORMAT = 1
TITLES = {
    "before": "Performance lost: the old policy on the robot",
    "runs": "Runs recorded",
    "gap": "Found: what the model lacks",
    "model": "What is trained with",
    "training": "Training on from the policy",
    "acceptance": "Acceptance test, in simulation",
    "after": "Performance regained: the old and the new policy on the robot",
}
_COLOURS = {True: "#1a7f37", False: "#9a6700"}
_EMULATED = (
    "The robot is emulated: servos, command limiter and sensors in emulated time on a simulator. Its tracking error is of its "
    "true motion. Nothing on this page was measured on hardware."
)
_REAL = "Tracking errors of a real robot are what its slip observer and its gyro say of its motion."


def numbers_of(progress: Progress, kept: str) -> dict[str, Any]:
    """Return what ``adapt.json`` says."""
    steps = {name: progress.steps[name].model_dump(mode="json") for name in STEPS if name in progress.steps}
    return {
        "format": FORMAT,
        "policy": progress.asked.policy,
        "kept": kept,
        "is_new": kept != progress.asked.policy,
        "driving_seconds": sum(one["driving"] for one in steps.values()),
        "computing_seconds": sum(one["computing"] for one in steps.values()),
        "asked": progress.asked.model_dump(mode="json"),
        "steps": steps,
    }


def write_page(progress: Progress, kept: str) -> Path:
    """Write the page and its numbers; return the path of the page."""
    content = numbers_of(progress, kept)
    write_json(progress.out / NUMBERS_FILE, content)
    parts = [_head(progress, content), section("Time", _times(progress, content))]
    parts += [section(f"{n}. {TITLES[name]}", _step(progress.steps[name])) for n, name in enumerate(STEPS, 1)]
    note = {"emulated": _EMULATED, "real": _REAL}.get(progress.asked.driven, "")
    parts.append(f"<footer><p>{escape(note)}</p></footer>" if note else "")
    path = progress.out / PAGE_FILE
    write_text(path, document("Adaptation of a policy", _COLOURS[content["is_new"]], parts))
    return path


def headline(content: dict[str, Any]) -> str:
    """Return the outcome in one sentence."""
    after = content["steps"]["after"]
    if not content["is_new"]:
        return f"{content['policy']} is kept as it is."
    if after["outcome"] == "left out":
        return f"{content['policy']} was adapted; the new policy was not driven."
    numbers = after["numbers"]
    low, high = numbers["better_ci95"]
    said = (
        f"{content['policy']} was adapted: its tracking error fell by {numbers['better_percent']:.0f} % [{low:.0f}, {high:.0f}]"
    )
    share = numbers.get("regained_percent")
    return said + ("." if share is None else f", {share:.0f} % of what the robot had cost it.")


def _head(progress: Progress, content: dict[str, Any]) -> str:
    said = [line for name in ("gap", "acceptance") for line in progress.steps[name].said[:1]]
    lines = "".join(f"<p>{escape(line)}</p>" for line in said)
    return f'<header><p class="label">wlr adapt</p><h1>{escape(headline(content))}</h1>{lines}</header>'


def _times(progress: Progress, content: dict[str, Any]) -> str:
    rows = [
        (TITLES[name], one["outcome"], duration(one["driving"]), duration(one["computing"]))
        for name, one in content["steps"].items()
    ]
    rows.append(("all", "", duration(content["driving_seconds"]), duration(content["computing_seconds"])))
    return table(("step", "", "driving", "computing"), rows, (2, 3))


def _step(record: AdaptStep) -> str:
    said = "".join(f"<p>{escape(line)}</p>" for line in record.said)
    numbers = record.numbers
    if "rows" in numbers:
        said += table(("robots", *COLUMNS), numbers["rows"], range(2, 6))
    if "old" in numbers and isinstance(numbers["old"], list):
        said += _episodes(numbers)
    return said + (commands([record.command]) if record.command else "")


def _episodes(numbers: dict[str, Any]) -> str:
    names = [name for name in ("old", "new") if name in numbers]
    columns = [numbers[name] for name in names]
    rows = [(str(k + 1), *(_number(value) for value in row)) for k, row in enumerate(zip(*columns, strict=True))]
    rows.append(("mean", *(_number(sum(one) / len(one)) for one in columns)))
    return table(("episode", *(f"tracking error, {name} policy" for name in names)), rows, range(1, 1 + len(names)))


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"
