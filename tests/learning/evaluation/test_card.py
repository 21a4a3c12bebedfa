"""Score cards: what is compared, what is written; and the episodes themselves, the same for the same seeds."""

import json

import numpy as np
import pandas
import pytest
from evaluation_examples import EPISODES, TICKS, measured, rollout

from wlr_gym.base.plots import COLOURS, GREY
from wlr_gym.envs.tasks.signals import yaw_of
from wlr_gym.learning.evaluation.card import (
    MAIN,
    OTHER_PLANT,
    Card,
    cell,
    comparison_rows,
    rows,
    sweep_comparison_rows,
    sweep_rows,
    transfer_rows,
    write_card,
    write_episodes,
)
from wlr_gym.learning.evaluation.conditions import SWEEPS
from wlr_gym.learning.evaluation.metrics import Estimate, summarise
from wlr_gym.learning.evaluation.plots import draw_card, improvements, learning_curve, pareto
from wlr_gym.learning.evaluation.rollout import make_core, roll_out, saturated
from wlr_gym.policy import make_policy

ONE = np.ones((TICKS, EPISODES))


def played(error, reward=1.0, blocks=1):
    return summarise([rollout(measured=measured(error), reward=reward / TICKS * ONE) for _ in range(blocks)])


def card(**more):
    main = {"ours": played(0.01, 9.0), "do_nothing": played(0.05, 1.0), "pid": played(0.02, 7.0)}
    return Card({MAIN: main, **more}, conditions={"environment": "WLR-Velocity-v0"})


def test_the_first_subject_is_compared_with_each_other():
    better = card().comparison[MAIN]
    assert list(better) == ["do_nothing", "pid"]
    assert better["pid"]["velocity_error"].mean == pytest.approx(50.0)
    assert better["pid"]["reward"].mean == pytest.approx(2.0)  # no share: a reward has no zero
    assert better["pid"]["success"].mean == better["pid"]["falls"].mean == 0.0


def test_less_falls_are_better():
    fallen = summarise([rollout(fell=np.array([True, False, False, False]))])
    main = {"ours": played(0.01), "clumsy": fallen}
    assert Card({MAIN: main}).comparison[MAIN]["clumsy"]["falls"].mean == pytest.approx(25.0)


def test_a_score_counts_from_doing_nothing():
    assert card().share_of == {"pid": pytest.approx(card().share_of["pid"])}
    assert card().share_of["pid"].mean == pytest.approx(100.0 * (9 - 1) / (7 - 1))
    without = Card({MAIN: {"ours": played(0.01), "pid": played(0.02)}})
    assert without.share_of == {}


def test_what_is_kept_on_the_other_plant_is_paired_with_the_same_episodes():
    main = {"ours": played(0.01, 9.0, blocks=2), "do_nothing": played(0.05, 1.0, blocks=2)}
    other = {"ours": played(0.02, 5.0), "do_nothing": played(0.05, 3.0)}
    both = Card({MAIN: main, OTHER_PLANT: other})
    assert both.kept["ours"].mean == pytest.approx(100.0 * (5 - 3) / (9 - 1))
    assert transfer_rows(both)[1][:2] == ["ours", "25.0 [25.0, 25.0]"]
    assert "do_nothing" not in both.kept


def test_rows_show_nothing_where_there_is_nothing():
    still = summarise([rollout(position=np.zeros((TICKS, EPISODES, 2)))])
    table = {row[0]: row[2] for row in rows(Card({MAIN: {"still": still}}).scores[MAIN], card().metrics)}
    assert table["slip_per_metre"] == "-"
    assert table["power"] == "1.00 [1.00, 1.00]"
    better = {row[0]: row[2:] for row in comparison_rows(card())}
    assert better["slip_speed"] == ["-", "-"]
    assert better["score, % of the baseline's"] == ["-", "133.3 [133.3, 133.3]"]
    assert better["velocity_error"] == ["**80.0 [80.0, 80.0]**", "**50.0 [50.0, 50.0]**"]
    assert better["success"][0] == "0 [0, 0]"


