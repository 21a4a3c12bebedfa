"""Score cards: figures against hand-made episodes whose answer is known; the same episodes for the same seeds."""

import json

import numpy as np
import pytest

from wlr_gym.cli import main
from wlr_gym.evaluation import Rollout, make_core, roll_out, rows, score, write_card
from wlr_gym.evaluation.plots import commanded_path
from wlr_gym.evaluation.rollout import saturated, yaw_of
from wlr_gym.policy import make_policy

TICKS, EPISODES, PERIOD = 50, 4, 0.02


def rollout(**changes):
    """Robots that drive along x at 0.1 m/s as told, without slip, drawing 1 W."""
    one, vector = np.ones((TICKS, EPISODES)), np.zeros((TICKS, EPISODES, 2))
    position, command = vector.copy(), vector.copy()
    position[:, :, 0] = 0.1 * PERIOD * np.arange(TICKS)[:, None]
    command[:, :, 0] = 0.1
    content = {
        "control_period": PERIOD,
        "seeds": np.arange(EPISODES),
        "command_names": ("linear_velocity_x", "yaw_rate"),
        "active": one > 0,
        "fell": np.zeros(EPISODES, bool),
        "reward": 0.5 * one,
        "command": command,
        "position": position,
        "yaw": 0 * one,
        "forward_velocity": 0.1 * one,
        "yaw_rate": 0 * one,
        "slip_velocity": np.zeros((TICKS, EPISODES, 4, 2)),
        "energy": 1.0 * PERIOD * one,
        "saturated": np.zeros((TICKS, EPISODES, 8), bool),
        "friction": np.ones((EPISODES, 4, 2)),
        "sampled": ("body.mass",),
        "samples": np.ones((EPISODES, 1)),
    }
    return Rollout(**(content | changes))


def test_perfect_driving():
    card = score(rollout())
    assert card["velocity_error"].mean == pytest.approx(0.0, abs=1e-12)
    assert card["success"].mean == 100.0
    assert card["falls"].mean == card["slip_speed"].mean == card["slip_per_metre"].mean == card["saturation"].mean == 0.0
    assert card["reward"].mean == pytest.approx(0.5 * TICKS)
    travelled = 0.1 * PERIOD * (TICKS - 1)
    assert card["energy_per_metre"].mean == pytest.approx(1.0 * PERIOD * TICKS / travelled)


def test_slip_is_the_length_of_its_vector_averaged_over_wheels():
    slip = np.zeros((TICKS, EPISODES, 4, 2))
    slip[:, :, 0] = (0.03, 0.04)
    card = score(rollout(slip_velocity=slip))
    assert card["slip_speed"].mean == pytest.approx(0.05 / 4)
    assert card["slip_per_metre"].mean == pytest.approx(0.05 / 4 / 0.1, rel=0.03)


def test_interval_holds_the_mean_and_vanishes_without_spread():
    spread = 0.1 + np.linspace(0.0, 0.03, EPISODES) * np.ones((TICKS, 1))
    card = score(rollout(forward_velocity=spread))
    error = card["velocity_error"]
    assert error.low < error.mean < error.high
    assert error.mean == pytest.approx(0.015)
    assert card["reward"].low == card["reward"].high


def test_ticks_after_the_end_do_not_count():
    active = np.ones((TICKS, EPISODES), bool)
    active[10:, 0] = False
    wild = np.where(active, 0.1, 99.0)
    card = score(rollout(active=active, forward_velocity=wild, fell=np.array([True, False, False, False])))
    assert card["velocity_error"].mean == pytest.approx(0.0, abs=1e-12)
    assert card["falls"].mean == 25.0
    assert card["success"].mean == 75.0


def test_figures_per_metre_need_metres():
    card = score(rollout(position=np.zeros((TICKS, EPISODES, 2))))
    assert np.isnan(card["slip_per_metre"].mean)
    assert dict(zip(*np.array(rows({"still": card}))[[0, 6]].tolist(), strict=True))["still"] == "-"


def test_card_files(tmp_path):
    write_card(tmp_path / "new", {"mine": score(rollout())}, {"episodes": EPISODES})
    content = json.loads((tmp_path / "new" / "card.json").read_text())
    assert content["policies"]["mine"]["success"]["mean"] == 100.0
    assert "| success | % | 100 [100, 100] |" in (tmp_path / "new" / "card.md").read_text()


