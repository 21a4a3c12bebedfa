"""What a sweep knows of its trials, and does as they end: the table, the ranking, what matters. Nothing is trained here."""

import os
import shlex
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pandas
import pytest
from waiting import wait_until

import wlr_gym
from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import Ended
from wlr_gym.base.provenance import write_yaml
from wlr_gym.learning.evaluation.subjects import expand
from wlr_gym.learning.sweep import book as book_module
from wlr_gym.learning.sweep import running
from wlr_gym.learning.sweep.plan import SweepPlan, Trial, trials_of
from wlr_gym.learning.sweep.results import TrialResult, summarise, write_page, write_table

PLAN = SweepPlan(environment="WLR-Velocity-v0", space={"gamma": [0.9, 0.97]}, seeds=3)
TRIALS = trials_of([{"gamma": 0.9}, {"gamma": 0.97}], [0, 1, 2])


def result(settings, folder, score=1.0, seed=0, status="done"):
    scores = [{"steps": 10.0, "tracking_error": score}]
    return TrialResult(Trial(settings, seed), folder, status, scores=scores, steps=10, seconds=1.0)


def write_curve(folder, steps):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "learning_curve.csv").write_text(f"steps,seconds\n{steps},1.0\n")


@pytest.fixture
def book(tmp_path):
    for name in ("trials", ".locks"):
        (tmp_path / name).mkdir()
    return book_module.Book(PLAN, tmp_path, lambda line: None)


@pytest.mark.parametrize(
    ("values", "column"),
    [
        ([None, 0.02], ["missing", 0.02]),
        ([1, 0.5], [1.0, 0.5]),
        (["ice", None], ["ice", "missing"]),
        ([[64, 64], [32]], ["[64, 64]", "[32]"]),
        ([0.02, "auto"], ["0.02", '"auto"']),
        ([True, 2], ["true", "2"]),
        ([True, False], [True, False]),
    ],
)
def test_every_setting_finds_room_in_the_table(values, column, tmp_path):
    write_table([result({"some.setting": value}, tmp_path) for value in values], tmp_path)
    written = pandas.read_parquet(tmp_path / "trials.parquet")["some.setting"]
    assert ["missing" if pandas.isna(value) else value for value in written] == column


def test_a_trial_that_has_ended_is_read_once(book, monkeypatch):
    """Otherwise the end of each of 1000 trials would read the folders of 1000."""
    reads = []

    def read(result):
        reads.append(result.trial.name)
        result.status = "done"

    monkeypatch.setattr(TrialResult, "read", read)
    book.train(TRIALS, lambda jobs: (Ended(job.name) for job in jobs))
    assert sorted(set(reads)) == sorted(trial.name for trial in TRIALS)
    assert len(reads) <= 2 * len(TRIALS)


def test_all_seeds_of_the_best_are_scored_as_one_column(tmp_path):
    """The command that is printed names its trials, no others."""
    folders = [tmp_path / "a sweep" / "trials" / trial.name for trial in trials_of([{"gamma": 0.9}, {"gamma": 0.95}], [0, 12])]
    for folder in folders:
        (folder / "policy").mkdir(parents=True)
        (folder / "policy" / "contract.json").write_text("{}")
    results = [result({"gamma": 0.9}, folder, seed=seed) for folder, seed in zip(folders, (0, 12), strict=False)]
    (text,) = shlex.split(summarise(results, "tracking_error")[0].policies)
    assert expand(text) == (str(folders[0]), str(folders[1]))
    (text,) = shlex.split(summarise(results[1:], "tracking_error")[0].policies)
    assert text == str(folders[1])


def test_what_failed_is_read_again_when_it_was_tried_again(book):
    write_curve(book.folder / "trials" / TRIALS[0].name, 64)
    book.end(TRIALS[0], "no space")
    write_curve(book.folder / "trials" / TRIALS[0].name, 128)
    book.end(TRIALS[0], "no space again")
    (known,) = book.results()
    assert (known.steps, known.error) == (128, "no space again")


