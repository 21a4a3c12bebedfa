"""Motion of the engine: free flight, energy, loads, turns, convergence; flat tyres and creeping gears in both simulators."""

import itertools

import numpy as np
import pytest
from energy import audit, kinetic_energy, mechanical_energy
from random_robots import States, random_parameters, relative_error
from rig import (
    BACKENDS,
    BODY_MASS,
    HOME,
    LEG_COM,
    LEG_MASS,
    LEGS_DOWN,
    MIRROR,
    RADIUS,
    ROBOT,
    WEIGHT,
    WHEEL_INERTIA,
    WHEEL_MASS,
    G,
    channel,
    contact_force,
    drive,
    lock,
    make_plant,
    record,
    wheels_off,
)

from wlr_gym.physics import servo
from wlr_gym.physics.plants.base import Truth

FLYING = 200


def velocity(state):
    return np.concatenate([state.linear_velocity_in_body, state.angular_velocity_in_body, state.joint_velocity], axis=1)


def test_engine_accelerations_equal_the_equations():
    """(u(h) - u(0)) / h of one step is a power series in h; Richardson's table over five step sizes leaves rounding only.

    All motors at their voltage limit, external force and viscous friction included, so their signs are tested as well.
    """
    rng, drawn = np.random.default_rng(1), States(FLYING, 1)
    parameters = random_parameters(FLYING, 2)
    parameters["servo.viscous_friction"] = rng.uniform(0.0, 0.02, (FLYING, 8))
    parameters["external_force"] = rng.normal(size=(FLYING, 2)) * 5.0
    sign = rng.choice([-1.0, 1.0], (FLYING, 8))
    setpoints = np.where(np.arange(8) < 4, drawn.angles + 50.0 * sign, 1000.0 * sign)

    def place(state):
        state.position[:] = 0.0, 0.0, 100.0
        state.quaternion[:], state.linear_velocity_in_body[:], state.angular_velocity_in_body[:] = (
            drawn.quaternion, drawn.v, drawn.w,
        )  # fmt: skip
        state.joint_position[:], state.joint_velocity[:] = drawn.angles, drawn.rates
        state.reference_position[:] = np.where(np.arange(8) < 4, setpoints, drawn.angles)
        state.reference_velocity[:] = np.where(np.arange(8) < 4, 0.0, setpoints)

    table = []
    for level in range(6):
        step = 2e-4 / 2**level
        plant = make_plant(FLYING, lambda p: p.values.__setitem__(..., parameters.values), place, step=step, period=step)
        before = velocity(plant.mechanical_state())
        plant.step(setpoints)
        table.append((velocity(plant.mechanical_state()) - before) / step)
    for power in range(1, 6):
        table = [(2**power * fine - coarse) / (2**power - 1) for coarse, fine in itertools.pairwise(table)]

    constants = servo.motor_constants(parameters["servo.stall_torque"], parameters["servo.no_load_speed"], 12.0)
    drawn.force[:] = 0.0
    drawn.force[:, :3] = np.einsum("nji,nj->ni", drawn.rotation[:, :2], parameters["external_force"])
    drawn.force[:, 6:] = servo.motor_torque(*constants, 12.0 * sign, drawn.rates)
    drawn.force[:, 6:] -= parameters["servo.viscous_friction"] * drawn.rates
    assert relative_error(table[0], drawn.accelerations(parameters)) < 1e-9


def fly(step):
    """Return the largest |energy - first energy| over 2 s, in units of the first kinetic energy; 8 tumbling robots."""
    rng = np.random.default_rng(3)

    uneven = {
        "servo.coulomb_friction": 0.0,
        "body.com_offset": (0.02, -0.01, 0.03),
        "ground.slope": (0.2, -0.1),
        "payload.mass": 0.4,
        "payload.position": (0.1, 0.05, 0.04),
        "wheel.mass": [0.02, 0.03, 0.05, 0.04],
    }

    def place(state):
        state.position[:, 2] = 100.0
        state.linear_velocity_in_body[:] = rng.normal(size=(8, 3))
        state.angular_velocity_in_body[:] = 2.0 * rng.normal(size=(8, 3))
        state.joint_velocity[:] = np.repeat([4.0, 20.0], 4) * rng.normal(size=(8, 8))

    plant = make_plant(8, uneven, place, step=step)
    kinetic, energy = energies(plant)
    drift = np.zeros(8)
    for _ in range(20):
        for _ in range(5):
            plant.step(np.zeros((8, 8)), np.zeros((8, 8), bool))
        drift = np.maximum(drift, np.abs(energies(plant)[1] - energy) / kinetic)
    return drift


