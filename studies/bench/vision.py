"""How well the camera measures: accuracy, recall, false poses, speed, and slip over whole filmed drives, all rendered.

Ours stands beside printed square tags (OpenCV's ArUco detector, AprilTag 3) and the paper's own method, in the same scenes.
Poses are drawn from a seed, so every number repeats. The engine drives the robots of the films.
"""

from __future__ import annotations

import atexit
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from studies.bench.measure import Size
from wlr_gym.data.format import COMMANDS, Profile, RunMeta
from wlr_gym.data.replay import profile_parameters
from wlr_gym.data.runs import Run
from wlr_gym.data.sensors import SENSED, channels
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Image, detect, refine
from wlr_gym.perception.markers.pose import circle_centres, find_target
from wlr_gym.perception.markers.targets import CODES, Target, load_target, ring_radii
from wlr_gym.perception.scene import (
    Facet,
    Look,
    Renderer,
    ScenePose,
    develop,
    floor_facets,
    plate_facet,
    project,
    robot_facets,
    rotation_of,
    view,
)
from wlr_gym.perception.vision.analysis import analyse
from wlr_gym.perception.vision.tracking import Tracker, VideoFrame, angles, locate_floor
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import PlantOptions, standing_state
from wlr_gym.robot import LEG_SLICE, Robot, load_robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

CAMERA = Camera(width=1280, height=720, focal=(800.0, 800.0), centre=(639.5, 359.5))
#: Distortion (k1, k2, p1, p2, k3) of the camera in most scenes, and of two strong lenses.
LENS = (-0.1, 0.02, 0.001, -0.001, 0.0)
STRONG_LENSES = ((-0.3, 0.1, 0.0, 0.0, 0.0), (0.3, -0.05, 0.0, 0.0, 0.0))
#: m, the body's origin above the floor with the legs at home.
HOME_HEIGHT = 0.169


def random_pose(rng: np.random.Generator, height: float | None = None) -> ScenePose:
    """A pose in view; with a height the body is level."""
    position = np.array([rng.uniform(-0.45, 0.45), rng.uniform(-0.2, 0.2), height or HOME_HEIGHT + rng.uniform(-0.06, 0.0)])
    return ScenePose(position, rotation_of(rng.uniform(-math.pi, math.pi), rng.uniform(-0.1, 0.1) if height is None else 0.0))


def shown_robot(robot: Robot, plate: Facet, pose: ScenePose) -> list[Facet]:
    """The robot with a plate of markers or tags at a pose."""
    return [facet.moved(pose.position, pose.rotation) for facet in (*robot_facets(robot, pose.legs), plate)]


def pose_error(found: Array, pose: ScenePose) -> Array:
    """x, y (m) and yaw (rad) found, minus the truth."""
    yaw = angles(pose.rotation)[0]
    return np.array([*(found[:2] - pose.position[:2]), math.remainder(found[2] - yaw, 2 * math.pi)])


# ---- drives with known slip ------------------------------------------------------------------------------------------


#: s, period of the truth's clock.
TICK = 0.002
#: Period of the run, in ticks of that clock.
ROW = 10
#: rad/s, rad/s2, rad/s: registers 80, 1 and 15 of the paper's servos; four turns of the driven wheels.
PAPER_SPEED = 1.918474
PAPER_ACCELERATION = 0.374508
PAPER_LEG_SPEED = 0.359712
#: s at rest before the motion.
_REST = 1.0
_SETTLING = 1.0  # s before the log starts: legs and tyres take the weight
#: What is logged of the sensors: joints and IMU, which come first.
_LOGGED = SENSED[: SENSED.index("cam_x")]


@dataclass(frozen=True, eq=False)
class FilmedDrive:
    """A drive and its truth.

    Attributes:
        name: of it. run: what the robot logged (50 Hz).
        time: (T,) s, servo clock, every :data:`TICK`. position: (T, 3). rotation: (T, 3, 3). legs: (T, 4).
        slip: (T, 4, 2) m, true slip displacement of every wheel, accumulated.
    """

    name: str
    run: Run
    robot: Robot
    time: Array
    position: Array
    rotation: Array
    legs: Array
    slip: Array


