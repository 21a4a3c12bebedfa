"""Robots of other programs' files: a tree of links and joints, what of it a robot file can hold, and URDF. No simulator.

MJCF is read and written by :mod:`wlr_gym.physics.plants.mujoco.mjcf`: MuJoCo's own compiler knows what such a file means.
"""
