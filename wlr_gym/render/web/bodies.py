"""The robot's bodies as triangles: the shapes of :class:`wlr_gym.render.stage.Stage`, which pictures and the window draw, too."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from wlr_gym.render.stage import Stage

Array = NDArray[np.float64]

#: Sides of what is round.
SIDES = 32
#: Geoms of this group are hidden: what touches the floor, not what is drawn.
_HIDDEN = 3


@dataclass(frozen=True, eq=False)
class Body:
    """A body in its own frame.

    Attributes:
        name: of the model's body.
        index: of it in the model.
        vertices: (V, 3) m.
        faces: (F, 3) indices of vertices, seen from outside against the clock.
        colours: (V, 3) red, green, blue, 0 to 255.
    """

    name: str
    index: int
    vertices: Array
    faces: NDArray[np.int64]
    colours: NDArray[np.uint8]


def bodies(stage: Stage) -> list[Body]:
    """Return the bodies of a stage that have something to draw; the floor is none of them."""
    model, found = stage.model, []
    for index in range(1, model.nbody):
        first = int(model.body_geomadr[index])
        geoms = [one for one in range(first, first + int(model.body_geomnum[index])) if _is_drawn(model, one)]
        if geoms:
            found.append(_merged(model, index, geoms))
    return found


def _is_drawn(model: Any, geom: int) -> bool:
    return int(model.geom_group[geom]) != _HIDDEN and float(model.geom_rgba[geom, 3]) > 0.0


def _merged(model: Any, index: int, geoms: list[int]) -> Body:
    parts = [_triangles(model, geom) for geom in geoms]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    colours = [np.tile(np.rint(255 * model.geom_rgba[geom, :3]).astype(np.uint8), (len(v), 1)) for geom, (v, _) in zip(geoms, parts, strict=True)]
    return Body(
        model.body(index).name,
        index,
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=True)]),
        np.concatenate(colours),
    )


def _triangles(model: Any, geom: int) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices in the body's frame, and faces, of one geom."""
    import trimesh

    kind, size, shapes = int(model.geom_type[geom]), np.asarray(model.geom_size[geom]), mujoco.mjtGeom
    if kind == shapes.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2.0 * size)
    elif kind == shapes.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=SIDES)
        mesh.unmerge_vertices()  # edges stay sharp
    elif kind == shapes.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[SIDES // 2, SIDES // 2])
        mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
    else:
        raise ValueError(f"geom {geom} of the model has a shape that is not drawn: {kind}")
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    vertices = np.asarray(mesh.vertices) @ turn.reshape(3, 3).T + model.geom_pos[geom]
    return vertices, np.asarray(mesh.faces, np.int64)
