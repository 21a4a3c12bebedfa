import pytest


@pytest.fixture(scope="session", autouse=True)
def shared_kernels():
    """Give robots with any effect the engine's kernel for all effects, so that the suite compiles a few kernels and not dozens.

    A family that a robot does not use changes none of its bits: tests/physics/test_engine_effects.py, on the product's own
    choice (``own_kernels``).
    """
    from shared_kernels import OWN, GibbsAppellPlant, choose_shared

    patch = pytest.MonkeyPatch()
    patch.setattr(GibbsAppellPlant, "_choose_kernel", choose_shared)
    yield OWN
    patch.undo()


@pytest.fixture
def own_kernels(shared_kernels, monkeypatch):
    """The kernel that the product chooses itself, for what a test's robots need."""
    from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant

    monkeypatch.setattr(GibbsAppellPlant, "_choose_kernel", shared_kernels)


@pytest.fixture(scope="session")
def graphics():
    """Skip where there is no OpenGL at all."""
    from wlr_gym.base.errors import InputError
    from wlr_gym.render.scene import Canvas
    from wlr_gym.render.stage import Stage
    from wlr_gym.robot import load_robot
    from wlr_gym.robot.parameters import Parameters

    robot = load_robot()
    try:
        Canvas(Stage(robot, Parameters.nominal(robot)).model, (64, 64)).close()
    except InputError as error:
        pytest.skip(f"no pictures on this machine: {error}")
