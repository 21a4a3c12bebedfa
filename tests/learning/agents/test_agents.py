"""Every agent drives every robot of a batch; each does what it says."""

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import agent_names, load_agent, load_agent_config, make_policy, policy_environment
from wlr_gym.robot.parameter_table import ELEMENTS

ENVIRONMENT = "WLR-Velocity-v0"
#: Agents that act on observations alone.
READERS = [name for name in agent_names() if not name.startswith("mppi")]
DELAYS = [index for index, element in enumerate(ELEMENTS) if element.startswith("command.delay[")]


@pytest.fixture(scope="module")
def contract():
    core = make_core(ENVIRONMENT, 1, {})
    yield core.contract()
    core.close()


def observations(contract, **readings):
    """One observation in which the named readings have the given values (SI), all else zero."""
    names = [column["name"] for column in contract["observation"]]
    row = np.zeros((1, len(names)), np.float32)
    for name, value in readings.items():
        column = contract["observation"][names.index(name)]
        row[0, names.index(name)] = column["scale"] * (value - column["offset"])
    return row


@pytest.mark.parametrize("name", READERS)
def test_actions_fit_the_action_space(contract, name):
    policy = make_policy(name, contract)
    readings = np.random.default_rng(0).normal(0, 3, (5, len(contract["observation"]))).astype(np.float32)
    policy.reset(np.ones(5, bool))
    actions = policy.act(readings)
    assert actions.shape == (5, 8)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0


@pytest.mark.parametrize("name", READERS)
def test_a_robot_is_driven_alike_alone_and_in_a_batch(contract, name):
    """Over several ticks: some remember integrals."""
    readings = np.random.default_rng(1).normal(0, 0.1, (4, 6, len(contract["observation"]))).astype(np.float32)

    def acts(robots):
        policy = make_policy(name, contract)
        policy.reset(np.ones(readings[0, robots].shape[0], bool))
        return [policy.act(tick[robots]) for tick in readings]

    together = acts(slice(None))
    alone = np.concatenate([acts(slice(k, k + 1)) for k in range(6)], axis=1)
    np.testing.assert_allclose(together, alone, atol=1e-6)


def test_do_nothing_does_nothing(contract):
    assert not make_policy("do_nothing", contract).act(np.ones((3, len(contract["observation"])))).any()


def test_untrained_is_ppo_before_training(contract):
    readings = np.random.default_rng(2).normal(0, 1, (4, len(contract["observation"]))).astype(np.float32)
    mine = make_policy("untrained", contract).act(readings)
    assert np.array_equal(mine, make_policy("ppo", contract).act(readings))
    other_seed = load_agent("ppo").make_policy(contract, load_agent_config("ppo") | {"seed": 1})
    assert not np.array_equal(mine, other_seed.act(readings))


KNOWS = {
    "ppo_blind": (None, False),
    "ppo_slip_aware": (True, False),
    "ppo_slip_aware_no_camera": (False, False),
    "pid": (None, False),
    "slip_compensating": (True, False),
}


@pytest.mark.parametrize("name", KNOWS)
def test_each_agent_is_told_what_its_name_says(name):
    """The observer with or without a camera, or none; true quantities for the oracle only."""
    core = make_core(ENVIRONMENT, 1, load_agent_config(name)["environment"])
    contract, groups = core.contract(), core.observation_space
    core.close()
    camera, oracle = KNOWS[name]
    sources = {column["source"] for column in contract["observation"]}
    assert (contract["observer"] or {}).get("camera") == camera
    assert ("estimate" in sources) == (camera is not None)
    assert ("truth" in sources) == oracle
    assert (getattr(groups, "spaces", None) is not None) == name.startswith("ppo_")


@pytest.mark.parametrize("task", ["Path", "Posture", "Slope"])
def test_the_blind_know_where_they_are_by_odometry_only(task):
    core = make_core(f"WLR-{task}-v0", 1, load_agent_config("ppo_blind")["environment"])
    contract = core.contract()
    core.close()
    assert contract["observer"] == {"camera": False}
    estimated = {column["name"].partition("[")[0] for column in contract["observation"] if column["source"] == "estimate"}
    assert not estimated
    assert any(column["name"].endswith("_error[lateral]") for column in contract["observation"])


def test_settings_may_lie_over_those_of_another_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("base: ppo\ntotal_steps: 7\nenvironment: {episode_length: 3.0}\n")
    mine, theirs = load_agent_config(path), load_agent_config("ppo")
    assert mine == theirs | {"total_steps": 7, "environment": theirs["environment"] | {"episode_length": 3.0}}


