"""``wlr export --reseal``: contracts in an older form are rewritten where the robot is the same; what is computed stays."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import onnx

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.learning.evaluation.rollout import make_core
from wlr_gym.policy import contract_of, find_policy, make_policy, policy_environment
from wlr_gym.policy.export import file_hash, reseal
from wlr_gym.policy.onnx_file import seal

#: Fingerprints of the nominal robot as contracts had them at first.
FIRST_ROBOT = "8601eeed2036c97c"
FIRST_SERVO = "c8636cc4d3b45309"


@pytest.fixture
def old(tmp_path):
    """A shipped policy and its card as they were: first form of the hash, and without keys that have a default."""
    path = Path(shutil.copy(find_policy("velocity_blind"), tmp_path))
    card = Path(shutil.copy(find_policy("velocity_blind").with_suffix(".md"), tmp_path))
    before, content = file_hash(path), contract_of(path)
    content["environment"]["robot"] = {"name": "wlr-nominal", "hash": FIRST_ROBOT, "servo": FIRST_SERVO}
    for column in content["environment"]["observation"]:
        if column["lag"] == 0:
            column.pop("lag")
    path.write_bytes(seal(path.read_bytes(), content))
    card.write_text(card.read_text().replace(before, file_hash(path)))
    return path


def test_the_older_form_is_refused_with_advice(old):
    core = make_core("WLR-Velocity-v0", 1, policy_environment(old))
    with pytest.raises(InputError, match=r"robot\.hash is '8601.*wlr export --reseal"):
        make_policy(old, core.contract())
    core.close()


def test_it_says_what_changed_and_changes_nothing_else(old, capsys):
    before, graph = contract_of(old), onnx.load(old).graph.SerializeToString(deterministic=True)
    sha = file_hash(old)
    assert main(["export", "--reseal", str(old)]) == 0
    said = capsys.readouterr().out
    assert f"environment.robot.hash: '{FIRST_ROBOT}' -> '2-" in said
    assert f"environment.robot.servo: '{FIRST_SERVO}' -> '2-" in said
    assert f"velocity_blind.md: SHA-256 {sha} -> {file_hash(old)}" in said
    assert onnx.load(old).graph.SerializeToString(deterministic=True) == graph
    after = contract_of(old)
    for column, was in zip(after["environment"]["observation"], before["environment"]["observation"], strict=True):
        assert column.pop("lag") == was.pop("lag", 0)
    assert [key for key in before if after[key] != before[key]] == ["environment"]
    assert [key for key in before["environment"] if after["environment"][key] != before["environment"][key]] == ["robot"]
    assert f"`{file_hash(old)}`" in old.with_suffix(".md").read_text()
    core = make_core("WLR-Velocity-v0", 1, policy_environment(old))
    assert np.isfinite(make_policy(old, core.contract()).act(core.observation)).all()
    core.close()


def test_twice_is_once(old, capsys):
    reseal(old)
    data = old.read_bytes()
    assert main(["export", "--reseal", str(old), str(old)]) == 0
    assert capsys.readouterr().out.count("nothing changed") == 2
    assert old.read_bytes() == data


def test_another_robot_is_refused(old, tmp_path):
    data = old.read_bytes()
    heavy = tmp_path / "heavy.yaml"
    heavy.write_text("base: nominal\nname: heavy\nbody: {mass: 3.0}\n")
    with pytest.raises(InputError, match=r"velocity_blind\.onnx: robot\.hash is '8601.*not the robot of its training"):
        reseal(old, str(heavy))
    assert old.read_bytes() == data


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--reseal"], "expected policies"),
        (["--reseal", "pid"], "'pid' is an agent"),
        (["--reseal", "velocity_blind", "--out", "x.onnx"], "--out: --reseal rewrites policies where they are: leave it out"),
        (["velocity_blind", "--robot", "nominal"], "--robot: of archives (.zip) and with --reseal only"),
        (["velocity_blind", "path_blind"], "expected one policy, got 2"),
    ],
)
def test_options_that_do_not_go_together(words, message, capsys):
    assert main(["export", *words]) == 2
    assert message in capsys.readouterr().err


def test_a_policy_folder_is_resealed_too(old, tmp_path, capsys):
    """What an earlier ``wlr train`` left: the advice of the refusal holds for it."""
    contract = tmp_path / "policy" / "contract.json"
    contract.parent.mkdir()
    contract.write_text(json.dumps(contract_of(old)))
    assert main(["export", "--reseal", str(tmp_path)]) == 0
    assert f"environment.robot.hash: '{FIRST_ROBOT}' -> '2-" in capsys.readouterr().out
    reseal(old)
    assert contract_of(tmp_path) == contract_of(old)


def test_a_contract_without_a_robot_is_refused(tmp_path, capsys):
    (tmp_path / "contract.json").write_text(json.dumps({"format": 1, "agent": "ppo", "environment": {}, "config": {}}))
    assert main(["export", "--reseal", str(tmp_path)]) == 2
    assert "robot.hash is None" in capsys.readouterr().err
