"""How well the camera measures: accuracy, recall, false poses, speed, and slip over whole filmed drives, all rendered.

Ours stands beside printed square tags (OpenCV's ArUco detector, sub-pixel corners) and the paper's own method, in the same
scenes. Poses are drawn from a seed, so every number repeats.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.bench.measure import Size
from studies.bench.paper_method import paper_pose
from studies.bench.vision_clutter import clutter
from studies.bench.vision_drives import FilmedDrive, film, paper_test, skid_turn, true_slip
from studies.bench.vision_scenes import CAMERA, HOME_HEIGHT, LENS, STRONG_LENSES, pose_error, random_pose, shown_robot
from studies.bench.vision_tags import tag_kinds, tag_poses
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import detect, refine
from wlr_gym.perception.markers.pose import circle_centres, find_target
from wlr_gym.perception.markers.targets import load_target, ring_radii
from wlr_gym.perception.scene import (
    Facet,
    Look,
    Renderer,
    ScenePose,
    floor_facets,
    plate_facet,
    project,
    rotation_of,
    view,
)
from wlr_gym.perception.vision.analysis import analyse
from wlr_gym.perception.vision.tracking import Tracker, VideoFrame, locate_floor
from wlr_gym.robot import load_robot

Array = NDArray[np.float64]

#: s between the film's clock and the log's.
TRUE_OFFSET = 0.137


@dataclass(frozen=True)
class VisionResult:
    """One line of the report.

    Attributes:
        what: in words. method: whose. value: found, in ``unit``. bar: of the project, None = for information.
        least: the bar is a lower one. count: of samples behind the value.
    """

    what: str
    method: str
    value: float
    unit: str
    bar: float | None = None
    least: bool = False
    count: int = 0

    @property
    def met(self) -> bool | None:
        """Whether the bar is met; None without one."""
        if self.bar is None:
            return None
        return self.value >= self.bar if self.least else self.value <= self.bar

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON types."""
        return {**vars(self), "met": self.met}


def measure_vision(size: Size) -> list[VisionResult]:
    """Measure everything."""
    import cv2

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        parts: Sequence[Callable[[Size], list[VisionResult]]] = (
            measure_centres, measure_poses, measure_recall, measure_false_poses, measure_rate, measure_drives,
        )  # fmt: skip
        results: list[VisionResult] = []
        for done, part in enumerate(parts):
            size.tell(done / len(parts))
            results += part(size)
        return results
    finally:
        cv2.setNumThreads(threads)


# --- centres ----------------------------------------------------------------------------------------------------------


def measure_centres(size: Size) -> list[VisionResult]:
    """Error of a single marker's centre, given its tilt: rms over both axes together, px."""
    count = size(200, 6)
    strong = [CAMERA.model_copy(update={"distortion": lens}) for lens in STRONG_LENSES]
    calm, blurred = Look(blur=0.8, noise=4.0), Look(blur=3.0, noise=4.0)
    cases = (
        ("centre, r 16 px, tilt 0-45 deg, noise 4", [CAMERA], calm, 0.05),
        ("centre, r 16 px, tilt 0-45 deg, blur sigma 3", [CAMERA], blurred, 0.20),
        ("centre, r 16 px, lens k1 = -0.3 and 0.3, calibrated", strong, calm, 0.08),
    )
    results = []
    for what, cameras, look, bar in cases:
        errors = np.array([_centre_error(cameras[k % len(cameras)], look, k) for k in range(count)])
        found = errors[np.isfinite(errors)]
        results.append(VisionResult(what, "ours", float(np.sqrt(np.mean(found**2))), "px", bar, count=len(found)))
    return results


