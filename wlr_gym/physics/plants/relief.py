"""Where a wheel touches a floor that is not flat, defined once for every simulator: waves, bumps, grids, and convex pieces.

A wheel is a disc with a rounded tread: a core disc of radius ``rho`` and half width ``b``, grown by ``rc`` on every side, so
that its radius is ``rho + rc`` and its width ``2 (b + rc)``. The floor is a smooth base z = h(x, y), on which pieces stand:
profiles with a flat top, extruded along a horizontal line without an end (kerb, ramp, plank, one step of stairs).

A wheel touches at two places at most: those of the base and of the two nearest pieces where it is deepest. Riser, edge and
top of a piece are one place, whose normal turns from one to the other without a jump. Everything is scalar source over lanes
(see :mod:`wlr_gym.physics.plants.drive`) in the floor frame, without branches.

Families that change what is traced: ``relief`` (any of the following), ``waves``, ``bumps``, ``grid``, ``piece`` (the first
piece), ``pieces`` (all of them).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from wlr_gym.base.errors import InputError
from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Value, Vector
from wlr_gym.robot import Robot
from wlr_gym.robot.parameter_table import PIECES, WAVES
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: How often the normal on a smooth base is improved.
REFINEMENTS = 2
#: Newton's steps over the angle of the normal on a piece's edge.
EDGE_STEPS = 3
#: Crown of the tread, about the angle (rad) over which the contact moves from one of its edges to the other (see
#: :func:`support`).
CROWN = 0.05
#: Where pieces are that are not there: far below (m).
NOWHERE = -10.0
#: Modulus of the permutation that draws bumps: a prime p of which p - 1 is no multiple of 3, so that k^3 mod p visits every
#: number once; small enough for single precision.
PERMUTED = 1019
#: Largest product of the base's curvature and a wheel's radius: up to here the contact is exact to 30 um.
LARGEST_CURVATURE = 0.25
#: Families of smooth bases.
BASES = frozenset({"waves", "bumps", "grid"})

_WAVE_FIELDS = ("height", "slope_x", "slope_y", "phase", "steepness_x", "steepness_y")
_BUMP_FIELDS = ("height", "inverse_spacing", "seed_x", "seed_y", "least", "inverse_share")
PIECE_FIELDS = ("x", "y", "z", "across_x", "across_y", "span", "front_u", "front_v", "rear_u", "rear_v", "edge_radius")
_MAP_FIELDS = (
    *(f"address{k}" for k in range(ops.ADDRESS_PARTS)), "columns", "rows", "x", "y", "along_x", "along_y", "scale"
)  # fmt: skip
_WHEEL_FIELDS = ("core_radius", "core_half_width", "rounding")


def map_lanes(kind: str) -> tuple[str, ...]:
    """Return the lanes of a map, ``grid`` or ``friction_map``: see :func:`pack_map`."""
    return tuple(f"{kind}_{name}" for name in _MAP_FIELDS)


#: Parameter lanes of the relief.
RELIEF_LANES: tuple[str, ...] = (
    *(f"{name}{i}" for name in _WHEEL_FIELDS for i in range(4)),
    *(f"wave_{name}{k}" for name in _WAVE_FIELDS for k in range(len(WAVES))),
    *(f"bump_{name}" for name in _BUMP_FIELDS),
    *map_lanes("grid"),
    *(f"piece_{name}{k}" for name in PIECE_FIELDS for k in range(len(PIECES))),
    "crest",
)


def families(parameters: Parameters) -> set[str]:
    """Return which families of relief some robot of the batch stands on."""
    pieces = np.any(parameters["piece.height"] > 0.0, axis=0)
    present = {
        "waves": parameters["wave.height"].any(),
        "bumps": parameters["bumps.height"].any(),
        "grid": parameters["grid.number"].any(),
        "piece": pieces.any(),
        "pieces": pieces[1:].any(),
    }
    found = {name for name, is_present in present.items() if is_present}
    return found | {"relief"} if found else found


def wheel_profile(parameters: Parameters, robot: Robot) -> tuple[Array, Array, Array]:
    """Return the radius of every wheel's core disc, its half width and its rounding, each (N, 4), m.

    Robots on a level floor have thin discs: as where no robot of the batch stands on relief.
    """
    shapes = ("wave.height", "bumps.height", "grid.number", "piece.height")
    on_relief = np.any([parameters[name].reshape(len(parameters), -1).any(axis=1) for name in shapes], axis=0)[:, None]
    half = np.where(on_relief, 0.25 * robot.wheel.width, np.zeros((1, 4)))
    return parameters["wheel.radius"] - half, half, half


def pack(parameters: Parameters, robot: Robot) -> dict[str, Array]:
    """Return the lanes RELIEF_LANES, each (N,)."""
    profile = zip(_WHEEL_FIELDS, wheel_profile(parameters, robot), strict=True)
    lanes = {f"{name}{i}": values[:, i] for name, values in profile for i in range(4)}
    shapes = _pack_waves(parameters) | _pack_bumps(parameters) | pack_map(parameters, "grid") | _pack_pieces(parameters)
    return lanes | shapes | {"crest": _crest(parameters)}


def _crest(parameters: Parameters) -> Array:
    """Return what no base is higher than, (N,), m."""
    numbers, each = np.unique(parameters["grid.number"], return_inverse=True)
    grids = np.array([np.abs(map_of(number)).max(initial=0.0) for number in numbers])[each] * np.abs(parameters["grid.scale"])
    return np.abs(parameters["wave.height"]).sum(axis=1) + parameters["bumps.height"] + grids


def _pack_waves(parameters: Parameters) -> dict[str, Array]:
    height, heading = parameters["wave.height"], parameters["wave.heading"]
    number = 2.0 * np.pi / parameters["wave.length"]
    fields = {
        "height": height,
        "slope_x": number * np.cos(heading),
        "slope_y": number * np.sin(heading),
        "phase": parameters["wave.phase"],
        "steepness_x": height * number * np.cos(heading),
        "steepness_y": height * number * np.sin(heading),
    }
    return {f"wave_{name}{k}": fields[name][:, k] for name in _WAVE_FIELDS for k in range(len(WAVES))}


def _pack_bumps(parameters: Parameters) -> dict[str, Array]:
    seed = np.floor(parameters["bumps.seed"])
    share = parameters["bumps.share"]
    return {
        "bump_height": parameters["bumps.height"],
        "bump_inverse_spacing": 1.0 / parameters["bumps.spacing"],
        "bump_seed_x": np.mod(seed, PERMUTED),
        "bump_seed_y": np.floor(seed / PERMUTED),
        "bump_least": 1.0 - share,
        "bump_inverse_share": 1.0 / share,
    }


def _pack_pieces(parameters: Parameters) -> dict[str, Array]:
    height, heading, radius = (parameters[f"piece.{name}"] for name in ("height", "heading", "edge_radius"))
    front, rear = parameters["piece.front_slope"], parameters["piece.rear_slope"]
    # The edge is a cylinder about the inner corner, which lies a radius below the top and behind the face.
    inset = {name: radius * np.tan(0.5 * slope) for name, slope in (("front", front), ("rear", rear))}
    along = np.stack([np.cos(heading), np.sin(heading)])
    there = height > 0.0
    # A face begins at the foot, (x, y); its sharp corner is height/tan(slope) further on.
    start = height / np.tan(front) + inset["front"]
    fields = {
        "x": parameters["piece.x"] + start * along[0],
        "y": parameters["piece.y"] + start * along[1],
        "z": np.where(there, height - radius, NOWHERE),
        "across_x": -along[0],
        "across_y": -along[1],
        "span": np.maximum(parameters["piece.length"] - inset["front"] - inset["rear"], 0.0),
        "front_u": np.sin(front),
        "front_v": np.cos(front),
        "rear_u": np.sin(rear),
        "rear_v": np.cos(rear),
        "edge_radius": radius,
    }
    return {f"piece_{name}{k}": fields[name][:, k] for name in PIECE_FIELDS for k in range(len(PIECES))}


# ---- maps: numbers in square cells ---------------------------------------------------------------------------------


#: Maps of this process by their number in the parameter table: rows along y, columns along x; they are never given back, since
#: kernels read them where they lie. Robots without one have number 0, a map without cells whose address may be read.
_MAPS: dict[int, Array] = {0: np.zeros((1, 1))[:0, :0]}


def enter_map(values: Array) -> int:
    """Make a map (rows, columns) known to this process, and return its number, which follows from what is in it."""
    kept = np.array(values, np.float64, order="C")
    number = int(hashlib.sha256(f"{kept.shape}".encode() + kept.tobytes()).hexdigest()[:12], 16)
    kept.flags.writeable = False
    _MAPS.setdefault(number, kept)
    return number


def map_of(number: float) -> Array:
    """Return a map (rows, columns) by its number.

    Raises:
        InputError: no floor with that map has been loaded in this process.
    """
    if int(number) not in _MAPS:
        raise InputError(f"map {int(number)}: is not known here: expected a floor that holds it to be loaded and laid first")
    return _MAPS[int(number)]


def pack_map(parameters: Parameters, kind: str) -> dict[str, Array]:
    """Return the lanes of :func:`map_lanes`, each (N,): where its numbers lie in memory, its size, place, turn and scale."""
    numbers, each = np.unique(parameters[f"{kind}.number"], return_inverse=True)
    maps = [map_of(number) for number in numbers]
    heading, cell = parameters[f"{kind}.heading"], parameters[f"{kind}.cell"]
    address, size = (np.array(found, np.float64) for found in ([*map(ops.address_of, maps)], [one.shape for one in maps]))
    columns = [*address[each].T, *size[each, ::-1].T, parameters[f"{kind}.x"], parameters[f"{kind}.y"]]
    columns += [np.cos(heading) / cell, np.sin(heading) / cell, parameters[f"{kind}.scale"]]
    return dict(zip(map_lanes(kind), columns, strict=True))


def place_in_map(lanes: Lanes, kind: str, x: Value, y: Value) -> tuple[Value, Value]:
    """Return column and row of a place (m, floor frame) in a map: whole numbers at the edges of cells, 0 at the first."""
    dx, dy = x - lanes[f"{kind}_x"], y - lanes[f"{kind}_y"]
    along_x, along_y = lanes[f"{kind}_along_x"], lanes[f"{kind}_along_y"]
    column = (dx * along_x + dy * along_y) + 0.5 * lanes[f"{kind}_columns"]
    return column, (dy * along_x - dx * along_y) + 0.5 * lanes[f"{kind}_rows"]


def map_value(lanes: Lanes, kind: str, column: Value, row: Value) -> Value:
    """Return the number in a cell (whole numbers); beyond the map that of the nearest."""
    column = ops.maximum(ops.minimum(column, lanes[f"{kind}_columns"] - 1.0), 0.0)  # in this order also of what is not finite
    row = ops.maximum(ops.minimum(row, lanes[f"{kind}_rows"] - 1.0), 0.0)
    address = [lanes[f"{kind}_address{k}"] for k in range(ops.ADDRESS_PARTS)]
    return ops.element(address, row * lanes[f"{kind}_columns"] + column)


# ---- the wheel -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WheelProfile:
    """Cross-section of a wheel: radius of its core disc, half its width, and the rounding of its edges, m."""

    radius: Value
    half_width: Value
    rounding: Value


@dataclass(frozen=True)
class Touch:
    """Where a wheel is nearest to the floor.

    Attributes:
        depth: how far it is in the floor, m; negative: how far away.
        normal: of the floor there, upwards; floor frame.
        reach: from the wheel's centre to its point that is deepest, m; floor frame.
        place: what it touches: 1 = the base, from 2 on the pieces.
    """

    depth: Value
    normal: Vector
    reach: Vector
    place: Value = 1.0


def profile_of(lanes: Lanes, i: int) -> WheelProfile:
    """Return the cross-section of wheel ``i``."""
    return WheelProfile(lanes[f"core_radius{i}"], lanes[f"core_half_width{i}"], lanes[f"rounding{i}"])


def _dot(a: Sequence[Value], b: Sequence[Value]) -> Value:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def support(profile: WheelProfile, axle: Vector, normal: Vector) -> tuple[Value, Vector]:
    """Return how far a wheel reaches against ``normal`` (m), and the vector from its centre to the point that does.

    S(n) = rho sqrt(1 - x^2) + b (sqrt(x^2 + e^2) - e) + rc with x = n . axle, and the point is -dS/dn. The crown e lets the
    point move across the tread over a small angle where a cylinder's would jump from one edge to the other.
    """
    x = _dot(normal, axle)
    # rounded: with the constant normal of a plane, signs would fold and another product be fused
    in_plane = [ops.rounded(normal[k] - x * axle[k]) for k in range(3)]
    square = _dot(in_plane, in_plane) + 1e-18
    inverse = 1.0 / ops.sqrt(square)
    root = ops.sqrt(x * x + CROWN * CROWN)
    along_axle = profile.half_width * x / root
    along_normal = profile.rounding + profile.half_width * (CROWN * CROWN / root - CROWN)
    reach = [-(profile.radius * inverse) * in_plane[k] - along_axle * axle[k] - along_normal * normal[k] for k in range(3)]
    distance = profile.radius * (square * inverse) + profile.half_width * (root - CROWN) + profile.rounding
    return distance, reach


# ---- the base --------------------------------------------------------------------------------------------------------


def base_height(lanes: Lanes, x: Value, y: Value, features: frozenset[str]) -> tuple[Value, Value, Value]:
    """Return height (m) and slope along x and y of the base at a place (m, floor frame)."""
    height: Value = 0.0
    slope_x: Value = 0.0
    slope_y: Value = 0.0
    if "waves" in features:
        for k in range(len(WAVES)):
            angle = lanes[f"wave_slope_x{k}"] * x + lanes[f"wave_slope_y{k}"] * y + lanes[f"wave_phase{k}"]
            sine, cosine = ops.sin_cos(angle)
            height = height + lanes[f"wave_height{k}"] * sine
            slope_x = slope_x + lanes[f"wave_steepness_x{k}"] * cosine
            slope_y = slope_y + lanes[f"wave_steepness_y{k}"] * cosine
    if "bumps" in features:
        bump, rise_x, rise_y = _bumps(lanes, x, y)
        height, slope_x, slope_y = height + bump, slope_x + rise_x, slope_y + rise_y
    if "grid" in features:
        rise, rise_x, rise_y = _grid(lanes, x, y)
        height, slope_x, slope_y = height + rise, slope_x + rise_x, slope_y + rise_y
    return height, slope_x, slope_y


def _permuted(k: Value) -> Value:
    """k^3 modulo :data:`PERMUTED`, of a whole number below that; exact in either precision."""
    return _below_modulus(_below_modulus(k * k) * k)


def _below_modulus(k: Value) -> Value:
    return k - PERMUTED * ops.floor((k + 0.5) * (1.0 / PERMUTED))


def _bumps(lanes: Lanes, x: Value, y: Value) -> tuple[Value, Value, Value]:
    """Biquadratic B-spline over a square lattice whose heights are drawn from the lattice point's number and the seed."""
    scale = lanes["bump_inverse_spacing"]
    column, row = x * scale, y * scale
    first_column, first_row = ops.floor(column), ops.floor(row)
    weights_x, slopes_x = _quadratic(column - first_column)
    weights_y, slopes_y = _quadratic(row - first_row)
    in_rows = [_permuted(_below_modulus(first_row + (float(k) + lanes["bump_seed_y"]))) for k in range(3)]
    total: Value = 0.0
    slope_x: Value = 0.0
    slope_y: Value = 0.0
    for j in range(3):
        shuffled = _permuted(_below_modulus(first_column + float(j)))
        in_column = _permuted(_below_modulus(shuffled + lanes["bump_seed_x"]))
        line: Value = 0.0
        line_slope: Value = 0.0
        for k in range(3):
            number = _permuted(_below_modulus(in_column + in_rows[k]))
            drawn = _permuted(_below_modulus(number + lanes["bump_seed_y"])) * (1.0 / (PERMUTED - 1))
            height = ops.maximum(drawn - lanes["bump_least"], 0.0)
            line = line + weights_y[k] * height
            line_slope = line_slope + slopes_y[k] * height
        total = total + weights_x[j] * line
        slope_x = slope_x + slopes_x[j] * line
        slope_y = slope_y + weights_x[j] * line_slope
    size = lanes["bump_height"] * lanes["bump_inverse_share"]
    # rounded as where waves are added, whichever they are: bits must not depend on the robots beside
    return ops.rounded(size * total), ops.rounded((size * scale) * slope_x), ops.rounded((size * scale) * slope_y)


