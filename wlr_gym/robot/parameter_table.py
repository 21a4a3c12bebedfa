"""THE parameter table: every physical number a simulator reads, once, one line each. Joints by name, and tolerances.

Names are dotted, with the joint, wheel or axis in brackets: ``wheel.radius[wheel_lf]``, ``ground.mu_x[wheel_rr]``,
``body.com_offset[x]``. Values for a batch of robots: :class:`wlr_gym.robot.parameters.Parameters`.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from wlr_gym.base.errors import InputError, check_name, nearest, unknown_name

#: Names and order of the joints: the four legs, then the four wheels, each lf, rf, lr, rr (left/right, front/rear).
CORNERS = ("lf", "rf", "lr", "rr")
#: Corners in words.
CORNER_NAMES: dict[str, str] = dict(zip(CORNERS, ("left front", "right front", "left rear", "right rear"), strict=True))
LEGS = tuple(f"leg_{corner}" for corner in CORNERS)
WHEELS = tuple(f"wheel_{corner}" for corner in CORNERS)
JOINTS = LEGS + WHEELS
#: Where legs and wheels stand in the joint order: ``position[:, LEG_SLICE]``; wheel i is joint ``FIRST_WHEEL + i``.
FIRST_WHEEL = len(LEGS)
LEG_SLICE = slice(0, FIRST_WHEEL)
WHEEL_SLICE = slice(FIRST_WHEEL, len(JOINTS))
#: Signs of the hip positions (x, y) in the body frame, in corner order.
CORNER_SIGNS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))

#: Radius (m) of the rods that legs are, from hip to axle.
SHANK_RADIUS = 0.008


def full_name(joint: str) -> str:
    """Return a joint's name with its corner in words: ``leg_lf (left front)``."""
    return f"{joint} ({CORNER_NAMES[joint.rpartition('_')[2]]})"


# ---- the table -------------------------------------------------------------------------------------------------------


Labels = tuple[str, ...]
Sources = tuple[str | float, ...]

XYZ = ("x", "y", "z")
XY = ("x", "y")
#: Areas of the floor that may have a friction of their own.
PATCHES = ("patch_1", "patch_2", "patch_3", "patch_4")
#: Waves that the floor may have, and pieces that may stand on it.
WAVES = ("wave_1", "wave_2")
PIECES = tuple(f"piece_{number}" for number in range(1, 9))
SLOPE = ("pitch", "roll")
ANGLES = ("roll", "pitch", "yaw")
#: Largest number of a map: 48 bits.
LARGEST_MAP = 2**48 - 1
INERTIA_LABELS = ("xx", "yy", "zz", "xy", "xz", "yz")
#: Nominal values of rows that need more than one path.
LEVEL_ACROSS = ("ground.slope", 0.0)
HIP = ("hip_position.x", "hip_position.y", "hip_position.z")
LEG_INERTIA_LABELS = tuple(f"{leg},{axis}" for leg in LEGS for axis in XYZ)


