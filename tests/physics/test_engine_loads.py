"""Wheel loads at rest against statics and against the paper's normal forces (16), (17)."""

import numpy as np
import pytest
from rig import BODY_MASS, LEG_COM, LEG_MASS, ROBOT, WEIGHT, WHEEL_MASS, G, contact_force, drive, lock, make_plant

HALF_LENGTH, HALF_WIDTH, LENGTH, RADIUS = (
    ROBOT.hip_position.x,
    ROBOT.hip_position.y,
    ROBOT.leg.length,
    ROBOT.wheel.radius,
)
WHEEL_X = HALF_LENGTH * np.array([1.0, 1.0, -1.0, -1.0])
WHEEL_Y = HALF_WIDTH * np.array([1.0, -1.0, 1.0, -1.0])


def settle(count, edit, place=None):
    """Locked robots on hard tyres, so that their tilt does not move the centre of mass; loads (N, 4) after 2 s."""

    def hard(parameters):
        lock(parameters)
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 1.0
        parameters["ground.normal_stiffness"], parameters["ground.normal_damping"] = 1e5, 300.0
        edit(parameters)

    plant = make_plant(count, hard, place, step=2.5e-4)
    return contact_force(drive(plant, 2.0))[:, :, 2]


def static_loads(weight, x, y, height, slope):
    """Loads of four equal springs at the wheels' corners that balance a weight at (x, y, height) on an inclined floor."""
    uphill = np.sin(slope)
    normal = weight * np.sqrt(1.0 - (uphill**2).sum())
    mean = normal / 4
    pitch = (normal * x - weight * uphill[0] * height) / (4 * HALF_LENGTH**2)
    roll = (normal * y - weight * uphill[1] * height) / (4 * HALF_WIDTH**2)
    return mean + pitch * WHEEL_X + roll * WHEEL_Y


LEVEL = LENGTH + RADIUS
LIMBS = 4 * (LEG_MASS * (LENGTH - LEG_COM + RADIUS) + WHEEL_MASS * RADIUS)
#: payload mass, payload position, centre-of-mass offset of the body, slope
CASES = [
    (0.0, (0, 0, 0), (0, 0, 0), (0, 0)),
    (1.0, (0.1, 0.05, 0.04), (0, 0, 0), (0, 0)),
    (0.0, (0, 0, 0), (0.03, -0.02, 0.01), (0, 0)),
    (0.0, (0, 0, 0), (0, 0, 0), (0.3, 0.0)),
    (0.0, (0, 0, 0), (0, 0, 0), (0.0, -0.3)),
    (0.8, (-0.1, 0.1, 0.02), (0.02, 0.01, -0.01), (-0.2, 0.15)),
]


def test_wheel_loads_are_those_of_statics():
    def edit(parameters):
        for robot, (mass, position, offset, slope) in enumerate(CASES):
            parameters["payload.mass"][robot], parameters["payload.position"][robot] = mass, position
            parameters["body.com_offset"][robot], parameters["ground.slope"][robot] = offset, slope

    loads = settle(len(CASES), edit)
    for load, (mass, position, offset, slope) in zip(loads, CASES, strict=True):
        weight = WEIGHT + mass * G
        moment = BODY_MASS * np.array(offset) + mass * np.array(position)
        height = (BODY_MASS + mass) * LEVEL + moment[2] + LIMBS
        center = np.array([moment[0], moment[1], height]) * G / weight
        expected = static_loads(weight, center[0], center[1], center[2], np.array(slope))
        np.testing.assert_allclose(load, expected, atol=2e-3 * weight / 4)
        np.testing.assert_allclose(load.sum(), expected.sum(), rtol=1e-6)


@pytest.mark.parametrize("step", [2.5e-4, 1e-3, 2e-3, 4e-3])
def test_loads_of_the_nominal_robot_sum_to_its_weight(step):
    plant = make_plant(2, step=step)
    np.testing.assert_allclose(contact_force(drive(plant, 1.0))[:, :, 2].sum(axis=1), WEIGHT, rtol=1e-9)


