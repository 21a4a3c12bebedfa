"""A kinematic robot that obeys the Plant contract: wheels reach their goal speed at once and roll without slip.

``fall_at`` (s) tips the robot over, so that tests can have terminations when they want them.
"""

from __future__ import annotations

import numpy as np

from wlr_gym.physics.plants.base import (
    SENSOR_LAYOUT,
    TRUTH_LAYOUT,
    Capabilities,
    PlantOptions,
    Sensors,
    Truth,
    check_setpoints,
    standing_state,
)
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters


class FakePlant:
    capabilities = Capabilities("fake", has_truth=True, can_set_state=True, real_time=False)

    def __init__(self, robot=None, count=1, options=None, fall_at=np.inf):
        self.robot = robot or load_robot()
        self.options = options or PlantOptions()
        self.count = count
        self.fall_at = fall_at
        self.setpoints_seen = []
        self.parameters = Parameters.nominal(self.robot, count)
        self._seeds = np.zeros(count, np.uint64)
        self._ticks = np.zeros(count, np.int64)
        self._sensors = Sensors(np.zeros((count, SENSOR_LAYOUT.width)))
        self._truth = Truth(np.zeros((count, TRUTH_LAYOUT.width)))
        self.reset(parameters=self.parameters)

    def reset(self, seeds=None, parameters=None, mask=None, state=None):
        rows = np.arange(self.count) if mask is None else np.flatnonzero(mask)
        if seeds is not None:
            self._seeds[rows] = seeds[rows]
        if parameters is not None:
            self.set_parameters(parameters, mask)
        start = standing_state(self.robot, self.parameters) if state is None else state
        self._ticks[rows] = 0
        self._truth.values[rows] = 0.0
        for name in ("position", "quaternion", "linear_velocity_in_body", "angular_velocity_in_body", "joint_position"):
            self._truth[name][rows] = getattr(start, name)[rows]
        self._publish(rows)
        return self._sensors

    def set_parameters(self, parameters, mask=None):
        rows = np.arange(self.count) if mask is None else np.flatnonzero(mask)
        chosen = Parameters(parameters.values[rows])
        chosen.validate()
        self.parameters.values[rows] = chosen.values

    def step(self, setpoints, torque_on=None):
        setpoints = check_setpoints(setpoints if torque_on is None else np.where(torque_on, setpoints, 0.0), self.count)
        self.setpoints_seen.append(setpoints.copy())
        on = np.ones_like(setpoints) if torque_on is None else np.asarray(torque_on, float)
        period, truth = self.options.control_period, self._truth
        self._ticks += 1
        speed = setpoints[:, 4:] * on[:, 4:]
        ground = speed * self.parameters["wheel.radius"]
        truth["joint_velocity"][:, 4:] = speed
        truth["joint_position"][:, :4] = setpoints[:, :4]
        truth["joint_position"][:, 4:] += speed * period
        truth["linear_velocity_in_body"][:, 0] = ground.mean(axis=1)
        truth["angular_velocity_in_body"][:, 2] = (ground[:, 1] + ground[:, 3] - ground[:, 0] - ground[:, 2]) / 0.64
        truth["position"][:, 0] += truth["linear_velocity_in_body"][:, 0] * period
        truth["electrical_energy"][:] = 0.01 * np.abs(speed).sum(axis=1)
        truth["slip_displacement"][:] = 1e-4
        fallen = self._ticks * period >= self.fall_at
        truth["quaternion"][fallen] = [np.cos(0.6), np.sin(0.6), 0.0, 0.0]
        self._publish(np.arange(self.count))
        return self._sensors

    def _publish(self, rows):
        truth, sensors = self._truth, self._sensors
        sensors.values[rows] = 0.0
        truth["body_clearance"][rows] = 0.1
        truth["effective_friction"][rows, 0::2] = self.parameters["ground.mu_x"][rows]
        truth["effective_friction"][rows, 1::2] = self.parameters["ground.mu_y"][rows]
        sensors["joint_position"][rows] = truth["joint_position"][rows]
        sensors["joint_velocity"][rows] = truth["joint_velocity"][rows]
        sensors["gyro"][rows] = truth["angular_velocity_in_body"][rows]
        sensors["accelerometer"][rows] = [0.0, 0.0, 9.81]
        sensors["supply_voltage"][rows] = 12.0
        if self.options.sensor_noise:
            noise = 0.7548 * (self._seeds[rows, None] % np.uint64(10007)) + 0.5698 * self._ticks[rows, None]
            sensors.values[rows] += 0.04 * ((noise + 0.618 * np.arange(SENSOR_LAYOUT.width)) % 1.0 - 0.5)

    def truth(self):
        return self._truth

    def mechanical_state(self):
        return standing_state(self.robot, self.parameters)

    def close(self):
        pass