def _centre_error(camera: Camera, look: Look, seed: int) -> float:
    """Distance (px) of the rings' common centre from where the pose puts it; NaN when the marker is not found."""
    rng = np.random.default_rng(seed)
    code = seed % 2  # the two codes on the robot
    tilt, radius = rng.uniform(0, math.pi / 4), 0.03
    distance = camera.focal[0] * radius / rng.uniform(16, 18)
    spread = 0.45 if any(camera.distortion) else 0.1
    direction = rng.uniform(-spread, spread, 2)
    centre = distance * np.array([*direction, 1.0])
    turn = rotation_of(rng.uniform(-math.pi, math.pi)) @ rotation_of(0, tilt) @ rotation_of(rng.uniform(-math.pi, math.pi))
    rotation = turn @ np.diag([1.0, -1.0, -1.0])
    radii = np.array(ring_radii(code))
    circles = np.array([[0.0, 0.0, *(radius * radii)]])
    facet = Facet(np.zeros(3), np.eye(3)[:2], (0.05, 0.05), 225.0, circles=circles).moved(centre, rotation)
    crop, corner = _crop(camera, project(camera, centre[None])[0])
    image = Renderer(crop, ScenePose(np.zeros(3), np.eye(3)), []).frame([[facet]], look, seed)
    middle = project(camera, centre[None])[0] - corner + rng.uniform(-1, 1, 2)
    edge = project(camera, centre + radius * rotation[:, :2].T) - project(camera, centre[None])
    found = refine(image, crop.values, np.array([*middle, edge[0, 0], edge[1, 0], edge[0, 1], edge[1, 1]]), code)
    if found is None:
        return math.nan
    expected = np.empty((3, 2))
    circle_centres(np.zeros((3, 3)), radius * radii, rotation, centre, expected)
    used = np.isfinite(found.centres[:, 0])
    weights = 1 / np.trace(found.covariances[used], axis1=1, axis2=2)
    error = np.average((found.centres - expected)[used], axis=0, weights=weights)
    return float(np.hypot(*error) * camera.focal[0])


def _crop(camera: Camera, middle: Array) -> tuple[Camera, Array]:
    """A camera that sees only the pixels around ``middle``, and its upper left corner."""
    half = 60
    corner = np.round(middle) - half
    centre = (camera.centre[0] - corner[0], camera.centre[1] - corner[1])
    return camera.model_copy(update={"width": 2 * half, "height": 2 * half, "centre": centre}), corner


# --- poses ------------------------------------------------------------------------------------------------------------


def measure_poses(size: Size) -> list[VisionResult]:
    """Error of the body's pose in the floor frame from 2 m: ours, square tags, the paper's method."""
    results = []
    for name, tilt, bars in (("overhead", 0.0, (0.1, 0.01)), ("45 deg", math.pi / 4, (0.3, 0.02))):
        rings, paper = _ring_poses(tilt, size(60, 3))
        label = f"{name} at 2 m"
        results += _pose_lines(label, "ours", rings, bars)
        for legs, errors in paper.items():
            results += _pose_lines(f"{label}{legs}", "paper's method", errors, None)
        for dictionary in tag_kinds():
            errors, seen = tag_poses(tilt, size(30, 2), dictionary)
            results += _pose_lines(label, f"tags {dictionary} ({seen})", errors, None)
    return results


def _pose_lines(label: str, method: str, errors: Array, bars: tuple[float, float] | None) -> list[VisionResult]:
    """Lines for xy (mm, rms of the distance) and yaw (deg, rms); ``errors`` is (F, 3) in m and rad."""
    if not len(errors):
        return [VisionResult(f"body xy, {label}", method, math.nan, "mm")]
    xy = 1e3 * float(np.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))))
    yaw = math.degrees(float(np.sqrt(np.mean(errors[:, 2] ** 2))))
    first, second = bars or (None, None)
    count = len(errors)
    return [VisionResult(f"body xy, {label}", method, xy, "mm", first, count=count),
            VisionResult(f"body yaw, {label}", method, yaw, "deg", second, count=count)]  # fmt: skip


