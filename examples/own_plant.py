"""A plant of one's own: wheels that roll without slip, joints that follow their setpoints: ``python examples/own_plant.py``.

``backend="rolling"`` names it. It has no snapshots (``can_set_state=False``): those need ``mechanical_state``, ``get_state``,
``set_state``.
"""

import gymnasium as gym
import numpy as np

import wlr_gym  # noqa: F401  (registers the environments)
from wlr_gym.physics.plants import BACKENDS
from wlr_gym.physics.plants.base import (
    SENSOR_LAYOUT,
    TRUTH_LAYOUT,
    Capabilities,
    PlantOptions,
    Sensors,
    Truth,
    check_setpoints,
    hold_where_off,
    standing_state,
)  # fmt: skip
from wlr_gym.robot.parameters import Parameters

BACKENDS["rolling"] = "own_plant:RollingPlant"  # a module that can be imported, and its class


class RollingPlant:
    capabilities = Capabilities("rolling", has_truth=True, can_set_state=False, real_time=False)

    def __init__(self, robot, count=1, options=None):
        self.robot, self.count, self.options = robot, count, options or PlantOptions()
        self.parameters = Parameters.nominal(robot, count)
        self._truth = Truth(np.zeros((count, TRUTH_LAYOUT.width)))
        self._sensors = Sensors(np.zeros((count, SENSOR_LAYOUT.width)))
        self._yaw = np.zeros(count)
        self.reset()

    def reset(self, seeds=None, parameters=None, mask=None, state=None):
        rows = slice(None) if mask is None else np.flatnonzero(mask)
        if parameters is not None:
            self.parameters.values[rows] = parameters.values[rows]
        start = standing_state(self.robot, self.parameters) if state is None else state
        for name in ("position", "quaternion", "joint_position"):
            self._truth[name][rows] = getattr(start, name)[rows]
        w, _, _, z = start.quaternion.T
        self._yaw[rows] = 2.0 * np.arctan2(z, w)[rows]
        self._move(np.zeros((self.count, 8)))
        return self._sensors

    def step(self, setpoints, torque_on=None):
        setpoints = check_setpoints(setpoints, self.count)
        angles = self._truth.joint_position
        present = np.hstack([angles[:, :4], np.zeros((self.count, 4))])
        if torque_on is not None:
            setpoints = hold_where_off(setpoints, torque_on, present)
        rates = setpoints.copy()
        rates[:, :4] = (setpoints[:, :4] - present[:, :4]) / self.options.control_period
        self._move(rates)
        return self._sensors

    def _move(self, rates):
        """Go on for one tick at these joint rates (N, 8)."""
        truth, sensors, period = self._truth, self._sensors, self.options.control_period
        rolled = rates[:, 4:] * self.parameters["wheel.radius"]
        left, right = rolled[:, 0::2].mean(axis=1), rolled[:, 1::2].mean(axis=1)
        forward, yaw_rate = 0.5 * (left + right), 0.5 * (right - left) / self.robot.hip_position.y
        truth.position[:, 0] += period * forward * np.cos(self._yaw)
        truth.position[:, 1] += period * forward * np.sin(self._yaw)
        self._yaw += period * yaw_rate
        truth.quaternion[:, 0], truth.quaternion[:, 3] = np.cos(0.5 * self._yaw), np.sin(0.5 * self._yaw)
        truth.joint_position[:] += period * rates
        truth.joint_velocity[:] = rates
        truth.linear_velocity_in_body[:, 0], truth.angular_velocity_in_body[:, 2] = forward, yaw_rate
        truth["body_clearance"][:] = truth.position[:, 2] - 0.5 * self.robot.body.size[2]
        sensors.joint_position[:], sensors.joint_velocity[:] = truth.joint_position, rates
        sensors.gyro[:, 2], sensors.accelerometer[:, 2] = yaw_rate, self.robot.gravity
        sensors["supply_voltage"][:] = self.robot.servo.supply_voltage
        sensors.camera_pose[:] = np.column_stack([truth.position[:, :2], self._yaw])
        sensors["camera_is_new"][:] = 1.0

    def set_parameters(self, parameters, mask=None):
        rows = slice(None) if mask is None else np.flatnonzero(mask)
        self.parameters.values[rows] = parameters.values[rows]

    def truth(self):
        return self._truth

    def close(self):
        pass


def main() -> None:
    """Drive a second at 3 rad/s: 0.102 m with a radius of 0.034 m."""
    env = gym.make("WLR-Velocity-v0", backend="rolling", randomization="none")
    env.reset(seed=0)
    for _ in range(50):
        env.step(np.array([0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5], dtype=np.float32))
    travelled = env.get_wrapper_attr("core").plant.truth().position[0, 0]
    print(f"travelled: {travelled:.3f} m")
    env.close()


if __name__ == "__main__":
    main()
