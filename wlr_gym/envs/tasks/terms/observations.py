"""Commands, and observation terms: what a task can ask, and what a policy can see.

The robot itself can know its sensors, the command, its last action, what the slip observer estimates from the sensors, and what
is computed from these. Terms of the true state are for asymmetric critics, for upper bounds (a policy that sees friction) and
for analysis: a real robot refuses a policy that needs one.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter

from wlr_gym.envs.tasks.scaling import QUANTITIES
from wlr_gym.envs.tasks.signals import (
    PREVIEW,
    PlanarPose,
    Signals,
    Value,
    climb_speed,
    error_from_path,
    estimated_pose,
    leg_references,
    mean,
    true_pose,
)
from wlr_gym.envs.tasks.terms.measures import refuse_another
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.codegen import ops
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, Layout
from wlr_gym.policy.control import ERROR_TIME, LEAST_SLIP, SLIP_TIME, UNEVEN, UNEVEN_RANGE, WARP_RATE
from wlr_gym.robot import CORNER_SIGNS, JOINTS, LEG_SLICE, LEGS, WHEELS, Robot

# ---- commands a task can ask the robot to follow ---------------------------------------------------------------------


def _forward(robot: Robot) -> tuple[float, float]:
    speed = QUANTITIES["top_speed"].of(robot)
    return -speed, speed


def _turning(robot: Robot) -> tuple[float, float]:
    """On the spot, rolling."""
    fastest = 2.0 * QUANTITIES["top_speed"].of(robot) / QUANTITIES["track_width"].of(robot)
    return -fastest, fastest


_legs = attrgetter("leg_limits")


@dataclass(frozen=True)
class CommandTerm:
    """One commanded quantity: name, SI unit, frame, meaning, the least and most that mean something, and between which values
    a robot can follow it, None = whatever they are."""

    name: str
    unit: str
    frame: str
    doc: str
    least: float = -math.inf
    most: float = math.inf
    reach: Callable[[Robot], tuple[float, float]] | None = None

    def bounds(self, robot: Robot) -> tuple[float, float]:
        """Return the least and the most that a robot can be asked for."""
        low, high = (-math.inf, math.inf) if self.reach is None else self.reach(robot)
        return max(low, self.least), min(high, self.most)

    def words(self, low: float, high: float) -> str:
        """Return bounds in words: ``0.1 m or more``, ``0 to 0.217 m/s``."""
        unit = "" if self.unit == "-" else f" {self.unit}"
        return f"{low:g}{unit} or more" if high == math.inf else f"{low:.3g} to {high:.3g}{unit}"


COMMANDS = {
    term.name: term
    for term in (
        CommandTerm("linear_velocity_x", "m/s", "body", "forward velocity of the body origin", reach=_forward),
        CommandTerm(
            "yaw_rate", "rad/s", "body", "angular velocity about the body's z axis, positive to the left", reach=_turning
        ),
        CommandTerm("path_shape", "-", "-", "below 1 a line, below 2 an S-curve, above a circle", least=0.0, most=3.0),
        CommandTerm(
            "path_curvature",
            "1/m",
            "path",
            "of the circle, and of the S-curve at its start; positive to the left",
            least=-20.0,
            most=20.0,
        ),
        CommandTerm("path_wavelength", "m", "path", "of the S-curve", least=0.1),
        CommandTerm("path_offset", "m", "start", "where the path begins, to the left of where the robot stands"),
        CommandTerm("path_heading", "rad", "start", "direction of the path where it begins, positive to the left"),
        CommandTerm("front_leg_first", "rad", "joint", "front leg angle before the sweep", reach=_legs),
        CommandTerm("front_leg_second", "rad", "joint", "front leg angle after the sweep", reach=_legs),
        CommandTerm("rear_leg_first", "rad", "joint", "rear leg angle before the sweep", reach=_legs),
        CommandTerm("rear_leg_second", "rad", "joint", "rear leg angle after the sweep", reach=_legs),
        CommandTerm(
            "leg_rate",
            "rad/s",
            "joint",
            "rate of the legs in the sweep",
            least=0.0,
            reach=lambda robot: (0.0, robot.servo.leg.no_load_speed),
        ),
        CommandTerm(
            "climb_speed", "m/s", "body", "forward velocity of the body origin while climbing", least=0.0, reach=_forward
        ),
        CommandTerm("climb_time", "s", "-", "when to stop climbing and hold", least=0.0),
    )
}


# ---- observation terms: columns of one signal matrix -----------------------------------------------------------------


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


# ---- computed observations: functions of named signals, traced into one compiled kernel per task ---------------------

# They are evaluated after the step's new commands are drawn, so that they speak of what is asked from now on.


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
    error = error_from_path(signals, pose)
    return [error.lateral, error.heading]


@computed("lateral", "heading", unit="m, rad", frame="path", limit=4.0, estimated=True)
def path_error(signals: Signals) -> list[Value]:
    """Estimated distance from the path and heading against it, positive to the left."""
    return _path_error(signals, estimated_pose(signals))


@computed("lateral", "heading", unit="m, rad", frame="path", limit=4.0)
def true_path_error(signals: Signals) -> list[Value]:
    """True distance from the path and heading against it, positive to the left."""
    return _path_error(signals, true_pose(signals))


@computed(*(f"{distance:g} m" for distance in PREVIEW), unit="1/m", frame="path", limit=10.0, estimated=True)
def path_curvature(signals: Signals) -> list[Value]:
    """Curvature of the path at distances ahead, positive to the left."""
    return list(error_from_path(signals, estimated_pose(signals)).curvature)


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
    return [angle - signals.robot("home.leg_angle") for angle, _ in leg_references(signals)]


@computed(*LEGS, unit="rad/s", frame="joint", limit=5.0)
def leg_reference_rate(signals: Signals) -> list[Value]:
    """Commanded leg rate at this time."""
    return [rate for _, rate in leg_references(signals)]


# ---- slopes ----


@computed(unit="m/s", frame="body", limit=2.0)
def climb_command(signals: Signals) -> list[Value]:
    """Commanded forward velocity at this time: climbing, then holding."""
    return [climb_speed(signals)]


# ---- the hand-written controller, for a policy that acts on top of it ------------------------------------------------

# The law of the agent ``slip_compensating`` (wlr_gym.policy.control), whose gains the task's ``controller`` gives. What it
# remembers is its own value of the step before, so that the policy needs no memory.


#: What the controller remembers: integrals of the errors of yaw rate (rad/s) and forward velocity (m/s), times their gains, and
#: by how much the front wheels slip more than the rear ones (m/s), where load is shifted.
MEMORY = ("yaw_rate_integral", "velocity_integral", "slip_difference")
#: What the term ``<task>_memory`` keeps, where the task has it: of the warp (``Warp`` of the agent), and the step's commands.
MORE_MEMORY = ("warp", "warp_level", "yaw_rate_error", "side_difference", "slip_size", "forward", "turn")
#: Where the legs sweep also integrals of the errors of their angles (rad), times their gain.
LEG_MEMORY = tuple(f"{leg}_integral" for leg in LEGS)
#: Ends the name of a term that holds a controller's action.
CONTROLLER = "_controller"

_LABELS = (*JOINTS, *MEMORY)
_UNITS = ", ".join(["-"] * len(JOINTS) + ["rad/s", "m/s", "m/s"])
_MORE_UNITS = "rad, -, rad/s, m/s, m/s, m/s, rad/s"


@dataclass(frozen=True)
class WantedMotion:
    """What the controller is to do.

    Attributes:
        forward: velocity, m/s. turn: yaw rate, rad/s.
        legs: angle from home (rad) and rate (rad/s) of each leg. sweeping: integrate their errors.
        commanded_turn: yaw rate without what leads back to a path, rad/s.
    """

    forward: Value
    turn: Value
    legs: Sequence[tuple[Value, Value]] = ((0.0, 0.0),) * 4
    sweeping: bool = False
    commanded_turn: Value = 0.0


@computed(*_LABELS, unit=_UNITS, frame="-", limit=1.0, estimated=True)
def velocity_controller(signals: Signals) -> list[Value]:
    """Action of the controller that follows the commanded velocity, and what it remembers."""
    return _feedback(signals, "velocity", _commanded(signals))


@computed(*MORE_MEMORY, unit=_MORE_UNITS, frame="-", limit=1.0, estimated=True)
def velocity_memory(signals: Signals) -> list[Value]:
    """What else that controller remembers: the warp of the legs and what it follows, commands."""
    return _more_memory(signals, "velocity", _commanded(signals))


def _commanded(signals: Signals) -> WantedMotion:
    turn = signals.command("yaw_rate")
    return WantedMotion(signals.command("linear_velocity_x"), turn + _steer(signals, 0.0, 0.0), commanded_turn=turn)


@computed(*_LABELS, unit=_UNITS, frame="-", limit=1.0, estimated=True)
def path_controller(signals: Signals) -> list[Value]:
    """Action of the controller that follows the path, and what it remembers."""
    return _feedback(signals, "path", _back_to_path(signals))


@computed(*MORE_MEMORY, unit=_MORE_UNITS, frame="-", limit=1.0, estimated=True)
def path_memory(signals: Signals) -> list[Value]:
    """What else that controller remembers: the warp of the legs and what it follows, commands."""
    return _more_memory(signals, "path", _back_to_path(signals))


def _back_to_path(signals: Signals) -> WantedMotion:
    forward = signals.command("linear_velocity_x")
    error = error_from_path(signals, estimated_pose(signals))
    return WantedMotion(forward, error.curvature[0] * forward + _steer(signals, error.lateral, error.heading))


@computed(*_LABELS, *LEG_MEMORY, unit=f"{_UNITS}, rad, rad, rad, rad", frame="-", limit=1.0, estimated=True)
def posture_controller(signals: Signals) -> list[Value]:
    """Action of the controller that keeps straight on while the legs move, and what it remembers."""
    home = signals.robot("home.leg_angle")
    legs = [(angle - home, rate) for angle, rate in leg_references(signals)]
    motion = WantedMotion(signals.command("linear_velocity_x"), _course(signals), legs, sweeping=True)
    return _feedback(signals, "posture", motion)


@computed(*_LABELS, unit=_UNITS, frame="-", limit=1.0, estimated=True)
def slope_controller(signals: Signals) -> list[Value]:
    """Action of the controller that climbs and holds, and what it remembers."""
    return _feedback(signals, "slope", _uphill(signals))


@computed(*MORE_MEMORY, unit=_MORE_UNITS, frame="-", limit=1.0, estimated=True)
def slope_memory(signals: Signals) -> list[Value]:
    """What else that controller remembers: the warp of the legs and what it follows, commands."""
    return _more_memory(signals, "slope", _uphill(signals))


def _uphill(signals: Signals) -> WantedMotion:
    return WantedMotion(climb_speed(signals), _course(signals))


def _course(signals: Signals) -> Value:
    pose = estimated_pose(signals)
    return _steer(signals, pose.y, pose.yaw)


def _steer(signals: Signals, lateral: Value, heading: Value) -> Value:
    """Yaw rate that leads back to a line, rad/s; on a slope gravity tells which way is up."""
    leftward_force = signals.sensors("accelerometer")[1]
    return signals.gain("uphill") * leftward_force - signals.gain("lateral") * lateral - signals.gain("heading") * heading


def _feedback(signals: Signals, task: str, motion: WantedMotion) -> list[Value]:
    gain, name = signals.gain, f"{task}{CONTROLLER}"
    yaw_rate, velocity = signals.sensors("gyro")[2], signals.estimate("linear_velocity_in_body")[0]
    yaw_integral, velocity_integral, slip_difference = (signals.remembered(f"{name}[{label}]") for label in MEMORY)
    error = motion.turn - yaw_rate
    yaw_integral = _integral(signals, yaw_integral, gain("yaw_rate_i") * error)
    lead, turn_lead = _leads(signals, task, motion)
    turn = gain("steering") * (motion.turn + turn_lead) + gain("yaw_rate_p") * error + yaw_integral
    error = motion.forward - velocity
    velocity_integral = _integral(signals, velocity_integral, gain("velocity_i") * error)
    forward = motion.forward + lead + gain("velocity_p") * error + velocity_integral
    share = ops.where_positive(gain("load_shift"), ops.minimum(signals.control_period / gain("load_shift_time"), 1.0), 0.0)
    warp_before = signals.remembered(f"{task}_memory[warp]")
    warp, level, *_ = _more_memory(signals, task, motion)
    shifted = _lean(signals, slip_difference)
    slip_difference = slip_difference + share * (_slip_difference(signals) - slip_difference)
    hip_x, hip_y = signals.robot("hip_position.x"), signals.robot("hip_position.y")
    reach = hip_x * hip_x / hip_y
    allowed = gain("slip_limit") + reach * ops.absolute(turn / ops.maximum(gain("steering"), 1.0))
    lean = _lean(signals, slip_difference)
    legs, wheels = [], []
    corrections: list[Value] = []
    for index, ((front, left), (offset, rate)) in enumerate(zip(CORNER_SIGNS, motion.legs, strict=True)):
        side = hip_y * left
        travel = velocity - yaw_rate * side
        rolling = ops.clip(forward - turn * side, travel - allowed, travel + allowed)
        inward = gain("legs_inward") * front
        reach, reach_rate = (
            (inward, 0.0)
            if motion.sweeping
            else _reach_under(signals, f"{name}[{LEGS[index]}]", index, shifted - left * warp_before, level)
        )
        offset = offset + reach + lean - left * warp
        rate = rate + reach_rate - left * ((warp - warp_before) / signals.control_period)
        setpoint = offset
        if motion.sweeping:
            corrections.append(_leg_correction(signals, name, index, offset))
            setpoint = offset + corrections[index]
        legs.append(setpoint / signals.task("action.leg_scale"))
        wheels.append(_wheel_rate(signals, rolling, offset, rate) / signals.task("action.wheel_scale"))
    return [
        *(ops.clip(action, -1.0, 1.0) for action in legs + wheels),
        yaw_integral,
        velocity_integral,
        slip_difference,
        *corrections,
    ]


def _leg_correction(signals: Signals, name: str, leg: int, offset: Value) -> Value:
    """What is added to a leg's setpoint (rad): the integral of the error of its measured angle."""
    error = signals.robot("home.leg_angle") + offset - signals.sensors("joint_position")[LEG_SLICE][leg]
    return _integral(signals, signals.remembered(f"{name}[{LEG_MEMORY[leg]}]"), signals.gain("leg_i") * error)


