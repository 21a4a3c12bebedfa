"""Wheels and floors of relief, told by code that shares nothing with the simulators: what their contacts are held to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rig import ROBOT

from wlr_gym.physics import maps
from wlr_gym.physics.plants import relief
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

#: Radius of a wheel's core disc, its half width, and the rounding of the tread (a quarter of the width each), m.
HALF_WIDTH = ROUNDING = 0.25 * ROBOT.wheel.width
CORE = ROBOT.wheel.radius - ROUNDING


def parameters_of(count: int, values: Mapping[str, Any]) -> Parameters:
    """Return nominal robots on a floor of the given parameters."""
    parameters = Parameters.nominal(ROBOT, count)
    for name, value in values.items():
        parameters[name] = value
    return parameters


def touches(parameters: Parameters, centre: Array, axle: Array) -> list[relief.Touch]:
    """Return the contacts of one wheel per robot of a batch: centres and axles (N, 3), floor frame."""
    lanes = relief.pack(parameters, ROBOT)
    return relief.touches(lanes, 0, list(centre.T), list(axle.T), frozenset(relief.families(parameters)))


def columns(vector: Any, count: int) -> Array:
    """Return a traced vector as (N, 3)."""
    return np.stack([np.broadcast_to(value, count) for value in vector], axis=1)


def turns(rng: np.random.Generator, count: int, yaw: float, roll: float) -> Array:
    """Return rotations (N, 3, 3): of up to ``yaw`` about the vertical, then of up to ``roll`` about the wheel's heading."""
    y, r = rng.uniform(-yaw, yaw, count), rng.uniform(-roll, roll, count)
    zero, one = np.zeros(count), np.ones(count)
    about_z = np.array([[np.cos(y), -np.sin(y), zero], [np.sin(y), np.cos(y), zero], [zero, zero, one]])
    about_x = np.array([[one, zero, zero], [zero, np.cos(r), -np.sin(r)], [zero, np.sin(r), np.cos(r)]])
    return np.einsum("ijn,jkn->nik", about_z, about_x)


# ---- the wheel: a convex body, which its support function says in full -----------------------------------------------


def reach(direction: Array, axle: Array, crown: float = relief.CROWN) -> Array:
    """Return how far a wheel reaches along directions (..., 3) of any length: it grows in proportion to that length."""
    size = np.linalg.norm(direction, axis=-1)
    along = (direction * axle).sum(axis=-1)
    radial = np.sqrt(np.maximum(size**2 - along**2, 0.0))
    crowned = np.sqrt(along**2 + (crown * size) ** 2) - crown * size
    return CORE * radial + HALF_WIDTH * crowned + ROUNDING * size


def wheel_surface(around: int = 1441, across: int = 161) -> Array:
    """Return points (K, 3) all over the lower half of an unturned wheel, axle along y: slopes of its reach, by differences."""
    angle = np.linspace(-1.6, 1.6, around)
    sine = 0.93 * np.sinh(np.linspace(-3.0, 3.0, across)) / np.sinh(3.0)  # densest where the tread is flat
    angle, sine = (grid.ravel() for grid in np.meshgrid(angle, sine, indexing="ij"))
    direction = np.stack([np.sin(angle) * np.sqrt(1 - sine**2), sine, -np.cos(angle) * np.sqrt(1 - sine**2)], axis=1)
    axle, small = np.array([0.0, 1.0, 0.0]), 1e-6
    steps = small * np.eye(3)
    return np.stack([(reach(direction + d, axle) - reach(direction - d, axle)) / (2 * small) for d in steps], axis=1)


def along_heading(heading: Array, vector: Array) -> Array:
    """Return vectors (N, 3) turned about the vertical by headings (N,), rad."""
    cosine, sine, (x, y, z) = np.cos(heading), np.sin(heading), vector.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)


# ---- floors ----------------------------------------------------------------------------------------------------------


def wave_height(parameters: Parameters, x: Array, y: Array) -> Array:
    """Return the height of the waves of row 0, m."""
    height, length, heading, phase = (parameters[f"wave.{name}"][0] for name in ("height", "length", "heading", "phase"))
    way = x[..., None] * np.cos(heading) + y[..., None] * np.sin(heading)
    return (height * np.sin(2 * np.pi * way / length + phase)).sum(axis=-1)


