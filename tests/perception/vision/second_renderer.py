"""A second renderer, for films that the product's drawing code had no hand in: rings by direct ray casting, row by row.

Every pixel of every row is followed at the row's own time to the plate on the body, then to the floor. Its pose maths, its
camera and the radii of the rings are its own. No lens distortion, no legs, no wheels.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.vision.tracking import VideoFrame

WIDTH, HEIGHT, FOCAL, ABOVE = 640, 480, 520.0, 1.5
FLOOR_PLACES = ((0.65, 0.55), (0.65, -0.55), (-0.65, 0.55), (-0.65, -0.55))
BODY_PLACES = ((0.14, 0.10), (0.14, -0.10), (-0.14, 0.10), (-0.14, -0.10))
PLATE_ABOVE = 0.04
FLOOR_RINGS = ((0.06, 0.06 * 0.78, 0.06 * 0.25), *3 * ((0.06, 0.06 * 0.55, 0.06 * 0.22),))
BODY_RINGS = ((0.03, 0.03 * 0.76, 0.03 * 0.50), *3 * ((0.03, 0.03 * 0.667, 0.03 * 0.333),))


@dataclass(frozen=True)
class Lab:
    """What is not perfect: standard deviations of hand-laid markers (m), stretch of the print, shutter (s), camera (rad, m).

    ``shake`` is the amplitude of the camera's sway (m), ``drift`` its speed (m/s), both along the floor, what it looks at held.
    """

    floor_error: float = 0.0
    body_error: float = 0.0
    stretch: tuple[float, float] = (0.0, 0.0)
    readout: float = 0.0
    shake: float = 0.0
    drift: float = 0.0
    noise: float = 3.0
    blur: float = 0.7
    seed: int = 0


def lens(readout=None):
    return Camera(width=WIDTH, height=HEIGHT, focal=(FOCAL, FOCAL), centre=(319.5, 239.5), readout=readout)


def true_places(lab):
    """Where the markers really are: floor (4, 2) and body (4, 3), m."""
    rng = np.random.default_rng(lab.seed)
    floor = np.array(FLOOR_PLACES) + lab.floor_error * rng.standard_normal((4, 2))
    flat = np.array(BODY_PLACES) * (1 + np.array(lab.stretch)) + lab.body_error * rng.standard_normal((4, 2))
    return floor, np.column_stack([flat, np.full(4, PLATE_ABOVE)])


def frames(drive, lab, seconds=5.0, rate=30.0, offset=0.137, start=0.011):
    """Film a drive; the middle row shows a frame's time."""
    import cv2

    floor, body = true_places(lab)
    rng = np.random.default_rng(lab.seed + 1)
    rows = (np.arange(HEIGHT) / HEIGHT - 0.5) * lab.readout
    for index in range(int(seconds * rate)):
        times = start + index / rate + rows
        places, turns = _body(drive, times)
        seat = _sway(lab, times)
        image = np.empty((HEIGHT, WIDTH))
        _render(image, floor, body, np.array(FLOOR_RINGS), np.array(BODY_RINGS), places, turns, *seat)
        image = cv2.GaussianBlur(image, (0, 0), lab.blur) + lab.noise * rng.standard_normal(image.shape)
        yield VideoFrame(index, start + index / rate - offset, np.clip(np.rint(image), 0, 255).astype(np.uint8))


def _body(drive, times):
    """Position (T, 3) and rotation (T, 3, 3): linear between the truth's ticks."""
    place = np.clip(times / (drive.time[1] - drive.time[0]), 0, len(drive.time) - 2)
    k = place.astype(int)
    part = (place - k)[:, None]
    positions = (1 - part) * drive.position[k] + part * drive.position[k + 1]
    turns = (1 - part)[..., None] * drive.rotation[k] + part[..., None] * drive.rotation[k + 1]
    return positions, turns / np.linalg.norm(turns, axis=1, keepdims=True)


def _sway(lab, times):
    """Camera place (T, 3) and axes (T, 3, 3) rows x, y, z in the floor frame: above the middle, looking near it."""
    middle = np.array([0.06, 0.0, ABOVE])
    moved = np.outer(lab.drift * times + lab.shake * np.sin(2 * math.pi * 0.9 * times), [1.0, 0.6, 0.2])
    places = middle + moved
    forward = np.array([0.04, 0.0, 0.0]) - places
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return places, np.stack([right, np.cross(forward, right), forward], axis=1)


@njit(cache=True)
def _ink(x, y, places, rings, reach):
    """Brightness of a sheet at (x, y), and the distance to the nearest edge on it."""
    shade, near = 215.0, math.inf
    for m in range(places.shape[0]):
        r = math.hypot(x - places[m, 0], y - places[m, 1])
        if r > rings[m, 0] * reach:
            continue
        for ring in range(3):
            near = min(near, abs(r - rings[m, ring]))
        if rings[m, 1] < r < rings[m, 0] or r < rings[m, 2]:
            shade = 30.0
    return shade, near


@njit(cache=True)
def _ray(u, v, floor, body, floor_rings, body_rings, origin, to_body, seat, to_floor):
    """Brightness and distance to the nearest edge along the ray of a pixel."""
    x, y = (u - 319.5) / 520.0, (v - 239.5) / 520.0
    depth = (body[0, 2] - origin[2]) / (to_body[2, 0] * x + to_body[2, 1] * y + to_body[2, 2])
    px = origin[0] + depth * (to_body[0, 0] * x + to_body[0, 1] * y + to_body[0, 2])
    py = origin[1] + depth * (to_body[1, 0] * x + to_body[1, 1] * y + to_body[1, 2])
    edge = max(abs(px) - 0.2, abs(py) - 0.145)
    if edge < 0:
        shade, near = _ink(px, py, body, body_rings, 1.5)
        return shade, min(near, -edge)
    depth = -seat[2] / (to_floor[2, 0] * x + to_floor[2, 1] * y + to_floor[2, 2])
    fx = seat[0] + depth * (to_floor[0, 0] * x + to_floor[0, 1] * y + to_floor[0, 2])
    fy = seat[1] + depth * (to_floor[1, 0] * x + to_floor[1, 1] * y + to_floor[1, 2])
    shade, near = _ink(fx, fy, floor, floor_rings, 1.5)
    on_sheet = False
    for m in range(floor.shape[0]):
        out = max(abs(fx - floor[m, 0]), abs(fy - floor[m, 1])) - 0.095
        near = min(near, abs(out))
        on_sheet = on_sheet or out < 0
    return (shade if on_sheet else 125.0), min(near, edge)


@njit(cache=True)
def _render(image, floor, body, floor_rings, body_rings, places, turns, seats, axes):
    for v in range(image.shape[0]):
        turn, seat = np.ascontiguousarray(turns[v].T), seats[v]
        origin, to_floor = turn @ (seat - places[v]), np.ascontiguousarray(axes[v].T)
        to_body = turn @ to_floor
        for u in range(image.shape[1]):
            shade, near = _ray(u, v, floor, body, floor_rings, body_rings, origin, to_body, seat, to_floor)
            if near < 0.003:
                shade = 0.0
                for i in range(25):
                    du, dv = (i % 5 - 2) / 5, (i // 5 - 2) / 5
                    shade += _ray(u + du, v + dv, floor, body, floor_rings, body_rings, origin, to_body, seat, to_floor)[0] / 25
            image[v, u] = shade
