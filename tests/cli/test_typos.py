"""Mistakes that a newcomer makes: one line that names what was wrong, what was expected, and the nearest valid name."""

import re

import gymnasium
import pytest
import yaml

from wlr_gym.cli import main

COMMANDS = {
    "a command": ("trian", "unknown command 'trian' (did you mean 'train'?)"),
    "a command of a command": ("robot shwo", "unknown command of wlr robot 'shwo' (did you mean 'show'?)"),
    "a command beside what a command takes": ("vision chek", "unknown word 'chek' (did you mean 'check'?)"),
    "a policy to look at": ("doctor velocity_blnd --emulated", "did you mean 'velocity_blind'?"),
    "a policy to start from": ("train --init nopolicy", "nor a shipped policy; shipped: path_blind"),
    "a policy on an emulated robot": ("deploy pidd --env WLR-Path-v0 --emulated", "did you mean 'pid'?"),
    "an environment of an emulated robot": ("deploy pid --env WLR-Pth-v0 --emulated", "did you mean 'WLR-Path-v0'?"),
    "a command of an emulated robot": ("deploy pid --command yaw=1 --emulated", "did you mean 'yaw_rate'?"),
    "a command out of range": (
        "deploy pid --command yaw_rate=50 --emulated",
        "--command: yaw_rate = 50: expected -0.3 to 0.3 rad/s",
    ),
    "an option": ("evaluate pid --epsiodes 3", "Unrecognized options: --epsiodes, 3 Perhaps you meant: --episodes INT"),
    "one dash": ("record -list", "Unrecognized options: -list"),
    "a number in words": ("evaluate pid --episodes ten", "Error parsing --episodes:"),
    "a number below its range": ("evaluate pid --episodes -3", "--episodes -3: expected 1 or more"),
    "half a number": ("play --seconds 1,5", "could not convert string to float: '1,5'"),
    "no value": ("evaluate pid --env", "Missing value for argument '--env'. Expected 1 values."),
    "one value of two": ("play --size 640", "Missing value for argument '--size'. Expected 2 values."),
    "a value that is none": (
        "evaluate pid --sensors camra",
        "invalid choice 'camra' for argument '--sensors'. Expected one of ('",
    ),
    "what must be there": ("compare", "Missing from wlr compare: --out PATH"),
    "nothing to work on": ("gap --out x", "DATA Folder of measured runs; with --rig"),
    "no run": ("replay --out x", "RUNS A run (CSV or Parquet) or a folder of runs."),
    "several policies without a name": ("evaluate tr,nope", "policy 'tr,nope': several need a name: a=tr,nope\n"),
    "no thread": ("evaluate pid --threads 0", "--threads 0: expected 1 or more"),
    "no episodes elsewhere": ("evaluate pid --other-episodes 0", "--other-episodes 0: expected 1 or more"),
    "no step": ("compare --out x --physics-step 0", "--physics-step 0: expected more than 0 s"),
    "no time to drive": ("record --excitation straight --seconds -1 --out x", "--seconds -1: expected more than 0 s"),
    "no time to cut at": ("import . --split -3 --out x", "--split -3: expected more than 0 s"),
    "no columns of a board": (
        "calibrate camera x --square 0.02 --out x.yaml --columns 1",
        "wlr: --columns 1: expected 3 or more\n",
    ),
    "a robot of no environment": (
        "envs --robot nominl",
        "--robot nominl: name the environment too: wlr envs WLR-Velocity-v0 --robot nominl",
    ),
    "nothing to check": ("effects check", "wlr: give the patch files to check: wlr effects check FILE ..."),
    "no policy": ("evaluate", "no policy given; see: wlr evaluate --help"),
    "too many words": ("envs WLR-Path-v0 WLR-Slope-v0", "Unrecognized options: WLR-Slope-v0"),
    "a value of a switch": ("evaluate pid --full=yes", "Unrecognized options: yes"),
    "a policy": ("evaluate pdi", "did you mean 'pid'?"),
    "an environment": ("train WLR-Velocty-v0", "did you mean 'WLR-Velocity-v0'?"),
    "an agent": ("train --agent pppo", "unknown agent 'pppo' (did you mean 'ppo'?)"),
    "a setting": ("train --set learning_rat=1", "did you mean 'learning_rate'?"),
    "a setting's number": ("train --set total_steps=-5", "total_steps = -5: expected more than 0"),
    "a setting of the environment": (
        "train --set environment.randomisation=wide",
        "unknown setting 'environment.randomisation' (did you mean 'randomization'?); valid: backend,",
    ),
    "no seeds": ("sweep WLR-Velocity-v0 --seeds 0", "wlr: --seeds 0: expected 1 or more\n"),
    "no steps": ("adapt velocity_blind --emulated --steps 0", "wlr: --steps 0: expected 1 or more\n"),
    "one drive": ("adapt velocity_blind --emulated --drives 1", "wlr: --drives 1: expected 2 or more\n"),
    "a setting given twice": (
        "train --set learning_rate=1 learning_rate=2",
        "setting: 'learning_rate' is given twice, 1 and 2: expected once",
    ),
    "a setting of a sweep given twice": (
        "sweep WLR-Velocity-v0 --set gamma=0.9 gamma=0.97",
        "--set: 'gamma' is given twice, 0.9 and 0.97: expected once, such as learning_rate=1e-3,2e-3",
    ),
    "a command given twice": (
        "deploy pid --command yaw_rate=0.1 yaw_rate=0.2 --emulated",
        "--command: 'yaw_rate' is given twice, 0.1 and 0.2: expected once",
    ),
    "an effect": ("effects stribek", "did you mean 'stribeck_friction'?"),
    "an effect where a patch goes": ("evaluate pid --effects backlash", "'backlash' is an effect"),
    "a robot": ("robot show nominall", "did you mean 'nominal'?"),
    "a motion": ("record --excitation strait --out x", "did you mean 'straight'?"),
    "a policy file's name": ("export velocity_blind --out z.txt", "--out z.txt: expected a file that ends in .onnx"),
    "a policy file to export": ("export velocity_blind --out z.onnx", "velocity_blind.onnx: is a policy file already: copy it"),
    "a folder without runs": ("export . --to mcap", ".: no run_*.csv or run_*.parquet"),
    "a folder without a card": (
        "export velocity_blind --card .",
        "--card .: no card.json; expected a folder that wlr evaluate --out wrote",
    ),
    "two formats": ("robot export nominal --out r.urdf --format mjcf", "a name of urdf, and --format mjcf"),
    "a robot file's name": ("robot new --out r.txt --yes", "--out r.txt: expected a file that ends in .yaml, .yml"),
    "a stream's name": ("deploy pid --emulated --mcap x.txt", "--mcap x.txt: expected a file that ends in .mcap"),
    "one plant twice": ("compare --plants mujoco mujoco --out c", "--plants mujoco mujoco: the same plant twice"),
    "a shell": ("--completion bsh", "expected one of bash, zsh, fish"),
}


