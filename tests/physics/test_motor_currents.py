"""Currents of motors: against a circuit computed here, and in the energy and the supply of both simulators."""

import numpy as np
import pytest
from rig import BACKENDS, LEGS_DOWN, drive, float_in_space, lift, lock, make_plant

from wlr_gym.base.errors import InputError
from wlr_gym.physics import servo
from wlr_gym.robot import Robot, load_robot
from wlr_gym.robot.parameters import Parameters

NOMINAL, EMANUAL = load_robot(), load_robot("emanual")
SUPPLY, TICK = 12.0, 0.02
#: N m, rad/s, A, A of the e-manual at 12 V (no-load currents: chosen), legs and wheels.
LEG, WHEEL = (7.3, 5.55, 4.4, 0.24), (1.5, 6.388, 1.4, 0.10)


def changed(**motor):
    data = EMANUAL.model_dump()
    data["servo"]["leg"].update(motor)
    return Robot.model_validate(data)


@pytest.mark.parametrize(("motor", "k"), [(LEG, 0), (WHEEL, 4)])
def test_current_is_that_of_a_winding_with_a_back_emf(motor, k):
    """Resistance from stall, back-EMF from no load: I = (v - K_e w)/R at every voltage and rate."""
    torque, speed, stall, idle = motor
    resistance = SUPPLY / stall
    back_emf = (SUPPLY - resistance * idle) / speed
    law = servo.current_law(EMANUAL)
    for volt in (-12.0, -3.0, 0.0, 5.0, 12.0):
        for rate in (-8.0, -1.0, 0.0, 2.0, speed):
            on_the_line = torque * (volt / SUPPLY - rate / speed)
            found = law.current(np.full(8, on_the_line), np.full(8, rate))[k]
            assert found == pytest.approx((volt - back_emf * rate) / resistance, abs=1e-12)
    constants, resistances = servo.winding(EMANUAL)
    assert (constants[k], resistances[k]) == pytest.approx((back_emf, resistance), rel=1e-12)


def test_the_ends_of_the_line_are_those_of_the_data_sheet():
    law = servo.current_law(EMANUAL)
    stall = law.current([7.3] * 4 + [1.5] * 4, np.zeros(8))
    idle = law.current(np.zeros(8), [5.55] * 4 + [6.388] * 4)
    np.testing.assert_allclose(stall, [4.4] * 4 + [1.4] * 4, rtol=1e-12)
    np.testing.assert_allclose(idle, [0.24] * 4 + [0.10] * 4, rtol=1e-12)
    assert law.torque_constant[0] == pytest.approx(1.659, abs=5e-4)  # as the e-manual prints it


def test_a_robot_file_without_currents_has_one_constant_as_before():
    law, (constant, resistance) = servo.current_law(NOMINAL), servo.line_constants(NOMINAL)
    assert (law.torque_constant == constant).all()
    assert not law.idle.any()
    assert all((a == b).all() for a, b in zip(servo.winding(NOMINAL), (constant, resistance), strict=True))
    assert (constant == np.repeat([12.0 / 5.55, 12.0 / 6.388], 4)).all()
    assert servo.effort_counts(NOMINAL)[0] == 2.69e-3 * (12.0 / 5.55)


def test_no_motor_gives_more_than_it_takes():
    """Over the full range of voltage and rate, driven and braked."""
    volt, rate = np.meshgrid(np.linspace(-12.0, 12.0, 101), np.linspace(-12.0, 12.0, 101))
    law = servo.current_law(EMANUAL)
    for (torque, speed, *_), k in ((LEG, 0), (WHEEL, 4)):
        shaft = torque * (volt / SUPPLY - rate / speed)
        current = shaft / law.torque_constant[k] + law.idle[k] * rate
        assert (volt * current - shaft * rate).min() >= -1e-9


@pytest.mark.parametrize(
    ("motor", "words"),
    [
        ({"stall_current": None}, r"servo.leg.no_load_current: expected stall_current beside it"),
        ({"no_load_current": None}, r"servo.leg.stall_current: expected no_load_current beside it"),
        ({"stall_current": 4400}, r"servo.leg.stall_current = 4400 A: expected 100 A at most; is it in mA\?"),
        ({"no_load_current": 4.4}, r"no_load_current = 4.4 A: expected less than stall_current, 4.4 A"),
        ({"stall_current": 1.0}, r"stall_current = 1 A: .* expected at least 1.82 A"),
        ({"stall_current": -1.0}, "greater than 0"),
    ],
)
def test_refusals(motor, words):
    with pytest.raises((InputError, ValueError), match=words):
        changed(**motor)


