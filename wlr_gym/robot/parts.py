"""The robot as parts to cut, print and buy, from the robot file, and their mass properties against it. Needs extra ``parts``.

Axes of each assembly are the body's (x forward, y left, z up): ``body`` from its centre G, ``leg`` from the hip of a left leg
that hangs straight down, with y = 0 in the wheel's middle plane, ``wheel`` from its centre. Lengths of solids are in mm.

Free sizes are solved so that the parts weigh what the file says: two ballast bars give the body its mass and moments of
inertia, rim, boss and webs give the wheel its own. A leg cannot be matched where the file's is lighter than its wheel's servo.
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
#: Servos, as their manuals say, mm: length, along the axle, width; then kg; then mm from the axle to the near end.
XM540, XL430 = (58.5, 44.0, 33.5, 0.165, 16.75), (46.5, 34.0, 28.5, 0.0572, 14.25)
#: mm: thickness of plates and leg arms; from the wheel's middle to its servo's horn; hole of an M3 and of an M2.5 screw.
PLATE, ARM, M3, M25 = 2.0, 3.0, 3.2, 2.7
#: Part within which computed numbers count as those of the robot file.
TOLERANCE = 0.03
#: mm: a higher ballast bar would be in the way of a leg at its limit.
HIGHEST_BAR = 40.0
_CIRCLE = 96


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
        made: how it comes about: ``cut``, ``print``, ``bought``, with material.
        solid: its shape, mm, at the origin of its own.
        density: kg/m3, or None where ``mass`` (kg) is known.
        places: where its copies are, mm, axes of the assembly.
        profile: what is cut out of a sheet; None = it is not cut.
    """

    name: str
    made: str
    solid: Manifold
    density: float | None
    places: tuple[Place, ...]
    mass: float | None = None
    profile: CrossSection | None = None

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
        parts = [(part, 1) for part in self.body] + [(part, 4) for part in (*self.leg, *self.wheel)]
        return [
            (part.name, times * len(part.places), part.properties().mass / len(part.places), part.made) for part, times in parts
        ]

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


def _sheet(length: float, width: float, corner: float, holes: Iterable[tuple[float, float, float]]) -> CrossSection:
    """Return a rounded rectangle (mm) with holes: x, y, diameter."""
    from manifold3d import CrossSection, JoinType

    flat = CrossSection.square((length - 2 * corner, width - 2 * corner), True).offset(corner, JoinType.Round, 2.0, _CIRCLE)
    for x, y, diameter in holes:
        flat -= CrossSection.circle(diameter / 2.0, 48).translate((x, y))
    return flat


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
    return 500.0 * robot.wheel.width + XL430[1] + ARM


