"""A second renderer, for films that the product's drawing code has no part in: rings by direct ray casting, row by row.

Every pixel of every row is followed at the row's own time to the plate on the body, then to the floor. Its pose maths, its
camera and the radii of the rings are its own. No lens distortion, no legs, no wheels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.vision.tracking import VideoFrame

Array = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 640, 480, 520.0
FLOOR_PLACES = ((0.65, 0.55), (0.65, -0.55), (-0.65, 0.55), (-0.65, -0.55))
BODY_PLACES = ((0.14, 0.10), (0.14, -0.10), (-0.14, 0.10), (-0.14, -0.10))
PLATE_ABOVE = 0.04
FLOOR_RINGS = ((0.06, 0.06 * 0.78, 0.06 * 0.25), *3 * ((0.06, 0.06 * 0.55, 0.06 * 0.22),))
BODY_RINGS = ((0.03, 0.03 * 0.76, 0.03 * 0.50), *3 * ((0.03, 0.03 * 0.667, 0.03 * 0.333),))
#: Hand-held: frequency (Hz), amplitude of the camera's place (m) and direction (rad) along each axis, at ``hand`` = 1.
_HAND = ((0.45, 0.006, 0.008), (1.3, 0.002, 0.003), (4.1, 0.0003, 0.0006))


class FilmedMotion(Protocol):
    """Where a body is, tick by tick: time (T,) s, position (T, 3) m, rotation (T, 3, 3)."""

    @property
    def time(self) -> Array: ...
    @property
    def position(self) -> Array: ...
    @property
    def rotation(self) -> Array: ...


@dataclass(frozen=True)
class Lab:
    """What is not perfect in a lab.

    Attributes:
        floor_error, body_error: m, standard deviation of hand-laid markers along each axis. stretch: of the body's print.
        readout: s, rolling shutter.
        shake, drift: amplitude (m) of a sway at 0.9 Hz and speed (m/s) of the camera along the floor, what it looks at held.
        hand: hand-held camera, 1 = a calm hand.
        noise: grey levels. blur: px, sigma. gradient: of brightness over the image's width. above: m, camera over the floor.
        uneven: s, standard deviation of the times between frames, which their stamps show.
        stamp_error: s, standard deviation of a stamp. dropped, doubled: share of the frames; a doubled one repeats the last.
        kick: time (s) from which on floor marker number 1 is displaced, and by how much (m); None = never.
        seed: of all of them.
    """

    floor_error: float = 0.0
    body_error: float = 0.0
    stretch: tuple[float, float] = (0.0, 0.0)
    readout: float = 0.0
    shake: float = 0.0
    drift: float = 0.0
    hand: float = 0.0
    noise: float = 3.0
    blur: float = 0.7
    gradient: float = 0.0
    above: float = 1.5
    uneven: float = 0.0
    stamp_error: float = 0.0
    dropped: float = 0.0
    doubled: float = 0.0
    kick: tuple[float, float] | None = None
    seed: int = 0


def lens(readout: float | None = None) -> Camera:
    """The renderer's camera."""
    return Camera(width=WIDTH, height=HEIGHT, focal=(FOCAL, FOCAL), centre=(319.5, 239.5), readout=readout)


def true_places(lab: Lab) -> tuple[Array, Array]:
    """Where the markers really are: floor (4, 2) and body (4, 3), m."""
    rng = np.random.default_rng(lab.seed)
    floor = np.array(FLOOR_PLACES) + lab.floor_error * rng.standard_normal((4, 2))
    flat = np.array(BODY_PLACES) * (1 + np.array(lab.stretch)) + lab.body_error * rng.standard_normal((4, 2))
    return floor, np.column_stack([flat, np.full(4, PLATE_ABOVE)])


