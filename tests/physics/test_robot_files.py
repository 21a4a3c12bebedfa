"""MuJoCo and Pinocchio load the robot's MJCF and URDF files and agree with the engine's equations without contact.

Random robots in random states. Gear friction is no part of the equations; it is switched off where the files hold it.
"""

from typing import Any

import numpy as np
import pytest
from random_robots import States, mujoco, relative_error

from wlr_gym.base.settings import overlay
from wlr_gym.physics.plants.mujoco.mjcf import mjcf_text, read_mjcf
from wlr_gym.robot import JOINTS, LEGS, Robot, load_robot
from wlr_gym.robot.interchange.recognition import recognise
from wlr_gym.robot.interchange.urdf import parse_urdf, urdf_text
from wlr_gym.robot.parameters import Parameters

ROBOTS, STATES = 3, 40
#: Relative to the largest acceleration of the state.
AGREE = 1e-9
FORMATS = {"urdf": urdf_text, "xml": mjcf_text}


def random_robot(seed):
    """A robot that is far from the nominal one; inertias of bodies with three different second moments."""
    rng = np.random.default_rng(seed)

    def moments(scale):
        second = scale * rng.uniform(0.5, 1.5, 3)
        return [float(value) for value in second.sum() - second]

    def scaled(value):
        return float(value * rng.uniform(0.5, 2.0))

    return Robot.model_validate(
        overlay(
            load_robot().model_dump(),
            {
                "name": f"random-{seed}",
                "gravity": scaled(9.81),
                "body": {"mass": scaled(8.0), "inertia": moments(0.05), "com_offset": rng.uniform(-0.05, 0.05, 3).tolist()},
                "hip_position": {"x": scaled(0.2), "y": scaled(0.2), "z": float(rng.uniform(-0.03, 0.03))},
                "leg": {"length": scaled(0.2), "mass": scaled(0.4), "com_along_leg": scaled(0.1), "inertia": moments(1e-3)},
                "wheel": {
                    "radius": scaled(0.06),
                    "width": scaled(0.03),
                    "mass": scaled(0.3),
                    "spin_inertia": (spin := scaled(5e-4)),
                    "transverse_inertia": spin * float(rng.uniform(0.6, 2.0)),
                },
                "servo": {group: {"armature": scaled(0.01), "viscous_friction": scaled(0.02)} for group in ("leg", "wheel")},
                "leg_limits": [-3.2, 3.2],
            },
        )
    )


@pytest.fixture(params=range(ROBOTS), scope="module")
def case(request):
    robot = random_robot(request.param)
    states = States(STATES, 100 + request.param)
    return robot, states, states.accelerations(Parameters.nominal(robot, STATES))


def written(robot, suffix, folder):
    path = folder / f"robot.{suffix}"
    path.write_text(FORMATS[suffix](robot), encoding="utf-8")
    return path


def armature_of(robot):
    return np.repeat([robot.servo.leg.armature, robot.servo.wheel.armature], 4)


def mujoco_model(path, robot):
    """The file as MuJoCo loads it. A URDF hangs on the world there, without rotors and gravity of its own."""
    spec = mujoco.MjSpec.from_file(str(path))
    if path.suffix == ".urdf":
        spec.body("base_link").add_freejoint()
    model = spec.compile()
    if path.suffix == ".urdf":
        model.opt.gravity[2] = -robot.gravity
        model.dof_armature[[model.joint(name).dofadr[0] for name in JOINTS]] = armature_of(robot)
    model.dof_damping[:], model.dof_frictionloss[:] = 0.0, 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    return model


@pytest.mark.parametrize("suffix", FORMATS)
def test_mujoco_loads_the_file_and_agrees(case, suffix, tmp_path):
    robot, states, expected = case
    model = mujoco_model(written(robot, suffix, tmp_path), robot)
    found = np.array([states.forward(row, model)[1] for row in range(STATES)])
    assert relative_error(found, expected) < AGREE


def test_a_single_servo_keeps_its_torque(tmp_path):
    robot = load_robot({"base": "nominal", "name": "weak", "individual": {"servo.stall_torque[leg_rf]": 5.0}})
    expected = dict.fromkeys(LEGS, 7.3) | {"leg_rf": 5.0}
    for suffix, read in (("urdf", lambda path: parse_urdf(path.read_text(), "x")), ("xml", read_mjcf)):
        joints = read(written(robot, suffix, tmp_path)).joints
        assert {joint.name: joint.effort for joint in joints if joint.name in LEGS} == expected


