"""The robot as parts to cut, print and buy, from the robot file, and their mass properties against it. Needs extra ``parts``.

Axes of each assembly are the body's (x forward, y left, z up): ``body`` from its centre G, ``leg`` from the hip of a left leg
that hangs straight down, with y = 0 in the wheel's middle plane, ``wheel`` from its centre. Lengths of solids are in mm.

Free sizes are solved so that the parts weigh what the file says: two ballast bars give the body its mass and moments of
inertia, rim and spokes give the wheel its own. A leg cannot be matched where the file's is lighter than its wheel's servo.

Sizes of servos and horns are those of ROBOTIS's drawings XM540/XH540/XD540 (HINGE) of 2019-03-18, HN13-N101 of 2019-05-22 and
XL-430 of 2018-03-24, as public projects quote them. Nobody here has held the drawings or the servos.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError, require_package
from wlr_gym.base.files import write_text
from wlr_gym.robot.description import Robot

if TYPE_CHECKING:
    from manifold3d import CrossSection, Manifold

Array = NDArray[np.float64]
Place = tuple[float, float, float]

#: kg/m3. What is printed has walls and infill: weigh a print and correct it here.
ALUMINIUM, STEEL, GLASS_FIBRE, FOAM_BOARD, PETG, RUBBER = 2670.0, 7850.0, 1850.0, 600.0, 1270.0, 1000.0
#: mm: thickness of plates and leg arms; hole of an M3 and of an M2.5 screw.
PLATE, ARM, M3, M25 = 2.0, 3.0, 3.2, 2.7
#: Part within which computed numbers count as those of the robot file.
TOLERANCE = 0.03
#: mm: a higher ballast bar would be in the way of a leg at its limit.
HIGHEST_BAR = 40.0
#: mm: hole of an M5 screw; from a ballast bar's middle to its two.
M5, BAR_SCREW = 5.5, 25.0
_CIRCLE = 96


class Hole(NamedTuple):
    """A round hole in a sheet, mm."""

    x: float
    y: float
    diameter: float


class ServoCase(NamedTuple):
    """Case and horn of a servo, mm; ``u`` is along the case from the axle to the near end, ``v`` across."""

    size: Place  #: along the case, along the axle, across
    mass: float  #: kg
    near: float  #: from the axle to the near end
    horn: float  #: how far the horn's face stands out of the case
    circle: float  #: diameter of the horn's circle of threads
    threads: int
    screw: float  #: clearance hole of the horn's screws
    centre: float  #: hole that clears the horn's centre
    case: tuple[tuple[float, float], ...]  #: threads of the case that the kit uses

    def horn_holes(self, x: float = 0.0) -> list[Hole]:
        """Return the holes that a part on the horn needs, the axle at ``x``: the centre's first."""
        turns = np.arange(self.threads) * 2.0 * np.pi / self.threads
        ring = [Hole(x + 0.5 * self.circle * np.cos(turn), 0.5 * self.circle * np.sin(turn), self.screw) for turn in turns]
        return [Hole(x, 0.0, self.centre), *ring]


#: Threads of the case: of each flat side (u, mm behind the front; M2.5, 4 deep at most), of the back (u, v; M2.5 case screws).
XM540 = ServoCase((58.5, 44.0, 33.5), 0.165, 13.75, 2.6, 22.0, 8, M25, 10.2, ((-6, 14), (-6, 30), (-38, 14), (-38, 30)))
XL430 = ServoCase((46.5, 34.0, 28.5), 0.0572, 11.25, 2.0, 16.0, 4, 2.2, 11.0, ((8, 11), (8, -11), (-32, 11), (-32, -11)))
#: mm: diameter and height of the hub at the XL430's back; height of the ring on its horn's face.
HUB, RING = (7.9, 3.9), 1.0


class Sheet(NamedTuple):
    """What is cut out of a plate, mm."""

    outline: CrossSection
    holes: tuple[Hole, ...]

    def solid(self, thickness: float) -> Manifold:
        """Return the plate, its middle at z = 0."""
        from manifold3d import CrossSection

        flat = self.outline
        for x, y, diameter in self.holes:
            flat -= CrossSection.circle(diameter / 2.0, 48).translate((x, y))
        return flat.extrude(thickness).translate((0.0, 0.0, -thickness / 2.0))


