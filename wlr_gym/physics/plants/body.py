"""Where body and shanks touch the floor, defined once for every simulator: corners, edges of the underside, legs.

The body is a box, a shank a rod of radius :data:`SHANK_RADIUS` from hip to axle. They touch at twenty spots (:data:`SPOTS`):

- the box's eight corners, against the base and the pieces of the floor;
- the four edges of its underside and its four upright ones, each where it crosses the upper edge of a piece;
- the four shanks, at the hip as a corner does, and where they cross the upper edge of a piece. (A shank's lower end is in its
  wheel, which is wider.)

At each spot a spring and a damper push along the floor's normals, and an elastic bristle holds along the floor: it is strained
by what the spot moves, at most until its force is ``body.mu`` times the push (return mapping). What rests does not creep.

Forces are explicit: with positions at the middle of a step and velocities at its start. Stiffness and damping are bounded by
what the step resolves (:func:`wlr_gym.physics.plants.ground.pack_body`). All in the floor frame, as scalar source over lanes.
A simulator first asks :func:`nearness`, then lets the base (:func:`push_of_base`) and each piece (:func:`push_of_piece`) push,
and ends with :func:`hold`; where nothing is near it leaves the rest out, and no bit changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.codegen import ops
from wlr_gym.physics.codegen.ops import Lanes, Out, Value, Vector
from wlr_gym.physics.plants import ground, relief
from wlr_gym.physics.plants.base import Contacts, Truth
from wlr_gym.physics.plants.contacts import AXES, CORNERS, cross, dot, lanes_at, rotation_rows, to_body, vector
from wlr_gym.robot import CORNER_SIGNS, SHANK_RADIUS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Corners of the box, by their signs along its axes.
BOX_CORNERS = tuple((x, y, z) for z in (-1.0, 1.0) for x, y in CORNER_SIGNS)
#: Edges of the underside along x and y, and the upright ones: along which axis, and by the signs of their first ends.
BOX_EDGES = (
    *((0, (-1.0, y, -1.0)) for y in (1.0, -1.0)),
    *((1, (x, -1.0, -1.0)) for x in (1.0, -1.0)),
    *((2, (x, y, -1.0)) for x, y in CORNER_SIGNS),
)
#: Spots: corners 0 to 7, shanks 8 to 11, edges 12 to 19.
SPOTS = range(len(BOX_CORNERS) + len(CORNERS) + len(BOX_EDGES))
SHANKS = range(len(BOX_CORNERS), len(BOX_CORNERS) + len(CORNERS))
EDGES = range(SHANKS.stop, SPOTS.stop)
#: Within this distance (m) of the floor something is near: more than a spot moves in a step.
MARGIN = 0.01

#: What spots keep from step to step: strain of the bristle (m) and the force in the last step that anything was near (N).
SPOT_STATE: tuple[str, ...] = tuple(f"{name}_{a}{s}" for name in ("spot_strain", "spot_force") for s in SPOTS for a in AXES)
#: What the floor's parts add up within a step: normal force (N) as a vector, its size, and that times the share of the way
#: along a shank or edge at which it acts.
PUSHES: tuple[str, ...] = (
    *(f"push_{a}{s}" for s in SPOTS for a in AXES),
    *(f"load{s}" for s in SPOTS),
    *(f"load_share{s}" for s in SPOTS),
)  # fmt: skip
#: A piece's lanes without its number: those of the piece that pushes.
PIECE_LANES: tuple[str, ...] = tuple(f"piece_{name}" for name in relief.PIECE_FIELDS)


@dataclass(frozen=True)
class _Spot:
    """A corner, or what is between two ends of a shank or edge.

    Attributes:
        number: in SPOTS.
        start, way: from the body's origin to its first end, and on to its second; None = it is a point.
        speed, turning: velocity of the first end, and how much faster the second is.
        stiffness, damping: N/m, N s/m.
        radius: m.
        leg: whose it is; None = the body's.
    """

    number: int
    start: Vector
    speed: Vector
    stiffness: Value
    damping: Value
    way: Vector | None = None
    turning: Vector | None = None
    radius: float = 0.0
    leg: int | None = None

    def at(self, share: Value) -> tuple[Vector, Vector]:
        """Place from the body's origin and velocity at a share of the way."""
        if self.way is None or self.turning is None:
            return self.start, self.speed
        return _moved(self.start, share, self.way), _moved(self.speed, share, self.turning)


