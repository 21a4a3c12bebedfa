"""Tables of the documentation that are made from code and data; pages say where: ``<!-- table: NAME -->``.

``python .ci/docs/tables.py --write`` writes all of them into docs/tables, for readers of the repository; NAME ... prints some.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path

import measured

from studies import ablations, learning
from studies.bench import performance
from studies.bench.adapt import markdown as markdown_of_cases
from studies.bench.adapt import read_lines
from studies.bench.decide import markdown as markdown_of_decisions
from studies.bench.gap import markdown, score_answers
from studies.bench.lying_sensors import markdown as markdown_of_faults
from studies.paper.verdicts import verdict_table
from wlr_gym.base.paths import config_names
from wlr_gym.data.excitations import EXCITATIONS
from wlr_gym.data.format import COLUMNS, Column
from wlr_gym.envs.registry import ENVIRONMENTS
from wlr_gym.envs.settings import EnvironmentOptions
from wlr_gym.envs.tasks import load_randomization, load_task
from wlr_gym.envs.tasks.describe import (
    RANDOMIZATION_HEADER,
    limits_text,
    observation_meanings,
    parameters_text,
    randomization_rows,
)
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.task import ObservationColumn, Task, scales_of
from wlr_gym.envs.tasks.terms import COMMANDS, MEASURES, REWARDS, TERMINATIONS
from wlr_gym.learning.evaluation.scoring import acceptance_rows, read_acceptance
from wlr_gym.physics.effects import EFFECTS
from wlr_gym.physics.effects.effect import EffectParameter
from wlr_gym.physics.effects.library import coordinates, places
from wlr_gym.physics.floor import load_floor
from wlr_gym.physics.plants.forces import FEATURES
from wlr_gym.robot import JOINTS, load_robot

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "tables"
DATA = ROOT / "docs" / "data"
ANSWERS = DATA / "gap_answers.json"
TYRE_ANSWERS = DATA / "tyre_answers.json"
LIMITS = ROOT / "configs" / "hardware" / "nominal.yaml"
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))
#: Randomisations that are laid over ``nominal``.
PRESETS = ("ice", "split", "patches", "slippery", "asymmetric", "slope", "stripes", "ribbed")
_OBSERVATION = ("numbers", "unit", "frame", "scale", "meaning")


def effect_table() -> list[str]:
    """Return the library of effects: ``wlr effects``."""
    rows = [
        (
            f"`{effect.name}`",
            effect.doc,
            f"`{effect.equation}`",
            ", ".join(parameter_text(f"`{name}`", parameter) for name, parameter in effect.parameters.items()),
            places(effect),
        )
        for effect in EFFECTS.values()
    ]
    return _table(("name", "what is missing", "law", "parameters [plausible range]", "where"), rows)


def coordinate_table() -> list[str]:
    """Return where a formula may act: ``wlr effects unknown_effect``."""
    rows = [(_code(names), unit, meaning) for names, unit, meaning in coordinates()]
    return _table(("where", "unit", "meaning"), rows)


def feature_table() -> list[str]:
    """Return what a formula may depend on: ``wlr effects unknown_effect``."""
    rows = [(f"`{name}`", feature.unit, feature.doc, feature.scope) for name, feature in FEATURES.items()]
    return _table(("name", "unit", "meaning", "of the"), rows)


def column_table() -> list[str]:
    """Return the columns of a run; those of all joints, or of some axes, that are alike share a line."""
    alike: dict[tuple[str, str], list[Column]] = {}
    for column in COLUMNS.values():
        alike.setdefault((column.name.partition("_")[0], column.doc), []).append(column)
    rows = []
    for (kind, doc), same in alike.items():
        joints = same[0].name.endswith(JOINTS)
        names = [f"{kind}_<j>"] if joints else [column.name for column in same]
        units = list(dict.fromkeys(column.unit for column in same))
        unit = f"{units[0]} (legs), {units[1]} (wheels)" if len(units) > 1 else units[0]
        rows.append((_code(names), unit, doc, "no" if same[0].required else "yes"))
    return _table(("column", "unit", "meaning", "may be missing"), rows)


def motion_table() -> list[str]:
    """Return the excitations: ``wlr record --list``."""
    rows = [(f"`{name}`", excitation.doc, excitation.shows) for name, excitation in EXCITATIONS.items()]
    return _table(("motion", "what the robot does", "what it shows"), rows)


def limit_table() -> list[str]:
    """Return the safety limits of the nominal robot; the comments of its file are units and reasons."""
    section = LIMITS.read_text(encoding="utf-8").partition("\nsafety:\n")[2]
    rows = [(f"`{name}`", value, why) for name, value, why in re.findall(r"^  (\w+): (\S+) +# (.+)$", section, re.MULTILINE)]
    return _table(("limit", "nominal", "unit: reason"), rows)


def acceptance_table() -> list[str]:
    """Return the stored acceptance tests of the shipped policies."""
    header, rows = [], []
    for stored in map(read_acceptance, sorted((DATA / "acceptance").glob("*.json"))):
        header, *losses = acceptance_rows(stored)
        sensors = ", ".join(stored.sensors or ()) or "neither"
        rows += [(f"`{stored.policy}`", sensors, f"{stored.blocks} x {stored.episodes}", *loss) for loss in losses]
    return _table(("policy", "robot has", "episodes", *header), rows)


def blind_test_table(answers: Path) -> list[str]:
    """Return the score of stored answers of a blind test; its data are not needed."""
    return markdown(score_answers(answers)).splitlines()


def result_table(task: str) -> list[str]:
    """Return the scores of a task's trained seeds."""
    return _table(learning.HEADER, learning.table(task))