def _ring_poses(tilt: float, count: int) -> tuple[Array, dict[str, Array]]:
    """Errors (F, 3) of our poses, and of the paper's method with legs at home and with legs that moved."""
    body, floor, robot = load_target("body"), load_target("floor"), load_robot()
    camera = CAMERA.model_copy(update={"distortion": LENS})
    straight = view(tilt, 2.0)
    renderer = Renderer(camera, straight, floor_facets(floor))
    empty = [VideoFrame(k, k / 30, renderer.frame([], Look(), 900 + k)) for k in range(10)]
    floor_pose, homes = locate_floor(empty, camera, floor)
    plate, ours = plate_facet(body), []
    paper: dict[str, list[Array]] = {", legs at home": [], ", legs moved": []}
    rng = np.random.default_rng(11)
    for k in range(count):
        for home in (True, False):
            pose = random_pose(rng, HOME_HEIGHT if home else None)
            image = renderer.frame([shown_robot(robot, plate, pose)], Look(), k)
            sample = Tracker(camera, body, floor, floor_pose, homes)(VideoFrame(k, 0.0, image))
            ours.append(pose_error(sample.pose[[0, 1, 3]], pose))
            near = project(camera, (body.positions @ pose.rotation.T + pose.position) @ straight.rotation.T + straight.position)
            height = HOME_HEIGHT + float(body.positions[0, 2])
            found = paper_pose(image, camera, body, straight.rotation, straight.position, height, near)
            if found is not None:
                # the method knows nothing of the height of the markers over the body's origin; held against the plate's middle
                plate_middle = pose.position + pose.rotation[:, 2] * body.positions[0, 2]
                error = pose_error(found, ScenePose(plate_middle, pose.rotation))
                paper[", legs at home" if home else ", legs moved"].append(error)
    lost = sum(not np.isfinite(error).all() for error in ours)
    if lost:
        raise RuntimeError(f"{lost} of {len(ours)} poses were not found at tilt {tilt:g} rad")
    return np.array(ours), {name: np.array(errors) for name, errors in paper.items()}


# --- recall, false poses, rate ----------------------------------------------------------------------------------------


def measure_recall(size: Size) -> list[VisionResult]:
    """Share of markers found in whole images, at 12 to 16 px (the long axis), tilt up to 45 degrees, noise up to 10."""
    body, robot = load_target("body"), load_robot()
    rng, found, shown = np.random.default_rng(5), 0, 0
    for k in range(size(150, 3)):
        distance = CAMERA.focal[0] * body.radii[0] / rng.uniform(12.3, 16)
        renderer = Renderer(CAMERA, view(rng.uniform(0, math.pi / 4), distance, turn=rng.uniform(-3, 3)), floor_facets(None))
        pose = ScenePose(np.array([*rng.uniform(-0.2, 0.2, 2), 0.06]), rotation_of(rng.uniform(-math.pi, math.pi)))
        look = Look(blur=rng.uniform(0.5, 1.2), noise=rng.uniform(0, 10), gain=rng.uniform(0.5, 1.1),
                    gradient=(rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4)))  # fmt: skip
        detections = detect(renderer.frame([shown_robot(robot, plate_facet(body), pose)], look, k), CAMERA)
        eye = renderer.floor_in_camera
        places = project(CAMERA, (body.positions @ pose.rotation.T + pose.position) @ eye.rotation.T + eye.position)
        for place, code in zip(places, body.codes, strict=True):
            if np.all((place > 25) & (place < [CAMERA.width - 25, CAMERA.height - 25])):
                shown += 1
                found += any(d.code == code and np.hypot(*(d.ellipse[:2] - place)) < 1.0 for d in detections)
    what = "recall, r >= 12 px, tilt <= 45 deg, noise <= 10"
    return [VisionResult(what, "ours", 100 * found / shown, "%", 99.0, least=True, count=shown)]


