"""WLR-Slope: climb a slope, then hold; data in ``configs/task/slope.yaml``."""

SUMMARY = """Climb a slope at a commanded speed, straight on, then hold.

Friction and slope are drawn together: the slope is 1.5 to 12 degrees less than the steepest one that the floor's friction could
hold, atan(mu). The world frame is the floor's; it is gravity that leans. Near the limit every wheel must carry its share:
wheels that spin, or fight each other, use up what holds the robot."""

#: Version of the environment id -> what changed.
HISTORY = {"v0": "first version"}
