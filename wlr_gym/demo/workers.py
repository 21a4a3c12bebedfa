"""Stages in two workers, each a process of its own on one core: what one worker breaks or leaks does not harm the other.

A worker is a job (:mod:`wlr_gym.base.jobs`): it sends progress and finished sections to its parent.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from wlr_gym.base.errors import InputError, MissingPackageError, require_package
from wlr_gym.base.jobs import Job, Send, read_message, serve, start, stop
from wlr_gym.demo import diagnosis, policies, retraining
from wlr_gym.demo.page import FAILED, SKIPPED, Demo, DemoStage, Section, paragraph

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
        DemoStage(policies.LEARN_TITLE, policies.train, 0.6, _TRAINING),
        DemoStage(policies.ICE_TITLE, policies.compare, 0.4, _POLICIES),
    ),
    "robot": (
        DemoStage(diagnosis.DRIVE_TITLE, diagnosis.drive, 0.15, (*_POLICIES, *_ROBOT)),
        DemoStage(diagnosis.NAME_TITLE, diagnosis.name, 0.49),
        DemoStage(diagnosis.CHECK_TITLE, diagnosis.check, 0.01),
        DemoStage(retraining.TITLE, retraining.retrain, 0.35, (*_TRAINING, *_POLICIES, *_FILE_WEIGHTS, *_ROBOT)),
    ),
}
#: Called with the worker, what it is doing, and the share of its work that is done.
TellWorker = Callable[[str, str, float], None]


# ---- the parent ------------------------------------------------------------------------------------------------------


def run_workers(demo: Demo, tell: TellWorker) -> tuple[list[Section], bool]:
    """Run all workers at once; return sections in the order of the page, and whether somebody stopped the demo.

    Ctrl-C ends the workers in good order.
    """
    inbox: queue.Queue[tuple[str, str]] = queue.Queue()  # worker and a line that it said; an empty one: it has ended
    found: dict[str, list[Section]] = {worker: [] for worker in WORKERS}
    interrupted, running = False, {}

    def read(worker: str) -> None:
        for line in running[worker].stdout:
            inbox.put((worker, line))
        inbox.put((worker, ""))

    try:
        for worker in WORKERS:
            task = {"worker": worker, "demo": {**asdict(demo), "out": str(demo.out)}}
            running[worker] = start(Job(worker, "wlr_gym.demo.workers", task, str(demo.out / "log.txt")))
            threading.Thread(target=read, args=(worker,), daemon=True).start()
        while running:
            try:
                worker, line = inbox.get()
                said = read_message(line)
                if not line:
                    running.pop(worker).wait()
                elif "section" in said:
                    found[worker].append(Section(**said["section"]))
                elif "text" in said:
                    tell(worker, said["text"], said["share"])
            except KeyboardInterrupt:
                interrupted = True
                with contextlib.suppress(KeyboardInterrupt):  # a second one kills them
                    stop(running.values())  # what they say meanwhile comes into the inbox
    finally:
        for process in running.values():
            process.kill()
    why, verdict = ("the demo was stopped.", SKIPPED) if interrupted else ("this worker ended early; log.txt says why.", FAILED)
    for worker, stages in WORKERS.items():
        missing = stages[len(found[worker]) :]
        found[worker] += [Section(one.title, "", paragraph(f"Not reached: {why}"), verdict) for one in missing]
    return [section for sections in found.values() for section in sections], interrupted


# ---- a worker --------------------------------------------------------------------------------------------------------


def work(worker: str, demo: Demo, send: Send) -> None:
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


if __name__ == "__main__":
    serve(lambda task, send: work(task["worker"], Demo(**{**task["demo"], "out": Path(task["demo"]["out"])}), send))
