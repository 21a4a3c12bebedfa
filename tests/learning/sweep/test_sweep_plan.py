"""Plans: what they say, what they refuse, before any trial begins."""

import datetime
import json
from pathlib import Path

import pytest

import wlr_gym
from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import parse_config
from wlr_gym.cli import main, sweep
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.learning.sweep.book import Book
from wlr_gym.learning.sweep.plan import (
    SweepPlan,
    Trial,
    read_plan,
    resolve,
    trials_of,
)

ENVIRONMENT = "WLR-Velocity-v0"
ROOT = Path(__file__).resolve().parents[3]


def plan(**fields):
    return parse_config(SweepPlan, {"environment": ENVIRONMENT, **fields}, "test")


def test_a_grid_is_all_combinations_with_all_seeds():
    whole = resolve(plan(space={"gamma": [0.9, 0.97], "environment.randomization": ["ice", None]}, seeds=[3, 4]))
    trials = trials_of(whole.known_settings() or [], whole.seed_list)
    assert len(trials) == 8
    assert trials[3].name == "gamma=0.9,environment.randomization=null,seed=4"
    settings = whole.settings_of(trials[0])
    assert (settings["gamma"], settings["seed"], settings["environment"]["randomization"]) == (0.9, 3, "ice")
    assert settings["environment"]["precision"] == "float32"
    assert whole.settings["environment"]["randomization"] != "ice"


def test_settings_for_one_task_count_there():
    own = {"tasks": {"velocity": {"gamma": 0.5}, "path": {"gamma": 0.6}}}
    assert resolve(plan(settings=own, seeds=1)).settings["gamma"] == 0.5


def test_a_value_is_no_group(capsys, tmp_path):
    words = ["sweep", ENVIRONMENT, "--set", "environment=3", "environment.randomization=ice", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "setting 'environment.randomization=\"ice\"': 'environment' is a value, not a group" in capsys.readouterr().err


def test_what_a_folder_keeps_is_the_whole_plan():
    whole = resolve(plan(config="ppo_blind", settings={"total_steps": 1000}, space={"gamma": [0.9, 0.97]}))
    again = parse_config(SweepPlan, whole.model_dump(mode="json"), "again")
    assert again.config is None
    assert again.settings_of(Trial({"gamma": 0.9}, 1)) == whole.settings_of(Trial({"gamma": 0.9}, 1))


def test_variants_are_settings_that_belong_together():
    variants = {"recipe": {}, "no history": {"gamma": 0.9, "environment.randomization": None}}
    whole = resolve(plan(variants=variants, space={"epochs": [2, 3]}, seeds=1))
    again = parse_config(SweepPlan, whole.model_dump(mode="json"), "again")
    trials = trials_of(again.known_settings() or [], again.seed_list)
    assert [trial.name for trial in trials][-1] == "epochs=3,variant=no_history,seed=0"
    first, last = again.settings_of(trials[0]), again.settings_of(trials[-1])
    assert (last["gamma"], last["epochs"], last["environment"]["randomization"]) == (0.9, 3, None)
    assert first == whole.settings | {"seed": 0, "epochs": 2}


def test_the_ablations_can_begin():
    """Every setting that they name exists, in the agent and in the task."""
    whole = resolve(read_plan(ROOT / "examples" / "ablations.yaml"))
    found = [whole.settings_of(trial) for trial in trials_of(whole.known_settings() or [], [0])]
    assert len({json.dumps(settings, sort_keys=True) for settings in found}) == len(found) == len(whole.variants)
    for settings in found:
        make_core(ENVIRONMENT, 1, settings["environment"]).close()


def test_random_settings_are_the_same_again_and_within_their_ranges():
    fields = {
        "space": {
            "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
            "epochs": {"low": 2, "high": 4, "whole": True},
            "activation": ["tanh", "elu"],
        },
        "search": {"method": "random", "trials": 50},
    }
    drawn = plan(**fields).known_settings()
    assert drawn == plan(**fields).known_settings()
    assert drawn is not None
    assert all(1e-4 <= one["learning_rate"] <= 1e-2 for one in drawn)
    assert 10 < sum(one["learning_rate"] < 1e-3 for one in drawn) < 40
    assert {one["epochs"] for one in drawn} == {2, 3, 4}
    assert {one["activation"] for one in drawn} == {"tanh", "elu"}


def test_a_setting_drawn_twice_is_trained_once():
    drawn = plan(space={"gamma": [0.9, 0.97]}, search={"trials": 10}).known_settings()
    assert len(drawn or []) == 2


def test_long_names_stay_different():
    first, second = ({"environment.task": {"rewards": {"slip": {"weight": -w}, "x" * 200: {}}}} for w in (1.0, 2.0))
    assert len(Trial(first, 0).label) < 200
    assert Trial(first, 0).label != Trial(second, 0).label


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"space": {"learning_rte": [1e-3]}}, "did you mean 'learning_rate'"),
        ({"space": {"environment.randomisation": ["ice"]}}, "did you mean 'randomization'"),
        ({"space": {"gamma": [0.9, 1.5]}}, "gamma=1.5,seed=0.*gamma"),
        ({"variants": {"one": {"learning_rte": 1e-3}}}, "variant=one,seed=0.*did you mean 'learning_rate'"),
        ({"variants": {"one": {}}, "space": {"variant": ["two"]}}, "give 'variants'"),
        ({"variants": {"one": {"gamma": 0.9}}, "space": {"gamma": [0.97]}}, "one sets 'gamma', which 'seeds' or 'space'"),
        ({"variants": {"one": {"seed": 1}}}, "one sets 'seed'"),
        ({"variants": {"one": {"gamma": datetime.date(2026, 1, 1)}}}, "variants: one: gamma: .* is no setting"),
        ({"variants": {"a b": {}, "a_b": {}}, "search": {"trials": 1}}, "two trials are called 'variant=a_b"),
        ({"variants": {"one": {}, "two": {"gama": 0.9}}, "search": {"trials": 1}}, "did you mean 'gamma'"),
        ({"space": {"gamma": [0.9, 0.9]}}, "two trials are called 'gamma=0.9,seed=0': the same value is given twice"),
        ({"seeds": [1, 1]}, "two trials are called 'seed=1'"),
        (
            {"seeds": [1, 1], "space": {"gamma": [0.9]}, "search": {"method": "optuna"}},
            "two trials are called 'gamma=0.9,seed=1'",
        ),
        ({"space": {"gamma": [0.9, 1.5]}, "search": {"trials": 9}}, "gamma=1.5,seed=0.*gamma"),
        ({"space": {"environment.task": ["a/b", "a_b"]}}, "two trials are called"),
        ({"space": {"batch_size": [512, 500]}}, "batch_size 500 does not divide"),
        ({"agent": "do_nothing"}, "agents that have"),
        ({"agent": "pid", "space": {"yaw_rate_q": [1.0]}}, "did you mean 'yaw_rate_p'"),
        ({"agent": "slip_compensating", "settings": {"gamma": 0.9}}, "agent 'slip_compensating': unknown key 'gamma'"),
        ({"config": "ppo_blnd"}, "did you mean 'ppo_blind'"),
        ({"environment": "WLR-Velocty-v0"}, "WLR-Velocity-v0"),
    ],
)
def test_what_no_trial_can_do_is_refused_at_once(fields, message):
    with pytest.raises(InputError, match=message):
        resolve(plan(**fields))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"space": {"gamma": {"low": 0.9, "high": 0.99}}}, "is a range"),
        ({"space": {"gamma": {"low": 0.99, "high": 0.9}}, "search": {}}, "not below"),
        ({"search": {"trials": 3}}, "no 'space'"),
        ({"search": {"trails": 3}, "space": {"gamma": [0.9]}}, "did you mean 'trials'"),
        ({"space": {"seed": [1, 2]}}, "give 'seeds'"),
        ({"space": {"tasks.Path.network.share": [1, 2]}}, "'tasks.Path.network.share' comes too late"),
        ({"variants": {"a": {"tasks": {}}}}, "variants: a: 'tasks' comes too late"),
        ({"seeds": 0}, "seeds"),
        ({"sedes": 3}, "did you mean 'seeds'"),
    ],
)
def test_bad_files_are_refused(fields, message):
    with pytest.raises(InputError, match=message):
        plan(**fields)


