"""Stages in two lanes, each a process of its own on one core: what one lane breaks or leaks does not harm the other.

A lane tells its parent of progress and of finished sections in lines of JSON. Whatever else it prints goes to a log file.
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
from wlr_gym.studies.demo import answer, ice, learn, secret
from wlr_gym.studies.demo.settings import Demo
from wlr_gym.studies.demo.stage import FAILED, SKIPPED, Section, Stage, paragraph

#: The shipped policies are ONNX files; the emulated robot is driven by the servo library.
_POLICIES, _ROBOT = (("onnxruntime", "export"),), (("dynamixel_sdk", "robot"), ("serial", "robot"))
#: Lane -> its stages, one after the other. Shares: measured on a quiet core.
LANES: Mapping[str, tuple[Stage, ...]] = {
    "policies": (
        Stage(learn.TITLE, learn.train, 0.6, (("torch", "train"), ("stable_baselines3", "train"), ("tensorboard", "train"))),
        Stage(ice.TITLE, ice.compare, 0.4, _POLICIES),
    ),
    "robot": (
        Stage(secret.TITLE, secret.drive, 0.25, (*_POLICIES, *_ROBOT)),
        Stage(answer.NAME_TITLE, answer.name, 0.7),
        Stage(answer.CHECK_TITLE, answer.check, 0.05),
    ),
}
#: Told of the lane, of what is going on, and of the share of the lane's work that is done.
TellLane = Callable[[str, str, float], None]
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")
#: s that a lane has to come to an end after Ctrl-C, before it is killed.
_PATIENCE = 20.0


@dataclass
class Outcome:
    """Sections in the order of the page, and whether somebody stopped the demo."""

    sections: list[Section]
    interrupted: bool


# ---- the parent ------------------------------------------------------------------------------------------------------


def run_lanes(demo: Demo, tell: TellLane) -> Outcome:
    """Run all lanes at once and return what they found; Ctrl-C ends them in good order."""
    inbox: queue.Queue[tuple[str, dict[str, Any] | None]] = queue.Queue()
    found: dict[str, list[Section]] = {lane: [] for lane in LANES}
    interrupted = False
    log = (demo.out / "log.txt").open("w", encoding="utf-8")
    running = {lane: _start(lane, demo, log, inbox) for lane in LANES}
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
    return Outcome([section for lane in LANES for section in _complete(lane, found[lane], interrupted)], interrupted)


def _start(lane: str, demo: Demo, log: TextIO, inbox: queue.Queue[Any]) -> subprocess.Popen[str]:
    """Start a lane in a session of its own: Ctrl-C reaches it through its parent, once."""
    task = {"lane": lane, "demo": {**asdict(demo), "out": str(demo.out)}}
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
            inbox.put((lane, json.loads(line)))
        inbox.put((lane, None))

    threading.Thread(target=read, daemon=True).start()
    return process


def _take(
    inbox: queue.Queue[tuple[str, dict[str, Any] | None]],
    running: dict[str, subprocess.Popen[str]],
    found: dict[str, list[Section]],
    tell: TellLane,
) -> None:
    """Take one message of a lane."""
    lane, message = inbox.get()
    if message is None:
        running.pop(lane).wait()
    elif "section" in message:
        found[lane].append(Section(**message["section"]))
    else:
        tell(lane, message["text"], message["share"])


def _interrupt(running: Mapping[str, subprocess.Popen[str]]) -> None:
    """Ask the lanes to end, and see to it that they do."""
    for process in running.values():
        process.send_signal(signal.SIGINT)
        killer = threading.Timer(_PATIENCE, process.kill)
        killer.daemon = True
        killer.start()


def _complete(lane: str, sections: list[Section], interrupted: bool) -> list[Section]:
    """Return a section for each stage of a lane: those that were not reached say so."""
    text = "Not reached: the demo was stopped." if interrupted else "Not reached: this lane ended early; log.txt says why."
    verdict = SKIPPED if interrupted else FAILED
    missing = [Section(stage.title, "", paragraph(text), verdict) for stage in LANES[lane][len(sections) :]]
    return sections + missing


# ---- a lane ----------------------------------------------------------------------------------------------------------


def work(lane: str, demo: Demo, send: Callable[[dict[str, Any]], None]) -> None:
    """Do the stages of a lane; one that cannot be done says why and lets the others go on."""
    done = 0.0
    for stage in LANES[lane]:

        def tell(text: str, share: float, base: float = done, stage: Stage = stage) -> None:
            send({"text": text, "share": base + stage.share * share})

        send({"section": asdict(_attempt(stage, demo, tell))})
        done += stage.share


def _attempt(stage: Stage, demo: Demo, tell: Callable[[str, float], None]) -> Section:
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
        work(task["lane"], demo, send)
    except KeyboardInterrupt as interruption:
        print(f"{task['lane']}: stopped {interruption}", file=sys.stderr)


if __name__ == "__main__":
    _main(json.loads(sys.argv[1]))