def posture(front, rear):
    """Pitch psi (nose down) and height of the body when all four wheels touch; audit of the paper, section 1."""
    pitch = np.arctan2(LENGTH * (np.sin(rear) - np.sin(front)), 2 * HALF_LENGTH + LENGTH * (np.cos(front) - np.cos(rear)))
    return pitch, RADIUS + LENGTH / 2 * (np.sin(front + pitch) + np.sin(rear + pitch))


def paper_normal_forces(front, rear):
    """Equations (16) and (17) per wheel, with the wheels' mass added and the leg's centre of mass at the fraction c."""
    pitch, _ = posture(front, rear)
    f, r = np.cos(front + pitch), np.cos(rear + pitch)
    track = 2 * HALF_LENGTH * np.cos(pitch)
    c = LEG_COM / LENGTH
    body, leg, wheel = BODY_MASS * G, LEG_MASS * G, WHEEL_MASS * G
    base = track + LENGTH * (f - r)
    front_force = body / 2 * (track / 2 - LENGTH * r) + leg * (track + c * LENGTH * f - (2 - c) * LENGTH * r)
    rear_force = body / 2 * (track / 2 + LENGTH * f) + leg * (track + (2 - c) * LENGTH * f - c * LENGTH * r)
    return front_force / base + wheel, rear_force / base + wheel


def test_normal_forces_of_the_paper():
    """Symmetric postures, among them the start, middle and end of both of its experiments."""
    degrees = np.array([(30, 30), (30, 90), (30, 150), (90, 90), (150, 30), (120, 60), (60, 40), (75, 110)], dtype=float)
    front, rear = np.radians(degrees).T
    pitch, height = posture(front, rear)

    def place(state):
        state.position[:, 2] = height
        state.quaternion[:] = np.column_stack([np.cos(pitch / 2), 0 * pitch, np.sin(pitch / 2), 0 * pitch])
        state.joint_position[:, :4] = np.column_stack([front, front, rear, rear])

    loads = settle(len(degrees), lambda parameters: None, place)
    expected = np.column_stack(paper_normal_forces(front, rear))
    np.testing.assert_allclose(loads[:, 0], loads[:, 1], rtol=1e-5)
    np.testing.assert_allclose(loads[:, 2], loads[:, 3], rtol=1e-5)
    np.testing.assert_allclose(loads[:, [0, 2]], expected, rtol=1e-3)
    np.testing.assert_allclose(expected.sum(axis=1), WEIGHT / 2, rtol=1e-12)


def test_hip_torque_at_rest_is_the_papers_static_torque():
    """tau = l cos(alpha + psi) (N - c m_l g - m_w g) per leg, carried by the motors where gears are free of friction."""
    front, rear = np.radians([50.0, 60.0]), np.radians([130.0, 120.0])

    def edit(parameters):
        parameters["servo.coulomb_friction"] = 0.0
        parameters["servo.kp"][:, :4] = 1500.0

    def place(state):
        state.position[:, 2] = posture(front, rear)[1]
        state.joint_position[:, :4] = np.column_stack([front, front, rear, rear])
        state.reference_position[:] = state.joint_position

    plant = make_plant(2, edit, place, step=2.5e-4)
    setpoints = np.column_stack([front, front, rear, rear, np.zeros((2, 4))])
    truth = drive(plant, 2.0, setpoints)
    force = contact_force(truth)
    angle = truth.joint_position[:, :4]
    arm = LENGTH * np.cos(angle)
    weight = (LEG_COM / LENGTH * LEG_MASS + WHEEL_MASS) * G
    traction = (LENGTH * np.sin(angle) + RADIUS) * force[:, :, 0]
    wheel_torque = truth.motor_torque[:, 4:]
    expected = arm * (force[:, :, 2] - weight) + traction
    np.testing.assert_allclose(truth.motor_torque[:, :4], expected, atol=2e-3)
    np.testing.assert_allclose(wheel_torque, RADIUS * force[:, :, 0], atol=1e-4)
