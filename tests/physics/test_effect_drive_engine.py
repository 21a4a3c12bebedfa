"""Effects of the joint drive in the engine: friction laws, ripple, weak motor, supply sag, against closed forms."""

import numpy as np
import pytest
from rig import ROBOT, drive, float_in_space, lift, make_plant, record, wheels_off

from wlr_gym.physics.plants.base import Truth
from wlr_gym.physics.servo import motor_constants

WHEEL = ROBOT.servo.wheel
V0 = ROBOT.servo.supply_voltage
K, R = motor_constants(WHEEL.stall_torque, WHEEL.no_load_speed, V0)
DOWN = np.full(4, np.pi / 2)


def bench(count, edit, **options):
    """Robots in space whose wheels turn against nothing but their gears; legs locked. ``kp`` 0: volts = kd (goal - rate)."""

    def change(parameters):
        float_in_space(parameters)
        parameters["servo.coulomb_friction"][:, :4] = 50.0
        parameters["servo.kp"][:, 4:] = 0.0
        parameters["servo.kd"][:, 4:] = 1.0
        edit(parameters)

    return make_plant(count, change, lift, **options)


def setpoints_for(volts):
    """Setpoints that put ``volts`` (N,) on resting wheels."""
    return np.concatenate([np.tile(DOWN, (len(volts), 1)), np.repeat(np.asarray(volts)[:, None], 4, axis=1)], axis=1)


def test_stribeck_breakaway_and_sliding_torque():
    coulomb, extra, speed = 0.03, 0.05, 0.5

    def edit(parameters):
        parameters["servo.coulomb_friction"][:, 4:] = coulomb
        parameters["servo.stribeck_torque"][:, 4:] = extra
        parameters["servo.stribeck_speed"][:, 4:] = speed

    volts = np.array([0.99, 1.01, 2.0, 4.0]) * (coulomb + extra) * R / K
    truth = drive(bench(4, edit), 3.0, setpoints_for(volts))
    rate, friction = np.abs(truth.joint_velocity[:, 4:]), np.abs(truth.friction_torque[:, 4:])
    assert rate[0].max() < 1e-12
    np.testing.assert_allclose(friction[0], 0.99 * (coulomb + extra), rtol=1e-6)
    assert rate[1].min() > 1e-3
    np.testing.assert_allclose(friction[1:], coulomb + extra * np.exp(-((rate[1:] / speed) ** 2)), rtol=1e-6)


def test_load_dependent_friction_grows_with_the_motors_torque():
    """Turning steadily, friction = torque, so that torque = c/(1 - k); at rest the bound is c + k |torque|."""
    coulomb, ratio = 0.02, 0.4

    def edit(parameters):
        parameters["servo.coulomb_friction"][:, 4:] = coulomb
        parameters["servo.load_friction"][:, 4:] = ratio

    breakaway = coulomb / (1.0 - ratio) * R / K
    truth = drive(bench(3, edit), 4.0, setpoints_for(np.array([0.99, 1.05, 2.0]) * breakaway))
    assert np.abs(truth.joint_velocity[0]).max() < 1e-12
    np.testing.assert_allclose(truth.motor_torque[1:, 4:], coulomb / (1.0 - ratio), rtol=1e-6)
    np.testing.assert_allclose(truth.friction_torque[1:, 4:], -coulomb / (1.0 - ratio), rtol=1e-6)


def test_torque_ripple_is_a_potential():
    """A coasting wheel obeys J w^2/2 + (A/n) cos(n q + phase) = const: period 2 pi/n, no mean work over a turn."""
    amplitude, order, phase, start = 0.002, 7.0, 0.4, 4.0

    def edit(parameters):
        parameters["servo.ripple_amplitude"][:, 4:] = amplitude
        parameters["servo.ripple_order"][:, 4:] = order
        parameters["servo.ripple_phase"][:, 4:] = phase
        parameters["body.inertia"] = 10.0
        parameters["body.mass"] = 100.0

    def spin(state):
        lift(state)
        state.joint_velocity[:, 4:] = start

    def prepare(parameters):
        float_in_space(parameters)
        _lock_legs(parameters)
        edit(parameters)

    plant = make_plant(2, prepare, spin, step=5e-4, period=1e-3)
    seen = [Truth(values) for values in record(plant, 2.5, np.concatenate([DOWN, np.zeros(4)]), wheels_off(2))]
    angle, rate = (np.array([getattr(t, name)[0, 4] for t in seen]) for name in ("joint_position", "joint_velocity"))
    inertia = WHEEL.armature + ROBOT.wheel.spin_inertia
    expected = start**2 + 2.0 * amplitude / (order * inertia) * (np.cos(phase) - np.cos(order * angle + phase))
    np.testing.assert_allclose(rate**2, expected, rtol=2e-4)
    assert np.ptp(rate**2) > 1.0
    assert angle[-1] > 2.0 * np.pi
    torque = np.array([t.motor_torque[0, 4] for t in seen])
    middle = angle - 0.25e-3 * rate  # of the last substep
    np.testing.assert_allclose(torque, amplitude * np.sin(order * middle + phase), atol=1e-4 * amplitude)


