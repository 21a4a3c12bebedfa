"""Hand-written controllers: readings by name, the wheel speeds of a motion, and the feedback that agents are made of.

Forward velocity v and yaw rate w are commanded, or follow from the errors of a path. A wheel y to the left of the body
origin rolls at (v - y u) / radius, where the turn u is

    u = steering * w + P (w - gyro) + I integral(w - gyro):

a skid-steered robot turns less than its wheels would, ``steering`` times less on even friction. On a path, w is the
curvature times v, minus ``heading`` times the heading error, minus ``lateral`` times the lateral error; on a slope gravity
tells which way is up. Where the forward velocity is estimated, its error is corrected likewise. Moving legs are made up for
in the wheel speeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.settings import SettingsModel, parse_config
from wlr_gym.robot import CORNER_SIGNS, LEGS, WHEELS, Robot, load_robot, robot_hash

Array = NDArray[np.float64]
#: Reads one quantity in its own unit (N,) from observations (N, D).
Reader = Callable[[NDArray[np.floating]], Array]
#: Where the wanted forward velocity stands, by task.
FORWARD = ("command[linear_velocity_x]", "speed_command", "climb_command")
ESTIMATED_FORWARD = "estimated_linear_velocity_in_body[x]"


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

    def legs(self, term: str) -> Reader:
        """Return what reads a quantity of the four legs (N, 4), zeros where the observation does not have it."""
        readers = [self.optional(f"{term}[{leg}]") for leg in LEGS]
        return lambda observations: np.stack([read(observations) for read in readers], axis=1)


class Chassis:
    """Geometry of a robot whose wheels stand in a rectangle, and its actions.

    Attributes:
        left: (4,) y of each wheel in the body frame, m.
        front: (4,) +1 for front wheels, -1 for rear ones.
    """

    def __init__(self, contract: Mapping[str, Any], robot: Robot) -> None:
        self.robot = robot
        signs = np.array(CORNER_SIGNS, np.float64)
        self.front: NDArray[np.float64] = signs[:, 0]
        self.left: NDArray[np.float64] = robot.hip_position.y * signs[:, 1]
        self._centre = np.array([column["centre"] for column in contract["action"]])
        self._scale = np.array([column["scale"] for column in contract["action"]])

    def rolling_speed(self, forward: Array, turn: Array) -> Array:
        """Return how fast each wheel moves ahead (N, 4), m/s, for forward velocities and yaw rates (N,)."""
        return forward[:, None] - turn[:, None] * self.left

    def wheel_rate(self, rolling_speed: Array, leg_angle: Array, leg_rate: Array) -> Array:
        """Return the wheel rates (N, 4) in rad/s, relative to the legs, that move the hips ahead at ``rolling_speed`` (N, 4).

        A turning leg carries its wheel along at -l sin(angle) * rate and turns it by its own rate (``wlr_gym/robot/slip.py``).
        """
        wheel, leg = self.robot.wheel.radius, self.robot.leg.length
        return (rolling_speed - leg * np.sin(leg_angle) * leg_rate) / wheel - leg_rate

    def within(self, leg_angle: Array) -> Array:
        """Return leg setpoints (N, 4), rad, as far as actions reach."""
        centre, scale = self._centre[: len(LEGS)], self._scale[: len(LEGS)]
        return np.clip(leg_angle, centre - scale, centre + scale)

    def actions(self, leg_angle: Array, wheel_rate: Array) -> NDArray[np.float32]:
        """Return the actions (N, 8) for setpoints (N, 4) in rad and (N, 4) in rad/s, clipped to [-1, 1]."""
        setpoints = np.concatenate([leg_angle, wheel_rate], axis=1)
        return np.clip((setpoints - self._centre) / self._scale, -1.0, 1.0).astype(np.float32)


class SearchConfig(SettingsModel):
    """How gains are searched (``wlr_gym/learning/tuning.py``).

    Attributes:
        steps: setting -> its first step.
        rounds: passes over the settings.
        episodes: that every candidate is scored by.
        randomization: task -> floors and robots of these episodes; a task without one has the environment's.
    """

    steps: dict[str, float] = Field(default_factory=dict)
    rounds: int = Field(default=5, gt=0)
    episodes: int = Field(default=256, gt=0)
    randomization: dict[str, Any] = Field(default_factory=dict)


class PidGains(SettingsModel):
    """Gains of the feedback; without a unit unless named.

    Attributes:
        steering: wheel speed difference over what rolling alone needs for the wanted yaw rate.
        yaw_rate_p: on the error of the gyro's yaw rate. yaw_rate_i: on its integral, 1/s.
        forward_lead, turn_lead: s by which the commanded forward velocity and yaw rate run ahead as they change: that is how
            late wheels and body follow. Up to ``integral_limit``.
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
    forward_lead: float = Field(0.0, ge=0)
    turn_lead: float = Field(0.0, ge=0)
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


