"""A system of one's own: the linear axis of the examples."""

import dataclasses
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.gap.estimation import level, mean_squares
from wlr_gym.gap.problem import MeasuredSignal, Quantity, Setting
from wlr_gym.gap.rig.own import OwnRigProblem, check_rig, load_rig, open_own_rig, read_rig_runs, simulate
from wlr_gym.gap.workflow import analyse, known_patch

FILE = Path(__file__).resolve().parents[2] / "examples" / "linear_axis.py"
PAGE = FILE.parents[1] / "docs" / "own_rig.md"
AXIS = load_rig(FILE)
AXIS_FILE = sys.modules["wlr_gym_rig_linear_axis"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("axis")
    AXIS_FILE.record(folder)
    return folder


@pytest.fixture(scope="module")
def found(runs):
    return analyse(runs, rig=str(FILE))


@pytest.mark.slow
def test_asymmetric_friction_is_named_and_sized(found):
    (effect,) = found.effects
    assert (found.verdict, effect.name, effect.where) == ("effect_found", "asymmetric_friction", ("axis",))
    difference = effect.parameters["difference"]
    assert difference.value == pytest.approx(1.0, abs=0.05)
    assert difference.low < 1.0 < difference.high
    assert found.gap.reduction > 0.8
    said = re.search(r"(\S+) N \((\S+) to (\S+)\)", " ".join(PAGE.read_text(encoding="utf-8").split()))
    assert said is not None
    assert [float(number) for number in said.groups()] == pytest.approx(
        [difference.value, difference.low, difference.high], abs=1e-3
    )


@pytest.mark.slow
def test_nothing_is_missing_beside_what_is_given(runs, found):
    given = {"name": "asymmetric_friction", "where": ["axis"], "parameters": {"difference": 1.0}}
    again = analyse(runs, known=given, rig=str(FILE))
    assert (again.verdict, again.effects) == ("nothing_missing", ())
    assert again.gap is not None
    assert again.gap.heldout_calibrated < 0.5 * found.gap.heldout_calibrated


def test_nothing_is_missing_of_an_axis_like_the_model(tmp_path):
    AXIS_FILE.record(tmp_path, difference=0.0, runs=4, seed=5)
    assert analyse(tmp_path, rig=str(FILE)).verdict == "nothing_missing"


def test_equation_is_integrated_between_rows_and_begins_anew_where_windows_do():
    """A constant force on a carriage without friction: a parabola from each start."""
    t = np.cumsum([0.0, 0.01, 0.017, 0.005, 0.02])
    values = AXIS.numbers | {"friction": 0.0}
    begun = np.array([[0.1, -0.2], [0.5, 0.3]])
    starts = np.array([0, -1, -1, 1, -1])
    read, states = simulate(AXIS, values, t, np.full((5, 1), 4.0), starts, begun)
    acceleration = 4.0 * values["force_constant"] / values["mass"]
    since = np.array([t[0], t[1], t[2], 0.0, t[4] - t[3]])
    first = begun[[0, 0, 0, 1, 1]]
    assert read[:, 0] == pytest.approx(first[:, 0] + first[:, 1] * since + 0.5 * acceleration * since**2, abs=1e-12)
    assert states[:, 1] == pytest.approx(first[:, 1] + acceleration * since, abs=1e-12)


def test_a_model_replays_its_own_runs_to_the_noise(runs):
    problem, findings = open_own_rig(runs, AXIS)
    assert isinstance(problem, OwnRigProblem)
    assert findings == []
    nominal = Setting(np.array([one.nominal for one in AXIS.parameters]))
    made = list(problem.remade(nominal, [0, 1], 2))
    again = next(problem.remade(nominal, [0], 1))
    np.testing.assert_array_equal(made[0][0], again[0])
    assert not np.array_equal(made[0][0], made[1][0])
    assert 0.8 < np.sqrt(np.nanmean(made[0][0][:, 0] ** 2)) < 1.5, "first states are taken out"


def falling(x, u, p):
    return x.rate, p.fall * x.angle + u.push


def test_an_unstable_system_has_the_noise_floor_of_its_windows(tmp_path):
    """Held upright by feedback that the model does not know: from the first row on it would fall."""
    rig = dataclasses.replace(
        AXIS,
        change=falling,
        readings=lambda x, u, p: (x.angle,),
        states={"angle": "angle", "rate": "rate of angle"},
        inputs={"push": "rad/s2"},
        columns=(MeasuredSignal("angle", "rad", 5e-4, "angle"),),
        parameters=(Quantity("fall", "1/s2", 30.0, 1.0, 10.0, 60.0),),
    )
    for k in range(3):
        rng, angle, rate, rows = np.random.default_rng(k), 0.02, 0.0, []
        for t in 0.01 * np.arange(600):
            push = -60.0 * (angle - 0.05 * np.sin(3.0 * t + k)) - 10.0 * rate
            rows.append((t, push, angle + 5e-4 * rng.standard_normal()))
            for _ in range(50):
                rate += 2e-4 * (32.0 * angle + push)
                angle += 2e-4 * rate
        pd.DataFrame(rows, columns=["t", "push", "angle"]).to_csv(tmp_path / f"run_{k}.csv", index=False)
    problem, _ = open_own_rig(tmp_path, rig)
    assert isinstance(problem, OwnRigProblem)
    true = Setting(np.array([32.0]))
    left = level(mean_squares([residual[0] for residual in problem.residuals([true], range(3))], problem.cap))
    made = level(mean_squares(next(problem.remade(true, range(3), 1)), problem.cap))
    assert 0.5 * left < made < 1.5 * left


def test_two_runs_are_too_few(tmp_path):
    AXIS_FILE.record(tmp_path, runs=2)
    done = analyse(tmp_path, rig=str(FILE))
    with pytest.raises(InputError, match=r"threads = 0: expected 1 or more"):
        analyse(tmp_path, rig=FILE, threads=0)
    assert (done.verdict, done.intake[0].kind) == ("bad_data", "few_runs")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.rename(columns={"position": "positon"}), r"has no column 'position'.*positon"),
        (lambda table: table.assign(current="much"), r"column 'current' holds"),
        (lambda table: table.assign(current=np.nan), r"column 'current', row 0.*: expected a finite number"),
        (lambda table: table.assign(t=table["t"].to_numpy()[::-1]), r"column 't', row 1.*: expected times that rise"),
        (lambda table: table.assign(position=np.nan), r"column 'position' holds no number"),
        (
            lambda table: table.assign(position=table["position"].where(table.index != 7, -np.inf)),
            r"column 'position', row 7.*: expected a finite number, got an infinite one",
        ),
        (lambda table: table[:5], r"5 rows: expected 20 or more"),
    ],
)
def test_runs_that_are_none_are_refused_with_file_and_column(runs, tmp_path, change, message):
    change(pd.read_csv(runs / "run_01.csv")).to_csv(tmp_path / "run_07.csv", index=False)
    with pytest.raises(InputError, match=rf"run_07\.csv: {message}"):
        read_rig_runs(tmp_path, AXIS)