def test_yaw_of_a_quaternion():
    angle = np.array([0.0, 1.0, -3.0])
    turned = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    np.testing.assert_allclose(yaw_of(turned), angle)


def test_commanded_path_of_a_circle_closes():
    turn = 2 * np.pi / (PERIOD * (TICKS - 1))
    command = np.stack([np.full((TICKS, EPISODES), 0.1), np.full((TICKS, EPISODES), turn)], axis=-1)
    path, yaw = commanded_path(rollout(command=command), 0, TICKS)
    np.testing.assert_allclose(path[-1], path[0], atol=1e-3)
    assert yaw[-1] == pytest.approx(2 * np.pi)


@pytest.fixture(scope="module")
def core():
    made = make_core("WLR-Velocity-v0", 6, {"episode_length": 1.0})
    yield made
    made.close()


def same(first, second):
    return all(np.array_equal(value, getattr(second, name)) for name, value in vars(first).items())


def test_episodes_repeat_bit_for_bit(core):
    policy = make_policy("proportional", core.contract())
    first = roll_out(core, policy, 5)
    assert same(first, roll_out(core, policy, 5))
    assert not same(first, roll_out(core, policy, 6))
    assert first.active.shape == (50, 6)


def test_an_episode_depends_on_its_seed_and_not_on_the_batch(core):
    policy = make_policy("proportional", core.contract())
    alone = make_core("WLR-Velocity-v0", 1, {"episode_length": 1.0})
    mine, batch = roll_out(alone, policy, 8), roll_out(core, policy, 5)
    alone.close()
    np.testing.assert_array_equal(mine.position[:, 0], batch.position[:, 3])
    np.testing.assert_array_equal(mine.slip_velocity[:, 0], batch.slip_velocity[:, 3])


def test_a_fall_ends_the_episode():
    falling = make_core("WLR-Velocity-v0", 3, {"task": {"terminations": {"left_floor": {"clearance": -1.0}}}})
    fallen = roll_out(falling, make_policy("do_nothing", falling.contract()), 0)
    falling.close()
    assert fallen.fell.all()
    assert fallen.active.sum() == 3


def test_full_throttle_saturates_and_rest_does_not(core):
    class Spin:
        """Left wheels back, right wheels ahead at full speed: beyond what the supply can do against skidding."""

        def act(self, observations):
            return np.tile(np.array([0, 0, 0, 0, -1, 1, -1, 1], np.float32), (len(observations), 1))

        def reset(self, mask):
            pass

    assert roll_out(core, Spin(), 0).saturated[-10:, :, 4:].mean() > 0.5
    assert not roll_out(core, make_policy("do_nothing", core.contract()), 0).saturated[25:].any()


def test_saturation_follows_the_motor_law(core):
    truth = core.plant.truth()
    truth["motor_torque"][:] = 0.0
    truth["joint_velocity"][:] = 0.0
    truth["joint_velocity"][:, 4] = core.task.robot.servo.wheel.no_load_speed  # no torque at no-load speed: full voltage
    truth["motor_torque"][:, 0] = 0.5 * core.task.robot.servo.leg.stall_torque  # half voltage at standstill
    limits = saturated(truth, core.task.robot)
    assert limits[:, 4].all()
    assert limits.sum() == core.count


def test_evaluate_command_writes_the_same_card_twice(tmp_path, capsys):
    arguments = ["evaluate", "proportional", "--baselines", "do_nothing", "--episodes", "3", "--no-progress", "--out"]
    assert main([*arguments, str(tmp_path / "a")]) == 0
    assert main([*arguments, str(tmp_path / "b")]) == 0
    assert "yaw_rate_error" in capsys.readouterr().out
    first, second = (json.loads((tmp_path / name / "card.json").read_text()) for name in "ab")
    assert first == second
    assert list(first["policies"]) == ["proportional", "do_nothing"]
    assert (tmp_path / "a" / "provenance.yaml").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "proportionl"], "did you mean 'proportional'"),
        (["evaluate", "do_nothing", "--randomization", "wid"], "did you mean 'wide'"),
        (["evaluate", "do_nothing", "--env", "WLR-Path-v0"], "unknown environment"),
        (["evaluate", "do_nothing", "--episodes", "0"], "episodes = 0"),
    ],
)
def test_bad_input_exits_with_2(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err
