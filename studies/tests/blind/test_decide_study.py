"""The study of ``wlr gap --until-decided``: its robots, what they drive, what counts as right, and how it goes on."""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest

from studies.bench import decide
from studies.bench.blind.cases import NAMED
from studies.bench.decide import CASES, EIGHT, START, cases, decided_by, markdown, run_decide_study
from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import Ended
from wlr_gym.data.excitations import excite
from wlr_gym.data.runs import read_run
from wlr_gym.gap.report.result import Result

decision = importlib.import_module("wlr_gym.gap.decision")
EMPTY = {"equivalent": [], "calibration": {}, "localisation": {}, "gap": None, "patch": "patch.yaml"}


def result(name, probability=1.0):
    """A result that names an effect of one wheel, as probable as it says; else rolling resistance."""
    parameters = {"torque": {"value": 0.1, "ci95": None, "unit": "N m"}}
    effect = {"name": name, "where": ["wheel_lf"], "parameters": parameters, "confidence": 1.0}
    other = "worse fit" if probability == 1.0 else "equivalent"
    entry = {"round": 1, "where": ["wheel_lf"], "values": {}, "gain": 0.0, "screened": 0.0, "reason": ""}
    evidence = [{**entry, "name": name, "outcome": "selected", "probability": probability}]
    evidence.append({**entry, "name": "rolling_resistance", "outcome": other, "probability": 1.0 - probability})
    content = {"verdict": "effect_found", "effects": [effect], "evidence": evidence}
    return Result.model_validate(
        EMPTY | content | {"thresholds": [{"round": 1, "none": 0.0}], "runs": {"fit": ["run_01"], "heldout": []}}
    )


@pytest.fixture
def answers(monkeypatch):
    """Analyses answer what is left in the list; runs take a second."""
    given = []

    def analyse(data, folder, **options):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "result.json").write_text(given.pop(0).model_dump_json())

    monkeypatch.setattr(decision, "analyse", analyse)
    script = decide._script
    monkeypatch.setattr(decide, "_script", lambda motion: replace(script(motion), duration=1.0))
    return given


def test_every_effect_comes_once_and_some_robots_have_none():
    hidden = [one.effect["name"] if one.effect else "" for one in cases()]
    assert len(hidden) == CASES
    assert sorted(name for name in hidden if name) == sorted(NAMED)
    assert hidden.count("") == CASES - len(NAMED)
    assert all(one.camera for one in cases() if one.effect and one.effect["name"].startswith("camera"))
    assert cases(3) == cases()[:3]


def test_a_robot_drives_the_motion_that_was_chosen(tmp_path):
    motion = excite("turns").cut(3.0)
    table = decide._robot(cases(1)[0]).drive(decide._script(motion), np.random.default_rng(1))
    now = motion.setpoints[(table["t"].to_numpy() / motion.period).astype(int)]
    assert np.array_equal(table.filter(like="cmd_").to_numpy(), now, equal_nan=True)
    assert np.abs(table["vel_wheel_lf"]).max() > 1.0  # it moves


def test_right_is_the_hidden_name_alone_and_decided(tmp_path, answers):
    one = cases(1)[0]
    assert one.effect is not None
    answers[:] = [result(one.effect["name"]), result("coulomb_friction"), result(one.effect["name"], 0.5)]
    first, second, third = (decided_by("eight", one, tmp_path / str(k)) for k in range(3))
    assert (first["right"], first["ended"], first["runs"]) == (True, "decided", list(EIGHT))
    assert (second["right"], second["ended"]) == (False, "decided")
    assert (third["right"], third["ended"]) == (False, "budget")
    assert first["seconds"] == pytest.approx(sum(excite(name).duration for name in EIGHT), abs=0.01)


def test_random_drives_until_it_is_decided(tmp_path, answers):
    one = cases(1)[0]
    assert one.effect is not None
    answers[:] = [result(one.effect["name"], 0.5), result(one.effect["name"])]
    line = decided_by("random", one, tmp_path)
    assert (line["right"], len(line["runs"])) == (True, len(START) + 2)  # two runs are too few for an analysis
    assert len(read_run(tmp_path / "runs" / "run_04.parquet")["t"]) > 40


