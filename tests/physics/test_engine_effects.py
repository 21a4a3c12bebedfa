"""Effects in the engine: drive, backlash, ground, power, and the bits of a robot that has none of them."""

import numpy as np
import pytest
from energy import kinetic_energy, mechanical_energy, wheel_gaps
from rig import (
    HOME,
    LEGS_DOWN,
    RADIUS,
    ROBOT,
    STEPS,
    WEIGHT,
    G,
    contact_force,
    drive,
    float_in_space,
    gears,
    lift,
    lock,
    make_plant,
    record,
    turn,
    wheels_off,
)

from wlr_gym.physics.plants.base import PlantOptions, Truth
from wlr_gym.physics.plants.forces import make_force
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.physics.servo import motor_constants
from wlr_gym.robot.parameters import Parameters

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


# ---- gear play in the engine: lost motion, impact, energy, and its limits, against closed forms ----------------------


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


def energy_with_teeth(plant):
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
        energies.append(energy_with_teeth(plant))
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
        energy = energy_with_teeth(plant)
        parameters = plant.parameters.copy()
        parameters["servo.backlash"] = play
        plant.set_parameters(parameters)
        assert np.all(energy_with_teeth(plant) < energy * (1.0 + 1e-9) + 1e-9)
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


# ---- effects of the floor in the engine: patches, slip weakening, creep, grip, tether; against closed forms ----------


MASS = WEIGHT / G


def sliding(parameters):
    lock(parameters)


def thrown(speed):
    def place(state):
        state.linear_velocity_in_body[:, 0] = speed

    return place


def friction_used(truth):
    """Friction over normal force of every wheel (N, 4)."""
    force = contact_force(truth)
    return np.hypot(force[..., 0], force[..., 1]) / force[..., 2]


def contact_x(truth):
    """Place of the contact points (N, 4) along the floor's x for a robot that heads along it, legs down."""
    hip = ROBOT.hip_position.x
    return truth.position[:, :1] + hip * np.array([1.0, 1.0, -1.0, -1.0])


def test_patch_acts_under_each_wheel_from_its_edge_on():
    mu, patch_mu, edge = 0.6, 0.2, 0.25

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu
        parameters["patch.mu"][:, 1], parameters["patch.x_min"][:, 1], parameters["patch.x_max"][:, 1] = patch_mu, edge, 50.0
        parameters["patch.y_min"][:, 1], parameters["patch.y_max"][:, 1] = -9.0, 9.0

    plant = make_plant(2, edit, thrown(2.0), period=1e-3)
    on_patch, inside = [], []
    for values in record(plant, 0.4):
        truth = Truth(values)
        x = contact_x(truth)
        clear = np.abs(x - edge) > 4e-3
        is_inside = x > edge
        expected = np.where(is_inside, patch_mu, mu)
        np.testing.assert_allclose(np.where(clear, friction_used(truth), expected), expected, rtol=1e-5)
        np.testing.assert_allclose(np.where(clear, truth.effective_friction[:, ::2], expected), expected, rtol=1e-12)
        inside.append(is_inside[0])
        on_patch.append(is_inside[0].sum())
    assert {0, 2, 4} <= set(on_patch)  # front wheels enter first
    assert inside[0].sum() == 0


def test_sliding_slows_by_what_the_floor_under_it_gives():
    mu = 0.25

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.6
        parameters["patch.mu"][:, 0] = mu
        for name, value in (("x_min", -50.0), ("x_max", 50.0), ("y_min", -50.0), ("y_max", 50.0)):
            parameters[f"patch.{name}"][:, 0] = value

    plant = make_plant(2, edit, thrown(2.0))
    first, last = drive(plant, 0.2), drive(plant, 0.4)
    rate = (first.linear_velocity_in_body[:, 0] - last.linear_velocity_in_body[:, 0]) / 0.4
    np.testing.assert_allclose(rate, mu * G, rtol=2e-4)


