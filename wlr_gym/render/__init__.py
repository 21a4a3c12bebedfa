"""Pictures and videos of the robot, drawn by MuJoCo from the truth of any plant. Parts load when asked for."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlr_gym.render.scene import Scene
    from wlr_gym.render.video import side_by_side, write_video
    from wlr_gym.render.view import View
    from wlr_gym.render.viewer import Viewer

_PARTS = {"Scene": "scene", "View": "view", "Viewer": "viewer", "side_by_side": "video", "write_video": "video"}

__all__ = ["Scene", "View", "Viewer", "side_by_side", "write_video"]


def __getattr__(name: str) -> Any:
    if name not in _PARTS:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"wlr_gym.render.{_PARTS[name]}"), name)