def paper_test(number: int, robot: Robot) -> FilmedDrive:
    """The paper's first or second test: front wheels drive four turns, rear wheels run free, legs sweep 120 degrees.

    Rear gear friction and floor are chosen so that it slips; the left rear gear is stiffer, so that it drifts sideways.
    """
    low, high = math.radians(30), math.radians(150)
    start = [low] * 4 if number == 1 else [low, low, high, high]
    end = [low, low, high, high] if number == 1 else [high, high, low, low]
    profile = Profile(wheel_acceleration=PAPER_ACCELERATION, leg_velocity=PAPER_LEG_SPEED)
    parameters = profile_parameters(Parameters.nominal(robot), profile)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.3
    parameters["servo.coulomb_friction"][:, 6:] = 0.07, 0.03
    ramp = PAPER_SPEED / PAPER_ACCELERATION
    stop = _REST + (8 * math.pi - PAPER_SPEED * ramp) / PAPER_SPEED + ramp

    def setpoints(t: float) -> tuple[list[float], list[float]]:
        moving = _REST <= t < stop
        return (end if t >= _REST else start), [PAPER_SPEED * moving] * 2 + [0.0, 0.0]

    free = np.array([True] * 6 + [False] * 2)
    return _drive(f"paper test {number}", robot, parameters, start, setpoints, stop + ramp + 0.5, free, -0.55)


def skid_turn(robot: Robot) -> FilmedDrive:
    """Forward, a turn on the spot with the wheels against each other, forward again; the legs move all the time."""
    parameters = Parameters.nominal(robot)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.4

    def setpoints(t: float) -> tuple[list[float], list[float]]:
        sweep = math.pi / 2 + 0.35 * math.sin(1.5 * max(0.0, t - _REST))
        left, right = (4.0, 4.0) if _REST <= t < 3.2 or 5.6 <= t < 7.8 else (-3.5, 3.5) if 3.2 <= t < 5.6 else (0.0, 0.0)
        return [sweep, sweep, sweep, sweep], [left, right, left, right]

    return _drive("skid turn", robot, parameters, [math.pi / 2] * 4, setpoints, 8.5, np.ones(8, bool), -0.3)


def lab_drive(robot: Robot, speed: float, spin: float, friction: float, seconds: float = 5.4) -> FilmedDrive:
    """Forward, a turn on the spot, forward again, rest, all within 5 s; the legs move.

    Args:
        robot: it. speed: m/s of the wheels' rims. spin: the turn's share of that. friction: of the floor. seconds: of the run.
    """
    parameters = Parameters.nominal(robot)
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = friction
    pace = speed / float(parameters["wheel.radius"].mean())

    def setpoints(t: float) -> tuple[list[float], list[float]]:
        sweep = math.pi / 2 + 0.25 * math.sin(2.0 * min(max(0.0, t - 0.6), math.pi))
        left, right = (1.0, 1.0) if 0.6 <= t < 1.9 or 3.3 <= t < 4.4 else (-spin, spin) if 1.9 <= t < 3.3 else (0.0, 0.0)
        return [sweep] * 4, [pace * left, pace * right] * 2

    return _drive("lab drive", robot, parameters, [math.pi / 2] * 4, setpoints, seconds, np.ones(8, bool), -0.15)


def _drive(
    name: str,
    robot: Robot,
    parameters: Parameters,
    legs: list[float],
    setpoints: Callable[[float], tuple[list[float], list[float]]],
    duration: float,
    torque_on: NDArray[np.bool_],
    x: float,
) -> FilmedDrive:
    plant = make_plant("gibbs_appell", robot, 1, PlantOptions(control_period=TICK, physics_step=0.001))
    state = standing_state(robot, parameters, legs[0])  # sin is the same for all legs, so the body is level
    state.joint_position[:, LEG_SLICE] = legs
    state.reference_position[:, LEG_SLICE] = legs
    state.position[:, 0] = x
    sensors = plant.reset(np.array([7], np.uint64), parameters, state=state)
    for _ in range(int(_SETTLING / TICK)):
        sensors = plant.step(np.concatenate(setpoints(0.0))[None], torque_on[None])
    count = int(duration / TICK)
    rows: list[list[float]] = []
    truths, slips = [], np.zeros((count + 1, 4, 2))
    for tick in range(count + 1):
        time = tick * TICK
        goal = np.concatenate(setpoints(time - time % (ROW * TICK) if tick % ROW else time))
        truth = plant.truth()
        truths.append(np.concatenate([truth.position[0], truth.quaternion[0], truth.joint_position[0, LEG_SLICE]]))
        if tick > 0:
            slips[tick] = slips[tick - 1] + truth.slip_displacement[0].reshape(4, 2)
        if tick % ROW == 0:
            rows.append([time, *np.where(torque_on, goal, np.nan), *channels(sensors, 0)[: len(_LOGGED)]])
        sensors = plant.step(goal[None], torque_on[None])
    plant.close()
    found = np.array(truths)
    table = pandas.DataFrame(rows, columns=["t", *COMMANDS, *_LOGGED])
    run = Run(table, RunMeta(robot=robot.name), Path(f"{name.replace(' ', '_')}.parquet"))
    time = np.asarray(TICK * np.arange(count + 1), np.float64)
    turns = Rotation.from_quat(found[:, 3:7], scalar_first=True).as_matrix()
    return FilmedDrive(name, run, robot, time, found[:, :3], turns, found[:, 7:], slips)


