"""Motion of the engine: free flight, energy, loads, turns, convergence; flat tyres and creeping gears in both simulators."""

import itertools

import numpy as np
import pytest
from energy import kinetic_energy, mechanical_energy, wheel_gaps
from rig import (
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
    contact_force,
    drive,
    lock,
    make_plant,
    wheels_off,
)
from test_contact_free_mujoco import random_parameters

from wlr_gym.physics import plants, servo
from wlr_gym.physics.model import dynamics
from wlr_gym.physics.plants.base import PlantOptions, PlantState, Truth, standing_state
from wlr_gym.robot.parameters import Parameters

FLYING = 200


def random_state(rng, count):
    quaternion = rng.normal(size=(count, 4))
    joint_scale = np.repeat([3.0, 30.0], 4)
    return PlantState(
        position=np.tile([0.0, 0.0, 100.0], (count, 1)),
        quaternion=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        linear_velocity_in_body=2.0 * rng.normal(size=(count, 3)),
        angular_velocity_in_body=3.0 * rng.normal(size=(count, 3)),
        joint_position=rng.uniform(-np.pi, np.pi, (count, 8)),
        joint_velocity=joint_scale * rng.normal(size=(count, 8)),
        reference_position=np.zeros((count, 8)),
        reference_velocity=np.zeros((count, 8)),
    )


def velocity(state):
    return np.concatenate([state.linear_velocity_in_body, state.angular_velocity_in_body, state.joint_velocity], axis=1)


def assign(target, source):
    for name, value in vars(source).items():
        if value is not None:
            getattr(target, name)[:] = value


def test_engine_accelerations_equal_the_equations():
    """(u(h) - u(0)) / h of one step is a power series in h; Richardson's table over five step sizes leaves rounding only.

    All motors at their voltage limit, external force and viscous friction included, so their signs are tested as well.
    """
    rng = np.random.default_rng(1)
    parameters = random_parameters(FLYING, 2)
    parameters["servo.viscous_friction"] = rng.uniform(0.0, 0.02, (FLYING, 8))
    parameters["external_force"] = rng.normal(size=(FLYING, 2)) * 5.0
    state = random_state(rng, FLYING)
    sign = rng.choice([-1.0, 1.0], (FLYING, 8))
    state.reference_velocity[:, 4:] = 1000.0 * sign[:, 4:]
    setpoints = np.where(np.arange(8) < 4, state.joint_position + 50.0 * sign, 1000.0 * sign)
    state.reference_position[:] = np.where(np.arange(8) < 4, setpoints, state.joint_position)

    table = []
    for level in range(6):
        step = 2e-4 / 2**level
        plant = make_plant(
            FLYING, lambda p: p.values.__setitem__(..., parameters.values), lambda s: assign(s, state), step=step, period=step
        )
        plant.step(setpoints)
        table.append((velocity(plant.mechanical_state()) - velocity(state)) / step)
    for power in range(1, 6):
        table = [(2**power * fine - coarse) / (2**power - 1) for coarse, fine in itertools.pairwise(table)]

    motor = servo.motor_torque(
        *servo.motor_constants(parameters["servo.stall_torque"], parameters["servo.no_load_speed"], 12.0),
        12.0 * sign,
        state.joint_velocity,
    )
    rotation = dynamics.rotation_matrix(state.quaternion)
    force = np.zeros((FLYING, 14))
    force[:, :3] = np.einsum("nji,nj->ni", rotation[:, :2], parameters["external_force"])
    force[:, 6:] = motor - parameters["servo.viscous_friction"] * state.joint_velocity
    expected = dynamics.accelerations(
        parameters,
        state.quaternion,
        state.linear_velocity_in_body,
        state.angular_velocity_in_body,
        state.joint_position,
        state.joint_velocity,
        force,
    )
    error = np.abs(table[0] - expected).max(axis=1) / np.abs(expected).max(axis=1)
    assert error.max() < 1e-9


