"""``wlr gap``: what is asked of the analysis, what is printed and written, exit codes, refusals that leave nothing behind."""

import importlib
import json
from dataclasses import replace

import gap_examples as examples
import pytest
import yaml

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.gap.report.page import save_analysis

workflow = importlib.import_module("wlr_gym.gap.workflow")


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    return folder


@pytest.fixture
def answer(monkeypatch):
    """Let the analysis give one of the examples; return what it was asked."""
    asked = {}

    def give(analysis):
        def analyse(folder, out, *, tell, **options):
            tell("calibrating", 0.2)
            tell("calibrating", 0.3)
            tell("naming", 0.7)
            asked.update(options, data=folder)
            save_analysis(analysis, out)
            return analysis

        monkeypatch.setattr(workflow, "analyse", analyse)
        return asked

    monkeypatch.setattr("wlr_gym.gap.report.page.draw", lambda analysis: {"gap": b"\x89PNG"})
    return give


def printed(capsys):
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("verdict", examples.ALL)
def test_every_verdict_is_written_and_answered(verdict, data, tmp_path, answer, capsys):
    answer(examples.ALL[verdict])
    out = tmp_path / "out"
    assert main(["gap", str(data), "--out", str(out)]) == (1 if verdict == "bad_data" else 0)
    assert json.loads((out / "result.json").read_text())["verdict"] == verdict
    names = {path.name for path in out.iterdir()}
    assert names == {"result.json", "patch.yaml", "report.html", "plots", "config.yaml", "provenance.yaml"}
    shown = printed(capsys)
    for path in ("report.html", "result.json"):
        assert str(out / path) in shown
    assert ("patch: " in shown) is (verdict != "bad_data")


def test_what_was_found_is_printed(data, tmp_path, answer, capsys):
    answer(examples.EFFECT_FOUND)
    assert main(["gap", str(data), "--out", str(tmp_path / "out")]) == 0
    shown = printed(capsys)
    assert "Missing effect found The model lacks rolling resistance (both front wheels)" in shown
    assert "rolling resistance at both front wheels: coefficient 0.0412 (0.0383 to 0.0447); selection frequency 97 %" in shown
    assert "7.91 as given, 5.24 calibrated, 1.21 with the effects; noise floor 1.00" in shown
    assert "removed of the avoidable error: 95 % (95 % interval 91 to 97 %)" in shown
    assert "data: run_02: 3 rows are missing" in shown
    assert (
        "not distinguishable: rolling resistance and coulomb friction; discriminating experiment: straight with a payload"
        in shown
    )
    assert "record next: straight: with 0.5 kg" in shown
    assert shown.count("calibrating") == 1
    assert "70 % naming" in shown


def test_a_formula_and_fatal_findings_are_printed(data, tmp_path, answer, capsys):
    answer(examples.UNKNOWN_EFFECT)
    main(["gap", str(data), "--out", str(tmp_path / "a")])
    assert "left rear leg: -k * (leg_angle - a0); k 0.81 (0.74 to 0.88) N m/rad" in printed(capsys)
    answer(examples.BAD_DATA)
    main(["gap", str(data), "--out", str(tmp_path / "b")])
    assert "FATAL: run_01 pos_leg_lf: pos_leg_lf reaches 87" in printed(capsys)


