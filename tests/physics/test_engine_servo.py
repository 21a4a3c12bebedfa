"""Servos of a robot held in the air against the closed forms of the DC motor and of gear friction; delays and zero errors."""

import numpy as np
import pytest
from rig import (
    HOME,
    LEG_COM,
    LEG_MASS,
    LEG_PITCH_INERTIA,
    ROBOT,
    STEPS,
    WHEEL_INERTIA,
    WHEEL_MASS,
    drive,
    lift,
    make_plant,
    wheels_off,
)

from wlr_gym.physics import servo

LEG = ROBOT.servo.leg
WHEEL = ROBOT.servo.wheel
#: A leg's inertia about its hip; its free wheel is dragged along by disc and rotor in series.
LEG_INERTIA = (
    LEG.armature
    + LEG_PITCH_INERTIA
    + LEG_MASS * LEG_COM**2
    + WHEEL_MASS * ROBOT.leg.length**2
    + ROBOT.wheel.spin_inertia * WHEEL.armature / WHEEL_INERTIA
)


#: Weightless, with a body too heavy to move, gears without friction.
IN_THE_AIR = {"gravity": 0.0, "body.mass": 100.0, "body.inertia": 10.0, "servo.coulomb_friction": 0.0}


def damping(motor):
    constant, resistance = servo.motor_constants(motor.stall_torque, motor.no_load_speed, 12.0)
    return constant**2 / resistance


@pytest.mark.parametrize("step", STEPS)
def test_wheel_at_full_voltage_follows_the_dc_motor(step):
    """w(t) = w_0 (1 - exp(-t/T)), T = J R / K^2; the second robot has a rotor 30 times as heavy."""
    rotors = WHEEL.armature * np.array([1.0, 30.0])
    sign = np.array([1.0, -1.0, 1.0, -1.0])
    setpoints = np.concatenate([HOME[:4], 100.0 * sign])
    plant = make_plant(2, [IN_THE_AIR, {"servo.armature of wheels": rotors[:, None]}], lift, step=step, period=4e-3)
    inertia = ROBOT.wheel.spin_inertia + rotors
    for tick in range(1, 11):
        truth = drive(plant, 4e-3, setpoints)
        expected = WHEEL.no_load_speed * (1 - np.exp(-4e-3 * tick * damping(WHEEL) / inertia))
        np.testing.assert_allclose(sign * truth.joint_velocity[:, 4:], np.tile(expected[:, None], (1, 4)), rtol=1e-3)


@pytest.mark.parametrize("step", STEPS)
def test_leg_at_full_voltage_follows_the_dc_motor(step):
    """A step of 2.5 rad: the voltage stays at its limit, so that the speed rises as a first-order lag."""
    plant = make_plant(2, IN_THE_AIR, lift, step=step, period=4e-3)
    sign = np.array([1.0, -1.0, 1.0, -1.0])
    setpoints = np.concatenate([HOME[:4] + 2.5 * sign, np.zeros(4)])
    for tick in range(1, 11):
        truth = drive(plant, 4e-3, setpoints, wheels_off(2))
        expected = LEG.no_load_speed * (1 - np.exp(-4e-3 * tick * damping(LEG) / LEG_INERTIA))
        np.testing.assert_allclose(truth.joint_velocity[:, :4], np.tile(expected * sign, (2, 1)), rtol=2e-3)


@pytest.mark.parametrize("step", STEPS)
def test_free_wheel_without_torque(step):
    """Motors off: no loss, viscous friction w_0 exp(-b t/J), Coulomb friction w_0 - c t/J and then rest, exactly."""
    start, time = 5.0, 0.04
    viscous, coulomb = np.array([0.0, 0.003, 0.0, 0.0]), np.array([0.0, 0.0, 0.02, 0.02])
    losses = {"servo.viscous_friction of wheels": viscous[:, None], "servo.coulomb_friction of wheels": coulomb[:, None]}

    def place(state):
        lift(state)
        state.joint_velocity[:, 4:] = start

    plant = make_plant(4, [IN_THE_AIR, losses], place, step=step, period=4e-3)
    rate = drive(plant, time, torque_on=wheels_off(4)).joint_velocity[:, 4:]
    np.testing.assert_allclose(rate[0], start, rtol=1e-4)
    # the implicit weight of the damping is fitted to a motor that is on: first order for one that is off
    np.testing.assert_allclose(rate[1], start * np.exp(-viscous[1] * time / WHEEL_INERTIA), rtol=1.5 * step)
    np.testing.assert_allclose(rate[2], start - coulomb[2] * time / WHEEL_INERTIA, rtol=1e-3)
    rate = drive(plant, 2.0 * time, torque_on=wheels_off(4)).joint_velocity[:, 4:]
    assert np.abs(rate[2]).max() < 1e-12


