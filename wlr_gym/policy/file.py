"""A policy on disk: a folder with the agent's files and ``contract.json``: what it must be fed, what its output means."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_json
from wlr_gym.base.provenance import versions
from wlr_gym.base.settings import read_json
from wlr_gym.policy.control import SlipGains
from wlr_gym.robot import load_robot

Contract = Mapping[str, Any]
Config = Mapping[str, Any]

FORMAT = 1
CONTRACT_FILE = "contract.json"
#: Keys of an environment's contract that a policy depends on. The others (randomisation, commands, latency) are recorded only:
#: a policy may be tried under conditions it was not trained in.
BINDING = ("robot", "control_period", "observation", "observer", "controller", "action")
#: Of those, what differs by conditions or by name and not by meaning; what matters of a robot's description is in its hash.
CONDITIONS = ("observation.noise", "observation.bias", "observation.sensor_noise", "robot.name", "robot.description")
#: What an absent key means. A key that contracts get later is listed here with what went without saying before, so that older
#: policies stay valid.
DEFAULTS = {
    "observation.offset": 0.0,
    "observation.scale": 1.0,
    "observation.lag": 0,
    "observation.device": "",
    "observer": None,
    "observer.camera": True,
    "controller": None,
    **{f"controller.{name}": gain.default for name, gain in SlipGains.model_fields.items()},
}
_INDEX = re.compile(r"\[\d+\]")


def write_contract(folder: Path, agent: str, config: Config, environment: Contract, training: Mapping[str, Any]) -> None:
    """Write ``contract.json``.

    Args:
        folder: of the policy.
        agent: its name.
        config: the agent's settings, resolved.
        environment: what ``env.contract()`` returned.
        training: how it came about (environment id, steps, seed).
    """
    write_json(folder / CONTRACT_FILE, policy_content(agent, config, environment, training))


def policy_content(agent: str, config: Config, environment: Contract, training: Mapping[str, Any]) -> dict[str, Any]:
    """Return what ``contract.json``, or the metadata of a policy file, says; arguments as for :func:`write_contract`."""
    return {
        "format": FORMAT,
        "agent": agent,
        "environment": environment,
        "training": training,
        "config": config,
        "versions": versions(),
    }


def read_contract(folder: str | Path) -> dict[str, Any]:
    """Read the ``contract.json`` of a policy folder.

    Raises:
        InputError: absent, broken, or of another format version.
    """
    path = Path(folder) / CONTRACT_FILE
    content = read_json(path)
    check_content(content, str(path))
    return content


def check_content(content: Any, where: str) -> None:
    """Refuse what is no policy contract.

    Raises:
        InputError: another format version, or a key is missing.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{where}: not a policy contract of format {FORMAT}")
    for key in ("agent", "environment", "config"):
        if not isinstance(content.get(key), str if key == "agent" else dict):
            raise InputError(f"{where}: '{key}' is missing")


def check_contract(policy: Contract, environment: Contract, where: str) -> None:
    """Refuse a policy made for another robot, observation, action or control period.

    Raises:
        InputError: naming the first difference, with both values.
    """
    for name, mine, theirs in _binding_differences(policy, environment):
        hint = ""
        if name in ("robot.hash", "robot.servo"):
            ours, other = (contract["robot"].get("name") for contract in (policy, environment))
            hint = f" (robot '{ours}' in the policy, '{other}' in the environment)"
            if ours == other:
                hint = f" (both are called '{ours}'; their numbers differ, or the policy is of an older version)"
        raise InputError(
            f"{where}: made for another environment: {name} is {mine!r} in the policy, {theirs!r} in the environment{hint}"
        )


def _binding_differences(policy: Contract, environment: Contract) -> Iterator[tuple[str, Any, Any]]:
    for key in BINDING:
        yield from differences(key, _entry(policy, key, key), _entry(environment, key, key))
    if any(column.get("device") == "flow" for column in policy.get("observation") or ()):
        mine, theirs = _flow_sensor(policy), _flow_sensor(environment)
        does_without = (policy.get("sensors") or {}).get("flow", 1.0) < 1.0
        if theirs is not None or not does_without:
            yield from differences("robot.description.sensors.flow", mine, theirs)


def _flow_sensor(environment: Contract) -> dict[str, Any] | None:
    """Return the optical-flow sensor of a contract's robot, which is in no fingerprint."""
    flow = load_robot((environment.get("robot") or {}).get("description") or "nominal").sensors.flow
    return None if flow is None else flow.model_dump(mode="json")


def _is_condition(place: str, mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> bool:
    """Return whether a place is no matter of meaning; the limit of a command grows with the range it is drawn from."""
    general = _INDEX.sub("", place)
    of_command = mine.get("source") == theirs.get("source") == "command"
    return general in CONDITIONS or (of_command and general == "observation.limit")


def _entry(mapping: Mapping[str, Any], key: str, place: str) -> Any:
    """Return what a contract says at a place such as ``observation[3].scale``, or the default."""
    return mapping.get(key, DEFAULTS.get(_INDEX.sub("", place)))


def differences(name: str, mine: Any, theirs: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield (path, value here, value there) of everything that differs, in order."""
    if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
        for key in dict.fromkeys([*mine, *theirs]):
            place = f"{name}.{key}" if name else key
            if not _is_condition(place, mine, theirs):
                yield from differences(place, _entry(mine, key, place), _entry(theirs, key, place))
    elif isinstance(mine, list | tuple) and isinstance(theirs, list | tuple):
        for index, (left, right) in enumerate(zip(mine, theirs, strict=False)):
            yield from differences(f"{name}[{index}]", left, right)
        if len(mine) != len(theirs):
            yield f"length of {name}", len(mine), len(theirs)
    elif mine != theirs:
        yield name, mine, theirs


def camera_share(environment: Contract) -> float:
    """Return in which share of its training what a policy is fed rested on camera poses, through the slip observer."""
    if not (environment.get("observer") or {}).get("camera"):
        return 0.0
    return (environment.get("sensors") or {}).get("camera", 1.0)


def misses_camera(environment: Contract) -> bool:
    """Whether a policy that drives without camera had one in most of its training."""
    return camera_share(environment) > 0.5


def needs_camera(environment: Contract) -> bool:
    """Whether what a policy is fed rests on camera poses, and it never did without."""
    return camera_share(environment) >= 1.0