def _moved(start: Vector, share: Value, way: Vector) -> Vector:
    return [start[k] + share * way[k] for k in range(3)]


def _spots(lanes: Lanes, rows: Sequence[Vector]) -> list[_Spot]:
    """Return the spots in their order; ``rows``: of the rotation body -> floor."""
    axes = [[row[k] for row in rows] for k in range(3)]
    half = [[lanes[f"half_size_{a}"] * axes[k][m] for m in range(3)] for k, a in enumerate(AXES)]
    velocity, turn = ([dot(row, vector(lanes, name)) for row in rows] for name in "vw")
    swing = [cross(turn, side) for side in half]
    springs = lanes["body_stiffness"], lanes["body_damping"]

    def place(signs: Iterable[float]) -> tuple[Vector, Vector]:
        start, speed = [0.0, 0.0, 0.0], velocity
        for sign, side, faster in zip(signs, half, swing, strict=True):
            start = [start[k] + sign * side[k] for k in range(3)]
            speed = [speed[k] + sign * faster[k] for k in range(3)]
        return start, speed

    found = [_Spot(number, *place(signs), *springs) for number, signs in enumerate(BOX_CORNERS)]
    for i, number in zip(CORNERS, SHANKS, strict=True):
        hip, leg = ([dot(row, part) for row in rows] for part in _leg(lanes, i))
        speed = [velocity[k] + x for k, x in enumerate(cross(turn, hip))]
        bend = lanes[f"leg_rate{i}"] - lanes["wy"]
        turning = cross([turn[k] + bend * axes[1][k] for k in range(3)], leg)
        springs_of_leg = lanes["shank_stiffness"], lanes["shank_damping"]
        found.append(_Spot(number, hip, speed, *springs_of_leg, leg, turning, SHANK_RADIUS, i))
    for (axis, signs), number in zip(BOX_EDGES, EDGES, strict=True):
        way, turning = ([2.0 * x for x in part[axis]] for part in (half, swing))
        found.append(_Spot(number, *place(signs), *springs, way, turning))
    return found


def _leg(lanes: Lanes, i: int) -> tuple[Vector, Vector]:
    """From the body's origin to hip ``i``, and on to its axle; body frame."""
    sine, cosine = ops.sin_cos(lanes[f"leg_angle{i}"])
    length = lanes[f"length{i}"]
    return [lanes[f"hip_{a}{i}"] for a in AXES], [length * cosine, 0.0, -(length * sine)]


# ---- whether anything may touch --------------------------------------------------------------------------------------


def nearness(lanes: Lanes, features: frozenset[str]) -> Out:
    """Return ``near_base`` and ``near_piece{k}``, positive where body or shanks may touch them, and the largest, ``near``."""
    up = rotation_rows(lanes)[2]
    half, hip = ([ops.absolute(up[k]) * lanes[name.format(a)] for k, a in enumerate(AXES)] for name in _SIZES)
    corner = lanes["pz"] - (half[0] + half[1] + half[2])
    hips = lanes["pz"] - (hip[0] + hip[1]) - (ops.absolute(lanes["hip_z0"]) + SHANK_RADIUS)
    lowest = ops.minimum(corner, hips)
    crest = lanes["crest"] if features & relief.BASES else 0.0
    out: Out = {"near_base": (crest + MARGIN) - lowest}
    lowest = ops.minimum(corner, hips - reduce(ops.maximum, [lanes[f"length{i}"] for i in CORNERS]))
    for k in relief.piece_numbers(features):
        top = relief.piece_height(lanes, k, lanes["px"], lanes["py"], lanes["reach"])
        out[f"near_piece{k}"] = (top + MARGIN) - lowest
    return {"near": reduce(ops.maximum, out.values())} | out


