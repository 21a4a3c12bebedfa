"""Hand-written controllers: their gains and settings, and what reads an observation by name.

The law is :func:`wlr_gym.envs.tasks.terms.observations.feedback`; :mod:`wlr_gym.learning.controllers` makes policies of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.settings import SettingsModel, parse_config
from wlr_gym.robot import Robot, load_robot, robot_hash

Array = NDArray[np.float64]
#: Reads one quantity in its own unit (N,) from observations (N, D).
Reader = Callable[[NDArray[np.floating]], Array]


def known_robot(contract: Mapping[str, Any], name: str | None, agent: str) -> Robot:
    """Return the robot whose numbers a controller uses: the environment's, as its contract describes it.

    Args:
        contract: of the environment.
        name: robot that the settings name; None = any.
        agent: whose settings, for messages.

    Raises:
        InputError: the settings name another one, or an older contract names one that it does not describe.
    """
    robot = load_robot(contract["robot"].get("description") or name or "nominal")
    named = robot if name is None else load_robot(name)
    if robot_hash(robot) != contract["robot"]["hash"] or robot_hash(named) != robot_hash(robot):
        raise InputError(f"agent '{agent}': robot '{named.name}' is not the environment's ('{contract['robot']['name']}')")
    return robot


class Readings:
    """Quantities of an observation by their names in the contract; of a term with a history, the newest reading.

    Args:
        contract: of the environment.
        agent: who reads, for messages.
    """

    def __init__(self, contract: Mapping[str, Any], agent: str) -> None:
        numbered = enumerate(contract["observation"])
        self.columns: dict[Any, tuple[int, Any]] = {
            column["name"]: (index, column) for index, column in numbered if column["lag"] == 0
        }
        self.agent = agent

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def first(self, names: Sequence[str]) -> Reader:
        """Return what reads the first of ``names`` that the observation has.

        Raises:
            InputError: it has none of them; names the nearest.
        """
        found = [name for name in names if name in self.columns]
        if not found:
            raise unknown_name("observation", names[0], list(self.columns), f"agent '{self.agent}' needs")
        index, column = self.columns[found[0]]
        scale, offset = column["scale"], column["offset"]
        return lambda observations: observations[:, index].astype(np.float64) / scale + offset

    def optional(self, *names: str) -> Reader:
        """Return what reads the first of ``names`` that the observation has, zeros where it has none."""
        known = any(name in self.columns for name in names)
        return self.first(names) if known else lambda observations: np.zeros(len(observations))


class SearchConfig(SettingsModel):
    """How gains are searched (``wlr_gym/learning/tuning.py``).

    Attributes:
        steps: setting -> its first step.
        rounds: passes over the settings.
        episodes: that every candidate is scored by.
    """

    steps: dict[str, float] = Field(default_factory=dict)
    rounds: int = Field(default=5, gt=0)
    episodes: int = Field(default=256, gt=0)


class PidGains(SettingsModel):
    """Gains of the feedback; without a unit unless named.

    Attributes:
        steering: wheel speed difference over what rolling alone needs for the wanted yaw rate.
        yaw_rate_p: on the error of the gyro's yaw rate. yaw_rate_i: on its integral, 1/s.
        velocity_p: on the error of the estimated forward velocity. velocity_i: on its integral, 1/s.
        lateral: yaw rate per lateral error, rad/(m s). heading: yaw rate per heading error, 1/s.
        uphill: yaw rate per specific force to the left, rad s/m: turns the robot uphill on a slope.
        legs_inward: rad by which the legs reach under the body: a shorter wheelbase turns with less slip.
        lean_time: s for a way of ``legs_inward``: so fast, evenly, legs go there from where they stand when an episode begins.
            At once, they jerk the body. 0 = at once, as always where legs sweep or ``legs_inward`` is 0.
        leg_i: on the integral of the error of a leg's measured angle, 1/s: servos give way to loads. Only where legs sweep.
        integral_limit: bound of the corrections by integrals, m/s, rad/s and rad.
    """

    steering: float = Field(1.0, ge=0)
    yaw_rate_p: float = Field(0.0, ge=0)
    yaw_rate_i: float = Field(0.0, ge=0)
    velocity_p: float = Field(0.0, ge=0)
    velocity_i: float = Field(0.0, ge=0)
    lateral: float = Field(0.0, ge=0)
    heading: float = Field(0.0, ge=0)
    uphill: float = Field(0.0, ge=0)
    legs_inward: float = Field(0.0, ge=-0.4, le=0.4)
    lean_time: float = Field(0.0, ge=0)
    leg_i: float = Field(0.0, ge=0)
    integral_limit: float = Field(0.2, gt=0)


class PidConfig(PidGains):
    """Settings: the gains, and

    Attributes:
        robot: whose geometry is used; None = the environment's. Another one than the environment's is refused.
        tasks: task name -> settings that differ there.
        environment: keywords of the environment.
        seed: of the first episode of the search. search: how it is made.
    """

    robot: str | None = None
    tasks: dict[str, dict[str, float]] = Field(default_factory=dict)
    environment: dict[str, Any] = Field(default_factory=dict)
    seed: int = Field(0, ge=0)
    search: SearchConfig = Field(default_factory=SearchConfig)


Settings = TypeVar("Settings", bound=PidConfig)


def task_settings(model: type[Settings], contract: Mapping[str, Any], config: Mapping[str, Any], agent: str) -> Settings:
    """Return checked settings with those of the contract's task laid over."""
    where = f"agent '{agent}'"
    general = parse_config(model, dict(config), where)
    own = general.tasks.get(contract["task"], {})
    return parse_config(model, {**config, **own}, f"{where}, task '{contract['task']}'") if own else general


# ---- with the slip observer ------------------------------------------------------------------------------------------


class SlipGains(PidGains):
    """Gains: those of ``pid``, and

    Attributes:
        slip_limit: of a wheel along its heading, beyond a skid turn's, m/s.
        load_shift: share of the load moved per difference of the axles' slip speeds, s/m; 0 = legs stay.
        load_shift_time: time constant of that difference, s.
        largest_shift: of the share.
    """

    slip_limit: float = Field(1.0, gt=0)
    load_shift: float = Field(0.0, ge=0)
    load_shift_time: float = Field(0.5, gt=0)
    largest_shift: float = Field(0.14, ge=0, lt=0.3)


class SlipCompensatingConfig(SlipGains, PidConfig):
    """Settings: the gains, and those of ``pid``."""
