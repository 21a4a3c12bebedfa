"""In free flight the engine is the Gibbs-Appell equations: the same accelerations, energy conserved, second order."""

import itertools

import numpy as np
from energy import kinetic_energy, mechanical_energy
from rig import ROBOT, make_plant
from test_contact_free_mujoco import random_parameters

from wlr_gym.physics import servo
from wlr_gym.physics.model import dynamics
from wlr_gym.physics.plants.base import PlantState

COUNT = 200


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
    parameters = random_parameters(COUNT, 2)
    parameters["servo.viscous_friction"] = rng.uniform(0.0, 0.02, (COUNT, 8))
    parameters["external_force"] = rng.normal(size=(COUNT, 2)) * 5.0
    state = random_state(rng, COUNT)
    sign = rng.choice([-1.0, 1.0], (COUNT, 8))
    state.reference_velocity[:, 4:] = 1000.0 * sign[:, 4:]
    setpoints = np.where(np.arange(8) < 4, state.joint_position + 50.0 * sign, 1000.0 * sign)
    state.reference_position[:] = np.where(np.arange(8) < 4, setpoints, state.joint_position)

    table = []
    for level in range(6):
        step = 2e-4 / 2**level
        plant = make_plant(
            COUNT, lambda p: p.values.__setitem__(..., parameters.values), lambda s: assign(s, state), step=step, period=step
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
    force = np.zeros((COUNT, 14))
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
