"""Fingerprints of a robot: they follow the numbers that a simulator reads, and nothing else."""

import pytest
import yaml
from pydantic import Field

from wlr_gym.base.paths import find_config
from wlr_gym.base.settings import SettingsModel
from wlr_gym.robot import Robot, load_robot, robot_hash, servo_hash
from wlr_gym.robot.description import Motor, Servo

ROBOT = load_robot()


class FlowSensor(SettingsModel):
    noise: float = 0.01


class LaterMotor(Motor):
    resistance: float | None = None


class LaterServo(Servo):
    leg: LaterMotor  # pyright: ignore[reportIncompatibleVariableOverride]
    fuse: float = Field(default=10.0, gt=0)


class LaterRobot(Robot):
    """A robot of a later version: with fields that today's files do not have."""

    servo: LaterServo  # pyright: ignore[reportIncompatibleVariableOverride]
    flow: FlowSensor = Field(default_factory=FlowSensor)
    toe: tuple[float, float] = (0.0, 0.0)


def later(**changes):
    """The nominal file, read by the later version; ``changes``: dotted path (``__``) -> value."""
    data = yaml.safe_load(find_config("robot", "nominal").read_text())
    for path, value in changes.items():
        *parents, last = path.split("__")
        place = data
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return LaterRobot.model_validate(data)


def test_the_nominal_robots_are_known():
    """They change when a number does, or the canonical form (then HASH_FORM has to)."""
    assert robot_hash(ROBOT) == "2-1bad2a980ac2fdec"
    assert servo_hash(ROBOT) == "2-8e2765725d7f700f"


@pytest.mark.parametrize("changes", [{}, {"toe": [0.0, 0.0], "servo__fuse": 10.0, "flow__noise": 0.01}])
def test_a_new_field_with_its_default_changes_nothing(changes):
    assert robot_hash(later(**changes)) == robot_hash(ROBOT)
    assert servo_hash(later(**changes)) == servo_hash(ROBOT)


@pytest.mark.parametrize(
    ("changes", "servo_too"),
    [
        ({"toe": [0.0, 0.1]}, False),
        ({"flow__noise": 0.02}, False),
        ({"servo__fuse": 9.0}, True),
        ({"servo__leg__resistance": 1.0}, True),
    ],
)
def test_a_new_field_with_another_value_does(changes, servo_too):
    assert robot_hash(later(**changes)) != robot_hash(ROBOT)
    assert (servo_hash(later(**changes)) != servo_hash(ROBOT)) == servo_too


@pytest.mark.parametrize(
    "changes",
    [
        {"tolerances": {}},
        {"tolerances": {"body.mass": "3 g"}},
        {"name": "other"},
        {"dynamixel_ids__leg_lf": 42},
        {"gravity": 9.81},
    ],
)
def test_what_no_simulator_reads_does_not_matter(changes):
    assert robot_hash(later(**changes)) == robot_hash(ROBOT)


@pytest.mark.parametrize(
    "changes",
    [
        {"body__mass": 2.8000000000000003},
        {"body__com_offset": [0.0, 0.0, 1e-9]},
        {"ground__slope": 0.01},
        {"hip_position__z": 0.001},
        {"leg_limits": [0.35, 2.8]},
        {"home__leg_angle": 1.5},
        {"sensors__imu__gyro_noise": 0.001},
        {"sensors__control_rate": 100.0},
    ],
)
def test_every_number_of_a_simulator_does(changes):
    assert robot_hash(later(**changes)) != robot_hash(ROBOT)
    assert servo_hash(later(**changes)) == servo_hash(ROBOT)


def test_currents_of_the_motors_do_not_matter():
    """No motion depends on them: a policy from ``nominal`` drives a robot with ``emanual``."""
    emanual = load_robot("emanual")
    assert emanual.servo.leg.stall_current != ROBOT.servo.leg.stall_current
    assert (robot_hash(emanual), servo_hash(emanual)) == (robot_hash(ROBOT), servo_hash(ROBOT))


def test_the_cycle_of_the_wheels_integral_does():
    assert robot_hash(later(servo__integral_cycle=2e-3)) != robot_hash(ROBOT)
    assert servo_hash(later(servo__integral_cycle=1e-3)) == servo_hash(ROBOT)


def test_whole_numbers_are_the_same_numbers():
    assert robot_hash(later(servo__supply_voltage=12)) == robot_hash(ROBOT)
