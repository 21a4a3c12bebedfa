"""The sensor model: noise and counts, camera timing against a known path, and the same bits in any batch."""

import dataclasses

import numpy as np
import pytest
from simulators import QUIET, ROBOT, channel, read

from wlr_gym.base.errors import InputError
from wlr_gym.base.random import spawn_seeds
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, PlantOptions, Sensors, Truth
from wlr_gym.physics.plants.sensors import RAW_LAYOUT, SensorModel
from wlr_gym.physics.servo import effort_counts
from wlr_gym.robot.parameters import Parameters

NOISY = PlantOptions()
PERIOD = 0.02


def along_path(times, count=1, wrap=False):
    """Raw matrices (T, count, width) of robots on a smooth path; and the exact pose function."""

    def pose(t):
        t = np.maximum(t, 0.0)
        return np.stack([0.4 * t, 0.1 * np.sin(2 * t), 1.7 * t], axis=-1)

    raws = np.zeros((len(times), count, RAW_LAYOUT.width))
    poses = pose(times)
    if wrap:
        poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    raws[:, :, RAW_LAYOUT.slices["pose"]] = poses[:, None, :]
    return raws, pose


@pytest.fixture(scope="module")
def noisy():
    count, ticks = 64, 200
    raw = np.zeros((ticks, count, RAW_LAYOUT.width))
    raw[:, :, :] = np.random.default_rng(0).normal(size=(1, 1, RAW_LAYOUT.width))
    raw[:, :, RAW_LAYOUT.slices["supply_voltage"]] = 11.87
    readings = read(raw, seeds=spawn_seeds(4, count), options=NOISY)
    return raw[0, 0], readings


@pytest.mark.parametrize(
    ("name", "sigma"),
    [("gyro", 0.0009), ("accelerometer", 0.03), ("supply_voltage", np.hypot(0.03, 0.1 / np.sqrt(12)))],
)
def test_noise_has_the_stated_size_and_no_bias(noisy, name, sigma):
    truth, readings = noisy
    errors = channel(readings, name) - truth[RAW_LAYOUT.slices[name]]
    relative = 0.25 if name == "supply_voltage" else 0.03
    assert errors.std(axis=(0, 1)) == pytest.approx(np.full(errors.shape[-1], sigma), rel=relative)
    assert np.abs(errors.mean(axis=(0, 1))).max() < (0.012 if name == "supply_voltage" else 5 * sigma / np.sqrt(200 * 64))


def test_effort_noise_and_counts(noisy):
    truth, readings = noisy
    efforts, counts = channel(readings, "joint_effort"), effort_counts(ROBOT)
    errors = efforts - truth[RAW_LAYOUT.slices["joint_effort"]]
    assert errors.std(axis=(0, 1)) == pytest.approx(np.hypot([0.010] * 4 + [0.005] * 4, counts / np.sqrt(12)), rel=0.03)
    np.testing.assert_allclose(efforts / counts, np.rint(efforts / counts), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "count"), [("joint_position", 2 * np.pi / 4096), ("joint_velocity", 0.02398082392240917), ("supply_voltage", 0.1)]
)
def test_registers_come_in_whole_counts(noisy, name, count):
    truth, readings = noisy
    values = channel(readings, name)
    np.testing.assert_allclose(values / count, np.rint(values / count), atol=1e-6)
    if name == "joint_velocity":
        assert np.abs(values - truth[RAW_LAYOUT.slices[name]]).max() <= 0.5 * count + 1e-12


def test_noise_is_white_and_differs_between_robots_and_channels(noisy):
    errors = channel(noisy[1], "gyro") - noisy[0][RAW_LAYOUT.slices["gyro"]]
    lag = (errors[1:] * errors[:-1]).mean() / errors.var()
    assert abs(lag) < 5 / np.sqrt(errors.size)
    flat = errors.transpose(1, 2, 0).reshape(-1, len(errors))
    assert np.abs(np.corrcoef(flat) - np.eye(len(flat))).max() < 6 / np.sqrt(len(errors))


