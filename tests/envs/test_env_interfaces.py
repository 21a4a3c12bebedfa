"""Three faces, one robot: Gymnasium single and vector, calling conventions, autoreset, errors."""

import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from velocity import ID, TIMED, make, make_vec

from wlr_gym.base.errors import InputError
from wlr_gym.envs.interfaces import VelocityEnv, VelocityVectorEnv
from wlr_gym.envs.settings import EnvironmentOptions

SHORT = {"episode_length": 0.4, "randomization": "wide"}


def actions_for(steps, count, seed=3):
    return np.random.default_rng(seed).uniform(-1, 1, (steps, count, 8)).astype(np.float32)


# ---- Gymnasium's own checks ----


@pytest.mark.parametrize("observation", ["policy", "dict"])
@pytest.mark.parametrize("randomization", ["none", "wide"])
def test_gymnasium_check_env_without_a_warning(fake, observation, randomization):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(observation=observation, randomization=randomization), skip_render_check=True)  # test_env_pictures


def test_ways_to_make_it(fake):
    assert str(gym.make(f"wlr_gym:{ID}").unwrapped) == f"<VelocityEnv<{ID}>>"
    assert gym.make_vec(f"wlr_gym:{ID}", num_envs=2).num_envs == 2
    assert make_vec(2, vectorization_mode="sync").num_envs == 2
    limited = make_vec(2, max_episode_steps=3)
    limited.reset(seed=0)
    flags = [limited.step(np.zeros((2, 8)))[3].tolist() for _ in range(3)]
    assert flags == [[False] * 2, [False] * 2, [True] * 2]


def test_spec_and_pickle_round_trips(fake):
    env: Any = gym.make(ID, randomization="wide", task={"episode_length": 1.0})
    spec = EnvSpec.from_json(env.spec.to_json())
    copies = [gym.make(spec), pickle.loads(pickle.dumps(env.unwrapped)), env.spec.make()]
    expected = env.reset(seed=4)[0]
    for copy in copies:
        assert np.array_equal(copy.reset(seed=4)[0], expected)
        assert copy.unwrapped.core.limit == 50


def test_a_vector_environment_is_pickled_by_its_arguments(fake):
    env = make_vec(3, autoreset_mode="SameStep", max_episode_steps=5, randomization="wide")
    copy = pickle.loads(pickle.dumps(env))
    assert (copy.num_envs, copy.autoreset_mode, copy.core.limit) == (3, AutoresetMode.SAME_STEP, 5)
    assert np.array_equal(copy.reset(seed=4)[0], env.reset(seed=4)[0])


def test_options_are_keywords():
    options = EnvironmentOptions(plant="mujoco", episode_length=3.0)
    assert dict(**options) == {"backend": "mujoco", "episode_length": 3.0}
    assert EnvironmentOptions(**options) == EnvironmentOptions(backend="mujoco", episode_length=3.0)


def test_the_second_word_for_the_backend(fake):
    assert make(plant="mujoco").core.settings.backend == "mujoco"
    assert make_vec(2, plant="mujoco", backend="mujoco").core.settings.backend == "mujoco"
    with pytest.raises(InputError, match="plant = 'mujoco' and backend = 'gibbs_appell'"):
        make(plant="mujoco", backend="gibbs_appell")


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
def test_an_unknown_keyword_is_what_python_raises_for_one(make):
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'frameskip'") as caught:
        make(ID, frameskip=2)
    assert isinstance(caught.value, InputError)


def test_the_spec_knows_when_episodes_end(fake):
    for env in (gym.make(ID, episode_length=1.0), gym.make_vec(ID, num_envs=2, episode_length=1.0)):
        assert env.spec is not None
        assert env.spec.max_episode_steps == 50
    assert gym.spec(ID).max_episode_steps is None  # or gym.make would cut longer episodes short
    env = gym.wrappers.TimeAwareObservation(gym.make(ID, episode_length=1.0))
    env.reset(seed=0)
    ends = [env.step(np.zeros(8, np.float32))[3] for _ in range(50)]
    assert ends == [False] * 49 + [True]
    assert make(episode_length=60.0).spec.max_episode_steps == 3000
    assert make_vec(2, max_episode_steps=7).spec.max_episode_steps == 7


