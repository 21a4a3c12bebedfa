"""Without contacts, the Gibbs-Appell equations and MuJoCo's recursive algorithms must agree to rounding.

MuJoCo's model is built from the parameters without any code of ``wlr_gym.physics.model``.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from energy import kinetic_energy, potential_energy

from wlr_gym.base.errors import InputError
from wlr_gym.physics.model import dynamics
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.robot import LEGS, WHEELS, load_robot
from wlr_gym.robot.parameters import Parameters

mujoco = pytest.importorskip("mujoco")
mjcf = pytest.importorskip("wlr_gym.physics.plants.mujoco.mjcf")

COUNT = 1000
ROBOT = load_robot()


def random_parameters(count, seed):
    """Robots without any symmetry, far from the nominal one; no gear friction, which is no part of the equations."""
    rng = np.random.default_rng(seed)
    parameters = Parameters.nominal(ROBOT, count)
    for name in ("gravity", "body.mass", "hip.position", "leg.length", "leg.mass", "leg.com_along_leg", "wheel.radius",
                 "wheel.mass", "wheel.spin_inertia", "wheel.transverse_inertia", "servo.armature"):  # fmt: skip
        parameters[name] *= rng.uniform(0.4, 2.5, parameters[name].shape)
    parameters["wheel.transverse_inertia"] = parameters["wheel.spin_inertia"] * rng.uniform(0.5, 3.0, (count, 4))
    parameters["hip.position"][:, 2] = rng.uniform(-0.05, 0.05, count)
    parameters["body.com_offset"] = rng.uniform(-0.1, 0.1, (count, 3))
    parameters["body.inertia"] = body_inertia(rng, 0.03, (count,))
    parameters["leg.inertia"] = body_inertia(rng, 1e-4, (count, 4)).reshape(count, 12)
    parameters["payload.mass"] = rng.uniform(0.0, 3.0, count)
    parameters["payload.position"] = rng.uniform(-0.2, 0.2, (count, 3))
    parameters["payload.inertia"] = load_inertia(rng, 0.01, count)
    parameters["ground.slope"] = rng.uniform(-0.6, 0.6, (count, 2))
    parameters["servo.coulomb_friction"] = parameters["servo.viscous_friction"] = 0.0
    parameters.validate()
    return parameters


def body_inertia(rng, scale, shape):
    """Three different principal moments that a rigid body can have: sums of pairs of second moments."""
    second = scale * rng.uniform(0.2, 2.0, (*shape, 3))
    return second.sum(axis=-1, keepdims=True) - second


def load_inertia(rng, scale, count):
    """Inertias (N, 6) of bodies with second moments of mass S about their centre: trace(S) - S, xy = -S_xy."""
    spread = rng.normal(size=(count, 3, 3))
    second = scale * spread @ spread.transpose(0, 2, 1)
    xx, yy, zz = (second[:, k, k] for k in range(3))
    return np.stack([yy + zz, xx + zz, xx + yy, -second[:, 0, 1], -second[:, 0, 2], -second[:, 1, 2]], axis=1)


@dataclass
class Cases:
    """One random robot in one random state per row, and what MuJoCo makes of it."""

    parameters: Parameters
    position: np.ndarray
    quaternion: np.ndarray
    v: np.ndarray
    w: np.ndarray
    joint_position: np.ndarray
    joint_velocity: np.ndarray
    force: np.ndarray
    acceleration: np.ndarray
    kinetic: np.ndarray
    potential: np.ndarray
    mass_matrix: np.ndarray


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(11)
    quaternion = rng.normal(size=(COUNT, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    joint_scale = np.repeat([3.0, 30.0], 4)
    drawn = Cases(
        parameters=random_parameters(COUNT, 12),
        position=rng.normal(size=(COUNT, 3)),
        quaternion=quaternion,
        v=2.0 * rng.normal(size=(COUNT, 3)),
        w=3.0 * rng.normal(size=(COUNT, 3)),
        joint_position=rng.uniform(-np.pi, np.pi, (COUNT, 8)),
        joint_velocity=joint_scale * rng.normal(size=(COUNT, 8)),
        force=rng.normal(size=(COUNT, 14)) * np.repeat([5.0, 1.0], [6, 8]),
        acceleration=np.zeros((COUNT, 14)),
        kinetic=np.zeros(COUNT),
        potential=np.zeros(COUNT),
        mass_matrix=np.zeros((COUNT, 14, 14)),
    )
    rotation = dynamics.rotation_matrix(quaternion)
    for index in range(COUNT):
        ask_mujoco(drawn, index, rotation[index])
    return drawn


def ask_mujoco(cases, index, rotation):
    """Fill in MuJoCo's answers for one row, in the coordinates of :func:`dynamics.accelerations`."""
    model = mjcf.build_model(ROBOT, cases.parameters, index, contacts=False)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in LEGS + WHEELS]
    angles, rates = [joint.qposadr[0] for joint in joints], [joint.dofadr[0] for joint in joints]
    v, w, force = cases.v[index], cases.w[index], cases.force[index]
    data.qpos[:3], data.qpos[3:7], data.qpos[angles] = (
        cases.position[index],
        cases.quaternion[index],
        cases.joint_position[index],
    )
    data.qvel[:3], data.qvel[3:6], data.qvel[rates] = rotation @ v, w, cases.joint_velocity[index]
    data.qfrc_applied[:3], data.qfrc_applied[3:6], data.qfrc_applied[rates] = rotation @ force[:3], force[3:6], force[6:]
    mujoco.mj_forward(model, data)
    cases.acceleration[index] = [*(rotation.T @ data.qacc[:3] - np.cross(w, v)), *data.qacc[3:6], *data.qacc[rates]]
    cases.potential[index], cases.kinetic[index] = data.energy
    full = np.zeros((14, 14))
    mujoco.mj_fullM(model, data, full)
    order = [*range(6), *rates]
    to_floor = np.eye(14)
    to_floor[:3, :3] = rotation
    cases.mass_matrix[index] = to_floor.T @ full[np.ix_(order, order)] @ to_floor