def test_camera_noise(noisy):
    readings = noisy[1]
    new = channel(readings, "camera_is_new")[1:, :, 0] == 1
    poses = channel(readings, "camera_pose")[1:][new]
    assert poses.std(axis=0) == pytest.approx([0.001, 0.001, 0.005], rel=0.05)


def random_case(count, ticks=40):
    rng = np.random.default_rng(11)
    raws = rng.normal(size=(ticks, count, RAW_LAYOUT.width))
    parameters = Parameters.nominal(ROBOT, count)
    for name in ("imu.gyro_bias", "imu.accel_bias", "joint.zero_offset"):
        parameters[name] = rng.normal(scale=0.01, size=parameters[name].shape)
    parameters["camera.delay"] = rng.uniform(0, 0.5, count)
    parameters["camera.mount_yaw"] = rng.uniform(-0.1, 0.1, count)
    parameters["camera.scale"] = rng.uniform(0.9, 1.1, count)
    parameters["imu.mount"] = rng.uniform(-0.2, 0.2, (count, 3))
    return raws, spawn_seeds(2, count), parameters


@pytest.mark.parametrize("place", [0, 17, 63])
def test_alone_or_in_a_batch_gives_the_same_bits(place):
    raws, seeds, parameters = random_case(64)
    batch = read(raws, parameters, seeds, NOISY)
    row = slice(place, place + 1)
    alone = read(raws[:, row].copy(), Parameters(parameters.values[row]), seeds[row], NOISY)
    assert np.array_equal(batch[:, row], alone)


def test_ranges_give_the_same_bits_as_the_whole_batch():
    raws, seeds, parameters = random_case(64)
    whole, parts = (SensorModel(ROBOT, NOISY, 64) for _ in range(2))
    out, other = np.zeros((2, 64, SENSOR_LAYOUT.width))
    whole.reset(raws[0], out, seeds, parameters)
    parts.reset(raws[0], other, seeds, parameters)
    for raw in raws[1:]:
        whole.measure(raw, out)
        for start, stop in ((40, 64), (0, 7), (7, 40)):
            parts.measure(raw, other, start, stop)
        assert np.array_equal(out, other)


def test_masked_reset_restarts_only_the_masked_robots():
    raws, seeds, parameters = random_case(4)
    touched, untouched = (SensorModel(ROBOT, NOISY, 4) for _ in range(2))
    out, other = np.zeros((2, 4, SENSOR_LAYOUT.width))
    for model, matrix in ((touched, out), (untouched, other)):
        model.reset(raws[0], matrix, seeds, parameters)
        for raw in raws[1:20]:
            model.measure(raw, matrix)
    mask = np.array([False, True, False, False])
    touched.reset(raws[0], out, seeds, parameters, mask)
    fresh = read(raws[[0, 20]], parameters, seeds, NOISY)
    assert np.array_equal(out[1], fresh[0, 1])
    touched.measure(raws[20], out)
    untouched.measure(raws[20], other)
    assert np.array_equal(out[~mask], other[~mask])
    assert np.array_equal(out[1], fresh[1, 1])


def test_without_noise_the_readings_are_exact_and_biases_stay():
    raws, seeds, parameters = random_case(3)
    readings = read(raws, parameters, seeds)
    truth = raws[-1]
    sensors = Sensors(readings[-1])
    legs, wheels = truth[:, :4], truth[:, 4:8]
    np.testing.assert_allclose(sensors.joint_position[:, :4], legs + parameters["joint.zero_offset"], atol=1e-15)
    np.testing.assert_allclose(sensors.joint_position[:, 4:], wheels - raws[0][:, 4:8], atol=1e-15)
    for name in ("joint_velocity", "joint_effort"):
        np.testing.assert_array_equal(sensors[name], truth[:, RAW_LAYOUT.slices[name]])
    np.testing.assert_array_equal(sensors.supply_voltage, truth[:, RAW_LAYOUT.slices["supply_voltage"]][:, 0])
    assert not sensors.joint_age.any()
    assert not sensors.imu_age.any()


