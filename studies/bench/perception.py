"""Whether the live camera keeps up beside the control loop, in real time, with an emulated robot in another process.

Once with a recorded film, so that only what runs on the robot's computer is measured (taking frames, finding poses, handing
them over), at 30 frames per second; and once with frames rendered from the emulated robot while it drives, as many as there is
time for.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from studies.bench.bus import drive_in_real_time
from studies.bench.measure import Measurement, Size
from wlr_gym.base.errors import require_package
from wlr_gym.base.provenance import write_yaml
from wlr_gym.hardware.camera.reading import CameraFile, load_camera_file
from wlr_gym.hardware.camera.rendered import RenderedCamera, RobotPose
from wlr_gym.robot import Robot, load_robot

#: Frames of the film: a circle, so that its end joins its beginning.
_FRAMES = 120
#: m, radius of the circle.
_CIRCLE = 0.15
_POLICY = "velocity_slip_aware"
_RATE = 30.0


def measure_perception(size: Size) -> list[Measurement]:
    """Frames per second, ticks missed, and the age of poses, with a film and with rendered frames."""
    for package, extra in (("cv2", "vision"), ("dynamixel_sdk", "robot"), ("serial", "robot")):
        require_package(package, extra)
    seconds, rounds = size(30, 2), min(size.rounds, 3)
    with tempfile.TemporaryDirectory(prefix="wlr-bench-") as folder:
        film = _film(Path(folder), load_camera_file("emulated"), load_robot(), size(_FRAMES, 12))
        filmed = [drive_in_real_time(seconds, [_POLICY, "--camera", str(film)]) for _ in range(rounds)]
        rendered = [drive_in_real_time(seconds, [_POLICY, "--camera", "emulated"]) for _ in range(rounds)]
    return [*_rows("film", seconds, filmed, 1.0), *_rows("rendered as it drives", seconds, rendered, None)]


def _rows(kind: str, seconds: int, drives: list[dict[str, Any]], bar: float | None) -> list[Measurement]:
    what = f"{seconds} s at 50 Hz beside the camera, {kind}"
    cameras = [drive["camera"] for drive in drives]
    rates = tuple(camera["rate"] for camera in cameras)
    missed = float(sum(drive["missed"] for drive in drives))
    return [
        Measurement("perception", f"{what}: frames per second of {_RATE:g}", "1/s", rates),
        Measurement("perception", f"{what}: ticks missed in {len(drives)} rounds", "ticks", (missed,), bar=bar),
        Measurement("perception", f"{what}: pictures to poses, p99", "us", tuple(1e3 * c["work"]["p99"] for c in cameras)),
    ]


def _film(folder: Path, file: CameraFile, robot: Robot, frames: int) -> Path:
    """Render a film of a robot that drives in a circle; return the camera's file that shows it."""
    camera = RenderedCamera(file, robot)
    height = robot.leg.length + robot.wheel.radius - robot.hip_position.z
    pictures = []
    for number in range(frames):
        angle = 2 * math.pi * number / frames
        place = np.array([_CIRCLE * math.sin(angle), _CIRCLE * (1 - math.cos(angle)), height])
        turn = np.array([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)])
        pose = RobotPose(0.0, place, turn, np.full(4, math.pi / 2))
        pictures.append(camera.picture(camera.exposure(number), [pose, pose]))
    np.save(folder / "film.npy", np.stack(pictures))
    content = file.model_copy(update={"device": str(folder / "film.npy"), "rate": _RATE}).model_dump(mode="json")
    path = folder / "film.yaml"
    write_yaml(path, content)
    return path
