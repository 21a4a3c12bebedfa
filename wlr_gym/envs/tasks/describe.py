"""What a task is, for people (sections with tables) and for machines (the contract a policy file carries)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import Any

from wlr_gym.envs.tasks.entries import AreaConfig, EventConfig
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.scaling import QUANTITIES, quantities_of, scaled_numbers
from wlr_gym.envs.tasks.task import ObservationColumn, Task, TaskConfig, limits_within
from wlr_gym.envs.tasks.terms import COMMANDS, MEASURES, REWARDS, TERMINATIONS
from wlr_gym.robot import Robot, load_robot, robot_content, robot_hash, servo_hash
from wlr_gym.robot.parameter_table import spec_of


@dataclass(frozen=True)
class DescriptionPart:
    """Part of a description: a title, what it says in a sentence or two, and a table, which has no rows where there is none."""

    title: str
    sentence: str
    headings: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def describe(task: Task) -> str:
    """Return the task's action, observation, command, reward, termination and measure tables as text (reStructuredText)."""
    sections = task_sections(task)
    return "\n".join(line for one in sections for line in (f"**{one.title}** {one.sentence}", "", *_simple_table(one)))


def _simple_table(section: DescriptionPart) -> list[str]:
    if not section.rows:
        return []
    widths = [max(map(len, column)) for column in zip(section.headings, *section.rows, strict=True)]
    rule = ["=" * width for width in widths]
    lines = (rule, section.headings, rule, *section.rows, rule, ())
    return ["  ".join(map(str.ljust, line, widths)).rstrip() for line in lines]


def task_sections(task: Task) -> list[DescriptionPart]:
    """Return what a task is: action, observation, commands, reward, end of the episode, measures."""
    config = task.config
    commands = [
        (name, COMMANDS[name].unit, COMMANDS[name].frame, f"[{low:g}, {high:g}]{_ramp(config, name)}", COMMANDS[name].doc)
        for name, (low, high) in config.commands.terms.items()
    ]
    rewards = [
        (name, f"{values['weight']:g}", parameters_text(values, REWARDS[name].parameters), REWARDS[name].doc)
        for name, values in config.rewards.items()
    ]
    terminations = [
        (name, parameters_text(values, TERMINATIONS[name].parameters), TERMINATIONS[name].doc)
        for name, values in config.terminations.items()
    ]
    measures = [(name, MEASURES[name].unit, limits_text(config, name), MEASURES[name].doc) for name in task.measures]
    policy, exact = _observation_rows(config, task.policy), _observation_rows(config, task.privileged)
    sensors = [f"{name} with probability {share:g}" for name, share in config.sensors if share is not None]
    boxes = [f"Box(({len(columns)},), float32)" for columns in (task.policy, task.privileged)]
    space = f"Box(-1, 1, ({len(task.actions)},), float32): setpoint = clip(centre + scale * action, range)"
    success = "in core.measures; an episode is a success when nothing terminated it and all limits hold"
    end = f"after {config.episode_length:g} s ({task.episode_steps} control steps of {1000 * config.control_period:g} ms)"
    return [
        DescriptionPart("Action", space, _ACTION, _action_rows(task)),
        DescriptionPart("Observation", f"{boxes[0]}: {_READING}", (*_COLUMNS, "noise", "delay (ms)"), policy),
        DescriptionPart("Observation", "what each reading is", ("name", "meaning"), observation_meanings(task.policy)),
        DescriptionPart(
            "Privileged observation", f'{boxes[1]}, exact; with observation="dict"', _COLUMNS, [row[:-2] for row in exact]
        ),
        DescriptionPart(
            "Privileged observation", "what each number is", ("name", "meaning"), observation_meanings(task.privileged)
        ),
        *([DescriptionPart("Sensors", f"present per episode: {', '.join(sensors)}")] if sensors else []),
        DescriptionPart("Commands", _timing(config), ("command", "unit", "frame", "range, largest rate", "meaning"), commands),
        DescriptionPart(
            "Reward", "sum of weight * term * control period", ("term", "weight (1/s)", "parameters", "meaning"), rewards
        ),
        DescriptionPart("Terminated", "when a term is greater than 0", ("term", "parameters", "meaning"), terminations),
        DescriptionPart("Measured", success, ("measure", "unit", "limits", "meaning"), measures),
        DescriptionPart("Truncated", end),
    ]


