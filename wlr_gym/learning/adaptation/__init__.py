"""Adaptation of a policy to a robot: drive, find what the model lacks, train on with it, test, drive again; docs/adapt.md."""

from wlr_gym.learning.adaptation.adapt import Adapted, adapt
from wlr_gym.learning.adaptation.plan import Asked
from wlr_gym.learning.adaptation.robots import EmulatedRobot, RealRobot

__all__ = ["Adapted", "Asked", "EmulatedRobot", "RealRobot", "adapt"]
