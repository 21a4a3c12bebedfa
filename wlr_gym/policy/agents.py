"""Agents by name, and what names a policy.

An agent is a folder ``agents/<name>/`` whose ``agent.py`` offers the functions of :class:`Agent`. A policy is named by an
agent, a policy or run folder, a policy file (``.onnx``), or one shipped in ``agents/shipped/``.
"""

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

from wlr_gym.base.errors import InputError, check_name, nearest, unknown_name
from wlr_gym.base.paths import as_path, config_names, data_directory, named_in
from wlr_gym.base.settings import merge_changes, parse_yaml, read_layers
from wlr_gym.base.text import pairs
from wlr_gym.policy.file import CONTRACT_FILE, Config, Contract, check_contract, read_contract
from wlr_gym.policy.onnx_file import SUFFIX, open_policy


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
    """Import ``agents/<name>/agent.py`` by its place on disk."""
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


# --- what names a policy -----------------------------------------------------------------------------------------------


#: Of a task's settings, what decides which numbers a policy is fed and what its own mean. The others are conditions.
FED = ("observations", "observer", "controller", "action", "control_period")
#: Key of an environment's ``task``: the task file that these are taken from; the environment reads it, for its robot.
FED_AS = "fed_as"


def shipped_directory() -> Path:
    """Return the folder of the shipped policies, in a clone or a wheel."""
    return data_directory("agents") / "shipped"


def shipped_names() -> list[str]:
    """Return the names of the shipped policies, such as ``velocity_slip_aware``."""
    return sorted(path.stem for path in shipped_directory().glob(f"*{SUFFIX}"))


def _policy_place(source: str | Path) -> Path | None:
    """Return the folder or file of a policy that is given by it, by a run folder or by a shipped name; None = none of these."""
    path = as_path(source)
    if path.suffix == SUFFIX and path.is_file():
        return path
    for folder in (path, path / "policy"):
        if (folder / CONTRACT_FILE).is_file():
            return folder
    return shipped_directory() / f"{source}{SUFFIX}" if str(source) in shipped_names() else None


def is_policy(source: str | Path) -> bool:
    """Whether there is an agent or a trained policy of this name or at this path."""
    return str(source) in agent_names() or _policy_place(source) is not None


def untrained(source: str | Path) -> str:
    """Return what to say of the name of an agent whose training begins with a random policy; empty = it is none."""
    if str(source) not in agent_names() or not hasattr(load_agent(str(source)), "settings_to_start_from"):
        return ""
    return f"'{source}' is the agent before any training; trained ones: {', '.join(shipped_names())}"


def find_policy(source: str | Path, or_agent: bool = False) -> Path:
    """Return the policy folder or file of a trained policy.

    Args:
        source: as of :func:`load_policy`.
        or_agent: an agent's name would have done, too; the message lists them.

    Raises:
        InputError: there is none; the message lists the names there are.
    """
    place = _policy_place(source)
    if place is not None:
        return place
    if as_path(source).is_dir():
        raise InputError(f"'{source}': no policy there (looked for {CONTRACT_FILE} in it and in its folder 'policy')")
    if as_path(source).exists():
        raise InputError(f"'{source}': not a policy: expected a folder, or a file {SUFFIX}")
    if str(source) in agent_names():
        raise InputError(f"'{source}' is an agent: expected a trained policy (folder, file {SUFFIX} or shipped policy)")
    agents = agent_names() if or_agent else []
    kinds, listed = (", an agent", f"agents: {', '.join(agents)}; ") if agents else ("", "")
    raise InputError(
        f"'{source}' is no policy: neither a folder, a file {SUFFIX}{kinds} nor a shipped policy"
        f"{nearest(str(source), [*agents, *shipped_names()])}; {listed}shipped: {', '.join(shipped_names()) or 'none'}"
    )


def contract_of(source: str | Path) -> dict[str, Any]:
    """Return the contract of a trained policy: what ``contract.json`` says, or the metadata of a policy file."""
    place = find_policy(source)
    return open_policy(place)[1] if place.is_file() else read_contract(place)


