"""Proximal policy optimisation (Schulman et al. 2017): its settings, its policies, and their ONNX graphs.

Observations are normalised by the fixed scales of the task, which are part of the policy's contract: no statistics are
gathered while training, none can go missing. Nothing here imports torch before a policy is made.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from wlr_gym.base.errors import LARGEST_SEED, InputError, require_package
from wlr_gym.base.settings import SettingsModel, parse_config
from wlr_gym.policy import contract_of
from wlr_gym.robot import LEGS, WHEELS

if TYPE_CHECKING:
    import torch


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
        residual: the network's output times this is added to the action of the task's ``controller``: of all joints, or of
            (legs, wheels); None = no controller.
        residual_share: how much of the residual the finished policy adds; all of it in training. Less than 1 shrinks what is
            one seed's own more than what all seeds learn.
        mirror: learn from the left-right mirror image of every other sample.
        initial_log_std: logarithm of the exploration noise at the start, in actions: of all joints, or of (legs, wheels).
        teacher: agent whose actions the actor learns before PPO starts (``warm_start.py``); None = from nothing.
        evaluate_every: environment steps between scores on held-out episodes (``training.py``); 0 = never.
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
    residual: PositiveFloat | tuple[PositiveFloat, PositiveFloat] | None = None
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

    @model_validator(mode="after")
    def _whole_batches(self) -> PpoConfig:
        if self.num_envs * self.steps_per_env % self.batch_size:
            raise ValueError(
                f"batch_size {self.batch_size} does not divide num_envs * steps_per_env = {self.num_envs * self.steps_per_env}"
            )
        return self


# ---- policies --------------------------------------------------------------------------------------------------------

MODEL_FILE = "model.zip"
#: Settings that make the network.
NETWORK = ("hidden_layers", "activation", "normalise", "residual")
#: Logarithm of the exploration noise of a start from a file without a critic, which does not say that of each joint either.
#: The mean over joints of what shipped ones had in the end, e**-3.5, costs 5 % of the reward on the legs.
LOG_STD = -4.6
#: Divergence that ends the passes of an update early, where little noise makes a small step of the weights a large one.
TARGET_KL = 0.02
#: Weights that act; the others belong to the critic or to exploration.
ACTOR = ("mlp_extractor.policy_net.", "action_net.")


class ModulePolicy:
    """A torch module, observations (N, D) to actions (N, 8), as a policy."""

    def __init__(self, module: Any) -> None:
        import torch

        self._module, self._torch = module, torch

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return actions (N, 8) for observations (N, D)."""
        with self._torch.no_grad():
            return self._module(self._torch.as_tensor(np.asarray(observations, dtype=np.float32))).numpy()

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Nothing to forget: the network has no memory."""


class PpoPolicy(ModulePolicy):
    """The mean action of a network, clipped to [-1, 1]."""

    def __init__(self, network: Any) -> None:
        super().__init__(actor(network))
        self.network = network


def make_policy(contract: Mapping[str, Any], config: Mapping[str, Any]) -> PpoPolicy:
    """Return the policy before training: the network as the seed of ``config`` initialises it."""
    return PpoPolicy(_network(contract, parse_settings(config)))


def load_policy(folder: Path, contract: Mapping[str, Any]) -> PpoPolicy:
    """Return the trained policy of a folder; ``contract`` is the content of its ``contract.json``.

    Raises:
        InputError: the model file is absent, broken, or of another network.
    """
    network = _network(contract["environment"], parse_settings(contract["config"]))
    try:
        load_actor(network, saved_weights(folder))
    except Exception as error:  # zip, pickle and torch each raise their own kinds for a broken file
        raise InputError(f"{folder / MODEL_FILE}: not a readable model: {error}") from None
    return PpoPolicy(network)


def saved_weights(folder: Path) -> Mapping[str, Any]:
    """Return the weights of the whole network in a policy folder, by their names."""
    from stable_baselines3.common.save_util import load_from_zip_file

    return load_from_zip_file(folder / MODEL_FILE, device="cpu", load_data=False)[1]["policy"]  # type: ignore[return-value]


def export_network(folder: Path, contract: Mapping[str, Any]) -> bytes:
    """Return the ONNX model of the trained policy of a folder: observations (N, D) to actions (N, 8); see ``with_learner``."""
    require_package("torch", "train")
    require_package("onnxscript", "export")

    graph = to_onnx(actor(load_policy(folder, contract).network), len(contract["environment"]["observation"]))
    weights = saved_weights(folder)
    return with_learner(graph, {name: value for name, value in weights.items() if not name.startswith(ACTOR)})


def settings_to_start_from(source: str | Path) -> dict[str, Any]:
    """Return the settings of a fine-tuning: those of the policy's training, at the rate at which it ended."""
    contract = contract_to_start_from(source)
    settings = dict(contract["config"])
    settings["learning_rate"] = settings.get("final_learning_rate", PpoConfig.model_fields["final_learning_rate"].default)
    settings["target_kl"] = settings.get("target_kl") or TARGET_KL
    return settings | {"teacher": None, "initial_log_std": LOG_STD, "schedule_steps": None, "residual_share": 1.0}


def with_network_of(config: PpoConfig, source: str | Path) -> PpoConfig:
    """Return settings with the network of a policy."""
    own = contract_to_start_from(source)["config"]
    return parse_settings({**config.model_dump(), **{name: own[name] for name in NETWORK if name in own}})