_SIZES = ("half_size_{}", "hip_{}0")


# ---- what the floor pushes -------------------------------------------------------------------------------------------


class _Pushes:
    """Sums of what spots are pushed with, on top of what the lanes have; a robot that is not near stays as it is."""

    def __init__(self, lanes: Lanes, near: Value) -> None:
        self._lanes = lanes
        self._near = near
        self.sums: Out = {}

    def add(self, spot: _Spot, share: Value, normal: Vector, speed: Vector, depth: Value, valid: Value) -> None:
        """Push a spot at a share of its way along a unit normal where it is ``depth`` deep and ``valid`` is positive."""
        push = ops.maximum(spot.stiffness * depth - spot.damping * dot(normal, speed), 0.0)
        push = ops.rounded(ops.where_positive(ops.minimum(ops.minimum(valid, depth), self._near), push, 0.0))
        self._sum(f"load{spot.number}", push)
        if spot.way is not None:
            self._sum(f"load_share{spot.number}", push * share)
        for k, a in enumerate(AXES):
            self._sum(f"push_{a}{spot.number}", push * normal[k])

    def before(self, spot: _Spot) -> Value:
        """Positive where a spot was pushed in the step before."""
        force = [self._lanes[f"spot_force_{a}{spot.number}"] for a in AXES]
        return dot(force, force)

    def _sum(self, name: str, value: Value) -> None:
        self.sums[name] = self.sums.get(name, self._lanes[name]) + value


def push_of_base(lanes: Lanes, features: frozenset[str]) -> Out:
    """Return PUSHES after the base has pushed: corners and hips."""
    pushes = _Pushes(lanes, lanes["near_base"])
    origin = vector(lanes, "p")
    for spot in _spots(lanes, rotation_rows(lanes))[: SHANKS.stop]:
        x, y, z = (origin[k] + spot.start[k] for k in range(3))
        normal, above = [0.0, 0.0, 1.0], z
        if features & relief.BASES:
            height, *slopes = relief.base_height(lanes, x, y, features)
            normal = [ops.rounded(component) for component in relief.normal_of(*slopes)]
            above = ops.rounded((z - height) * normal[2])
        pushes.add(spot, 0.0, normal, spot.speed, spot.radius - above, 1.0)
    return pushes.sums


