"""The robot as the observer's filter takes it, and the state that the filter keeps of each robot."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.observer.kalman import DIRECTION_SIZE
from wlr_gym.perception.observer.trust import MEMORY, load_trust
from wlr_gym.physics.plants.base import SENSOR_LAYOUT
from wlr_gym.robot import CORNER_SIGNS, Robot

#: 1 sigma of rounding to whole counts.
_ROUNDING = 12.0**-0.5
#: rad/s and m/s2; what an ideal encoder and accelerometer count as: errors are divided by.
_LEAST = 1e-4


def constants(robot: Robot, period: float, camera: bool) -> NDArray[np.void]:
    """Return one record (1,): the robot as its file describes it, its sensors' errors, the learned weights of ``trust.py``.

    Args:
        period: s between two readings.
        camera: whether its poses are used.
    """
    sensors, flow = robot.sensors, robot.sensors.flow
    frames = max(flow.rate * period, 1.0) if flow else 1.0  # of a reading
    values: dict[str, Any] = {
        "period": period,
        "gravity": robot.gravity,
        "mass": robot.total_mass,
        "body_mass": robot.body.mass,
        "body_com": robot.body.com_offset,
        "hip": [(x * robot.hip_position.x, y * robot.hip_position.y, robot.hip_position.z) for x, y in CORNER_SIGNS],
        "leg_length": robot.leg.length,
        "leg_mass": robot.leg.mass or 0.0,
        "leg_com": robot.leg.com_along_leg,
        "wheel_mass": robot.wheel.mass or 0.0,
        "wheel_radius": robot.wheel.radius,
        "spin_inertia": robot.wheel.spin_inertia + robot.servo.wheel.armature,
        "gear_friction": robot.servo.wheel.coulomb_friction,
        "stiffness": robot.ground.normal_stiffness,
        "velocity_count": max(sensors.encoder.velocity, _LEAST),
        "lag": 1.0 / (2.0 * math.pi * sensors.imu.bandwidth * period),
        "gyro_noise": sensors.imu.gyro_noise,
        "gyro_bias": sensors.imu.gyro_bias,
        "accel_noise": sensors.imu.accel_noise,
        "accel_bias": max(sensors.imu.accel_bias, _LEAST),
        "camera": float(camera),
        "camera_noise": sensors.camera.position_noise,
        "camera_yaw_noise": sensors.camera.yaw_noise,
        "flow": sensors.has_flow,
        "lens": flow.position if flow else (0.0, 0.0, 0.0),
        "flow_noise": math.hypot(flow.noise * math.sqrt(frames), _ROUNDING) * flow.count * flow.rate / frames if flow else 0.0,
        "flow_speed_noise": flow.speed_noise / math.sqrt(frames) if flow else 0.0,
        "flow_quality": flow.quality if flow else 0.0,
        **load_trust(),
    }
    arrays = {name: np.asarray(value, dtype=np.float64) for name, value in values.items()}
    record = np.zeros(1, np.dtype([(name, np.float64, array.shape) for name, array in arrays.items()]))
    for name, array in arrays.items():
        record[name] = array
    return record


def state_type(history: int) -> np.dtype[Any]:
    """Return the type of the state of one robot; vectors along heading, left and normal unless named otherwise."""
    numbers = {
        "tick": (),
        "seen": (SENSOR_LAYOUT.width,),  # last finite readings
        # pose and motion
        "position": (2,),  # start frame
        "yaw": (),
        "pointing": (2,),  # cosine and sine of the yaw
        "turned": (),  # over the step
        "velocity": (2,),
        "leak": (2,),  # of the accelerometer, m/s2
        "guess": (),  # what the accelerometer read along the floor at first, m/s2
        "slope": (2,),  # gravity along the floor, m/s2
        "covariance": (2, DIRECTION_SIZE, DIRECTION_SIZE),
        "yaw_covariance": (3,),  # yaw, yaw with bias, bias
        "gyro_bias": (),  # about the normal
        "normal": (3,),  # of the floor, body frame
        "rate": (3,),  # body frame
        "last_rate": (3,),
        "yaw_rate": (),
        "force": (3,),  # specific, mean over the step
        "last_force": (3,),
        "demand": (),  # friction demand, smoothed
        "kick": (2,),  # acceleration along the floor over the step, m/s2
        "shaken": (),  # change of the specific force along the floor, m/s2
        "inclined": (),  # 0 to 1: what the accelerometer read at first is a slope
        "legs": (),  # rms rate of the legs, rad/s
        # camera and flow
        "anchor": (3,),  # pose of the camera's start frame in the start frame: it has been moved
        "first_off": (3,),  # by how much the first of the refused frames in a row was off, start frame
        "off": (3,),  # by how much the last refused frame was off, start frame
        "refused": (),  # s over which frames have been off by the same
        "doubt": (),  # m/s: the camera has contradicted the wheels by so much
        "frame": (3,),  # last frame's pose
        "camera_off": (),  # normalised innovation of the last frame, 0 when there has been none for a while
        "camera_rejected": (),
        "frame_time": (),  # s since the last frame
        "lens": (2,),  # true over measured flow less 1, and the flow sensor's rotation (rad)
        "reading": (2,),  # last flow reading
        "repeats": (),  # readings that were the same as the last
        "flow_error": (2,),  # m/s
        "flow_variance": (2,),
        "flow_off": (),
        "flow_rejected": (),
        "flow_refused": (),  # s
        "flow_time": (),  # s since the last reading
        # without corrections, for what the camera saw some steps ago
        "raw_velocity": (2,),  # start frame
        "raw": (history, 3),  # x, y, yaw at each step
        # wheels, see contacts.py
        "heading": (3,),  # body frame
        "left": (3,),  # body frame
        "leg": (4, 2),  # cosine and sine of the leg angles
        "point": (4, 3),
        "rolling": (4, 2),
        "lift": (4,),
        "carries": (4,),
        "load": (4,),
        "traction": (4,),
        "spin": (4,),
        # trust in the wheels, see trust.py
        "memory": (4, MEMORY),
        "last_rolling": (4, 2),
        "last_velocity": (2,),
        "trust": (4, 2),
        "lead": (4,),
        "wander": (2,),
        # scratch
        "column": (DIRECTION_SIZE,),
        "change": (DIRECTION_SIZE,),
    }
    return np.dtype([(name, np.float64, shape) for name, shape in numbers.items()])
