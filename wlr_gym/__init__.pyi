"""Types of the public names; tests/test_api.py keeps them equal to ``__init__.py``."""

from wlr_gym import hardware as hardware
from wlr_gym.base.errors import InputError as InputError
from wlr_gym.base.snapshot import Snapshot as Snapshot
from wlr_gym.data.replay import replay as replay
from wlr_gym.data.runs import Run as Run
from wlr_gym.data.runs import read_dataset as read_dataset
from wlr_gym.data.runs import read_run as read_run
from wlr_gym.envs.interfaces import WlrEnv as WlrEnv
from wlr_gym.envs.interfaces import WlrVectorEnv as WlrVectorEnv
from wlr_gym.envs.registry import register_task as register_task
from wlr_gym.envs.sb3 import Sb3VecEnv as Sb3VecEnv
from wlr_gym.envs.settings import EnvironmentOptions as EnvironmentOptions
from wlr_gym.gap.analysis import Analysis as Analysis
from wlr_gym.gap.workflow import analyse as analyse
from wlr_gym.learning.adaptation.adapt import adapt as adapt
from wlr_gym.learning.evaluation.card import Card as Card
from wlr_gym.learning.evaluation.scoring import evaluate as evaluate
from wlr_gym.learning.foreign import import_policy as import_policy
from wlr_gym.learning.sweep.running import resume_sweep as resume_sweep
from wlr_gym.learning.sweep.running import sweep as sweep
from wlr_gym.learning.training import resume_training as resume_training
from wlr_gym.learning.training import train as train
from wlr_gym.perception.observer.observer import SlipObserver as SlipObserver
from wlr_gym.physics.effects.effect import Effect as Effect
from wlr_gym.physics.effects.patch import Patch as Patch
from wlr_gym.physics.effects.patch import load_patch as load_patch
from wlr_gym.physics.floor import Floor as Floor
from wlr_gym.physics.floor import load_floor as load_floor
from wlr_gym.physics.plants import make_plant as make_plant
from wlr_gym.physics.plants.base import PlantOptions as PlantOptions
from wlr_gym.policy.agents import Policy as Policy
from wlr_gym.policy.agents import TrainingProgress as TrainingProgress
from wlr_gym.policy.agents import load_policy as load_policy
from wlr_gym.robot.description import Robot as Robot
from wlr_gym.robot.description import load_robot as load_robot
from wlr_gym.robot.parameters import Parameters as Parameters

__version__: str
HOMES: dict[str, str]
__all__ = [
    "Analysis",
    "Card",
    "Effect",
    "EnvironmentOptions",
    "Floor",
    "InputError",
    "Parameters",
    "Patch",
    "PlantOptions",
    "Policy",
    "Robot",
    "Run",
    "Sb3VecEnv",
    "SlipObserver",
    "Snapshot",
    "TrainingProgress",
    "WlrEnv",
    "WlrVectorEnv",
    "adapt",
    "analyse",
    "evaluate",
    "hardware",
    "import_policy",
    "load_floor",
    "load_patch",
    "load_policy",
    "load_robot",
    "make_plant",
    "read_dataset",
    "read_run",
    "register_task",
    "replay",
    "resume_sweep",
    "resume_training",
    "sweep",
    "train",
]
