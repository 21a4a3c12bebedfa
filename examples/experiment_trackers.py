"""Follow a training in Weights & Biases and in MLflow, each by a callback of a few lines: minutes (``--quick``: seconds).

Neither is a dependency: what is not installed is left out (``pip install wandb mlflow``). Both write into a folder of this
machine and need no network; for a server, set WANDB_MODE=online, or MLFLOW_TRACKING_URI to its address. Prints the folder.

    python examples/experiment_trackers.py [--quick] [--out DIR]
"""

import argparse
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import wlr_gym

PROJECT = "wlr_gym"
#: Called after every update of a training.
Callback = Callable[[wlr_gym.TrainingProgress], None]
#: Called at the end with the folder of the policy that did best on the held-out episodes.
Finish = Callable[[Path], None]


def numbers(progress: wlr_gym.TrainingProgress) -> dict[str, float]:
    """Return an update's numbers, and the scores on held-out episodes where they are of this update."""
    found = {f"training/{name}": value for name, value in progress.metrics.items() if name != "steps"}
    if progress.held_out.get("steps") == progress.steps:
        found |= {f"held_out/{name}": value for name, value in progress.held_out.items() if name != "steps"}
    return found


def with_wandb(out: Path, settings: Mapping[str, Any]) -> tuple[Callback, Finish]:
    """Report to Weights & Biases."""
    import wandb  # pyright: ignore[reportMissingImports]

    mode = os.environ.get("WANDB_MODE", "offline")
    run = wandb.init(project=PROJECT, name=out.name, dir=str(out), config=dict(settings), mode=mode)

    def finish(policy: Path) -> None:
        artifact = wandb.Artifact("policy", type="model")
        artifact.add_dir(str(policy))
        run.log_artifact(artifact)
        run.finish()

    return lambda progress: run.log(numbers(progress), step=progress.steps), finish


def with_mlflow(out: Path, settings: Mapping[str, Any]) -> tuple[Callback, Finish]:
    """Report to MLflow."""
    import mlflow  # pyright: ignore[reportMissingImports]

    if "MLFLOW_TRACKING_URI" not in os.environ:
        mlflow.set_tracking_uri(f"sqlite:///{out / 'mlflow.db'}")
        if mlflow.get_experiment_by_name(PROJECT) is None:  # else files would go into the present folder
            mlflow.create_experiment(PROJECT, artifact_location=(out / "mlflow").as_uri())
    mlflow.set_experiment(PROJECT)
    mlflow.start_run(run_name=out.name)
    mlflow.log_params(dict(settings))

    def finish(policy: Path) -> None:
        mlflow.log_artifacts(str(policy), artifact_path="policy")
        mlflow.end_run()

    return lambda progress: mlflow.log_metrics(numbers(progress), step=progress.steps), finish


def train(out: Path, settings: Mapping[str, Any]) -> None:
    """Train, reporting to every tracker that is installed."""
    trackers = []
    for open_tracker in (with_wandb, with_mlflow):
        try:
            trackers.append(open_tracker(out, settings))
        except ImportError as error:
            print(f"left out: {error}")

    def report(progress: wlr_gym.TrainingProgress) -> None:
        for tell, _ in trackers:
            tell(progress)

    policy = wlr_gym.train("WLR-Velocity-v0", out / "run", "ppo_blind", settings=settings, on_update=report)
    for _, finish in trackers:
        finish(policy.parent / "best")
    print(f"trained, {len(trackers)} of 2 trackers: {out}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two updates")
    parser.add_argument("--out", type=Path, help="folder of the run and of what the trackers write; default: a temporary one")
    options = parser.parse_args()
    settings = {"total_steps": 16_384 if options.quick else 1_500_000, "evaluate_every": 8_192 if options.quick else 100_000}
    with tempfile.TemporaryDirectory() as folder:
        out = (options.out or Path(folder) / "velocity").resolve()
        out.mkdir(parents=True, exist_ok=True)
        train(out, settings)


if __name__ == "__main__":
    main()
