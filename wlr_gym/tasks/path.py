"""WLR-Path: follow paths on the floor; data in ``configs/task/path.yaml``."""

SUMMARY = """Follow a line, an S-curve or a circle on the floor at a commanded speed, with the least lateral error.

Where the robot is against its path it knows from its own estimate: odometry and gyroscope drift as wheels slip, which turning
on skids makes them do, and the camera holds the estimate where there is one. Reward and measures use the true pose."""

#: Version of the environment id -> what changed.
HISTORY = {"v0": "first version"}
