"""The robot's numbers, loaded from ``configs/robot/*.yaml``. SI units and radians; frames as in REP-103.

Joint order everywhere (actions, observations, logs): the four legs, then the four wheels, each lf, rf, lr, rr
(left/right, front/rear). Leg angle: right-handed about body +y of the vector hip -> wheel centre, 0 forward, pi/2
straight down. Wheel angle: right-handed about body +y, relative to its leg; positive rolls forward.
"""

from __future__ import annotations

import copy
import hashlib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from wlr_gym.errors import InputError, nearest
from wlr_gym.paths import find_config, named_in

CORNERS = ("lf", "rf", "lr", "rr")
LEGS = tuple(f"leg_{corner}" for corner in CORNERS)
WHEELS = tuple(f"wheel_{corner}" for corner in CORNERS)
JOINTS = LEGS + WHEELS
#: Signs of the hip positions (x, y) in the body frame, in corner order.
CORNER_SIGNS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))

Vector3 = tuple[float, float, float]
ModelType = TypeVar("ModelType", bound=BaseModel)


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Body(_Model):
    """The platform: mass (kg), size (m), principal inertia about its centre of mass (kg m2), centre of mass (m)."""

    mass: float = Field(gt=0)
    size: Vector3
    inertia: tuple[float | None, float | None, float | None]
    com_offset: Vector3 = (0.0, 0.0, 0.0)


class HipPosition(_Model):
    """Distance of the hips from the body origin along x and y (m, both signs occur), and their common z."""

    x: float = Field(gt=0)
    y: float = Field(gt=0)
    z: float = 0.0


class Leg(_Model):
    """One leg: length hip to wheel centre (m), mass (kg), centre of mass from the hip (m), inertia (kg m2)
    about its own centre of mass, straight down: about x, about y, about its own axis."""

    length: float = Field(gt=0)
    mass: float | None = Field(gt=0)
    com_along_leg: float = Field(ge=0)
    inertia: tuple[float | None, float | None, float | None]


class Wheel(_Model):
    """One wheel: radius, width (m), mass (kg), inertia about the axle and across it (kg m2)."""

    radius: float = Field(gt=0)
    width: float = Field(gt=0)
    mass: float | None = Field(gt=0)
    spin_inertia: float = Field(gt=0)
    transverse_inertia: float | None = Field(gt=0)


class Motor(_Model):
    """One servo at its output shaft; torque and speed at the nominal supply voltage (source: ROBOTIS e-manual)."""

    stall_torque: float = Field(gt=0)
    no_load_speed: float = Field(gt=0)
    kp: float = Field(ge=0)
    kd: float = Field(ge=0)
    armature: float = Field(gt=0)
    coulomb_friction: float = Field(ge=0)
    gear_stiffness: float = Field(gt=0)
    viscous_friction: float = Field(ge=0)


class Servo(_Model):
    """Supply voltage (V) and the two servo types."""

    supply_voltage: float = Field(gt=0)
    leg: Motor
    wheel: Motor


class Ground(_Model):
    """Floor: friction along heading and axle, slope along x (rad), contact stiffness (N/m) and damping (N s/m)."""

    mu_x: float = Field(ge=0)
    mu_y: float = Field(ge=0)
    slope: float = 0.0
    normal_stiffness: float = Field(gt=0)
    normal_damping: float = Field(ge=0)


class Encoder(_Model):
    """One register count of position (rad) and velocity (rad/s)."""

    position: float = Field(ge=0)
    velocity: float = Field(ge=0)


class EffortSensor(_Model):
    """1 sigma noise of the torque estimate (N m)."""

    leg_noise: float = Field(ge=0)
    wheel_noise: float = Field(ge=0)


class Imu(_Model):
    """Bandwidth (Hz), noise per 50 Hz sample and constant bias, 1 sigma (rad/s, m/s2)."""

    bandwidth: float = Field(gt=0)
    gyro_noise: float = Field(ge=0)
    accel_noise: float = Field(ge=0)
    gyro_bias: float = Field(ge=0)
    accel_bias: float = Field(ge=0)


class Camera(_Model):
    """Frame rate (Hz) and 1 sigma noise of the floor pose (m, rad)."""

    rate: float = Field(gt=0)
    position_noise: float = Field(ge=0)
    yaw_noise: float = Field(ge=0)


class SensorSet(_Model):
    """What the robot can measure, and how badly."""

    control_rate: float = Field(gt=0)
    encoder: Encoder
    effort: EffortSensor
    volt_noise: float = Field(ge=0)
    imu: Imu
    camera: Camera


class Home(_Model):
    """The pose every episode starts from."""

    leg_angle: float