class Mass(NamedTuple):
    """Mass properties of some parts together."""

    mass: float  #: kg
    centre: Array  #: (3,) m
    inertia: Array  #: (3, 3) kg m2, about the centre

    @property
    def spread(self) -> Array:
        """Return sum of m x^2, m y^2, m z^2 about the centre (3,), kg m2."""
        moments = np.diag(self.inertia)
        return moments.sum() / 2.0 - moments


@dataclass(frozen=True)
class Part:
    """One kind of part.

    Args:
        name: also of its files.
        made: ``cut``, ``print`` or ``bought``, with material.
        solid: its shape, mm, at the origin of its own.
        density: kg/m3, or None where ``mass`` (kg) is known.
        places: where its copies are, mm, axes of the assembly.
        sheet: what is cut out of a plate; None = it is not cut.
    """

    name: str
    made: str
    solid: Manifold
    density: float | None
    places: tuple[Place, ...]
    mass: float | None = None
    sheet: Sheet | None = None

    def properties(self) -> Mass:
        """Return the mass properties of all copies."""
        mesh = self.solid.to_mesh()
        one = _mesh_mass(np.asarray(mesh.vert_properties, float)[:, :3] * 1e-3, np.asarray(mesh.tri_verts))
        weight = self.mass if self.density is None else one.mass * self.density
        assert weight is not None
        scale = weight / one.mass
        return together(Mass(weight, one.centre + np.array(place) * 1e-3, one.inertia * scale) for place in self.places)


@dataclass(frozen=True)
class Kit:
    """All parts of a robot, by assembly."""

    body: list[Part]
    leg: list[Part]
    wheel: list[Part]

    def bill(self) -> list[tuple[str, int, float, str]]:
        """Return name, number in a whole robot, mass of one (kg) and how it is made, of each part."""
        found: dict[str, tuple[str, int, float, str]] = {}
        for part, times in [*((part, 1) for part in self.body), *((part, 4) for part in (*self.leg, *self.wheel))]:
            pieces = times * len(part.places) + (found[part.name][1] if part.name in found else 0)
            found[part.name] = (part.name, pieces, part.properties().mass / len(part.places), part.made)
        return list(found.values())

    def properties(self) -> dict[str, Mass]:
        """Return the mass properties of ``body``, ``leg`` and ``wheel``, their centres in the assembly's axes."""
        assemblies = {"body": self.body, "leg": self.leg, "wheel": self.wheel}
        return {name: together(part.properties() for part in parts) for name, parts in assemblies.items()}


class MassDifference(NamedTuple):
    """A number of the robot file beside that of the parts."""

    name: str
    file: float
    parts: float
    unit: str
    allowed: float  #: absolute

    @property
    def fits(self) -> bool:
        """Return whether both agree."""
        return abs(self.parts - self.file) <= self.allowed