# ---- in the simulators


def held(backend, robot, seconds, setpoints, edit, place=None):
    """Truth and readings of one robot after ``seconds`` of ``setpoints``."""
    plant = make_plant(1, edit, place, backend=backend, robot=robot)
    drive(plant, seconds - TICK, setpoints)
    sensors = plant.step(np.asarray(setpoints, np.float64)[None])
    return plant.truth(), sensors


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("robot", "current"), [(NOMINAL, 12.0 / (12.0 / 5.55 * 12.0 / 7.3)), (EMANUAL, 4.4)])
def test_energy_and_effort_of_stalled_legs(backend, robot, current):
    truth, sensors = held(backend, robot, 0.1, np.r_[LEGS_DOWN + 1.0, np.zeros(4)], lock)
    assert truth.electrical_energy[0] == pytest.approx(4 * SUPPLY * current * TICK, rel=5e-5)  # MuJoCo's dry friction creeps
    np.testing.assert_allclose(sensors.joint_effort[0, :4], 7.3, atol=0.5 * servo.effort_counts(robot)[0])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("robot", "current"), [(NOMINAL, 0.0), (EMANUAL, 0.10)])
def test_energy_of_free_wheels_at_full_speed(backend, robot, current):
    truth, sensors = held(backend, robot, 1.5, np.r_[LEGS_DOWN, np.full(4, 20.0)], float_in_space, lift)
    np.testing.assert_allclose(truth.joint_velocity[0, 4:], 6.388, rtol=1e-3)
    assert truth.electrical_energy[0] == pytest.approx(4 * SUPPLY * current * TICK, abs=2e-3)
    np.testing.assert_allclose(sensors.joint_effort[0, 4:], 0.0, atol=2e-3)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("robot", "winding"), [(NOMINAL, 12.0**2 / 5.55 / 7.3), (EMANUAL, 12.0 / 4.4)])
def test_supply_sags_by_the_currents(backend, robot, winding):
    edit = [lock, {"servo.supply_resistance": 0.1}]
    _, sensors = held(backend, robot, 0.2, np.r_[LEGS_DOWN + 1.0, np.zeros(4)], edit)
    assert sensors.supply_voltage[0] == pytest.approx(SUPPLY / (1.0 + 4 * 0.1 / winding), abs=0.06)


@pytest.mark.parametrize("backend", BACKENDS)
def test_motion_is_the_same_to_the_bit(backend):
    wishes = np.random.default_rng(3).uniform([1.2] * 4 + [-5.0] * 4, [1.9] * 4 + [5.0] * 4, (25, 8))
    found = []
    for robot in (NOMINAL, EMANUAL):
        plant = make_plant(1, backend=backend, robot=robot)
        for wish in wishes:
            plant.step(wish[None])
        truth = plant.truth()
        found.append(np.r_[truth.position[0], truth.joint_position[0], truth.joint_velocity[0], truth.motor_torque[0]])
    assert (found[0] == found[1]).all()


# ---- cycle of the wheels' integral


def test_twice_the_cycle_is_half_the_integral_gain():
    slow, weak = Parameters.nominal(NOMINAL), Parameters.nominal(NOMINAL)
    assert (servo.position_gains(slow) == slow["servo.kp"]).all()
    slow["servo.integral_cycle"] = 2e-3
    weak["servo.kp"][:, 4:] /= 2.0
    assert (servo.position_gains(slow) == weak["servo.kp"]).all()


@pytest.mark.parametrize("cycle", [0.5e-3, 1e-3, 2e-3])
def test_what_is_left_of_a_speed_step_decays_as_the_page_says(cycle):
    """docs/robot.md: rate = gain/(kd + K), of a free wheel; from it the cycle is measured."""
    edit = [float_in_space, {"servo.integral_cycle": cycle}]
    wishes = np.r_[LEGS_DOWN, np.full(4, 2.0)]
    truths = [held("gibbs_appell", NOMINAL, seconds, wishes, edit, lift)[0] for seconds in (0.2, 0.4)]
    left = [2.0 - truth.joint_velocity[0, 4] for truth in truths]
    rate = np.log(left[0] / left[1]) / 0.2
    assert 8.63 / (0.4418 + 12.0 / 6.388) / rate * 1e-3 == pytest.approx(cycle, rel=0.03)
