"""The slip observer on motions whose answer is known in closed form, and on both simulators."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike

from studies.observer.runs import PERIOD, estimated, observe, plain_odometry, simulate, slip_in_truth_order
from wlr_gym.base.errors import InputError
from wlr_gym.perception.observer import ESTIMATE_LAYOUT, SlipObserver, slip_filter
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, PlantOptions, Sensors, standing_state
from wlr_gym.robot import CORNER_SIGNS, load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot("nominal")
RADIUS, GRAVITY = ROBOT.wheel.radius, ROBOT.gravity


def readings(ticks: int, speed: ArrayLike = 0.0, wheel_speed: np.ndarray | None = None, slope: float = 0.0) -> np.ndarray:
    """Exact sensors (T, 1, W) of a level robot that moves straight ahead.

    Args:
        speed: (T,) m/s of the body. wheel_speed: (T, 4) m/s at the rims, None = rolling freely.
        slope: rad uphill.
    """
    speed = np.broadcast_to(speed, ticks)
    rims = np.repeat(speed[:, None], 4, axis=1) if wheel_speed is None else wheel_speed
    out = np.zeros((ticks, 1, SENSOR_LAYOUT.width))
    view = {name: out[:, 0, columns] for name, columns in SENSOR_LAYOUT.slices.items()}
    view["joint_position"][:, :4] = ROBOT.home.leg_angle
    view["joint_velocity"][:, 4:] = rims / RADIUS
    view["joint_position"][:, 4:] = np.cumsum(rims / RADIUS, axis=0) * PERIOD
    acceleration = np.diff(speed, prepend=speed[0]) / PERIOD
    view["accelerometer"][:, 0] = acceleration + GRAVITY * np.sin(slope)
    view["accelerometer"][:, 2] = GRAVITY * np.cos(slope)
    # the floor pushes all wheels alike: effort for that, for spinning up and for the gear's friction
    push = ROBOT.total_mass * view["accelerometer"][:, :1] / 4
    rate = rims / RADIUS
    spin = (ROBOT.wheel.spin_inertia + ROBOT.servo.wheel.armature) * np.diff(rate, axis=0, prepend=rate[:1]) / PERIOD
    dry = ROBOT.servo.wheel.coulomb_friction * np.tanh(rate / ROBOT.sensors.encoder.velocity)
    view["joint_effort"][:, 4:] = RADIUS * push + spin + dry
    return out


def follow(sensors: np.ndarray, camera: bool = False) -> np.ndarray:
    """Estimates (T, N, ESTIMATE_LAYOUT.width)."""
    observer, everyone = SlipObserver(ROBOT, PERIOD, sensors.shape[1], camera), np.ones(sensors.shape[1], bool)
    observer.reset(everyone, sensors[0])
    out = [observer.values.copy()]
    for row in sensors[1:]:
        observer.update(everyone, row)
        out.append(observer.values.copy())
    return np.array(out)


def ramp(ticks: int, start: int, stop: int, end: float) -> np.ndarray:
    return end * np.clip((np.arange(ticks) - start) / (stop - start), 0.0, 1.0)


# ---- closed form -----------------------------------------------------------------------------------------------------


def test_a_standing_robot_stays_where_it_is_and_learns_its_biases():
    sensors = readings(1000)
    rng = np.random.default_rng(1)
    sensors[..., SENSOR_LAYOUT.slices["accelerometer"]] += rng.normal((0.1, -0.08, 0.05), 0.03, (1000, 1, 3))
    sensors[..., SENSOR_LAYOUT.slices["gyro"]] += rng.normal((0.001, -0.001, 0.0015), 0.0009, (1000, 1, 3))
    found = follow(sensors)
    assert np.abs(estimated(found, "linear_velocity_in_body")[100:]).max() < 2e-3
    assert np.abs(estimated(found, "position")[-1]).max() < 5e-3
    assert abs(estimated(found, "yaw")[-1, 0]) < 2e-3  # open loop: 0.03 rad
    assert abs(estimated(found, "yaw_rate")[-100:, 0].mean()) < 2e-4
    assert estimated(found, "linear_velocity_sigma")[-1].max() < 2e-3


def test_free_rolling_is_no_slip():
    speed = ramp(300, 20, 60, 0.1)
    found = follow(readings(300, speed))
    assert np.abs(estimated(found, "linear_velocity_in_body")[60:, 0, 0] - speed[60:]).max() < 1e-3
    assert np.abs(estimated(found, "slip_velocity")[60:]).max() < 1e-3
    travelled = PERIOD * (speed.sum() - 0.5 * speed[-1])
    assert estimated(found, "position")[-1, 0, 0] == pytest.approx(travelled, abs=2e-3)


def test_locked_wheels_that_slide_are_seen_to_slide():
    mu = 0.2
    speed = ramp(300, 20, 60, 0.3)
    braking = np.arange(300) - 150
    speed = np.where(braking > 0, np.maximum(0.3 - mu * GRAVITY * braking * PERIOD, 0.0), speed)
    wheels = np.repeat(np.where(braking > 0, 0.0, speed)[:, None], 4, axis=1)
    found = follow(readings(300, speed, wheels))
    sliding = slice(151, 157)
    assert speed[sliding].min() > 0.02
    assert np.abs(estimated(found, "linear_velocity_in_body")[sliding, 0, 0] - speed[sliding]).max() < 0.04
    assert np.abs(estimated(found, "slip_velocity")[151:155, 0, 0]).min() > 0.08  # encoders alone say 0
    assert np.abs(estimated(found, "linear_velocity_in_body")[200:, 0, 0]).max() < 5e-3


def test_one_spinning_wheel_does_not_deceive():
    speed = ramp(300, 20, 60, 0.05)
    wheels = np.repeat(speed[:, None], 4, axis=1)
    wheels[150:250, 2] = 0.2
    found = follow(readings(300, speed, wheels))
    assert np.abs(estimated(found, "linear_velocity_in_body")[150:, 0, 0] - 0.05).max() < 3e-3
    slip = slip_in_truth_order(estimated(found, "slip_velocity"))[160:250, 0, :, 0]
    assert slip[:, 2] == pytest.approx(-0.15, abs=3e-3)
    assert np.abs(slip[:, [0, 1, 3]]).max() < 3e-3


def test_four_wheels_that_spin_up_on_ice_do_not_deceive():
    mu = 0.05
    speed = ramp(200, 50, 50 + round(0.1 / (mu * GRAVITY * PERIOD)), 0.1)
    wheels = np.repeat(np.where(np.arange(200) > 50, 0.1, 0.0)[:, None], 4, axis=1)
    found = follow(readings(200, speed, wheels))
    assert np.abs(estimated(found, "linear_velocity_in_body")[51:60, 0, 0] - speed[51:60]).max() < 0.02  # encoders alone: 0.09
    assert estimated(found, "linear_velocity_in_body")[-1, 0, 0] == pytest.approx(0.1, abs=3e-3)


def test_a_slope_is_told_from_a_bias_and_gravity_points_down_it():
    found = follow(readings(200, slope=0.3))
    assert np.abs(estimated(found, "linear_velocity_in_body")[5:]).max() < 2e-3
    gravity = estimated(found, "gravity_in_body")[-1, 0]
    assert gravity == pytest.approx([-np.sin(0.3), 0.0, -np.cos(0.3)], abs=2e-3)
    assert estimated(found, "friction_demand")[-1, 0] == pytest.approx(np.tan(0.3), abs=0.01)


def test_a_steady_tow_with_locked_wheels_is_not_observable_without_a_camera():
    """Nothing that the robot measures tells it from standing; a camera does."""
    sensors = readings(200, np.full(200, 0.05), np.zeros((200, 4)))
    assert np.abs(estimated(follow(sensors), "linear_velocity_in_body")[-1]).max() < 5e-3
    x = 0.05 * PERIOD * np.arange(200)
    with_camera = follow(seen_by_camera(sensors, x, delay=0.11), camera=True)
    assert estimated(with_camera, "position")[-1, 0, 0] == pytest.approx(x[-1], abs=2e-3)  # seen: 5.5 mm behind
    sigma = estimated(with_camera, "linear_velocity_sigma")[-1, 0, 0]
    assert estimated(with_camera, "linear_velocity_in_body")[-1, 0, 0] == pytest.approx(0.05, abs=2.0 * sigma)
    assert slip_in_truth_order(estimated(with_camera, "slip_velocity"))[-1, 0, :, 0] == pytest.approx(0.05, abs=2.0 * sigma)
    assert sigma < 9e-3


def test_a_circle_closes():
    """A skid turn on an even floor: centripetal acceleration is no drift to the side, and the pose turns with the body.

    Friction balances about the normal where every wheel's slip s has s_x b = s_y a (a, b: half the wheelbase and the track).
    """
    speed, rate, mu = 0.1, 0.5, 0.3
    time = PERIOD * np.arange(1 + round(2 * np.pi / rate / PERIOD))
    sensors = readings(len(time), ramp(len(time), -1, 1, speed))
    right = -np.array([y for _, y in CORNER_SIGNS])
    a, b = ROBOT.hip_position.x, ROBOT.hip_position.y
    rims = speed + right * rate * (b + a * a / b)
    sensors[1:, 0, SENSOR_LAYOUT.slices["joint_velocity"]][:, 4:] = rims / RADIUS
    traction = right * mu * ROBOT.total_mass * GRAVITY / 4 * a / np.hypot(a, b)
    dry = ROBOT.servo.wheel.coulomb_friction * np.tanh(rims / RADIUS / ROBOT.sensors.encoder.velocity)
    sensors[1:, 0, SENSOR_LAYOUT.slices["joint_effort"]][:, 4:] = RADIUS * traction + dry
    sensors[1:, 0, SENSOR_LAYOUT.slices["gyro"].start + 2] = rate
    sensors[1:, 0, SENSOR_LAYOUT.slices["accelerometer"].start + 1] = rate * speed
    found = follow(sensors)
    assert np.abs(estimated(found, "linear_velocity_in_body")[5:, 0, 1]).max() < 3e-3
    assert estimated(found, "yaw")[-1, 0] == pytest.approx(2 * np.pi, abs=0.03)
    opposite = estimated(found, "position")[len(time) // 2, 0]
    assert opposite == pytest.approx([0.0, 2 * speed / rate], abs=0.06)  # 12 % of the speed: one sigma
    assert estimated(found, "position")[-1, 0] == pytest.approx([0.0, 0.0], abs=0.015)


# ---- camera ----------------------------------------------------------------------------------------------------------


def seen_by_camera(sensors: np.ndarray, x: np.ndarray, delay: float) -> np.ndarray:
    """The same readings with an exact camera frame each tick, exposed ``delay`` s before."""
    out = sensors.copy()
    time = PERIOD * np.arange(len(sensors))
    out[:, 0, SENSOR_LAYOUT.slices["camera_pose"].start] = np.interp(time - delay, time, x)
    out[:, 0, SENSOR_LAYOUT.slices["camera_age"].start] = delay
    out[:, 0, SENSOR_LAYOUT.slices["camera_is_new"].start] = 1.0
    return out


def test_a_delayed_camera_frame_counts_for_the_moment_of_its_exposure():
    time = PERIOD * np.arange(400)
    speed = 0.1 * np.sin(2.0 * time)
    x = 0.05 * (1.0 - np.cos(2.0 * time))
    sensors = seen_by_camera(readings(400, speed), x, delay=0.11)
    late = sensors.copy()
    late[..., SENSOR_LAYOUT.slices["camera_age"]] = 0.0
    found, wrong = follow(sensors, camera=True), follow(late, camera=True)
    assert np.abs(estimated(found, "position")[50:, 0, 0] - x[50:]).max() < 1.5e-3
    assert estimated(found, "camera_innovation").max() < 1.5
    assert estimated(wrong, "camera_innovation").max() > 4.0


def test_a_robot_without_camera_frames_is_estimated_as_if_told_so():
    runs = simulate("gibbs_appell", "nominal", "commands", 2, 1.0)
    sensors = runs.sensors.copy()
    sensors[..., SENSOR_LAYOUT.slices["camera_is_new"]] = 0.0
    sensors[..., SENSOR_LAYOUT.slices["camera_pose"]] = np.nan
    np.testing.assert_array_equal(follow(sensors, camera=True), follow(runs.sensors, camera=False))


def test_one_wild_camera_frame_does_little():
    sensors = seen_by_camera(readings(200), np.zeros(200), delay=0.03)
    sensors[100, 0, SENSOR_LAYOUT.slices["camera_pose"].start] = 1.0
    assert np.abs(estimated(follow(sensors, camera=True), "position")).max() < 5e-3


# ---- forces ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("legs", [(1.57, 1.57, 1.57, 1.57), (1.2, 1.2, 1.9, 1.9), (1.9, 1.9, 1.9, 1.9), (1.5, 1.57, 1.6, 1.5)])
def test_normal_forces_are_the_engines_at_rest(legs):
    plant = make_plant("gibbs_appell", ROBOT, 1, PlantOptions(sensor_noise=False))
    parameters = Parameters.nominal(ROBOT, 1)
    state = standing_state(ROBOT, parameters)
    state.joint_position[:, :4] = state.reference_position[:, :4] = legs
    state.position[:, 2] = ROBOT.leg.length * np.sin(legs).mean() + RADIUS
    observer, everyone = SlipObserver(ROBOT, PERIOD, 1, False), np.ones(1, bool)
    observer.reset(everyone, plant.reset(parameters=parameters, state=state).values)
    setpoints = np.zeros((1, 8))
    setpoints[:, :4] = legs
    for _ in range(300):
        observer.update(everyone, plant.step(setpoints).values)
    true = plant.truth().contact_force[0, 2::3]
    assert ESTIMATE_LAYOUT.view(observer.values, "normal_force")[0] == pytest.approx(true, abs=0.1)
    assert true.sum() == pytest.approx(ROBOT.total_mass * GRAVITY, rel=1e-3)


def test_acceleration_shifts_load_to_the_rear():
    sensors = readings(10, 2.0 * PERIOD * np.arange(10))
    sensors[..., SENSOR_LAYOUT.slices["accelerometer"].start] = 2.0
    load = estimated(follow(sensors), "normal_force")[-1, 0]
    assert ROBOT.leg.mass is not None
    assert ROBOT.wheel.mass is not None
    below = ROBOT.leg.length * 4 * (0.5 * ROBOT.leg.mass + ROBOT.wheel.mass) / ROBOT.total_mass
    height = ROBOT.leg.length + RADIUS - below  # of the centre of mass above the floor
    shift = ROBOT.total_mass * 2.0 * height / (4 * ROBOT.hip_position.x)
    weight = ROBOT.total_mass * GRAVITY / 4
    assert load == pytest.approx([weight - shift, weight - shift, weight + shift, weight + shift], rel=0.01)
    assert shift > 0.15 * weight


def test_traction_in_a_skid_turn_is_the_engines():
    runs = simulate("gibbs_appell", "none", "commands", 4, 3.0)
    found = observe(runs, camera=False)
    true = runs.true("contact_force")[..., 0::3]
    turning = np.abs(true[50:]) > 2.0
    error = (estimated(found, "traction_force") - true)[50:]
    assert turning.sum() > 100
    assert np.sqrt((error[turning] ** 2).mean()) < 0.4


# ---- the filter --------------------------------------------------------------------------------------------------------


def test_the_filter_is_the_textbooks():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4))
    start, step = root @ root.T, 0.02
    transition = np.eye(4)
    transition[0, 1:3], transition[1, 2] = (step, -0.5 * step**2), -step
    p = start.copy()
    slip_filter.predict_direction(p, step, 0.3, 0.7)
    np.testing.assert_allclose(p, transition @ start @ transition.T + np.diag([0, 0.3, 0.7, 0]), rtol=1e-12, atol=1e-12)

    age, flow, column = 0.1, 0.4, np.empty(4)
    measurements = [
        (slip_filter.see_velocity(p, age, 0.0, column), column.copy(), np.array([0, 1, age, 0])),
        (slip_filter.see_velocity(p, age, flow, column), column.copy(), np.array([0, 1, age, -flow])),
        (slip_filter.see_position(p, age, column), column.copy(), h := np.array([1, -age, -0.5 * age**2, 0])),
    ]
    for spread, seen, row in measurements:
        np.testing.assert_allclose(seen, p @ row, rtol=1e-12)
        assert spread == pytest.approx(row @ p @ row)
    change, total = np.zeros(4), float(h @ p @ h) + 0.5
    corrected = p.copy()
    slip_filter.correct_direction(corrected, column.copy(), 2.0, total, change)
    np.testing.assert_allclose(change, 2.0 * (p @ h) / total, rtol=1e-12)
    np.testing.assert_allclose(corrected, p - np.outer(p @ h, p @ h) / total, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(corrected, corrected.T)


# ---- contract --------------------------------------------------------------------------------------------------------


def test_a_robot_gets_the_same_bits_alone_in_a_batch_and_behind_a_mask():
    runs = simulate("gibbs_appell", "patches", "excitation", 5, 2.0)
    together = follow(runs.sensors, camera=True)
    alone = follow(np.ascontiguousarray(runs.sensors[:, 3:4]), camera=True)
    np.testing.assert_array_equal(together[:, 3:4], alone)
    observer, mask = SlipObserver(ROBOT, PERIOD, 5, True), np.array([True, False, False, True, False])
    observer.reset(np.ones(5, bool), runs.sensors[0])
    for row in runs.sensors[1:]:
        observer.update(mask, row)
    np.testing.assert_array_equal(observer.values[mask], together[-1, mask])
    np.testing.assert_array_equal(observer.values[~mask], together[0, ~mask])
    observer.reset(mask, runs.sensors[0])
    np.testing.assert_array_equal(observer.values, together[0])
    for row in runs.sensors[1:]:  # nothing of the life before
        observer.update(mask, row)
    np.testing.assert_array_equal(observer.values[mask], together[-1, mask])


def test_covariances_stay_positive_and_readings_that_are_no_numbers_do_no_harm():
    runs = simulate("gibbs_appell", "ice", "excitation", 8, 6.0)
    sensors = runs.sensors.copy()
    rng = np.random.default_rng(2)
    sensors[rng.random(sensors.shape) < 0.01] = np.nan
    sensors[100:110] = np.nan
    observer, everyone = SlipObserver(ROBOT, PERIOD, 8, True), np.ones(8, bool)
    observer.reset(everyone, sensors[0])
    for row in sensors[1:]:
        observer.update(everyone, row)
        spread = np.linalg.eigvalsh(observer._states["covariance"])
        assert (spread[..., 0] > -1e-12 * spread[..., -1]).all()
        yaw, both, bias = observer._states["yaw_covariance"].T
        assert ((yaw >= 0) & (bias > 0) & (both**2 <= yaw * bias * (1 + 1e-9) + 1e-18)).all()
    assert np.isfinite(observer.values).all()
    error = ESTIMATE_LAYOUT.view(observer.values, "linear_velocity_in_body") - runs.true("linear_velocity_in_body")[-1, :, :2]
    assert np.abs(error).max() < 0.1


def test_a_robot_file_may_have_ideal_sensors():
    ideal = {"encoder": {"velocity": 0.0}, "imu": {"gyro_noise": 0.0, "accel_noise": 0.0, "gyro_bias": 0.0, "accel_bias": 0.0}}
    robot = load_robot({"base": "nominal", "name": "ideal", "sensors": ideal})
    observer = SlipObserver(robot, PERIOD, 1, False)
    readings = Sensors(np.zeros((1, SENSOR_LAYOUT.width)))
    readings.joint_position[:, :4], readings.accelerometer[:, 2] = robot.home.leg_angle, robot.gravity
    observer.reset(np.ones(1, bool), readings.values)
    for acceleration in (0.1, 0.0):  # for 1 s, then rolling on
        for _ in range(50):
            readings.accelerometer[:, 0] = acceleration
            readings.joint_velocity[:, 4:] += acceleration * PERIOD / robot.wheel.radius
            observer.update(np.ones(1, bool), readings.values)
    velocity = ESTIMATE_LAYOUT.view(observer.values, "linear_velocity_in_body")[0]
    assert velocity == pytest.approx([50 * PERIOD * 0.1, 0.0], abs=0.005)


def test_wrong_shapes_are_refused():
    observer = SlipObserver(ROBOT, PERIOD, 3, True)
    with pytest.raises(InputError, match="observer of 3 robots"):
        observer.reset(np.ones(2, bool), np.zeros((3, SENSOR_LAYOUT.width)))
    with pytest.raises(InputError, match="sensors"):
        observer.update(np.ones(3, bool), np.zeros((3, 4)))
    with pytest.raises(InputError, match="gravity = 0"):
        SlipObserver(ROBOT.model_copy(update={"gravity": 0.0}), PERIOD, 3, True)


# ---- against simulated truth -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
@pytest.mark.parametrize(("floor", "drive"), [("split", "commands"), ("ice", "excitation")])
def test_errors_and_their_sigmas_with_a_camera(backend, floor, drive):
    """Docs have the table; here: small, far better than wheel odometry, and as large as the sigma says."""
    runs = simulate(backend, floor, drive, 12, 5.0, seed=11)
    found, start = observe(runs, camera=True), 25
    true = runs.true("linear_velocity_in_body")[start:, :, :2]
    error = estimated(found, "linear_velocity_in_body")[start:] - true
    assert np.sqrt((error**2).mean()) < 8e-3
    assert np.sqrt((error**2).mean()) < 0.5 * np.sqrt(((plain_odometry(runs)[start:] - true) ** 2).mean())
    slip_error = estimated(found, "slip_velocity")[start:] - runs.true("slip_velocity")[start:]
    assert 0.3 < np.sqrt(((slip_error / estimated(found, "slip_sigma")[start:]) ** 2).mean()) < 1.5


def test_without_a_camera_the_sigma_says_how_wrong_it_is():
    runs = simulate("gibbs_appell", "ice", "excitation", 24, 5.0, seed=12)
    found, start = observe(runs, camera=False), 25
    error = (estimated(found, "linear_velocity_in_body") - runs.true("linear_velocity_in_body")[..., :2])[start:]
    assert np.sqrt(((error / estimated(found, "linear_velocity_sigma")[start:]) ** 2).mean()) < 2.0
    odometry = (plain_odometry(runs) - runs.true("linear_velocity_in_body")[..., :2])[start:]
    assert np.median(np.abs(error[..., 0])) < 0.5 * np.median(np.abs(odometry[..., 0]))  # some robots choose the wrong wheels
