"""The slip observer of a batch of robots: the robot as its filter takes it, the state that it keeps of each, the estimates."""

from __future__ import annotations

import math
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.base.snapshot import RowStore
from wlr_gym.perception.observer import slip_filter
from wlr_gym.perception.observer.slip_filter import DIRECTION_SIZE, ESTIMATE_LAYOUT
from wlr_gym.perception.observer.trust import MEMORY, WORK
from wlr_gym.physics.plants.base import SENSOR_LAYOUT
from wlr_gym.robot import CORNER_SIGNS, Robot
from wlr_gym.robot.parameter_table import SPECS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROUNDING = 12.0**-0.5  # 1 sigma of rounding to whole counts
_LEAST = 1e-4  # rad/s and m/s2; what an ideal encoder and accelerometer count as: errors are divided by


def load_trust() -> dict[str, Array]:
    """Return the shipped network of ``trust.py``: weights (outputs, inputs), and what else was learned with it."""
    with (files("wlr_gym.perception.observer") / "trust.npz").open("rb") as file, np.load(file) as data:
        return {name: data[name].astype(np.float64) for name in data.files}


def constants(robot: Robot, period: float, camera: bool) -> NDArray[np.void]:
    """Return one record (1,): the robot as its file describes it, its sensors' errors, the learned weights of ``trust.py``.

    ``period``: s between two readings. ``camera``: whether its poses are used.
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
    record = np.zeros(1, np.dtype([(name, np.float64, np.shape(value)) for name, value in values.items()]))
    for name, value in values.items():
        record[name] = value
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
        # wheels, see :func:`wlr_gym.perception.observer.slip_filter.look`
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


class SlipObserver:
    """Estimates of ``count`` robots; a robot's are the same bits alone or in any batch.

    Args:
        robot: as its file describes it; how the real one differs is what the filter's noise stands for.
        control_period: s between two readings. count: N. camera: use camera poses where the sensors bring them.

    Attributes:
        values: (N, ESTIMATE_LAYOUT.width), overwritten by ``reset`` and ``update``.
    """

    def __init__(self, robot: Robot, control_period: float, count: int, camera: bool) -> None:
        if robot.gravity == 0.0:
            raise InputError(f"robot '{robot.name}': gravity = 0: the slip observer tells the attitude by it, expected more")
        history = math.ceil(SPECS["camera.delay"].high / control_period) + 3
        self.count = count
        self.values: Array = np.zeros((count, ESTIMATE_LAYOUT.width))
        self._constants = constants(robot, control_period, camera)
        self._states = np.zeros(count, state_type(history))
        self._work = np.zeros(1, WORK)

    def reset(self, mask: Mask, sensors: Array) -> None:
        """Start the masked robots anew from their first readings (N, SENSOR_LAYOUT.width): at rest, or nearly."""
        self._require(mask, sensors)
        self._states[mask] = np.zeros((), self._states.dtype)
        slip_filter.reset(self._constants, self._states, mask, sensors, self.values)

    def update(self, mask: Mask, sensors: Array) -> None:
        """Take in the readings of one control step later of the masked robots. A reading that is no number is the last one."""
        self._require(mask, sensors)
        slip_filter.update(self._constants, self._states, mask, sensors, self.values, self._work)

    def stores(self) -> dict[str, RowStore]:
        """Return everything that decides the estimates to come."""
        return {"estimate": self.values, "filter": self._states}

    def _require(self, mask: Mask, sensors: Array) -> None:
        if mask.shape != (self.count,) or sensors.shape != (self.count, SENSOR_LAYOUT.width):
            raise InputError(
                f"observer of {self.count} robots takes a mask ({self.count},) and sensors ({self.count}, "
                f"{SENSOR_LAYOUT.width}), got {mask.shape} and {sensors.shape}"
            )
