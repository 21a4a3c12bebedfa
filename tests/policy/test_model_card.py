"""Model cards: written from a file's contract and a score card; every shipped policy has its own."""

import shutil

import numpy as np
import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.cli import main
from wlr_gym.learning.evaluation.rollout import make_core, start_episodes
from wlr_gym.policy import (
    contract_of,
    find_policy,
    make_policy,
    policy_environment,
    shipped_names,
    trained_environment,
    write_model_card,
)
from wlr_gym.policy.export import _summary, file_hash
from wlr_gym.policy.onnx_file import open_policy, seal

SCORES = """# Score card: velocity_blind

| metric | velocity_blind |
|---|---|
| rms | 0.01 |

![bars](bars.png)

## Spectrum

![spectrum](spectrum.png)

## Sweep

![sweep](sweep.png)

| friction | rms |
"""


def scores(policy):
    """A score card that says which file was played."""
    return f"{SCORES}\n## Who played\n\n- velocity_blind: `{file_hash(policy)}`\n"


def card_of(policy):
    """The card beside a policy file, which is about this file."""
    text = policy.with_suffix(".md").read_text(encoding="utf-8")
    assert f"| SHA-256 | `{file_hash(policy)}` |" in text
    return text


@pytest.fixture
def policy(exported, tmp_path):
    return shutil.copy(exported, tmp_path / "velocity_blind.onnx")


def test_a_card_says_what_the_file_is(policy):
    text = write_model_card(policy, scores(policy)).read_text()
    lines = text.splitlines()
    assert lines[0] == "# velocity_blind"
    assert "wlr-nominal, at 50 Hz" in text
    assert "| observation | " in text
    assert "command 2, leg_position 4" in text
    assert "ppo, 64 environment steps, 0.0 min with 1 thread(s), seed 0" in text
    assert "| randomisation |" in text
    below = text[text.index("## Score card: velocity_blind") :]
    assert below.splitlines()[2] == "| metric | velocity_blind |"
    assert "| rms | 0.01 |\n\n### Sweep\n\n| friction | rms |\n\n### Who played\n\n- velocity_blind: `" in below
    card_of(policy)


@pytest.mark.parametrize(
    ("sources", "observer", "words"),
    [
        (["computed"], None, "It is blind to slip"),
        (["sensors", "computed"], {"camera": False}, "It is blind to slip"),
        (["sensors", "estimate"], {"camera": True}, "slip observer, with a camera"),
        (["sensors", "estimate"], {"camera": False}, "slip observer, without a camera"),
        (["sensors", "estimate"], {"camera": True, "present": 0.5}, "slip observer, with or without a camera"),
        (["estimate", "truth"], {}, "for simulators only"),
    ],
)
def test_a_card_says_what_the_policy_sees(policy, sources, observer, words):
    content = contract_of(policy)
    content["environment"]["sensors"] = {"camera": observer.pop("present")} if observer and "present" in observer else None
    content["environment"]["observer"] = observer
    for index, column in enumerate(content["environment"]["observation"]):
        column["source"] = sources[index % len(sources)]
    policy.write_bytes(seal(policy.read_bytes(), content))
    assert words in write_model_card(policy, scores(policy)).read_text()


@pytest.mark.parametrize(
    ("commit", "shown"), [("0123456789abcdef", "seed 0, commit 0123456 |"), ("0123456789-dirty", "0123456-dirty |")]
)
def test_a_card_names_the_commit_it_was_trained_with(policy, commit, shown):
    content = contract_of(policy)
    content["training"]["git_commit"] = commit
    policy.write_bytes(seal(policy.read_bytes(), content))
    assert shown in write_model_card(policy, scores(policy)).read_text()


def test_a_card_says_what_follows_a_pose(policy):
    content = contract_of(policy)
    content["environment"]["observer"] = {"camera": False}
    for column in content["environment"]["observation"]:
        column |= {"source": "computed", "name": "path_error[lateral]"}
    policy.write_bytes(seal(policy.read_bytes(), content))
    assert "from the slip observer's pose, without a camera" in write_model_card(policy, scores(policy)).read_text()


def test_scores_of_other_policies_are_refused(policy):
    with pytest.raises(InputError, match="about other policies than 'velocity_blind'"):
        write_model_card(policy, "# Score card: velocity_slip_aware\n")
    with pytest.raises(InputError, match=rf"about another 'velocity_blind': SHA-256 {file_hash(policy)} is not in it"):
        write_model_card(policy, SCORES)  # of a file that has since been trained anew
    assert not policy.with_suffix(".md").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["velocity_blind", "--robot", "nominal"], "--robot: of archives (.zip) only"),
        (["velocity_blind", "path_blind"], "expected one policy, got 2"),
    ],
)
def test_options_that_do_not_go_together(words, message, capsys):
    assert main(["export", *words]) == 2
    assert message in capsys.readouterr().err


def test_command_line(policy, tmp_path, capsys):
    (tmp_path / "scores").mkdir()
    assert main(["export", str(policy), "--card", str(tmp_path / "scores")]) == 2
    assert "scores: no card.json; expected a folder that wlr evaluate --out wrote" in capsys.readouterr().err
    (tmp_path / "scores" / "card.json").touch()
    (tmp_path / "scores" / "card.md").write_text(scores(policy))
    assert main(["export", str(policy), "--card", str(tmp_path / "scores")]) == 0
    card_of(policy)
    assert main(["export", str(policy), "--card", str(tmp_path / "scores"), "--out", "x.onnx"]) == 2
    capsys.readouterr()
    assert main(["export", "velocity_blind", "--card", str(tmp_path / "scores")]) == 2
    assert "the shipped policy 'velocity_blind' has its model card" in (said := capsys.readouterr().err)
    assert "--force" not in said


@pytest.mark.parametrize("name", shipped_names())
def test_every_shipped_policy_plays_in_its_environment(name):
    core = make_core(trained_environment(name) or "", 2, policy_environment(name))
    policy = make_policy(name, core.contract())
    start_episodes(core, policy, 0)
    for _ in range(10):
        actions = policy.act(core.observation)
        assert actions.shape == (2, 8)
        assert np.isfinite(actions).all()
        core.step(actions, core.everyone)
    assert not core.terminated.any()
    core.close()


@pytest.mark.parametrize("name", shipped_names())
def test_every_shipped_policy_has_its_card(name):
    text = card_of(find_policy(name))
    for place in ("/tmp", "/home", "/root", "/work", "\\Users"):
        assert place not in text
        assert f"{place}/".encode() not in find_policy(name).read_bytes()


def test_the_first_lines_of_shipped_cards_are_those_of_their_contracts():
    """What a policy sees follows from its contract: a card of an older version may say otherwise."""
    for name in shipped_names():
        path = find_policy(name)
        assert _summary(open_policy(path)[1]) in path.with_suffix(".md").read_text()