def test_settings_of_a_task_lie_over_the_general_ones_and_changes_over_both(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("{gamma: 0.9, seed: 1, environment: {a: 1}, tasks: {path: {gamma: 0.99, seed: 2, environment: {b: 2}}}}")
    assert load_agent_config(path, task="path") == {"gamma": 0.99, "seed": 2, "environment": {"a": 1, "b": 2}}
    assert load_agent_config(path, ("seed=3",), task="path")["seed"] == 3
    assert load_agent_config(path, task="slope") == {"gamma": 0.9, "seed": 1, "environment": {"a": 1}}


def test_a_change_for_one_task_counts_there(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("{gamma: 0.9}")
    change = ("tasks.path.gamma=0.99",)
    assert load_agent_config(path, change, task="path") == {"gamma": 0.99}
    assert load_agent_config(path, change, task="slope") == {"gamma": 0.9}
    with pytest.raises(InputError, match=r"settings: tasks: unknown task 'pth'.*'path'"):
        load_agent_config(path, ("tasks.pth.gamma=0.99",), task="path")


def test_settings_of_a_task_file_are_found_by_whatever_way_it_is_named(tmp_path, monkeypatch):
    """A registered task is known by the absolute path of its file."""
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "hill.yaml").write_text("")
    path = tmp_path / "mine.yaml"
    for name in ("tasks/hill.yaml", "./tasks/../tasks/hill.yaml", tmp_path / "tasks" / "hill.yaml"):
        path.write_text(f"{{gamma: 0.9, tasks: {{{name}: {{gamma: 0.99}}}}}}")
        assert load_agent_config(path, task=str(tmp_path / "tasks" / "hill.yaml")) == {"gamma": 0.99}
        assert load_agent_config(path, task="path") == {"gamma": 0.9}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tasks: 5", r"mine\.yaml: tasks = 5: expected a mapping"),
        ("tasks: {path: 5}", r"mine\.yaml: tasks.path = 5: expected a mapping"),
        ("{gamma: 0.9, tasks: {pth: {gamma: 0.99}}}", r"mine\.yaml: tasks: unknown task 'pth'.*'path'"),
        ("base: mine.yaml", "is its own base"),
        ("base: 5", "base = 5: expected the name"),
        ("base: ppo_blnd", "did you mean 'ppo_blind'"),
    ],
)
def test_files_that_mean_nothing_are_refused(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match=message):
        load_agent_config("mine.yaml", task="path")


def test_a_base_is_looked_for_beside_the_file(tmp_path):
    (tmp_path / "base.yaml").write_text("{gamma: 0.9, seed: 1}")
    path = tmp_path / "mine.yaml"
    path.write_text("{base: base.yaml, seed: 2}")
    assert load_agent_config(path) == {"gamma": 0.9, "seed": 2}
    (tmp_path / "base.yaml").write_text(f"base: ../{tmp_path.name}/mine.yaml")
    with pytest.raises(InputError, match="is its own base"):
        load_agent_config(path)


def test_what_a_file_says_lies_over_its_base_for_every_task(tmp_path):
    base, path = tmp_path / "base.yaml", tmp_path / "mine.yaml"
    base.write_text("{gamma: 0.9, seed: 1, tasks: {path: {gamma: 0.99, seed: 2}}}")
    path.write_text(f"base: {base}\ngamma: 0.95\n")
    assert load_agent_config(path, task="path") == {"gamma": 0.95, "seed": 2}


@pytest.mark.parametrize("task", ["velocity", "path", "posture", "slope"])
@pytest.mark.parametrize("name", ["ppo", "ppo_slip_aware", "ppo_slip_aware_no_camera", "ppo_blind"])
def test_settings_of_every_task_are_valid(name, task):
    settings = load_agent_config(name, task=task)
    core = make_core(f"WLR-{task.title()}-v0", 1, settings["environment"])
    load_agent("ppo").make_policy(core.contract(), settings)
    core.close()


@pytest.mark.slow
@pytest.mark.parametrize("config", ["ppo_slip_aware", "ppo_blind"])
@pytest.mark.parametrize("task", ["velocity", "path", "posture", "slope"])
def test_what_is_learnt_from_comes_later_than_what_is_scored(task, config):
    """Training draws commands late, alike for all joints; scores have the task's own."""
    latest = 0.045 if task == "velocity" else 0.03
    learnt, scored = _learnt_and_scored(task, config)
    late = learnt[:, DELAYS]
    assert late.min() < 0.005
    assert 0.8 * latest < late.max() <= latest
    np.testing.assert_array_equal(late, late[:, [0]].repeat(8, axis=1))
    assert scored[:, DELAYS].max() <= 0.01


def _learnt_and_scored(task, config):
    """Parameters (episodes, elements) that training draws, and those that the scores of the shipped policy draw."""
    environment = f"WLR-{task.capitalize()}-v0"
    shipped = f"{task}_{config.removeprefix('ppo_')}"
    settings = load_agent_config(config, task=task)["environment"]
    return [_drawn(make_core(environment, 64, keywords)) for keywords in (settings, policy_environment(shipped))]


def _drawn(core):
    """Parameters of the first episodes of seeds 0, 1, ..."""
    for robot in range(core.count):
        core.seed(robot, robot)
    core.begin_episodes(core.everyone)
    values = core.parameters.values.copy()
    core.close()
    return values


def test_unknown_agent_names_the_nearest():
    with pytest.raises(InputError, match="did you mean 'constant_command'"):
        load_agent("constant_comand")


@pytest.mark.parametrize(
    ("name", "setting", "message"),
    [
        ("ppo", {"learning_rat": 1e-3}, "did you mean 'learning_rate'"),
        ("ppo", {"batch_size": 1000}, "does not divide"),
        ("ppo", {"gamma": 1.5}, "gamma = 1.5"),
        ("pid", {"yaw_rate_pp": 1.0}, "did you mean 'yaw_rate_p'"),
        ("pid", {"tasks": {"velocity": {"steerin": 1.0}}}, "task 'velocity': unknown key 'steerin'"),
        ("slip_compensating", {"slip_limit": 0.0}, "slip_limit = 0.0"),
    ],
)
def test_bad_settings_are_named(contract, name, setting, message):
    with pytest.raises(InputError, match=message):
        load_agent(name).make_policy(contract, load_agent_config(name) | setting)


@pytest.mark.parametrize(("change", "message"), [("total_steps", "expected name=value"), ("seed.x=1", "a value, not a group")])
def test_bad_changes_are_named(change, message):
    with pytest.raises(InputError, match=message):
        load_agent_config("ppo", ("seed=3", change))


def test_changes_reach_nested_settings():
    config = load_agent_config("ppo", ("environment.precision=float64", "learning_rate=5e-4"))
    assert config["environment"]["precision"] == "float64"
    assert config["learning_rate"] == 5e-4
