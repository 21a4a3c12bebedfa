"""Frames of the moving robot and its markers, to scale, for tests, tutorials and the vision bench.

A ray caster: every sub-sample of a pixel is followed through the lens to flat facets (floor, marker plate, body, legs,
wheels), each sub-sample at its own instant of the exposure. Then lens blur, uneven light, a shadow's edge, noise. It shares no
code with the detector: of :mod:`wlr_gym.perception.markers` it takes only the data of cameras and targets.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.compiled import compiled
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.targets import CODES, Target
from wlr_gym.robot import CORNER_SIGNS, Robot

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Brightness, grey levels.
WHITE = 225.0
BLACK = 25.0
FLOOR = 130.0
DARK = 45.0
GREY = 80.0
PLATE = (0.40, 0.29)  # m; size of the sheet with the robot's markers
_SHEET = 1.6  # half the side of a sheet with a floor marker, in outer radii of the marker
#: Rays a side in every pixel; grey levels by which they may differ in a pixel without an edge.
_FEW, _FLAT = 3, 8.0
#: Facets as the kernels take them: geometry (instants, facets, 12), per facet its kind (9) and its box in the image (4),
#: circles, tags and the cells of all tags.
_Packed = tuple[Array, Array, NDArray[np.int64], Array, Array, NDArray[np.uint8]]


@dataclass(frozen=True)
class ScenePose:
    """A pose in a frame: position (3,) m and rotation (3, 3) to that frame; leg angles (4,) rad."""

    position: Array
    rotation: Array
    legs: Array = field(default_factory=lambda: np.full(4, math.pi / 2))


@dataclass(frozen=True)
class Look:
    """What light, lens and sensor do to a frame.

    Attributes:
        blur: px, 1 sigma of the lens's blur. noise: grey levels, 1 sigma. gain: brightness.
        gradient: share by which the light changes across the image, along x and y.
        shadow: share of the light lost to one side of a line through the image, 0 = none; shadow_line: (angle rad, offset px
            from the image's middle).
        gamma: exponent of the sensor's response.
    """

    blur: float = 0.8
    noise: float = 4.0
    gain: float = 1.0
    gradient: tuple[float, float] = (0.0, 0.0)
    shadow: float = 0.0
    shadow_line: tuple[float, float] = (0.6, 0.0)
    gamma: float = 1.0


@dataclass(frozen=True)
class Facet:
    """A flat piece: centre (3,), axes (2, 3) along its sides, half sizes (m), brightness; its markers in its own plane.

    ``circles`` is (M, 5): x, y, outer radius and the radii of white disc and dot, m. ``tags`` is a list of (x, y, side m,
    cells (n, n) of 0 and 1). ``texture`` is the share of uneven brightness.
    """

    centre: Array
    axes: Array
    half: tuple[float, float]
    shade: float
    disc: bool = False
    circles: Array = field(default_factory=lambda: np.zeros((0, 5)))
    tags: tuple[tuple[float, float, float, NDArray[np.uint8]], ...] = ()
    texture: float = 0.0

    def moved(self, position: Array, rotation: Array) -> Facet:
        """Return the facet in another frame."""
        return replace(self, centre=rotation @ self.centre + position, axes=self.axes @ rotation.T)


def look_at(eye: ArrayLike, target: ArrayLike, up: Sequence[float] = (1.0, 0.0, 0.0)) -> ScenePose:
    """Pose of the floor frame in the frame of a camera at ``eye`` that looks at ``target``, image up along ``up``."""
    forward = np.subtract(target, eye).astype(float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return ScenePose(-rotation @ np.asarray(eye, float), rotation)


def view(tilt: float, distance: float, target: Sequence[float] = (0.0, 0.0, 0.1), turn: float = 0.0) -> ScenePose:
    """Floor in the camera frame: ``distance`` m from ``target``, ``tilt`` rad from straight above, ``turn`` rad around."""
    away = np.array([-math.cos(turn) * math.sin(tilt), -math.sin(turn) * math.sin(tilt), math.cos(tilt)])
    return look_at(np.asarray(target) + distance * away, target, (math.cos(turn), math.sin(turn), 0.0))


def rotation_of(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (yaw, pitch, roll))
    turn = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return turn @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])


# --- facets ----------------------------------------------------------------------------------------------------------


def circles_of(target: Target) -> Array:
    """(M, 5) circles of a target in its own plane."""
    rows = [(*m.position[:2], m.radius, *(m.radius * share for share in CODES[m.code])) for m in target.markers]
    return np.array(rows, float)


def floor_facets(target: Target | None) -> list[Facet]:
    """The floor, and one sheet of paper per floor marker."""
    flat = np.eye(3)[:2]
    facets = [Facet(np.zeros(3), flat, (50.0, 50.0), FLOOR, texture=0.12)]
    for x, y, *radii in circles_of(target) if target else ():
        half = _SHEET * radii[0]
        facets.append(Facet(np.array([x, y, 1e-4]), flat, (half, half), WHITE, circles=np.array([[0.0, 0.0, *radii]])))
    return facets


def plate_facet(target: Target, tags: Sequence[tuple[float, float, float, NDArray[np.uint8]]] = ()) -> Facet:
    """The plate on top of the body, with ring markers, or with ``tags`` in their place."""
    circles = circles_of(target) if not tags else np.zeros((0, 5))
    half = (PLATE[0] / 2, PLATE[1] / 2)
    return Facet(np.array([0, 0, target.positions[0, 2]]), np.eye(3)[:2], half, WHITE, circles=circles, tags=tuple(tags))


def robot_facets(robot: Robot, legs: Array) -> list[Facet]:
    """Body, legs and wheels in the body frame."""
    x, y, z = np.eye(3)
    length, width, height = (half / 2 for half in robot.body.size)
    facets = [Facet(height * z, np.stack([x, y]), (length, width), DARK)]
    facets += [Facet(s * width * y, np.stack([x, z]), (length, height), DARK) for s in (-1, 1)]
    facets += [Facet(s * length * x, np.stack([y, z]), (width, height), DARK) for s in (-1, 1)]
    for (sx, sy), angle in zip(CORNER_SIGNS, legs, strict=True):
        along = np.array([math.cos(angle), 0, -math.sin(angle)])
        hip = np.array([sx * robot.hip_position.x, sy * (robot.hip_position.y + 0.02), robot.hip_position.z])
        axle = hip + robot.leg.length * along
        facets.append(Facet(hip + robot.leg.length / 2 * along, np.stack([along, y]), (robot.leg.length / 2, 0.012), GREY))
        facets.append(Facet(hip + robot.leg.length / 2 * along + 0.012 * sy * y, np.stack([along, np.cross(y, along)]),
                             (robot.leg.length / 2, 0.012), GREY))  # fmt: skip
        radius, half = robot.wheel.radius, robot.wheel.width / 2
        facets.append(Facet(axle, np.stack([x, y]), (radius, half), BLACK))
        facets += [Facet(axle + s * half * y, np.stack([x, z]), (radius, radius), BLACK, disc=True) for s in (-1, 1)]
    return facets


# --- frames -----------------------------------------------------------------------------------------------------------


class Renderer:
    """Frames of one camera that stands still over a still floor.

    Args:
        camera: intrinsics. floor_in_camera: where the floor frame is. still: facets in the floor frame that never move.
        samples: rays a side, per pixel with an edge.
    """

    def __init__(self, camera: Camera, floor_in_camera: ScenePose, still: Sequence[Facet], samples: int = 12) -> None:
        self.camera, self.floor_in_camera, self.still, self.samples = camera, floor_in_camera, tuple(still), samples
        self._rays = _rays(camera)
        self._background = np.zeros((camera.height, camera.width), np.float32)
        if self.still:
            whole = np.array([0, 0, camera.width, camera.height])
            _cast(self._rays, self._pack([self.still]), whole, samples, 0, self._background)

    def frame(self, moving: Sequence[Sequence[Facet]], look: Look, seed: int) -> Image:
        """Render one frame.

        Args:
            moving: facets in the floor frame at instants spread evenly over the exposure (one list each, same facets).
            look: light, blur, noise. seed: of the noise.
        """
        image = self._background.copy()
        if moving and moving[0]:
            packed = self._pack([[*self.still, *instant] for instant in moving])
            box = self._box([p for instant in moving for p in instant])
            _cast(self._rays, packed, box, self.samples, len(self.still), image)
        return develop(image, look, seed)

    def _pack(self, instants: Sequence[Sequence[Facet]]) -> _Packed:
        turn, shift = self.floor_in_camera.rotation, self.floor_in_camera.position
        seen = [[facet.moved(shift, turn) for facet in instant] for instant in instants]
        geometry = np.array([[np.concatenate([p.centre, p.axes.ravel(), np.cross(*p.axes)]) for p in i] for i in seen])
        circles, tags, cells, kinds, offset = [], [], [], [], 0
        for facet in seen[0]:
            first = len(circles), len(tags)
            circles += list(facet.circles)
            for x, y, side, bits in facet.tags:
                tags.append((x, y, side, len(bits), offset))
                cells.append(np.asarray(bits, np.uint8).ravel())
                offset += bits.size
            kinds.append((*facet.half, facet.shade, facet.disc, first[0], len(circles), first[1], len(tags), facet.texture))
        boxes = np.array([self._box(same) for same in zip(*instants, strict=True)])
        rings, signs = (np.array(rows, float).reshape(-1, 5) for rows in (circles, tags))
        return geometry, np.array(kinds, float), boxes, rings, signs, np.concatenate([np.zeros(0, np.uint8), *cells])

    def _box(self, facets: Sequence[Facet]) -> NDArray[np.int64]:
        """Pixels (x0, y0, x1, y1) that show the facets, with a margin."""
        signs = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
        corners = np.concatenate([facet.centre + signs * facet.half @ facet.axes for facet in facets])
        points = corners @ self.floor_in_camera.rotation.T + self.floor_in_camera.position
        limit = [self.camera.width, self.camera.height]
        if (points[:, 2] < 0.05).any() or np.abs(points).max() > 20:
            return np.array([0, 0, *limit])
        pixels = project(self.camera, points)
        low, high = np.floor(pixels.min(axis=0)) - 3, np.ceil(pixels.max(axis=0)) + 4
        return np.concatenate([low.clip(0, limit), high.clip(0, limit)]).astype(np.int64)


def project(camera: Camera, points: Array) -> Array:
    """Pixels (N, 2) of points (N, 3) in the camera frame."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    dx, dy = _bend(camera, x, y)
    return np.stack([camera.focal[0] * dx + camera.centre[0], camera.focal[1] * dy + camera.centre[1]], axis=1)


def _bend(camera: Camera, x: Any, y: Any) -> tuple[Any, Any]:
    k1, k2, p1, p2, k3 = camera.distortion
    square = x**2 + y**2
    radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
    return x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2), y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y


