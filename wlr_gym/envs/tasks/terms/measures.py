"""Scalar terms: functions of named signals that are traced into one compiled kernel per task. Measures and terminations.

Measures are signed errors and other quantities, in SI units, that evaluations report and a task's success is judged by. They
speak of the true motion, and do not enter the reward. An episode ends (``terminated``) in the step in which a termination term
is greater than zero.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.envs.tasks.signals import Signals, Value, climb_speed, error_from_path, leg_errors, mean, norm, true_pose
from wlr_gym.physics.codegen import ops

Function = Callable[..., Any]

POSITIVE = (0.0, math.inf)


@dataclass(frozen=True)
class ScalarTerm:
    """One reward, termination or measure.

    Attributes:
        name: as in the task's YAML.
        function: ``function(signals, **parameters)``, written with ``wlr_gym.physics.codegen.ops``.
        parameters: names and default values of its parameters.
        ranges: name -> (low, high) that the parameter must lie between, both excluded.
        doc: first line of its docstring.
        unit: of its value; rewards and terminations have none.
    """

    name: str
    function: Function
    parameters: dict[str, float]
    ranges: dict[str, tuple[float, float]]
    doc: str
    unit: str = ""


def refuse_another(function: Function, present: Function | None) -> None:
    """Refuse a term whose name is taken by another one; the same one may come again, as its module is imported anew."""
    if present is None or (present.__module__, present.__qualname__) != (function.__module__, function.__qualname__):
        where = "the library" if present is None else present.__module__
        raise InputError(f"term '{function.__name__}' of {function.__module__}: {where} has one of that name; give it another")


def registered(
    registry: dict[str, ScalarTerm], unit: str = "", **ranges: tuple[float, float]
) -> Callable[[Function], Function]:
    """Return a decorator that enters a function into ``registry`` under its own name, with ranges of its parameters.

    Raises:
        InputError: a range of a parameter that the function does not have, or a name that is taken.
    """

    def enter(function: Function) -> Function:
        defaults = {
            name: float(parameter.default)
            for name, parameter in inspect.signature(function).parameters.items()
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY
        }
        for name in ranges:
            if name not in defaults:
                raise unknown_name("parameter", name, defaults, f"term '{function.__name__}' of {function.__module__}")
        doc = (inspect.getdoc(function) or "").partition("\n")[0]
        if function.__name__ in registry:
            refuse_another(function, registry[function.__name__].function)
        registry[function.__name__] = ScalarTerm(function.__name__, function, defaults, ranges, doc, unit)
        return function

    return enter


# ---- measures --------------------------------------------------------------------------------------------------------


MEASURES: dict[str, ScalarTerm] = {}


@registered(MEASURES, unit="m/s")
def velocity_error(signals: Signals) -> Value:
    """Forward velocity of the body origin beyond the commanded one."""
    return signals.truth("linear_velocity_in_body")[0] - signals.command("linear_velocity_x")


@registered(MEASURES, unit="rad/s")
def yaw_rate_error(signals: Signals) -> Value:
    """Yaw rate of the body beyond the commanded one."""
    return signals.truth("angular_velocity_in_body")[2] - signals.command("yaw_rate")


@registered(MEASURES, unit="m")
def path_lateral_error(signals: Signals) -> Value:
    """Distance of the body origin from the commanded path, positive to its left."""
    return error_from_path(signals, true_pose(signals)).lateral


@registered(MEASURES, unit="rad")
def path_heading_error(signals: Signals) -> Value:
    """Heading of the body against the path's direction at its nearest point, positive to the left."""
    return error_from_path(signals, true_pose(signals)).heading


@registered(MEASURES, unit="m")
def lateral_error(signals: Signals) -> Value:
    """Distance of the body origin from the line straight ahead of the start, positive to the left."""
    return true_pose(signals).y


@registered(MEASURES, unit="rad")
def heading_error(signals: Signals) -> Value:
    """Heading of the body against that at the start, positive to the left."""
    return true_pose(signals).yaw


@registered(MEASURES, unit="rad")
def leg_error(signals: Signals) -> Value:
    """Root mean square over the legs of true angle minus commanded angle."""
    return ops.sqrt(mean([error * error for error in leg_errors(signals)]))


@registered(MEASURES, unit="m/s")
def climb_speed_error(signals: Signals) -> Value:
    """Forward velocity of the body origin beyond that asked for while climbing (then 0, while holding)."""
    return signals.truth("linear_velocity_in_body")[0] - climb_speed(signals)


@registered(MEASURES, unit="m/s")
def slip_speed(signals: Signals) -> Value:
    """Mean over the wheels of the slip speed, averaged over the step."""
    slip, period = signals.truth("slip_displacement"), signals.control_period
    return mean([norm(x, y) for x, y in zip(slip[0::2], slip[1::2], strict=True)]) / period


# ---- terminations ----------------------------------------------------------------------------------------------------


TERMINATIONS: dict[str, ScalarTerm] = {}


@registered(TERMINATIONS)
def tilt(signals: Signals, *, limit: Value = 0.8) -> Value:
    """The body's z axis leans more than ``limit`` (rad) from the floor's normal."""
    _, x, y, _ = signals.truth("quaternion")
    return ops.cos(limit) - (1.0 - 2.0 * (x * x + y * y))


@registered(TERMINATIONS)
def body_contact(signals: Signals, *, clearance: Value = 0.0) -> Value:
    """The lowest corner of the body box is less than ``clearance`` (m) above the floor."""
    return clearance - signals.truth("body_clearance")[0]


@registered(TERMINATIONS)
def left_floor(signals: Signals, *, clearance: Value = 0.3) -> Value:
    """The body box is more than ``clearance`` (m) above the floor: no standing robot reaches that high."""
    return signals.truth("body_clearance")[0] - clearance
