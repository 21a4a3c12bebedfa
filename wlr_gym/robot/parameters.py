"""THE parameter table: every physical number a simulator reads, once.

:class:`Parameters` is a structure of arrays, one value per robot of a batch. Randomisation writes it, effects write it,
the gap workflow fits it, logs record it. Names are dotted, with the joint, wheel or axis in brackets:
``wheel.radius[wheel_lf]``, ``ground.mu_x[wheel_rr]``, ``body.com_offset[x]``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.errors import InputError, unknown_name
from wlr_gym.robot import JOINTS, LEGS, WHEELS, Robot

XYZ = ("x", "y", "z")
#: Areas of the floor that may have a friction of their own.
PATCHES = ("patch_1", "patch_2", "patch_3", "patch_4")
Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterSpec:
    """One row of the table.

    Attributes:
        name: dotted name without index.
        unit: SI unit, "-" for a pure number.
        labels: names of the elements; empty for a scalar.
        nominal: value(s) for a robot.
        low, high: bounds outside which the engine refuses a value.
        tolerance: key of the robot file's tolerances, or empty.
        doc: meaning.
    """

    name: str
    unit: str
    labels: tuple[str, ...]
    nominal: Callable[[Robot], Any]
    low: float
    high: float
    tolerance: str
    doc: str

    @property
    def size(self) -> int:
        """Number of values per robot."""
        return max(1, len(self.labels))

    @property
    def elements(self) -> list[str]:
        """Full names, one per value: ``wheel.radius[wheel_lf]`` or just ``gravity``."""
        return [f"{self.name}[{label}]" for label in self.labels] or [self.name]


def _per_joint(leg: Callable[[Robot], float], wheel: Callable[[Robot], float]) -> Callable[[Robot], list[float]]:
    return lambda robot: [leg(robot)] * 4 + [wheel(robot)] * 4


def _motor(field: str) -> Callable[[Robot], list[float]]:
    return _per_joint(lambda r: getattr(r.servo.leg, field), lambda r: getattr(r.servo.wheel, field))


INERTIA_LABELS = ("xx", "yy", "zz", "xy", "xz", "yz")
LEG_INERTIA_LABELS = tuple(f"{leg},{axis}" for leg in LEGS for axis in XYZ)

TABLE: tuple[ParameterSpec, ...] = (
    ParameterSpec("gravity", "m/s2", (), lambda r: r.gravity, 0, 30, "", "gravitational acceleration"),
    ParameterSpec(
        "body.mass", "kg", (), lambda r: r.body.mass, 0.05, 100, "body.mass", "platform without legs, wheels and payload"
    ),
    ParameterSpec(
        "body.inertia",
        "kg m2",
        XYZ,
        lambda r: r.body.inertia,
        1e-5,
        10,
        "body.inertia",
        "principal inertia of the platform about its own centre of mass, axes of the body frame",
    ),
    ParameterSpec(
        "body.com_offset",
        "m",
        XYZ,
        lambda r: r.body.com_offset,
        -0.2,
        0.2,
        "body.com_offset",
        "centre of mass of the platform from the body's geometric origin; IMU and marker stay at the origin",
    ),
    ParameterSpec("payload.mass", "kg", (), lambda r: 0.0, 0, 20, "", "mass fixed to the body"),
    ParameterSpec(
        "payload.position", "m", XYZ, lambda r: (0.0, 0.0, 0.0), -0.5, 0.5, "", "its centre of mass in the body frame"
    ),
    ParameterSpec(
        "payload.inertia",
        "kg m2",
        INERTIA_LABELS,
        lambda r: [0.0] * 6,
        -10,
        10,
        "",
        "of a payload of several masses about its own centre, axes of the body frame; xy = -integral of x y dm",
    ),
    ParameterSpec(
        "hip.position",
        "m",
        XYZ,
        lambda r: (r.hip_position.x, r.hip_position.y, r.hip_position.z),
        -1,
        1,
        "",
        "hips from the body origin; x and y with the signs of the corner",
    ),
    ParameterSpec("leg.length", "m", LEGS, lambda r: [r.leg.length] * 4, 0.01, 1, "", "hip axis to wheel axle"),
    ParameterSpec("leg.mass", "kg", LEGS, lambda r: [r.leg.mass] * 4, 0, 10, "leg.mass", "leg without wheel"),
    ParameterSpec(
        "leg.com_along_leg", "m", LEGS, lambda r: [r.leg.com_along_leg] * 4, -0.5, 1, "", "hip to the leg's centre of mass"
    ),
    ParameterSpec(
        "leg.inertia",
        "kg m2",
        LEG_INERTIA_LABELS,
        lambda r: list(r.leg.inertia) * 4,
        1e-8,
        1,
        "leg.inertia",
        "about the leg's own centre of mass, leg straight down: about x, about y, about its own axis",
    ),
    ParameterSpec("wheel.radius", "m", WHEELS, lambda r: [r.wheel.radius] * 4, 0.005, 0.5, "wheel.radius", "rolling radius"),
    ParameterSpec(
        "wheel.grip",
        "-",
        WHEELS,
        lambda r: [1.0] * 4,
        0,
        5,
        "",
        "factor on the friction of every floor under this wheel (wear)",
    ),
    ParameterSpec("wheel.mass", "kg", WHEELS, lambda r: [r.wheel.mass] * 4, 0, 10, "", "wheel, at the end of its leg"),
    ParameterSpec(
        "wheel.spin_inertia",
        "kg m2",
        WHEELS,
        lambda r: [r.wheel.spin_inertia] * 4,
        1e-8,
        1,
        "",
        "about the axle, without rotor",
    ),
    ParameterSpec(
        "wheel.transverse_inertia",
        "kg m2",
        WHEELS,
        lambda r: [r.wheel.transverse_inertia] * 4,
        0,
        1,
        "",
        "about an axis across the axle",
    ),
    ParameterSpec(
        "servo.supply_voltage",
        "V",
        (),
        lambda r: r.servo.supply_voltage,
        0,
        30,
        "servo.supply_voltage",
        "voltage at the servos",
    ),
    ParameterSpec(
        "servo.stall_torque",
        "N m",
        JOINTS,
        _motor("stall_torque"),
        1e-3,
        100,
        "servo.stall_torque",
        "at the robot file's nominal supply voltage; with no_load_speed it gives torque constant and resistance",
    ),
    ParameterSpec(
        "servo.no_load_speed",
        "rad/s",
        JOINTS,
        _motor("no_load_speed"),
        0.1,
        200,
        "servo.no_load_speed",
        "at the robot file's nominal supply voltage",
    ),
    ParameterSpec(
        "servo.kp",
        "V/rad",
        JOINTS,
        _motor("kp"),
        0,
        2000,
        "servo.kp",
        "gain on the position error (wheels: on the integral of the speed error)",
    ),
    ParameterSpec("servo.kd", "V s/rad", JOINTS, _motor("kd"), 0, 50, "", "gain on the velocity error"),
    ParameterSpec(
        "servo.armature", "kg m2", JOINTS, _motor("armature"), 1e-6, 1, "servo.armature", "rotor inertia at the output shaft"
    ),
    ParameterSpec(
        "servo.coulomb_friction",
        "N m",
        JOINTS,
        _motor("coulomb_friction"),
        0,
        50,
        "servo.coulomb_friction",
        "dry gear friction",
    ),
    ParameterSpec(
        "servo.viscous_friction",
        "N m s/rad",
        JOINTS,
        _motor("viscous_friction"),
        0,
        10,
        "servo.viscous_friction",
        "beyond back-EMF",
    ),
    ParameterSpec(
        "servo.torque_scale",
        "-",
        JOINTS,
        lambda r: [1.0] * 8,
        0,
        2,
        "",
        "torque of the motor over what its current says: a weak magnet, not seen in the reported effort",
    ),
    ParameterSpec(
        "servo.stribeck_torque",
        "N m",
        JOINTS,
        lambda r: [0.0] * 8,
        0,
        50,
        "",
        "dry gear friction at rest beyond that in motion; fades with exp(-(rate/stribeck_speed)^2)",
    ),
    ParameterSpec(
        "servo.stribeck_speed", "rad/s", JOINTS, lambda r: [0.1] * 8, 1e-4, 20, "", "rate over which stribeck_torque fades"
    ),
    ParameterSpec(
        "servo.load_friction",
        "-",
        JOINTS,
        lambda r: [0.0] * 8,
        0,
        1,
        "",
        "dry gear friction per motor torque: grows with what the gear transmits",
    ),
    ParameterSpec(
        "servo.ripple_amplitude",
        "N m",
        JOINTS,
        lambda r: [0.0] * 8,
        0,
        10,
        "",
        "motor torque periodic in the joint angle: amplitude sin(order angle + phase)",
    ),
    ParameterSpec("servo.ripple_order", "-", JOINTS, lambda r: [1.0] * 8, 0, 1000, "", "periods of the ripple per turn"),
    ParameterSpec("servo.ripple_phase", "rad", JOINTS, lambda r: [0.0] * 8, -10, 10, "", "phase of the ripple at angle 0"),
    ParameterSpec(
        "servo.backlash",
        "rad",
        JOINTS,
        lambda r: [0.0] * 8,
        0,
        0.5,
        "",
        "full width of the gear's play; encoder and link are on its output side, rotor and gear friction on the motor's",
    ),
    ParameterSpec(
        "servo.gear_stiffness",
        "N m/rad",
        JOINTS,
        _motor("gear_stiffness"),
        1,
        1e5,
        "",
        "of the teeth that meet at the end of the play; without play the gear is rigid",
    ),
    ParameterSpec(
        "servo.supply_resistance",
        "ohm",
        (),
        lambda r: 0.0,
        0,
        5,
        "",
        "internal resistance: the supply drops by it times the sum of absolute motor currents",
    ),
    ParameterSpec(
        "servo.profile_velocity",
        "rad/s",
        JOINTS,
        lambda r: [0.0] * 8,
        0,
        200,
        "",
        "profile velocity of the legs; 0 = no limit (Dynamixel convention); not used by the wheels",
    ),
    ParameterSpec(
        "servo.profile_acceleration",
        "rad/s2",
        JOINTS,
        lambda r: [0.0] * 8,
        0,
        1e5,
        "",
        "profile acceleration; 0 = step references",
    ),
    ParameterSpec(
        "command.delay", "s", JOINTS, lambda r: [0.0] * 8, 0, 0.2, "command.delay", "goals act this much later than written"
    ),
    ParameterSpec(
        "ground.mu_x", "-", WHEELS, lambda r: [r.ground.mu_x] * 4, 0, 5, "ground.mu", "friction along the wheel's heading"
    ),
    ParameterSpec(
        "ground.mu_y", "-", WHEELS, lambda r: [r.ground.mu_y] * 4, 0, 5, "ground.mu", "friction along the wheel's axle"
    ),
    ParameterSpec(
        "ground.rolling_resistance",
        "-",
        WHEELS,
        lambda r: [0.0] * 4,
        0,
        1,
        "",
        "torque over normal force and radius, opposing the spin",
    ),
    ParameterSpec(
        "ground.kinetic_ratio",
        "-",
        WHEELS,
        lambda r: [1.0] * 4,
        0,
        1,
        "",
        "friction at fast slip over friction at rest: ratio + (1 - ratio) exp(-slip speed/weakening_speed)",
    ),
    ParameterSpec(
        "ground.weakening_speed", "m/s", WHEELS, lambda r: [0.1] * 4, 1e-3, 10, "", "slip speed over which friction falls"
    ),
    ParameterSpec(
        "ground.creep_speed",
        "m/s",
        WHEELS,
        lambda r: [0.0] * 4,
        0,
        1,
        "",
        "friction builds up with slip speed as tanh(speed/creep_speed); 0 = dry friction that sticks",
    ),
    ParameterSpec(
        "patch.mu",
        "-",
        PATCHES,
        lambda r: [0.0] * 4,
        0,
        5,
        "",
        "friction along the heading inside an area of the floor (along the axle: times ground.mu_y/mu_x); later patches win",
    ),
    ParameterSpec("patch.x_min", "m", PATCHES, lambda r: [0.0] * 4, -1e3, 1e3, "", "area of the patch, floor frame"),
    ParameterSpec("patch.x_max", "m", PATCHES, lambda r: [0.0] * 4, -1e3, 1e3, "", "no patch where x_max <= x_min"),
    ParameterSpec("patch.y_min", "m", PATCHES, lambda r: [0.0] * 4, -1e3, 1e3, "", "area of the patch, floor frame"),
    ParameterSpec("patch.y_max", "m", PATCHES, lambda r: [0.0] * 4, -1e3, 1e3, "", "no patch where y_max <= y_min"),
    ParameterSpec(
        "ground.normal_stiffness",
        "N/m",
        WHEELS,
        lambda r: [r.ground.normal_stiffness] * 4,
        100,
        2e5,
        "",
        "tyre and chassis together",
    ),
    ParameterSpec(
        "ground.normal_damping", "N s/m", WHEELS, lambda r: [r.ground.normal_damping] * 4, 0, 500, "", "normal contact damping"
    ),
    ParameterSpec(
        "ground.slope",
        "rad",
        ("pitch", "roll"),
        lambda r: (r.ground.slope, 0.0),
        -1.2,
        1.2,
        "ground.slope",
        "inclination of the floor's x and y axes; positive = uphill. The world frame is the floor frame",
    ),
    ParameterSpec(
        "external_force", "N", ("x", "y"), lambda r: (0.0, 0.0), -1e3, 1e3, "", "constant force on the body origin, floor frame"
    ),
    ParameterSpec(
        "tether.stiffness",
        "N/m",
        (),
        lambda r: 0.0,
        0,
        1e4,
        "",
        "horizontal pull on the body origin towards the anchor, no rest length",
    ),
    ParameterSpec("tether.anchor", "m", ("x", "y"), lambda r: (0.0, 0.0), -1e3, 1e3, "", "point on the floor, floor frame"),
    ParameterSpec(
        "joint.zero_offset",
        "rad",
        LEGS,
        lambda r: [0.0] * 4,
        -0.5,
        0.5,
        "joint_zero",
        "encoder reading minus true angle; the servo regulates the reading",
    ),
    ParameterSpec("imu.gyro_bias", "rad/s", XYZ, lambda r: (0.0, 0.0, 0.0), -1, 1, "", "constant gyroscope offset"),
    ParameterSpec("imu.accel_bias", "m/s2", XYZ, lambda r: (0.0, 0.0, 0.0), -5, 5, "", "constant accelerometer offset"),
    ParameterSpec(
        "imu.mount",
        "rad",
        ("roll", "pitch", "yaw"),
        lambda r: (0.0, 0.0, 0.0),
        -0.5,
        0.5,
        "",
        "rotation from sensor to body, Rz(yaw) Ry(pitch) Rx(roll)",
    ),
    ParameterSpec(
        "imu.bandwidth",
        "Hz",
        (),
        lambda r: r.sensors.imu.bandwidth,
        1,
        1e4,
        "",
        "first-order low-pass of gyroscope and accelerometer",
    ),
    ParameterSpec(
        "camera.mount_yaw",
        "rad",
        (),
        lambda r: 0.0,
        -0.5,
        0.5,
        "camera.mount_yaw",
        "camera's floor frame turned against the start heading",
    ),
    ParameterSpec("camera.scale", "-", (), lambda r: 1.0, 0.5, 2, "", "measured over true lengths of the camera's floor frame"),
    ParameterSpec("camera.delay", "s", (), lambda r: 0.0, 0, 0.5, "camera.delay", "age of a vision pose when it is delivered"),
)

SPECS: dict[str, ParameterSpec] = {spec.name: spec for spec in TABLE}
ELEMENTS: tuple[str, ...] = tuple(element for spec in TABLE for element in spec.elements)
_COLUMN = {element: column for column, element in enumerate(ELEMENTS)}
_SLICES: dict[str, slice] = {}
for _spec in TABLE:
    _start = _COLUMN[_spec.elements[0]]
    _SLICES[_spec.name] = slice(_start, _start + _spec.size)
_LOW = np.array([spec.low for spec in TABLE for _ in spec.elements])
_HIGH = np.array([spec.high for spec in TABLE for _ in spec.elements])


class Parameters:
    """Physical parameters of a batch of robots: matrix ``values`` of shape (N, len(ELEMENTS)), float64.

    ``parameters["wheel.radius"]`` is a writable view: shape (N,) for a scalar, (N, size) otherwise;
    ``parameters["wheel.radius[wheel_lf]"]`` is a writable view of shape (N,).
    """

    def __init__(self, values: Array) -> None:
        self.values = np.ascontiguousarray(values, dtype=np.float64)
        if self.values.ndim != 2 or self.values.shape[1] != len(ELEMENTS):
            raise InputError(f"parameter matrix has shape {self.values.shape}, expected (N, {len(ELEMENTS)})")

    @classmethod
    def nominal(cls, robot: Robot, count: int = 1) -> Parameters:
        """Return the nominal parameters of ``robot`` for ``count`` robots."""
        row = np.concatenate([np.ravel(np.asarray(spec.nominal(robot), dtype=np.float64)) for spec in TABLE])
        return cls(np.tile(row, (count, 1)))

    def __len__(self) -> int:
        return self.values.shape[0]

    def __getitem__(self, name: str) -> Array:
        if name in _SLICES:
            view = self.values[:, _SLICES[name]]
            return view[:, 0] if not SPECS[name].labels else view
        if name in _COLUMN:
            return self.values[:, _COLUMN[name]]
        raise unknown_parameter(name)

    def __setitem__(self, name: str, value: ArrayLike) -> None:
        target = self[name]
        try:
            target[...] = value
        except (TypeError, ValueError) as error:
            raise InputError(f"parameter '{name}' takes numbers of shape {target.shape}: {error}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(SPECS)

    def copy(self) -> Parameters:
        """Return an independent copy."""
        return Parameters(self.values.copy())

    def validate(self) -> None:
        """Raise :class:`InputError` naming the first element that is not finite or outside its bounds."""
        bad = ~((self.values >= _LOW) & (self.values <= _HIGH))
        if not bad.any():
            self._validate_payload()
            return
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"parameter {ELEMENTS[column]} = {self.values[row, column]:g} (robot {row} of the batch) is outside "
            f"{range_in_words(float(_LOW[column]), float(_HIGH[column]), spec_of(ELEMENTS[column]).unit)}"
        )

    def _validate_payload(self) -> None:
        """Refuse an inertia that no masses have."""
        inertia = self["payload.inertia"]
        if not inertia.any():
            return
        xx, yy, zz, xy, xz, yz = inertia.T
        moments = np.linalg.eigvalsh(np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3))
        excess = 2.0 * moments.max(axis=1) - moments.sum(axis=1)
        wrong = np.maximum(excess, -moments.min(axis=1)) > 1e-9 * np.abs(moments).max(axis=1)
        if wrong.any():
            robot = int(np.argmax(wrong))
            raise InputError(
                f"parameter payload.inertia (robot {robot} of the batch) has principal moments {moments[robot].tolist()} "
                "kg m2: no masses have them (none may be negative, none above the sum of the other two)"
            )


def unit_in_words(unit: str) -> str:
    """Return a unit as messages name it: "-" is a pure number."""
    return "a pure number" if unit == "-" else unit


def range_in_words(low: float, high: float, unit: str) -> str:
    """Return a range with its unit as messages name it."""
    return f"[{low:g}, {high:g}] {'(a pure number)' if unit == '-' else unit}"


def spec_of(name: str) -> ParameterSpec:
    """Return the table row of a parameter or of one of its elements."""
    spec = SPECS.get(name.partition("[")[0])
    if spec is None or (name != spec.name and name not in spec.elements):
        raise unknown_parameter(name)
    return spec


def unknown_parameter(name: str) -> InputError:
    """Build the error for a name that is not in the table, with the nearest valid one."""
    base = name.partition("[")[0]
    if base in SPECS and SPECS[base].labels:
        label = name.partition("[")[2].rstrip("]")
        return unknown_name(f"element of parameter '{base}'", label, SPECS[base].labels)
    return unknown_name("parameter", name, [*SPECS])
