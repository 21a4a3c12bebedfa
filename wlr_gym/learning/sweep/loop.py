"""The loop over the trials of a sweep, and what comes of them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import locked
from wlr_gym.base.jobs import PATIENCE, Ended, Job
from wlr_gym.base.text import duration
from wlr_gym.learning.sweep.plan import SweepPlan, Trial, trials_of
from wlr_gym.learning.sweep.results import FAILED, STOPPED_EARLY, UNFINISHED, Summary, TrialResult, summarise, write_results
from wlr_gym.learning.sweep.trial import LOCKS, TRIALS, is_complete, job_of

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


class SweepLoop:
    """The trials of a sweep and how they ended; the loop over those that are left.

    Args:
        plan, folder, say: of the sweep.
    """

    def __init__(self, plan: SweepPlan, folder: Path, say: Say) -> None:
        self.plan, self.folder, self.say = plan, folder, say
        self._found: dict[str, TrialResult] = {}

    def fill(self, run: Run, search: Callable[[], Sequence[Trial]] | None = None) -> SweepResult:
        """Train the grid with all seeds; or search with the first seed, then train the best with the others.

        At the end, and after Ctrl-C, table and page say what there is.

        Args:
            run: runs jobs.
            search: searches in place of training all known settings, and returns the trials that failed before a resume.
        """
        plan, resume = self.plan, f"wlr sweep --resume {self.folder}"
        seeds = plan.seed_list if plan.search is None else plan.seed_list[:1]
        try:
            if search is not None:
                self.train(search(), run)
            else:
                self.train(trials_of(plan.known_settings() or [], seeds), run)
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

    def train(self, trials: Sequence[Trial], run: Run) -> None:
        """Train those of some trials that are not complete."""
        for trial in trials:
            self.note(trial)
        left = {trial.name: trial for trial in trials if not is_complete(self._found[trial.name].folder)}
        if len(left) < len(trials):
            self.say(f"{len(trials) - len(left)} of {len(trials)} trials are done already")
        with closing(run(job_of(self.plan, trial, self.folder) for trial in left.values())) as ends:
            for done, ended in enumerate(ends, 1):  # closed in any case: jobs end before who runs them
                found = self.note(left[ended.name], error=ended.error)
                self.tell(found, f"{done}/{len(left)}")

    def note(self, trial: Trial, status: str = UNFINISHED, error: str = "") -> TrialResult:
        """Read the run folder of a trial that begins or has ended."""
        found = TrialResult.read(trial, self.folder / TRIALS / trial.name, status, error)
        self._found[trial.name] = found
        return found

    def tell(self, found: TrialResult, number: str) -> None:
        """Say how a trial ended."""
        metric = self.plan.metric
        scores = f"{metric} {found.final[metric]:.3f}" if metric in found.final else "no scores"
        ended = f"FAILED: {found.error}" if found.error else f"{found.status}, {scores}, {duration(found.seconds)}"
        self.say(f"{number}  {found.trial.name}: {ended}")

    def results(self) -> list[TrialResult]:
        """Return what is known of all trials."""
        return list(self._found.values())

    def write(self) -> None:
        """Write table and page; trials that do not run to their end write their last checkpoint before they are read."""
        for one in self.results():
            if one.status in (STOPPED_EARLY, UNFINISHED) and one.folder.is_dir():
                with suppress(InputError), locked(self.folder / LOCKS / one.trial.name, 2 * PATIENCE):
                    self.note(one.trial, one.status)
        if self._found:  # else no trial has begun
            write_results(self.plan, self.results(), self.folder)
