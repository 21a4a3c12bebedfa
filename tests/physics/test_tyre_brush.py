"""The elastic tread against what a brush with relaxation must do: slip curve, relaxation length, parking, the rigid limit."""

import numpy as np
import pytest
from rig import BACKENDS, HOME, RADIUS, WEIGHT, channel, drive, lock, make_plant, record

from wlr_gym.physics.plants.gibbs_appell.kinematics import STORED
from wlr_gym.physics.plants.mujoco.step import STATE
from wlr_gym.robot import load_robot

SPEED = 0.05  # m/s
STEP = 2.5e-4  # s
COMPLIANCE = np.array([0.02, 0.05, 0.1, 0.2])
ROLLING = np.concatenate([HOME[:4], np.full(4, SPEED / RADIUS)])
TREAD = {"ground.slip_compliance": COMPLIANCE[:, None], "ground.tread_damping": 0.0}
EACH = pytest.mark.parametrize("backend", BACKENDS)


@EACH
def test_steady_slip_is_in_proportion_to_traction(backend):
    plant = make_plant(4, [TREAD, {"external_force[x]": -6.0}], backend=backend)
    truth = drive(plant, 4.0, ROLLING)
    force = truth.contact_force.reshape(4, 4, 3)
    slip = truth.slip_velocity.reshape(4, 4, 2)[:, :, 0] / (RADIUS * truth.joint_velocity[:, 4:])
    np.testing.assert_allclose(slip, -COMPLIANCE[:, None] * force[:, :, 0] / force[:, :, 2], rtol=0.01)


@EACH
def test_friction_builds_up_over_the_relaxation_length(backend):
    """A heavy body, light on its wheels, begins to go askew: lateral friction against u' = s - V/sigma u, F = -c u."""
    length = np.array([0.003, 0.005, 0.01, 0.02])

    def edit(parameters):
        lock(parameters)
        parameters["servo.coulomb_friction"][:, 4:] = 0.0
        parameters["body.mass"], parameters["body.inertia"] = 100.0, 10.0
        parameters["gravity"] = 3.0 * 9.81 / 100.2
        parameters["ground.slip_compliance"], parameters["ground.tread_damping"] = 0.5, 0.0
        parameters["ground.relaxation_length"] = length[:, None]

    def place(state):
        state.linear_velocity_in_body[:, 0], state.linear_velocity_in_body[:, 1] = SPEED, 0.1 * SPEED
        state.joint_velocity[:, 4:] = SPEED / RADIUS

    plant = make_plant(4, edit, place, backend=backend, step=STEP, period=STEP)
    history = record(plant, 0.6, ROLLING, np.tile(np.arange(8) < 4, (4, 1)))
    force = channel(history, "contact_force").reshape(-1, 4, 4, 3)[:, :, 0]
    slip = channel(history, "slip_velocity").reshape(-1, 4, 4, 2)[:, :, 0, 1]
    load = force[..., 2]
    grown = np.sqrt(load / (3.0 * 9.81 / 4.0)) * length
    shear, expected = np.zeros(4), np.zeros(load.shape)
    for tick in range(len(history)):
        kept = np.exp(-STEP * SPEED / grown[tick])
        shear = kept * shear + slip[tick] * grown[tick] / SPEED * (1.0 - kept)
        expected[tick] = -load[tick] / (0.5 * grown[tick]) * shear
    assert np.abs(force[..., 1] - expected).max() < 0.02 * np.abs(expected).max()
    assert np.abs(expected).max(axis=0).min() > 0.4  # N: there was something to see


@EACH
def test_a_parked_robot_stays(backend):
    plant = make_plant(4, [TREAD, {"ground.tread_damping": 5.0, "ground.slope[pitch]": np.radians(20.0)}], backend=backend)
    history = channel(record(plant, 10.0, HOME), "position")
    drift = np.abs(history[-1, :, :2] - history[-101, :, :2]).max() / 2.0
    # MuJoCo's gears give way a little under load; its own friction lets the robot slide ten times as fast.
    assert drift < {"gibbs_appell": 1e-9, "mujoco": 1e-6}[backend]


