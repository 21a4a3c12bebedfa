"""Both tests without slip: the numbers that follow from geometry, profile and statics alone (audit, section 5)."""

import math
from dataclasses import replace

import numpy as np
import pytest

from studies.paper import printed
from studies.paper.experiments import (
    DURATION,
    LEG_SPEED,
    STOP_TIME,
    TESTS,
    WHEEL_ACCELERATION,
    WHEEL_SPEED,
    ideal_motion,
)
from studies.paper.quantities import PaperConstants

ONE, TWO = (ideal_motion(test) for test in TESTS.values())
RPM = 60 / (2 * math.pi)


def at(motion, time):
    return int(np.argmin(np.abs(motion.time - time)))


def test_commands_are_whole_register_counts():
    assert pytest.approx(80 * 0.229) == WHEEL_SPEED * RPM
    assert pytest.approx(214.577) == WHEEL_ACCELERATION * 3600 / (2 * math.pi)
    assert pytest.approx(15 * 0.229) == LEG_SPEED * RPM
    assert pytest.approx(18.223, abs=1e-3) == DURATION
    assert math.radians(120) / LEG_SPEED == pytest.approx(5.8224, abs=1e-4)


def test_goals_are_what_the_paper_commands():
    for name, test in TESTS.items():
        setpoints = TESTS[name].motion().setpoints
        assert np.isnan(setpoints[:, 6:]).all()
        rest = int(1.0 / 0.02)
        np.testing.assert_allclose(np.degrees(setpoints[rest - 1, :4]), np.degrees(np.repeat(test.start, 2)))
        np.testing.assert_allclose(np.degrees(setpoints[rest, :4]), np.degrees(np.repeat(test.end, 2)))
        driving = setpoints[:, 4] > 0.0
        assert driving.sum() * 0.02 == pytest.approx(STOP_TIME, abs=0.01)
        assert set(setpoints[driving, 4]) == {WHEEL_SPEED}


def test_travel_and_turns():
    assert ONE.x[-1] == pytest.approx(0.8545, abs=1e-4)
    assert TWO.x[-1] == pytest.approx(1.1595, abs=1e-4)
    np.testing.assert_allclose(ONE.wheels[-1] / (2 * np.pi), [4, 4, 2.572, 2.572], atol=1e-3)
    np.testing.assert_allclose(TWO.wheels[-1] / (2 * np.pi), [4, 4, 6.856, 6.856], atol=1e-3)
    assert ONE.u[:, 0].max() == pytest.approx(0.065, abs=1e-3)
    assert TWO.u[:, 0].max() == pytest.approx(0.111, abs=2e-3)
    assert ONE.u[at(ONE, 0.11), 9] * RPM == pytest.approx(-10.3, abs=0.3)
    assert TWO.u[at(TWO, 0.11), 9] * RPM == pytest.approx(20.5, abs=1.2)


def test_posture():
    assert math.degrees(ONE.posture.pitch.max()) == pytest.approx(8.40, abs=0.01)
    assert np.abs(TWO.posture.pitch).max() < 1e-12
    np.testing.assert_allclose([ONE.posture.height[0], ONE.posture.height.max()], [0.1015, 0.1434], atol=1e-4)
    np.testing.assert_allclose([TWO.posture.height[0], TWO.posture.height.max()], [0.1015, 0.1690], atol=1e-4)
    np.testing.assert_allclose([ONE.posture.wheelbase[0], ONE.posture.wheelbase[-1]], [0.350, 0.584], atol=1e-3)
    np.testing.assert_allclose([TWO.posture.wheelbase[0], TWO.posture.wheelbase[-1]], [0.584, 0.116], atol=1e-3)
    assert TWO.posture.wheelbase[-1] > 2 * PaperConstants().a  # wheels do not touch


