"""The optical-flow sensor against what it is computed from by other means: true velocities, and counted statistics."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from simulators import QUIET, channel, read

from wlr_gym.base.errors import InputError
from wlr_gym.base.random import spawn_seeds
from wlr_gym.physics.model.dynamics import rotation_matrix
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, PlantOptions, Sensors, standing_state
from wlr_gym.physics.plants.sensors import RAW_LAYOUT, SensorModel
from wlr_gym.robot import load_robot, robot_content, robot_hash
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot("flow")
FLOW: Any = ROBOT.sensors.flow
PERIOD = 0.02
record = partial(read, robot=ROBOT)


def robot_with(**flow):
    content = robot_content(ROBOT)
    content["sensors"]["flow"].update(flow)
    return load_robot(content)


def gliding(velocity, ticks, count=1, height=0.134 + 0.035, yaw=0.0):
    """Raw signals (ticks, count, W) of level robots that move at a constant velocity (2,), floor frame."""
    raw = np.zeros((ticks, count, RAW_LAYOUT.width))
    raw[..., RAW_LAYOUT.slices["height"]] = height
    raw[..., RAW_LAYOUT.slices["quaternion"]] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
    way = PERIOD * np.arange(ticks)[:, None, None] * np.asarray(velocity)
    raw[..., RAW_LAYOUT.slices["pose"]] = np.concatenate([way, np.full((ticks, 1, 1), yaw)], axis=2)
    return raw


# ---- against the true velocities ------------------------------------------------------------------------------------


def drive(backend, robot, period, seconds, parameters, setpoints):
    """Readings and truth, tick by tick, of one robot under the same setpoints."""
    plant = make_plant(backend, robot, 1, PlantOptions(control_period=period, sensor_noise=False))
    state = standing_state(robot, parameters)
    state.joint_position[:, :4] = state.reference_position[:, :4] = setpoints[0, :4]
    sensors = plant.reset(np.array([3], np.uint64), parameters, state=state)
    readings, truths = [sensors.values[0].copy()], [plant.truth().values[0].copy()]
    for tick in range(round(seconds / period)):
        row = int(tick * period / PERIOD + 1e-9)
        sensors = plant.step(setpoints[row : row + 1])
        readings.append(sensors.values[0].copy())
        truths.append(plant.truth().values[0].copy())
    plant.close()
    return np.array(readings), np.array(truths)


def test_an_edge_under_the_body_moves_nothing():
    """Pitched by 0.1 rad and level at 0.2 m/s; from the tenth tick on the floor is 40 mm higher: the flow grows, no more."""
    raw, columns = gliding([0.2, 0.0], 20), RAW_LAYOUT.slices
    raw[..., columns["quaternion"]] = [np.cos(0.05), 0.0, np.sin(0.05), 0.0]
    higher = np.where(np.arange(20) < 10, 0.0, 0.04)[:, None, None]
    raw[..., columns["height"]] -= higher
    raw[..., columns["floor"]] = higher
    flow = channel(record(raw), "flow")[2:, 0, 0]
    before, after = flow[5], flow[-1]
    assert 1.2 * before < after
    assert (flow > before - 0.01).all()
    assert (flow < after + 0.01).all()


def instantaneous_flow(truths, lens):
    """Flow (rows, 2) by its definition from true velocities; height along the optical axis to the plane z = 0."""
    rotation = rotation_matrix(truths[:, 3:7])
    v, w, position = truths[:, 7:10], truths[:, 10:13], truths[:, :3]
    at_lens = v + np.cross(w, lens)
    place = position[:, 2] + rotation[:, 2] @ lens
    distance = place / rotation[:, 2, 2]
    return np.stack([at_lens[:, 0] / distance - w[:, 1], at_lens[:, 1] / distance + w[:, 0]], axis=1)


@pytest.mark.parametrize("backend", ["gibbs_appell", "mujoco"])
def test_flow_is_that_of_the_true_velocities_on_a_slope_and_with_a_pitched_body(backend):
    robot = robot_with(position=[0.08, -0.05, -0.03])
    parameters = Parameters.nominal(robot)
    parameters["ground.slope"] = [0.12, -0.08]
    seconds = 1.0
    setpoints = np.zeros((51, 8))
    setpoints[:, :2], setpoints[:, 2:4] = 1.25, 1.75
    setpoints[15:, 2:4] = 2.5  # it pitches while it drives
    setpoints[:, 4::2], setpoints[:, 5::2] = 3.0, 6.0  # a turn
    coarse, truth = drive(backend, robot, PERIOD, seconds, parameters, setpoints)
    _, fine = drive(backend, robot, 0.001, seconds, parameters, setpoints)
    np.testing.assert_allclose(fine[::20, :3], truth[:, :3], atol=1e-9)  # the same motion
    sensor: Any = robot.sensors.flow
    flow = instantaneous_flow(fine, np.array(sensor.position))
    assert np.ptp(rotation_matrix(fine[:, 3:7])[:, 2, 0]) > 0.05  # it pitches
    shift = np.concatenate([np.zeros((1, 2)), np.cumsum(0.0005 * (flow[1:] + flow[:-1]), axis=0)])
    times = 0.001 * np.arange(len(shift))
    ends = PERIOD * np.arange(len(coarse)) - channel(coarse, "flow_age")[:, 0]
    at = np.stack([np.interp(ends, times, shift[:, k]) for k in range(2)], axis=1)
    expected = np.diff(at[1:], axis=0) / np.diff(ends[1:])[:, None]
    measured = channel(coarse, "flow")[2:]
    assert (channel(coarse, "flow_is_new")[1:] == 1.0).all()
    assert np.abs(expected).max() > 1.0
    # where the speed jumps within a tick, the pose at a frame is not on the line between two ticks: the next reading makes up
    assert np.quantile(np.abs(measured - expected), 0.85) < 0.02
    intervals = np.diff(ends[1:])[:, None]
    np.testing.assert_allclose(np.cumsum(measured * intervals, axis=0), at[2:] - at[1], atol=4e-3)
    assert np.abs(at[-1] - at[1]).max() > 0.7


def test_flow_of_a_level_glide_is_velocity_over_height():
    readings = record(gliding([0.3, -0.1], 40))
    np.testing.assert_allclose(channel(readings, "flow")[3:, 0], np.tile([0.3 / 0.134, -0.1 / 0.134], (37, 1)), rtol=1e-9)
    np.testing.assert_allclose(channel(readings, "flow_quality")[3:], FLOW.quality)
    assert channel(readings, "flow_is_new")[0, 0, 0] == 0.0  # nothing has been counted yet at the reset
    ages = channel(readings, "flow_age")[1:, 0, 0]
    assert (ages >= 0.0).all()
    assert (ages < 1.0 / FLOW.rate).all()


def test_scale_and_mounting_turn_and_stretch_what_is_read():
    raw = gliding([0.3, 0.1], 10, count=2, yaw=0.7)
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["flow.scale"][1], parameters["flow.mount_yaw"][1] = 1.2, 0.25
    plain, turned = channel(record(raw, parameters, seeds=np.zeros(2, np.uint64)), "flow")[-1]
    c, s = np.cos(0.25), np.sin(0.25)
    np.testing.assert_allclose(turned, 1.2 * np.array([[c, s], [-s, c]]) @ plain, rtol=1e-12)


def test_frames_slower_than_the_control_rate_leave_ticks_without_a_reading():
    slow = robot_with(rate=20.0)
    readings = record(gliding([0.2, 0.0], 201), robot=slow)
    new = channel(readings, "flow_is_new")[1:, 0, 0]
    assert new.sum() == 80
    np.testing.assert_allclose(channel(readings, "flow")[5:, 0, 0], 0.2 / 0.134, rtol=1e-9)  # held in between
    assert channel(readings, "flow_age").max() < 1.0 / 20.0


# ---- noise, quality, dropouts ---------------------------------------------------------------------------------------


def noisy(velocity, count=400, ticks=60, **parameters):
    values = Parameters.nominal(ROBOT, count)
    for name, value in parameters.items():
        values[f"flow.{name}"] = value
    return record(gliding(velocity, ticks, count), values, options=PlantOptions())[3:]


@pytest.mark.parametrize("speed", [0.0, 0.4])
def test_noise_is_that_of_its_frames_and_grows_with_speed(speed):
    errors = channel(noisy([speed, 0.0]), "flow") - [speed / 0.134, 0.0]
    three = FLOW.rate * PERIOD - 2.0  # share of the ticks with three frames, not two
    for axis, per_frame in ((0, speed / 0.134 / FLOW.rate / FLOW.count), (1, 0.0)):
        one = FLOW.noise**2 + (FLOW.speed_noise * per_frame) ** 2
        variance = sum(p * (n * one + 1 / 12) * (FLOW.count * FLOW.rate / n) ** 2 for n, p in ((2, 1.0 - three), (3, three)))
        assert errors[..., axis].std() == pytest.approx(np.sqrt(variance), rel=0.03)
        assert abs(errors[..., axis].mean()) < 5.0 * np.sqrt(variance / errors[..., axis].size)
    lag = np.mean(errors[1:, :, 1] * errors[:-1, :, 1]) / np.mean(errors[..., 1] ** 2)
    assert abs(lag) < 0.03  # white
    whole = channel(noisy([speed, 0.0], count=1), "flow")[:, 0] * (3 / FLOW.rate) / FLOW.count * 2
    np.testing.assert_allclose(np.minimum(whole % 1.0, 1.0 - whole % 1.0), 0.0, atol=1e-6)  # counts over 2 or 3 frames


def test_poor_floor_is_in_places_and_costs_quality_then_readings():
    readings = noisy([0.5, 0.0], count=200, ticks=100, poor_floor=0.5)
    quality, new = channel(readings, "flow_quality")[..., 0], channel(readings, "flow_is_new")[..., 0]
    lost = 1.0 - new.mean()
    assert lost == pytest.approx(0.5 * FLOW.least_quality / FLOW.quality, abs=0.04)
    assert (quality[new == 0.0] == 0.0).all()
    runs = np.diff(new[:, 0]) != 0
    assert runs.sum() < 20  # places of 0.2 m, not single readings
    errors = np.abs(channel(readings, "flow")[..., 1])
    poor = (new == 1.0) & (quality < 0.2)
    assert errors[poor].std() > 1.3 * errors[(new == 1.0) & (quality > 0.3)].std()


def test_dropouts_hold_the_last_reading_and_let_it_age():
    readings = noisy([0.2, 0.0], dropout=0.3)
    new = channel(readings, "flow_is_new")[..., 0]
    assert 1.0 - new.mean() == pytest.approx(0.3, abs=0.02)
    flow, age = channel(readings, "flow"), channel(readings, "flow_age")[..., 0]
    held = new[1:] == 0.0
    np.testing.assert_array_equal(flow[1:][held], flow[:-1][held])
    np.testing.assert_allclose(age[1:][held], age[:-1][held] + PERIOD, atol=1e-12)


@pytest.mark.parametrize("case", ["low", "fast", "over"])
def test_too_low_too_fast_or_tipped_over_is_no_reading(case):
    raw = gliding([1.2 if case == "fast" else 0.2, 0.0], 30, height=0.1 if case == "low" else 0.169)
    if case == "over":
        raw[..., RAW_LAYOUT.slices["quaternion"]] = [0.0, 1.0, 0.0, 0.0]
    readings = record(raw)
    assert not channel(readings, "flow_is_new")[3:].any()
    assert not channel(readings, "flow_quality")[3:].any()


def test_absent_sensors_read_nothing_and_change_no_other_channel():
    raw = gliding([0.3, 0.0], 60, count=3)
    parameters = Parameters.nominal(ROBOT, 3)
    parameters["flow.present"][1] = 0.0
    parameters["camera.present"][2] = 0.0
    seeds = np.full(3, 5, np.uint64)
    both, no_flow, no_camera = record(raw, parameters, options=PlantOptions(), seeds=seeds).swapaxes(0, 1)
    flow = slice(SENSOR_LAYOUT.slices["flow"].start, None)
    np.testing.assert_array_equal(both[:, : flow.start], no_flow[:, : flow.start])
    np.testing.assert_array_equal(both[:, flow], no_camera[:, flow])
    ages = PERIOD * np.arange(60)
    np.testing.assert_allclose(channel(no_flow, "flow_age")[:, 0], ages)
    np.testing.assert_allclose(channel(no_camera, "camera_age")[:, 0], ages)
    for readings, names in ((no_flow, ("flow", "flow_quality", "flow_is_new")), (no_camera, ("camera_pose", "camera_is_new"))):
        for name in names:
            assert not channel(readings, name).any()


def test_camera_frames_are_lost_from_a_stream_of_their_own():
    raw = gliding([0.3, 0.0], 2000, count=2)
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["camera.dropout"][1] = 0.25
    whole, lossy = record(raw, parameters, options=PlantOptions(), seeds=np.full(2, 5, np.uint64)).swapaxes(0, 1)
    new, kept = channel(whole, "camera_is_new")[:, 0] == 1.0, channel(lossy, "camera_is_new")[:, 0] == 1.0
    assert (new | ~kept).all()
    assert kept[0]
    assert 1.0 - kept.sum() / new.sum() == pytest.approx(0.25, abs=0.04)
    names = ("camera_pose", "camera_age")
    for name in names:
        np.testing.assert_array_equal(channel(whole, name)[kept], channel(lossy, name)[kept])
    held = ~kept[1:]
    np.testing.assert_array_equal(channel(lossy, "camera_pose")[1:][held], channel(lossy, "camera_pose")[:-1][held])
    np.testing.assert_allclose(np.diff(channel(lossy, "camera_age")[:, 0])[held], PERIOD, atol=1e-12)


def test_same_bits_alone_and_in_a_batch_and_after_changes_in_mid_run():
    rng = np.random.default_rng(1)
    raw = gliding([0.3, 0.1], 40, count=16) + 0.0
    raw[..., RAW_LAYOUT.slices["quaternion"].start + 2] = 0.02 * rng.normal(size=(40, 16))
    parameters = Parameters.nominal(ROBOT, 16)
    parameters["flow.poor_floor"], parameters["flow.dropout"] = 0.3, 0.1
    seeds = spawn_seeds(2, 16)
    batch = record(raw, parameters, options=PlantOptions(), seeds=seeds)
    alone = record(raw[:, 7:8].copy(), Parameters(parameters.values[7:8]), options=PlantOptions(), seeds=seeds[7:8])
    np.testing.assert_array_equal(batch[:, 7], alone[:, 0])


def test_a_sensor_that_appears_in_mid_run_begins_with_what_it_then_sees():
    raw = gliding([0.3, 0.0], 40)
    model, out = SensorModel(ROBOT, QUIET, 1), np.zeros((1, SENSOR_LAYOUT.width))
    parameters = Parameters.nominal(ROBOT)
    parameters["flow.present"] = 0.0
    model.reset(raw[0], out, spawn_seeds(0, 1), parameters)
    for row in raw[1:20]:
        model.measure(row, out)
    parameters["flow.present"] = 1.0
    model.set_errors(np.arange(1), parameters)
    model.measure(raw[20], out)
    assert not Sensors(out).flow_is_new[0]
    model.measure(raw[22], out)
    model.measure(raw[23], out)
    assert Sensors(out).flow[0, 0] < 1.5 * 0.3 / 0.134  # the way it missed is not in it


def test_a_robot_without_the_section_cannot_have_the_sensor():
    parameters = Parameters.nominal(load_robot("nominal"))
    assert parameters["flow.present"][0] == 0.0
    parameters["flow.present"] = 1.0
    with pytest.raises(InputError, match=r"expected a section sensors\.flow"):
        SensorModel(load_robot("nominal"), QUIET, 1).set_errors(np.arange(1), parameters)


def test_a_flow_sensor_changes_no_fingerprint_and_no_content_of_other_robots():
    assert robot_hash(ROBOT) == robot_hash(load_robot("emanual"))
    assert "flow" not in robot_content("nominal")["sensors"]
    assert load_robot(robot_content(ROBOT)) == ROBOT
