"""Rewards, terminations, measures and computed observations of a task, traced from their terms into compiled loops over robots.

Weights, parameters and the robot's numbers are run-time inputs: changing them compiles nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks.signals import PRESENCE, START, Signals, Value
from wlr_gym.envs.tasks.task import Task
from wlr_gym.envs.tasks.terms import COMPUTED, MEASURES, REWARDS, SCALARS, TERMINATIONS
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.codegen import Graph, emit, load_module, ops, straight_line_source
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT
from wlr_gym.robot import JOINTS

Array = NDArray[np.float64]


#: The signals of a control step, a matrix each, float64 and C-contiguous, one row per robot. ``clock`` has the one column
#: ``time``; ``presence`` says which sensors there are. ``computed`` holds the computed observations, which rewards,
#: terminations and measures do not read; while these are computed it still holds those of the step before (``remembered``).
MATRICES = ("sensors", "estimate", "truth", "command", "action", "previous_action", "start", "clock", "presence", "computed")


class Scores(NamedTuple):
    """What a control step is worth.

    Weighted reward ``terms`` (N, T), their ``total`` (N,) and ``sums`` (N, T) over the episode, termination terms ``over``
    (N, K), ``measures`` (N, M), and of these over the episode the sum of ``squares`` and the ``largest`` magnitude (N, M).
    """

    terms: Array
    total: Array
    over: Array
    sums: Array
    measures: Array
    squares: Array
    largest: Array

    @classmethod
    def zeros(cls, task: Task, count: int) -> Scores:
        """Return the scores of ``count`` robots on a task before their first step."""
        rewards, ends, measures = ((count, len(names)) for names in (task.rewards, task.terminations, task.measures))
        return cls(
            terms=np.zeros(rewards),
            total=np.zeros(count),
            over=np.zeros(ends),
            sums=np.zeros(rewards),
            measures=np.zeros(measures),
            squares=np.zeros(measures),
            largest=np.zeros(measures),
        )


@dataclass(frozen=True)
class TermKernel:
    """Terms of a task, compiled.

    Attributes:
        run: takes ``active`` (N,), whose rows to do, a plain tuple of :data:`MATRICES`, and ``numbers``. That of rewards,
            terminations and measures also takes a plain tuple of :class:`Scores`, writes them, and returns the first robot
            whose reward or measure is not finite or whose termination is no number, or -1; that of computed observations
            writes ``computed``. (numba takes twice as long to receive a named tuple as a plain one.)
        numbers: (P,) weights, parameters and robot numbers in the order the kernel reads them.
    """

    run: Callable[..., Any]
    numbers: Array


def expressions(task: Task, read: Callable[[str], Value]) -> dict[str, Value]:
    """Return ``over.<term>``, ``term.<term>``, ``total`` and ``measure.<measure>`` for signals read by ``read`` (numpy arrays
    or trace nodes)."""
    signals = Signals(read)
    outputs: dict[str, Value] = {}
    for name in task.terminations:
        outputs[f"over.{name}"] = _value(signals, read, "termination", TERMINATIONS[name])
    for value in list(outputs.values()):
        signals.terminated = ops.maximum(signals.terminated, ops.where_positive(value, 1.0, 0.0))
    total: Value = 0.0
    for name in task.rewards:
        weight = read(f"reward.{name}.weight") * signals.control_period
        outputs[f"term.{name}"] = weight * _value(signals, read, "reward", REWARDS[name])
        total = total + outputs[f"term.{name}"]
    measures = {f"measure.{name}": _value(signals, read, "measure", MEASURES[name]) for name in task.measures}
    return {**outputs, "total": total, **measures}


def not_finite(task: Task, scores: Scores, row: int) -> list[str]:
    """Return the terms of a task, such as ``reward 'slip'``, whose values for one robot are not finite."""
    groups = (
        ("termination", task.terminations, np.isnan(scores.over[row])),  # an infinite one is fine
        ("reward", task.rewards, ~np.isfinite(scores.terms[row])),
        ("measure", task.measures, ~np.isfinite(scores.measures[row])),
    )
    return [f"{kind} '{name}'" for kind, names, bad in groups for name, wrong in zip(names, bad, strict=True) if wrong]


def computed_expressions(task: Task, read: Callable[[str], Value]) -> dict[str, Value]:
    """Return the computed observations by element for signals read by ``read``."""
    signals = Signals(read)
    outputs: dict[str, Value] = {}
    for name in task.computed_terms:
        elements = COMPUTED[name].elements
        result = _result(f"observation term '{name}'", COMPUTED[name].function, signals)
        values = list(result) if isinstance(result, Iterable) else None
        if values is None or len(values) != len(elements):
            got = "no list" if values is None else f"{len(values)} of {len(elements)} values"
            raise InputError(f"observation term '{name}' returned {got}: expected [{', '.join(elements)}]")
        outputs |= zip(elements, values, strict=True)
    return outputs


def _value(signals: Signals, read: Callable[[str], Value], kind: str, term: Any) -> Value:
    parameters = {name: read(f"{kind}.{term.name}.{name}") for name in term.parameters}
    value = _result(f"{kind} '{term.name}'", term.function, signals, **parameters)
    if value is None or isinstance(value, list | tuple | dict | str):
        raise InputError(f"{kind} '{term.name}' returned {type(value).__name__}: expected a single number")
    return value


def _result(term: str, function: Callable[..., Any], signals: Signals, **parameters: Value) -> Any:
    """Return what a term's function returns; Python and numpy can do less with a value that is traced than ``ops``."""
    try:
        return function(signals, **parameters)
    except TypeError as error:
        if "Node" not in str(error) and "traced value" not in str(error):
            raise
        raise InputError(f"{term}: a traced value (Node) cannot do this: {error}; {_INSTEAD}") from error


