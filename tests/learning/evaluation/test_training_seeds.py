"""Several trainings of one recipe: intervals that contain training-seed variance, cards that say so, and what is refused."""

import json

import numpy as np
import pandas
import pytest
from evaluation_examples import EPISODES, TICKS, measured, rollout
from scipy import stats

import wlr_gym
from wlr_gym.base.errors import InputError
from wlr_gym.base.provenance import CONFIG_FILE, write_yaml
from wlr_gym.cli import evaluate, main
from wlr_gym.learning.evaluation.card import MAIN, OTHER_PLANT, Card, content, scores_of, seed_rows, write_card, write_episodes
from wlr_gym.learning.evaluation.metrics import Bootstrap, interquartile_mean, summarise
from wlr_gym.learning.evaluation.subjects import Subject, read_subjects
from wlr_gym.policy import write_contract

N = 48
RESAMPLING = Bootstrap(1, N)


def pairs(values):
    """Scores (T, N) as numerators and denominators of one block."""
    values = np.asarray(values, float)[:, None]
    return np.stack([values, np.ones_like(values)], axis=-1)


def scores(draws, seeds, of_seed, of_episode, of_both):
    """Scores (T, N) with true mean 1 and known components of variance."""
    noise = of_both * draws.normal(size=(seeds, N))
    return 1.0 + of_seed * draws.normal(size=(seeds, 1)) + of_episode * draws.normal(size=(1, N)) + noise


def covers(estimate, truth):
    return estimate.low <= truth <= estimate.high


@pytest.mark.parametrize(("seeds", "sigmas"), [(5, (0.3, 0.1, 0.1)), (5, (0.1, 0.3, 0.3)), (3, (0.3, 0.1, 0.1))])
def test_intervals_cover_the_mean_over_all_trainings_as_often_as_they_say(seeds, sigmas):
    """One of episodes alone, of the same data, does not: it is about these trainings, not about the recipe."""
    draws, trials = np.random.default_rng(3), 250
    covered = np.zeros(3)
    for _ in range(trials):
        values = scores(draws, seeds, *sigmas)
        both = pairs(values)
        episodes_only = RESAMPLING.mean(pairs(values.mean(axis=0, keepdims=True)))
        estimates = (RESAMPLING.mean(both), RESAMPLING.interquartile_mean(both), episodes_only)
        covered += [covers(estimate, 1.0) for estimate in estimates]
    mean, quartiles, episodes_only = covered / trials
    assert 0.91 <= mean <= 1.0
    assert 0.91 <= quartiles <= 1.0
    assert episodes_only < (0.3 if sigmas[0] > sigmas[1] else 0.88)


def test_with_seed_variance_alone_it_is_student_s_interval():
    """Closed form: T scores without any noise of episodes; mean over many draws of the ratio of widths."""
    ratios = []
    for trial in range(60):
        values = np.random.default_rng(trial).normal(1.0, 0.3, 8)
        estimate = RESAMPLING.mean(pairs(np.tile(values[:, None], N)))
        low, high = stats.t.interval(0.95, 7, loc=values.mean(), scale=stats.sem(values))
        assert estimate.mean == pytest.approx(values.mean())
        ratios.append((estimate.high - estimate.low) / (high - low))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.04)
    assert 0.9 < min(ratios) < max(ratios) < 1.1


def test_the_variance_of_episodes_does_not_shrink_with_training_seeds():
    """An episode that is hard for all trainings is drawn once: more trainings tell nothing about other episodes."""
    hard = np.random.default_rng(0).normal(1.0, 0.5, N)
    one, ten = (RESAMPLING.mean(pairs(np.tile(hard, (seeds, 1)))) for seeds in (1, 10))
    assert (ten.low, ten.high) == pytest.approx((one.low, one.high))


@pytest.mark.parametrize("seeds", range(1, 12))
def test_the_interquartile_mean_is_that_of_scipy(seeds):
    values = np.random.default_rng(seeds).normal(size=(3, seeds)) ** 3
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25, axis=1))
    over_all = RESAMPLING.interquartile_mean(pairs(np.tile(values[0][:, None], N)))
    assert over_all.mean == pytest.approx(stats.trim_mean(values[0], 0.25))


