"""Effects in the engine: drive, backlash, ground, power, and the bits of a robot that has none of them."""

import numpy as np
import pytest
from energy import audit, stored
from rig import (
    BACKENDS,
    HOME,
    LEGS_DOWN,
    MASS,
    RADIUS,
    ROBOT,
    STEPS,
    WEIGHT,
    G,
    channel,
    contact_force,
    drive,
    float_in_space,
    gears,
    lift,
    lock,
    make_plant,
    own_path,
    record,
    turn,
    wheels_off,
)

from wlr_gym.physics import maps
from wlr_gym.physics.plants.base import PlantOptions, Truth
from wlr_gym.physics.plants.forces import make_force
from wlr_gym.physics.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.physics.servo import motor_constants
from wlr_gym.robot.parameters import Parameters

WHEEL = ROBOT.servo.wheel
V0 = ROBOT.servo.supply_voltage
K, R = motor_constants(WHEEL.stall_torque, WHEEL.no_load_speed, V0)
INERTIA = WHEEL.armature + ROBOT.wheel.spin_inertia
HEAVY = {"body.inertia": 10.0, "body.mass": 100.0}
#: Wheels that turn against nothing but their gears; legs locked. ``kp`` 0: volts = kd (goal - rate).
BENCH = [float_in_space, {"servo.coulomb_friction of legs": 50.0, "servo.kp of wheels": 0.0, "servo.kd of wheels": 1.0}]


def bench(count, edit, **options):
    return make_plant(count, [*BENCH, edit], lift, **options)


def at(volts):
    """Setpoints that put ``volts`` (N,) on resting wheels."""
    return np.hstack([np.tile(LEGS_DOWN, (len(volts), 1)), np.repeat(np.asarray(volts)[:, None], 4, axis=1)])


def test_stribeck_breakaway_and_sliding_torque():
    coulomb, extra, speed = 0.03, 0.05, 0.5
    stick = {"servo.stribeck_torque of wheels": extra, "servo.stribeck_speed of wheels": speed}
    volts = np.array([0.99, 1.01, 2.0, 4.0]) * (coulomb + extra) * R / K
    truth = drive(bench(4, {"servo.coulomb_friction of wheels": coulomb} | stick), 3.0, at(volts))
    rate, friction = np.abs(truth.joint_velocity[:, 4:]), np.abs(truth.friction_torque[:, 4:])
    assert rate[0].max() < 1e-12
    np.testing.assert_allclose(friction[0], 0.99 * (coulomb + extra), rtol=1e-6)
    assert rate[1].min() > 1e-3
    np.testing.assert_allclose(friction[1:], coulomb + extra * np.exp(-((rate[1:] / speed) ** 2)), rtol=1e-6)


def test_load_dependent_friction_grows_with_the_motors_torque():
    """Turning steadily, friction = torque, so that torque = c/(1 - k); at rest the bound is c + k |torque|."""
    coulomb, ratio = 0.02, 0.4
    plant = bench(3, {"servo.coulomb_friction of wheels": coulomb, "servo.load_friction of wheels": ratio})
    truth = drive(plant, 4.0, at(np.array([0.99, 1.05, 2.0]) * coulomb / (1.0 - ratio) * R / K))
    assert np.abs(truth.joint_velocity[0]).max() < 1e-12
    np.testing.assert_allclose(truth.motor_torque[1:, 4:], coulomb / (1.0 - ratio), rtol=1e-6)
    np.testing.assert_allclose(truth.friction_torque[1:, 4:], -coulomb / (1.0 - ratio), rtol=1e-6)