def film(
    drive: FilmedDrive,
    renderer: Renderer,
    body: Target,
    look: Look,
    offset: float,
    rate: float = 30.0,
    exposure: float = 0.005,
    phase: float = 0.011,
    seed: int = 0,
    occluder: Callable[[float], list[Facet]] | None = None,
) -> Iterator[VideoFrame]:
    """Film a drive.

    Args:
        drive: what happens. renderer: camera and floor. body: markers on the robot. look: light, blur, noise.
        offset: s; servo time = the frame's time + offset. rate: Hz. exposure: s, around a frame's time. phase: s.
        occluder: facets (floor frame) that hide something at a servo time.
    """
    instants = 4
    shifts = exposure * ((np.arange(instants) + 0.5) / instants - 0.5)
    for index in range(int((drive.time[-1] - 2 * phase) * rate)):
        time = phase + index / rate
        shown = [shown_robot(drive.robot, plate_facet(body), pose_at(drive, time + shift)) for shift in shifts]
        moving = [[*robot, *(occluder(time) if occluder else [])] for robot in shown]
        yield VideoFrame(index, time - offset, renderer.frame(moving, look, seed + index))


def pose_at(drive: FilmedDrive, time: float) -> ScenePose:
    """True pose of the body at a servo time: linear between ticks."""
    k = min(int(time / TICK), len(drive.time) - 2)
    part = (time - drive.time[k]) / TICK
    turn = Slerp([0, 1], Rotation.from_matrix(drive.rotation[k : k + 2]))(part).as_matrix()
    position, legs = ((1 - part) * a[k] + part * a[k + 1] for a in (drive.position, drive.legs))
    return ScenePose(position, turn, legs)


def true_slip(drive: FilmedDrive, at: Array) -> Array:
    """(K, 4, 2) m, true accumulated slip from the first of the times on."""
    flat = drive.slip.reshape(len(drive.time), 8)
    values = np.stack([np.interp(at, drive.time, column) for column in flat.T], axis=1).reshape(-1, 4, 2)
    return values - values[0]


# ---- square tags in the places of our markers ------------------------------------------------------------------------


#: From an image to the corners (4, 2) px of every tag, clockwise from its upper left one.
Finder = Callable[[Image], dict[int, Array]]

#: m.
TAG_SIDE = 0.06
#: Behind a dictionary's name: found by AprilTag 3 (package ``pupil-apriltags``) in place of OpenCV.
APRILTAG_3 = " AprilTag 3"


def tag_kinds() -> list[str]:
    """The kinds of tags that can be measured here."""
    peers = [f"APRILTAG_36H11{APRILTAG_3}"] if find_spec("pupil_apriltags") else []
    return ["APRILTAG_36H11", "5X5_100", *peers]


def tag_poses(tilt: float, count: int, name: str) -> tuple[Array, str]:
    """Errors (F, 3) with four square tags in the markers' places; the floor is given. Best of the corner conventions."""
    import cv2

    body, robot = load_target("body"), load_robot()
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.removesuffix(APRILTAG_3)}"))
    cells = dictionary.markerSize + 2
    bits = [np.asarray(cv2.aruco.generateImageMarker(dictionary, k, cells) > 127, np.uint8) for k in range(4)]
    tags = [(x, y, TAG_SIDE, bit) for (x, y, _), bit in zip(body.positions, bits, strict=True)]
    plate, straight = plate_facet(body, tags), view(tilt, 2.0)
    camera = CAMERA.model_copy(update={"distortion": LENS})
    renderer = Renderer(camera, straight, floor_facets(None))
    find = _apriltag_3() if name.endswith(APRILTAG_3) else _opencv(dictionary)
    rng, errors, whole = np.random.default_rng(11), {shift: [] for shift in (0.0, -0.5, 0.5)}, 0
    for k in range(count):
        pose = random_pose(rng)
        image = renderer.frame([shown_robot(robot, plate, pose)], Look(), k)
        seen = find(image)
        whole += len(seen) == 4
        if len(seen) < 3:
            continue
        for shift, kept in errors.items():
            kept.append(_tag_error(seen, shift, body, camera, straight, pose))
    best = min(errors.values(), key=lambda kept: float(np.mean(np.square(kept))) if kept else math.inf)
    return np.array(best).reshape(-1, 3), f"all four in {whole} of {count} frames"


