"""Going on until it is decided: what is in play, what is driven next, how it ends, and how it goes on after an interruption."""

import importlib
import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from waiting import wait_until

from wlr_gym.base.errors import InputError
from wlr_gym.cli.gap import DecideOptions, ask, recorder_of
from wlr_gym.data.excitations import GENTLE, excite
from wlr_gym.data.record import record_simulation
from wlr_gym.data.runs import read_run
from wlr_gym.gap import Budget, Recorded, decide
from wlr_gym.gap.report.result import Explanation, Result, explanations
from wlr_gym.physics.effects import PatchEffect
from wlr_gym.robot import load_robot

decision = importlib.import_module("wlr_gym.gap.decision")
ROBOT = load_robot()
EMPTY = {"effects": [], "equivalent": [], "calibration": {}, "localisation": {}, "gap": None, "patch": "patch.yaml"}


def candidate(name, probability, outcome, number=1, where=("wheel_lf",)):
    values = {"coulomb_friction": "torque", "rolling_resistance": "coefficient", "viscous_friction": "coefficient"}
    return {
        "round": number, "name": name, "where": list(where), "values": {values[name]: 0.1}, "outcome": outcome,
        "probability": probability, "gain": 0.0, "screened": 0.0, "reason": "",
    }  # fmt: skip


def result(verdict, *rounds, runs=("run_01", "run_02")):
    evidence = [entry for _, entries in rounds for entry in entries]
    thresholds = [{"round": k, "none": none} for k, (none, _) in enumerate(rounds, 1)]
    content = {"verdict": verdict, "evidence": evidence, "thresholds": thresholds, "runs": {"fit": list(runs), "heldout": []}}
    return Result.model_validate(EMPTY | content)


def test_one_name_with_95_percent_is_decided():
    found = result(
        "effect_found",
        (0.0, [candidate("coulomb_friction", 0.97, "selected"), candidate("rolling_resistance", 0.03, "worse fit")]),
        (0.3, [candidate("viscous_friction", 0.7, "too little", 2)]),
    )
    (only,) = explanations(found)
    assert (only.name, [effect.name for effect in only.effects]) == ("coulomb_friction", ["coulomb_friction"])


def test_names_that_share_the_probability_are_in_play():
    found = result(
        "effect_found",
        (0.0, [
            candidate("coulomb_friction", 0.6, "selected"),
            candidate("rolling_resistance", 0.39, "equivalent"),
            candidate("viscous_friction", 0.01, "worse fit"),
        ]),
    )  # fmt: skip
    assert [one.name for one in explanations(found)] == ["coulomb_friction", "rolling_resistance"]


def test_a_name_that_is_equivalent_is_in_play_however_improbable():
    entries = [
        candidate("coulomb_friction", 1.0, "selected"),
        candidate("viscous_friction", 1e-50, "equivalent"),
        candidate("rolling_resistance", 1e-60, "worse fit"),
    ]
    assert [one.name for one in explanations(result("effect_found", (0.0, entries)))] == [
        "coulomb_friction",
        "viscous_friction",
    ]


def test_places_of_a_name_count_together_and_the_best_one_stands_for_it():
    entries = [
        candidate("coulomb_friction", 0.5, "selected"),
        candidate("coulomb_friction", 0.46, "worse fit", where=["leg_lf"]),
    ]
    (only,) = explanations(result("effect_found", (0.04, entries)))
    assert only.probability == pytest.approx(0.96)
    assert only.effects[0].where == ("wheel_lf",)


def test_what_further_runs_cannot_change_is_not_in_play():
    entries = [candidate("coulomb_friction", 0.9, "implausible"), candidate("viscous_friction", 0.001, "too little")]
    (only,) = explanations(result("nothing_missing", (0.099, entries)))
    assert (only.name, only.effects) == ("nothing", ())


def test_a_name_that_the_held_out_runs_refute_is_not_in_play_beside_one_that_was_found():
    refuted, kept = candidate("coulomb_friction", 0.0, "fails cross-validation"), candidate("viscous_friction", 1.0, "selected")
    (only,) = explanations(result("effect_found", (0.0, [kept, refuted])))
    assert (only.name, [effect.name for effect in only.effects]) == ("viscous_friction", ["viscous_friction"])


