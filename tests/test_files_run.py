"""How many files of the package a newcomer meets: those in which a function runs, counted by a trace.

``python tests/test_files_run.py make traced`` (or ``train``, ``deploy``) prints their names.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path
from types import FrameType

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: What is done -> in how many files functions may run.
MOST = {"make": 40, "train": 63, "deploy": 80}  # 61 and 76 where nothing is compiled anew
COMMANDS = {
    "train": "train WLR-Velocity-v0 --config ppo_slip_aware --max-minutes 0.05 --no-progress --out run",
    "deploy": "deploy velocity_slip_aware --emulated --stepped --seconds 0.5 --no-status --yes",
}


def files_run(what: str, *, traced: bool) -> set[str]:
    """Do it in this process, which has not imported the package, and return the files in which functions ran, if traced."""
    package, found = str(ROOT / "wlr_gym") + "/", set[str]()

    def note(frame: FrameType, event: str, _: object) -> None:
        place = frame.f_code.co_filename
        # Bodies of modules and classes are no functions, comprehensions are part of what they stand in.
        if place.startswith(package) and frame.f_code.co_flags & 1 and not frame.f_code.co_name.startswith("<"):
            found.add(place.removeprefix(package))

    if traced:
        sys.settrace(note)
        threading.settrace(note)
    if what == "make":
        import gymnasium

        import wlr_gym  # noqa: F401

        gymnasium.make("WLR-Velocity-v0")
    else:
        from wlr_gym.cli import main

        main(COMMANDS[what].split())
    sys.settrace(None)
    return found


@pytest.mark.parametrize(
    "what", ["make", pytest.param("train", marks=pytest.mark.slow), pytest.param("deploy", marks=pytest.mark.slow)]
)
def test_files_run(what, tmp_path):
    for how in ("plain", "traced"):  # the first compiles what has to be compiled
        (tmp_path / how).mkdir()
        words = [sys.executable, __file__, what, how]
        ran = subprocess.run(words, cwd=tmp_path / how, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
    files = [line for line in ran.stdout.splitlines() if line.endswith(".py")]
    assert 20 < len(files) <= MOST[what], "\n".join(files)


if __name__ == "__main__":
    print(*sorted(files_run(sys.argv[1], traced=sys.argv[2] == "traced")), sep="\n")
