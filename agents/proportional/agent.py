"""A controller without learning: wheel speeds by kinematics from the commanded velocity and yaw rate, legs at home.

A wheel at y to the left of the body origin rolls at (v - y w) / radius for forward velocity v and yaw rate w. The robot
turns on skids, so it turns less than that; ``steering`` and ``yaw_rate_gain`` make up for it: w is replaced by
steering * w + yaw_rate_gain * (w - measured yaw rate).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from wlr_gym.errors import InputError, unknown_name
from wlr_gym.robot import CORNER_SIGNS, load_robot, parse_config
from wlr_gym.tasks.task import robot_hash


class ProportionalConfig(BaseModel):
    """Settings: the robot whose geometry is used, and two gains without unit."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    robot: str = "nominal"
    steering: float = Field(1.0, ge=0)
    yaw_rate_gain: float = Field(0.0, ge=0)


class Proportional:
    """action = (wheel goal - centre) / scale, from the command and the gyro in the observation."""

    def __init__(self, contract: Mapping[str, Any], config: ProportionalConfig) -> None:
        robot = load_robot(config.robot)
        if robot_hash(robot) != contract["robot"]["hash"]:
            raise InputError(
                f"agent 'proportional': robot '{config.robot}' is not the environment's ('{contract['robot']['name']}')"
            )
        self.config = config
        self.forward = reader(contract, "command[linear_velocity_x]")
        self.yaw_rate = reader(contract, "command[yaw_rate]")
        self.measured_yaw_rate = reader(contract, "gyro[z]")
        self.radius = robot.wheel.radius
        self.left = robot.hip_position.y * np.array([y for _, y in CORNER_SIGNS])
        self.centre = np.array([column["centre"] for column in contract["action"][4:]])
        self.scale = np.array([column["scale"] for column in contract["action"][4:]])

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return actions (N, 8) for observations (N, D)."""
        wanted = self.yaw_rate(observations)
        turn = self.config.steering * wanted + self.config.yaw_rate_gain * (wanted - self.measured_yaw_rate(observations))
        speed = (self.forward(observations)[:, None] - turn[:, None] * self.left) / self.radius
        actions = np.zeros((len(observations), 8), dtype=np.float32)
        actions[:, 4:] = np.clip((speed - self.centre) / self.scale, -1.0, 1.0)
        return actions

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Nothing to forget."""


def reader(contract: Mapping[str, Any], name: str) -> Any:
    """Return a function that reads one quantity, in its own unit, from observations (N, D)."""
    names = [column["name"] for column in contract["observation"]]
    if name not in names:
        raise unknown_name("observation", name, names, "agent 'proportional' needs")
    index = names.index(name)
    column = contract["observation"][index]
    return lambda observations: observations[:, index].astype(np.float64) / column["scale"] + column["offset"]


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> Proportional:
    """Return the controller for an environment's contract."""
    return Proportional(contract, parse_config(ProportionalConfig, dict(config), "agent 'proportional'"))