def load_policy(source: str | Path, environment: Contract | Any) -> Policy:
    """Load a trained policy for an environment.

    Args:
        source: policy folder, run folder with a ``policy`` in it, policy file, or name of a shipped policy.
        environment: single, vector or Stable-Baselines3 environment, wrapped or not, or what its ``contract()`` returns.

    Raises:
        InputError: no policy there, broken, or a contract that does not fit, naming the first difference.
    """
    place = find_policy(source)
    if not isinstance(environment, Mapping):
        bare = getattr(environment, "unwrapped", environment)
        if not hasattr(bare, "contract"):
            raise InputError(f"environment = {environment!r}: expected one that was made, or what its contract() returns")
        environment = bare.contract()
    if place.is_file():
        policy, contract = open_policy(place)
        check_contract(contract["environment"], environment, str(place))
        return policy
    contract = read_contract(place)
    check_contract(contract["environment"], environment, str(place))
    return agent_function(contract["agent"], "load_policy")(place, contract)


def make_policy(source: str | Path, environment: Contract) -> Policy:
    """Return the policy of an agent's name (with its shipped settings), or a trained one; see :func:`load_policy`."""
    if str(source) in agent_names():
        return agent_function(str(source), "make_policy")(environment, load_agent_config(source))
    find_policy(source, or_agent=True)
    return load_policy(source, environment)


def policy_environment(source: str | Path) -> dict[str, Any]:
    """Return the keywords that an environment must be made with so that a policy is fed what it was made for.

    They are those of its training that decide what its inputs and outputs mean (see :data:`FED`), and its robot, by content.
    Conditions, such as backend, randomisation, commands or precision, are not among them: a policy may be tried under others.

    Args:
        source: as of :func:`make_policy`.

    Returns:
        ``{"task": ..., "robot": ...}``; without the task where it is the one that ships, without the robot where it is the
        nominal one.

    Raises:
        InputError: neither an agent nor a policy, both, or a broken one.
    """
    if str(source) in agent_names():
        if _policy_place(source) is not None:
            raise InputError(f"'{source}' is an agent, and a policy in this folder: give ./{source}, or rename the policy")
        return fed_environment(load_agent_config(source).get("environment") or {})
    contract = contract_of(find_policy(source, or_agent=True))
    robot = robot_of_contract(contract)
    own = fed_environment(contract["config"].get("environment") or {})
    if FED_AS in own.get("task", {}):
        own["task"]["observer"] = contract["environment"].get("observer")  # for those who ask whether it has a camera
    return own | ({} if robot is None else {"robot": robot})


def robot_of_contract(content: Mapping[str, Any]) -> Any:
    """Return the robot that a policy was made for, by content (of older policies: by name or path); None = the nominal one.

    A sensor that the policy did without at times is left out: it is a condition, and fits the robot with and without it.
    """
    environment = content["environment"]
    stated = (environment.get("robot") or {}).get("description")
    if stated is None:
        return (content["config"].get("environment") or {}).get("robot")
    if (environment.get("sensors") or {}).get("flow", 1.0) >= 1.0:
        return stated
    return {**stated, "sensors": {name: sensor for name, sensor in stated["sensors"].items() if name != "flow"}}


def environment_for(source: str | Path, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keywords of an environment that feeds a policy what it was made for, under the conditions of ``given``.

    A robot that is given holds: a policy that was made for another one is then refused by its contract. Without one it is that
    of the policy.

    Args:
        source: as of :func:`make_policy`.
        given: keywords of the environment, such as ``{"randomization": "ice", "robot": None}``.
    """
    own = policy_environment(source)
    if isinstance(own.get("task"), Mapping) and isinstance(given.get("task"), Mapping):
        own["task"] = merge_changes(given["task"], own["task"])
    if given.get("robot") is not None:
        own.pop("robot", None)
    return {**given, **own}


def fed_environment(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of an environment's keywords that decide what a policy's inputs and outputs mean."""
    task = environment.get("task")
    if isinstance(task, Mapping):
        task = {key: task[key] for key in (FED_AS, *FED) if key in task}
    elif task is not None:
        task = {FED_AS: str(task)}
    return {"task": task} if task else {}


def trained_environment(source: str | Path) -> str | None:
    """Return the id of the environment that a policy was trained in; None for agents, which nobody trained."""
    if str(source) in agent_names():
        return None
    return contract_of(find_policy(source, or_agent=True)).get("training", {}).get("environment")
