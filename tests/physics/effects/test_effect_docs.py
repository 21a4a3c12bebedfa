"""docs/effects.md says what the code does, and its examples work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from wlr_gym.physics.codegen.expression import UNITS
from wlr_gym.physics.effects import EFFECTS, load_patch

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("number", range(len(re.findall("```yaml", TEXT))))
def test_yaml_examples_load(number):
    assert load_patch(yaml.safe_load(re.findall("```yaml\n(.*?)```", TEXT, re.S)[number])).effects


def test_ready_patches_and_units_are_all_named():
    text = " ".join(TEXT.split())
    assert f"`configs/effects/`: {', '.join(f'`{path.stem}`' for path in ready_patches())}." in text
    assert f"SI symbols without prefixes ({', '.join(UNITS)})" in text


def test_prose_names_only_effects_and_parameters_that_exist():
    prose = TEXT.split("## Conventions")[1].split("## Patch files")[0]
    known = {*EFFECTS, *(parameter for effect in EFFECTS.values() for parameter in effect.parameters), "cam_yaw", "mu"}
    assert [name for name in re.findall(r"`([a-z_]+)`", prose) if name not in known] == []


def ready_patches() -> list[Path]:
    return sorted((ROOT / "configs" / "effects").glob("*.yaml"))