class Integral:
    """Integrals of errors, of each robot, bounded.

    Args:
        gain: 1/s; the integral is of gain * error.
        period: s per reading.
        limit: bound of the integral.
    """

    def __init__(self, gain: float, period: float, limit: float) -> None:
        self.step = gain * period
        self._limit = limit
        self.value: Array = np.zeros(0)

    def add(self, error: Array) -> Array:
        """Return the integrals (N, ...) with the present errors (N, ...) in them."""
        if self.value.shape != error.shape:
            self.value = np.zeros(error.shape)
        self.value = np.clip(self.value + self.step * error, -self._limit, self._limit)
        return self.value

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the robots in ``mask`` (N,)."""
        if len(self.value) == len(mask):
            self.value[mask] = 0.0


class Pid:
    """The controller; integrals and how far the legs reach under the body are what it remembers."""

    def __init__(self, contract: Mapping[str, Any], config: PidConfig, agent: str = "pid") -> None:
        self.config = config
        self.chassis: Chassis = Chassis(contract, known_robot(contract, config.robot, agent))
        self.readings: Readings = Readings(contract, agent)
        read = self.readings
        self.forward: Reader = read.first(FORWARD)
        self.turn: Reader = read.optional("command[yaw_rate]")
        self.curvature: Reader = read.optional("path_curvature[0 m]")
        self.lateral_error: Reader = read.optional("path_error[lateral]", "course_error[lateral]")
        self.heading_error: Reader = read.optional("path_error[heading]", "course_error[heading]")
        self.gyro: Reader = read.first(("gyro[z]",))
        self.leftward_force: Reader = read.first(("accelerometer[y]",))
        self.estimated_forward: Reader | None = read.first((ESTIMATED_FORWARD,)) if ESTIMATED_FORWARD in read else None
        self.leg_offset, self.leg_rate = read.legs("leg_reference"), read.legs("leg_reference_rate")
        self.leg_angle: Reader = read.legs("leg_position")
        period = contract["control_period"]
        self._yaw_rate_integral = Integral(config.yaw_rate_i, period, config.integral_limit)
        self._velocity_integral = Integral(config.velocity_i, period, config.integral_limit)
        self._sweeping = f"leg_reference[{LEGS[0]}]" in read
        self._leg_integral = Integral(config.leg_i if self._sweeping else 0.0, period, config.integral_limit)
        self._period = period
        self._sees_legs = f"leg_position[{LEGS[0]}]" in read
        self._sent: Array = np.zeros((0, 4))
        self._commands: Array = np.zeros((2, 0))

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return actions (N, 8) for observations (N, D)."""
        forward, turn = self.motion(observations)
        without, rate = self.legs(observations)
        reach, reach_rate = self._reach_under(observations)
        legs = without + reach
        self._sent = self.chassis.within(legs) - without
        rolling = self.rolling_speed(observations, forward, turn)
        wheels = self.chassis.wheel_rate(rolling, legs, rate + reach_rate)
        return self.chassis.actions(legs + self._leg_integral.add(legs - self.leg_angle(observations)), wheels)

    def _reach_under(self, observations: NDArray[np.floating]) -> tuple[Array, Array]:
        """Return how far the legs reach under the body after this step (N, 4), rad from home, and how fast they move, rad/s."""
        config = self.config
        wanted = np.broadcast_to(config.legs_inward * self.chassis.front, (len(observations), 4))
        if config.lean_time * config.legs_inward == 0.0 or self._sweeping:
            return wanted, np.zeros(wanted.shape)
        if len(self._sent) != len(observations):
            self._sent = np.full(wanted.shape, np.nan)
        angle = self.leg_angle(observations)
        error = angle - self.chassis.robot.home.leg_angle if self._sees_legs else np.zeros(angle.shape)
        before = np.where(np.isnan(self._sent), error, self._sent)
        step = self.pace() * abs(config.legs_inward) * self._period / max(config.lean_time, self._period)
        change = np.clip(wanted - before, -step, step)
        return before + change, change / self._period

    def motion(self, observations: NDArray[np.floating]) -> tuple[Array, Array]:
        """Return the forward velocity and turn (N,) to roll at: what is wanted, with corrections."""
        config = self.config
        forward = self.forward(observations)
        turn = self.wanted_yaw_rate(observations, forward)
        lead, turn_lead = self._leads(forward, self.turn(observations))
        error = turn - self.gyro(observations)
        turn = config.steering * (turn + turn_lead) + config.yaw_rate_p * error + self._yaw_rate_integral.add(error)
        if self.estimated_forward is None:
            return forward + lead, turn
        error = forward - self.estimated_forward(observations)
        forward = forward + lead + config.velocity_p * error + self._velocity_integral.add(error)
        return forward, turn

    def _leads(self, forward: Array, turn: Array) -> Array:
        """Return by how much commanded forward velocities (N,), m/s, and yaw rates (N,), rad/s, run ahead (2, N)."""
        commands, limit = np.stack([forward, turn]), self.config.integral_limit
        before = self._commands if self._commands.shape == commands.shape else np.full(commands.shape, np.nan)
        self._commands = commands
        seconds = np.array([[self.config.forward_lead], [self.config.turn_lead]])
        change = np.where(np.isnan(before), 0.0, commands - before)
        return np.clip(seconds / self._period * change, -limit, limit)

    def wanted_yaw_rate(self, observations: NDArray[np.floating], forward: Array) -> Array:
        """Return the commanded yaw rate (N,), or the one that leads back to the path."""
        lateral, heading = self.lateral_error(observations), self.heading_error(observations)
        steer = self.curvature(observations) * forward - self.config.lateral * lateral - self.config.heading * heading
        return self.turn(observations) + steer + self.config.uphill * self.leftward_force(observations)

    def pace(self) -> Array | float:
        """Return how many times as fast as ``lean_time`` says the legs (N, 4) reach under the body."""
        return 1.0

    def legs(self, observations: NDArray[np.floating]) -> tuple[Array, Array]:
        """Return the leg setpoints (N, 4), rad, without what reaches under the body, and how fast they move, rad/s."""
        return self.chassis.robot.home.leg_angle + self.leg_offset(observations), self.leg_rate(observations)

    def rolling_speed(self, observations: NDArray[np.floating], forward: Array, turn: Array) -> Array:
        """Return how fast each wheel is to roll ahead (N, 4), m/s."""
        return self.chassis.rolling_speed(forward, turn)

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the integrals of the robots in ``mask`` (N,), and where their legs were sent."""
        self._yaw_rate_integral.reset(mask)
        self._velocity_integral.reset(mask)
        self._leg_integral.reset(mask)
        if len(self._sent) == len(mask):
            self._sent[mask] = np.nan
        if self._commands.shape[1] == len(mask):
            self._commands[:, mask] = np.nan


def task_settings(model: type[Settings], contract: Mapping[str, Any], config: Mapping[str, Any], agent: str) -> Settings:
    """Return checked settings with those of the contract's task laid over."""
    where = f"agent '{agent}'"
    general = parse_config(model, dict(config), where)
    own = general.tasks.get(contract["task"], {})
    return parse_config(model, {**config, **own}, f"{where}, task '{contract['task']}'") if own else general


