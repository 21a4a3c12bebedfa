"""Stages in two workers, each a process of its own on one core: what one worker breaks or leaks does not harm the other.

A worker reports progress and finished sections to its parent in lines of JSON. Whatever else it prints goes to a log file.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TextIO

from wlr_gym.base.errors import InputError, MissingPackageError, require_package
from wlr_gym.studies.demo import diagnosis, hidden_fault, ice_comparison, learn, retraining
from wlr_gym.studies.demo.settings import Demo
from wlr_gym.studies.demo.stage import FAILED, SKIPPED, DemoStage, Section, paragraph

#: The shipped policies are ONNX files.
_POLICIES = (("onnxruntime", "export"),)
#: What training on from a policy file takes, to read its weights.
_FILE_WEIGHTS = (("onnx", "export"),)
#: What training takes.
_TRAINING = (("torch", "train"), ("stable_baselines3", "train"), ("tensorboard", "train"))
#: The emulated robot is driven by the servo library.
_ROBOT = (("dynamixel_sdk", "robot"), ("serial", "robot"))
#: Worker -> its stages, one after the other. Shares: measured on a quiet core.
WORKERS: Mapping[str, tuple[DemoStage, ...]] = {
    "policies": (
        DemoStage(learn.TITLE, learn.train, 0.6, _TRAINING),
        DemoStage(ice_comparison.TITLE, ice_comparison.compare, 0.4, _POLICIES),
    ),
    "robot": (
        DemoStage(hidden_fault.TITLE, hidden_fault.drive, 0.15, (*_POLICIES, *_ROBOT)),
        DemoStage(diagnosis.NAME_TITLE, diagnosis.name, 0.45),
        DemoStage(diagnosis.CHECK_TITLE, diagnosis.check, 0.05),
        DemoStage(retraining.TITLE, retraining.retrain, 0.35, (*_TRAINING, *_POLICIES, *_FILE_WEIGHTS, *_ROBOT)),
    ),
}
#: Called with the worker, what it is doing, and the share of its work that is done.
TellWorker = Callable[[str, str, float], None]
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")
#: s that a worker has to come to an end after Ctrl-C, before it is killed.
_PATIENCE = 60.0


@dataclass
class Outcome:
    """Sections in the order of the page, and whether somebody stopped the demo."""

    sections: list[Section]
    interrupted: bool


# ---- the parent ------------------------------------------------------------------------------------------------------


def run_workers(demo: Demo, tell: TellWorker) -> Outcome:
    """Run all workers at once and return what they found; Ctrl-C ends them in good order."""
    inbox: queue.Queue[tuple[str, dict[str, Any] | None]] = queue.Queue()
    found: dict[str, list[Section]] = {worker: [] for worker in WORKERS}
    interrupted = False
    log = (demo.out / "log.txt").open("w", encoding="utf-8")
    running = {worker: _start(worker, demo, log, inbox) for worker in WORKERS}
    try:
        while running:
            try:
                _take(inbox, running, found, tell)
            except KeyboardInterrupt:
                interrupted = True
                _interrupt(running)
    finally:
        for process in running.values():
            process.kill()
        log.close()
    return Outcome([section for worker in WORKERS for section in _complete(worker, found[worker], interrupted)], interrupted)


def _start(worker: str, demo: Demo, log: TextIO, inbox: queue.Queue[Any]) -> subprocess.Popen[str]:
    """Start a worker in a session of its own: Ctrl-C reaches it through its parent, once."""
    task = {"worker": worker, "demo": {**asdict(demo), "out": str(demo.out)}}
    process = subprocess.Popen(
        [sys.executable, "-m", "wlr_gym.studies.demo.workers", json.dumps(task)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=log,
        text=True,
        env={**os.environ, **dict.fromkeys(_THREADS, "1")},
        start_new_session=True,
    )

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            inbox.put((worker, json.loads(line)))
        inbox.put((worker, None))

    threading.Thread(target=read, daemon=True).start()
    return process


def _take(
    inbox: queue.Queue[tuple[str, dict[str, Any] | None]],
    running: dict[str, subprocess.Popen[str]],
    found: dict[str, list[Section]],
    tell: TellWorker,
) -> None:
    """Take one message of a worker."""
    worker, message = inbox.get()
    if message is None:
        running.pop(worker).wait()
    elif "section" in message:
        found[worker].append(Section(**message["section"]))
    else:
        tell(worker, message["text"], message["share"])


def _interrupt(running: Mapping[str, subprocess.Popen[str]]) -> None:
    """Ask the workers to end, and see to it that they do."""
    for process in running.values():
        process.send_signal(signal.SIGINT)
        killer = threading.Timer(_PATIENCE, process.kill)
        killer.daemon = True
        killer.start()


def _complete(worker: str, sections: list[Section], interrupted: bool) -> list[Section]:
    """Return a section for each stage of a worker: those that were not reached say so."""
    text = "Not reached: the demo was stopped." if interrupted else "Not reached: this worker ended early; log.txt says why."
    verdict = SKIPPED if interrupted else FAILED
    missing = [Section(stage.title, "", paragraph(text), verdict) for stage in WORKERS[worker][len(sections) :]]
    return sections + missing


# ---- a worker --------------------------------------------------------------------------------------------------------


def work(worker: str, demo: Demo, send: Callable[[dict[str, Any]], None]) -> None:
    """Do the stages of a worker; one that cannot be done says why and the others continue."""
    done = 0.0
    for stage in WORKERS[worker]:

        def tell(text: str, share: float, base: float = done, stage: DemoStage = stage) -> None:
            send({"text": text, "share": base + stage.share * share})

        send({"section": asdict(_attempt(stage, demo, tell))})
        done += stage.share


def _attempt(stage: DemoStage, demo: Demo, tell: Callable[[str, float], None]) -> Section:
    try:
        for package, extra in stage.needs:
            require_package(package, extra)
        return stage.work(demo, tell)
    except MissingPackageError as error:
        return Section(stage.title, "", paragraph(f"Left out: {error}"), SKIPPED)
    except InputError as error:
        return Section(stage.title, "", paragraph(f"Not done: {error}"), FAILED)
    except Exception as error:  # one stage that fails must not take the page with it
        traceback.print_exc()
        return Section(stage.title, "", paragraph(f"Failed: {type(error).__name__}: {error}; log.txt has more."), FAILED)


def _main(task: Mapping[str, Any]) -> None:
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def send(message: dict[str, Any]) -> None:
        print(json.dumps(message), file=answers, flush=True)

    demo = Demo(**{**task["demo"], "out": Path(task["demo"]["out"])})
    try:
        work(task["worker"], demo, send)
    except KeyboardInterrupt as interruption:
        print(f"{task['worker']}: stopped {interruption}", file=sys.stderr)


if __name__ == "__main__":
    _main(json.loads(sys.argv[1]))