def parameters_text(values: dict[str, float], defaults: dict[str, float]) -> str:
    """Return ``width 0.06, ...`` for the parameters of a term."""
    return ", ".join(f"{name} {values.get(name, default):g}" for name, default in defaults.items()) or "-"


def _timing(config: TaskConfig) -> str:
    (low, high), stop = config.commands.hold_time, config.commands.zero_probability
    drawn = "drawn once per episode" if low > config.episode_length else f"drawn anew every {low:g} to {high:g} s"
    return f"{drawn}, all zero with probability {stop:g}" if stop else drawn


def _ramp(config: TaskConfig, command: str) -> str:
    return f", {config.commands.ramp[command]:g} /s" if command in config.commands.ramp else ""


def limits_text(config: TaskConfig, measure: str) -> str:
    """Return ``rms at most 0.02 m/s`` for a measure that success depends on."""
    bounds = config.success.get(measure)
    limits = {} if bounds is None else limits_within(bounds)
    unit = "" if MEASURES[measure].unit == "-" else f" {MEASURES[measure].unit}"
    return ", ".join(f"{kind} at most {limit:g}{unit}" for kind, limit in limits.items()) or "-"


_ACTION = ("joints", "index", "setpoint", "unit", "range", "centre", "scale")
_COLUMNS = ("name", "index", "unit", "frame", "range", "scale", "components")
_READING = (
    "value = scale * clip(reading - offset, +-limit). Range: offset +-limit. Noise: the sensor's own (1 sigma, or one count of "
    "an encoder) + the task's, and the task's bias (1 sigma)."
)


def _action_rows(task: Task) -> list[tuple[str, ...]]:
    return [
        (", ".join(a.joint for a in same), index, one.quantity, one.unit, f"[{one.low:.4g}, {one.high:.4g}]",
         f"{one.centre:.4g}", f"{one.scale:g}")
        for index, one, same in _alike(task.actions, lambda column: replace(column, joint=""))
    ]  # fmt: skip


def _observation_rows(config: TaskConfig, columns: Sequence[ObservationColumn]) -> list[tuple[str, ...]]:
    """Return one row per observation term and age: its columns differ in component, and some in unit."""
    rows = []
    for index, one, same in _alike(columns, lambda column: (column.term, column.lag)):
        name = f"{one.term}, lag {one.lag} (steps)" if one.lag else one.term
        units = [column.unit for column in same]
        unit = ", ".join(units if len(set(units)) > 1 else units[:1])
        span = f"{one.offset:.4g} +-{one.limit:.4g}" if one.offset else f"+-{one.limit:.4g}"
        components = _components([label for column in same if (label := _label(column))])
        rows.append((name, index, unit, one.frame, span, f"{one.scale:.4g}", components, _noise(one), _delay(config, one)))
    return rows


def _alike(columns: Sequence[Any], key: Callable[[Any], Any]) -> Iterator[tuple[str, Any, list[Any]]]:
    """Return columns that follow each other and have the same key, each time their indices (``6-9``), the first, and all."""
    first = 0
    for _, group in groupby(columns, key):
        same = list(group)
        yield f"{first}-{first + len(same) - 1}" if same[1:] else str(first), same[0], same
        first += len(same)


def _components(labels: list[str]) -> str:
    """Return ``leg_lf, leg_rf`` for labels; ``wheel_lf, wheel_rf: each x, y`` where they are all pairs of these."""
    parts = [list(dict.fromkeys(part)) for part in zip(*(label.split(",") for label in labels), strict=False)]
    paired = [",".join(pair) for pair in product(*parts)] == labels
    return ": each ".join(map(", ".join, parts if paired else [labels])) or "-"