def test_a_probable_name_that_was_not_selected_is_not_decided():
    entries = [candidate("coulomb_friction", 0.99, "fails cross-validation")]
    assert [one.name for one in explanations(result("not_excited", (0.01, entries)))] == ["coulomb_friction", "nothing"]


def test_later_rounds_build_on_what_was_found():
    found = result(
        "effect_found",
        (0.0, [candidate("coulomb_friction", 1.0, "selected")]),
        (0.1, [candidate("viscous_friction", 0.5, "selected", 2), candidate("rolling_resistance", 0.4, "worse fit", 2)]),
        (1.0, []),
    )
    names = {one.name: [effect.name for effect in one.effects] for one in explanations(found)}
    assert names["rolling_resistance"] == ["coulomb_friction", "rolling_resistance"]
    assert names["nothing"] == ["coulomb_friction"]


# ---- what a motion promises ------------------------------------------------------------------------------------------


def test_what_calibration_takes_up_does_not_tell():
    columns = np.array([[2.0, 0.0]])
    # a number of unit variance leaves d^2 / (1 + c^2)
    assert decision._told(np.array([3.0, 0.0]), columns) == pytest.approx(9.0 / (1.0 + 4.0))
    assert decision._told(np.array([0.0, 2.0]), columns) == pytest.approx(4.0)
    assert decision._told(np.array([0.0, 2.0]), columns[:0]) == pytest.approx(4.0)


def test_own_numbers_are_moved_towards_no_effect_and_those_that_say_nothing_are_not():
    values = {"mu": 0.3, "x_min": -1000.0, "x_max": 0.5, "y_min": -1000.0, "y_max": 1000.0}
    patch = Explanation("friction_patch", 0.5, (PatchEffect("friction_patch", ("ground",), values),))
    moved = [dict(own.parameters) for (own,) in decision._own_moved(patch)]
    assert moved == [{**values, "mu": pytest.approx(0.24)}, {**values, "x_min": -800.0}, {**values, "x_max": 0.4}]
    weak = Explanation("weak_motor", 0.5, (PatchEffect("weak_motor", ("wheel_lf",), {"scale": 0.8}),))
    assert [own.parameters["scale"] for (own,) in decision._own_moved(weak)] == [pytest.approx(0.84)]
    assert decision._own_moved(Explanation("nothing", 0.5, ())) == []


@pytest.mark.slow
def test_a_motion_that_loads_what_is_in_question_promises_more(data):
    driven = [read_run(path) for path in sorted(data.glob("run_*.parquet"))]
    both = [candidate("coulomb_friction", 0.5, "selected"), candidate("viscous_friction", 0.5, "equivalent")]
    found = result("effect_found", (0.0, both))
    drive = excite("straight", robot=ROBOT, seconds=3.0)
    stand = decision.Motion("stand", np.repeat(drive.setpoints[:1], 150, axis=0), drive.period)
    # standing cannot promise more
    problem = decision.RobotProblem(driven, ROBOT)
    (promised,) = decision.promises(found, explanations(found), [stand, drive], problem)
    (alone,) = decision.promises(found, explanations(found), [stand], problem)
    assert (promised.motion.name, alone.motion.name) == ("straight", "stand")
    assert promised.most > decision.TELLS > alone.most
    assert {"coulomb_friction", "viscous_friction"} & set(promised.pair)


@pytest.mark.parametrize(
    ("bounds", "whole", "worked_out", "best"),
    [
        ({"a": (9, 9), "b": (8, 8), "c": (2, 2)}, {"a": (5, 5), "b": (7, 7), "c": (1, 1)}, ["a", "b"], "b"),
        ({"a": (9, 5), "b": (2, 9)}, {"a": (8, 4), "b": (1, 7)}, ["a", "b"], "a"),  # b may be the only one that tells
        ({"a": (0, 0), "b": (0, 0)}, {"a": (0, 0), "b": (0, 0)}, ["a"], "a"),
    ],
)
def test_motions_that_cannot_promise_more_are_not_worked_out(data, monkeypatch, bounds, whole, worked_out, best):
    monkeypatch.setattr(decision, "record_simulation", lambda path, motion, *_: data / "run_01.parquet")
    monkeypatch.setattr(decision, "RobotProblem", lambda *_, **__: None)
    done = []

    def promise(motion, free=None):
        if free is not None:
            done.append(motion.name)
        per_second, most = (bounds if free is None else whole)[motion.name]
        return decision.Promise(motion, per_second * motion.duration, most, ("x", "y"))

    seen = SimpleNamespace(promise=promise, own_uncertainty=list)
    monkeypatch.setattr(decision, "_Foresight", lambda *_: seen)
    drive = excite("straight", robot=ROBOT, seconds=1.0)
    motions = [decision.Motion(name, drive.setpoints, drive.period) for name in bounds]
    problem = SimpleNamespace(robot=ROBOT, known=None, backend="gibbs_appell", threads=1)
    found = decision.promises(result(*UNDECIDED), explanations(result(*UNDECIDED)), motions, problem)
    assert (done, found[0].motion.name) == (worked_out, best)


