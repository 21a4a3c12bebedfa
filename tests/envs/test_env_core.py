"""What happens inside an episode, on a kinematic plant whose answers are known."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from velocity import make, make_vec, push

from wlr_gym.base.errors import InputError
from wlr_gym.envs.core import make_task
from wlr_gym.envs.settings import EnvironmentOptions
from wlr_gym.envs.tasks.compiled_terms import (
    MATRICES,
    Scores,
    compile_computed,
    compile_scores,
    computed_expressions,
    expressions,
    reader,
)
from wlr_gym.envs.tasks.describe import column_name
from wlr_gym.envs.tasks.terms import COMMANDS, COMPUTED, MEASURES, REWARDS, TERMINATIONS, ScalarTerm
from wlr_gym.perception.observer import ESTIMATE_LAYOUT
from wlr_gym.physics.codegen import ops
from wlr_gym.physics.plants.base import SENSOR_LAYOUT, TRUTH_LAYOUT


def names(env):
    return [column_name(column) for column in env.core.task.policy]


# ---- action ----


def test_action_is_scaled_about_home_and_clipped_to_the_limits(fake):
    env = make(task={"action": {"leg_scale": 2.0, "wheel_scale": 100.0}})
    env.reset(seed=0)
    env.step(np.array([0.1, -0.1, 1.0, -1.0, 0.01, -0.01, 1.0, -1.0], np.float32))
    robot = env.core.task.robot
    home, (low, high), top = robot.home.leg_angle, robot.leg_limits, robot.servo.wheel.no_load_speed
    expected = [home + 0.2, home - 0.2, high, low, 1.0, -1.0, top, -top]
    assert fake["plants"][-1].setpoints_seen[-1][0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("value", "text"), [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "-inf"), (1.01, "1.01"), (-1e30, "-1e"), (1e300, "inf")]
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_bad_actions_name_robot_and_joint_and_never_reach_the_plant(fake, value, text):
    env = make_vec(3)
    env.reset(seed=0)
    plant = fake["plants"][-1]
    actions = np.zeros((3, 8))
    actions[1, 5] = value
    steps, ticks = len(plant.setpoints_seen), env.core.episodes.steps.copy()
    with pytest.raises(InputError, match=rf"wheel_rf of robot 1 of the batch is {text}.*finite number in \[-1, 1\]"):
        env.step(actions)
    assert len(plant.setpoints_seen) == steps
    assert np.array_equal(env.core.episodes.steps, ticks)


SHAPES = [np.zeros(7), np.zeros((1, 8)), 0.5, np.zeros((2, 8))]
KINDS = [np.zeros(8, complex), [1j] * 8, [None] * 8, ["0.5"] * 8, [True] * 8, "forward", None]


@pytest.mark.parametrize(
    ("action", "words"), [*((shape, "action") for shape in SHAPES), *((kind, "expected real numbers") for kind in KINDS)]
)
def test_actions_of_wrong_shape_or_type(fake, action, words):
    env = make()
    env.reset(seed=0)
    with pytest.raises(InputError, match=words):
        env.step(action)


def test_rounding_beyond_one_is_accepted(fake):
    env = make()
    env.reset(seed=0)
    env.step(np.full(8, np.nextafter(np.float32(1), np.float32(2))))
    assert env.core.action.max() == 1.0


def test_free_wheels_spin_free(fake):
    env = make(free_wheels=iter(["wheel_lf", "wheel_rr"]), randomization="none")
    env.reset(seed=0)
    env.step(np.array([0, 0, 0, 0, 1, 1, 1, 1], np.float32))
    moving = fake["plants"][-1].truth()["joint_velocity"][0, 4:] != 0
    assert moving.tolist() == [False, True, True, False]


# ---- observation ----


def test_observation_holds_the_scaled_readings(fake):
    env = make(randomization="none", task={"latency": None})
    env.reset(seed=0)
    action = np.linspace(-0.5, 0.5, 8).astype(np.float32)
    observation, *_ = env.step(action)
    named = dict(zip(names(env), observation.tolist(), strict=True))
    assert named["leg_position[leg_lf]"] == pytest.approx(-0.5 * 0.4)
    assert named["wheel_velocity[wheel_rr]"] == pytest.approx(0.2 * 6.0 * 0.5)
    assert named["accelerometer[z]"] == pytest.approx(0.981)
    assert named["last_action[leg_rf]"] == pytest.approx(action[1])
    assert named["command[yaw_rate]"] == pytest.approx(5.0 * env.core.command[0, 1])


def wheel_speeds(env, speeds):
    """Drive the first wheel through given speeds (rad/s); return what the observation shows of it after each tick."""
    env.reset(seed=0)
    shown = []
    for speed in speeds:
        action = np.zeros(8, np.float32)
        action[4] = speed / 6.0
        shown.append(env.step(action)[0][names(env).index("wheel_velocity[wheel_lf]")])
    return np.array(shown) / 0.2


@pytest.mark.parametrize(
    ("delay", "mode", "expected"),
    [
        (0.0, "interpolate", [1, 2, 4, 4]),
        (0.02, "interpolate", [0, 1, 2, 4]),
        (0.03, "interpolate", [0, 0.5, 1.5, 3]),
        (0.03, "hold", [0, 0, 1, 2]),
        (0.005, "interpolate", [0.75, 1.75, 3.5, 4]),
        (0.005, "hold", [0, 1, 2, 4]),
    ],
)
def test_latency_interpolates_or_holds(fake, delay, mode, expected):
    env = make(randomization="none", task={"latency": {"joints": {"delay": [delay, delay], "mode": mode}}})
    assert wheel_speeds(env, [1, 2, 4, 4]) == pytest.approx(expected, abs=1e-6)


def test_an_angle_is_not_interpolated_over_its_end():
    joints = {"delay": [0.01, 0.01], "mode": "interpolate"}
    observed = {"path_error": {"scale": 1.0, "limit": 4.0}}
    env: Any = gym.make("WLR-Path-v0", randomization="none", task={"latency": {"joints": joints}, "observations": observed})
    env.reset(seed=0)
    core, column = env.unwrapped.core, names(env.unwrapped).index("path_error[heading]")
    shown = []
    for heading in (3.1, 3.12, -3.14, -3.12):
        core.computed[:, core.task.computed.index("path_error[heading]")] = heading
        core.pipeline.observe(core.everyone, core._signals(), core.episodes, first=heading == 3.1)
        core.episodes.steps += 1
        shown.append(core.observation[0, column])
    assert shown == pytest.approx([3.1, 3.11, 3.12, -3.13])


def test_history_comes_newest_first_and_starts_filled(fake):
    env = make(
        randomization="none",
        task={"latency": None, "observations": {"wheel_velocity": {"history": 3}, "accelerometer": {"history": 2}}},
    )
    columns = [k for k, name in enumerate(names(env)) if name == "wheel_velocity[wheel_lf]"]
    gravity = [k for k, name in enumerate(names(env)) if name == "accelerometer[z]"]
    observation, _ = env.reset(seed=0)
    assert observation[gravity] == pytest.approx(0.981)
    for speed in (1.0, 2.0, 4.0, 5.0):
        action = np.zeros(8, np.float32)
        action[4] = speed / 6.0
        observation, *_ = env.step(action)
    assert observation[columns] / 0.2 == pytest.approx([5.0, 4.0, 2.0], rel=1e-6)


def test_latency_differs_between_robots_within_its_range_and_is_shared_by_a_device(fake):
    env = make_vec(200, task={"latency": {"joints": {"delay": [0.01, 0.03]}}})
    env.reset(seed=0)
    delays = env.core.pipeline.delays * 0.02
    assert 0.01 <= delays[:, 0].min() < 0.011
    assert 0.029 < delays[:, 0].max() <= 0.03
    assert np.all(delays[:, -1] == 0.0)


def test_observation_noise_and_bias_have_the_stated_spread(fake):
    task = {"observations": {"supply_voltage": {"noise": 0.3, "bias": 0.5}}, "latency": None}
    env = make_vec(400, task=task, randomization={"initial_state": {}})
    column = names(env).index("supply_voltage")
    env.reset(seed=1)
    values = np.array([env.step(np.zeros((400, 8)))[0][:, column] for _ in range(60)])
    assert values.mean(axis=0).std() == pytest.approx(0.5, rel=0.1)
    assert (values - values.mean(axis=0)).std() == pytest.approx(0.3, rel=0.05)
    quiet = make_vec(5, task=task, randomization="none")
    quiet.reset(seed=1)
    assert np.ptp(quiet.step(np.zeros((5, 8)))[0][:, column]) == 0.0


def test_dict_observation_adds_exact_truth(fake):
    env = make(observation="dict", randomization="none")
    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.array([0, 0, 0, 0, 1, 1, 1, 1], np.float32))
    assert set(second) == {"policy", "privileged"}
    assert env.observation_space.contains(second)
    assert second["privileged"][0] == pytest.approx(5.0 * 6.0 * env.core.task.robot.wheel.radius)
    flat = make(randomization="none")
    assert np.array_equal(first["policy"], flat.reset(seed=0)[0])


def test_observations_never_leave_their_space(fake):
    env = make(task={"observations": {"wheel_velocity": {"limit": 1.0}}})
    env.reset(seed=0)
    observation, *_ = env.step(np.ones(8, np.float32))
    assert env.observation_space.contains(observation)
    assert observation.max() == env.observation_space.high.max() or observation[
        names(env).index("wheel_velocity[wheel_lf]")
    ] == np.float32(0.2)


# ---- commands ----


def test_commands_are_held_then_redrawn_within_range_and_sometimes_zero(fake):
    env = make_vec(300, autoreset_mode="SameStep", task={"commands": {"ramp": None}})
    env.reset(seed=0)
    held, commands = [], [env.core.command.copy()]
    for _ in range(900):
        env.step(np.zeros((300, 8)))
        commands.append(env.core.command.copy())
    history = np.array(commands)
    changed = (np.diff(history, axis=0) != 0).any(axis=2)
    for robot in range(300):
        held += np.diff(np.flatnonzero(changed[:, robot])).tolist()
    # two stand-stills in a row look like one longer hold
    assert min(held) >= 200
    assert np.median(held) == pytest.approx(300, abs=15)
    assert np.abs(history[..., 0]).max() == pytest.approx(0.1, rel=0.01)
    assert np.abs(history[..., 1]).max() == pytest.approx(0.3, rel=0.01)
    assert np.mean((history == 0).all(axis=2)) == pytest.approx(0.1, abs=0.03)


def test_drawn_commands_ramp_from_zero_and_given_ones_hold_at_once(fake):
    env = make_vec(50, task={"commands": {"ramp": {"linear_velocity_x": 0.25, "yaw_rate": 1.5}}})
    env.reset(seed=0)
    commands = [env.core.command.copy()]
    for _ in range(500):
        env.step(np.zeros((50, 8)))
        commands.append(env.core.command.copy())
    jumping = make_vec(50, task={"commands": {"ramp": None}})
    jumping.reset(seed=0)
    changes = np.abs(np.diff(np.concatenate([np.zeros((1, 50, 2)), commands]), axis=0))
    assert changes.max(axis=(0, 1)) == pytest.approx([0.005, 0.03])
    assert np.array_equal(commands[60], jumping.core.command)
    env.set_command(linear_velocity_x=-0.1)
    assert np.all(env.core.command[:, 0] == -0.1)
    env.step(np.zeros((50, 8)))
    assert np.all(env.core.command[:, 0] == -0.1)


def test_computed_observations_speak_of_the_commands_that_hold_from_now_on(fake):
    changes = {"commands": {"hold_time": [0.1, 0.1], "ramp": None}, "observations": {"speed_command": {}}}
    env = make_vec(20, randomization="none", autoreset_mode="SameStep", episode_length=1.0, task=changes)
    env.reset(seed=0)
    speed = names(env.unwrapped).index("speed_command")
    shown = []
    for _ in range(120):
        observation = env.step(np.zeros((20, 8)))[0]
        assert observation[:, speed] == pytest.approx(env.unwrapped.core.command[:, 0])
        shown.append(observation[0, speed])
    assert len(set(shown)) > 15


def test_command_can_be_fixed_for_an_episode_and_live(fake):
    env = make()
    with pytest.raises(gym.error.ResetNeeded, match=r"before set_command\(\)"):
        env.set_command(yaw_rate=0.3)
    env.reset(seed=0, options={"command": {"linear_velocity_x": 0.07, "yaw_rate": 0.0}})
    for _ in range(600):
        env.step(np.zeros(8, np.float32))
    assert env.core.command.tolist() == [[0.07, 0.0]]
    env.set_command(yaw_rate=0.3)
    observation, *_ = env.step(np.zeros(8, np.float32))
    assert observation[1] == pytest.approx(1.5)
    with pytest.raises(InputError, match="did you mean 'yaw_rate'"):
        env.set_command(yaw_rat=0.3)
    with pytest.raises(InputError, match="finite"):
        env.reset(options={"command": {"yaw_rate": np.nan}})


def test_commands_that_are_not_given_are_drawn_as_before(fake):
    changes = {"task": {"commands": {"hold_time": [0.1, 0.1], "ramp": None, "zero_probability": 0.0}}, "randomization": "none"}
    free, env = make(**changes), make(**changes)
    free.reset(seed=0)
    env.reset(seed=0, options={"command": {"linear_velocity_x": 0.07}})
    seen = []
    for _ in range(30):
        assert env.core.command[0].tolist() == [0.07, free.core.command[0, 1]]
        seen.append(env.core.command[0, 1])
        for each in (free, env):
            each.step(np.zeros(8, np.float32))
    assert len(set(seen)) == 6
    env.reset(seed=0)
    free.reset(seed=0)
    assert env.core.command.tolist() == free.core.command.tolist()


# ---- rewards and terminations ----


def random_matrices(task, count=50):
    rng = np.random.default_rng(0)
    widths = {
        "sensors": SENSOR_LAYOUT.width,
        "estimate": ESTIMATE_LAYOUT.width,
        "truth": TRUTH_LAYOUT.width,
        "command": len(task.commands),
        "action": 8,
        "previous_action": 8,
        "start": 3,
        "clock": 1,
        "presence": 2,
    }
    matrices = {name: rng.normal(size=(count, width)) for name, width in widths.items()}
    matrices["computed"] = np.full((count, len(task.computed)), np.nan)
    matrices["truth"][:, TRUTH_LAYOUT.slices["quaternion"]] /= 2.0
    return matrices


def signals_in_order(matrices):
    return tuple(matrices[name] for name in MATRICES)


def every_reward():
    return {
        "commands": {"terms": {name: [max(-1.0, term.least), 1.0] for name, term in COMMANDS.items()}},
        "rewards": {name: {"weight": 0.5 + k} for k, name in enumerate(REWARDS)},
        "terminations": {name: {} for name in TERMINATIONS},
        "measures": {name: {} for name in MEASURES},
        "observations": {name: {} for name in COMPUTED},
        "privileged": {name: {} for name in COMPUTED},
        "controller": {"velocity_i": 1.0, "load_shift": 1.0, "uphill": 0.1},
    }


def test_compiled_rewards_equal_the_same_terms_on_numpy():
    task = make_task("velocity", EnvironmentOptions(task=every_reward()))
    matrices = random_matrices(task)
    count = len(matrices["truth"])
    expected = expressions(task, reader(task, matrices))
    scores = Scores.zeros(task, count)
    terms, total, over, sums, measures, squares, largest = scores
    sums[:] = squares[:] = 1.0
    kernel = compile_scores(task)
    assert kernel.run(np.ones(count, bool), signals_in_order(matrices), kernel.numbers, tuple(scores)) == -1
    for k, name in enumerate(task.rewards):
        np.testing.assert_allclose(
            terms[:, k], np.broadcast_to(expected[f"term.{name}"], count), rtol=1e-12, atol=1e-13, err_msg=name
        )
    for k, name in enumerate(task.terminations):
        np.testing.assert_allclose(over[:, k], expected[f"over.{name}"], rtol=1e-12, atol=1e-13, err_msg=name)
    for k, name in enumerate(task.measures):
        np.testing.assert_allclose(measures[:, k], expected[f"measure.{name}"], rtol=1e-12, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(total, terms.sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(sums, 1.0 + terms)
    np.testing.assert_array_equal(squares, 1.0 + measures**2)
    np.testing.assert_array_equal(largest, np.abs(measures))
    assert (over > 0).any(axis=1).sum() > 0


def test_compiled_computed_observations_equal_the_same_terms_on_numpy():
    task = make_task("velocity", EnvironmentOptions(task=every_reward()))
    matrices = random_matrices(task)
    before = matrices["computed"] = np.random.default_rng(1).normal(0, 0.1, (50, len(task.computed)))
    expected = computed_expressions(task, reader(task, matrices))
    kernel, computed = compile_computed(task), before.copy()
    matrices["computed"] = computed
    active = np.arange(50) % 2 == 0
    kernel.run(active, signals_in_order(matrices), kernel.numbers)
    for k, name in enumerate(task.computed):
        wanted = np.broadcast_to(expected[name], 50)[active]
        np.testing.assert_allclose(computed[active, k], wanted, rtol=1e-12, atol=1e-12, err_msg=name)
    np.testing.assert_array_equal(computed[~active], before[~active])


def value_of(name, parameters=None, **truth):
    """One reward term, weighted 1 per tick, of a still robot with some true quantities set."""
    task = make_task("velocity", EnvironmentOptions(task={"rewards": {name: {"weight": 50.0, **(parameters or {})}}}))
    matrices = random_matrices(task, 1)
    for matrix in matrices.values():
        matrix[:] = 0.0
    matrices["truth"][:, TRUTH_LAYOUT.slices["joint_position"]] = np.pi / 2
    matrices["truth"][:, TRUTH_LAYOUT.slices["quaternion"]] = [1.0, 0.0, 0.0, 0.0]
    matrices["truth"][:, TRUTH_LAYOUT.slices["body_clearance"]] = 0.1
    for channel, value in truth.items():
        source = channel if channel in ("command", "action") else "truth"
        where = TRUTH_LAYOUT.slices[channel] if source == "truth" else slice(None)
        matrices[source][:, where] = value
    return float(np.squeeze(expressions(task, reader(task, matrices))[f"term.{name}"]))


def test_reward_terms_by_hand():
    assert value_of("track_linear_velocity", command=[0.1, 0.0], linear_velocity_in_body=[0.1, 0, 0]) == pytest.approx(1.0)
    assert value_of("track_linear_velocity", {"width": 0.1}, command=[0.1, 0.0]) == pytest.approx(np.exp(-1.0))
    assert value_of("track_yaw_rate", {"width": 0.3}, angular_velocity_in_body=[0, 0, 0.6]) == pytest.approx(np.exp(-4.0))
    assert value_of(
        "other_motion", linear_velocity_in_body=[9.0, 0.1, 0], angular_velocity_in_body=[0.5, 0, 9.0]
    ) == pytest.approx(2.0)
    assert value_of("energy", electrical_energy=0.2) == pytest.approx(1.0)
    assert value_of("energy", electrical_energy=-0.2) == 0.0
    torque = [0.9 * 7.3, 0, 0, 0, 1.5, 0, 0, 0]
    assert value_of("torque_saturation", motor_torque=torque) == pytest.approx((0.5 + 1.0) / 8)
    speeds = [0.0] * 4 + [0.2, -0.1, 0.3, 0.0]  # rad/s; 6 rad/s are an action of 1, legs do not count
    action = [1.0] * 4 + [0.1, 0.0, 0.5, -0.05]
    assert value_of("stuck_wheels", action=action, joint_velocity=speeds) == pytest.approx((0.6 + 0.0 + 0.3) / 4)
    assert value_of("stuck_wheels", {"scale": 0.5}, action=action, joint_velocity=[5.0] * 8) == 0.0
    assert value_of("leg_posture", joint_position=[np.pi / 2 + 0.5] * 4 + [0] * 4) == pytest.approx(1.0)
    tipped = [np.cos(0.6), np.sin(0.6), 0, 0]
    assert value_of("alive", quaternion=tipped) == 0.0
    assert value_of("termination", quaternion=tipped) == 1.0
    assert value_of("termination") == 0.0


def test_slip_reward_spares_rolling_and_what_a_skid_turn_needs():
    period, speed, hip = 0.02, 0.05, 0.175
    rolling = {"linear_velocity_in_body": [0.2, 0, 0], "joint_velocity": [0] * 4 + [6.0] * 4}
    assert value_of("slip", **rolling) == 0.0
    needed = np.zeros(8)
    needed[1::2] = [1, 1, -1, -1] * np.full(4, 0.5 * hip * period)
    turning = {"angular_velocity_in_body": [0, 0, 0.5]}
    assert value_of("slip", slip_displacement=needed, **turning) == pytest.approx(0.0, abs=1e-12)
    assert value_of("slip", slip_displacement=needed) == pytest.approx(0.5 * hip / speed)
    spinning = np.zeros(8)
    spinning[0::2] = -0.3 * period
    assert value_of("slip", slip_displacement=spinning) == pytest.approx(0.3 / speed)
    assert value_of("slip", slip_displacement=spinning, **turning) == pytest.approx((0.3 - 0.5 * hip**2 / 0.16) / speed)


def test_action_rate_compares_with_the_tick_before(fake):
    env = make(task={"rewards": {"action_rate": {"weight": -50.0}}})
    env.reset(seed=0)
    changes = [env.step(np.full(8, value, np.float32))[4]["reward_terms"]["action_rate"] for value in (0.5, 0.5, -0.25)]
    assert changes == pytest.approx([-0.25, 0.0, -0.5625])
    env.reset()
    assert env.step(np.zeros(8, np.float32))[4]["reward_terms"]["action_rate"] == 0.0


def test_weights_and_parameters_compile_nothing_new():
    base = compile_scores(make_task("velocity", EnvironmentOptions()))
    options = EnvironmentOptions(task={"rewards": {"slip": {"weight": -9.0, "speed": 0.3}}})
    changed = compile_scores(make_task("velocity", options))
    assert changed.run is base.run
    assert not np.array_equal(changed.numbers, base.numbers)


def test_falling_terminates_and_the_time_limit_truncates(fake):
    fake["fall_at"] = 0.1
    env = make(episode_length=0.2)
    env.reset(seed=0)
    flags = [env.step(np.zeros(8, np.float32))[2:4] for _ in range(5)]
    assert flags == [(False, False)] * 4 + [(True, False)]
    fake["fall_at"] = np.inf
    env = make(episode_length=0.2)
    env.reset(seed=0)
    steps = [env.step(np.zeros(8, np.float32)) for _ in range(10)]
    assert [step[2:4] for step in steps] == [(False, False)] * 9 + [(False, True)]
    total = steps[-1][4]["episode_reward_terms"]
    assert sum(total.values()) == pytest.approx(sum(step[1] for step in steps))
    assert "episode_reward_terms" not in steps[-2][4]
    for _, reward, _, _, info in steps:
        assert sum(info["reward_terms"].values()) == pytest.approx(reward)


def test_robots_outside_the_mask_keep_time_flags_and_observation(fake):
    env = make_vec(2, episode_length=0.1)
    env.reset(seed=0)
    core = env.core
    for _ in range(5):
        core.step(np.zeros((2, 8)), core.everyone)
    assert core.truncated.all()
    before = core.observation[0].copy()
    core.step(np.full((2, 8), [[np.nan], [0.5]]), np.array([False, True]))
    assert core.episodes.steps.tolist() == [5, 6]
    assert core.truncated.all()
    assert core.reward[0] == 0.0
    assert np.array_equal(core.observation[0], before)
    assert fake["plants"][-1].setpoints_seen[-1][0, 4:].tolist() == [0.0] * 4


def test_a_plant_that_leaves_the_finite_numbers_is_reported(fake):
    env = make()
    env.reset(seed=0)
    plant = fake["plants"][-1]
    publish = plant._publish

    def broken(rows):
        publish(rows)
        plant.truth()["linear_velocity_in_body"][:, 0] = np.nan

    plant._publish = broken
    with pytest.raises(FloatingPointError, match="robot 0 of the batch left the finite numbers"):
        env.step(np.zeros(8, np.float32))


@pytest.mark.parametrize(
    ("registry", "kind", "task"),
    [
        (REWARDS, "reward", {"rewards": {"broken": {"weight": 1.0}}}),
        (MEASURES, "measure", {"measures": {"broken": {}}}),
        (TERMINATIONS, "termination", {"terminations": {"broken": {}}}),
    ],
)
def test_a_term_that_leaves_the_finite_numbers_is_named(fake, monkeypatch, registry, kind, task):
    term = ScalarTerm("broken", lambda signals: ops.sqrt(-1.0 - signals.time), {}, {}, "No number.")
    monkeypatch.setitem(registry, "broken", term)
    env = make(task=task)
    env.reset(seed=0)
    with pytest.raises(FloatingPointError, match=f"^{kind} 'broken': not finite for robot 0 of the batch"):
        env.step(np.zeros(8, np.float32))


# ---- episodes ----


def test_reset_options_set_parameters_after_randomisation(fake):
    env = make(randomization="nominal")
    _, info = env.reset(seed=0, options={"parameters": {"ground.mu_x": 0.2, "wheel.radius[wheel_lf]": 0.033}})
    plant = fake["plants"][-1]
    assert plant.parameters["ground.mu_x"].tolist() == [[0.2] * 4]
    assert plant.parameters["wheel.radius[wheel_lf]"].tolist() == [0.033]
    assert info["randomization"]["ground.mu_x[wheel_rr]"] == 0.2
    env.reset(seed=0)
    assert plant.parameters["ground.mu_x"].min() >= 0.3
    for options, expected in (
        ({"parameters": {"ground.mux": 1.0}}, "did you mean 'ground.mu_x'"),
        ({"parameters": {"ground.mu_x": -1.0}}, r"outside \[0, 5\]"),
        (
            {"parameters": {"ground.mu_x": "a"}},
            r"parameters: ground.mu_x = 'a': expected a number, or an array of shape \(4,\)",
        ),
        ({"parameters": {"ground.mu_x": [[1.0], [1.0, 2.0]]}}, "expected a number, or an array"),
        ({"comand": {}}, "did you mean 'command'"),
    ):
        with pytest.raises(InputError, match=expected):
            env.reset(options=options)


def test_interval_events_strike_each_in_its_own_time_and_leave_reset_options_alone(fake):
    events = {
        "push": push("external_force", -2.0, 2.0, [0.04, 0.2]),
        "drift": push("ground.mu_x", 0.3, 0.9, [0.5, 0.5]),
    }
    env = make_vec(4, randomization={"events": events})
    env.reset(seed=0, options={"parameters": {"ground.mu_x[wheel_lf]": 0.1}})
    friction, force = [], []
    for _ in range(60):
        env.step(np.zeros((4, 8)))
        friction.append(fake["plants"][-1].parameters["ground.mu_x"].copy())
        force.append(fake["plants"][-1].parameters["external_force[x]"].copy())
    friction, force = np.array(friction), np.array(force)
    assert np.array_equal(np.flatnonzero((np.diff(friction[:, :, 1], axis=0) != 0).all(axis=1)), [23, 48])
    assert np.all(friction[:, :, 0] == 0.1)
    strikes = [np.flatnonzero(np.diff(force[:, robot])) for robot in range(4)]
    assert len({tuple(ticks.tolist()) for ticks in strikes}) == 4
    assert all(np.diff(ticks).min() >= 2 and np.diff(ticks).max() <= 10 for ticks in strikes)


def test_reset_options_are_alike_for_all_robots_of_a_batch(fake):
    """A value per robot would not fit the one robot whose parameters an event redraws."""
    env = make_vec(3, randomization={"events": {"drift": push("ground.mu_x", 0.3, 0.9, [0.04, 0.04])}})
    for name, given, expected in (
        ("body.mass", [2.9, 3.0, 3.1], r"body\.mass of shape \(3,\): expected shape \(\), the same"),
        ("ground.mu_x", np.full((3, 4), 0.5), r"ground\.mu_x of shape \(3, 4\): expected shape \(4,\)"),
    ):
        with pytest.raises(InputError, match=expected):
            env.reset(seed=0, options={"parameters": {name: given}})
    env.reset(seed=0, options={"parameters": {"ground.mu_x": [0.1, 0.2, 0.3, 0.4], "body.mass": [3.0]}})
    for _ in range(4):
        env.step(np.zeros((3, 8)))
    assert fake["plants"][-1].parameters["ground.mu_x"].tolist() == [[0.1, 0.2, 0.3, 0.4]] * 3
    assert fake["plants"][-1].parameters["body.mass"].tolist() == [3.0] * 3


def test_every_episode_of_a_robot_is_another_one_and_all_repeat_with_the_seed(fake):
    env = make()

    def episodes():
        return [env.reset(seed=5)[0], *(env.reset()[0] for _ in range(3))]

    first, second = episodes(), episodes()
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))
    assert len({tuple(observation.tolist()) for observation in first}) == 4
    assert not np.array_equal(env.reset(seed=6)[0], first[0])


def test_a_seed_beyond_64_bits_is_no_small_one(fake):
    first = [make().reset(seed=seed)[0].tolist() for seed in (0, 2**64, 2**65, 2**200)]
    assert len({tuple(observation) for observation in first}) == 4
    assert make().reset(seed=2**64)[0].tolist() == first[1]
    batch = make_vec(2).reset(seed=2**64 - 1)[0].tolist()
    assert batch == [make().reset(seed=2**64 - 1)[0].tolist(), first[1]]


@pytest.mark.parametrize("face", [make, lambda: make_vec(3)])
def test_unseeded_environments_differ_and_tell_their_seed(fake, face):
    one = face()
    found, other = one.reset()[0], face().reset()[0]
    assert len(np.unique(np.vstack([found, other]), axis=0)) == 2 * np.atleast_2d(found).shape[0]
    assert np.array_equal(face().reset(seed=one.np_random_seed)[0], found)


@pytest.mark.parametrize("face", [make, lambda: make_vec(2)])
def test_a_generator_of_the_users_own_decides_what_is_drawn(fake, face):
    def first(seed):
        env = face()
        env.np_random = np.random.default_rng(seed)
        return env.reset()[0].tolist()

    assert first(1) == first(1) != first(2)


# ---- effects ----

PUSH = {"events": {"push": push("external_force[x]", 1.0, 2.0, [0.04, 0.1])}}
EFFECTS = [
    {"name": "external_force", "where": ["body"], "parameters": {"fx": 10.0}},
    {"name": "friction_level", "parameters": {"mu": 0.4}},
]


def test_effects_come_after_randomization_and_before_the_users_parameters(fake):
    plain, patched = make_vec(3, randomization=PUSH), make_vec(3, randomization=PUSH, effects=EFFECTS)
    for env in (plain, patched):
        env.reset(seed=0, options={"parameters": {"ground.mu_y": 0.3}})
    before = patched.core.parameters["external_force[x]"].copy()
    for _ in range(10):
        for env in (plain, patched):
            env.step(np.zeros((3, 8)))
        force = plain.core.parameters["external_force[x]"]
        assert np.array_equal(patched.core.parameters["external_force[x]"], force + 10.0)
        assert np.all(patched.core.parameters["ground.mu_x"] == 0.4)
        assert np.all(patched.core.parameters["ground.mu_y"] == 0.3)
    assert not np.array_equal(before, patched.core.parameters["external_force[x]"])
    changed = np.flatnonzero((plain.core.parameters.values != patched.core.parameters.values).any(axis=0))
    assert len(changed) == 5
    assert patched.contract() == plain.contract()


def test_effects_file_and_masked_reset(fake, tmp_path):
    path = tmp_path / "patch.yaml"
    path.write_text("effects: [{name: payload, parameters: {mass: 0.5, x: 0.0, y: 0.0, z: 0.05}}]")
    env, nominal = make_vec(2, effects=str(path), randomization="none"), make_vec(2, randomization="none")
    env.reset(seed=0)
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.core.parameters["payload.mass"].tolist() == [0.5, 0.5]
    nominal.reset(seed=0)
    assert nominal.core.parameters["payload.mass"].tolist() == [0.0, 0.0]


def test_effects_beyond_the_bounds_are_refused_when_made(fake):
    with pytest.raises(InputError, match=r"effect 2 \(floor_slope\)"):
        make(effects=[{"name": "floor_slope", "where": "ground", "parameters": {"pitch": 1.2}}] * 2)
