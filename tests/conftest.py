import pytest


@pytest.fixture(scope="session")
def graphics():
    """Skip where there is no OpenGL at all."""
    from wlr_gym.base.errors import InputError
    from wlr_gym.render.gl import Canvas
    from wlr_gym.render.stage import Stage
    from wlr_gym.robot import load_robot
    from wlr_gym.robot.parameters import Parameters

    robot = load_robot()
    try:
        Canvas(Stage(robot, Parameters.nominal(robot)).model, (64, 64)).close()
    except InputError as error:
        pytest.skip(f"no pictures on this machine: {error}")
