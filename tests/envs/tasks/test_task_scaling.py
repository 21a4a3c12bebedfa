"""Numbers of a task follow the robot by the rules of its file; for the robot it is written for they stay as they are."""

import copy

import pytest

from wlr_gym import cli
from wlr_gym.base.errors import InputError
from wlr_gym.envs.registry import ENVIRONMENTS
from wlr_gym.envs.tasks import load_task
from wlr_gym.envs.tasks.describe import contract
from wlr_gym.envs.tasks.scaling import QUANTITIES, check_rule, ratio
from wlr_gym.envs.tasks.task import read_task
from wlr_gym.robot import load_robot, robot_content

TASKS = tuple(ENVIRONMENTS.values())
NOMINAL = load_robot()
#: Twice as wide and long, wheels of twice the radius at half the rate, legs of three times the length and half their range.
LARGE = robot_content(NOMINAL) | {"name": "large", "leg_limits": [0.96, 2.18]}
LARGE = copy.deepcopy(LARGE)
LARGE["hip_position"] |= {"x": 0.35, "y": 0.32}
LARGE["wheel"] |= {"radius": 0.068}
LARGE["leg"] |= {"length": 0.405}
LARGE["servo"]["wheel"] |= {"no_load_speed": 3.194, "stall_torque": 30.0}


def at(config, place):
    value = config.model_dump()
    for key in place.split("."):
        value = value[key]
    return value


@pytest.mark.parametrize("name", TASKS)
def test_the_tasks_own_robot_has_the_numbers_of_the_file(name):
    assert load_task(name, NOMINAL).config == read_task(name) == load_task(name).config
    assert load_task(name, "emanual").config == read_task(name)


@pytest.mark.parametrize("name", TASKS)
def test_every_rule_acts(name):
    written, large = read_task(name), load_task(name, LARGE).config
    for place, rule in written.scaling.items():
        expected = "leg_limits" if rule == "leg_limits" else ratio(rule, load_robot(LARGE), NOMINAL)
        if expected != pytest.approx(1.0):
            assert at(large, place) != at(written, place), place
    unscaled = {"name", "history", "summary", "robot", "randomization", "control_period", "episode_length", "scaling"}
    assert all(at(large, key) == at(written, key) for key in unscaled)


@pytest.mark.parametrize(
    ("name", "place", "expected"),
    [
        ("velocity", "commands.terms.linear_velocity_x", (-0.1, 0.1)),  # twice the radius, half the rate
        ("velocity", "commands.terms.yaw_rate", (-0.15, 0.15)),  # the same speed, twice the track
        ("velocity", "commands.ramp.linear_velocity_x", 0.5),  # the floor, not the motors, is the limit of both
        ("velocity", "action.wheel_scale", 3.0),
        ("velocity", "action.leg_scale", 0.267),  # twice the wheelbase over three times the leg: 0.4 * 2/3
        ("velocity", "success.yaw_rate_error.rms", 0.015),
        ("velocity", "terminations.left_floor.clearance", 0.9),
        ("path", "commands.terms.path_curvature", (-0.8, 0.8)),
        ("path", "success.path_lateral_error.rms", 0.024),
        ("posture", "commands.terms.front_leg_first", (1.05, 2.09)),  # 0.96 + (0.5236 - 0.35)/2.44 * 1.22
        ("posture", "action.leg_scale", 0.625),
        ("slope", "observations.wheel_effort.scale", 0.1),
        ("slope", "observations.wheel_effort.limit", 100.0),
    ],
)
def test_numbers_worked_out_by_hand(name, place, expected):
    assert at(load_task(name, LARGE).config, place) == pytest.approx(expected)


def test_weak_motors_are_the_limit_of_what_grip_gives():
    weak = copy.deepcopy(LARGE)
    weak["servo"]["wheel"] |= {"stall_torque": 0.1}
    robot = load_robot(weak)
    assert QUANTITIES["grip"].of(robot) == pytest.approx(4 * 0.1 / 0.068 / robot.total_mass)


