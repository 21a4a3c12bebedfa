"""A floor that is not flat, or has a map of friction, as triangles around a place: for drawing only, never for contact.

The base is a grid whose lines lie closer near the place; pieces are their profiles, extruded. What wheels touch:
:mod:`wlr_gym.physics.plants.relief`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants import ground, relief
from wlr_gym.robot import Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]
Faces = NDArray[np.int32]
#: Corners (x, y) of an area of the floor, m.
Rectangle = tuple[tuple[float, float], tuple[float, float]]

REACH = 15.0  # m; the floor is drawn this far around the robot; farther away there is fog
#: m from the place -> distance of the base's lines up to there, over the smallest.
BANDS = ((0.6, 1), (1.2, 2), (2.4, 6), (6.0, 20), (REACH, 80))
#: The smallest distance of lines: of the length of a wave, of the spacing of bumps, of the cells of maps; and its limits, m.
WAVE_LINES, BUMP_LINES, GRID_LINES, FRICTION_LINES = 1.0 / 24.0, 1.0 / 4.0, 1.0 / 4.0, 1.0 / 2.0
FINEST, WIDEST = 0.0125, 0.05
LIT = 3.0  # times as steep as it is, the base is lit, so that low bumps are seen
LEVELS = 8  # most colours of a map of friction
STEP = 0.2  # m; the place moves in such steps, so that a moving robot seldom needs another surface
ARC = 4  # strips of a rounded edge
BAND = 0.006  # m; width of the lines along the edges and feet of pieces
BURIED = 1e-3  # m; faces of pieces go on so far below the base
#: m; half the width of the square over which a floor's level is averaged, and how many points it takes along a side.
LEVEL_REACH, LEVEL_POINTS = 0.3, 25
#: Parameters that a surface follows from.
SHAPING = (
    *(f"wave.{field}" for field in ("height", "length", "heading", "phase")),
    *(f"bumps.{field}" for field in ("height", "spacing", "share", "seed")),
    *(f"piece.{field}" for field in ("x", "y", "heading", "height", "length", "front_slope", "rear_slope", "edge_radius")),
    *(f"patch.{field}" for field in ("mu", "x_min", "x_max", "y_min", "y_max")),
    *(f"{map_}.{field}" for map_ in ("grid", "friction_map") for field in ("number", "scale", "cell", "x", "y", "heading")),
)


@dataclass(frozen=True, eq=False)
class Surface:
    """The floor around a place, floor frame.

    Attributes:
        vertices: (V, 3) m.
        normals: (V, 3) unit vectors out of the floor, for its light; see :data:`LIT`.
        faces: triangles (F, 3) of vertices, counter-clockwise from outside: of the bare floor, of each area, of each level of
            the map of friction (:attr:`Relief.levels`), and of the lines along the edges of pieces.
    """

    vertices: Array
    normals: Array
    faces: list[Faces]


class Relief:
    """One robot's floor that is not flat, or has a map of friction.

    Args:
        robot: its wheels.
        parameters: (1).
    """

    def __init__(self, robot: Robot, parameters: Parameters) -> None:
        self._parameters = Parameters(parameters.values.copy())
        self._features = frozenset(relief.families(parameters))
        self._lanes = relief.pack(self._parameters, robot) | relief.pack_map(self._parameters, "friction_map")
        grid, friction = (self._map(kind) for kind in ("grid", "friction_map"))
        #: m; the base is nowhere deeper.
        self.lowest: float = min(float(grid.min(initial=0.0)), 0.0) - float(self._parameters["wave.height"].sum()) - BURIED
        found = np.unique(friction)
        #: Friction of the colours of its map.
        self.levels: Array = found if len(found) <= LEVELS else np.linspace(found[0], found[-1], LEVELS)

    def _map(self, kind: str) -> Array:
        return float(self._parameters[f"{kind}.scale"][0]) * relief.map_of(self._parameters[f"{kind}.number"][0])

    @staticmethod
    def of(robot: Robot, parameters: Parameters) -> Relief | None:
        """Return the floor of one robot; None = it is flat, and has no map of friction."""
        is_plain = not relief.families(parameters) and not parameters["friction_map.number"].any()
        return None if is_plain else Relief(robot, parameters)

    def height(self, x: Array, y: Array) -> Array:
        """Return the height (m) at places (m) of base and pieces."""
        return np.broadcast_to(relief.floor_height(self._lanes, x, y, self._features), np.shape(x))

    def level(self, place: Array) -> float:
        """Return the mean height (m) around a place (x, y): it changes little by little where a robot goes up a kerb."""
        along = np.linspace(-LEVEL_REACH, LEVEL_REACH, LEVEL_POINTS)
        x, y = np.meshgrid(place[0] + along, place[1] + along)
        return float(self.height(x.ravel(), y.ravel()).mean())

    def surface(self, around: Array, areas: Sequence[Rectangle], coarseness: float = 1.0) -> Surface:
        """Return what of the floor can be seen from a place.

        Args:
            around: (x, y), m.
            areas: rectangles that have triangles of their own; of those that overlap, the last one has them.
            coarseness: of the base's grid; 1 = fine.
        """
        parts, edges = [self._base(around, areas, coarseness)], 1 + len(areas) + len(self.levels)
        for number in np.flatnonzero(self._parameters["piece.height"][0] > 0.0):
            for strip, is_edge in self._strips(int(number), around):
                parts += [_part(*one) for one in ([(edges, strip)] if is_edge else _cut(strip, areas))]
        return _joined(parts, 1 + edges)

    # ---- the base ----

    def _base(self, around: Array, areas: Sequence[Rectangle], coarseness: float) -> Surface:
        finest = self._finest() * coarseness
        edges = np.array(areas, dtype=np.float64).reshape(-1, 2)
        x, y = (_lines(around[axis], finest, edges[:, axis]) for axis in range(2))
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        values = relief.base_height(self._lanes, grid[:, 0], grid[:, 1], self._features)
        height, slope_x, slope_y = (np.broadcast_to(value, len(grid)) for value in values)
        normals = np.stack([-LIT * slope_x, -LIT * slope_y, np.ones(len(grid))], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        owner = self._levels_at(_middles(x), _middles(y))
        owner[owner > 0] += len(areas)
        for number, (low, high) in enumerate(areas, 1):
            inside = [(middles > low[axis]) & (middles < high[axis]) for axis, middles in enumerate((_middles(x), _middles(y)))]
            owner[np.ix_(*inside)] = number
        corner = np.arange(len(grid), dtype=np.int32).reshape(len(x), len(y))
        a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
        triangles = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2)
        faces = [triangles[owner == number].reshape(-1, 3) for number in range(1 + len(areas) + len(self.levels))]
        return Surface(np.column_stack([grid, height]), normals, faces)

    def _levels_at(self, x: Array, y: Array) -> NDArray[np.int64]:
        """Return at a grid of places 1 + the number of the nearest level of the map of friction, 0 beyond it."""
        if not len(self.levels):
            return np.zeros((len(x), len(y)), np.int64)
        inside, mu = ground.friction_of_map(self._lanes, x[:, None], y)
        return np.where(inside > 0.0, 1 + np.abs(mu[..., None] - self.levels).argmin(axis=-1), 0)

    def _finest(self) -> float:
        """Return the smallest distance of the base's lines, m; of a plane the whole reach."""
        lengths = [*(WAVE_LINES * self._parameters["wave.length"][0][self._parameters["wave.height"][0] > 0.0])]
        if self._parameters["bumps.height"][0] > 0.0:
            lengths.append(BUMP_LINES * float(self._parameters["bumps.spacing"][0]))
        for kind, share in (("grid", GRID_LINES), ("friction_map", FRICTION_LINES)):
            if self._parameters[f"{kind}.number"][0]:
                lengths.append(share * float(self._parameters[f"{kind}.cell"][0]))
        return float(np.clip(min(lengths), FINEST, WIDEST)) if lengths else REACH

    # ---- pieces ----

    def _strips(self, number: int, around: Array) -> Iterator[tuple[Array, bool]]:
        """Yield the strips of a piece around a place, corners (4, 6): points and normals, and whether it lies along an edge."""
        heading = float(self._parameters["piece.heading"][0, number])
        ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        foot = np.array([self._parameters[f"piece.{axis}"][0, number] for axis in "xy"])
        middle, aside = float((around[:2] - foot) @ ahead), float((around[:2] - foot) @ left)
        turn = np.array([[*ahead, 0.0], [*left, 0.0], [0.0, 0.0, 1.0]])
        for points, normals, is_edge in _profile(self._piece(number), self.lowest):
            points, normals = _between(points, normals, middle - REACH, middle + REACH)
            if not len(points):
                continue
            corners = [(0, -REACH), (1, -REACH), (1, REACH), (0, REACH)]
            at = np.array([[points[k, 0], aside + side, points[k, 1]] for k, side in corners]) @ turn + np.append(foot, 0.0)
            out = np.array([[normals[k, 0], 0.0, normals[k, 1]] for k, _ in corners]) @ turn
            yield np.hstack([at, out]), is_edge

    def _piece(self, number: int) -> dict[str, float]:
        names = ("height", "length", "front_slope", "rear_slope", "edge_radius")
        return {name: float(self._parameters[f"piece.{name}"][0, number]) for name in names}


