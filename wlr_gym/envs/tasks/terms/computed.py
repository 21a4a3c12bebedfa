"""Computed observations: functions of named signals, traced into one compiled kernel per task.

They are evaluated after the step's new commands are drawn, so that they speak of what is asked from now on.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass

from wlr_gym.envs.tasks.signals import Signals, Value
from wlr_gym.envs.tasks.terms import references
from wlr_gym.envs.tasks.terms.geometry import PlanarPose, estimated_pose, true_pose
from wlr_gym.envs.tasks.terms.observations import POLICY_TERMS, PRIVILEGED_TERMS, ObservationTerm
from wlr_gym.envs.tasks.terms.scalar import refuse_another
from wlr_gym.robot import LEGS

Function = Callable[[Signals], list[Value]]


@dataclass(frozen=True)
class ComputedTerm:
    """Some numbers computed from signals.

    Attributes:
        function: ``function(signals)`` returns one value per element; written with ``wlr_gym.physics.codegen.ops``.
        elements: ``name[label]`` of each number.
    """

    function: Function
    elements: tuple[str, ...]


COMPUTED: dict[str, ComputedTerm] = {}


def computed(*labels: str, unit: str, frame: str, limit: float, estimated: bool = False) -> Callable[[Function], Function]:
    """Return a decorator that makes a function an observation term under its own name, for policies and critics.

    Args:
        labels: of its numbers; none for a single number.
        unit, frame: for the tables; the first line of the docstring says the rest.
        limit: values are clipped to +-limit (in ``unit``), so that the observation space is bounded.
        estimated: made of the slip observer's estimate, and so as old as the joint readings that is made of.
    """

    def enter(function: Function) -> Function:
        name = function.__name__
        elements = tuple(f"{name}[{label}]" for label in labels) or (name,)
        doc = (inspect.getdoc(function) or "").partition("\n")[0]
        device = "joints" if estimated else ""
        if name in POLICY_TERMS:
            refuse_another(function, COMPUTED[name].function if name in COMPUTED else None)
        COMPUTED[name] = ComputedTerm(function, elements)
        POLICY_TERMS[name] = PRIVILEGED_TERMS[name] = ObservationTerm(
            name, "computed", elements, unit, frame, limit, doc, device=device
        )
        return function

    return enter


@computed(unit="m/s", frame="body", limit=2.0)
def speed_command(signals: Signals) -> list[Value]:
    """Commanded forward velocity."""
    return [signals.command("linear_velocity_x")]


# ---- sensors ----


@computed(unit="-", frame="-", limit=1.0)
def camera_present(signals: Signals) -> list[Value]:
    """1 where the robot has a camera, else 0."""
    return [signals.is_present("camera")]


@computed(unit="-", frame="-", limit=1.0)
def flow_present(signals: Signals) -> list[Value]:
    """1 where the robot has an optical-flow sensor, else 0."""
    return [signals.is_present("flow")]


# ---- paths ----


def _path_error(signals: Signals, pose: PlanarPose) -> list[Value]:
    error = references.path_error(signals, pose)
    return [error.lateral, error.heading]


@computed("lateral", "heading", unit="m, rad", frame="path", limit=4.0, estimated=True)
def path_error(signals: Signals) -> list[Value]:
    """Estimated distance from the path and heading against it, positive to the left."""
    return _path_error(signals, estimated_pose(signals))


@computed("lateral", "heading", unit="m, rad", frame="path", limit=4.0)
def true_path_error(signals: Signals) -> list[Value]:
    """True distance from the path and heading against it, positive to the left."""
    return _path_error(signals, true_pose(signals))


@computed(*(f"{distance:g} m" for distance in references.PREVIEW), unit="1/m", frame="path", limit=10.0, estimated=True)
def path_curvature(signals: Signals) -> list[Value]:
    """Curvature of the path at distances ahead, positive to the left."""
    return list(references.path_error(signals, estimated_pose(signals)).curvature)


# ---- a straight course ----


@computed("lateral", "heading", unit="m, rad", frame="start", limit=4.0, estimated=True)
def course_error(signals: Signals) -> list[Value]:
    """Estimated distance from the line straight ahead of the start and heading against it, positive to the left."""
    pose = estimated_pose(signals)
    return [pose.y, pose.yaw]


@computed("lateral", "heading", unit="m, rad", frame="start", limit=4.0)
def true_course_error(signals: Signals) -> list[Value]:
    """True distance from the line straight ahead of the start and heading against it, positive to the left."""
    pose = true_pose(signals)
    return [pose.y, pose.yaw]


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
