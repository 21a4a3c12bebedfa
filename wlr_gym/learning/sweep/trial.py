"""One trial: a process that trains into an ordinary run folder, or resumes what is there."""

from __future__ import annotations

import contextlib
import hashlib
import json
import platform
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym import __version__
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import locked
from wlr_gym.base.jobs import PATIENCE, Job, Send, import_modules, serve
from wlr_gym.base.paths import PACKAGE
from wlr_gym.base.provenance import git_commit
from wlr_gym.learning.sweep.plan import SweepPlan, Trial, check_settings, draw, trial_of, whole_settings
from wlr_gym.learning.sweep.results import is_complete, scores_of
from wlr_gym.learning.training import can_resume, resume_training, run_training
from wlr_gym.policy import Training, TrainingProgress

TRIALS = "trials"
LOGS = "logs"
LOCKS = ".locks"


def job_of(plan: SweepPlan, trial: Trial, out: Path, *, report: bool = False, train: bool = True) -> Job:
    """Return the job that trains a trial.

    Args:
        plan, trial: what to train.
        out: folder of the sweep.
        report: let the job say each held-out score.
        train: False = say the scores that there are, no more.
    """
    out, module = out.resolve(), plan.environment.rpartition(":")[0]  # of an id such as ``my_tasks:WLR-Climb-v0``
    task = {
        "out": str(out),
        "name": trial.name,
        "environment": plan.environment,
        "agent": plan.agent,
        "settings": whole_settings(plan, trial),
        "init": plan.init,
        "imports": [*plan.imports, *([module] if module else [])],
        "report": report,
        "train": train,
        "version": __version__,
        "command": sys.argv,
    }
    return Job(trial.name, "wlr_gym.learning.sweep.trial", task, str(out / LOGS / f"{trial.name}.txt"))


def check_job(plan: SweepPlan, out: Path) -> Job:
    """Return a job that ends well where trials can be trained: the same version, all packages, the modules to import."""
    any_settings = draw(plan, np.random.default_rng(0))
    job = job_of(plan, trial_of(any_settings, plan.seed_list[0]), out)
    return replace(job, name="check", task={**job.task, "check": True}, log=str(out.resolve() / LOGS / "check.txt"))


def train_trial(task: Mapping[str, Any], send: Send) -> None:
    """Train what a task of :func:`job_of` says, from where its run folder is.

    Raises:
        InputError: this machine has another version, another process trains the trial, or the training refuses its settings.
        MissingPackageError: a package is missing on this machine.
    """
    if task["version"] != __version__:
        raise InputError(f"{platform.node()} has wlr_gym {__version__}, the sweep was started with {task['version']}")
    import_modules(task["imports"])
    if "check" in task:
        check_settings(task["agent"], task["settings"])
        return
    sys.argv[:] = task["command"]  # the run folder says how the sweep was started, not how its processes are
    out = Path(task["out"])
    folder = out / TRIALS / task["name"]
    with locked(out / LOCKS / task["name"], 2 * PATIENCE):
        reporter = _Reporter(folder, send if task["report"] else None)
        if task["train"] and not is_complete(folder):
            _train(task, folder, reporter)
        reporter.catch_up()


def _train(task: Mapping[str, Any], folder: Path, reporter: _Reporter) -> None:
    """Train, or resume from the newest checkpoint; what has none is trained from the beginning."""
    keywords = task["settings"].get("environment") or {}
    with contextlib.ExitStack() as until_compiled:
        if (compiled := _compiled(task["environment"], keywords)) is not None and not compiled.is_file():
            until_compiled.enter_context(locked(compiled.with_suffix(".lock"), 900.0))  # longer than a compilation takes

        def on_update(progress: TrainingProgress) -> None:
            if compiled is not None:
                with contextlib.suppress(OSError):
                    compiled.touch()
                until_compiled.close()
            reporter.tell(progress.held_out)

        if can_resume(folder):
            resume_training(folder, on_update=on_update)
            return
        shutil.rmtree(folder, ignore_errors=True)
        run_training(
            task["agent"],
            Training(task["environment"], folder, task["settings"], False, None, False, task["init"], on_update),
        )


class _Reporter:
    """Says each held-out score once, the earlier ones of a resumed trial first.

    Args:
        folder: run folder.
        send: None = say nothing.
    """

    def __init__(self, folder: Path, send: Callable[[Mapping[str, Any]], None] | None) -> None:
        self._folder, self._send, self._told = folder, send, -1.0
        self.catch_up()

    def tell(self, scores: Mapping[str, float]) -> None:
        """Say scores, if they are new."""
        if self._send is not None and scores and scores["steps"] > self._told:
            self._told = scores["steps"]
            self._send(dict(scores))

    def catch_up(self) -> None:
        """Say what is new in the run folder, such as what the end of the training added."""
        for row in scores_of(self._folder):
            self.tell(row)


# ---- kernels ---------------------------------------------------------------------------------------------------------


def _compiled(environment: str, keywords: Mapping[str, Any]) -> Path | None:
    """Return the file that says that this machine has the kernels of an environment.

    The first trial of a kind holds a lock until its first update is done, when all is compiled; the others load the kernels.
    A file that is wrong (the cache was emptied) costs time only.
    """
    import llvmlite.binding

    from wlr_gym.physics.codegen.compilation import cache_directory, fingerprint

    texts = (environment, json.dumps(keywords, sort_keys=True), str(PACKAGE), str(git_commit()), __version__)
    key = hashlib.sha256("\0".join((fingerprint(*texts), str(llvmlite.binding.get_host_cpu_name()))).encode()).hexdigest()[:16]
    return cache_directory() / f"compiled_{key}.txt"


if __name__ == "__main__":
    serve(train_trial)
