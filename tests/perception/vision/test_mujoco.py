"""The detector on frames of another renderer: MuJoCo's."""

import math

import numpy as np
from vision_studio import wrapped

from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.markers.targets import load_target
from wlr_gym.perception.scene import Look, ScenePose, rotation_of, view
from wlr_gym.perception.vision.tracking import OK, Tracker, VideoFrame, locate_floor
from wlr_gym.robot import load_robot


def test_pose_in_mujocos_picture(graphics):
    from mujoco_studio import MujocoStudio  # after a graphics backend is chosen

    camera = Camera(width=1280, height=720, focal=(800.0, 800.0), centre=(639.5, 359.5))
    floor = load_target("floor")
    studio = MujocoStudio(load_robot(), camera, view(0.4, 2.0), load_target("body"), floor)
    poses = [ScenePose(np.array([0.1 * k - 0.1, 0.05 * k, 0.169]), rotation_of(0.5 * k, 0.03 * k)) for k in range(3)]
    frames = [VideoFrame(k, k / 30, studio.frame(pose, Look(blur=0.6, noise=3.0), k)) for k, pose in enumerate(poses)]
    studio.close()
    tracker = Tracker(camera, studio.body, floor, *locate_floor(frames, camera, floor))
    for frame, pose in zip(frames, poses, strict=True):
        sample = tracker(frame)
        assert sample.status == OK
        assert np.hypot(*(sample.pose[:2] - pose.position[:2])) < 0.5e-3
        assert abs(math.degrees(wrapped(sample.pose[3] - math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])))) < 0.03
