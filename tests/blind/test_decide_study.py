"""The study of ``wlr gap --until-decided``: its robots, what they drive, what counts as right, and how it goes on."""

import importlib
import json

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.base.jobs import Ended
from wlr_gym.data.excitations import excite
from wlr_gym.data.read import read_run
from wlr_gym.gap.report.entries import Result
from wlr_gym.studies.bench import decide_study
from wlr_gym.studies.bench.blind.commands import BlindScript
from wlr_gym.studies.bench.blind.truth import NAMED
from wlr_gym.studies.bench.decide_study import CASES, EIGHT, START, cases, decided_by, markdown

decision = importlib.import_module("wlr_gym.gap.decision")
EMPTY = {"equivalent": [], "calibration": {}, "localisation": {}, "gap": None, "patch": "patch.yaml"}


def result(name, probability=1.0):
    """A result that names an effect of one wheel, as probable as it says; else rolling resistance."""
    parameters = {"torque": {"value": 0.1, "ci95": None, "unit": "N m"}}
    effect = {"name": name, "where": ["wheel_lf"], "parameters": parameters, "confidence": 1.0}
    other = "worse fit" if probability == 1.0 else "equivalent"
    entry = {"round": 1, "where": ["wheel_lf"], "values": {}}
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

    def short(motion):
        last = len(motion.setpoints) - 1
        return BlindScript(1.0, lambda t: motion.setpoints[np.clip((t / motion.period).astype(int), 0, last)])

    monkeypatch.setattr(decision, "analyse", analyse)
    monkeypatch.setattr(decide_study, "_script", short)
    return given


def test_every_effect_comes_once_and_some_robots_have_none():
    hidden = [one.effect["name"] if one.effect else "" for one in cases()]
    assert len(hidden) == CASES
    assert sorted(name for name in hidden if name) == sorted(NAMED)
    assert hidden.count("") == CASES - len(NAMED)
    assert all(one.camera for one in cases() if one.effect and one.effect["name"].startswith("camera"))
    assert cases(3) == cases()[:3]
    with pytest.raises(InputError, match="--cases 0: expected 1 or more"):
        cases(0)


def test_a_robot_drives_the_motion_that_was_chosen(tmp_path):
    motion = excite("turns").cut(3.0)
    table = decide_study._robot(cases(1)[0]).drive(decide_study._script(motion), np.random.default_rng(1))
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


def test_a_study_goes_on_where_it_was(tmp_path, monkeypatch):
    done = []

    def spread(jobs, processes):
        for job in jobs:
            done.append(job.name)
            line = {"case": job.name[:9], "contender": job.task["contender"], "hidden": ["payload"], "camera": True}
            line |= {"ended": "decided", "verdict": "effect_found", "found": ["payload"], "right": True, "seconds": 50.0}
            (tmp_path / "lines" / f"{job.name}.json").write_text(json.dumps(line))
            yield Ended(job.name)

    monkeypatch.setattr(decide_study, "spread", spread)
    decide_study.run_decide_study(tmp_path, 1, ("chosen",), say=lambda text: None)
    lines = decide_study.run_decide_study(tmp_path, 1, ("chosen", "eight"), say=lambda text: None)
    assert done == ["case_9100_chosen", "case_9100_eight"]
    text = markdown(lines)
    assert (
        "| the run that distinguishes best, per second | 1 | 1 (at least 5%) | 0 (at most 95%) | 50 s | 50 s | 0 | 0 |" in text
    )
    assert "| payload | yes | right, decided, 50 s |  | right, decided, 50 s |" in text
