"""Observation terms. Policy terms are what the robot itself can know: its sensors, the command, its last action.

Privileged terms are channels of the true state, for asymmetric critics and analysis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from wlr_gym.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Layout
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot


def _zero(_: Robot) -> float:
    return 0.0


@dataclass(frozen=True)
class ObservationTerm:
    """Some columns of one signal matrix.

    Attributes:
        name: as in the task's YAML.
        source: ``sensors``, ``truth``, ``command`` or ``action``.
        elements: full element names in the source; empty = all of the task's commands or actions.
        unit, frame, doc: for the generated tables.
        limit: readings are clipped to +-limit about the offset (in ``unit``), so that the observation space is bounded.
        offset: subtracted from the reading, from the robot's numbers.
        device: what it is read from: readings of one device share one latency; empty = no latency.
    """

    name: str
    source: str
    elements: tuple[str, ...]
    unit: str
    frame: str
    limit: float
    doc: str
    offset: Callable[[Robot], float] = _zero
    device: str = ""


def _elements(channel: str, labels: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{channel}[{label}]" for label in labels)


def _sensor(name: str, channel: str, frame: str, limit: float, device: str, **more: object) -> ObservationTerm:
    spec = SENSOR_LAYOUT.channels[channel]
    labels: tuple[str, ...] = more.get("labels", spec.labels)  # type: ignore[assignment]
    elements = _elements(channel, labels) or (channel,)
    offset: Callable[[Robot], float] = more.get("offset", _zero)  # type: ignore[assignment]
    return ObservationTerm(name, "sensors", elements, spec.unit, frame, limit, str(more.get("doc", spec.doc)), offset, device)


POLICY_TERMS = {
    term.name: term
    for term in (
        ObservationTerm("command", "command", (), "", "body", 2.0, "what the robot is asked to follow"),
        ObservationTerm("last_action", "action", (), "-", "-", 1.0, "the action given one control tick before"),
        _sensor(
            "leg_position", "joint_position", "joint", 2.0, "joints",
            labels=LEGS, offset=lambda robot: robot.home.leg_angle, doc="leg encoder, from the home angle",
        ),
        _sensor("leg_velocity", "joint_velocity", "joint", 20.0, "joints", labels=LEGS),
        _sensor("wheel_velocity", "joint_velocity", "joint", 20.0, "joints", labels=WHEELS, doc="wheel against its leg, the servo's own reading"),
        _sensor("leg_effort", "joint_effort", "joint", 10.0, "joints", labels=LEGS),
        _sensor("wheel_effort", "joint_effort", "joint", 5.0, "joints", labels=WHEELS),
        _sensor("gyro", "gyro", "body", 20.0, "imu"),
        _sensor("accelerometer", "accelerometer", "body", 60.0, "imu"),
        _sensor("supply_voltage", "supply_voltage", "-", 5.0, "joints", offset=lambda robot: robot.servo.supply_voltage, doc="from nominal"),
        _sensor("camera_pose", "camera_pose", "floor", 20.0, "camera"),
        _sensor("camera_age", "camera_age", "-", 1.0, "camera"),
        _sensor("camera_is_new", "camera_is_new", "-", 1.0, "camera"),
    )
}  # fmt: skip

_TRUTH_LIMITS = {
    "position": ("floor", 20.0),
    "quaternion": ("body to floor", 1.0),
    "linear_velocity_in_body": ("body", 5.0),
    "angular_velocity_in_body": ("body", 20.0),
    "joint_velocity": ("joint", 20.0),
    "motor_torque": ("joint", 10.0),
    "contact_force": ("wheel", 200.0),
    "slip_velocity": ("wheel", 5.0),
    "slip_displacement": ("wheel", 0.2),
    "effective_friction": ("wheel", 5.0),
    "mechanical_energy": ("-", 10.0),
    "electrical_energy": ("-", 10.0),
    "body_clearance": ("floor", 2.0),
}


def _truth(layout: Layout, channel: str, frame: str, limit: float) -> ObservationTerm:
    spec = layout.channels[channel]
    return ObservationTerm(channel, "truth", tuple(spec.elements), spec.unit, frame, limit, spec.doc)


PRIVILEGED_TERMS = {name: _truth(TRUTH_LAYOUT, name, frame, limit) for name, (frame, limit) in _TRUTH_LIMITS.items()}

#: Action elements, in order: what the numbers of the action vector move.
ACTIONS = JOINTS
