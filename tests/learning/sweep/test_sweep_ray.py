"""Sweeps on Ray: two nodes on this machine, one of which dies; a node without the package; searches."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from sweep_runs import ENVIRONMENT, SETTINGS, assert_like_alone

import wlr_gym
from wlr_gym.base.errors import InputError

pytest.importorskip("torch")
ray = pytest.importorskip("ray")

LONGER = SETTINGS | {"total_steps": 6400, "checkpoint_every": 640, "evaluate_every": 3200}
#: Read by Python at its start: there is no wlr_gym.
WITHOUT = """
import sys

class Without:
    def find_spec(self, name, path=None, target=None):
        if name == "wlr_gym":
            raise ModuleNotFoundError("No module named 'wlr_gym'")

sys.meta_path.insert(0, Without())
"""


@pytest.fixture
def cluster():
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    yield made
    made.shutdown()


@pytest.mark.slow
def test_a_node_dies_in_mid_run_and_the_sweep_ends_complete(cluster, tmp_path):
    """3 settings x 3 seeds on two nodes; results as of the same trainings alone, to the bit."""
    node = cluster.add_node(num_cpus=1)
    lines = []

    def say(line: str) -> None:
        lines.append(line)
        if line.startswith("2/9"):
            deadline = time.monotonic() + 60.0
            while len(list(tmp_path.glob("out/trials/*/checkpoints"))) < 4:  # both nodes are at work on the next
                assert time.monotonic() < deadline
                time.sleep(0.02)
            cluster.remove_node(node, allow_graceful=False)

    found = wlr_gym.sweep(
        ENVIRONMENT,
        tmp_path / "out",
        settings=LONGER,
        space={"gamma": [0.9, 0.95, 0.97]},
        seeds=3,
        ray=cluster.address,
        say=say,
    )
    assert [one.status for one in found.trials] == ["done"] * 9
    assert len(found.ranking) == 3
    assert sum((one.folder / "provenance_resumed.yaml").is_file() for one in found.trials) == 1  # the one that was there
    for one in found.trials:
        assert_like_alone(one, tmp_path / "alone" / one.trial.name, LONGER)


@pytest.mark.slow
def test_a_killed_driver_resumes(cluster, tmp_path):
    out = tmp_path / "out"
    arguments = f"{ENVIRONMENT!r}, {str(out)!r}, settings={LONGER!r}, seeds=2, ray={cluster.address!r}"
    code = f"import wlr_gym\nwlr_gym.sweep({arguments})"
    driver = subprocess.Popen([sys.executable, "-c", code])
    deadline = time.monotonic() + 90.0
    while not list(out.glob("trials/*/checkpoints/step_*")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    found = wlr_gym.resume_sweep(out, ray=cluster.address)
    assert [one.status for one in found.trials] == ["done", "done"]
    assert (found.trials[0].folder / "provenance_resumed.yaml").is_file()
    for one in found.trials:
        assert_like_alone(one, tmp_path / f"alone_{one.trial.seed}", LONGER)


@pytest.mark.slow
def test_a_node_without_the_package_is_named_and_left_out(cluster, tmp_path):
    (tmp_path / "sitecustomize.py").write_text(WITHOUT)
    path = ":".join([str(tmp_path), *sys.path])
    cluster.add_node(num_cpus=4, env_vars={"PYTHONPATH": path})
    lines = []
    found = wlr_gym.sweep(ENVIRONMENT, tmp_path / "out", settings=SETTINGS, seeds=3, ray=cluster.address, say=lines.append)
    assert [one.status for one in found.trials] == ["done"] * 3
    (left_out,) = (line for line in lines if "left out" in line)
    assert "No module named 'wlr_gym'" in left_out
    assert "it needs wlr-gym[train]" in left_out


@pytest.mark.slow
def test_a_search_stops_early_repeats_the_best_and_resumes(tmp_path):
    """Optuna and ASHA on a Ray of this machine; one choice of the space is one that every training refuses."""
    lines: list[str] = []
    space = {"learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}, "teacher": [None, "no_such_agent"]}
    settings = SETTINGS | {"total_steps": 1152, "evaluate_every": 128}
    search = {"method": "optuna", "trials": 6, "early_stopping": True, "repeat_best": 1}
    found = wlr_gym.sweep(
        ENVIRONMENT, tmp_path / "out", settings=settings, space=space, seeds=2, search=search, say=lines.append
    )
    status = [one.status for one in found.trials]
    assert len(status) >= 6
    assert set(status) <= {"done", "stopped early", "failed"}
    assert "failed" in status
    assert all("no_such_agent" in one.error for one in found.failed)
    assert len(found.ranking[0].values) == 2
    assert not (tmp_path / "out" / ".ray_tune").exists()
    stopped = {one.trial.name: one.steps for one in found.trials if one.status == "stopped early"}
    again = wlr_gym.resume_sweep(tmp_path / "out")
    assert stopped == {one.trial.name: one.steps for one in again.trials if one.status == "stopped early"}
    for one in again.ranking[0].results:
        assert_like_alone(one, tmp_path / f"alone_{one.trial.seed}", settings)


def test_no_cluster_answers(tmp_path):
    with pytest.raises(InputError, match=r"--ray 127.0.0.1:1: no Ray cluster answers"):
        wlr_gym.sweep(ENVIRONMENT, tmp_path / "out", ray="127.0.0.1:1")
    assert Path(tmp_path / "out" / "sweep.yaml").is_file()  # to be resumed when there is one