def _body(robot: Robot, lacking: float) -> list[Part]:
    from manifold3d import Manifold

    x, y, height = 1e3 * robot.hip_position.x, 1e3 * robot.hip_position.y, 1e3 * robot.body.size[2]
    long, deep, wide, servo_mass, near = XM540
    horn, gap, middle = y - _horn(robot), height - 2 * PLATE, height / 2 - PLATE / 2
    servo = (x + near - long / 2, horn - deep / 2)
    half = horn - 3.0
    screws = [(sx * (servo[0] + dx), sy * (servo[1] - 12.0), M3) for sx in (1, -1) for sy in (1, -1) for dx in (-20.0, 20.0)]
    posts = [(sx * 60.0, sy * (half - 10.0), M3) for sx in (1, -1) for sy in (1, -1)]
    sides = lambda py, pz: ((0.0, py, pz), (0.0, -py, pz))  # noqa: E731
    windows = [(sx * 0.5 * x, 0.0, 80.0) for sx in (1, -1)]
    feet = [(sx * 20.0, sy * (half - 7.0), M3) for sx in (1, -1) for sy in (1, -1)]
    plate = _sheet(2 * x, 2 * half, 8.0, [*screws, *posts, *windows, *feet])
    block = _box((long + 4.0, deep - 6.0, gap)) - _box((long + 0.4, deep, wide + 0.4))
    for dx in (-20.0, 20.0):
        block -= Manifold.cylinder(2 * gap, 1.25, circular_segments=24, center=True).translate((dx, -9.0, 0.0))
    sheet = _sheet(2 * x, 270.0, 8.0, [(sx * 60.0, sy * (half - 10.0), M3) for sx in (1, -1) for sy in (1, -1)])
    parts = [
        Part("body_plate", "cut: glass fibre (G10) 2 mm", plate.extrude(PLATE).translate((0, 0, -PLATE / 2)), GLASS_FIBRE,
             ((0.0, 0.0, middle), (0.0, 0.0, -middle)), profile=plate),
        Part("hip_block", "print: PETG, 2 walls, 15 % infill", block, 0.3 * PETG, tuple(
            (px, py - 3.0 * np.sign(py), pz) for px, py, pz in _mirrored(*servo))),
        Part("hip_servo", "bought: XM540-W150-R", _box((long, deep, wide)), None, _mirrored(*servo), mass=servo_mass),
        Part("post", "bought: M3 hexagonal spacer, aluminium", _box((5.5, 5.0, gap)), ALUMINIUM, _mirrored(60.0, half - 10.0)),
        Part("marker_plate", "cut: PVC foam board 2 mm", sheet.extrude(2.0).translate((0, 0, -1)), FOAM_BOARD,
             ((0.0, 0.0, height / 2 + 4.0),), profile=sheet),
        Part("power_hub", "bought: U2D2 power hub board", _box((64.0, 48.0, 18.0)), None, sides(30.0, -20.0), mass=0.035),
        Part("adapter", "bought: U2D2", _box((48.0, 18.0, 14.6)), None, sides(30.0, 0.0), mass=0.009),
        Part("sensor_board", "bought: Arduino Nano and level shifters on strip board", _box((50.0, 40.0, 15.0)), None,
             ((95.0, 0.0, -20.0),), mass=0.025),
        Part("imu", "bought: MPU-6050 (GY-521)", _box((21.0, 16.0, 3.0)), None, ((0.0, 0.0, 0.0),), mass=0.002),
        Part("flow_sensor", "bought: PMW3901 board", _box((28.0, 28.0, 4.0)), None, ((0.0, 0.0, 2.0 - gap / 2),), mass=0.003),
        Part("cables", "bought: cables, plugs, screws (weigh yours)", _box((150.0, 100.0, 20.0)), None,
             ((0.0, 0.0, 10.0),), mass=0.18),
    ]  # fmt: skip
    support = _feet(_ballast(robot, parts, lacking), gap, half)
    for _ in range(2):  # the feet weigh little, and their height is the bars'
        support = _feet(_ballast(robot, [*parts, support], lacking), gap, half)
    return [*parts, support, _ballast(robot, [*parts, support], lacking)]


def _feet(bar: Part, gap: float, half: float) -> Part:
    """Return the two feet that carry the ballast bars over the edges of the lower plate."""
    _, y, z = bar.places[0]
    below, edge = z + bar.solid.bounding_box()[2], y + bar.solid.bounding_box()[4]
    foot, tall = _box((56.0, edge - half + 14.0, below + gap / 2)), (below - gap / 2) / 2
    middle = (edge + half - 14.0) / 2
    made = "print: PETG, 2 walls, 15 % infill; under a ballast bar"
    return Part("ballast_foot", made, foot, 0.3 * PETG, ((0.0, middle, tall), (0.0, -middle, tall)))


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
    thick = 0.5 * mass / (long * high * STEEL * 1e-9)
    y = np.sqrt(1e6 * missing[1] / mass - thick**2 / 12.0)
    z = 1e3 * (robot.body.mass * robot.body.com_offset[2] - given.mass * given.centre[2]) / mass
    bar = _box((long, thick, high))
    return Part("ballast", f"cut: steel bar {long:.0f} x {thick:.1f} x {high:.0f} mm", bar, STEEL, ((0.0, y, z), (0.0, -y, z)))


