"""What the commands refuse before they do any work."""

import json

import pytest
import yaml

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
        (["train", "--total-steps", "64"], "--total-steps goes with --resume; of a new training: --set total_steps=64"),
    ],
)
def test_numbers_out_of_range(tmp_path, capsys, arguments, words):
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("seed", [-1, 2**32, 2**64])
@pytest.mark.parametrize(
    "command", ["adapt pid", "compare --out x", "demo", "deploy pid", "emulate", "evaluate pid", "play", "record", "train"]
)
def test_a_seed_out_of_range(capsys, command, seed):
    assert main([*command.split(), "--seed", str(seed)]) == 2
    assert f"--seed {seed}: expected a number from 0 to 4294967295" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "--backend", "mujoco"], "precision 'float32': the MuJoCo plant has float64 only"),
        (["train", "--backend", "dynamixel"], "wlr: unknown backend 'dynamixel'; valid: gibbs_appell, mujoco\n"),
        (["train", "--backend", "mujco"], "did you mean 'mujoco'?); valid: gibbs_appell, mujoco\n"),
        (["evaluate", "do_nothing", "--backend", "mujco"], "did you mean 'mujoco'"),
    ],
)
def test_backends_that_do_not_do(tmp_path, capsys, arguments, words):
    if arguments[0] == "train":
        pytest.importorskip("torch")
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err
    assert not any((tmp_path / "out").glob("*"))


def test_evaluate_on_mujoco_says_so(tmp_path):
    words = ["evaluate", "do_nothing", "--baselines", "--episodes", "1", "--randomization", "none", "--no-progress"]
    assert main([*words, "--backend", "mujoco", "--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "card.json").read_text())["conditions"]["backend"] == "mujoco"


@pytest.mark.slow
def test_train_on_mujoco_with_its_precision(tmp_path):
    pytest.importorskip("torch")
    small = ["total_steps=16", "num_envs=2", "steps_per_env=8", "batch_size=16", "epochs=1", "evaluation_episodes=2"]
    small += ["environment.precision=float64"]
    assert main(["train", "--backend", "mujoco", "--out", str(tmp_path), "--no-progress", "--set", *small]) == 0
    settings = yaml.safe_load((tmp_path / "config.yaml").read_text())["settings"]
    assert (settings["environment"]["precision"], settings["environment"]["backend"]) == ("float64", "mujoco")