def test_later_patch_wins_and_empty_patches_do_nothing():
    def edit(parameters):
        for k, mu in ((0, 0.1), (2, 0.7)):
            parameters["patch.mu"][0, k] = mu
            parameters["patch.x_min"][0, k], parameters["patch.x_max"][0, k] = -9.0, 9.0
            parameters["patch.y_min"][0, k], parameters["patch.y_max"][0, k] = -9.0, 9.0
        parameters["patch.mu"][1, 3], parameters["patch.x_max"][1, 3] = 0.1, 5.0  # no width along y
        parameters["wheel.grip"][0, 3] = 0.5
        parameters["ground.mu_x"][1], parameters["ground.mu_y"][1] = 0.6, 0.3
        parameters["ground.mu_x"][0], parameters["ground.mu_y"][0] = 0.6, 0.3

    shown = make_plant(2, edit).truth().effective_friction.reshape(2, 4, 2)
    np.testing.assert_allclose(shown[1], np.tile([0.6, 0.3], (4, 1)), rtol=1e-12)
    np.testing.assert_allclose(shown[0], np.outer([1, 1, 1, 0.5], [0.7, 0.35]), rtol=1e-12)


@pytest.mark.parametrize("step", STEPS)
def test_slip_weakening_slows_a_slide_by_its_law(step):
    """dv/dt = -g mu (ratio + (1 - ratio) exp(-v/v_s)), integrated finely by hand."""
    mu, ratio, slip_speed, start = 0.5, 0.4, 0.3, 1.5

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu
        parameters["ground.kinetic_ratio"], parameters["ground.weakening_speed"] = ratio, slip_speed
        parameters["body.com_offset"] = (0.0, 0.0, -0.05)

    plant = make_plant(2, edit, thrown(start), step=step)
    seen = record(plant, 0.4)
    speed = seen[:, 0, :]
    v, expected = Truth(seen[3]).linear_velocity_in_body[0, 0], []
    for _ in range(3, len(seen)):
        expected.append(v)
        for _ in range(200):  # 20 ms
            middle = v - 0.5e-4 * G * mu * (ratio + (1 - ratio) * np.exp(-v / slip_speed))
            v -= 1e-4 * G * mu * (ratio + (1 - ratio) * np.exp(-middle / slip_speed))
    measured = np.array([Truth(values).linear_velocity_in_body[0, 0] for values in seen[3:]])
    assert measured[-1] > 0.1
    np.testing.assert_allclose(measured, expected, atol=2e-3 + step)
    truth = Truth(seen[-1])
    slip = np.abs(truth.slip_velocity[:, ::2])
    np.testing.assert_allclose(
        friction_used(truth), mu * (ratio + (1 - ratio) * np.exp(-slip / slip_speed)), rtol=0.1 * step / 1e-3
    )
    assert speed.shape[0] == len(seen)


@pytest.mark.parametrize("step", STEPS)
def test_creep_slips_steadily_under_a_steady_pull(step):
    """v = v_c atanh(F/(mu N)) summed over the wheels: here all carry alike."""
    mu, creep_speed, share = 0.5, 0.05, np.array([0.2, 0.6, 0.9, 0.97])

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu
        parameters["ground.creep_speed"] = creep_speed
        parameters["external_force"][:, 1] = share * mu * WEIGHT

    truth = drive(make_plant(4, edit, step=step), 4.0)
    speed = np.abs(truth.slip_velocity.reshape(4, 4, 2)[..., 1])
    normal = contact_force(truth)[..., 2]
    np.testing.assert_allclose(friction_used(truth), mu * np.tanh(speed / creep_speed), rtol=1e-6)
    np.testing.assert_allclose(np.abs(contact_force(truth)[..., 1]).sum(axis=1), share * mu * WEIGHT, rtol=1e-6)
    alike = np.abs(truth.linear_velocity_in_body[:, 1])
    np.testing.assert_allclose(alike, creep_speed * np.arctanh(share), rtol=0.02)
    assert normal.min() > 0.0


def test_slow_creep_is_dry_friction():
    """Thrown robots come to rest where dry friction stops them, as the creep speed goes to zero."""
    creep_speed = np.array([0.0, 1e-4, 1e-3, 1e-2])

    def edit(parameters):
        sliding(parameters)
        parameters["ground.creep_speed"] = creep_speed[:, None]

    truth = drive(make_plant(4, edit, thrown(1.0)), 0.6)
    off = np.abs(truth.position[1:, 0] - truth.position[0, 0])
    assert off[0] < 1e-4
    assert off[0] < off[1] < off[2]