def _middles(lines: Array) -> Array:
    return 0.5 * (lines[1:] + lines[:-1])


def _lines(middle: float, finest: float, edges: Array) -> Array:
    """Return where lines are, m: whole multiples of their distance, so that they stay when the middle moves, and ``edges``."""
    lines, reached = [middle - REACH, middle + REACH, *edges], 0.0
    for reach, coarser in BANDS:
        step = finest * coarser
        there = step * np.arange(np.ceil((middle - reach) / step), np.floor((middle + reach) / step) + 1.0)
        lines += [line for line in there if reached <= abs(line - middle)]
        reached = reach
    return np.unique(np.round(np.array(lines, np.float64), 9))


def _profile(piece: Mapping[str, float], lowest: float) -> Iterator[tuple[Array, Array, bool]]:
    """Yield the lines of a piece's profile, along its heading from its foot and up, m.

    Ends (2, 2), normals (2, 2) there, and whether it is of an edge: the rounding, and a band beside it and at the foot.
    """
    height, radius, front, rear = (piece[name] for name in ("height", "edge_radius", "front_slope", "rear_slope"))
    inset = radius * np.tan(0.5 * np.array([front, rear]))
    begin = height / np.tan(front) + inset[0]
    end = begin + max(piece["length"] - inset.sum(), 0.0)
    band = min(BAND, (end - begin) / 3.0)
    angles = np.linspace(-front, 0.0, ARC + 1), np.linspace(0.0, rear, ARC + 1)
    arcs = [np.stack([np.sin(angle), np.cos(angle)], axis=1) for angle in angles]
    first, last = (np.array([corner, height - radius]) + radius * arc for corner, arc in zip((begin, end), arcs, strict=True))
    points = [
        *_face(first[0], front, -1.0, lowest)[::-1],
        *first,
        np.array([begin + band, height]),
        np.array([end - band, height]),
        *last,
        *_face(last[-1], rear, 1.0, lowest),
    ]
    normals = [*arcs[0][[0, 0]], *arcs[0], *([[0.0, 1.0]] * 2), *arcs[1], *arcs[1][[-1, -1]]]
    plain = (1, len(points) // 2 - 1, len(points) - 3)  # faces and top
    for k, (line, normal) in enumerate(zip(pairwise(points), pairwise(normals), strict=True)):
        yield np.array(line), np.array(normal), k not in plain


def _face(corner: Array, slope: float, side: float, lowest: float) -> tuple[Array, Array]:
    """Return where a face goes down from a corner: the upper end of the line along its foot at z = 0, and its lowest end."""
    run = side / np.tan(slope)
    upper, end = min(BAND * np.sin(slope), max(corner[1], 0.0)), min(lowest, corner[1])
    return corner + (corner[1] - upper) * np.array([run, -1.0]), corner + (corner[1] - end) * np.array([run, -1.0])


def _between(points: Array, normals: Array, low: float, high: float) -> tuple[Array, Array]:
    """Return what of a line of a profile is within limits along the heading; nothing (0, 2) where it is outside."""
    begin, end = points[:, 0]
    if end < low or begin > high:
        return points[:0], normals[:0]
    shares = np.clip([(low - begin) / (end - begin), (high - begin) / (end - begin)], 0.0, 1.0) if end > begin else [0.0, 1.0]
    share = np.array(shares)[:, None]
    return points[0] + share * (points[1] - points[0]), normals


def _cut(polygon: Array, areas: Sequence[Rectangle]) -> list[tuple[int, Array]]:
    """Return the parts of a convex polygon (n, 6): 0 and what is in no area, or the number of the last area that it is in."""
    rest, found = [polygon], []
    for number in range(len(areas), 0, -1):
        outside: list[Array] = []
        for part in rest:
            inside = part
            for axis in range(2):
                below, inside = _split(inside, axis, areas[number - 1][0][axis])
                inside, above = _split(inside, axis, areas[number - 1][1][axis])
                outside += [below, above]
            found.append((number, inside))
        rest = [part for part in outside if len(part)]
    return [(number, part) for number, part in [*found, *((0, part) for part in rest)] if len(part)]


def _split(polygon: Array, axis: int, place: float) -> tuple[Array, Array]:
    """Return what of a convex polygon lies below a place on an axis, and what above."""
    beyond = polygon[:, axis] - place if len(polygon) else np.zeros(0)
    if (beyond <= 0.0).all():
        return polygon, polygon[:0]
    if (beyond >= 0.0).all():
        return polygon[:0], polygon
    sides: tuple[list[Array], list[Array]] = ([], [])
    for k, (corner, far) in enumerate(zip(polygon, beyond, strict=True)):
        following, next_far = polygon[(k + 1) % len(polygon)], beyond[(k + 1) % len(polygon)]
        for side, is_there in zip(sides, (far <= 0.0, far >= 0.0), strict=True):
            side.extend([corner] * int(is_there))
        if far * next_far < 0.0:
            crossing = corner + far / (far - next_far) * (following - corner)
            sides[0].append(crossing)
            sides[1].append(crossing)
    return np.array(sides[0]), np.array(sides[1])


def _part(number: int, polygon: Array) -> Surface:
    fan = np.arange(1, len(polygon) - 1, dtype=np.int32)
    faces = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    return Surface(polygon[:, :3], polygon[:, 3:], [faces if k == number else faces[:0] for k in range(number + 1)])


def _joined(parts: Sequence[Surface], count: int) -> Surface:
    """Return parts as one surface of ``count`` kinds of faces."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    nothing = np.zeros((0, 3), np.int32)
    faces = [
        np.concatenate(
            [nothing, *(part.faces[k] + start for part, start in zip(parts, starts, strict=False) if k < len(part.faces))]
        )
        for k in range(count)
    ]
    vertices, normals = (np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals"))
    return Surface(vertices, normals, [one.astype(np.int32) for one in faces])