class Robot(_Model):
    """A whole robot, as one ``configs/robot/*.yaml`` describes it."""

    name: str
    gravity: float = Field(ge=0)
    body: Body
    hip_position: HipPosition
    leg: Leg
    wheel: Wheel
    joints: tuple[str, ...]
    dynamixel_ids: dict[str, int]
    home: Home
    leg_limits: tuple[float, float]
    servo: Servo
    ground: Ground
    sensors: SensorSet
    tolerances: dict[str, float | str] = {}

    @field_validator("leg_limits")
    @classmethod
    def _limits_are_ordered(cls, limits: tuple[float, float]) -> tuple[float, float]:
        if not limits[0] < limits[1]:
            raise ValueError("the lower limit must be below the upper one")
        return limits

    @field_validator("dynamixel_ids")
    @classmethod
    def _every_joint_has_its_own_id(cls, ids: dict[str, int]) -> dict[str, int]:
        if set(ids) != set(JOINTS) or len(set(ids.values())) != len(JOINTS):
            raise ValueError(f"expected one id of its own for each of {', '.join(JOINTS)}")
        if not all(0 <= number <= 252 for number in ids.values()):
            raise ValueError("Dynamixel ids are 0 to 252")
        return ids

    @property
    def total_mass(self) -> float:
        """Mass of body, legs and wheels (kg)."""
        return self.body.mass + 4 * ((self.leg.mass or 0.0) + (self.wheel.mass or 0.0))


def physical_faults(robot: Robot) -> list[str]:
    """Return why ``robot`` cannot be simulated: missing numbers and inertias no rigid body of that size can have.

    A body's inertia is bounded below by plausibility (5 % of a uniform box of the given size: all mass within a fifth
    of the half-width) and by the triangle inequality. Paper audit, Table I: I_Gy and I_Gz are 1000 times too small.
    """
    faults = [f"{path} is missing" for path, value in _missing_candidates(robot) if value is None]
    x, y, z = robot.body.size
    box = [robot.body.mass / 12 * s for s in (y * y + z * z, x * x + z * z, x * x + y * y)]
    for axis, value, uniform in zip("xyz", robot.body.inertia, box, strict=True):
        if value is not None and value < 0.05 * uniform:
            faults.append(
                f"body.inertia {axis} = {value:g} kg m2 is impossible for {robot.body.mass:g} kg in a body of {x:g} x {y:g} x "
                f"{z:g} m: a uniform box has {uniform:.4g}, {uniform / value:.0f} times more"
            )
    faults += _triangle_faults("body.inertia", robot.body.inertia)
    faults += _triangle_faults("leg.inertia", robot.leg.inertia)
    if not robot.leg_limits[0] <= robot.home.leg_angle <= robot.leg_limits[1]:
        faults.append(f"home.leg_angle = {robot.home.leg_angle:g} rad is outside leg_limits {list(robot.leg_limits)}")
    if robot.joints != JOINTS:
        faults.append(f"joints must be {list(JOINTS)} in this order, not {list(robot.joints)}")
    return faults


def _missing_candidates(robot: Robot) -> list[tuple[str, float | None]]:
    candidates: list[tuple[str, float | None]] = [
        (f"body.inertia {axis}", value) for axis, value in zip("xyz", robot.body.inertia, strict=True)
    ]
    candidates += [("leg.mass", robot.leg.mass)]
    candidates += [(f"leg.inertia {axis}", value) for axis, value in zip("xyz", robot.leg.inertia, strict=True)]
    return [*candidates, ("wheel.mass", robot.wheel.mass), ("wheel.transverse_inertia", robot.wheel.transverse_inertia)]


def _triangle_faults(name: str, inertia: tuple[float | None, ...]) -> list[str]:
    if any(value is None for value in inertia):
        return []
    values = [float(value) for value in inertia if value is not None]
    if min(values) > 0 and 2 * max(values) <= sum(values) * (1 + 1e-9):
        return []
    return [f"{name} = {values} breaks the triangle inequality every rigid body obeys"]


def load_robot(source: str | Path | Robot = "nominal", *, check: bool = True) -> Robot:
    """Load a robot by config name or path.

    Args:
        source: name in ``configs/robot/``, path of a YAML file, or a :class:`Robot` (returned as it is).
        check: refuse a robot that no rigid body can be (see :func:`physical_faults`).

    Raises:
        InputError: unreadable file, unknown or missing key, value of the wrong kind, or a physically impossible robot.
    """
    robot = source if isinstance(source, Robot) else _read(find_config("robot", source))
    faults = physical_faults(robot) if check else []
    if faults:
        raise InputError(f"robot '{robot.name}' cannot be simulated: " + "; ".join(faults))
    return robot


def _read(path: Path) -> Robot:
    return parse_config(Robot, _resolved(path), str(path))