def simulator_table() -> list[str]:
    """Return the shipped policies' tracking errors on both simulators: what ``wlr evaluate --backend both --json`` printed."""
    rows = []
    for card in json.loads((DATA / "both_simulators.json").read_text(encoding="utf-8")):
        said, sensors = card["conditions"], card["conditions"]["sensors that not every robot has"]
        for policy in card["policies"]:
            scores = [found["policies"][policy]["tracking_error"] for found in (card, card["other_plant"])]
            errors = [f"{one['mean']:.3f} [{one['low']:.3f}, {one['high']:.3f}]" for one in scores]
            rows.append((said["environment"], f"`{policy}`", "neither" if sensors == "none" else sensors, *errors))
    return _table(("task", "policy", "robot has", "tracking error, engine", "on MuJoCo"), rows)


def measured_table(name: str) -> list[str]:
    """Return a table of what was measured once."""
    header, rows = measured.TABLES[name]
    return _table(header, list(rows()))


def ablation_table() -> list[str]:
    """Return what each part of Velocity's recipe is worth."""
    return _table(ablations.HEADER, ablations.rows())


def adapt_table() -> list[str]:
    """Return the cases of ``python -m studies.bench adapt`` that were run."""
    return markdown_of_cases(read_lines(DATA / "adapt.jsonl")).strip().splitlines()


def decide_table() -> list[str]:
    """Return the robots of ``python -m studies.bench decide`` that were run."""
    return markdown_of_decisions(json.loads((DATA / "decide.json").read_text(encoding="utf-8"))).strip().splitlines()


def lying_table() -> list[str]:
    """Return what becomes of sensors that lie: what ``python -m studies.bench.lying_sensors`` measured."""
    return markdown_of_faults(json.loads((DATA / "lying_sensors.json").read_text(encoding="utf-8")))


def parameter_text(name: str, parameter: EffectParameter) -> str:
    """Return ``torque N m [0, 2]``: name, unit and prior range; in brackets if it may be left out."""
    low, high = parameter.prior
    text = f"{name} {parameter.unit} [{low:.3g}, {high:.3g}]"
    return f"({text})" if parameter.optional else text


def floor_table() -> list[str]:
    """Return the floors that ship, and what of each a seed draws."""
    rows = []
    for floor in map(load_floor, config_names("floor")):
        drawn = [
            f"`{place}`" + ("" if isinstance(span, str) else f" {span[0]:g} to {span[1]:g}")
            for place, span in floor.randomise.items()
        ]
        rows.append((f"`{floor.name}`", floor.summary, ", ".join(drawn) or "-"))
    return _table(("name", "what it is", "drawn by the seed"), rows)


def keyword_table() -> list[str]:
    """Return the keywords of ``gym.make`` with their defaults: ``help(wlr_gym.EnvironmentOptions)``."""
    _, _, attributes = str(inspect.getdoc(EnvironmentOptions)).partition("Attributes:\n")
    told = dict(re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", attributes, re.MULTILINE))
    defaults = {field.name: field.default for field in fields(EnvironmentOptions)}
    rows = [(f"`{name}`", f"`{defaults.get(name)!r}`", " ".join(text.split())) for name, text in told.items()]
    return _table(("keyword", "default", "what it takes"), rows)


def script_table() -> list[str]:
    """Return the first sentence of every example."""
    documents = {path.name: ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) for path in SCRIPTS}
    rows = [(f"`{name}`", " ".join(str(text).split("\n\n")[0].split())) for name, text in documents.items()]
    return _table(("script", "shows"), rows)


def all_tasks() -> dict[str, Task]:
    """Return the shipped tasks by their titles."""
    return {env_id.split("-")[1]: load_task(name, load_robot()) for env_id, name in ENVIRONMENTS.items()}