@pytest.mark.parametrize("kind", [VelocityEnv, VelocityVectorEnv])
def test_an_environment_that_is_made_or_pickled_as_a_class_has_a_spec_as_well(fake, kind):
    made = kind(episode_length=1.0)
    for env in (made, pickle.loads(pickle.dumps(made))):
        assert (env.spec.id, env.spec.max_episode_steps, env.spec.kwargs) == (ID, 50, {"episode_length": 1.0})
    remade: Any = gym.make(made.spec, max_episode_steps=-1).unwrapped
    assert remade.core.limit == 50


def test_a_batch_has_the_methods_of_gymnasiums_vector_environments(fake):
    env, loop = make_vec(3), make_vec(3, vectorization_mode="sync")
    env.reset(seed=0)
    assert env.get_attr("render_mode") == loop.get_attr("render_mode") == (None,) * 3
    assert [one["task"] for one in env.call("contract")] == ["velocity"] * 3
    env.call("set_command", linear_velocity_x=0.02)
    assert env.core.command[:, 0].tolist() == [0.02] * 3
    env.set_attr("note", [7] * 3)
    env.set_attr("other", 8)
    assert env.call("note") + env.get_attr("other") == (7, 7, 7, 8, 8, 8)
    for values in ([1, 2, 3], [1, 1]):
        with pytest.raises(InputError, match="shared by all 3 robots"):
            env.set_attr("note", values)


def test_contract_names_the_task_robot_and_randomization(fake):
    for env in (make(randomization="wide"), make_vec(2, randomization="wide")):
        contract = env.contract()
        assert (contract["task"], contract["robot"]["name"], contract["randomization"]["name"]) == (
            "velocity",
            "wlr-nominal",
            "wide",
        )
        assert len(contract["observation"]) == 52
        assert contract["observer"] == {"camera": True}


# ---- errors ----


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"randomisation": "none"}, "did you mean 'randomization'"),
        ({"randomization": "wid"}, "did you mean 'wide'"),
        ({"randomization": {"event": {}}}, "did you mean 'events'"),
        ({"robot": "nominl"}, "did you mean 'nominal'"),
        ({"robot": "paper"}, "cannot be simulated"),
        ({"task": {"reward": {}}}, "did you mean 'rewards'"),
        ({"task": "velocit"}, "did you mean 'velocity'"),
        ({"task": 3}, "task = 3"),
        ({"observation": "dct"}, "did you mean 'dict'"),
        ({"free_wheels": ["wheel_lg"]}, "unknown wheel 'wheel_lg'"),
        ({"free_wheels": "wheel_lf"}, "expected a list"),
        ({"episode_length": -1.0}, "above 0 s"),
        ({"physics_step": 0.003}, "does not divide"),
        ({"episode_length": "20"}, "episode_length = '20': expected a time"),
        ({"physics_step": "a"}, "physics_step = 'a': expected a time"),
        ({"robot": 3}, "robot = 3: expected a name, a path, a mapping or a Robot"),
        ({"threads": 1.5}, "threads = 1.5: expected a whole number"),
        ({"threads": True}, "threads = True: expected a whole number"),
        ({"backend": None}, "backend = None: expected a name"),
        ({"randomization": 3}, "randomization = 3: expected a name, a path or a mapping"),
        ({"effects": 3}, "effects = 3: expected a name, a path, a mapping or a list"),
        ({"effects": [{"name": "paylod"}]}, "did you mean 'payload'"),
        ({"effects": [{"name": "payload", "parameters": {"mass": "heavy"}}]}, "mass = 'heavy'"),
        ({"task": {"rewards": {"track_yaw_rate": {"width": 0}}}}, "width = 0: expected a number above 0"),
        ({"task": {"rewards": {"torque_saturation": {"weight": -1.0, "threshold": 1}}}}, "threshold = 1: .* below 1"),
    ],
)
def test_bad_keywords_name_the_nearest_valid_one(fake, make, keywords, expected):
    with pytest.raises(InputError, match=expected):
        make(ID, **keywords)


@pytest.mark.parametrize("make", [make, lambda: make_vec(2)])
@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (3, "options = 3: expected a mapping"),
        ({"command": 3}, "command = 3: expected a mapping"),
        ({"command": {"yaw_rate": "fast"}}, "command yaw_rate = 'fast': expected a finite number"),
        ({"command": {"yaw_rate": [0.1, 0.2]}}, "expected a finite number"),
        ({"command": {"yaw_rate": np.nan}}, "expected a finite number"),
        ({"parameters": 3}, "parameters = 3: expected a mapping"),
        ({"parameters": {3: 1.0}}, "unknown parameter '3'"),
        ({"comand": {}}, "did you mean 'command'"),
    ],
)
def test_bad_reset_options(fake, make, options, expected):
    with pytest.raises(InputError, match=expected):
        make().reset(seed=0, options=options)