def test_what_was_stopped_early_is_read_after_its_last_checkpoint(book, monkeypatch):
    """Its process ends after the search has moved on; until then it holds the trial."""
    folder = book.folder / "trials" / TRIALS[0].name
    write_curve(folder, 64)
    book.end(TRIALS[0], "", early=True)

    @contextmanager
    def lock_that_is_free_after_the_checkpoint(path, patience):
        assert path.name == TRIALS[0].name
        write_curve(folder, 128)
        yield

    monkeypatch.setattr(book_module, "locked", lock_that_is_free_after_the_checkpoint)
    book.write()
    assert [(one.status, one.steps) for one in book.results()] == [("stopped early", 128)]
    assert list(pandas.read_parquet(book.folder / "trials.parquet")["steps"]) == [128]


def test_jobs_are_ended_before_an_interruption_goes_on(book):
    """Ctrl-C may come while a line is printed."""
    ended = []

    def run(jobs):
        try:
            for job in jobs:
                yield Ended(job.name)
        finally:
            ended.append("in good order")

    def interrupted(line):
        raise KeyboardInterrupt

    book.say = interrupted
    with pytest.raises(KeyboardInterrupt) as caught:
        book.train(TRIALS, run)
    assert (ended, caught.type) == (["in good order"], KeyboardInterrupt)


def test_a_table_that_cannot_be_written_says_what_to_do(book, monkeypatch):
    def full(results, folder):
        raise InputError(f"{folder}/trials.parquet: cannot be written: No space left on device")

    monkeypatch.setattr(book_module, "write_table", full)
    with pytest.raises(InputError, match=r"No space left.*wlr sweep --resume"):
        book.fill(lambda jobs: (Ended(job.name, "no space") for job in jobs))


def test_two_cannot_run_one_sweep(tmp_path, monkeypatch):
    monkeypatch.setattr(running, "_HANDOVER", 0.1)
    write_yaml(tmp_path / "sweep.yaml", PLAN.model_dump(mode="json"))
    held = tmp_path / "held"
    code = f"import pathlib\nfrom wlr_gym.base.files import alone_in\nwith alone_in(pathlib.Path({str(tmp_path)!r})):\n"
    code += f"    pathlib.Path({str(held)!r}).touch(); input()"
    other = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, env=os.environ | {"PYTHONPATH": ":".join(sys.path)}
    )
    wait_until(held.exists, other)
    with pytest.raises(InputError, match=f"held for 0.1 s by process {other.pid}"):
        wlr_gym.resume_sweep(tmp_path)
    other.communicate(b"\n")


@pytest.mark.parametrize("steps", [(), (0.0,), (0.0, 10.0)])
def test_a_page_says_what_there_is(steps, tmp_path):
    """Before the first score, with one before the first update only, and with curves."""
    trials = [TrialResult(trial, tmp_path / trial.name) for trial in TRIALS]
    for one in trials:
        one.scores = [{"steps": step, "tracking_error": 1.0 + one.trial.seed} for step in steps]
    write_page(PLAN, trials, tmp_path)
    page = (tmp_path / "sweep.html").read_text()
    assert ("No trial has scores yet" in page) == (not steps)
    assert ("gamma 0.9. Tracking error 2 (1 to 3, 3 seeds)" in page) == bool(steps)
    assert ("data:image/png" in page) == bool(steps)


def test_settings_are_ranked_by_the_mean_over_their_seeds(tmp_path):
    random = np.random.default_rng(0)
    results = []
    for rate in np.geomspace(1e-4, 1e-2, 12):
        for seed in range(3):
            score = abs(np.log10(rate) + 3) + 0.1 * random.standard_normal()
            results.append(result({"learning_rate": float(rate)}, tmp_path, score, seed))
    ranking = summarise(results, "tracking_error")
    assert 5e-4 < ranking[0].settings["learning_rate"] < 2e-3
    assert len(ranking[0].values) == 3
    assert [one.mean for one in ranking] == sorted(one.mean for one in ranking)
