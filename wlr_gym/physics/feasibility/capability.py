"""How fast, how steep, how hard a robot drives, turns and stands, by its masses, motors and friction."""

from __future__ import annotations

import math
from dataclasses import dataclass

from wlr_gym.physics.feasibility.stance import hip_torque, stance_of, stances
from wlr_gym.robot import Robot
from wlr_gym.robot.description import Motor


@dataclass(frozen=True)
class Capability:
    """Numbers of a robot on its own floor, in its home pose unless something else is said; see :data:`ENTRIES`."""

    total_mass: float
    com_height: float
    wheelbase: float
    track_width: float
    top_speed: float
    acceleration_of_motors: float
    acceleration_of_grip: float
    tipping_acceleration: float
    tipping_deceleration: float
    climb_of_motors: float
    climb_of_grip: float
    tipping_uphill: float
    tipping_downhill: float
    tipping_sideways: float
    turning_torque: float
    turning_rate: float
    wheel_torque: float
    holding_torque: float
    holding_torque_at_limits: float
    leg_torque: float
    leg_sag: float
    smallest_wheel_share: float
    contact_sag: float


#: Name of a number of :class:`Capability` -> unit and meaning.
ENTRIES: dict[str, tuple[str, str]] = {
    "total_mass": ("kg", "body, legs and wheels"),
    "com_height": ("m", "centre of mass above the floor"),
    "wheelbase": ("m", "front to rear wheels"),
    "track_width": ("m", "left to right wheels"),
    "top_speed": ("m/s", "level floor, full supply, against gear friction"),
    "acceleration_of_motors": ("m/s2", "from standstill, by the motors' stall torque"),
    "acceleration_of_grip": ("m/s2", "by the floor's friction"),
    "tipping_acceleration": ("m/s2", "at which the front wheels lift"),
    "tipping_deceleration": ("m/s2", "at which the rear wheels lift"),
    "climb_of_motors": ("rad", "steepest slope by the motors' stall torque"),
    "climb_of_grip": ("rad", "steepest slope by the floor's friction"),
    "tipping_uphill": ("rad", "slope, nose up, on which it tips over"),
    "tipping_downhill": ("rad", "slope, nose down, on which it tips over"),
    "tipping_sideways": ("rad", "slope across, on which it tips over"),
    "turning_torque": ("N m", "of the most loaded wheel, to turn on the spot"),
    "turning_rate": ("rad/s", "fastest turn on the spot; 0: the motors are too weak"),
    "wheel_torque": ("N m", "stall torque of a wheel less gear friction"),
    "holding_torque": ("N m", "of a leg at home, to carry the body"),
    "holding_torque_at_limits": ("N m", "of a leg, the largest of nine poses at limits and home"),
    "leg_torque": ("N m", "stall torque of a leg"),
    "leg_sag": ("rad", "angle by which the position loop gives way under the largest holding torque"),
    "smallest_wheel_share": ("-", "of the weight, on the least loaded wheel in nine poses at limits and home"),
    "contact_sag": ("m", "of the wheels' contact springs under the weight"),
}


def speed_at(motor: Motor, torque: float) -> float:
    """Return the speed (rad/s) at which a motor at full supply still gives ``torque`` (N m) beyond its friction; or 0."""
    left = motor.stall_torque - motor.coulomb_friction - torque
    return max(left, 0.0) / (motor.stall_torque / motor.no_load_speed + motor.viscous_friction)


def turning(robot: Robot, load: float) -> tuple[float, float]:
    """Return the torque (N m) of a wheel under ``load`` (N), and its path over the robot's angle (m/rad), turning on the spot.

    All wheels slip across, by x times the yaw rate; they must slip along, too, until the moments of friction balance. With the
    friction ellipse, force along N mu_x a/sqrt(1 + a^2) and across N mu_y/sqrt(1 + a^2), a = x mu_y/(y mu_x).
    """
    x, y = robot.hip_position.x, robot.hip_position.y
    mu_x, mu_y = robot.ground.mu_x, robot.ground.mu_y
    if min(mu_x, mu_y) <= 0.0:
        return 0.0, math.inf
    a = x * mu_y / (y * mu_x)
    force = load * mu_x * a / math.hypot(1.0, a)
    return force * robot.wheel.radius, y + x * a * mu_y / mu_x


def capability_of(robot: Robot) -> Capability:
    """Return what a robot can do. All its numbers must be there (:func:`wlr_gym.robot.physical_faults`)."""
    home, poses = stance_of(robot, robot.home.leg_angle), stances(robot)
    gravity, mass, radius = robot.gravity, robot.total_mass, robot.wheel.radius
    weight, motor = mass * gravity, robot.servo.wheel
    wheel_torque = motor.stall_torque - motor.coulomb_friction
    push = 4.0 * max(wheel_torque, 0.0) / radius
    moved = mass + 4.0 * (robot.wheel.spin_inertia + motor.armature) / radius**2
    torque, path = turning(robot, weight * home.largest_wheel_share)
    held = hip_torque(robot, home.front, weight * home.largest_wheel_share)
    held_at_limits = max(
        hip_torque(robot, angle, weight * share / 2.0)
        for pose in poses
        for angle, share in ((pose.front, pose.front_share), (pose.rear, 1.0 - pose.front_share))
    )
    stiffness = robot.servo.leg.kp * robot.servo.leg.stall_torque / robot.servo.supply_voltage
    return Capability(
        total_mass=mass,
        com_height=home.height,
        wheelbase=home.ahead + home.behind,
        track_width=home.left + home.right,
        top_speed=radius * speed_at(motor, 0.0),
        acceleration_of_motors=push / moved,
        acceleration_of_grip=robot.ground.mu_x * gravity,
        tipping_acceleration=gravity * home.behind / home.height,
        tipping_deceleration=gravity * home.ahead / home.height,
        climb_of_motors=math.asin(min(push / weight, 1.0)) if weight else math.pi / 2,
        climb_of_grip=math.atan(robot.ground.mu_x),
        tipping_uphill=math.atan2(home.behind, home.height),
        tipping_downhill=math.atan2(home.ahead, home.height),
        tipping_sideways=math.atan2(min(home.left, home.right), home.height),
        turning_torque=torque,
        turning_rate=radius * speed_at(motor, torque) / path,
        wheel_torque=wheel_torque,
        holding_torque=held,
        holding_torque_at_limits=held_at_limits,
        leg_torque=robot.servo.leg.stall_torque,
        leg_sag=held_at_limits / stiffness if stiffness else math.inf,
        smallest_wheel_share=min(pose.smallest_wheel_share for pose in poses),
        contact_sag=weight / (4.0 * robot.ground.normal_stiffness),
    )
