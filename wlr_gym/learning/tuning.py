"""Gains of a hand-written controller by search: what ``wlr train ENV --agent pid`` does.

Every setting in turn goes up and down by its step; what scores best stays, and a step that brought nothing is halved. All
candidates drive the same robots on the same floors, so the result depends on the settings at the start and the seed only.
The score is the card's tracking error (:func:`wlr_gym.learning.evaluation.metrics.tracking_error`), mean over episodes: how
much of each limit of the task's success is reached; a fall counts like errors of ten times the limits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import record_provenance
from wlr_gym.envs.interfaces import Infos
from wlr_gym.envs.registry import task_name_of
from wlr_gym.learning.evaluation.metrics import has_limits
from wlr_gym.learning.evaluation.rollout import make_core, measures_of, start_episodes
from wlr_gym.policy import Policy, Training, write_contract
from wlr_gym.policy.control import PidConfig, task_settings

if TYPE_CHECKING:
    from wlr_gym.envs.core import Core

MakePolicy = Callable[[Mapping[str, Any], Mapping[str, Any]], Policy]
#: Called with what is going on, and the share of the search that is done.
TellSearch = Callable[[str, float], None]


def tune(training: Training, agent: str, make_policy: MakePolicy, model: type[PidConfig]) -> Path:
    """Search from the settings of ``training``, and return the folder of the policy with the best ones.

    A search that is interrupted leaves nothing in the folder.

    Raises:
        InputError: bad settings, a task without limits to score by, or what a search has not: ``resume``, ``init``, a limit of
            time.
    """
    from rich.console import Console

    if training.resume:
        raise InputError(f"agent '{agent}' is tuned by a search of a few minutes, which cannot be resumed: start it anew")
    for name, option in {"init": "--init", "max_seconds": "--max-minutes"}.items():  # what ``wlr train`` calls them
        if getattr(training, name) is not None:
            raise InputError(f"agent '{agent}' is tuned by a search of a few minutes: leave out '{name}' ({option})")
    config = dict(training.config)
    general = task_settings(model, {"task": ""}, config, agent)
    tunable = [name for name, value in general if isinstance(value, float)]
    for name in general.search.steps:
        if name not in tunable:
            raise unknown_name("setting", name, tunable, f"agent '{agent}': search.steps")
    episodes = general.search.episodes
    floors = general.search.randomization.get(task_name_of(training.environment))
    keywords = dict(config.get("environment", {})) | ({} if floors is None else {"randomization": floors})
    with closing(make_core(training.environment, episodes, keywords)) as core:
        contract = core.contract()
        if not has_limits(measures_of(core)):
            raise InputError(f"agent '{agent}' is tuned by the limits of a task's success, and '{contract['task']}' has none")
        start = task_settings(model, contract, config, agent)
        with progress(Console(), shown=training.progress) as tell:
            best, score = search(core, make_policy, start, partial(tell, ""))
    settings = {"environment": training.environment, "agent": agent, "settings": config}
    record_provenance(training.folder, settings, start.seed)
    folder = training.folder / "policy"
    folder.mkdir(exist_ok=True)
    origin = {"environment": training.environment, "score": score, "episodes": episodes, "seed": start.seed}
    write_contract(folder, agent, best, contract, origin)
    return folder


def search(core: Core, make_policy: MakePolicy, start: PidConfig, tell: TellSearch) -> tuple[dict[str, Any], float]:
    """Return the best settings found from ``start`` on, without those of other tasks, and their score."""
    contract = core.contract()
    best = start.model_dump(mode="json") | {"tasks": {}}

    def tried(settings: Mapping[str, Any]) -> float:
        return tracking_score(core, make_policy(contract, settings), start.seed)

    tell("searching", 0.0)
    score = tried(best)
    steps, rounds = dict(start.search.steps), start.search.rounds
    for done in range(rounds):
        present = list(steps.items())
        for index, (name, step) in enumerate(present):
            tell(f"searching: error {score:.4f}, now {name}", (done + index / len(present)) / rounds)
            candidates = [_changed(best, name, move, type(start)) for move in (step, -step)]
            values = [np.inf if candidate is None else tried(candidate) for candidate in candidates]
            better = int(np.argmin(values))
            if values[better] < score:
                best, score = candidates[better] or best, values[better]
            elif values[0] == values[1]:
                del steps[name]  # plays no part in this task
            else:
                steps[name] = step / 2
    return best, score


def _changed(settings: Mapping[str, Any], name: str, step: float, model: type[PidConfig]) -> dict[str, Any] | None:
    """Return the settings with one of them moved by ``step``, None where it would leave its range."""
    changed = {**settings, name: settings[name] + step}
    try:
        model(**changed)
    except ValueError:
        return None
    return changed


def tracking_score(core: Core, policy: Policy, first_seed: int) -> float:
    """Return the score of whole episodes, one per robot of ``core`` (see the module); less is better."""
    start_episodes(core, policy, first_seed)
    active = core.everyone.copy()
    while active.any():
        core.step(policy.act(core.observation), active)
        active &= ~(core.terminated | core.truncated)
    return float(Infos(core).tracking_error().mean())