@pytest.mark.parametrize(("words", "expected"), COMMANDS.values(), ids=COMMANDS)
def test_a_mistake_on_the_command_line(words, expected, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if words.startswith("train"):
        pytest.importorskip("torch")
    assert main(words.split()) == 2
    shown = capsys.readouterr()
    is_ours = shown.err.splitlines()[-1].startswith("wlr: ")
    said = shown.err if is_ours else re.sub(r"(\s|[\u2500\u2502|]|-{5,})+", " ", shown.err)  # tyro's box
    assert expected in said
    assert is_ours or f"wlr {words.partition(' ')[0]} --help" in said
    assert "Traceback" not in shown.err
    assert not shown.out.strip()
    assert not list(tmp_path.iterdir())


KEYWORDS = {
    "an option": ({"bakend": "mujoco"}, "did you mean 'backend'?"),
    "how many": ({"num_envs": 4}, "'num_envs'; several at once: gymnasium.make_vec(ID, num_envs=4); valid: backend,"),
    "a seed": ({"seed": 3}, "'seed'; it goes to env.reset(seed=3); valid: backend,"),
    "sensors": ({"sensors": "cam"}, "'sensors'; it is of the task: task={\"sensors\": {\"camera\": 1.0}}; valid: backend,"),
    "nothing like it": ({"xyzzy": 1}, "got an unexpected keyword argument 'xyzzy'; valid: backend,"),
    "no keys": ({"task": {"sensors": ["camera"]}}, "sensors = ['camera']: expected keys and values; keys: camera, flow"),
    "a simulator": ({"backend": "mujco"}, "did you mean 'mujoco'?"),
    "a precision": ({"precision": "float16"}, "unknown precision 'float16' (did you mean 'float64'?); valid: float32, float64"),
    "an effect where a patch goes": ({"effects": ["backlash"]}, "'backlash' is an effect"),
    "what an effect acts on": (
        {"effects": [{"name": "weak_motor", "where": ["wheel_fl"], "parameters": {"scale": 0.9}}]}, "did you mean 'wheel_lf'?",
    ),
    "what an effect has": (
        {"effects": [{"name": "weak_motor", "where": ["wheel_lf"], "parameters": {"scal": 0.9}}]}, "did you mean 'scale'?",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("keywords", "expected"), KEYWORDS.values(), ids=KEYWORDS)
def test_a_mistake_in_make(keywords, expected):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - InputError, or what Gymnasium makes of it
        gymnasium.make("WLR-Velocity-v0", **keywords)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            {"effects": [{"name": "weak_moter", "where": ["wheel_lf"], "parameters": {"scale": 0.9}}]},
            "did you mean 'weak_motor'?",
        ),
        ({"effect": []}, "did you mean 'effects'?"),
        ({"effects": [{"name": "weak_motor", "where": ["wheel_lf"], "parameters": {"scale": "0,9"}}]}, "scale"),
    ],
    ids=["a name", "a key", "a number"],
)
def test_a_mistake_in_a_file(content, expected, tmp_path, capsys):
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(content))
    assert main(["effects", "check", str(file)]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert str(file) in error
    assert error.count("\n") == 1
