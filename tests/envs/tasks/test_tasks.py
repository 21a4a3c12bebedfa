"""Tasks as data: what ships, names of terms, numbers that follow the robot, what the docs show."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import yaml

from wlr_gym import cli
from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import overlay
from wlr_gym.envs.registry import ENVIRONMENTS
from wlr_gym.envs.tasks import contract, describe, load_randomization, load_task
from wlr_gym.envs.tasks.describe import column_name, task_sections
from wlr_gym.envs.tasks.scaling import QUANTITIES, check_rule, ratio
from wlr_gym.envs.tasks.task import bounds, read_task
from wlr_gym.envs.tasks.terms import COMPUTED, POLICY_TERMS, POSITIVE, REWARDS, TERMINATIONS, computed, registered
from wlr_gym.robot import load_robot, robot_content


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ({"rewards": {"slipp": {"weight": -1.0}}}, "did you mean 'slip'"),
        ({"rewards": {"slip": {"sped": 1.0}}}, "did you mean 'speed'"),
        ({"rewards": {"alive": {}}}, "lacks 'weight'"),
        ({"rewards": {"slip": {"weight": "much"}}}, "rewards.slip.weight = 'much'"),
        ({"rewards": {"slip": {"weight": float("nan")}}}, "finite"),
        ({"observations": {"gyroscope": {}}}, "did you mean 'gyro'"),
        ({"observations": {"gyro": {"nois": 0.1}}}, "did you mean 'noise'"),
        ({"observations": {"gyro": {"history": 0}}}, "observations.gyro.history = 0"),
        ({"privileged": {"position_of_all": {}}}, "did you mean 'position'"),
        ({"terminations": {"tilted": {}}}, "did you mean 'tilt'"),
        ({"commands": {"terms": {"yaw": [0, 1]}}}, "did you mean 'yaw_rate'"),
        ({"commands": {"terms": {"yaw_rate": [1, 0]}}}, "low <= high"),
        ({"commands": {"hold_time": [0.0, 1.0]}}, "commands.hold_time.0 = 0.0: expected more than 0"),
        ({"latency": {"imu": {"delay": [-0.01, 0.0]}}}, "latency.imu.delay.0 = -0.01: expected 0 or more"),
        ({"latency": {"radar": {"delay": [0, 0]}}}, "radar"),
        ({"episode_length": 0.03}, "whole number of control periods"),
        ({"episode_lenght": 10.0}, "did you mean 'episode_length'"),
        ({"observations": None}, "'observations' is missing"),
        (
            {"observations": {"estimated_slip_velcity": None}},
            "unknown observation term.*did you mean 'estimated_slip_velocity'",
        ),
        ({"privileged": {"positoin": None}}, "did you mean 'position'"),
        ({"rewards": {"slipp": None}}, "did you mean 'slip'"),
        ({"terminations": {"tillt": None}}, "did you mean 'tilt'"),
        ({"measures": {"velocity_eror": None}}, "did you mean 'velocity_error'"),
    ],
)
def test_bad_data_names_the_place_and_the_nearest_valid_name(robot, overrides, expected):
    with pytest.raises(InputError, match=expected.replace("(", r"\(")):
        load_task("velocity", robot, overrides)


def test_the_contract_has_the_observer_where_the_policy_is_fed_its_estimate(robot):
    blind = {name: None for name in load_task("velocity", robot).config.observations if name.startswith("estimated_")}
    changes = {"observations": blind, "rewards": {"estimate_error": {"weight": -0.1}}, "observer": {"camera": False}}
    task = load_task("velocity", robot, changes)
    assert task.needs_observer
    assert contract(task, {})["observer"] is None
    shown = load_task("velocity", robot, {"observer": {"camera": False}})
    assert contract(shown, {})["observer"] == {"camera": False}


def test_a_known_term_that_is_not_there_may_be_removed(robot):
    """One set of changes serves several tasks."""
    assert load_task("velocity", robot, {"observations": {"path_error": None}}) == load_task("velocity", robot)


def test_a_termination_needs_its_commands(robot, monkeypatch):
    def far_off(signals):
        return signals.command("path_offset") - 1.0

    monkeypatch.setitem(TERMINATIONS, "tilt", replace(TERMINATIONS["tilt"], function=far_off))
    with pytest.raises(InputError, match="termination term 'tilt' needs the command 'path_offset'"):
        load_task("velocity", robot)


def test_unknown_task_and_broken_file(robot, tmp_path):
    with pytest.raises(InputError, match="did you mean 'velocity'"):
        load_task("velocit", robot)
    broken = tmp_path / "task.yaml"
    broken.write_text("name: [velocity\n")
    with pytest.raises(InputError, match="line"):
        load_task(broken, robot)


def test_overlay_merges_and_removes():
    base = {"a": {"b": 1, "c": 2}, "d": 3}
    assert overlay(base, {"a": {"b": 5}, "d": None}) == {"a": {"b": 5, "c": 2}}
    assert base == {"a": {"b": 1, "c": 2}, "d": 3}


def test_history_and_limits_shape_the_observation(robot):
    task = load_task("velocity", robot, {"observations": {"gyro": {"history": 3, "scale": 2.0, "limit": 4.0}}})
    gyro = [column for column in task.policy if column.term == "gyro"]
    assert [column.lag for column in gyro] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    low, high = bounds(tuple(gyro))
    assert np.all(high == 8.0)
    assert np.all(low == -8.0)


def test_only_measurable_quantities_are_policy_terms(robot):
    assert {column.source for column in load_task("velocity", robot).policy} <= {
        "sensors",
        "command",
        "action",
        "estimate",
        "computed",
    }


def test_sections_have_every_column_in_order(robot):
    task = load_task("velocity", robot, {"observations": {"gyro": {"history": 2}, "leg_velocity": {"noise": 0.1, "bias": 0.2}}})
    action, policy, privileged = (
        [dict(zip(section.headings, row, strict=True)) for row in section.rows]
        for section in task_sections(task)
        if "index" in section.headings
    )
    assert ", ".join(row["joints"] for row in action) == ", ".join(robot.joints)
    for rows, columns in ((policy, task.policy), (privileged, task.privileged)):
        told = iter(enumerate(columns))
        for row in rows:
            parts = [part.split(", ") for part in row["components"].split(": each ")]
            components = [] if parts == [["-"]] else [",".join(pair) for pair in product(*parts)]
            same = [next(told) for _ in components or "-"]
            assert row["index"] == "-".join(dict.fromkeys(str(index) for index in (same[0][0], same[-1][0])))
            term, _, lag = row["name"].partition(", lag ")
            assert [column_name(column) for _, column in same] == ([f"{term}[{one}]" for one in components] or [term])
            units = row["unit"].split(", ")
            assert [column.unit for _, column in same] == (units if len(units) > 1 else len(same) * units)
            assert {(column.frame, column.lag) for _, column in same} == {(row["frame"], int(lag.split()[0] if lag else 0))}
        assert not list(told)
    assert {row["name"]: row["noise"] for row in policy}["leg_velocity"] == "0.02398 + 0.1, bias 0.2"


def test_the_text_has_what_the_task_says(robot):
    lines = describe(load_task("velocity", robot)).splitlines()
    assert "**Observation** Box((52,), float32): value = scale * clip(reading - offset, +-limit)." in "\n".join(lines)
    rule = next(k for k, line in enumerate(lines) if line.startswith("="))
    assert lines[rule] == lines[rule + 2] == lines[rule + 5]
    assert lines[rule + 3].split("  ")[0] == "leg_lf, leg_rf, leg_lr, leg_rr"
    changed = describe(
        load_task("velocity", robot, {"observations": {"gyro": {"scale": 0.123}}, "rewards": {"slip": {"speed": 0.777}}})
    )
    assert "0.123" in changed
    assert "speed 0.777" in changed


def test_contract_is_plain_data_and_complete(robot):
    task = load_task("velocity", robot)
    made = contract(task, {"name": "none"})
    assert json.loads(json.dumps(made)) == made
    assert len(made["observation"]) == len(task.policy)
    assert [entry["joint"] for entry in made["action"]] == list(robot.joints)
    assert made["action"][0]["low"] == robot.leg_limits[0]
    assert made["control_period"] == 0.02
    other = robot.model_copy(update={"gravity": 9.8})
    assert contract(load_task("velocity", other), {})["robot"]["hash"] != made["robot"]["hash"]


# ---- names of terms belong to one function each ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "decorator"),
    [
        ("slip", registered(REWARDS)),
        ("path_error", computed(unit="m", frame="path", limit=1.0)),
        ("gyro", computed(unit="rad/s", frame="body", limit=1.0)),
    ],
)
def test_a_name_that_is_taken_is_refused(name, decorator):
    def other(signals):
        """Something else."""
        return 0.0

    other.__name__ = name
    before = REWARDS["slip"], COMPUTED["path_error"], POLICY_TERMS["gyro"]
    with pytest.raises(InputError, match=f"'{name}' of .* has one of that name"):
        decorator(other)
    assert (REWARDS["slip"], COMPUTED["path_error"], POLICY_TERMS["gyro"]) == before


def test_a_range_belongs_to_a_parameter():
    def quick(signals, *, speed=1.0):
        """Something else."""
        return 0.0

    with pytest.raises(InputError, match=r"term 'quick' of .*: unknown parameter 'sped' \(did you mean 'speed'\?\)"):
        registered(REWARDS, sped=POSITIVE)(quick)
    assert "quick" not in REWARDS


def test_the_same_function_may_come_again():
    assert registered(REWARDS)(REWARDS["alive"].function) is REWARDS["alive"].function


# --- scaling of a task's numbers to the robot -------------------------------------------------------------------------


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


# ---- docs/randomization.md says what the code does -------------------------------------------------------------------


ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "randomization.md").read_text(encoding="utf-8")


def test_the_examples_load(tmp_path):
    late, copy, whole = re.findall("```yaml\n(.*?)```", TEXT, re.S)
    (tmp_path / "mine.yaml").write_text(copy)
    assert load_robot(tmp_path / "mine.yaml").tolerances["body.com_offset"].legs == 0.003
    late, whole = yaml.safe_load(late), yaml.safe_load(whole)
    delay = load_randomization(late, load_robot()).config.events["command_delay"]
    assert (delay.low, delay.high) == (0.0, 0.03)
    events = load_randomization(whole, load_robot()).config.events
    assert (events["floor_friction"].low, events["floor_friction"].high) == (0.2, 0.9)
    assert "body_mass" not in events
    assert {"wear", "gust", "wet_strip"} < set(events)


def test_the_recording_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    example = re.findall("```python\n(.*?)```", TEXT, re.S)[-1]
    names: dict = {}
    exec("import gymnasium as gym, wlr_gym\n" + example, names)
    assert names["again"]["pos_leg_lf"].tolist() == names["run"]["pos_leg_lf"].tolist()
    assert (tmp_path / "runs" / "run_01.simulation.yaml").is_file()