def push_of_piece(lanes: Lanes) -> Out:
    """Return PUSHES after a piece has pushed (lanes PIECE_LANES and ``near_piece``): its top and faces, then its two edges.

    A corner leaves a piece by the nearest of top and faces, which are taken as sharp: their rounding is smaller than what would
    be felt.
    """
    pushes = _Pushes(lanes, lanes["near_piece"])
    across = [lanes["piece_across_x"], lanes["piece_across_y"]]
    rows = rotation_rows(lanes)
    spots = _spots(lanes, rows)
    corner = [lanes[f"p{a}"] - lanes[f"piece_{a}"] for a in AXES]

    def in_profile(a: Vector) -> tuple[Value, Value]:
        return across[0] * a[0] + across[1] * a[1], a[2]

    def out_of_profile(u: Value, v: Value) -> Vector:
        return [u * across[0], u * across[1], v]

    span, edge_radius = lanes["piece_span"], lanes["piece_edge_radius"]
    front, rear = ((lanes[f"piece_{side}_u"], lanes[f"piece_{side}_v"]) for side in ("front", "rear"))
    origin = in_profile(corner)
    for spot in spots[: SHANKS.stop]:
        u, v = (x + y for x, y in zip(in_profile(spot.start), origin, strict=True))
        reach = edge_radius + spot.radius
        top = reach - v
        ahead, behind = reach - (u * front[0] + v * front[1]), reach + ((u + span) * rear[0] - v * rear[1])
        face = ops.minimum(ahead, behind)
        is_rear, is_top = ahead - behind, face - top
        normal_u = ops.where_positive(is_rear, -rear[0], front[0])
        normal_v = ops.where_positive(is_rear, rear[1], front[1])
        normal_u, normal_v = ops.where_positive(is_top, 0.0, normal_u), ops.where_positive(is_top, 1.0, normal_v)
        pushes.add(spot, 0.0, out_of_profile(normal_u, normal_v), spot.speed, ops.minimum(top, face), 1.0)
    sides = [_Edge(1.0, origin, front, edge_radius), _Edge(-1.0, (-(origin[0] + span), origin[1]), rear, edge_radius)]
    box = [in_profile([lanes[f"half_size_{a}"] * row[k] for row in rows]) for k, a in enumerate(AXES)]
    whole = _Outline((0.0, 0.0), box)
    for spot in spots[SHANKS.start :]:
        assert spot.way is not None
        start, way = in_profile(spot.start), in_profile(spot.way)
        half = 0.5 * way[0], 0.5 * way[1]
        outline = whole if spot.leg is None else _Outline((start[0] + half[0], start[1] + half[1]), [half])
        least = reduce(ops.minimum, [edge.least(outline) for edge in sides])
        for edge in sides:
            depth = edge.depth_of(outline, way)
            _cross(pushes, spot, edge, start, way, out_of_profile, depth, least)
    return pushes.sums


Pair = tuple[Value, Value]
#: Something crosses an edge only where that is the shortest way out of the piece, to this much (m).
SLACK = 1e-4
#: Nothing begins to cross an edge deeper than this (m): the shortest way out may turn to an edge that is far away.
SHALLOW = 0.005
#: What is shorter than the root of this across an edge (m2) lies along it, and does not cross it.
ALONG = 1e-8


@dataclass(frozen=True)
class _Outline:
    """What a centre (from the body's origin) and half axes span, in the plane across a piece's edges, m."""

    centre: Pair
    axes: Sequence[Pair]


@dataclass(frozen=True)
class _Edge:
    """One upper edge of a piece, in the plane across it (u: outwards of the front edge, v: up).

    Attributes:
        side: 1 = front, -1 = rear.
        origin: the body's origin from the inner corner, u turned outwards.
        face: normal of the face below it, u turned outwards.
        radius: m.
    """

    side: float
    origin: Pair
    face: Pair
    radius: Value

    def normal_to(self, way: Pair) -> Pair:
        """Return the normal square to a way, limited to those between face and top."""
        u, v = self.side * way[0], way[1]
        square = u * u + v * v + 1e-12
        inverse = ops.where_positive(u * (1.0 + self.face[1]) - v * self.face[0], 1.0, -1.0) / ops.sqrt(square)
        normal = relief.within_faces(-(v * inverse), u * inverse, self.face)
        crosses = square - ALONG
        return ops.where_positive(crosses, normal[0], 0.0), ops.where_positive(crosses, normal[1], 1.0)

    def _reach(self, outline: _Outline, normal: Pair) -> Value:
        depth = self.radius - (self.side * outline.centre[0] + self.origin[0]) * normal[0]
        depth = depth - (outline.centre[1] + self.origin[1]) * normal[1]
        for u, v in outline.axes:
            depth = depth + ops.absolute(self.side * u * normal[0] + v * normal[1])
        return depth

    def depth_of(self, outline: _Outline, way: Pair) -> Value:
        """How deep an outline is in the piece along the normal square to a way, m."""
        return self._reach(outline, self.normal_to(way))

    def least(self, outline: _Outline) -> Value:
        """How deep an outline is along the normals of face and top, and those square to its axes: the least, m."""
        depths = [self.depth_of(outline, axis) for axis in outline.axes]
        return reduce(ops.minimum, depths, ops.minimum(self._reach(outline, self.face), self._reach(outline, (0.0, 1.0))))


