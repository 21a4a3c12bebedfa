"""The gap workflow: find where simulation and measurement disagree, name what is missing, add it, show that the gap shrinks."""

from wlr_gym.gap.analyse import analyse
from wlr_gym.gap.analysis import Analysis

__all__ = ["Analysis", "analyse"]
