"""Play whole episodes, all at once as one batch, and keep what the score card and the plots need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.errors import InputError
from wlr_gym.robot import Robot

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.plants.base import Truth
    from wlr_gym.policy import Policy

Array = NDArray[np.float64]
#: Share of the supply voltage, or of the stall torque, from which a motor counts as saturated.
SATURATED = 0.98


@dataclass(frozen=True)
class Rollout:
    """Episodes of N robots over at most T control ticks. Signals of a robot count where ``active`` says so.

    Attributes:
        control_period: s.
        seeds: (N,) seed of each episode.
        command_names: names of the commands, such as ``linear_velocity_x``.
        active: (T, N) the robot's episode was still going on in this tick.
        fell: (N,) a termination term ended the episode.
        reward: (T, N).
        command: (T, N, C) what the robot was asked to follow in this tick; SI units.
        position: (T, N, 2) body origin in the floor frame, m. yaw: (T, N) rad.
        forward_velocity: (T, N) of the body origin along the body's x, m/s. yaw_rate: (T, N) rad/s.
        slip_velocity: (T, N, 4, 2) mean over the tick, along each wheel's heading and axle, m/s.
        energy: (T, N) drawn from the supply, J; braking counts as negative.
        saturated: (T, N, 8) the motor was at its voltage or torque limit.
        friction: (N, 4, 2) coefficients at each wheel, along heading and axle, in the first tick.
        sampled: (K,) parameter elements that randomisation draws. samples: (N, K) their values at the start.
    """

    control_period: float
    seeds: NDArray[np.int64]
    command_names: tuple[str, ...]
    active: NDArray[np.bool_]
    fell: NDArray[np.bool_]
    reward: Array
    command: Array
    position: Array
    yaw: Array
    forward_velocity: Array
    yaw_rate: Array
    slip_velocity: Array
    energy: Array
    saturated: NDArray[np.bool_]
    friction: Array
    sampled: tuple[str, ...]
    samples: Array

    @property
    def episodes(self) -> int:
        """Number of episodes N."""
        return self.active.shape[1]

    def commanded(self, name: str) -> Array:
        """Return one command, (T, N)."""
        return self.command[:, :, self.command_names.index(name)]


def make_core(environment: str, episodes: int, keywords: Mapping[str, Any]) -> Core:
    """Return the batched core of an environment with one robot per episode.

    Raises:
        InputError: unknown environment or keyword.
    """
    from wlr_gym.envs.core import Core
    from wlr_gym.envs.registry import task_name_of
    from wlr_gym.envs.settings import read_settings

    if episodes < 1:
        raise InputError(f"episodes = {episodes}: expected 1 or more")
    return Core(task_name_of(environment), read_settings(keywords), episodes)


def roll_out(
    core: Core,
    policy: Policy,
    first_seed: int = 0,
    on_tick: Callable[[], object] | None = None,
    on_start: Callable[[], object] | None = None,
) -> Rollout:
    """Play one episode per robot of ``core``; robot i has seed ``first_seed + i``. Deterministic.

    Args:
        core: batch of robots; nothing of its past matters.
        policy: what drives them.
        first_seed: seed of the first episode.
        on_tick: called after every control tick (progress bars, logs).
        on_start: called once when the episodes have begun.

    Raises:
        InputError: a real robot.
    """
    if not core.plant.capabilities.has_truth:
        raise InputError(f"backend '{core.settings.backend}' has no truth to score by; to drive the robot: wlr deploy")
    seeds = first_seed + np.arange(core.count)
    for row, seed in enumerate(seeds.tolist()):
        core.seed(row, seed)
    core.begin_episodes(core.everyone)
    samples = core.parameters.values[:, core.randomization.columns]
    policy.reset(core.everyone)
    if on_start is not None:
        on_start()
    active = core.everyone.copy()
    ticks: list[dict[str, NDArray]] = []
    while active.any():
        command = core.command.copy()
        core.step(policy.act(core.observation), active)
        ticks.append(_signals(core) | {"command": command, "active": active.copy()})
        active &= ~(core.terminated | core.truncated)
        if on_tick is not None:
            on_tick()
    stacked = {name: np.stack([tick[name] for tick in ticks]) for name in ticks[0]}
    friction = stacked.pop("friction")[0]
    return Rollout(
        control_period=core.task.config.control_period,
        seeds=seeds,
        command_names=core.task.commands,
        fell=core.terminated.copy(),
        friction=friction,
        sampled=core.randomization.elements,
        samples=samples,
        **stacked,
    )


def _signals(core: Core) -> dict[str, NDArray]:
    truth = core.plant.truth()
    shape = (core.count, 4, 2)
    return {
        "reward": core.reward.copy(),
        "position": truth["position"][:, :2].copy(),
        "yaw": yaw_of(truth["quaternion"]),
        "forward_velocity": truth["linear_velocity_in_body"][:, 0].copy(),
        "yaw_rate": truth["angular_velocity_in_body"][:, 2].copy(),
        "slip_velocity": truth["slip_displacement"].reshape(shape) / core.task.config.control_period,
        "energy": truth["electrical_energy"].copy(),
        "saturated": saturated(truth, core.task.robot),
        "friction": truth["effective_friction"].reshape(shape).copy(),
    }


def yaw_of(quaternion: Array) -> Array:
    """Return the heading of the body's x axis in the floor (rad) for quaternions (N, 4) as (w, x, y, z)."""
    w, x, y, z = quaternion.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def saturated(truth: Truth, robot: Robot) -> NDArray[np.bool_]:
    """Return which motors (N, 8) are at their limit: supply voltage, or stall torque.

    DC motor at its output shaft: voltage / supply = torque / stall torque + speed / no-load speed.
    """
    legs, wheels = robot.servo.leg, robot.servo.wheel
    stall = np.repeat([legs.stall_torque, wheels.stall_torque], 4)
    no_load = np.repeat([legs.no_load_speed, wheels.no_load_speed], 4)
    torque = truth["motor_torque"] / stall
    voltage = torque + truth["joint_velocity"] / no_load
    return (np.abs(voltage) >= SATURATED) | (np.abs(torque) >= SATURATED)
