"""What an episode is scored by, against hand-made episodes whose scores are known."""

import numpy as np
import pytest
from evaluation_examples import EPISODES, MEASURES, PERIOD, TICKS, measured, rollout

from wlr_gym.learning.evaluation.card import score
from wlr_gym.learning.evaluation.metrics import metrics_of, spectrum, summarise
from wlr_gym.learning.evaluation.rollout import Measure


def test_perfect_driving():
    card = score(rollout())
    assert card["tracking_error"].mean == card["velocity_error"].mean == 0.0
    assert card["success"].mean == 100.0
    nothing = ("falls", "slip_speed", "excess_slip", "slip_per_metre", "saturation", "action_saturation", "action_jitter")
    assert [card[key].mean for key in nothing] == [0.0] * len(nothing)
    assert card["reward"].mean == pytest.approx(0.5 * TICKS)
    assert card["power"].mean == pytest.approx(1.0)
    travelled = 0.1 * PERIOD * (TICKS - 1)
    assert card["energy_per_metre"].mean == pytest.approx(1.0 * PERIOD * TICKS / travelled)
    assert list(card) != []
    assert {metric.key for metric in metrics_of(MEASURES)} == set(card)


def test_tracking_error_is_what_is_reached_of_every_limit():
    assert score(rollout(measured=measured(0.02, 0.06)))["tracking_error"].mean == pytest.approx(1.0)
    assert score(rollout(measured=measured(-0.01, 0.0)))["tracking_error"].mean == pytest.approx(0.5 / np.sqrt(2))


def test_a_limit_on_the_largest_error():
    errors = measured(0.0)
    errors[7, :, 0] = -0.3
    limited = rollout(measured=errors, measures=(Measure("lateral_error", "m", "aside", max=0.1), MEASURES[1]))
    card = score(limited)
    assert card["lateral_error_max"].mean == pytest.approx(0.3)
    assert card["lateral_error"].mean == pytest.approx(0.3 / np.sqrt(TICKS))
    assert card["tracking_error"].mean == pytest.approx(3.0 / np.sqrt(2))
    assert "max of lateral_error 0.1 m, rms of yaw_rate_error" in metrics_of(limited.measures)[0].doc


def test_a_task_without_limits_has_no_tracking_error():
    card = score(rollout(measures=(Measure("a", "m", ""), Measure("b", "m", ""))))
    assert np.isnan(card["tracking_error"].mean)


def test_slip_is_the_length_of_its_vector_averaged_over_wheels():
    slip = np.zeros((TICKS, EPISODES, 4, 2))
    slip[:, :, 0] = (0.03, 0.04)
    card = score(rollout(slip_velocity=slip))
    assert card["slip_speed"].mean == pytest.approx(0.05 / 4)
    assert card["slip_per_metre"].mean == pytest.approx(0.05 / 4 / 0.1, rel=0.03)


def test_ticks_after_the_end_do_not_count():
    active = np.ones((TICKS, EPISODES), bool)
    active[10:, 0] = False
    wild = np.where(active, 0.0, np.nan)
    errors = measured(0.0) + wild[:, :, None]
    fallen = np.array([True, False, False, False])
    card = score(rollout(active=active, measured=errors, energy=PERIOD + wild, fell=fallen, succeeded=~fallen))
    assert card["velocity_error"].mean == 0.0
    assert card["tracking_error"].mean == pytest.approx(10.0 / 4)  # one fall of four
    assert card["power"].mean == pytest.approx(1.0)
    assert card["falls"].mean == 25.0
    assert card["success"].mean == 75.0


def test_figures_per_metre_need_metres():
    assert np.isnan(score(rollout(position=np.zeros((TICKS, EPISODES, 2))))["slip_per_metre"].mean)


def wave(frequency, ticks=400, phase=0.0):
    """An action of amplitude 0.5 in one of eight joints; phase in half turns."""
    action = np.zeros((ticks, EPISODES, 8))
    action[:, :, 3] = 0.5 * np.sin(np.pi * (2 * frequency * PERIOD * np.arange(ticks) + phase))[:, None]
    return rollout(ticks, action=action)


def test_the_spectrum_holds_the_power_of_the_action_at_its_frequency():
    frequency, power = spectrum(wave(10.0))
    assert power.shape == (EPISODES, frequency.size)
    assert frequency[np.argmax(power[0])] == pytest.approx(10.0, abs=frequency[1])
    assert power[0].sum() * frequency[1] == pytest.approx(0.5**2 / 2 / 8, rel=0.02)


def test_an_action_that_alternates_every_tick_counts_once():
    assert score(wave(25.0, phase=0.5))["action_jitter"].mean == pytest.approx(0.5 / np.sqrt(8), rel=0.01)


def test_jitter_is_what_is_faster_than_5_hz():
    fast, slow = score(wave(10.0))["action_jitter"], score(wave(2.0))["action_jitter"]
    assert fast.mean == pytest.approx(0.5 / np.sqrt(2 * 8), rel=0.01)
    assert slow.mean < 0.01 * fast.mean


