"""Jobs: processes that end in good order, whatever ends who waits for them. Locks; threads that are interrupted."""

import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from waiting import wait_until

import wlr_gym
from wlr_gym.base import jobs
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import locked
from wlr_gym.base.jobs import Job, follow, in_threads, spread

#: Says what it sees, and leaves a file when it is ended in good order.
MODULE = """
import os, signal, sys, time, pathlib
from wlr_gym.base.jobs import serve

def work(task, send):
    here = pathlib.Path(task["folder"])
    if task["do"] == "die":
        print("the last words", file=sys.stderr)
        os._exit(7)
    if task["do"] == "tear":
        os.write(ANSWERS, b'{"text": "half a li')
        os._exit(0)
    if task["do"] == "raise":
        raise OSError(28, "No space left on device", "a_file")
    send({"threads": os.environ["OMP_NUM_THREADS"]})
    if task["do"] == "wait":
        def end(*_):
            (here / "ended").write_text("in good order")
            sys.exit()
        signal.signal(signal.SIGTERM, end)
        (here / "began").write_text("")
        time.sleep(600)

ANSWERS = os.dup(1)
serve(work)
"""


@pytest.fixture
def job(tmp_path, monkeypatch):
    (tmp_path / "a_job_for_tests.py").write_text(MODULE)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    return lambda do: Job(do, "a_job_for_tests", {"do": do, "folder": str(tmp_path)}, str(tmp_path / f"{do}.txt"))


def test_each_ends_for_itself(job):
    ended = {one.name: one.error for one in spread([job("die"), job("raise"), job("speak")], 2)}
    assert ended["speak"] == ""
    assert "process ended with 7" in ended["die"]
    assert "the last words" in ended["die"]
    assert "No space left on device" in ended["raise"]


def test_one_hears_what_it_says_and_it_has_one_thread(job):
    heard = []
    assert follow(job("speak"), heard.append) == ""
    assert heard == [{"threads": "1"}]


def test_a_line_that_its_writer_did_not_end_is_not_heard(job):
    heard = []
    assert "process ended with 0" in follow(job("tear"), heard.append)
    assert heard == []


def test_a_log_that_cannot_be_written_is_an_error_of_its_job(job, tmp_path):
    good, bad = job("speak"), Job("bad", "a_job_for_tests", {}, str(tmp_path / "none" / "log.txt"))
    ended = {one.name: one.error for one in spread([bad, good], 1)}
    assert ended["speak"] == ""
    assert "cannot be started" in ended["bad"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no disk that is always full")
def test_the_error_is_known_though_the_log_is_on_the_full_disk(job):
    full = replace(job("raise"), log="/dev/full")
    assert "No space left on device" in follow(full, print)


def test_jobs_end_in_good_order_with_who_runs_them(job, tmp_path):
    running = spread([job("wait"), job("speak")], 2)
    next(running)
    wait_until((tmp_path / "began").exists)
    running.close()
    assert (tmp_path / "ended").read_text() == "in good order"


def test_jobs_end_in_good_order_when_who_waits_is_killed(job, tmp_path):
    code = f"from wlr_gym.base.jobs import *\nfollow({job('wait')!r}, print)"
    waiting = subprocess.Popen([sys.executable, "-c", code])
    wait_until((tmp_path / "began").exists)
    waiting.send_signal(signal.SIGKILL)
    waiting.wait()
    wait_until((tmp_path / "ended").exists)


def test_threads_that_end_their_work_first_say_so(capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        in_threads(2, interrupted, [1, 2])
    assert capsys.readouterr().err == "interrupting ...\n"


def test_a_lock_is_held_among_processes_and_freed_by_death(tmp_path):
    path = tmp_path / "lock"
    code = f"import pathlib, time\nfrom wlr_gym.base.files import locked\nwith locked(pathlib.Path({str(path)!r}), 1):\n"
    code += f"    pathlib.Path({str(tmp_path / 'held')!r}).touch(); time.sleep(600)"
    holder = subprocess.Popen([sys.executable, "-c", code])
    wait_until((tmp_path / "held").exists)
    with pytest.raises(InputError, match=rf"lock: held for 0\.2 s by process {holder.pid} on .*: -c;"), locked(path, 0.2):
        pass
    holder.kill()
    holder.wait()
    with locked(path, 0.2):
        pass


@pytest.mark.parametrize(("quota", "expected"), [("max 100000", 6), ("150000 100000", 2), ("50000 100000", 1), ("", 6)])
def test_cores_are_those_of_the_affinity_and_the_container(monkeypatch, tmp_path, quota, expected):
    (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(jobs, "_QUOTAS", ((str(tmp_path / "cpu.max"),), (str(tmp_path / "none"),)))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)), raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    assert jobs.cores() == expected


def test_only_one_function_counts_cores():
    package = Path(str(wlr_gym.__file__)).parent
    found = [path for path in package.rglob("*.py") if re.search("cpu_count|getaffinity", path.read_text(encoding="utf-8"))]
    assert found == [package / "base" / "jobs.py"]
