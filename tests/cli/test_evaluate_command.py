"""``wlr evaluate``: options, files and messages."""

import importlib.util
import json

import pytest

from wlr_gym.cli import evaluate, main

SMALL = ["--episodes", "3", "--no-progress"]


@pytest.mark.slow
def test_it_writes_the_same_card_twice(tmp_path, capsys):
    arguments = ["evaluate", "constant_command", "--baselines", "do_nothing", "--blocks", "2", *SMALL, "--out"]
    assert main([*arguments, str(tmp_path / "a")]) == 0
    assert main([*arguments, str(tmp_path / "b")]) == 0
    printed = capsys.readouterr().out
    assert "yaw_rate_error" in printed
    assert "constant_command is better by" in printed
    first, second = ((tmp_path / name / "card.json").read_text() for name in "ab")
    assert first == second
    content = json.loads(first)
    assert list(content["policies"]) == ["constant_command", "do_nothing"]
    assert content["conditions"]["episodes"] == "3, in each of 2 blocks"
    files = {path.name for path in (tmp_path / "a").iterdir()}
    assert files == {
        "card.md",
        "card.json",
        "episodes.parquet",
        "samples.csv",
        "spectrum.png",
        "config.yaml",
        "provenance.yaml",
    }


def test_an_agent_is_scored_without_what_policy_files_need(monkeypatch, capsys):
    """A plain installation has no onnxruntime."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "onnxruntime" else find(name, *rest))
    assert main(["evaluate", "velocity_blind", "--episodes", "2", "--no-progress"]) == 2
    assert "onnxruntime" in capsys.readouterr().err
    assert main(["evaluate", "pid", "--episodes", "2", "--no-progress"]) == 0


@pytest.mark.slow
def test_full_means_blocks_sweeps_and_both_simulators(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "FULL_EPISODES", 2)
    monkeypatch.setattr(evaluate, "FULL_BLOCKS", 2)
    arguments = ["evaluate", "constant_command", "--full", "--baselines", "do_nothing", "--sweep", "payload", "--no-progress"]
    arguments += ["--other-episodes", "1", "--sweep-episodes", "1", "--out", str(tmp_path)]
    assert main(arguments) == 0
    content = json.loads((tmp_path / "card.json").read_text())
    assert content["conditions"]["episodes"] == "2, in each of 2 blocks"
    assert content["conditions"]["second simulator"] == "mujoco, 1 episodes"
    assert [point["at"] for point in content["sweeps"]["payload"]] == ["0", "0.25", "0.5", "1", "2"]
    assert content["other_plant"]["score_kept"]["constant_command"]["mean"] > 50.0
    assert "on both simulators" in capsys.readouterr().out


def test_a_named_policy_meets_the_controller_that_could_replace_it():
    pytest.importorskip("onnxruntime")
    options = evaluate._complete(evaluate.EvaluateOptions(("mine=velocity_blind",)))
    assert options.baselines == ("do_nothing", "pid", "slip_compensating_no_camera")


def test_what_is_left_open_is_decided_by_full():
    quick, full = (evaluate._complete(evaluate.EvaluateOptions(("pid",), full=full)) for full in (False, True))
    assert quick.baselines == ("do_nothing", "pid")
    assert (quick.episodes, quick.blocks, quick.sweep, quick.backend) == (64, 1, (), "gibbs_appell")
    assert set(full.baselines or ()) >= {"do_nothing", "constant_command", "pid", "slip_compensating"}
    assert (full.episodes, full.blocks, full.backend) == (256, 5, "both")
    assert set(full.sweep or ()) >= {"friction", "split", "floors", "latency", "payload"}
    slope = evaluate._complete(evaluate.EvaluateOptions(("pid",), full=True, env="WLR-Slope-v0", blocks=2, sweep=("slope",)))
    assert (slope.blocks, slope.sweep) == (2, ("slope",))


def test_a_baseline_that_is_the_policy_is_said_to_be_none(capsys):
    evaluate._complete(evaluate.EvaluateOptions(("pid",), baselines=("do_nothing", "pid")))
    assert capsys.readouterr().out == "no baseline, the policy itself: pid\n"
    evaluate._complete(evaluate.EvaluateOptions(("pid",), baselines=("again=pid",)))
    evaluate._complete(evaluate.EvaluateOptions(("pid",)))
    assert capsys.readouterr().out == ""


def test_a_policy_of_another_task_is_told_where_it_was_trained(capsys):
    pytest.importorskip("onnxruntime")
    words = ["--episodes", "2", "--no-progress", "--baselines"]
    assert main(["evaluate", "velocity_slip_aware", "--env", "WLR-Path-v0", *words]) == 2
    assert "'velocity_slip_aware' was trained in WLR-Velocity-v0, not WLR-Path-v0: " in capsys.readouterr().err
    assert main(["evaluate", "velocity_blind", "--env", "WLR-Slope-v0", *words]) == 2
    assert "'velocity_blind' was trained in WLR-Velocity-v0, not WLR-Slope-v0: " in capsys.readouterr().err
    assert main(["evaluate", "velocity_blind", "--robot", "flow", "--randomization", "slipery", *words]) == 2
    assert "was trained in" not in capsys.readouterr().err


def test_an_agent_before_any_training_is_noted(capsys):
    assert main(["evaluate", "a=ppo", "--episodes", "2", "--baselines", "--no-progress"]) == 0
    assert "note: 'ppo' is the agent before any training; trained ones: path_blind" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["constant_comand"], "did you mean 'constant_command'"),
        (["do_nothing", "--randomization", "wid"], "did you mean 'wide'"),
        (["do_nothing", "--env", "WLR-Velocty-v0"], "unknown environment"),
        (["do_nothing", "--blocks", "0"], "--blocks 0: expected 1 or more"),
        (["do_nothing", "--sweep", "slope"], "not for task 'velocity'"),
        (["do_nothing", "--record", "3", "--episodes", "2"], "--record 3"),
        (["do_nothing", "--video", "a.webp", "--video-seconds", "0"], "--video-seconds 0"),
        (["a=do_nothing", "--baselines", "a=pid"], "two policies are called 'a'"),
        (["do_nothing", "do_nothing"], "policy 'do_nothing' is given twice"),
        (["pid", "--accept", "--baselines", "do_nothing", "--episodes", "0"], "--episodes 0: expected 1 or more"),
        (["do_nothing", "--accept", "--baselines", "do_nothing"], "nothing to compare it with"),
    ],
)
def test_bad_input_exits_with_2(arguments, message, capsys):
    assert main(["evaluate", *arguments, "--no-progress"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("more", [[], ["--accept"]])
def test_no_sensors_and_some_are_refused_before_anything_is_written(more, tmp_path, capsys):
    words = ["evaluate", "pid", "--sensors", "none", "camera", "--out", str(tmp_path / "card")]
    assert main([*words, *more]) == 2
    assert "--sensors none camera: expected none alone, or camera, flow or both" in capsys.readouterr().err
    assert not (tmp_path / "card").exists()


@pytest.mark.parametrize("more", [(), ("--accept",)], ids=["card", "acceptance"])
def test_an_interrupt_leaves_no_empty_folder(more, tmp_path, monkeypatch):
    def interrupt(*given, **named):
        assert (tmp_path / "out").is_dir()
        raise KeyboardInterrupt

    for name in ("evaluate", "accept"):
        monkeypatch.setattr(f"wlr_gym.cli.evaluate.{name}", interrupt)
    assert main(["evaluate", "pid", *more, "--out", str(tmp_path / "out")]) == 130
    assert not (tmp_path / "out").exists()
