"""Whoever writes a folder holds it: a second one is refused in one line that names the first."""

import os
import subprocess
import sys
import threading

import pytest
from waiting import wait_until

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import LOCK, alone_in
from wlr_gym.cli import main

COMMANDS = {
    "train": "train WLR-Velocity-v0",
    "resume": "train --resume {out}",
    "sweep": "sweep WLR-Velocity-v0 --seeds 1",
    "evaluate": "evaluate pid --out {out}",
    "record": "record --excitation straight --out {out}",
    "replay": "replay {out}/none.csv --out {out}",
    "compare": "compare --out {out}",
    "gap": "gap {out} --out {out}",
    "adapt": "adapt velocity_slip_aware --emulated --out {out}",
    "vision": "vision film.avi --run run_01.csv --camera c --markers m --floor f --out {out}",
    "deploy": "deploy velocity_slip_aware --emulated --out {out}",
    "commission": "commission --emulated --out {out}",
    "demo": "demo --quick --out {out}",
}


@pytest.fixture(scope="module")
def held(tmp_path_factory):
    """A folder, and the process that holds it."""
    out, begun = tmp_path_factory.mktemp("held") / "with space", tmp_path_factory.mktemp("held") / "begun"
    out.mkdir()
    (out / "config.yaml").write_text("environment: WLR-Velocity-v0\nagent: ppo\nsettings: {}\n")
    code = f"import pathlib, time\nfrom wlr_gym.base.files import alone_in\nwith alone_in(pathlib.Path({str(out)!r})):\n"
    code += f"    pathlib.Path({str(begun)!r}).touch(); time.sleep(600)"
    process = subprocess.Popen([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    wait_until(begun.exists, process)
    yield out, process
    process.kill()
    process.wait()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_writer_is_refused_by_the_name_of_the_first(command, held, capsys):
    out, process = held
    words = [word.replace("{out}", str(out)) for word in COMMANDS[command].split()]
    if "{out}" not in COMMANDS[command]:
        words += ["--out", str(out)]
    before = sorted(path.name for path in out.iterdir())
    assert main(words) == 2
    assert f"held by process {process.pid}" in capsys.readouterr().err
    assert sorted(path.name for path in out.iterdir()) == before


def test_a_folder_is_free_when_its_holder_is_dead_and_nothing_of_it_is_left(tmp_path):
    (tmp_path / LOCK).write_text("process 1 on another machine: wlr train\n")
    with alone_in(tmp_path), alone_in(tmp_path):
        assert f"process {os.getpid()} " in (tmp_path / LOCK).read_text()
    assert list(tmp_path.iterdir()) == []


def test_two_threads_do_not_write_one_folder(tmp_path):
    found = []

    def write():
        try:
            with alone_in(tmp_path):
                pass
        except InputError as error:
            found.append(str(error))

    with alone_in(tmp_path):
        (thread := threading.Thread(target=write)).start()
        thread.join()
    assert "another thread" in found[0]