def test_torque_ripple_is_a_potential():
    """A coasting wheel obeys J w^2/2 + (A/n) cos(n q + phase) = const: period 2 pi/n, no mean work over a turn."""
    amplitude, order, phase, start = 0.002, 7.0, 0.4, 4.0
    wave = {"amplitude": amplitude, "order": order, "phase": phase}
    ripple = {f"servo.ripple_{name} of wheels": value for name, value in wave.items()}

    def spin(state):
        lift(state)
        state.joint_velocity[:, 4:] = start

    edit = [float_in_space, {"servo.coulomb_friction of legs": 50.0}, ripple, HEAVY]
    history = record(make_plant(2, edit, spin, step=5e-4, period=1e-3), 2.5, HOME, wheels_off(2))
    angle, rate, torque = (channel(history, name)[:, 0, 4] for name in ("joint_position", "joint_velocity", "motor_torque"))
    expected = start**2 + 2.0 * amplitude / (order * INERTIA) * (np.cos(phase) - np.cos(order * angle + phase))
    np.testing.assert_allclose(rate**2, expected, rtol=2e-4)
    assert np.ptp(rate**2) > 1.0
    assert angle[-1] > 2.0 * np.pi
    middle = angle - 0.25e-3 * rate  # of the last substep
    np.testing.assert_allclose(torque, amplitude * np.sin(order * middle + phase), atol=1e-4 * amplitude)