def fly(step):
    """Return the largest |energy - first energy| over 2 s, in units of the first kinetic energy; 8 tumbling robots."""
    rng = np.random.default_rng(3)

    def edit(parameters):
        parameters["servo.coulomb_friction"] = 0.0
        parameters["body.com_offset"] = (0.02, -0.01, 0.03)
        parameters["ground.slope"] = (0.2, -0.1)
        parameters["payload.mass"], parameters["payload.position"] = 0.4, (0.1, 0.05, 0.04)
        parameters["wheel.mass"] = [0.02, 0.03, 0.05, 0.04]

    def place(state):
        state.position[:, 2] = 100.0
        state.linear_velocity_in_body[:] = rng.normal(size=(8, 3))
        state.angular_velocity_in_body[:] = 2.0 * rng.normal(size=(8, 3))
        state.joint_velocity[:] = np.repeat([4.0, 20.0], 4) * rng.normal(size=(8, 8))

    plant = make_plant(8, edit, place, step=step)
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


COUNT = 4
STEP = 1e-3
VISCOUS = 0.005
ROLLING = 0.01
MU = np.array([[0.3, 0.3], [0.5, 0.4], [0.6, 0.2], [0.4, 0.4]])


def edit(parameters):
    parameters["ground.slope"] = (0.1, 0.05)
    parameters["ground.mu_x"], parameters["ground.mu_y"] = MU.T
    parameters["ground.rolling_resistance"] = ROLLING
    parameters["servo.viscous_friction"] = VISCOUS
    parameters["servo.profile_velocity"] = 2.0
    parameters["servo.profile_acceleration"] = np.repeat([15.0, 10.0], 4)


def rates(truth):
    """Joint rates (N, 8), slip velocity (N, 8) and absolute spins of the wheels (N, 4)."""
    spin = truth.angular_velocity_in_body[:, 1:2] + truth.joint_velocity[:, :4] + truth.joint_velocity[:, 4:]
    return np.hstack([truth.joint_velocity, truth.slip_velocity, spin])


@pytest.fixture(scope="module")
def audit():
    """Work (ticks, N) of every force over 10 s of random driving, by name, and the energy at the ends."""
    rng = np.random.default_rng(0)
    plant = make_plant(COUNT, edit, step=STEP, period=STEP)
    parameters = plant.parameters
    names = ("motor", "gear", "viscous", "friction", "normal", "rolling")
    work = {name: np.zeros((10_000, COUNT)) for name in names}
    shown = np.zeros((10_000, COUNT))
    start = mechanical_energy(parameters, plant.truth())
    old = Truth(plant.truth().values.copy())
    old_gap, old_rates = wheel_gaps(parameters, old), rates(old)
    setpoints = np.zeros((COUNT, 8))
    for tick in range(10_000):
        if tick % 500 == 0:
            setpoints = np.hstack([rng.uniform(1.0, 2.1, (COUNT, 4)), rng.uniform(-5.0, 5.0, (COUNT, 4))])
        plant.step(setpoints)
        truth = plant.truth()
        gap, new_rates = wheel_gaps(parameters, truth), rates(truth)
        joint, slip, spin = np.split(0.5 * STEP * (new_rates + old_rates), [8, 16], axis=1)
        force = truth.contact_force.reshape(COUNT, 4, 3)
        work["motor"][tick] = (truth.motor_torque * joint).sum(axis=1)
        work["gear"][tick] = (truth.friction_torque * joint).sum(axis=1)
        work["viscous"][tick] = -VISCOUS * (joint**2).sum(axis=1) / STEP
        work["friction"][tick] = (force[..., :2].reshape(COUNT, 8) * slip).sum(axis=1)
        work["normal"][tick] = (force[..., 2] * (gap - old_gap)).sum(axis=1)
        work["rolling"][tick] = (truth.rolling_torque * spin).sum(axis=1)
        shown[tick] = truth.mechanical_energy
        old_gap, old_rates = gap, new_rates
    return start, mechanical_energy(parameters, plant.truth()), work, shown


def test_energy_balance_closes(audit):
    start, end, work, _ = audit
    total = sum(term.sum(axis=0) for term in work.values())
    done = np.abs(work["motor"]).sum(axis=0)
    error = np.abs(end - start - total) / done
    assert done.min() > 1.0
    assert error.max() < 1e-5


@pytest.mark.parametrize("term", ["gear", "viscous", "friction", "rolling"])
def test_every_friction_dissipates(audit, term):
    work = audit[2][term]
    assert work.sum(axis=0).max() < -1e-3
    assert work.max() < 1e-6  # J per tick: slip that reverses within a tick is averaged over its ends


def test_mechanical_energy_is_the_motors_work(audit):
    _, _, work, shown = audit
    np.testing.assert_allclose(shown, work["motor"], atol=1e-12)