def frames(
    motion: FilmedMotion, lab: Lab, seconds: float = 5.0, rate: float = 30.0, offset: float = 0.137, start: float = 0.011
) -> Iterator[VideoFrame]:
    """Film a drive; the middle row shows a frame's time. Servo time = the frame's time + ``offset``."""
    import cv2

    floor, body = true_places(lab)
    rng, clock = np.random.default_rng(lab.seed + 1), np.random.default_rng(lab.seed + 2)
    rows = (np.arange(HEIGHT) / HEIGHT - 0.5) * lab.readout
    light = 1 + lab.gradient * (np.arange(WIDTH) / WIDTH - 0.5)
    last, number = None, 0
    for index in range(int(seconds * rate)):
        moment = start + index / rate + lab.uneven * clock.uniform(-1.7, 1.7)
        stamp = moment - offset + lab.stamp_error * clock.standard_normal()
        dropped, doubled = clock.uniform(size=2) < (lab.dropped, lab.doubled)
        if dropped:
            continue
        if last is None or not doubled:
            times = moment + rows
            places, turns = _body(motion, times)
            laid = floor.copy()
            if lab.kick is not None and moment > lab.kick[0]:
                laid[1] += lab.kick[1]
            image = np.empty((HEIGHT, WIDTH))
            _render(image, laid, body, np.array(FLOOR_RINGS), np.array(BODY_RINGS), places, turns, *_seat(lab, times))
            image = cv2.GaussianBlur(image, (0, 0), lab.blur) * light + lab.noise * rng.standard_normal(image.shape)
            last = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        yield VideoFrame(number, stamp, last)
        number += 1


def _body(motion: FilmedMotion, times: Array) -> tuple[Array, Array]:
    """Position (T, 3) and rotation (T, 3, 3): linear between the truth's ticks."""
    place = np.clip(times / (motion.time[1] - motion.time[0]), 0, len(motion.time) - 2)
    k = place.astype(int)
    part = (place - k)[:, None]
    positions = (1 - part) * motion.position[k] + part * motion.position[k + 1]
    turns = (1 - part)[..., None] * motion.rotation[k] + part[..., None] * motion.rotation[k + 1]
    return positions, turns / np.linalg.norm(turns, axis=1, keepdims=True)


def _seat(lab: Lab, times: Array) -> tuple[Array, Array]:
    """Camera place (T, 3) and axes (T, 3, 3) rows x, y, z in the floor frame: above the middle, looking near it."""
    middle = np.array([0.06, 0.0, lab.above])
    moved = np.outer(lab.drift * times + lab.shake * np.sin(2 * math.pi * 0.9 * times), [1.0, 0.6, 0.2])
    shaken, tilted = _hand_held(lab, times)
    places = middle + moved + shaken
    forward = np.array([0.04, 0.0, 0.0]) - middle - moved
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    forward = forward + tilted[:, [0]] * (1.0, 0.0, 0.0) + tilted[:, [1]] * (0.0, 1.0, 0.0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    side = np.column_stack([np.sin(tilted[:, 2]), np.cos(tilted[:, 2]), np.zeros(len(times))])
    right = np.cross(forward, side)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return places, np.stack([right, np.cross(forward, right), forward], axis=1)


def _hand_held(lab: Lab, times: Array) -> tuple[Array, Array]:
    """Displacement (T, 3) m and tilts (T, 3) rad of a camera held in the hands."""
    phases = np.random.default_rng(lab.seed + 3).uniform(0, 2 * math.pi, (len(_HAND), 6))
    result = np.zeros((len(times), 6))
    for (frequency, shift, turn), phase in zip(_HAND, phases, strict=True):
        sizes = lab.hand * np.array([shift] * 3 + [turn] * 3)
        result += sizes * np.sin(2 * math.pi * frequency * times[:, None] * (1 + 0.03 * np.arange(6)) + phase)
    return result[:, :3], result[:, 3:]


@njit(cache=True, nogil=True)
def _ink(x: Any, y: Any, places: Any, rings: Any, reach: Any) -> Any:
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


@njit(cache=True, nogil=True)
def _ray(
    u: Any,
    v: Any,
    floor: Any,
    body: Any,
    floor_rings: Any,
    body_rings: Any,
    origin: Any,
    to_body: Any,
    seat: Any,
    to_floor: Any,
) -> Any:
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


@njit(cache=True, nogil=True)
def _render(
    image: Any, floor: Any, body: Any, floor_rings: Any, body_rings: Any, places: Any, turns: Any, seats: Any, axes: Any
) -> Any:
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