def _grid(lanes: Lanes, x: Value, y: Value) -> tuple[Value, Value, Value]:
    """Biquadratic B-spline over the map of heights, whose numbers are the spline's weights in the middles of cells."""
    column, row = place_in_map(lanes, "grid", x, y)
    first_column, first_row = ops.floor(column), ops.floor(row)
    weights_x, slopes_x = _quadratic(column - first_column)
    weights_y, slopes_y = _quadratic(row - first_row)
    middle = map_value(lanes, "grid", first_column, first_row)  # taken off, so that a level map is level to the last bit
    total: Value = 0.0
    along: Value = 0.0
    across: Value = 0.0
    for k in range(3):
        heights = [map_value(lanes, "grid", first_column + (j - 1.0), first_row + (k - 1.0)) - middle for j in range(3)]
        line = weights_x[0] * heights[0] + weights_x[1] * heights[1] + weights_x[2] * heights[2]
        slope = slopes_x[0] * heights[0] + slopes_x[1] * heights[1] + slopes_x[2] * heights[2]
        total, along, across = total + weights_y[k] * line, along + weights_y[k] * slope, across + slopes_y[k] * line
    scale, along_x, along_y = lanes["grid_scale"], lanes["grid_along_x"], lanes["grid_along_y"]
    slope_x, slope_y = scale * (along * along_x - across * along_y), scale * (along * along_y + across * along_x)
    return ops.rounded(scale * (middle + total)), ops.rounded(slope_x), ops.rounded(slope_y)  # rounded: see _bumps