def _leads(signals: Signals, task: str, motion: WantedMotion) -> list[Value]:
    """By how much the commands for forward velocity (m/s) and turn (rad/s) run ahead, for they change."""
    limit, begun = signals.gain("integral_limit"), signals.time - 0.5 * signals.control_period
    leads = []
    for name, command in (("forward", motion.forward), ("turn", motion.commanded_turn)):
        change = command - signals.remembered(f"{task}_memory[{name}]")
        lead = ops.clip(signals.gain(f"{name}_lead") / signals.control_period * change, 0.0 - limit, limit)
        leads.append(ops.where_positive(begun, lead, 0.0))
    return leads


def _more_memory(signals: Signals, task: str, motion: WantedMotion) -> list[Value]:
    """What is remembered after the next step, in the order of :data:`MORE_MEMORY`."""
    gain, period = signals.gain, signals.control_period
    angle, level, error, difference, size = (signals.remembered(f"{task}_memory[{label}]") for label in MORE_MEMORY[:5])
    slip = [ops.absolute(along) for along in signals.estimate("slip_velocity")[0::2]]
    error = error + ops.minimum(period / ERROR_TIME, 1.0) * (motion.turn - signals.sensors("gyro")[2] - error)
    more_left = sum((left * along for (_, left), along in zip(CORNER_SIGNS, slip, strict=True)), 0.0) * 0.5
    difference = difference + period / SLIP_TIME * (more_left - difference)
    size = size + period / SLIP_TIME * (mean(slip) - size)
    uneven = ops.absolute(difference) / (size + LEAST_SLIP)
    split = ops.clip((uneven - UNEVEN) / UNEVEN_RANGE, 0.0, 1.0)
    rise = gain("warp_rise") * split * ops.maximum(ops.absolute(error) - gain("warp_threshold"), 0.0)
    level = ops.clip(level + period * (rise - level / gain("warp_forget")), 0.0, 1.0)
    most = WARP_RATE * period
    angle = angle + ops.clip(gain("warp") * level - angle, 0.0 - most, most)
    return [angle, level, error, difference, size, motion.forward, motion.commanded_turn]