def test_only_a_batch_knows_reset_mask(fake):
    with pytest.raises(InputError, match=r"unknown reset option 'reset_mask'; valid: command, parameters$"):
        make().reset(seed=0, options={"reset_mask": np.array([True])})
    with pytest.raises(InputError, match="did you mean 'reset_mask'"):
        make_vec(2).reset(seed=0, options={"rest_mask": np.ones(2, bool)})


def test_unknown_backend():
    with pytest.raises(InputError, match="did you mean 'gibbs_appell'"):
        gym.make(ID, backend="gibbs_apell")


def test_a_render_mode_that_does_not_exist(fake):
    with (
        pytest.raises(InputError, match="expected None, 'human' or 'rgb_array'"),
        pytest.warns(UserWarning, match="render_mode"),
    ):
        gym.make(ID, render_mode="ansi")


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"num_envs": 0}, "num_envs = 0"),
        ({"num_envs": 2, "autoreset_mode": "NextStp"}, "did you mean 'NextStep'"),
        ({"num_envs": 2, "max_episode_steps": 0}, "max_episode_steps = 0"),
        ({"num_envs": 2, "max_episode_steps": True}, "max_episode_steps = True"),
    ],
)
def test_bad_vector_keywords(fake, keywords, expected):
    with pytest.raises(InputError, match=expected):
        gym.make_vec(ID, **keywords)