def _quadratic(t: Value) -> tuple[Vector, Vector]:
    """Weights of three neighbours in a quadratic B-spline at a fraction ``t`` of a cell, and their slopes."""
    rest = 1.0 - t
    return [0.5 * rest * rest, 0.5 + t * rest, 0.5 * t * t], [-rest, rest - t, t]


def touch_of_base(lanes: Lanes, centre: Vector, axle: Vector, profile: WheelProfile, features: frozenset[str]) -> Touch:
    """Return where a wheel is nearest to the base: the normal under its centre, improved at the point that it finds."""
    if not features & BASES:
        _, reach = support(profile, axle, [0.0, 0.0, 1.0])
        return Touch(-(centre[2] + reach[2]), [0.0, 0.0, 1.0], reach)
    height, normal, reach = 0.0, normal_of(*base_height(lanes, centre[0], centre[1], features)[1:]), [0.0] * 3
    for _ in range(REFINEMENTS):
        _, reach = support(profile, axle, normal)
        height, *slopes = base_height(lanes, centre[0] + reach[0], centre[1] + reach[1], features)
        normal = normal_of(*slopes)
    return Touch((height - (centre[2] + reach[2])) * normal[2], normal, reach)


def normal_of(slope_x: Value, slope_y: Value) -> Vector:
    """Return the unit normal of a surface of slopes along x and y."""
    up = 1.0 / ops.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
    return [-(slope_x * up), -(slope_y * up), up]


