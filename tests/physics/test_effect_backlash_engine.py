"""Gear play in the engine: lost motion, impact, energy, and its limits, against closed forms."""

import numpy as np
import pytest
from energy import kinetic_energy
from rig import LEGS_DOWN, RADIUS, ROBOT, drive, float_in_space, gears, lift, lock, make_plant, record, wheels_off

from wlr_gym.physics.servo import motor_constants

WHEEL = ROBOT.servo.wheel
V0 = ROBOT.servo.supply_voltage
K, R = motor_constants(WHEEL.stall_torque, WHEEL.no_load_speed, V0)
PLAY = 0.03


def in_space(parameters):
    float_in_space(parameters)
    parameters["servo.coulomb_friction"][:, :4] = 50.0
    parameters["servo.backlash"][:, 4:] = PLAY
    parameters["servo.kp"][:, 4:] = 0.0


def test_lost_motion_is_the_play():
    """Rotors held, the robot pushed to and fro: the wheels turn by the play and what the teeth give."""
    force, stiffness = np.array([2.0, 4.0]), 20.0

    def edit(parameters):
        lock(parameters)
        parameters["servo.backlash"][:, 4:] = PLAY
        parameters["servo.gear_stiffness"][:, 4:] = stiffness

    plant = make_plant(2, edit)
    ends = []
    for sign in (1.0, -1.0):
        parameters = plant.parameters.copy()
        parameters["external_force"][:, 0] = sign * force
        plant.set_parameters(parameters)
        ends.append(drive(plant, 3.0, torque_on=wheels_off(2)))
    give = 2.0 * force * RADIUS / 4.0 / stiffness
    assert np.abs(ends[1].joint_velocity).max() < 1e-6
    turned = (ends[0].joint_position - ends[1].joint_position)[:, 4:].mean(axis=1)  # the body's pitch shares the load unevenly
    np.testing.assert_allclose(turned, PLAY + give, rtol=1e-3)


def test_rotor_spins_up_alone_until_the_teeth_meet():
    """Rotor inertia alone against back-EMF, exactly; the wheel knows nothing of it before the gap is crossed."""

    def edit(parameters):
        in_space(parameters)
        parameters["servo.kd"][:, 4:] = 50.0

    plant = make_plant(2, edit, lift, step=1e-4, period=1e-3)
    setpoints = np.concatenate([LEGS_DOWN, np.full(4, 1000.0)])
    decay = K * K / R / WHEEL.armature
    angle = 0.0
    for tick in range(1, 6):
        truth = drive(plant, 1e-3, setpoints)
        rate = WHEEL.no_load_speed * (1.0 - np.exp(-decay * tick * 1e-3))
        lead, rotor_rate = gears(plant)
        np.testing.assert_allclose(rotor_rate[:, 4:], rate, rtol=1e-9)
        assert np.abs(truth.joint_velocity).max() < 1e-12
        angle = WHEEL.no_load_speed * (tick * 1e-3 - (1.0 - np.exp(-decay * tick * 1e-3)) / decay)
        np.testing.assert_allclose(lead[:, 4:], angle, rtol=5e-3)
        if angle + rate * 1e-3 > 0.5 * PLAY:
            break
    assert angle > 0.1 * PLAY
    assert np.abs(drive(plant, 5e-3, setpoints).joint_velocity[:, 4:]).min() > 0.5


def mechanical_energy(plant):
    """Bodies, rotors and pressed teeth (N,), J."""
    state, truth = plant.mechanical_state(), plant.truth()
    parameters = plant.parameters.copy()
    armature, play = parameters["servo.armature"].copy(), parameters["servo.backlash"]
    parameters["servo.armature"] = np.where(play > 0.0, 0.0, armature)
    bodies = kinetic_energy(
        parameters,
        truth.linear_velocity_in_body,
        truth.angular_velocity_in_body,
        truth.joint_position,
        truth.joint_velocity,
    )
    pressed = np.maximum(np.abs(state.rotor_lead) - 0.5 * play, 0.0)
    rotor = np.where(play > 0.0, armature * state.rotor_rate**2 + parameters["servo.gear_stiffness"] * pressed**2, 0.0)
    return bodies + 0.5 * rotor.sum(axis=1)