def energies(plant):
    state = plant.mechanical_state()
    motion = state.linear_velocity_in_body, state.angular_velocity_in_body, state.joint_position, state.joint_velocity
    return kinetic_energy(plant.parameters, *motion), mechanical_energy(plant.parameters, state)


def test_free_flight_conserves_energy():
    assert ROBOT.servo.leg.viscous_friction == 0.0
    drift = fly(1e-5).max()
    assert drift < 1e-8


def test_free_flight_is_second_order():
    ratio = fly(1e-3) / fly(5e-4)
    assert np.median(ratio) > 3.6


# ---- energy balance of a driven robot on a slope: what the motors put in is stored or dissipated, term by term -------


VISCOUS = 0.005
ON_A_SLOPE = {
    "ground.slope": (0.1, 0.05),
    "ground.mu_x": np.array([[0.3], [0.5], [0.6], [0.4]]),
    "ground.mu_y": np.array([[0.3], [0.4], [0.2], [0.4]]),
    "ground.rolling_resistance": 0.01,
    "servo.viscous_friction": VISCOUS,
    "servo.profile_velocity": 2.0,
    "servo.profile_acceleration": np.repeat([15.0, 10.0], 4),
}


@pytest.fixture(scope="module")
def driven():
    """Work of every force over 10 s of random driving."""
    rng = np.random.default_rng(0)

    def draw():
        return np.hstack([rng.uniform(1.0, 2.1, (4, 4)), rng.uniform(-5.0, 5.0, (4, 4))])

    return audit(make_plant(4, ON_A_SLOPE, period=1e-3), 10_000, 500, draw, VISCOUS)


def test_energy_balance_closes(driven):
    assert driven.done.min() > 1.0
    assert np.abs(driven.missing).max() < 1e-5


@pytest.mark.parametrize("term", ["gear", "viscous", "friction", "rolling"])
def test_every_friction_dissipates(driven, term):
    assert driven.work[term].sum(axis=0).max() < -1e-3
    assert driven.work[term].max() < 1e-6  # J per tick: slip that reverses within a tick is averaged over its ends


def test_mechanical_energy_is_the_motors_work(driven):
    np.testing.assert_allclose(driven.shown, driven.work["motor"], atol=1e-12)


# ---- wheel loads at rest against statics and against the paper's normal forces (16), (17) ----------------------------


HALF_LENGTH, HALF_WIDTH, LENGTH = (
    ROBOT.hip_position.x,
    ROBOT.hip_position.y,
    ROBOT.leg.length,
)
WHEEL_X = HALF_LENGTH * np.array([1.0, 1.0, -1.0, -1.0])
WHEEL_Y = HALF_WIDTH * np.array([1.0, -1.0, 1.0, -1.0])


def settle(count, edit=None, place=None):
    """Locked robots on hard tyres, so that their tilt does not move the centre of mass; loads (N, 4) after 2 s."""
    hard = {"ground.mu_x": 1.0, "ground.mu_y": 1.0, "ground.normal_stiffness": 1e5, "ground.normal_damping": 300.0}
    plant = make_plant(count, [lock, hard, edit], place, step=2.5e-4)
    return contact_force(drive(plant, 2.0))[:, :, 2]


def static_loads(weight, x, y, height, slope):
    """Loads of four equal springs at the wheels' corners that balance a weight at (x, y, height) on an inclined floor."""
    uphill = np.sin(slope)
    normal = weight * np.sqrt(1.0 - (uphill**2).sum())
    mean = normal / 4
    pitch = (normal * x - weight * uphill[0] * height) / (4 * HALF_LENGTH**2)
    roll = (normal * y - weight * uphill[1] * height) / (4 * HALF_WIDTH**2)
    return mean + pitch * WHEEL_X + roll * WHEEL_Y