def test_stalled_motors_turn_electrical_energy_into_heat():
    """A stalled motor draws V I with I = V/R and does no work."""

    def hold(parameters):
        parameters["servo.coulomb_friction"] = 50.0

    plant = make_plant(2, hold)
    setpoints = np.tile(np.concatenate([np.full(4, np.pi / 2), np.full(4, 100.0)]), (2, 1))
    plant.step(setpoints)
    truth = plant.truth()
    motor = plant.robot.servo.wheel
    current = motor.stall_torque / (12.0 / motor.no_load_speed)
    electrical = 4 * 12.0 * current * 0.02
    np.testing.assert_allclose(truth.electrical_energy, electrical, rtol=1e-5)
    assert np.abs(truth.mechanical_energy).max() < 1e-5 * electrical


# ---- wheel loads at rest against statics and against the paper's normal forces (16), (17) ----------------------------


HALF_LENGTH, HALF_WIDTH, LENGTH = (
    ROBOT.hip_position.x,
    ROBOT.hip_position.y,
    ROBOT.leg.length,
)
WHEEL_X = HALF_LENGTH * np.array([1.0, 1.0, -1.0, -1.0])
WHEEL_Y = HALF_WIDTH * np.array([1.0, -1.0, 1.0, -1.0])


def settle(count, edit, place=None):
    """Locked robots on hard tyres, so that their tilt does not move the centre of mass; loads (N, 4) after 2 s."""

    def hard(parameters):
        lock(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 1.0
        parameters["ground.normal_stiffness"], parameters["ground.normal_damping"] = 1e5, 300.0
        edit(parameters)

    plant = make_plant(count, hard, place, step=2.5e-4)
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
    def edit(parameters):
        for robot, (mass, position, offset, slope) in enumerate(CASES):
            parameters["payload.mass"][robot], parameters["payload.position"][robot] = mass, position
            parameters["body.com_offset"][robot], parameters["ground.slope"][robot] = offset, slope

    loads = settle(len(CASES), edit)
    for load, (mass, position, offset, slope) in zip(loads, CASES, strict=True):
        weight = WEIGHT + mass * G
        moment = BODY_MASS * np.array(offset) + mass * np.array(position)
        height = (BODY_MASS + mass) * LEVEL + moment[2] + LIMBS
        center = np.array([moment[0], moment[1], height]) * G / weight
        expected = static_loads(weight, center[0], center[1], center[2], np.array(slope))
        np.testing.assert_allclose(load, expected, atol=2e-3 * weight / 4)
        np.testing.assert_allclose(load.sum(), expected.sum(), rtol=1e-6)


@pytest.mark.parametrize("step", [2.5e-4, 1e-3, 2e-3, 4e-3])
def test_loads_of_the_nominal_robot_sum_to_its_weight(step):
    plant = make_plant(2, step=step)
    np.testing.assert_allclose(contact_force(drive(plant, 1.0))[:, :, 2].sum(axis=1), WEIGHT, rtol=1e-9)


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

    loads = settle(len(degrees), lambda parameters: None, place)
    expected = np.column_stack(paper_normal_forces(front, rear))
    np.testing.assert_allclose(loads[:, 0], loads[:, 1], rtol=1e-5)
    np.testing.assert_allclose(loads[:, 2], loads[:, 3], rtol=1e-5)
    np.testing.assert_allclose(loads[:, [0, 2]], expected, rtol=1e-3)
    np.testing.assert_allclose(expected.sum(axis=1), WEIGHT / 2, rtol=1e-12)


def test_hip_torque_at_rest_is_the_papers_static_torque():
    """tau = l cos(alpha + psi) (N - c m_l g - m_w g) per leg, carried by the motors where gears are free of friction."""
    front, rear = np.radians([50.0, 60.0]), np.radians([130.0, 120.0])

    def edit(parameters):
        parameters["servo.coulomb_friction"] = 0.0
        parameters["servo.kp"][:, :4] = 1500.0

    def place(state):
        state.position[:, 2] = posture(front, rear)[1]
        state.joint_position[:, :4] = np.column_stack([front, front, rear, rear])
        state.reference_position[:] = state.joint_position

    plant = make_plant(2, edit, place, step=2.5e-4)
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

    def edit(parameters):
        parameters["wheel.radius"][0, [1, 3]] = 0.97 * RADIUS
        parameters["wheel.radius"][1, [0, 2]] = 0.97 * RADIUS

    truth = drive(make_plant(3, edit), 4.0, np.concatenate([LEGS_DOWN, np.full(4, 5.0)]))
    yaw = heading(truth)
    assert yaw[0] < -1e-3
    assert yaw[1] > 1e-3
    assert abs(yaw[2]) < 1e-9
    np.testing.assert_allclose(yaw[1], -yaw[0], rtol=1e-6)


# --- convergence with the step ----------------------------------------------------------------------------------------


DRIVEN = 32


def uneven_floor(parameters):
    mu = np.random.default_rng(1).uniform(0.2, 0.9, (DRIVEN, 4))
    parameters["ground.mu_x"] = parameters["ground.mu_y"] = mu


def smooth(parameters):
    uneven_floor(parameters)
    parameters["servo.profile_velocity"] = 2.0
    parameters["servo.profile_acceleration"] = np.repeat([15.0, 10.0], 4)


def driven_setpoints(rng):
    return np.hstack([np.pi / 2 + rng.uniform(-0.3, 0.3, (DRIVEN, 4)), rng.uniform(-6, 6, (DRIVEN, 4))])


def drive_smoothly(step, sweeps=4):
    """Position after 1 s of trapezoidal profiles between two random setpoints."""
    rng = np.random.default_rng(5)
    setpoints = driven_setpoints(rng), driven_setpoints(rng)
    plant = make_plant(DRIVEN, smooth, step=step, sweeps=sweeps)
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
    plant = make_plant(DRIVEN, uneven_floor, place, step=step)
    for _ in range(200):
        plant.step(driven_setpoints(rng))
        truth = plant.truth()
        assert np.isfinite(truth.values).all()
        assert np.abs(truth.linear_velocity_in_body).max() < 2.0
        assert np.abs(truth.position[:, 2] - 0.17).max() < 0.08
        assert np.hypot(truth.quaternion[:, 1], truth.quaternion[:, 2]).max() < 0.3
    np.testing.assert_allclose(np.linalg.norm(plant.truth().quaternion, axis=1), 1.0, atol=1e-12)


# --- tyres that flatten, in both simulators ---------------------------------------------------------------------------


BACKENDS = ["gibbs_appell", "mujoco"]


def rolled(backend, parameters, setpoints, seconds=1.5):
    """Distance over angle (N, 4) of wheels that drive steadily, and the truth at the end."""
    count = len(parameters)
    plant = plants.make_plant(backend, ROBOT, count, PlantOptions(control_period=0.02, physics_step=1e-3, sensor_noise=False))
    plant.reset(parameters=parameters, state=standing_state(ROBOT, parameters))
    setpoints, truths = np.tile(setpoints, (count, 1)), []
    for _ in range(round(seconds / 0.02)):
        plant.step(setpoints)
        truths.append(plant.truth().values.copy())
    truth = plant.truth()
    first, last = (type(truth)(values) for values in (truths[len(truths) // 2], truths[-1]))
    turned = (last.joint_position - first.joint_position)[:, 4:]
    way = np.hypot(*(last.position - first.position)[:, :2].T)
    return way[:, None] / turned, last


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_load_shortens_the_rolling_radius(backend):
    """Four robots: none, a load, tyres that flatten, both."""
    parameters = Parameters.nominal(ROBOT, 4)
    parameters["payload.mass"][[1, 3]] = 1.5
    parameters["ground.flattening"][2:] = share = 0.4
    found, _ = rolled(backend, parameters, HOME + np.repeat([0.0, 4.0], 4))
    deeper = 1.5 * G / 4 / ROBOT.ground.normal_stiffness
    np.testing.assert_allclose(found.mean(axis=1), RADIUS - share * np.array([0.0, 0.0, 0.0, deeper]), atol=3e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_is_the_arm_of_friction_too(backend):
    """Against a steady pull the wheels' torques are the pull times the radius on which they roll."""
    parameters, pull = Parameters.nominal(ROBOT, 2), 4.0
    parameters["payload.mass"] = load = 3.0
    parameters["external_force"][:, 0] = -pull
    parameters["ground.flattening"][1] = share = 0.5
    _, truth = rolled(backend, parameters, HOME + np.repeat([0.0, 3.0], 4))
    torque = (truth.motor_torque + truth.friction_torque)[:, 4:].sum(axis=1)
    deeper = load * G / 4 / ROBOT.ground.normal_stiffness
    np.testing.assert_allclose(torque, pull * (RADIUS - np.array([0.0, share * deeper])), rtol=3e-3)
    assert torque[1] / torque[0] == pytest.approx(1.0 - share * deeper / RADIUS, abs=1e-3)
    slip = truth.slip_velocity.reshape(2, 4, 2)
    assert np.abs(slip).max() < 1e-4


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_wheel_in_the_air_lands_where_the_floor_is(backend):
    """Only the arm of friction changes: dropped without spin, robots fall, land and bounce alike."""
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["ground.flattening"][1] = 1.0
    state = standing_state(ROBOT, parameters)
    state.position[:, 2] += 0.01
    plant = plants.make_plant(backend, ROBOT, 2, PlantOptions(control_period=0.02, physics_step=1e-3, sensor_noise=False))
    plant.reset(parameters=parameters, state=state)
    lightest, truth = np.inf, plant.truth()
    for _ in range(40):
        plant.step(np.tile(HOME, (2, 1)))
        truth = plant.truth()
        lightest = min(lightest, truth.contact_force[:, 2::3].max())
        np.testing.assert_allclose(truth.position[1, 2], truth.position[0, 2], atol=1e-6)
    plant.close()
    assert lightest == 0.0
    assert truth.contact_force[:, 2::3].sum(axis=1) == pytest.approx(WEIGHT, rel=0.01)


# ---- gears whose dry friction creeps before it is full, in both simulators, against closed forms ---------------------


CREEP, FRICTION = 0.02, 0.05


def pulled(backend, share, step=1e-3, seconds=1.0, **changes):
    """Rates (ticks, N) and last friction (N) of the left front wheel of robots with wheels off, pulled by a share of what gears
    hold."""
    count = len(share)
    parameters = Parameters.nominal(ROBOT, count)
    parameters["servo.coulomb_friction"] = np.repeat([50.0, FRICTION], 4)
    parameters["servo.viscous_friction"] = 0.0
    parameters["servo.creep_rate"][:, 4:] = CREEP
    parameters["external_force"][:, 0] = share * 4 * FRICTION / RADIUS
    for name, value in changes.items():
        parameters[name.replace("__", ".")][:, 4:] = value
    options = PlantOptions(control_period=0.02, physics_step=step, sensor_noise=False)
    plant = plants.make_plant(backend, ROBOT, count, options)
    plant.reset(parameters=parameters, state=standing_state(ROBOT, parameters))
    rates = []
    for _ in range(round(seconds / 0.02)):
        plant.step(np.tile(HOME, (count, 1)), wheels_off(count))
        rates.append(plant.truth().joint_velocity[:, 4].copy())
    friction = plant.truth().friction_torque[:, 4].copy()
    plant.close()
    return np.array(rates), friction


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_a_gear_creeps_in_proportion_to_its_load(backend):
    """Below its dry friction F a gear turns at creep_rate x torque/F, and its friction is that torque."""
    share = np.array([0.2, 0.6, 0.95])
    rates, friction = pulled(backend, share)
    np.testing.assert_allclose(rates[-1], share * CREEP, rtol=2e-3)
    np.testing.assert_allclose(friction, -share * FRICTION, rtol=2e-3)


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_beyond_it_the_friction_is_coulombs(backend):
    """Pulled by 1.5 F the robot gains what half of F accelerates: its mass, and four wheels that turn."""
    mass = WEIGHT / G + 4 * WHEEL_INERTIA / RADIUS**2
    for step in (1e-3, 2.5e-4):
        rates = pulled(backend, np.array([1.5]), step, seconds=0.4)[0][:, 0]
        gained = (rates[-1] - rates[9]) / (0.02 * (len(rates) - 10))
        assert gained == pytest.approx(0.5 * 4 * FRICTION / RADIUS**2 / mass, rel=2e-3)


def test_slow_creep_is_sticking():
    for creep in (0.0, 1e-7):
        assert np.abs(pulled("gibbs_appell", np.array([0.5]), servo__creep_rate=creep)[0][20:]).max() < 1e-6


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_a_gear_with_play_creeps_too(backend):
    """The rotor rubs: once its teeth meet, the joint creeps as one without play."""
    share = np.array([0.2, 0.6, 0.95])
    rates, friction = pulled(backend, share, seconds=2.0, servo__backlash=0.01)
    np.testing.assert_allclose(rates[-1], share * CREEP, rtol=5e-3)
    np.testing.assert_allclose(friction, -share * FRICTION, rtol=5e-3)
