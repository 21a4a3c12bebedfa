"""Who is evaluated: agents and trained policies, each in an environment that feeds it what it was trained on."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob, has_magic
from os.path import commonprefix
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.provenance import CONFIG_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.envs.core import make_task
from wlr_gym.envs.registry import plain_id, task_source_of
from wlr_gym.envs.settings import read_settings
from wlr_gym.envs.tasks.describe import contract
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import (
    agent_names,
    contract_of,
    environment_for,
    find_policy,
    is_policy,
    load_agent_config,
    make_policy,
    policy_environment,
    trained_environment,
)
from wlr_gym.policy.file import differences
from wlr_gym.policy.onnx_file import SUFFIX

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core
    from wlr_gym.policy import Policy


#: What names one or several policies; see :func:`read_subjects`.
Source = str | Path


@dataclass(frozen=True)
class Subject:
    """One column of the card.

    Attributes:
        name: heads the column.
        sources: agent, policy file or folder, or shipped policy. Several are trainings of one recipe: all play all episodes.
        seeds: training seed of each of several sources, as text.
    """

    name: str
    sources: tuple[str, ...]
    seeds: tuple[str, ...] = ()


def read_subjects(given: Sequence[Source | Sequence[Source]]) -> tuple[Subject, ...]:
    """Return subjects; a repeated subject counts once.

    Args:
        given: for each subject ``SOURCE`` or ``NAME=SOURCE``, and for trainings of one recipe that differ in the seed
            ``SOURCE,SOURCE,...`` after a name, a list of sources, a pattern such as ``out/five/trials/*``, or a folder that
            holds nothing but their run folders.

    Raises:
        InputError: no source, two subjects of the same name, or policies of one subject that are not
            different trainings of one recipe.
    """
    subjects = list(dict.fromkeys(_subject([one] if isinstance(one, str | Path) else one) for one in given))
    for index, subject in enumerate(subjects):
        if subject.name in [other.name for other in subjects[:index]]:
            raise InputError(f"two policies are called '{subject.name}': write NAME=POLICY for one of them")
    return tuple(subjects)


def _subject(given: Sequence[Source]) -> Subject:
    texts = [str(text) for text in given]
    found = [_named(text) for text in texts]
    sources = tuple(source for _, several in found for source in several)
    if not sources:
        raise InputError("no policy given")
    for index, source in enumerate(sources):
        if source in sources[:index]:
            raise InputError(f"policy '{source}' is given twice: expected each training of a recipe once")
    common = _SEED.sub("", commonprefix(texts)) or "trained"  # noqa: RUF071 (names may have more in common than folders)
    name = next((name for name, _ in found if name), texts[0] if len(texts) == 1 else common)
    if len(sources) == 1:
        return Subject(name, sources)
    seeds = by_seed(name, sources)
    return Subject(name, tuple(seeds.values()), tuple(seeds))


def _named(text: str) -> tuple[str, tuple[str, ...]]:
    """Return the name that a text gives, or none, and the policies."""
    found = expand(text)
    if found or "=" not in text or Path(text).exists():
        if not found and "," in text and not Path(text).exists():
            raise InputError(f"policy '{text}': several need a name: a={text}")
        return "", found or (text,)
    name, _, sources = text.partition("=")
    parts = [part for part in sources.split(",") if part]
    if not name or not parts:
        raise InputError(f"policy '{text}': expected NAME=POLICY or NAME=POLICY,POLICY,...")
    return name, tuple(source for part in parts for source in expand(part) or (part,))


def identity(subject: Subject, task: str = "") -> str:
    """Return who exactly plays: the SHA-256 of each source's policy file or folder, or of its agent's settings.

    Args:
        subject: who.
        task: name; of an agent's settings for single tasks those for this one alone count. Empty = all.
    """
    return ", ".join(_identity(source, task) for source in subject.sources)


def _identity(source: str, task: str) -> str:
    if source in agent_names():
        settings = load_agent_config(source)
        if task and "tasks" in settings:
            settings = {**settings, "tasks": settings["tasks"].get(task)}
        return f"agent, settings {hashlib.sha256(json.dumps(settings).encode()).hexdigest()}"
    place = find_policy(source)
    if place.is_file():
        return hashlib.sha256(place.read_bytes()).hexdigest()
    digest = hashlib.sha256()
    for path in sorted(path for path in place.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(place)).encode() + path.read_bytes())
    return digest.hexdigest()


def common_robot(subjects: Sequence[Subject]) -> Any:
    """Return the robot that all subjects drive, by content: that of the first trained policy with one; None = the task's own.

    Agents drive any robot, and a policy of another robot than the others' is refused by its contract.
    """
    sources = [source for subject in subjects for source in subject.sources if source not in agent_names()]
    return next((robot for source in sources if (robot := policy_environment(source).get("robot")) is not None), None)


def make_player(environment: str, source: str | Path, episodes: int, keywords: Mapping[str, Any]) -> tuple[Core, Policy]:
    """Return a core that feeds a policy what it was trained on, under the conditions of ``keywords``, and the policy.

    Raises:
        InputError: unknown environment, policy or keyword, or a policy that does not fit the environment.
    """
    core = None
    try:
        core = make_core(environment, episodes, environment_for(source, keywords))
        policy = make_policy(source, core.contract())
        if (plan_with := getattr(policy, "use_simulator", None)) is not None:  # it plans on the simulator's own state
            plan_with(core)
        return core, policy
    except BaseException as error:
        if core is not None:
            core.close()
        if isinstance(error, InputError):
            _refuse_another_task(environment, source)
        raise


def _refuse_another_task(environment: str, source: str | Path) -> None:
    """Say where a policy was trained, if it fits an environment under no conditions at all."""
    trained, task = trained_environment(source), task_source_of(environment)
    if trained is None or plain_id(trained) == plain_id(environment):
        return
    try:
        make_policy(source, contract(make_task(task, read_settings(environment_for(source, {}))), {}))
    except InputError as error:
        raise InputError(f"'{source}' was trained in {trained}, not {environment}: {error}") from None


# ---- several trainings of one recipe, which differ in nothing but the training seed ----------------------------------

#: Folder of a run's policy that did best while it trained: after how many steps that was differs from seed to seed.
BEST = "best"
#: Folders of policies inside of a run's.
_INSIDE = (BEST, "policy")
#: What the names of a recipe's runs end in, before and after the seed.
_SEED = re.compile(r"[-_/. ]*(seed)?[-_=]*\d*$")


def expand(text: str) -> tuple[str, ...]:
    """Return the policies that a text without a name names, in the order of their paths; nothing where it names none.

    It is a policy itself, a pattern of policies (``out/five/trials/*``), or a folder of run folders.

    Raises:
        InputError: a run among them without a policy.
    """
    if is_policy(text):
        return (text,)
    path = Path(text)
    places = (
        sorted(path.iterdir()) if path.is_dir() else [Path(found) for found in sorted(glob(text))] if has_magic(text) else []
    )
    if has_magic(text) and path.name in _INSIDE:  # a run that has none yet is not passed over
        places = [place / path.name for run in sorted(glob(str(path.parent))) if _is_run(place := Path(run))]
    runs = [place for place in places if _is_run(place) or path.name in _INSIDE]
    for run in runs:
        if not is_policy(run):
            raise InputError(
                f"{run}: a run without a policy, among those of '{text}': finish it (wlr train --resume), or name the others"
            )
    return tuple(str(run) for run in runs)


def _is_run(place: Path) -> bool:
    return place.suffix == SUFFIX or (place.is_dir() and (is_policy(place) or (place / CONFIG_FILE).is_file()))


def by_seed(name: str, sources: Sequence[str]) -> dict[str, str]:
    """Return training seed -> policy, in order of the seeds. A policy that does not say its seed comes last, by its path.

    Raises:
        InputError: the policies are not trainings of one recipe that differ in the seed, naming the first difference; or two
            have the same seed.
    """
    for source in sources:
        if source in agent_names():
            raise InputError(f"'{name}': '{source}' is an agent, no training of a recipe; what to compare with: --baselines")
    first = _recipe(sources[0])
    for source in sources[1:]:
        for place, mine, theirs in differences("", first, _recipe(source)):
            raise InputError(
                f"'{name}': '{sources[0]}' and '{source}' differ in more than the training seed: {place} is {mine!r} and "
                f"{theirs!r}; one policy is compared with others by --baselines"
            )
    seeds = {source: _seed(source) for source in dict.fromkeys(sources)}
    ordered = sorted(seeds, key=lambda source: (seeds[source] is None, seeds[source] or 0, source))
    found: dict[str, str] = {}
    for source in ordered:
        label = source if seeds[source] is None else str(seeds[source])
        if label in found:
            raise InputError(
                f"'{name}': '{found[label]}' and '{source}' have the same training seed, {label}: expected different ones"
            )
        found[label] = source
    return found


def _seed(source: str) -> int | None:
    contract = contract_of(source)
    return contract["config"].get("seed", contract.get("training", {}).get("seed"))


def _recipe(source: str) -> dict[str, Any]:
    """Return what the trainings of one recipe agree in."""
    contract, place = contract_of(source), find_policy(source)
    training = contract.get("training", {})
    run = place.parent / CONFIG_FILE
    return {
        "agent": contract["agent"],
        "settings": {key: value for key, value in contract["config"].items() if key != "seed"},
        "init": read_yaml(run).get("init") if place.is_dir() and run.is_file() else None,
        "training.environment": training.get("environment"),
        "training.steps": None if place.name == BEST else training.get("steps"),
        "environment": contract["environment"],
    }
