"""Without contacts, the Gibbs-Appell equations and MuJoCo's recursive algorithms must agree to rounding.

MuJoCo's model is built from the parameters without any code of ``wlr_gym.physics.model``.
"""

import numpy as np
import pytest
from energy import kinetic_energy, potential_energy
from random_robots import States, mujoco, random_parameters, relative_error

from wlr_gym.base.errors import InputError
from wlr_gym.physics.model import dynamics
from wlr_gym.physics.plants.base import standing_state
from wlr_gym.robot import LEGS, WHEELS, load_robot
from wlr_gym.robot.parameters import Parameters

mjcf = pytest.importorskip("wlr_gym.physics.plants.mujoco.mjcf")

COUNT = 1000
ROBOT = load_robot()


class Cases(States):
    """One random robot in one random state per row, and what MuJoCo makes of it."""

    def __init__(self):
        super().__init__(COUNT, 11)
        self.parameters = random_parameters(COUNT, 12)
        self.acceleration, self.energy, self.mass_matrix = (
            np.zeros((COUNT, 14)),
            np.zeros((COUNT, 2)),
            np.zeros((COUNT, 14, 14)),
        )
        for row in range(COUNT):
            model = mjcf.build_model(ROBOT, self.parameters, row, contacts=False)
            model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
            data, self.acceleration[row] = self.forward(row, model)
            self.energy[row] = data.energy
            mujoco.mj_fullM(model, data, full := np.zeros((14, 14)))
            order = [*range(6), *(model.joint(name).dofadr[0] for name in LEGS + WHEELS)]
            to_floor = np.eye(14)
            to_floor[:3, :3] = self.rotation[row]
            self.mass_matrix[row] = to_floor.T @ full[np.ix_(order, order)] @ to_floor


@pytest.fixture(scope="module")
def cases():
    return Cases()


def test_accelerations(cases):
    assert relative_error(cases.accelerations(cases.parameters), cases.acceleration) < 1e-9


def test_mass_matrix(cases):
    """Ours is in absolute rates, MuJoCo's in joint rates: u = T u_joint."""
    leg_rate, wheel_rate = dynamics.absolute_rates(cases.w, cases.rates)
    ours, _ = dynamics.mass_matrix_and_bias(cases.parameters, cases.angles, cases.w, leg_rate, wheel_rate)
    np.testing.assert_array_equal(ours, ours.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(ours).min() > 0
    to_absolute = np.eye(14)
    for leg in range(6, 10):
        to_absolute[leg, 4] = to_absolute[leg + 4, 4] = to_absolute[leg + 4, leg] = 1.0
    assert relative_error(to_absolute.T @ ours @ to_absolute, cases.mass_matrix) < 1e-12


def test_energies(cases):
    kinetic = kinetic_energy(cases.parameters, cases.v, cases.w, cases.angles, cases.rates)
    np.testing.assert_allclose(kinetic, cases.energy[:, 1], rtol=1e-12)
    potential = potential_energy(cases.parameters, cases.position, cases.quaternion, cases.angles)
    np.testing.assert_allclose(potential, cases.energy[:, 0], rtol=1e-10, atol=1e-10)


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
