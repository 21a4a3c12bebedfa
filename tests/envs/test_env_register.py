"""Environments that are registered from a task file, and the versions of those that ship."""

import pickle
import subprocess
import sys

import gymnasium as gym
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.envs import Sb3VecEnv, WlrEnv, register_task
from wlr_gym.envs.interfaces import VelocityEnv
from wlr_gym.envs.registry import ENVIRONMENTS, title_of
from wlr_gym.envs.tasks.task import read_task

TASK = """
name: {name}
summary: Turn on the spot.
history: {{v0: first version, v1: turns faster}}
control_period: 0.02
episode_length: 1.0
action: {{leg_scale: 0.4, wheel_scale: 6.0}}
commands: {{hold_time: [2.0, 4.0], terms: {{yaw_rate: [-0.5, 0.5]}}}}
observations: {{command: {{}}, gyro: {{}}}}
rewards: {{track_yaw_rate: {{weight: 1.0}}}}
"""


@pytest.fixture
def registry():
    """Keep both registries as they are."""
    known = dict(ENVIRONMENTS)
    yield
    for env_id in set(ENVIRONMENTS) - set(known):
        del ENVIRONMENTS[env_id], gym.registry[env_id]


@pytest.fixture
def task(tmp_path):
    path = tmp_path / "my_task.yaml"
    path.write_text(TASK.format(name="turn_about"))
    return path


def test_a_task_file_becomes_an_environment(registry, task):
    assert register_task(task) == register_task(task) == "WLR-TurnAbout-v1"
    env = gym.make("WLR-TurnAbout-v1", robot="nominal")
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert pickle.loads(pickle.dumps(env.unwrapped)).core.task.config.name == "turn_about"
    batch = gym.make_vec("WLR-TurnAbout-v1", num_envs=2)
    assert batch.reset(seed=0)[0].shape == (2, 4)