_INSTEAD = (
    "use + - * / and the functions of wlr_gym.physics.codegen.ops: ops.where_positive for if and comparisons, x * x for x**2, "
    "ops.absolute for abs, ops.exp for np.exp"
)


def constants(task: Task) -> Mapping[str, float]:
    """Return the run-time numbers of a task by name, without those of the robot."""
    config = task.config
    values = {"task.control_period": config.control_period}
    values |= {f"task.action.{name}": scale for name, scale in config.action}
    values |= {f"controller.{name}": gain for name, gain in config.controller or ()}
    for group, registry in SCALARS.items():
        for name, given in getattr(config, group).items():
            merged = {**registry[name].parameters, **given}
            values |= {f"{group.removesuffix('s')}.{name}.{key}": float(value) for key, value in merged.items()}
    return values


def number(task: Task, name: str) -> float:
    """Return the run-time number ``name`` (``reward.slip.weight``, ``robot.leg.length``); what no term keeps is 0."""
    if name.startswith("remembered.") and "_memory[" in name:
        return 0.0
    if not name.startswith("robot."):
        return constants(task)[name]
    value: Any = task.robot
    for part in name.split(".")[1:]:
        value = getattr(value, part)
    return float(value)


def matrix_columns(task: Task) -> dict[str, tuple[str, int]]:
    """Return signal name -> (matrix, column) for everything that differs from robot to robot and step to step."""
    groups = {
        "sensors": ("sensors.{}", SENSOR_LAYOUT.elements),
        "estimate": ("estimate.{}", ESTIMATE_LAYOUT.elements),
        "truth": ("truth.{}", TRUTH_LAYOUT.elements),
        "command": ("command.{}", task.commands),
        "action": ("action[{}]", JOINTS),
        "previous_action": ("previous_action[{}]", JOINTS),
        "start": ("start[{}]", START),
        "clock": ("{}", ("time",)),
        "presence": ("presence[{}]", PRESENCE),
        "computed": ("remembered.{}", task.computed),
    }
    return {
        pattern.format(element): (matrix, column)
        for matrix, (pattern, elements) in groups.items()
        for column, element in enumerate(elements)
    }


