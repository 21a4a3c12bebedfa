"""Ray Tune in 20 lines: every trial reports its held-out scores while it learns, and ASHA stops the worse ones.

Needs ``pip install -e '.[sweep]'`` in the clone. Minutes (``--quick``: one). ``wlr sweep`` does the same and resumes; this
is for a search of your own.

    python examples/ray_tune.py [--quick]
"""

import sys
import tempfile

from ray import init, tune
from ray.tune.schedulers import ASHAScheduler

import wlr_gym

STEPS = 16_384 if "--quick" in sys.argv else 400_000


def train(settings):
    changes = {"total_steps": STEPS, "evaluate_every": STEPS // 8, "learning_rate": settings["learning_rate"]}
    with tempfile.TemporaryDirectory() as folder:
        wlr_gym.train("WLR-Velocity-v0", folder, "ppo", settings=changes, on_update=lambda now: tune.report(dict(now.held_out)))


if __name__ == "__main__":
    init(address="local", include_dashboard=False, log_to_driver=False)
    with tempfile.TemporaryDirectory() as storage:
        best = tune.Tuner(
            train,
            param_space={"learning_rate": tune.grid_search([3e-4, 1e-3, 3e-3])},
            tune_config=tune.TuneConfig(metric="tracking_error", mode="min", scheduler=ASHAScheduler("steps", max_t=STEPS)),
            run_config=tune.RunConfig(storage_path=storage, verbose=0),
        ).fit().get_best_result()  # fmt: skip
    print(f"best learning rate: {best.config}, tracking error {(best.metrics or {})['tracking_error']:.3f}")
