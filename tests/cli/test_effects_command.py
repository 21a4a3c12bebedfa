"""``wlr effects``, and ``--effects`` of the commands that simulate."""

from __future__ import annotations

import json

import pytest
import yaml

from wlr_gym.cli import main
from wlr_gym.physics.effects import EFFECTS

ICE = "effects: [{name: friction_level, parameters: {mu: 0.1}}]\n"


def test_the_library_is_listed(capsys):
    assert main(["effects"]) == 0
    text = capsys.readouterr().out
    for name, effect in EFFECTS.items():
        assert f"\n{name} " in text
        assert effect.doc.split()[0] in text


def test_effects_are_explained(capsys):
    assert main(["effects", "friction_patch", "supply_sag"]) == 0
    text = capsys.readouterr().out
    for word in ("x_min < x < x_max", "y_max (optional)", "[0.05, 1.5]", "the robot's ground.mu_x", "supply_sag", "ohm"):
        assert word in text


def test_formulas_are_explained(capsys):
    assert main(["effects", "unknown_effect"]) == 0
    text = capsys.readouterr().out
    assert main(["effects", "unknown_effect", "supply_sag", "--json"]) == 0
    formulas, sag = json.loads(as_json := capsys.readouterr().out)
    assert (formulas["name"], sag["name"]) == ("unknown_effect", "supply_sag")
    for word in ("body_torque_yaw", "floor_force_x", "leg_angle", "slip_speed", "m/s"):
        assert word in text
        assert word in as_json


def test_check_prints_what_changes(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a long path would be cut short in the table
    (tmp_path / "ice.yaml").write_text(ICE)
    assert main(["effects", "check", "ice.yaml", "leg_spring"]) == 0
    text = capsys.readouterr().out
    for word in (
        "friction_level",
        "ice.yaml",
        "mu = 0.1",
        "ground.mu_x[wheel_lf]",
        "0.6",
        "-k * (leg_angle - a0)",
        "0.8 N m/rad",
    ):
        assert word in text
    assert "body.mass" not in text
    assert main(["effects", "check", "leg_spring"]) == 0
    assert "no parameter changes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["backlsh"], ["unknown effect 'backlsh'", "did you mean 'backlash'"]),
        (["icy_patch"], ["'icy_patch' is a patch, not an effect: wlr effects check icy_patch"]),
        (["mine.yaml"], ["wlr effects check mine.yaml"]),
        (["chek", "mine.yaml"], ["unknown word 'chek' (did you mean 'check'?); see: wlr effects --help"]),
        (["check"], ["give the patch files"]),
        (["check", "backlash"], ["'backlash' is an effect, not a patch", "wlr effects backlash"]),
        (["check", "unknown_effect"], ["'unknown_effect' is an effect, not a patch"]),
        (["check", "report/result.json"], ["report/result.json: not a patch", "the patch.yaml beside it"]),
        (["check", "empty.yaml"], ["empty.yaml: is empty; expected a mapping with 'effects'"]),
        (["check", "binary.yaml"], ["binary.yaml: is no text file; expected YAML in UTF-8"]),
        (["check", "nowhere.yaml"], ["nowhere.yaml"]),
        (["check", "icy_patch", "icy_patch", "icy_patch", "icy_patch", "icy_patch"], ["icy_patch.yaml: effect 1", "4 patches"]),
        (["check", "icy_patch", "--robot", "nominl"], ["nominl", "did you mean 'nominal'"]),
    ],
)
def test_bad_words_are_refused(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.yaml").write_text("")
    (tmp_path / "binary.yaml").write_bytes(b"\x80")
    assert main(["effects", *arguments]) == 2
    text = capsys.readouterr().err
    for word in words:
        assert word in text


@pytest.mark.parametrize("command", [["train"], ["evaluate", "do_nothing"]], ids=lambda words: words[0])
def test_bad_patches_are_refused_before_anything_is_written(tmp_path, capsys, command):
    if command[0] != "evaluate":
        pytest.importorskip("torch")
    assert main([*command, "--out", str(tmp_path / "out"), "--effects", "icy_patch", "icy_ptch"]) == 2
    assert "did you mean 'icy_patch'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_evaluate_plays_with_effects_and_says_so(tmp_path):
    (tmp_path / "ice.yaml").write_text(ICE)
    out = tmp_path / "out"
    words = ["evaluate", "do_nothing", "--baselines", "--episodes", "2", "--randomization", "none", "--no-progress"]
    assert main([*words, "--out", str(out), "--effects", str(tmp_path / "ice.yaml"), "tired_battery"]) == 0
    card = json.loads((out / "card.json").read_text())
    assert card["conditions"]["effects"] == "friction_level, supply_sag, weak_motor"
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert [effect["name"] for effect in config["effects"]] == ["friction_level", "supply_sag", "weak_motor"]
    assert config["effects"][0]["parameters"] == {"mu": 0.1}


def test_train_writes_the_effects_content_into_its_settings(tmp_path):
    pytest.importorskip("torch")
    (tmp_path / "ice.yaml").write_text(ICE)  # not tired_battery: the engine would be compiled once more for it
    out = tmp_path / "run"
    small = ["total_steps=64", "num_envs=4", "steps_per_env=8", "batch_size=32", "epochs=1"]
    words = ["train", "--out", str(out), "--no-progress", "--set", *small, "--effects", str(tmp_path / "ice.yaml")]
    assert main(words) == 0
    settings = yaml.safe_load((out / "config.yaml").read_text())["settings"]
    assert [(effect["name"], effect["parameters"]) for effect in settings["environment"]["effects"]] == [
        ("friction_level", {"mu": 0.1})
    ]
    assert main(["train", "--resume", str(out), "--effects", "icy_patch"]) == 2
