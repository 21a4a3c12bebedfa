"""Evaluation: whole episodes as one batch, score cards with confidence intervals, and their plots.

Each name loads its module when it is used.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from wlr_gym.learning.curves import read_curve
    from wlr_gym.learning.evaluation.card import (
        MAIN,
        OTHER_PLANT,
        Card,
        comparison_rows,
        rows,
        score,
        seed_rows,
        sweep_comparison_rows,
        sweep_rows,
        transfer_rows,
        write_card,
        write_episodes,
    )
    from wlr_gym.learning.evaluation.conditions import FIRST_SEED, Condition, Sweep, play, read_sweep, sweeps_for, work
    from wlr_gym.learning.evaluation.episode_recorder import EpisodeRecorder, record_episodes, write_samples
    from wlr_gym.learning.evaluation.metrics import Estimate, Metric, Played, metrics_of, summarise
    from wlr_gym.learning.evaluation.rollout import Measure, Rollout, make_core, measures_of, roll_out, start_episodes
    from wlr_gym.learning.evaluation.subjects import Subject, common_robot, identity, make_player, read_subjects

__all__ = [
    "FIRST_SEED",
    "MAIN",
    "OTHER_PLANT",
    "Card",
    "Condition",
    "EpisodeRecorder",
    "Estimate",
    "Measure",
    "Metric",
    "Played",
    "Rollout",
    "Subject",
    "Sweep",
    "common_robot",
    "comparison_rows",
    "identity",
    "make_core",
    "make_player",
    "measures_of",
    "metrics_of",
    "play",
    "read_curve",
    "read_subjects",
    "read_sweep",
    "record_episodes",
    "roll_out",
    "rows",
    "score",
    "seed_rows",
    "start_episodes",
    "summarise",
    "sweep_comparison_rows",
    "sweep_rows",
    "sweeps_for",
    "transfer_rows",
    "work",
    "write_card",
    "write_episodes",
    "write_samples",
]
#: Where they are; the light ones first.
_MODULES = ("curves", "evaluation.rollout", "evaluation.metrics", "evaluation.subjects", "evaluation.conditions")
_MODULES += ("evaluation.card", "evaluation.episode_recorder")


def __getattr__(name: str) -> object:
    for module in _MODULES if name in __all__ else ():
        found = vars(importlib.import_module(f"wlr_gym.learning.{module}"))
        if name in found:
            return found[name]
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