def test_next_to_nothing_has_no_sign():
    assert cell(Estimate(-0.2, -0.4, 0.3), 0) == "0 [0, 0]"
    assert cell(Estimate(5000.0, 1.0, 9000.0), 0) == "-"
    assert cell(Estimate(2.0, np.nan, np.nan), 1, short=True) == cell(Estimate(2.0, np.nan, np.nan), 1) == "2.0"


@pytest.fixture(scope="module")
def swept():
    sweep = SWEEPS["friction"]
    points = {sweep.label(p): {"ours": played(0.002 / p.value), "pid": played(0.004 / p.value)} for p in sweep.points}
    main = {"ours": played(0.01), "do_nothing": played(0.05), "pid": played(0.02)}
    other = {name: played(0.03) for name in main}
    for point in points.values():
        point["do_nothing"] = played(0.05)
    return Card({MAIN: main, OTHER_PLANT: other, **points}, (sweep,), {"episodes": EPISODES})


def test_a_sweep_has_a_row_per_point(swept):
    header, *body = sweep_rows(swept, 0)
    assert header[1:] == ["ours", "do_nothing", "pid"]
    assert [row[0] for row in body] == [point.label for point in SWEEPS["friction"].points]
    assert body[0][1].startswith("1.414 ±")  # 0.04 m/s: twice one of two limits
    header, *body = sweep_comparison_rows(swept, 0)
    assert header[1:] == ["do_nothing", "pid"]
    assert [row[2] for row in body] == ["**50.0 [50.0, 50.0]**"] * len(body)


def test_card_files(swept, tmp_path):
    folder = tmp_path / "new"
    folder.mkdir()
    pictures = draw_card(folder, swept)
    write_card(folder, swept, pictures)
    write_episodes(folder / "episodes.parquet", swept, 7)
    assert set(pictures.values()) == {"spectrum.png", "improvement.png", "pareto.png", "sweep_friction.png"}
    assert all((folder / name).stat().st_size > 5000 for name in pictures.values())
    text = (folder / "card.md").read_text()
    assert text.startswith("# Score card: ours\n")
    assert "| success | % | 100 [100, 100] | 100 [100, 100] | 100 [100, 100] |" in text
    assert all(f"]({name})" in text for name in pictures.values())
    content = json.loads((folder / "card.json").read_text())
    assert content["policies"]["ours"]["velocity_error"]["mean"] == pytest.approx(0.01)
    assert content["better_than"]["pid"]["velocity_error"]["mean"] == pytest.approx(50.0)
    assert content["sweeps"]["friction"][0]["at"] == "0.05"
    assert content["sweeps"]["friction"][0]["policies"]["pid"]["velocity_error"]["mean"] == pytest.approx(0.08)
    assert content["other_plant"]["policies"]["ours"]["velocity_error"]["mean"] == pytest.approx(0.03)
    assert content["policies"]["ours"]["slip_per_metre"]["mean"] == 0.0
    episodes = pandas.read_parquet(folder / "episodes.parquet")
    assert len(episodes) == EPISODES * 3 * (2 + len(SWEEPS["friction"].points))
    assert episodes["seed"].tolist()[:EPISODES] == [7, 8, 9, 10]


def test_pictures_of_values_that_are_wide_apart():
    wide = Card({MAIN: {"ours": played(0.05), "pid": played(0.001), "other": played(0.04)}})
    assert "-4900 %" in [text.get_text() for text in improvements(wide).axes[0].texts]  # the bar ends at -100
    assert pareto(wide).axes[0].get_xscale() == "log"
    assert pareto(card()).axes[0].get_xscale() == "linear"


def test_yaw_of_a_quaternion():
    angle = np.array([0.0, 1.0, -3.0])
    turned = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    np.testing.assert_allclose(yaw_of(*turned.T), angle)


@pytest.fixture(scope="module")
def core():
    made = make_core("WLR-Velocity-v0", 6, {"episode_length": 1.0})
    yield made
    made.close()


def same(first, second):
    return all(np.array_equal(value, getattr(second, name)) for name, value in vars(first).items())


def test_episodes_repeat_bit_for_bit(core):
    policy = make_policy("constant_command", core.contract())
    first = roll_out(core, policy, 5)
    assert same(first, roll_out(core, policy, 5))
    assert not same(first, roll_out(core, policy, 6))
    assert first.active.shape == (50, 6)


