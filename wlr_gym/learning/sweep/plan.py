"""What a sweep trains: settings x seeds as data, read from a file or made from options."""

from __future__ import annotations

import copy
import hashlib
import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from wlr_gym.base.errors import LARGEST_SEED, InputError
from wlr_gym.base.settings import SettingsModel, merge_changes, parse_config, read_yaml, require_keys
from wlr_gym.learning.training import check_environment_settings, settings_of
from wlr_gym.policy.agents import agent_function, apply_changes, load_agent

#: Setting of a trial that names one of the plan's ``variants``.
VARIANT = "variant"
#: Early stopping: after 1/9 and 1/3 of the steps the best third so far goes on; scores are needed at least so often.
REDUCTION, SCORES = 3, 9
#: Characters of a trial's name before it is cut and a hash of its settings added.
_LONGEST = 120


class NumberRange(SettingsModel):
    """Numbers that a search draws one from.

    Attributes:
        low, high: ends, both possible.
        log: draw the logarithm evenly, for numbers that differ by factors.
        whole: whole numbers only.
    """

    low: float
    high: float
    log: bool = False
    whole: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> NumberRange:
        if not self.low < self.high:
            raise ValueError(f"low {self.low:g} is not below high {self.high:g}")
        if self.log and self.low <= 0.0:
            raise ValueError(f"log needs low above 0, not {self.low:g}")
        if self.whole and not (self.low.is_integer() and self.high.is_integer()):
            raise ValueError(f"whole needs whole ends, not {self.low:g} and {self.high:g}")
        return self

    def draw(self, random: np.random.Generator) -> float | int:
        """Return one of its numbers."""
        low, high = (np.log(self.low), np.log(self.high)) if self.log else (self.low, self.high)
        if self.whole:
            return int(random.integers(int(self.low), int(self.high) + 1))
        value = random.uniform(low, high)
        return float(np.clip(np.exp(value), self.low, self.high) if self.log else value)


class SearchPlan(SettingsModel):
    """How settings are chosen, where not all of the grid are trained to their end.

    A search trains each settings with the first seed; the best of them then with the other seeds.

    Attributes:
        method: ``grid`` (all of them), ``random``, or ``optuna`` (each chosen from what the earlier ones gave; Ray Tune).
        trials: how many settings are chosen; not for a grid.
        metric: held-out score that decides.
        early_stopping: ASHA of Ray Tune: after 1/9 and 1/3 of the steps, only the best third so far goes on.
        repeat_best: how many of the best are trained with the other seeds.
        seed: of the choice.
    """

    method: Literal["grid", "random", "optuna"] = "random"
    trials: int = Field(20, gt=0)
    metric: Literal["tracking_error", "success", "excess_slip", "reward"] = "tracking_error"
    early_stopping: bool = False
    repeat_best: int = Field(3, gt=0)
    seed: int = Field(0, ge=0)


@dataclass(frozen=True)
class Trial:
    """One training of a sweep.

    Attributes:
        settings: dotted name -> value: what this trial sets.
        seed: of everything random in it.
    """

    settings: Mapping[str, Any]
    seed: int

    @property
    def label(self) -> str:
        """Its settings as text that a folder may be called: ``learning_rate=0.001,gamma=0.97``."""
        parts = []
        for name, value in self.settings.items():
            text = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
            parts.append(f"{name}=" + re.sub(r"[^\w.,+=-]", "_", text))
        label = ",".join(parts)
        if len(label) <= _LONGEST:
            return label
        return f"{label[:_LONGEST]}-{hashlib.sha256(json.dumps(dict(self.settings)).encode()).hexdigest()[:8]}"

    @property
    def name(self) -> str:
        """Name of its run folder: settings and seed."""
        return ",".join(filter(None, (self.label, f"seed={self.seed}")))


Seed = Annotated[int, Field(ge=0, le=LARGEST_SEED)]


