"""Model predictive path integral control (Williams et al. 2017) on the batched engine: a reference that no robot can run.

In every control step each robot's true state is copied to a batch of imagined robots, which try random plans; the plan that
is followed is their mean, weighted by what they cost. The cost is the task's own tracking error, so that the score says what
is reachable with the robot's motors on the floors at hand, known exactly. Commands are taken to stay as they are. The
setting ``knows`` has it plan for a nominal robot or a nominal floor instead: what the knowledge of them is worth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import SettingsModel, parse_config
from wlr_gym.envs.core import Core
from wlr_gym.envs.tasks.task import scales_of
from wlr_gym.policy import make_policy
from wlr_gym.robot import FIRST_WHEEL, JOINTS
from wlr_gym.robot.parameters import ELEMENTS, Parameters

if TYPE_CHECKING:
    from wlr_gym.base.snapshot import Snapshot
    from wlr_gym.policy import Policy

Array = NDArray[np.float64]


class MppiConfig(SettingsModel):
    """Settings.

    Attributes:
        seed: of the random plans.
        samples: plans that are tried for each robot, per iteration. iterations: each begins at the last one's mean, with half
            the noise.
        horizon: control steps that are looked ahead. hold: control steps for which an action is kept.
        wheel_noise, leg_noise: 1 sigma of the random changes, in actions.
        temperature: share of the spread of the costs by which a plan may cost more and still weigh 1/e of the best.
        slip: weight of the mean slip speed (per 0.05 m/s) beside the squared tracking error.
        action_rate: weight of the squared change of the action.
        proposer: agent whose action, kept, is among the plans tried.
        knows: what has each robot's own numbers, its state apart; the rest has nominal ones, and no friction patches.
        tasks: task name -> settings that differ there. environment: keywords of the environment.
    """

    seed: int = Field(0, ge=0)
    samples: int = Field(40, ge=4)
    iterations: int = Field(2, ge=1)
    horizon: int = Field(10, ge=1)
    hold: int = Field(5, ge=1)
    wheel_noise: float = Field(0.3, gt=0)
    leg_noise: float = Field(0.05, gt=0)
    temperature: float = Field(0.03, gt=0)
    slip: float = Field(0.0, ge=0)
    action_rate: float = Field(0.02, ge=0)
    proposer: str = "slip_compensating"
    knows: tuple[Literal["robot", "floor"], ...] = ("robot", "floor")
    tasks: dict[str, dict[str, Any]] = Field(default_factory=dict)
    environment: dict[str, Any] = Field(default_factory=dict)


def parse_settings(config: Mapping[str, Any], task: str = "") -> MppiConfig:
    """Return the checked settings of the agent, with those of a task laid over them."""
    general = parse_config(MppiConfig, dict(config), "agent 'mppi'")
    return parse_config(MppiConfig, {**config, **general.tasks.get(task, {})}, f"agent 'mppi', task '{task}'")


class Mppi:
    """The planner; what it remembers is the plan of each robot."""

    def __init__(self, contract: Mapping[str, Any], config: MppiConfig) -> None:
        self.config = config
        self._proposer: Policy = make_policy(config.proposer, contract)
        self._core: Core | None = None
        self._random = np.random.default_rng(config.seed)

    def use_simulator(self, core: Core) -> None:
        """Plan for the robots of ``core``, whose true states are read in every step.

        Raises:
            InputError: robots whose state cannot be copied, or a task without limits to track within.
        """
        if not core.plant.capabilities.can_set_state:
            raise InputError(f"agent 'mppi' plans from the true state, which backend '{core.settings.backend}' does not tell")
        scales = scales_of(core.task.config)
        if not scales:
            raise InputError(f"agent 'mppi': task '{core.task.config.name}' has no limits of success to plan for")
        names = list(core.task.measures)
        self._weights = np.zeros(len(names))
        for (name, _), scale in scales.items():
            self._weights[names.index(name)] += 1.0 / (len(scales) * scale**2)
        self._core = core
        self._owner = np.repeat(np.arange(core.count), self.config.samples)
        self._imagined = _imagined(core, len(self._owner))
        self._nominal = Parameters.nominal(core.task.robot).values
        kinds = ("ground.", "patch.", "friction_map.", "wave.", "bumps.", "grid.", "piece.")
        floor = np.array([name.startswith(kinds) for name in ELEMENTS])
        self._known = np.where(floor, "floor" in self.config.knows, "robot" in self.config.knows)
        knots = -(-self.config.horizon // self.config.hold)
        self._plan = np.zeros((core.count, knots, len(JOINTS)))
        self._noise = np.full(len(JOINTS), self.config.leg_noise)
        self._noise[FIRST_WHEEL:] = self.config.wheel_noise

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the first actions (N, 8) of the plans for the robots as they are now; observations go to the proposer."""
        if self._core is None:
            raise InputError("agent 'mppi' plans on a simulator's own state: it runs in 'wlr evaluate' and nowhere else")
        config, core = self.config, self._core
        proposed = self._proposer.act(observations).astype(np.float64)
        state = self._believed(core.plant.get_state())[self._owner]
        for iteration in range(config.iterations):
            plans = self._candidates(proposed, 0.5**iteration)
            cost = self._cost(state, plans)
            spread = cost - cost.min(axis=1, keepdims=True)
            scale = config.temperature * (spread.mean(axis=1, keepdims=True) + 1e-12)
            weights = np.exp(-spread / scale)
            weights /= weights.sum(axis=1, keepdims=True)
            self._plan = np.einsum("ns,nskj->nkj", weights, plans)
        return self._plan[:, 0].astype(np.float32)

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the plans of the robots in ``mask`` (N,)."""
        self._proposer.reset(mask)
        if mask.all():
            self._random = np.random.default_rng(self.config.seed)
        if self._core is not None:
            self._plan[mask] = 0.0

    def _believed(self, state: Snapshot) -> Snapshot:
        """Return the state of robots that have nominal numbers where the planner does not know theirs."""
        parameters = np.where(self._known, state.arrays["parameters"], self._nominal)
        return replace(state, arrays={**state.arrays, "parameters": parameters})

    def _candidates(self, proposed: Array, size: float) -> Array:
        """Return plans (N, S, K, 8): that of the last step, the proposer's action kept, and random changes of both."""
        samples, (_, knots, width) = self.config.samples, self._plan.shape
        kept = np.repeat(proposed[:, None], knots, axis=1)
        plans = np.repeat(self._plan[:, None], samples, axis=1)
        plans[:, 1::4] = kept[:, None]
        noise = self._random.standard_normal((samples, knots, width)) * (size * self._noise)  # every robot tries the same
        noise[:2] = 0.0
        return np.clip(plans + noise, -1.0, 1.0)

    def _cost(self, state: Any, plans: Array) -> Array:
        """Return what the plans cost, (N, S): mean over the horizon."""
        core, imagined = self._core, self._imagined
        assert core is not None
        imagined.sensors = imagined.plant.set_state(state)
        for mine, theirs in ((imagined.command, core.command), (imagined.start, core.start), (imagined.action, core.action)):
            mine[:] = theirs[self._owner]
        flat = plans.reshape(len(self._owner), *plans.shape[2:])
        cost = np.zeros(len(flat))
        for step in range(self.config.horizon):
            imagined.episodes.steps[:] = core.episodes.steps[self._owner] + step
            imagined.try_step(flat[:, step // self.config.hold])
            cost += (imagined.measures**2) @ self._weights + 10.0 * (imagined.scores.over > 0.0).any(axis=1)
            if self.config.slip:
                slip = imagined.plant.truth()["slip_velocity"].reshape(-1, 4, 2)
                cost += self.config.slip * np.sqrt((slip**2).sum(axis=-1)).mean(axis=-1) / 0.05
            change = imagined.action - imagined.actions.previous
            cost += self.config.action_rate * (change**2).sum(axis=1)
        return (cost / self.config.horizon).reshape(plans.shape[:2])


def make_planner(contract: Mapping[str, Any], config: Mapping[str, Any]) -> Mppi:
    """Return the planner for an environment's contract: the ``make_policy`` of its agents."""
    return Mppi(contract, parse_settings(config, contract["task"]))


def _imagined(core: Core, count: int) -> Core:
    """Return a core of imagined robots with the task and plant of ``core``; nothing of theirs is observed."""
    task = core.task.config.model_dump(mode="json", exclude_none=True)
    task |= {"observations": {"last_action": {}}, "scaling": {}}  # its numbers are those of the robot at hand already
    return Core(task, replace(core.settings, task=None, observation="policy"), count)