@pytest.mark.parametrize("delay", [0.0, 0.007, 0.033, 0.5])
def test_camera_shows_the_path_as_it_was_at_the_stated_age(delay):
    count = 5
    times = np.arange(0, 4, PERIOD)
    raws, pose = along_path(times, count, wrap=True)
    parameters = Parameters.nominal(ROBOT, count)
    parameters["camera.delay"] = delay
    readings = read(raws, parameters, spawn_seeds(3, count))
    age = channel(readings, "camera_age")[..., 0]
    new = channel(readings, "camera_is_new")[..., 0] == 1
    exposed = times[:, None] - age
    np.testing.assert_allclose(channel(readings, "camera_pose"), pose(exposed), atol=1e-4)
    assert (age[1:] >= delay - 1e-12).all()
    assert (age[1:] < delay + 1 / 30 + 1e-12).all()
    assert (age[1:][new[1:]] < delay + PERIOD + 1e-12).all()
    frames = exposed * 30
    np.testing.assert_allclose(frames - frames[0], np.rint(frames - frames[0]), atol=1e-9)
    np.testing.assert_allclose(np.diff(frames, axis=0), new[1:], atol=1e-9)
    assert new[1:].sum(axis=0) == pytest.approx(np.full(count, 30 * times[-1]), abs=1.01)
    phases = (frames[0] % 1).round(9)
    assert len(np.unique(phases)) == count


def test_camera_frame_is_the_start_pose_turned_by_the_mounting():
    raws, _ = along_path(np.zeros(100), 1)
    start, mount = np.array([1.0, -2.0, 0.8]), 0.1
    raws[:, 0, RAW_LAYOUT.slices["pose"]] = start
    raws[1:, 0, RAW_LAYOUT.slices["pose"]] = start + np.array([0.3, 0.4, 0.25])
    parameters = Parameters.nominal(ROBOT)
    parameters["camera.mount_yaw"] = mount
    readings = read(raws, parameters)
    shown = channel(readings, "camera_pose")[:, 0]
    assert shown[0].tolist() == [0, 0, 0]
    turn = -(0.8 + mount)
    expected = [0.3 * np.cos(turn) - 0.4 * np.sin(turn), 0.3 * np.sin(turn) + 0.4 * np.cos(turn), 0.25]
    assert shown[-1] == pytest.approx(expected)


def test_camera_scale_stretches_the_measured_path_and_leaves_the_yaw():
    raws, _ = along_path(np.arange(0, 2, PERIOD), 2)
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["camera.mount_yaw"] = 0.2
    parameters["camera.scale"] = [1.0, 1.07]
    readings = read(raws, parameters, np.full(2, 9, np.uint64))
    shown = channel(readings, "camera_pose")
    assert np.abs(shown[-1, 0, :2]).min() > 0.01
    np.testing.assert_allclose(shown[:, 1, :2], 1.07 * shown[:, 0, :2], rtol=1e-14)
    np.testing.assert_array_equal(shown[:, 1, 2], shown[:, 0, 2])


def test_a_tilted_imu_reads_gravity_along_its_own_axes():
    raw = np.zeros((2, 3, RAW_LAYOUT.width))
    raw[:, :, RAW_LAYOUT.slices["accelerometer"]] = [0.0, 0.0, 9.81]
    raw[:, :, RAW_LAYOUT.slices["gyro"]] = [0.0, 0.0, 2.0]
    parameters = Parameters.nominal(ROBOT, 3)
    parameters["imu.mount"] = [[0.0, 0.1, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.3]]
    sensors = Sensors(read(raw, parameters)[-1])
    sine, cosine = np.sin(0.1), np.cos(0.1)
    # nose of the sensor down: its x axis looks down; right side down: its y axis looks up; turned about z: nothing changes
    directions = [[-sine, 0, cosine], [0, sine, cosine], [0, 0, 1]]
    np.testing.assert_allclose(sensors.accelerometer, 9.81 * np.array(directions), atol=1e-14)
    np.testing.assert_allclose(sensors.gyro, 2.0 * np.array(directions), atol=1e-14)