def _rays(camera: Camera) -> Array:
    """Directions (H + 1, W + 1, 2) through the corners of all pixels; NaN where the lens shows nothing."""
    u, v = np.meshgrid(np.arange(camera.width + 1) - 0.5, np.arange(camera.height + 1) - 0.5)
    goal = (u - camera.centre[0]) / camera.focal[0], (v - camera.centre[1]) / camera.focal[1]
    x, y = goal[0].copy(), goal[1].copy()
    small = 1e-6
    for _ in range(20):
        ex, ey = (found - wanted for found, wanted in zip(_bend(camera, x, y), goal, strict=True))
        if max(np.abs(ex).max(), np.abs(ey).max()) < 1e-11:
            break
        (ax, ay), (bx, by) = _bend(camera, x + small, y), _bend(camera, x, y + small)
        a, c, b, d = ax - ex - goal[0], ay - ey - goal[1], bx - ex - goal[0], by - ey - goal[1]
        determinant = a * d - b * c
        x, y = x - small * (d * ex - b * ey) / determinant, y - small * (a * ey - c * ex) / determinant
    return np.stack([x, y], axis=-1).astype(np.float64)


def develop(light: NDArray[np.float32], look: Look, seed: int) -> Image:
    """What the sensor makes of the light: gradient, shadow, gain, blur, noise, gamma, whole grey levels."""
    import cv2

    height, width = light.shape
    x, y = np.linspace(-0.5, 0.5, width, dtype=np.float32), np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]
    image = light
    if look.gain != 1.0 or any(look.gradient):
        image = image * np.float32(look.gain) * (1 + look.gradient[0] * x + look.gradient[1] * y)
    if look.shadow:
        angle, offset = look.shadow_line
        side = math.cos(angle) * x * width + math.sin(angle) * y * height - offset
        image = image * (1 - look.shadow / (1 + np.exp(-np.clip(side / 2, -30, 30))))
    if look.blur > 0:
        image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), look.blur, borderType=cv2.BORDER_REPLICATE)
    if look.gamma != 1.0:
        image = 255 * (np.clip(image, 0, 255) / 255) ** look.gamma
    if look.noise > 0:
        noise = np.random.default_rng(seed).standard_normal(image.shape, dtype=np.float32)
        image = image + np.float32(look.noise) * noise
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@compiled
def _uneven(x: float, y: float) -> float:
    """Smooth noise in [-1, 1] with a grain of 6 cm."""
    x, y = x / 0.06, y / 0.06
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    total = 0.0
    for s in range(2):
        for t in range(2):
            value = math.sin((i + s) * 127.1 + (j + t) * 311.7) * 43758.5453
            weight = (a if s else 1 - a) * (b if t else 1 - b)
            total += weight * (2 * (value - math.floor(value)) - 1)
    return total


