"""``wlr paper``: files, and refusals that leave nothing behind."""

import json

import pytest

from wlr_gym.cli import run_command
from wlr_gym.errors import InputError


def test_report_is_written(tmp_path, capsys):
    out = tmp_path / "out"
    assert run_command("paper", ["--out", str(out), "--plant", "gibbs_appell", "--draws", "0"]) == 0
    names = {path.name for path in out.iterdir()}
    figures = {f"figure_{number:02d}.png" for number in (7, 8, 9, 10, 11, 13, 14, 15, 16, 17)}
    assert names >= figures | {"test_1_slip.png", "test_2_slip.png"}
    assert names >= {"report.md", "claims.json", "agreement.json", "search.json", "config.yaml", "provenance.yaml"}
    assert len(json.loads((out / "claims.json").read_text())) == 25
    text = (out / "report.md").read_text()
    assert "| gibbs_appell | test_2 |" in text
    assert "| (30) |" in text
    assert "does not hold" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--plant", "mujocco"], "did you mean 'mujoco'"),
        (["--draws", "-1"], "--draws -1"),
        (["--levels", "4"], "--levels 4"),
        (["--threads", "0"], "--threads 0"),
        (["--robot", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_named_and_leaves_no_folder(tmp_path, arguments, words):
    out = tmp_path / "out"
    with pytest.raises(InputError, match=words):
        run_command("paper", ["--out", str(out), *arguments])
    assert not out.exists()