def contract_to_start_from(source: str | Path) -> Mapping[str, Any]:
    """Return the contract of a policy that PPO trained.

    Raises:
        InputError: no policy there, or one that PPO did not train.
    """
    contract = contract_of(source)
    if contract["agent"] != "ppo":
        raise InputError(f"'{source}' is of agent '{contract['agent']}': expected a policy that PPO trained")
    return contract


def load_actor(network: Any, saved: Mapping[str, Any]) -> None:
    """Put the weights that act into a network; the critic may see what is not in the contract, and stays as it is.

    Raises:
        RuntimeError: other weights, or of other shapes, than the network has.
    """
    acting = {name: value for name, value in saved.items() if name.startswith(ACTOR)}
    own = network.state_dict()
    network.load_state_dict({name: value for name, value in own.items() if not name.startswith(ACTOR)} | acting, strict=True)


def actor(network: Any) -> Any:
    """Return the part of a network that acts, as a torch module: observations (N, D) to actions (N, 8) clipped to [-1, 1]."""
    from torch import nn

    return nn.Sequential(network.mlp_extractor.policy_net, acting_net(network), nn.Hardtanh(-1.0, 1.0))


def acting_net(network: Any) -> Any:
    """Return the last layer of a network as the finished policy has it."""
    from wlr_gym.learning.ppo.networks import LayeredPolicy

    return network.acting_net() if isinstance(network, LayeredPolicy) else network.action_net


def parse_settings(config: Mapping[str, Any]) -> PpoConfig:
    """Return the checked settings of an agent."""
    return parse_config(PpoConfig, dict(config), "agent 'ppo'")


def each_joint(given: float | tuple[float, float]) -> tuple[float, ...]:
    """Return a setting of all joints, or of (legs, wheels), joint by joint."""
    legs, wheels = given if isinstance(given, tuple) else (given, given)
    return (legs,) * len(LEGS) + (wheels,) * len(WHEELS)


def network_kind(config: PpoConfig, contract: Mapping[str, Any], *, asymmetric: bool = False) -> tuple[Any, dict[str, Any]]:
    """Return the class of the configured network for an environment's contract, and the keywords that make it."""
    from stable_baselines3.common.policies import ActorCriticPolicy
    from torch import nn

    from wlr_gym.learning.ppo import networks

    activation = {"tanh": nn.Tanh, "elu": nn.ELU, "relu": nn.ReLU}[config.activation]
    keywords: dict[str, Any] = {"net_arch": list(config.hidden_layers), "activation_fn": activation}
    if not config.normalise and config.residual is None:
        return networks.AsymmetricPolicy if asymmetric else ActorCriticPolicy, keywords
    columns = () if config.residual is None else networks.controller_columns(contract)
    residual = () if config.residual is None else each_joint(config.residual)
    layers = networks.Layers(config.normalise, columns, residual, config.residual_share)
    return networks.LayeredAsymmetricPolicy if asymmetric else networks.LayeredPolicy, keywords | {"layers": layers}


def _network(contract: Mapping[str, Any], config: PpoConfig) -> Any:
    """Return the network PPO starts with for these settings, in evaluation mode; leaves the global random state alone."""
    require_package("torch", "train")
    require_package("stable_baselines3", "train")
    import torch
    from gymnasium import spaces

    high = np.array([column["scale"] * column["limit"] for column in contract["observation"]], dtype=np.float32)
    observation_space = spaces.Box(-high, high, dtype=np.float32)
    action_space = spaces.Box(-1.0, 1.0, (len(contract["action"]),), dtype=np.float32)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        kind, keywords = network_kind(config, contract)
        network = kind(observation_space, action_space, lambda _: config.learning_rate, **keywords)
    network.set_training_mode(False)
    return network


# ---- the ONNX graph: the mean action, clipped ------------------------------------------------------------------------

#: Before the names of weights that do not act.
LEARNER = "learner."


def to_onnx(actor: torch.nn.Module, width: int) -> bytes:
    """Return a serialised ONNX model: ``observation`` (N, width) to ``action``, N free, nothing else in it.

    Args:
        actor: maps observations to actions, both float32.
        width: of the observation.
    """
    import torch

    robots = torch.export.Dim("robots")
    with _quiet():
        program = torch.onnx.export(
            actor.eval(),
            (torch.zeros(2, width),),
            dynamo=True,
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes=({0: robots},),
            external_data=False,
            verbose=False,
        )
    assert program is not None
    model: Any = program.model_proto
    graph = model.graph
    # Without what the exporter notes about itself: source files, stack traces, intermediate shapes.
    del model.metadata_props[:], graph.metadata_props[:], graph.value_info[:]
    for part in [*graph.node, *graph.input, *graph.output, *graph.initializer]:
        part.doc_string = ""
        del part.metadata_props[:]
    return model.SerializeToString(deterministic=True)


def with_learner(graph: bytes, weights: Mapping[str, torch.Tensor]) -> bytes:
    """Return an ONNX model that also holds what only a training needs: critic and exploration noise, beside the graph.

    Args:
        graph: serialised model. weights: those that do not act, by their names in the network.
    """
    import onnx
    from onnx import numpy_helper

    model = onnx.load_from_string(graph)
    for name, value in weights.items():
        model.graph.initializer.append(numpy_helper.from_array(value.numpy(), LEARNER + name))
    return model.SerializeToString(deterministic=True)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's warnings about packages that are not installed and its own deprecated calls."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