def test_mounting_is_the_rotation_from_sensor_to_body_and_biases_are_the_sensors():
    raws, seeds, parameters = random_case(3)
    roll, pitch, yaw = parameters["imu.mount"].T
    readings = read(raws, parameters, seeds)
    sensors = Sensors(readings[-1])
    for name, bias in (("gyro", "imu.gyro_bias"), ("accelerometer", "imu.accel_bias")):
        for robot in range(3):
            to_body = np.eye(3)
            for axis, angle in ((2, yaw[robot]), (1, pitch[robot]), (0, roll[robot])):
                turn, (a, b) = np.eye(3), ((1, 2), (2, 0), (0, 1))[axis]
                turn[a, a] = turn[b, b] = np.cos(angle)
                turn[b, a], turn[a, b] = np.sin(angle), -np.sin(angle)
                to_body = to_body @ turn
            measured = sensors[name][robot] - parameters[bias][robot]
            np.testing.assert_allclose(to_body @ measured, raws[-1][robot, RAW_LAYOUT.slices[name]], atol=1e-14)


def test_without_mounting_errors_the_readings_are_the_truth_to_the_bit():
    raws, seeds, _ = random_case(4)
    raws[3], raws[4] = 0.0, -1e-300
    readings = read(raws, seeds=seeds)
    for name in ("gyro", "accelerometer"):
        assert np.array_equal(channel(readings, name), raws[..., RAW_LAYOUT.slices[name]])


def test_yaw_unwraps_over_many_turns():
    times = np.arange(0, 20, PERIOD)
    raws, _ = along_path(times, 1, wrap=True)
    readings = read(raws)
    assert channel(readings, "camera_pose")[-1, 0, 2] == pytest.approx(1.7 * times[-1], abs=1.7 * 0.06)


def test_same_seed_same_noise_other_seed_other_noise():
    raws, seeds, parameters = random_case(2)
    first, again, other = (read(raws, parameters, given, NOISY) for given in (seeds, seeds, seeds + np.uint64(1)))
    assert np.array_equal(first, again)
    gyro = SENSOR_LAYOUT.slices["gyro"]
    assert not (first[..., gyro] == other[..., gyro]).any()


def test_control_period_sets_the_camera_pattern():
    options = dataclasses.replace(QUIET, control_period=1 / 30, physics_step=1 / 300)
    raws, _ = along_path(np.arange(60) / 30)
    assert channel(read(raws, options=options), "camera_is_new").all()


def test_channels_that_do_not_exist_can_be_asked_for():
    sensors = Sensors(np.zeros((1, SENSOR_LAYOUT.width)))
    assert not hasattr(sensors, "gyr")
    assert getattr(sensors, "gyr", None) is None
    for look in (lambda: sensors.gyr, lambda: sensors["gyr"]):
        with pytest.raises(InputError, match=r"unknown channel 'gyr' \(did you mean 'gyro'"):
            look()


def test_wrong_shapes_are_refused():
    model = SensorModel(ROBOT, PlantOptions(), 2)
    with pytest.raises(InputError, match="sensors of 2 robots"):
        model.measure(np.zeros((3, RAW_LAYOUT.width)), np.zeros((3, SENSOR_LAYOUT.width)))


@pytest.mark.parametrize(
    "values",
    [np.zeros((2, 3), order="F"), np.zeros((4, 6))[:, ::2], np.zeros((2, 3), np.float32)],
    ids=["columns", "part", "single"],
)
def test_numbers_that_kernels_would_misread_are_refused(values):
    """Kernels read the rows of any plant's matrices, users' own included, by their place in memory."""
    for kind in (Sensors, Truth):
        with pytest.raises(InputError, match=f"{kind.__name__}: expected float64 numbers row by row"):
            kind(values)