def test_weak_motor_stalls_weaker_and_reports_the_same_effort():
    scale = np.array([[1.0], [0.7], [0.0]])
    plant = bench(3, [lock, {"servo.torque_scale of wheels": scale}])
    sensors = plant.step(at(np.full(3, 100.0)))
    torque = plant.truth().motor_torque[:, 4:]
    np.testing.assert_allclose(torque, np.tile(scale, (1, 4)) * WHEEL.stall_torque, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(sensors.joint_effort[:, 4:], WHEEL.stall_torque, rtol=1e-9)
    np.testing.assert_allclose(plant.truth().electrical_energy, 4 * V0**2 / R * 0.02, rtol=1e-9)


def test_weak_motor_runs_up_as_slowly_as_its_torque_says():
    """Rotor and disc against back-EMF: the rate constant scales with the torque, the final speed does not."""
    scale = np.array([1.0, 0.5])
    plant = bench(2, {"servo.torque_scale of wheels": scale[:, None], **HEAVY}, period=1e-3)
    truth = drive(plant, 2e-3, at(np.full(2, 1000.0)))
    expected = WHEEL.no_load_speed * (1.0 - np.exp(-2e-3 * scale * K * K / R / INERTIA))
    np.testing.assert_allclose(truth.joint_velocity[:, 4], expected, rtol=1e-3)


@pytest.mark.parametrize("resistance", [0.3, 2.0])
def test_supply_sags_under_stall(resistance):
    """Four stalled wheels: V = V0/(1 + R_s sum 1/R), in the sensors too; legs that hold nothing draw nothing."""
    plant = bench(2, [lock, {"servo.supply_resistance": resistance}])
    drive(plant, 0.08, at(np.full(2, 1000.0)))
    sensors = plant.step(at(np.full(2, 1000.0)))
    expected = V0 / (1.0 + resistance * 4.0 / R)
    np.testing.assert_allclose(sensors.supply_voltage, expected, rtol=1e-9)
    np.testing.assert_allclose(plant.truth().motor_torque[:, 4:], K / R * expected, rtol=1e-9)
    sensors = plant.step(at(np.zeros(2)))
    np.testing.assert_allclose(sensors.supply_voltage, V0, atol=0.1)  # recovers


def test_sagging_supply_settles_where_motors_run_partly_loaded():
    """A motor that turns freely at an unlimited voltage draws its friction's current, and the supply shows it."""
    resistance, coulomb = 1.0, 0.1
    plant = bench(2, {"servo.coulomb_friction of wheels": coulomb, "servo.supply_resistance": resistance})
    drive(plant, 2.98, at(np.full(2, 6.0)))
    sensors = plant.step(at(np.full(2, 6.0)))
    np.testing.assert_allclose(sensors.supply_voltage, V0 - resistance * 4.0 * coulomb / K, rtol=1e-6)


# ---- gear play in the engine: lost motion, impact, energy, and its limits, against closed forms ----------------------


PLAY = 0.03
IN_SPACE = [
    float_in_space, {"servo.coulomb_friction of legs": 50.0, "servo.backlash of wheels": PLAY, "servo.kp of wheels": 0.0},
]  # fmt: skip
PROFILE = {"servo.profile_acceleration": 15.0, "servo.profile_velocity": 2.0}


def to_and_fro(plant, seconds):
    """Drive forth, back and forth again, legs leaning with it; return the last truth."""
    for speed in (3.0, -2.0, 1.0):
        truth = drive(plant, seconds, np.concatenate([LEGS_DOWN + 0.1 * speed, np.full(4, speed)]))
    return truth


def test_lost_motion_is_the_play():
    """Rotors held, the robot pushed to and fro: the wheels turn by the play and what the teeth give."""
    force, stiffness = np.array([2.0, 4.0]), 20.0
    plant = make_plant(2, [lock, {"servo.backlash of wheels": PLAY, "servo.gear_stiffness of wheels": stiffness}])
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
    plant = make_plant(2, [*IN_SPACE, {"servo.kd of wheels": 50.0}], lift, step=1e-4, period=1e-3)
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


@pytest.mark.parametrize("step", STEPS)
def test_impacts_keep_momentum_and_lose_energy(step):
    """A rotor coasts into its teeth: momentum of rotor and wheel about the axle stays, energy only falls."""
    plant = make_plant(2, IN_SPACE, lift, step=step, period=step)
    state = plant.mechanical_state()
    state.rotor_rate = np.zeros((2, 8))
    state.rotor_rate[:, 4:] = 5.0 * np.array([1.0, -1.0, 0.5, -0.5])
    plant.reset(state=state)
    energies, momenta = [], []
    for _ in range(round(0.2 / step)):
        energies.append(stored(plant))
        (_, rotor_rate), truth = gears(plant), plant.truth()
        spin = truth.angular_velocity_in_body[:, 1:2] + truth.joint_velocity[:, :4] + truth.joint_velocity[:, 4:]
        momenta.append(WHEEL.armature * rotor_rate[:, 4:] + ROBOT.wheel.spin_inertia * spin)
        drive(plant, step, torque_on=np.zeros((2, 8), bool))
    np.testing.assert_allclose(np.array(momenta), np.broadcast_to(momenta[0], np.shape(momenta)), rtol=1e-9)
    first, *_, last = energies
    assert np.max(energies) < first.max() * (1.0 + 1e-12)
    # all of it that the momentum allows is lost: rotor and wheel turn as one
    assert np.all(last < 0.97 * first)
    assert ROBOT.wheel.spin_inertia < 0.1 * WHEEL.armature


def test_vanishing_play_of_stiff_teeth_is_a_rigid_gear():
    """Driven to and fro on the floor: the difference from a rigid gear shrinks with the play."""
    plays = np.array([0.0, 1e-4, 1e-3, 1e-2])
    plant = make_plant(4, {"servo.backlash": plays[:, None], "servo.gear_stiffness": 1e5, **PROFILE})
    x = to_and_fro(plant, 0.6).position[:, 0]
    off = np.abs(x[1:] - x[0])
    assert off[0] < 2e-5
    assert off[0] < off[1] < off[2]
    assert off[2] < 3.0 * (RADIUS + ROBOT.leg.length) * plays[3]


def test_converges_with_the_step():
    """Reversals on a slope, which presses the teeth together, with play in the wheels: the error falls with the step."""
    edit = {"servo.backlash of wheels": 0.02, "ground.slope": (0.15, 0.0), **PROFILE}

    def end(step):
        truth = to_and_fro(make_plant(2, edit, step=step), 0.4)
        return np.hstack([truth.position, RADIUS * truth.joint_position[:, 4:]])[0]

    fine = end(2.5e-5)
    errors = [np.abs(end(step) - fine).max() for step in (1e-4, 2.5e-4, 1e-3)]
    assert errors[2] < 5e-5  # m
    assert errors[1] < 2e-5
    assert errors[0] < 5e-6


def test_a_resting_robot_with_play_stays_at_rest():
    """Rotors hold; wheels and legs roll to and fro within the play, ever more slowly."""
    plant = make_plant(2, {"servo.backlash": 0.02})
    first, later = (np.abs(channel(record(plant, 3.0), "linear_velocity_in_body")[:, 0, 0]).max() for _ in range(2))
    end = drive(plant, 0.02)
    assert later < first
    assert later < 2e-3  # m/s along the body's x
    assert np.abs(end.position[:, 0]).max() < 0.02 * (RADIUS + ROBOT.leg.length)


def test_play_may_come_and_go_in_mid_run():
    plant = make_plant(2)
    setpoints = np.concatenate([LEGS_DOWN, np.full(4, 3.0)])
    drive(plant, 0.5, setpoints)
    for play in (0.02, 0.01, 0.03, 0.0):
        energy = stored(plant)
        parameters = plant.parameters.copy()
        parameters["servo.backlash"] = play
        plant.set_parameters(parameters)
        assert np.all(stored(plant) < energy + 1e-9)
        truth = drive(plant, 0.1, setpoints)
        assert np.abs(truth.joint_velocity[:, 4:] - 3.0).max() < 1.0


def test_state_with_play_round_trips():
    plant = make_plant(2, {"servo.backlash": 0.02})
    drive(plant, 0.3, np.concatenate([LEGS_DOWN + 0.1, np.full(4, 3.0)]))
    state = plant.mechanical_state()
    assert np.abs(gears(plant)[0]).max() > 0.005
    plant.reset(state=state)
    again = plant.mechanical_state()
    for name in ("rotor_lead", "rotor_rate", "supply_drop"):
        np.testing.assert_array_equal(getattr(again, name), getattr(state, name))


# ---- effects of the floor in the engine: patches, slip weakening, creep, grip, tether; against closed forms ----------


def floor(mu, mu_y=None, **more):
    """Friction of the floor, and others of its numbers."""
    numbers = {"mu_x": mu, "mu_y": mu if mu_y is None else mu_y, **more}
    return {f"ground.{name}": value for name, value in numbers.items()}


def patch(place, mu, x=(-50.0, 50.0), y=(-50.0, 50.0), robots: int | slice = slice(None)):
    """Lay a patch of other friction into a place of the table."""

    def edit(parameters):
        for name, value in zip(("mu", "x_min", "x_max", "y_min", "y_max"), (mu, *x, *y), strict=True):
            parameters[f"patch.{name}"][robots, place] = value

    return edit


def thrown(speed):
    def place(state):
        state.linear_velocity_in_body[:, 0] = speed

    return place


def friction_used(truth):
    """Friction over normal force of every wheel (N, 4)."""
    force = contact_force(truth)
    return np.hypot(force[..., 0], force[..., 1]) / force[..., 2]


def test_patch_acts_under_each_wheel_from_its_edge_on():
    mu, patch_mu, edge = 0.6, 0.2, 0.25
    plant = make_plant(2, [lock, floor(mu), patch(1, patch_mu, (edge, 50.0))], thrown(2.0), period=1e-3)
    inside = []
    for values in record(plant, 0.4):
        truth = Truth(values)
        x = truth.position[:, :1] + ROBOT.hip_position.x * np.array([1.0, 1.0, -1.0, -1.0])  # it heads along x, legs down
        clear = np.abs(x - edge) > 4e-3
        expected = np.where(x > edge, patch_mu, mu)
        np.testing.assert_allclose(np.where(clear, friction_used(truth), expected), expected, rtol=1e-5)
        np.testing.assert_allclose(np.where(clear, truth.effective_friction[:, ::2], expected), expected, rtol=1e-12)
        inside.append((x[0] > edge).sum())
    assert {0, 2, 4} <= set(inside)  # front wheels enter first
    assert inside[0] == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_map_of_friction_acts_under_each_wheel_cell_by_cell(backend):
    """Under patches; beyond the map the floor has its own friction."""
    across, cell = np.array([0.2, 0.7, 0.4, 0.3]), 0.15
    on_map = {"friction_map.number": maps.enter_map(np.tile(across, (3, 1)) / 2.0), "friction_map.cell": cell}
    on_map |= {"friction_map.x": 0.2, "friction_map.scale": 2.0}
    plant = make_plant(
        2, [lock, floor(0.6), on_map, patch(0, 0.1, (0.45, 0.48))], thrown(2.0), period=1e-3, step=2.5e-4, backend=backend
    )
    seen = set()
    for values in record(plant, 0.4):
        truth = Truth(values)
        x = truth.position[:, :1] + ROBOT.hip_position.x * np.array([1.0, 1.0, -1.0, -1.0])
        column = np.floor((x - 0.2) / cell).astype(int) + 2
        expected = np.where((column < 0) | (column > 3), 0.6, across[np.clip(column, 0, 3)])
        expected = np.where((x > 0.45) & (x < 0.48), 0.1, expected)
        edges = np.append(0.2 + cell * np.arange(-2, 3), [0.45, 0.48])
        clear = (np.abs(x[..., None] - edges) > 4e-3).all(axis=-1)
        np.testing.assert_allclose(np.where(clear, truth.effective_friction[:, ::2], expected), expected, rtol=1e-12)
        np.testing.assert_allclose(np.where(clear, friction_used(truth), expected), expected, rtol=5e-3)
        seen |= set(expected[clear].tolist())
    assert seen == {0.6, 0.1, *across}


def test_sliding_slows_by_what_the_floor_under_it_gives():
    mu = 0.25
    plant = make_plant(2, [lock, floor(0.6), patch(0, mu)], thrown(2.0))
    first, last = drive(plant, 0.2), drive(plant, 0.4)
    rate = (first.linear_velocity_in_body[:, 0] - last.linear_velocity_in_body[:, 0]) / 0.4
    np.testing.assert_allclose(rate, mu * G, rtol=2e-4)


def test_later_patch_wins_and_empty_patches_do_nothing():
    both = [patch(0, 0.1, robots=0), patch(2, 0.7, robots=0)]
    grip = np.ones((2, 4))
    grip[0, 3] = 0.5
    narrow = patch(3, 0.1, (0.0, 5.0), (0.0, 0.0), robots=1)
    shown = make_plant(2, [floor(0.6, 0.3), *both, narrow, {"wheel.grip": grip}]).truth().effective_friction.reshape(2, 4, 2)
    np.testing.assert_allclose(shown[1], np.tile([0.6, 0.3], (4, 1)), rtol=1e-12)
    np.testing.assert_allclose(shown[0], np.outer([1, 1, 1, 0.5], [0.7, 0.35]), rtol=1e-12)


@pytest.mark.parametrize("step", STEPS)
def test_slip_weakening_slows_a_slide_by_its_law(step):
    """dv/dt = -g mu (ratio + (1 - ratio) exp(-v/v_s)), integrated finely by hand."""
    mu, ratio, slip_speed = 0.5, 0.4, 0.3
    weak = floor(mu, kinetic_ratio=ratio, weakening_speed=slip_speed)
    history = record(make_plant(2, [lock, weak, {"body.com_offset": (0.0, 0.0, -0.05)}], thrown(1.5), step=step), 0.4)
    measured = channel(history, "linear_velocity_in_body")[3:, 0, 0]

    def law(v):
        return mu * (ratio + (1 - ratio) * np.exp(-v / slip_speed))

    v, expected = measured[0], []
    for _ in measured:
        expected.append(v)
        for _ in range(200):  # 20 ms
            v -= 1e-4 * G * law(v - 0.5e-4 * G * law(v))
    assert measured[-1] > 0.1
    np.testing.assert_allclose(measured, expected, atol=2e-3 + step)
    truth = Truth(history[-1])
    np.testing.assert_allclose(friction_used(truth), law(np.abs(truth.slip_velocity[:, ::2])), rtol=0.1 * step / 1e-3)


@pytest.mark.parametrize("step", STEPS)
def test_creep_slips_steadily_under_a_steady_pull(step):
    """v = v_c atanh(F/(mu N)) summed over the wheels: here all carry alike."""
    mu, creep_speed, share = 0.5, 0.05, np.array([0.2, 0.6, 0.9, 0.97])
    edit = [lock, floor(mu, creep_speed=creep_speed), {"external_force[y]": share * mu * WEIGHT}]
    truth = drive(make_plant(4, edit, step=step), 4.0)
    speed = np.abs(truth.slip_velocity.reshape(4, 4, 2)[..., 1])
    np.testing.assert_allclose(friction_used(truth), mu * np.tanh(speed / creep_speed), rtol=1e-6)
    np.testing.assert_allclose(np.abs(contact_force(truth)[..., 1]).sum(axis=1), share * mu * WEIGHT, rtol=1e-6)
    alike = np.abs(truth.linear_velocity_in_body[:, 1])
    np.testing.assert_allclose(alike, creep_speed * np.arctanh(share), rtol=0.02)
    assert contact_force(truth)[..., 2].min() > 0.0


def test_slow_creep_is_dry_friction():
    """Thrown robots come to rest where dry friction stops them, as the creep speed goes to zero."""
    creep_speed = np.array([[0.0], [1e-4], [1e-3], [1e-2]])
    x = drive(make_plant(4, [lock, {"ground.creep_speed": creep_speed}], thrown(1.0)), 0.6).position[:, 0]
    off = np.abs(x[1:] - x[0])
    assert off[0] < 1e-4
    assert off[0] < off[1] < off[2]


def test_creep_knows_no_heading():
    """Anisotropic tyres that creep, pushed along the same body direction at eight headings: the same motion in the body."""
    yaw = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    push = 0.4 * WEIGHT * np.column_stack([np.cos(yaw + 0.6), np.sin(yaw + 0.6)])

    def place(state):
        turn(state, yaw)
        state.linear_velocity_in_body[:] = (0.3, -0.2, 0.0)

    truth = drive(make_plant(8, [lock, floor(0.8, 0.4, creep_speed=0.05), {"external_force": push}], place), 1.0)
    assert np.ptp(own_path(truth, yaw)[:, :2], axis=0).max() < 1e-8
    assert np.ptp(truth.linear_velocity_in_body, axis=0).max() < 1e-8


def test_creep_force_opposes_the_scaled_slip():
    """Along (mu_x^2 sx, mu_y^2 sy), of size N |(mu_x^2 sx, mu_y^2 sy)|/|(mu_x sx, mu_y sy)| tanh(|s|/v_c)."""
    mu = np.array([0.8, 0.4])

    def place(state):
        state.linear_velocity_in_body[:, 0] = 0.3
        state.linear_velocity_in_body[:, 1] = np.linspace(0.0, 0.4, len(state))

    truth = drive(make_plant(6, [lock, floor(*mu, creep_speed=0.2)], place, period=1e-3), 0.02)
    slip, force = truth.slip_velocity.reshape(6, 4, 2), contact_force(truth)
    scaled = mu * slip
    size = np.tanh(np.linalg.norm(slip, axis=2) / 0.2) / np.linalg.norm(scaled, axis=2)
    np.testing.assert_allclose(force[..., :2], -mu * scaled * (size * force[..., 2])[..., None], rtol=2e-2, atol=0.02)


def test_creep_converges_with_the_step():
    def end(step):
        plant = make_plant(2, {"ground.creep_speed": 0.03, "servo.profile_acceleration": 15.0}, step=step)
        for left, right in ((3.0, -2.0), (-2.0, 4.0), (4.0, 3.0)):
            truth = drive(plant, 0.3, np.concatenate([LEGS_DOWN, [left, right, left, right]]))
        return truth.position[0, :2]

    fine = end(2.5e-5)
    errors = [np.abs(end(step) - fine).max() for step in (2.5e-4, 1e-3, 4e-3)]
    assert errors[1] < 1e-4
    assert errors[0] < 0.5 * errors[1]
    assert errors[2] < 1e-3


def test_tether_is_a_horizontal_spring_to_the_anchor():
    """On ice the robot swings about the anchor with sqrt(k/m); the pull is k times the distance."""
    stiffness, anchor = 40.0, np.array([0.3, -0.2])
    spring = {"tether.stiffness": stiffness, "tether.anchor": anchor}
    measured = channel(record(make_plant(2, [lock, floor(0.0), spring], period=1e-2), 2.0), "position")[:, 0, :2]
    time = 0.01 * np.arange(1, len(measured) + 1)
    expected = anchor * (1.0 - np.cos(np.sqrt(stiffness / MASS) * time))[:, None]
    np.testing.assert_allclose(measured, expected, atol=0.01 * float(np.linalg.norm(anchor)))

    held = drive(make_plant(2, [lock, {"tether.stiffness": 10.0, "tether.anchor": (0.5, 0.0)}]), 1.0)
    np.testing.assert_allclose(contact_force(held)[..., 0].sum(axis=1), -10.0 * (0.5 - held.position[:, 0]), rtol=1e-4)


# ---- power balance with effects on, and formula forces, in the engine ------------------------------------------------


FAMILIES = {
    "drive": {
        "servo.torque_scale": 0.8, "servo.stribeck_torque": 0.03, "servo.load_friction": 0.1, "servo.ripple_amplitude": 0.02,
        "servo.ripple_order": 5.0, "servo.supply_resistance": 0.3,
    },
    "ground": [{"ground.kinetic_ratio": 0.6, "ground.weakening_speed": 0.2}, patch(0, 0.3, (0.05, 9.0))],
    "creep": {"ground.creep_speed": 0.05},
    "compliance": {"servo.creep_rate": 0.3, "ground.flattening": 0.5},
    "tether": {"tether.stiffness": 20.0, "tether.anchor": (0.2, 0.3)},
    "backlash": {"servo.backlash": 0.02},
}  # fmt: skip


@pytest.mark.parametrize("family", FAMILIES)
def test_power_balance_closes(family):
    """What the motors do is stored or goes into friction; gear play may lose more, in its teeth, never less."""
    rng = np.random.default_rng(1)
    plant = make_plant(4, FAMILIES[family], period=1e-3)
    done = audit(plant, 2000, 400, lambda: np.hstack([rng.uniform(1.3, 1.8, (4, 4)), rng.uniform(-4.0, 4.0, (4, 4))]))
    np.testing.assert_allclose(done.shown, done.work["motor"], atol=1e-9)
    assert done.done.min() > 0.5
    assert (done.work["gear"] + done.work["friction"]).sum(axis=0).max() < -0.01
    if family == "backlash":
        assert done.missing.max() < 1e-3
        assert done.missing.min() > -0.2
    else:
        assert np.abs(done.missing).max() < 2e-5


@pytest.mark.slow
def test_formula_spring_in_a_leg_acts_like_a_motor():
    """Torque off, in space: leg and platform swing against each other about the spring's rest angle."""
    stiffness, rest = 2.0, 1.4
    spring = [make_force(["leg_lf"], "-k * (leg_angle - a)", {"k": stiffness, "a": rest}, {"k": "N m/rad", "a": "rad"})]
    friction = {"servo.coulomb_friction": [0.0, *[50.0] * 7]}
    plant = make_plant(2, [float_in_space, friction, HEAVY], lift, forces=spring, period=1e-3)
    angles = channel(record(plant, 0.6, torque_on=np.zeros((2, 8), bool)), "joint_position")[:, 0, 0]
    np.testing.assert_allclose([angles.min(), angles.max()], [2 * rest - np.pi / 2, np.pi / 2], atol=2e-3)


@pytest.mark.slow
def test_formula_drag_on_the_body_slows_it_exponentially():
    drag = [make_force(["body_force_x"], "-c * velocity_x", {"c": 2.0}, {"c": "N s/m"})]

    def throw(state):
        lift(state)
        state.linear_velocity_in_body[:, 0] = 1.0

    truth = drive(make_plant(2, [float_in_space, lock], throw, forces=drag), 0.5)
    np.testing.assert_allclose(np.linalg.norm(truth.linear_velocity_in_body, axis=1), np.exp(-2.0 * 0.5 / MASS), rtol=2e-2)


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


def different_robots(count):
    """Robots that differ from each other; row i depends on i alone."""
    parameters = Parameters.nominal(ROBOT, count)
    for row in range(count):
        rng = np.random.default_rng([7, row])
        parameters["ground.mu_x"][row], parameters["ground.mu_y"][row] = rng.uniform(0.2, 0.9, (2, 4))
        parameters["body.com_offset"][row] = rng.uniform(-0.01, 0.01, 3)
        parameters["servo.viscous_friction"][row] = rng.uniform(0.0, 0.02, 8)
    return parameters


def random_setpoints(count, ticks=20):
    """Setpoints (ticks, count, 8); column i depends on i alone."""
    low, high = np.repeat([1.2, -5.0], 4), np.repeat([1.9, 5.0], 4)
    return np.stack([np.random.default_rng([8, row]).uniform(low, high, (ticks, 8)) for row in range(count)], axis=1)


def rollout(plant, parameters, commands):
    """Truth and sensors (ticks, N, columns)."""
    plant.reset(seeds=np.arange(len(parameters), dtype=np.uint64), parameters=parameters)
    return np.array([np.hstack([plant.step(row).values, plant.truth().values]) for row in commands])


def with_effects(parameters, families):
    changed = parameters.copy()
    for name, value in (ONE_OF_EACH[family] for family in families):
        changed[name] = value
    return changed


@pytest.mark.usefixtures("own_kernels")
@pytest.mark.parametrize(
    ("count", "precision"), [(1, "float64"), pytest.param(9, "float64", marks=pytest.mark.slow), (17, "float32")]
)
def test_all_families_at_once(count, precision):
    """Neutral robots as in the plain kernel, robots with one family as in that family's, at every tile width; these families'
    own kernels too leave the neutral ones their bits."""
    parameters, commands = different_robots(count), random_setpoints(count)
    options = PlantOptions(precision=precision)
    plant = GibbsAppellPlant(ROBOT, count, options)
    rollout(plant, with_effects(parameters, ONE_OF_EACH), commands[:2])
    assert plant._features == set().union(*FEATURES.values())
    plain = rollout(GibbsAppellPlant(ROBOT, count, options), parameters, commands)
    np.testing.assert_array_equal(rollout(plant, parameters, commands), plain)
    if precision == "float64" and count > 1:
        for family in ONE_OF_EACH:
            changed, own = with_effects(parameters, [family]), GibbsAppellPlant(ROBOT, count)
            alone = rollout(own, changed, commands)
            assert own._features == FEATURES[family]
            assert not np.array_equal(alone, plain)
            np.testing.assert_array_equal(rollout(plant, changed, commands), alone)
            np.testing.assert_array_equal(rollout(own, parameters, commands), plain)