def test_differences_are_paired_by_episode_and_keep_the_variance_of_both_recipes():
    draws, covered, widths, trials = np.random.default_rng(5), np.zeros(2), np.zeros(2), 150
    for _ in range(trials):
        floors = draws.normal(size=(1, N))
        ours, theirs = 1.0 + floors + 0.1 * draws.normal(size=(5, 1)), 1.5 + floors + 0.1 * draws.normal(size=(5, 1))
        several, single = (RESAMPLING.difference(pairs(ours), pairs(other)) for other in (theirs, 1.5 + floors))
        covered += [covers(several, -0.5), covers(single, -0.5)]
        widths += [estimate.high - estimate.low for estimate in (single, RESAMPLING.mean(pairs(ours)))]
    assert (covered / trials >= 0.91).all()
    assert widths[0] < 0.5 * widths[1]


def test_one_subject_has_the_same_resamples_everywhere():
    draws = np.random.default_rng(1)
    ours, idle = pairs(scores(draws, 4, 0.3, 0.1, 0.1)), pairs(np.zeros((1, N)))
    same = RESAMPLING.share(ours, ours, idle, idle, subjects=(0, 0, 2, 2))
    assert (same.low, same.high) == pytest.approx((100.0, 100.0))
    other = RESAMPLING.share(ours, ours, idle, idle, subjects=(0, 1, 2, 2))
    assert other.high - other.low > 10.0


def trained(*errors, reward=1.0, fell=(), blocks=1):
    """What is kept of trainings with constant velocity errors, m/s."""
    ones = np.ones((TICKS, EPISODES))
    every = [
        rollout(measured=measured(error), reward=reward / TICKS * ones, fell=np.full(EPISODES, index in fell))
        for index, error in enumerate(errors)
        for _ in range(blocks)
    ]
    return summarise(every, len(errors))


def card(**more):
    ours = {"ours": trained(0.01, 0.02, 0.04, 0.05, 0.06, blocks=2), "pid": trained(0.03, blocks=2)}
    return Card({MAIN: ours, **more}, training_seeds={"ours": ("0", "1", "2", "3", "10")})


def test_a_card_shows_every_training_seed(tmp_path):
    seeds = card().seed_scores["ours"]
    assert list(seeds.scores) == ["0", "1", "2", "3", "10"]
    assert [own["velocity_error"].mean for own in seeds.scores.values()] == pytest.approx([0.01, 0.02, 0.04, 0.05, 0.06])
    assert seeds.median_seed == "2"
    assert seeds.median("velocity_error") == pytest.approx(0.04)
    assert seeds.spread("velocity_error") == pytest.approx(125.0)
    assert np.isnan(seeds.spread("falls"))
    header, *body = seed_rows(card(), "ours")
    table = {row[0]: row[1] for row in body}
    assert header == ["training seed", "tracking_error", "success (%)", "excess_slip (m/s)", "reward"]
    assert table["10"] == "2.121 [2.121, 2.121]"  # 0.06 m/s: three times one of two limits
    assert table["interquartile mean"].startswith("1.296 [")
    assert table["mean"].startswith("1.273 [")
    assert (table["median"], table["(max - min) / median"]) == ("1.414", "125 %")
    write_card(tmp_path, card())
    text = (tmp_path / "card.md").read_text()
    assert "5 trainings of one recipe; median seed: 2." in text
    assert "without training-seed variance of theirs: pid." in text
    written = json.loads((tmp_path / "card.json").read_text())["training_seeds"]["ours"]
    assert written["median_seed"] == "2"
    assert written["scores"]["3"]["velocity_error"]["mean"] == pytest.approx(0.05)
    assert written["spread_in_percent_of_median"]["velocity_error"] == pytest.approx(125.0)
    assert written["interquartile_mean"]["velocity_error"]["mean"] == pytest.approx((0.02 + 0.04 + 0.05) / 3)


def test_the_median_seed_is_the_one_that_is_recorded_and_filmed():
    several = Subject("ours", ("run_0", "run_1", "run_2", "run_3", "run_10"), ("0", "1", "2", "3", "10"))
    assert evaluate._shown(card(), several).sources == ("run_2",)
    assert evaluate._shown(card(), Subject("pid", ("pid",))).sources == ("pid",)


