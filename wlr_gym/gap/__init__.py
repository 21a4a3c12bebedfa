"""The gap workflow: find where simulation and measurement disagree, name what is missing, add it, show that the gap shrinks."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlr_gym.gap.analysis import Analysis
    from wlr_gym.gap.decision import Budget, Decided, Recorded, decide
    from wlr_gym.gap.workflow import analyse

HOMES = {
    "Analysis": "wlr_gym.gap.analysis",
    "Budget": "wlr_gym.gap.decision",
    "Decided": "wlr_gym.gap.decision",
    "Recorded": "wlr_gym.gap.decision",
    "decide": "wlr_gym.gap.decision",
    "analyse": "wlr_gym.gap.workflow",
}

__all__ = ["Analysis", "Budget", "Decided", "Recorded", "analyse", "decide"]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(HOMES[name]), name)