def test_motions_keep_the_profile_of_the_runs_and_are_drawn_anew():
    first, again = (decision.motions_to_drive(ROBOT, GENTLE, driven) for driven in ([], ["random"]))
    assert "steps" not in [motion.name for motion in first]  # made for no profile
    pairs = zip(first, again, strict=True)
    changed = [one.name for one, two in pairs if not np.array_equal(one.setpoints, two.setpoints, equal_nan=True)]
    assert changed == ["random"]


def test_runs_of_an_excitation_are_known_by_their_setpoints(data):
    whole = record_simulation(data / "run_03.parquet", excite("straight", robot=ROBOT), ROBOT, "gibbs_appell")
    runs = [read_run(path) for path in (data / "run_02.parquet", whole)]
    assert decision.driven_already(runs, ROBOT) == ["straight"]  # the first was cut short


# ---- rounds ----------------------------------------------------------------------------------------------------------

UNDECIDED = (
    "effect_found",
    (0.0, [candidate("coulomb_friction", 0.6, "selected"), candidate("rolling_resistance", 0.4, "equivalent")]),
)
CERTAIN = ("effect_found", (0.0, [candidate("coulomb_friction", 1.0, "selected")]), (1.0, []))


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "runs"
    folder.mkdir()
    for name in ("straight", "random"):
        record(excite(name, robot=ROBOT, seconds=1.0), folder)
    return folder


def record(motion, folder):
    path = folder / f"run_{len(list(folder.glob('run_*.parquet'))) + 1:02d}.parquet"
    return Recorded(record_simulation(path, motion.cut(1.0), ROBOT, "gibbs_appell"))


@pytest.fixture
def answers(monkeypatch):
    """Analyses that give what is asked for, one after the other; motions promise what ``telling`` says."""
    given = {"results": [], "analysed": 0, "telling": 100.0}

    def analyse(data, folder, **options):
        given["analysed"] += 1
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "result.json").write_text(given["results"].pop(0).model_dump_json())

    def promises(found, left, motions, problem):
        telling, names = given["telling"], (left[0].name, left[1].name)
        return [decision.Promise(motion, telling, telling, names) for motion in motions if motion.name == "turns"]

    monkeypatch.setattr(decision, "analyse", analyse)
    monkeypatch.setattr(decision, "promises", promises)
    return given


def test_from_two_runs_to_a_decision(data, tmp_path, answers):
    answers["results"] = [result(*UNDECIDED), result(*CERTAIN)]
    found = decide(data, tmp_path / "out", record)
    rounds = found.history.rounds
    assert [one.verdict for one in rounds] == ["too_few_runs", "effect_found", "effect_found"]
    assert [one.run for one in rounds] == ["run_03", "run_04", ""]
    assert rounds[1].excitation == "turns"
    assert rounds[1].names == pytest.approx({"coulomb_friction": 0.6, "rolling_resistance": 0.4})
    assert (found.history.ended, found.history.driven) == ("decided", [rounds[0].excitation, "turns"])
    assert found.folder == tmp_path / "out" / "round_03"
    assert json.loads((tmp_path / "out" / "history.json").read_text())["rounds"][1]["run"] == "run_04"


