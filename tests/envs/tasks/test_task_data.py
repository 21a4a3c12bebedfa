"""Tasks as data: bad data is refused with the nearest valid name; tables and contract tell the truth."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import overlay
from wlr_gym.envs.tasks import contract, describe, load_task
from wlr_gym.envs.tasks.describe import column_name, task_sections
from wlr_gym.envs.tasks.task import bounds
from wlr_gym.envs.tasks.terms import TERMINATIONS
from wlr_gym.robot import load_robot


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
        ({"commands": {"hold_time": [0.0, 1.0]}}, "above 0 s"),
        ({"latency": {"imu": {"delay": [-0.01, 0.0]}}}, "younger than 0 s"),
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
