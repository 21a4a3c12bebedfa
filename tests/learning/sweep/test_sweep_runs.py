"""Sweeps that are run (docs/learning.md): results as of the same trainings alone, failures, interruptions, table and page."""

import os
import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from sweep_runs import ENVIRONMENT, SETTINGS, assert_like_alone, checkpoints
from waiting import LONGEST, wait_until

import wlr_gym
from wlr_gym.base.settings import read_yaml
from wlr_gym.cli import main

pytest.importorskip("torch")

#: Imported by every trial: the disk is full for one of them, as long as a file says so.
FULL_DISK = """
import errno, os, pathlib
from wlr_gym.learning.ppo import training
save = training.write_policy

def save_on_full_disk(folder, *arguments, **keywords):
    if "gamma=0.9," in str(folder) and pathlib.Path(__file__).with_suffix(".full").exists():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
    return save(folder, *arguments, **keywords)

training.write_policy = save_on_full_disk
"""


@pytest.mark.slow
def test_one_fails_the_others_go_on_and_a_resume_completes_it(tmp_path, monkeypatch, capsys):
    """Four trials, one of them without space on its disk; then there is space again."""
    (tmp_path / "disk_for_tests.py").write_text(FULL_DISK)
    (tmp_path / "disk_for_tests.full").touch()
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    file, out = tmp_path / "sweep.yaml", tmp_path / "out"
    from wlr_gym.base.provenance import write_yaml

    plan = {"environment": ENVIRONMENT, "settings": SETTINGS, "space": {"gamma": [0.9, 0.97]}, "seeds": 1}
    write_yaml(file, {**plan, "imports": ["disk_for_tests"]})
    assert main(["sweep", str(file), "--out", str(out), "--workers", "2"]) == 1
    printed = capsys.readouterr().out
    assert "gamma=0.9,seed=0: FAILED: OSError: [Errno 28] No space left on device" in printed
    assert "1 trial FAILED" in printed
    assert "No space left on device" in (out / "sweep.html").read_text()
    (tmp_path / "disk_for_tests.full").unlink()
    assert main(["sweep", "--resume", str(out)]) == 0
    assert "1 of 2 trials are done already" in capsys.readouterr().out
    found = wlr_gym.resume_sweep(out)  # nothing left to do
    assert [one.status for one in found.trials] == ["done", "done"]
    for one in found.trials:
        assert_like_alone(one, tmp_path / f"alone_{one.trial.name}")
        assert read_yaml(one.folder / "provenance.yaml")["command"] == read_yaml(out / "provenance.yaml")["command"]

    import pandas

    table = pandas.read_parquet(out / "trials.parquet")
    assert list(table["gamma"]) == [0.9, 0.97]
    assert table["final_tracking_error"].tolist() == [one.final["tracking_error"] for one in found.trials]
    assert np.all(table["best_tracking_error"].to_numpy() <= table["final_tracking_error"].to_numpy())
    assert table["steps"].tolist() == [512, 512]
    assert (out / table["folder"][0] / "policy").is_dir()
    assert found.ranking[0].mean == table["final_tracking_error"].min()
    assert read_yaml(out / "trials" / table["name"][0] / "config.yaml")["settings"]["gamma"] == 0.9


@pytest.mark.slow
def test_a_sweep_that_is_stopped_resumes_exactly(tmp_path, hold):
    """Three times in a row, always in mid-run: first both trials at once, then one while the other waits for its turn."""
    out = tmp_path / "out"
    begin = f"wlr_gym.sweep({ENVIRONMENT!r}, {str(out)!r}, settings={SETTINGS!r}, seeds=2, workers=2)"
    resume = f"wlr_gym.resume_sweep({str(out)!r}, workers=1)"
    hold.touch()
    for call, number, at_work in ((begin, signal.SIGINT, 2), (resume, signal.SIGTERM, 1), (resume, signal.SIGKILL, 1)):
        before = checkpoints(out)
        heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a background shell has switched it off
        driver = subprocess.Popen(
            [sys.executable, "-c", f"import wlr_gym\n{call}"], stderr=subprocess.PIPE, text=True, preexec_fn=heard
        )
        wait_until(lambda before=before, at_work=at_work: len(checkpoints(out) - before) == at_work, driver)
        driver.send_signal(number)
        said = driver.communicate(timeout=LONGEST)[1]
        if number != signal.SIGKILL:
            assert f"resume with: wlr sweep --resume {out}" in said
            assert (out / "sweep.html").is_file()
    assert not list(out.glob("trials/*/policy"))
    hold.unlink()
    found = wlr_gym.resume_sweep(out)
    assert [one.status for one in found.trials] == ["done", "done"]
    for one in found.trials:
        assert (one.folder / "provenance_resumed.yaml").is_file()
        assert_like_alone(one, tmp_path / f"alone_{one.trial.seed}")


def test_a_search_without_ray_names_the_extra(tmp_path, monkeypatch):
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "ray" else find(name))
    with pytest.raises(ImportError, match=r"wlr-gym\[sweep\]"):
        wlr_gym.sweep(ENVIRONMENT, tmp_path / "out", space={"gamma": [0.9]}, search={"early_stopping": True})
    assert not (tmp_path / "out").exists()
