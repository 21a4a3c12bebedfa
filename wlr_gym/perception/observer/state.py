"""The robot as the observer's filter takes it, and the state that the filter keeps of each robot."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.observer import kalman
from wlr_gym.physics.plants.base import SENSOR_LAYOUT
from wlr_gym.robot import CORNER_SIGNS, Robot

Array = NDArray[np.float64]


class ObserverConstants(NamedTuple):
    """The robot as its file describes it, and its sensors' errors."""

    period: float
    gravity: float
    mass: float
    body_mass: float
    body_com: Array
    hip: Array
    leg_length: float
    leg_mass: float
    leg_com: float
    wheel_mass: float
    wheel_radius: float
    spin_inertia: float
    gear_friction: float
    stiffness: float
    velocity_count: float
    lag: float
    gyro_noise: float
    gyro_bias: float
    accel_noise: float
    accel_bias: float
    camera: float
    camera_noise: float
    camera_yaw_noise: float


def constants(robot: Robot, period: float, camera: bool) -> ObserverConstants:
    """Return the constants of a robot read every ``period`` s; ``camera``: whether its poses are used."""
    hip, sensors = robot.hip_position, robot.sensors
    return ObserverConstants(
        period=period,
        gravity=robot.gravity,
        mass=robot.total_mass,
        body_mass=robot.body.mass,
        body_com=np.array(robot.body.com_offset),
        hip=np.array([(x * hip.x, y * hip.y, hip.z) for x, y in CORNER_SIGNS]),
        leg_length=robot.leg.length,
        leg_mass=robot.leg.mass or 0.0,
        leg_com=robot.leg.com_along_leg,
        wheel_mass=robot.wheel.mass or 0.0,
        wheel_radius=robot.wheel.radius,
        spin_inertia=robot.wheel.spin_inertia + robot.servo.wheel.armature,
        gear_friction=robot.servo.wheel.coulomb_friction,
        stiffness=robot.ground.normal_stiffness,
        velocity_count=robot.sensors.encoder.velocity,
        lag=1.0 / (2.0 * math.pi * sensors.imu.bandwidth * period),
        gyro_noise=sensors.imu.gyro_noise,
        gyro_bias=sensors.imu.gyro_bias,
        accel_noise=sensors.imu.accel_noise,
        accel_bias=sensors.imu.accel_bias,
        camera=float(camera),
        camera_noise=sensors.camera.position_noise,
        camera_yaw_noise=sensors.camera.yaw_noise,
    )


def state_type(history: int) -> np.dtype[Any]:
    """Return the type of the state of one robot; vectors along heading, left and normal unless named otherwise."""
    numbers = {
        "tick": (),
        "seen": (SENSOR_LAYOUT.width,),  # last finite readings
        # pose and motion
        "position": (2,),  # start frame
        "yaw": (),
        "velocity": (2,),
        "leak": (2,),  # of the accelerometer, m/s2
        "slip": (2, 4),  # by how much each wheel rolls faster than the body moves, m/s
        "slope": (2,),  # gravity along the floor, m/s2
        "covariance": (2, kalman.SIZE, kalman.SIZE),
        "yaw_covariance": (3,),  # yaw, yaw with bias, bias
        "gyro_bias": (),  # about the normal
        "normal": (3,),  # of the floor, body frame
        "rate": (3,),  # body frame
        "yaw_rate": (),
        "force": (3,),  # specific, mean over the step
        "last_force": (3,),
        "demand": (),  # friction demand, smoothed
        "limit": (),  # 0 to 1: slip that all wheels share is possible
        "surprise": (2,),  # mean normalised innovation of the camera's last frames
        "doubt": (),  # 0 to 1: the camera contradicts the wheels
        "strange": (),  # camera frames far off, in a row
        # without corrections, for what the camera saw some steps ago
        "raw_velocity": (2,),  # start frame
        "raw": (history, 3),  # x, y, yaw at each step
        # wheels, see contacts.py
        "heading": (3,),  # body frame
        "left": (3,),  # body frame
        "point": (4, 3),
        "rolling": (4, 2),
        "lift": (4,),
        "carries": (4,),
        "load": (4,),
        "traction": (4,),
        "spin": (4,),
        # scratch
        "noise": (kalman.SIZE,),
        "decay": (4,),
        "column": (kalman.SIZE,),
        "change": (kalman.SIZE,),
        "grips": (4,),
        "loose": (),
        "mean_square": (),
        "weight": (4,),
        "share": (4,),
    }
    return np.dtype([(name, np.float64, shape) for name, shape in numbers.items()])