def test_a_task_file_means_the_files_beside_it(registry, task, tmp_path, monkeypatch):
    """Not those of the working folder, by whatever way it becomes an environment."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for folder, name in ((tmp_path, "beside"), (elsewhere, "other")):
        (folder / "own_robot.yaml").write_text(f"base: nominal\nname: {name}\n")
        (folder / "own_floor.yaml").write_text(f"base: ice\nname: {name}\n")
    task.write_text(task.read_text() + "robot: own_robot.yaml\nrandomization: own_floor.yaml\n")
    monkeypatch.chdir(elsewhere)
    for env in (gym.make("WLR-Velocity-v0", task=str(task)).unwrapped, gym.make(register_task(task)).unwrapped):
        assert isinstance(env, WlrEnv)
        core = env.core
        assert (core.task.robot.name, core.randomization.config.name) == ("beside", "beside")


def test_a_task_travels_in_its_spec(registry, task, tmp_path):
    """A worker needs neither the id nor the file; Ray pickles, ``spawn`` starts a fresh Python."""
    env_id = register_task(task)
    spec = gym.make(env_id, task={"episode_length": 0.5}).spec
    assert spec is not None
    (tmp_path / "spec.json").write_text(spec.to_json())
    (tmp_path / "spec.pickle").write_bytes(pickle.dumps([gym.spec(env_id), gym.make(env_id).unwrapped]))
    task.unlink()
    code = (
        "import pathlib, pickle, gymnasium as gym;"
        "spec = gym.envs.registration.EnvSpec.from_json(pathlib.Path('spec.json').read_text());"
        "plain, env = pickle.loads(pathlib.Path('spec.pickle').read_bytes());"
        "made = [gym.make(spec), gym.make(plain), env, gym.make_vec(plain, num_envs=2)];"
        "print(*[each.unwrapped.core.limit for each in made], *[each.reset(seed=0)[0].sum() for each in made[1:3]])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    limits, sums = done.stdout.split()[:4], done.stdout.split()[4:]
    assert limits == ["25", "50", "50", "50"]
    assert sums[0] == sums[1]


def test_workers_of_a_vector_environment_know_the_task(registry, task):
    env_id = register_task(task)
    env = gym.make_vec(env_id, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    try:
        observation = env.reset(seed=0)[0]
    finally:
        env.close()
    assert (observation == gym.make_vec(env_id, num_envs=2).reset(seed=0)[0]).all()


@pytest.mark.slow
def test_a_pickled_batch_of_stable_baselines3_knows_the_task_elsewhere(registry, task, tmp_path):
    """So does the evaluation once the file is gone: the spec holds the whole task."""
    from wlr_gym.learning.evaluation.rollout import make_core

    env_id = register_task(task)
    (tmp_path / "env.pkl").write_bytes(pickle.dumps(Sb3VecEnv(env_id, 2)))
    task.unlink()
    assert make_core(env_id, 1, {}).task.config.name == "turn_about"
    code = "import pickle, sys; env = pickle.load(open(sys.argv[1], 'rb')); env.reset(); print(env.num_envs)"
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path / "env.pkl")], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "2"


def test_a_task_that_is_registered_again_is_what_it_says_now(registry, task):
    env_id = register_task(task)
    task.write_text(task.read_text().replace("weight: 1.0", "weight: 3.0"))
    assert register_task(task) == env_id
    env = Sb3VecEnv(env_id, 1)
    assert env.core.task.config.rewards["track_yaw_rate"]["weight"] == 3.0


def test_the_contents_of_a_task_are_for_classes_without_one():
    for make in (lambda: WlrEnv(), lambda: VelocityEnv(definition={"name": "x"})):
        with pytest.raises(InputError, match="definition"):
            make()


def test_an_id_is_not_taken_twice(registry, task, tmp_path):
    register_task(task)
    other = tmp_path / "other.yaml"
    other.write_text(TASK.format(name="turn_about"))
    with pytest.raises(InputError, match=r"'WLR-TurnAbout-v1' is the task .*my_task\.yaml' already"):
        register_task(other)


def test_each_version_is_its_own_environment(registry, task, tmp_path):
    register_task(task)
    newer = tmp_path / "newer.yaml"
    changed = TASK.replace("v1: turns faster", "v1: faster, v2: longer").replace("episode_length: 1.0", "episode_length: 3.0")
    newer.write_text(changed.format(name="turn_about"))
    assert register_task(newer) == "WLR-TurnAbout-v2"
    assert [gym.make(f"WLR-TurnAbout-v{n}").unwrapped.core.limit for n in (1, 2)] == [50, 150]  # type: ignore[attr-defined]
    assert [gym.make_vec(f"WLR-TurnAbout-v{n}", num_envs=2).core.limit for n in (1, 2)] == [50, 150]  # type: ignore[attr-defined]


def test_another_version_of_a_shipped_task_is_not_the_shipped_one(registry, tmp_path):
    path = tmp_path / "velocity.yaml"
    path.write_text(TASK.format(name="velocity"))
    assert register_task(path) == "WLR-Velocity-v1"
    assert gym.make("WLR-Velocity-v1").unwrapped.core.task.commands == ("yaw_rate",)  # type: ignore[attr-defined]
    assert len(gym.make("WLR-Velocity-v0").unwrapped.core.task.commands) == 2  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("old", "new"),
    [("name: turn_about", "name: turn about"), ("name: turn_about", "name: ''"), ("v1: turns", "second: turns")],
)
def test_what_can_be_no_id_is_refused(registry, task, old, new):
    task.write_text(task.read_text().replace(old, new))
    known = set(ENVIRONMENTS)
    with pytest.raises(InputError, match="pattern"):
        register_task(task)
    assert set(ENVIRONMENTS) == known


def test_a_broken_file_is_refused(registry, tmp_path):
    path = tmp_path / "task.yaml"
    path.write_text("name: nothing\n")
    with pytest.raises(InputError, match="'control_period' is missing"):
        register_task(path)
    assert "WLR-Nothing-v0" not in ENVIRONMENTS


def test_versions_of_ids_are_the_last_of_the_history():
    for env_id, name in ENVIRONMENTS.items():
        config = read_task(name)
        assert env_id == f"WLR-{title_of(name)}-{list(config.history)[-1]}"
        assert config.summary
