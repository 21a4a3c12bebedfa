"""wlr_gym: a Gymnasium environment for slip-aware control of a wheeled-legged robot."""

from wlr_gym.envs.registry import register_environments

__version__ = "0.1.0"

register_environments()