def test_it_ends_with_the_budget_and_goes_on_with_a_larger_one(data, tmp_path, answers):
    answers["results"] = [result(*UNDECIDED), result(*CERTAIN)]
    first = decide(data, tmp_path / "out", record, Budget(runs=1))
    assert (first.history.ended, len(first.history.rounds)) == ("budget", 2)
    second = decide(data, tmp_path / "out", record, Budget(runs=2))
    assert (second.history.ended, len(second.history.rounds)) == ("decided", 3)
    assert answers["analysed"] == 2  # what was analysed is not analysed again
    assert decide(data, tmp_path / "out", record).history == second.history


def test_two_processes_do_not_drive_one_robot_for_one_folder(data, tmp_path, answers):
    answers["results"] = [result(*CERTAIN)]
    out, begun = tmp_path / "out", tmp_path / "begun"
    out.mkdir()
    code = f"import pathlib, time\nfrom wlr_gym.base.files import alone_in\nwith alone_in(pathlib.Path({str(out)!r})):\n"
    holder = subprocess.Popen([sys.executable, "-c", f"{code}    pathlib.Path({str(begun)!r}).touch(); time.sleep(600)"])
    wait_until(begun.exists, holder)
    with pytest.raises(InputError, match=rf"out/\.lock: held by process {holder.pid} "):
        decide(data, out, record)
    holder.kill()
    holder.wait()
    assert decide(data, out, record).history.ended == "decided"


def test_a_name_that_leaves_far_more_than_simulators_do_is_not_decided(data, tmp_path, answers):
    errors = dict.fromkeys(("fit_before", "heldout_before", "heldout_calibrated", "heldout_after"), 9.0)
    gap = {"metric": "RMS", **errors, "noise_floor": 1.0, "reduction": 0.5, "reduction_ci95": None}
    bad, good = (result(*CERTAIN).model_dump() | {"gap": {**gap, "fit_after": after}} for after in (5.0, 2.0))
    answers["results"] = [Result.model_validate(one) for one in (bad, good)]
    found = decide(data, tmp_path / "out", record)
    assert (found.history.ended, len(found.history.driven)) == ("decided", 2)
    assert found.history.rounds[1].why == "an error of 5.0 noise floors is left, more than 3.5; shows most effects best"


def test_nothing_is_not_decided_where_one_held_out_run_is_far_off(data, tmp_path, answers):
    errors = dict.fromkeys(("fit_before", "fit_after", "heldout_before", "heldout_calibrated", "heldout_after"), 1.5)
    gap = {"metric": "RMS", **errors, "noise_floor": 1.0, "reduction": 0.0, "reduction_ci95": None}
    runs = [{"run": "run_01", "heldout": False, "after": 5.0}, {"run": "run_02", "heldout": True, "after": 4.8}]
    nothing = result("unknown_effect", (1.0, [])).model_dump() | {"gap": gap}
    answers["results"] = [Result.model_validate(nothing | {"run_gaps": runs})] * 5
    history = decide(data, tmp_path / "out", record, Budget(runs=5)).history
    assert (history.ended, len(history.rounds[-1].runs)) == ("budget", 7)
    assert history.rounds[-2].why == "an error of 4.8 noise floors is left, more than 3.5; shows most effects best"


def test_a_name_that_no_motion_tells_from_an_equivalent_one_is_decided_where_it_has_95_percent(data, tmp_path, answers):
    names = [candidate("coulomb_friction", 0.97, "selected"), candidate("viscous_friction", 0.03, "equivalent")]
    found = result("effect_found", (0.0, names))
    effect = {"name": "coulomb_friction", "where": ["wheel_lf"], "parameters": {}, "confidence": 1.0, "gain": 99.0}
    answers.update(results=[Result.model_validate(found.model_dump() | {"effects": [effect]})], telling=1.5 * decision.TELLS)
    history = decide(data, tmp_path / "out", record).history
    assert (history.ended, list(history.rounds[-1].names)) == ("decided", ["coulomb_friction", "viscous_friction"])


def test_that_nothing_is_missing_takes_six_runs(data, tmp_path, answers):
    nothing = result("nothing_missing", (1.0, []))
    answers["results"] = [nothing] * 4
    history = decide(data, tmp_path / "out", record).history
    assert (history.ended, len(history.rounds[-1].runs)) == ("decided", 6)
    assert history.rounds[1].why.startswith("6 runs or more tell that nothing is missing; ")
    assert len(set(history.driven)) == 4
    answers["results"] = [nothing]
    (tmp_path / "few").mkdir()
    few = decide(data, tmp_path / "few" / "out", record, Budget(runs=0)).history
    assert few.ended == "decided"  # the six are there


