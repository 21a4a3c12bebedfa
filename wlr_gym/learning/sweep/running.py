"""Sweeps from Python: what ``wlr sweep`` does."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, check_number, require_package
from wlr_gym.base.files import locked, make_output_folder, require_empty
from wlr_gym.base.jobs import PATIENCE, Ended, Job, spread
from wlr_gym.base.provenance import PROVENANCE_FILE, provenance, write_yaml
from wlr_gym.base.settings import parse_config, read_yaml
from wlr_gym.base.text import counted, duration
from wlr_gym.learning.sweep.plan import SweepPlan, Trial, known_settings, resolve, trial_of, trials_of
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
from wlr_gym.learning.sweep.trial import LOCKS, LOGS, TRIALS, check_job, is_complete, job_of

PLAN_FILE = "sweep.yaml"
#: Settings that a search has begun, a line of JSON each.
BEGUN_FILE = "begun.jsonl"
#: s that a sweep waits for one that is just ending in the same folder.
_HANDOVER = 5.0
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


def sweep(
    env_id: str,
    out: str | Path,
    config: str | None = None,
    *,
    agent: str = "ppo",
    settings: Mapping[str, Any] | None = None,
    space: Mapping[str, Any] | None = None,
    variants: Mapping[str, Mapping[str, Any]] | None = None,
    seeds: int | Sequence[int] = 5,
    search: Mapping[str, Any] | None = None,
    init: str | Path | None = None,
    ray: str | None = None,
    workers: int | None = None,
    say: Say = print,
) -> SweepResult:
    """Train settings x seeds, as ``wlr sweep`` does. Each trial is an ordinary run folder, and a process with one thread.

    Args:
        env_id, config, agent, init: as for :func:`wlr_gym.train`.
        out: folder to fill; it must be empty or absent.
        settings: changes of the settings that all trials share.
        space: dotted name of a setting -> list of values, or, for a search, ``{"low": 1e-4, "high": 1e-2, "log": True}``.
            All combinations of lists make the grid.
        variants: name -> dotted name of a setting -> value: settings that belong together, one more dimension of the grid.
        seeds: how many, from 0 on, or which.
        search: fields of :class:`wlr_gym.learning.sweep.plan.SearchPlan`, such as
            ``{"method": "optuna", "trials": 20, "early_stopping": True}``; None = every settings with every seed.
        ray: None = processes of this machine; ``"local"`` = a Ray that is started here; otherwise the address of a cluster,
            such as ``"auto"``. Optuna and early stopping run on Ray in any case.
        workers: most trials at a time; None = one per core.
        say: told, in lines, how it goes.

    Returns:
        What was found. Trials that failed are in it; the others went on.

    Raises:
        InputError: an unknown name or setting, two trials of one name, a folder with contents, a cluster that does not answer.
        MissingPackageError: Ray or Optuna is needed and not installed.
        KeyboardInterrupt: Ctrl-C or SIGTERM, after the trials saved checkpoints; :func:`resume_sweep` continues.
    """
    fields = {
        "environment": env_id,
        "agent": agent,
        "config": config,
        "init": None if init is None else str(init),
        "settings": dict(settings or {}),
        "space": {name: dict(given) if isinstance(given, Mapping) else given for name, given in (space or {}).items()},
        "variants": {name: dict(given) for name, given in (variants or {}).items()},
        "seeds": seeds if isinstance(seeds, int) else list(seeds),
        "search": None if search is None else dict(search),
    }
    return start_sweep(parse_config(SweepPlan, fields, "sweep"), out, ray=ray, workers=workers, say=say)


def start_sweep(
    plan: SweepPlan, out: str | Path, *, ray: str | None = None, workers: int | None = None, say: Say = print
) -> SweepResult:
    """Run a plan in a new folder; arguments, result and errors as of :func:`sweep`."""
    folder = Path(out)
    require_empty(folder, "wlr sweep" if (folder / PLAN_FILE).is_file() else "")
    whole = resolve(plan)
    _check_machines(whole, ray, workers)
    make_output_folder(folder)
    write_yaml(folder / PROVENANCE_FILE, provenance(whole.seed_list[0]))
    write_yaml(folder / PLAN_FILE, whole.model_dump(mode="json"))
    return _run(whole, folder, ray, workers, say)


def resume_sweep(folder: str | Path, *, ray: str | None = None, workers: int | None = None, say: Say = print) -> SweepResult:
    """Continue a sweep that was stopped or lost machines: trials go on from their checkpoints; failed ones are tried again.

    Args:
        folder: of the sweep; it is continued as it was planned.
        ray, workers, say: as for :func:`sweep`; they need not be those of before.

    Returns:
        What was found.

    Raises:
        InputError: not the folder of a sweep, or another process runs it.
        KeyboardInterrupt: as for :func:`sweep`.
    """
    file = Path(folder) / PLAN_FILE
    if not file.is_file():
        raise InputError(f"{folder}: not the folder of a sweep: {PLAN_FILE} is missing")
    plan = parse_config(SweepPlan, read_yaml(file), str(file))
    _check_machines(plan, ray, workers)
    return _run(plan, Path(folder), ray, workers, say)


def _check_machines(plan: SweepPlan, ray: str | None, workers: int | None) -> None:
    if workers is not None:
        check_number("workers", workers, least=1, whole=True)
    if ray is not None or plan.needs_ray:
        require_package("ray", "sweep")
    if plan.needs_ray:
        require_package("optuna", "sweep")


def _run(plan: SweepPlan, folder: Path, ray: str | None, workers: int | None, say: Say) -> SweepResult:
    """Train what is left of a plan, on this machine's processes or on Ray."""
    for name in (TRIALS, LOGS, LOCKS):
        make_output_folder(folder / name)
    with locked(folder / LOCKS / "sweep", _HANDOVER):
        book = _Book(plan, folder, say)
        if ray is None and not plan.needs_ray:
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            count = workers or cores
            say(f"{book.size}; {count} at a time, processes of this machine")
            with _sigterm_interrupts():
                return book.result_of(lambda: _train_all(book, lambda jobs: spread(jobs, count)))
        from wlr_gym.learning.sweep.ray import LOCAL, connected, fit_nodes, search_with_tune, spread_on_ray

        address = ray or LOCAL
        with connected(address, workers), _sigterm_interrupts():
            say(f"{book.size}; Ray {'on this machine' if address == LOCAL else f'at {address}'}")
            nodes = fit_nodes(check_job(plan, folder), say)

            def search() -> None:
                search_with_tune(plan, folder, book.begun(), book.stopped, nodes, workers, book.begin, book.end)

            by_tune = search if plan.needs_ray else None
            return book.result_of(lambda: _train_all(book, lambda jobs: spread_on_ray(jobs, nodes, workers), by_tune))


@contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _train_all(book: _Book, run: Run, search: Callable[[], None] | None = None) -> None:
    """Train the grid with all seeds; or search with the first seed, then train the best with the others."""
    plan, known = book.plan, known_settings(book.plan) or []
    if plan.search is None:
        book.train(trials_of(known, plan.seed_list), run)
        return
    if search is not None:
        search()
    else:
        book.train(trials_of(known, plan.seed_list[:1]), run)
    best = [dict(one.settings) for one in summarise(book.results(), plan.metric)[: plan.search.repeat_best]]
    book.train(trials_of(best, plan.seed_list), run)


class _Book:
    """Keeps how the trials of a sweep ended; writes table and page.

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
        plan, seeds = self.plan, len(self.plan.seed_list)
        known = known_settings(plan)
        count = len(known) if known is not None else plan.search.trials if plan.search else 0
        steps = plan.settings.get("total_steps")
        each = f" of {steps:,} environment steps" if isinstance(steps, int) and "total_steps" not in plan.space else ""
        if plan.search is None:
            return f"{counted(count * seeds, 'trial')}: {counted(count, 'setting')} x {counted(seeds, 'seed')}{each}"
        best = min(plan.search.repeat_best, count)
        return f"{counted(count, 'trial')}{each}, then the best {best} with {counted(seeds, 'seed')}"

    def begun(self) -> list[dict[str, Any]]:
        """Return the settings that a search tries first, and count their trials in: all known ones, or those begun before."""
        known, file = known_settings(self.plan), self.folder / BEGUN_FILE
        if known is None:
            lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
            # Oldest first, each once; a last line may be cut short.
            known = list({line: json.loads(line) for line in lines if line.endswith("}")}.values())
        for settings in known:
            self._enter(trial_of(settings, self.plan.seed_list[0]))
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
        for trial in trials:
            self._enter(trial)
        left = [trial for trial in trials if not is_complete(self.folder / TRIALS / trial.name)]
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
        self.say(self._line(found))
        try:
            write_table(self.results(), self.folder)
        except InputError as problem:  # a full disk; the trials go on
            self.say(str(problem))

    def _line(self, result: TrialResult) -> str:
        metric, name = self.plan.metric, result.trial.name
        of = f"/{self._expected}" if self._expected else ""
        if result.status == FAILED:
            return f"{self._done}{of}  {name}: FAILED: {result.error}"
        scores = f"{metric} {result.final[metric]:.3f}" if metric in result.final else "no scores"
        left = (time.monotonic() - self._began) / self._done * (self._expected - self._done)
        rest = f"; about {duration(left)} left" if left > 0.0 else ""
        return f"{self._done}{of}  {name}: {result.status}, {scores}, {duration(result.seconds)}{rest}"

    def results(self) -> list[TrialResult]:
        """Return what is known of all trials; those that have ended are not read again: of thousands some end all the time."""
        for one in self._found.values():
            if one.status == UNFINISHED:
                one.read()
        return list(self._found.values())

    def result_of(self, work: Callable[[], None]) -> SweepResult:
        """Do the work; write table and page of what there is, however it ends; return the result."""
        resume = f"wlr sweep --resume {self.folder}"
        try:
            work()
        except KeyboardInterrupt:
            try:
                self.write()
            except InputError as problem:
                self.say(str(problem))
            raise KeyboardInterrupt(f"interrupted; trials have checkpoints; resume with: {resume}") from None
        try:
            self.write()
        except InputError as problem:
            found = Counter(one.status for one in self.results())
            count = ", ".join(f"{status}: {number}" for status, number in found.items())
            raise InputError(f"{problem}; trials {count}; when it can be written: {resume}") from None
        results = self.results()
        return SweepResult(self.folder, results, summarise(results, self.plan.metric))

    def write(self) -> None:
        """Write table and page; trials that were stopped early write their last checkpoint before they are read."""
        for one in self._found.values():
            if one.status == STOPPED_EARLY:
                with suppress(InputError), locked(self.folder / LOCKS / one.trial.name, 2 * PATIENCE):
                    pass
                one.read()
        results = self.results()
        write_table(results, self.folder)
        write_page(self.plan, results, self.folder)