@dataclass(frozen=True)
class ParameterSpec:
    """One row of the table.

    Attributes:
        name: dotted name without index.
        unit: SI unit, "-" for a pure number.
        labels: names of the elements; empty for a scalar.
        sources: nominal values: numbers, or dotted paths in the robot's file; repeated until every element has one.
        low, high: bounds outside which the engine refuses a value.
        tolerance: key of the robot file's tolerances, or empty.
        doc: meaning.
    """

    name: str
    unit: str
    labels: Labels
    sources: Sources
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

    def nominal(self, robot: Any) -> list[float | None]:
        """Return the values (size) for a :class:`wlr_gym.robot.Robot`; None where its file has none."""
        found = (attrgetter(source)(robot) if isinstance(source, str) else source for source in self.sources)
        values: list[Any] = [value for one in found for value in (one if isinstance(one, tuple) else (one,))]
        whole = values * (self.size // len(values))
        if not robot.individual:
            return whole
        return [robot.individual.get(element, value) for element, value in zip(self.elements, whole, strict=True)]

    @property
    def may_differ(self) -> bool:
        """Whether a robot's file may state it of a single leg, wheel or servo."""
        single = self.labels in (LEGS, WHEELS, JOINTS, LEG_INERTIA_LABELS) and isinstance(self.sources[0], str)
        return single and not self.name.startswith("ground.")


def stated(
    name: str, unit: str, labels: Labels = (), *, of: Sources = (), low: float, high: float, tolerance: str = "", doc: str
) -> ParameterSpec:
    """Return a row whose nominal value the robot's file states at the path of the same name, or at those ``of``."""
    return ParameterSpec(name, unit, labels, of or (name,), low, high, tolerance, doc)


def motor(name: str, unit: str, *, low: float, high: float, tolerance: str = "", doc: str) -> ParameterSpec:
    """Return a row of all joints whose nominal values are those of the robot's leg servos and of its wheel servos."""
    group, _, field = name.partition(".")
    sources = (f"{group}.leg.{field}",) * len(LEGS) + (f"{group}.wheel.{field}",) * len(WHEELS)
    return ParameterSpec(name, unit, JOINTS, sources, low, high, tolerance, doc)


def fixed(
    name: str, unit: str, labels: Labels = (), *, at: float = 0.0, low: float, high: float, tolerance: str = "", doc: str
) -> ParameterSpec:
    """Return a row whose nominal value is the same for every robot."""
    return ParameterSpec(name, unit, labels, (at,), low, high, tolerance, doc)


# fmt: off
TABLE: tuple[ParameterSpec, ...] = (
    stated("gravity", "m/s2", low=0, high=30, doc="gravitational acceleration"),
    # The body is the platform. Its inertia is principal, axes of the body frame. IMU and marker stay at its geometric origin.
    stated("body.mass", "kg", low=0.05, high=100, tolerance="body.mass", doc="platform without legs, wheels and payload"),
    stated("body.inertia", "kg m2", XYZ, low=1e-5, high=10, tolerance="body.inertia", doc="about its centre of mass"),
    stated("body.com_offset", "m", XYZ, low=-0.2, high=0.2, tolerance="body.com_offset", doc="centre of mass from the origin"),
    # Across the floor and along it, as long as the spot sticks; bounded by what the physics step resolves.
    fixed("body.normal_stiffness", "N/m", at=3e4, low=1e3, high=1e6, doc="of each spot of body or leg on the floor"),
    fixed("body.normal_damping", "N s/m", at=60.0, low=0, high=1e3, doc="of each spot of body or leg on the floor"),
    fixed("body.mu", "-", at=0.6, low=0, high=5, doc="friction of body and legs on the floor, in every direction"),
    # A payload may be several masses; xy = -integral of x y dm.
    fixed("payload.mass", "kg", low=0, high=20, doc="mass fixed to the body"),
    fixed("payload.position", "m", XYZ, low=-0.5, high=0.5, doc="its centre of mass in the body frame"),
    fixed("payload.inertia", "kg m2", INERTIA_LABELS, low=-10, high=10, doc="about its own centre, axes of the body frame"),
    stated("hip.position", "m", XYZ, of=HIP, low=-1, high=1, doc="from the body origin; x and y with the signs of the corner"),
    stated("leg.length", "m", LEGS, low=0.01, high=1, doc="hip axis to wheel axle"),
    stated("leg.mass", "kg", LEGS, low=0, high=10, tolerance="leg.mass", doc="leg without wheel"),
    stated("leg.com_along_leg", "m", LEGS, low=-0.5, high=1, doc="hip to the leg's centre of mass"),
    # About the leg's own centre of mass, leg straight down: about x, about y, about its own axis.
    stated("leg.inertia", "kg m2", LEG_INERTIA_LABELS, low=1e-8, high=1, tolerance="leg.inertia", doc="own, leg straight down"),
    stated("wheel.radius", "m", WHEELS, low=0.005, high=0.5, tolerance="wheel.radius", doc="rolling radius"),
    fixed("wheel.grip", "-", WHEELS, at=1.0, low=0, high=5, doc="factor on every floor's friction under this wheel (wear)"),
    stated("wheel.mass", "kg", WHEELS, low=0, high=10, doc="wheel, at the end of its leg"),
    stated("wheel.spin_inertia", "kg m2", WHEELS, low=1e-8, high=1, doc="about the axle, without rotor"),
    stated("wheel.transverse_inertia", "kg m2", WHEELS, low=0, high=1, doc="about an axis across the axle"),
    # Torque and speed are those at the robot file's nominal supply voltage; together they give torque constant and resistance.
    stated("servo.supply_voltage", "V", low=0, high=30, tolerance="servo.supply_voltage", doc="voltage at the servos"),
    motor("servo.stall_torque", "N m", low=1e-3, high=100, tolerance="servo.stall_torque", doc="at the nominal voltage"),
    motor("servo.no_load_speed", "rad/s", low=0.1, high=200, tolerance="servo.no_load_speed", doc="at the nominal voltage"),
    motor("servo.kp", "V/rad", low=0, high=2000, tolerance="servo.kp", doc="on angle error; wheels: integral of speed error"),
    motor("servo.kd", "V s/rad", low=0, high=50, doc="gain on the velocity error"),
    # The wheels' kp holds for 1 ms.
    stated(
        "servo.integral_cycle", "s", WHEELS, low=1e-4, high=1e-2, tolerance="servo.integral_cycle",
        doc="cycle in which a wheel's speed error is summed",
    ),
    motor("servo.armature", "kg m2", low=1e-6, high=1, tolerance="servo.armature", doc="rotor inertia at the output shaft"),
    motor("servo.coulomb_friction", "N m", low=0, high=50, tolerance="servo.coulomb_friction", doc="dry gear friction"),
    motor("servo.viscous_friction", "N m s/rad", low=0, high=10, tolerance="servo.viscous_friction", doc="beyond back-EMF"),
    fixed("servo.creep_rate", "rad/s", JOINTS, low=0, high=1, doc="dry gear friction grows linearly to here; 0 = sticks"),
    # Below 1: a weak magnet, not seen in the reported effort.
    fixed("servo.torque_scale", "-", JOINTS, at=1.0, low=0, high=2, doc="torque of the motor over what its current says"),
    # Fades with exp(-(rate/stribeck_speed)^2).
    fixed("servo.stribeck_torque", "N m", JOINTS, low=0, high=50, doc="dry gear friction at rest beyond that in motion"),
    fixed("servo.stribeck_speed", "rad/s", JOINTS, at=0.1, low=1e-4, high=20, doc="rate over which stribeck_torque fades"),
    fixed("servo.load_friction", "-", JOINTS, low=0, high=1, doc="dry gear friction per torque that the gear transmits"),
    fixed("servo.ripple_amplitude", "N m", JOINTS, low=0, high=10, doc="of motor torque: amplitude sin(order angle + phase)"),
    fixed("servo.ripple_order", "-", JOINTS, at=1.0, low=0, high=1000, doc="periods of the ripple per turn"),
    fixed("servo.ripple_phase", "rad", JOINTS, low=-10, high=10, doc="phase of the ripple at angle 0"),
    # Encoder and link are on the output side of the play, rotor and gear friction on the motor's. Without play: a rigid gear.
    fixed("servo.backlash", "rad", JOINTS, low=0, high=0.5, doc="full width of the gear's play"),
    motor("servo.gear_stiffness", "N m/rad", low=1, high=1e5, doc="of the teeth that meet at the end of the play"),
    fixed("servo.supply_resistance", "ohm", low=0, high=5, doc="supply drop per sum of absolute motor currents"),
    fixed("servo.profile_velocity", "rad/s", JOINTS, low=0, high=200, doc="of the legs; 0 = no limit; not used by the wheels"),
    fixed("servo.profile_acceleration", "rad/s2", JOINTS, low=0, high=1e5, doc="of the profile; 0 = step references"),
    fixed("command.delay", "s", JOINTS, low=0, high=0.2, tolerance="command.delay", doc="setpoints act this much later"),
    stated("ground.mu_x", "-", WHEELS, low=0, high=5, tolerance="ground.mu", doc="friction along the wheel's heading"),
    stated("ground.mu_y", "-", WHEELS, low=0, high=5, tolerance="ground.mu", doc="friction along the wheel's axle"),
    fixed("ground.rolling_resistance", "-", WHEELS, low=0, high=1, doc="torque over normal force and radius, against the spin"),
    # ratio + (1 - ratio) exp(-slip speed/weakening_speed)
    fixed("ground.kinetic_ratio", "-", WHEELS, at=1.0, low=0, high=1, doc="friction at fast slip over friction at rest"),
    fixed("ground.weakening_speed", "m/s", WHEELS, at=0.1, low=1e-3, high=10, doc="slip speed over which friction falls"),
    fixed("ground.creep_speed", "m/s", WHEELS, low=0, high=1, doc="friction grows as tanh(slip/creep_speed); 0 = dry, sticks"),
    # A tread of elastic bristles (brush): slip over speed = slip_compliance times friction over load, up to mu.
    stated("ground.slip_compliance", "-", WHEELS, low=0, high=5, doc="slip per friction over load, rolling steadily; 0: rigid"),
    stated("ground.relaxation_length", "m", WHEELS, low=5e-4, high=0.1, doc="way over which friction builds up"),
    stated("ground.tread_damping", "N s/m", WHEELS, low=0, high=100, doc="of the tread along the floor"),
    # Of the deflection beyond that under the robot at rest, a quarter of its weight.
    fixed("ground.flattening", "-", WHEELS, low=0, high=1, doc="share of a tyre's deflection that its rolling radius loses"),
    # A patch has a friction of its own along the heading (along the axle: times ground.mu_y/mu_x). Later patches win.
    fixed("patch.mu", "-", PATCHES, low=0, high=5, doc="friction along the heading inside an area of the floor"),
    fixed("patch.x_min", "m", PATCHES, low=-1e3, high=1e3, doc="area of the patch, floor frame"),
    fixed("patch.x_max", "m", PATCHES, low=-1e3, high=1e3, doc="no patch where x_max <= x_min"),
    fixed("patch.y_min", "m", PATCHES, low=-1e3, high=1e3, doc="area of the patch, floor frame"),
    fixed("patch.y_max", "m", PATCHES, low=-1e3, high=1e3, doc="no patch where y_max <= y_min"),
    # Cells with a friction of their own along the heading, under the patches.
    fixed("friction_map.number", "-", low=0, high=LARGEST_MAP, doc="which map of friction; 0 = none"),
    fixed("friction_map.scale", "-", at=1.0, low=0, high=100, doc="factor on its friction"),
    fixed("friction_map.cell", "m", at=0.05, low=1e-3, high=100, doc="width of its square cells"),
    fixed("friction_map.x", "m", low=-1e3, high=1e3, doc="middle of the map"),
    fixed("friction_map.y", "m", low=-1e3, high=1e3, doc="middle of the map"),
    fixed("friction_map.heading", "rad", low=-10, high=10, doc="of the map's x axis, from the floor's"),
    # Relief of the floor: height = sum of wave.height sin(2 pi distance/wave.length + phase) + bumps + grid, and pieces on top.
    fixed("wave.height", "m", WAVES, low=0, high=1, doc="half of crest to trough; 0 = no wave"),
    fixed("wave.length", "m", WAVES, at=1.0, low=0.01, high=1e3, doc="crest to crest"),
    fixed("wave.heading", "rad", WAVES, low=-10, high=10, doc="direction across the crests, from the floor's x axis"),
    fixed("wave.phase", "rad", WAVES, low=-10, high=10, doc="at the floor's origin; 0 = rising"),
    # A smooth surface over a square lattice of points, of which a share is raised by up to the height.
    fixed("bumps.height", "m", low=0, high=1, doc="of the highest bump; 0 = none"),
    fixed("bumps.spacing", "m", at=0.1, low=0.005, high=10, doc="between the lattice's points"),
    fixed("bumps.share", "-", at=1.0, low=0.01, high=1, doc="share of the points that are raised"),
    fixed("bumps.seed", "-", low=0, high=1038360, doc="whole number: which bumps"),
    # Heights in the middles of cells, with a smooth surface through them; beyond the outermost it goes on level.
    fixed("grid.number", "-", low=0, high=LARGEST_MAP, doc="which map of heights; 0 = none"),
    fixed("grid.scale", "-", at=1.0, low=0, high=100, doc="factor on its heights"),
    fixed("grid.cell", "m", at=0.05, low=1e-3, high=100, doc="width of its square cells"),
    fixed("grid.x", "m", low=-1e3, high=1e3, doc="middle of the map"),
    fixed("grid.y", "m", low=-1e3, high=1e3, doc="middle of the map"),
    fixed("grid.heading", "rad", low=-10, high=10, doc="of the map's x axis, from the floor's"),
    # A piece has a flat top and two faces (pi/2: upright); its edges run across its heading without an end.
    fixed("piece.x", "m", PIECES, low=-1e3, high=1e3, doc="foot of the front face"),
    fixed("piece.y", "m", PIECES, low=-1e3, high=1e3, doc="foot of the front face"),
    fixed("piece.heading", "rad", PIECES, low=-10, high=10, doc="direction up the front face, from the floor's x axis"),
    fixed("piece.height", "m", PIECES, low=0, high=1, doc="of the top above z = 0; 0 = no piece"),
    fixed("piece.length", "m", PIECES, at=1e3, low=0.01, high=1e3, doc="of the top along the heading"),
    fixed("piece.front_slope", "rad", PIECES, at=math.pi / 2, low=0.01, high=math.pi / 2, doc="of the front face"),
    fixed("piece.rear_slope", "rad", PIECES, at=math.pi / 2, low=0.01, high=math.pi / 2, doc="of the rear face"),
    fixed("piece.edge_radius", "m", PIECES, at=0.003, low=1e-4, high=0.1, doc="of the upper edges"),
    stated("ground.normal_stiffness", "N/m", WHEELS, low=100, high=2e5, doc="tyre and chassis together"),
    stated("ground.normal_damping", "N s/m", WHEELS, low=0, high=500, doc="normal contact damping"),
    # Inclination of the floor's x and y axes, positive = uphill. The world frame is the floor frame.
    stated("ground.slope", "rad", SLOPE, of=LEVEL_ACROSS, low=-1.2, high=1.2, tolerance="ground.slope", doc="of floor axes"),
    fixed("external_force", "N", XY, low=-1e3, high=1e3, doc="constant force on the body origin, floor frame"),
    fixed("tether.stiffness", "N/m", low=0, high=1e4, doc="horizontal pull of the body origin to the anchor, no rest length"),
    fixed("tether.anchor", "m", XY, low=-1e3, high=1e3, doc="point on the floor, floor frame"),
    # The servo regulates the reading.
    fixed("joint.zero_offset", "rad", LEGS, low=-0.5, high=0.5, tolerance="joint_zero", doc="encoder reading minus true angle"),
    fixed("imu.gyro_bias", "rad/s", XYZ, low=-1, high=1, doc="constant gyroscope offset"),
    fixed("imu.accel_bias", "m/s2", XYZ, low=-5, high=5, doc="constant accelerometer offset"),
    fixed("imu.mount", "rad", ANGLES, low=-0.5, high=0.5, doc="rotation from sensor to body, Rz(yaw) Ry(pitch) Rx(roll)"),
    stated("imu.bandwidth", "Hz", of=("sensors.imu.bandwidth",), low=1, high=1e4, doc="low-pass of gyro, accelerometer"),
    fixed("camera.mount_yaw", "rad", low=-0.5, high=0.5, tolerance="camera.mount_yaw", doc="floor frame to start heading"),
    fixed("camera.scale", "-", at=1.0, low=0.5, high=2, doc="measured over true lengths of the camera's floor frame"),
    fixed("camera.delay", "s", low=0, high=0.5, tolerance="camera.delay", doc="age of a vision pose when it is delivered"),
    fixed("camera.present", "-", at=1.0, low=0, high=1, doc="1 = there is a camera, 0 = there is none"),
    fixed("camera.dropout", "-", low=0, high=1, doc="share of the camera's frames that never arrive"),
    stated("flow.present", "-", of=("sensors.has_flow",), low=0, high=1, doc="1 = there is an optical-flow sensor, 0 = none"),
    fixed("flow.scale", "-", at=1.0, low=0.5, high=2, doc="measured over true optical flow"),
    fixed("flow.mount_yaw", "rad", low=-3.2, high=3.2, doc="rotation about body z from body to flow sensor"),
    fixed("flow.dropout", "-", low=0, high=1, doc="share of the flow sensor's readings that are lost, wherever it is"),
    fixed("flow.poor_floor", "-", low=0, high=1, doc="share of the floor (squares of 0.2 m) that has poor texture"),
)
# fmt: on

SPECS: dict[str, ParameterSpec] = {spec.name: spec for spec in TABLE}
ELEMENTS: tuple[str, ...] = tuple(element for spec in TABLE for element in spec.elements)


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


# ---- tolerances: how well a number of the robot is known -------------------------------------------------------------

# A tolerance is 1 sigma: relative (``0.05``, ``5 %``) or with a unit of the parameter's dimension (``0.2 deg``, ``3 mm``,
# ``2 mN m``); one for all, or one each for legs and wheels (``0.01 N m s/rad (legs), 2e-3 N m s/rad (wheels)``).


#: Symbol -> its size in SI, and the SI symbol of that dimension.
UNITS = {
    "m": (1.0, "m"), "cm": (1e-2, "m"), "mm": (1e-3, "m"), "s": (1.0, "s"), "ms": (1e-3, "s"),
    "rad": (1.0, "rad"), "mrad": (1e-3, "rad"), "deg": (math.radians(1.0), "rad"), "kg": (1.0, "kg"), "g": (1e-3, "kg"),
    "N": (1.0, "N"), "mN": (1e-3, "N"), "V": (1.0, "V"), "mV": (1e-3, "V"),
}  # fmt: skip
#: Unit of an amount that is relative -> what it is divided by.
RELATIVE = {"": 1.0, "%": 100.0}
#: Tolerances of a robot file, and the rows of the parameter table that each is about.
KEYS = {spec.tolerance: [row for row in TABLE if row.tolerance == spec.tolerance] for spec in TABLE if spec.tolerance}
_PART = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^(,]*?)\s*(?:\(\s*(\w*)\s*\))?\s*")
_SYMBOL = re.compile(r"([A-Za-z]+)([2-9]?)")


