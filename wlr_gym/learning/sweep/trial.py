"""One trial: a process that trains into an ordinary run folder, or resumes what is there."""

from __future__ import annotations

import json
import platform
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from wlr_gym import __version__
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import locked
from wlr_gym.base.jobs import PATIENCE, Job, Send, import_modules, serve
from wlr_gym.base.provenance import CONFIG_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.learning.curves import read_curve
from wlr_gym.learning.sweep.plan import SweepPlan, Trial
from wlr_gym.learning.training import can_resume, resume_training, run_training
from wlr_gym.policy import Training, TrainingProgress

TRIALS = "trials"
LOGS = "logs"
LOCKS = ".locks"


def job_of(plan: SweepPlan, trial: Trial, out: Path, do: Literal["train", "train and say", "say"] = "train") -> Job:
    """Return the job of a trial.

    Args:
        plan, trial: what to train.
        out: folder of the sweep.
        do: train it; train it and say its held-out scores, those of before and new ones; or only say those that it has.
    """
    out = out.resolve()
    task = {
        "plan": plan.model_dump(mode="json"),
        "settings": dict(trial.settings),
        "seed": trial.seed,
        "out": str(out),
        "do": do,
        "version": __version__,
        "command": sys.argv,
    }
    return Job(trial.name, "wlr_gym.learning.sweep.trial", task, str(out / LOGS / f"{trial.name}.txt"))


def train_trial(task: Mapping[str, Any], send: Send) -> None:
    """Do what a task of :func:`job_of` says, from where its run folder is.

    Raises:
        InputError: this machine has another version, another process trains the trial, or the training refuses its settings.
        MissingPackageError: a package is missing on this machine.
    """
    if task["version"] != __version__:
        raise InputError(f"{platform.node()} has wlr_gym {__version__}, the sweep was started with {task['version']}")
    plan, trial, do = SweepPlan(**task["plan"]), Trial(task["settings"], task["seed"]), task["do"]
    module = plan.environment.rpartition(":")[0]  # of an id such as ``my_tasks:WLR-Climb-v0``
    import_modules([*plan.imports, *([module] if module else [])])
    sys.argv[:] = task["command"]  # the run folder says how the sweep was started, not how its processes are
    out, told = Path(task["out"]), -1.0
    folder = out / TRIALS / trial.name

    def tell(scores: Mapping[str, float]) -> None:
        """Say held-out scores, each once."""
        nonlocal told
        if "say" in do and scores and scores["steps"] > told:
            told = scores["steps"]
            send(dict(scores))

    def on_update(progress: TrainingProgress) -> None:
        tell(progress.held_out)

    with locked(out / LOCKS / trial.name, 2 * PATIENCE):
        for row in scores_of(folder):  # what a trial that is resumed has already
            tell(row)
        if do == "say" or is_complete(folder):
            return
        if can_resume(folder):
            resume_training(folder, on_update=on_update)
        else:  # without a checkpoint it is trained from the beginning
            shutil.rmtree(folder, ignore_errors=True)
            settings = plan.settings_of(trial)
            request = Training(plan.environment, folder, settings, progress=False, init=plan.init, on_update=on_update)
            run_training(plan.agent, request)
        for row in scores_of(folder):  # what the end of the training added
            tell(row)


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
