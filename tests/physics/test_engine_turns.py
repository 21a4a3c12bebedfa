"""Skid turns, mirrored robots and unequal wheels."""

import numpy as np
from rig import HOME, LEGS_DOWN, MIRROR, RADIUS, ROBOT, drive, make_plant

LEFT, RIGHT = [4, 6], [5, 7]


def skid(left, right):
    setpoints = HOME.copy()
    setpoints[LEFT], setpoints[RIGHT] = left, right
    return setpoints


def heading(truth):
    w, x, y, z = truth.quaternion.T
    return np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def test_skid_turns_turn_towards_the_slower_side():
    """Left back and right forth is a left turn; forwards it bends to the slower side; straight stays straight."""
    setpoints = np.array([skid(-4, 4), skid(4, -4), skid(2, 5), skid(5, 2), skid(4, 4), skid(-4, -4)], dtype=float)
    truth = drive(make_plant(6), 3.0, setpoints)
    rate, speed = truth.angular_velocity_in_body[:, 2], truth.linear_velocity_in_body[:, 0]
    assert (np.sign(rate[:4]) == [1, -1, 1, -1]).all()
    np.testing.assert_allclose(rate[[1, 3]], -rate[[0, 2]], rtol=1e-8)
    assert np.abs(rate[4:]).max() < 1e-8
    assert np.abs(truth.position[4:, 1]).max() < 1e-8
    # a skid turn yaws slower than its wheels would without slip
    ideal = RADIUS * 8 / (2 * ROBOT.hip_position.y)
    assert 0.2 * ideal < rate[0] < 0.9 * ideal
    assert np.linalg.norm(truth.position[:2, :2], axis=1).max() < 1e-3
    np.testing.assert_allclose(speed[4:], [4 * RADIUS, -4 * RADIUS], rtol=1e-3)


def test_mirrored_commands_give_mirrored_motion():
    """Eight random drives of 5 s and their mirror images, legs and wheels independent of each other."""
    rng = np.random.default_rng(0)
    plant = make_plant(16)
    for _ in range(10):
        setpoints = np.hstack([rng.uniform(1.0, 2.0, (8, 4)), rng.uniform(-5.0, 5.0, (8, 4))])
        drive(plant, 0.5, np.vstack([setpoints, setpoints[:, MIRROR]]))
    truth = plant.truth()
    assert np.linalg.norm(truth.position[:, :2], axis=1).min() > 1e-3
    position, joints = truth.position, truth.joint_position
    error = np.abs(position[8:] * [1, -1, 1] - position[:8]).max()
    assert error < 1e-9
    assert np.abs(joints[8:, MIRROR] - joints[:8]).max() < 1e-9
    np.testing.assert_allclose(truth.quaternion[8:] * [1, -1, 1, -1], truth.quaternion[:8], atol=1e-9)


def test_robot_turns_towards_its_smaller_wheels():
    """Smaller wheels on the right: a right turn (yaw < 0); mirrored on the left; equal wheels go straight."""

    def edit(parameters):
        parameters["wheel.radius"][0, [1, 3]] = 0.97 * RADIUS
        parameters["wheel.radius"][1, [0, 2]] = 0.97 * RADIUS

    truth = drive(make_plant(3, edit), 4.0, np.concatenate([LEGS_DOWN, np.full(4, 5.0)]))
    yaw = heading(truth)
    assert yaw[0] < -1e-3
    assert yaw[1] > 1e-3
    assert abs(yaw[2]) < 1e-9
    np.testing.assert_allclose(yaw[1], -yaw[0], rtol=1e-6)