LEVEL = LENGTH + RADIUS
LIMBS = 4 * (LEG_MASS * (LENGTH - LEG_COM + RADIUS) + WHEEL_MASS * RADIUS)
#: payload mass, payload position, centre-of-mass offset of the body, slope
CASES = [
    (0.0, (0, 0, 0), (0, 0, 0), (0, 0)),
    (1.0, (0.1, 0.05, 0.04), (0, 0, 0), (0, 0)),
    (0.0, (0, 0, 0), (0.03, -0.02, 0.01), (0, 0)),
    (0.0, (0, 0, 0), (0, 0, 0), (0.3, 0.0)),
    (0.0, (0, 0, 0), (0, 0, 0), (0.0, -0.3)),
    (0.8, (-0.1, 0.1, 0.02), (0.02, 0.01, -0.01), (-0.2, 0.15)),
]


def test_wheel_loads_are_those_of_statics():
    names = ("payload.mass", "payload.position", "body.com_offset", "ground.slope")
    loads = settle(len(CASES), dict(zip(names, map(np.array, zip(*CASES, strict=True)), strict=True)))
    for load, (mass, position, offset, slope) in zip(loads, CASES, strict=True):
        weight = WEIGHT + mass * G
        moment = BODY_MASS * np.array(offset) + mass * np.array(position)
        height = (BODY_MASS + mass) * LEVEL + moment[2] + LIMBS
        center = np.array([moment[0], moment[1], height]) * G / weight
        expected = static_loads(weight, center[0], center[1], center[2], np.array(slope))
        np.testing.assert_allclose(load, expected, atol=2e-3 * weight / 4)
        np.testing.assert_allclose(load.sum(), expected.sum(), rtol=1e-6)


def posture(front, rear):
    """Pitch psi (nose down) and height of the body when all four wheels touch; audit of the paper, section 1."""
    pitch = np.arctan2(LENGTH * (np.sin(rear) - np.sin(front)), 2 * HALF_LENGTH + LENGTH * (np.cos(front) - np.cos(rear)))
    return pitch, RADIUS + LENGTH / 2 * (np.sin(front + pitch) + np.sin(rear + pitch))


def paper_normal_forces(front, rear):
    """Equations (16) and (17) per wheel, with the wheels' mass added and the leg's centre of mass at the fraction c."""
    pitch, _ = posture(front, rear)
    f, r = np.cos(front + pitch), np.cos(rear + pitch)
    track = 2 * HALF_LENGTH * np.cos(pitch)
    c = LEG_COM / LENGTH
    body, leg, wheel = BODY_MASS * G, LEG_MASS * G, WHEEL_MASS * G
    base = track + LENGTH * (f - r)
    front_force = body / 2 * (track / 2 - LENGTH * r) + leg * (track + c * LENGTH * f - (2 - c) * LENGTH * r)
    rear_force = body / 2 * (track / 2 + LENGTH * f) + leg * (track + (2 - c) * LENGTH * f - c * LENGTH * r)
    return front_force / base + wheel, rear_force / base + wheel


def test_normal_forces_of_the_paper():
    """Symmetric postures, among them the start, middle and end of both of its experiments."""
    degrees = np.array([(30, 30), (30, 90), (30, 150), (90, 90), (150, 30), (120, 60), (60, 40), (75, 110)], dtype=float)
    front, rear = np.radians(degrees).T
    pitch, height = posture(front, rear)

    def place(state):
        state.position[:, 2] = height
        state.quaternion[:] = np.column_stack([np.cos(pitch / 2), 0 * pitch, np.sin(pitch / 2), 0 * pitch])
        state.joint_position[:, :4] = np.column_stack([front, front, rear, rear])

    loads = settle(len(degrees), place=place)
    expected = np.column_stack(paper_normal_forces(front, rear))
    np.testing.assert_allclose(loads[:, 0], loads[:, 1], rtol=1e-5)
    np.testing.assert_allclose(loads[:, 2], loads[:, 3], rtol=1e-5)
    np.testing.assert_allclose(loads[:, [0, 2]], expected, rtol=1e-3)
    np.testing.assert_allclose(expected.sum(axis=1), WEIGHT / 2, rtol=1e-12)


