"""The numpy reference against what it cannot share a mistake with: statics by hand, the paper's model, free flight."""

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.physics.model import dynamics, equations
from wlr_gym.robot import load_robot
from wlr_gym.robot.parameters import Parameters

LF, RF, LR, RR = range(4)


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


def symmetric_angles(count, seed):
    """Front and rear leg angle (N,) each, and the joint positions (N, 8)."""
    rng = np.random.default_rng(seed)
    front, rear = rng.uniform(0.4, 2.7, (2, count))
    joints = np.zeros((count, 8))
    joints[:, [LF, RF]], joints[:, [LR, RR]] = front[:, None], rear[:, None]
    return front, rear, joints


def posture(parameters, front, rear):
    """Body pitch psi (nose down positive) with all wheels on a level floor, and the wheelbase (paper audit, section 1)."""
    length, base = parameters["leg.length"][:, 0], 2 * parameters["hip.position"][:, 0]
    pitch = np.arctan2(length * (np.sin(rear) - np.sin(front)), base + length * (np.cos(front) - np.cos(rear)))
    f, r = front + pitch, rear + pitch
    return pitch, f, r, base * np.cos(pitch) + length * (np.cos(f) - np.cos(r))


def gravity_forces(parameters, pitch, joints):
    """What gravity does to the generalised forces (N, 14) at rest: minus the bias, with a0 = -gravity."""
    count = len(parameters)
    zeros = np.zeros((count, 3))
    mass_matrix, bias = dynamics.mass_matrix_and_bias(parameters, joints, zeros, np.zeros((count, 4)), np.zeros((count, 4)))
    np.testing.assert_array_equal(bias, 0.0)
    g = parameters["gravity"]
    gravity_in_body = np.column_stack([g * np.sin(pitch), np.zeros(count), -g * np.cos(pitch)])
    return np.einsum("nij,nj->ni", mass_matrix[:, :, :3], gravity_in_body)


def wheel_loads(parameters, pitch, f, r, joints):
    """Load (N, 2) of one front and one rear wheel at rest: balance of vertical force and of moment about the body origin."""
    gravity = gravity_forces(parameters, pitch, joints)
    vertical = -np.sin(pitch) * gravity[:, 0] + np.cos(pitch) * gravity[:, 2]
    moment = gravity[:, 4] + gravity[:, 6:10].sum(axis=1)  # in absolute rates the legs' share stands in their own rows
    length, half = parameters["leg.length"][:, 0], parameters["hip.position"][:, 0]
    ahead = np.cos(pitch)[:, None] * half[:, None] * [1, -1] + length[:, None] * np.cos(np.column_stack([f, r]))
    # An upward force ahead of the origin lifts the nose: moment -ahead * N about +y.
    balance = np.stack([np.full_like(ahead, 2.0), -2 * ahead], axis=1)
    return np.linalg.solve(balance, -np.column_stack([vertical, moment])[:, :, None])[:, :, 0]


def test_statics_give_the_papers_normal_forces():
    """Paper equations (16), (17) as printed: leg mass at mid-leg; the wheels, massless in the paper, add their own weight."""
    count = 200
    parameters = symmetric_robots(count, seed=2)
    parameters["leg.com_along_leg"] = parameters["leg.length"] / 2
    front, rear, joints = symmetric_angles(count, seed=3)
    pitch, f, r, wheelbase = posture(parameters, front, rear)
    g, body, leg = parameters["gravity"], parameters["body.mass"], parameters["leg.mass"][:, 0]
    length, hips = parameters["leg.length"][:, 0], 2 * parameters["hip.position"][:, 0] * np.cos(pitch)
    cos_f, cos_r = length * np.cos(f), length * np.cos(r)
    eq16 = (body * g / 2 * (hips / 2 - cos_r) + leg * g * (hips + cos_f / 2 - 3 / 2 * cos_r)) / wheelbase
    eq17 = (body * g / 2 * (hips / 2 + cos_f) + leg * g * (hips + 3 / 2 * cos_f - cos_r / 2)) / wheelbase
    expected = np.column_stack([eq16, eq17]) + (parameters["wheel.mass"][:, 0] * g)[:, None]
    np.testing.assert_allclose(wheel_loads(parameters, pitch, f, r, joints), expected, rtol=1e-10)


