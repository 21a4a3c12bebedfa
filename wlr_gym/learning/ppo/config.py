"""Settings of PPO training (``configs/agent/ppo*.yaml``)."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, PositiveInt, model_validator

from wlr_gym.base.seeds import LARGEST_SEED
from wlr_gym.base.settings import SettingsModel
from wlr_gym.robot import LEGS, WHEELS


class PpoConfig(SettingsModel):
    """Proximal policy optimisation on one native batch of robots.

    Attributes:
        seed: of weights, exploration, minibatches and episodes; the same seed gives the same run bit for bit.
        total_steps: environment steps of all robots together.
        schedule_steps: steps over which the learning rate falls; it stays where it ended after that. None = ``total_steps``.
        num_envs, steps_per_env: robots, and environment steps of each, per update.
        batch_size: samples per gradient step. Small ones cap the speed: the optimiser, not the physics, takes the time.
        epochs: passes over the samples of an update.
        learning_rate, final_learning_rate, learning_rate_falls: Adam's, over the training. Once little exploration noise is
            left, a small step of the weights is a large one of the policy: then it should have fallen far.
        gamma, gae_lambda, clip_range, entropy_coefficient, value_coefficient, max_gradient_norm: as in Stable-Baselines3.
        target_kl: end the passes of an update early beyond 1.5 times this divergence; None = never.
        desired_kl: divergence of an update by which the learning rate adapts: lowered above twice of it, raised below half.
            None = the rate falls as ``final_learning_rate`` says.
        hidden_layers, activation: of the networks of policy and value, which share nothing.
        normalise: bring the observations to mean 0 and deviation 1, as the untrained policy meets them, inside the network.
        residual: the network's output times this is added to the action of the task's ``controller``; None = no controller.
        residual_share: how much of the residual the finished policy adds; all of it in training. Less than 1 shrinks what is
            one seed's own more than what all seeds learn.
        mirror: learn from the left-right mirror image of every other sample.
        initial_log_std: logarithm of the exploration noise at the start, in actions: of all joints, or of (legs, wheels).
        teacher: agent whose actions the actor learns before PPO starts (``warm_start.py``); None = from nothing.
        evaluate_every: environment steps between scores on held-out episodes (``held_out.py``); 0 = never.
        evaluation_episodes: how many these are.
        checkpoint_every: environment steps between checkpoints.
        keep_checkpoints: how many of the newest stay.
        torch_threads: more than 1 was slower on busy machines, and changes the last bits.
        environment: keywords of the environment (precision, randomization, task, ...).
        tasks: task name -> settings that differ there (``load_agent_config`` lays them over the others).
    """

    seed: int = Field(0, ge=0, le=LARGEST_SEED)
    total_steps: int = Field(5_000_000, gt=0)
    schedule_steps: int | None = Field(None, gt=0)
    num_envs: int = Field(512, gt=0)
    steps_per_env: int = Field(32, gt=1)
    batch_size: int = Field(4096, gt=1)
    epochs: int = Field(5, gt=0)
    learning_rate: float = Field(1e-3, gt=0)
    final_learning_rate: float = Field(1e-4, gt=0)
    learning_rate_falls: Literal["linearly", "exponentially"] = "linearly"
    gamma: float = Field(0.99, gt=0, lt=1)
    gae_lambda: float = Field(0.95, ge=0, le=1)
    clip_range: float = Field(0.2, gt=0)
    entropy_coefficient: float = Field(0.0, ge=0)
    value_coefficient: float = Field(0.5, ge=0)
    max_gradient_norm: float = Field(0.5, gt=0)
    target_kl: float | None = Field(None, gt=0)
    desired_kl: float | None = Field(None, gt=0)
    normalise: bool = False
    residual: float | None = Field(None, gt=0)
    residual_share: float = Field(1.0, gt=0, le=1)
    mirror: bool = False
    hidden_layers: tuple[PositiveInt, ...] = (64, 64)
    activation: Literal["tanh", "elu", "relu"] = "tanh"
    initial_log_std: float | tuple[float, float] = 0.0
    teacher: str | None = None
    evaluate_every: int = Field(500_000, ge=0)
    evaluation_episodes: int = Field(64, gt=0)
    checkpoint_every: int = Field(1_000_000, gt=0)
    keep_checkpoints: int = Field(3, gt=0)
    torch_threads: int = Field(1, gt=0)
    environment: dict[str, Any] = Field(default_factory=dict)
    tasks: dict[str, dict[str, Any]] = Field(default_factory=dict)

    def initial_log_stds(self) -> tuple[float, ...]:
        """Return the logarithm of the exploration noise of each joint at the start."""
        given = self.initial_log_std
        legs, wheels = given if isinstance(given, tuple) else (given, given)
        return (legs,) * len(LEGS) + (wheels,) * len(WHEELS)

    @model_validator(mode="after")
    def _whole_batches(self) -> PpoConfig:
        if self.num_envs * self.steps_per_env % self.batch_size:
            raise ValueError(
                f"batch_size {self.batch_size} does not divide num_envs * steps_per_env = {self.num_envs * self.steps_per_env}"
            )
        return self