def test_options_reach_the_analysis(data, tmp_path, answer):
    asked = answer(examples.NOTHING_MISSING)
    out = tmp_path / "out"
    options = ["--effects", "icy_patch", "--backend", "mujoco", "--heldout", "run_03", "run_06", "--threads", "2"]
    options += ["--robot", "nominal"]
    assert main(["gap", str(data), "--out", str(out), *options]) == 0
    assert asked["data"] == data
    assert [effect.name for effect in asked["known"].effects] == ["friction_patch", "slip_weakening"]
    assert (asked["robot"], asked["backend"], asked["rig"], asked["threads"]) == ("nominal", "mujoco", None, 2)
    assert asked["heldout"] == ("run_03", "run_06")
    settings = yaml.safe_load((out / "config.yaml").read_text())
    assert settings["heldout"] == ["run_03", "run_06"]
    assert settings["effects"][0]["name"] == "friction_patch"
    assert main(["gap", str(data), "--out", str(out), "--rig", "pendulum", "--force"]) == 0  # replaces the earlier one
    assert asked["heldout"] == ()
    assert asked["rig"] == "pendulum"
    assert not asked["known"].effects


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--rig", "pendulm"], "unknown rig 'pendulm' (did you mean 'pendulum'?)"),
        (["--backend", "mujocco"], "--backend: unknown backend 'mujocco' (did you mean 'mujoco'?)"),
        (["--backend", "dynamixel"], "unknown backend 'dynamixel'; valid: gibbs_appell, mujoco"),
        (["--rig", "pendulum", "--backend", "mujoco"], "--rig pendulum has a simulator of its own: leave it out"),
        (["--rig", "pendulum", "--robot", "paper"], "--rig pendulum has a simulator of its own: leave it out"),
        (["--robot", "papr"], "unknown robot config 'papr' (did you mean 'paper'?)"),
        (["--threads", "0"], "--threads 0: expected 1 or more"),
        (["--effects", "nothing_like_it"], "--effects: unknown effects config 'nothing_like_it'"),
        (["--effects", "knwon.yaml"], "--effects: effects config: no file 'knwon.yaml'"),
        (["--rig", "pendulum", "--effects", "icy_patch"], "unknown effect 'friction_patch'"),
        (["--until-decided", "--budget-runs", "-1"], "--budget-runs -1: expected 0 or more"),
        (["--budget-runs", "2"], "--budget-runs: it is for --until-decided"),
        (["--record", "emulated"], "--record: it is for --until-decided"),
        (["--hidden", "stiff_leg"], "--hidden: it is for --until-decided"),
        (["--heldout", "run_99"], "unknown run to hold out"),
    ],
)
def test_bad_input_is_named_and_leaves_no_folder(data, tmp_path, answer, monkeypatch, capsys, options, words):
    def refuse(folder, out, **_):
        raise InputError("unknown run to hold out 'run_99'")

    answer(examples.NOTHING_MISSING)
    monkeypatch.setattr(workflow, "analyse", refuse)
    out = tmp_path / "out"
    assert main(["gap", str(data), "--out", str(out), *options]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_a_run_to_hold_out_is_looked_for_at_once(data, tmp_path, capsys):
    for name in ("run_01.csv", "run_02.parquet"):
        (data / name).touch()
    assert main(["gap", str(data), "--out", str(tmp_path / "out"), "--heldout", "run_02", "run_99"]) == 2
    assert "--heldout: unknown run 'run_99' (did you mean" in capsys.readouterr().err


def test_data_that_are_not_there(tmp_path, answer, capsys):
    answer(examples.NOTHING_MISSING)
    (tmp_path / "run.csv").write_text("")
    assert main(["gap", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]) == 2
    assert main(["gap", str(tmp_path / "run.csv"), "--out", str(tmp_path / "out")]) == 2
    shown = " ".join(capsys.readouterr().err.split())
    assert "no such folder; expected a folder of runs" in shown
    assert "is a file; expected a folder of runs" in shown


def test_the_data_are_not_overwritten(data, answer, capsys):
    asked = answer(examples.NOTHING_MISSING)
    (data / "run_01.csv").write_text("t\n")
    assert main(["gap", str(data), "--out", str(data)]) == 2
    assert "'run_01.csv' in it is not of an analysis" in " ".join(capsys.readouterr().err.split())
    assert not asked  # refused before the work
    assert [path.name for path in data.iterdir()] == ["run_01.csv"]


def test_texts_are_printed_as_they_are(data, tmp_path, answer, capsys):
    answer(replace(examples.NOT_EXCITED, summary="Record [bold]turns[/bold] 机器人."))
    assert main(["gap", str(data), "--out", str(tmp_path / "out")]) == 0
    assert "Record [bold]turns[/bold] 机器人." in printed(capsys)


def test_a_file_that_is_not_there_is_named_with_the_nearest(data, tmp_path, answer, capsys):
    answer(examples.NOTHING_MISSING)
    (tmp_path / "known.yaml").write_text("effects: []")
    given = ["--effects", str(tmp_path / "knwon.yaml")]
    assert main(["gap", str(data), "--out", str(tmp_path / "out"), *given]) == 2
    assert "did you mean 'known.yaml'?" in " ".join(capsys.readouterr().err.split())


def test_what_is_left_is_printed(data, tmp_path, answer, capsys):
    answer(replace(examples.EFFECT_FOUND, gap=replace(examples.GAP, heldout_after=2.2)))
    assert main(["gap", str(data), "--out", str(tmp_path / "out")]) == 0
    shown = printed(capsys)
    assert "Not all is explained: an error of 2.20 is left in the held-out runs" in shown


def test_effects_known_to_the_rig_are_read_as_the_rig_s(data, tmp_path, answer):
    asked = answer(examples.NOTHING_MISSING)
    (tmp_path / "patch.yaml").write_text("effects: [{name: torque_saturation, where: [servo], parameters: {coefficient: 0.3}}]")
    options = ["--rig", "pendulum", "--effects", str(tmp_path / "patch.yaml")]
    assert main(["gap", str(data), "--out", str(tmp_path / "out"), *options]) == 0
    assert [effect.name for effect in asked["known"].effects] == ["torque_saturation"]


def test_what_is_given_as_known_is_not_replaced(data, tmp_path, answer, capsys):
    answer(examples.EFFECT_FOUND)
    out = tmp_path / "out"
    assert main(["gap", str(data), "--out", str(out)]) == 0
    found = (out / "patch.yaml").read_text()
    assert main(["gap", str(data), "--out", str(out), "--effects", str(out / "patch.yaml")]) == 2
    assert "the results would replace it: give another --out" in " ".join(capsys.readouterr().err.split())
    assert (out / "patch.yaml").read_text() == found
