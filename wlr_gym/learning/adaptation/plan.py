"""What an adaptation was asked for, and how far it is: ``state.json``, from which the same command resumes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import check_same_request, make_output_folder, resumes, write_json
from wlr_gym.base.seeds import LARGEST_SEED
from wlr_gym.base.settings import SettingsModel, parse_config

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
    try:
        state = parse_config(AdaptState, json.loads(path.read_text(encoding="utf-8")), str(path))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    check_same_request(path, dict(state.asked), dict(asked))
    return Progress(out, asked, tell, threads, dict(state.steps), dict(state.spent))