def reader(task: Task, matrices: Mapping[str, Array]) -> Callable[[str], Value]:
    """Return a ``read`` on numpy matrices: the reference that the compiled kernel is tested against."""
    columns = matrix_columns(task)

    def read(name: str) -> Value:
        if name in columns:
            matrix, column = columns[name]
            return matrices[matrix][:, column]
        return number(task, name)

    return read


def compile_scores(task: Task) -> TermKernel:
    """Trace and compile the rewards, terminations and measures of a task."""
    stores = {"total": "total[i]"}
    stores |= {f"over.{name}": f"over[{k}]" for k, name in enumerate(task.terminations)}
    stores |= {f"term.{name}": f"terms[{k}]" for k, name in enumerate(task.rewards)}
    stores |= {f"measure.{name}": f"measures[{k}]" for k, name in enumerate(task.measures)}
    outputs = expressions(task, Graph().input)
    written = {name: f"numbers_of({name}[i])" for name in ("terms", "over", "measures")} | {
        "total": "numbers_of(total)",
        "i": "i",
    }
    return _compile(task, "evaluation", outputs, stores, written, _SCORES_HEAD, _SCORES_TAIL)


def compile_computed(task: Task) -> TermKernel:
    """Trace and compile the computed observations of a task."""
    outputs = computed_expressions(task, Graph().input)
    stores = {element: f"computed[{k}]" for k, element in enumerate(task.computed)}
    return _compile(task, "computation", outputs, stores, {}, _COMPUTED_HEAD, ())


def _compile(
    task: Task,
    kind: str,
    outputs: Mapping[str, Value],
    stores: Mapping[str, str],
    written: Mapping[str, str],
    head: Sequence[str],
    tail: Sequence[str],
) -> TermKernel:
    columns = matrix_columns(task)
    numbers: dict[str, int] = {}

    def load(name: str) -> str:
        if name in columns:
            matrix, column = columns[name]
            return f"{matrix}[{column}]"
        return f"numbers[{numbers.setdefault(name, len(numbers))}]"

    lines = emit(outputs, load, lambda name, value: f"{stores[name]} = {value}", "")
    arguments = {name: f"numbers_of({name}[i])" for name in MATRICES} | {"numbers": "numbers_of(numbers)"} | dict(written)
    block = straight_line_source("terms_of_robot", list(arguments), lines)
    call = f"        terms_of_robot({', '.join(arguments.values())})"
    source = "\n".join([*block, "", _DECORATOR, *head, call, *tail, ""])
    name = task.config.name
    module = load_module(f"{kind}_{name}", source, f"wlr_gym: compiling the {kind} of task '{name}' (once)")
    return TermKernel(module.run, np.array([number(task, name) for name in numbers], dtype=np.float64))


_DECORATOR = "@compiled(error_model='numpy')"
_UNPACK = f"    {', '.join(MATRICES)} = signals"
_SCORES_HEAD = (
    "def run(active, signals, numbers, scores):",
    _UNPACK,
    f"    {', '.join(Scores._fields)} = scores",
    "    bad = -1",
    "    for i in range(total.shape[0]):",
    "        if not active[i]:",
    "            total[i] = 0.0",
    "            terms[i, :] = 0.0",
    "            over[i, :] = 0.0",
    "            measures[i, :] = 0.0",
    "            continue",
)
_SCORES_TAIL = (
    "        check = total[i]",
    "        for k in range(over.shape[1]):",
    "            if math.isnan(over[i, k]):",
    "                check = over[i, k]",
    "        for k in range(terms.shape[1]):",
    "            sums[i, k] += terms[i, k]",
    "        for k in range(measures.shape[1]):",
    "            check += measures[i, k]",
    "            squares[i, k] += measures[i, k] ** 2",
    "            largest[i, k] = max(largest[i, k], abs(measures[i, k]))",
    "        if bad < 0 and not math.isfinite(check):",
    "            bad = i",
    "    return bad",
)
_COMPUTED_HEAD = (
    "def run(active, signals, numbers):",
    _UNPACK,
    "    for i in range(computed.shape[0]):",
    "        if not active[i]:",
    "            continue",
)