def _reach_under(signals: Signals, action: str, leg: int, shifted: Value, level: Value) -> tuple[Value, Value]:
    """How far a leg reaches under the body after the next step (rad from home), and how fast it moves (rad/s).

    Args:
        action: name of the leg's action in what the controller remembers: it says where the leg was sent.
        leg: index. shifted: what of that was load shift and warp, rad. level: of the warp; the legs it unloads go faster.
    """
    gain, period = signals.gain, signals.control_period
    wanted, within = gain("legs_inward") * CORNER_SIGNS[leg][0], gain("lean_time")
    start = signals.sensors("joint_position")[LEG_SLICE][leg] - signals.robot("home.leg_angle")
    sent = signals.remembered(action) * signals.task("action.leg_scale") - shifted
    before = ops.where_positive(signals.time - 0.5 * period, sent, start)
    step = ops.absolute(wanted) * period / ops.maximum(within, period)
    if CORNER_SIGNS[leg][0] != CORNER_SIGNS[leg][1]:
        step = step * (1.0 + gain("warp_reach") * level)
    after = before + ops.clip(wanted - before, 0.0 - step, step)
    even = within * ops.absolute(wanted)  # positive = not at once
    return ops.where_positive(even, after, wanted), ops.where_positive(even, (after - before) / period, 0.0)