# ---- pieces ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Edge:
    """One upper edge of a piece as a wheel sees it, in the plane across the edge (u: outwards, v: up).

    Attributes:
        gap: distance of the wheel's centre from the edge's surface, m.
        centre: of the wheel, from the inner corner, m.
        across: unit vector outwards, horizontal (x, y).
        steepest: normal (u, v) of the face below the edge; the other limit is straight up.
        normal: direction (u, v) from the inner corner to the centre, within those limits.
        radius: of the edge, m.
        place: of the piece, see :class:`Touch`.
    """

    gap: Value
    centre: tuple[Value, Value]
    across: tuple[Value, Value]
    steepest: tuple[Value, Value]
    normal: tuple[Value, Value]
    radius: Value
    place: Value


def _choose(condition: Value, a: _Edge, b: _Edge) -> _Edge:
    """Return ``a`` where the condition is positive, else ``b``."""

    def pick(x: tuple[Value, Value], y: tuple[Value, Value]) -> tuple[Value, Value]:
        return ops.where_positive(condition, x[0], y[0]), ops.where_positive(condition, x[1], y[1])

    return _Edge(
        ops.where_positive(condition, a.gap, b.gap),
        pick(a.centre, b.centre),
        pick(a.across, b.across),
        pick(a.steepest, b.steepest),
        pick(a.normal, b.normal),
        ops.where_positive(condition, a.radius, b.radius),
        ops.where_positive(condition, a.place, b.place),
    )


