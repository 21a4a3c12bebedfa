"""Power balance with effects on, and formula forces, in the engine."""

import numpy as np
import pytest
from energy import mechanical_energy, wheel_gaps
from rig import LEGS_DOWN, ROBOT, drive, float_in_space, gears, lift, lock, make_plant

from wlr_gym.physics.plants.base import Truth
from wlr_gym.physics.plants.forces import make_force

STEP = 1e-3
TETHER = 20.0


def drive_effects(parameters):
    parameters["servo.torque_scale"] = 0.8
    parameters["servo.stribeck_torque"], parameters["servo.load_friction"] = 0.03, 0.1
    parameters["servo.ripple_amplitude"], parameters["servo.ripple_order"] = 0.02, 5.0
    parameters["servo.supply_resistance"] = 0.3


def ground_effects(parameters):
    parameters["ground.kinetic_ratio"], parameters["ground.weakening_speed"] = 0.6, 0.2
    parameters["patch.mu"][:, 0], parameters["patch.x_min"][:, 0], parameters["patch.x_max"][:, 0] = 0.3, 0.05, 9.0
    parameters["patch.y_min"][:, 0], parameters["patch.y_max"][:, 0] = -9.0, 9.0


def creep(parameters):
    parameters["ground.creep_speed"] = 0.05


def compliance(parameters):
    parameters["servo.creep_rate"], parameters["ground.flattening"] = 0.3, 0.5


def tether(parameters):
    parameters["tether.stiffness"], parameters["tether.anchor"] = TETHER, (0.2, 0.3)


def backlash(parameters):
    parameters["servo.backlash"] = 0.02


FAMILIES = {f.__name__: f for f in (drive_effects, ground_effects, creep, compliance, tether, backlash)}


def stored(plant):
    """Energy of bodies, rotors, pressed teeth and tether (N,), J; the contact springs' is counted as work."""
    truth, state, parameters = plant.truth(), plant.mechanical_state(), plant.parameters.copy()
    play, armature = parameters["servo.backlash"], parameters["servo.armature"].copy()
    parameters["servo.armature"] = np.where(play > 0.0, 0.0, armature)
    total = mechanical_energy(parameters, truth)
    pressed = np.maximum(np.abs(state.rotor_lead) - 0.5 * play, 0.0)
    rotor = armature * state.rotor_rate**2 + parameters["servo.gear_stiffness"] * pressed**2
    total += 0.5 * np.where(play > 0.0, rotor, 0.0).sum(axis=1)
    reach = truth.position[:, :2] - parameters["tether.anchor"]
    return total + 0.5 * parameters["tether.stiffness"] * (reach**2).sum(axis=1)


@pytest.mark.parametrize("family", FAMILIES)
def test_power_balance_closes(family):
    """What the motors do is stored or goes into friction; gear play may lose more, in its teeth, never less."""
    rng = np.random.default_rng(1)
    plant = make_plant(4, FAMILIES[family], step=STEP, period=STEP)
    parameters, count = plant.parameters, plant.count
    start, done, work, friction_work = stored(plant), np.zeros(count), np.zeros(count), np.zeros((2000, count))
    old, old_rate = Truth(plant.truth().values.copy()), gears(plant)[1]
    setpoints = np.zeros((count, 8))
    for tick in range(2000):
        if tick % 400 == 0:
            setpoints = np.hstack([rng.uniform(1.3, 1.8, (count, 4)), rng.uniform(-4.0, 4.0, (count, 4))])
        plant.step(setpoints)
        truth, rate = Truth(plant.truth().values.copy()), gears(plant)[1]
        turned = 0.5 * STEP * (rate + old_rate)
        slid = 0.5 * STEP * (truth.slip_velocity + old.slip_velocity)
        force = truth.contact_force.reshape(count, 4, 3)
        motor = (truth.motor_torque * turned).sum(axis=1)
        np.testing.assert_allclose(truth.mechanical_energy, motor, atol=1e-9)
        gear = (truth.friction_torque * turned).sum(axis=1)
        floor = (force[..., :2].reshape(count, 8) * slid).sum(axis=1)
        friction_work[tick] = gear + floor
        squeezed = wheel_gaps(parameters, truth) - wheel_gaps(parameters, old)
        work += motor + gear + floor + (force[..., 2] * squeezed).sum(axis=1)
        done += np.abs(motor)
        old, old_rate = truth, rate
    missing = (stored(plant) - start - work) / done
    assert done.min() > 0.5
    assert friction_work.sum(axis=0).max() < -0.01
    if family == "backlash":
        assert missing.max() < 1e-3
        assert missing.min() > -0.2
    else:
        assert np.abs(missing).max() < 2e-5


def test_neutral_formula_changes_no_bit():
    setpoints = np.concatenate([LEGS_DOWN + 0.2, np.full(4, 3.0)])
    plain = drive(make_plant(3), 0.3, setpoints)
    neutral = [make_force(["leg_lf", "floor_force_x", "body_torque_yaw"][:1], "0 * motor_torque", {}, {})]
    np.testing.assert_array_equal(drive(make_plant(3, forces=neutral), 0.3, setpoints).values, plain.values)


@pytest.mark.slow
def test_formula_force_on_the_floor_is_the_external_force():
    setpoints = np.concatenate([LEGS_DOWN, np.full(4, 2.0)])
    pull = [make_force(["floor_force_y"], "f", {"f": 3.0}, {"f": "N"})]
    pushed = drive(make_plant(2, lambda p: p.__setitem__("external_force", (0.0, 3.0))), 0.5, setpoints)
    formula = drive(make_plant(2, forces=pull), 0.5, setpoints)
    np.testing.assert_allclose(formula.values, pushed.values, rtol=1e-9, atol=1e-10)


@pytest.mark.slow
def test_formula_spring_in_a_leg_acts_like_a_motor():
    """Torque off, in space: leg and platform swing against each other about the spring's rest angle."""
    stiffness, rest = 2.0, 1.4
    spring = [make_force(["leg_lf"], "-k * (leg_angle - a)", {"k": stiffness, "a": rest}, {"k": "N m/rad", "a": "rad"})]

    def edit(parameters):
        float_in_space(parameters)
        parameters["servo.coulomb_friction"][:, 1:] = 50.0
        parameters["body.mass"], parameters["body.inertia"] = 100.0, 10.0

    plant = make_plant(2, edit, lift, forces=spring, period=1e-3)
    angles = []
    for _ in range(600):
        plant.step(np.zeros((2, 8)), np.zeros((2, 8), bool))
        angles.append(plant.truth().joint_position[0, 0])
    angles = np.array(angles)
    np.testing.assert_allclose([angles.min(), angles.max()], [2 * rest - np.pi / 2, np.pi / 2], atol=2e-3)


@pytest.mark.slow
def test_formula_drag_on_the_body_slows_it_exponentially():
    drag = [make_force(["body_force_x"], "-c * velocity_x", {"c": 2.0}, {"c": "N s/m"})]

    def edit(parameters):
        float_in_space(parameters)
        lock(parameters)

    def throw(state):
        lift(state)
        state.linear_velocity_in_body[:, 0] = 1.0

    truth = drive(make_plant(2, edit, throw, forces=drag), 0.5)
    mass = ROBOT.total_mass
    np.testing.assert_allclose(np.linalg.norm(truth.linear_velocity_in_body, axis=1), np.exp(-2.0 * 0.5 / mass), rtol=2e-2)
