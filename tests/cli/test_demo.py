"""``wlr demo`` end to end, with a training far too short to learn."""

import json

import pytest

from wlr_gym.cli import main

pytest.importorskip("torch")


def test_demo_writes_everything_and_runs_again(tmp_path, capsys):
    out = tmp_path / "demo"
    arguments = ["demo", "--out", str(out), "--steps", "20000", "--episodes", "4", "--no-progress"]
    assert main(arguments) == 0
    assert main(arguments) == 0  # replaces the demo before
    for name in ("card.md", "card.json", "learning_curve.png", "episode.png", "config.yaml", "run/policy/contract.json"):
        assert (out / name).stat().st_size > 0, name
    card = json.loads((out / "card.json").read_text())
    assert list(card["policies"]) == ["PPO", "do_nothing", "untrained", "pid"]
    last_line = capsys.readouterr().out.strip().splitlines()[-1]
    assert last_line.startswith("done in")
    assert "episode.png" in last_line


def test_demo_does_not_remove_what_is_not_its_own(tmp_path, capsys):
    mine = tmp_path / "demo" / "run" / "thesis.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("years of work")
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 2
    assert "in the way" in capsys.readouterr().err
    assert mine.read_text() == "years of work"