def test_hip_torque_at_rest_is_the_papers_static_torque():
    """tau = l cos(alpha + psi) (N - c m_l g - m_w g) per leg, carried by the motors where gears are free of friction."""
    front, rear = np.radians([50.0, 60.0]), np.radians([130.0, 120.0])

    def place(state):
        state.position[:, 2] = posture(front, rear)[1]
        state.joint_position[:, :4] = np.column_stack([front, front, rear, rear])
        state.reference_position[:] = state.joint_position

    plant = make_plant(2, {"servo.coulomb_friction": 0.0, "servo.kp of legs": 1500.0}, place, step=2.5e-4)
    setpoints = np.column_stack([front, front, rear, rear, np.zeros((2, 4))])
    truth = drive(plant, 2.0, setpoints)
    force = contact_force(truth)
    angle = truth.joint_position[:, :4]
    arm = LENGTH * np.cos(angle)
    weight = (LEG_COM / LENGTH * LEG_MASS + WHEEL_MASS) * G
    traction = (LENGTH * np.sin(angle) + RADIUS) * force[:, :, 0]
    wheel_torque = truth.motor_torque[:, 4:]
    expected = arm * (force[:, :, 2] - weight) + traction
    np.testing.assert_allclose(truth.motor_torque[:, :4], expected, atol=2e-3)
    np.testing.assert_allclose(wheel_torque, RADIUS * force[:, :, 0], atol=1e-4)


# ---- skid turns, mirrored robots and unequal wheels ------------------------------------------------------------------


LEFT, RIGHT = [4, 6], [5, 7]


def skid(left, right):
    setpoints = HOME.copy()
    setpoints[LEFT], setpoints[RIGHT] = left, right
    return setpoints


def heading(truth):
    w, x, y, z = truth.quaternion.T
    return np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def test_skid_turns_turn_towards_the_slower_side():
    """Left back and right forth is a left turn; forwards it bends to the slower side; straight stays straight."""
    setpoints = np.array([skid(-4, 4), skid(4, -4), skid(2, 5), skid(5, 2), skid(4, 4), skid(-4, -4)], dtype=float)
    truth = drive(make_plant(6), 3.0, setpoints)
    rate, speed = truth.angular_velocity_in_body[:, 2], truth.linear_velocity_in_body[:, 0]
    assert (np.sign(rate[:4]) == [1, -1, 1, -1]).all()
    np.testing.assert_allclose(rate[[1, 3]], -rate[[0, 2]], rtol=1e-8)
    assert np.abs(rate[4:]).max() < 1e-8
    assert np.abs(truth.position[4:, 1]).max() < 1e-8
    # a skid turn yaws slower than its wheels would without slip
    ideal = RADIUS * 8 / (2 * ROBOT.hip_position.y)
    assert 0.2 * ideal < rate[0] < 0.9 * ideal
    assert np.linalg.norm(truth.position[:2, :2], axis=1).max() < 1e-3
    np.testing.assert_allclose(speed[4:], [4 * RADIUS, -4 * RADIUS], rtol=1e-3)


def test_mirrored_commands_give_mirrored_motion():
    """Eight random drives of 5 s and their mirror images, legs and wheels independent of each other."""
    rng = np.random.default_rng(0)
    plant = make_plant(16)
    for _ in range(10):
        setpoints = np.hstack([rng.uniform(1.0, 2.0, (8, 4)), rng.uniform(-5.0, 5.0, (8, 4))])
        drive(plant, 0.5, np.vstack([setpoints, setpoints[:, MIRROR]]))
    truth = plant.truth()
    assert np.linalg.norm(truth.position[:, :2], axis=1).min() > 1e-3
    position, joints = truth.position, truth.joint_position
    error = np.abs(position[8:] * [1, -1, 1] - position[:8]).max()
    assert error < 1e-9
    assert np.abs(joints[8:, MIRROR] - joints[:8]).max() < 1e-9
    np.testing.assert_allclose(truth.quaternion[8:] * [1, -1, 1, -1], truth.quaternion[:8], atol=1e-9)


def test_robot_turns_towards_its_smaller_wheels():
    """Smaller wheels on the right: a right turn (yaw < 0); mirrored on the left; equal wheels go straight."""

    radius = RADIUS * np.array([[1.0, 0.97, 1.0, 0.97], [0.97, 1.0, 0.97, 1.0], [1.0] * 4])
    truth = drive(make_plant(3, {"wheel.radius": radius}), 4.0, np.concatenate([LEGS_DOWN, np.full(4, 5.0)]))
    yaw = heading(truth)
    assert yaw[0] < -1e-3
    assert yaw[1] > 1e-3
    assert abs(yaw[2]) < 1e-9
    np.testing.assert_allclose(yaw[1], -yaw[0], rtol=1e-6)


