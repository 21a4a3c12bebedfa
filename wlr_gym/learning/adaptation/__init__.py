"""Adaptation of a policy to a robot: drive, find what the model lacks, train on with it, test, drive again; docs/adapt.md."""

from wlr_gym.learning.adaptation.adapt import Adapted, adapt
from wlr_gym.learning.adaptation.driving import EmulatedRobot, RealRobot
from wlr_gym.learning.adaptation.state import Asked

__all__ = ["Adapted", "Asked", "EmulatedRobot", "RealRobot", "adapt"]
