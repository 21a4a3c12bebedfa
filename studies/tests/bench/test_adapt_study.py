"""The study of adaptation: its cases are fixed, it resumes contender by contender, and its table says what its lines say."""

import numpy as np
import pytest

from studies.bench.__main__ import main
from wlr_gym.base.errors import InputError
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.learning.adaptation.uncertainty import uncertainty_of
from wlr_gym.physics.effects import apply_patch, load_patch
from wlr_gym.robot import load_robot

pytest.importorskip("torch")
pytest.importorskip("dynamixel_sdk")

from studies.bench import adapt
from studies.bench.adapt import cases, chosen_cases


def line(case, contender, errors, **more):
    return {"case": case, "contender": contender, "errors": list(errors), "shared_law": True, **more}


def test_the_cases_are_those_of_the_plan():
    every = cases()
    kinds = [one.kind for one in every if one.copy == 0]
    assert [kinds.count(kind) for kind in ("named", "second", "pair", "outside")] == [12, 6, 2, 3]
    assert len({one.name for one in every}) == len(every) == 2 * 23
    assert all(load_patch([dict(effect) for effect in one.effects]).effects for one in every)
    copies = [one.parameters(load_robot()).values for one in (every[0], every[23])]
    assert every[0].effects == every[23].effects
    assert (copies[0] != copies[1]).any()


def test_cases_are_chosen_by_name_or_number():
    assert [one.name for one in chosen_cases(("2",))] == [one.name for one in cases()[:2]]
    with pytest.raises(InputError, match="did you mean 'gyro_bias_copy"):
        chosen_cases(("gyro_bias_cop",))


def test_it_resumes_contender_by_contender_where_the_truth_helps_most_first(tmp_path, monkeypatch):
    errors = {("a", "none"): 1.0, ("a", "truth"): 0.95, ("b", "none"): 1.0, ("b", "truth"): 0.5}
    order = []

    def worked(study, case, contender):
        order.append((case.name, contender))
        if len(order) == 3:
            raise KeyboardInterrupt
        return line(case.name, contender, [errors.get((case.name, contender), 0.9)])

    monkeypatch.setattr(adapt, "_line", worked)
    first, second = cases()[:2]
    chosen = tuple(one.__class__(**{**vars(one), "name": name}) for one, name in ((first, "a"), (second, "b")))
    study = adapt.AdaptStudy(tmp_path, chosen)
    with pytest.raises(KeyboardInterrupt):
        adapt.run_adapt_study(study, lambda text: None)
    lines = adapt.run_adapt_study(study, lambda text: None)
    assert order[2] == order[3] == ("a", "wide")
    assert [name for name, contender in order[-4:]] == ["b", "b", "a", "a"]
    assert len(lines) == 10
    with pytest.raises(InputError, match="steps: 7500000, requested 7"):
        adapt.run_adapt_study(adapt.AdaptStudy(tmp_path, chosen, sizes={**adapt.FULL, "steps": 7}), lambda text: None)


def test_regained_is_the_share_of_what_the_truth_wins():
    old = np.array([1.0, 2.0, 3.0])
    lines = [line("a", "none", old), line("a", "truth", 0.5 * old), line("a", "ours", 0.6 * old, kept="new", found=[])]
    lines += [line("b", "none", old), line("b", "truth", 0.95 * old), line("b", "ours", old, kept="old", found=[])]
    table = adapt.by_case(lines)
    share = adapt.regained(table["a"])
    assert (share.mean, share.low, share.high) == pytest.approx((80.0, 80.0, 80.0))
    assert (adapt.helps(table["a"]), adapt.helps(table["b"])) == (True, False)
    said = "\n".join(adapt.summary(table))
    assert "in 1 of 2 cases" in said
    assert "median 80; at least 50 in 1 of 1" in said
    assert "kept the old policy in 1 of 2 cases" in said
    assert "larger in 0 (-)" in said


@pytest.mark.parametrize(("option", "said"), [("--contenders", "'ours'"), ("--cases", "unknown case 'our'")])
def test_bad_input(capsys, option, said):
    assert main(["adapt", "--out", "x", option, "our"]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", ["friction_asymmetry_copy0", "command_delay_copy1"])
def test_the_truth_is_the_robot_that_is_driven(name, tmp_path):
    (case,), own = chosen_cases((name,)), load_robot()
    hidden = load_patch([dict(one) for one in case.effects])
    found = uncertainty_of(adapt.exact_result(case, own), hidden, "slippery", own, tmp_path)
    (stated, *_), seeds = found.families, np.arange(3, dtype=np.uint64)
    drawn = load_randomization(dict(stated.randomization), own).parameters(seeds, seeds)
    true = apply_patch(hidden, case.parameters(own)).values
    assert drawn.values == pytest.approx(np.repeat(true, 3, axis=0), rel=1e-9, abs=1e-12)
