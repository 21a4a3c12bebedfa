"""What an adaptation was asked for, how far it is (``state.json``: the same command resumes), and its page (``adapt.html``)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from wlr_gym.base.errors import LARGEST_SEED
from wlr_gym.base.files import check_same_request, make_output_folder, resumes, write_json, write_text
from wlr_gym.base.html import commands, document, section, table
from wlr_gym.base.settings import SettingsModel, parse_config, read_json
from wlr_gym.base.text import duration
from wlr_gym.learning.evaluation.scoring import COLUMNS

STATE_FILE = "state.json"
#: In their order; each has a folder of its name.
STEPS = ("before", "runs", "gap", "model", "training", "acceptance", "after")
#: Excitations of the first runs: between them they drive straight, turn, stop and move the legs.
EXCITATIONS = ("straight", "turns", "stop_and_go", "posture")

Tell = Callable[[str, float], None]


class Asked(SettingsModel):
    """What was asked for.

    Attributes:
        policy: its source. identity: SHA-256 of it.
        environment: id.
        robot_runs: folder of measured runs; None = they are recorded.
        robot: fingerprint of the robot's file.
        driven: what is driven: ``emulated``, ``real``, or nothing (``""``).
        effects: what the emulated robot has that its file does not say. backend: simulator behind it.
        floor: content of the floor that it drives on, and that is trained on; None = a plane, and the recipe's.
        excitations: of the first runs.
        budget_runs: further runs at most. budget_seconds: of driving them; None = as many as they take.
        drives, drive_seconds: episodes of the task before and after, and their length (s).
        steps: environment steps of the training. learning_rate: at its start.
        episodes: of every family in the acceptance test.
        sensors: which of camera and flow the robot has.
        seed: of everything random.
    """

    policy: str
    identity: str
    environment: str
    robot_runs: str | None = None
    robot: str
    driven: Literal["", "emulated", "real"] = ""
    effects: list[dict[str, Any]] = Field(default_factory=list)
    backend: str = "gibbs_appell"
    floor: dict[str, Any] | None = None
    excitations: tuple[str, ...] = EXCITATIONS
    budget_runs: int = Field(default=2, ge=0)
    budget_seconds: float | None = Field(default=None, ge=0)
    drives: int = Field(default=6, ge=2)
    drive_seconds: float = Field(default=10.0, gt=0)
    steps: int = Field(default=7_500_000, ge=1)
    learning_rate: float = Field(default=5e-4, gt=0)
    episodes: int = Field(default=256, ge=8)
    sensors: tuple[str, ...] = ()
    seed: int = Field(default=0, ge=0, le=LARGEST_SEED)


class AdaptStep(SettingsModel):
    """A step that is over.

    Attributes:
        outcome: ``done``, or ``left out``.
        said: what it found, in sentences.
        driving, computing: s.
        command: the ordinary command that does it alone; empty = none.
        numbers: what it found.
    """

    outcome: Literal["done", "left out"] = "done"
    said: tuple[str, ...] = ()
    driving: float = 0.0
    computing: float = 0.0
    command: str = ""
    numbers: dict[str, Any] = Field(default_factory=dict)


class AdaptState(SettingsModel):
    """``state.json``."""

    asked: Asked
    steps: dict[str, AdaptStep] = Field(default_factory=dict)
    spent: dict[str, float] = Field(default_factory=dict)


@dataclass
class Progress:
    """The folder of an adaptation, and what is done of it.

    Attributes:
        out: the folder. asked: see :class:`Asked`. tell: called with what is going on and the share of the step that is done.
        threads: worker threads. steps: those that are over.
        spent: step -> s of computing so far.
    """

    out: Path
    asked: Asked
    tell: Tell = lambda text, share: None
    threads: int = 1
    steps: dict[str, AdaptStep] = field(default_factory=dict)
    spent: dict[str, float] = field(default_factory=dict)

    def folder(self, step: str) -> Path:
        """Return the folder of a step, made if it is not there."""
        make_output_folder(self.out / step)
        return self.out / step

    def note(self, step: str, record: AdaptStep) -> None:
        """Note that a step is over."""
        self.steps[step] = record.model_copy(update={"computing": round(self.spent.get(step, 0.0), 2)})
        self.save()

    def save(self) -> None:
        """Write ``state.json``."""
        state = AdaptState(asked=self.asked, steps=self.steps, spent=self.spent)
        write_json(self.out / STATE_FILE, state.model_dump(mode="json"))

    @contextmanager
    def clock(self, step: str) -> Iterator[None]:
        """Count the time that a step takes, also where it is interrupted."""
        before, began = self.spent.get(step, 0.0), time.monotonic()
        try:
            yield
        finally:
            self.spent[step] = before + time.monotonic() - began
            self.save()


def open_folder(out: Path, asked: Asked, tell: Tell, threads: int) -> Progress:
    """Return what is done in a folder, which is new, empty, or of the same request.

    Raises:
        InputError: a folder of something else, or of another request; the message names the first difference.
    """
    if not resumes(out, STATE_FILE):
        return Progress(out, asked, tell, threads)
    path = out / STATE_FILE
    state = parse_config(AdaptState, read_json(path), str(path))
    check_same_request(path, dict(state.asked), dict(asked))
    return Progress(out, asked, tell, threads, dict(state.steps), dict(state.spent))


# ---- the page, and its numbers ---------------------------------------------------------------------------------------


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
    said = [line for name in ("gap", "acceptance") for line in progress.steps[name].said[:1]]
    lines = "".join(f"<p>{escape(line)}</p>" for line in said)
    times = [
        (TITLES[name], one["outcome"], duration(one["driving"]), duration(one["computing"]))
        for name, one in content["steps"].items()
    ]
    times.append(("all", "", duration(content["driving_seconds"]), duration(content["computing_seconds"])))
    note = {"emulated": _EMULATED, "real": _REAL}.get(progress.asked.driven, "")
    parts = [
        f'<header><p class="label">wlr adapt</p><h1>{escape(headline(content))}</h1>{lines}</header>',
        section("Time", table(("step", "", "driving", "computing"), times, (2, 3))),
        *(section(f"{n}. {TITLES[name]}", _step(progress.steps[name])) for n, name in enumerate(STEPS, 1)),
        f"<footer><p>{escape(note)}</p></footer>" if note else "",
    ]
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


def _step(record: AdaptStep) -> str:
    said, numbers = "".join(f"<p>{escape(line)}</p>" for line in record.said), record.numbers
    if "rows" in numbers:
        said += table(("robots", *COLUMNS), numbers["rows"], range(2, 6))
    if isinstance(numbers.get("old"), list):  # of each episode
        names = [name for name in ("old", "new") if name in numbers]
        errors = [[*numbers[name], sum(numbers[name]) / len(numbers[name])] for name in names]
        titles = [*(str(k + 1) for k in range(len(numbers["old"]))), "mean"]
        shown = [[f"{value:.3f}" if math.isfinite(value) else "-" for value in row] for row in zip(*errors, strict=True)]
        rows = [(title, *row) for title, row in zip(titles, shown, strict=True)]
        said += table(("episode", *(f"tracking error, {name} policy" for name in names)), rows, range(1, 1 + len(names)))
    return said + (commands([record.command]) if record.command else "")