def test_an_episode_depends_on_its_seed_and_not_on_the_batch(core):
    policy = make_policy("constant_command", core.contract())
    alone = make_core("WLR-Velocity-v0", 1, {"episode_length": 1.0})
    mine, batch = roll_out(alone, policy, 8), roll_out(core, policy, 5)
    alone.close()
    np.testing.assert_array_equal(mine.position[:, 0], batch.position[:, 3])
    np.testing.assert_array_equal(mine.slip_velocity[:, 0], batch.slip_velocity[:, 3])


def test_parameters_are_set_after_randomisation(core):
    policy = make_policy("constant_command", core.contract())
    slippery = roll_out(core, policy, 5, parameters={"ground.mu_x": 0.07, "ground.mu_y": 0.07, "patch.mu": 0.07})
    np.testing.assert_allclose(slippery.friction, 0.07)
    assert roll_out(core, policy, 5).friction.std() > 0.05


def test_a_fall_ends_the_episode():
    falling = make_core("WLR-Velocity-v0", 3, {"task": {"terminations": {"left_floor": {"clearance": -1.0}}}})
    fallen = roll_out(falling, make_policy("do_nothing", falling.contract()), 0)
    falling.close()
    assert fallen.fell.all()
    assert not fallen.succeeded.any()
    assert fallen.active.sum() == 3


class Spin:
    """Left wheels back, right wheels ahead at full speed: beyond what the supply can do against skidding."""

    def act(self, observations):
        return np.tile(np.array([0, 0, 0, 0, -1, 1, -1, 1], np.float32), (len(observations), 1))

    def reset(self, mask):
        pass


def test_full_throttle_saturates_and_rest_does_not(core):
    grippy = {"ground.mu_x": 0.9, "ground.mu_y": 0.9, "patch.mu": 0.9}
    assert roll_out(core, Spin(), 0, parameters=grippy).saturated[-10:, :, 4:].mean() > 0.5
    assert not roll_out(core, make_policy("do_nothing", core.contract()), 0).saturated[25:].any()


def test_slip_beyond_a_turn_is_what_the_reward_counts(core):
    spun = roll_out(core, Spin(), 0)
    slip = core.task.rewards.index("slip")
    rate = core.task.config.rewards["slip"]["weight"] * core.task.config.control_period / 0.05
    np.testing.assert_allclose(spun.excess_slip[-1] * rate, core.scores.terms[:, slip], rtol=1e-9)
    assert 0.0 < spun.excess_slip.mean() < np.linalg.norm(spun.slip_velocity, axis=-1).mean()


def test_saturation_follows_the_motor_law(core):
    truth = core.plant.truth()
    truth["motor_torque"][:] = 0.0
    truth["joint_velocity"][:] = 0.0
    truth["joint_velocity"][:, 4] = core.task.robot.servo.wheel.no_load_speed  # no torque at no-load speed: full voltage
    truth["motor_torque"][:, 0] = 0.5 * core.task.robot.servo.leg.stall_torque  # half voltage at standstill
    limits = saturated(truth, core.task.robot)
    assert limits[:, 4].all()
    assert limits.sum() == core.count


SIZES = {"slip": -0.8, "tracking": 1.0, "energy": -0.1, "posture": -0.02, "error": -0.7, "torque": 0.0, "action": -0.3}
CURVE = [
    {"steps": 1e6 * k, "reward_per_second": 1.0, **{f"term.{name}": k * size for name, size in SIZES.items()}} for k in (1, 2)
]


def test_terms_that_matter_have_a_curve_and_the_others_one():
    right = learning_curve(CURVE, {"pid": 1.5}).axes[1]
    assert [line.get_label() for line in right.lines] == ["tracking", "slip", "error", "action", "3 others"]
    assert [line.get_color() for line in right.lines] == [*COLOURS[:4], GREY]
    np.testing.assert_allclose(np.asarray(right.lines[-1].get_ydata()), [-0.12, -0.24])
    few = [{key: row[key] for key in ("steps", "reward_per_second", "term.slip")} for row in CURVE]
    assert [line.get_label() for line in learning_curve(few, {}).axes[1].lines] == ["slip"]
