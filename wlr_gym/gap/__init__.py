"""The gap workflow: find where simulation and measurement disagree, name what is missing, add it, show that the gap shrinks."""

from wlr_gym.gap.analysis import Analysis
from wlr_gym.gap.decision import Budget, Decided, Recorded, decide
from wlr_gym.gap.workflow import analyse

__all__ = ["Analysis", "Budget", "Decided", "Recorded", "analyse", "decide"]
