"""Computed observations: functions of named signals, traced into one compiled kernel per task.

They are evaluated after the tick's new commands are drawn, so that they speak of what is asked from now on.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass

from wlr_gym.robot import LEGS
from wlr_gym.tasks.signals import Signals, Value
from wlr_gym.tasks.terms import references
from wlr_gym.tasks.terms.geometry import Motion, estimated_motion, true_motion

Function = Callable[[Signals], list[Value]]


@dataclass(frozen=True)
class ComputedTerm:
    """Some numbers computed from signals.

    Attributes:
        name: as in the task's YAML.
        function: ``function(signals)`` returns one value per element; written with ``wlr_gym.codegen.ops``.
        elements: ``name[label]`` of each number.
        unit, frame, limit: for the tables and the observation space.
        doc: first line of the function's docstring.
        estimated: made of the slip observer's estimate, and so as old as that.
    """

    name: str
    function: Function
    elements: tuple[str, ...]
    unit: str
    frame: str
    limit: float
    doc: str
    estimated: bool


COMPUTED: dict[str, ComputedTerm] = {}


def computed(*labels: str, unit: str, frame: str, limit: float, estimated: bool = False) -> Callable[[Function], Function]:
    """Return a decorator that enters a function into :data:`COMPUTED` under its own name."""

    def enter(function: Function) -> Function:
        name = function.__name__
        elements = tuple(f"{name}[{label}]" for label in labels) or (name,)
        doc = (inspect.getdoc(function) or "").partition("\n")[0]
        COMPUTED[name] = ComputedTerm(name, function, elements, unit, frame, limit, doc, estimated)
        return function

    return enter


@computed(unit="m/s", frame="body", limit=2.0)
def speed_command(signals: Signals) -> list[Value]:
    """Commanded forward velocity."""
    return [signals.command("linear_velocity_x")]


# ---- paths ----


def _path_error(signals: Signals, motion: Motion) -> list[Value]:
    error = references.path_error(signals, motion)
    return [error.lateral, error.heading]


@computed("lateral", "heading", unit="m, rad", frame="path", limit=4.0, estimated=True)
def path_error(signals: Signals) -> list[Value]:
    """Estimated distance from the path and heading against it, positive to the left."""
    return _path_error(signals, estimated_motion(signals))


@computed("lateral", "heading", unit="m, rad", frame="path", limit=4.0)
def true_path_error(signals: Signals) -> list[Value]:
    """True distance from the path and heading against it, positive to the left."""
    return _path_error(signals, true_motion(signals))


@computed(*(f"{distance:g} m" for distance in references.PREVIEW), unit="1/m", frame="path", limit=10.0, estimated=True)
def path_curvature(signals: Signals) -> list[Value]:
    """Curvature of the path at distances ahead, positive to the left."""
    return list(references.path_error(signals, estimated_motion(signals)).curvature)


# ---- a straight course ----


@computed("lateral", "heading", unit="m, rad", frame="start", limit=4.0, estimated=True)
def course_error(signals: Signals) -> list[Value]:
    """Estimated distance from the line straight ahead of the start and heading against it, positive to the left."""
    motion = estimated_motion(signals)
    return [motion.y, motion.yaw]


@computed("lateral", "heading", unit="m, rad", frame="start", limit=4.0)
def true_course_error(signals: Signals) -> list[Value]:
    """True distance from the line straight ahead of the start and heading against it, positive to the left."""
    motion = true_motion(signals)
    return [motion.y, motion.yaw]


# ---- leg angles ----


@computed(*LEGS, unit="rad", frame="joint", limit=2.0)
def leg_reference(signals: Signals) -> list[Value]:
    """Commanded leg angle at this time, from the home angle."""
    return [angle - signals.robot("home.leg_angle") for angle, _ in references.leg_references(signals)]


@computed(*LEGS, unit="rad/s", frame="joint", limit=5.0)
def leg_reference_rate(signals: Signals) -> list[Value]:
    """Commanded leg rate at this time."""
    return [rate for _, rate in references.leg_references(signals)]


# ---- slopes ----


@computed(unit="m/s", frame="body", limit=2.0)
def climb_command(signals: Signals) -> list[Value]:
    """Commanded forward velocity at this time: climbing, then holding."""
    return [references.climb_speed(signals)]