def shears(plant, backend) -> np.ndarray:
    """Shear (4, 2) of the treads of the only robot, along heading and axle, m."""
    store, names = {"gibbs_appell": ("lanes", STORED), "mujoco": ("servos", STATE)}[backend]
    values = plant.get_state().arrays[store][0]
    return np.array([[values[names.index(f"shear_{axis}{wheel}")] for axis in "xy"] for wheel in range(4)])


@EACH
def test_a_wheel_in_the_air_forgets_its_shear(backend):
    """Parked on a slope with little gravity, a robot draws its legs in faster than it falls."""
    weak = {"gravity": 1.0, "ground.slope[pitch]": 0.3, "ground.slip_compliance": 0.2}
    plant = make_plant(1, weak, backend=backend)
    drive(plant, 0.5)
    assert np.abs(shears(plant, backend)[:, 0]).min() > 1e-4
    folded, flew = HOME + np.array([-1.2, -1.2, 1.2, 1.2, 0, 0, 0, 0]), 0
    for _ in range(20):
        load = drive(plant, 0.02, folded).contact_force.reshape(4, 3)[:, 2]
        assert not shears(plant, backend)[load == 0.0].any()
        flew += (load == 0.0).sum()
    assert flew > 8
    drive(plant, 3.0, folded)
    assert np.abs(shears(plant, backend)[:, 0]).min() > 1e-4


@EACH
def test_the_state_of_a_plant_has_the_shear(backend):
    """Put where it is, a parked robot pushes as hard on the floor as before; without its shear it would begin to slide."""
    plant = make_plant(1, {"ground.slip_compliance": 0.2, "ground.slope[pitch]": 0.3}, backend=backend, period=0.001)
    parked = drive(plant, 1.0).contact_force.reshape(4, 3)[:, 0]
    plant.reset(state=plant.mechanical_state())
    np.testing.assert_allclose(drive(plant, 0.001).contact_force.reshape(4, 3)[:, 0], parked, rtol=0.1)


def test_a_robot_file_states_its_tyre():
    robot = load_robot({"base": "nominal", "name": "soft", "ground": {"slip_compliance": 0.1, "relaxation_length": 0.008}})
    same = {"ground.slip_compliance": 0.1, "ground.relaxation_length": 0.008}
    np.testing.assert_array_equal(swerve(make_plant(1, robot=robot)), swerve(make_plant(1, same)))


def swerve(plant, ticks=100) -> np.ndarray:
    for tick in range(ticks):
        wheels = 4.0 * np.sin(0.07 * tick) * np.array([1.0, 0.5, 1.0, 0.5])
        setpoints = np.concatenate([HOME[:4] + 0.1 * np.sin(0.1 * tick), wheels])
        plant.step(np.tile(setpoints, (plant.count, 1)))
    return plant.truth().values.copy()


def test_a_stiff_tread_is_a_rigid_one():
    compliance = 0.25 * WEIGHT / (0.005 * 1e8)  # of bristles with 1e8 N/m
    truth = swerve(make_plant(2, {"ground.slip_compliance": np.array([[compliance], [0.0]])}), 50)
    assert np.abs(truth[0, :3] - truth[1, :3]).max() < 1e-6


def test_a_rigid_tread_beside_an_elastic_one_keeps_its_bits():
    beside = swerve(make_plant(2, {"ground.slip_compliance": np.array([[0.1], [0.0]])}))
    np.testing.assert_array_equal(beside[1], swerve(make_plant(1))[0])


def test_both_simulators_on_a_kerb():
    floor = {"ground.slip_compliance": 0.05, "piece.height[piece_1]": 0.012, "piece.x[piece_1]": 0.3}
    first, second = (drive(make_plant(1, floor, backend=backend), 4.0, ROLLING).position for backend in BACKENDS)
    np.testing.assert_allclose(first, second, atol=2e-4)
