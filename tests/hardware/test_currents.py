"""Currents and loads on the bus: what the emulated servos say, what it becomes, when the limits trip, whose robot file."""

import gymnasium as gym
import numpy as np
import pytest
import yaml
from test_rules import HOME, status

import wlr_gym  # noqa: F401  registers the environments
from wlr_gym.base.paths import find_config
from wlr_gym.hardware.config import SafetyLimits, load_hardware
from wlr_gym.hardware.emulator import Machine, MachineOptions
from wlr_gym.hardware.emulator.line import NO_TIME
from wlr_gym.hardware.safety import rules
from wlr_gym.hardware.safety.status import ratings_of
from wlr_gym.hardware.servos import JointMap
from wlr_gym.robot import JOINTS, LEGS, load_robot
from wlr_gym.robot.parameters import Parameters

NOMINAL, EMANUAL, HARDWARE = load_robot(), load_robot("emanual"), load_hardware()
CURRENT_COUNT = 2.69e-3


def machine_with(robot, friction):
    """An emulated robot whose gears have this dry friction; all motors on."""
    parameters = Parameters.nominal(robot)
    parameters["servo.coulomb_friction"] = friction
    machine = Machine(robot, HARDWARE, MachineOptions(timing=NO_TIME, sensor_noise=False), parameters=parameters)
    for servo in machine.servos.values():
        write(servo, "torque_enable", 1)
    return machine


def write(servo, name, count):
    item = servo.table[name]
    servo.write(item.address, item.encode(count))


def read(machine, robot):
    """Registers of current or load, and the torques that the host makes of them."""
    efforts = [machine.servos[joint]["present_current" if joint in LEGS else "present_load"] for joint in JOINTS]
    velocities = [machine.servos[joint]["present_velocity"] for joint in JOINTS]
    return efforts, JointMap(robot, HARDWARE).effort(efforts, velocities)


@pytest.mark.parametrize(("robot", "amperes"), [(NOMINAL, 3.37625), (EMANUAL, 4.4)])
def test_stalled_motors_at_full_voltage(robot, amperes):
    machine = machine_with(robot, 50.0)
    for joint in JOINTS[:4]:
        write(machine.servos[joint], "goal_position", 3000)
    for joint in JOINTS[4:]:
        write(machine.servos[joint], "goal_velocity", 200)
    machine.advance(1.5)
    efforts, torques = read(machine, robot)
    sign = np.array([HARDWARE.joints[joint].sign for joint in JOINTS])
    assert efforts[:4] == [round(amperes / CURRENT_COUNT)] * 4
    assert efforts[4:] == [1000] * 4
    np.testing.assert_allclose(sign * torques, [7.3] * 4 + [1.5] * 4, atol=0.003)


def test_a_turning_leg_draws_its_idle_current_beside_its_torque():
    """Free legs at full voltage: the circuit of the data sheet, computed here; what is left is the torque on the shaft."""
    machine = machine_with(EMANUAL, 0.0)
    leg = machine.servos["leg_lf"]
    write(leg, "torque_enable", 0)
    write(leg, "operating_mode", 16)
    write(leg, "torque_enable", 1)
    write(leg, "goal_pwm", 885)
    machine.advance(0.048)
    rate = leg.shaft.velocity
    assert 5.3 < rate < 5.55
    circuit = (12.0 - (12.0 - 12.0 / 4.4 * 0.24) / 5.55 * rate) / (12.0 / 4.4)
    efforts, torques = read(machine, EMANUAL)
    assert efforts[0] * CURRENT_COUNT == pytest.approx(circuit, rel=0.01)
    assert torques[0] == pytest.approx(7.3 * (1.0 - rate / 5.55), abs=0.01)
    assert torques[0] == pytest.approx(machine.coupling.sensors.joint_effort[0, 0], abs=0.01)


def test_a_motor_that_is_off_has_no_current():
    machine = machine_with(EMANUAL, 0.0)
    for servo in machine.servos.values():
        write(servo, "torque_enable", 0)
    machine.advance(0.05)
    assert read(machine, EMANUAL)[0] == [0] * 8


def test_current_mode_gives_the_goal_current_to_a_stalled_leg():
    machine = machine_with(EMANUAL, 50.0)
    leg = machine.servos["leg_lf"]
    write(leg, "torque_enable", 0)
    write(leg, "operating_mode", 0)
    write(leg, "torque_enable", 1)
    write(leg, "goal_current", 500)
    machine.advance(0.05)
    assert leg["present_current"] == pytest.approx(500, abs=1)
    assert read(machine, EMANUAL)[1][0] == pytest.approx(500 * CURRENT_COUNT * 7.3 / 4.4, abs=0.005)


# ---- limits


def seconds_until(rule, share, robot, limits):
    """s until ``rule`` stops a robot whose leg servos say ``share`` of the data sheet's stall current; None = never."""
    ratings, memory = ratings_of(robot, 0.02), rules.Memory()
    counts = np.r_[np.full(4, share * 4.4 / CURRENT_COUNT), np.zeros(4)]
    effort = JointMap(robot, HARDWARE).effort(counts, np.zeros(8))
    for tick in range(200):
        decision = rules.decide(limits, ratings, status(effort=effort), memory, HOME, HOME)
        if any(verdict.rule == rule for verdict in decision.verdicts):
            return tick * 0.02
        memory = decision.memory
    return None


def test_the_load_limit_trips_at_its_share_of_stall_torque():
    limits = SafetyLimits(load=0.7, current=100.0)
    assert seconds_until("load", 0.69, EMANUAL, limits) is None
    assert seconds_until("load", 0.71, EMANUAL, limits) == pytest.approx(limits.load_time, abs=0.04)
    assert seconds_until("load", 0.56, NOMINAL, limits) is not None  # what was wrong with one constant for both


def test_the_current_limit_counts_true_amperes():
    limits = SafetyLimits(current=10.0, load=1.0)
    assert seconds_until("current", 0.56, EMANUAL, limits) is None  # 4 x 2.46 A
    assert seconds_until("current", 0.58, EMANUAL, limits) == pytest.approx(limits.current_time, abs=0.04)
    ratings = ratings_of(EMANUAL, 0.02)
    stalled = np.abs(ratings.currents.current(ratings.stall_torque, np.zeros(8))).sum()
    assert stalled == pytest.approx(23.2)  # "eight stalled take 23"


# ---- whose numbers


def test_a_hardware_file_names_its_robot_file(tmp_path):
    assert HARDWARE.robot == "emanual"
    data = yaml.safe_load(find_config("hardware", "nominal").read_text(encoding="utf-8"))
    path = tmp_path / "mine.yaml"
    (tmp_path / "robot.yaml").write_text("base: emanual\nname: mine\n", encoding="utf-8")
    path.write_text(yaml.safe_dump(data | {"robot": "robot.yaml"}), encoding="utf-8")
    assert load_robot(load_hardware(path).robot or "").name == "mine"
    path.write_text(yaml.safe_dump({key: value for key, value in data.items() if key != "robot"}), encoding="utf-8")
    assert load_hardware(path).robot is None


@pytest.mark.parametrize(("options", "name"), [({}, "wlr-emanual"), ({"robot": "nominal"}, "wlr-nominal")])
def test_an_environment_takes_the_robot_of_the_hardware_file(options, name):
    env = gym.make("WLR-Velocity-v0", backend="dynamixel", hardware={"emulated": True}, **options)
    try:
        assert env.unwrapped.core.task.robot.name == name  # type: ignore[attr-defined]
    finally:
        env.close()
