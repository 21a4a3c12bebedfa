"""Every command in README.md and docs/ exists as written: its options parse. And every link in them leads somewhere."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest
import tyro

from wlr_gym.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```\w*\n(.*?)^```", re.S | re.M)
LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]+)?\)")


def commands(page: Path) -> list[str]:
    """``wlr`` commands in the code blocks of a page, comments cut off."""
    lines = [line for block in BLOCK.findall(page.read_text(encoding="utf-8")) for line in block.splitlines()]
    parts = [part.strip() for line in lines for part in re.split(r"\s{2,}#|&&", line)]
    return [re.split(r"\s{2,}|\s#\s", part)[0] for part in parts if re.match(r"wlr [a-z]", part)]


CASES = [pytest.param(command, id=f"{page.stem}: {command}") for page in PAGES for command in commands(page)]


def test_there_are_commands_to_check() -> None:
    assert len(CASES) > 40


@pytest.mark.parametrize("command", CASES)
def test_command_parses(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, name, *arguments = shlex.split(command)
    assert name in COMMANDS, f"no command '{name}'"
    module = importlib.import_module(f"wlr_gym.cli.{name}")
    try:
        tyro.cli(module.Options, args=arguments)
    except SystemExit:
        pytest.fail(capsys.readouterr().err or capsys.readouterr().out)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target, _ in LINK.findall(page.read_text(encoding="utf-8")):
        if not re.match(r"https?:", target):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
