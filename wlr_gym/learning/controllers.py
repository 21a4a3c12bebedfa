"""The hand-written controllers as policies: the law that tasks compute, fed with what an observation says.

The law itself is :func:`wlr_gym.envs.tasks.terms.observations.feedback`, its gains are in :mod:`wlr_gym.policy.control`.
"""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.envs.tasks.signals import Signals
from wlr_gym.envs.tasks.terms.observations import LEG_MEMORY, MEMORY, WantedMotion, feedback, steer
from wlr_gym.policy.control import PidConfig, Readings, SlipCompensatingConfig, SlipGains, known_robot
from wlr_gym.robot import JOINTS, LEGS, WHEELS

#: Where the wanted forward velocity stands, by task.
FORWARD = ("command[linear_velocity_x]", "speed_command", "climb_command")
ESTIMATED_FORWARD = "estimated_linear_velocity_in_body[x]"
#: Quantity of the law -> the observation that says it; the others are 0.
_SEEN = {
    "sensors.gyro[z]": "gyro[z]",
    "sensors.accelerometer[y]": "accelerometer[y]",
    "estimate.linear_velocity_in_body[x]": ESTIMATED_FORWARD,
    **{f"estimate.slip_velocity[{wheel},x]": f"estimated_slip_velocity[{wheel},x]" for wheel in WHEELS},
    **{f"sensors.joint_position[{leg}]": f"leg_position[{leg}]" for leg in LEGS},
}
#: Of a controller that knows no slip: no limit to it.
_PID_ONLY = SlipGains.model_validate({"slip_limit": 1e9})


class Pid:
    """The controller; what the law remembers is of each robot's episode.

    Args:
        contract: of the environment.
        config: gains; without those of the slip observer, slip is not limited and load not shifted.
        agent: whose settings these are, for messages.
    """

    def __init__(self, contract: Mapping[str, Any], config: PidConfig, agent: str = "pid") -> None:
        self.config = config
        self.robot = known_robot(contract, config.robot, agent)
        self.readings: Readings = Readings(contract, agent)
        read = self.readings
        self._forward = read.first(FORWARD)
        self._turn, self._curvature = read.optional("command[yaw_rate]"), read.optional("path_curvature[0 m]")
        self._lateral = read.optional("path_error[lateral]", "course_error[lateral]")
        self._heading = read.optional("path_error[heading]", "course_error[heading]")
        self._legs = [(read.optional(f"leg_reference[{leg}]"), read.optional(f"leg_reference_rate[{leg}]")) for leg in LEGS]
        self._sweeping = f"leg_reference[{LEGS[0]}]" in read
        for needed in ("gyro[z]", "accelerometer[y]"):
            read.first((needed,))
        self._seen = {name: read.first((column,)) for name, column in _SEEN.items() if column in read}
        scales = {joint: column["scale"] for joint, column in zip(JOINTS, contract["action"], strict=True)}
        self._known: dict[str, float] = {
            "task.control_period": contract["control_period"],
            "task.action.leg_scale": scales[LEGS[0]],
            "task.action.wheel_scale": scales[WHEELS[0]],
        }
        self._known |= {f"sensors.joint_position[{leg}]": self.robot.home.leg_angle for leg in LEGS}  # where none is seen
        for name in SlipGains.model_fields:
            self._known[f"controller.{name}"] = getattr(config if hasattr(config, name) else _PID_ONLY, name)
        if ESTIMATED_FORWARD not in read:
            self._known |= {"controller.velocity_p": 0.0, "controller.velocity_i": 0.0}
        self._labels = (*JOINTS, *MEMORY, *(LEG_MEMORY if self._sweeping else ()))
        self._time: NDArray[np.float64] = np.zeros(0)
        self._memory: NDArray[np.float64] = np.zeros((0, len(self._labels)))

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return actions (N, 8) for observations (N, D)."""
        if len(self._time) != len(observations):
            self._time, self._memory = np.zeros(len(observations)), np.zeros((len(observations), len(self._labels)))
        values = self._known | {name: read(observations) for name, read in self._seen.items()} | {"time": self._time}
        values |= {f"remembered.law[{label}]": self._memory[:, k] for k, label in enumerate(self._labels)}

        def read(name: str) -> Any:
            if name.startswith("robot."):
                return attrgetter(name.removeprefix("robot."))(self.robot)
            return values.get(name, 0.0)

        signals, forward = Signals(read), self._forward(observations)
        turn = self._turn(observations) + self._curvature(observations) * forward
        turn = turn + steer(signals, self._lateral(observations), self._heading(observations))
        legs = [(offset(observations), rate(observations)) for offset, rate in self._legs]
        found = feedback(signals, "law", WantedMotion(forward, turn, legs, self._sweeping))
        self._memory = np.stack([np.broadcast_to(value, forward.shape) for value in found], axis=1)
        self._time = self._time + self._known["task.control_period"]
        return self._memory[:, : len(JOINTS)].astype(np.float32)

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the robots in ``mask`` (N,)."""
        if len(self._time) == len(mask):
            self._time[mask], self._memory[mask] = 0.0, 0.0


class SlipCompensating(Pid):
    """The feedback of ``pid`` with what the slip observer knows: true velocity, limited slip, load where the grip is."""

    def __init__(self, contract: Mapping[str, Any], config: SlipCompensatingConfig) -> None:
        super().__init__(contract, config, "slip_compensating")
        for name in (ESTIMATED_FORWARD, *(f"estimated_slip_velocity[{wheel},x]" for wheel in WHEELS)):
            self.readings.first((name,))
