"""The numpy reference against what it cannot share a mistake with: the paper's model in closed form; gravity by hand."""

import numpy as np
import pytest

from studies.paper import reduced
from wlr_gym.base.errors import InputError
from wlr_gym.physics.model import dynamics, equations
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters


def symmetric_robots(count, seed):
    """Pairwise equal legs without payload and offset, as the paper assumes; dimensions and masses at random."""
    rng = np.random.default_rng(seed)
    parameters = Parameters.nominal(load_robot(), count)
    scale = rng.uniform(0.5, 2.0, (count, len(parameters.values[0])))
    for name in ("body.mass", "body.inertia", "hip.position", "leg.length", "leg.mass", "leg.com_along_leg", "leg.inertia",
                 "wheel.radius", "wheel.mass", "wheel.spin_inertia", "wheel.transverse_inertia", "servo.armature"):  # fmt: skip
        view = parameters[name]
        factor = scale[:, : np.size(view[0])].reshape(view.shape)
        view *= factor
        if name == "leg.inertia":
            view[:] = np.tile(view[:, :3], 4)
        elif name == "servo.armature":
            view[:] = np.repeat(view[:, [0, 4]], 4, axis=1)
        elif name.startswith(("leg.", "wheel.")):
            view[:] = view[:, :1]
    return parameters


def test_reduced_model_of_the_paper_is_the_projection_of_the_full_one():
    """Legs pairwise equal, roll rate 0: u14 = B u11, so M11 = B'M B and h11 = B'(M Bdot u11 + h), gravity and w x v in a0.

    Its statics are the paper's normal forces (16), (17): studies/tests/paper.
    """
    count = 100
    parameters = symmetric_robots(count, seed=6)
    parameters["hip.position"][:, 2] = 0.0
    rng = np.random.default_rng(7)
    pitch, front, rear = rng.uniform([[-0.6], [0.4], [0.4]], [[0.6], [2.7], [2.7]], (3, count))
    joints = np.column_stack([front, front, rear, rear, np.zeros((count, 4))])
    u = rng.normal(size=(count, 11))
    sin, cos, rate, yaw_rate = np.sin(pitch), np.cos(pitch), u[:, 4], u[:, 2]
    b, b_dot = np.zeros((2, count, 14, 11))
    # Body axes are the yaw frame turned by pitch about y.
    for rows, (forward, up) in (((0, 2), (0, 3)), ((3, 5), (None, 2))):
        x, z = rows
        b[:, x, up], b[:, z, up] = -sin, cos
        b_dot[:, x, up], b_dot[:, z, up] = -cos * rate, -sin * rate
        if forward is not None:
            b[:, x, forward], b[:, z, forward] = cos, sin
            b_dot[:, x, forward], b_dot[:, z, forward] = -sin * rate, cos * rate
    b[:, 1, 1] = b[:, 4, 4] = 1.0
    for corner, leg in enumerate((5, 5, 6, 6)):
        b[:, 6 + corner, [4, leg]] = 1.0
        b[:, 10 + corner, [4, leg, 7 + corner]] = 1.0
    u14 = np.einsum("nij,nj->ni", b, u)
    v, w, leg_rate, wheel_rate = np.split(u14, [3, 6, 10], axis=1)
    np.testing.assert_allclose(w[:, 0], -sin * yaw_rate)
    mass_matrix, bias = dynamics.mass_matrix_and_bias(parameters, joints, w, leg_rate, wheel_rate)
    extra = np.einsum("nij,nj->ni", b_dot, u)
    g = parameters["gravity"]
    extra[:, :3] += np.cross(w, v) - np.column_stack([g * sin, np.zeros(count), -g * cos])
    projected_mass = np.einsum("nki,nkl,nlj->nij", b, mass_matrix, b)
    projected_bias = np.einsum("nki,nk->ni", b, np.einsum("nkl,nl->nk", mass_matrix, extra) + bias)
    constants = reduced.constants_of(parameters)
    expected_mass, expected_bias = reduced.mass_matrix_and_bias(constants, front, rear, pitch, u)
    np.testing.assert_allclose(projected_mass, expected_mass, atol=1e-10 * np.abs(expected_mass).max())
    np.testing.assert_allclose(projected_bias, expected_bias, atol=1e-10 * np.abs(expected_bias).max())


def test_generated_code_takes_floats_and_arrays_alike():
    arguments = np.random.default_rng(1).normal(size=(20, 5))
    batched = equations.assembly_terms(*list(arguments))
    single = equations.assembly_terms(*arguments[:, 3].tolist())
    assert isinstance(single[6], float)
    assert batched[0].keys() == single[0].keys()
    for key, value in single[0].items():
        assert np.broadcast_to(batched[0][key], 5)[3] == value
    for row, value in single[1].items():
        assert batched[1][row][3] == value
    assert batched[6][3] == single[6]


def test_gravity_leans_against_a_climbing_floor():
    parameters = Parameters.nominal(load_robot(), 3)
    parameters["ground.slope"] = [[0.0, 0.0], [0.2, 0.0], [0.0, -0.3]]
    gravity = dynamics.gravity_in_floor(parameters)
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 9.81)
    expected = 9.81 * np.array([[0, 0, -1], [-np.sin(0.2), 0, -np.cos(0.2)], [0, np.sin(0.3), -np.cos(0.3)]])
    np.testing.assert_allclose(gravity, expected, atol=1e-12)


def test_a_floor_no_plane_can_be_is_refused():
    parameters = Parameters.nominal(load_robot(), 2)
    parameters["ground.slope"][1] = 1.2
    with pytest.raises(InputError, match="robot 1"):
        dynamics.gravity_in_floor(parameters)
