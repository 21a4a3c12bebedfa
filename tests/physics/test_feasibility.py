"""What a robot can do, and robots that are impossible."""

import json
import math

import numpy as np
import pytest
import yaml
from rig import HOME, ROBOT, contact_force, drive, lock, make_plant

from wlr_gym.base.settings import overlay
from wlr_gym.cli import BAD_INPUT, FAILED, OK, main
from wlr_gym.physics.feasibility import capability_of, examine_robot, hip_torque, stance_of
from wlr_gym.robot import Robot, load_robot
from wlr_gym.robot.interchange.recognition import robot_over
from wlr_gym.robot.outline import QUESTIONS, derived_numbers

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
    setpoints = np.tile(HOME, (4, 1))
    setpoints[:, FRONT], setpoints[:, REAR] = angles[:, :1], angles[:, 1:]
    truth = drive(make_plant(4, {"body.com_offset": offset}), 3.0, setpoints)
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
    setpoints = np.tile(HOME, (3, 1))
    setpoints[:, :4] = angles[:, None]
    ice = {"ground.mu_x": 0.0, "ground.mu_y": 0.0, "servo.coulomb_friction": 0.0}
    truth = drive(make_plant(3, ice), 3.0, setpoints)
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
    setpoints = HOME.copy()
    setpoints[LEFT], setpoints[RIGHT] = -FULL, FULL
    truth = drive(make_plant(1, {"ground.mu_x": mu_x, "ground.mu_y": mu_y}), 3.0, setpoints)
    expected = capability_of(changed(ground={"mu_x": mu_x, "mu_y": mu_y})).turning_rate
    assert truth.angular_velocity_in_body[0, 2] == pytest.approx(expected, rel=0.05)


def test_motors_that_are_just_too_weak_to_turn_do_not():
    """Stall torque 8 % below and above what the skid moment asks."""
    needed = CAN.turning_torque + ROBOT.servo.wheel.coulomb_friction
    torques = np.array([0.92, 1.08]) * needed
    setpoints = HOME.copy()
    setpoints[LEFT], setpoints[RIGHT] = -FULL, FULL
    rate = drive(make_plant(2, {"servo.stall_torque of wheels": torques[:, None]}), 4.0, setpoints).angular_velocity_in_body[
        :, 2
    ]
    assert abs(rate[0]) < 1e-3
    assert rate[1] > 1e-2
    weak, strong = (capability_of(changed(servo={"wheel": {"stall_torque": float(one)}})) for one in torques)
    assert weak.turning_rate == 0.0
    assert strong.turning_rate > 0.0


def test_it_tips_over_on_the_slope_that_is_said():
    """Locked joints, grippy floor, tall load: 3 degrees less and it stands, 3 degrees more and it falls."""
    offset = (0.0, 0.0, 0.15)
    can = capability_of(changed(body={"com_offset": offset}))
    steepest = np.array([[-can.tipping_downhill, 0.0], [can.tipping_uphill, 0.0], [0.0, can.tipping_sideways]])
    margin = math.radians(3.0) * np.sign(steepest)
    slopes = np.concatenate([steepest - margin, steepest + margin])
    numbers = {"body.com_offset": offset, "ground.mu_x": 3.0, "ground.mu_y": 3.0, "ground.slope": slopes}
    truth = drive(make_plant(6, [lock, numbers]), 1.5)
    upright = 1.0 - 2.0 * (truth.quaternion[:, 1] ** 2 + truth.quaternion[:, 2] ** 2)
    assert (upright[:3] > 0.99).all()
    assert (upright[3:] < 0.9).all()


# --- bad robot files are refused, fine ones are not -------------------------------------------------------------------


REFUSED, FAULT, WARNING = "refused", "fault", "warning"


def servo(group, **numbers):
    return {"servo": {group: numbers}}