@pytest.mark.parametrize("step", [2.5e-4, 1e-3, 4e-3])
def test_impacts_keep_momentum_and_lose_energy(step):
    """A rotor coasts into its teeth: momentum of rotor and wheel about the axle stays, energy only falls."""
    start = 5.0
    plant = make_plant(2, in_space, lift, step=step, period=step)
    state = plant.mechanical_state()
    state.rotor_rate = np.zeros((2, 8))
    state.rotor_rate[:, 4:] = start * np.array([1.0, -1.0, 0.5, -0.5])
    plant.reset(state=state)
    energies, momenta = [], []
    for _ in range(round(0.2 / step)):
        energies.append(mechanical_energy(plant))
        (_, rotor_rate), truth = gears(plant), plant.truth()
        spin = truth.angular_velocity_in_body[:, 1:2] + truth.joint_velocity[:, :4] + truth.joint_velocity[:, 4:]
        momenta.append(WHEEL.armature * rotor_rate[:, 4:] + ROBOT.wheel.spin_inertia * spin)
        drive(plant, step, torque_on=np.zeros((2, 8), bool))
    np.testing.assert_allclose(np.array(momenta), np.broadcast_to(momenta[0], np.shape(momenta)), rtol=1e-9)
    first, *_, last = energies
    assert np.max(energies) < first.max() * (1.0 + 1e-12)
    # all of it that the momentum allows is lost: rotor and wheel turn as one
    inertia = np.array([WHEEL.armature, ROBOT.wheel.spin_inertia])
    assert np.all(last < 0.97 * first)
    assert inertia[1] < 0.1 * inertia[0]


def test_vanishing_play_of_stiff_teeth_is_a_rigid_gear():
    """Driven to and fro on the floor: the difference from a rigid gear shrinks with the play."""
    plays = np.array([0.0, 1e-4, 1e-3, 1e-2])

    def edit(parameters):
        parameters["servo.backlash"] = plays[:, None]
        parameters["servo.gear_stiffness"] = 1e5
        parameters["servo.profile_acceleration"] = 15.0
        parameters["servo.profile_velocity"] = 2.0

    plant = make_plant(4, edit)
    for speed in (3.0, -2.0, 1.0):
        truth = drive(plant, 0.6, np.concatenate([LEGS_DOWN + 0.1 * speed, np.full(4, speed)]))
    off = np.abs(truth.position[1:, 0] - truth.position[0, 0])
    assert off[0] < 2e-5
    assert off[0] < off[1] < off[2]
    assert off[2] < 3.0 * (RADIUS + ROBOT.leg.length) * plays[3]


def test_converges_with_the_step():
    """Reversals on a slope, which presses the teeth together, with play in the wheels: the error falls with the step."""

    def edit(parameters):
        parameters["servo.backlash"][:, 4:] = 0.02
        parameters["servo.profile_acceleration"] = 15.0
        parameters["servo.profile_velocity"] = 2.0
        parameters["ground.slope"] = (0.15, 0.0)

    def end(step):
        plant = make_plant(2, edit, step=step)
        for speed in (3.0, -2.0, 1.0):
            truth = drive(plant, 0.4, np.concatenate([LEGS_DOWN + 0.1 * speed, np.full(4, speed)]))
        return np.hstack([truth.position, RADIUS * truth.joint_position[:, 4:]])[0]

    fine = end(2.5e-5)
    errors = [np.abs(end(step) - fine).max() for step in (1e-4, 2.5e-4, 1e-3)]
    assert errors[2] < 5e-5  # m
    assert errors[1] < 2e-5
    assert errors[0] < 5e-6


def test_a_resting_robot_with_play_stays_at_rest():
    plant = make_plant(2, lambda p: p.__setitem__("servo.backlash", 0.02))
    """Rotors hold; wheels and legs roll to and fro within the play, ever more slowly."""
    first, later = (np.abs(record(plant, 3.0)[:, 0, 7]).max() for _ in range(2))
    end = drive(plant, 0.02)
    assert later < first
    assert later < 2e-3  # m/s along the body's x
    assert np.abs(end.position[:, 0]).max() < 0.02 * (RADIUS + ROBOT.leg.length)


def test_play_may_come_and_go_in_mid_run():
    plant = make_plant(2)
    setpoints = np.concatenate([LEGS_DOWN, np.full(4, 3.0)])
    drive(plant, 0.5, setpoints)
    for play in (0.02, 0.01, 0.03, 0.0):
        energy = mechanical_energy(plant)
        parameters = plant.parameters.copy()
        parameters["servo.backlash"] = play
        plant.set_parameters(parameters)
        assert np.all(mechanical_energy(plant) < energy * (1.0 + 1e-9) + 1e-9)
        truth = drive(plant, 0.1, setpoints)
        assert np.abs(truth.joint_velocity[:, 4:] - 3.0).max() < 1.0


def test_state_with_play_round_trips():
    plant = make_plant(2, lambda p: p.__setitem__("servo.backlash", 0.02))
    setpoints = np.concatenate([LEGS_DOWN + 0.1, np.full(4, 3.0)])
    drive(plant, 0.3, setpoints)
    state = plant.mechanical_state()
    assert np.abs(gears(plant)[0]).max() > 0.005
    plant.reset(state=state)
    again = plant.mechanical_state()
    for name in ("rotor_lead", "rotor_rate", "supply_drop"):
        np.testing.assert_array_equal(getattr(again, name), getattr(state, name))
