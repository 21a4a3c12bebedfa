"""The firmware is built once for all tests; without its packages they are skipped, and say which are missing."""

import pytest
from simulated_board import SimulatedBoard, build, missing_packages


@pytest.fixture(scope="session")
def default_build(tmp_path_factory):
    """Firmware with its default settings: 200 Hz at 115200 bit/s."""
    if why := missing_packages():
        pytest.skip(why)
    return build(tmp_path_factory.mktemp("firmware"))


@pytest.fixture(scope="session")
def fast_build(tmp_path_factory):
    """Firmware at 500 Hz and 500000 bit/s."""
    if why := missing_packages():
        pytest.skip(why)
    return build(tmp_path_factory.mktemp("fast"), IMU_RATE=500, BAUD_RATE=500000)


@pytest.fixture
def board(default_build, tmp_path):
    with SimulatedBoard(default_build, tmp_path) as running:
        yield running
