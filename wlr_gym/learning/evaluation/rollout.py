"""Play whole episodes, all at once as one batch, and keep what the score card needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_number
from wlr_gym.robot import Robot

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.physics.plants.base import Truth
    from wlr_gym.policy import Policy

Array = NDArray[np.float64]
#: Share of the supply voltage, or of the stall torque, from which a motor counts as saturated.
SATURATED = 0.98


@dataclass(frozen=True)
class Measure:
    """One number per environment step that says how well the task is done.

    Attributes:
        name, unit, doc: what it is.
        rms, max: largest root mean square and largest magnitude over an episode that still count as a success; None = any.
        scale: root mean square that counts as 1 in the tracking error; None = ``rms``.
    """

    name: str
    unit: str
    doc: str
    rms: float | None = None
    max: float | None = None
    scale: float | None = None


@dataclass(frozen=True)
class Rollout:
    """Episodes of N robots over at most T environment steps. Signals of a robot count where ``active`` says so.

    Attributes:
        control_period: s.
        seeds: (N,) seed of each episode.
        measures: what the task measures itself by; see :class:`Measure`.
        active: (T, N) the robot's episode had not ended before this step.
        fell: (N,) a termination term ended the episode. succeeded: (N,) as the task defines it.
        reward: (T, N).
        measured: (T, N, M) the task's measures.
        action: (T, N, 8) in [-1, 1].
        command: (T, N, C) what the robot had to follow in this step; SI units.
        position: (T, N, 2) body origin in the floor frame, m.
        forward_velocity: (T, N) of the body origin along the body's x, m/s. yaw_rate: (T, N) rad/s.
        slip_velocity: (T, N, 4, 2) mean over the step, along each wheel's heading and axle, m/s.
        load: (T, N, 4) normal force of each wheel, N.
        excess_slip: (T, N) mean slip speed of the wheels beyond what a steady skid turn needs, as the reward ``slip``, m/s.
        energy: (T, N) drawn from the supply, J; braking counts as negative.
        saturated: (T, N, 8) the motor was at its voltage or torque limit.
        friction: (N, 4, 2) coefficients at each wheel, along heading and axle, in the first step.
        sampled: (K,) parameter elements that randomisation draws. samples: (N, K) their values at the start.
        parameters: (N, P) the whole parameter table at the start. start: (N, S) the state the episodes began from.
    """

    control_period: float
    seeds: NDArray[np.int64]
    measures: tuple[Measure, ...]
    active: NDArray[np.bool_]
    fell: NDArray[np.bool_]
    succeeded: NDArray[np.bool_]
    reward: Array
    measured: Array
    action: Array
    command: Array
    position: Array
    forward_velocity: Array
    yaw_rate: Array
    slip_velocity: Array
    load: Array
    excess_slip: Array
    energy: Array
    saturated: NDArray[np.bool_]
    friction: Array
    sampled: tuple[str, ...]
    samples: Array
    parameters: Array
    start: Array

    @property
    def episodes(self) -> int:
        """Number of episodes N."""
        return self.active.shape[1]


def make_core(environment: str, episodes: int, keywords: Mapping[str, Any]) -> Core:
    """Return the batched core of an environment with one robot per episode."""
    from wlr_gym.envs.core import Core
    from wlr_gym.envs.registry import task_source_of
    from wlr_gym.envs.settings import read_settings

    check_number("episodes", episodes, least=1)
    return Core(task_source_of(environment), read_settings(keywords), episodes)


def start_episodes(core: Core, policy: Policy, first_seed: int, options: Mapping[str, Any] | None = None) -> None:
    """Begin an episode with every robot of ``core``, robot i with seed ``first_seed + i``; the policy forgets the past."""
    for row in range(core.count):
        core.seed(row, first_seed + row)
    core.begin_episodes(core.everyone, options)
    policy.reset(core.everyone)


def seen_observations(core: Core, policy: Policy, seconds: float) -> NDArray[np.float32]:
    """Return the observations (M, D) of all robots of ``core`` while a policy drives them for so long, or until they end."""
    start_episodes(core, policy, 0)
    active, seen = core.everyone.copy(), []
    for _ in range(round(seconds / core.task.config.control_period)):
        if not active.any():
            break
        seen.append(core.observation[active])
        core.step(policy.act(core.observation), active)
        active &= ~(core.terminated | core.truncated)
    return np.concatenate(seen)


def roll_out(
    core: Core,
    policy: Policy,
    first_seed: int = 0,
    on_tick: Callable[[], object] | None = None,
    on_start: Callable[[], object] | None = None,
    parameters: Mapping[str, float] | None = None,
    commands: Mapping[str, float] | None = None,
) -> Rollout:
    """Play one episode per robot of ``core``; robot i has seed ``first_seed + i``. Deterministic.

    Args:
        core: batch of robots; nothing of its past matters.
        policy: what drives them.
        first_seed: seed of the first episode.
        on_tick: called after every environment step (progress bars, logs).
        on_start: called once when the episodes have begun.
        parameters: values set after randomisation and effects, the same for all episodes.
        commands: commands held through all episodes; the others are drawn.

    Raises:
        InputError: a real robot.
    """
    from wlr_gym.envs.interfaces import Infos

    if not core.plant.capabilities.has_truth:
        raise InputError(f"backend '{core.settings.backend}' has no truth to score by; to drive the robot: wlr deploy")
    start_episodes(core, policy, first_seed, {"parameters": dict(parameters or {}), "command": dict(commands or {})})
    table = core.parameters.values.copy()
    start = np.concatenate([v.reshape(core.count, -1) for v in vars(core.state).values() if v is not None], axis=1)
    if on_start is not None:
        on_start()
    active = core.everyone.copy()
    excess_slip = excess_slip_of(core)
    ticks: list[dict[str, NDArray]] = []
    while active.any():
        command = core.command.copy()
        core.step(policy.act(core.observation), active)
        ticks.append(_signals(core) | {"command": command, "active": active.copy(), "excess_slip": excess_slip()})
        active &= ~(core.terminated | core.truncated)
        if on_tick is not None:
            on_tick()
    stacked = {name: np.stack([tick[name] for tick in ticks]) for name in ticks[0]}
    friction = stacked.pop("friction")[0]
    return Rollout(
        control_period=core.task.config.control_period,
        seeds=first_seed + np.arange(core.count),
        measures=measures_of(core),
        fell=core.terminated.copy(),
        succeeded=Infos(core).succeeded(),
        friction=friction,
        sampled=core.randomization.elements,
        samples=table[:, core.randomization.columns],
        parameters=table,
        start=start,
        **stacked,
    )


def _signals(core: Core) -> dict[str, NDArray]:
    truth = core.plant.truth()
    shape = (core.count, 4, 2)
    return {
        "reward": core.reward.copy(),
        "measured": core.measures.copy(),
        "action": core.action.copy(),
        "position": truth["position"][:, :2].copy(),
        "forward_velocity": truth["linear_velocity_in_body"][:, 0].copy(),
        "yaw_rate": truth["angular_velocity_in_body"][:, 2].copy(),
        "slip_velocity": truth["slip_displacement"].reshape(shape) / core.task.config.control_period,
        "load": truth["contact_force"].reshape(core.count, 4, 3)[..., 2].copy(),
        "energy": truth["electrical_energy"].copy(),
        "saturated": saturated(truth, core.task.robot),
        "friction": truth["effective_friction"].reshape(shape).copy(),
    }


def measures_of(core: Core) -> tuple[Measure, ...]:
    """Return the measures of a core's task."""
    from wlr_gym.envs.tasks.terms import MEASURES

    limits = {name: chosen.model_dump() for name, chosen in core.task.config.success.items()}
    return tuple(Measure(name, MEASURES[name].unit, MEASURES[name].doc, **limits.get(name, {})) for name in core.task.measures)


def excess_slip_of(core: Core) -> Callable[[], Array]:
    """Return a function that returns the mean slip speed (N,) of the wheels beyond what a steady skid turn needs, m/s.

    It is what the reward term ``slip`` counts in the last step, whether the task has that term or not.
    """
    from wlr_gym.envs.tasks.compiled_terms import reader
    from wlr_gym.envs.tasks.signals import Signals
    from wlr_gym.envs.tasks.terms import REWARDS

    matrices: dict[str, Array] = {}
    signals = Signals(reader(core.task, matrices))

    def excess_slip() -> Array:
        matrices["truth"] = core.plant.truth().values
        return REWARDS["slip"].function(signals, speed=1.0)

    return excess_slip


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
