"""The controller that the environment computes is the agent ``slip_compensating``: two implementations, one law."""

from __future__ import annotations

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks import load_task
from wlr_gym.learning.evaluation import make_core
from wlr_gym.policy import Policy, load_agent
from wlr_gym.robot import JOINTS

PROMPT = {"joints": {"delay": [0.0, 0.0]}, "imu": {"delay": [0.0, 0.0]}}
#: Every gain at work, none as it ships.
GAINS = {
    "steering": 1.7, "yaw_rate_p": 3.0, "yaw_rate_i": 4.0, "velocity_p": 2.0, "velocity_i": 3.0, "lateral": 3.0, "heading": 1.5,
    "uphill": 0.05, "legs_inward": 0.1, "lean_time": 0.5, "leg_i": 0.7,
    "integral_limit": 0.05, "slip_limit": 0.05, "load_shift": 2.0, "load_shift_time": 0.3,
}  # fmt: skip
TASKS = ("velocity", "path", "posture", "slope")


def core_with_controller(task: str, count: int = 4, gains=GAINS, **more):
    term = f"{task}_controller"
    changes = {"latency": PROMPT, "controller": gains, "observations": {term: {}}, **more}
    core = make_core(f"WLR-{task.title()}-v0", count, {"task": changes})
    columns = [k for k, column in enumerate(core.task.policy) if column.term == term]
    for row in range(count):
        core.seed(row, row)
    core.begin_episodes(core.everyone)
    return core, columns


def agent_of(core, gains=GAINS) -> Policy:
    policy = load_agent("slip_compensating").make_policy(core.contract(), gains)
    policy.reset(core.everyone)
    return policy


@pytest.mark.parametrize("task", TASKS)
def test_action_is_that_of_the_agent(task):
    core, columns = core_with_controller(task)
    agent = agent_of(core)
    seen = []
    for _ in range(150):
        actions = agent.act(core.observation)
        np.testing.assert_allclose(core.observation[:, columns[: len(JOINTS)]], actions, atol=2e-6)
        seen.append(actions)
        core.step(actions, core.everyone)
    core.close()
    assert np.ptp(seen, axis=0).max() > 0.1


@pytest.mark.parametrize(
    "changes",
    [
        {"lean_time": 0.0},
        {"legs_inward": -0.1},
        {"legs_inward": 0.0},
        {"legs_inward": 0.35, "load_shift": 0.0},
        {"legs_inward": 0.2},
    ],
    ids=["at once", "outward", "home", "beyond the action", "beyond the action with load shift"],
)
def test_legs_of_agent_and_task_agree_whatever_the_gains(changes):
    """Also where the action does not reach as far as the legs are to go, and after one robot alone begins anew."""
    gains = GAINS | changes
    core, columns = core_with_controller("velocity", 4, gains, action={"leg_scale": 0.15})
    agent = agent_of(core, gains)
    for tick in range(90):
        actions = agent.act(core.observation)
        np.testing.assert_allclose(core.observation[:, columns[: len(JOINTS)]], actions, atol=2e-6)
        core.step(actions, core.everyone)
        if tick == 40:
            second = np.arange(4) == 1
            core.begin_episodes(second)
            agent.reset(second)
    core.close()


def test_memory_is_of_the_episode_and_in_snapshots():
    core, columns = core_with_controller("velocity")
    memory = columns[len(JOINTS) :]
    first = core.observation[:, memory].copy()
    for _ in range(40):
        core.step(core.observation[:, columns[: len(JOINTS)]], core.everyone)
    assert (np.abs(core.observation[:, memory]) > np.abs(first)).any()
    for row in range(core.count):
        core.seed(row, row)
    core.begin_episodes(core.everyone)
    np.testing.assert_array_equal(core.observation[:, memory], first)
    core.close()


def test_gains_are_data():
    """Another gain compiles nothing and acts."""
    changes = {"controller": {"steering": 0.0}, "observations": {"velocity_controller": {}}}
    core = make_core("WLR-Velocity-v0", 1, {"task": changes})
    core.seed(0, 0)
    core.begin_episodes(core.everyone, {"command": {"linear_velocity_x": 0.0, "yaw_rate": 0.3}})
    columns = [k for k, column in enumerate(core.task.policy) if column.term == "velocity_controller"]
    np.testing.assert_allclose(core.observation[0, columns[:8]], 0.0, atol=1e-6)
    assert core.contract()["controller"]["steering"] == 0.0
    core.close()