class SweepPlan(SettingsModel):
    """A sweep, as a file says it (``wlr sweep FILE``) and as its folder keeps it (``sweep.yaml``).

    Attributes:
        environment: id.
        agent: folder of ``agents/``.
        config: its settings: name in ``configs/agent/`` or path; None = the agent's own.
        init: trained policy that every trial starts from; None = none.
        settings: changes of the settings, the same in all trials.
        space: dotted name of a setting -> its values, or a :class:`NumberRange` for a search. All combinations make the grid.
        variants: name -> dotted name of a setting -> its value: settings that belong together, as in an ablation. The names are
            the values of ``variant`` in the space.
        seeds: how many, from 0 on, or which.
        search: None = every settings of the grid with every seed.
        imports: modules that trials import first: what registers your own task.
    """

    environment: str
    agent: str = "ppo"
    config: str | None = None
    init: str | None = None
    settings: dict[str, Any] = Field(default_factory=dict)
    space: dict[str, NumberRange | Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)
    variants: dict[str, dict[str, Any]] = Field(default_factory=dict)
    seeds: Annotated[int, Field(gt=0, le=1_000_000)] | Annotated[list[Seed], Field(min_length=1)] = 5
    search: SearchPlan | None = None
    imports: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _possible(self) -> SweepPlan:
        if self.space.setdefault(VARIANT, list(self.variants)) != list(self.variants):
            raise InputError(f"space: '{VARIANT}' is none of its settings; give 'variants', and there what each of them sets")
        if not self.variants:
            del self.space[VARIANT]
        if "seed" in self.space:
            raise InputError("space: 'seed' is none of its settings; give 'seeds'")
        groups: dict[str, Mapping[str, Any]] = {"space": self.space}
        groups |= {f"variants: {name}": changes for name, changes in self.variants.items()}
        for where, key, value in [(where, *item) for where, group in groups.items() for item in group.items()]:
            if where != "space" and (key == "seed" or key in self.space):
                raise InputError(f"{where} sets '{key}', which 'seeds' or 'space' sets too")
            if key.partition(".")[0] == "tasks":
                raise InputError(f"{where}: '{key}' comes too late: 'tasks' is read with the file; name the setting itself")
            try:
                json.dumps(None if isinstance(value, NumberRange) else value)
            except TypeError as error:
                raise InputError(f"{where}: {key}: {value!r} is no setting: {error}; put words into quotes") from None
        ranges = [name for name, values in self.space.items() if isinstance(values, NumberRange)]
        if ranges and (self.search is None or self.search.method == "grid"):
            raise InputError(f"space: {', '.join(ranges)} is a range: give a list, or search with 'random' or 'optuna'")
        if self.search is not None and not self.space:
            raise InputError("search: there is no 'space' to search")
        return self

    @property
    def seed_list(self) -> list[int]:
        """The seeds themselves."""
        return list(range(self.seeds)) if isinstance(self.seeds, int) else self.seeds

    @property
    def needs_ray(self) -> bool:
        """Whether only Ray Tune can choose or stop its trials."""
        return self.search is not None and (self.search.method == "optuna" or self.search.early_stopping)

    @property
    def metric(self) -> str:
        """Held-out score that decides which settings are best."""
        return self.search.metric if self.search else "tracking_error"

    def known_settings(self) -> list[dict[str, Any]] | None:
        """Return the settings that are tried, in order: of the grid, or drawn at random; None where results decide (Optuna)."""
        if self.search is not None and self.search.method == "optuna":
            return None
        if self.search is not None and self.search.method == "random":
            random = np.random.default_rng(self.search.seed)
            drawn = [self.draw(random) for _ in range(self.search.trials)]
            return list({Trial(settings, 0).label: settings for settings in drawn}.values())  # each once
        lists = [values for values in self.space.values() if isinstance(values, list)]
        return [dict(zip(self.space, values, strict=True)) for values in itertools.product(*lists)]

    def draw(self, random: np.random.Generator) -> dict[str, Any]:
        """Return random settings out of the space."""
        return {
            name: values.draw(random) if isinstance(values, NumberRange) else values[random.integers(len(values))]
            for name, values in self.space.items()
        }

    def settings_of(self, trial: Trial) -> dict[str, Any]:
        """Return all settings of a trial, as ``wlr train`` takes them."""
        settings, own = copy.deepcopy(self.settings), dict(trial.settings)
        changes = self.variants.get(own.pop(VARIANT, ""), {}) | own
        apply_changes(settings, [f"{name}={json.dumps(value)}" for name, value in changes.items()])
        return settings | {"seed": trial.seed}