#: What is bad in words -> changes of the nominal robot, how it is answered, the key that is named, words of the message.
BAD = {
    # by units
    "leg in mm": ({"leg": {"length": 135.0}}, FAULT, "leg.length", ["135 mm = 0.135 m"]),
    "leg in cm": ({"leg": {"length": 13.5}}, FAULT, "leg.length", ["13.5 cm = 0.135 m"]),
    "leg a thousand times too short": ({"leg": {"length": 1.35e-4}}, FAULT, "leg.length", ["0.000135", "too small by 1000"]),
    "wheel in mm": ({"wheel": {"radius": 34.0}}, FAULT, "wheel.radius", ["34 mm = 0.034 m"]),
    "wheel width in mm": ({"wheel": {"width": 20.0}}, WARNING, "wheel.width", ["20 mm = 0.02 m"]),
    "body in mm": ({"body": {"size": [350.0, 320.0, 70.0]}}, WARNING, "body.size", ["350 mm = 0.35 m"]),
    "hips in mm": ({"hip_position": {"x": 175.0}}, FAULT, "hip_position.x", ["175 mm = 0.175 m"]),
    "centre of mass in mm": ({"body": {"com_offset": [10.0, 0.0, 0.0]}}, FAULT, "body.com_offset", ["10 mm = 0.01 m"]),
    "body in g": ({"body": {"mass": 2800.0}}, FAULT, "body.mass", ["2800 g = 2.8 kg"]),
    "body in t": ({"body": {"mass": 0.0028}}, FAULT, "body.mass", ["0.0028", "too small by 1000"]),
    "wheel in g": ({"wheel": {"mass": 20.0}}, FAULT, "wheel.mass", ["20 kg"]),
    "leg in g": ({"leg": {"mass": 30.0}}, FAULT, "leg.mass", ["30 kg"]),
    "body inertia in g m2": (
        {"body": {"inertia": [25.04, 29.73, 52.48]}}, FAULT, "body.inertia", ["25.04", "[1e-05, 10] kg m2"],
    ),
    "body inertia a thousand times too small": (
        {"body": {"inertia": [2.5e-5, 3.0e-5, 5.2e-5]}}, FAULT, "body.inertia", ["body.inertia x = 2.5e-05", "1001 times more"],
    ),
    "leg inertia a thousand times too large": (
        {"leg": {"inertia": [0.12, 0.12, 0.02]}}, WARNING, "leg.inertia", ["0.12 kg m2", "too large by 1000"],
    ),
    "leg inertia a thousand times too small": (
        {"leg": {"inertia": [1.2e-7, 1.2e-7, 2e-8]}}, WARNING, "leg.inertia", ["1.2e-07", "too small by 1000"],
    ),
    "wheel inertia in g m2": (
        {"wheel": {"spin_inertia": 1.156e-2, "transverse_inertia": 6.45e-3}}, WARNING, "wheel.spin_inertia", ["0.01156"],
    ),
    "wheel inertia too small": (
        {"wheel": {"spin_inertia": 1.156e-8, "transverse_inertia": 6.45e-9}}, WARNING, "wheel.spin_inertia", ["1.156e-08"],
    ),
    "torque in mN m": (servo("leg", stall_torque=7300.0), FAULT, "servo.leg.stall_torque", ["7300 mN m = 7.3 N m"]),
    "torque a thousand times too small": (
        servo("wheel", stall_torque=0.0015), WARNING, "servo.wheel.stall_torque", ["0.0015", "too small by 1000"],
    ),
    "leg speed in rpm": (servo("leg", no_load_speed=53.0), WARNING, "servo.leg.no_load_speed", ["53 rpm = 5.55 rad/s"]),
    "wheel speed in deg/s": (servo("wheel", no_load_speed=366.0), FAULT, "servo.wheel.no_load_speed", ["366 rpm"]),
    "supply in mV": ({"servo": {"supply_voltage": 12000.0}}, FAULT, "servo.supply_voltage", ["12000", "mV"]),
    "limits in degrees": (
        {"leg_limits": [20.0, 160.0], "home": {"leg_angle": 90.0}}, WARNING, "leg_limits", ["20 deg = 0.3491 rad"],
    ),
    "gain in counts of the register": (servo("leg", kp=800.0), WARNING, "servo.leg.kp", ["800 V/rad", "counts"]),
    "rotor a thousand times too heavy": (servo("wheel", armature=0.2684), WARNING, "servo.wheel.armature", ["0.2684"]),
    "friction in mN m": (servo("wheel", coulomb_friction=30.0), FAULT, "servo.wheel.coulomb_friction", ["30 N m", "1.5 N m"]),
    "encoder in counts per turn": (
        {"sensors": {"encoder": {"position": 4096.0}}}, WARNING, "sensors.encoder.position", ["4096 rad"],
    ),
    "control period for rate": ({"sensors": {"control_rate": 0.02}}, WARNING, "sensors.control_rate", ["0.02 Hz"]),
    "gyro noise in deg/s": ({"sensors": {"imu": {"gyro_noise": 0.5}}}, WARNING, "sensors.imu.gyro_noise", ["0.5 deg/s"]),
    "gravity in mm/s2": ({"gravity": 9810.0}, FAULT, "gravity", ["9810 mm/s2 = 9.81 m/s2"]),
    "slope in degrees": ({"ground": {"slope": 5.0}}, FAULT, "ground.slope", ["5 deg = 0.08727 rad"]),
    "friction in per cent": ({"ground": {"mu_x": 60.0}}, FAULT, "ground.mu_x", ["60 % = 0.6"]),
    "stiffness in N/mm": ({"ground": {"normal_stiffness": 7.4}}, FAULT, "ground.normal_stiffness", ["7.4 N/m"]),
    # by what no file may say
    "massless wheel": ({"wheel": {"mass": 0.0}}, REFUSED, "wheel.mass", ["wheel.mass = 0.0"]),
    "next to massless wheel": ({"wheel": {"mass": 1e-6}}, WARNING, "wheel.mass", ["1e-06 kg", "next to no mass"]),
    "next to massless leg": ({"leg": {"mass": 1e-6}}, WARNING, "leg.mass", ["1e-06 kg", "next to no mass"]),
    "negative gear": (servo("wheel", gear_stiffness=-430.0), REFUSED, "servo.wheel.gear_stiffness", ["= -430.0"]),
    "negative torque": (servo("wheel", stall_torque=-1.5), REFUSED, "servo.wheel.stall_torque", ["= -1.5"]),
    "negative rotor": (servo("leg", armature=-0.01), REFUSED, "servo.leg.armature", ["= -0.01"]),
    "motor that makes power": (
        servo("leg", stall_current=0.1, no_load_current=0.01), REFUSED, "servo.leg.stall_current", ["more power than it takes"],
    ),
    "limits in the wrong order": ({"leg_limits": [2.79, 0.35]}, REFUSED, "leg_limits", ["lower limit must be below"]),
    "home outside the limits": ({"home": {"leg_angle": 0.2}}, FAULT, "home.leg_angle", ["0.2 rad is outside leg_limits"]),
    "inertia no body has": ({"body": {"inertia": [0.02, 0.03, 0.08]}}, FAULT, "body.inertia", ["triangle inequality"]),
    "wheel inertia no body has": (
        {"wheel": {"transverse_inertia": 4e-6}}, FAULT, "wheel.spin_inertia", ["twice wheel.transverse_inertia, 4e-06"],
    ),
    # by geometry
    "hips above the body": ({"hip_position": {"z": 0.1}}, WARNING, "hip_position.z", ["0.1 m", "0.065 m above the top"]),
    "hips below the body": ({"hip_position": {"z": -0.09}}, WARNING, "hip_position.z", ["0.055 m below the bottom"]),
    "hips far from the body": ({"hip_position": {"x": 0.6}}, WARNING, "hip_position.x", ["0.6 m", "twice as far out"]),
    "legs that cross": ({"leg": {"length": 0.25}}, WARNING, "leg.length", ["legs cross", "-0.1195 m apart"]),
    "wheels that touch": ({"wheel": {"radius": 0.05}}, WARNING, "leg.length", ["legs touch", "wheels need 0.1 m"]),
    "wheels above the hips": (
        {"leg_limits": [-1.0, -0.2], "home": {"leg_angle": -0.5}}, FAULT, "home.leg_angle", ["the body lies on the floor"],
    ),
    "body that drags": ({"body": {"size": [0.35, 0.32, 0.20]}}, WARNING, "leg_limits", ["in the floor", "0.35 rad"]),
    "centre of mass outside the body": ({"body": {"com_offset": [0.0, 0.0, 0.19]}}, WARNING, "body.com_offset z", ["0.19 m"]),
    "leg mass beyond the wheel": ({"leg": {"com_along_leg": 0.3}}, WARNING, "leg.com_along_leg", ["0.3 m", "beyond the wheel"]),
    # by what it cannot do
    "tips over at rest": ({"body": {"com_offset": [0.19, 0.0, 0.0]}}, FAULT, "body.com_offset x", ["tips over forward"]),
    "tips over on slopes": (
        {"hip_position": {"y": 0.04}, "body": {"size": [0.35, 0.08, 0.07], "inertia": [0.0038, 0.0297, 0.0301]}},
        WARNING, "tipping", ["13.8 deg", "nearest contacts 0.04 m"],
    ),
    "tips over when it accelerates": (
        {"body": {"com_offset": [-0.1, 0.0, 0.03]}}, WARNING, "tipping_acceleration", ["4.", "motors and floor give 5.89 m/s2"],
    ),
    "a wheel unloaded at a leg limit": (
        {"body": {"com_offset": [0.13, 0.0, 0.0]}}, WARNING, "leg_limits", ["least loaded wheel carries"],
    ),
    "cannot turn": (
        overlay(servo("wheel", stall_torque=0.12), {"ground": {"mu_x": 1.2, "mu_y": 1.2}}),
        FAULT, "servo.wheel.stall_torque", ["cannot turn", "asks 0.222 N m of a wheel"],
    ),
    "turns too slowly": (servo("wheel", no_load_speed=0.4), WARNING, "servo.wheel.no_load_speed", ["turns on the spot at"]),
    "wheel motors too weak": (
        overlay(servo("wheel", stall_torque=0.05), {"ground": {"mu_x": 0.05, "mu_y": 0.05}}),
        WARNING, "servo.wheel.stall_torque", ["too weak for 3 kg", "climb 0.08 rad"],
    ),
    "cannot hold its own slope": ({"ground": {"slope": 0.58}}, FAULT, "ground.slope", ["grip allow 0.54 rad"]),
    "leg motors too weak": (servo("leg", stall_torque=1.2), WARNING, "servo.leg.stall_torque", ["asks 1.57 N m of a leg"]),
    "cannot stand": (
        overlay(servo("leg", stall_torque=0.5), {"home": {"leg_angle": 0.7}}),
        FAULT, "servo.leg.stall_torque", ["cannot stand", "N m of a leg at home"],
    ),
    "legs give way": (servo("leg", kp=5.0), WARNING, "servo.leg.kp", ["give way by 0.517 rad"]),
    "no gain": (servo("leg", kp=0.0), FAULT, "servo.leg.kp", ["follows no setpoint"]),
    "brake for a motor": (servo("leg", coulomb_friction=5.0), WARNING, "servo.leg.coulomb_friction", ["68% of the stall"]),
    "soft floor": ({"ground": {"normal_stiffness": 400.0}}, WARNING, "ground.normal_stiffness", ["0.0184 m into the floor"]),
    "undamped floor": ({"ground": {"normal_damping": 0.0}}, WARNING, "ground.normal_damping", ["damping ratio 0"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_robot_is_refused_or_warned_about_with_its_number(case, tmp_path, capsys):
    changes, answer, key, words = BAD[case]
    path = tmp_path / "bad.yaml"
    path.write_text(yaml.safe_dump({"base": "nominal", "name": "bad", **changes}))
    code = main(["robot", "check", str(path), "--json"])
    said = capsys.readouterr()
    if answer == REFUSED:
        assert code == BAD_INPUT
        text = " ".join(said.err.split())
        assert key in text
    else:
        findings = json.loads(said.out)["findings"]
        found = [one for one in findings if one["key"].startswith(key) and one["level"] == answer]
        assert found, [(one["level"], one["key"], one["text"]) for one in findings]
        assert code == (FAILED if any(one["level"] == FAULT for one in findings) else OK)
        text = " ".join(f"{one['key']} = {one['value'] or 0:.6g} {one['unit']}: {one['text']}" for one in found)
    assert all(word in text for word in words), text


@pytest.mark.parametrize("name", ["nominal", "emanual"])
def test_shipped_robots_are_fine(name):
    assert examine_robot(load_robot(name)) == []


def test_a_large_robot_is_fine(tmp_path):
    """18 kg, legs of 0.3 m, wheels of 80 mm: scale alone is not odd."""
    base = load_robot()
    given = {
        "body.mass": 12.0, "body.size": [0.6, 0.4, 0.15], "leg.length": 0.3, "leg.mass": 0.7, "wheel.radius": 0.08,
        "wheel.mass": 0.8, "servo.supply_voltage": 24.0, "servo.leg.stall_torque": 30.0, "servo.wheel.stall_torque": 9.0,
    }  # fmt: skip
    answers: dict = {}
    for question in QUESTIONS:
        answers[question.key] = given.get(question.key, question.default(answers, base))
    numbers, comments = derived_numbers(answers, base)
    robot = robot_over("nominal", "large", numbers, tmp_path / "large.yaml")
    assert examine_robot(robot) == []
    assert robot.total_mass == pytest.approx(18.0)
    assert set(comments) >= set(answers)


def test_faults_come_first_and_strict_counts_warnings(tmp_path):
    path = tmp_path / "odd.yaml"
    path.write_text("base: nominal\nname: odd\nhip_position: {z: 0.1}\n")
    assert main(["robot", "check", str(path)]) == OK
    assert main(["robot", "check", str(path), "--strict"]) == FAILED
    both = overlay(load_robot().model_dump(), {"hip_position": {"z": 0.1}, "wheel": {"transverse_inertia": 4e-6}})
    levels = [one.level for one in examine_robot(Robot.model_validate(both))]
    assert levels[0] == FAULT
    assert levels == sorted(levels)
