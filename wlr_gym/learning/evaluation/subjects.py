"""Who is evaluated: agents and trained policies, each in an environment that feeds it what it was trained on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import merge_changes
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import agent_names, find_policy, load_agent_config, make_policy, policy_environment

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.policy import Policy


@dataclass(frozen=True)
class Subject:
    """One column of the card.

    Attributes:
        name: heads the column.
        sources: agent, policy file or folder, or shipped policy. Several are the same agent trained with several seeds: block
            k of the episodes is played by source k modulo their number, so that the intervals cover training seeds too.
    """

    name: str
    sources: tuple[str, ...]


def read_subjects(texts: Sequence[str | Path]) -> tuple[Subject, ...]:
    """Return subjects for ``SOURCE``, ``NAME=SOURCE`` or ``NAME=SOURCE,SOURCE,...``; a repeated one counts once.

    Raises:
        InputError: no source, or two subjects of the same name.
    """
    subjects = list(dict.fromkeys(_subject(str(text)) for text in texts))
    for index, subject in enumerate(subjects):
        if subject.name in [other.name for other in subjects[:index]]:
            raise InputError(f"two policies are called '{subject.name}': write NAME=POLICY for one of them")
    return tuple(subjects)


def _subject(text: str) -> Subject:
    name, equals, sources = text.partition("=")
    if not equals or Path(text).exists():
        return Subject(text, (text,))
    found = tuple(source for source in sources.split(",") if source)
    if not name or not found:
        raise InputError(f"policy '{text}': expected NAME=POLICY or NAME=POLICY,POLICY,...")
    return Subject(name, found)


def identity(subject: Subject) -> str:
    """Return who exactly plays: the SHA-256 of each source's policy file or folder, or of its agent's settings."""
    return ", ".join(_identity(source) for source in subject.sources)


def _identity(source: str) -> str:
    if source in agent_names():
        return f"agent, settings {hashlib.sha256(json.dumps(load_agent_config(source)).encode()).hexdigest()}"
    place = find_policy(source)
    if place.is_file():
        return hashlib.sha256(place.read_bytes()).hexdigest()
    digest = hashlib.sha256()
    for path in sorted(path for path in place.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(place)).encode() + path.read_bytes())
    return digest.hexdigest()


def make_player(environment: str, source: str | Path, episodes: int, keywords: Mapping[str, Any]) -> tuple[Core, Policy]:
    """Return a core that feeds a policy what it was trained on, under the conditions of ``keywords``, and the policy.

    Raises:
        InputError: unknown environment, policy or keyword, or a policy that does not fit the environment.
    """
    own = dict(policy_environment(source))
    if isinstance(own.get("task"), Mapping) and isinstance(keywords.get("task"), Mapping):
        own["task"] = merge_changes(keywords["task"], own["task"])
    core = make_core(environment, episodes, {**keywords, **own})
    try:
        return core, make_policy(source, core.contract())
    except BaseException:
        core.close()
        raise