def read_plan(path: Path, changes: Mapping[str, Any] | None = None) -> SweepPlan:
    """Read a plan; ``changes`` are fields laid over the file's."""
    content = read_yaml(path)
    require_keys(SweepPlan, content, str(path))
    return parse_config(SweepPlan, merge_changes(content, changes or {}), str(path))


def trials_of(settings: Sequence[Mapping[str, Any]], seeds: Sequence[int]) -> list[Trial]:
    """Return the trials of settings x seeds.

    Raises:
        InputError: two of them have one name.
    """
    found: dict[str, Trial] = {}
    for trial in (Trial(chosen, seed) for chosen in settings for seed in seeds):
        if (other := found.setdefault(trial.name, trial)) is not trial:
            same = "the same value is given twice" if other == trial else f"{dict(other.settings)} and {dict(trial.settings)}"
            raise InputError(f"two trials are called '{trial.name}': {same}")
    return list(found.values())


def resolve(plan: SweepPlan) -> SweepPlan:
    """Return a plan with all settings in it, so that it means the same whatever happens to the files it names.

    Raises:
        InputError: unknown agent, config, environment or setting, a value that no trial can have, or two trials of one name.
    """
    agent_function(plan.agent, "train")
    settings = settings_of(plan.environment, plan.config, plan.agent, plan.init, settings=plan.settings)
    early = plan.search is not None and plan.search.early_stopping
    named = plan.settings if plan.config is None else settings
    if early and isinstance(settings.get("total_steps"), int) and "evaluate_every" not in named:
        settings["evaluate_every"] = max(1, settings["total_steps"] // SCORES)
    init = plan.init if plan.init is None or not Path(plan.init).exists() else str(Path(plan.init).resolve())
    whole = plan.model_copy(update={"config": None, "settings": settings, "init": init})
    drawn = whole.draw(np.random.default_rng(0))
    every_variant = [drawn | {VARIANT: name} for name in whole.variants] if whole.search else []  # a search may try few of them
    for several in (whole.known_settings() or [drawn], every_variant):
        for trial in trials_of(several, whole.seed_list)[:: len(whole.seed_list)]:
            chosen = whole.settings_of(trial)
            try:
                check_environment_settings(chosen)
                if hasattr(load_agent(whole.agent), "check_settings"):  # the agent can tell whether it could begin to train
                    agent_function(whole.agent, "check_settings")(chosen)
            except InputError as error:
                raise InputError(f"trial {trial.name}: {error}") from None
    if early:
        _check_early_stopping(whole)
    return whole


def _check_early_stopping(plan: SweepPlan) -> None:
    total, every = plan.settings.get("total_steps"), plan.settings.get("evaluate_every")
    if not isinstance(total, int) or not isinstance(every, int) or not 0 < every <= total // SCORES:
        raise InputError(
            f"early_stopping: settings 'evaluate_every' = {every} and 'total_steps' = {total}: expected scores at least every "
            "ninth of the steps; set evaluate_every"
        )
    if any("total_steps" in changes for changes in (plan.space, *plan.variants.values())):
        raise InputError("early_stopping: trials must be comparable at equal steps: 'total_steps' cannot be searched")
