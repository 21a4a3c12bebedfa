"""Jobs: work for processes of their own. What one breaks or leaks does not harm the others, and each has one thread.

A job is a module that is run with a task (JSON) on its standard input, and says in lines of JSON on its standard output what it
has to say; the last line is ``{"error": ""}``. Whatever else it prints goes to its log. Its input stays open as long as
somebody waits for it. When that ends, for whatever reason, the job gets SIGTERM and ends in good order.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

Send = Callable[[Mapping[str, Any]], None]

#: Environment of a job: one thread each, as many jobs as there are cores.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), "1")
#: s that a job has to end in good order, before it is killed.
PATIENCE = 60.0
#: s between looks at jobs.
POLL = 0.05


@dataclass(frozen=True)
class Job:
    """One piece of work.

    Attributes:
        name: as messages call it.
        module: run as ``python -m MODULE``; it calls :func:`serve`.
        task: what it gets, plain types.
        log: file that its output is added to.
    """

    name: str
    module: str
    task: Mapping[str, Any]
    log: str


@dataclass(frozen=True)
class Ended:
    """How a job ended: ``error`` is empty where all went well."""

    name: str
    error: str = ""


# ---- who waits for jobs ----------------------------------------------------------------------------------------------


def spread(jobs: Iterable[Job], workers: int) -> Generator[Ended, None, None]:
    """Run jobs in processes of this machine, ``workers`` at a time; yield how each ended, as it does.

    When the caller ends early (an exception, Ctrl-C), the running jobs are ended in good order.
    """
    left, running = list(jobs)[::-1], {}
    try:
        while left or running:
            while left and len(running) < workers:
                job = left.pop()
                try:
                    running[job.name] = job, start(job)
                except OSError as error:
                    yield Ended(job.name, f"cannot be started: {error}")
            time.sleep(POLL)
            for job, process in [pair for pair in running.values() if pair[1].poll() is not None]:
                del running[job.name]
                yield Ended(job.name, outcome(job, process, process.stdout.readlines()[-1:]))
    finally:
        stop([process for _, process in running.values()])


def follow(job: Job, hear: Callable[[dict[str, Any]], object]) -> str:
    """Run a job here and call ``hear`` with all that it says; return its error, empty where all went well."""
    try:
        process = start(job)
    except OSError as error:
        return f"cannot be started: {error}"
    try:
        last = []
        for line in process.stdout:
            last = [line]
            if (said := read_message(line)) and "error" not in said:
                hear(said)
        process.wait()
        return outcome(job, process, last)
    finally:
        stop([process])


def start(job: Job) -> Any:
    """Start a job in a session of its own (Ctrl-C reaches it through who waits for it) and return its process."""
    with open(job.log, "ab") as log:
        process: Any = subprocess.Popen(
            [sys.executable, "-m", job.module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env={**os.environ, **ONE_THREAD},
            start_new_session=True,
        )
    with contextlib.suppress(BrokenPipeError):  # it died at once; its log says why
        process.stdin.write(json.dumps(job.task) + "\n")
        process.stdin.flush()
    return process


def read_message(line: str) -> dict[str, Any]:
    """Return what a line says; nothing, where its writer was killed before the end of the line."""
    return json.loads(line) if line.endswith("\n") else {}


def outcome(job: Job, process: Any, last: list[str]) -> str:
    """Return the error of a job that ended; ``last`` is the last line it said."""
    if last and "error" in (said := read_message(last[0])):
        return said["error"]
    with open(job.log, "rb") as file:
        file.seek(max(0, os.path.getsize(job.log) - 2000))
        said = file.read(2000).decode("utf-8", errors="replace").strip().splitlines()[-1:]
    return f"the process ended with {process.returncode}; last in {job.log}: {' '.join(said)}"


def stop(processes: Iterable[Any]) -> None:
    """Ask processes to end in good order, and see to it that they do."""
    asked = [process for process in processes if process.poll() is None]
    for process in asked:
        process.stdin.close()
    deadline = time.monotonic() + PATIENCE
    try:
        while any(process.poll() is None for process in asked) and time.monotonic() < deadline:
            time.sleep(POLL)
    finally:
        for process in asked:
            process.kill()


# ---- a job -----------------------------------------------------------------------------------------------------------


def serve(work: Callable[[Mapping[str, Any], Send], None]) -> None:
    """Be a job's process: read the task, do the work, say how it ended.

    Args:
        work: called with the task, and a function that says something to who waits.
    """
    from wlr_gym.base.errors import InputError, MissingPackageError

    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def send(message: Mapping[str, Any]) -> None:
        print(json.dumps(message), file=answers, flush=True)

    task = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_input, daemon=True).start()
    try:
        work(task, send)
    except (InputError, MissingPackageError) as error:
        send({"error": str(error)})
    except KeyboardInterrupt as interruption:
        send({"error": f"stopped: {interruption}"})
    except Exception as error:  # whatever it is, the other jobs go on
        send({"error": f"{type(error).__name__}: {error}"})
        with contextlib.suppress(OSError):  # the log may be on the disk that is full
            traceback.print_exc()
    else:
        send({"error": ""})


def _end_with_input() -> None:
    """Wait for the end of the standard input: nobody waits for this job any more."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


def import_modules(names: Iterable[str]) -> None:
    """Import what adds to the library (``wlr --import MODULE``), also from the present folder."""
    if str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    for name in names:
        importlib.import_module(name)


# ---- processors ------------------------------------------------------------------------------------------------------


#: Where Linux says how much of the processors a container may use: quota and period, "max" or -1 = no limit.
_QUOTAS = (("/sys/fs/cgroup/cpu.max",), ("/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "/sys/fs/cgroup/cpu/cpu.cfs_period_us"))


def cores() -> int:
    """Return how many processors this process may use: those of its affinity, at most its container's share of time."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in _QUOTAS:
        with contextlib.suppress(OSError, ValueError):
            quota, period = map(int, " ".join(Path(file).read_text() for file in files).split())  # "max" is no number
            if quota > 0:
                found = min(found, math.ceil(quota / period))
    return found


# ---- threads ---------------------------------------------------------------------------------------------------------


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_threads(threads: int, work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Return ``work`` of every item, in their order; so many are done at a time. What is returned does not depend on it."""
    if threads == 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        try:
            return list(pool.map(work, items))
        except KeyboardInterrupt:
            print("interrupting ...", file=sys.stderr, flush=True)  # what has begun ends first
            raise
