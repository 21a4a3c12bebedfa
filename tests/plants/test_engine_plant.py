"""The Gibbs-Appell plant keeps the Plant contract: columns, state, masks, parameters, refusals."""

import numpy as np
import pytest

from wlr_gym import slip
from wlr_gym.errors import InputError
from wlr_gym.model import dynamics
from wlr_gym.parameters import Parameters
from wlr_gym.plants.base import TRUTH_LAYOUT, PlantOptions, standing_state
from wlr_gym.plants.gibbs_appell.kernel import OUTPUTS
from wlr_gym.plants.gibbs_appell.plant import GibbsAppellPlant
from wlr_gym.plants.sensors import RAW_LAYOUT
from wlr_gym.robot import JOINTS, WHEELS, load_robot

ROBOT = load_robot()
COUNT = 9
QUIET = PlantOptions(sensor_noise=False)


def goals_for(tick, count=COUNT):
    rng = np.random.default_rng(100 + tick)
    return np.hstack([rng.uniform(1.1, 2.0, (count, 4)), rng.uniform(-5, 5, (count, 4))])


def make(count=COUNT, edit=None, options=QUIET):
    parameters = Parameters.nominal(ROBOT, count)
    parameters["ground.mu_x"] = np.linspace(0.2, 0.9, count)[:, None]
    parameters["ground.mu_y"] = np.linspace(0.8, 0.3, count)[:, None]
    if edit is not None:
        edit(parameters)
    plant = GibbsAppellPlant(ROBOT, count, options)
    plant.reset(seeds=np.arange(count, dtype=np.uint64), parameters=parameters)
    return plant


def run(plant, first, last):
    for tick in range(first, last):
        plant.step(goals_for(tick, plant.count))
    return plant.truth().values.copy()


# ---- columns -----------------------------------------------------------------------------------------------------------


def kernel_name(element):
    """The kernel's name of a TRUTH_LAYOUT element."""
    channel, _, labels = element.partition("[")
    labels = labels.rstrip("]").split(",") if labels else []
    numbers = {name: JOINTS.index(name) for name in JOINTS}
    numbers |= {} if channel in ("motor_torque", "friction_torque", "joint_position", "joint_velocity") else {
        wheel: corner for corner, wheel in enumerate(WHEELS)
    }  # fmt: skip
    own = f"shown_{channel}" if channel.endswith("_energy") else channel
    return "_".join([own, *(str(numbers.get(label, label)) for label in labels)])


def test_kernel_writes_its_columns_in_the_layouts_order():
    assert list(OUTPUTS[: TRUTH_LAYOUT.width]) == [kernel_name(element) for element in TRUTH_LAYOUT.elements]
    raw = OUTPUTS[TRUTH_LAYOUT.width :]
    assert len(raw) == RAW_LAYOUT.width + 1  # the heading's cosine and sine stand for the yaw
    assert raw[-2:] == ("heading_cosine", "heading_sine")


def test_truth_agrees_with_independent_values():
    """Slip, clearance and effective friction computed from the state without the engine's code."""
    plant = make()
    run(plant, 0, 25)
    truth, state = plant.truth(), plant.get_state()
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


def test_slip_displacement_is_the_slip_velocity_integrated_over_the_tick():
    fine, coarse = make(options=PlantOptions(control_period=1e-3)), make()
    total, travelled = np.zeros((COUNT, 8)), np.zeros((COUNT, 8))
    for tick in range(10):
        for _ in range(20):
            fine.step(goals_for(tick))
            total += 1e-3 * fine.truth().slip_velocity
        coarse.step(goals_for(tick))
        travelled += coarse.truth().slip_displacement
    assert np.abs(travelled).max() > 1e-3
    np.testing.assert_allclose(travelled, total, atol=1e-4)


def test_sensors_show_the_truth_where_nothing_disturbs_them():
    plant = make()
    run(plant, 0, 10)
    sensors, truth = plant.step(goals_for(10)), plant.truth()
    np.testing.assert_array_equal(sensors.joint_position, truth.joint_position)
    np.testing.assert_array_equal(sensors.joint_velocity, truth.joint_velocity)
    np.testing.assert_array_equal(sensors.joint_effort, truth.motor_torque)
    np.testing.assert_array_equal(sensors.supply_voltage, 12.0)