def _noise(column: ObservationColumn) -> str:
    """Return ``0.001 + 0.02, bias 0.1``: of the sensor, what the task adds, and its bias."""
    added = f" + {column.noise:.4g}" if column.noise else ""
    return f"{column.sensor_noise:.4g}{added}" + (f", bias {column.bias:.4g}" if column.bias else "")


def observation_meanings(columns: Sequence[ObservationColumn]) -> list[tuple[str, str]]:
    """Return every term of an observation with what it means."""
    told = {column.term: column.doc for column in columns}
    return list((told | {"command": "what the robot is asked to follow"} if "command" in told else told).items())


def column_name(column: ObservationColumn) -> str:
    """Return ``leg_position[leg_lf]``: the term with the label of its element."""
    return f"{column.term}[{label}]" if (label := _label(column)) else column.term


def _label(column: ObservationColumn) -> str:
    return column.element.partition("[")[2].rstrip("]") or (column.element if column.source in {"command", "action"} else "")


def _delay(config: TaskConfig, column: ObservationColumn) -> str:
    delays = {device: latency.delay for device, latency in config.latency.items() if device == column.device}
    return "".join(f"{low * 1000:g}..{high * 1000:g}" for low, high in delays.values()) or "0"


_DRAWN = (
    "Drawn at each reset where nothing else is said, once per robot, label (joint, wheel, axis or patch) or element. A "
    "tolerance is that of the robot's file, scales or adds, and is cut at so many sigma."
)
_STATE_UNITS = {"leg_angle": "rad", "yaw": "rad", "linear_velocity": "m/s", "angular_velocity": "rad/s"}
RANDOMIZATION_HEADER = ("event", "parameters", "draw", "per")


def randomization_section(config: RandomizationConfig) -> DescriptionPart:
    """Return what a randomisation draws: switches, initial state, and the table of its events."""
    spread = ((name, width, _STATE_UNITS[name]) for name, width in config.initial_state if width)
    state = ", ".join(f"{name} +-{width:.4g} {unit}" for name, width, unit in spread) or "standing at home"
    noise, latency = ("on" if switch else "off" for switch in (config.sensor_noise, config.latency))
    sentence = f"{config.name}; sensor noise {noise}, latency {latency}, start: {state}"
    rows = randomization_rows(config)
    return DescriptionPart("Randomization", f"{sentence}. {_DRAWN}" if rows else sentence, RANDOMIZATION_HEADER, rows)


def randomization_rows(config: RandomizationConfig) -> list[tuple[str, ...]]:
    """Return one row of text per event, columns as in :data:`RANDOMIZATION_HEADER`."""
    return [(name, ", ".join(event.parameters), _draw(event), event.per) for name, event in config.events.items()]


def _draw(event: EventConfig) -> str:
    """Return ``interval 1..3 s: set uniform -2..2``: when, if not at each reset; operation, distribution, area."""
    span = "" if event.interval is None else f" {_span(event.interval)} s"
    when = "" if event.when == "reset" else f"{event.when}{span}: "
    area = "" if event.area is None else f"; {_area(event.area)}"
    return when + " ".join(filter(None, (event.operation, _distribution(event)))) + area


def _unit(event: EventConfig) -> str:
    """Return `` rad``: the unit of what is drawn; nothing for factors and pure numbers."""
    unit = ", ".join(dict.fromkeys(spec_of(name).unit for name in event.parameters))
    return "" if event.operation == "scale" or unit == "-" else f" {unit}"


def _span(limits: Sequence[float | str | None]) -> str:
    return "..".join(dict.fromkeys(f"{value:.4g}" if isinstance(value, int | float) else str(value) for value in limits))


def _distribution(event: EventConfig) -> str:
    match event.distribution:
        case "choice":
            return "choice of " + ", ".join(f"{value:.4g}" for value in event.values or ()) + _unit(event)
        case "tolerance":
            return f"tolerance x {event.sigmas:g}, cut at {event.cut:g}"
        case "normal":
            mean = "" if event.mean is None else f"{_span([event.mean])} "
            return f"normal {mean}+- {_span([event.sigma])}{_unit(event)}, cut at {event.cut:g}"
        case _:
            return f"{event.distribution} {_span((event.low, event.high))}{_unit(event)}"