def test_one_run_in_two_formats_is_not_two(runs, tmp_path):
    table = pd.read_csv(runs / "run_01.csv")
    table.to_csv(tmp_path / "run_01.csv", index=False)
    table.to_parquet(tmp_path / "run_01.parquet")
    with pytest.raises(InputError, match=r"run_01\.csv and run_01\.parquet are the same run"):
        read_rig_runs(tmp_path, AXIS)


def test_a_law_under_a_name_of_the_library_keeps_its_own_units(tmp_path):
    text = FILE.read_text().replace('"viscous_friction"', '"viscous"').replace("asymmetric_friction", "coulomb_friction")
    path = tmp_path / "axis.py"
    path.write_text(text.replace('{"difference": ', '{"torque": ').replace("p.difference", "p.torque"))
    AXIS_FILE.record(tmp_path, runs=3)
    done = analyse(tmp_path, tmp_path / "out", rig=path)
    assert [(one.name, one.parameters["torque"].unit) for one in done.effects] == [("coulomb_friction", "N")]
    page = (tmp_path / "out" / "report.html").read_text()
    assert re.search(r"torque [\d.]+ N<", page)
    assert re.search(r"cogging [\d.]+ N, phase [-\d.]+ rad", page)


def test_a_run_under_two_names_is_refused(runs, tmp_path):
    for name, copied in {"run_01": "run_01", "run_02": "run_02", "run_03": "run_01"}.items():
        (tmp_path / f"{name}.csv").write_bytes((runs / f"{copied}.csv").read_bytes())
    with pytest.raises(InputError, match=r"run_01 and run_03 are the same run"):
        analyse(tmp_path, rig=FILE)