def relative_error(ours, theirs):
    """Largest difference per row over the row's largest magnitude."""
    axes = tuple(range(1, theirs.ndim))
    return np.abs(ours - theirs).max(axis=axes) / np.abs(theirs).max(axis=axes)


def test_accelerations(cases):
    ours = dynamics.accelerations(
        cases.parameters, cases.quaternion, cases.v, cases.w, cases.joint_position, cases.joint_velocity, cases.force
    )
    assert relative_error(ours, cases.acceleration).max() < 1e-9


def test_mass_matrix(cases):
    """Ours is in absolute rates, MuJoCo's in joint rates: u = T u_joint."""
    leg_rate, wheel_rate = dynamics.absolute_rates(cases.w, cases.joint_velocity)
    ours, _ = dynamics.mass_matrix_and_bias(cases.parameters, cases.joint_position, cases.w, leg_rate, wheel_rate)
    np.testing.assert_array_equal(ours, ours.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(ours).min() > 0
    to_absolute = np.eye(14)
    for leg in range(6, 10):
        to_absolute[leg, 4] = to_absolute[leg + 4, 4] = to_absolute[leg + 4, leg] = 1.0
    assert relative_error(to_absolute.T @ ours @ to_absolute, cases.mass_matrix).max() < 1e-12


def test_kinetic_energy(cases):
    ours = kinetic_energy(cases.parameters, cases.v, cases.w, cases.joint_position, cases.joint_velocity)
    np.testing.assert_allclose(ours, cases.kinetic, rtol=1e-12)


def test_potential_energy(cases):
    ours = potential_energy(cases.parameters, cases.position, cases.quaternion, cases.joint_position)
    np.testing.assert_allclose(ours, cases.potential, rtol=1e-10, atol=1e-10)


def test_robot_stands_on_its_contact_springs_with_its_whole_weight():
    """The MuJoCo model with contacts: standing_state is at rest, and the four springs carry the weight."""
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["ground.mu_y"][1] = 0.3  # capsules instead of spheres
    for index in range(2):
        model, data = standing(parameters, index)
        start = data.qpos.copy()
        run(model, data, 200)
        np.testing.assert_allclose(data.qpos, start, atol=2e-6)
        normal = sum(contact_force(model, data, contact)[0] for contact in range(data.ncon))
        assert normal == pytest.approx(ROBOT.total_mass * ROBOT.gravity, rel=1e-4)


@pytest.mark.parametrize("yaw", [0.0, 1.0])
@pytest.mark.parametrize("mu_y", [0.6, 0.3])
def test_locked_robot_slides_with_the_friction_of_the_wheels_own_axes(yaw, mu_y):
    """Deceleration mu_x g along the heading and mu_y g along the axles, whatever the heading; the robot does not bounce."""
    parameters = Parameters.nominal(ROBOT)
    parameters["ground.mu_y"] = mu_y
    parameters["servo.coulomb_friction"] = 50.0  # locked
    for direction, expected in ((0.0, 0.6), (np.pi / 2, mu_y)):
        model, data = standing(parameters, 0)
        course = np.array([np.cos(yaw + direction), np.sin(yaw + direction)])
        data.qpos[3:7] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        data.qvel[:2] = course
        run(model, data, 50)  # until pitch has settled
        before = course @ data.qvel[:2]
        run(model, data, 50)
        assert (before - course @ data.qvel[:2]) / 0.05 == pytest.approx(expected * ROBOT.gravity, rel=0.02)
        normal = sum(contact_force(model, data, contact)[0] for contact in range(data.ncon))
        assert normal == pytest.approx(ROBOT.total_mass * ROBOT.gravity, rel=0.02)


def test_rolling_resistance_brakes_a_free_rolling_robot():
    """c m g = (m + 4 (spin inertia + rotor) / radius^2) a."""
    parameters = Parameters.nominal(ROBOT)
    parameters["ground.rolling_resistance"] = resistance = 0.02
    parameters["servo.coulomb_friction"][:, 4:] = 0.0
    parameters["servo.coulomb_friction"][:, :4] = 50.0
    model, data = standing(parameters, 0)
    data.qvel[0] = 0.5
    for name in WHEELS:
        data.joint(name).qvel[0] = 0.5 / ROBOT.wheel.radius
    run(model, data, 100)
    before = data.qvel[0]
    run(model, data, 200)
    inertia = ROBOT.total_mass + 4 * (ROBOT.wheel.spin_inertia + ROBOT.servo.wheel.armature) / ROBOT.wheel.radius**2
    expected = resistance * ROBOT.total_mass * ROBOT.gravity / inertia
    assert (before - data.qvel[0]) / 0.2 == pytest.approx(expected, rel=0.02)


def test_spheres_are_refused_where_friction_has_a_direction():
    parameters = Parameters.nominal(ROBOT)
    parameters["ground.mu_y"] = 0.3
    with pytest.raises(InputError, match="capsule"):
        mjcf.build_model(ROBOT, parameters, wheel_shape="sphere")


def test_index_outside_the_batch_is_refused():
    with pytest.raises(InputError, match="index = 3"):
        mjcf.build_model(ROBOT, Parameters.nominal(ROBOT, 3), 3)


def standing(parameters, index):
    """Model and data of one robot in ``standing_state``."""
    state = standing_state(ROBOT, parameters)
    model = mjcf.build_model(ROBOT, parameters, index)
    data = mujoco.MjData(model)
    data.qpos[:3] = state.position[index]
    return model, data


def run(model, data, steps):
    """Step with the legs held in their home pose."""
    legs = [data.joint(name) for name in LEGS]
    for _ in range(steps):
        for leg in legs:
            leg.qfrc_applied[0] = -1000.0 * (leg.qpos[0] - ROBOT.home.leg_angle) - 4.0 * leg.qvel[0]
        mujoco.mj_step(model, data)


def contact_force(model, data, contact):
    force = np.zeros(6)
    mujoco.mj_contactForce(model, data, contact, force)
    return force
