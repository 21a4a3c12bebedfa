"""The robot at rest on a level floor with its legs at given angles: where it stands, and what each wheel and leg carries.

Front legs share one angle, rear legs another; the body pitches until all wheels touch the floor. Contacts are rigid.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from wlr_gym.robot import Robot


@dataclass(frozen=True)
class Stance:
    """One pose.

    Attributes:
        front, rear: angles of the front and rear legs, rad.
        pitch: of the body, right-handed about +y (positive: nose down), rad.
        height: of the centre of mass of the whole robot above the floor, m.
        clearance: of the lowest corner of the body above the floor, m; below 0 the body lies on it.
        ahead, behind: distance along the floor from the centre of mass to the front and rear wheels' contacts, m; negative: the
            centre of mass is beyond them.
        left, right: the same across, m.
    """

    front: float
    rear: float
    pitch: float
    height: float
    clearance: float
    ahead: float
    behind: float
    left: float
    right: float

    @property
    def front_share(self) -> float:
        """Part of the weight that the front wheels carry; the rear wheels carry the rest."""
        return self.behind / (self.ahead + self.behind)

    @property
    def largest_wheel_share(self) -> float:
        """Part of the weight on the wheel that carries most."""
        across = max(self.left, self.right) / (self.left + self.right)
        return max(self.front_share, 1.0 - self.front_share) * across

    @property
    def smallest_wheel_share(self) -> float:
        """Part of the weight on the wheel that carries least; negative: the robot tips over."""
        across = min(self.left, self.right) / (self.left + self.right)
        along = min(self.front_share, 1.0 - self.front_share)
        return along * across if min(along, across) >= 0.0 else min(along, across)


def stance_of(robot: Robot, front: float, rear: float | None = None) -> Stance:
    """Return the pose with the legs at angles ``front`` and ``rear`` (rad); None: as the front ones."""
    rear = front if rear is None else rear
    hip, leg, wheel = robot.hip_position, robot.leg, robot.wheel
    leg_mass, wheel_mass = leg.mass or 0.0, wheel.mass or 0.0
    axles, legs = [], []
    for side, angle in ((1.0, front), (-1.0, rear)):
        direction = np.array([math.cos(angle), -math.sin(angle)])
        axles.append(np.array([side * hip.x, hip.z]) + leg.length * direction)
        legs.append(np.array([side * hip.x, hip.z]) + leg.com_along_leg * direction)
    x, y, z = robot.body.com_offset
    moment = robot.body.mass * np.array([x, z])
    for leg_com, axle in zip(legs, axles, strict=True):
        moment = moment + 2.0 * (leg_mass * leg_com + wheel_mass * axle)
    com = moment / robot.total_mass
    base = axles[0] - axles[1]
    span = float(np.hypot(*base))
    along = base / span if span else np.array([1.0, 0.0])
    up = np.array([-along[1], along[0]])
    behind = float((com - axles[1]) @ along)
    across = robot.body.mass * y / robot.total_mass
    corners = itertools.product(*((-size / 2, size / 2) for size in (robot.body.size[0], robot.body.size[2])))
    return Stance(
        front=front,
        rear=rear,
        pitch=math.atan2(along[1], along[0]),
        height=float((com - axles[1]) @ up) + wheel.radius,
        clearance=min(float((np.array(corner) - axles[1]) @ up) for corner in corners) + wheel.radius,
        ahead=span - behind,
        behind=behind,
        left=hip.y - across,
        right=hip.y + across,
    )


def stances(robot: Robot) -> list[Stance]:
    """Return the nine poses with front and rear legs at their lower limit, at home and at their upper limit."""
    angles = (robot.leg_limits[0], robot.home.leg_angle, robot.leg_limits[1])
    return [stance_of(robot, front, rear) for front, rear in itertools.product(angles, angles)]


def hip_torque(robot: Robot, angle: float, load: float) -> float:
    """Return the torque (N m) about a hip that holds its leg at an angle (rad) under a load (N) on its wheel.

    Leg and wheel hang on the hip; the floor's friction is 0.
    """
    leg, wheel = robot.leg, robot.wheel
    own = robot.gravity * ((leg.mass or 0.0) * leg.com_along_leg + (wheel.mass or 0.0) * leg.length)
    return abs(math.cos(angle)) * abs(load * leg.length - own)