def test_the_case_of_a_files_ending_loses_no_run(runs, tmp_path):
    for name in ("run_01.csv", "run_02.CSV"):
        (tmp_path / name).write_bytes((runs / name.lower()).read_bytes())
    assert [run.name for run in read_rig_runs(tmp_path, AXIS)] == ["run_01", "run_02"]


def test_a_candidate_has_the_meaning_of_its_own_law(runs):
    problem, _ = open_own_rig(runs, AXIS)
    assert isinstance(problem, OwnRigProblem)
    _, candidates = problem.candidates(Setting(np.array([one.nominal for one in AXIS.parameters])), [], [])
    assert {one.name: one.doc for one in candidates} == {name: law.doc for name, law in AXIS.laws.items()}


def without_sigma():
    return (dataclasses.replace(AXIS.parameters[0], sigma=0.0),)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": {"position": "positon"}}, r"states: position.*unknown column 'positon'.*position"),
        ({"states": {}}, r"states = \[\]: expected one name or more"),
        ({"inputs": {"position": "m"}}, r"'position' is an input or the clock"),
        ({"inputs": {"a b": "m"}}, r"inputs = 'a b': expected a name of letters"),
        ({"parameters": without_sigma()}, r"parameters: mass: sigma = 0: expected more than 0 kg$"),
        ({"parameters": AXIS.parameters * 2}, r"parameters and laws = 'mass': expected every name once"),
        ({"windows": ()}, r"windows = \(\): expected lengths above 0"),
        ({"windows": 0.5}, r"windows = 0\.5: expected a tuple of lengths"),
        ({"columns": AXIS.columns[0]}, r"columns = MeasuredSignal\(.*: expected a tuple of MeasuredSignal"),
        ({"inputs": ["current"]}, r"inputs = \['current'\]: expected a mapping from names to units"),
        ({"inputs": {"lambda": "m"}}, r"inputs = 'lambda': expected a name"),
        ({"inputs": {"_current": "A"}}, r"inputs = '_current': expected a name"),
        ({"disagreement": "much"}, r"disagreement = 'much': expected 0 or more$"),
        (
            {"columns": (dataclasses.replace(AXIS.columns[0], noise=None),)},
            r"position: noise = None: expected more than 0 m$",
        ),
        ({"step": 0.0}, r"step = 0: expected more than 0 s$"),
    ],
)
def test_rigs_that_contradict_themselves_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        check_rig(dataclasses.replace(AXIS, **changes), "axis.py")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file"),
        ("1 / 0", "does not run: ZeroDivisionError"),
        ("RIG = 3", r"RIG = 3: expected"),
        ("raise SystemExit(3)", "does not run: SystemExit: 3"),
    ],
)
def test_files_that_are_no_rig_are_refused(tmp_path, text, message):
    path = tmp_path / "rig.py"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=rf"rig\.py: {message}"):
        load_rig(path)


def test_equations_that_cannot_be_compiled_are_named(runs):
    broken = dataclasses.replace(AXIS, change=lambda x, u, p: (x.no_such_state, 0.0))
    with pytest.raises(
        InputError, match=r"rig 'axis': change \(2 rates\) or readings \(1 columns\) cannot be compiled: .*no_such_state"
    ):
        open_own_rig(runs, broken)


def test_patches_are_read_by_the_rigs_own_laws(tmp_path):
    path = tmp_path / "patch.yaml"
    path.write_text(yaml.safe_dump({"effects": [{"name": "load", "where": ["axis"], "parameters": {"load": 0.4}}]}))
    assert known_patch(path, FILE).effects[0].parameters == {"load": 0.4}
    with pytest.raises(InputError, match=r"unknown effect 'lod'.*load"):
        known_patch({"name": "lod", "parameters": {}}, FILE)
    with pytest.raises(InputError, match="unknown where 'servo'; valid: axis"):
        known_patch({"name": "load", "where": ["servo"], "parameters": {"load": 0.4}}, FILE)
    with pytest.raises(InputError, match="unknown effect 'unknown_effect'"):
        known_patch({"name": "unknown_effect", "formula": "-b * rate"}, FILE)