def test_an_episode_without_a_whole_window_has_no_spectrum():
    both = wave(10.0)
    active = both.active.copy()
    active[100:, 1] = False
    short = rollout(400, action=both.action, active=active)
    _, power = spectrum(short)
    assert np.isnan(power[1]).all()
    assert np.isfinite(power[[0, 2, 3]]).all()
    assert score(short)["action_jitter"].mean == pytest.approx(score(both)["action_jitter"].mean)


def test_an_action_at_its_limit_counts():
    action = np.zeros((TICKS, EPISODES, 8))
    action[:, :, 4:6] = (1.0, -1.0)
    assert score(rollout(action=action))["action_saturation"].mean == pytest.approx(25.0)


def test_blocks_are_stacked():
    kept = summarise([rollout(), rollout(measured=measured(0.02))])
    assert kept.pairs["velocity_error"].shape == (1, 2, EPISODES, 2)
    np.testing.assert_allclose(kept.pairs["velocity_error"][0, :, :, 0].mean(axis=1), [0.0, 0.02])


def test_median_and_tail_of_the_tracking_error():
    reached = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 4.0])
    card = score(rollout(episodes=10, measured=measured(0.02 * reached, 0.06 * reached, episodes=10)))
    assert card["tracking_error"].mean == pytest.approx(0.85)
    assert card["tracking_error_median"].mean == pytest.approx(0.5)
    assert card["tracking_error_p90"].mean == pytest.approx(0.9)
    assert 0.15 < card["tracking_error_median"].low < 0.5 < card["tracking_error_median"].high < 0.85


def test_errors_by_friction_ratio():
    """Ratios of 1, 3, 4.5 and 9, whichever wheel grips; excess slip of the last two."""
    friction = np.ones((4, 4, 2))
    friction[[1, 2, 3], [0, 1, 2], 0] = 1.0 / 3.0, 4.5, 1.0 / 9.0
    excess = np.broadcast_to([0.001, 0.002, 0.003, 0.005], (TICKS, 4))
    reached = np.array([0.1, 0.2, 0.3, 0.5])
    card = score(rollout(friction=friction, excess_slip=excess, measured=measured(0.02 * reached, 0.06 * reached)))
    found = [card[f"tracking_error_{name}"].mean for name in ("even", "uneven", "hard")]
    assert found == pytest.approx([0.1, 0.2, 0.4])
    assert card["excess_slip_hard"].mean == pytest.approx(0.004)
    assert np.isnan(score(rollout())["tracking_error_hard"].mean)


def test_slip_by_load():
    """A wheel without load slips for nothing, one with all of it for all."""
    slip, load = np.zeros((TICKS, EPISODES, 4, 2)), np.zeros((TICKS, EPISODES, 4))
    slip[:, :, 0, 0], slip[:, :, 1, 1] = 0.08, 0.02
    load[:, :, 1], load[:, :, 2] = 10.0, 30.0
    card = score(rollout(slip_velocity=slip, load=load))
    assert card["load_weighted_slip"].mean == pytest.approx(0.005)
    assert card["slip_speed"].mean == pytest.approx(0.025)


def test_steady_and_transient_parts():
    """The error is 2 in the first 2 s and after a change of command, else 1; both parts together are the whole."""
    ticks, change = 400, 200
    since = np.concatenate([np.arange(change), np.arange(ticks - change)]) * PERIOD
    size = np.where(since < 2.0, 2.0, 1.0)
    command = np.zeros((ticks, EPISODES, 2))
    command[change:, :, 1] = 0.3
    errors = measured(0.0, ticks=ticks)
    errors[:, :, 0], errors[:, :, 1] = 0.02 * size[:, None], 0.06 * size[:, None]
    card = score(rollout(ticks=ticks, command=command, measured=errors))
    assert card["tracking_error_transient"].mean == pytest.approx(2.0)
    assert card["tracking_error_steady"].mean == pytest.approx(1.0)
    assert card["tracking_error"].mean == pytest.approx(np.sqrt((4.0 + 1.0) / 2))


def test_an_episode_without_a_steady_part():
    card = score(rollout(measured=measured(0.02, 0.06)))
    assert np.isnan(card["tracking_error_steady"].mean)
    assert card["tracking_error_transient"].mean == pytest.approx(1.0)


def test_the_scale_of_the_tracking_error_is_not_the_limit_of_success():
    """Twice the limit and half the scale: no success, though the tracking error is small."""
    own = (Measure("velocity_error", "m/s", "ahead", rms=0.01, scale=0.04), MEASURES[1])
    errors = measured(0.02, 0.0)
    card = score(rollout(measured=errors, measures=own, succeeded=np.zeros(EPISODES, bool)))
    assert card["tracking_error"].mean == pytest.approx(0.5 / np.sqrt(2))
    assert card["success"].mean == 0.0
    assert card["within_scales"].mean == 100.0
    docs = {metric.key: metric.doc for metric in metrics_of(own)}
    assert "0.04 m/s" in docs["tracking_error"]
    assert "0.01 m/s" in docs["success"]
    largest = (Measure("velocity_error", "m/s", "ahead", max=0.1, scale=0.04), MEASURES[1])  # as the environment has it
    assert score(rollout(measured=errors, measures=largest))["tracking_error"].mean == pytest.approx(0.2 / np.sqrt(2))
