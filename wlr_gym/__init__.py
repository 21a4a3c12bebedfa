"""wlr_gym: a Gymnasium environment for slip-aware control of a wheeled-legged robot.

Importing it registers the environments and loads nothing heavy: each name below loads its module when it is used. Types are in
``__init__.pyi``. The real robot is in :mod:`wlr_gym.hardware`.
"""

import importlib

from wlr_gym.base.errors import nearest
from wlr_gym.envs.registry import register_environments

__version__ = "0.1.0"

#: Public name -> module that it lives in.
HOMES = {
    "WlrEnv": "wlr_gym.envs.interfaces",
    "WlrVectorEnv": "wlr_gym.envs.interfaces",
    "Sb3VecEnv": "wlr_gym.envs.sb3",
    "EnvironmentOptions": "wlr_gym.envs.settings",
    "register_task": "wlr_gym.envs.registry",
    "Snapshot": "wlr_gym.base.snapshot",
    "train": "wlr_gym.learning.training",
    "resume_training": "wlr_gym.learning.training",
    "adapt": "wlr_gym.learning.adaptation.adapt",
    "sweep": "wlr_gym.learning.sweep.running",
    "resume_sweep": "wlr_gym.learning.sweep.running",
    "import_policy": "wlr_gym.learning.foreign",
    "evaluate": "wlr_gym.learning.evaluation.scoring",
    "TrainingProgress": "wlr_gym.policy.agents",
    "Card": "wlr_gym.learning.evaluation.card",
    "Policy": "wlr_gym.policy.agents",
    "load_policy": "wlr_gym.policy.agents",
    "Robot": "wlr_gym.robot.description",
    "load_robot": "wlr_gym.robot.description",
    "Parameters": "wlr_gym.robot.parameters",
    "make_plant": "wlr_gym.physics.plants",
    "PlantOptions": "wlr_gym.physics.plants.base",
    "Effect": "wlr_gym.physics.effects.effect",
    "Patch": "wlr_gym.physics.effects.patch",
    "load_patch": "wlr_gym.physics.effects.patch",
    "Floor": "wlr_gym.physics.floor",
    "load_floor": "wlr_gym.physics.floor",
    "SlipObserver": "wlr_gym.perception.observer.observer",
    "Run": "wlr_gym.data.runs",
    "read_run": "wlr_gym.data.runs",
    "read_dataset": "wlr_gym.data.runs",
    "replay": "wlr_gym.data.replay",
    "analyse": "wlr_gym.gap.workflow",
    "Analysis": "wlr_gym.gap.analysis",
    "InputError": "wlr_gym.base.errors",
}

__all__ = [*sorted(HOMES), "hardware"]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name == "hardware":
        return importlib.import_module("wlr_gym.hardware")
    if name not in HOMES:
        raise AttributeError(f"module 'wlr_gym' has no attribute '{name}'{nearest(name, __all__)}")
    return getattr(importlib.import_module(HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_environments()
