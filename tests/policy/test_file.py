"""The policy folder and its contract: what is refused, and how the refusal reads."""

import copy
import json

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks import contract as task_contract
from wlr_gym.envs.tasks import load_task
from wlr_gym.envs.tasks.task import ObserverConfig
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import check_contract, load_policy, read_contract, write_contract
from wlr_gym.policy.file import DEFAULTS
from wlr_gym.robot import Robot, load_robot


@pytest.fixture(scope="module")
def contract():
    core = make_core("WLR-Velocity-v0", 1, {})
    yield json.loads(json.dumps(core.contract()))
    core.close()


@pytest.fixture
def folder(tmp_path, contract):
    write_contract(tmp_path, "do_nothing", {}, contract, {"steps": 0})
    return tmp_path


def changed(contract, change):
    other = copy.deepcopy(contract)
    change(other)
    return other


def test_contract_survives_writing_and_reading(folder, contract):
    saved = read_contract(folder)
    assert saved["environment"] == contract
    assert "numpy" in saved["versions"]
    check_contract(saved["environment"], contract, "here")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["robot"].update(hash="0"), r"robot\.hash"),
        (lambda c: c.update(control_period=0.04), r"control_period is 0\.02 in the policy, 0\.04 in the environment"),
        (lambda c: c["observation"][3].update(scale=9.0), r"observation\[3\]\.scale"),
        (lambda c: c["observation"][3].update(limit=9.0), r"observation\[3\]\.limit"),
        (lambda c: c["observation"][5].update(unit="deg"), r"observation\[5\]\.unit"),
        (lambda c: c["observation"].insert(0, c["observation"].pop(1)), r"observation\[0\]\.name"),
        (lambda c: c["observation"].pop(), r"length of observation is (\d+) in the policy, \d+ in the environment"),
        (lambda c: c["action"][0].update(centre=1.0), r"action\[0\]\.centre"),
    ],
)
def test_first_difference_is_named(contract, change, message):
    with pytest.raises(InputError, match=message):
        check_contract(contract, changed(contract, change), "policy")


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.update(randomization={"name": "wide"}),
        lambda c: c["observation"][2].update(noise=0.3),
        lambda c: c["commands"].clear(),
    ],
)
def test_other_conditions_are_not_refused(contract, change):
    check_contract(contract, changed(contract, change), "policy")


def test_commands_beyond_those_of_the_training_are_a_condition(contract):
    core = make_core("WLR-Velocity-v0", 1, {"task": {"commands": {"terms": {"yaw_rate": [-2.5, 2.5]}}}})
    assert [column["limit"] for column in core.contract()["observation"][:2]] == [2.0, 2.5]
    check_contract(contract, core.contract(), "policy")


def contract_with(motor):
    """Contract of an environment of a robot with the e-manual's currents and ``motor`` numbers of its legs."""
    data = load_robot("emanual").model_dump()
    data["servo"]["leg"].update(motor)
    core = make_core("WLR-Velocity-v0", 1, {"robot": Robot.model_validate(data)})
    core.close()
    return core.contract()


def test_currents_of_the_motors_are_not_refused(contract):
    check_contract(contract, contract_with({}), "policy")
    check_contract(contract, contract_with({"stall_current": 4.0, "no_load_current": 0.3}), "policy")


@pytest.mark.parametrize("motor", [{"stall_torque": 7.0}, {"no_load_speed": 5.6}])
def test_another_torque_speed_line_is_refused(contract, motor):
    with pytest.raises(InputError, match=r"robot\.(hash|servo) is .* \(robot 'wlr-nominal' in the policy, 'wlr-emanual'"):
        check_contract(contract, contract_with(motor), "policy")


def flow_contract(changes, **sensors):
    """Contract of the robot with a flow sensor, some of whose numbers are others, in a task that shows it."""
    robot = load_robot({"base": "flow", "name": "flow", "sensors": {"flow": changes}})
    return task_contract(load_task("velocity", robot, {"observations": {"flow": {}}, "sensors": sensors}), {})


@pytest.mark.parametrize("sensors", [{}, {"flow": 0.5}])
def test_another_flow_sensor_is_refused_where_the_policy_reads_it(contract, sensors):
    reads, other = flow_contract({}, **sensors), flow_contract({"counts_per_pixel": 20.0})
    none = task_contract(load_task("velocity", "emanual", {"observations": {"flow": {}}}), {})
    check_contract(reads, flow_contract({}), "policy")
    with pytest.raises(InputError, match=r"sensors\.flow\.counts_per_pixel is 10\.0 in the policy, 20\.0 in the environment"):
        check_contract(reads, other, "policy")
    if sensors:  # it did without at times
        check_contract(reads, none, "policy")
    else:
        with pytest.raises(InputError, match=r"sensors\.flow is .* in the policy, None in the environment"):
            check_contract(reads, none, "policy")
    check_contract(contract, task_contract(load_task("velocity", "flow"), {}), "policy")


@pytest.mark.parametrize("absent", DEFAULTS)
def test_an_absent_key_means_its_default(contract, absent):
    contract = {"controller": None} | contract  # left out where there is none
    group, _, key = absent.partition(".")

    def forget(c):
        entries = c[group] if isinstance(c[group], list) else [c[group] or {}]
        for entry in entries if key else ():
            if entry.get(key) == DEFAULTS[absent]:
                del entry[key]
        if not key and c[group] is None:
            del c[group]

    def differ(c):
        forget(c)
        entries = c[group] if isinstance(c[group], list) else [c[group]]
        entries[0][key] = "other"

    older = changed(contract, forget)
    check_contract(older, contract, "policy")
    check_contract(contract, older, "policy")
    if key and contract[group]:
        with pytest.raises(InputError, match=rf"{key} is .* in the policy, 'other' in the environment"):
            check_contract(older, changed(contract, differ), "policy")


def test_the_observers_defaults_are_those_of_its_settings():
    defaults = {key.partition(".")[2]: value for key, value in DEFAULTS.items() if key.startswith("observer.")}
    assert defaults == ObserverConfig().model_dump()


def test_the_name_of_the_robot_does_not_matter(contract):
    check_contract(contract, changed(contract, lambda c: c["robot"].update(name="other")), "policy")


def test_the_environment_itself_decides(folder):
    core = make_core("WLR-Velocity-v0", 1, {"task": {"action": {"wheel_scale": 3.0}}})
    write_contract(folder, "ppo", {}, read_contract(folder)["environment"], {})
    with pytest.raises(InputError, match=r"action\[4\]\.scale is 6\.0 in the policy, 3\.0 in the environment"):
        load_policy(folder, core.contract())
    core.close()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "line 1, column 2: broken JSON"),
        (b'{"format": 99}', "not a policy contract of format 1"),
        (b"[]", "not a policy contract"),
        (b'{"format": 1, "agent": "ppo"}', "'environment' is missing"),
        (b"\xff\xfe", "cannot be read"),
    ],
)
def test_broken_contracts_are_refused(tmp_path, content, message):
    (tmp_path / "contract.json").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_contract(tmp_path)