def test_the_interval_of_the_card_is_over_training_seeds():
    estimate, better = card().scores[MAIN]["ours"]["velocity_error"], card().comparison[MAIN]["pid"]["velocity_error"]
    values = [0.01, 0.02, 0.04, 0.05, 0.06]
    low, high = stats.t.interval(0.95, 4, loc=np.mean(values), scale=stats.sem(values))
    assert (estimate.low, estimate.high) == pytest.approx((low, high), rel=0.15)
    assert not better.excludes_zero


def test_few_seeds_have_no_interquartile_mean_and_no_impossible_interval():
    played = trained(0.01, 0.05, fell=(1,))
    few = Card({MAIN: {"ours": played}}, training_seeds={"ours": ("0", "1")})
    assert "interquartile mean" not in [row[0] for row in seed_rows(few, "ours")]
    assert few.seed_scores["ours"].interquartile_mean == {}
    assert few.seed_scores["ours"].median_seed == "0"  # of two in the middle the better one
    estimates = scores_of(played)
    assert (estimates["falls"].mean, estimates["falls"].low, estimates["falls"].high) == (50.0, 0.0, 100.0)
    assert estimates["velocity_error"].low == 0.0


def test_a_recipe_has_its_share_and_what_it_keeps_on_fewer_episodes():
    here = {"ours": trained(0.01, 0.02, reward=9.0, blocks=2), "do_nothing": trained(0.05, blocks=2)}
    there = {"ours": trained(0.01, 0.02, reward=5.0), "do_nothing": trained(0.05)}
    both = Card({MAIN: here, OTHER_PLANT: there}, training_seeds={"ours": ("0", "1")})
    assert both.kept["ours"].mean == pytest.approx(50.0)
    assert Card({MAIN: {**here, "pid": trained(0.02, reward=3.0, blocks=2)}}).share_of["pid"].mean == pytest.approx(400.0)


def test_episodes_are_listed_per_training_seed(tmp_path):
    write_episodes(tmp_path / "episodes.parquet", card(), 7)
    rows = pandas.read_parquet(tmp_path / "episodes.parquet").to_dict("records")
    assert len(rows) == (5 + 1) * 2 * EPISODES
    last = [row for row in rows if row["training_seed"] == "10"]
    assert [row["velocity_error"] for row in last] == pytest.approx([0.06] * 2 * EPISODES)
    assert [row["seed"] for row in last] == [*range(7, 7 + EPISODES), *range(10_007, 10_007 + EPISODES)]
    assert {row["training_seed"] for row in rows if row["policy"] == "pid"} == {""}


def run(folder, seed, place="policy", steps=100, init=None, **settings):
    """A run folder as far as a recipe is read from it."""
    environment = {"control_period": settings.pop("control_period", 0.02)}
    config = {"seed": seed, "learning_rate": 0.1, **settings}
    (folder / place).mkdir(parents=True)
    training = {"environment": "WLR-Velocity-v0", "steps": steps, "seed": seed}
    write_contract(folder / place, "ppo", config, environment, training)
    write_yaml(folder / CONFIG_FILE, {"settings": config, **({"init": init} if init else {})})
    return str(folder)


@pytest.fixture
def trials(tmp_path):
    """Runs of two recipes, ``lr=1`` with three seeds and ``lr=2`` with one."""
    (tmp_path / "note.txt").write_text("no run")
    for seed in (10, 2, 0):
        run(tmp_path / f"lr=1-seed{seed}", seed)
    run(tmp_path / "lr=2-seed0", 0, learning_rate=0.2)
    return tmp_path


def test_a_pattern_a_list_and_a_name_give_the_same_recipe(trials):
    sources = tuple(str(trials / f"lr=1-seed{seed}") for seed in (0, 2, 10))
    seeds = ("0", "2", "10")
    pattern = f"{trials}/lr=1-*"
    (found,) = read_subjects([pattern])
    assert found == Subject(pattern, sources, seeds)
    assert read_subjects([list(sources)]) == (Subject(str(trials / "lr=1"), sources, seeds),)
    assert read_subjects([f"mine={pattern}"]) == (Subject("mine", sources, seeds),)
    assert read_subjects([f"mine={sources[1]},{sources[0]}"]) == (Subject("mine", sources[:2], seeds[:2]),)
    assert read_subjects([sources[0], pattern])[0] == Subject(sources[0], sources[:1])


