"""An actor-critic for Stable-Baselines3 whose critic sees more than its actor (Pinto et al. 2018).

The critic is needed while training only. It may see what no robot measures (friction, true slip, contact forces), so that it
judges a situation right which the actor sees in part.
"""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from torch import nn

GROUPS = ("policy", "privileged")


class SideBySide(BaseFeaturesExtractor):
    """Both groups of the observation in one row, the policy's first."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        super().__init__(observation_space, sum(_width(observation_space, group) for group in GROUPS))

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Return the rows (N, D + P)."""
        return torch.cat([observations[group] for group in GROUPS], dim=1)


class AsymmetricNetworks(MlpExtractor):
    """Hidden layers: the actor's see the first ``seen_by_actor`` numbers of a row, the critic's see all."""

    def __init__(self, seen_by_actor: int, width: int, layers: list[int], activation: type[nn.Module], device: Any) -> None:
        super().__init__(width, {"pi": [], "vf": layers}, activation, device)
        actor = MlpExtractor(seen_by_actor, {"pi": layers, "vf": []}, activation, device)
        self.seen_by_actor = seen_by_actor
        self.policy_net, self.latent_dim_pi = actor.policy_net, actor.latent_dim_pi

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Return the actor's last hidden layer."""
        return self.policy_net(features[:, : self.seen_by_actor])


class AsymmetricPolicy(ActorCriticPolicy):
    """Stable-Baselines3's policy for observations {``policy``: (N, D), ``privileged``: (N, P)}.

    ``net_arch`` must be a list: the same hidden layers for actor and critic.
    """

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **{**keywords, "features_extractor_class": SideBySide})

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.observation_space, spaces.Dict)
        assert isinstance(self.net_arch, list)
        seen = _width(self.observation_space, "policy")
        self.mlp_extractor: AsymmetricNetworks = AsymmetricNetworks(
            seen, self.features_dim, self.net_arch, self.activation_fn, self.device
        )


def _width(space: spaces.Dict, group: str) -> int:
    shape = space[group].shape
    assert shape is not None
    return shape[0]