def test_what_is_laid_over_a_task_holds_as_it_is_given():
    changes = {"commands": {"terms": {"yaw_rate": [-0.2, 0.2]}}, "rewards": {"slip": {"speed": 0.07}}}
    config = load_task("velocity", LARGE, changes).config
    assert config.commands.terms["yaw_rate"] == (-0.2, 0.2)
    assert config.rewards["slip"]["speed"] == 0.07
    without = {"scaling": {"commands.terms.yaw_rate": None}}
    assert load_task("velocity", LARGE, without).config.commands.terms["yaw_rate"] == (-0.3, 0.3)
    removed = load_task("velocity", LARGE, {"rewards": {"energy": None}}).config
    assert "energy" not in removed.rewards


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"commands.terms.yaw_rate": "topspeed"}, r"scaling\.commands\.terms\.yaw_rate.*'topspeed'.*did you mean 'top_speed'"),
        ({"commands.terms.yaw_rate": "top_speed /"}, "expected a product such as 'top_speed / track_width'"),
        ({"commands.terms.yaw_rat": "top_speed"}, r"scaling\.commands\.terms\.yaw_rat: the task has no number there"),
        ({"summary": "top_speed"}, r"scaling\.summary: the task has no number there"),
    ],
)
def test_a_bad_rule_is_named(rules, message):
    with pytest.raises(InputError, match=message):
        load_task("velocity", LARGE, {"scaling": rules})


@pytest.mark.parametrize(("name", "quantity"), [("velocity", "grip = 0 m/s2"), ("slope", "weight = 0 N")])
def test_a_robot_without_weight_is_refused(name, quantity):
    with pytest.raises(InputError, match=f"robot 'floating': {quantity}: expected more than 0"):
        load_task(name, {"base": "nominal", "name": "floating", "gravity": 0.0})


def test_what_a_fast_robot_reads_is_not_cut_off():
    fast = {"base": "nominal", "name": "fast", "servo": {"wheel": {"no_load_speed": 60.0}}, "leg_limits": [-3.0, 5.0]}
    task, nominal = load_task("velocity", fast), load_task("velocity")
    limit = {column.term: column.limit for column in task.policy}
    turning = max(task.config.commands.terms["yaw_rate"])
    assert turning > 2.0
    assert [column.limit for column in task.policy[:2]] == [2.0, turning]
    assert limit["wheel_velocity"] == 75.0
    assert limit["leg_position"] == pytest.approx(1.25 * (3.0 + task.robot.home.leg_angle))
    assert limit["leg_velocity"] == 20.0
    assert {column.limit for column in nominal.policy if column.term in ("command", "leg_position")} == {2.0}
    given = load_task("velocity", fast, {"observations": {"wheel_velocity": {"limit": 3.0}}})
    assert {column.limit for column in given.policy if column.term == "wheel_velocity"} == {3.0}


def test_rules_are_products():
    check_rule("x", "top_speed*track_width / leg_reach", "task")
    assert ratio("1 / leg_reach", load_robot(LARGE), NOMINAL) == pytest.approx(1 / 3)


def test_the_contract_describes_a_robot_that_is_not_the_nominal_one():
    assert "description" not in contract(load_task("velocity", NOMINAL), {})["robot"]
    described = contract(load_task("velocity", LARGE), {})["robot"]["description"]
    assert load_robot(described) == load_robot(LARGE)


def test_wlr_envs_prints_each_number_with_its_rule(capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    file = tmp_path / "large.yaml"
    file.write_text("base: nominal\nname: wide\nhip_position: {x: 0.35, y: 0.32}\n")
    assert cli.main(["envs", "WLR-Velocity-v0", "--robot", str(file)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["commands.terms.yaw_rate", *["[-0.3,", "0.3]", "->", "[-0.15,", "0.15]", "top_speed", "/", "track_width"]] in lines
    assert ["track_width", "m", "0.32", "->", "0.64", "distance", "of", "left", "and", "right", "wheels"] in lines
    assert cli.main(["envs", "--robot", str(file)]) == 2