def _resolved(path: Path, above: tuple[Path, ...] = ()) -> Any:
    """Return what a robot file says, laid over its ``base`` where it names one: a config name, or a path from this file on.

    The name is its own: another robot has another one.
    """
    data = read_yaml(path)
    if not isinstance(data, dict) or "base" not in data:
        return data
    if path in above:
        raise InputError(f"{path}: is its own base ({' -> '.join(map(str, [*above, path]))})")
    base = data.pop("base")
    if not isinstance(base, str):
        raise InputError(f"{path}: base = {base!r}: expected the name or the path of a robot file")
    place = find_config("robot", named_in(path, base))
    lower = _resolved(place, (*above, path))
    parse_config(Robot, lower, str(place))  # what is wrong in a base is said with its own name
    return overlay({key: value for key, value in lower.items() if key != "name"}, data)


def overlay(base: Any, changes: Mapping[str, Any]) -> Any:
    """Return ``base`` with ``changes`` laid over it: mappings merge key by key, None removes a key."""
    if not isinstance(base, Mapping):
        return dict(changes)
    merged = dict(copy.deepcopy(base))
    for key, value in changes.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = overlay(merged.get(key) or {}, value) if isinstance(value, Mapping) else value
    return merged


def merge_changes(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Return the changes that say what ``first`` says and, over it, ``second``: mappings merge key by key, None stays."""
    merged = {**first, **second}
    for key, value in second.items():
        if isinstance(value, Mapping) and isinstance(first.get(key), Mapping):
            merged[key] = merge_changes(first[key], value)
    return merged


def read_yaml(path: str | Path) -> Any:
    """Read a YAML file; a broken one is an :class:`InputError` naming file, line and column."""
    try:
        return parse_yaml(Path(path).read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise InputError(f"{path}{place}: broken YAML: {getattr(error, 'problem', error)}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def parse_yaml(text: str) -> Any:
    """Return what YAML text says, as a file of ours is read: 1e-3 is a number.

    Raises:
        yaml.YAMLError: broken, or a key given twice.
    """
    return yaml.load(text, Loader=_Loader)


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e-3 and 2.5e-4 as numbers (YAML 1.1 takes the former for text) and refuses a key given twice."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        """Read a mapping as it is written; merging by ``<<`` comes later."""
        node = super().compose_mapping_node(anchor)
        lines: dict[str, int] = {}
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in lines:
                problem = f"key '{key.value}' occurs twice, first in line {lines[key.value]}"
                raise yaml.constructor.ConstructorError(problem=problem, problem_mark=key.start_mark)
            lines[key.value] = key.start_mark.line + 1
        return node


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def parse_config(model: type[ModelType], data: object, where: str) -> ModelType:
    """Validate ``data`` against a pydantic model.

    Raises:
        InputError: naming file, field, value, what was expected and, for an unknown key, the nearest valid name.
    """
    if not isinstance(data, dict):
        raise InputError(f"{where}: expected a mapping of {', '.join(model.model_fields)}, got {type(data).__name__}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise InputError("; ".join(_explain(model, problem, where) for problem in error.errors())) from None


def _explain(model: type[BaseModel], problem: Any, where: str) -> str:
    location = [str(part) for part in problem["loc"]]
    field = ".".join(location)
    if problem["type"] == "extra_forbidden":
        valid = _fields_at(model, location[:-1])
        return f"{where}: unknown key '{field}'{nearest(location[-1], valid)}; valid: {', '.join(valid)}"
    if problem["type"] == "missing":
        return f"{where}: '{field}' is missing"
    value = f"{field} = {problem['input']!r}: " if field else ""  # what is about the whole file does not repeat it
    return f"{where}: {value}{problem['msg']}"


def _fields_at(model: Any, path: list[str]) -> list[str]:
    for part in path:
        if get_origin(model) is dict:
            model = get_args(model)[1]
            continue
        field = getattr(model, "model_fields", {}).get(part)
        if field is None:
            return []
        options = get_args(field.annotation)
        model = options[0] if type(None) in options else field.annotation  # X | None
    return list(getattr(model, "model_fields", {}))


def standing_height(robot: Robot, leg_angle: float) -> float:
    """Height of the body origin above a level floor with all legs at ``leg_angle``, contacts unloaded (m)."""
    return robot.leg.length * math.sin(leg_angle) + robot.wheel.radius - robot.hip_position.z


def robot_hash(robot: Robot) -> str:
    """Short fingerprint of a robot's numbers."""
    return _fingerprint(robot)


def servo_hash(robot: Robot) -> str:
    """Short fingerprint of the numbers of a robot's servos."""
    return _fingerprint(robot.servo)


def _fingerprint(numbers: BaseModel) -> str:
    return hashlib.sha256(numbers.model_dump_json().encode()).hexdigest()[:16]