@dataclass(frozen=True)
class ParameterTolerance:
    """One tolerance.

    Attributes:
        legs: 1 sigma of a number of a leg or its servo.
        wheels: 1 sigma of all other numbers; the same as ``legs`` unless the file states one each.
        unit: SI unit of both; None = they are relative.
    """

    legs: float
    wheels: float
    unit: str | None

    def of(self, element: str) -> float:
        """Return 1 sigma of an element of the parameter table, such as ``servo.kp[leg_lf]``."""
        return self.legs if element.partition("[")[2].rstrip("]") in LEGS else self.wheels

    def sigma(self, element: str, nominal: float) -> float:
        """Return 1 sigma of an element in its SI unit."""
        return self.of(element) * (abs(nominal) if self.unit is None else 1.0)

    def share(self, element: str, nominal: float) -> float:
        """Return 1 sigma of an element over its nominal value."""
        return self.of(element) / (1.0 if self.unit is None else abs(nominal))

    def __str__(self) -> str:
        """Return the text of a robot file."""
        unit = f" {self.unit}" if self.unit else ""
        one = f"{self.wheels!r}{unit}"
        return one if self.legs == self.wheels else f"{self.legs!r}{unit} (legs), {one} (wheels)"


def read_tolerances(stated: Any) -> dict[str, ParameterTolerance]:
    """Return the tolerances of a robot file by key.

    Raises:
        InputError: unknown key or unit, another dimension than the parameter's, a negative or infinite amount, or a form that
            is none; the message names key, value, what is expected and the nearest valid name.
    """
    if not isinstance(stated, Mapping):
        raise InputError(f"tolerances = {stated!r}: expected a mapping of {', '.join(KEYS)}")
    return {key: value if isinstance(value, ParameterTolerance) else _read(key, value) for key, value in stated.items()}


