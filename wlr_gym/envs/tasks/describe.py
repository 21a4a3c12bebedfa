"""What a task is, for people (tables) and for machines (the contract a policy file carries)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from wlr_gym.envs.tasks.entries import AreaConfig, EventConfig
from wlr_gym.envs.tasks.randomization import RandomizationConfig
from wlr_gym.envs.tasks.scaling import QUANTITIES, quantities_of, scaled_numbers
from wlr_gym.envs.tasks.success import limits_within
from wlr_gym.envs.tasks.task import ObservationColumn, Task
from wlr_gym.envs.tasks.task_config import TaskConfig
from wlr_gym.envs.tasks.terms import COMMANDS, MEASURES, REWARDS, TERMINATIONS
from wlr_gym.robot import Robot, load_robot, robot_content, robot_hash, servo_hash


def describe(task: Task) -> str:
    """Return the task's action, observation, command, reward, termination and measure tables as text (reStructuredText)."""
    config = task.config
    command_rows = [
        (name, COMMANDS[name].unit, COMMANDS[name].frame, f"[{low:g}, {high:g}]", _ramp(config, name), COMMANDS[name].doc)
        for name, (low, high) in config.commands.terms.items()
    ]
    reward_rows = [
        (name, f"{values['weight']:g}", parameters_text(values, REWARDS[name].parameters), REWARDS[name].doc)
        for name, values in config.rewards.items()
    ]
    termination_rows = [
        (name, parameters_text(values, TERMINATIONS[name].parameters), TERMINATIONS[name].doc)
        for name, values in config.terminations.items()
    ]
    privileged_rows = [
        (str(index), column_name(column), column.unit, column.frame, f"{column.scale:g}", f"{column.limit:g}")
        for index, column in enumerate(task.privileged)
    ]
    measure_rows = [(name, MEASURES[name].unit, limits_text(config, name), MEASURES[name].doc) for name in task.measures]
    period = config.control_period * 1000
    return "\n".join(
        [
            f"**Action** ``Box(-1, 1, ({len(task.actions)},), float32)``: setpoint = clip(centre + scale * action, low, high)",
            *table(("index", "joint", "setpoint", "unit", "centre", "scale", "low", "high"), _action_rows(task)),
            f"**Observation** ``Box(({len(task.policy)},), float32)``: value = scale * clip(reading - offset, +-limit)",
            *table(_OBSERVATION_HEADER, _observation_rows(task)),
            *table(("observation", "meaning"), observation_meanings(task)),
            f'**Privileged observation** (``observation="dict"``): ``Box(({len(task.privileged)},), float32)``',
            *table(("index", "name", "unit", "frame", "scale", "limit"), privileged_rows),
            *_sensors_text(config),
            f"**Commands** {_timing(config)}",
            *table(("command", "unit", "frame", "range", "largest rate (1/s)", "meaning"), command_rows),
            "**Reward** sum of weight * term * control period",
            *table(("term", "weight (1/s)", "parameters", "meaning"), reward_rows),
            "**Terminated** when a term is greater than 0",
            *table(("term", "parameters", "meaning"), termination_rows),
            "**Measured**, in ``core.measures``; an episode is a success when nothing terminated it and all limits hold",
            *table(("measure", "unit", "limits", "meaning"), measure_rows),
            f"**Truncated** after {config.episode_length:g} s ({task.episode_steps} control steps of {period:g} ms).",
        ]
    )


def parameters_text(values: dict[str, float], defaults: dict[str, float]) -> str:
    """Return ``width 0.06, ...`` for the parameters of a term."""
    return ", ".join(f"{name} {values.get(name, default):g}" for name, default in defaults.items()) or "-"


def _sensors_text(config: TaskConfig) -> list[str]:
    """Return how often the robots have sensors, where the task says it."""
    said = [f"{name} with probability {share:g}" for name, share in config.sensors if share is not None]
    return [f"**Sensors** present per episode: {', '.join(said)}", ""] if said else []


def _timing(config: TaskConfig) -> str:
    (low, high), stop = config.commands.hold_time, config.commands.zero_probability
    drawn = "drawn once per episode" if low > config.episode_length else f"drawn anew every {low:g} to {high:g} s"
    return f"{drawn}, all zero with probability {stop:g}" if stop else drawn


