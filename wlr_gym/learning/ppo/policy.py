"""Proximal policy optimisation (Schulman et al. 2017) with Stable-Baselines3 on the native batch of robots.

Observations are normalised by the fixed scales of the task, which are part of the policy's contract: no statistics are
gathered while training, none can go missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.settings import parse_config
from wlr_gym.learning.ppo.config import PpoConfig
from wlr_gym.policy import contract_of

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
    """Return the ONNX model of the trained policy of a folder: observations (N, D) to actions (N, 8); see ``with_learner``.

    Raises:
        MissingPackageError: a package is not installed.
    """
    require_package("torch", "train")
    require_package("onnxscript", "export")
    from wlr_gym.learning.ppo.export import to_onnx, with_learner

    graph = to_onnx(actor(load_policy(folder, contract).network), len(contract["environment"]["observation"]))
    weights = saved_weights(folder)
    return with_learner(graph, {name: value for name, value in weights.items() if not name.startswith(ACTOR)})


def settings_to_start_from(source: str | Path) -> dict[str, Any]:
    """Return the settings of a fine-tuning: those of the policy's training, at the rate at which it ended.

    Raises:
        InputError: no policy there, or one that PPO did not train.
    """
    contract = contract_to_start_from(source)
    settings = dict(contract["config"])
    settings["learning_rate"] = settings.get("final_learning_rate", PpoConfig.model_fields["final_learning_rate"].default)
    settings["target_kl"] = settings.get("target_kl") or TARGET_KL
    return settings | {"teacher": None, "initial_log_std": LOG_STD, "schedule_steps": None, "residual_share": 1.0}


def with_network_of(config: PpoConfig, source: str | Path) -> PpoConfig:
    """Return settings with the network of a policy.

    Raises:
        InputError: no policy there, or one that PPO did not train.
    """
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
    from wlr_gym.learning.ppo.layers import Layered

    return network.acting_net() if isinstance(network, Layered) else network.action_net


def parse_settings(config: Mapping[str, Any]) -> PpoConfig:
    """Return the checked settings of an agent."""
    return parse_config(PpoConfig, dict(config), "agent 'ppo'")


def policy_class(config: PpoConfig, *, asymmetric: bool) -> Any:
    """Return the class of the configured network."""
    from stable_baselines3.common.policies import ActorCriticPolicy

    from wlr_gym.learning.ppo.asymmetric import AsymmetricPolicy
    from wlr_gym.learning.ppo.layers import LayeredAsymmetricPolicy, LayeredPolicy

    plain, layered = (AsymmetricPolicy, LayeredAsymmetricPolicy) if asymmetric else (ActorCriticPolicy, LayeredPolicy)
    return layered if _is_layered(config) else plain


def policy_keywords(config: PpoConfig, contract: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords that make Stable-Baselines3's network the configured one for an environment's contract."""
    from torch import nn

    activation = {"tanh": nn.Tanh, "elu": nn.ELU, "relu": nn.ReLU}[config.activation]
    keywords = {"net_arch": list(config.hidden_layers), "activation_fn": activation}
    if not _is_layered(config):
        return keywords
    from wlr_gym.learning.ppo.layers import Layers, controller_columns

    columns = () if config.residual is None else controller_columns(contract)
    return keywords | {"layers": Layers(config.normalise, columns, config.residual or 0.0, config.residual_share)}


def _is_layered(config: PpoConfig) -> bool:
    return config.normalise or config.residual is not None


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
        kind = policy_class(config, asymmetric=False)
        network = kind(observation_space, action_space, lambda _: config.learning_rate, **policy_keywords(config, contract))
    network.set_training_mode(False)
    return network
