"""The conformance suite: what every plant promises (``plants.base.Plant``), on every plant in ``simulators.PLANTS``.

Tests that take ``plant_name`` need sensors only and hold for a real robot too; those that take ``simulator`` look at the truth
or put robots into states.
"""

import re
from typing import Any

import numpy as np
import pytest
from simulators import (
    COUNT,
    PLANTS,
    QUIET,
    ROBOT,
    SIMULATORS,
    hold,
    home,
    make,
    parameters_for,
    random_parameters,
    random_setpoints,
    rollout,
    run,
    setpoints_for,
)

from wlr_gym.base.errors import InputError
from wlr_gym.physics.model import dynamics
from wlr_gym.physics.plants import BACKENDS, make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT, PlantOptions, standing_state
from wlr_gym.physics.plants.forces import WIND_UP, make_force
from wlr_gym.physics.plants.gibbs_appell.plant import TILES_AT_A_TIME
from wlr_gym.physics.plants.simulator import Simulator
from wlr_gym.robot import slip
from wlr_gym.robot.parameters import Parameters

#: One parameter of every family of effects.
EFFECTS = {
    "ground.rolling_resistance": 0.02,
    "ground.creep_speed": 0.02,
    "servo.creep_rate": 0.02,
    "ground.flattening": 0.4,
    "ground.kinetic_ratio": 0.6,
    "servo.backlash": 0.02,
    "servo.supply_resistance": 0.3,
    "servo.ripple_amplitude": 0.1,
    "tether.stiffness": 2.0,
}


@pytest.fixture(params=PLANTS)
def plant_name(request):
    return request.param


@pytest.fixture(params=SIMULATORS)
def simulator(request):
    return request.param


# ---- what any plant does -----------------------------------------------------------------------------------------------


def test_capabilities_are_those_of_its_entry(plant_name):
    plant, entry = PLANTS[plant_name].make(1, QUIET), PLANTS[plant_name]
    assert plant.capabilities.name == plant_name
    assert plant.capabilities.has_truth == entry.has_truth
    assert plant.capabilities.can_set_state == entry.can_set_state
    assert plant.count == 1
    plant.close()


def test_standing_robots_read_what_they_should(plant_name):
    count = PLANTS[plant_name].most or 2
    plant = PLANTS[plant_name].make(count, PlantOptions())
    assert plant.reset().values.shape == (count, SENSOR_LAYOUT.width)
    sensors = hold(plant, home(count), ticks=50)
    assert np.isfinite(sensors.values).all()
    np.testing.assert_allclose(sensors.joint_position[:, :4], np.pi / 2, atol=0.01)
    np.testing.assert_allclose(sensors.joint_velocity, 0.0, atol=0.05)
    np.testing.assert_allclose(sensors.accelerometer, np.tile([0, 0, 9.81], (count, 1)), atol=0.3)
    np.testing.assert_allclose(sensors.gyro, 0.0, atol=0.02)
    np.testing.assert_allclose(sensors.supply_voltage, 12.0, atol=0.3)
    np.testing.assert_allclose(sensors.camera_pose, 0.0, atol=0.02)
    plant.close()


def test_wheels_and_legs_follow_their_setpoints(plant_name):
    plant = PLANTS[plant_name].make(1, QUIET)
    setpoints = np.array([[1.3, 1.3, 1.3, 1.3, 2.0, 2.0, 2.0, 2.0]])
    sensors = hold(plant, setpoints, ticks=100)
    np.testing.assert_allclose(sensors.joint_position[:, :4], 1.3, atol=0.05)
    np.testing.assert_allclose(sensors.joint_velocity[:, 4:], 2.0, atol=0.1)
    plant.close()


def test_a_motor_that_is_off_gives_no_effort(plant_name):
    plant = PLANTS[plant_name].make(1, QUIET)
    torque_on = np.ones((1, 8), bool)
    torque_on[0, 4:] = False
    setpoints = home(1)
    setpoints[0, 4:] = np.nan
    sensors = hold(plant, setpoints, 10, torque_on)
    np.testing.assert_array_equal(sensors.joint_effort[:, 4:], 0.0)
    plant.close()


# ---- columns -----------------------------------------------------------------------------------------------------------