def test_accelerometer_shows_gravity_at_rest_and_nothing_in_free_fall():
    plant = make(2)
    state = plant.get_state()
    state.position[1, 2] = 50.0
    plant.reset(state=state)
    home = np.tile(np.concatenate([np.full(4, np.pi / 2), np.zeros(4)]), (2, 1))
    for _ in range(49):
        plant.step(home)
    sensors = plant.step(home)
    np.testing.assert_allclose(sensors.accelerometer, [[0, 0, 9.81], [0, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(sensors.gyro, 0.0, atol=1e-9)


# ---- state -------------------------------------------------------------------------------------------------------------


def test_state_survives_a_round_trip():
    plant = make(edit=lambda p: p["joint.zero_offset"].__setitem__(..., (0.02, -0.01, 0.0, 0.03)))
    run(plant, 0, 10)
    state = plant.get_state()
    other = make(edit=lambda p: p.values.__setitem__(..., plant.parameters.values))
    other.reset(state=state)
    for name, value in vars(other.get_state()).items():
        np.testing.assert_allclose(value, getattr(state, name), atol=1e-14, err_msg=name)
    # what is not state, the extrapolated rates and the warm start, is forgotten: the motion goes on almost alike
    np.testing.assert_allclose(run(other, 10, 15)[:, :3], run(plant, 10, 15)[:, :3], atol=1e-4)


def test_returned_state_is_a_copy():
    plant = make()
    run(plant, 0, 3)
    before = run(make(), 0, 5)
    for value in vars(plant.get_state()).values():
        value[:] = 0.0
    np.testing.assert_array_equal(run(plant, 3, 5), before)


def test_reset_with_a_mask_leaves_the_others_alone():
    mask = np.zeros(COUNT, bool)
    mask[[1, 8]] = True
    undisturbed, plant = make(), make()
    run(plant, 0, 10)
    run(undisturbed, 0, 10)
    replaced = plant.parameters.copy()
    replaced["ground.mu_x"] = 0.123
    plant.reset(seeds=np.arange(50, 50 + COUNT, dtype=np.uint64), parameters=replaced, mask=mask)
    np.testing.assert_array_equal(plant.parameters["ground.mu_x"][mask], 0.123)
    np.testing.assert_array_equal(plant.parameters.values[~mask], undisturbed.parameters.values[~mask])
    standing = standing_state(ROBOT, plant.parameters)
    np.testing.assert_array_equal(plant.get_state().position[mask], standing.position[mask])
    ours, theirs = run(plant, 10, 20), run(undisturbed, 10, 20)
    np.testing.assert_array_equal(ours[~mask], theirs[~mask])
    assert (ours[mask] != theirs[mask]).any(axis=1).all()


def test_reset_starts_anew():
    plant = make()
    first = run(plant, 0, 10)
    plant.reset(seeds=np.arange(COUNT, dtype=np.uint64))
    np.testing.assert_array_equal(run(plant, 0, 10), first)


def test_parameters_can_change_in_mid_run():
    """Friction drops under a robot that is being pushed: it starts to slide, its state is not touched by the change."""

    def push(parameters):
        parameters["servo.coulomb_friction"] = 50.0
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.6
        parameters["external_force"][:, 0] = 6.0

    plant = make(3, push)
    home = np.tile(np.concatenate([np.full(4, np.pi / 2), np.zeros(4)]), (3, 1))
    for _ in range(50):
        plant.step(home)
    before = plant.get_state()
    slippery = plant.parameters.copy()
    slippery["ground.mu_x"] = slippery["ground.mu_y"] = 0.1
    plant.set_parameters(slippery, np.array([True, False, True]))
    np.testing.assert_array_equal(plant.get_state().position, before.position)
    for _ in range(25):
        plant.step(home)
    gained = plant.truth().linear_velocity_in_body[:, 0]
    expected = (6.0 / ROBOT.total_mass - 0.1 * 9.81) * 0.5
    np.testing.assert_allclose(gained[[0, 2]], expected, rtol=5e-3)
    assert abs(gained[1]) < 1e-5


def test_delay_and_sensor_errors_change_in_mid_run_too():
    """A robot whose delay is switched on goes on with the goals it was given before; readings take the new zero at once."""

    def change(plant, mask):
        changed = plant.parameters.copy()
        changed["command.delay"], changed["joint.zero_offset"] = 0.06, 0.1
        plant.set_parameters(changed, mask)

    plant = make(2)
    goals = np.tile(np.concatenate([np.full(4, 1.3), np.zeros(4)]), (2, 1))
    for _ in range(100):
        plant.step(goals)
    change(plant, np.array([True, False]))
    sensors = plant.step(goals)
    reading = sensors.joint_position[:, :4] - plant.truth().joint_position[:, :4]
    np.testing.assert_allclose(reading, [[0.1] * 4, [0.0] * 4], atol=1e-12)
    for _ in range(100):
        plant.step(goals)
    np.testing.assert_allclose(plant.truth().joint_position[0, :4], 1.2, atol=0.02)
    goals[:, :4] = 1.8
    for tick in range(4):
        plant.step(goals)
        moving = np.abs(plant.truth().joint_velocity[:, :4]).max(axis=1) > 0.1
        assert moving[0] == (tick == 3)
        assert moving[1] or tick > 0


def test_callers_parameters_are_not_kept_by_reference():
    parameters = Parameters.nominal(ROBOT, 2)
    plant = GibbsAppellPlant(ROBOT, 2, QUIET)
    plant.reset(parameters=parameters)
    parameters["ground.mu_x"] = 0.0
    np.testing.assert_array_equal(plant.parameters["ground.mu_x"], 0.6)


# ---- refusals ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(8,), (2, 8), (3, 7), (3, 8, 1)])
def test_goals_of_a_wrong_shape_are_refused(shape):
    with pytest.raises(InputError, match=r"goals have shape .*expected \(3, 8\)"):
        make(3).step(np.zeros(shape))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_goals_that_are_no_numbers_never_reach_the_physics(bad):
    plant = make(3)
    goals = goals_for(0, 3)
    goals[2, 5] = bad
    before = plant.truth().values.copy()
    with pytest.raises(InputError, match=r"wheel_rf \(robot 2 of the batch\)"):
        plant.step(goals)
    np.testing.assert_array_equal(plant.truth().values, before)
    torque_on = np.ones((3, 8), bool)
    torque_on[2, 5] = False
    plant.step(goals, torque_on)
    assert np.isfinite(plant.truth().values).all()


def test_unknown_precision_is_refused_with_the_nearest():
    with pytest.raises(InputError, match=r"'float46'.*float64.*valid: float64, float32"):
        GibbsAppellPlant(ROBOT, 1, PlantOptions(precision="float46"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"physics_step": 0.0}, r"physics_step 0.0 s must be in \(0, control_period"),
        ({"physics_step": 0.03}, r"physics_step 0.03 s must be in"),
        ({"physics_step": 0.003}, "does not divide the control period"),
        ({"threads": 0}, "threads = 0, expected 1 or more"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        PlantOptions(**options)


def test_contact_too_stiff_for_the_step_is_refused_with_a_way_out():
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["ground.normal_stiffness"][1] = 2e5
    plant = GibbsAppellPlant(ROBOT, 2, PlantOptions(physics_step=4e-3))
    with pytest.raises(InputError, match=r"normal_stiffness 200000 N/m .*shorten physics_step below"):
        plant.reset(parameters=parameters)


def test_parameters_out_of_bounds_are_refused_by_name():
    parameters = Parameters.nominal(ROBOT, 3)
    parameters["wheel.radius"][2, 1] = -0.1
    with pytest.raises(InputError, match=r"wheel.radius\[wheel_rf\] = -0.1 \(robot 2"):
        make(3).reset(parameters=parameters)


def test_parameters_for_another_number_of_robots_are_refused():
    with pytest.raises(InputError, match="parameters hold 2 robots, the plant 3"):
        make(3).reset(parameters=Parameters.nominal(ROBOT, 2))


def test_goals_of_a_motor_that_is_off_never_act_later():
    def delayed(parameters):
        parameters["command.delay"] = 0.03

    plant = make(2, delayed)
    goals = np.tile(np.r_[[np.pi / 2] * 4, [0.0] * 4], (2, 1))
    off = np.ones((2, 8), bool)
    off[:, :4] = False
    for _ in range(10):
        plant.step(goals)
    for _ in range(5):
        plant.step(np.where(off, goals, np.nan), off)
    lowest = before = plant.truth().joint_position[:, :4].copy()
    for _ in range(10):
        plant.step(goals)
        lowest = np.minimum(lowest, plant.truth().joint_position[:, :4])
    assert (lowest > before - 0.02).all()


def test_accelerometer_starts_with_the_specific_force_of_standing_still():
    def inclined(parameters):
        parameters["ground.slope[pitch]"] = 0.3
        parameters["ground.slope[roll]"] = -0.1
        parameters["imu.accel_bias"] = 0.0

    plant = make(1, inclined)
    up = np.array([np.sin(0.3), np.sin(-0.1), np.sqrt(1 - np.sin(0.3) ** 2 - np.sin(0.1) ** 2)])
    assert plant.reset().accelerometer[0] == pytest.approx(9.81 * up, abs=1e-9)


def test_bad_resets_are_refused():
    plant = make(2)
    with pytest.raises(InputError, match="mask has shape"):
        plant.reset(mask=np.ones(3, bool))
    state = plant.get_state()
    state.position[0, 0] = np.nan
    with pytest.raises(InputError, match="not finite"):
        plant.reset(state=state)


@pytest.mark.parametrize("options", [{"threads": 1.5}, {"physics_step": "a"}, {"precision": 64}])
def test_options_of_the_wrong_kind_are_refused(options):
    with pytest.raises(InputError, match=next(iter(options))):
        PlantOptions(**options)


@pytest.mark.parametrize("count", [0, -1, 1.5])
def test_count_must_be_a_positive_whole_number(count):
    with pytest.raises(InputError, match="number of robots"):
        GibbsAppellPlant(ROBOT, count, QUIET)
