"""What closed-form mechanics says a robot can do, against the engine that does it."""

import math

import numpy as np
import pytest
from rig import HOME, ROBOT, contact_force, drive, lock, make_plant

from wlr_gym.base.settings import overlay
from wlr_gym.physics.feasibility import capability_of, hip_torque, stance_of
from wlr_gym.robot import Robot

CAN = capability_of(ROBOT)
LEFT, RIGHT, FRONT, REAR = [4, 6], [5, 7], [0, 1], [2, 3]
#: rad/s; the controllers give the whole supply.
FULL = 30.0


def changed(**changes):
    return Robot.model_validate(overlay(ROBOT.model_dump(), changes))


def test_loads_and_pitch_of_the_robot_at_rest():
    """Legs at unequal angles, centre of mass aside: the engine's four contact springs carry what the lever rule says."""
    offset = (0.03, 0.02, 0.04)
    robot = changed(body={"com_offset": offset})
    angles = np.array([[1.2, 1.9], [0.9, 0.9], [2.0, 1.0], [1.57, 0.8]])

    def edit(parameters):
        parameters["body.com_offset"] = offset

    setpoints = np.tile(HOME, (4, 1))
    setpoints[:, FRONT], setpoints[:, REAR] = angles[:, :1], angles[:, 1:]
    truth = drive(make_plant(4, edit), 3.0, setpoints)
    normal = contact_force(truth)[:, :, 2]
    for row in range(4):
        front, rear = truth.joint_position[row, FRONT].mean(), truth.joint_position[row, REAR].mean()
        stance = stance_of(robot, front, rear)
        share = normal[row] / normal[row].sum()
        assert share[:2].sum() == pytest.approx(stance.front_share, abs=0.01)
        assert share[[0, 2]].sum() == pytest.approx(stance.right / (stance.left + stance.right), abs=0.01)
        # four legs on a floor are one too many: gear friction keeps a little on one diagonal
        assert min(share) == pytest.approx(stance.smallest_wheel_share, abs=0.04)
        assert max(share) == pytest.approx(stance.largest_wheel_share, abs=0.04)
        w, _, y, _ = truth.quaternion[row]
        assert 2.0 * math.atan2(y, w) == pytest.approx(stance.pitch, abs=0.01)
        assert truth.body_clearance[row] == pytest.approx(stance.clearance, abs=3e-3)  # the contacts give way


def test_hip_torque_on_a_floor_without_friction():
    angles = np.array([0.5, 1.0, 2.3])

    def edit(parameters):
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 0.0
        parameters["servo.coulomb_friction"] = 0.0

    setpoints = np.tile(HOME, (3, 1))
    setpoints[:, :4] = angles[:, None]
    truth = drive(make_plant(3, edit), 3.0, setpoints)
    normal = contact_force(truth)[:, :, 2]
    for row in range(3):
        for leg in range(4):
            expected = hip_torque(ROBOT, truth.joint_position[row, leg], normal[row, leg])
            assert abs(truth.motor_torque[row, leg]) == pytest.approx(expected, rel=0.02)


def test_top_speed():
    truth = drive(make_plant(1), 3.0, np.concatenate([HOME[:4], np.full(4, FULL)]))
    assert truth.linear_velocity_in_body[0, 0] == pytest.approx(CAN.top_speed, rel=0.01)


@pytest.mark.parametrize(("mu_x", "mu_y"), [(0.6, 0.6), (0.3, 0.6), (0.8, 0.3)])
def test_fastest_turn_on_the_spot(mu_x, mu_y):
    def edit(parameters):
        parameters["ground.mu_x"], parameters["ground.mu_y"] = mu_x, mu_y

    setpoints = HOME.copy()
    setpoints[LEFT], setpoints[RIGHT] = -FULL, FULL
    truth = drive(make_plant(1, edit), 3.0, setpoints)
    expected = capability_of(changed(ground={"mu_x": mu_x, "mu_y": mu_y})).turning_rate
    assert truth.angular_velocity_in_body[0, 2] == pytest.approx(expected, rel=0.05)


def test_motors_that_are_just_too_weak_to_turn_do_not():
    """Stall torque 8 % below and above what the skid moment asks."""
    needed = CAN.turning_torque + ROBOT.servo.wheel.coulomb_friction
    torques = np.array([0.92, 1.08]) * needed

    def edit(parameters):
        parameters["servo.stall_torque"][:, 4:] = torques[:, None]

    setpoints = HOME.copy()
    setpoints[LEFT], setpoints[RIGHT] = -FULL, FULL
    rate = drive(make_plant(2, edit), 4.0, setpoints).angular_velocity_in_body[:, 2]
    assert abs(rate[0]) < 1e-3
    assert rate[1] > 1e-2
    weak, strong = (capability_of(changed(servo={"wheel": {"stall_torque": float(one)}})) for one in torques)
    assert weak.turning_rate == 0.0
    assert strong.turning_rate > 0.0


def test_it_tips_over_on_the_slope_that_is_said():
    """Locked joints, grippy floor, tall load: 3 degrees less and it stands, 3 degrees more and it falls."""
    offset = (0.0, 0.0, 0.15)
    can = capability_of(changed(body={"com_offset": offset}))
    slopes = [(0, -can.tipping_downhill), (0, can.tipping_uphill), (1, can.tipping_sideways)]
    margin = math.radians(3.0)

    def edit(parameters):
        lock(parameters)
        parameters["body.com_offset"] = offset
        parameters["ground.mu_x"] = parameters["ground.mu_y"] = 3.0
        for row, (axis, slope) in enumerate(slopes * 2):
            parameters["ground.slope"][row, axis] = slope - math.copysign(margin, slope) * (1 if row < 3 else -1)

    truth = drive(make_plant(6, edit), 1.5)
    upright = 1.0 - 2.0 * (truth.quaternion[:, 1] ** 2 + truth.quaternion[:, 2] ** 2)
    assert (upright[:3] > 0.99).all()
    assert (upright[3:] < 0.9).all()