@compiled
def _shade(packed: Any, facet: int, x: float, y: float) -> float:
    _, kinds, _, circles, tags, cells = packed
    kind = kinds[facet]
    shade = kind[2]
    if kind[8] > 0.0:
        shade *= 1.0 + kind[8] * _uneven(x, y)
    for i in range(int(kind[4]), int(kind[5])):
        distance = math.hypot(x - circles[i, 0], y - circles[i, 1])
        if distance < circles[i, 2]:
            return WHITE if circles[i, 4] < distance < circles[i, 3] else BLACK
    for i in range(int(kind[6]), int(kind[7])):
        count = int(tags[i, 3])
        column = math.floor((x - tags[i, 0]) / tags[i, 2] * count + 0.5 * count)
        row = math.floor((tags[i, 1] - y) / tags[i, 2] * count + 0.5 * count)
        if 0 <= row < count and 0 <= column < count:
            return WHITE if cells[int(tags[i, 4]) + row * count + column] else BLACK
    return shade


@compiled
def _cast(rays: Any, packed: Any, box: Any, samples: int, first: int, image: Any) -> None:
    """Render the pixels of ``box`` that may show facet ``first`` or a later one.

    A few rays per pixel first; where they differ there is an edge, and samples x samples rays say where.
    """
    geometry, boxes = packed[0], packed[2]
    facets = geometry.shape[1]
    near, corners = np.empty(facets, np.int64), np.empty((4, 2))
    for v in range(box[1], box[3]):
        for u in range(box[0], box[2]):
            count = 0
            for p in range(facets):
                if boxes[p, 0] <= u < boxes[p, 2] and boxes[p, 1] <= v < boxes[p, 3]:
                    near[count] = p
                    count += 1
            if count == 0 or near[count - 1] < first:
                continue
            corners[0], corners[1] = rays[v, u], rays[v, u + 1]
            corners[2], corners[3] = rays[v + 1, u], rays[v + 1, u + 1]
            mean, spread = _pixel(corners, packed, near[:count], _FEW, u + 2 * v)
            if spread > _FLAT:
                mean, _ = _pixel(corners, packed, near[:count], samples, u + 2 * v)
            image[v, u] = mean


