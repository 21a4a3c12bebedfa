"""Accuracy against speed: the reference is what both simulators converge to, and ratios compare settings of equal error."""

import numpy as np
import pytest

from studies.bench.engine import (
    KINDS,
    EngineSetting,
    distance,
    make_reference,
    motions,
    pairs,
    prepare,
    reference_text,
    row_of,
    save_picture,
    settings_table,
)
from wlr_gym.robot import load_robot

ROBOT = load_robot()
HIP = np.array([0.2, 0.1, 0.0])
TUNED = EngineSetting("MuJoCo", 5e-4, contact="tuned", cone="elliptic", integrator="implicitfast")


@pytest.fixture(scope="module")
def short():
    """All motions within 0.2 s, and what both simulators converge to."""
    chosen = motions(ROBOT, ticks=10)
    return chosen, make_reference(chosen, engine=(1e-4, 5e-5), peer=(5e-4, 2.5e-4))


def test_the_limits_of_both_simulators_agree(short):
    _, reference = short
    assert reference.disagreement.max() < 5e-6
    assert reference.disagreement.max() < 0.5 * reference.convergence.max()  # extrapolation is closer than any step


def test_another_mujoco_robot_converges_to_the_same_limit(short):
    """Servos as MuJoCo's actuators and its own contact point: nothing shared with the plant but the masses."""
    chosen, reference = short
    apart = distance(prepare(TUNED, chosen, 1)()[0], reference.pose, HIP)
    assert np.median(apart) < 1.5e-5
    assert apart.max() < 2e-4
    coarse = prepare(EngineSetting("MuJoCo", 1e-3, cone="elliptic"), chosen, 1)()[0]
    assert distance(coarse, reference.pose, HIP).max() > 5e-4


def test_rollout_and_batch_are_the_same_simulation(short):
    chosen, _ = short
    rollouts = [EngineSetting("MuJoCo", 1e-3, call="rollout", threads=threads) for threads in (1, 2)]
    poses = [prepare(setting, chosen, 1)()[0] for setting in (EngineSetting("MuJoCo", 1e-3), *rollouts)]
    np.testing.assert_array_equal(poses[0], poses[1])
    np.testing.assert_array_equal(poses[0], poses[2])


def test_locked_wheels_slide_as_far_as_the_closed_form_says():
    chosen = [motion for motion in motions(ROBOT) if motion.distance is not None]
    pose, _ = prepare(EngineSetting("engine", 1e-3, iterations=4, contact="own"), chosen, 1)()
    assert len(chosen) == 2
    np.testing.assert_allclose(np.linalg.norm(pose[:, :2], axis=1), [motion.distance or 0.0 for motion in chosen], rtol=5e-3)


def _result(side, step, error, speed, **others):
    contact, cone, integrator = ("own", "elliptic", "Euler") if side == "engine" else ("default", "pyramidal", "Euler")
    upright, precision = others.pop("upright", True), others.pop("precision", "float64")
    iterations = 4 if side == "engine" else 100
    setting = EngineSetting(side, step, precision, iterations, contact, cone, integrator)
    return row_of(setting, np.full(10, error), upright, (speed, 2 * speed, 3 * speed))


RESULTS = [
    _result("engine", 1e-3, 2e-5, 1000.0),
    _result("engine", 4e-3, 3e-4, 3000.0),
    _result("engine", 1e-3, 2e-5, 2000.0, precision="float32"),
    _result("MuJoCo", 1e-3, 1.5e-2, 50.0),
    _result("MuJoCo", 5e-4, 9e-5, 10.0),
    _result("MuJoCo", 4e-3, 4e-4, 200.0, upright=False),
]


def test_ratios_compare_the_fastest_that_stay_upright_at_equal_error():
    found = {row.what.partition(":")[0]: row for row in pairs(RESULTS)}
    assert found["float64, error at most 0.1 mm"].ratios == (100.0,) * 3
    assert found["float64, error at most 0.5 mm"].ratios == (300.0,) * 3  # MuJoCo at 4 ms falls
    assert found["float64, error at most 25 mm"].ratios == (60.0,) * 3
    assert found["float64, both at 1 ms, MuJoCo's defaults"].ratios == (20.0,) * 3
    assert found["float32, both at 1 ms, MuJoCo's defaults"].ratios == (40.0,) * 3
    assert "1 ms, pyramidal, default contact, Euler" in found["float64, error at most 25 mm"].peer_name


def test_table_and_picture_are_made_from_the_report(short, tmp_path):
    _, reference = short
    report = {"reference": reference.summary(), "settings": RESULTS}
    _, rows = settings_table(report)
    assert ("MuJoCo", "4 ms, pyramidal, default contact, Euler", "float64", "falls", "falls", "400 [200..600]") in rows
    assert "Not measured, for want of a GPU" in reference_text(report)
    save_picture(report, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
    assert KINDS[0] == ("pyramidal", "default", "Euler")
