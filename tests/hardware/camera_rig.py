"""An emulated robot under an emulated camera, in emulated time, and what its control loop believed beside the truth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from robot_rig import HARDWARE, PERIOD, RIGS, ROBOT

from wlr_gym.hardware.camera.reading import CameraFile, load_camera_file
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.camera import true_pose
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.emulator.link import emulated_link
from wlr_gym.hardware.loop import ControlLoop
from wlr_gym.physics.plants.base import RobotOptions

STAND = np.array([math.pi / 2] * 4 + [0.0] * 4)
FORWARD = STAND + np.array([0.0] * 4 + [2.0] * 4)
TURN = STAND + np.array([0.0] * 4 + [-4.0, 4.0, -4.0, 4.0])
#: m and rad: a pose further from the truth is wrong.
WRONG = (0.03, 0.05)


def small_camera(**scene: Any) -> CameraFile:
    """A camera of few pixels, which is quick to render."""
    file = load_camera_file("emulated")
    lens = file.calibration.model_copy(update={"width": 480, "height": 270, "focal": (300.0, 300.0), "centre": (239.5, 134.5)})
    set_up = {"height": 1.66, "tilt": 0.0, "clutter": 6, "samples": 3, "noise": 3.0} | scene
    return file.model_copy(update={"calibration": lens, "emulated": file.emulated.model_copy(update=set_up)})


class CameraRig:
    """A robot under a camera.

    Attributes:
        machine, link, loop: of the robot. truth: time and true x, y, yaw, tick by tick.
        shown: per control step: time; pose that is shown, when it was exposed, whether it is new, whether it counts as wrong.
        reasons: why there is no pose, per control step.
    """

    def __init__(self, file: CameraFile | None = None, log: Any = None, tick: float = 0.002, **parts: Any) -> None:
        self.machine = Machine(ROBOT, HARDWARE, MachineOptions(timing=NO_TIME, tick=tick), **parts)
        self.link = emulated_link(self.machine, file or small_camera())
        self.loop = ControlLoop(ROBOT, HARDWARE, self.link, PERIOD, RobotOptions(log=log))
        RIGS.append(self)
        self.truth: list[tuple[float, float, float, float]] = []
        self.machine.watchers.append(self._look)
        self.shown: list[tuple[float, ...]] = []
        self.reasons: list[str] = []

    def _look(self) -> None:
        pose = true_pose(self.machine)
        w, x, y, z = pose.quaternion
        self.truth.append((pose.time, *pose.position[:2], math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))

    def start(self, seconds: float, setpoints: np.ndarray = FORWARD) -> None:
        """Start, and drive for so long."""
        self.loop.start()
        self.drive(seconds, setpoints)

    def drive(self, seconds: float, setpoints: np.ndarray = FORWARD) -> None:
        """Drive and note what the camera shows."""
        for _ in range(round(seconds / PERIOD)):
            status = self.loop.tick(setpoints)
            assert status.camera is not None
            camera = status.camera
            self.shown.append((status.time, *camera.pose, camera.time, camera.is_new, camera.is_wrong))
            self.reasons.append(camera.reason)

    def errors(self) -> np.ndarray:
        """(K, 4) time, and error along x, y (m) and of yaw (rad), of every pose that was believed."""
        truth = np.array(self.truth)
        truth[:, 3] = np.unwrap(truth[:, 3])
        assert self.loop.recorder.origin is not None
        start = self._at(truth, self.loop.recorder.origin.time)
        cosine, sine = math.cos(start[2]), math.sin(start[2])
        found = []
        for time, x, y, yaw, exposed, is_new, _ in self.shown:
            if is_new:
                dx, dy, turned = self._at(truth, exposed) - start
                true = np.array([cosine * dx + sine * dy, cosine * dy - sine * dx, turned])
                found.append((time, *(np.array([x, y, yaw]) - true)))
        return np.array(found).reshape(-1, 4)

    def _at(self, truth: np.ndarray, time: float) -> np.ndarray:
        return np.array([np.interp(time, truth[:, 0], column) for column in truth[:, 1:].T])

    def longest_wrong(self) -> float:
        """s for which wrong poses were believed without a pause, from the first until the first right one or the end."""
        longest, since = 0.0, None
        for time, x, y, yaw in self.errors():
            if math.hypot(x, y) > WRONG[0] or abs(yaw) > WRONG[1]:
                since = time if since is None else since
                longest = max(longest, time - since + PERIOD)
            else:
                since = None
        return longest
