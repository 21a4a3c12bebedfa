"""The same tests through Gibbs-Appell and MuJoCo; inverse dynamics of what they do; a robot without truth."""

from dataclasses import replace

import numpy as np
import pytest

from studies.paper import reduced, report
from studies.paper.experiments import (
    PERIOD,
    TESTS,
    drive,
    drive_both,
    drive_plant,
    error_of_ignoring_slip,
    ideal_motion,
    inverse_from_record,
    no_slip_travel,
    select,
)
from wlr_gym.base.errors import InputError
from wlr_gym.physics.plants import make_plant
from wlr_gym.physics.plants.base import Capabilities, PlantOptions
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()
SIMULATORS = ("gibbs_appell", "mujoco")


def with_drag():
    """A nominal robot, and one with gear drag of 0.1 N m in both rear wheels."""
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["servo.coulomb_friction"][1, 6:] = 0.10
    return parameters


@pytest.fixture(scope="module")
def pairs():
    """Both tests with both robots on every model."""
    return {model: drive_both(model, ROBOT, with_drag()) for model in SIMULATORS}


@pytest.fixture(scope="module")
def records(pairs):
    """The nominal robots."""
    return {model: {name: select(own, np.array([0])) for name, own in tests.items()} for model, tests in pairs.items()}


@pytest.mark.slow
def test_models_agree_within_the_bounds_of_the_plants(records):
    """2 % of the travel, 2 degrees of yaw, 5 % of the torques (docs/compare.md); in fact ten times better."""
    for model, tests in report.agreement(records).items():
        for name, found in tests.items():
            assert found["position"] < 0.002, (model, name)
            assert found["yaw_degrees"] < 0.01, (model, name)
            assert found["leg_torque"] < 0.03, (model, name)
            assert found["wheel_torque"] < 0.03, (model, name)


@pytest.mark.parametrize("name", TESTS)
def test_nothing_slips_on_rigid_coulomb_friction(records, name):
    for model, tests in records.items():
        record = tests[name]
        assert abs(float(error_of_ignoring_slip(ROBOT, record)[0])) < 1e-3, model
        assert np.abs(record.slip_path).max() < 1e-4, model
        assert abs(record.end[0, 1]) < 1e-5, model


@pytest.mark.parametrize("name", TESTS)
def test_loads_are_16_and_17(records, name):
    """Away from leg starts and with the loads of a robot whose legs give a little."""
    ideal = ideal_motion(TESTS[name], reduced.constants_of(Parameters.nominal(ROBOT)))
    forces = ideal.inverse_dynamics()
    for model, tests in records.items():
        record = tests[name]
        normal = record.force[:, 0, :, 2]
        expected = np.stack([np.interp(record.time, ideal.time, forces.normal[:, k].ravel()) for k in range(4)], axis=1)
        calm = (record.time > 0.5) & (np.abs(record.time - 5.9) > 0.4)
        assert np.abs(normal - expected)[calm].max() < 0.45, model


def test_prediction_of_3_as_printed_is_seven_centimetres_short_in_the_second_test(records):
    for name, apart in (("test_1", 0.0), ("test_2", 0.0712)):
        record = records["gibbs_appell"][name]
        gap = no_slip_travel(ROBOT, record, True)[-1, 0] - no_slip_travel(ROBOT, record, False)[-1, 0]
        assert gap == pytest.approx(apart, abs=3e-3)


def test_inverse_dynamics_of_a_measured_motion_gives_its_torques():
    """Gears without friction: what the motors did is what the motion says; the printed equations say nothing."""
    parameters = Parameters.nominal(ROBOT)
    parameters["servo.coulomb_friction"] = 0.0
    record = drive("gibbs_appell", TESTS["test_1"], ROBOT, parameters)
    found = inverse_from_record(ROBOT, record, rear_drag=0.0)
    calm = (record.time > 0.3) & (np.abs(record.time - 5.9) > 0.3)
    legs = record.torque[calm][:, 0, [0, 2]]
    error = found.right.leg_torque[calm] / 2 - legs
    assert np.sqrt(np.mean(error**2) / np.mean(legs**2)) < 0.01
    assert np.abs(found.right.wheel_torque[calm][:, :2] - record.torque[calm][:, 0, 4:6]).max() < 2e-3
    assert np.abs(found.leg_torque_printed[calm]).max() < 0.01 * np.abs(legs).max()


def test_models_slip_alike(pairs):
    """Rear wheels that stick while the rear legs swing back push the body on: negative error, in every model."""
    error = {model: float(error_of_ignoring_slip(ROBOT, tests["test_1"])[1]) for model, tests in pairs.items()}
    assert error["gibbs_appell"] < -0.08
    assert error["mujoco"] == pytest.approx(error["gibbs_appell"], abs=0.005)
    ends = {model: float(tests["test_1"].end[1, 0]) for model, tests in pairs.items()}
    assert max(ends.values()) - min(ends.values()) < 0.02 * ends["gibbs_appell"]


class Blind:
    """A plant that shows its sensors only, like a robot."""

    def __init__(self, plant, has_camera=True):
        self.has_camera = has_camera
        self._plant, self.robot, self.options, self.parameters = plant, plant.robot, plant.options, plant.parameters
        self.capabilities = Capabilities("blind", has_truth=False, can_set_state=False, real_time=False)
        self.count = plant.count

    def reset(self, seeds=None, parameters=None, mask=None, state=None):
        assert parameters is None  # nothing can be set about a robot
        readings = self._plant.reset(seeds=seeds, state=state)
        readings.camera_is_new[:] = 0.0
        return readings

    def step(self, setpoints, torque_on=None):
        readings = self._plant.step(setpoints, torque_on)
        if not self.has_camera:
            readings.camera_is_new[:] = 0.0
        return readings


@pytest.mark.parametrize("has_camera", [True, False])
def test_a_robot_without_truth_shows_what_it_can_measure(has_camera):
    plant = make_plant("gibbs_appell", ROBOT, 1, PlantOptions(PERIOD))
    blind = Blind(plant, has_camera)
    record = drive_plant(blind, TESTS["test_2"], Parameters.nominal(ROBOT), every=10)  # type: ignore[arg-type]
    plant.close()
    assert np.isnan(record.slip).all()
    assert np.isnan(record.force).all()
    assert np.isfinite(record.joint_position).all()
    assert np.isfinite(record.torque).all()
    assert (record.end[0, 0] > 0.5) if has_camera else np.isnan(record.end).all()


def test_bad_input_is_named():
    with pytest.raises(InputError, match="unknown backend 'mujocco'"):
        drive("mujocco", TESTS["test_1"], ROBOT)


def test_rear_wheels_can_be_driven_for_comparison():
    setpoints = replace(TESTS["test_1"], rear_driven=True).motion().setpoints
    assert np.isfinite(setpoints).all()
    np.testing.assert_array_equal(setpoints[:, 4:6], setpoints[:, 6:])
