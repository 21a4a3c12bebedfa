"""A log of a laboratory, and the map that it is answered with."""

import pytest
from foreign_logs import lab_map, lab_messages, made_up, write_mcap

from wlr_gym.data.logs.map import content


@pytest.fixture(scope="module")
def messages():
    return lab_messages(made_up(8.0))


@pytest.fixture(scope="module")
def mcap(messages, tmp_path_factory):
    return write_mcap(tmp_path_factory.mktemp("mcap") / "lab.mcap", messages)


@pytest.fixture(scope="module")
def known(mcap):
    """The map, answered, and what its file says."""
    return lab_map(mcap)


@pytest.fixture(scope="module")
def answered(known):
    return content(known)
