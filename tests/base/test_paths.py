"""Configs are found by name or path; what is none is refused as what it is."""

import re

import pytest

from wlr_gym.base.errors import InputError
from wlr_gym.base.paths import find_config
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
