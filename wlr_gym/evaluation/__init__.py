"""Evaluation: whole episodes as one batch, score cards with confidence intervals, and their plots."""

from wlr_gym.evaluation.card import METRICS, Card, Estimate, rows, score, write_card
from wlr_gym.evaluation.curve import read_curve
from wlr_gym.evaluation.record import Recorder, record_episodes, write_samples
from wlr_gym.evaluation.rollout import Rollout, make_core, roll_out

__all__ = [
    "METRICS",
    "Card",
    "Estimate",
    "Recorder",
    "Rollout",
    "make_core",
    "read_curve",
    "record_episodes",
    "roll_out",
    "rows",
    "score",
    "write_card",
    "write_samples",
]
