"""Robots of other programs' files: a tree of links and joints, what of it a robot file can hold, and URDF. No simulator.

MJCF is read and written by :mod:`wlr_gym.physics.plants.mujoco.mjcf`: MuJoCo's own compiler knows what such a file means.
"""

from wlr_gym.robot.interchange.recognition import (
    ImportedRobot,
    JointMapping,
    LinkJoint,
    LinkShape,
    LinkTree,
    Placement,
    RigidLink,
    recognise,
)
from wlr_gym.robot.interchange.urdf import parse_urdf, urdf_text

__all__ = [
    "ImportedRobot",
    "JointMapping",
    "LinkJoint",
    "LinkShape",
    "LinkTree",
    "Placement",
    "RigidLink",
    "parse_urdf",
    "recognise",
    "urdf_text",
]
