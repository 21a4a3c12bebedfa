"""The planner on the true state: reproducible, at home in evaluations only, and better than what it begins with."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.learning.evaluation.card import score
from wlr_gym.learning.evaluation.rollout import make_core, roll_out
from wlr_gym.learning.evaluation.subjects import make_player
from wlr_gym.policy import load_agent, make_policy

SLIPS = {"randomization": "split", "episode_length": 0.6, "precision": "float32"}


def played(name: str, count: int, conditions=SLIPS):
    core, policy = make_player("WLR-Velocity-v0", name, count, conditions)
    rollout = roll_out(core, policy, 3)
    core.close()
    return rollout


def test_same_seed_same_plans():
    first, again = played("mppi", 2), played("mppi", 2)
    np.testing.assert_array_equal(first.action, again.action)


def test_alone_as_in_a_batch():
    first, third = played("mppi", 3), played("mppi", 1)
    np.testing.assert_allclose(first.action[:, :1], third.action, atol=1e-6)


def test_planning_leaves_the_robots_alone():
    """The robots under the planner's actions do what they do under the same actions without a planner."""
    rollout = played("mppi", 2)
    core = make_core("WLR-Velocity-v0", 2, SLIPS)
    for row in range(2):
        core.seed(row, 3 + row)
    core.begin_episodes(core.everyone)
    for action, position in zip(rollout.action, rollout.position, strict=True):
        core.step(action, core.everyone)
        np.testing.assert_array_equal(core.plant.truth()["position"][:, :2], position)
    core.close()


@pytest.mark.parametrize(("name", "parameter"), [("mppi_nominal", "ground.mu_x"), ("mppi_nominal", "servo.stall_torque")])
def test_what_is_not_known_changes_no_plan(name, parameter):
    """The same state on another floor, or with other motors: a planner that does not know of it does the same."""
    core, knowing = make_player("WLR-Velocity-v0", "mppi", 1, SLIPS)
    ignorant: Any = make_policy(name, core.contract())
    ignorant.use_simulator(core)
    core.seed(0, 3)
    core.begin_episodes(core.everyone)
    before = [policy.act(core.observation) for policy in (ignorant, knowing)]
    core.parameters[parameter] = 0.5 * core.parameters[parameter]
    core.plant.set_parameters(core.parameters, core.everyone)
    for policy in (ignorant, knowing):
        policy.reset(core.everyone)
    after = [policy.act(core.observation) for policy in (ignorant, knowing)]
    core.close()
    np.testing.assert_array_equal(after[0], before[0])
    assert (after[1] != before[1]).any()


@pytest.mark.slow
def test_plans_are_better_than_the_controller_on_split_floors():
    conditions = {**SLIPS, "episode_length": 3.0}
    ours, theirs = (score(played(name, 4, conditions))["tracking_error"].mean for name in ("mppi", "slip_compensating"))
    assert ours < 0.6 * theirs


def test_needs_a_simulator_and_limits():
    core = make_core("WLR-Velocity-v0", 1, {})
    with pytest.raises(InputError, match="wlr evaluate"):
        make_policy("mppi", core.contract()).act(core.observation)
    core.close()
    core = make_core("WLR-Velocity-v0", 1, {"task": {"success": {"velocity_error": None, "yaw_rate_error": None}}})
    planner: Any = load_agent("mppi").make_policy(core.contract(), {})
    with pytest.raises(InputError, match="no limits of success"):
        planner.use_simulator(core)
    core.close()


def test_settings_are_checked():
    core = make_core("WLR-Velocity-v0", 1, {})
    with pytest.raises(InputError, match="horizon"):
        load_agent("mppi").make_policy(core.contract(), {"horizonn": 3})
    core.close()
