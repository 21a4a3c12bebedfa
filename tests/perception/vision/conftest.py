"""Fixtures of the tests of vision. Without OpenCV (the extra ``vision``) they are left out."""

import pytest

pytest.importorskip("cv2")

from vision_studio import Studio

from studies.bench.vision import skid_turn
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.robot import load_robot


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    import cv2

    cv2.setNumThreads(1)


@pytest.fixture(scope="session")
def studio() -> Studio:
    """Overhead at 2 m, with some lens distortion."""
    lens = (-0.1, 0.02, 0.001, -0.001, 0.0)
    return Studio(Camera(width=1280, height=720, focal=(800.0, 805.0), centre=(630.0, 365.0), distortion=lens))


@pytest.fixture(scope="session")
def drive():
    """A skid turn: its run, its poses and its slip."""
    return skid_turn(load_robot())
