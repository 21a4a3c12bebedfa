"""WLR-Velocity: follow commands of forward velocity and yaw rate; data in ``configs/task/velocity.yaml``."""

SUMMARY = """Follow commands of forward velocity and yaw rate that change a few times within an episode.

The robot turns on skids, so it cannot turn without slip; what it can learn is to slip no more than the turn needs, on
floors from slippery to grippy, which it must tell apart from wheel speeds, motor currents and the IMU."""

#: Version of the environment id -> what changed.
HISTORY = {"v0": "first version"}
