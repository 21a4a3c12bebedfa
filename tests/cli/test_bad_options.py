"""What the commands refuse before they do any work."""

import pytest

from wlr_gym.cli import main


@pytest.mark.parametrize("arguments", [["train"], ["evaluate", "do_nothing"], ["demo"]], ids=lambda arguments: arguments[0])
def test_output_that_cannot_be_a_folder(tmp_path, capsys, arguments):
    if arguments[0] == "demo":
        pytest.importorskip("torch")
    (tmp_path / "file").write_text("mine")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        assert main([*arguments, "--out", str(out)]) == 2
        assert "cannot be a folder" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "--max-minutes", "-1"], "--max-minutes -1: expected more than 0"),
        (["evaluate", "do_nothing", "--seed", "-1"], "--seed -1: expected 0 or more"),
    ],
)
def test_numbers_out_of_range(tmp_path, capsys, arguments, words):
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
