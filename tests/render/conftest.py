import pytest
from standing import PLAIN

from wlr_gym.render.scene import Scene
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters


@pytest.fixture
def robot():
    return load_robot()


@pytest.fixture
def parameters(robot):
    return Parameters.nominal(robot)


@pytest.fixture
def new_scene(robot, graphics):
    """Make scenes that are closed after the test."""
    scenes = []

    def make(view=PLAIN):
        scenes.append(Scene(robot, view))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()
