"""``python -m studies.bench sysid``: both sides solve the same problem. No test looks at a time."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo fills its namespace when it is imported.)
import json

import numpy as np
import pytest

from studies.bench import sysid
from studies.bench.__main__ import main
from studies.bench.sysid_contest import Contest, Fitted, rows, settled
from wlr_gym.base.errors import MissingPackageError
from wlr_gym.gap.estimation.fit import CONVERGED
from wlr_gym.gap.problem import Quantity, Setting

mujoco_sysid = pytest.importorskip("mujoco.sysid")
needs_sysid = pytest.mark.skipif(not hasattr(mujoco_sysid, "optimize"), reason="MuJoCo lacks what its calibration needs")


@pytest.fixture(scope="module")
def rig():
    from studies.bench.sysid_rig import make_rig

    return make_rig(seconds=3.0)


def predicted_by_peer(run, values, integrator=None):
    """Residuals (rows,) of the peer's run at these numbers, from MuJoCo's own rollout."""
    import mujoco
    from mujoco import rollout

    model = run.build(values)
    if integrator is not None:
        model.opt.integrator = integrator
    state, _ = rollout.rollout(model, mujoco.MjData(model), run.start[None], run.control[None, :-1])
    return run.residual(values, np.asarray(state)[0])


def test_both_sides_have_the_same_pendulum(rig):
    """With an integrator of the fourth order MuJoCo swings as ours does, at any numbers: within one count of the encoder."""
    import mujoco

    from studies.bench.sysid_rig import peer_of

    problem, truth = rig
    other = np.array([q.nominal for q in problem.quantities])
    ours = problem.residuals([Setting(truth), Setting(other)], range(4))
    for run, own in zip(peer_of(problem).runs, ours, strict=True):
        for values, mine in zip((truth, other), own, strict=True):
            exact = predicted_by_peer(run, values, mujoco.mjtIntegrator.mjINT_RK4)
            assert np.abs(exact - mine[1:, 0]).max() < 1.0
        assert np.abs(own[1] - own[0]).max() > 15.0


def test_recordings_have_the_encoders_noise_and_nothing_else(rig):
    problem, truth = rig
    for residual in problem.residuals([Setting(truth)], range(4)):
        assert 0.9 < np.sqrt(np.mean(residual**2)) < 1.1


def in_tolerances(contest, found):
    return (found.values - contest.truth) / [quantity.sigma for quantity in contest.quantities]


def test_ours_recovers_the_numbers():
    from studies.bench.sysid_rig import rig_contest

    contest = rig_contest(seconds=3.0)
    start = Fitted(np.array([quantity.nominal for quantity in contest.quantities]), 0.0, 0.0)
    assert contest.error(contest.ours()) < 20.0 < contest.error(start)


@pytest.mark.slow
@needs_sysid
def test_peer_recovers_the_numbers_and_is_silent(capsys):
    from studies.bench.sysid_rig import rig_contest

    contest = rig_contest(seconds=3.0)
    peer = contest.peers["mujoco.sysid, scipy"]()
    assert 0.0 < peer.settled <= peer.seconds
    length = [q.name for q in contest.quantities].index("length_error")  # takes on what a first-order integrator gets wrong
    assert np.abs(np.delete(in_tolerances(contest, peer), length)).max() < 0.25
    assert capsys.readouterr().out == ""


@pytest.fixture(scope="module")
def robot():
    from studies.bench.sysid_robot import make_robot

    return make_robot(seconds=2.0)


def test_both_sides_have_the_same_robot(robot):
    """At the true numbers both are near the sensors' noise: nearer than at nominal, where they agree about what is off."""
    from studies.bench.sysid_robot import peer_of

    problem, truth = robot
    nominal = np.array([q.nominal for q in problem.quantities])
    ours = problem.residuals([Setting(truth), Setting(nominal)], range(len(problem.runs)))
    for run, own in zip(peer_of(problem).runs, np.nan_to_num(ours), strict=True):
        peer = np.stack([predicted_by_peer(run, values) for values in (truth, nominal)])
        level = np.sqrt([np.mean(each[..., compared(each)] ** 2, axis=(1, 2)) for each in (own, peer)])
        assert (level[:, 0] < 2.2).all(), level
        assert (level[:, 0] < level[:, 1]).all(), level


def compared(residuals):
    """Channels (of the last axis) in which something is compared."""
    return np.abs(residuals).max(axis=(0, 1)) > 0.0


@needs_sysid
def test_command_reports_both_systems(monkeypatch, tmp_path):
    from studies.bench import sysid_rig, sysid_robot

    monkeypatch.setattr(sysid_rig, "rig_contest", lambda seconds: toy_contest("pendulum"))
    monkeypatch.setattr(sysid_robot, "robot_contest", lambda seconds: toy_contest("robot"))
    file = tmp_path / "bench.json"
    assert main(["--rounds", "1", "--only", "sysid", "--save", str(file)]) == 0
    found = json.loads(file.read_text())["measurements"]
    assert [row["bar"] for row in found if row["peer"]] == [1.0, None, 1.0, None]
    assert {row["what"].split(",")[0] for row in found} == {"pendulum", "robot"}
    assert all(row["unit"] == "% of a tolerance" for row in found if not row["peer"])


def toy_contest(name):
    """Ours needs 1 s, the peers 4 s and 8 s, half of it to the same fit; a number is a tolerance off."""
    quantities = tuple(Quantity(key, "m", 0.0, sigma, -1.0, 1.0) for key, sigma in (("a", 0.1), ("b", 0.2)))
    ours = Fitted(np.array([0.1, 0.2]), 1.0, 1.0)
    fast, slow = (Fitted(np.array([0.1, 0.2]), seconds, seconds / 2) for seconds in (4.0, 8.0))
    return Contest(name, quantities, np.zeros(2), lambda: ours, {"fast": lambda: fast, "slow": lambda: slow})


def test_trace_settles_where_it_comes_near_its_least():
    assert settled([(1.0, 100.0), (2.0, 3.5 + 2.0 * CONVERGED), (3.0, 3.5 + 0.9 * CONVERGED), (4.0, 3.5)]) == 3.0


def test_bar_is_the_time_to_the_same_fit_and_error_the_worst_number():
    same, own, *errors = rows(toy_contest("toy"), rounds=2)
    assert (same.bar, own.bar) == (1.0, None)
    assert (same.ratios, own.ratios) == ((2.0, 2.0), (4.0, 4.0))
    assert same.peer_name == "fast"
    assert [error.ours for error in errors] == [(100.0, 100.0)] * 3


def test_says_what_to_install(monkeypatch):
    import mujoco.sysid

    monkeypatch.delattr(mujoco.sysid, "optimize", raising=False)
    with pytest.raises(MissingPackageError, match=r"mujoco\[sysid\]"):
        sysid.require_sysid()