def test_driving_counts_the_motions_that_were_driven(tmp_path, answers, monkeypatch):
    again = excite("straight", 1)
    monkeypatch.setattr(decide, "motions_to_drive", lambda *_: [again])
    one = cases(1)[0]
    answers[:] = [result("payload", 0.5), result("payload")]
    line = decided_by("random", one, tmp_path)
    assert line["runs"] == ["straight", "random", "straight", "straight"]
    assert line["seconds"] == pytest.approx(
        excite("straight").duration + excite("random").duration + 2 * again.duration, abs=0.01
    )
    assert again.duration != excite("straight").duration


def test_an_interrupted_contender_begins_anew(tmp_path, answers):
    (tmp_path / "lines").mkdir()
    task = {"out": str(tmp_path), "index": 0, "contender": "random"}
    answers[:] = [result("payload", 0.5)]
    with pytest.raises(IndexError):  # no second answer
        decide._work(task, lambda message: None)
    answers[:] = [result("payload")]
    decide._work(task, lambda message: None)
    line = json.loads((tmp_path / "lines" / "case_9200_random.json").read_text())
    assert len(line["runs"]) == 3 == len(list((tmp_path / "work" / "case_9200_random" / "runs").glob("run_*.parquet")))


def test_a_name_that_is_found_twice_is_one_name(tmp_path, answers):
    one = cases(1)[0]
    name = one.hidden[0]
    twice = result(name).model_dump(mode="json")
    answers[:] = [Result.model_validate(twice | {"effects": 2 * twice["effects"]})]
    assert decided_by("eight", one, tmp_path)["found"] == [name]


@pytest.fixture
def jobs(monkeypatch, tmp_path):
    """Jobs that were done, each with an effect found rightly; those in ``failing`` fail."""
    told = {"done": [], "failing": ()}

    def spread(left, processes):
        for job in left:
            told["done"].append(job.name)
            if job.name in told["failing"]:
                yield Ended(job.name, "killed")
                continue
            one = cases(job.task["index"] + 1)[-1]
            line = decide._line(one, job.task["contender"]) | {"ended": "decided", "verdict": "effect_found"}
            line |= {"found": one.hidden, "right": True, "seconds": 50.0}
            (tmp_path / "lines" / f"{job.name}.json").write_text(json.dumps(line))
            yield Ended(job.name)

    monkeypatch.setattr(decide, "spread", spread)
    return told


def quiet(text):
    pass


def test_a_study_goes_on_where_it_was(tmp_path, jobs):
    run_decide_study(tmp_path, 1, ("chosen",), say=quiet)
    lines = run_decide_study(tmp_path, 1, ("chosen", "eight"), say=quiet)
    assert jobs["done"] == ["case_9200_chosen", "case_9200_eight"]
    text = markdown(lines)
    assert "| the run that distinguishes best, per second | 1/1 (at least 5%) | 0 (at most 95%) | 0 | 50 s | 0/0 | 0 |" in text
    (one,) = cases(1)
    assert f"| {one.hidden[0]} | {'yes' if one.camera else 'no'} | right, decided, 50 s | right, decided, 50 s |" in text
    assert len(run_decide_study(tmp_path, 1, ("eight",), say=quiet)) == 1  # only what is asked


def test_a_contender_that_fails_is_counted_and_tried_again(tmp_path, jobs):
    jobs["failing"] = ("case_9200_chosen",)
    said = []
    lines = run_decide_study(tmp_path, 1, ("chosen",), say=said.append)
    assert "failed, killed" in said[0]
    assert "| 0/1 (at least 0%) | 0 (at most 95%) | 1 | - |" in markdown(lines)
    jobs["failing"] = ()
    assert run_decide_study(tmp_path, 1, ("chosen",), say=quiet)[0]["right"]


def test_a_study_of_other_robots_or_nothing_is_refused(tmp_path, jobs, monkeypatch):
    run_decide_study(tmp_path, 1, ("chosen",), say=quiet)
    monkeypatch.setattr(decide, "SEVERITY", 1.0)
    with pytest.raises(InputError, match=r"study.json: severity: 2.0, requested 1.0"):
        run_decide_study(tmp_path, 1, ("chosen",), say=quiet)
