"""Sweeps: settings x seeds, each trial an ordinary run folder; what was stopped resumes. What ``wlr sweep`` does."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError, check_number, require_package
from wlr_gym.base.files import alone_in, make_output_folder, require_empty
from wlr_gym.base.jobs import cores, spread
from wlr_gym.base.paths import as_path
from wlr_gym.base.provenance import PROVENANCE_FILE, provenance, write_yaml
from wlr_gym.base.settings import parse_config, read_yaml
from wlr_gym.learning.sweep.book import Book, Say, SweepResult
from wlr_gym.learning.sweep.plan import SweepPlan, resolve
from wlr_gym.learning.sweep.trial import LOCKS, LOGS, TRIALS

PLAN_FILE = "sweep.yaml"
#: s that a sweep waits for one that is just ending in the same folder.
_HANDOVER = 5.0


def sweep(
    env_id: str,
    out: str | Path,
    config: str | None = None,
    *,
    init: str | Path | None = None,
    ray: str | None = None,
    workers: int | None = None,
    say: Say = print,
    **plan: Any,
) -> SweepResult:
    """Train settings x seeds, as ``wlr sweep`` does. Each trial is an ordinary run folder, and a process with one thread.

    Args:
        env_id, config, init: as for :func:`wlr_gym.train`.
        out: folder to fill; it must be empty or absent.
        ray: None = processes of this machine; ``"local"`` = a Ray that is started here; otherwise the address of a cluster,
            such as ``"auto"``. Optuna and early stopping run on Ray in any case.
        workers: most trials at a time; None = one per core.
        say: told, in lines, how it goes.
        plan: further fields of :class:`wlr_gym.learning.sweep.plan.SweepPlan`: ``agent``, ``settings`` of all trials, ``space``
            (``{"gamma": [0.9, 0.97]}``, for a search also ``{"gamma": {"low": 0.9, "high": 0.99}}``), ``variants``, ``seeds``,
            ``search`` (``{"method": "optuna", "trials": 20}``) and ``imports``.

    Returns:
        What was found. Trials that failed are in it; the others went on.

    Raises:
        InputError: an unknown name or setting, two trials of one name, a folder with contents, a cluster that does not answer.
        MissingPackageError: Ray or Optuna is needed and not installed.
        KeyboardInterrupt: Ctrl-C or SIGTERM, after the trials saved checkpoints; :func:`resume_sweep` continues.
    """
    if "environment" in plan:
        raise InputError(f"environment = {plan['environment']!r}: it is the first argument, {env_id!r}")
    given = {name: value for name, value in plan.items() if value is not None}
    fields = given | {"environment": env_id, "config": config, "init": None if init is None else str(init)}
    return start_sweep(parse_config(SweepPlan, fields, "sweep"), out, ray=ray, workers=workers, say=say)


def start_sweep(
    plan: SweepPlan, out: str | Path, *, ray: str | None = None, workers: int | None = None, say: Say = print
) -> SweepResult:
    """Run a plan in a new folder; arguments, result and errors as of :func:`sweep`."""
    folder = as_path(out)
    with alone_in(folder):
        require_empty(folder, "wlr sweep" if (folder / PLAN_FILE).is_file() else "")
        whole = resolve(plan)
        _check_machines(whole, ray, workers)
        write_yaml(folder / PROVENANCE_FILE, provenance(whole.seed_list[0]))
        write_yaml(folder / PLAN_FILE, whole.model_dump(mode="json"))
        return _run(whole, folder, ray, workers, say)


def resume_sweep(folder: str | Path, *, ray: str | None = None, workers: int | None = None, say: Say = print) -> SweepResult:
    """Continue a sweep that was stopped or lost machines: trials go on from their checkpoints; failed ones are tried again.

    Args:
        folder: of the sweep; it is continued as it was planned.
        ray, workers, say: as for :func:`sweep`; they need not be those of before.

    Raises:
        InputError: not the folder of a sweep, or another process runs it.
        KeyboardInterrupt: as for :func:`sweep`.
    """
    file = as_path(folder) / PLAN_FILE
    if not file.is_file():
        raise InputError(f"{folder}: not the folder of a sweep: {PLAN_FILE} is missing")
    plan = parse_config(SweepPlan, read_yaml(file), str(file))
    _check_machines(plan, ray, workers)
    return _run(plan, as_path(folder), ray, workers, say)


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
    with alone_in(folder, _HANDOVER):
        book = Book(plan, folder, say)
        if ray is None and not plan.needs_ray:
            most = workers or cores()
            say(f"{book.size}; {most} at a time, processes of this machine")
            with _sigterm_interrupts():
                return book.fill(lambda jobs: spread(jobs, most))
        from wlr_gym.learning.sweep.ray import LOCAL, connected, search_with_tune, spread_on_ray

        address = ray or LOCAL
        with connected(address, workers), _sigterm_interrupts():
            say(f"{book.size}; Ray {'on this machine' if address == LOCAL else f'at {address}'}")
            search = (lambda: search_with_tune(book, workers)) if plan.needs_ray else None
            return book.fill(lambda jobs: spread_on_ray(jobs, workers), search)


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