def test_nothing_is_not_decided_where_some_runs_alone_show_an_effect(data, tmp_path, answers):
    alone = candidate("coulomb_friction", 0.01, "fails cross-validation")
    answers["results"] = [result("nothing_missing", (0.99, [alone]))] * 5
    history = decide(data, tmp_path / "out", record, Budget(runs=5)).history
    assert (history.ended, len(history.rounds[-1].runs)) == ("budget", 7)


def test_motions_that_take_longer_than_what_is_left_are_not_driven(data, tmp_path, answers):
    found = decide(data, tmp_path / "out", record, Budget(seconds=5.0))
    assert (found.history.ended, found.history.seconds, found.result) == ("budget", 0.0, None)


def test_it_ends_when_no_motion_would_tell(data, tmp_path, answers):
    answers.update(results=[result(*UNDECIDED)], telling=1.0)
    assert decide(data, tmp_path / "out", record).history.ended == "nothing would tell"


def test_it_goes_on_after_an_interruption_with_the_run_that_was_driven(data, tmp_path, answers):
    def interrupted(motion, folder):
        record(motion, folder)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        decide(data, tmp_path / "out", interrupted)
    answers["results"] = [result(*CERTAIN)]
    found = decide(data, tmp_path / "out", record)
    assert [one.run for one in found.history.rounds] == ["run_03", ""]
    assert found.history.rounds[0].seconds == pytest.approx(0.98)


@pytest.mark.parametrize("mended", ["run_01.parquet", "meta.yaml"])
def test_data_that_were_mended_are_analysed_again(data, tmp_path, answers, mended):
    answers["results"] = [result(*UNDECIDED), result(*CERTAIN)]
    decide(data, tmp_path / "out", record, Budget(runs=1))
    path = data / mended
    path.write_bytes(path.read_bytes())
    assert decide(data, tmp_path / "out", record, Budget(runs=1)).history.ended == "decided"


def test_a_drive_that_leaves_nothing_ends_it(data, tmp_path, answers):
    found = decide(data, tmp_path / "out", lambda motion, folder: Recorded(None, "a leg is too warm"))
    assert (found.history.ended, found.history.rounds[-1].stopped) == ("stopped", "a leg is too warm")


def test_a_history_of_other_data_is_refused(data, tmp_path, answers):
    decide(data, tmp_path / "out", record, Budget(runs=0))
    with pytest.raises(InputError, match=r"history.json: backend: gibbs_appell, requested mujoco"):
        decide(data, tmp_path / "out", record, backend="mujoco")
    with pytest.raises(InputError, match=r"expected a new folder, or one with a history.json"):
        decide(data, data, record)


@pytest.mark.slow
def test_an_emulated_robot_drives_a_motion_into_the_folder(data):
    options = DecideOptions(until_decided=True, record="emulated", hidden=("stiff_leg",))
    motion = excite("straight", robot=ROBOT, seconds=0.4)
    found = recorder_of(options, ROBOT, "gibbs_appell", data, Console())(motion, data)
    assert (found.run, found.reason) == (data / "run_03.csv", "")
    assert read_run(data / "run_03.csv").meta.profile == motion.profile


def test_a_real_robot_has_no_hidden_effects(tmp_path):
    with pytest.raises(InputError, match="--hidden: a real robot has its own effects"):
        recorder_of(DecideOptions(until_decided=True, hidden=("stiff_leg",)), ROBOT, "gibbs_appell", tmp_path, Console())


def test_asking_waits_for_the_run(data, tmp_path, capsys):
    motion = excite("turns", robot=ROBOT)
    waited = []

    def wait(seconds):
        waited.append(seconds)
        if len(waited) == 2:
            record(motion, data)

    found = ask(motion, data, out=tmp_path, console=Console(soft_wrap=True), wait=wait)
    assert found.run == data / "run_03.parquet"
    assert f"wlr record --commands {tmp_path / 'motions' / 'turns.csv'} --out {data}" in capsys.readouterr().out
