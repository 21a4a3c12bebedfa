"""Policies that other programs trained: any torch network, or an archive of Stable-Baselines3, becomes a policy file."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.paths import as_path
from wlr_gym.envs.core import Core
from wlr_gym.envs.registry import ENVIRONMENTS, task_source_of
from wlr_gym.learning.evaluation.rollout import seen_observations
from wlr_gym.learning.ppo.policy import ModulePolicy, acting_net, to_onnx
from wlr_gym.policy.agents import FED_AS
from wlr_gym.policy.export import Parity, write_policy_file
from wlr_gym.policy.file import policy_content

require_package("torch", "train")
require_package("stable_baselines3", "train")

import torch  # noqa: E402
from stable_baselines3.common.policies import ActorCriticPolicy  # noqa: E402
from stable_baselines3.common.save_util import load_from_zip_file  # noqa: E402
from stable_baselines3.common.vec_env import VecEnvWrapper, VecFrameStack, VecNormalize  # noqa: E402
from stable_baselines3.sac.policies import SACPolicy  # noqa: E402
from stable_baselines3.td3.policies import TD3Policy  # noqa: E402

#: Wrappers that change what a network sees or does.
_CHANGING = (
    gymnasium.ObservationWrapper, gymnasium.ActionWrapper, gymnasium.vector.VectorObservationWrapper,
    gymnasium.vector.VectorActionWrapper, VecFrameStack,
)  # fmt: skip
#: Of these, those that do what happens anyway: actions are clipped, observations are flat.
_HARMLESS = (gymnasium.wrappers.ClipAction, gymnasium.wrappers.FlattenObservation)
#: The name that the contract gives as agent.
AGENT = "imported"
#: Robots that drive, and for how long (s), while file and network are compared.
ROBOTS, SECONDS = 16, 4.0


def import_policy(
    network: torch.nn.Module | str | Path,
    env: Any,
    out: str | Path,
    *,
    normalizer: torch.nn.Module | VecNormalize | str | Path | None = None,
) -> Parity:
    """Make a policy file of a network that was trained elsewhere; ``wlr evaluate``, ``play`` and ``deploy`` take it.

    Args:
        network: maps (normalised) observations (N, D) to mean actions (N, 8), float32; or the path of an archive that
            Stable-Baselines3 saved (PPO, A2C, SAC, TD3 and what is built on their policies). Actions are clipped to [-1, 1].
        env: the environment of the training, made as it was then: single, vector or Stable-Baselines3. What its ``contract()``
            says is what the file is fed.
        out: file to write, ending in ``.onnx``.
        normalizer: what observations went through before the network, folded into the file: a torch module, a
            ``VecNormalize`` or the path of a saved one. None = the ``VecNormalize`` around ``env``, or nothing.

    Returns:
        The largest differences between the actions of file and network: over random observations, and over those of robots
        that it drives.

    Raises:
        InputError: no environment of this library, a network that does not fit it, an archive that cannot be read, or a file
            that cannot be written or answers differently.
        MissingPackageError: a package is not installed.
    """
    require_package("onnxscript", "export")
    bare = getattr(env, "unwrapped", env)
    if not hasattr(bare, "contract") or not hasattr(bare, "core"):
        raise InputError(f"env = {env!r}: expected an environment of wlr_gym, made as it was for the training")
    contract = bare.contract()
    width = len(contract["observation"])
    worn = _worn(env, bare)
    worn = worn if normalizer is None else normalizer
    seen = bare.core.observation_space if worn is None else None
    source = network if isinstance(network, torch.nn.Module) else sb3_network(as_path(network), seen, bare.core.action_space)
    whole = _Whole(_normalizer(worn, width), source)
    task = bare.core.settings.task
    if task is not None and not isinstance(task, Mapping):  # a file, which may be elsewhere tomorrow: its content, scaled
        written = bare.core.task.config.model_dump(mode="json", exclude_none=True)
        task = {FED_AS: {**written, "robot": "nominal", "scaling": {}}}
    config = {"environment": {"task": dict(task or {})}}  # its robot is in the contract
    env_id = _id_of(bare)
    content = policy_content(AGENT, config, contract, {"environment": env_id})
    policy = ModulePolicy(whole)
    before = {module: module.training for module in whole.modules()}
    whole.eval()
    try:
        _check(whole, width, len(contract["action"]))
        graph = to_onnx(whole, width)
        definition = (bare.spec and bare.spec.kwargs.get("definition")) or task_source_of(env_id)
        with closing(Core(definition, bare.core.settings, ROBOTS)) as core:
            driven = seen_observations(core, policy, SECONDS)
        return write_policy_file(as_path(out), graph, content, policy, driven)
    except torch.onnx.OnnxExporterError as error:
        raise InputError(f"the network cannot be written as an ONNX graph: {_reason(error)}") from error
    finally:
        for module, training in before.items():
            module.training = training


def _reason(error: BaseException) -> str:
    """Return the first line of what the exporter itself ran into."""
    while error.__cause__ is not None:
        error = error.__cause__
    return f"{type(error).__name__}: {next(iter(str(error).strip().splitlines()), '')}"


class _Whole(torch.nn.Module):
    """Normaliser, network and the clip of the actions."""

    def __init__(self, normalizer: torch.nn.Module, network: torch.nn.Module) -> None:
        super().__init__()
        self.normalizer, self.network = normalizer, network

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return actions (N, 8) for observations (N, D)."""
        return torch.clamp(self.unclipped(observation), -1.0, 1.0)

    def unclipped(self, observation: torch.Tensor) -> torch.Tensor:
        """Return what the network itself answers."""
        return self.network(self.normalizer(observation))


