"""Optuna in 15 lines beside the imports: a study whose trials stop early where their held-out scores fall behind.

Needs ``pip install -e '.[sweep]'`` in the clone. Minutes (``--quick``: one).

    python examples/optuna_search.py [--quick]
"""

import sys
import tempfile

import optuna

import wlr_gym

STEPS, TRIALS = (16_384, 2) if "--quick" in sys.argv else (400_000, 12)


def train(trial):
    def report(now):
        trial.report(now.held_out["tracking_error"], now.steps)
        if trial.should_prune():
            raise optuna.TrialPruned

    rate = trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True)
    changes = {"total_steps": STEPS, "evaluate_every": STEPS // 8, "learning_rate": rate}
    with tempfile.TemporaryDirectory() as folder:
        policy = wlr_gym.train("WLR-Velocity-v0", folder, settings=changes, on_update=report)
        card = wlr_gym.evaluate(policy, baselines=(), episodes=16)
    return card.scores["main"][card.names[0]]["tracking_error"].mean


if __name__ == "__main__":
    study = optuna.create_study(pruner=optuna.pruners.MedianPruner(n_startup_trials=3))
    study.optimize(train, n_trials=TRIALS)
    print(f"best learning rate {study.best_params['learning_rate']:g}: tracking error {study.best_value:.3f}")
