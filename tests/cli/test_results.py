"""``--json``: valid JSON on the standard output and nothing else; ``--force``: nothing is replaced without it."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from wlr_gym import cli
from wlr_gym.cli import main
from wlr_gym.cli.terminal import only_results, print_json

#: Commands that end in no results: they run until they are ended.
WITHOUT_RESULTS = {"emulate", "view"}


def test_every_command_with_results_has_json():
    kinds = {name: cli.options_of(name) for name in cli.COMMANDS}
    kinds = {name: list(kind.values()) if isinstance(kind, dict) else [kind] for name, kind in kinds.items()}
    assert {name for name, all in kinds.items() for kind in all if not hasattr(kind, "json")} == WITHOUT_RESULTS


@dataclass
class Found:
    path: Path
    value: float


def test_json_has_no_numbers_that_are_not_finite(capsys):
    print_json({"found": Found(Path("a/b"), math.nan), "array": np.array([1.0, np.inf]), "count": np.int64(3), 4: (True, None)})
    assert json.loads(capsys.readouterr().out) == {
        "found": {"path": "a/b", "value": None}, "array": [1.0, None], "count": 3, "4": [True, None],
    }  # fmt: skip
    with pytest.raises(ValueError, match="JSON has no such value"):
        print_json(object())


def test_json_is_ascii(capsys):
    print_json({"robot": "Räder"})
    assert capsys.readouterr().out.isascii()


def test_only_results_reach_the_standard_output(capsys):
    with only_results(True):
        print("a message")
        print_json([1])
    print("later")
    shown = capsys.readouterr()
    assert shown.out == "[\n  1\n]\nlater\n"
    assert shown.err == "a message\n"


@pytest.mark.parametrize(
    "words",
    [
        ["envs"],
        ["envs", "WLR-Velocity-v0"],
        ["effects"],
        ["effects", "backlash"],
        ["effects", "check", "worn_wheels"],
        ["robot", "show"],
        ["robot", "check"],
        ["record", "--list"],
        ["commission", "--list"],
        ["doctor", "--emulated"],
        ["evaluate", "do_nothing", "--baselines", "--episodes", "2", "--randomization", "none"],
    ],
    ids=" ".join,
)
def test_the_output_is_json(words, capsys):
    main([*words, "--json"])
    assert json.loads(capsys.readouterr().out)


def test_json_of_a_mistake_is_nothing(capsys):
    assert main(["evaluate", "pdi", "--json"]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "did you mean 'pid'?" in shown.err


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    words = ["--excitation", "straight", "--backend", "gibbs_appell", "--seconds", "1", "--json"]
    assert main(["record", *words, "--out", str(folder)]) == 0
    return folder


EVALUATE = "evaluate do_nothing --baselines --episodes 2 --randomization none --no-progress --out OUT/card"
COMPARE = "compare --excitation straight --seconds 0.2 --no-plots --out OUT/c"


@pytest.mark.parametrize(
    "words",
    [
        EVALUATE,
        "replay RUNS --no-plots --out OUT/replayed",
        "export RUNS --to rosbag2 --out OUT/bags",
        f"{COMPARE} --plants gibbs_appell gibbs_appell:physics_step=0.0005",
        "record --excitation straight --commands-only --out OUT/motions",
        "play --seconds 0.1 --size 64 64 --randomization none --video OUT/film.webp",
    ],
    ids=lambda words: words.partition(" ")[0],
)
def test_results_are_not_replaced(words, tmp_path, runs, capsys):
    """The second time a command is refused, and what is there is as before."""
    if words.startswith("export"):
        pytest.importorskip("mcap")
    command = words.replace("RUNS", str(runs)).replace("OUT", str(tmp_path)).split()
    option = "--video" if "--video" in command else "--out"
    assert main(command) == 0
    out = Path(command[command.index(option) + 1])
    before = {path: path.read_bytes() for path in ([out] if out.is_file() else out.rglob("*")) if path.is_file()}
    capsys.readouterr()
    assert main(command) == 2
    error = capsys.readouterr().err
    assert f"{option} {out}" in error
    assert "exists; choose another name, or replace it with --force" in error
    assert before == {path: path.read_bytes() for path in before}
    assert main([*command, "--force"]) == 0


@pytest.mark.parametrize(
    ("command", "there"),
    [
        ("evaluate pid --no-progress", "config.yaml"),
        ("replay RUNS --no-plots", "provenance.yaml"),
        ("compare --excitation straight --seconds 0.2", "meta.yaml"),
        ("commission --emulated", "meta.yaml"),
    ],
)
def test_nothing_is_written_among_results_of_another_command(tmp_path, runs, capsys, command, there):
    (tmp_path / there).write_text("of another")
    assert main([*command.replace("RUNS", str(runs)).split(), "--out", str(tmp_path)]) == 2
    assert f"--out {tmp_path}: '{there}' of another command is in it; choose another folder" in capsys.readouterr().err
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(there, "of another")]


def test_an_analysis_a_policy_and_a_picture_are_not_replaced(tmp_path, runs, capsys):
    for name in ("report/result.json", "mine.onnx", "page.png", "demo/demo.html", "paper/report.md", "bench.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("{}")
    (tmp_path / "demo" / "provenance.yaml").write_text("{}")
    for words in (
        ["gap", str(runs), "--out", str(tmp_path / "report")],
        ["export", "velocity_blind", "--out", str(tmp_path / "mine.onnx")],
        ["envs", "WLR-Velocity-v0", "--picture", str(tmp_path / "page.png")],
        ["robot", "show", "--picture", str(tmp_path / "page.png")],
        ["demo", "--quick", "--out", str(tmp_path / "demo")],
    ):
        assert main(words) == 2, words
        assert "exists; choose another name, or replace it with --force" in capsys.readouterr().err, words