def test_creep_knows_no_heading():
    """Anisotropic tyres that creep, pushed along the same body direction at eight headings: the same motion in the body."""
    yaw = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    push = 0.4 * WEIGHT

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"], parameters["ground.mu_y"] = 0.8, 0.4
        parameters["ground.creep_speed"] = 0.05
        direction = yaw + 0.6
        parameters["external_force"] = push * np.column_stack([np.cos(direction), np.sin(direction)])

    def place(state):
        turn(state, yaw)
        state.linear_velocity_in_body[:] = (0.3, -0.2, 0.0)

    truth = drive(make_plant(8, edit, place), 1.0)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = truth.position[:, 0], truth.position[:, 1]
    own = np.column_stack([c * x + s * y, c * y - s * x])
    assert np.ptp(own, axis=0).max() < 1e-8
    assert np.ptp(truth.linear_velocity_in_body, axis=0).max() < 1e-8


def test_creep_force_opposes_the_scaled_slip():
    """Along (mu_x^2 sx, mu_y^2 sy), of size N |(mu_x^2 sx, mu_y^2 sy)|/|(mu_x sx, mu_y sy)| tanh(|s|/v_c)."""
    mu = np.array([0.8, 0.4])

    def edit(parameters):
        sliding(parameters)
        parameters["ground.mu_x"], parameters["ground.mu_y"] = mu
        parameters["ground.creep_speed"] = 0.2

    def place(state):
        state.linear_velocity_in_body[:, 0] = 0.3
        state.linear_velocity_in_body[:, 1] = np.linspace(0.0, 0.4, len(state))

    truth = drive(make_plant(6, edit, place, period=1e-3), 0.02)
    slip, force = truth.slip_velocity.reshape(6, 4, 2), contact_force(truth)
    scaled = mu * slip
    size = np.tanh(np.linalg.norm(slip, axis=2) / 0.2) / np.linalg.norm(scaled, axis=2)
    np.testing.assert_allclose(force[..., :2], -mu * scaled * (size * force[..., 2])[..., None], rtol=2e-2, atol=0.02)


def test_creep_converges_with_the_step():
    def edit(parameters):
        parameters["ground.creep_speed"] = 0.03
        parameters["servo.profile_acceleration"] = 15.0

    def end(step):
        plant = make_plant(2, edit, step=step)
        for left, right in ((3.0, -2.0), (-2.0, 4.0), (4.0, 3.0)):
            truth = drive(plant, 0.3, np.concatenate([HOME[:4], [left, right, left, right]]))
        return truth.position[0, :2]

    fine = end(2.5e-5)
    errors = [np.abs(end(step) - fine).max() for step in (2.5e-4, 1e-3, 4e-3)]
    assert errors[1] < 1e-4
    assert errors[0] < 0.5 * errors[1]
    assert errors[2] < 1e-3