def _lock_legs(parameters):
    parameters["servo.coulomb_friction"][:, :4] = 50.0


def test_weak_motor_stalls_weaker_and_reports_the_same_effort():
    scale = np.array([1.0, 0.7, 0.0])

    def edit(parameters):
        parameters["servo.coulomb_friction"] = 50.0
        parameters["servo.torque_scale"][:, 4:] = scale[:, None]

    plant = bench(3, edit)
    sensors = plant.step(setpoints_for(np.full(3, 100.0)))
    torque = plant.truth().motor_torque[:, 4:]
    np.testing.assert_allclose(torque, np.repeat(scale[:, None], 4, axis=1) * WHEEL.stall_torque, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sensors.joint_effort[:, 4:], WHEEL.stall_torque, rtol=1e-9)
    np.testing.assert_allclose(plant.truth().electrical_energy, 4 * V0**2 / R * 0.02, rtol=1e-9)


def test_weak_motor_runs_up_as_slowly_as_its_torque_says():
    """Rotor and disc against back-EMF: the rate constant scales with the torque, the final speed does not."""
    scale = np.array([1.0, 0.5])

    def edit(parameters):
        parameters["servo.torque_scale"][:, 4:] = scale[:, None]
        parameters["body.inertia"], parameters["body.mass"] = 10.0, 100.0

    truth = drive(bench(2, edit, period=1e-3), 2e-3, setpoints_for(np.full(2, 1000.0)))
    inertia = WHEEL.armature + ROBOT.wheel.spin_inertia
    expected = WHEEL.no_load_speed * (1.0 - np.exp(-2e-3 * scale * K * K / R / inertia))
    np.testing.assert_allclose(truth.joint_velocity[:, 4], expected, rtol=1e-3)


@pytest.mark.parametrize("resistance", [0.3, 2.0])
def test_supply_sags_under_stall(resistance):
    """Four stalled wheels: V = V0/(1 + R_s sum 1/R), in the sensors too; legs that hold nothing draw nothing."""

    def edit(parameters):
        parameters["servo.coulomb_friction"] = 50.0
        parameters["servo.supply_resistance"] = resistance

    plant = bench(2, edit)
    drive(plant, 0.08, setpoints_for(np.full(2, 1000.0)))
    sensors = plant.step(setpoints_for(np.full(2, 1000.0)))
    expected = V0 / (1.0 + resistance * 4.0 / R)
    np.testing.assert_allclose(sensors.supply_voltage, expected, rtol=1e-9)
    np.testing.assert_allclose(plant.truth().motor_torque[:, 4:], K / R * expected, rtol=1e-9)
    sensors = plant.step(setpoints_for(np.zeros(2)))
    np.testing.assert_allclose(sensors.supply_voltage, V0, atol=0.1)  # recovers


def test_sagging_supply_settles_where_motors_run_partly_loaded():
    """A motor that turns freely at an unlimited voltage draws its friction's current, and the supply shows it."""
    resistance, coulomb = 1.0, 0.1

    def edit(parameters):
        parameters["servo.coulomb_friction"][:, 4:] = coulomb
        parameters["servo.supply_resistance"] = resistance

    plant = bench(2, edit)
    for _ in range(149):
        plant.step(setpoints_for(np.full(2, 6.0)))
    sensors = plant.step(setpoints_for(np.full(2, 6.0)))
    np.testing.assert_allclose(sensors.supply_voltage, V0 - resistance * 4.0 * coulomb / K, rtol=1e-6)
