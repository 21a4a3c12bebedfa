"""What PPO has beyond Stable-Baselines3's own, and all private names of it that this needs: what a new version may break.

- A critic that sees more than its actor (Pinto et al. 2018). It is needed while training only, and may see what no robot
  measures (friction, true slip, contact forces): so it judges a situation right which the actor sees in part.
- Inputs brought to one scale, and a controller that the network acts on top of: part of its file and of its ONNX graph.
- Samples that are seen in the left-right mirror.
- A place in a training that can be read and set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor
from torch import nn
from torch.utils.tensorboard import SummaryWriter

from wlr_gym.base.errors import InputError
from wlr_gym.envs.sb3 import Sb3VecEnv
from wlr_gym.envs.tasks.describe import column_name
from wlr_gym.envs.tasks.terms import CONTROLLER
from wlr_gym.robot import JOINTS

if TYPE_CHECKING:
    from stable_baselines3 import PPO

GROUPS = ("policy", "privileged")


def grouped(observation: Any) -> dict[str, NDArray[np.float32]]:
    """Return observations by group; plain ones are those of ``policy``."""
    return dict(observation) if isinstance(observation, dict) else {"policy": observation}


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
        self.mlp_extractor = AsymmetricNetworks(seen, self.features_dim, self.net_arch, self.activation_fn, self.device)


def _width(space: spaces.Dict, group: str) -> int:
    shape = space[group].shape
    assert shape is not None
    return shape[0]


# ---- inputs of one scale, and a controller below ---------------------------------------------------------------------

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
        residual: what the network adds to it is its output times this, action by action; empty = no controller.
        residual_share: of that, how much the finished policy adds.
    """

    normalise: bool = False
    controller: tuple[int, ...] = ()
    residual: tuple[float, ...] = ()
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
    """The controller's action plus ``residual`` (8,) times what the network adds."""

    residual: torch.Tensor

    def __init__(self, last: nn.Linear, residual: torch.Tensor) -> None:
        super().__init__()
        self.last = last
        self.register_buffer("residual", residual, persistent=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the mean actions (N, 8)."""
        width = self.last.in_features
        return x[:, width:] + self.residual * self.last(x[:, :width])


class LayeredPolicy(ActorCriticPolicy):
    """Stable-Baselines3's policy with :class:`Layers`, for plain observations (N, D)."""

    def __init__(self, *arguments: Any, layers: Layers = Layers(), **keywords: Any) -> None:
        self.layers = layers
        super().__init__(*arguments, **keywords)

    def acting_net(self) -> nn.Module:
        """Return the last layer of the finished policy; it has the weights of the one that learns."""
        last: Any = self.action_net
        return OnTop(last.last, last.residual * self.layers.residual_share) if self.layers.controller else last

    def _build(self, lr_schedule: Any) -> None:
        """Make the networks; put the normalisers before them, and the controller behind the actor's."""
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
            self.action_net: nn.Module = OnTop(last, torch.tensor(layers.residual))
        keywords: dict[str, Any] = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **keywords)


class LayeredAsymmetricPolicy(LayeredPolicy, AsymmetricPolicy):
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


# ---- left and right --------------------------------------------------------------------------------------------------
# The robot is symmetric about its x-z plane. So an experience that is mirrored is one that it might have had: legs and wheels
# swap sides, velocities and forces along y change their sign, rotations about x and z too (Mittal et al. 2024).


#: Terms whose numbers have no direction, whatever their labels say.
_UNSIGNED = ("_sigma", "effective_friction", "_quality", "_age", "_present", "_is_new", "friction_demand")
#: Terms that are rotations: those about x and z change sign, those about y do not.
_ROTATIONS = ("gyro", "angular_velocity_in_body", "quaternion")
#: Labels and terms that are positive to the left.
_LEFTWARD = {
    "yaw", "yaw_rate", "lateral", "heading", "y", "yaw_rate_integral", "path_curvature", "path_offset", "path_heading",
    "estimated_yaw", "estimated_yaw_rate", "camera_yaw", "warp", "yaw_rate_error", "side_difference", "turn",
}  # fmt: skip
#: Labels and terms that the mirror leaves as they are.
_SAME = {
    "x", "z", "w", "linear_velocity_x", "velocity_integral", "slip_difference", "speed_command", "climb_command",
    "body_clearance", "supply_voltage", "leg_rate", "path_shape", "path_wavelength", "climb_speed", "climb_time",
    "warp_level", "slip_size", "forward",
    "front_leg_first", "front_leg_second", "rear_leg_first", "rear_leg_second", "mechanical_energy", "electrical_energy",
}  # fmt: skip
_SIDES = {"_lf": "_rf", "_rf": "_lf", "_lr": "_rr", "_rr": "_lr"}


