"""The parameter table: complete, documented, bounded; its views write; its errors name."""

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.robot import JOINTS, LEGS, WHEELS, load_robot
from wlr_gym.robot.parameter_table import ELEMENTS, SPECS, TABLE, spec_of
from wlr_gym.robot.parameters import Parameters

ROBOT = load_robot()


@pytest.fixture
def parameters():
    return Parameters.nominal(ROBOT, 3)


@pytest.mark.parametrize("spec", TABLE, ids=lambda spec: spec.name)
def test_every_row_is_complete(spec):
    assert spec.doc
    assert spec.unit
    assert spec.low < spec.high
    values = np.ravel(np.asarray(spec.nominal(ROBOT), float))
    assert values.shape == (spec.size,)
    assert np.isfinite(values).all()
    assert (spec.low <= values).all()
    assert (values <= spec.high).all()
    assert len(set(spec.elements)) == spec.size


def test_names_are_unique_and_elements_are_in_table_order():
    assert len(SPECS) == len(TABLE)
    assert len(set(ELEMENTS)) == len(ELEMENTS)
    assert list(ELEMENTS) == [element for spec in TABLE for element in spec.elements]
    assert "wheel.radius[wheel_lf]" in ELEMENTS
    assert "gravity" in ELEMENTS
    assert SPECS["servo.kp"].labels == JOINTS
    assert SPECS["leg.mass"].labels == LEGS
    assert SPECS["ground.mu_x"].labels == WHEELS


def test_every_tolerance_is_one_of_the_robot_files():
    named = {spec.tolerance for spec in TABLE if spec.tolerance}
    assert named == set(load_robot("emanual").tolerances)
    assert named - set(ROBOT.tolerances) == {"servo.integral_cycle"}  # which nobody thought of when nominal was written


def test_nominal_values_come_from_the_robot(parameters):
    assert parameters["body.mass"].tolist() == [2.8] * 3
    assert parameters["servo.kp"].tolist() == [[55.24] * 4 + [8.63] * 4] * 3
    assert parameters["servo.stall_torque[wheel_rr]"].tolist() == [1.5] * 3
    assert parameters["leg.inertia[leg_lr,x]"].tolist() == [1.2e-4] * 3
    assert parameters["command.delay"].shape == (3, 8)
    assert len(parameters) == 3
    assert list(parameters) == [spec.name for spec in TABLE]


def test_views_write_through(parameters):
    parameters["wheel.radius[wheel_rf]"][1] = 0.04
    assert parameters["wheel.radius"][1].tolist() == [0.034, 0.04, 0.034, 0.034]
    parameters["body.mass"][2] = 3.1
    assert parameters.values[2, ELEMENTS.index("body.mass")] == 3.1
    parameters["ground.mu_x"] = [0.1, 0.2, 0.3, 0.4]
    assert parameters["ground.mu_x[wheel_rr]"].tolist() == [0.4] * 3
    parameters["gravity"] = 1.62
    assert parameters["gravity"].tolist() == [1.62] * 3


def test_copies_are_independent(parameters):
    other = parameters.copy()
    other["gravity"] = 0.0
    assert parameters["gravity"].tolist() == [9.81] * 3


def test_nominal_is_valid(parameters):
    parameters.validate()


@pytest.mark.parametrize("value", [-0.01, 5.01, np.nan, np.inf])
def test_values_out_of_bounds_are_named(parameters, value):
    parameters["ground.mu_y[wheel_lr]"][1] = value
    with pytest.raises(InputError, match=r"ground.mu_y\[wheel_lr\] = .* \(robot 1 of the batch\) is outside \[0, 5\]"):
        parameters.validate()


@pytest.mark.parametrize("spec", TABLE, ids=lambda spec: spec.name)
def test_bounds_are_inclusive_and_enforced(spec):
    for bound, beyond in ((spec.low, -1), (spec.high, 1)):
        parameters = Parameters.nominal(ROBOT)
        parameters[spec.elements[-1]] = bound
        if spec.name != "payload.inertia":  # no masses have a single product of inertia
            parameters.validate()
        parameters[spec.elements[-1]] = np.nextafter(bound, beyond * np.inf)
        with pytest.raises(InputError, match="outside"):
            parameters.validate()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wheel.radios", r"unknown parameter 'wheel.radios' \(did you mean 'wheel.radius'\?\)"),
        ("wheel.radius[wheel_fl]", r"unknown element of parameter 'wheel.radius' 'wheel_fl'.*valid: wheel_lf, wheel_lr"),
        ("wheel.radius[leg_lf]", "unknown element of parameter 'wheel.radius' 'leg_lf'"),
        ("wheel.radius[wheel_lf", "unknown"),
        ("gravity[x]", r"unknown parameter 'gravity\[x\]' \(did you mean 'gravity'\?\)"),
        ("", "unknown parameter ''"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(parameters, name, message):
    with pytest.raises(InputError, match=message):
        parameters[name]
    with pytest.raises(InputError, match=message):
        parameters[name] = 1.0
    with pytest.raises(InputError, match=message):
        spec_of(name)


def test_spec_of_an_element():
    assert spec_of("wheel.radius[wheel_lf]") is SPECS["wheel.radius"]
    assert spec_of("gravity").unit == "m/s2"


@pytest.mark.parametrize("value", [[1.0, 2.0], np.zeros((3, 5)), "heavy", [[1.0], [2.0, 3.0]]])
def test_values_of_the_wrong_shape_or_kind_are_refused(parameters, value):
    with pytest.raises(InputError, match=r"parameter 'wheel\.radius' takes numbers of shape \(3, 4\)"):
        parameters["wheel.radius"] = value


def test_a_matrix_of_the_wrong_shape_is_refused():
    with pytest.raises(InputError, match=r"parameter matrix has shape \(2, 3\), expected \(N, "):
        Parameters(np.zeros((2, 3)))


@pytest.mark.parametrize("inertia", [(0, 0, 0, 0.1, 0, 0), (-0.02, 0, 0, 0, 0, 0), (0.1, 0.1, 0.3, 0, 0, 0)])
def test_payload_inertia_is_one_that_masses_have(inertia):
    parameters = Parameters.nominal(ROBOT, 2)
    parameters["payload.inertia"][0] = 0.0, 0.01, 0.01, 0.0, 0.0, 0.0  # two point masses on a line
    parameters.validate()
    parameters["payload.inertia"][1] = inertia
    with pytest.raises(InputError, match=r"payload.inertia \(robot 1 of the batch\)"):
        parameters.validate()