def test_a_folder_of_runs_is_a_recipe(trials):
    with pytest.raises(
        InputError, match=r"lr=1-seed0' and '.*lr=2-seed0' differ in .* settings\.learning_rate is 0\.1 and 0\.2"
    ):
        read_subjects([trials])
    (trials / "lr=2-seed0").rename(trials / ".lr=2")
    (trials / ".lr=2" / "policy" / "contract.json").rename(trials / "contract")
    (trials / ".lr=2" / CONFIG_FILE).unlink()
    assert read_subjects([trials])[0].seeds == ("0", "2", "10")


def test_best_policies_are_of_different_steps(tmp_path):
    for seed in range(2):
        run(tmp_path / f"run{seed}", seed, place="best", steps=100 * (1 + seed))
    assert read_subjects([f"{tmp_path}/run*/best"])[0].seeds == ("0", "1")
    run(tmp_path / "run2", 2)  # has no best policy yet
    with pytest.raises(InputError, match=r"run2/best: a run without a policy"):
        read_subjects([f"{tmp_path}/run*/best"])


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (
            {"steps": 50},
            "differ in more than the training seed: training.steps is 100 and 50; one policy is compared with others",
        ),
        ({"control_period": 0.01}, "environment.control_period is 0.02 and 0.01"),
        ({"init": "velocity_blind"}, "init is None and 'velocity_blind'"),
        ({"environment": {"randomization": "ice"}}, "settings.environment is None and {'randomization': 'ice'}"),
        ({"seed": 0}, "have the same training seed, 0"),
    ],
)
def test_what_is_no_recipe_is_refused(tmp_path, other, message):
    first = run(tmp_path / "a", 0)
    second = run(tmp_path / "b", **({"seed": 1} | other))
    with pytest.raises(InputError, match=r"^'ours': ") as caught:
        read_subjects([[f"ours={first}", second]])
    assert message in str(caught.value)


def test_bad_groups_are_refused_and_leave_nothing(trials, tmp_path, capsys):
    cases = {
        f"{trials}/lr=3*": "is no policy",
        f"ours=pid,{trials}/lr=1-seed0": "'pid' is an agent",
        f"ours={trials}/lr=1-seed0,{trials}/lr=1-seed0": "lr=1-seed0' is given twice",
        f"ours={trials}/lr=1-seed0,{trials}/lr=1-seed4": "lr=1-seed4' is no policy",
    }
    for text, message in cases.items():
        assert main(["evaluate", text, "--no-progress", "--out", str(tmp_path / "card")]) == 2
        assert message in capsys.readouterr().err
    (trials / "lr=1-seed5").mkdir()
    write_yaml(trials / "lr=1-seed5" / CONFIG_FILE, {})
    with pytest.raises(InputError, match="lr=1-seed5: a run without a policy"):
        read_subjects([f"{trials}/lr=1*"])
    with pytest.raises(InputError, match="no policy given"):
        read_subjects([[]])
    with pytest.raises(InputError, match="'velocity_blind' is given twice: expected each training of a recipe once"):
        read_subjects([["velocity_blind", "velocity_blind"]])
    assert not (tmp_path / "card").exists()


@pytest.mark.slow
def test_trainings_are_scored_as_one_column_by_the_command_and_in_python_to_the_bit(tmp_path):
    pytest.importorskip("torch")
    tiny = {"total_steps": 64, "num_envs": 8, "steps_per_env": 8, "batch_size": 32, "evaluate_every": 0}
    runs = tmp_path / "lr=1"
    for seed in range(2):
        wlr_gym.train("WLR-Velocity-v0", runs / f"seed{seed}", settings=tiny, seed=seed)
    command = ["evaluate", f"mine={runs}", "--baselines", "do_nothing", "--episodes", "2", "--no-progress"]
    assert main([*command, "--out", str(tmp_path / "card")]) == 0
    written = json.loads((tmp_path / "card" / "card.json").read_text())
    assert written["conditions"]["training seeds"] == "mine: 2 (0, 1)"
    listed = [f"mine={runs / 'seed1'}", runs / "seed0"]
    same = wlr_gym.evaluate(listed, baselines=["do_nothing"], episodes=2)
    assert json.loads(json.dumps(content(same))) == written
    alone = wlr_gym.evaluate(runs / "seed1", baselines=["do_nothing"], episodes=2)
    assert alone.scores[MAIN][alone.names[0]] == same.seed_scores["mine"].scores["1"]