def test_truth_agrees_with_independent_values(simulator):
    """Slip, clearance and effective friction computed from the state without the engine's code."""
    plant = make(simulator)
    run(plant, 0, 25)
    truth, state = plant.truth(), plant.mechanical_state()
    expected = slip.contact_slip_velocity(
        plant.parameters,
        state.quaternion,
        state.linear_velocity_in_body,
        state.angular_velocity_in_body,
        state.joint_position,
        state.joint_velocity,
    )
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(truth.slip_velocity.reshape(COUNT, 4, 2), expected, atol=1e-10)
    for name in ("position", "quaternion", "linear_velocity_in_body", "angular_velocity_in_body"):
        np.testing.assert_array_equal(truth[name], getattr(state, name))
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(8, 3) * ROBOT.body.size
    heights = np.einsum("nij,cj->nci", dynamics.rotation_matrix(state.quaternion), corners)[..., 2]
    np.testing.assert_allclose(truth.body_clearance, state.position[:, 2] + heights.min(axis=1), atol=1e-12)
    friction = truth.effective_friction.reshape(COUNT, 4, 2)
    np.testing.assert_array_equal(friction[..., 0], plant.parameters["ground.mu_x"])
    np.testing.assert_array_equal(friction[..., 1], plant.parameters["ground.mu_y"])


def test_slip_displacement_is_the_slip_velocity_integrated_over_the_tick(simulator):
    fine, coarse = make(simulator, options=PlantOptions(control_period=1e-3)), make(simulator)
    total, travelled = np.zeros((COUNT, 8)), np.zeros((COUNT, 8))
    for tick in range(10):
        for _ in range(20):
            fine.step(setpoints_for(tick))
            total += 1e-3 * fine.truth().slip_velocity
        coarse.step(setpoints_for(tick))
        travelled += coarse.truth().slip_displacement
    assert np.abs(travelled).max() > 1e-3
    np.testing.assert_allclose(travelled, total, atol=1e-4)


def test_sensors_show_the_truth_where_nothing_disturbs_them(simulator):
    plant = make(simulator)
    run(plant, 0, 10)
    sensors, truth = plant.step(setpoints_for(10)), plant.truth()
    np.testing.assert_array_equal(sensors.joint_position, truth.joint_position)
    np.testing.assert_array_equal(sensors.joint_velocity, truth.joint_velocity)
    np.testing.assert_array_equal(sensors.joint_effort, truth.motor_torque)
    np.testing.assert_array_equal(sensors.supply_voltage, 12.0)


