"""The loop of a sweep: which trials are left, how they ended; what was stopped goes on from what its folder says."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import locked
from wlr_gym.base.jobs import PATIENCE, Ended, Job
from wlr_gym.base.text import counted, duration, quoted
from wlr_gym.learning.sweep.plan import SweepPlan, Trial, trials_of
from wlr_gym.learning.sweep.results import (
    DONE,
    FAILED,
    STOPPED_EARLY,
    UNFINISHED,
    Summary,
    TrialResult,
    stopped_early,
    summarise,
    write_page,
    write_table,
)
from wlr_gym.learning.sweep.trial import LOCKS, TRIALS, is_complete, job_of

#: Settings that a search has begun, a line of JSON each.
BEGUN_FILE = "begun.jsonl"
Say = Callable[[str], object]
#: Runs jobs and yields how each ended.
Run = Callable[[Iterable[Job]], Generator[Ended, None, None]]


@dataclass(frozen=True)
class SweepResult:
    """What a sweep found.

    Attributes:
        folder: of the sweep; ``trials.parquet`` and ``sweep.html`` are in it.
        trials: every trial with its scores.
        ranking: settings over their seeds, best first.
    """

    folder: Path
    trials: Sequence[TrialResult]
    ranking: Sequence[Summary]

    @property
    def failed(self) -> list[TrialResult]:
        """Trials that failed; ``error`` says why."""
        return [one for one in self.trials if one.status == FAILED]


class Book:
    """The folder of a sweep: which trials there are, how they ended, table and page.

    Args:
        plan, folder, say: of the sweep.

    Attributes:
        stopped: names of the trials that a search had stopped early before this sweep was resumed.
    """

    def __init__(self, plan: SweepPlan, folder: Path, say: Say) -> None:
        self.plan, self.folder, self.say = plan, folder, say
        self.stopped = stopped_early(folder)
        self._found: dict[str, TrialResult] = {}
        self._began, self._done, self._expected = time.monotonic(), 0, 0

    @property
    def size(self) -> str:
        """What the sweep will do, in words."""
        plan, seeds, known = self.plan, len(self.plan.seed_list), self.plan.known_settings()
        count = len(known) if known is not None else plan.search.trials if plan.search else 0
        steps = plan.settings.get("total_steps")
        each = f" of {steps:,} environment steps" if isinstance(steps, int) and "total_steps" not in plan.space else ""
        if plan.search is None:
            return f"{counted(count * seeds, 'trial')}: {counted(count, 'setting')} x {counted(seeds, 'seed')}{each}"
        best = min(plan.search.repeat_best, count)
        return f"{counted(count, 'trial')}{each}, then the best {best} with {counted(seeds, 'seed')}"

    def fill(self, run: Run, search: Callable[[], None] | None = None) -> SweepResult:
        """Train the grid with all seeds; or search with the first seed, then train the best with the others.

        At the end, and after Ctrl-C, table and page say what there is.

        Args:
            run: runs jobs.
            search: searches in place of training all known settings.
        """
        plan, known = self.plan, self.plan.known_settings() or []
        resume = f"wlr sweep --resume {quoted(self.folder)}"
        try:
            if search is not None:
                search()
            else:
                self.train(trials_of(known, plan.seed_list if plan.search is None else plan.seed_list[:1]), run)
            if plan.search is not None:
                best = [one.settings for one in summarise(self.results(), plan.metric)[: plan.search.repeat_best]]
                self.train(trials_of(best, plan.seed_list), run)
        except KeyboardInterrupt:
            try:
                self.write()
            except InputError as problem:  # a full disk
                self.say(str(problem))
            raise KeyboardInterrupt(f"interrupted; trials have checkpoints; resume with: {resume}") from None
        try:
            self.write()
        except InputError as problem:
            raise InputError(f"{problem}; when it can be written: {resume}") from None
        results = self.results()
        return SweepResult(self.folder, results, summarise(results, plan.metric))

    def begun(self) -> list[dict[str, Any]]:
        """Return the settings that a search tries first, and count their trials in: all known ones, or those begun before."""
        known, file = self.plan.known_settings(), self.folder / BEGUN_FILE
        if known is None:
            lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
            # Oldest first, each once; a last line may be cut short.
            known = list({line: json.loads(line) for line in lines if line.endswith("}")}.values())
        for settings in known:
            self._enter(Trial(settings, self.plan.seed_list[0]))
        return known

    def begin(self, trial: Trial) -> None:
        """Note a trial that a search has chosen, in a line of a file."""
        self._enter(trial)
        with (self.folder / BEGUN_FILE).open("a", encoding="utf-8") as file:
            file.write(f"{json.dumps(dict(trial.settings))}\n")

    def _enter(self, trial: Trial) -> TrialResult:
        return self._found.setdefault(trial.name, TrialResult(trial, self.folder / TRIALS / trial.name))

    def train(self, trials: Sequence[Trial], run: Run) -> None:
        """Train those of some trials that are not complete."""
        left = [trial for trial in trials if not is_complete(self._enter(trial).folder)]
        if len(left) < len(trials):
            self.say(f"{len(trials) - len(left)} of {len(trials)} trials are done already")
        self._began, self._done, self._expected = time.monotonic(), 0, len(left)
        with closing(run(job_of(self.plan, trial, self.folder) for trial in left)) as ends:  # jobs end before who runs them
            for ended in ends:
                self.end(self._found[ended.name].trial, ended.error)

    def end(self, trial: Trial, error: str, early: bool = False) -> None:
        """Note how a trial ended, read its run folder, and write the table."""
        found = self._enter(trial)
        found.status, found.error = FAILED if error else STOPPED_EARLY if early else DONE, error
        found.read()
        self._done += 1
        metric, of = self.plan.metric, f"/{self._expected}" if self._expected else ""
        if error:
            self.say(f"{self._done}{of}  {trial.name}: FAILED: {error}")
        else:
            scores = f"{metric} {found.final[metric]:.3f}" if metric in found.final else "no scores"
            left = (time.monotonic() - self._began) / self._done * (self._expected - self._done)
            rest = f"; about {duration(left)} left" if left > 0.0 else ""
            self.say(f"{self._done}{of}  {trial.name}: {found.status}, {scores}, {duration(found.seconds)}{rest}")
        try:
            write_table(self.results(), self.folder)
        except InputError as problem:  # a full disk; the trials go on
            self.say(str(problem))

    def results(self) -> list[TrialResult]:
        """Return what is known of all trials; those that have ended are not read again: of thousands some end all the time."""
        for one in self._found.values():
            if one.status == UNFINISHED:
                one.read()
        return list(self._found.values())

    def write(self) -> None:
        """Write table and page; trials that were stopped early write their last checkpoint before they are read."""
        if not self._found:  # no trial has begun
            return
        for one in self._found.values():
            if one.status == STOPPED_EARLY:
                with suppress(InputError), locked(self.folder / LOCKS / one.trial.name, 2 * PATIENCE):
                    pass
                one.read()
        results = self.results()
        write_table(results, self.folder)
        write_page(self.plan, results, self.folder)