def _cross(
    pushes: _Pushes,
    spot: _Spot,
    edge: _Edge,
    start: Pair,
    way: Pair,
    out_of_profile: Callable[[Value, Value], Vector],
    depth: Value,
    least: Value,
) -> None:
    """Push a shank or an edge of the box where it crosses the edge of a piece, square to both.

    Args:
        pushes: taken to. spot: that crosses. edge: that is crossed.
        start, way: of the spot, in the plane across the edge.
        out_of_profile: a vector of that plane in the floor frame.
        depth: of body or shank along that normal, m.
        least: along any normal, m; where that is less, it does not leave the piece here.
    """
    u, v, way_u = edge.side * start[0] + edge.origin[0], start[1] + edge.origin[1], edge.side * way[0]
    square = way_u * way_u + way[1] * way[1] + 1e-12
    share = ops.where_positive(square - ALONG, -(u * way_u + v * way[1]) / square, -1.0)
    normal = edge.normal_to(way)
    own = (edge.radius + spot.radius) - (u + share * way_u) * normal[0] - (v + share * way[1]) * normal[1]
    valid = ops.minimum(ops.minimum(share, 1.0 - share), (least + SLACK) - depth)
    valid = ops.minimum(valid, ops.where_positive(pushes.before(spot), 1.0, SHALLOW - own))
    pushes.add(spot, share, out_of_profile(edge.side * normal[0], normal[1]), spot.at(share)[1], own, valid)


# ---- what holds along the floor, and the sum of all ------------------------------------------------------------------


def hold(lanes: Lanes, step: Value, features: frozenset[str]) -> tuple[Out, Vector, Vector, Vector]:
    """Strain the bristles by a step; return SPOT_STATE and the sum of all forces.

    Returns:
        SPOT_STATE; force on the body's origin (floor frame, N), torque about it (body frame, N m), torque of each leg about its
        hip. All 0, and the state as it was, where nothing is near.
    """
    rows = rotation_rows(lanes)
    axle = [row[1] for row in rows]
    out: Out = {}
    force: Vector = [0.0, 0.0, 0.0]
    torque: Vector = [0.0, 0.0, 0.0]
    legs: Vector = [0.0] * len(CORNERS)
    spots = _spots(lanes, rows)
    for spot in spots if "piece" in features else spots[: SHANKS.stop]:
        share = lanes[f"load_share{spot.number}"] / ops.maximum(lanes[f"load{spot.number}"], 1e-9)
        place, speed = spot.at(share)
        pushed = _held(lanes, spot, speed, step, out)
        moment = cross(place, pushed)
        force, torque = ([total[k] + more[k] for k in range(3)] for total, more in ((force, pushed), (torque, moment)))
        if spot.leg is not None and spot.way is not None:
            legs[spot.leg] = share * dot(axle, cross(spot.way, pushed))
    return out, force, to_body(rows, torque), legs


def _held(lanes: Lanes, spot: _Spot, speed: Vector, step: Value, out: Out) -> Vector:
    """Return the force (N) on a spot, and write the strain of its bristle."""
    s = spot.number
    push = [lanes[f"push_{a}{s}"] for a in AXES]
    square = dot(push, push)
    inverse = 1.0 / ops.sqrt(square + 1e-30)
    normal, load = [x * inverse for x in push], square * inverse
    old = [lanes[f"spot_strain_{a}{s}"] for a in AXES]
    strain = _along(normal, [old[k] + step * speed[k] for k in range(3)])
    slip = _along(normal, speed)
    wanted = [-(spot.stiffness * strain[k] + spot.damping * slip[k]) for k in range(3)]
    limit = lanes["body_mu"] * load
    shrink = ops.minimum(limit / ops.sqrt(dot(wanted, wanted) + 1e-30), 1.0)
    slides = 1.0 - shrink
    pushed: Vector = []
    for k, a in enumerate(AXES):
        friction = shrink * wanted[k]
        held = ops.where_positive(slides, -(friction / spot.stiffness), strain[k])
        strained = ops.where_positive(load, held, 0.0)
        total = ops.where_positive(load, push[k] + friction, 0.0)
        out[f"spot_strain_{a}{s}"] = ops.where_positive(lanes["near"], strained, old[k])
        out[f"spot_force_{a}{s}"] = ops.where_positive(lanes["near"], total, lanes[f"spot_force_{a}{s}"])
        pushed.append(ops.where_positive(lanes["near"], total, 0.0))
    return pushed