def measure_false_poses(size: Size) -> list[VisionResult]:
    """Poses found in cluttered frames without markers; should be none."""
    body, floor = load_target("body"), load_target("floor")
    poses = markers = 0
    count = size(1000, 5)
    for k in range(count):
        detections = detect(clutter(k, CAMERA), CAMERA)
        markers += len(detections)
        poses += sum(find_target(detections, target, CAMERA) is not None for target in (body, floor))
    return [
        VisionResult(f"false poses in {count} cluttered frames", "ours", poses, "", 0, count=count),
        VisionResult(f"single false markers in {count} cluttered frames", "ours", markers, "", count=count),
    ]


def measure_rate(size: Size) -> list[VisionResult]:
    """Frames per second of the tracker on one core, once it has found the robot, 1280 x 720, images in memory."""
    body, floor, robot = load_target("body"), load_target("floor"), load_robot()
    renderer = Renderer(CAMERA, view(0.2, 2.0), floor_facets(floor))
    frames = []
    for k in range(size(60, 8)):
        moment = k / 30
        pose = ScenePose(np.array([-0.3 + 0.15 * moment, 0.02 * math.sin(moment), HOME_HEIGHT]), rotation_of(0.4 * moment))
        frames.append(VideoFrame(k, moment, renderer.frame([shown_robot(robot, plate_facet(body), pose)], Look(), k)))
    floor_pose = locate_floor(frames[:5], CAMERA, floor)
    rates = []
    for _ in range(size.rounds):
        tracker = Tracker(CAMERA, body, floor, *floor_pose)
        for frame in frames[:2]:
            tracker(frame)
        start = time.perf_counter()
        for frame in frames[2:]:
            tracker(frame)
        rates.append((len(frames) - 2) / (time.perf_counter() - start))
    what = "tracked frames per second, 1280 x 720, one core"
    return [VisionResult(what, "ours", float(np.median(rates)), "1/s", 60, least=True, count=len(rates) * (len(frames) - 2))]


# --- whole drives -----------------------------------------------------------------------------------------------------


def measure_drives(size: Size) -> list[VisionResult]:
    """Film drives with known slip (30 Hz, 5 ms exposure) and measure it, clocks apart by an unknown offset."""
    robot = load_robot()
    makers = (lambda: paper_test(1, robot), lambda: paper_test(2, robot), lambda: skid_turn(robot))
    return [line for make in makers[size(0, 2) :] for line in measure_drive(make())]


def measure_drive(drive: FilmedDrive) -> list[VisionResult]:
    """Lines for one filmed drive: worst error of the accumulated slip of any wheel at any time, and the clocks' offset."""
    body, floor = load_target("body"), load_target("floor")
    camera = CAMERA.model_copy(update={"distortion": LENS})
    renderer = Renderer(camera, view(0.0, 2.0), floor_facets(floor))
    shots = film(drive, renderer, body, Look(), TRUE_OFFSET)
    analysis = analyse(shots, drive.run, camera, body, floor, drive.robot)
    samples, slip, found = analysis.samples, analysis.slip, analysis.alignment
    assert found is not None  # no offset was given
    error = 1e3 * np.abs(slip.slip - true_slip(drive, slip.time))
    largest = 1e3 * np.abs(drive.slip[-1]).max(axis=0)
    lines: list[VisionResult] = []
    for axis, name in enumerate(("longitudinal", "lateral")):
        what = f"{drive.name}: accumulated {name} slip (up to {largest[axis]:.0f} mm)"
        for when, apart in (("worst wheel and time", error[:, :, axis]), ("worst wheel, end", error[-1, :, axis])):
            lines.append(VisionResult(f"{what}, {when}", "ours", float(apart.max()), "mm", 1.0, count=len(samples)))
    late, what = 1e3 * abs(found.offset - TRUE_OFFSET), f"{drive.name}: clock offset (± {1e3 * found.std:.1f})"
    return [*lines, VisionResult(what, "ours", late, "ms", 2.0, count=len(samples))]
