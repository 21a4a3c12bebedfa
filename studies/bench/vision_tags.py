"""Square tags in the places of our markers, for comparison: OpenCV's detector, and AprilTag 3 where it is installed."""

from __future__ import annotations

import atexit
import math
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.bench.vision_scenes import CAMERA, LENS, pose_error, random_pose, shown_robot
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.detection import Image
from wlr_gym.perception.markers.targets import Target, load_target
from wlr_gym.perception.scene import Look, Renderer, ScenePose, floor_facets, plate_facet, view
from wlr_gym.perception.vision.tracking import angles
from wlr_gym.robot import load_robot

Array = NDArray[np.float64]
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