def _nearer(a: _Edge, b: _Edge) -> _Edge:
    return _choose(b.gap - a.gap, a, b)


def _further(a: _Edge, b: _Edge) -> _Edge:
    return _choose(b.gap - a.gap, b, a)


def _edge_of(lanes: Lanes, k: int, centre: Vector) -> _Edge:
    """Return the edge of piece ``k`` on whose side a wheel's centre stands."""
    across = (lanes[f"piece_across_x{k}"], lanes[f"piece_across_y{k}"])
    dx, dy = centre[0] - lanes[f"piece_x{k}"], centre[1] - lanes[f"piece_y{k}"]
    u = dx * across[0] + dy * across[1]
    behind = -(u + 0.5 * lanes[f"piece_span{k}"])  # beyond the middle of the top: the far edge
    turned = ops.where_positive(behind, -1.0, 1.0)
    u = ops.where_positive(behind, -(u + lanes[f"piece_span{k}"]), u)
    v = centre[2] - lanes[f"piece_z{k}"]
    steepest = tuple(ops.where_positive(behind, lanes[f"piece_rear_{a}{k}"], lanes[f"piece_front_{a}{k}"]) for a in "uv")
    inverse = 1.0 / ops.sqrt(u * u + v * v + 1e-18)
    normal = within_faces(u * inverse, v * inverse, steepest)
    radius = lanes[f"piece_edge_radius{k}"]
    gap = u * normal[0] + v * normal[1] - radius
    outwards = (turned * across[0], turned * across[1])
    return _Edge(gap, (u, v), outwards, (steepest[0], steepest[1]), normal, radius, k + 2.0)


