"""What is drawn besides the robot: areas of other friction, paths, slip and force arrows. Nothing here needs OpenGL."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import assert_never

import mujoco
import numpy as np
from numpy.typing import NDArray

from wlr_gym.physics.plants.base import Truth
from wlr_gym.render.colours import FORCE, LOAD, Colour, friction_colour, slip_colour
from wlr_gym.render.stage import SQUARE, Stage
from wlr_gym.robot.parameter_table import PATCHES
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: m of arrow per m/s of slip.
SLIP_SCALE = 2.0
#: m/s; less slip is not drawn.
SLIP_FLOOR = 0.003
#: m of arrow per N of friction.
FORCE_SCALE = 0.025
#: N; less friction is not drawn.
FORCE_FLOOR = 0.2
#: m.
LONGEST_ARROW = 0.4
#: m; half the width of an arrow.
SHAFT = 0.006
#: m; slip arrows start this far outside the wheel's middle plane, beside the tyre, where they can be seen.
SLIP_BESIDE = 0.022
#: m; force arrows start outside of them.
FORCE_BESIDE = 0.040
#: m; areas are drawn on the floor this far around the robot.
REACH = 15.0
LAYER = 4e-4
#: m; the floor's squares are drawn this far around the robot, and this high: over areas and pads.
SQUARES_REACH = 40.0
SQUARES_HEIGHT = 6 * LAYER
#: Away from the body along the axle (left): corners are lf, rf, lr, rr.
OUTWARDS = np.array([[1.0], [-1.0], [1.0], [-1.0]])
#: m; half the width of a trail.
LINE = 0.004
#: m; length of its pieces.
PIECE = 0.03


@dataclass(frozen=True)
class Area:
    """A rectangle of floor with a friction of its own: corners (x, y) in m, colour, height of its surface."""

    low: tuple[float, float]
    high: tuple[float, float]
    mu: float
    height: float

    def points(self, near: Array) -> Array:
        """Return a grid of points (49, 3) on what of it is within 0.9 m of a place (x, y), the innermost first."""
        reach, count = 0.9, 7
        low = np.maximum(np.minimum(near[:2] - reach, self.high), self.low)
        high = np.minimum(np.maximum(near[:2] + reach, self.low), self.high)
        share = (np.arange(count) + 0.5) / count
        share = share[np.argsort(np.abs(share - 0.5), kind="stable")]
        grid = np.stack(np.meshgrid(share, share, indexing="ij"), axis=-1).reshape(-1, 2)
        order = np.argsort(np.abs(grid - 0.5).sum(axis=1), kind="stable")
        return np.column_stack([low + grid[order] * (high - low), np.full(len(grid), self.height)])


@dataclass(frozen=True)
class Arrow:
    """An arrow in the floor frame, m."""

    start: Array
    end: Array
    colour: Colour


@dataclass(frozen=True)
class Trail:
    """A path over the floor: points (N, 2), m, and colour; dashed = every second piece is left out."""

    points: Array
    colour: Colour
    dashed: bool = False


@dataclass(frozen=True)
class Piece:
    """A straight piece of a trail, m."""

    start: Array
    end: Array
    colour: Colour


@dataclass(frozen=True)
class Spot:
    """A round pad under a wheel that has a floor friction of its own."""

    centre: Array
    mu: float


@dataclass(frozen=True)
class Squares:
    """The floor's squares, a shade over floor and areas alike: middle (x, y), m, and number of their material."""

    middle: Array
    material: int


Mark = Squares | Area | Spot | Arrow | Piece


def squares(stage: Stage, around: Array) -> Squares:
    """Return the squares around a place (x, y); they stay where they are when it moves."""
    pattern = 2.0 * SQUARE
    return Squares(pattern * np.round(around[:2] / pattern), int(stage.model.material("squares").id))


def areas(parameters: Parameters, row: int, around: Array) -> list[Area]:
    """Return the non-empty friction patches, cut to what can be seen from ``around`` (x, y); later ones lie on top.

    The colour is that of the friction along the heading and the axle on average (along the axle: times mu_y/mu_x).
    """
    found = []
    mu_x, mu_y = parameters["ground.mu_x"][row].mean(), parameters["ground.mu_y"][row].mean()
    share = 0.5 * (1.0 + (mu_y / mu_x if mu_x > 0 else 1.0))
    for index in range(len(PATCHES)):
        box = [parameters[f"patch.{side}"][row, index] for side in ("x_min", "x_max", "y_min", "y_max")]
        if not (box[0] < box[1] and box[2] < box[3]):
            continue
        low = np.maximum([box[0], box[2]], around[:2] - REACH)
        high = np.minimum([box[1], box[3]], around[:2] + REACH)
        if (low < high).all():
            mu = float(parameters["patch.mu"][row, index]) * float(share)
            found.append(Area(pair(low), pair(high), mu, LAYER * (index + 1)))
    return found


def pair(values: Array) -> tuple[float, float]:
    """Return the first two numbers."""
    return float(values[0]), float(values[1])


def spots(stage: Stage, parameters: Parameters, row: int) -> list[Spot]:
    """Return a pad under every wheel where the wheels have different floors, none where they share one."""
    mu = 0.5 * (parameters["ground.mu_x"][row] + parameters["ground.mu_y"][row])
    if np.ptp(mu) < 1e-9:
        return []
    points, _, _ = stage.contact_frames(parameters, row)
    return [Spot(point, float(value)) for point, value in zip(points, mu, strict=True)]


