"""All commissioning tests, in the order they are made: what cannot move first, hands first."""

from __future__ import annotations

from collections.abc import Sequence

from wlr_gym.base.errors import unknown_name
from wlr_gym.hardware.commissioning.bus_tests import LATENCY, SILENT_SERVO
from wlr_gym.hardware.commissioning.contract import StandTest
from wlr_gym.hardware.commissioning.hand_tests import IMU_AXES, SIGNS
from wlr_gym.hardware.commissioning.torque_tests import TORQUE_ON, WATCHDOG
from wlr_gym.hardware.commissioning.wheel_tests import LOAD, STALL, VELOCITY_STEP

_ORDER = (LATENCY, SILENT_SERVO, SIGNS, IMU_AXES, TORQUE_ON, WATCHDOG, VELOCITY_STEP, LOAD, STALL)
#: Name -> test.
TESTS: dict[str, StandTest] = {test.name: test for test in _ORDER}


def choose(names: Sequence[str]) -> list[StandTest]:
    """Return the named tests in the order they are made; no name = all.

    Raises:
        InputError: an unknown name.
    """
    for name in names:
        if name not in TESTS:
            raise unknown_name("test", name, TESTS)
    return [test for test in TESTS.values() if not names or test.name in names]
