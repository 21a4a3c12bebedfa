"""WLR-Posture: classes behind the ids; the tables in their documentation are made from the task's data."""

from __future__ import annotations

from typing import ClassVar

from wlr_gym.envs.document import class_document
from wlr_gym.envs.single import WlrEnv
from wlr_gym.envs.vector import WlrVectorEnv
from wlr_gym.tasks import posture


class PostureEnv(WlrEnv):
    task_name: ClassVar[str] = "posture"
    __doc__ = class_document("posture", posture.SUMMARY, posture.HISTORY)


class PostureVectorEnv(WlrVectorEnv):
    task_name: ClassVar[str] = "posture"
    __doc__ = class_document("posture", posture.SUMMARY, posture.HISTORY)
