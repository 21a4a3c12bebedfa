"""How long a shutter takes from the first row to the last, from a board that moves while it is filmed.

A row v of a frame at time t shows the board where it is at t + readout (v / height - 1/2). With the board's motion known from
the frames before and after, what the corners miss of a pose that all rows share is linear in the readout.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera

Array = NDArray[np.float64]

#: s, 1 sigma up to which a readout counts as known; from where on a shutter is not global, and by so many sigmas.
LARGEST_STD, LEAST_READOUT, SURE = 0.00025, 0.001, 4.0
LONGEST = 0.1  # s; longer ones are not readouts
#: Share of the image's width that corners may move by from the frame before to the frame after; more is another board.
_LARGEST_MOTION = 0.5
_FEWEST_VIEWS = 3
_SINGULAR = 1e12
_LENS = 8  # focal lengths, centre, k1, k2, p1, p2


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board in one frame: time s, places (N, 3) m on the board, pixels (N, 2)."""

    name: str
    time: float
    places: Array
    pixels: Array


@dataclass(frozen=True)
class Readout:
    """s from the first row to the last, and 1 sigma; infinite where no view tells."""

    value: float = 0.0
    std: float = math.inf

    @property
    def known(self) -> float | None:
        """The readout to write into a camera file, 0 = a global shutter; None = these views do not tell."""
        if not (self.std <= LARGEST_STD and abs(self.value) < LONGEST):
            return None
        return self.value if abs(self.value) > max(LEAST_READOUT, SURE * self.std) else 0.0


def board_motion(before: BoardView, view: BoardView, after: BoardView, camera: Camera) -> Array | None:
    """Velocity (N, 2) px/s of a view's corners, from the views before and after; None where they do not belong together."""
    step = after.time - before.time
    poses = [_board_pose(v, camera) for v in (before, view, after)]
    if step <= 0 or any(pose is None for pose in poses):
        return None
    first, middle, last = (pose for pose in poses if pose is not None)
    first[:3], last[:3] = _nearest_turn(first[:3], middle[:3]), _nearest_turn(last[:3], middle[:3])
    velocity: Array = (_slopes(view, middle, camera)[1][:, :6] @ ((last - first) / step)).reshape(-1, 2)
    return velocity if np.abs(velocity).max() * step < _LARGEST_MOTION * camera.width else None


def readout_of(views: Sequence[tuple[BoardView, Array]], camera: Camera) -> Readout:
    """Readout that explains best what the corners miss; its sigma from what every view does to it (jackknife).

    Args:
        views: with the velocities (N, 2) px/s of their corners. camera: its lens.
    """
    if len(views) < _FEWEST_VIEWS:
        return Readout()
    columns = [_without_pose(view, velocity, camera) for view, velocity in views]
    sizes = np.linalg.norm(np.concatenate(columns), axis=0)
    scaled = [part / np.maximum(sizes, 1e-12) for part in columns]
    products = np.stack([part.T @ part for part in scaled])  # a lens can look like a shutter: both are solved for
    total = products.sum(axis=0)
    if np.linalg.cond(total[1:, 1:]) > _SINGULAR:
        return Readout()
    values = [_solved(total), *(_solved(total - product) for product in products)]
    value, *without = np.array(values) * sizes[0] / sizes[1]
    count = len(without)
    return Readout(float(value), math.sqrt((count - 1) ** 2 / count) * float(np.std(without)))


def _solved(products: Array) -> float:
    return float(np.linalg.solve(products[1:, 1:], products[1:, 0])[0])


def at_frame_time(view: BoardView, velocity: Array, camera: Camera, readout: float) -> BoardView:
    """The view as a shutter that is open for all rows at the frame's time would show it."""
    return replace(view, pixels=view.pixels - readout * _rows(view, camera) * velocity)


def _rows(view: BoardView, camera: Camera) -> Array:
    return view.pixels[:, [1]] / camera.height - 0.5


def _without_pose(view: BoardView, velocity: Array, camera: Camera) -> Array:
    """(2 N, 2 + L) px: what the corners miss, and their derivatives by readout and lens, less what a pose can explain."""
    pose = _board_pose(view, camera)
    if pose is None:
        return np.zeros((0, 2 + _LENS))
    predicted, slopes = _slopes(view, pose, camera)
    basis = np.linalg.qr(slopes[:, :6])[0]
    columns = np.column_stack([(view.pixels - predicted).ravel(), (_rows(view, camera) * velocity).ravel(), slopes[:, 6:]])
    return columns - basis @ (basis.T @ columns)


def _board_pose(view: BoardView, camera: Camera) -> Array | None:
    """(6,) rotation vector (rad) and position (m) of the board in the camera frame."""
    import cv2

    solved, turn, place = cv2.solvePnP(view.places, view.pixels, camera.matrix, np.array(camera.distortion))
    return np.concatenate([turn.ravel(), place.ravel()]).astype(np.float64) if solved else None


def _slopes(view: BoardView, pose: Array, camera: Camera) -> tuple[Array, Array]:
    """Pixels (N, 2) of the corners at a pose, and their derivatives (2 N, 6 + L) by it and by the lens without k3."""
    import cv2

    found = cv2.projectPoints(view.places, pose[:3], pose[3:], camera.matrix, np.array(camera.distortion))
    return np.asarray(found[0], np.float64).reshape(-1, 2), np.asarray(found[1], np.float64)[:, : 6 + _LENS]


def _nearest_turn(turn: Array, other: Array) -> Array:
    """The rotation vector of the same turn that is nearest to another one."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-9:
        return turn
    turns = [turn * (1 + 2 * math.pi * k / angle) for k in (-1, 0, 1)]
    return min(turns, key=lambda found: float(np.linalg.norm(found - other)))