# ---- with the slip observer ------------------------------------------------------------------------------------------


#: Time constants of what the warp follows: the yaw rate's error, the slip of the sides, s.
ERROR_TIME, SLIP_TIME = 0.08, 0.3
#: The sides slip unevenly where the difference over the mean (and this, m/s) exceeds so much, surely where by so much.
LEAST_SLIP, UNEVEN, UNEVEN_RANGE = 0.01, 0.9, 0.4
#: How fast the warp moves, rad/s.
WARP_RATE = 0.2


class SlipGains(PidGains):
    """Gains: those of ``pid``, and

    Attributes:
        slip_limit: of a wheel along its heading, beyond a skid turn's, m/s.
        load_shift: share of the load moved per difference of the axles' slip speeds, s/m; 0 = legs stay.
        load_shift_time: time constant of that difference, s.
        largest_shift: of the share.
        warp: largest angle by which the legs of one side lean one way and those of the other side the other, rad; 0 = never.
            Not where legs sweep.
        warp_rise: of the warp's level (0 to 1) per s and rad/s of yaw rate error beyond ``warp_threshold`` (rad/s).
        warp_forget: s in which the level falls to 1/e.
        warp_reach: legs that the warp unloads reach under the body 1 + level * warp_reach times as fast.
    """

    slip_limit: float = Field(1.0, gt=0)
    load_shift: float = Field(0.0, ge=0)
    load_shift_time: float = Field(0.5, gt=0)
    largest_shift: float = Field(0.14, ge=0, lt=0.3)
    warp: float = Field(0.0, ge=0, le=0.2)
    warp_rise: float = Field(60.0, ge=0)
    warp_threshold: float = Field(0.015, ge=0)
    warp_forget: float = Field(5.0, gt=0)
    warp_reach: float = Field(0.0, ge=0)