@compiled
def _pixel(corners: Any, packed: Any, near: Any, samples: int, turn: int) -> tuple[float, float]:
    """Mean and range of the brightness over a pixel; its rays take turns through the instants of the exposure."""
    geometry, kinds = packed[0], packed[1]
    instants = geometry.shape[0]
    total, darkest, brightest = 0.0, math.inf, -math.inf
    for s in range(samples):
        for r in range(samples):
            a, b = (r + 0.5) / samples, (s + 0.5) / samples
            x = (1 - b) * ((1 - a) * corners[0, 0] + a * corners[1, 0]) + b * ((1 - a) * corners[2, 0] + a * corners[3, 0])
            y = (1 - b) * ((1 - a) * corners[0, 1] + a * corners[1, 1]) + b * ((1 - a) * corners[2, 1] + a * corners[3, 1])
            instant = (3 * s + 2 * r + s * r + turn) % instants
            nearest, shade = math.inf, 0.0
            hit, hx, hy = -1, 0.0, 0.0
            for p in near:
                g = geometry[instant, p]
                along = g[9] * x + g[10] * y + g[11]
                if along == 0.0:
                    continue
                depth = (g[9] * g[0] + g[10] * g[1] + g[11] * g[2]) / along
                if not 0.0 < depth < nearest:
                    continue
                dx, dy, dz = depth * x - g[0], depth * y - g[1], depth - g[2]
                px, py = g[3] * dx + g[4] * dy + g[5] * dz, g[6] * dx + g[7] * dy + g[8] * dz
                if kinds[p, 3] > 0.0:  # a disc
                    inside = px * px + py * py < kinds[p, 0] * kinds[p, 0]
                else:
                    inside = abs(px) < kinds[p, 0] and abs(py) < kinds[p, 1]
                if inside:
                    nearest, hit, hx, hy = depth, p, px, py
            if hit >= 0:
                shade = _shade(packed, hit, hx, hy)
            total += shade
            darkest, brightest = min(darkest, shade), max(brightest, shade)
    return total / (samples * samples), brightest - darkest
