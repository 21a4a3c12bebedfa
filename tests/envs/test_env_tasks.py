"""The four tasks on the engine: checkers, same bits alone and in a batch, what each asks for."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import wlr_gym  # noqa: F401
from wlr_gym.base.errors import InputError
from wlr_gym.envs.registry import ENVIRONMENTS

ESTIMATES = (
    "estimated_linear_velocity_in_body",
    "estimated_linear_velocity_sigma",
    "estimated_slip_velocity",
    "estimated_traction_use",
)
BLIND = {"observer": {"camera": False}, "observations": dict.fromkeys(ESTIMATES)}


def make(env_id, **keywords) -> Any:
    return gym.make(env_id, **keywords).unwrapped


def make_vec(env_id, count, **keywords) -> Any:
    return gym.make_vec(env_id, num_envs=count, **keywords)


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_checkers_of_gymnasium_and_sb3_without_a_warning(env_id):
    from stable_baselines3.common.env_checker import check_env as check_sb3

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(env_id))
        check_sb3(gym.make(env_id))


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_observation_and_measures_are_the_same_bits_alone_and_in_a_batch(env_id):
    keywords = {"episode_length": 0.5, "observation": "dict", "autoreset_mode": "SameStep"}
    vector = make_vec(env_id, 9, **keywords)
    alone = make_vec(env_id, 1, **keywords)
    seen, single = vector.reset(seed=40)[0], alone.reset(seed=44)[0]
    core, one = vector.unwrapped.core, alone.unwrapped.core
    for actions in np.random.default_rng(2).uniform(-1, 1, (60, 9, 8)).astype(np.float32):
        for group in ("policy", "privileged"):
            assert np.array_equal(seen[group][4], single[group][0])
        seen, single = vector.step(actions)[0], alone.step(actions[4:5])[0]
        assert np.array_equal(core.measures[4], one.measures[0])
        assert np.array_equal(core.observer.values[4], one.observer.values[0])
    assert np.isfinite(core.measures).all()


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_estimates_can_be_left_out(env_id):
    aware, blind = make(env_id), make(env_id, task=BLIND)
    left_out = set(aware.core.task.config.observations) - set(blind.core.task.config.observations)
    assert left_out == set(ESTIMATES)
    needs = any(name in blind.core.task.config.observations for name in ("path_error", "course_error")) or env_id.startswith(
        "WLR-Slope"
    )
    assert (blind.core.observer is not None) == needs
    assert blind.contract()["observer"] == ({"camera": False} if needs else None)


def test_estimates_of_an_episode_end_with_it_and_those_of_the_next_begin_anew():
    actions = np.random.default_rng(3).uniform(-1, 1, (40, 2, 8)).astype(np.float32)

    def play(env, acts):
        return [env.step(given) for given in acts]

    short, long, fresh = (
        make_vec("WLR-Path-v0", n, autoreset_mode="SameStep", episode_length=s) for n, s in ((2, 0.5), (2, 9), (1, 9))
    )
    for env in (short, long):
        env.reset(seed=5)
    ended, unended = play(short, actions[:25])[-1], play(long, actions[:25])[-1]
    assert np.array_equal(np.stack(list(ended[4]["final_obs"])), unended[0])
    fresh.reset(seed=6)
    fresh.reset()
    again, anew = play(short, actions[25:]), play(fresh, actions[25:, 1:])
    assert np.array_equal(again[-1][0][1], anew[-1][0][0])

    long.reset(options={"reset_mask": np.array([False, True])})  # the robot that is not reset goes on
    other = make_vec("WLR-Path-v0", 2, autoreset_mode="SameStep", episode_length=9)
    other.reset(seed=5)
    play(other, actions[:25])
    rest, undisturbed = play(long, actions[25:]), play(other, actions[25:])
    assert np.array_equal(rest[-1][0][0], undisturbed[-1][0][0])
    assert np.array_equal(rest[-1][0][1], anew[-1][0][0])


def test_estimates_are_as_old_as_the_joint_readings():
    task = {"latency": {"joints": {"delay": [0.04, 0.04]}, "imu": {"delay": [0.0, 0.0]}}}
    late, prompt = (make("WLR-Path-v0", task={"latency": given}) for given in (task["latency"], None))
    names = [column.term for column in late.core.task.policy]
    delayed = [k for k, name in enumerate(names) if name.startswith(("estimated_", "path_", "leg_", "wheel_"))]
    seen = {env: [env.reset(seed=1)[0]] for env in (late, prompt)}
    for action in np.random.default_rng(4).uniform(-1, 1, (12, 8)).astype(np.float32):
        for env, rows in seen.items():
            rows.append(env.step(action)[0])
    for tick in range(2, 13):
        assert np.array_equal(seen[late][tick][delayed], seen[prompt][tick - 2][delayed])
        assert np.array_equal(np.delete(seen[late][tick], delayed), np.delete(seen[prompt][tick], delayed))
    assert not np.array_equal(seen[late][12][delayed], seen[prompt][12][delayed])


@pytest.mark.parametrize(
    ("env_id", "command", "expected"),
    [
        ("WLR-Path-v0", {"path_wavelength": 0.0}, "0.1 m or more"),
        ("WLR-Path-v0", {"path_shape": -7}, "0 to 3"),
        ("WLR-Path-v0", {"path_curvature": 1e6}, "-20 to 20 1/m"),
        ("WLR-Posture-v0", {"leg_rate": -0.3}, "0 to 5.55 rad/s"),
        ("WLR-Posture-v0", {"front_leg_first": 9}, "0.35 to 2.79 rad"),
        ("WLR-Slope-v0", {"climb_speed": -0.05}, "0 to 0.217 m/s"),
        ("WLR-Velocity-v0", {"linear_velocity_x": 5.0}, "-0.217 to 0.217 m/s"),
        ("WLR-Velocity-v0", {"yaw_rate": -5.0}, "-1.36 to 1.36 rad/s"),
    ],
)
def test_commands_that_mean_nothing_or_that_no_robot_follows_are_refused(env_id, command, expected):
    env = make(env_id)
    text = f"command {next(iter(command))} = .*: expected {expected}$"
    with pytest.raises(InputError, match=text):
        env.reset(seed=0, options={"command": command})
    with pytest.raises(InputError, match=text):
        env.set_command(**command)


def test_commands_beyond_those_of_the_task_are_not_refused():
    env = make("WLR-Velocity-v0")
    env.reset(seed=0, options={"command": {"linear_velocity_x": -0.21, "yaw_rate": 1.3}})
    assert env.core.command.tolist() == [[-0.21, 1.3]]


def test_commands_of_a_task_mean_something():
    with pytest.raises(InputError, match=r"commands.terms.path_shape = \[0.0, 9.0\]: expected 0 to 3$"):
        make("WLR-Path-v0", task={"commands": {"terms": {"path_shape": [0.0, 9.0]}}})


def test_observer_follows_what_the_sensors_read():
    """Straight on at constant speed: the estimate of speed and pose is the true one within a few millimetres."""
    env = make_vec("WLR-Velocity-v0", 20, randomization="nominal", task={"commands": {"zero_probability": 0.0}})
    env.reset(seed=0, options={"command": {"linear_velocity_x": 0.1, "yaw_rate": 0.0}})
    action = np.zeros((20, 8), np.float32)
    action[:, 4:] = 0.1 / 0.034 / 6.0
    for _ in range(250):
        env.step(action)
    core = env.unwrapped.core
    names = [column.element for column in core.task.policy]
    speed = core.observation[:, names.index("linear_velocity_in_body[x]")] / 10.0
    true = core.plant.truth()["linear_velocity_in_body"][:, 0]
    assert np.abs(speed - true).max() < 0.005


def test_path_error_that_is_estimated_is_the_true_one_wherever_the_robot_stood():
    def ahead(core):
        return np.hstack([np.zeros((core.count, 4)), np.full((core.count, 4), 0.45)])

    core, _ = drive("WLR-Path-v0", 20, ahead, randomization="nominal", observation="dict", episode_length=4.0)
    assert np.ptp(core.start[:, 2]) > 3.0
    for error, bound in (("lateral", 0.01), ("heading", 0.03)):
        estimated, true = computed(core, f"path_error[{error}]"), computed(core, f"true_path_error[{error}]")
        assert np.abs(estimated - true).max() < bound
        assert np.ptp(true) > 5 * bound


def test_a_robot_measures_what_it_can_of_a_task():
    for package in ("dynamixel_sdk", "serial"):
        pytest.importorskip(package)
    env = make("WLR-Posture-v0", backend="dynamixel", hardware={"emulated": True, "guard": False})
    core = env.core
    assert core.task.measures == ("leg_error",)
    assert set(core.task.config.success) == {"leg_error"}
    assert {"course_error", "lateral_error", "slip_speed", "slip"} <= set(core.unmeasured)
    assert "leg_error" in core.task.rewards
    observation, _ = env.reset(seed=0)
    for _ in range(25):
        observation, *_ = env.step(np.array([0.0] * 4 + [0.3] * 4, np.float32))
    names = [column.element for column in core.task.policy]
    assert np.isfinite(observation).all()
    assert observation[names.index("linear_velocity_in_body[x]")] / 10.0 == pytest.approx(0.3 * 6.0 * 0.034, abs=0.02)
    env.close()


def test_a_policy_that_sees_the_truth_is_for_simulators_only():
    env = make("WLR-Velocity-v0", task={"observations": {"effective_friction": {}}}, randomization="nominal")
    observation, info = env.reset(seed=3)
    mu = info["randomization"]["ground.mu_x[wheel_lf]"]
    assert observation[-8:] == pytest.approx(np.full(8, mu), rel=1e-6)
    with pytest.raises(InputError, match=r"'effective_friction'.*only a simulator"):
        make(
            "WLR-Velocity-v0",
            backend="dynamixel",
            hardware={"emulated": True},
            task={"observations": {"effective_friction": {}}},
        )


def drive(env_id, count, act, **keywords):
    """Play one episode of every robot with ``act(core)``; return the core and the measures (T, N, M)."""
    env = make_vec(env_id, count, **keywords)
    env.reset(seed=0)
    core = env.unwrapped.core
    measures = []
    while not core.truncated.any():
        core.step(act(core).astype(np.float32), core.everyone)
        measures.append(core.measures.copy())
    return core, np.array(measures)


def computed(core, element):
    return core.computed[:, [core.task.computed.index(element)]]


def test_legs_that_follow_their_reference_have_no_leg_error():
    def follow(core):
        legs = np.hstack([computed(core, f"leg_reference[{leg}]") for leg in core.task.robot.joints[:4]])
        return np.hstack([legs / 1.25, np.zeros((core.count, 4))])

    core, measures = drive("WLR-Posture-v0", 12, follow, randomization="none")
    error = measures[:, :, core.task.measures.index("leg_error")]
    assert error.max() < 0.12  # the profile lags behind a ramp
    assert error[-50:].max() < 0.05  # legs sag under load: their servos have no integral part
    names = core.task.commands
    second = core.command[:, [names.index("front_leg_second"), names.index("rear_leg_second")]]
    assert core.plant.truth()["joint_position"][:, [0, 2]] == pytest.approx(second, abs=0.06)


def test_reward_and_observation_mean_the_same_moment():
    """The leg error that is measured is that of the reference which the policy is shown next."""
    env = make_vec("WLR-Posture-v0", 3, randomization="none")
    env.reset(seed=1)
    core = env.unwrapped.core
    for tick in range(320):
        core.step(np.zeros((3, 8), np.float32), core.everyone)
        if tick % 20 == 0:
            shown = np.hstack([computed(core, f"leg_reference[{leg}]") for leg in core.task.robot.joints[:4]])
            errors = core.plant.truth()["joint_position"][:, :4] - core.task.robot.home.leg_angle - shown
            measured = core.measures[:, core.task.measures.index("leg_error")]
            assert measured == pytest.approx(np.sqrt((errors**2).mean(axis=1)))


def test_slopes_stay_below_what_friction_holds_and_a_braked_robot_stands():
    def brake(core):
        return np.zeros((core.count, 8))

    core, _ = drive("WLR-Slope-v0", 40, brake, episode_length=4.0)
    slope, mu = core.parameters["ground.slope"], core.parameters["ground.mu_x"][:, 0]
    margin = np.degrees(np.arctan(mu) - slope[:, 0])
    assert np.all(slope[:, 1] == 0.0)
    assert np.all(margin[slope[:, 0] > 0] <= np.degrees(0.21) + 1e-9)
    assert margin.min() >= 1.5
    assert np.ptp(slope[:, 0]) > 0.2
    assert np.abs(core.plant.truth()["linear_velocity_in_body"]).max() < 0.01
    assert np.abs(core.plant.truth()["position"][:, 0]).max() < 0.05


def test_a_robot_steeper_than_friction_slides():
    env = make_vec("WLR-Slope-v0", 4)
    parameters = {"ground.slope[pitch]": np.arctan(0.3) + np.radians(1.0), "ground.mu_x": 0.3, "ground.mu_y": 0.3}
    env.reset(seed=0, options={"parameters": parameters})
    core = env.unwrapped.core
    for _ in range(150):
        core.step(np.zeros((4, 8)), core.everyone)
    assert core.plant.truth()["position"][:, 0].max() < -0.1


def test_progress_narrows_what_is_drawn_and_says_nothing_of_the_past():
    curriculum = {"commands": {"start": 0.2, "steps": 1000}, "randomization": {"start": 0.5, "steps": 2000}}
    env = make_vec("WLR-Velocity-v0", 200, task={"curriculum": curriculum}, randomization="nominal")

    def widths(steps=None):
        if steps is not None:
            env.unwrapped.set_progress(steps)
        env.reset(seed=7)
        core = env.unwrapped.core
        return np.abs(core.commands.target[:, 0]).max(), np.ptp(core.parameters["ground.mu_x"][:, 0])

    whole = widths()
    assert whole[0] == pytest.approx(0.1, abs=0.003)
    start = widths(0)
    assert start == pytest.approx((0.2 * whole[0], 0.5 * whole[1]))
    assert widths(500) == pytest.approx((0.6 * whole[0], 0.625 * whole[1]))
    assert widths(5000) == whole
    assert widths(0) == start
    for steps in (-1, float("nan"), "all", None, True):
        with pytest.raises(InputError, match="0 or more"):
            env.unwrapped.set_progress(steps)


def test_progress_within_an_episode_leaves_its_robot_and_floor_as_they_were():
    """A push redraws nothing but itself, however far training has come since the episode began."""
    curriculum = {"randomization": {"start": 0.2, "steps": 1000}}
    env = make_vec("WLR-Velocity-v0", 4, task={"curriculum": curriculum}, randomization="wide")
    core = env.unwrapped.core
    core.set_progress(0)
    env.reset(seed=0)
    before = core.parameters.values.copy()
    core.set_progress(1000)
    pushes = 0
    for _ in range(160):
        core.step(np.zeros((4, 8), np.float32), core.everyone)
        pushes += core.robots.changed.sum()
    assert pushes > 4
    changed = (core.parameters.values != before).any(axis=0)
    assert set(np.flatnonzero(changed)) <= set(core.randomization.timed_columns)