# ---- in numbers: for pictures, logs and tests ------------------------------------------------------------------------


def spots_at(robot: Robot, parameters: Parameters, truth: Truth, force: Array) -> Contacts:
    """Return the contacts of body and shanks of robots (N) in the poses of a truth.

    Args:
        robot: theirs.
        parameters: (N).
        truth: (N) where they are.
        force: (N, 20, 3) on the spots, floor frame, N.
    """
    count, features, still = len(parameters), frozenset(relief.families(parameters)), np.zeros(len(parameters))
    lanes = lanes_at(robot, parameters, truth) | ground.pack_body(parameters, robot, 1e-6)
    lanes |= dict.fromkeys((*PUSHES, *(f"{name}{a}" for name in "vw" for a in AXES)), still)
    lanes |= {f"leg_rate{i}": still for i in CORNERS}
    lanes |= {f"spot_force_{a}{s}": force[:, s, k] for s in SPOTS for k, a in enumerate(AXES)}
    lanes |= nearness(lanes, features)
    lanes |= push_of_base(lanes, features)
    for k in relief.piece_numbers(features):
        lanes |= push_of_piece(lanes | {name: lanes[f"{name}{k}"] for name in (*PIECE_LANES, "near_piece")})
    rows = rotation_rows(lanes)
    axle = np.stack([row[1] for row in rows], axis=1)
    point, normal, heading, lateral = np.zeros((4, count, len(SPOTS), 3))
    depth = np.full((count, len(SPOTS)), -np.inf)
    for spot in _spots(lanes, rows):
        s = spot.number
        push = np.stack([lanes[f"push_{a}{s}"] for a in AXES], axis=1)
        load = np.maximum(lanes[f"load{s}"], 1e-9)
        place, _ = spot.at(lanes[f"load_share{s}"] / load)
        normal[:, s] = push / np.maximum(np.linalg.norm(push, axis=1, keepdims=True), 1e-9)
        ahead = np.cross(axle, normal[:, s])
        heading[:, s] = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
        lateral[:, s] = np.cross(normal[:, s], heading[:, s])
        touches = lanes[f"load{s}"] > 0.0
        depth[touches, s] = (load / spot.stiffness)[touches]
        point[touches, s] = (truth.position + np.stack(place, axis=1) - spot.radius * normal[:, s])[touches]
    axes = np.stack([heading, lateral, normal], axis=2)
    along = np.einsum("ncij,ncj->nci", axes, force)
    return Contacts(point, depth, normal, heading, lateral, np.where(np.isfinite(depth)[:, :, None], along, 0.0))


def lowest_corner(robot: Robot, truth: Truth) -> Array:
    """Return how high (N,) the lowest corners of bodies are, m; ``truth``: of robots (N)."""
    up = np.abs(np.stack(rotation_rows(dict(zip(("qw", "qx", "qy", "qz"), truth.quaternion.T, strict=True)))[2], axis=1))
    return truth.position[:, 2] - up @ (0.5 * np.array(robot.body.size))


def _along(normal: Vector, a: Vector) -> Vector:
    """What of a vector is along the floor."""
    rise = dot(normal, a)
    return [a[k] - rise * normal[k] for k in range(3)]
