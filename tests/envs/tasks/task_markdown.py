"""Tasks and randomisations as Markdown tables: what ``docs/environments.md`` and ``docs/randomization.md`` show."""

from __future__ import annotations

from collections.abc import Sequence

from wlr_gym.envs.tasks.describe import RANDOMIZATION_HEADER, limits_text, parameters_text, randomization_rows
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.task import ObservationColumn, Task
from wlr_gym.envs.tasks.terms import COMMANDS, MEASURES, REWARDS, TERMINATIONS


def task_tables(task: Task) -> list[str]:
    """Return the lines of the tables of a task: commands, observations, rewards, terminations, measures."""
    config = task.config
    commands = [
        (f"`{name}`", f"{low:g} to {high:g}", COMMANDS[name].unit, COMMANDS[name].doc)
        for name, (low, high) in config.commands.terms.items()
    ]
    rewards = [
        (f"`{name}`", f"{values['weight']:g}", parameters_text(values, REWARDS[name].parameters), REWARDS[name].doc)
        for name, values in config.rewards.items()
    ]
    terminations = [
        (f"`{name}`", parameters_text(values, TERMINATIONS[name].parameters), TERMINATIONS[name].doc)
        for name, values in config.terminations.items()
    ]
    measures = [(f"`{name}`", MEASURES[name].unit, limits_text(config, name), MEASURES[name].doc) for name in task.measures]
    return [
        *_table(("command", "range", "unit", "meaning"), commands),
        *_table(("observation", "numbers", "unit", "frame", "scale", "meaning"), _terms(task.policy)),
        *_table(("privileged", "numbers", "unit", "frame", "scale", "meaning"), _terms(task.privileged)),
        *_table(("reward", "weight (1/s)", "parameters", "meaning"), rewards),
        *_table(("termination", "parameters", "meaning"), terminations),
        *_table(("measure", "unit", "success", "meaning"), measures)[:-1],
    ]


def randomization_table(config: RandomizationConfig, base: RandomizationConfig | None = None) -> list[str]:
    """Return the events as the lines of a table, without those that ``base`` has just so."""
    known = [] if base is None else randomization_rows(base)
    rows = [row for row in randomization_rows(config) if row not in known]
    code = [(f"`{name}`", ", ".join(f"`{item}`" for item in items.split(", ")), *rest) for name, items, *rest in rows]
    return _table(RANDOMIZATION_HEADER, code)[:-1]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    escaped = [[cell.replace("|", "\\|").replace("``", "`") for cell in row] for row in rows]
    return [f"| {' | '.join(cells)} |" for cells in [header, ["---"] * len(header), *escaped]] + [""]


def _terms(columns: Sequence[ObservationColumn]) -> list[tuple[str, ...]]:
    groups: dict[str, list[ObservationColumn]] = {}
    for column in columns:
        groups.setdefault(column.term, []).append(column)
    return [
        (
            f"`{term}`",
            str(len(group)),
            ", ".join(dict.fromkeys(column.unit for column in group)),
            group[0].frame,
            f"{group[0].scale:g}",
            group[0].doc if term != "command" else "what the robot is asked to follow",
        )
        for term, group in groups.items()
    ]
