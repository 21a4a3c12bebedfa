"""wlr_gym: a Gymnasium environment for slip-aware control of a wheeled-legged robot."""

__version__ = "0.1.0"