def within_faces(u: Value, v: Value, steepest: tuple[Value, ...]) -> tuple[Value, Value]:
    """Limit a direction to the normals between a face and the top."""
    below = steepest[1] * u - steepest[0] * v  # positive: below the face's normal
    # positive: behind straight up, and nearer to it than to the face's normal (inside a piece a direction may be beyond both)
    beyond = ops.minimum(-u, v - (steepest[0] * u + steepest[1] * v))
    u, v = ops.where_positive(below, steepest[0], u), ops.where_positive(below, steepest[1], v)
    return ops.where_positive(beyond, 0.0, u), ops.where_positive(beyond, 1.0, v)


def _touch_of_edge(edge: _Edge, axle: Vector, profile: WheelProfile) -> Touch:
    """Return where a wheel is nearest to an edge: the normal between face and top along which they are furthest apart.

    f(angle) = C . n - S(n) - r is concave there; Newton's steps start at the direction of the wheel's centre. Where the normal
    comes near to the axle f has a kink that they cannot find: the direction of the axle is tried as well.
    """
    cu, cv = edge.centre
    axle_u = axle[0] * edge.across[0] + axle[1] * edge.across[1]
    axle_v = axle[2]
    rho, b = profile.radius, profile.half_width
    u, v = edge.normal
    for _ in range(EDGE_STEPS):
        x = axle_u * u + axle_v * v
        y = axle_v * u - axle_u * v  # change of x with the angle
        square = ops.maximum(1.0 - x * x, 1e-6)
        inverse_g = 1.0 / ops.sqrt(square)
        inverse_r = 1.0 / ops.sqrt(x * x + CROWN * CROWN)
        product, difference = x * y, y * y - x * x
        first = cv * u - cu * v + product * (rho * inverse_g - b * inverse_r)
        second = rho * inverse_g * (difference + product * product * (inverse_g * inverse_g))
        second = second - b * inverse_r * (difference - product * product * (inverse_r * inverse_r))
        curvature = cu * u + cv * v - second
        turn = ops.clip(first / ops.maximum(curvature, 0.1 * rho), -0.5, 0.5)
        u, v = u - turn * v, v + turn * u
        inverse = 1.0 / ops.sqrt(u * u + v * v)
        u, v = within_faces(u * inverse, v * inverse, edge.steepest)
    facing = ops.where_positive(axle_u * cu + axle_v * cv, 1.0, -1.0)
    aside_u, aside_v = facing * axle_u + 1e-6 * u, facing * axle_v + 1e-6 * v  # an axle along the edge has no such direction
    inverse = 1.0 / ops.sqrt(aside_u * aside_u + aside_v * aside_v + 1e-30)
    aside = within_faces(aside_u * inverse, aside_v * inverse, edge.steepest)
    found: list[Touch] = []
    for out, up in ((u, v), aside):
        normal = [out * edge.across[0], out * edge.across[1], up]
        distance, reach = support(profile, axle, normal)
        found.append(Touch(distance + edge.radius - (cu * out + cv * up), normal, reach, edge.place))
    return _shallower(*found)


