"""A robot of one's own travels by content and fingerprint: what was trained with it finds it by itself, from any folder."""

import copy
from dataclasses import replace
from typing import Any

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config
from wlr_gym.cli.deploy import DeployOptions, driven_robot
from wlr_gym.envs.tasks import load_task
from wlr_gym.envs.tasks.describe import contract
from wlr_gym.learning.evaluation.subjects import common_robot, read_subjects
from wlr_gym.learning.sweep.plan import SweepPlan, resolve
from wlr_gym.learning.training import with_robot
from wlr_gym.policy import environment_for, load_policy, make_policy, policy_environment, write_contract
from wlr_gym.policy.control import PidConfig, known_robot
from wlr_gym.robot import load_robot, robot_content, robot_hash

NOMINAL = load_robot()
HEAVY = robot_content(NOMINAL) | {"name": "heavy", "gravity": 9.0}
TASK = {"observer": {"camera": False}, "observations": {"estimated_traction_use": None}}


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "heavy.yaml"
    path.write_text("base: nominal\nname: heavy\ngravity: 9.0\n")
    return path


@pytest.fixture
def policy(tmp_path):
    """A tuned controller of the heavy robot, as ``wlr train --agent pid --robot`` leaves it."""
    folder = tmp_path / "run" / "policy"
    folder.mkdir(parents=True)
    settings = with_robot({"environment": {"task": TASK}, "yaw_rate_p": 3.0}, HEAVY)
    environment = contract(load_task("velocity", HEAVY, TASK), {})
    pid = PidConfig.model_validate({"yaw_rate_p": 3.0, "environment": settings["environment"]}).model_dump(mode="json")
    write_contract(folder, "pid", pid, environment, {"environment": "WLR-Velocity-v0"})
    return folder.parent


def test_settings_hold_the_robot_by_content(file):
    assert with_robot({"environment": {"robot": str(file)}}) == with_robot({}, file) == {"environment": {"robot": HEAVY}}
    assert with_robot({"seed": 3}) == {"seed": 3}
    with pytest.raises(InputError, match="no file"):
        with_robot({}, file.with_name("heavi.yaml"))


def test_a_sweep_holds_the_robot_by_content(file):
    plan = SweepPlan(environment="WLR-Velocity-v0", settings={"environment": {"robot": str(file)}})
    assert resolve(plan).settings["environment"]["robot"] == HEAVY


def test_a_policy_brings_its_robot(policy, file):
    file.unlink()
    found = environment_for(policy, {"robot": None, "randomization": "ice"})
    assert load_robot(found["robot"]) == load_robot(HEAVY)
    assert found["randomization"] == "ice"
    assert found["task"] == TASK
    assert "robot" not in policy_environment("velocity_blind")
    load_policy(policy, contract(load_task("velocity", found["robot"], found["task"]), {}))


def test_a_robot_that_is_given_holds_and_another_robots_policy_is_refused(policy):
    found = environment_for(policy, {"robot": "nominal"})
    assert found["robot"] == "nominal"
    other = contract(load_task("velocity", found["robot"], found["task"]), {})
    with pytest.raises(InputError, match=r"robot\.(servo|hash) is '2-.*\(robot 'heavy' in the policy, 'wlr-nominal' in the"):
        load_policy(policy, other)


def test_what_is_compared_drives_one_robot(policy):
    subjects = read_subjects(["pid", f"tuned={policy}"])
    assert load_robot(common_robot(subjects)) == load_robot(HEAVY)
    assert common_robot(read_subjects(["pid", "velocity_blind"])) is None


def test_controllers_take_the_environments_robot():
    environment = contract(load_task("velocity", HEAVY), {})
    assert known_robot(environment, None, "pid") == load_robot(HEAVY)
    pid: Any = make_policy("pid", environment)
    assert pid.chassis.robot == load_robot(HEAVY)
    with pytest.raises(InputError, match=r"agent 'pid': robot 'wlr-nominal' is not the environment's \('heavy'\)"):
        known_robot(environment, "nominal", "pid")
    old = copy.deepcopy(environment)
    del old["robot"]["description"]
    with pytest.raises(InputError, match="is not the environment's"):
        known_robot(old, None, "pid")


def test_deploy_drives_the_policys_robot_where_nobody_names_one(policy, file, tmp_path):
    options = DeployOptions(policy=str(policy))
    assert load_robot(driven_robot(options)) == load_robot(HEAVY)
    assert driven_robot(replace(options, robot="nominal")) == "nominal"
    assert driven_robot(DeployOptions(policy="velocity_blind")) is None  # the hardware file's
    wiring = (tmp_path / "wiring.yaml").resolve()
    shipped = find_config("hardware", "nominal").read_text()
    wiring.write_text(shipped.replace("robot: emanual", "robot: heavy.yaml"))
    named = driven_robot(replace(options, hardware=str(wiring)))
    assert robot_hash(load_robot(named)) == robot_hash(load_robot(HEAVY))
    assert named == str(file.resolve())  # it may know more, such as currents
    wiring.write_text(shipped)
    assert driven_robot(replace(options, hardware=str(wiring))) == "emanual"  # which the policy is then refused on
