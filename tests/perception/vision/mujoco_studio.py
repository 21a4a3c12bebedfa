"""Frames of the same scene as MuJoCo draws it: a second renderer, to check the first one and the detector against.

No lens distortion and no exposure time: a pinhole camera, OpenGL's own edges. Needs OpenGL (see :mod:`wlr_gym.render.scene`).
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.targets import Target
from wlr_gym.perception.scene import PLATE, Look, ScenePose, circles_of, develop
from wlr_gym.render.scene import Canvas
from wlr_gym.render.stage import Stage
from wlr_gym.robot import LEGS, Robot
from wlr_gym.robot.parameters import Parameters

Array = NDArray[np.float64]

_WHITE = (0.9, 0.9, 0.9, 1.0)
_BLACK = (0.05, 0.05, 0.05, 1.0)
_STEP = 1e-4  # m between a disc and the one on it, so that they do not flicker through each other
#: m; height of the markers over the body's origin: MuJoCo's robot wears a deck that the default 0.04 m would put them under.
DECK = 0.06
#: m; what the camera draws.
_NEAR = 0.1
_FAR = 20.0
_SLICES = 128  # sides of what is drawn for a circle


class MujocoStudio:
    """A pinhole camera over MuJoCo's picture of the robot, with markers on robot and floor.

    Args:
        robot: what is filmed. camera: its size, focal length and centre; distortion must be 0.
        floor_in_camera: where the floor is. body, floor: targets; the body's is lifted to :data:`DECK` (``studio.body``).
    """

    def __init__(self, robot: Robot, camera: Camera, floor_in_camera: ScenePose, body: Target, floor: Target) -> None:
        self.camera, self.body, self.floor = camera, _lifted(body), floor
        self._floor_in_camera = floor_in_camera
        size = (camera.width, camera.height)
        self._stage = Stage(robot, Parameters.nominal(robot), size=size)
        model = self._stage.model
        model.vis.quality.numslices = _SLICES
        self._canvas = Canvas(model, size)
        self._scene = mujoco.MjvScene(model, maxgeom=600)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
            self._scene.flags[flag] = 0
        self._joints = [int(model.joint(joint).qposadr[0]) for joint in LEGS]

    def frame(self, pose: ScenePose, look: Look, seed: int) -> NDArray[np.uint8]:
        """Draw the robot at ``pose`` (H, W), then let ``look`` blur it and add noise."""
        data, model = self._stage.data, self._stage.model
        data.qpos[:3] = pose.position
        mujoco.mju_mat2Quat(data.qpos[3:7], pose.rotation.ravel())
        data.qpos[self._joints] = pose.legs
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        options, free = mujoco.MjvOption(), mujoco.MjvCamera()
        mujoco.mjv_updateScene(model, data, options, None, free, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene)
        self._aim()
        self._add_target(self.floor, ScenePose(np.zeros(3), np.eye(3)), None)
        self._add_target(self.body, pose, PLATE)
        picture = self._canvas.draw(self._scene).astype(np.float32)
        return develop(picture @ np.array([0.299, 0.587, 0.114], np.float32), look, seed)

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._canvas.close()

    def _aim(self) -> None:
        """Put MuJoCo's camera where ours is: its picture's middle is half a pixel off the middle pixel's centre."""
        turn, camera = self._floor_in_camera.rotation, self.camera
        middle = (camera.centre[0] + 0.5 - camera.width / 2, camera.centre[1] + 0.5 - camera.height / 2)
        for eye in self._scene.camera:
            eye.pos[:] = -turn.T @ self._floor_in_camera.position
            eye.forward[:], eye.up[:] = turn[2], -turn[1]
            eye.frustum_near, eye.frustum_far = _NEAR, _FAR
            eye.frustum_top = _NEAR * (camera.height / 2 + middle[1]) / camera.focal[1]
            eye.frustum_bottom = -_NEAR * (camera.height / 2 - middle[1]) / camera.focal[1]
            eye.frustum_center = -_NEAR * middle[0] / camera.focal[0]
            eye.frustum_width = _NEAR * camera.width / 2 / camera.focal[0]

    def _add_target(self, target: Target, pose: ScenePose, plate: tuple[float, float] | None) -> None:
        z = float(target.positions[0, 2])
        if plate is not None:
            half = np.array([plate[0] / 2, plate[1] / 2, _STEP / 2])
            self._add(mujoco.mjtGeom.mjGEOM_BOX, half, pose, np.array([0, 0, z - 2.5 * _STEP]), _WHITE)
        for x, y, *radii in circles_of(target):
            if plate is None:
                half = np.array([1.6 * radii[0], 1.6 * radii[0], _STEP / 2])
                self._add(mujoco.mjtGeom.mjGEOM_BOX, half, pose, np.array([x, y, z + 0.5 * _STEP]), _WHITE)
            for level, (radius, colour) in enumerate(zip(radii, (_BLACK, _WHITE, _BLACK), strict=True)):
                place = np.array([x, y, z + (level + (1.5 if plate is None else -1.5)) * _STEP])
                self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([radius, _STEP / 2, 0]), pose, place, colour)

    def _add(
        self, kind: mujoco.mjtGeom, size: Array, pose: ScenePose, place: Array, colour: tuple[float, float, float, float]
    ) -> None:
        geom = self._scene.geoms[self._scene.ngeom]
        where = pose.rotation @ place + pose.position
        mujoco.mjv_initGeom(geom, kind.value, size, where, pose.rotation.ravel(), np.array(colour, np.float32))
        geom.emission, geom.specular, geom.shininess = 0.5, 0.0, 0.0
        self._scene.ngeom += 1


def _lifted(body: Target) -> Target:
    markers = [marker.model_copy(update={"position": (*marker.position[:2], DECK)}) for marker in body.markers]
    return body.model_copy(update={"markers": tuple(markers)})
