"""Several trainings of one recipe: which policies a text names, and that they differ in nothing but the training seed."""

from __future__ import annotations

import re
from collections.abc import Sequence
from glob import glob, has_magic
from os.path import commonprefix
from pathlib import Path
from typing import Any

from wlr_gym.base.errors import InputError
from wlr_gym.base.provenance import CONFIG_FILE
from wlr_gym.base.settings import read_yaml
from wlr_gym.policy import agent_names, contract_of, find_policy, is_policy
from wlr_gym.policy.file import differences
from wlr_gym.policy.onnx_file import SUFFIX

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


def common_name(sources: Sequence[str]) -> str:
    """Return what the paths of a recipe's runs have in common, without the word seed at its end."""
    return _SEED.sub("", commonprefix(list(sources))) or "trained"  # noqa: RUF071 (names may have more in common than folders)


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