class SlipCompensatingConfig(SlipGains, PidConfig):
    """Settings: the gains, and those of ``pid``."""


class SlipCompensating(Pid):
    """The feedback of ``pid`` with what the slip observer knows: true forward velocity, limited slip, load where the grip is.

    Traction limiting: a wheel is asked to run at most so much faster or slower than it travels; more slip gives no more force.
    What a steady skid turn needs is allowed on top: yaw rate * reach^2 / side along the heading, see
    ``envs/tasks/terms/rewards.py``.

    Load shift: all four legs lean alike, which moves the wheels under the body. With leg angle phi, hips l_x apart and legs of
    length l the front wheels carry the share 1/2 - l cos(phi) / l_x of the body: equations (16) and (17) of the paper,
    corrected (``studies/paper/corrected.py``), for parallel legs on a level floor, their own mass neglected. Load goes to the
    axle that slips less: the smoothed difference of the axles' slip is remembered.

    Warp: where the robot turns too little and one side slips more than the other, the legs of the left lean one way and those
    of the right the other, which moves the load to one wheel diagonal. There it turns whatever the ratio of the frictions
    (docs/physics.md). Which diagonal does not matter. The level rises with the yaw rate's error and is forgotten slowly.
    """

    def __init__(self, contract: Mapping[str, Any], config: SlipCompensatingConfig) -> None:
        super().__init__(contract, config, "slip_compensating")
        self.settings = config
        self.velocity = self.readings.first((ESTIMATED_FORWARD,))
        self._slip = [self.readings.first((f"estimated_slip_velocity[{wheel},x]",)) for wheel in WHEELS]
        if self._sweeping and config.warp:
            raise InputError(f"agent 'slip_compensating': warp = {config.warp:g}: expected 0 where legs sweep")
        self._warp = Warp(config, contract["control_period"])
        self._share = min(1.0, contract["control_period"] / config.load_shift_time)
        self._difference: Array = np.zeros(0)
        hip = self.chassis.robot.hip_position
        self._reach = hip.x * hip.x / hip.y

    def rolling_speed(self, observations: NDArray[np.floating], forward: Array, turn: Array) -> Array:
        """Return how fast each wheel is to roll ahead (N, 4), m/s: as in ``pid``, within the slip limit of what it travels."""
        travel = self.chassis.rolling_speed(self.velocity(observations), self.gyro(observations))
        allowed = self.settings.slip_limit + self._reach * np.abs(turn / max(self.config.steering, 1.0))
        wanted = super().rolling_speed(observations, forward, turn)
        return np.clip(wanted, travel - allowed[:, None], travel + allowed[:, None])

    def pace(self) -> Array:
        """Return how many times as fast as ``lean_time`` says the legs (N, 4) reach under the body: those that the warp unloads
        go faster."""
        unloaded = self.chassis.front * self.chassis.left < 0
        return 1.0 + self.settings.warp_reach * self._warp.level[:, None] * unloaded

    def legs(self, observations: NDArray[np.floating]) -> tuple[Array, Array]:
        """Return the leg setpoints (N, 4), rad, and their rates, rad/s: leaning so that the load is on the axle that slips
        less, and warped."""
        home, rate = super().legs(observations)
        slip = np.abs(np.stack([read(observations) for read in self._slip], axis=1))
        difference = (slip * self.chassis.front).sum(axis=1) / 2
        if len(self._difference) != len(difference):
            self._difference = np.zeros(len(difference))
        self._difference = self._difference + self._share * (difference - self._difference)
        bound = self.settings.largest_shift
        shift = np.clip(-self.settings.load_shift * self._difference, -bound, bound)
        wanted = self.wanted_yaw_rate(observations, self.forward(observations))
        left = np.sign(self.chassis.left)
        warp, warp_rate = self._warp.follow(wanted - self.gyro(observations), slip, left)
        leaning = home + lean(self.chassis.robot, shift)[:, None]
        return leaning - warp[:, None] * left, rate - warp_rate[:, None] * left

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the robots in ``mask`` (N,)."""
        super().reset(mask)
        self._warp.reset(mask)
        known = len(self._difference) == len(mask)
        self._difference = np.where(mask, 0.0, self._difference) if known else np.zeros(len(mask))


class Warp:
    """How far the legs of N robots are warped: see :class:`SlipCompensating`.

    Attributes:
        angle: (N,) rad. level: (N,) share of the largest warp that is wanted.
    """

    def __init__(self, gains: SlipGains, period: float) -> None:
        self._gains, self._period = gains, period
        self._set(np.zeros((5, 0)))

    def _set(self, state: Array) -> None:
        self._state = state
        self.angle, self.level, self._error, self._difference, self._size = state

    def follow(self, error: Array, slip: Array, left: Array) -> tuple[Array, Array]:
        """Return the warp (N,) after this step, rad, and how fast it moves, rad/s.

        Args:
            error: wanted less measured yaw rate (N,), rad/s.
            slip: speed along the heading (N, 4), m/s. left: (4,) +1 for wheels on the left, -1 for those on the right.
        """
        gains, period = self._gains, self._period
        if self._state.shape[1] != len(error):
            self._set(np.zeros((5, len(error))))
        slow = self._error + min(period / ERROR_TIME, 1.0) * (error - self._error)
        difference = self._difference + period / SLIP_TIME * ((slip * left).sum(axis=1) / 2 - self._difference)
        size = self._size + period / SLIP_TIME * (slip.mean(axis=1) - self._size)
        uneven = np.abs(difference) / (size + LEAST_SLIP)
        split = np.clip((uneven - UNEVEN) / UNEVEN_RANGE, 0.0, 1.0)
        rise = gains.warp_rise * split * np.maximum(np.abs(slow) - gains.warp_threshold, 0.0)
        level = np.clip(self.level + period * (rise - self.level / gains.warp_forget), 0.0, 1.0)
        step = np.clip(gains.warp * level - self.angle, -WARP_RATE * period, WARP_RATE * period)
        self._set(np.stack([self.angle + step, level, slow, difference, size]))
        return self.angle, step / period

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the robots in ``mask`` (N,)."""
        if self._state.shape[1] == len(mask):
            self._state[:, mask] = 0.0


def lean(robot: Robot, shift: Array) -> Array:
    """Return by how much all legs lean back (rad) from straight down to put the share 1/2 + ``shift`` of the body in front."""
    return np.arcsin(2 * robot.hip_position.x * shift / robot.leg.length)