def test_early_stopping_needs_scores_to_stop_by():
    fields = {"space": {"gamma": [0.9, 0.97]}, "search": {"method": "grid", "early_stopping": True}}
    whole = resolve(plan(**fields, settings={"total_steps": 180}))
    assert whole.settings["evaluate_every"] == 20
    with pytest.raises(InputError, match="set evaluate_every"):
        resolve(plan(**fields, settings={"total_steps": 180, "evaluate_every": 100}))


def test_options_are_laid_over_a_file(tmp_path):
    file = tmp_path / "space.yaml"
    file.write_text("space: {gamma: [0.9, 0.97]}\nsearch: {trials: 4}\n")
    options = sweep.SweepOptions(ENVIRONMENT, search=file, seeds=2, set=("total_steps=1000", "learning_rate=1e-3,2e-3"))
    made = sweep._plan(options)
    assert made.space == {"gamma": [0.9, 0.97], "learning_rate": [1e-3, 2e-3]}
    assert (made.seeds, made.settings) == (2, {"total_steps": 1000})
    file.write_text(f"environment: {ENVIRONMENT}\nseeds: 3\n")
    assert sweep._plan(sweep.SweepOptions(str(file), set=("hidden_layers=[64,64],[32,32]",))) == read_plan(
        file, {"space": {"hidden_layers": [[64, 64], [32, 32]]}}
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "environment id"),
        ([ENVIRONMENT, "--set", "learning_rte=1e-3,2e-3"], "did you mean 'learning_rate'"),
        ([ENVIRONMENT, "--set", "gamma"], "--set gamma"),
        ([ENVIRONMENT, "--workers", "0"], "--workers 0: expected 1 or more"),
        ([ENVIRONMENT, "--search", "none.yaml"], "none.yaml"),
        (["--resume", "nothing_there"], "sweep.yaml is missing"),
        (["--resume", "somewhere", "--seeds", "3"], "as it was planned"),
        ([ENVIRONMENT, "--ray", "a", "b"], "one address"),
    ],
)
def test_bad_options_exit_with_2_and_leave_nothing(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("trials/*"))


def test_one_is_one(tmp_path):
    book = Book(parse_config(SweepPlan, {"environment": ENVIRONMENT, "seeds": 1}, "sweep"), tmp_path, print)
    assert book.size == "1 trial: 1 setting x 1 seed"


def test_the_environment_is_the_first_argument(tmp_path):
    with pytest.raises(InputError, match=r"environment = 'WLR-Path-v0': it is the first argument, 'WLR-Velocity-v0'"):
        wlr_gym.sweep("WLR-Velocity-v0", tmp_path / "out", environment="WLR-Path-v0")


def test_a_used_folder_is_refused(tmp_path):
    (tmp_path / "something").touch()
    with pytest.raises(InputError, match=r"not empty; give another folder$"):
        wlr_gym.sweep(ENVIRONMENT, tmp_path)
    (tmp_path / "sweep.yaml").touch()
    with pytest.raises(InputError, match=r"not empty.*--resume"):
        wlr_gym.sweep(ENVIRONMENT, tmp_path)