# --- convergence with the step ----------------------------------------------------------------------------------------


DRIVEN = 32


_MU = np.random.default_rng(1).uniform(0.2, 0.9, (DRIVEN, 4))
UNEVEN_FLOOR = {"ground.mu_x": _MU, "ground.mu_y": _MU}
SMOOTH = UNEVEN_FLOOR | {"servo.profile_velocity": 2.0, "servo.profile_acceleration": np.repeat([15.0, 10.0], 4)}


def driven_setpoints(rng):
    return np.hstack([np.pi / 2 + rng.uniform(-0.3, 0.3, (DRIVEN, 4)), rng.uniform(-6, 6, (DRIVEN, 4))])


def drive_smoothly(step, sweeps=4):
    """Position after 1 s of trapezoidal profiles between two random setpoints."""
    rng = np.random.default_rng(5)
    setpoints = driven_setpoints(rng), driven_setpoints(rng)
    plant = make_plant(DRIVEN, SMOOTH, step=step, sweeps=sweeps)
    for tick in range(50):
        plant.step(setpoints[tick // 15 % 2])
    return plant.truth().position.copy()


@pytest.fixture(scope="module")
def reference():
    return drive_smoothly(1e-5, sweeps=8)


def test_error_falls_with_the_step(reference):
    steps = np.array([2e-3, 1e-3, 5e-4])
    error = [np.median(np.linalg.norm(drive_smoothly(step) - reference, axis=1)) for step in steps]
    order = np.log2(error[0] / error[2]) / 2
    assert error[0] > error[1] > error[2]
    assert order > 0.9
    assert error[1] < 5e-4


def test_four_sweeps_are_enough():
    error = np.linalg.norm(drive_smoothly(1e-3) - drive_smoothly(1e-3, sweeps=100), axis=1)
    assert error.max() < 1e-4


@pytest.mark.parametrize("step", [2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3])
def test_stable_after_a_drop_and_under_random_commands(step):
    """Dropped from 5 cm, then new random setpoints every tick for 4 s: no growth of speed, height or tilt."""

    def place(state):
        state.position[:, 2] += 0.05

    rng = np.random.default_rng(7)
    plant = make_plant(DRIVEN, UNEVEN_FLOOR, place, step=step)
    for _ in range(200):
        plant.step(driven_setpoints(rng))
        truth = plant.truth()
        assert np.isfinite(truth.values).all()
        assert np.abs(truth.linear_velocity_in_body).max() < 2.0
        assert np.abs(truth.position[:, 2] - 0.17).max() < 0.08
        assert np.hypot(truth.quaternion[:, 1], truth.quaternion[:, 2]).max() < 0.3
    np.testing.assert_allclose(np.linalg.norm(plant.truth().quaternion, axis=1), 1.0, atol=1e-12)


# --- tyres that flatten, in both simulators ---------------------------------------------------------------------------


EACH = pytest.mark.parametrize("backend", BACKENDS)


def rolled(backend, count, changes, setpoints):
    """Distance over angle (N, 4) of wheels that drive steadily for 1.5 s, and the truth at the end."""
    history = record(make_plant(count, changes, backend=backend), 1.5, setpoints)
    first, last = Truth(history[len(history) // 2]), Truth(history[-1])
    turned = (last.joint_position - first.joint_position)[:, 4:]
    way = np.hypot(*(last.position - first.position)[:, :2].T)
    return way[:, None] / turned, last


@EACH
def test_a_load_shortens_the_rolling_radius(backend):
    """Four robots: none, a load, tyres that flatten, both."""
    share, load = 0.4, np.array([0.0, 1.5, 0.0, 1.5])
    changes = {"payload.mass": load, "ground.flattening": np.array([[0.0], [0.0], [share], [share]])}
    found, _ = rolled(backend, 4, changes, HOME + np.repeat([0.0, 4.0], 4))
    deeper = 1.5 * G / 4 / ROBOT.ground.normal_stiffness
    np.testing.assert_allclose(found.mean(axis=1), RADIUS - share * np.array([0.0, 0.0, 0.0, deeper]), atol=3e-6)


@EACH
def test_it_is_the_arm_of_friction_too(backend):
    """Against a steady pull the wheels' torques are the pull times the radius on which they roll."""
    pull, load, share = 4.0, 3.0, 0.5
    changes = {"payload.mass": load, "external_force[x]": -pull, "ground.flattening": np.array([[0.0], [share]])}
    _, truth = rolled(backend, 2, changes, HOME + np.repeat([0.0, 3.0], 4))
    torque = (truth.motor_torque + truth.friction_torque)[:, 4:].sum(axis=1)
    deeper = load * G / 4 / ROBOT.ground.normal_stiffness
    np.testing.assert_allclose(torque, pull * (RADIUS - np.array([0.0, share * deeper])), rtol=3e-3)
    assert torque[1] / torque[0] == pytest.approx(1.0 - share * deeper / RADIUS, abs=1e-3)
    assert np.abs(truth.slip_velocity).max() < 1e-4


@EACH
def test_a_wheel_in_the_air_lands_where_the_floor_is(backend):
    """Only the arm of friction changes: dropped without spin, robots fall, land and bounce alike."""

    def drop(state):
        state.position[:, 2] += 0.01

    flat = {"ground.flattening": np.array([[0.0], [1.0]])}
    history = record(make_plant(2, flat, drop, backend=backend), 0.8)
    height, normal = channel(history, "position")[..., 2], channel(history, "contact_force")[..., 2::3]
    np.testing.assert_allclose(height[:, 1], height[:, 0], atol=1e-6)
    assert normal.max(axis=(1, 2)).min() == 0.0
    assert normal[-1].sum(axis=1) == pytest.approx(WEIGHT, rel=0.01)


# ---- gears whose dry friction creeps before it is full, in both simulators, against closed forms ---------------------


CREEP, FRICTION = 0.02, 0.05


def pulled(backend, share, step=1e-3, seconds=1.0, **changes):
    """Rates (ticks, N) and last friction (N) of the left front wheel of robots with wheels off, pulled by a share of what gears
    hold."""
    numbers = {"coulomb_friction": np.repeat([50.0, FRICTION], 4), "viscous_friction": 0.0, "creep_rate of wheels": CREEP}
    numbers |= {f"{name} of wheels": value for name, value in changes.items()}
    edit = {f"servo.{name}": value for name, value in numbers.items()} | {"external_force[x]": share * 4 * FRICTION / RADIUS}
    history = record(make_plant(len(share), edit, step=step, backend=backend), seconds, HOME, wheels_off(len(share)))
    return channel(history, "joint_velocity")[..., 4], channel(history, "friction_torque")[-1, :, 4]


@EACH
def test_a_gear_creeps_in_proportion_to_its_load(backend):
    """Below its dry friction F a gear turns at creep_rate x torque/F, and its friction is that torque."""
    share = np.array([0.2, 0.6, 0.95])
    rates, friction = pulled(backend, share)
    np.testing.assert_allclose(rates[-1], share * CREEP, rtol=2e-3)
    np.testing.assert_allclose(friction, -share * FRICTION, rtol=2e-3)


@EACH
def test_beyond_it_the_friction_is_coulombs(backend):
    """Pulled by 1.5 F the robot gains what half of F accelerates: its mass, and four wheels that turn."""
    mass = WEIGHT / G + 4 * WHEEL_INERTIA / RADIUS**2
    for step in (1e-3, 2.5e-4):
        rates = pulled(backend, np.array([1.5]), step, seconds=0.4)[0][:, 0]
        gained = (rates[-1] - rates[9]) / (0.02 * (len(rates) - 10))
        assert gained == pytest.approx(0.5 * 4 * FRICTION / RADIUS**2 / mass, rel=2e-3)


def test_slow_creep_is_sticking():
    for creep in (0.0, 1e-7):
        assert np.abs(pulled("gibbs_appell", np.array([0.5]), creep_rate=creep)[0][20:]).max() < 1e-6


@EACH
def test_a_gear_with_play_creeps_too(backend):
    """The rotor rubs: once its teeth meet, the joint creeps as one without play."""
    share = np.array([0.2, 0.6, 0.95])
    rates, friction = pulled(backend, share, seconds=2.0, backlash=0.01)
    np.testing.assert_allclose(rates[-1], share * CREEP, rtol=5e-3)
    np.testing.assert_allclose(friction, -share * FRICTION, rtol=5e-3)