def _area(area: AreaConfig) -> str:
    return "area " + ", ".join(f"{name} {_span(limits)} m" for name, limits in area if limits is not None)


def scaling_sections(written: TaskConfig, robot: Robot) -> list[DescriptionPart]:
    """Return a task's numbers that follow the robot: as written for the task's own one, now, and by which rule."""
    reference = load_robot(written.robot)
    both = f"{reference.name} -> {robot.name}"
    scaled = scaled_numbers(written.model_dump(), written.scaling, robot, reference)
    numbers = [
        (_broken(number.place), f"{_numbers(number.before)} -> {_numbers(number.after)}", number.rule)
        for number in scaled
        if number.before != number.after
    ]
    asked = set[str]().union(*map(quantities_of, written.scaling.values()))
    used = [(name, one) for name, one in QUANTITIES.items() if name in asked]
    quantities = [(name, one.unit, f"{one.of(reference):.4g} -> {one.of(robot):.4g}", one.doc) for name, one in used]
    rules = f"by the rules of the task's file: times what the rule says of {robot.name} over {reference.name}, to three digits"
    rules += f"; {len(scaled) - len(numbers)} of {len(scaled)} stay as they are" if len(numbers) < len(scaled) else ""
    return [
        DescriptionPart("Follows the robot", rules, ("number", both, "rule"), numbers),
        DescriptionPart("Rules", "products of these", ("quantity", "unit", both, "meaning"), quantities),
    ]


def _broken(place: str) -> str:
    """Return a long place on two lines, so that there is room beside it."""
    return place if len(place) < 40 else place.replace(".", ".\n", 1)


def _numbers(value: Any) -> str:
    return f"[{', '.join(f'{number:g}' for number in value)}]" if isinstance(value, list) else f"{value:g}"


def contract(task: Task, randomization: dict[str, Any], floor: dict[str, Any] | None = None) -> dict[str, Any]:
    """Return what a policy must be fed and what its output means, as plain JSON types.

    Keys: task, robot (name, hashes of its servos and of all its numbers; of another robot than ``nominal`` also its
    ``description``, every number of it), control_period, episode_length, observation (one entry per number, in order: name,
    source, element, unit, frame, offset, scale, limit, lag, device), observer (settings of the slip observer; None where the
    policy is not fed its estimate), controller (gains of the hand-written one, where the task names them), sensors (how often
    they are present; only where the task says it), latency, action (one entry per number: joint, quantity, unit, centre, scale,
    low, high), commands, randomization and, where it is not flat, floor.
    """
    config = task.config
    return {
        "task": config.name,
        "robot": _contract_robot(task.robot),
        "control_period": config.control_period,
        "episode_length": config.episode_length,
        "observation": [_contract_column(column) for column in task.policy],
        "observer": config.observer.model_dump(mode="json") if task.shows_estimate else None,
        **({"sensors": said} if (said := config.sensors.model_dump(mode="json", exclude_none=True)) else {}),
        "latency": {device: latency.model_dump(mode="json") for device, latency in config.latency.items()},
        "action": [dict(vars(column)) for column in task.actions],
        **({} if config.controller is None else {"controller": config.controller.model_dump(mode="json")}),
        "commands": {
            name: {"unit": COMMANDS[name].unit, "range": list(limits)} for name, limits in config.commands.terms.items()
        },
        "randomization": randomization,
        **({} if floor is None else {"floor": floor}),
    }


def _contract_robot(robot: Robot) -> dict[str, Any]:
    known: dict[str, Any] = {"name": robot.name, "servo": servo_hash(robot), "hash": robot_hash(robot)}
    return known if robot == load_robot() else known | {"description": robot_content(robot)}


def _contract_column(column: ObservationColumn) -> dict[str, Any]:
    names = "source element unit frame offset scale limit sensor_noise noise bias lag device"
    return {"name": column_name(column), **{name: getattr(column, name) for name in names.split(" ")}}