def test_controller_needs_gains():
    with pytest.raises(InputError, match=r"observation term 'velocity_controller' needs 'controller'"):
        load_task("velocity", None, {"observations": {"velocity_controller": {}}})
    with pytest.raises(InputError, match="yaw_rate_p"):
        load_task("velocity", None, {"controller": {"yaw_rate_pp": 1.0}})


def test_controller_of_another_task_is_refused():
    with pytest.raises(InputError, match=r"'path_controller' needs the command 'path_"):
        load_task("velocity", None, {"controller": {}, "observations": {"path_controller": {}}})


def test_legs_reach_under_the_body_evenly_from_the_start():
    """As the gain says: a tenth of the way per 0.1 s of 1 s, front and rear legs towards each other, and no further."""
    changes = {
        "latency": PROMPT,
        "controller": {"legs_inward": 0.2, "lean_time": 1.0},
        "observations": {"velocity_controller": {}},
    }
    core = make_core("WLR-Velocity-v0", 1, {"task": changes, "randomization": "none"})
    columns = [k for k, column in enumerate(core.task.policy) if column.term == "velocity_controller"][:4]
    core.seed(0, 0)
    core.begin_episodes(core.everyone)
    leaned = []
    for _ in range(60):
        leaned.append(core.observation[0, columns] * core.task.actions[0].scale)
        core.step(np.zeros((1, 8), np.float32), core.everyone)
    core.close()
    wanted = 0.2 * np.minimum(np.arange(1, 61) * 0.02, 1.0)
    np.testing.assert_allclose(np.abs(leaned), wanted[:, None].repeat(4, axis=1), atol=1e-6)
    assert (np.sign(leaned[-1]) == [1, 1, -1, -1]).all() or (np.sign(leaned[-1]) == [1, -1, 1, -1]).all()


def test_legs_are_not_thrown_from_where_an_episode_begins():
    """The first leg setpoints are where the legs stand; on they go at the rate of the gain."""
    changes = {
        "latency": PROMPT,
        "controller": {"legs_inward": 0.2, "lean_time": 1.0},
        "observations": {"velocity_controller": {}},
    }
    start = {"name": "crooked", "base": "none", "initial_state": {"leg_angle": 0.1}}
    core = make_core("WLR-Velocity-v0", 3, {"task": changes, "randomization": start})
    columns = [k for k, column in enumerate(core.task.policy) if column.term == "velocity_controller"]
    for row in range(3):
        core.seed(row, row)
    core.begin_episodes(core.everyone)
    stand, sent = core.state.joint_position[:, :4] - core.task.robot.home.leg_angle, []
    for _ in range(100):
        action = core.observation[:, columns[: len(JOINTS)]].copy()
        sent.append(action[:, :4] * core.task.actions[0].scale)
        core.step(action, core.everyone)
    core.close()
    assert np.ptp(stand) > 0.05
    assert np.abs(sent[0] - stand).max() < 0.2 * 0.02 + 0.002  # the encoder's resolution
    assert np.abs(np.diff(sent, axis=0)).max() < 0.2 * 0.02 + 1e-6
    np.testing.assert_allclose(np.abs(sent[-1]), 0.2, atol=1e-6)


def test_legs_that_sweep_are_held_against_loads():
    """With the integral the servos' sag under load goes from the legs' angles; without it, it stays."""
    errors = {}
    for gain in (0.0, 2.0):
        changes = {
            "controller": GAINS | {"legs_inward": 0.0, "load_shift": 0.0, "leg_i": gain},
            "observations": {"posture_controller": {}},
        }
        core = make_core("WLR-Posture-v0", 1, {"task": changes, "randomization": "none"})
        columns = [k for k, column in enumerate(core.task.policy) if column.term == "posture_controller"][:8]
        core.seed(0, 3)
        core.begin_episodes(core.everyone)
        for _ in range(190):
            core.step(core.observation[:, columns], core.everyone)
        errors[gain] = abs(core.measures[0, list(core.task.measures).index("leg_error")])
        core.close()
    assert errors[2.0] < 0.5 * errors[0.0]