# ---- both ------------------------------------------------------------------------------------------------------------


def touches(lanes: Lanes, i: int, centre: Vector, axle: Vector, features: frozenset[str]) -> list[Touch]:
    """Return where wheel ``i`` is nearest to the floor: one place, or two where there are pieces, the deeper one first.

    Args:
        lanes: RELIEF_LANES.
        i: wheel.
        centre: of the wheel, floor frame, m.
        axle: its direction, floor frame.
        features: families that are traced.
    """
    profile = profile_of(lanes, i)
    base = _rounded(touch_of_base(lanes, centre, axle, profile, features))
    if "piece" not in features:
        return [base]
    edges = [_edge_of(lanes, k, centre) for k in piece_numbers(features)]
    nearest = reduce(_nearer, edges)
    on_piece = _rounded(_touch_of_edge(nearest, axle, profile))
    first, second = _deeper(base, on_piece), _shallower(base, on_piece)
    if "pieces" in features:
        second = _deeper(second, _rounded(_touch_of_edge(_second_nearest(edges), axle, profile)))
        first, second = _deeper(first, second), _shallower(first, second)
    return [first, second]


def _rounded(touch: Touch) -> Touch:
    """Round a touch as if it were chosen among several, so that bits do not depend on what the robots beside stand on."""
    normal, reach = ([ops.rounded(x) for x in vector] for vector in (touch.normal, touch.reach))
    return Touch(ops.rounded(touch.depth), normal, reach, touch.place)


def _deeper(a: Touch, b: Touch) -> Touch:
    return _choose_touch(b.depth - a.depth, b, a)


def _shallower(a: Touch, b: Touch) -> Touch:
    return _choose_touch(b.depth - a.depth, a, b)


def _choose_touch(condition: Value, a: Touch, b: Touch) -> Touch:
    """Return ``a`` where the condition is positive, else ``b``."""
    normal, reach = (
        [ops.where_positive(condition, x, y) for x, y in zip(one, other, strict=True)]
        for one, other in ((a.normal, b.normal), (a.reach, b.reach))
    )
    depth, place = (ops.where_positive(condition, x, y) for x, y in ((a.depth, b.depth), (a.place, b.place)))
    return Touch(depth, normal, reach, place)


def _second_nearest(edges: Sequence[_Edge]) -> _Edge:
    """Return the edge that is second nearest: of each next one and the nearest so far, the further is a candidate."""
    nearest, second = _nearer(*edges[:2]), _further(*edges[:2])
    for edge in edges[2:]:
        second = _nearer(second, _further(nearest, edge))
        nearest = _nearer(nearest, edge)
    return second


def floor_height(lanes: Lanes, x: Value, y: Value, features: frozenset[str]) -> Value:
    """Return the height (m) of base and pieces at a place (m, floor frame); edges are taken as sharp."""
    height, *_ = base_height(lanes, x, y, features)
    for k in piece_numbers(features):
        height = ops.maximum(height, piece_height(lanes, k, x, y))
    return height


def piece_height(lanes: Lanes, k: int, x: Value, y: Value, reach: Value = 0.0) -> Value:
    """Return the height (m) of piece ``k`` at a place, or how high it is at most within a distance ``reach`` (m) of it."""
    edge = _edge_of(lanes, k, [x, y, lanes[f"piece_z{k}"]])
    (u, _), (steep, level) = edge.centre, edge.steepest
    level = ops.maximum(level, 1e-3)
    outside = ops.maximum((u - reach) * steep - edge.radius * (1.0 - level), 0.0)  # times the face's sine: 0 at the corner
    return lanes[f"piece_z{k}"] + edge.radius - outside / level


def piece_numbers(features: frozenset[str]) -> range:
    """Return which pieces are traced."""
    return range(len(PIECES) if "pieces" in features else int("piece" in features))
