"""Tasks and randomisations as Markdown tables: what ``docs/environments.md`` and ``docs/randomization.md`` show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from wlr_gym.envs.tasks.describe import RANDOMIZATION_HEADER, limits_text, parameters_text, randomization_rows
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.task import ObservationColumn, Task
from wlr_gym.envs.tasks.terms import COMMANDS, MEASURES, REWARDS, TERMINATIONS

_OBSERVATION = ("numbers", "unit", "frame", "scale", "meaning")


def shared_tables(tasks: Mapping[str, Task]) -> list[str]:
    """Return the lines of the tables of all tasks together: shared observations, rewards, terminations, measures."""
    policy = _shared([_terms(task.policy) for task in tasks.values()])
    rewards = [
        (
            f"`{name}`",
            *(f"{task.config.rewards[name]['weight']:g}" if name in task.config.rewards else "" for task in tasks.values()),
            _parameters({title: task.config.rewards.get(name) for title, task in tasks.items()}, REWARDS[name].parameters),
            REWARDS[name].doc,
        )
        for name in _names(task.config.rewards for task in tasks.values())
    ]
    terminations = [
        (
            f"`{name}`",
            _parameters({title: task.config.terminations.get(name) for title, task in tasks.items()}, term.parameters),
            term.doc,
        )
        for name, term in ((name, TERMINATIONS[name]) for name in _names(task.config.terminations for task in tasks.values()))
    ]
    measures = [
        (f"`{name}`", MEASURES[name].unit, *(_measure_cell(task, name) for task in tasks.values()), MEASURES[name].doc)
        for name in _names(task.measures for task in tasks.values())
    ]
    return [
        *_table(("observation", *_OBSERVATION), policy),
        *_table(("reward: weight (1/s)", *tasks, "parameters", "meaning"), rewards),
        *_table(("termination", "parameters", "meaning"), terminations),
        *_table(("measure", "unit", *tasks, "meaning"), measures)[:-1],
    ]


def task_tables(task: Task, tasks: Mapping[str, Task]) -> list[str]:
    """Return the lines of the tables of one task: its commands, and the observations that not all ``tasks`` have."""
    commands = [
        (f"`{name}`", f"{low:g} to {high:g}", COMMANDS[name].unit, COMMANDS[name].doc)
        for name, (low, high) in task.config.commands.terms.items()
    ]
    shared = _shared([_terms(other.policy) for other in tasks.values()])
    own = [row for row in _terms(task.policy) if row not in shared]
    tables = _table(("command", "range", "unit", "meaning"), commands) + _table(("observation", *_OBSERVATION), own)
    return tables[:-1]


def randomization_table(config: RandomizationConfig) -> list[str]:
    """Return the events as the lines of a table; events that are drawn alike share a line."""
    alike: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for name, items, *rest in randomization_rows(config):
        alike.setdefault(tuple(rest), []).append((name, items))
    rows = [(_code(name for name, _ in same), _code(items for _, items in same), *rest) for rest, same in alike.items()]
    return _table(RANDOMIZATION_HEADER, rows)[:-1]


def preset_table(configs: Mapping[str, RandomizationConfig], base: RandomizationConfig) -> list[str]:
    """Return what presets draw otherwise than ``base``, as the lines of one table."""
    known = randomization_rows(base)
    rows = [
        (f"`{preset}`", _code([name]), _code([items]), *rest)
        for preset, config in configs.items()
        for name, items, *rest in (row for row in randomization_rows(config) if row not in known)
    ]
    return _table(("preset", *RANDOMIZATION_HEADER), rows)[:-1]


def _code(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for text in names for name in text.split(", "))


def _shared(groups: Sequence[list[tuple[str, ...]]]) -> list[tuple[str, ...]]:
    return [row for row in groups[0] if all(row in group for group in groups)]


def _names(groups: Iterable[Iterable[str]]) -> list[str]:
    """Every name once, in the order of the first group that has it."""
    return list(dict.fromkeys(name for group in groups for name in group))


def _parameters(values: Mapping[str, Mapping[str, float] | None], defaults: Mapping[str, float]) -> str:
    """Parameters of a term in the tasks that have it: once where all have the same, else task by task."""
    texts = {title: parameters_text(dict(given), dict(defaults)) for title, given in values.items() if given is not None}
    return next(iter(texts.values())) if len(set(texts.values())) == 1 else "; ".join(map(": ".join, texts.items()))


def _measure_cell(task: Task, name: str) -> str:
    return limits_text(task.config, name) if name in task.measures else ""


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
