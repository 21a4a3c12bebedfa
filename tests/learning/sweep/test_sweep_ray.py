"""Sweeps on Ray: two nodes on this machine, one of which dies; searches."""

import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest
from sweep_runs import ENVIRONMENT, SETTINGS, assert_like_alone, checkpoints, trials_at_work
from waiting import LONGEST, wait_until

import wlr_gym
from wlr_gym.base.errors import InputError

pytest.importorskip("torch")
ray = pytest.importorskip("ray")

UNSCORED = SETTINGS | {"evaluate_every": 0}


@pytest.fixture(scope="module", autouse=True)
def patient_ray():
    """Other tests may fill memory and cores: Ray kills no process for it and gives no slow node up."""
    from ray._private import services
    from ray.cluster_utils import Cluster

    ask = services.get_node

    def ask_until_there(*arguments):
        found = []

        def there():
            with suppress(RuntimeError):
                found.append(ask(*arguments))
            return found

        wait_until(there)
        return found[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")
        patch.setenv("RAY_health_check_timeout_ms", "60000")
        patch.setenv("RAY_gcs_server_port_wait_time_s", f"{LONGEST:.0f}")
        patch.setattr(services, "get_node", ask_until_there)  # 30 s, whatever the machine does
        patch.setattr(Cluster._wait_for_node, "__defaults__", (LONGEST,))
        yield


@pytest.fixture(scope="module")
def cluster(hold_file):
    """One node with one core."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    yield made
    made.shutdown()


@pytest.mark.slow
def test_a_node_dies_in_mid_run_and_the_sweep_ends_complete(cluster, hold, tmp_path):
    """Three trials on two nodes; results as of the same trainings alone, to the bit."""
    node, out = cluster.add_node(num_cpus=1), tmp_path / "out"
    hold.touch()

    def kill_the_node():
        try:
            wait_until(lambda: len(checkpoints(out)) == 2)  # both nodes are at work
            cluster.remove_node(node, allow_graceful=False)
            wait_until(lambda: trials_at_work(hold) < 2)  # here a trial outlives its node by a moment, enough to be done
        finally:
            hold.unlink()  # or the sweep would wait for ever

    with ThreadPoolExecutor(1) as beside:
        killing = beside.submit(kill_the_node)
        space = {"gamma": [0.9, 0.95, 0.97]}
        found = wlr_gym.sweep(ENVIRONMENT, out, settings=UNSCORED, space=space, seeds=1, ray=cluster.address)
        killing.result()
    assert [one.status for one in found.trials] == ["done"] * 3
    assert sum((one.folder / "provenance_resumed.yaml").is_file() for one in found.trials) == 1  # the one that was there
    for one in found.trials:
        assert_like_alone(one, tmp_path / "alone" / one.trial.name, UNSCORED)


@pytest.mark.slow
def test_a_killed_driver_resumes(cluster, hold, tmp_path):
    out = tmp_path / "out"
    arguments = f"{ENVIRONMENT!r}, {str(out)!r}, settings={UNSCORED!r}, seeds=1, ray={cluster.address!r}"
    hold.touch()
    driver = subprocess.Popen([sys.executable, "-c", f"import wlr_gym\nwlr_gym.sweep({arguments})"])
    wait_until(lambda: checkpoints(out), driver)
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    hold.unlink()
    found = wlr_gym.resume_sweep(out, ray=cluster.address)
    assert [one.status for one in found.trials] == ["done"]
    assert (found.trials[0].folder / "provenance_resumed.yaml").is_file()
    assert_like_alone(found.trials[0], tmp_path / "alone", UNSCORED)


@pytest.mark.slow
def test_a_search_stops_early_repeats_the_best_and_resumes(hold, tmp_path):
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


def test_ray_that_cannot_be_started_is_said(tmp_path, monkeypatch):
    def init(**options):
        raise Exception("The current node timed out during startup.\nMore of it.")

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(InputError, match=r"--ray local: Ray cannot be started: The current node timed out during startup\.$"):
        wlr_gym.sweep(ENVIRONMENT, tmp_path / "out", ray="local")