def drawn_height(column: int, row: int, seed: int, share: float) -> float:
    """Return the height of a lattice point as a share of the highest, in whole numbers."""

    def permuted(k: int) -> int:
        return k**3 % 1019

    in_column = permuted(permuted(column) + seed % 1019)
    return max(permuted(permuted(in_column + permuted(row + seed // 1019)) + seed // 1019) / 1018 - (1 - share), 0.0) / share


def bump_height(parameters: Parameters, x: Array, y: Array) -> Array:
    """Return the height of the bumps of row 0, m: a sum of bells, one on every lattice point nearby."""
    spacing, share = float(parameters["bumps.spacing"][0]), float(parameters["bumps.share"][0])
    seed = int(parameters["bumps.seed"][0])
    total = np.zeros_like(x)
    for column in range(int(np.floor(x.min() / spacing)), int(np.floor(x.max() / spacing)) + 3):
        for row in range(int(np.floor(y.min() / spacing)), int(np.floor(y.max() / spacing)) + 3):
            bell = _bell(x / spacing - column + 0.5) * _bell(y / spacing - row + 0.5)
            total += drawn_height(column, row, seed, share) * bell
    return float(parameters["bumps.height"][0]) * total


def _bell(t: Array) -> Array:
    """The convolution of three unit boxes."""
    t = np.abs(t)
    return np.where(t < 0.5, 0.75 - t**2, np.where(t < 1.5, 0.5 * (1.5 - t) ** 2, 0.0))


def enter_grid(heights: Array) -> int:
    """Make a grid known whose surface goes through heights (rows, columns; the first row with the smallest y)."""
    return maps.enter_heights(maps.map_text(heights[::-1]))


def grid_height(parameters: Parameters, x: Array, y: Array) -> Array:
    """Return the height of the grid of row 0, m: a sum of bells on the middles of cells, the outermost ones repeated."""
    number, scale, cell, at_x, at_y, turn = (
        float(parameters[f"grid.{name}"][0]) for name in ("number", "scale", "cell", "x", "y", "heading")
    )
    weights = relief.map_of(number)
    rows, columns = weights.shape
    along, across = np.cos(turn) * (x - at_x) + np.sin(turn) * (y - at_y), np.cos(turn) * (y - at_y) - np.sin(turn) * (x - at_x)
    column, row = along / cell + (columns - 1) / 2, across / cell + (rows - 1) / 2
    total = np.zeros_like(x)
    for j in range(int(np.floor(column.min())) - 1, int(np.ceil(column.max())) + 2):
        for k in range(int(np.floor(row.min())) - 1, int(np.ceil(row.max())) + 2):
            total += weights[np.clip(k, 0, rows - 1), np.clip(j, 0, columns - 1)] * _bell(column - j) * _bell(row - k)
    return scale * total


def piece_distance(
    parameters: Parameters, row: int, piece: int, centre: Array, axle: Array, crown: float = relief.CROWN
) -> float:
    """Return the distance (m) of a wheel from a piece, negative inside: the largest over all upward normals in its plane."""

    def number(name: str) -> float:
        return float(parameters[f"piece.{name}"][row, piece])

    height, front, rear, edge = (number(name) for name in ("height", "front_slope", "rear_slope", "edge_radius"))
    near = height / np.tan(front) + edge * np.tan(front / 2)
    far = height / np.tan(front) + number("length") - edge * np.tan(rear / 2)
    along = np.array([np.cos(number("heading")), np.sin(number("heading"))])
    place = (centre[:2] - [number("x"), number("y")]) @ along

    def gap(angle: Array) -> Array:
        across, up = np.sin(angle), np.cos(angle)
        normal = np.stack([across * along[0], across * along[1], up], axis=1)
        solid = np.maximum(near * across, max(far, near) * across) + (height - edge) * up + edge
        return place * across + centre[2] * up - reach(-normal, axle, crown) - solid

    angle = np.append(np.linspace(-front, rear, 1001), 0.0)  # 0: straight up, where there is a corner
    best, step = angle[gap(angle).argmax()], (front + rear) / 1000
    around = np.append(np.linspace(max(best - step, -front), min(best + step, rear), 201), best)
    return float(gap(around).max())