def _read(key: Any, value: Any) -> ParameterTolerance:
    check_name("tolerance", key, KEYS)
    place = f"tolerances.{key} = {value!r}"
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(f"{place}: expected {_expected(key)}")
    texts = value.split(",") if isinstance(value, str) else [repr(value)]
    parts = [_part(key, text, place) for text in texts]
    if len({relative for _, relative, _ in parts}) > 1:
        raise InputError(f"{place}: expected both relative, or both with a unit")
    amounts = {group: amount for amount, _, group in parts}
    if len(amounts) < len(parts) or set(amounts) not in ({""}, {"legs", "wheels"}):
        raise InputError(f"{place}: expected one amount for all, or one each: A (legs), B (wheels)")
    if len(amounts) > 1 and any(row.labels != JOINTS for row in KEYS[key]):
        raise InputError(f"{place}: expected one amount: legs and wheels do not both have a {key}")
    relative = parts[0][1]
    legs, wheels = (amounts[""],) * 2 if "" in amounts else (amounts["legs"], amounts["wheels"])
    return ParameterTolerance(legs, wheels, None if relative else KEYS[key][0].unit)


def _part(key: str, text: str, place: str) -> tuple[float, bool, str]:
    """Return the amount (SI, or a share), whether it is relative, and whom it is of: ``legs``, ``wheels`` or all ('')."""
    found = _PART.fullmatch(text)
    if found is None:
        raise InputError(f"{place}: expected {_expected(key)}")
    number, unit, group = float(found[1]), found[2], found[3] or ""
    if not math.isfinite(number) or number < 0.0:
        raise InputError(f"{place}: expected a finite amount of 0 or more, {_expected(key)}")
    if unit in RELATIVE:
        return number / RELATIVE[unit], True, group
    try:
        size, dimension = _parsed(unit)
    except KeyError as error:
        symbol = error.args[0]
        raise InputError(f"{place}: unknown unit '{symbol}'{nearest(symbol, UNITS)}; expected {_expected(key)}") from None
    if dimension != _parsed(KEYS[key][0].unit)[1]:
        raise InputError(f"{place}: '{unit}' is not a unit of {key}; expected {_expected(key)}")
    return number * size, False, group


def _parsed(unit: str) -> tuple[float, Counter[str]]:
    """Return the size in SI and the dimension (symbol -> exponent) of a unit such as ``mN m s/rad``; "-" is a pure number.

    Raises:
        KeyError: a symbol that is none.
    """
    size = 1.0
    dimension: Counter[str] = Counter()
    for place, half in enumerate([] if unit == "-" else unit.split("/")):
        for symbol in half.split() or [unit]:
            found = _SYMBOL.fullmatch(symbol)
            if found is None or found[1] not in UNITS:
                raise KeyError(symbol)
            exponent = int(found[2] or 1) * (-1 if place else 1)
            factor, base = UNITS[found[1]]
            size *= factor**exponent
            dimension[base] += exponent
    return size, dimension


def _expected(key: str) -> str:
    unit = KEYS[key][0].unit
    first = unit.split("/")[0].split()[0]
    units = [unit, *(symbol + unit.removeprefix(first) for symbol, (_, base) in UNITS.items() if base == first != symbol)]
    return f"a relative number (0.05 or '5 %'), or one with its unit ({', '.join(units)})"