def _ramp(config: TaskConfig, command: str) -> str:
    return f"{config.commands.ramp[command]:g}" if command in config.commands.ramp else "-"


def limits_text(config: TaskConfig, measure: str) -> str:
    """Return ``rms at most 0.02`` for a measure that success depends on."""
    bounds = config.success.get(measure)
    limits = {} if bounds is None else limits_within(bounds)
    return ", ".join(f"{kind} at most {limit:g}" for kind, limit in limits.items()) or "-"


def _action_rows(task: Task) -> list[tuple[str, ...]]:
    return [
        (str(i), a.joint, a.quantity, a.unit, f"{a.centre:.4g}", f"{a.scale:g}", f"{a.low:.4g}", f"{a.high:.4g}")
        for i, a in enumerate(task.actions)
    ]


_OBSERVATION_HEADER = (
    "index",
    "name",
    "unit",
    "frame",
    "offset",
    "scale",
    "limit",
    "sensor noise",
    "noise",
    "bias",
    "delay (ms)",
    "lag (steps)",
)


def _observation_rows(task: Task) -> list[tuple[str, ...]]:
    """Return one row per policy observation column. ``noise`` and ``bias`` are the task's, on top of the sensor's own noise."""
    rows = []
    for index, column in enumerate(task.policy):
        numbers = (column.offset, column.scale, column.limit, column.sensor_noise, column.noise, column.bias)
        texts = [f"{value:.4g}" for value in numbers]
        rows.append((str(index), column_name(column), column.unit, column.frame, *texts, _delay(task, column), str(column.lag)))
    return rows


def observation_meanings(task: Task) -> list[tuple[str, str]]:
    """Return every term of the policy's observation with what it means."""
    told = {column.term: column.doc for column in task.policy}
    return list((told | {"command": "what the robot is asked to follow"} if "command" in told else told).items())


def column_name(column: ObservationColumn) -> str:
    """Return ``leg_position[leg_lf]``: the term with the label of its element."""
    label = column.element.partition("[")[2].rstrip("]") or (column.element if column.source in {"command", "action"} else "")
    return f"{column.term}[{label}]" if label else column.term