def test_paper_experiment_one_loads_the_front_wheels_with_a_sixth_of_the_weight():
    """Audit, section 5: all legs at 30 degrees leave 2.606 N in front, 12.109 N behind (0.05 kg mid-leg, massless wheels)."""
    parameters = Parameters.nominal(load_robot(), 1)
    parameters["leg.mass"], parameters["wheel.mass"] = 0.05, 0.0
    joints = np.zeros((1, 8))
    joints[:, :4] = angle = np.deg2rad(30)
    loads = wheel_loads(parameters, np.zeros(1), np.array([angle]), np.array([angle]), joints)
    np.testing.assert_allclose(loads, [[2.606, 12.109]], atol=1e-3)


def test_static_hip_torque_balances_leg_and_ground():
    """Audit, section 4a: both front hips together hold 2 l cos f (N_f - lambda m_l g - m_w g)."""
    count = 50
    parameters = symmetric_robots(count, seed=4)
    front, rear, joints = symmetric_angles(count, seed=5)
    pitch, f, _, _ = posture(parameters, front, rear)
    gravity = gravity_forces(parameters, pitch, joints)
    g, ratio = parameters["gravity"], parameters["leg.com_along_leg"][:, 0] / parameters["leg.length"][:, 0]
    weight = (ratio * parameters["leg.mass"][:, 0] + parameters["wheel.mass"][:, 0]) * g
    np.testing.assert_allclose(gravity[:, 6], parameters["leg.length"][:, 0] * np.cos(f) * weight, rtol=1e-11)


def reduced_model(parameters, front, rear, pitch, u):
    """Closed forms of the paper's reduced model (audit 4a): M (11, 11) and bias (11,) per robot, gravity included.

    u = vx vy w | vz psi' | alpha' beta' | p_rf' p_lf' p_rr' p_lr', yaw frame.
    """
    vx, vy, w, _, pitch_rate, front_rate, rear_rate = u.T[:7]
    g, body = parameters["gravity"], parameters["body.mass"]
    leg, wheel = parameters["leg.mass"][:, 0], parameters["wheel.mass"][:, 0]
    length, com = parameters["leg.length"][:, 0], parameters["leg.com_along_leg"][:, 0]
    lx, ly = 2 * parameters["hip.position"][:, 0], 2 * parameters["hip.position"][:, 1]
    leg_x, leg_y, leg_z = parameters["leg.inertia"][:, :3].T  # straight down: across, about the pitch axis, along
    body_x, body_y, body_z = parameters["body.inertia"].T
    spin, transverse = parameters["wheel.spin_inertia"][:, 0], parameters["wheel.transverse_inertia"][:, 0]
    hip_rotor, wheel_rotor = parameters["servo.armature"][:, 0], parameters["servo.armature"][:, 4]
    mb, k1, k2 = leg + wheel, leg * com + wheel * length, leg * com**2 + wheel * length**2
    total, jl = body + 4 * mb, leg_y + k2
    f, r, sin, cos = front + pitch, rear + pitch, np.sin, np.cos
    fr, rr = front_rate + pitch_rate, rear_rate + pitch_rate
    # The audit's leg angle counts from forward, so its I_1 is the inertia about the leg's own axis.
    along, normal = leg_z, leg_x
    dl, db = along - normal, body_x - body_z
    s2 = mb * lx**2 / 2 * cos(pitch) ** 2 + k1 * lx * cos(pitch) * (cos(f) - cos(r)) + k2 * (cos(f) ** 2 + cos(r) ** 2)
    s2_rate = (
        -mb * lx**2 / 2 * sin(2 * pitch) * pitch_rate
        - k1 * lx * sin(pitch) * pitch_rate * (cos(f) - cos(r))
        + k1 * lx * cos(pitch) * (-sin(f) * fr + sin(r) * rr)
        - k2 * (sin(2 * f) * fr + sin(2 * r) * rr)
    )
    leg_yaw = sum(along * sin(x) ** 2 + normal * cos(x) ** 2 for x in (f, r))
    body_yaw = body_x * sin(pitch) ** 2 + body_z * cos(pitch) ** 2
    zero = np.zeros_like(f)
    m = np.zeros((len(f), 11, 11))
    entries = {
        (0, 0): total, (1, 1): total, (3, 3): total,
        (0, 4): -2 * k1 * (sin(f) + sin(r)), (0, 5): -2 * k1 * sin(f), (0, 6): -2 * k1 * sin(r),
        (3, 4): -2 * k1 * (cos(f) + cos(r)), (3, 5): -2 * k1 * cos(f), (3, 6): -2 * k1 * cos(r),
        (1, 2): 2 * k1 * (cos(f) + cos(r)),
        (2, 2): body_yaw + 2 * (s2 + leg_yaw + 2 * transverse) + mb * ly**2,
        (4, 4): body_y + mb * lx**2 + 4 * (jl + spin) + 2 * k1 * lx * (cos(front) - cos(rear)),
        (4, 5): 2 * (jl + spin) + k1 * lx * cos(front), (4, 6): 2 * (jl + spin) - k1 * lx * cos(rear),
        (5, 5): 2 * (jl + spin + hip_rotor), (6, 6): 2 * (jl + spin + hip_rotor),
    }  # fmt: skip
    for wheel_row in range(7, 11):
        leg_row = 5 if wheel_row < 9 else 6
        entries |= {(4, wheel_row): spin, (leg_row, wheel_row): spin, (wheel_row, wheel_row): spin + wheel_rotor}
    for (row, column), value in entries.items():
        m[:, row, column] = m[:, column, row] = value
    h_front = 2 * (
        k1 * (lx / 2 * pitch_rate**2 * sin(front) + w * vy * sin(f) - g * cos(f))
        + w**2 * sin(f) * (k1 * lx / 2 * cos(pitch) + k2 * cos(f))
        - dl / 2 * w**2 * sin(2 * f)
    )
    h_rear = 2 * (
        k1 * (-lx / 2 * pitch_rate**2 * sin(rear) + w * vy * sin(r) - g * cos(r))
        + w**2 * sin(r) * (-k1 * lx / 2 * cos(pitch) + k2 * cos(r))
        - dl / 2 * w**2 * sin(2 * r)
    )
    h_pitch = (
        h_front + h_rear - k1 * lx * (fr**2 * sin(front) - rr**2 * sin(rear))
        + w**2 * lx * sin(pitch) * (mb * lx * cos(pitch) + k1 * (cos(f) - cos(r)))
        - db / 2 * w**2 * sin(2 * pitch)
    )  # fmt: skip
    h_yaw = w * (
        2 * k1 * vx * (cos(f) + cos(r)) + 2 * s2_rate + db * sin(2 * pitch) * pitch_rate
        + 2 * dl * (sin(2 * f) * fr + sin(2 * r) * rr)
    )  # fmt: skip
    h = np.column_stack([
        -2 * k1 * (fr**2 * cos(f) + rr**2 * cos(r)) - w * (total * vy + 2 * k1 * w * (cos(f) + cos(r))),
        w * total * vx - 4 * k1 * w * (sin(f) * fr + sin(r) * rr),
        h_yaw,
        2 * k1 * (fr**2 * sin(f) + rr**2 * sin(r)) + total * g,
        h_pitch, h_front, h_rear, zero, zero, zero, zero,
    ])  # fmt: skip
    return m, h


