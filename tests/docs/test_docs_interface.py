"""The public interface is documented and typed, examples and pages use no more than that; versions are those of the tasks."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from typing import Any

import pytest
from blocks import PAGES, ROOT, blocks, site_script

import wlr_gym
from wlr_gym.envs.registry import ENVIRONMENTS
from wlr_gym.envs.tasks.task import read_task


def _public(module: Any) -> dict[str, Any]:
    """What a module offers: ``__all__``, or what it defines itself without an underscore."""
    if hasattr(module, "__all__"):
        return {name: getattr(module, name) for name in module.__all__}
    found = {name: value for name, value in vars(module).items() if not name.startswith("_")}
    return {name: value for name, value in found.items() if getattr(value, "__module__", "") == module.__name__}


def test_the_table_is_that_of_the_task_files():
    text = (ROOT / "docs" / "environments.md").read_text(encoding="utf-8")
    block = text.split("<!-- environments: ")[1].split("<!-- end of environments -->")[0]
    rows = []
    for env_id, task in ENVIRONMENTS.items():
        title = env_id.rpartition("-")[0]
        rows += [f"| `{title}-{version}` | {change} |" for version, change in read_task(task).history.items()]
    assert block.splitlines()[3:] == rows


@pytest.mark.parametrize("name", site_script("pages").API.values())
def test_public_names_are_documented_and_typed(name):
    module = importlib.import_module(name)
    assert module.__doc__
    for label, value in _public(module).items():
        if inspect.isclass(value) or inspect.isfunction(value):
            assert inspect.getdoc(value), f"{name}.{label} says nothing about itself"
        if inspect.isfunction(value):
            untyped = [p for p in inspect.signature(value).parameters.values() if p.annotation is inspect.Parameter.empty]
            assert not untyped, f"{name}.{label}: {untyped}"
            assert inspect.signature(value).return_annotation is not inspect.Signature.empty, f"{name}.{label}"


def _imported(text: str) -> set[tuple[str, str]]:
    """(module, name) of all that a program imports from this library."""
    statements = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    own = [node for node in statements if str(node.module).startswith("wlr_gym")]
    return {(str(node.module), alias.name) for node in own for alias in node.names}


def test_examples_and_pages_use_what_is_public():
    modules = {"wlr_gym", *site_script("pages").API.values()}
    programs = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "examples").glob("*.py")}
    for page in PAGES:
        found = [block.text for block in blocks(page) if block.language == "python"]
        programs[page.name] = "\n".join(found)
    used = {(name, *pair) for name, text in programs.items() for pair in _imported(text)}
    assert len(used) > 30
    for name, module, label in sorted(used):
        if f"{module}.{label}" in modules or (module, label) == ("wlr_gym.cli", "main"):
            continue
        assert module in modules, f"{name}: {module} is no page of the Python interface"
        listed = getattr(importlib.import_module(module), "__all__", [label])
        assert label in listed, f"{name}: {module}.{label} is not public"
        assert not label.startswith("_"), f"{name}: {module}.{label} is not public"


def test_roles_of_docstrings_are_links_on_the_site():
    shown, found = site_script("pages").on_page_content, set()
    for path in (ROOT / "wlr_gym").rglob("*.py"):
        found |= set(re.findall(r":[a-z]+:`[^`]+`", path.read_text(encoding="utf-8")))
    assert len(found) > 100
    for role in found:
        kind, name, _ = role.split("`")
        assert kind not in shown(f"<p>{kind}<code>{name}</code></p>"), role


def test_formulas_are_mathml_on_the_site():
    pytest.importorskip("latex2mathml")
    page = (ROOT / "docs" / "derivation.md").read_text(encoding="utf-8")
    shown = site_script("pages").on_page_markdown(page)
    assert "$" not in shown
    assert shown.count('display="block"') == page.count("$$") // 2
    assert site_script("pages").on_page_markdown("`$WLR_GYM_CACHE`, else `$HOME`") == "`$WLR_GYM_CACHE`, else `$HOME`"


def test_the_package_says_that_it_is_typed():
    assert (ROOT / "wlr_gym" / "py.typed").is_file()
    assert wlr_gym.__doc__