def _leg(robot: Robot) -> list[Part]:
    length, horn = 1e3 * robot.leg.length, _horn(robot)
    long, deep, wide, servo_mass, near = XL430
    hip = [(8.0 * np.cos(a) - length / 2, 8.0 * np.sin(a), M25) for a in np.arange(8) * np.pi / 4]
    servo = [(length / 2 - dx, sy * 8.0, M25) for dx in (6.0, 30.0) for sy in (1, -1)]
    flat = _sheet(length + 28.0, 26.0, 12.0, [*hip, *servo, (-length / 2, 0.0, 8.0), (-10.0, 0.0, 14.0)])
    arm = flat.extrude(ARM).translate((0, 0, -ARM / 2)).rotate((90.0, 90.0, 0.0))
    places = {"arm": (0.0, ARM / 2 - horn, -length / 2), "servo": (0.0, -500.0 * robot.wheel.width - deep / 2, 0.0)}
    servo_middle = (0.0, places["servo"][1], -length + long / 2 - near)
    return [
        Part("leg_arm", "cut: glass fibre (G10) 3 mm", arm, GLASS_FIBRE, (places["arm"],), profile=flat),
        Part("wheel_servo", "bought: XL430-W250-T", _box((wide, deep, long)), None, (servo_middle,), mass=servo_mass),
        Part("leg_screws", "bought: screws of a leg", _box((16.0, ARM, length)), None, (places["arm"],), mass=0.004),
    ]


def _wheel(robot: Robot) -> list[Part]:
    """Return wheel and tyre; rim, length of the boss and distance of the webs are solved for mass and both inertias."""
    from scipy.optimize import least_squares

    wheel, tread, web, boss = robot.wheel, 0.5, 0.8, 10.5
    radius, width = 1e3 * wheel.radius - tread, 1e3 * wheel.width
    ring = _disc(radius + tread, width) - _disc(radius, width + 1.0)
    tyre = Part("tyre", f"cut: rubber strip {tread} mm, glued on", ring, RUBBER, ((0.0, 0.0, 0.0),))
    targets = np.array([wheel.mass, wheel.spin_inertia, wheel.transverse_inertia])

    def printed(sizes: Array) -> Part:
        rim, long, apart = sizes
        solid = _disc(radius, width) - _disc(radius - rim, width + 1.0) + _disc(boss, long)
        for side in (1, -1):
            solid += _disc(radius - rim / 2, web, side * apart / 2)
        for angle in np.arange(4) * 90.0:
            solid -= _disc(M25 / 2, width + 1.0).translate((8.0, 0.0, 0.0)).rotate((0.0, angle, 0.0))
        made = f"print: PETG, solid: rim {rim:.2f}, webs {web} thick and {apart:.1f} apart, boss {long:.1f} long (mm)"
        return Part("wheel", made, solid, PETG, ((0.0, 0.0, 0.0),))

    def errors(sizes: Array) -> Array:
        found = together(part.properties() for part in (printed(sizes), tyre))
        return np.array([found.mass, found.inertia[1, 1], found.inertia[0, 0]]) / targets - 1.0

    bounds = [0.4, 3.0, 2.0], [0.4 * radius, width, width - web]
    solved = least_squares(errors, [1.0, 0.7 * width, 0.6 * width], bounds=bounds, diff_step=1e-3)
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
    for part in (*kit.body, *kit.leg, *kit.wheel):
        if part.made.startswith("bought"):
            continue
        written.append(folder / f"{part.name}.stl")
        written[-1].write_bytes(stl(part.solid))
        if part.profile is not None:
            written.append(folder / f"{part.name}.dxf")
            write_text(written[-1], dxf(part.profile))
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


def dxf(profile: CrossSection) -> str:
    """Return the outlines of a cut as DXF, mm."""
    import io

    import ezdxf
    from ezdxf import units

    drawing = ezdxf.new("R2010")  # type: ignore[attr-defined]
    drawing.units = units.MM
    for outline in profile.to_polygons():
        drawing.modelspace().add_lwpolyline([(float(x), float(y)) for x, y in outline], close=True)
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue()
