"""Agents by name. An agent is a folder ``agents/<name>/`` whose ``agent.py`` offers the functions of :class:`Agent`."""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import yaml
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, check_name, unknown_name
from wlr_gym.base.paths import config_names, data_directory, named_in
from wlr_gym.base.settings import merge_changes, parse_yaml, read_layers
from wlr_gym.base.text import pairs

Contract = Mapping[str, Any]
Config = Mapping[str, Any]


class Policy(Protocol):
    """What drives N robots: observations in, actions out."""

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return actions (N, 8) in [-1, 1] for observations (N, D), as the contract lists them."""
        ...

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget what was remembered of the robots in ``mask`` (N,): their episodes start anew."""
        ...


@dataclass
class TrainingProgress:
    """What is known of a training after an update.

    Attributes:
        folder: run folder.
        steps, total_steps: environment steps done, and to be done.
        metrics: the update's row of ``learning_curve.csv``.
        held_out: newest scores on the held-out episodes, a row of ``held_out.csv``; empty before the first.
        stop_requested: the training ends in good order after this update.
    """

    folder: Path
    steps: int
    total_steps: int
    metrics: Mapping[str, float]
    held_out: Mapping[str, float]
    stop_requested: bool = False

    def stop(self) -> None:
        """End the training in good order, with a checkpoint that it can be resumed from."""
        self.stop_requested = True


@dataclass(frozen=True)
class Training:
    """One request to train.

    Attributes:
        environment: id, such as ``WLR-Velocity-v0``.
        folder: run folder to fill.
        config: the agent's settings; ``seed`` among them decides everything random.
        resume: continue from the newest checkpoint in ``folder``.
        max_seconds: stop in good order after this wall time; None = no limit.
        progress: show a progress bar.
        init: policy to start from: run or policy folder, policy file, or shipped policy; None = untrained.
        on_update: called after every update. What it raises ends the training, with a checkpoint.
    """

    environment: str
    folder: Path
    config: Config = field(default_factory=dict)
    resume: bool = False
    max_seconds: float | None = None
    progress: bool = True
    init: str | Path | None = None
    on_update: Callable[[TrainingProgress], object] | None = None


class Agent(Protocol):
    """The functions of an ``agent.py``. All but ``make_policy`` are absent where there is nothing to learn, or to export."""

    def make_policy(self, contract: Contract, config: Config) -> Policy:
        """Return the policy an agent has before any training, for an environment's contract."""
        ...

    def load_policy(self, folder: Path, contract: Contract) -> Policy:
        """Return the trained policy saved in ``folder``."""
        ...

    def train(self, training: Training) -> Path:
        """Train and return the folder of the final policy."""
        ...

    def check_settings(self, config: Config) -> None:
        """Raise what a training with these settings would be refused with, without beginning it."""
        ...

    def settings_to_start_from(self, source: str | Path) -> dict[str, Any]:
        """Return the settings of a training that starts from a trained policy (``init``).

        An agent that has this is taken to be random before any training: it moves no real robot then.
        """
        ...

    def export_network(self, folder: Path, contract: Contract) -> bytes:
        """Return the policy of a folder as an ONNX model: ``observation`` (N, D) to ``action`` (N, 8); see ``onnx_file``."""
        ...


def agent_names() -> list[str]:
    """Return the names of the agents there are."""
    return sorted(path.parent.name for path in data_directory("agents").glob("*/agent.py"))


def load_agent(name: str) -> Agent:
    """Import ``agents/<name>/agent.py`` by its place on disk.

    Raises:
        InputError: no such agent; the message lists those there are.
    """
    check_name("agent", name, agent_names())
    package = f"wlr_gym_agents_{name}"  # made for its folder, so that it can import its neighbours relatively
    if package not in sys.modules:
        module = types.ModuleType(package)
        module.__path__ = [str(data_directory("agents") / name)]
        sys.modules[package] = module
    return cast(Agent, importlib.import_module(f"{package}.agent"))


def agent_function(name: str, function: str) -> Callable[..., Any]:
    """Return a function of an agent.

    Raises:
        InputError: the agent does not have it, such as ``train`` where there is nothing to learn.
    """
    agent = load_agent(name)
    if not hasattr(agent, function):
        able = [other for other in agent_names() if hasattr(load_agent(other), function)]
        raise InputError(f"agent '{name}' has no '{function}'; agents that have: {', '.join(able)}")
    return getattr(agent, function)


def load_agent_config(name: str | Path, changes: tuple[str, ...] = (), task: str | None = None) -> dict[str, Any]:
    """Read ``configs/agent/<name>.yaml`` (or a path) and lay changes such as ``environment.precision=float64`` over it.

    A name without a file is an agent without settings: empty. ``base: NAME`` in a file lays it over another. With a ``task``
    the settings are that task's: those in ``tasks: {TASK: ...}`` lie over the file's general ones, what the file says lies over
    both of its base's, and changes over all. A base or task given by a path is looked for beside the file first.

    Raises:
        InputError: no such file, broken YAML, a base or a task that is none, or a change that is not ``key=value``.
    """
    shipped = data_directory("configs") / "agent" / f"{name}.yaml"
    layers = [] if str(name) in agent_names() and not shipped.is_file() else read_layers("agent", name)
    config: dict[str, Any] = {}
    for data, where in layers:
        if not isinstance(data, Mapping | None):
            raise InputError(f"{where}: expected a mapping, got {type(data).__name__}")
        own = dict(data or {})
        config = merge_changes(config, own if task is None else for_task(own, task, where))
    apply_changes(config, changes)
    return config if task is None else for_task(config, task)


def apply_changes(config: dict[str, Any], changes: Iterable[str]) -> None:
    """Lay changes such as ``environment.precision=float64`` over settings, in place.

    Raises:
        InputError: a change that is not ``key=value``, or a key given twice.
    """
    for key, text in pairs("setting", changes, "total_steps=1000000").items():
        *parents, last = key.split(".")
        group = config
        for parent in parents:
            group = group.setdefault(parent, {})
            if not isinstance(group, dict):
                raise InputError(f"setting '{key}={text}': '{parent}' is a value, not a group")
        try:
            group[last] = parse_yaml(text)
        except yaml.YAMLError:
            raise InputError(f"setting '{key}={text}': '{text}' is not a YAML value") from None


def for_task(settings: Mapping[str, Any], task: str, where: str = "settings") -> dict[str, Any]:
    """Return settings with what their ``tasks`` says of one task laid over the others.

    A task is a name in ``configs/task/`` or the path of a file.

    Raises:
        InputError: a task that is none.
    """
    own, found = dict(settings), {}
    for name, given in _settings(own.pop("tasks", None), f"{where}: tasks").items():
        if Path(name).suffix not in {".yaml", ".yml"} and name not in config_names("task"):
            raise unknown_name("task", name, config_names("task"), f"{where}: tasks")
        of_task = _settings(given, f"{where}: tasks.{name}")
        if name == task or named_in(where, name).resolve() == Path(task).resolve():  # a registered task is an absolute path
            found = of_task
    return merge_changes(own, found)


def _settings(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, Mapping | None):
        raise InputError(f"{where} = {value!r}: expected a mapping")
    return {str(key): entry for key, entry in (value or {}).items()}
