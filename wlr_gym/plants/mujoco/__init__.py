"""MuJoCo as an independent second opinion: the same robot and parameters as an ``MjModel``."""
