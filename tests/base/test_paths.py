"""Configs are found by name or path; what is none is refused as what it is."""

import re
import shlex

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config, named_in
from wlr_gym.hardware.camera.reading import load_camera_file
from wlr_gym.hardware.config import load_hardware
from wlr_gym.robot import load_robot

HARDWARE = find_config("hardware", "nominal").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "folder",
            "folder: is a folder; expected a .yaml file, or a name in configs/robot/: emanual, flow, kit, nominal, paper",
        ),
        ("folder.yaml", "folder.yaml: is a folder; expected a .yaml file"),
        ("run_01.parquet", "run_01.parquet: expected a .yaml file, or a name in configs/robot/"),
        ("/dev/null", "/dev/null: expected a .yaml file"),
        ("mine.yml", "robot config: no file 'mine.yml'"),
        ("thiner.yaml", "robot config: no file 'thiner.yaml' (did you mean 'thinner.yaml'?)"),
        ("emanul.yaml", "robot config: no file 'emanul.yaml'"),
    ],
)
def test_what_is_no_config(tmp_path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    for folder in ("folder", "folder.yaml"):
        (tmp_path / folder).mkdir()
    for file in ("run_01.parquet", "nb.yaml", "thinner.yaml"):
        (tmp_path / file).touch()
    with pytest.raises(InputError, match=f"^{re.escape(words)}") as caught:
        find_config("robot", name)
    assert "nb.yaml" not in str(caught.value)


def test_a_name_in_a_file_is_told_with_the_file(tmp_path):
    file = tmp_path / "mine.yaml"
    for name, words in (
        ("emanul", r"unknown robot config 'emanul' \(did you mean 'emanual'\?\)"),
        ("lab/x.yaml", "robot config: no file"),
    ):
        file.write_text(re.sub(r"^robot:.*$", f"robot: {name}", HARDWARE, flags=re.MULTILINE))
        with pytest.raises(InputError, match=rf"mine\.yaml: robot: {words}"):
            load_hardware(file)
    file.write_text("base: nomnal\nname: mine\n")
    with pytest.raises(InputError, match=r"mine\.yaml: base: unknown robot config 'nomnal'"):
        load_robot(file)
    file.write_text("body: bodi\n")
    with pytest.raises(InputError, match=r"mine\.yaml: body: unknown vision config 'bodi'"):
        load_camera_file(file)


def test_a_file_of_the_other_kind():
    with pytest.raises(InputError, match=r"nominal\.yaml: a hardware file; expected a robot file"):
        load_robot(find_config("hardware", "nominal"))
    with pytest.raises(InputError, match=r"nominal\.yaml: a robot file; expected a hardware file"):
        load_hardware(find_config("robot", "nominal"))


# ---- ~ is the user's home, whoever names the path ---------------------------------------------------------------------


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home with a space and an umlaut in its name, seen from another folder."""
    folder = tmp_path / "my hömé" / ("long" * 30)
    folder.mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setenv("HOME", str(folder))
    yield folder
    assert not (tmp_path / "elsewhere" / "~").exists()


def test_a_command_expands_home_where_the_shell_does_not(home):
    from wlr_gym.cli import main

    assert main(["record", "--excitation", "straight", "--seconds", "0.2", "--commands-only", "--out=~/runs"]) == 0
    assert [path.name for path in (home / "runs").iterdir() if path.suffix == ".csv"] == ["straight.csv"]


def test_configs_and_yaml_expand_home(home):
    nominal = find_config("robot", "nominal")
    (home / "mine.yaml").write_text(nominal.read_text(encoding="utf-8"), encoding="utf-8")
    assert load_robot("~/mine.yaml") == load_robot("nominal")
    assert named_in("any/config.yaml", "~/mine.yaml") == home / "mine.yaml"


def test_python_expands_home(home):
    from wlr_gym.data.runs import read_dataset
    from wlr_gym.learning.training import resume_training
    from wlr_gym.policy.agents import find_policy

    for ask in (resume_training, find_policy, read_dataset):
        (home / "run").mkdir(exist_ok=True)
        with pytest.raises(InputError) as told:
            ask("~/run")
        assert "no such" not in str(told.value)  # it looked there, and found an empty folder


def test_commands_in_messages_can_be_pasted(home):
    from wlr_gym.base.files import require_empty

    (home / "a file").touch()
    with pytest.raises(InputError) as told:
        require_empty(home, "wlr train")
    assert shlex.split(str(told.value).partition("resume what is there: ")[2]) == ["wlr", "train", "--resume", str(home)]
