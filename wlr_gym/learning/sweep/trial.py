"""One trial: a process that trains into an ordinary run folder, or resumes what is there."""

from __future__ import annotations

import json
import platform
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wlr_gym import __version__
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import locked
from wlr_gym.base.jobs import PATIENCE, Job, Send, import_modules, serve
from wlr_gym.base.provenance import CONFIG_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.learning.curves import read_curve
from wlr_gym.learning.sweep.plan import SweepPlan, Trial, check_settings, draw, trial_of, whole_settings
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
    job = job_of(plan, trial_of(draw(plan, np.random.default_rng(0)), plan.seed_list[0]), out)
    return Job("check", job.module, {**job.task, "check": True}, str(out.resolve() / LOGS / "check.txt"))


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
    out, told = Path(task["out"]), -1.0
    folder = out / TRIALS / task["name"]

    def tell(scores: Mapping[str, float]) -> None:
        """Say held-out scores, each once."""
        nonlocal told
        if task["report"] and scores and scores["steps"] > told:
            told = scores["steps"]
            send(dict(scores))

    with locked(out / LOCKS / task["name"], 2 * PATIENCE):
        for row in scores_of(folder):  # what a trial that is resumed has already
            tell(row)
        if task["train"] and not is_complete(folder):
            _train(task, folder, tell)
        for row in scores_of(folder):  # what the end of the training added
            tell(row)


def _train(task: Mapping[str, Any], folder: Path, tell: Send) -> None:
    """Train, or resume from the newest checkpoint; what has none is trained from the beginning."""

    def on_update(progress: TrainingProgress) -> None:
        tell(progress.held_out)

    if can_resume(folder):
        resume_training(folder, on_update=on_update)
        return
    shutil.rmtree(folder, ignore_errors=True)
    training = Training(task["environment"], folder, task["settings"], progress=False, init=task["init"], on_update=on_update)
    run_training(task["agent"], training)


def scores_of(folder: Path) -> list[dict[str, float]]:
    """Return the held-out scores of a run folder, oldest first."""
    file = folder / "held_out.csv"
    return read_curve(file) if file.is_file() else []


def is_complete(folder: Path) -> bool:
    """Return whether a run folder holds a training that has done all its steps."""
    contract = folder / "policy" / "contract.json"
    if not contract.is_file() or not (folder / CONFIG_FILE).is_file():
        return False
    steps = json.loads(contract.read_text(encoding="utf-8")).get("training", {}).get("steps")
    total = read_yaml(folder / CONFIG_FILE)["settings"].get("total_steps")
    return steps is None or total is None or steps >= total


if __name__ == "__main__":
    serve(train_trial)
