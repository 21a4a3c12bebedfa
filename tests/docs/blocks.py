"""Code blocks of README.md and docs/, and how each is run.

A comment before a block says what else than "run it" is to be done with it:

- ``<!-- file: NAME -->``: it is the contents of that file, in the folder in which the page is run;
- ``<!-- slow -->``: run in the slow suite only;
- ``<!-- checked by tests/... -->``: that test runs it, or compares it with the code;
- ``<!-- demo-command -->``, ``<!-- test-command -->``: ``.ci/run`` runs it in a new virtual environment;
- ``<!-- not run: REASON -->``: nothing runs it.
"""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from studies.bench.__main__ import main as bench
from studies.paper.__main__ import main as paper
from wlr_gym.cli import main

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(r"^(?:<!-- (?P<mark>[^\n]*?) -->\n)?```(?P<language>\w*)\n(?P<text>.*?)^```", re.S | re.M)
_MARK = re.compile(r"(file|slow|checked by|not run|demo-command|test-command)(?:: | |$)(.*)")

#: Programs that pages run -> function.
PROGRAMS = {"wlr": main, "python -m studies.bench": bench, "python -m studies.paper": paper}
#: Words of a command -> options that make it small enough for a test, added to its own.
SMALLER = {
    "train": "--max-minutes 0.02 --no-progress",
    "sweep": "--seeds 1 --set total_steps=16_384 evaluation_episodes=4",
    "evaluate": "--episodes 2 --blocks 1 --sweep-episodes 1 --other-episodes 1 --video-seconds 0.1 --no-progress",
    "evaluate --full": "--sweep friction",
    "play": "--seconds 0.2 --size 96 64",
    "deploy": "--seconds 0.5 --yes --no-status",
    "compare": "--seconds 1 --no-plots",
    "python -m studies.bench": "--quick --rounds 1",
    "record": "--seconds 4",
    "python -m studies.paper": "--plant gibbs_appell --draws 0",
}


def site_script(name: str) -> ModuleType:
    """Return a script of ``.ci/docs``, loaded as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / ".ci" / "docs")  # as mkdocs does: scripts import each other
        spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Block:
    """One code block: where it stands, its language, its text, and its mark with the words after it."""

    page: Path
    line: int
    language: str
    text: str
    mark: str = ""
    words: str = ""

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """Its lines, comments cut off; a line that ends in a backslash goes on."""
        joined = self.text.replace("\\\n", " ")
        lines = [re.split(r"\s{2,}#|\s#\s", line)[0].strip() for line in joined.splitlines()]
        return [line for line in lines if line and not line.startswith("#")]


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page that are no plain text."""
    text, found = page.read_text(encoding="utf-8"), []
    for match in _BLOCK.finditer(text):
        if match["language"] == "text":
            continue
        mark = _MARK.fullmatch(match["mark"] or "")
        kind, words = mark.groups() if mark else ("", "")
        line = text[: match.start("language")].count("\n") + 1
        found.append(Block(page, line, match["language"], match["text"], kind, words))
    return found


def run_page(page: Path, *, slow: bool, smaller: bool = True) -> dict[str, Any]:
    """Run a page's blocks in order in the present folder; return the names its Python blocks leave.

    ``smaller`` adds options that shorten commands; without it they run as they are printed.
    """
    names: dict[str, Any] = {"__name__": page.stem}
    found = blocks(page)
    for block in found:
        if block.mark == "file":
            Path(block.words).write_text(block.text, encoding="utf-8")
    for block in found:
        if not block.mark or (slow and block.mark == "slow"):
            run_block(block, names, smaller=smaller)
    return names


def run_block(block: Block, names: dict[str, Any], *, smaller: bool = True) -> None:
    """Run one block: Python in ``names``, or commands, each of which must end well."""
    if block.language == "python":
        exec(compile("\n" * block.line + block.text, str(block.page), "exec"), names)
        return
    assert block.language == "bash", f"{block}: a block of '{block.language}' cannot be run"
    for command in block.commands:
        assert run_command(command, smaller=smaller) == 0, f"{block}: {command}"


def run_command(command: str, *, smaller: bool = True) -> int:
    """Run ``wlr ...``, or a study, in this process; return its exit code."""
    program, words = program_of(command)
    assert program in PROGRAMS, f"{command}: only {', '.join(PROGRAMS)} are run here"
    fitting = [options for key, options in SMALLER.items() if key == program or set(key.split()) <= set(words)]
    return PROGRAMS[program](laid_over(words, " ".join(fitting).split() if smaller else []))


def program_of(command: str) -> tuple[str, list[str]]:
    """Return what a command runs, and the words behind it; ``python -m MODULE`` is a program."""
    program, *words = shlex.split(command)
    if words[:1] == ["-m"]:
        program, words = f"{program} -m {words[1]}", words[2:]
    return program, words


def laid_over(words: Sequence[str], more: Sequence[str]) -> list[str]:
    """Return the words of a command without the options, and their values, that ``more`` gives, and ``more``."""
    kept, skipped = [], False
    for word in words:
        skipped = word in more if word.startswith("--") else skipped
        if not skipped:
            kept.append(word)
    return [*kept, *more]