def _delay(task: Task, column: ObservationColumn) -> str:
    latency = task.config.latency.get(column.device)  # type: ignore[call-overload]
    return "0" if latency is None else f"{latency.delay[0] * 1000:g}..{latency.delay[1] * 1000:g}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a reStructuredText simple table as lines, with an empty line before and after."""
    widths = [max(len(str(row[k])) for row in [header, *rows]) for k in range(len(header))]
    rule = "  ".join("=" * width for width in widths)

    def line(row: Sequence[str]) -> str:
        return "  ".join(str(cell).ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()

    return ["", rule, line(header), rule, *(line(row) for row in rows), rule, ""]


RANDOMIZATION_HEADER = ("event", "parameters", "when", "operation", "distribution", "one draw per")


def describe_randomization(config: RandomizationConfig) -> str:
    """Return what a randomisation draws as text: switches, initial state, and the table of its events."""
    state = ", ".join(f"{name} +-{width:.4g}" for name, width in config.initial_state if width) or "standing at home"
    return "\n".join(
        [
            f"**Randomization** ``{config.name}``",
            "",
            f"Sensor noise {_on(config.sensor_noise)}, latency {_on(config.latency)}. Start: {state}.",
            *(table(RANDOMIZATION_HEADER, randomization_rows(config)) if config.events else []),
        ]
    )


def _on(switch: bool) -> str:
    return "on" if switch else "off"


def randomization_rows(config: RandomizationConfig) -> list[tuple[str, ...]]:
    """Return one row of text per event, columns as in :data:`RANDOMIZATION_HEADER`."""
    return [
        (name, ", ".join(event.parameters), _when(event), event.operation or "scale or add", _distribution(event), event.per)
        for name, event in config.events.items()
    ]


def _when(event: EventConfig) -> str:
    return event.when if event.interval is None else f"{event.when} {_span(event.interval)} s"


def _span(limits: Sequence[float | str | None]) -> str:
    texts = [f"{value:.4g}" if isinstance(value, int | float) else str(value) for value in limits]
    return texts[0] if texts[0] == texts[1] else "..".join(texts)


def _distribution(event: EventConfig) -> str:
    match event.distribution:
        case "choice":
            text = "choice of " + ", ".join(f"{value:.4g}" for value in event.values or ())
        case "tolerance":
            text = f"tolerance x {event.sigmas:g}, cut at {event.cut:g}"
        case "normal":
            mean = "" if event.mean is None else f"{_span((event.mean, event.mean))} "
            text = f"normal {mean}+- {_span((event.sigma, event.sigma))}, cut at {event.cut:g}"
        case _:
            text = f"{event.distribution} {_span((event.low, event.high))}"
    return text if event.area is None else f"{text}; {_area(event.area)}"


def _area(area: AreaConfig) -> str:
    return "area " + ", ".join(f"{name} {_span(limits)} m" for name, limits in area if limits is not None)


def describe_scaling(written: TaskConfig, robot: Robot) -> str:
    """Return the table of a task's numbers that follow the robot: as written for the task's own one, by which rule, and now."""
    reference = load_robot(written.robot)
    rows = [
        (number.place, number.rule, _numbers(number.before), _numbers(number.after))
        for number in scaled_numbers(written.model_dump(), written.scaling, robot, reference)
    ]
    asked = set[str]().union(*map(quantities_of, written.scaling.values()))
    used = [name for name in QUANTITIES if name in asked]
    quantities = [
        (name, QUANTITIES[name].unit, *(f"{QUANTITIES[name].of(one):.4g}" for one in (reference, robot)), QUANTITIES[name].doc)
        for name in used
    ]
    return "\n".join(
        [
            f"**Follows the robot** by the rules of the task's file: number for {robot.name} = number for {reference.name} x "
            "what the rule says of the one over the other, to three digits",
            *table(("number", "rule", reference.name, robot.name), rows),
            *table(("quantity", "unit", reference.name, robot.name, "meaning"), quantities),
        ]
    )


def _numbers(value: Any) -> str:
    return f"[{', '.join(f'{number:g}' for number in value)}]" if isinstance(value, list) else f"{value:g}"


def contract(task: Task, randomization: dict[str, Any]) -> dict[str, Any]:
    """Return what a policy must be fed and what its output means, as plain JSON types.

    Keys: task, robot (name, hashes of its servos and of all its numbers; of another robot than ``nominal`` also its
    ``description``, every number of it), control_period, episode_length, observation (one entry per number, in order: name,
    source, element, unit, frame, offset, scale, limit, lag, device), observer (settings of the slip observer; None where no
    term needs it), controller (gains of the hand-written one, where the task names them), sensors (how often they are present;
    only where the task says it), latency, action (one entry per number: joint, quantity, unit, centre, scale, low, high),
    commands and randomization.
    """
    config = task.config
    return {
        "task": config.name,
        "robot": _contract_robot(task.robot),
        "control_period": config.control_period,
        "episode_length": config.episode_length,
        "observation": [_contract_column(column) for column in task.policy],
        "observer": config.observer.model_dump(mode="json") if task.needs_observer else None,
        **({"sensors": said} if (said := config.sensors.model_dump(mode="json", exclude_none=True)) else {}),
        "latency": {device: latency.model_dump(mode="json") for device, latency in config.latency.items()},
        "action": [dict(vars(column)) for column in task.actions],
        **({} if config.controller is None else {"controller": config.controller.model_dump(mode="json")}),
        "commands": {
            name: {"unit": COMMANDS[name].unit, "range": list(limits)} for name, limits in config.commands.terms.items()
        },
        "randomization": randomization,
    }


def _contract_robot(robot: Robot) -> dict[str, Any]:
    known: dict[str, Any] = {"name": robot.name, "servo": servo_hash(robot), "hash": robot_hash(robot)}
    return known if robot == load_robot() else known | {"description": robot_content(robot)}


def _contract_column(column: ObservationColumn) -> dict[str, Any]:
    fields = (
        "source",
        "element",
        "unit",
        "frame",
        "offset",
        "scale",
        "limit",
        "sensor_noise",
        "noise",
        "bias",
        "lag",
        "device",
    )
    return {"name": column_name(column), **{field: getattr(column, field) for field in fields}}
