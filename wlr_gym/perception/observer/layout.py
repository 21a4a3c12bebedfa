"""What the observer says, and where it and the sensors' readings stand in their rows."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

from wlr_gym.physics.plants.base import SENSOR_LAYOUT, Channel, Layout
from wlr_gym.robot import WHEELS

_WHEEL_XY = tuple(f"{wheel},{axis}" for wheel in WHEELS for axis in ("x", "y"))

ESTIMATE_LAYOUT = Layout(
    (
        Channel("position", ("x", "y"), "m", "body origin in the start frame: the floor frame as the body stood at the reset"),
        Channel("yaw", (), "rad", "heading in the start frame, unwrapped"),
        Channel("yaw_sigma", (), "rad", "1 sigma of the yaw"),
        Channel("linear_velocity_in_body", ("x", "y"), "m/s", "of the body origin, body frame"),
        Channel("linear_velocity_sigma", ("x", "y"), "m/s", "1 sigma of the linear velocity"),
        Channel("yaw_rate", (), "rad/s", "about the floor's normal"),
        Channel("gravity_in_body", ("x", "y", "z"), "-", "direction of gravity in the body frame, unit length"),
        Channel(
            "slip_velocity", _WHEEL_XY, "m/s", "of the contact point over the floor: along the wheel's heading, along its axle"
        ),
        Channel("slip_sigma", _WHEEL_XY, "m/s", "1 sigma of the slip velocity"),
        Channel("traction_force", WHEELS, "N", "of the floor on the wheel along its heading, from the wheel's effort"),
        Channel("normal_force", WHEELS, "N", "of the floor on the wheel, from leg angles and accelerometer"),
        Channel("traction_use", WHEELS, "-", "size of the traction force over the normal force"),
        Channel("friction_demand", (), "-", "force of the floor on the whole robot: along the floor over normal to it"),
        Channel(
            "camera_innovation", (), "-", "size of the last camera frame's largest normalised innovation; 0 = no frame of late"
        ),
        Channel("camera_rejected", (), "-", "1 = the last camera frame was not believed, else 0"),
        Channel("flow_innovation", (), "-", "size of the last flow reading's larger normalised innovation; 0 = none of late"),
        Channel("flow_rejected", (), "-", "1 = the last flow reading was not believed, else 0"),
    )
)


def _starts(layout: Layout) -> Any:
    """Return the first column of each channel, by its name: a named tuple, as compiled code takes it for constants."""
    return namedtuple("Starts", layout.slices)(*(columns.start for columns in layout.slices.values()))


SENSOR, ESTIMATE = _starts(SENSOR_LAYOUT), _starts(ESTIMATE_LAYOUT)
