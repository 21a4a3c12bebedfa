"""What a robot can do by closed-form mechanics, and which of its numbers are odd. No simulator runs here."""

from wlr_gym.physics.feasibility.capability import ENTRIES, Capability, capability_of
from wlr_gym.physics.feasibility.examination import examine_robot
from wlr_gym.physics.feasibility.findings import RobotFinding
from wlr_gym.physics.feasibility.plausibility import unusual
from wlr_gym.physics.feasibility.stance import Stance, stance_of, stances

__all__ = [
    "ENTRIES",
    "Capability",
    "RobotFinding",
    "Stance",
    "capability_of",
    "examine_robot",
    "stance_of",
    "stances",
    "unusual",
]
