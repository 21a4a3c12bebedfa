"""Slip observer: what the robot cannot measure, estimated from what it can.

Body velocity, pose, slip and load of every wheel from ``SENSOR_LAYOUT`` readings alone: encoders, wheel efforts, IMU, and the
camera where there is one. See docs/slip_observer.md.
"""

from wlr_gym.perception.observer.observer import SlipObserver
from wlr_gym.perception.observer.slip_filter import ESTIMATE_LAYOUT

__all__ = ["ESTIMATE_LAYOUT", "SlipObserver"]
