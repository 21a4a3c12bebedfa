"""docs/randomization.md says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from wlr_gym.envs.registry import ENVIRONMENTS
from wlr_gym.envs.tasks import load_randomization
from wlr_gym.envs.tasks.entries import AreaConfig, EventConfig
from wlr_gym.robot import load_robot

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "randomization.md").read_text(encoding="utf-8")
ENVIRONMENTS_PAGE = (ROOT / "docs" / "environments.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ENVIRONMENTS.values())
def test_every_environment_has_its_picture(name):
    assert f"(figures/environment_{name}.png)" in ENVIRONMENTS_PAGE
    assert (ROOT / "docs" / "figures" / f"environment_{name}.png").is_file()


def test_every_preset_is_named():
    section = TEXT.split("## Presets")[1].split("![")[0]
    shipped = {path.stem for path in (ROOT / "configs" / "randomization").glob("*.yaml")}
    assert set(re.findall(r"^\| `(\w+)`", section, re.M)) == shipped


def test_every_key_of_an_event_is_explained():
    section = TEXT.split("| key of an event |")[1].split("## From a gap result")[0]
    for key in (*EventConfig.model_fields, *AreaConfig.model_fields):
        assert f"`{key}`" in section, key


def test_the_examples_load(tmp_path):
    late, copy, whole = re.findall("```yaml\n(.*?)```", TEXT, re.S)
    (tmp_path / "mine.yaml").write_text(copy)
    assert load_robot(tmp_path / "mine.yaml").tolerances["body.com_offset"].legs == 0.003
    late, whole = yaml.safe_load(late), yaml.safe_load(whole)
    delay = load_randomization(late, load_robot()).config.events["command_delay"]
    assert (delay.low, delay.high) == (0.0, 0.03)
    events = load_randomization(whole, load_robot()).config.events
    assert (events["floor_friction"].low, events["floor_friction"].high) == (0.2, 0.9)
    assert "body_mass" not in events
    assert {"wear", "gust", "wet_strip"} < set(events)


def test_the_recording_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    example = re.findall("```python\n(.*?)```", TEXT, re.S)[-1]
    names: dict = {}
    exec("import gymnasium as gym, wlr_gym\n" + example, names)
    assert names["again"]["pos_leg_lf"].tolist() == names["run"]["pos_leg_lf"].tolist()
    assert (tmp_path / "runs" / "run_01.simulation.yaml").is_file()
