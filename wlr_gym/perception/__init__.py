"""Perception: what the robot knows of its motion beyond its sensors: the slip observer, markers in pictures, films."""