def test_tether_is_a_horizontal_spring_to_the_anchor():
    """On ice the robot swings about the anchor with sqrt(k/m); the pull is k times the distance."""
    stiffness, anchor = 40.0, np.array([0.3, -0.2])

    def edit(parameters):
        lock(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.0
        parameters["tether.stiffness"] = stiffness
        parameters["tether.anchor"] = anchor

    plant = make_plant(2, edit, period=1e-2)
    seen = record(plant, 2.0)
    time = 0.01 * np.arange(1, len(seen) + 1)
    expected = anchor * (1.0 - np.cos(np.sqrt(stiffness / MASS) * time))[:, None]
    measured = np.array([Truth(values).position[0, :2] for values in seen])
    np.testing.assert_allclose(measured, expected, atol=0.01 * float(np.linalg.norm(anchor)))

    def hold(parameters):
        lock(parameters)
        parameters["tether.stiffness"], parameters["tether.anchor"] = 10.0, (0.5, 0.0)

    held = drive(make_plant(2, hold), 1.0)
    np.testing.assert_allclose(contact_force(held)[..., 0].sum(axis=1), -10.0 * (0.5 - held.position[:, 0]), rtol=1e-4)


# ---- power balance with effects on, and formula forces, in the engine ------------------------------------------------


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


# --- bits of kernels for families of effects --------------------------------------------------------------------------


ONE_OF_EACH = {
    "rolling_resistance": ("ground.rolling_resistance", 0.01),
    "drive": ("servo.torque_scale", 0.8),
    "backlash": ("servo.backlash", 0.01),
    "ground": ("ground.kinetic_ratio", 0.7),
    "creep": ("ground.creep_speed", 0.05),
    "creep of gears": ("servo.creep_rate", 0.05),
    "flattening": ("ground.flattening", 0.4),
}
FEATURES = {family: {"compliance", "backlash"} if family.startswith(("creep", "flat")) else {family} for family in ONE_OF_EACH}
TICKS = 20


def different_robots(count):
    """Robots that differ from each other; row i depends on i alone."""
    parameters = Parameters.nominal(ROBOT, count)
    for row in range(count):
        rng = np.random.default_rng([7, row])
        parameters["ground.mu_x"][row], parameters["ground.mu_y"][row] = rng.uniform(0.2, 0.9, (2, 4))
        parameters["body.com_offset"][row] = rng.uniform(-0.01, 0.01, 3)
        parameters["servo.viscous_friction"][row] = rng.uniform(0.0, 0.02, 8)
    return parameters


def setpoints(count):
    rows = [np.random.default_rng([8, row]) for row in range(count)]
    low, high = np.repeat([1.2, -5.0], 4), np.repeat([1.9, 5.0], 4)
    return np.stack([rng.uniform(low, high, (TICKS, 8)) for rng in rows], axis=1)


def rollout(plant, parameters, commands):
    """Truth and sensors (ticks, N, columns)."""
    plant.reset(seeds=np.arange(len(parameters), dtype=np.uint64), parameters=parameters)
    seen = [np.hstack([plant.step(row).values, plant.truth().values]) for row in commands]
    return np.array(seen)


def with_effects(parameters, families, robots=slice(None)):
    changed = parameters.copy()
    for family in families:
        name, value = ONE_OF_EACH[family]
        changed[name][robots] = value
    return changed


@pytest.mark.usefixtures("own_kernels")
@pytest.mark.slow  # a kernel for every family
@pytest.mark.parametrize("family", ONE_OF_EACH)
def test_neutral_robot_keeps_its_bits(family):
    count = 9
    parameters, commands = different_robots(count), setpoints(count)
    plain = rollout(GibbsAppellPlant(ROBOT, count), parameters, commands)
    plant = GibbsAppellPlant(ROBOT, count)
    changed = rollout(plant, with_effects(parameters, [family]), commands)
    assert plant._features == FEATURES[family]
    assert np.isfinite(changed).all()
    assert not np.array_equal(changed, plain)
    np.testing.assert_array_equal(rollout(plant, parameters, commands), plain)
    beside = rollout(plant, with_effects(parameters, [family], slice(3, 6)), commands)
    np.testing.assert_array_equal(beside[:, [0, 1, 2, 6, 7, 8]], plain[:, [0, 1, 2, 6, 7, 8]])
    np.testing.assert_array_equal(beside[:, 3:6], changed[:, 3:6])


@pytest.mark.usefixtures("own_kernels")
@pytest.mark.parametrize(
    ("count", "precision"), [(1, "float64"), pytest.param(9, "float64", marks=pytest.mark.slow), (17, "float32")]
)
def test_all_families_at_once(count, precision):
    """Neutral robots as in the plain kernel, robots with one family as in that family's, at every tile width."""
    parameters, commands = different_robots(count), setpoints(count)
    options = PlantOptions(precision=precision)
    plant = GibbsAppellPlant(ROBOT, count, options)
    rollout(plant, with_effects(parameters, ONE_OF_EACH), commands[:2])
    assert plant._features == set().union(*FEATURES.values())
    plain = rollout(GibbsAppellPlant(ROBOT, count, options), parameters, commands)
    np.testing.assert_array_equal(rollout(plant, parameters, commands), plain)
    if precision == "float64" and count > 1:
        for family in ONE_OF_EACH:
            changed = with_effects(parameters, [family])
            alone = rollout(GibbsAppellPlant(ROBOT, count), changed, commands)
            np.testing.assert_array_equal(rollout(plant, changed, commands), alone)
