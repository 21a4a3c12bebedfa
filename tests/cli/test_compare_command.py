"""``wlr compare``: files, exit codes, refusals that leave nothing behind."""

import json

import pytest

from wlr_gym.cli import main
from wlr_gym.data import comparison as module

SELF = ["--plants", "gibbs_appell", "gibbs_appell:physics_step=0.002", "--seconds", "1.5"]


def test_report_is_written(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["compare", "--out", str(out), *SELF, "--excitation", "steps", "--halve"]) == 0
    shown = capsys.readouterr().out
    assert "Agreement" in shown
    assert "total_across" in shown
    (found,) = json.loads((out / "compare.json").read_text())
    assert [case["motion"] for case in found["cases"]] == ["steps"]
    assert [plant["physics_step"] for plant in found["plants"]] == [0.001, 0.002]
    assert found["cases"][0]["differences"]["vel_wheel"]["rms_in_noise_units"] > 0.0
    assert len(found["half_step"]) == 1
    names = {path.name for path in out.iterdir()}
    assert {"report.md", "config.yaml", "provenance.yaml", "none.png", "none_steps.png"} <= names
    report = (out / "report.md").read_text()
    assert "| steps |" in report
    assert "| friction_along * |" in report
    assert "| total_along |" in report
    assert "own step of gibbs_appell, 1 ms | own step of gibbs_appell, 2 ms |" in report


def test_figures_of_many_effects_have_names_that_a_file_system_takes(tmp_path):
    out = tmp_path / "out"
    slopes = []
    for k in range(25):
        (tmp_path / f"{k}.yaml").write_text("effects: [{name: floor_slope, parameters: {pitch: 0.001, roll: 0.0}}]")
        slopes.append(str(tmp_path / f"{k}.yaml"))
    assert main(["compare", "--out", str(out), *SELF, "--excitation", "steps", "--effects", *slopes]) == 0
    assert len(list(out.glob("*.png"))) == 2


def test_strict_fails_when_plants_disagree(tmp_path, monkeypatch):
    arguments = ["compare", *SELF, "--excitation", "steps", "--no-plots"]
    assert main([*arguments, "--out", str(tmp_path / "a"), "--strict"]) == 0
    monkeypatch.setitem(module.BOUNDS, "wheel_torque", 1e-9)
    assert main([*arguments, "--out", str(tmp_path / "b")]) == 0
    assert main([*arguments, "--out", str(tmp_path / "c"), "--strict"]) == 1


def test_an_interrupt_leaves_no_empty_folder(tmp_path, monkeypatch):
    def interrupt(*given, **named):
        assert (tmp_path / "out").is_dir()
        raise KeyboardInterrupt

    monkeypatch.setattr("wlr_gym.data.comparison.compare", interrupt)
    assert main(["compare", "--out", str(tmp_path / "out"), "--excitation", "turns"]) == 130
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--plants", "gibbs_appell", "mujocco"], "did you mean 'mujoco'"),
        (["--excitation", "skid"], "unknown excitation 'skid'"),
        (["--excitation", "turns", "--runs", "x"], "expected one of them"),
        (["--runs", "nowhere"], "no such file or folder"),
        (["--seconds", "0"], "--seconds 0"),
        (["--threshold", "-1"], "--threshold -1"),
        (["--threads", "0"], "--threads 0: expected 1 or more"),
        (["--seed", "-1"], "--seed -1: expected a number from 0 to"),
        (["--effects", "nothing_like_it"], "nothing_like_it"),
        (["--physics-step", "0.0007"], "does not divide"),
    ],
)
def test_bad_input_is_named_and_leaves_no_folder(tmp_path, capsys, arguments, words):
    out = tmp_path / "out"
    assert main(["compare", "--out", str(out), *arguments]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