def _id_of(bare: Any) -> str:
    """Return the id of an environment, also of one whose class was called without ``gymnasium.make``."""
    if bare.spec is not None:
        return bare.spec.id
    for env_id, task in ENVIRONMENTS.items():
        if task == bare.task_name:
            return env_id
    raise InputError(f"env = {bare!r} has no id: register its task with register_task and make it with gymnasium.make")


def _check(network: _Whole, width: int, actions: int) -> None:
    """Refuse a network that does not map observations to actions."""
    try:
        with torch.no_grad():
            found = network.unclipped(torch.zeros(2, width))
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(
            f"the network does not take the environment's observations, rows of {width} numbers: {_reason(error)}"
        ) from None
    if not isinstance(found, torch.Tensor) or found.shape != (2, actions) or found.dtype != torch.float32:
        what = f"{found.dtype} of shape {tuple(found.shape)}" if isinstance(found, torch.Tensor) else type(found).__name__
        raise InputError(f"the network returns {what} for 2 observations, expected float32 of shape (2, {actions})")


# ---- normalisers ----


class _Standardise(torch.nn.Module):
    """(x - mean) / sqrt(variance + epsilon), clipped: what VecNormalize does."""

    mean: torch.Tensor
    scale: torch.Tensor

    def __init__(self, given: VecNormalize) -> None:
        super().__init__()
        scale = 1.0 / np.sqrt(given.obs_rms.var + given.epsilon)  # type: ignore[union-attr]
        self.register_buffer("mean", torch.as_tensor(given.obs_rms.mean, dtype=torch.float32))  # type: ignore[union-attr]
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32))
        self.limit = float(given.clip_obs)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return torch.clamp((observation - self.mean) * self.scale, -self.limit, self.limit)


def _worn(env: Any, bare: Any) -> VecNormalize | None:
    """Return the normaliser around an environment; other wrappers that change what a network sees or does are refused."""
    found: VecNormalize | None = None
    layer: Any = env
    while layer is not bare:
        if isinstance(layer, VecNormalize):
            found = layer
        elif isinstance(layer, _CHANGING) and not isinstance(layer, _HARMLESS):
            raise InputError(
                f"env: the wrapper {type(layer).__name__} changes observations or actions: expected the environment without "
                "it, and what it does in the network or as normalizer"
            )
        layer = layer.venv if isinstance(layer, VecEnvWrapper) else layer.env
    return found


