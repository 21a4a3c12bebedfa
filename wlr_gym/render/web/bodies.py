"""The robot's bodies as triangles: the shapes of :class:`wlr_gym.render.stage.Stage`, as in pictures and the window."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from wlr_gym.render.colours import Colour
from wlr_gym.render.stage import Stage

Array = NDArray[np.float64]

#: Sides of what is round.
SIDES = 32
#: Geoms of this group are hidden: what touches the floor, not what is drawn.
_HIDDEN = 3


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of one colour in the frame of their body.

    Attributes:
        vertices: (V, 3) m.
        faces: (F, 3) indices of vertices; seen from outside they go round against the clock.
        colour: red, green, blue, 0 to 1.
    """

    vertices: Array
    faces: NDArray[np.int64]
    colour: Colour


@dataclass(frozen=True, eq=False)
class BodyShape:
    """A body in its own frame: its name and index in the model, and its surfaces, one per colour."""

    name: str
    index: int
    surfaces: tuple[Surface, ...]


def bodies(stage: Stage) -> list[BodyShape]:
    """Return the bodies of a stage that have something to draw; the floor is none of them."""
    model, found = stage.model, []
    for index in range(1, model.nbody):
        first = int(model.body_geomadr[index])
        colours: dict[Colour, list[int]] = {}
        for geom in range(first, first + int(model.body_geomnum[index])):
            red, green, blue, opacity = (float(part) for part in model.geom_rgba[geom])
            if int(model.geom_group[geom]) != _HIDDEN and opacity > 0.0:
                colours.setdefault((red, green, blue), []).append(geom)
        if colours:
            surfaces = (_joined([_triangles(model, geom) for geom in geoms], colour) for colour, geoms in colours.items())
            found.append(BodyShape(model.body(index).name, index, tuple(surfaces)))
    return found


def joined(body: BodyShape, colour: Colour) -> Surface:
    """Return a body as one surface."""
    return _joined([(one.vertices, one.faces) for one in body.surfaces], colour)


def _joined(parts: list[tuple[Array, NDArray[np.int64]]], colour: Colour) -> Surface:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=True)])
    return Surface(np.concatenate([vertices for vertices, _ in parts]), faces, colour)


def _triangles(model: Any, geom: int) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices in the body's frame, and faces, of one geom."""
    import trimesh

    kind, size, shapes = int(model.geom_type[geom]), np.asarray(model.geom_size[geom]), mujoco.mjtGeom
    if kind == shapes.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2.0 * size)
    elif kind == shapes.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=SIDES)
    elif kind == shapes.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[SIDES // 2, SIDES // 2])
        mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
    else:
        raise ValueError(f"geom {geom} of the model has a shape that is not drawn: {kind}")
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    vertices = np.asarray(mesh.vertices) @ turn.reshape(3, 3).T + model.geom_pos[geom]
    return vertices, np.asarray(mesh.faces, np.int64)