def test_loads_and_torques():
    one, two = ONE.inverse_dynamics(), TWO.inverse_dynamics()
    np.testing.assert_allclose(one.normal[0, [0, 2]], [2.606, 12.109], atol=1e-3)
    np.testing.assert_allclose(one.normal[-1], 7.3575, atol=1e-4)
    np.testing.assert_allclose(two.normal[[0, -1]], 7.3575, atol=1e-4)
    np.testing.assert_allclose(one.leg_torque[0] / 2, [0.276, 1.387], atol=1e-3)
    np.testing.assert_allclose(one.leg_torque[-1] / 2, [0.832, -0.832], atol=1e-3)
    np.testing.assert_allclose(two.leg_torque[[0, -1]] / 2, [[0.832, -0.832], [-0.832, 0.832]], atol=1e-3)
    assert np.abs(one.lateral).max() < 1e-12


@pytest.mark.parametrize("motion", [ONE, TWO])
def test_commands_cannot_cause_coulomb_slip(motion):
    """Friction needed over load: 0.007, and 0.1 during a leg start of 0.1 s; the robot never tips."""
    forces = motion.inverse_dynamics()
    needed = np.abs(forces.along / forces.normal).max(axis=1)
    calm = (motion.time > 0.3) & (np.abs(motion.time - 5.87) > 0.2)
    assert needed[calm].max() < 0.0071
    assert needed.max() < 0.102
    assert forces.normal.min() > 2.4


@pytest.mark.parametrize(("motion", "largest"), [(ONE, 2.89), (TWO, 2.0)])
def test_printed_torques_are_a_thousandth_of_the_true_ones(motion, largest):
    """With absolute wheel angles, as (3) takes them.

    The audit's bound of 2e-4 N m holds away from leg starts only; in a leg start of 0.1 s, 2 I_ly alpha'' alone is 9e-4.
    """
    s = motion.state()
    absolute = {wheel: s.theta_dd[wheel] + s.absolute_leg(wheel)[2] for wheel in s.theta_dd}
    found = printed.forces_as_used(motion.constants, replace(s, theta_dd=absolute))
    torque = np.abs([found["tau_alpha"], found["tau_beta"]])
    assert np.abs(motion.inverse_dynamics().leg_torque).max() == pytest.approx(largest, abs=0.05)
    calm = (motion.time > 0.3) & (np.abs(motion.time - 5.87) > 0.2)
    assert torque[:, calm].max() < 2e-4
    assert 9e-4 - 5e-5 < torque.max() < 5e-3


def test_the_force_of_28_as_printed_has_a_pole():
    """Its denominator passes zero while the rear legs turn."""
    force = printed.forces_as_used(ONE.constants, ONE.state())["x"]
    assert np.abs(force["lr"]).max() > 100 * np.abs(force["rr"]).max()


def test_rotor_of_a_free_wheel_takes_little():
    """Audit: 3e-3 N m in a leg start of the first test; in the second, twice that."""
    peaks = [np.abs(m.u_dot[:, 9] * m.constants.I_o).max() for m in (ONE, TWO)]
    np.testing.assert_allclose(peaks, [3.1e-3, 6.5e-3], rtol=0.1)


def test_the_traction_that_21_to_24_lack_is_most_of_a_front_wheels_torque():
    """Cruising up: a F_x against I_o (theta'' + ...), which is all that the printed equations keep on a true motion."""
    found = ONE.inverse_dynamics()
    k = at(ONE, 3.0)
    traction = abs(PaperConstants().a * found.along[k, 0])
    assert traction > 0.8 * abs(found.wheel_torque[k, 0])
    s = ONE.state()
    absolute = {wheel: s.theta_dd[wheel] + s.absolute_leg(wheel)[2] for wheel in s.theta_dd}
    left = printed.eq21_torque_of_the_right_front_wheel(ONE.constants, replace(s, theta_dd=absolute))[k]
    assert left == pytest.approx(PaperConstants().I_o * absolute["rf"][k], rel=1e-3)
