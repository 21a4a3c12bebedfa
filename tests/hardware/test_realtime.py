"""Real-time scheduling: what is asked of the system, and what a refusal says. The system itself is not touched."""

import os
import sys

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.cli import run_command
from wlr_gym.hardware import timing as realtime

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux only")


@pytest.fixture
def system(monkeypatch):
    """A system that grants everything and writes down what it was asked."""
    asked = []

    class Library:
        code = 0

        def mlockall(self, flags):
            asked.append(("lock", flags))
            return self.code

        def munlockall(self):
            asked.append(("unlock",))

    monkeypatch.setattr(os, "sched_setscheduler", lambda pid, policy, param: asked.append((policy, param.sched_priority)))
    monkeypatch.setattr(realtime.ctypes, "CDLL", lambda *_, **__: Library())
    monkeypatch.setattr(realtime.ctypes, "get_errno", lambda: 12)
    return asked, Library


def test_scheduling_and_memory_are_set_and_given_back(system):
    asked, _ = system
    with realtime.real_time(20):
        assert asked == [(os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 20), ("lock", 3)]
    assert asked[2:] == [("unlock",), (os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, 0)]


def test_a_refusal_says_how_to_be_granted_it(system, monkeypatch):
    asked, library = system
    monkeypatch.setattr(library, "code", -1)
    with (
        pytest.raises(InputError, match=r"mlockall is refused \(Cannot allocate memory\).*memlock unlimited.*limits\.d"),
        realtime.real_time(20),
    ):
        pass
    assert asked[-1] == (os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, 0)

    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(InputError, match=r"SCHED_FIFO, priority 20 is refused .*rtprio 20"), realtime.real_time(20):
        pass
    with pytest.raises(InputError, match="priority 100: expected 1 to 99"), realtime.real_time(100):
        pass


def test_emulated_time_is_not_real_time(tmp_path):
    with pytest.raises(InputError, match="emulated time is not real time"):
        run_command("deploy", ["pid", "--emulated", "--stepped", "--realtime", "20", "--out", str(tmp_path)])
