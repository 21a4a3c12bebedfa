"""Where the time of one analysis of the gap workflow goes: wall and processor time of every step, in order."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.gap import analyse


@dataclass(frozen=True)
class StepTime:
    """A step of an analysis: what was reported when it began, and how long it took, s."""

    step: str
    wall: float
    processor: float


@dataclass(frozen=True)
class AnalysisTime:
    """One analysis: folder, verdict, names of the effects, its steps."""

    folder: str
    verdict: str
    effects: tuple[str, ...]
    steps: tuple[StepTime, ...]

    @property
    def wall(self) -> float:
        """Wall time of all steps, s."""
        return sum(step.wall for step in self.steps)

    @property
    def processor(self) -> float:
        """Processor time of all steps and threads, s."""
        return sum(step.processor for step in self.steps)


def time_analyses(folders: Sequence[Path], threads: int = 2, say: Callable[[str], None] = print) -> list[AnalysisTime]:
    """Analyse folders of runs, one after the other, without writing anything.

    Args:
        folders: of runs in the measured-run format.
        threads: as of ``wlr gap --threads``.
        say: shown a line per step that takes long, and one per folder.

    Raises:
        InputError: no folders, or fewer than one thread.
    """
    if not folders:
        raise InputError("--speed: expected one folder of runs or more")
    if threads < 1:
        raise InputError(f"--threads {threads}: expected 1 or more")
    found = []
    for folder in folders:
        found.append(_timed(folder, threads))
        for line in lines(found[-1]):
            say(line)
    return found


def _timed(folder: Path, threads: int) -> AnalysisTime:
    marks: list[tuple[str, float, float]] = []

    def mark(stage: str, share: float) -> None:
        marks.append((stage, time.perf_counter(), time.process_time()))

    done = analyse(folder, threads=threads, tell=mark)
    mark("", 1.0)
    steps = [
        StepTime(step, after[1] - wall, after[2] - processor) for (step, wall, processor), after in itertools.pairwise(marks)
    ]
    return AnalysisTime(str(folder), done.verdict, tuple(effect.name for effect in done.effects), tuple(steps))


def lines(one: AnalysisTime) -> list[str]:
    """Return the steps of an analysis that take 2 % of its time or more, and their sum, as lines of text."""
    shown = [step for step in one.steps if step.wall >= 0.02 * one.wall]
    rest = one.wall - sum(step.wall for step in shown)
    title = f"{one.folder}: {one.verdict} {', '.join(one.effects)}".rstrip()
    rows = [f"{step.wall:8.1f} s  {step.processor:8.1f} s  {step.step}" for step in shown]
    return [
        title,
        "    wall    processor  step",
        *rows,
        f"{rest:8.1f} s  {'':8}    the rest",
        f"{one.wall:8.1f} s  {one.processor:8.1f} s  all",
    ]