def _normalizer(given: Any, width: int) -> torch.nn.Module:
    """Return what observations go through: a module as it is; nothing, a ``VecNormalize`` or the path of one as a module."""
    if isinstance(given, torch.nn.Module):
        return given
    if isinstance(given, str | Path):
        try:
            given, path = pickle.loads(as_path(given).read_bytes()), given
        except Exception as error:  # pickle raises whatever the bytes lead it to
            raise InputError(f"{given}: not a saved VecNormalize: {error}") from None
        if not isinstance(given, VecNormalize):
            raise InputError(f"{path}: holds {type(given).__name__}, expected a saved VecNormalize")
    if given is None or not given.norm_obs:
        return torch.nn.Identity()
    shape = getattr(getattr(given, "obs_rms", None), "mean", np.zeros(0)).shape
    if shape != (width,):
        raise InputError(f"normalizer: statistics of shape {shape}, expected ({width},) as the environment observes")
    return _Standardise(given)


# ---- Stable-Baselines3 ----


class _Sb3Mean(torch.nn.Module):
    """The action that ``predict(deterministic=True)`` of a Stable-Baselines3 model returns, before the clip."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        policy = self.policy
        if isinstance(policy, SACPolicy):
            return torch.tanh(policy.actor.get_action_dist_params(observation)[0])
        if isinstance(policy, TD3Policy):
            return policy.actor(observation)
        features = policy.extract_features(observation, policy.pi_features_extractor)
        mean = acting_net(policy)(policy.mlp_extractor.forward_actor(features))
        return torch.tanh(mean) if policy.squash_output else mean


def sb3_network(path: Path, seen: gymnasium.Space | None = None, done: gymnasium.Space | None = None) -> torch.nn.Module:
    """Return the acting network of an archive that Stable-Baselines3 saved.

    Args:
        path: of the archive.
        seen, done: what the training must have observed and acted in, or wrappers lay between; None = not compared.

    Raises:
        InputError: absent, broken, of a policy that is no torch network of the kinds above, or trained behind wrappers.
    """
    try:
        data, parameters, _ = load_from_zip_file(path, device="cpu")
        assert data is not None
        spaces = data["observation_space"], data["action_space"]
        keywords = {**data["policy_kwargs"], **({"use_sde": True} if data.get("use_sde") else {})}
        policy = data["policy_class"](*spaces, lambda _: 0.0, **keywords)
        policy.load_state_dict(parameters["policy"])
    except Exception as error:  # zip, pickle and torch each raise their own kinds for a broken file
        raise InputError(f"{path}: not a readable archive of Stable-Baselines3: {type(error).__name__}: {error}") from None
    if not isinstance(policy, ActorCriticPolicy | SACPolicy | TD3Policy):
        raise InputError(f"{path}: policy '{type(policy).__name__}': expected one of PPO, A2C, SAC or TD3")
    _refuse_wrappers(path, data, seen, done)
    policy.set_training_mode(False)
    return _Sb3Mean(policy)


def _refuse_wrappers(path: Path, data: Mapping[str, Any], seen: gymnasium.Space | None, done: gymnasium.Space | None) -> None:
    """Refuse an archive whose training saw or did other than the environment, by what is kept of both."""
    if done is not None and data["action_space"] != done:
        found = f"trained in actions {data['action_space']}, the environment has {done}"
        raise InputError(f"{path}: {found}: put into the network what a wrapper changed")
    is_normalised = data.get("_last_original_obs") is not None  # what a VecNormalize got
    if seen is None or (data["observation_space"] == seen and not is_normalised):
        return
    if is_normalised:
        between, remedy = "a VecNormalize", "give what its save() wrote as normalizer"
    else:
        between, remedy = "a wrapper that changed its observations", "give what it did as normalizer"
    raise InputError(f"{path}: trained behind {between}: {remedy}, or the environment of the training with it")