def test_gear_friction_holds_a_leg_against_less_torque():
    """A goal so near that kp (goal - q) K/R stays below the Coulomb friction does not move the joint; farther, it does."""
    constant, resistance = servo.motor_constants(LEG.stall_torque, LEG.no_load_speed, 12.0)
    reach = 0.1 / (LEG.kp * constant / resistance)
    setpoints = np.tile(HOME, (2, 1))
    setpoints[:, :4] += np.array([[0.98], [1.1]]) * reach
    plant = make_plant(2, [IN_THE_AIR, {"servo.coulomb_friction": 0.1}], lift)
    moved = drive(plant, 0.5, setpoints).joint_position[:, :4] - np.pi / 2
    assert np.abs(moved[0]).max() < 1e-12
    assert moved[1].min() > 0.01 * reach


def test_zero_offset_is_reading_minus_truth_and_the_servo_regulates_the_reading():
    offset = np.array([0.1, -0.05, 0.0, 0.2])
    plant = make_plant(2, [IN_THE_AIR, {"joint.zero_offset": offset}], lift)
    setpoints = np.concatenate([np.full(4, 1.2), np.zeros(4)])
    truth = drive(plant, 1.0, setpoints)
    reading = plant.step(np.tile(setpoints, (2, 1)))
    np.testing.assert_allclose(truth.joint_position[:, :4], np.tile(1.2 - offset, (2, 1)), atol=1e-6)
    np.testing.assert_allclose(reading.joint_position[:, :4], 1.2, atol=1e-6)


GOALS = np.concatenate([[1.0, 1.2, 1.9, 2.1], [3.0, -2.0, 4.0, 1.0]])


@pytest.mark.parametrize("milliseconds", [7, 20, 50, 133])
def test_delay_shifts_the_response_by_exactly_the_delay(milliseconds):
    """20 ms ticks with a delay against 1 ms ticks without: equal to rounding, for whole and broken numbers of ticks."""
    delayed = make_plant(2, [IN_THE_AIR, {"command.delay": 1e-3 * milliseconds}], lift)
    prompt = make_plant(2, IN_THE_AIR, lift, period=1e-3)
    ticks = milliseconds // 20 + 3
    truth = drive(delayed, 0.02 * ticks, GOALS)
    expected = drive(prompt, 1e-3 * (20 * ticks - milliseconds), GOALS)
    np.testing.assert_allclose(truth.joint_position, expected.joint_position, atol=1e-13)
    np.testing.assert_allclose(truth.joint_velocity, expected.joint_velocity, atol=1e-11)
    assert np.abs(truth.joint_velocity).max() > 0.1


def test_delay_is_per_joint_and_per_robot():
    plant = make_plant(2, [IN_THE_AIR, {"command.delay[leg_lr]": [0.0, 0.1]}], lift)
    moved = np.abs(drive(plant, 0.06, GOALS).joint_velocity) > 1e-3
    assert moved[0].all()
    assert not moved[1, 2]
    assert moved[1, [0, 1, 3]].all()


def test_supply_voltage_and_stall_torque_set_top_speed():
    """No-load speed is proportional to the supply voltage; the stall torque does not change it."""
    torque = np.repeat([LEG.stall_torque, WHEEL.stall_torque], 4) * np.array([[1.0], [1.0], [0.5]])
    plant = make_plant(3, [IN_THE_AIR, {"servo.supply_voltage": [12.0, 9.0, 12.0], "servo.stall_torque": torque}], lift)
    rate = drive(plant, 1.0, np.concatenate([HOME[:4], np.full(4, 100.0)])).joint_velocity[:, 4:]
    expected = WHEEL.no_load_speed * np.array([1.0, 0.75, 1.0])
    np.testing.assert_allclose(rate, np.tile(expected[:, None], (1, 4)), rtol=1e-3)