@pytest.mark.parametrize("suffix", FORMATS)
def test_pinocchio_loads_the_file_and_agrees(case, suffix, tmp_path):
    pin: Any = pytest.importorskip("pinocchio")
    robot, states, expected = case
    path = str(written(robot, suffix, tmp_path))
    model = pin.buildModelFromUrdf(path, pin.JointModelFreeFlyer()) if suffix == "urdf" else pin.buildModelFromMJCF(path)
    joints = [model.joints[model.getJointId(name)] for name in JOINTS]
    rates = [joint.idx_v for joint in joints]
    if suffix == "urdf":
        armature = np.zeros(model.nv)
        armature[rates] = armature_of(robot)
        model.armature = armature
    model.gravity.linear = np.array([0.0, 0.0, -robot.gravity])  # Pinocchio reads it from no file
    data = model.createData()
    found = np.zeros((STATES, 14))
    for row in range(STATES):
        position, velocity, force = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        position[3:7] = states.quaternion[row][[1, 2, 3, 0]]
        for joint, angle in zip(joints, states.angles[row], strict=True):
            turn = [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
            position[joint.idx_q : joint.idx_q + joint.nq] = turn
        velocity[:3], velocity[3:6], velocity[rates] = states.v[row], states.w[row], states.rates[row]
        force[:6], force[rates] = states.force[row][:6], states.force[row][6:]
        acceleration = pin.aba(model, data, position, velocity, force)
        found[row] = [*acceleration[:6], *acceleration[rates]]
    assert relative_error(found, expected) < AGREE


#: A robot of somebody else's: frames turned and shifted, legs that hang down at angle 0, right joints the other way round,
#: degrees, a default class, parts that are welded on, inertias about turned axes.
FOREIGN = """
<mujoco model="foreign">
  <compiler angle="degree" autolimits="true"/>
  <default>
    <default class="leg"><joint axis="0 0 1" range="-60 70" armature="0.02" damping="0.05"/></default>
    <default class="wheel"><joint axis="0 0 -1" armature="0.001"/><geom type="cylinder" size="0.08 0.025"/></default>
  </default>
  <worldbody>
    <body name="trunk" pos="0 0 0.5">
      <freejoint/>
      <inertial pos="0.13 0.01 0.06" mass="10" diaginertia="0.2 0.3 0.4"/>
      <geom type="box" size="0.3 0.2 0.05" pos="0.1 0 0.05"/>
      <body name="battery" pos="0.13 0.01 0.1" euler="0 0 90">
        <inertial pos="0 0 0" mass="2" diaginertia="0.02 0.01 0.03"/>
      </body>
      {legs}
    </body>
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>
"""
LEG = """
      <body name="{corner}_leg" pos="{x} {y} 0.02" euler="{turn} 0 0" childclass="leg">
        <inertial pos="0 {down} {inward}" mass="0.6" diaginertia="0.006 0.0005 0.0055"/>
        <joint name="{corner}_hip"/>
        <body name="{corner}_wheel" pos="0 {reach} {out}" childclass="wheel">
          <inertial pos="0 0 0" mass="0.9" diaginertia="0.0016 0.0016 0.003"/>
          <joint name="{corner}_axle"/>
          <geom/>
        </body>
      </body>
"""


def foreign_text():
    """Left legs turn about +y, right ones about -y; a leg's frame has y down or up, and z to its own side."""
    legs, motors = "", ""
    for corner, x, side in (("fr", 0.35, -1), ("fl", 0.35, 1), ("hl", -0.15, 1), ("hr", -0.15, -1)):
        # turned by -90 deg about x: the frame's z is the body's y, its y the body's -z; by +90 deg: the other way round
        legs += LEG.format(
            corner=corner, x=x, y=0.22 * side, turn=-90 * side, down=0.1 * side, inward=0.05, reach=0.3 * side, out=0.05
        )
        motors += (
            f'<motor joint="{corner}_hip" gear="30" ctrlrange="-1 1"/><motor joint="{corner}_axle" gear="8" ctrlrange="-1 1"/>'
        )
    return FOREIGN.format(legs=legs, motors=motors)


def imported(path):
    found = recognise(read_mjcf(path))
    return found, Robot.model_validate(overlay(load_robot().model_dump(), {"name": "imported", **found.numbers}))


def test_a_foreign_robot_moves_as_its_import_does(tmp_path):
    """MuJoCo moves the file's robot, the engine the imported one: angular and joint accelerations, by the mapping of joints."""
    path = tmp_path / "foreign.xml"
    path.write_text(foreign_text())
    found, robot = imported(path)
    assert [joint.name for joint in found.joints[:4]] == ["fl_hip", "fr_hip", "hl_hip", "hr_hip"]
    assert [joint.sign for joint in found.joints[:4]] == [1.0, -1.0, 1.0, -1.0]
    model = mujoco_model(path, robot)
    names = [joint.name for joint in found.joints]
    sign, offset = (np.array([getattr(joint, name) for joint in found.joints]) for name in ("sign", "offset"))
    states = States(STATES, 5)
    states.force[:, :6] = 0.0
    expected = states.accelerations(Parameters.nominal(robot, STATES))[:, 3:]
    moved = np.array([states.forward(row, model, names, sign, offset)[1][3:] for row in range(STATES)])
    assert relative_error(moved, expected) < AGREE


def test_numbers_of_a_foreign_robot(tmp_path):
    path = tmp_path / "foreign.xml"
    path.write_text(foreign_text())
    found, robot = imported(path)
    assert robot.total_mass == pytest.approx(12.0 + 4 * 1.5)
    assert (robot.hip_position.x, robot.hip_position.y) == pytest.approx((0.25, 0.27))  # the wheels' plane
    assert robot.hip_position.z == pytest.approx(0.02 - 0.05)
    assert robot.body.size == pytest.approx((0.6, 0.4, 0.1))
    assert (robot.leg.length, robot.leg.com_along_leg) == pytest.approx((0.3, 0.1))
    assert robot.leg_limits == pytest.approx(tuple(np.radians([30.0, 150.0])))  # what both sides can
    assert robot.home.leg_angle == pytest.approx(np.pi / 2)
    assert (robot.wheel.radius, robot.wheel.width) == pytest.approx((0.08, 0.05))
    assert (robot.servo.leg.stall_torque, robot.servo.wheel.stall_torque) == pytest.approx((30.0, 8.0))
    assert robot.servo.wheel.no_load_speed == load_robot().servo.wheel.no_load_speed  # no MJCF has it
    assert any("body origin: put at (0.1, 0, 0.05) m of link 'trunk'" in note for note in found.notes)


def test_gains_of_actuators_are_named(tmp_path):
    path = tmp_path / "foreign.xml"
    hold = '<position name="hold" joint="hr_hip" kp="40" kv="2"/></actuator>'
    path.write_text(foreign_text().replace("</actuator>", hold))
    found, _ = imported(path)
    assert "actuator 'hold': kp = 40, kv = 2: not used; servo gains are those of the base" in found.notes


# ---- round trips -------------------------------------------------------------------------------------------------------

#: What each format cannot hold: keys of a robot file.
LOST = {
    "urdf": (
        "gravity",
        "ground",
        "home",
        "sensors",
        "tolerances",
        "dynamixel_ids",
        "servo.supply_voltage",
        "servo.integral_cycle",
    ),
    "xml": ("sensors", "tolerances", "dynamixel_ids", "servo.supply_voltage", "servo.integral_cycle"),
}
#: Of a motor; a URDF has its no-load speed. (Counts are what a servo reports by.)
_LAW = {"kp", "kd", "gear_stiffness", "stall_current", "no_load_current", "current_count", "load_count"}
LOST_OF_A_MOTOR = {"urdf": _LAW, "xml": _LAW | {"no_load_speed"}}


def leaves(tree, above=""):
    if isinstance(tree, dict):
        return {key: value for name, branch in tree.items() for key, value in leaves(branch, f"{above}{name}.").items()}
    return {above[:-1]: tree}


@pytest.mark.parametrize("suffix", FORMATS)
def test_round_trips_keep_every_number_that_the_format_holds(case, suffix, tmp_path):
    robot, *_ = case
    if suffix == "xml":
        ground = {"mu_x": 0.7, "mu_y": 0.4, "slope": 0.1, "normal_stiffness": 12345.678, "normal_damping": 98.7}
        ground |= {"slip_compliance": 1 / 17, "relaxation_length": 0.0041, "tread_damping": 3.1}
        robot = Robot.model_validate(overlay(robot.model_dump(), {"ground": ground, "home": {"leg_angle": 1.234}}))
    path = written(robot, suffix, tmp_path)
    tree = read_mjcf(path) if suffix == "xml" else parse_urdf(path.read_text(), str(path))
    found = recognise(tree)
    assert found.notes == []
    assert found.name == robot.name
    held, expected = leaves(found.numbers), leaves(robot.model_dump(exclude={"name", "joints", "tolerances"}))
    for key, value in expected.items():
        group, _, name = key.rpartition(".")
        lost = key.startswith(LOST[suffix]) or (group in ("servo.leg", "servo.wheel") and name in LOST_OF_A_MOTOR[suffix])
        assert lost == (key not in held), key
        if not lost:
            assert held[key] == pytest.approx(np.array(value).tolist(), rel=1e-12, abs=1e-15), key
    assert set(held) <= set(expected)
