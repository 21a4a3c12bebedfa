"""WLR-Slope: classes behind the ids; the tables in their documentation are made from the task's data."""

from __future__ import annotations

from typing import ClassVar

from wlr_gym.envs.document import class_document
from wlr_gym.envs.single import WlrEnv
from wlr_gym.envs.vector import WlrVectorEnv
from wlr_gym.tasks import slope


class SlopeEnv(WlrEnv):
    task_name: ClassVar[str] = "slope"
    __doc__ = class_document("slope", slope.SUMMARY, slope.HISTORY)


class SlopeVectorEnv(WlrVectorEnv):
    task_name: ClassVar[str] = "slope"
    __doc__ = class_document("slope", slope.SUMMARY, slope.HISTORY)
