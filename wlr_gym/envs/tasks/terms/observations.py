"""Observation terms. What the robot itself can know: its sensors, the command, its last action, what the slip observer
estimates from the sensors, and what is computed from these.

Terms of the true state are for asymmetric critics, for upper bounds (a policy that sees friction) and for analysis: a real
robot refuses a policy that needs one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from wlr_gym.envs.tasks.scaling import QUANTITIES
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Layout
from wlr_gym.robot import LEGS, WHEELS, Robot

RobotNumber = Callable[[Robot], float]


def _zero(_: Robot) -> float:
    return 0.0


@dataclass(frozen=True)
class ObservationTerm:
    """Some columns of one signal matrix.

    Attributes:
        name: as in the task's YAML.
        source: ``sensors``, ``command``, ``action``, ``estimate``, ``computed`` or ``truth``.
        elements: full element names in the source; empty = all of the task's commands or actions.
        unit, frame, doc: for the generated tables.
        limit: readings are clipped to +-limit about the offset (in ``unit``), so that the observation space is bounded; it is
            larger for robots that reach more (:func:`limit_for`).
        offset: subtracted from the reading, from the robot's numbers.
        sensor_noise: what the sensor itself adds, from the robot's numbers: 1 sigma, or one count of an encoder.
        device: what it is read from: readings of one device share one latency; empty = no latency.
    """

    name: str
    source: str
    elements: tuple[str, ...]
    unit: str
    frame: str
    limit: float
    doc: str
    offset: RobotNumber = _zero
    sensor_noise: RobotNumber = _zero
    device: str = ""


def _sensor(
    name: str,
    channel: str,
    frame: str,
    limit: float,
    device: str,
    sensor_noise: RobotNumber,
    *,
    labels: tuple[str, ...] | None = None,
    offset: RobotNumber = _zero,
    doc: str = "",
) -> ObservationTerm:
    spec = SENSOR_LAYOUT.channels[channel]
    elements = tuple(spec.elements) if labels is None else tuple(f"{channel}[{label}]" for label in labels)
    return ObservationTerm(name, "sensors", elements, spec.unit, frame, limit, doc or spec.doc, offset, sensor_noise, device)


_SENSED = {
    term.name: term
    for term in (
        ObservationTerm("command", "command", (), "", "body", 2.0, "what the robot is asked to follow"),
        ObservationTerm("last_action", "action", (), "-", "-", 1.0, "the action given one control step before"),
        _sensor(
            "leg_position", "joint_position", "joint", 2.0, "joints", lambda r: r.sensors.encoder.position,
            labels=LEGS, offset=lambda r: r.home.leg_angle, doc="leg encoder; the offset is the home angle",
        ),
        _sensor("leg_velocity", "joint_velocity", "joint", 20.0, "joints", lambda r: r.sensors.encoder.velocity, labels=LEGS),
        _sensor(
            "wheel_velocity", "joint_velocity", "joint", 20.0, "joints", lambda r: r.sensors.encoder.velocity,
            labels=WHEELS, doc="wheel against its leg, the servo's own reading",
        ),
        _sensor("leg_effort", "joint_effort", "joint", 10.0, "joints", lambda r: r.sensors.effort.leg_noise, labels=LEGS),
        _sensor("wheel_effort", "joint_effort", "joint", 5.0, "joints", lambda r: r.sensors.effort.wheel_noise, labels=WHEELS),
        _sensor("gyro", "gyro", "body", 20.0, "imu", lambda r: r.sensors.imu.gyro_noise),
        _sensor("accelerometer", "accelerometer", "body", 60.0, "imu", lambda r: r.sensors.imu.accel_noise),
        _sensor(
            "supply_voltage", "supply_voltage", "-", 5.0, "joints", lambda r: r.sensors.volt_noise,
            offset=lambda r: r.servo.supply_voltage, doc="from nominal",
        ),
        _sensor(
            "camera_position", "camera_pose", "start", 20.0, "camera", lambda r: r.sensors.camera.position_noise,
            labels=("x", "y"),
        ),
        _sensor("camera_yaw", "camera_pose", "start", 20.0, "camera", lambda r: r.sensors.camera.yaw_noise, labels=("yaw",)),
        _sensor("camera_age", "camera_age", "-", 1.0, "camera", _zero),
        _sensor("camera_is_new", "camera_is_new", "-", 1.0, "camera", _zero),
        _sensor("flow", "flow", "body", 20.0, "flow", lambda r: r.sensors.flow_noise),
        _sensor("flow_quality", "flow_quality", "-", 1.0, "flow", _zero),
        _sensor("flow_age", "flow_age", "-", 1.0, "flow", _zero),
        _sensor("flow_is_new", "flow_is_new", "-", 1.0, "flow", _zero),
    )
}  # fmt: skip

#: Channel of the estimate -> frame, limit.
_ESTIMATE_LIMITS = {
    "position": ("start", 20.0),
    "yaw": ("start", 20.0),
    "yaw_sigma": ("start", 2.0),
    "linear_velocity_in_body": ("body", 2.0),
    "linear_velocity_sigma": ("body", 2.0),
    "yaw_rate": ("body", 20.0),
    "gravity_in_body": ("body", 1.0),
    "slip_velocity": ("wheel", 2.0),
    "slip_sigma": ("wheel", 2.0),
    "traction_force": ("wheel", 200.0),
    "normal_force": ("wheel", 200.0),
    "traction_use": ("wheel", 5.0),
    "friction_demand": ("-", 5.0),
}

_TRUTH_LIMITS = {
    "position": ("floor", 20.0),
    "quaternion": ("body to floor", 1.0),
    "linear_velocity_in_body": ("body", 5.0),
    "angular_velocity_in_body": ("body", 20.0),
    "joint_velocity": ("joint", 20.0),
    "motor_torque": ("joint", 10.0),
    "friction_torque": ("joint", 10.0),
    "rolling_torque": ("wheel", 5.0),
    "contact_force": ("wheel", 200.0),
    "slip_velocity": ("wheel", 5.0),
    "slip_displacement": ("wheel", 0.2),
    "effective_friction": ("wheel", 5.0),
    "mechanical_energy": ("-", 10.0),
    "electrical_energy": ("-", 10.0),
    "body_clearance": ("floor", 2.0),
}


def _channel(layout: Layout, source: str, channel: str, prefix: str, frame: str, limit: float, device: str) -> ObservationTerm:
    spec = layout.channels[channel]
    elements = tuple(spec.elements)
    return ObservationTerm(f"{prefix}{channel}", source, elements, spec.unit, frame, limit, spec.doc, device=device)


_ESTIMATED = [
    _channel(ESTIMATE_LAYOUT, "estimate", channel, "estimated_", frame, limit, "joints")
    for channel, (frame, limit) in _ESTIMATE_LIMITS.items()
]
_TRUE = [_channel(TRUTH_LAYOUT, "truth", channel, "", frame, limit, "") for channel, (frame, limit) in _TRUTH_LIMITS.items()]

#: What a policy may observe. Estimates are as old as the joint readings they are made of. ``computed`` terms enter themselves.
POLICY_TERMS = _SENSED | {term.name: term for term in (*_ESTIMATED, *_TRUE)}

#: What a critic may observe besides.
PRIVILEGED_TERMS = {term.name: term for term in _TRUE}

#: Terms that large, fast or strong robots read more of -> quantities of a robot, of which the largest says how much.
_REACHED = {
    "leg_velocity": ("leg_speed",),
    "wheel_velocity": ("wheel_speed",),
    "joint_velocity": ("leg_speed", "wheel_speed"),
    "leg_effort": ("leg_torque",),
    "wheel_effort": ("wheel_torque",),
    "motor_torque": ("leg_torque", "wheel_torque"),
    **dict.fromkeys(("speed_command", "climb_command", "linear_velocity_in_body", "slip_velocity"), ("top_speed",)),
    **dict.fromkeys(("estimated_linear_velocity_in_body", "estimated_slip_velocity"), ("top_speed",)),
    **dict.fromkeys(("contact_force", "estimated_normal_force", "estimated_traction_force"), ("weight",)),
}


def limit_for(term: ObservationTerm, robot: Robot, drawn: Sequence[float] = ()) -> float:
    """Return the limit of a term's readings, in its unit: its own, or, where that is more, what readings may come to.

    Args:
        term: of an observation.
        robot: readings reach a quarter more than its file says.
        drawn: ends of the range that a command is drawn from.
    """
    reached = [QUANTITIES[name].of(robot) for name in _REACHED.get(term.name, ())]
    if term.name in ("leg_position", "leg_reference"):
        reached = [abs(limit - robot.home.leg_angle) for limit in robot.leg_limits]
    return max([term.limit, *(1.25 * value for value in reached), *map(abs, drawn)])
