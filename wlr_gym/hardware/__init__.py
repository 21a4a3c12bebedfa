"""The real robot: Dynamixel protocol, control tables, bus groups, and an emulator of the eight servos and the IMU.

``gym.make(id, backend="dynamixel", hardware=RobotOptions(...))`` is the robot as an environment; what stands here
drives it with a policy or a motion, and says why it stopped. Each name loads its module when it is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wlr_gym.hardware.config import Hardware, load_hardware
    from wlr_gym.hardware.deployment import Deployment, DriveResult, deploy, drive_robot
    from wlr_gym.hardware.plant import RobotPlant
    from wlr_gym.physics.plants.base import RobotOptions

HOMES = {
    "Deployment": "wlr_gym.hardware.deployment",
    "DriveResult": "wlr_gym.hardware.deployment",
    "Hardware": "wlr_gym.hardware.config",
    "RobotOptions": "wlr_gym.physics.plants.base",
    "RobotPlant": "wlr_gym.hardware.plant",
    "deploy": "wlr_gym.hardware.deployment",
    "drive_robot": "wlr_gym.hardware.deployment",
    "load_hardware": "wlr_gym.hardware.config",
}

__all__ = ["Deployment", "DriveResult", "Hardware", "RobotOptions", "RobotPlant", "deploy", "drive_robot", "load_hardware"]


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(HOMES[name]), name)
