"""The Dockerfile, which is not built where tests run: what it says, and that it says so."""

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "Dockerfile").read_text(encoding="utf-8")
INSTRUCTIONS = [line.split(maxsplit=1) for line in TEXT.replace("\\\n", " ").splitlines() if line and line[0] != "#"]


def values(name):
    return [rest for instruction, rest in INSTRUCTIONS if instruction == name]


def test_its_first_comment_and_the_docs_say_that_it_was_not_built():
    assert TEXT.startswith("# NOT BUILT HERE")
    assert "not built here" in (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")


def test_it_runs_without_root():
    names = [instruction for instruction, _ in INSTRUCTIONS]
    assert values("USER") == ["1000"]
    assert names.index("USER") < names.index("ENTRYPOINT")
    assert all(k < names.index("USER") for k, name in enumerate(names) if name == "RUN")


def test_its_python_and_extras_are_those_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (image,) = values("FROM")
    version = re.fullmatch(r"python:(\d\.\d+)-slim-bookworm", image)
    assert version is not None
    assert f"Programming Language :: Python :: {version[1]}" in project["classifiers"]
    (extras,) = re.findall(r'"\.\[([\w,]+)\]"', TEXT)
    assert set(extras.split(",")) <= set(project["optional-dependencies"])


def test_hadolint_finds_nothing():
    if (hadolint := shutil.which("hadolint")) is None:
        pytest.skip("hadolint is not installed; CI has it")
    subprocess.run([hadolint, str(ROOT / "Dockerfile")], check=True)