def pieces(trail: Trail) -> list[Piece]:
    """Return a trail as straight pieces of at least :data:`PIECE`."""
    corners = [trail.points[:1]]
    for point in trail.points[1:]:
        if np.hypot(*(point - corners[-1][0])) >= PIECE:
            corners.append(point[None])
    if len(trail.points) > 1:
        corners.append(trail.points[-1:])
    heights = np.full((len(corners), 1), 2.0 * LINE)
    places = np.hstack([np.concatenate(corners), heights]) if corners else np.zeros((0, 3))
    every = 2 if trail.dashed else 1
    return [Piece(a, b, trail.colour) for a, b in list(pairwise(places))[::every] if np.hypot(*(b - a)[:2]) > 1e-6]


def slip_arrows(stage: Stage, truth: Truth, parameters: Parameters, row: int) -> list[Arrow]:
    """Return one arrow per slipping wheel: where its contact point skids to over the floor."""
    slip = truth.slip_velocity[row].reshape(4, 2)
    speed = np.hypot(slip[:, 0], slip[:, 1])
    colours = [slip_colour(float(value)) for value in speed]
    return _arrows(stage, parameters, row, SLIP_SCALE * slip, SLIP_SCALE * SLIP_FLOOR, SLIP_BESIDE, colours)


def force_arrows(stage: Stage, truth: Truth, parameters: Parameters, row: int) -> list[Arrow]:
    """Return one arrow per wheel: the floor's friction force on it."""
    force = truth.contact_force[row].reshape(4, 3)[:, :2]
    return _arrows(stage, parameters, row, FORCE_SCALE * force, FORCE_SCALE * FORCE_FLOOR, FORCE_BESIDE, [FORCE] * 4)


def load_arrows(stage: Stage, truth: Truth, parameters: Parameters, row: int) -> list[Arrow]:
    """Return one arrow per loaded wheel: the floor's normal force on it, upwards beside the wheel."""
    load = truth.contact_force[row].reshape(4, 3)[:, 2]
    points, _, left = stage.contact_frames(parameters, row)
    starts = points + FORCE_BESIDE * OUTWARDS * left
    length = np.minimum(FORCE_SCALE * load, LONGEST_ARROW)
    ends = starts + length[:, None] * [0.0, 0.0, 1.0]
    return [Arrow(starts[wheel], ends[wheel], LOAD) for wheel in range(4) if load[wheel] >= FORCE_FLOOR]


def _arrows(
    stage: Stage, parameters: Parameters, row: int, vectors: Array, shortest: float, beside: float, colours: list[Colour]
) -> list[Arrow]:
    points, heading, left = stage.contact_frames(parameters, row)
    starts = points + beside * OUTWARDS * left + [0.0, 0.0, SHAFT + LAYER * 5]
    length = np.hypot(vectors[:, 0], vectors[:, 1])
    scale = np.minimum(1.0, LONGEST_ARROW / np.maximum(length, 1e-12))[:, None]
    ends = starts + scale * (vectors[:, :1] * heading + vectors[:, 1:] * left)
    return [
        Arrow(starts[wheel], ends[wheel], colours[wheel])
        for wheel in range(4)
        if length[wheel] >= shortest and np.isfinite(length[wheel])
    ]


# --- into MuJoCo's scene ----------------------------------------------------------------------------------------------


def add_marks(scene: mujoco.MjvScene, marks: Iterable[Mark]) -> None:
    """Append marks to a scene; what does not fit in is left out."""
    for mark in marks:
        if scene.ngeom >= scene.maxgeom:
            return
        _draw(scene.geoms[scene.ngeom], mark)
        scene.ngeom += 1


def _draw(geom: mujoco.MjvGeom, mark: Mark) -> None:
    match mark:
        case Piece(start, end, colour):
            _start(geom, "CAPSULE", [LINE, LINE, LINE], start, colour)
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, LINE, start, end)
        case Area():
            low, high = np.array(mark.low), np.array(mark.high)
            size, middle = [*(0.5 * (high - low)), mark.height], [*(0.5 * (low + high)), 0.0]
            _start(geom, "BOX", size, middle, friction_colour(mark.mu))
        case Squares(middle, material):
            _start(geom, "PLANE", [SQUARES_REACH, SQUARES_REACH, 0.0], [*middle, SQUARES_HEIGHT], (1.0, 1.0, 1.0))
            geom.matid = material
            geom.rgba[3] = 0.99  # only what is not quite opaque is blended with what lies below
        case Spot(centre, mu):
            _start(geom, "CYLINDER", [0.06, LAYER * 5, 0.0], centre * [1.0, 1.0, 0.0], friction_colour(mu))
        case Arrow(start, end, colour):
            _start(geom, "ARROW", [SHAFT, SHAFT, SHAFT], start, colour)
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, SHAFT, start, end)
            geom.emission = 0.5
        case _:
            assert_never(mark)


def _start(geom: mujoco.MjvGeom, kind: str, size: Iterable[float], position: Iterable[float], colour: Colour) -> None:
    shape = getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")
    place = np.fromiter(position, np.float64)
    mujoco.mjv_initGeom(
        geom, shape, np.fromiter(size, np.float64), place, np.eye(3).ravel(), np.array([*colour, 1.0], np.float32)
    )
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR.value