@dataclass(frozen=True)
class Mirror:
    """``mirrored[..., k] = sign[k] * row[..., source[k]]``."""

    source: NDArray[np.intp]
    sign: NDArray[np.float32]

    def of(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the mirror image of rows (N, D)."""
        return rows[..., self.source] * self.sign


def mirror_of(names: Sequence[str]) -> Mirror:
    """Return the mirror image of numbers by their names: ``wheel_velocity[wheel_lf]``, or joints' plain names.

    Args:
        names: with the lag appended where it is not 0, so that each occurs once.

    Raises:
        InputError: a name whose mirror image is not known.
    """
    images = [_image(name) for name in names]
    source = np.array([names.index(image) for image, _ in images], np.intp)
    return Mirror(source, np.array([sign for _, sign in images], np.float32))


def _image(name: str) -> tuple[str, float]:
    """Return the name of the number on the other side, and the sign it comes with."""
    term, _, rest = name.partition("[")
    label, _, lag = rest.partition("]")
    joint, _, axis = label.partition(",")
    plain = label or term
    if plain[-3:] in _SIDES:
        return name.replace(plain, plain[:-3] + _SIDES[plain[-3:]]), 1.0
    other = f"{term}[{joint[:-3] + _SIDES[joint[-3:]]},{axis}]{lag}" if axis else name
    if any(part in term for part in _UNSIGNED):
        return other, 1.0
    direction = axis or label
    if term in _ROTATIONS:
        return other, 1.0 if direction in ("y", "w") else -1.0
    if direction in _LEFTWARD or term in _LEFTWARD:
        return other, -1.0
    if direction in _SAME or plain in _SAME:
        return other, 1.0
    raise InputError(f"agent 'ppo': setting 'mirror': the mirror image of observation '{name}' is not known; set mirror=false")


class _MirroredSamples:
    """Laid over a rollout buffer: every other sample of a minibatch is seen in the mirror."""

    mirrors: Mapping[str, Mirror]
    action_mirror: Mirror

    def _get_samples(self, batch_inds: NDArray[np.intp], env: Any = None) -> Any:
        samples = super()._get_samples(batch_inds, env)  # type: ignore[misc]
        seen = samples.observations
        for name, rows in seen.items() if isinstance(seen, dict) else (("policy", seen),):
            _mirror(rows, self.mirrors[name])
        _mirror(samples.actions, self.action_mirror)
        return samples


def _mirror(rows: torch.Tensor, mirror: Mirror) -> None:
    rows[1::2] = rows[1::2][:, torch.from_numpy(mirror.source)] * torch.from_numpy(mirror.sign)


class MirroredBuffer(_MirroredSamples, RolloutBuffer):
    """For plain observations."""


class MirroredDictBuffer(_MirroredSamples, DictRolloutBuffer):
    """For observations in groups."""


def set_mirror(buffer: Any, env: Sb3VecEnv) -> None:
    """Tell a buffer what the mirror image of the task's observations and actions is."""
    task = env.core.task
    groups = {"policy": task.policy, "privileged": task.privileged}
    names = {group: [column_name(c) + (f"@{c.lag}" if c.lag else "") for c in columns] for group, columns in groups.items()}
    used = names if env.core.dictionary else {"policy": names["policy"]}
    buffer.mirrors = {group: mirror_of(some) for group, some in used.items()}
    buffer.action_mirror = mirror_of([column.joint for column in task.actions])


# ---- where a training is ---------------------------------------------------------------------------------------------


def begin_learning(model: PPO, steps: int, watcher: BaseCallback) -> None:
    """Prepare ``steps`` more environment steps, what was learnt before stays; ``watcher`` is told of each."""
    model._setup_learn(steps, callback=watcher, reset_num_timesteps=False)


def set_share_done(model: PPO, steps: int, total: int) -> None:
    """Let schedules be where ``steps`` of ``total`` put them."""
    model._update_current_progress_remaining(steps, total)


def last_observations(model: PPO) -> Any:
    """Return what the robots observe now: (N, D), or {group: (N, ...)}."""
    return model._last_obs


def episode_starts(model: PPO) -> NDArray[np.bool_]:
    """Return whose episode starts now, (N,)."""
    return np.asarray(model._last_episode_starts)


def go_on_from(model: PPO, observations: Any, starts: NDArray[np.bool_] | None = None) -> None:
    """Let the next update begin at ``observations``; ``starts`` (N,): whose episode starts there, None = as before."""
    model._last_obs = observations
    if starts is not None:
        model._last_episode_starts = starts


def updates_done(model: PPO) -> int:
    """Return the number of passes over samples so far."""
    return model._n_updates


def set_updates_done(model: PPO, updates: int) -> None:
    """Count passes from ``updates`` on."""
    model._n_updates = updates


class StepWatcher(BaseCallback):
    """Is called after every environment step of an update."""

    def on_robots_stepped(self) -> None:
        """Look at ``self.locals``: ``rewards``, ``dones``, ``infos``, ``new_obs`` and what else is being collected."""

    def _on_step(self) -> bool:
        self.on_robots_stepped()
        return True


class ResumedTensorBoard(TensorBoardOutputFormat):
    """TensorBoard's files; what an interrupted run wrote beyond ``steps`` is no longer shown."""

    def __init__(self, folder: Path, steps: int) -> None:
        self.writer = SummaryWriter(str(folder), purge_step=steps or None)
        self._is_closed = False