def _opencv(dictionary: Any) -> Finder:
    """OpenCV's detector with sub-pixel corners."""
    import cv2

    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, settings)

    def find(image: Image) -> dict[int, Array]:
        corners, ids, _ = detector.detectMarkers(image)
        known = [] if ids is None else np.asarray(ids).reshape(-1)
        return {int(k): np.asarray(corner, float).reshape(4, 2) for k, corner in zip(known, corners, strict=True)}

    return find


@cache  # a detector must not be destroyed: the package frees its tags first, then uses them
def _apriltag_3() -> Finder:
    """AprilTag 3 at full resolution with refined edges; its corners go round the other way."""
    settings = {"quad_decimate": 1.0, "quad_sigma": 0.0, "refine_edges": 1, "decode_sharpening": 0.25}
    detector = import_module("pupil_apriltags").Detector("tag36h11", **settings)
    atexit.register(setattr, detector, "tag_detector_ptr", None)  # then its destructor does nothing

    def find(image: Image) -> dict[int, Array]:
        found = detector.detect(np.ascontiguousarray(image))
        return {tag.tag_id: np.roll(np.asarray(tag.corners)[::-1], 2, axis=0) for tag in found if tag.hamming == 0}

    return find


def _tag_error(seen: dict[int, Array], shift: float, body: Target, camera: Camera, floor: ScenePose, pose: ScenePose) -> Array:
    import cv2

    half = TAG_SIDE / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    places = np.concatenate([body.positions[k] + square for k in seen])
    pixels = np.concatenate(list(seen.values())) + shift
    _, turn, place = cv2.solvePnP(places, pixels, camera.matrix, np.array(camera.distortion), flags=cv2.SOLVEPNP_SQPNP)
    turn, place = cv2.solvePnPRefineLM(places, pixels, camera.matrix, np.array(camera.distortion), turn, place)
    rotation = floor.rotation.T @ cv2.Rodrigues(turn)[0]
    position = floor.rotation.T @ (np.asarray(place).reshape(3) - floor.position)
    return pose_error(np.array([*position[:2], angles(rotation)[0]]), pose)


# ---- frames that look as if they had markers -------------------------------------------------------------------------