def together(masses: Iterable[Mass]) -> Mass:
    """Return the mass properties of several bodies that move as one."""
    bodies = list(masses)
    mass = sum(body.mass for body in bodies)
    centre = sum((body.mass * body.centre for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        arm = body.centre - centre
        inertia += body.inertia + body.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Mass(mass, centre, inertia)


def _mesh_mass(vertices: Array, triangles: NDArray[Any]) -> Mass:
    """Return volume (as mass, density 1), centre and inertia of a closed mesh, by tetrahedra to the origin."""
    corners = vertices[triangles]
    volumes = np.linalg.det(corners) / 6.0
    volume = volumes.sum()
    sums = corners.sum(axis=1)
    centre = volumes @ sums / 4.0 / volume
    second = np.einsum("t,ti,tj->ij", volumes, sums, sums) + np.einsum("t,tki,tkj->ij", volumes, corners, corners)
    second = second / 20.0 - volume * np.outer(centre, centre)
    return Mass(float(volume), centre, np.trace(second) * np.eye(3) - second)


# ---- shapes ----


def _box(size: Place) -> Manifold:
    from manifold3d import Manifold

    return Manifold.cube(size, True)


def _disc(radius: float, width: float, middle: float = 0.0) -> Manifold:
    """Return a disc whose axle is y."""
    from manifold3d import Manifold

    cylinder = Manifold.cylinder(width, radius, circular_segments=_CIRCLE, center=True)
    return cylinder.rotate((90.0, 0.0, 0.0)).translate((0.0, middle, 0.0))


def _sheet(length: float, width: float, corner: float, holes: Iterable[Hole]) -> Sheet:
    """Return a rounded rectangle (mm) with holes."""
    from manifold3d import CrossSection, JoinType

    flat = CrossSection.square((length - 2 * corner, width - 2 * corner), True).offset(corner, JoinType.Round, 2.0, _CIRCLE)
    return Sheet(flat, tuple(holes))


def _hole(diameter: float, length: float, x: float, y: float, z: float = 0.0) -> Manifold:
    """Return what a drill along z takes away; ``z`` is its middle."""
    from manifold3d import Manifold

    return Manifold.cylinder(length, diameter / 2.0, circular_segments=24, center=True).translate((x, y, z))


def _mirrored(x: float, y: float, z: float = 0.0) -> tuple[Place, ...]:
    return tuple((sx * x, sy * y, z) for sx in (1, -1) for sy in (1, -1))


# ---- assemblies ----


def make_kit(robot: Robot) -> Kit:
    """Return the parts of a robot.

    Raises:
        InputError: the robot's mass or inertia leaves no room for them.
        MissingPackageError: extra ``parts`` is not installed.
    """
    for package in ("manifold3d", "ezdxf"):
        require_package(package, "parts")
    leg = _leg(robot)
    return Kit(_body(robot, _inside(robot, leg)), leg, _wheel(robot))


def _inside(robot: Robot, leg: list[Part]) -> float:
    """Return how much m y^2 (kg m2) four legs lack because their servos are inside the wheels' planes, where models have them.

    It does not depend on the legs' angles, so the body's ballast makes up for it.
    """
    found, plane = together(part.properties() for part in leg), robot.hip_position.y
    return 4.0 * found.mass * (plane**2 - (plane + float(found.centre[1])) ** 2)


def _horn(robot: Robot) -> float:
    """Return how far (mm) a hip servo's horn is inside the wheel's middle plane: half the wheel, its servo, the arm."""
    return 500.0 * robot.wheel.width + XL430.horn + XL430.size[1] + ARM


#: mm, x and y of holes in the lower plate: spacers of the sensor board, screws of the IMU's stand, straps of hubs and adapters.
SENSOR_BOARD, STAND = tuple((95.0 + x, y) for x in (21.0, -21.0) for y in (16.0, -16.0)), ((26.0, 0.0), (-26.0, 0.0))
STRAPS = tuple((x, s * y) for s in (1, -1) for x, y in ((36.0, 40.0), (-36.0, 40.0), (0.0, 68.0), (0.0, 92.0)))
#: mm: holes of the hip block's inserts, from the middle of its servo's case, on the left front; hole of an insert for M3.
INSERTS, INSERT = ((21.0, 12.0), (21.0, -12.0), (-10.0, 12.0), (-10.0, -12.0)), 4.0


def _both_sides(y: float, z: float) -> tuple[Place, Place]:
    """Two places on the body's middle, left and right, mm."""
    return (0.0, y, z), (0.0, -y, z)


def _body(robot: Robot, lacking: float) -> list[Part]:
    x, y, height = 1e3 * robot.hip_position.x, 1e3 * robot.hip_position.y, 1e3 * robot.body.size[2]
    long, deep, _ = XM540.size
    horn, gap, middle = y - _horn(robot), height - 2 * PLATE, height / 2 - PLATE / 2
    servo, edge = (x + XM540.near - long / 2, horn - XM540.horn - deep / 2), horn - 3.0
    posts = [Hole(px, py, M3) for px, py, _ in _mirrored(60.0, edge - 10.0)]
    common = [Hole(sx * (servo[0] + dx), sy * (servo[1] + dy), M3) for sx in (1, -1) for sy in (1, -1) for dx, dy in INSERTS]
    common += [*posts, *(Hole(px, py, 25.0) for px, py, _ in _mirrored(100.0, 40.0))]
    tied = [Hole(0.0, 0.0, 15.0), *(Hole(*at, M3) for at in (*SENSOR_BOARD, *STAND)), *(Hole(*at, 4.0) for at in STRAPS)]
    length = 2.0 * (x + 14.0)
    outline = _sheet(length, 2 * edge, 8.0, []).outline
    for side in (1, -1):  # open between the hips: light ends, and a way for cables
        outline -= _sheet(90.0, 60.0, 8.0, []).outline.translate((side * length / 2, 0.0))
    lower, marker = Sheet(outline, (*common, *tied)), _sheet(2 * x, 270.0, 8.0, posts)
    stand = _box((60.0, 22.0, gap / 2 - 1.5)) - _box((44.0, 23.0, gap / 2)).translate((0.0, 0.0, -6.0))
    for at in STAND:
        stand -= _hole(INSERT, 16.0, *at, -gap / 4)
    block = _hip_block(gap)
    parts = [
        Part("body_plate_lower", "cut: glass fibre (G10) 2 mm", lower.solid(PLATE), GLASS_FIBRE,
             ((0.0, 0.0, -middle),), sheet=lower),
        Part("hip_block", "print: PETG, 2 walls, 15 % infill", block, 0.3 * PETG,
             ((servo[0], servo[1], 0.0),)),
        Part("hip_servo", "bought: XM540-W150-R", _box(XM540.size), None, _mirrored(*servo), mass=XM540.mass),
        Part("post", "bought: M3 hexagonal spacers, aluminium, 50 and 16 mm", _box((5.5, 5.0, gap)), ALUMINIUM,
             _mirrored(60.0, edge - 10.0)),
        Part("marker_plate", "cut: PVC foam board 2 mm", marker.solid(2.0), FOAM_BOARD, ((0.0, 0.0, height / 2 + 4.0),),
             sheet=marker),
        Part("power_hub", "bought: U2D2 power hub board", _box((64.0, 48.0, 18.0)), None, _both_sides(40.0, -23.0), mass=0.035),
        Part("adapter", "bought: U2D2", _box((48.0, 18.0, 14.6)), None, _both_sides(80.0, -25.0), mass=0.009),
        Part("sensor_board", "bought: Arduino Nano and level shifters on strip board", _box((50.0, 40.0, 15.0)), None,
             ((95.0, 0.0, -20.5),), mass=0.025),
        Part("imu_stand", "print: PETG, 2 walls, 15 % infill", stand, 0.3 * PETG, ((0.0, 0.0, -gap / 4 - 0.75),)),
        Part("imu", "bought: MPU-6050 (GY-521)", _box((21.0, 16.0, 3.0)), None, ((0.0, 0.0, 0.0),), mass=0.002),
        Part("flow_sensor", "bought: PMW3901 board", _box((28.0, 28.0, 4.0)), None, ((0.0, 0.0, 2.0 - gap / 2),), mass=0.003),
        Part("cables", "bought: cables, plugs, screws (weigh yours)", _box((150.0, 100.0, 20.0)), None,
             ((0.0, 0.0, 10.0),), mass=0.18),
    ]  # fmt: skip
    for sx, sy in ((1, -1), (-1, 1), (-1, -1)):  # one print: turned over, it fits the other side
        solid = block.scale((sx, sy, 1.0))
        parts.append(Part("hip_block", parts[1].made, solid, 0.3 * PETG, ((sx * servo[0], sy * servo[1], 0.0),)))
    upper: list[Part] = []
    for _ in range(6):  # plate and feet reach as far as the bars, which weigh what these leave
        bar = _ballast(robot, [*parts, *upper], lacking)
        upper = _bar_carriers(bar, gap, middle, Sheet(outline, tuple(common)))
    return [*parts, *upper, _ballast(robot, [*parts, *upper], lacking)]


def _hip_block(gap: float) -> Manifold:
    """Return the front left hip's block around its servo's case, which stands out 6 mm: eight screws into the case, inserts."""
    long, deep, wide = XM540.size
    block = (_box((long + 4.0, deep - 6.0, gap)) - _box((long + 0.4, deep + 9.0, wide + 0.4))).translate((0.0, -3.0, 0.0))
    near, floor = long / 2 - XM540.near, wide / 2 + 3.2
    for side in (1, -1):
        for u, behind in XM540.case:
            at = (near + u, deep / 2 - behind)
            block -= _hole(M25, gap, *at, side * gap / 2)
            block -= _hole(5.5, gap, *at, side * (floor + gap / 2))
        for at in INSERTS:
            block -= _hole(INSERT, 28.0, *at, side * gap / 2)
    return block


def _bar_carriers(bar: Part, gap: float, middle: float, plate: Sheet) -> list[Part]:
    """Return the upper plate, wide enough for the ballast bars, and the feet between both."""
    from manifold3d import CrossSection

    _, y, z = bar.places[0]
    long, thick = bar.solid.bounding_box()[3] * 2, bar.solid.bounding_box()[4] * 2
    top = z + bar.solid.bounding_box()[5]
    tab = CrossSection.square((long + 4.0, 2 * y + thick), True)
    screws = [Hole(px, py, M5) for px, py, _ in _mirrored(BAR_SCREW, y)]
    upper = Sheet(plate.outline + tab, (*plate.holes, *screws))
    foot = _box((long, thick, gap / 2 - top))
    for side in (1, -1):
        foot -= _hole(M5, gap, side * BAR_SCREW, 0.0)
    at = (gap / 2 + top) / 2
    return [
        Part(
            "body_plate_upper",
            "cut: glass fibre (G10) 2 mm",
            upper.solid(PLATE),
            GLASS_FIBRE,
            ((0.0, 0.0, middle),),
            sheet=upper,
        ),
        Part("ballast_foot", "print: PETG, 2 walls, 15 % infill", foot, 0.3 * PETG, ((0.0, y, at), (0.0, -y, at))),
    ]


def _ballast(robot: Robot, parts: list[Part], lacking: float) -> Part:
    """Return two steel bars along x that give the body its mass, its centre and its moments about x and z."""
    given = together(part.properties() for part in parts)
    target = np.array(robot.body.inertia).sum() / 2.0 - np.array(robot.body.inertia) + np.array([0.0, lacking, 0.0])
    mass = robot.body.mass - given.mass
    missing = target - given.spread
    if mass <= 0.0 or missing[0] <= 0.0 or missing[1] <= 0.0:
        found = f"{given.mass:.3f} kg, spread {given.spread[0]:.4f} and {given.spread[1]:.4f} kg m2 along x and y"
        wanted = f"less than {robot.body.mass:.3f} kg, {target[0]:.4f} and {target[1]:.4f} kg m2"
        raise InputError(f"{robot.name}: the body's parts without ballast have {found}; expected {wanted}")
    long = 1e3 * np.sqrt(12.0 * missing[0] / mass)
    high = min(1e3 * np.sqrt(12.0 * max(missing[2], 0.0) / mass), HIGHEST_BAR)
    threads = 2.0 * np.pi * 2.1**2 * 18.0
    thick = (0.5 * mass / (STEEL * 1e-9) + threads) / (long * high)
    y = np.sqrt(1e6 * missing[1] / mass - thick**2 / 12.0)
    z = 1e3 * (robot.body.mass * robot.body.com_offset[2] - given.mass * given.centre[2]) / mass
    bar = _box((long, thick, high))
    for side in (1, -1):
        bar -= _hole(4.2, 36.0, side * BAR_SCREW, 0.0, high / 2)
    return Part(
        "ballast",
        f"cut: steel bar {long:.1f} x {thick:.1f} x {high:.0f} mm, two M5 threads 18 deep",
        bar,
        STEEL,
        ((0.0, y, z), (0.0, -y, z)),
    )


def _leg(robot: Robot) -> list[Part]:
    length, inside = 1e3 * robot.leg.length, 500.0 * robot.wheel.width + XL430.horn
    long, deep, wide = XL430.size
    case = [Hole(length / 2 + u, v, M25) for u, v in XL430.case]
    middle = [Hole(length / 2, 0.0, HUB[0] + 0.5), Hole(-10.0, 0.0, 14.0)]
    sheet = _sheet(length + 32.0, 30.0, 8.0, [*XM540.horn_holes(-length / 2), *case, *middle])
    arm = sheet.solid(ARM).rotate((90.0, 90.0, 0.0))
    places = {"arm": (0.0, ARM / 2 - _horn(robot), -length / 2), "servo": (0.0, -inside - deep / 2, 0.0)}
    servo = _box((wide, deep, long)) + _disc(HUB[0] / 2, HUB[1], -(deep + HUB[1]) / 2).translate(
        (0.0, 0.0, XL430.near - long / 2)
    )
    servo_middle = (0.0, places["servo"][1], -length + long / 2 - XL430.near)
    return [
        Part("leg_arm", "cut: glass fibre (G10) 3 mm", arm, GLASS_FIBRE, (places["arm"],), sheet=sheet),
        Part("wheel_servo", "bought: XL430-W250-T", servo, None, (servo_middle,), mass=XL430.mass),
        Part("leg_screws", "bought: screws of a leg", _box((16.0, ARM, length)), None, (places["arm"],), mass=0.004),
    ]


def _wheel(robot: Robot) -> list[Part]:
    """Return wheel and tyre: rim and spokes of full width, solved for mass and spin inertia; that across follows.

    The boss sits on the horn, level with the rim's inner face; from outside, screws go in through its counterbores.
    """
    from scipy.optimize import least_squares

    wheel, tread, boss, long, floor, spokes = robot.wheel, 0.5, 12.0, 12.0, 5.0, 6
    radius, width = 1e3 * wheel.radius - tread, 1e3 * wheel.width
    inner = -width / 2
    ring = _disc(radius + tread, width) - _disc(radius, width + 1.0)
    tyre = Part("tyre", f"cut: rubber strip {tread} mm, glued on", ring, RUBBER, ((0.0, 0.0, 0.0),))
    targets = np.array([wheel.mass, wheel.spin_inertia])

    def printed(sizes: Array) -> Part:
        rim, thick = sizes
        solid = _disc(radius, width) - _disc(radius - rim, width + 1.0)
        for turn in np.arange(spokes) * 360.0 / spokes:
            solid += (
                _box((radius - rim / 2, width, thick)).translate(((radius - rim / 2) / 2, 0.0, 0.0)).rotate((0.0, turn, 0.0))
            )
        solid -= _disc(boss, width, long)  # spokes end at the boss
        solid += _disc(boss, long, inner + long / 2)
        for x, y, diameter in XL430.horn_holes()[1:]:
            solid -= _disc(diameter / 2, 2 * width).translate((x, 0.0, y))
            solid -= _disc(2.1, width, inner + floor + width / 2).translate((x, 0.0, y))
        solid -= _disc(XL430.centre / 2, 2 * (RING + 0.5), inner)
        made = f"print: PETG, solid: rim {rim:.2f}, {spokes} spokes {thick:.2f}, boss {long:.1f} long (mm)"
        return Part("wheel", made, solid, PETG, ((0.0, 0.0, 0.0),))

    def errors(sizes: Array) -> Array:
        found = together(part.properties() for part in (printed(sizes), tyre))
        return np.array([found.mass, found.inertia[1, 1]]) / targets - 1.0

    solved = least_squares(errors, [1.0, 1.0], bounds=([0.4, 0.4], [0.4 * radius, 0.2 * radius]), diff_step=1e-3)
    return [printed(solved.x), tyre]


# ---- against the robot file ----


def compare(robot: Robot, kit: Kit) -> list[MassDifference]:
    """Return the robot file's mass properties beside those of the parts, the body's less what makes up for the legs."""
    found = kit.properties()
    body, leg, wheel = found["body"], found["leg"], found["wheel"]
    spin, across = float(wheel.inertia[1, 1]), float(wheel.inertia[0, 0])
    rows: list[tuple[str, float | None, float, str]] = [
        ("body.mass", robot.body.mass, body.mass, "kg"),
        *_axes("body.inertia", robot.body.inertia, np.diag(body.inertia) - _inside(robot, kit.leg) * np.array([1.0, 0.0, 1.0])),
        ("leg.mass", robot.leg.mass, leg.mass, "kg"),
        ("leg.com_along_leg", robot.leg.com_along_leg, -float(leg.centre[2]), "m"),
        *_axes("leg.inertia", robot.leg.inertia, np.diag(leg.inertia)),
        ("wheel.mass", robot.wheel.mass, wheel.mass, "kg"),
        ("wheel.spin_inertia", robot.wheel.spin_inertia, spin, "kg m2"),
        ("wheel.transverse_inertia", robot.wheel.transverse_inertia, across, "kg m2"),
    ]
    offset = 0.01 * max(robot.body.size)
    rows += _axes("body.com_offset", robot.body.com_offset, body.centre, "m")
    return [
        MassDifference(name, file, parts, unit, offset if name.startswith("body.com_offset") else TOLERANCE * abs(file))
        for name, file, parts, unit in rows
        if file is not None
    ]


def _axes(
    name: str, file: Iterable[float | None], parts: Array, unit: str = "kg m2"
) -> list[tuple[str, float | None, float, str]]:
    rows = zip("xyz", file, parts.tolist(), strict=True)
    return [(f"{name}.{axis}", of_file, of_parts, unit) for axis, of_file, of_parts in rows]


# ---- files ----


def write_kit(kit: Kit, folder: Path) -> list[Path]:
    """Write an STL file (mm) of each part that is made, a DXF file of each that is cut, and the list; return the paths."""
    lines = ["part,pieces,kg_each,made", *(f'{name},{count},{mass:.5f},"{made}"' for name, count, mass, made in kit.bill())]
    write_text(folder / "parts.csv", "\n".join(lines) + "\n")
    written = [folder / "parts.csv"]
    for part in {part.name: part for part in (*kit.leg, *kit.wheel, *reversed(kit.body))}.values():  # the first of a name
        if part.made.startswith("bought"):
            continue
        written.append(folder / f"{part.name}.stl")
        written[-1].write_bytes(stl(part.solid))
        if part.sheet is not None:
            written.append(folder / f"{part.name}.dxf")
            write_text(written[-1], dxf(part.sheet))
    return written


def posed(kit: Kit, robot: Robot, angles: Sequence[float]) -> list[tuple[str, Manifold]]:
    """Return name and solid (mm, body axes) of every piece of a robot whose legs stand at ``angles`` (rad), lf rf lr rr."""
    pieces = [(part.name, part.solid.translate(place)) for part in kit.body for place in part.places]
    hip, length = 1e3 * np.array([robot.hip_position.x, robot.hip_position.y, robot.hip_position.z]), 1e3 * robot.leg.length
    for angle, (front, left) in zip(angles, ((1, 1), (1, -1), (-1, 1), (-1, -1)), strict=True):
        for part in (*kit.leg, *kit.wheel):
            drop = (0.0, 0.0, -length if part in kit.wheel else 0.0)
            for place in part.places:
                solid = part.solid.translate(place).translate(drop).rotate((0.0, np.degrees(angle) - 90.0, 0.0))
                solid = solid if left > 0 else solid.mirror((0.0, 1.0, 0.0))
                pieces.append((part.name, solid.translate((front * hip[0], left * hip[1], hip[2]))))
    return pieces


def stl(solid: Manifold) -> bytes:
    """Return a solid as binary STL, mm."""
    mesh = solid.to_mesh()
    corners = np.asarray(mesh.vert_properties, np.float32)[:, :3][np.asarray(mesh.tri_verts)]
    record: Any = np.zeros(len(corners), [("normal", "<3f4"), ("corners", "<(3,3)f4"), ("extra", "<u2")])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    record["normal"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    record["corners"] = corners
    return b"wlr_gym, mm".ljust(80) + np.uint32(len(corners)).tobytes() + record.tobytes()


def dxf(sheet: Sheet) -> str:
    """Return the outline and the holes of a cut as DXF, mm."""
    import io

    import ezdxf
    from ezdxf import units

    drawing = ezdxf.new("R2010")  # type: ignore[attr-defined]
    drawing.units = units.MM
    for outline in sheet.outline.to_polygons():
        drawing.modelspace().add_lwpolyline([(float(x), float(y)) for x, y in outline], close=True)
    for x, y, diameter in sheet.holes:
        drawing.modelspace().add_circle((x, y), diameter / 2.0)
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue()