def test_accelerometer_shows_gravity_at_rest_and_nothing_in_free_fall(simulator):
    plant = make(simulator, 2)
    state = plant.mechanical_state()
    state.position[1, 2] = 50.0
    plant.reset(state=state)
    home = np.tile(np.concatenate([np.full(4, np.pi / 2), np.zeros(4)]), (2, 1))
    for _ in range(49):
        plant.step(home)
    sensors = plant.step(home)
    np.testing.assert_allclose(sensors.accelerometer, [[0, 0, 9.81], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(sensors.gyro, 0.0, atol=1e-9)


# ---- state -------------------------------------------------------------------------------------------------------------


def test_gyroscope_lags_by_its_whole_time_constant(simulator):
    """Against the exact response of a first-order low-pass to the true rate, straight between physics steps."""
    step = 0.001
    plant = make(simulator, 1, options=PlantOptions(control_period=step, physics_step=step, sensor_noise=False))
    turn = np.array([[1.2, 1.9, 1.7, 1.3, -3.0, 3.0, -3.0, 3.0]])
    filtered = plant.truth().angular_velocity_in_body[0].copy()
    rates, errors = [filtered], [np.zeros(3)]
    time_constant = 1.0 / (2.0 * np.pi * ROBOT.sensors.imu.bandwidth)
    fade = np.exp(-step / time_constant)
    for _ in range(600):
        sensors = plant.step(turn)
        rates.append(plant.truth().angular_velocity_in_body[0].copy())
        slope = (rates[-1] - rates[-2]) / step
        behind = time_constant * slope
        filtered = rates[-1] - behind + (filtered - rates[-2] + behind) * fade
        errors.append(sensors.gyro[0] - filtered)
    plant.close()
    change = np.gradient(np.array(rates), step, axis=0)
    lead = np.sum(np.array(errors) * change, axis=0) / np.sum(change**2, axis=0)
    assert (np.abs(change).max(axis=0) > 1.0).all()
    assert (np.abs(lead) < 4e-5).all(), lead  # s; a trapezoid per step is itself step^2/(12 time constants) = 23 us off


@pytest.mark.slow
def test_constants_of_formulas_are_per_robot(simulator):
    force = make_force(("floor_force_x",), "push", {"push": 0.0}, {"push": "N"})
    plant = make_plant(simulator, ROBOT, 3, QUIET, (force,))
    assert isinstance(plant, Simulator)
    plant.set_force_values(np.array([[0.0], [8.0], [-8.0]]))
    wheels_off = np.ones((3, 8), bool)
    wheels_off[:, 4:] = False
    hold(plant, home(3), 30, wheels_off)
    x = plant.truth().position[:, 0].copy()
    plant.close()
    assert abs(x[0]) < 1e-3
    assert x[1] > 0.05
    assert x[2] < -0.05


def test_expecting_all_effects_does_not_change_a_bit(simulator):
    results = []
    for expect in (False, True):
        plant: Any = make(simulator)
        if expect:
            plant.expect_all_effects()
        results.append(run(plant, 0, 20))
        plant.close()
    np.testing.assert_array_equal(*results)


def test_state_survives_a_round_trip(simulator):
    plant = make(simulator, edit=lambda p: p["joint.zero_offset"].__setitem__(..., (0.02, -0.01, 0.0, 0.03)))
    run(plant, 0, 10)
    state = plant.mechanical_state()
    other = make(simulator, edit=lambda p: p.values.__setitem__(..., plant.parameters.values))
    other.reset(state=state)
    for name, value in vars(other.mechanical_state()).items():
        np.testing.assert_allclose(value, getattr(state, name), atol=1e-14, err_msg=name)
    # what is not state, the extrapolated rates and the warm start, is forgotten: the motion goes on almost alike
    np.testing.assert_allclose(run(other, 10, 15)[:, :3], run(plant, 10, 15)[:, :3], atol=1e-4)


def test_returned_state_is_a_copy(simulator):
    plant = make(simulator)
    run(plant, 0, 3)
    before = run(make(simulator), 0, 5)
    for value in vars(plant.mechanical_state()).values():
        value[:] = 0.0
    np.testing.assert_array_equal(run(plant, 3, 5), before)


def test_reset_with_a_mask_leaves_the_others_alone(simulator):
    mask = np.zeros(COUNT, bool)
    mask[[1, 8]] = True
    undisturbed, plant = make(simulator), make(simulator)
    run(plant, 0, 10)
    run(undisturbed, 0, 10)
    replaced = plant.parameters.copy()
    replaced["ground.mu_x"] = 0.123
    plant.reset(seeds=np.arange(50, 50 + COUNT, dtype=np.uint64), parameters=replaced, mask=mask)
    np.testing.assert_array_equal(plant.parameters["ground.mu_x"][mask], 0.123)
    np.testing.assert_array_equal(plant.parameters.values[~mask], undisturbed.parameters.values[~mask])
    standing = standing_state(ROBOT, plant.parameters)
    np.testing.assert_array_equal(plant.mechanical_state().position[mask], standing.position[mask])
    ours, theirs = run(plant, 10, 20), run(undisturbed, 10, 20)
    np.testing.assert_array_equal(ours[~mask], theirs[~mask])
    assert (ours[mask] != theirs[mask]).any(axis=1).all()


def test_reset_starts_anew(simulator):
    plant = make(simulator)
    first = run(plant, 0, 10)
    plant.reset(seeds=np.arange(COUNT, dtype=np.uint64))
    np.testing.assert_array_equal(run(plant, 0, 10), first)


def test_parameters_can_change_in_mid_run(simulator):
    """Friction drops under a robot that is being pushed: it starts to slide, its state is not touched by the change."""

    def push(parameters):
        parameters["servo.coulomb_friction"] = 50.0
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.6
        parameters["external_force"][:, 0] = 6.0

    plant = make(simulator, 3, push)
    home = np.tile(np.concatenate([np.full(4, np.pi / 2), np.zeros(4)]), (3, 1))
    for _ in range(50):
        plant.step(home)
    before = plant.mechanical_state()
    slippery = plant.parameters.copy()
    slippery["ground.mu_x"] = slippery["ground.mu_y"] = 0.1
    plant.set_parameters(slippery, np.array([True, False, True]))
    np.testing.assert_array_equal(plant.mechanical_state().position, before.position)
    for _ in range(25):
        plant.step(home)
    gained = plant.truth().linear_velocity_in_body[:, 0]
    expected = (6.0 / ROBOT.total_mass - 0.1 * 9.81) * 0.5
    np.testing.assert_allclose(gained[[0, 2]], expected, rtol=5e-3)
    assert abs(gained[1]) < 1e-5


def test_delay_and_sensor_errors_change_in_mid_run_too(simulator):
    """A robot whose delay is switched on goes on with the setpoints it was given before; readings take the new zero at once."""

    def change(plant, mask):
        changed = plant.parameters.copy()
        changed["command.delay"], changed["joint.zero_offset"] = 0.06, 0.1
        plant.set_parameters(changed, mask)

    plant = make(simulator, 2)
    setpoints = np.tile(np.concatenate([np.full(4, 1.3), np.zeros(4)]), (2, 1))
    for _ in range(100):
        plant.step(setpoints)
    change(plant, np.array([True, False]))
    sensors = plant.step(setpoints)
    reading = sensors.joint_position[:, :4] - plant.truth().joint_position[:, :4]
    np.testing.assert_allclose(reading, [[0.1] * 4, [0.0] * 4], atol=1e-12)
    for _ in range(100):
        plant.step(setpoints)
    np.testing.assert_allclose(plant.truth().joint_position[0, :4], 1.2, atol=0.02)
    setpoints[:, :4] = 1.8
    for tick in range(4):
        plant.step(setpoints)
        moving = np.abs(plant.truth().joint_velocity[:, :4]).max(axis=1) > 0.1
        assert moving[0] == (tick == 3)
        assert moving[1] or tick > 0


def test_callers_parameters_are_not_kept_by_reference(simulator):
    parameters = Parameters.nominal(ROBOT, 2)
    plant = PLANTS[simulator].make(2, QUIET)
    plant.reset(parameters=parameters)
    parameters["ground.mu_x"] = 0.0
    np.testing.assert_array_equal(plant.parameters["ground.mu_x"], 0.6)


# ---- refusals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(8,), (2, 8), (3, 7), (3, 8, 1)])
def test_goals_of_a_wrong_shape_are_refused(simulator, shape):
    with pytest.raises(InputError, match=r"setpoints have shape .*expected \(3, 8\)"):
        make(simulator, 3).step(np.zeros(shape))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_goals_that_are_no_numbers_never_reach_the_physics(simulator, bad):
    plant = make(simulator, 3)
    setpoints = setpoints_for(0, 3)
    setpoints[2, 5] = bad
    before = plant.truth().values.copy()
    with pytest.raises(InputError, match=r"wheel_rf \(robot 2 of the batch\)"):
        plant.step(setpoints)
    np.testing.assert_array_equal(plant.truth().values, before)
    torque_on = np.ones((3, 8), bool)
    torque_on[2, 5] = False
    plant.step(setpoints, torque_on)
    assert np.isfinite(plant.truth().values).all()


def test_contact_too_stiff_for_the_step_is_refused_with_a_way_out(simulator):
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["ground.normal_stiffness"][1] = 2e5
    plant = PLANTS[simulator].make(2, PlantOptions(physics_step=4e-3))
    with pytest.raises(InputError, match=r"normal_stiffness 200000 N/m .*shorten physics_step below"):
        plant.reset(parameters=parameters)


def test_parameters_out_of_bounds_are_refused_by_name(simulator):
    parameters = Parameters.nominal(ROBOT, 3)
    parameters["wheel.radius"][2, 1] = -0.1
    with pytest.raises(InputError, match=r"wheel.radius\[wheel_rf\] = -0.1 \(robot 2"):
        make(simulator, 3).reset(parameters=parameters)


def test_parameters_for_another_number_of_robots_are_refused(simulator):
    with pytest.raises(InputError, match="parameters hold 2 robots, the plant 3"):
        make(simulator, 3).reset(parameters=Parameters.nominal(ROBOT, 2))


def test_goals_of_a_motor_that_is_off_never_act_later(simulator):
    def delayed(parameters):
        parameters["command.delay"] = 0.03

    plant = make(simulator, 2, delayed)
    setpoints = np.tile(np.r_[[np.pi / 2] * 4, [0.0] * 4], (2, 1))
    off = np.ones((2, 8), bool)
    off[:, :4] = False
    for _ in range(10):
        plant.step(setpoints)
    for _ in range(5):
        plant.step(np.where(off, setpoints, np.nan), off)
    lowest = before = plant.truth().joint_position[:, :4].copy()
    for _ in range(10):
        plant.step(setpoints)
        lowest = np.minimum(lowest, plant.truth().joint_position[:, :4])
    assert (lowest > before - 0.02).all()


def test_accelerometer_starts_with_the_specific_force_of_standing_still(simulator):
    def inclined(parameters):
        parameters["ground.slope[pitch]"] = 0.3
        parameters["ground.slope[roll]"] = -0.1
        parameters["imu.accel_bias"] = 0.0

    plant = make(simulator, 1, inclined)
    up = np.array([np.sin(0.3), np.sin(-0.1), np.sqrt(1 - np.sin(0.3) ** 2 - np.sin(0.1) ** 2)])
    assert plant.reset().accelerometer[0] == pytest.approx(9.81 * up, abs=1e-9)


def test_bad_resets_are_refused(simulator):
    plant = make(simulator, 2)
    for mask in (np.ones(3, bool), np.array([0, 1])):  # numbers of robots are no mask
        with pytest.raises(InputError, match=r"mask has shape .* expected \(2,\) booleans"):
            plant.reset(mask=mask)
    for count in (1, 3):
        with pytest.raises(InputError, match=f"state holds {count} robots, the plant 2"):
            plant.reset(state=make(simulator, count).mechanical_state())
    state = plant.mechanical_state()
    state.position[0, 0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        plant.reset(state=state)


@pytest.mark.parametrize("seeds", [[1], [1, 2, 3], [-1, 2], np.array([-1, 2]), [1.5, 2.5], ["a", "b"], 7, [[1, 2]]], ids=str)
def test_seeds_that_are_none_are_refused(simulator, seeds):
    plant = make(simulator, 2)
    with pytest.raises(InputError, match="expected whole numbers from 0 on, one for each robot, here 2"):
        plant.reset(seeds=seeds)
    plant.reset(seeds=np.array([2**63 + 1, 1], np.uint64))


def test_a_plant_is_made_of_a_robot_by_name_and_by_content():
    for robot in ("nominal", {"base": "nominal", "name": "x"}):
        assert make_plant("gibbs_appell", robot, 1).robot.body == ROBOT.body
    with pytest.raises(InputError, match="did you mean 'nominal'"):
        make_plant("gibbs_appell", "nominl", 1)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("nomodule:Cls", "BACKENDS['x'] = 'nomodule:Cls': no module 'nomodule'; expected 'module:class'"),
        ("json.nomodule:Cls", "no module 'json.nomodule'"),
        ("fractions:Fractoin", "did you mean 'Fraction'"),
    ],
)
def test_a_backend_that_leads_nowhere_is_refused(monkeypatch, entry, words):
    monkeypatch.setitem(BACKENDS, "x", entry)
    with pytest.raises(InputError, match=re.escape(words)):
        make_plant("x", ROBOT, 1)


@pytest.mark.parametrize("count", [0, -1, 1.5])
def test_count_must_be_a_positive_whole_number(simulator, count):
    with pytest.raises(InputError, match="number of robots"):
        PLANTS[simulator].make(count, QUIET)


# ---- the same bits -----------------------------------------------------------------------------------------------------


#: Simulator, precision, and robots that fill several tiles of the engine's, the last one partly.
BITS = pytest.mark.parametrize(
    ("name", "precision", "count"),
    [("gibbs_appell", "float64", 37), ("gibbs_appell", "float32", 37), ("mujoco", "float64", 13)],
)


@BITS
def test_alone_or_in_a_batch(name, precision, count):
    parameters, setpoints, seeds = random_parameters(count), random_setpoints(count, 20), np.arange(count, dtype=np.uint64)
    truth, sensors = rollout(name, parameters, setpoints, seeds, precision)
    assert np.abs(truth[-1, :, :2]).max() > 1e-3
    for row in (row for row in (0, 5, 12, 15, 16, 31, 36) if row < count):
        one = [row]
        alone = rollout(name, Parameters(parameters.values[one]), setpoints[:, one], seeds[one], precision)
        np.testing.assert_array_equal(alone[0][:, 0], truth[:, row])
        np.testing.assert_array_equal(alone[1][:, 0], sensors[:, row])
    shuffled = np.random.default_rng(0).permutation(count)
    again = rollout(name, Parameters(parameters.values[shuffled]), setpoints[:, shuffled], seeds[shuffled], precision)
    np.testing.assert_array_equal(again[0], truth[:, shuffled])
    np.testing.assert_array_equal(again[1], sensors[:, shuffled])


@BITS
def test_on_two_threads_and_again(name, precision, count):
    count = 64 if name == "mujoco" else 16 * TILES_AT_A_TIME * 3 + 5
    parameters, setpoints, seeds = random_parameters(count), random_setpoints(count, 5), np.arange(count, dtype=np.uint64)
    once, again = (rollout(name, parameters, setpoints, seeds, precision) for _ in range(2))
    threaded = rollout(name, parameters, setpoints, seeds, precision, threads=2)
    for a, b, c in zip(once, again, threaded, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_a_neighbours_effects_and_ones_own_past_do_not_change_a_bit(simulator):
    """A robot without effects, beside one that has them, and after it had them itself."""
    parameters, setpoints, seeds = random_parameters(2), random_setpoints(2, 10), np.arange(2, dtype=np.uint64)
    expected = rollout(simulator, parameters, setpoints, seeds)
    both = parameters.copy()
    for name, value in EFFECTS.items():
        both[name] = value
    plant = PLANTS[simulator].make(2, PlantOptions())
    plant.reset(seeds=seeds, parameters=both)
    plant.step(setpoints[0])
    both.values[0] = parameters.values[0]
    plant.reset(seeds=seeds, parameters=both)
    for tick, goal in enumerate(setpoints):
        sensors = plant.step(goal)
        np.testing.assert_array_equal(plant.truth().values[0], expected[0][tick, 0])
        np.testing.assert_array_equal(sensors.values[0], expected[1][tick, 0])
    assert (plant.truth().values[1] != expected[0][-1, 1]).any()


# ---- work and power ----------------------------------------------------------------------------------------------------


def test_stalled_motors_turn_electrical_energy_into_heat(simulator):
    """A stalled motor draws V I with I = V/R and does no work."""
    plant = make(simulator, 2, lambda p: p["servo.coulomb_friction"].__setitem__(..., 50.0))
    setpoints = home(2)
    setpoints[:, 4:] = 100.0
    plant.step(setpoints)
    motor = ROBOT.servo.wheel
    current = motor.stall_torque / (12.0 / motor.no_load_speed)
    electrical = 4 * 12.0 * current * 0.02
    creep = 1e-5 if simulator == "gibbs_appell" else 1e-4  # MuJoCo's dry friction gives way a little
    np.testing.assert_allclose(plant.truth().electrical_energy, electrical, rtol=creep)
    assert np.abs(plant.truth().mechanical_energy).max() < creep * electrical


def test_truth_shows_the_forces_that_hold_the_robot_up(simulator):
    plant = make(simulator, 2)
    for _ in range(100):
        plant.step(home(2))
    force = plant.truth().contact_force.reshape(2, 4, 3)
    np.testing.assert_allclose(force[..., 2].sum(axis=1), ROBOT.total_mass * ROBOT.gravity, rtol=1e-5)
    np.testing.assert_allclose(force.sum(axis=1)[:, :2], 0.0, atol=1e-4)
    assert TRUTH_LAYOUT.slices["contact_force"].stop - TRUTH_LAYOUT.slices["contact_force"].start == 12


# ---- formula forces ----------------------------------------------------------------------------------------------------


def test_a_formula_that_pulls_like_an_external_force_moves_the_robot_alike(simulator):
    pull = make_force(["floor_force_x"], "f", {"f": 3.0}, {"f": "N"})
    pushed = make(simulator, 2, lambda p: p["external_force"].__setitem__((..., 0), 3.0))
    pulled = make_plant(simulator, ROBOT, 2, QUIET, (pull,))
    pulled.reset(parameters=parameters_for(2))
    free = run(make(simulator, 2), 0, 15)
    truth = run(pulled, 0, 15)
    np.testing.assert_allclose(truth[:, :7], run(pushed, 0, 15)[:, :7], atol=1e-6)
    assert np.abs(truth - free)[:, 0].min() > 1e-5


def test_a_neutral_formula_does_not_change_a_bit(simulator):
    nothing = make_force(["leg_lf", "body_torque_yaw"], "0 * f", {"f": 1.0}, {"f": "N m"})
    plant = make_plant(simulator, ROBOT, 3, QUIET, (nothing,))
    plant.reset(parameters=parameters_for(3))
    np.testing.assert_array_equal(run(plant, 0, 10), run(make(simulator, 3), 0, 10))


@pytest.mark.slow
def test_a_formula_of_time_is_asked_at_every_step_and_time_goes_on_with_the_state(simulator):
    """Against an external force set anew before each step, from 2 s on; halfway through, robots are put where they are."""
    rise = make_force(["floor_force_x"], "f * time", {"f": 2.0}, {"f": "N/s"})
    start = make(simulator, 2).mechanical_state()
    start.time = np.array([2.0, 0.0])
    found = []
    for ticks, step in ((20, 0.01), (200, 0.001)):
        plant = make_plant(simulator, ROBOT, 2, PlantOptions(step, 0.001, sensor_noise=False), (rise,))
        plant.reset(state=start)
        hold(plant, home(2), ticks // 2)
        plant.reset(state=plant.mechanical_state(), mask=np.array([True, False]))
        hold(plant, home(2), ticks // 2)
        found.append(plant.truth().position.copy())
        plant.close()
    pushed = make_plant(simulator, ROBOT, 2, PlantOptions(0.001, 0.001, sensor_noise=False))
    parameters = Parameters.nominal(ROBOT, 2)
    for tick in range(200):
        parameters["external_force"][:, 0] = 2.0 * (start.time + 0.001 * tick)
        if tick == 0:
            pushed.reset(parameters=parameters, state=start)
        pushed.set_parameters(parameters)
        if tick == 100:
            pushed.reset(state=pushed.mechanical_state(), mask=np.array([True, False]))
        hold(pushed, home(2), 1)
    expected = pushed.truth().position.copy()
    pushed.close()
    for position in found:
        np.testing.assert_allclose(position, expected, atol=1e-7)
    assert expected[0, 0] > expected[1, 0] + 1e-5


def test_wind_up_is_state_of_the_joint_whose_formula_asks_for_it(simulator):
    law = make_force(["leg_lf"], "-f * wind_up", {"f": 0.3}, {"f": "N m"})
    setpoints, found, expected = home(2), [], np.zeros(2)
    setpoints[:, :4] += 0.3
    for ticks, step in ((10, 0.02), (200, 0.001)):
        plant = make_plant(simulator, ROBOT, 2, PlantOptions(step, 0.001, sensor_noise=False), (law,))
        for tick in range(ticks):
            if step == 0.001:
                way = plant.truth().joint_velocity[:, 0] * step / WIND_UP
                expected += way - np.abs(way) * expected
            if tick == ticks // 2:
                plant.reset(state=plant.mechanical_state(), mask=np.array([True, False]))
            hold(plant, setpoints, 1)
        wound = plant.mechanical_state().wind_up
        assert wound is not None
        assert not wound[:, 1:].any()
        found.append(wound[:, 0].copy())
        plant.reset()
        cleared = plant.mechanical_state().wind_up
        assert cleared is not None
        assert not cleared.any()
        plant.close()
    assert (expected > 0.5).all()
    np.testing.assert_allclose(found, [expected] * 2, atol=0.01)
