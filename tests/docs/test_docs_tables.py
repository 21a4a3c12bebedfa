"""The tables that are made (.ci/docs/tables.py): each has its place and its file, and commands print what they say."""

from __future__ import annotations

import re
from collections import Counter

import pytest
from blocks import PAGES, ROOT, site_script

from studies.bench.blind.cases import case
from studies.bench.gap import make_data, read_answers
from wlr_gym.cli import main
from wlr_gym.envs.registry import ENVIRONMENTS

tables, pages = site_script("tables"), site_script("pages")


def words(text: str) -> str:
    """Text without the marks of Markdown, reStructuredText and tables."""
    return " ".join(re.sub(r"[`|\\]", " ", text).split())


def rows(name: str) -> list[list[str]]:
    """Cells of a table's rows, without its heads."""
    lines = [re.split(r"(?<!\\)\|", line)[1:-1] for line in tables.TABLES[name]() if line.startswith("|")]
    rules = [k for k, line in enumerate(lines) if set("".join(line)) <= set("- ")]
    return [line for k, line in enumerate(lines) if k not in rules and k + 1 not in rules]


def test_every_table_has_its_place():
    found = Counter(name for page in PAGES for name in pages.TABLE.findall(page.read_text(encoding="utf-8")))
    assert found == dict.fromkeys(tables.TABLES, 1)


def test_the_files_are_those_that_the_script_writes():
    assert {path.name: path.read_text(encoding="utf-8") for path in tables.FOLDER.iterdir()} == tables.table_files()


@pytest.mark.slow
@pytest.mark.parametrize("name", tables.TABLES)
def test_the_site_has_whole_rows(name):
    lines = [line for line in tables.TABLES[name]() if line.startswith("|")]
    assert len(lines) > 2 or name == "machines"  # a list
    for block in "\n".join(tables.TABLES[name]()).split("\n\n"):
        inner = [len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines() if line.startswith("|")]
        assert len(set(inner)) <= 1
    assert tables.TABLES[name]()[0] in pages.on_page_markdown(f"<!-- table: {name} -->\n[Its name](tables/{name}.md)")


@pytest.mark.slow
def test_the_seeds_of_the_answers_give_the_data_they_are_about(tmp_path):
    """Four sets, spread over all; from the first of the version that was scored."""
    answers = read_answers(tables.ANSWERS)
    names = sorted(answers)
    first = int(names[0].removeprefix("set_"))
    for name in names[:: max(1, len(names) // 4)]:
        one = case(int(name.removeprefix("set_")) - first, first)
        assert make_data(tmp_path / name, one) == answers[name]["blind_test"]["data_sha256"], name


def test_the_page_names_what_the_acceptance_test_refuses():
    page = (ROOT / "docs" / "policies.md").read_text(encoding="utf-8").partition("\n## Acceptance")[2].partition("\n## ")[0]
    refused = [row for row in rows("acceptance") if row[-1].strip() == "no"]
    assert refused
    for policy, _, _, floors, *_, bound, _ in refused:
        assert all(word in page for word in (policy.strip(), f"`{floors.strip()}`", bound.strip())), policy


def test_wlr_effects_prints_the_library(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert main(["effects"]) == 0
    text = "".join(words(capsys.readouterr().out).split())
    for name, _, law, _, where in rows("effects"):
        assert "".join(words(law).split()) in text, name
        assert where.strip() in text


def test_wlr_effects_of_a_name_prints_its_numbers(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    for name, _, _, parameters, _ in rows("effects"):
        assert main(["effects", words(name)]) == 0
        lines = [words(line) for line in capsys.readouterr().out.splitlines()]
        for parameter, unit, plausible in re.findall(r"`(\w+)` ([^[]*)(\[[^]]*\])", parameters):
            assert any(line.startswith(parameter) and unit.strip() in line and plausible in line for line in lines), parameter


def test_wlr_effects_unknown_effect_prints_what_formulas_are_made_of(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    assert main(["effects", "unknown_effect"]) == 0
    text = words(capsys.readouterr().out)
    for names, unit, meaning in rows("coordinates"):
        assert "".join(words(f"{names} {unit} {meaning}").split()) in "".join(text.split())
    for row in rows("features"):
        assert words(" ".join(row)) in text


def test_wlr_record_lists_the_motions(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    assert main(["record", "--list"]) == 0
    text = words(capsys.readouterr().out)
    assert all(words(" ".join(row[1:])) in text for row in rows("motions"))


def test_wlr_envs_prints_the_terms(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    text = ""
    for env_id in ENVIRONMENTS:
        assert main(["envs", env_id]) == 0
        text += words(capsys.readouterr().out)
    for name in ("terms", *tables.all_tasks()):
        for row in rows(name):
            assert words(row[0]) in text
            assert words(row[-1]) in text


@pytest.mark.parametrize("name", ["nominal", "wide", *tables.PRESETS])
def test_wlr_envs_prints_what_is_drawn(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert main(["envs", "WLR-Velocity-v0", "--randomization", name]) == 0
    text = words(capsys.readouterr().out)
    found = rows(name) if name in tables.TABLES else [row[1:] for row in rows("presets") if words(row[0]) == name]
    assert found
    for events, _, *rest in found:
        assert words(" ".join(rest)) in text, events
        assert all(event in text for event in words(events).split(", "))