def test_bad_seeds_and_masks(fake):
    env = make_vec(3)
    for seed, expected in (([1, 2], "2 seeds for 3 robots"), ([1, -2, 3], "seed = -2"), ([1, 2.5, 3], "seed = 2.5")):
        with pytest.raises(InputError, match=expected):
            env.reset(seed=seed)
    for seed in (-1, 1.5, True):
        for face in (env, make()):
            with pytest.raises(InputError, match=f"seed = {seed!r}: expected a whole number of 0 or more"):
                face.reset(seed=seed)
    for mask in (np.zeros(3, bool), np.ones(2, bool), np.ones(3)):
        with pytest.raises(InputError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("face", [make, lambda: make_vec(2)])
def test_nothing_begins_before_a_reset_nor_by_a_refused_one(fake, face):
    env = face()
    with pytest.raises(gym.error.ResetNeeded):
        env.step(env.action_space.sample())
    with pytest.raises(InputError, match="did you mean 'command'"):
        env.reset(seed=0, options={"comand": {}})
    with pytest.raises(gym.error.ResetNeeded, match="no episode of robot 0"):
        env.step(env.action_space.sample())


def test_after_a_reset_that_the_plant_refuses_the_old_episode_does_not_go_on():
    env = make_vec(2)
    env.reset(seed=0)
    stiff = {"parameters": {"ground.normal_damping": 500.0}, "reset_mask": np.array([False, True])}
    with pytest.raises(InputError, match="too stiff for a physics step"):
        env.reset(options=stiff)
    with pytest.raises(gym.error.ResetNeeded, match="no episode of robot 1"):
        env.step(env.action_space.sample())
    env.reset(options={"reset_mask": stiff["reset_mask"]})
    env.step(env.action_space.sample())


def test_robots_left_out_of_the_first_reset_are_named(fake):
    env = make_vec(3)
    env.reset(seed=0, options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(gym.error.ResetNeeded, match="no episode of robot 1"):
        env.step(env.action_space.sample())


# ---- vector = single ----


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(("observation", "randomization"), [("policy", "wide"), ("dict", "wide"), ("policy", TIMED)])
def test_vector_equals_gymnasiums_loop_over_single_environments(fake, mode, observation, randomization):
    """Observations, rewards, flags and infos, masks and all, over several episodes that end at different times."""
    keywords = {"episode_length": 0.4, "observation": observation, "randomization": randomization}
    ours = make_vec(3, autoreset_mode=mode, **keywords)
    loop = SyncVectorEnv([lambda: gym.make(ID, **keywords)] * 3, autoreset_mode=AutoresetMode(mode))
    ours_first, loop_first = ours.reset(seed=11), loop.reset(seed=11)
    assert data_equivalence(ours_first[0], loop_first[0], exact=True)
    assert data_equivalence(ours_first[1], loop_first[1], exact=True)
    stagger, told = np.array([True, False, False]), 0
    for step, action in enumerate(actions_for(70, 3)):
        if step == 7:
            for env in (ours, loop):
                env.reset(options={"reset_mask": stagger.copy()})
        result, expected = ours.step(action), loop.step(action)
        for name, one, two in zip(("observation", "reward", "terminated", "truncated"), result, expected, strict=False):
            assert data_equivalence(one, two, exact=True), (step, name)
        assert set(result[4]) == set(expected[4]), step
        for key in result[4]:
            assert same_where_masked(result[4], expected[4], key), (step, key)
        told += "randomization" in result[4]
    assert told > (20 if randomization == TIMED else 2)


def same_where_masked(ours, loop, key):
    if key.startswith("_"):
        return np.array_equal(ours[key], loop[key])
    if isinstance(ours[key], dict):
        return ours[key].keys() == loop[key].keys() and all(same_where_masked(ours[key], loop[key], k) for k in ours[key])
    mask = ours[f"_{key}"]
    return all(data_equivalence(a, b, exact=True) for a, b in zip(ours[key][mask], loop[key][mask], strict=True))


def test_a_robot_is_the_same_in_a_batch_of_any_size(fake):
    many, few = make_vec(40, **SHORT), make_vec(3, **SHORT)
    many.reset(seed=100)
    few.reset(seed=[117, 100, 139])
    for action in actions_for(50, 40):
        a, b = many.step(action), few.step(action[[17, 0, 39]])
        for one, two in zip(a[:4], b[:4], strict=True):
            assert np.array_equal(one[[17, 0, 39]], two)


# ---- autoreset ----


def run_until_over(env, count):
    env.reset(seed=0)
    while True:
        result = env.step(np.zeros((count, 8), np.float32))
        if (result[2] | result[3]).any():
            return result


def test_next_step_resets_on_the_following_step_and_ignores_the_action(fake):
    env = make_vec(2, **SHORT)
    observation, _, _, truncated, infos = run_until_over(env, 2)
    assert truncated.all()
    assert "episode_reward_terms" in infos
    following, reward, terminated, truncated, infos = env.step(np.full((2, 8), np.nan))
    assert np.all(reward == 0)
    assert not terminated.any()
    assert not truncated.any()
    assert infos["_randomization"].all()
    assert not np.array_equal(following, observation)
    assert env.core.episodes.steps.tolist() == [0, 0]


def test_same_step_hands_out_the_final_observation_and_info(fake):
    env = make_vec(2, autoreset_mode="SameStep", **SHORT)
    single = gym.make(ID, **SHORT)
    observation, _, _, truncated, infos = run_until_over(env, 2)
    single.reset(seed=1)
    last = [single.step(np.zeros(8, np.float32)) for _ in range(20)][-1]
    assert truncated.all()
    assert np.array_equal(infos["final_obs"][1], last[0])
    assert infos["final_info"]["reward_terms"]["slip"][1] == last[4]["reward_terms"]["slip"]
    assert np.array_equal(observation[1], single.reset()[0])


def test_disabled_waits_for_the_user(fake):
    env = make_vec(2, autoreset_mode=AutoresetMode.DISABLED, **SHORT)
    run_until_over(env, 2)
    with pytest.raises(gym.error.ResetNeeded, match="robot 0 is over"):
        env.step(np.zeros((2, 8)))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(gym.error.ResetNeeded, match="robot 1 is over"):
        env.step(np.zeros((2, 8)))
    env.reset(options={"reset_mask": np.array([False, True])})
    env.step(np.zeros((2, 8)))


def test_a_masked_reset_leaves_the_others_alone(fake):
    env, other = make_vec(3, **SHORT), make_vec(3, **SHORT)
    env.reset(seed=0)
    other.reset(seed=0)
    for action in actions_for(5, 3):
        env.step(action)
        other.step(action)
    env.reset(seed=50, options={"reset_mask": np.array([False, True, False])})
    action = actions_for(1, 3)[0]
    a, b = env.step(action), other.step(action)
    assert np.array_equal(a[0][[0, 2]], b[0][[0, 2]])
    assert not np.array_equal(a[0][1], b[0][1])


def test_returned_arrays_are_the_users_own(fake):
    env = make_vec(2, observation="dict", **SHORT)
    kept = [env.reset(seed=0)]
    kept += [env.step(action) for action in actions_for(3, 2)]
    copies = pickle.loads(pickle.dumps(kept))
    for action in actions_for(40, 2):
        env.step(action)
    assert all(data_equivalence(a, b, exact=True) for a, b in zip(kept, copies, strict=True))
