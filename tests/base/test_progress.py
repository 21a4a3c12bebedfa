"""What long work tells: lines where nobody watches, a bar with the time on a terminal."""

import io
import time

import pytest
from rich.console import Console

from wlr_gym.base import progress as module
from wlr_gym.base.progress import progress, tracked


@pytest.fixture
def clock(monkeypatch):
    """Return a function that lets time pass."""
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])

    def wait(seconds):
        now[0] += seconds

    return wait


def test_without_a_terminal_there_is_a_line_for_each_stage_and_then_one_now_and_then(clock):
    out = io.StringIO()
    with progress(Console(file=out, width=80)) as tell:
        for done in range(40):
            tell("", f"searching: error {done}", done / 40)
            clock(1.0)
        tell("", "writing", 1.0)
    assert out.getvalue().splitlines() == [
        "  0 %  searching",
        " 25 %  searching: error 10; about 30 s left",
        " 50 %  searching: error 20; about 20 s left",
        " 75 %  searching: error 30; about 10 s left",
        "100 %  writing",
    ]


def test_nothing_is_printed_where_nothing_is_to_be_shown():
    out = io.StringIO()
    assert list(tracked("abc", 3, "drawing", Console(file=out), shown=False)) == ["a", "b", "c"]
    assert out.getvalue() == ""


def test_a_bar_fits_the_terminal(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    out = io.StringIO()
    with progress(Console(file=out, width=80, force_terminal=True, color_system=None)) as tell:
        tell("", "training: held-out error 0.123, 12,345 steps/s", 0.5)
        time.sleep(0.3)
    assert " 50% --:-- training: held-out error 0.123" in out.getvalue()
