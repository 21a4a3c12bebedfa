"""Every rig is closed when its test is over."""

import sys

import pytest


@pytest.fixture(autouse=True)
def _rigs_are_closed():
    yield
    rigs = getattr(sys.modules.get("robot_rig"), "RIGS", [])
    while rigs:
        rig = rigs.pop()
        rig.machine.clear()
        rig.loop.close()