def clutter(seed: int, camera: Camera) -> Image:
    """A frame full of discs, rings, targets with other radii, boxes, lines and words, but without our markers."""
    import cv2

    rng = np.random.default_rng(seed)
    height, width = camera.height, camera.width
    image: Any = cv2.resize(rng.uniform(60, 200, (9, 16)).astype(np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)

    def place() -> tuple[int, int]:
        return int(rng.integers(0, width)), int(rng.integers(0, height))

    for _ in range(60):
        shade, (x, y) = float(rng.choice([20, 235, rng.uniform(0, 255)])), place()
        kind = rng.integers(0, 6)
        if kind == 0:
            cv2.rectangle(image, (x, y), (x + int(rng.integers(5, 160)), y + int(rng.integers(5, 120))), shade, -1)
        elif kind == 1:
            axes = int(rng.integers(4, 50)), int(rng.integers(4, 50))
            cv2.ellipse(image, (x, y), axes, rng.uniform(0, 180), 0, 360, shade, int(rng.choice([-1, 2, 5])), cv2.LINE_AA)
        elif kind == 2:
            cv2.line(image, (x, y), place(), shade, int(rng.integers(1, 6)), cv2.LINE_AA)
        elif kind == 3:
            cv2.putText(image, "R0BO0 8@Q", (x, y), cv2.FONT_HERSHEY_DUPLEX, rng.uniform(0.4, 2.5), shade, 2, cv2.LINE_AA)
        else:
            _other_rings(image, rng, (x, y))
    return develop(image.astype(np.float32), Look(blur=rng.uniform(0.3, 2), noise=rng.uniform(0, 10)), seed)


def _other_rings(image: Image, rng: np.random.Generator, place: tuple[int, int]) -> None:
    """Draw concentric discs whose radii are no code's (or light on dark, or too many)."""
    import cv2

    radius, aspect, turn = rng.uniform(8, 60), rng.uniform(0.5, 1), rng.uniform(0, 180)
    while True:
        shares = np.sort(rng.uniform(0.1, 0.95, int(rng.integers(1, 5))))[::-1]
        dark_outside = bool(rng.integers(0, 2))
        alike = len(shares) == 2 and dark_outside and min(np.hypot(*(shares - code)) for code in CODES.values()) < 0.15
        if not alike:
            break
    for k, share in enumerate((1.0, *shares)):
        axes = max(1, int(radius * share)), max(1, int(radius * share * aspect))
        shade = 20.0 if (k % 2 == 0) == dark_outside else 235.0
        cv2.ellipse(image, place, axes, turn, 0, 360, shade, -1, cv2.LINE_AA)


# ---- what is measured ------------------------------------------------------------------------------------------------


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
    """Measure everything, on one thread of OpenCV."""
    import cv2

    threads, results = cv2.getNumThreads(), []
    cv2.setNumThreads(1)
    parts = measure_centres, measure_poses, measure_recall, measure_false_poses, measure_rate, measure_drives
    try:
        for done, part in enumerate(parts):
            size.tell(done / len(parts))
            results += part(size)
    finally:
        cv2.setNumThreads(threads)
    return results


# ---- centres ---------------------------------------------------------------------------------------------------------


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
    half = 60  # px around the centre that are drawn
    corner = np.round(project(camera, centre[None])[0]) - half
    shifted = (camera.centre[0] - corner[0], camera.centre[1] - corner[1])
    crop = camera.model_copy(update={"width": 2 * half, "height": 2 * half, "centre": shifted})
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


# ---- poses -----------------------------------------------------------------------------------------------------------


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


# ---- recall, false poses, rate ---------------------------------------------------------------------------------------


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


# ---- whole drives ----------------------------------------------------------------------------------------------------


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


# ---- the paper's own method ------------------------------------------------------------------------------------------
#
# Korayem, Nikseresht, Asadi 2024 average the centres of the concentric circles' contours to a virtual frame and scale pixels
# to metres once. Here: contours of a global threshold, their mean centres, and the homography of the plane in which the markers
# lie at the start, known exactly. There is no sub-pixel edge, no correction of the ellipse's centre, no lens model for the
# contours, and the plane stays where it was while the legs move the body up and down.


def paper_pose(
    image: Image, camera: Camera, body: Target, floor_rotation: Array, floor_position: Array, height: float, near: Array
) -> Array | None:
    """Return x, y (m) and yaw (rad) of the body in the floor frame, or None when a marker has no contour.

    Args:
        image: (H, W) grey. camera: focal length and centre; its distortion is not used. body: the markers.
        floor_rotation, floor_position: floor to camera frame. height: m, of the marker plane over the floor, taken as fixed.
        near: (M, 2) px, where each marker is, roughly (identity is given to the method).
    """
    pixels = [pixel for point in near if (pixel := _contour_mean(image, point)) is not None]
    if len(pixels) < len(near):
        return None
    eye = -floor_rotation.T @ floor_position
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(camera.matrix).T @ floor_rotation
    places = (eye + rays * ((height - eye[2]) / rays[:, 2])[:, None])[:, :2]
    x, y = places.mean(axis=0)
    layout = body.positions[:, :2] - body.positions[:, :2].mean(axis=0)
    offset = places - places.mean(axis=0)
    turn = math.atan2(np.sum(layout[:, 0] * offset[:, 1] - layout[:, 1] * offset[:, 0]), np.sum(layout * offset))
    return np.array([x, y, turn])


def _contour_mean(image: Image, near: Array, reach: int = 45) -> Array | None:
    """Mean centre (px) of the ellipses through a marker's contours."""
    import cv2

    x0, y0 = max(0, int(near[0]) - reach), max(0, int(near[1]) - reach)
    part = np.ascontiguousarray(image[y0 : y0 + 2 * reach, x0 : x0 + 2 * reach])
    if min(part.shape) < 8:
        return None
    _, dark = cv2.threshold(part, 0, 255, cv2.THRESH_BINARY_INV + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    centres = []
    for contour in contours:
        if len(contour) < 8:
            continue
        (x, y), (width, height), _ = cv2.fitEllipseDirect(contour.reshape(-1, 2))
        offset = math.hypot(x + x0 - near[0], y + y0 - near[1])
        if offset < 0.2 * max(width, height, 1.0) + 1.0 and max(width, height) < 1.8 * reach:
            centres.append((x + x0, y + y0))
    return np.mean(centres, axis=0) if centres else None