def shared_tables() -> list[str]:
    """Return the tables of all tasks together: shared observations, rewards, terminations, measures."""
    tasks = all_tasks()
    policy = _shared([_terms(task) for task in tasks.values()])
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
        "",
        *_table(("reward: weight (1/s)", *tasks, "parameters", "meaning"), rewards),
        "",
        *_table(("termination", "parameters", "meaning"), terminations),
        "",
        *_table(("measure", "unit", *tasks, "meaning"), measures),
    ]


def task_tables(title: str) -> list[str]:
    """Return the tables of one task: its commands, and the observations that not all tasks have."""
    tasks = all_tasks()
    task = tasks[title]
    commands = [
        (f"`{name}`", f"{low:g} to {high:g}", COMMANDS[name].unit, COMMANDS[name].doc)
        for name, (low, high) in task.config.commands.terms.items()
    ]
    shared = _shared([_terms(other) for other in tasks.values()])
    own = [row for row in _terms(task) if row not in shared]
    header = ("command", "range", "unit", "meaning")
    return [*_table(header, commands), "", *_table(("observation", *_OBSERVATION), own)]


def randomization_table(name: str) -> list[str]:
    """Return what a randomisation draws; events that are drawn alike share a line."""
    alike: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for event, items, *rest in randomization_rows(_randomization(name)):
        alike.setdefault(tuple(rest), []).append((event, items))
    rows = [(_code(event for event, _ in same), _code(items for _, items in same), *rest) for rest, same in alike.items()]
    return _table(RANDOMIZATION_HEADER, rows)


def preset_table() -> list[str]:
    """Return what presets draw otherwise than ``nominal``."""
    known = randomization_rows(_randomization("nominal"))
    rows = [
        (f"`{preset}`", _code([name]), _code([items]), *rest)
        for preset in PRESETS
        for name, items, *rest in (row for row in randomization_rows(_randomization(preset)) if row not in known)
    ]
    return _table(("preset", *RANDOMIZATION_HEADER), rows)


def _randomization(name: str) -> RandomizationConfig:
    return load_randomization(name, load_robot()).config


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
    """The limit of success of a measure, and its scale in the tracking error; empty in tasks that have no such measure."""
    if name not in task.measures:
        return ""
    scales = [f"scale {scale:g}" for (measure, _), scale in scales_of(task.config).items() if measure == name]
    return ", ".join([limits_text(task.config, name), *scales])


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    escaped = [[cell.replace("|", "\\|").replace("``", "`") for cell in row] for row in rows]
    return [f"| {' | '.join(cells)} |" for cells in [header, ["---"] * len(header), *escaped]]


def _terms(task: Task) -> list[tuple[str, ...]]:
    groups: dict[str, list[ObservationColumn]] = {}
    for column in task.policy:
        groups.setdefault(column.term, []).append(column)
    return [
        (
            f"`{term}`",
            str(len(group)),
            ", ".join(dict.fromkeys(column.unit for column in group)),
            group[0].frame,
            f"{group[0].scale:g}",
            meaning,
        )
        for (term, group), (_, meaning) in zip(groups.items(), observation_meanings(task.policy), strict=True)
    ]


#: Name in a page's mark -> what makes the lines of the table.
TABLES: dict[str, Callable[[], list[str]]] = {
    "effects": effect_table,
    "coordinates": coordinate_table,
    "features": feature_table,
    "columns": column_table,
    "motions": motion_table,
    "keywords": keyword_table,
    "floors": floor_table,
    "terms": shared_tables,
    **{title: partial(task_tables, title) for title in ("Velocity", "Path", "Posture", "Slope")},
    "nominal": partial(randomization_table, "nominal"),
    "wide": partial(randomization_table, "wide"),
    "presets": preset_table,
    **{name: partial(lambda name: performance.made()[name], name) for name in ("speed", "batch", "machines", "engine")},
    "equations": verdict_table,
    "adapt": adapt_table,
    "decide": decide_table,
    "lying_sensors": lying_table,
    **{f"results_{task}": partial(result_table, task) for task in learning.ROWS},
    "both_simulators": simulator_table,
    **{name: partial(measured_table, name) for name in measured.TABLES},
    "ablations": ablation_table,
    "scripts": script_table,
    "blind_test": partial(blind_test_table, ANSWERS),
    "tyre_test": partial(blind_test_table, TYRE_ANSWERS),
    "acceptance": acceptance_table,
    "limits": limit_table,
}


def table_files() -> dict[str, str]:
    """Return the text of every file of docs/tables."""
    note = "*Made by `python .ci/docs/tables.py --write`.*"
    return {f"{name}.md": "\n".join([note, "", *lines()]) + "\n" for name, lines in TABLES.items()}


if __name__ == "__main__":
    if sys.argv[1:] == ["--write"]:
        for file, text in table_files().items():
            (FOLDER / file).write_text(text, encoding="utf-8")
    else:
        for name in sys.argv[1:]:
            print("\n".join(TABLES[name]()), end="\n\n")