def _integral(signals: Signals, value: Value, rate: Value) -> Value:
    limit = signals.gain("integral_limit")
    return ops.clip(value + signals.control_period * rate, 0.0 - limit, limit)


def _wheel_rate(signals: Signals, rolling: Value, offset: Value, leg_rate: Value) -> Value:
    """Rate of a wheel against its leg (rad/s) that moves the hip ahead at ``rolling``; see ``Chassis.wheel_rate``."""
    angle = signals.robot("home.leg_angle") + offset
    return (rolling - signals.robot("leg.length") * ops.sin(angle) * leg_rate) / signals.robot("wheel.radius") - leg_rate


def _slip_difference(signals: Signals) -> Value:
    slip = signals.estimate("slip_velocity")[0::2]
    return sum((front * ops.absolute(s) for (front, _), s in zip(CORNER_SIGNS, slip, strict=True)), 0.0) * 0.5


def _lean(signals: Signals, slip_difference: Value) -> Value:
    """Angle (rad) by which all legs lean so that load moves to the axle that slips less; arcsin by arctan2."""
    bound = signals.gain("largest_shift")
    shift = ops.clip(0.0 - signals.gain("load_shift") * slip_difference, 0.0 - bound, bound)
    sine = 2.0 * signals.robot("hip_position.x") * shift / signals.robot("leg.length")
    return ops.arctan2(sine, ops.sqrt(1.0 - sine * sine))