def test_reduced_model_of_the_paper_is_the_projection_of_the_full_one():
    """Legs pairwise equal, roll rate 0: u14 = B u11, so M11 = B'M B and h11 = B'(M Bdot u11 + h), gravity and w x v in a0."""
    count = 100
    parameters = symmetric_robots(count, seed=6)
    parameters["hip.position"][:, 2] = 0.0
    rng = np.random.default_rng(7)
    front, rear, joints = symmetric_angles(count, seed=8)
    pitch = rng.uniform(-0.6, 0.6, count)
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
    for corner, wheel in ((LF, 8), (RF, 7), (LR, 10), (RR, 9)):
        leg = 5 if corner in (LF, RF) else 6
        b[:, 6 + corner, [4, leg]] = 1.0
        b[:, 10 + corner, [4, leg, wheel]] = 1.0
    u14 = np.einsum("nij,nj->ni", b, u)
    v, w, leg_rate, wheel_rate = np.split(u14, [3, 6, 10], axis=1)
    np.testing.assert_allclose(w[:, 0], -sin * yaw_rate)
    mass_matrix, bias = dynamics.mass_matrix_and_bias(parameters, joints, w, leg_rate, wheel_rate)
    extra = np.einsum("nij,nj->ni", b_dot, u)
    g = parameters["gravity"]
    extra[:, :3] += np.cross(w, v) - np.column_stack([g * sin, np.zeros(count), -g * cos])
    projected_mass = np.einsum("nki,nkl,nlj->nij", b, mass_matrix, b)
    projected_bias = np.einsum("nki,nk->ni", b, np.einsum("nkl,nl->nk", mass_matrix, extra) + bias)
    expected_mass, expected_bias = reduced_model(parameters, front, rear, pitch, u)
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
