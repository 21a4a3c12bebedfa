"""Every command in README.md and docs/ exists as written: its options parse. And every link in them leads somewhere."""

from __future__ import annotations

import re

import pytest
from blocks import PAGES, ROOT, Block, blocks, program_of

from studies.bench.__main__ import STUDIES, find_program
from studies.paper.__main__ import PaperOptions
from wlr_gym.cli import COMMANDS, parse_command
from wlr_gym.cli.options import parse

LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]+)?\)")
#: Pages that exist on the documentation site only (.ci/docs/pages.py).
MADE = ("commands.md", "api.md")


def commands(block: Block) -> list[str]:
    """Commands of a block that run ``wlr`` or a study."""
    parts = [part.strip() for line in block.commands for part in line.split("&&")]
    return [part for part in parts if part.startswith(("wlr ", "python -m studies."))]


CASES = [
    pytest.param(command, id=f"{page.stem}: {command}")
    for page in PAGES
    for block in blocks(page)
    if block.language == "bash"
    for command in commands(block)
]


def test_there_are_commands_to_check() -> None:
    assert len(CASES) > 60


@pytest.mark.parametrize("command", CASES)
def test_command_parses(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, (name, *arguments) = program_of(command)
    words = [name, *arguments]
    if program.startswith("python -m studies."):
        kind = PaperOptions if program.endswith("paper") else find_program(words)[0]
        parse(kind, program, arguments if name in STUDIES else words)
        return
    if name == "--import":
        _, name, *arguments = arguments
    assert name in COMMANDS, f"no command '{name}'"
    try:
        parse_command(name, arguments)
    except SystemExit:
        pytest.fail(capsys.readouterr().err or capsys.readouterr().out)


def test_what_the_readme_says_reproduces_a_number_exists(capsys: pytest.CaptureFixture[str]) -> None:
    table = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Measured")[2].partition("\n## ")[0]
    last_cells = [line.split("|")[-2] for line in table.splitlines() if line.startswith("| ") and "reproduce" not in line]
    commands = [re.search(r"`([^`]+)`", cell) for cell in last_cells]
    assert all(commands)
    for command in (match[1] for match in commands if match):
        if command.startswith(("wlr ", "python -m studies.")):
            test_command_parses(command, capsys)
        else:
            program, *paths = command.split()
            assert program == "pytest"
            assert all((ROOT / path).exists() for path in paths), command


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page) -> None:
    for target, _ in LINK.findall(page.read_text(encoding="utf-8")):
        if not re.match(r"https?:", target) and target not in MADE:
            assert (page.parent / target).exists(), f"{page.name}: {target}"
