"""What a network has besides its hidden layers: inputs brought to one scale, and a controller that it acts on top of.

All of it is part of the network, of its file and of its ONNX graph.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks.terms import CONTROLLER
from wlr_gym.learning.ppo.asymmetric import AsymmetricPolicy
from wlr_gym.robot import JOINTS

#: Normalised observations are clipped to this many standard deviations.
LIMIT = 10.0
#: Smallest standard deviation that counts: what hardly changed while it was gathered is left near its own scale.
LEAST = 0.02


@dataclass(frozen=True)
class Layers:
    """What a network has besides its hidden layers.

    Attributes:
        normalise: observations to mean 0 and standard deviation 1.
        controller: columns of the observation with the controller's action; empty = none.
        residual: what the network adds to it is its output times this.
        residual_share: of that, how much the finished policy adds.
    """

    normalise: bool = False
    controller: tuple[int, ...] = ()
    residual: float = 0.0
    residual_share: float = 1.0


def controller_columns(contract: Mapping[str, Any]) -> tuple[int, ...]:
    """Return where a contract's observation holds the controller's action, in the order of the joints.

    Raises:
        InputError: it holds none.
    """
    names = {column["name"]: index for index, column in enumerate(contract["observation"]) if column["lag"] == 0}
    terms = {name.partition("[")[0] for name in names if name.partition("[")[0].endswith(CONTROLLER)}
    if len(terms) != 1:
        task = contract["task"]
        raise InputError(
            f"agent 'ppo': setting 'residual' needs one observation with a controller's action, found {len(terms)}; "
            f"expected environment.task.observations.{task}{CONTROLLER} and environment.task.controller"
        )
    (term,) = terms
    return tuple(names[f"{term}[{joint}]"] for joint in JOINTS)


class Normaliser(nn.Module):
    """``(x - mean) / deviation``, clipped; mean 0 and deviation 1 until :meth:`take`."""

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("deviation", torch.ones(width))

    def take(self, rows: torch.Tensor) -> None:
        """Take mean and deviation of observations (M, D)."""
        self.mean.copy_(rows.mean(dim=0))
        self.deviation.copy_(rows.std(dim=0).clamp_min(LEAST))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the rows (N, D) normalised."""
        return torch.clamp((x - self.mean) / self.deviation, -LIMIT, LIMIT)


class BesideController(nn.Module):
    """The last hidden layer of the actor, and the controller's action beside it."""

    def __init__(self, hidden: nn.Module, columns: Sequence[int]) -> None:
        super().__init__()
        self.hidden = hidden
        self.columns = list(columns)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the rows (N, H + 8)."""
        return torch.cat([self.hidden(x), x[:, self.columns]], dim=1)


class OnTop(nn.Module):
    """The controller's action plus ``residual`` times what the network adds."""

    def __init__(self, last: nn.Linear, residual: float) -> None:
        super().__init__()
        self.last = last
        self.residual = residual

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the mean actions (N, 8)."""
        width = self.last.in_features
        return x[:, width:] + self.residual * self.last(x[:, :width])


class Layered(ActorCriticPolicy):
    """Stable-Baselines3's policy with :class:`Layers`."""

    def __init__(self, *arguments: Any, layers: Layers = Layers(), **keywords: Any) -> None:
        self.layers = layers
        super().__init__(*arguments, **keywords)

    def acting_net(self) -> nn.Module:
        """Return the last layer of the finished policy; it has the weights of the one that learns."""
        last: Any = self.action_net
        return OnTop(last.last, last.residual * self.layers.residual_share) if self.layers.controller else last

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        networks: Any = self.mlp_extractor
        layers = self.layers
        if layers.normalise:
            seen = getattr(networks, "seen_by_actor", self.features_dim)
            networks.policy_net = nn.Sequential(Normaliser(seen), networks.policy_net)
            networks.value_net = nn.Sequential(Normaliser(self.features_dim), networks.value_net)
        if layers.controller:
            networks.policy_net = BesideController(networks.policy_net, layers.controller)
            last: Any = self.action_net
            nn.init.zeros_(last.weight)  # at the start the network adds nothing
            nn.init.zeros_(last.bias)
            self.action_net: nn.Module = OnTop(last, layers.residual)
        keywords: dict[str, Any] = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **keywords)


class LayeredPolicy(Layered):
    """For plain observations (N, D)."""


class LayeredAsymmetricPolicy(Layered, AsymmetricPolicy):
    """For observations {``policy``: (N, D), ``privileged``: (N, P)}."""


def scale_residual(network: Any, factor: float) -> None:
    """Multiply what a network adds to the controller's action; without a controller nothing changes."""
    if factor != 1.0 and isinstance(network.action_net, OnTop):
        with torch.no_grad():
            for weights in network.action_net.last.parameters():
                weights.mul_(factor)


def normalisers(network: nn.Module) -> list[Normaliser]:
    """Return the normalisers of a network."""
    return [part for part in network.modules() if isinstance(part, Normaliser)]
