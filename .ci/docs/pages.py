"""Pages of the documentation site that are made while it builds, so that they cannot fall behind the code."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tables import TABLES

if TYPE_CHECKING:
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[2]
#: Modules of the API page, in order: title -> module. They are the public interface (docs/architecture.md).
API = {
    "Environments": "wlr_gym.envs",
    "The robot as a machine": "wlr_gym.hardware",
    "Its servos": "wlr_gym.hardware.servos",
    "What is checked before it moves": "wlr_gym.hardware.safety.preflight",
    "Tasks": "wlr_gym.envs.tasks",
    "Terms of tasks": "wlr_gym.envs.tasks.terms",
    "Signals that terms are written with": "wlr_gym.envs.tasks.signals",
    "Scalar operations": "wlr_gym.physics.codegen.ops",
    "Robot": "wlr_gym.robot",
    "Parameters": "wlr_gym.robot.parameters",
    "The parameter table": "wlr_gym.robot.parameter_table",
    "Plants": "wlr_gym.physics.plants",
    "The contract of a plant": "wlr_gym.physics.plants.base",
    "Effects": "wlr_gym.physics.effects",
    "What an effect is made of": "wlr_gym.physics.effects.effect",
    "Slip": "wlr_gym.robot.slip",
    "Slip observer": "wlr_gym.perception.observer",
    "Runs": "wlr_gym.data",
    "Logs of other programs": "wlr_gym.data.logs",
    "Motions": "wlr_gym.data.excitations",
    "Plants compared": "wlr_gym.data.comparison",
    "Policies": "wlr_gym.policy",
    "Evaluation": "wlr_gym.learning.evaluation.scoring",
    "Numbers of episodes": "wlr_gym.learning.evaluation.metrics",
    "Roll-outs": "wlr_gym.learning.evaluation.rollout",
    "Recorded episodes": "wlr_gym.learning.evaluation.episode_recorder",
    "Pictures": "wlr_gym.render",
    "Vision": "wlr_gym.perception.vision",
    "Gap workflow": "wlr_gym.gap",
    "A rig of one's own": "wlr_gym.gap.rig.own",
    "Errors": "wlr_gym.base.errors",
}


#: How docstrings refer to names; rendered as links where the name is on a page.
ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):<code>~?([\w.]+)</code>")
INTRODUCTION = (
    "`import wlr_gym` registers the environments and loads nothing heavy; the names below load when they are used. What most "
    "programs need stands first, under the name that you import it by; then the packages. "
    "[Public](architecture.md#what-is-public) is what stands here, no more."
)


#: LaTeX in a page: a displayed formula, or one within the text.
FORMULA = re.compile(r"\$\$(?P<display>.+?)\$\$|\$(?P<inline>[^$\s](?:[^$]*[^$\s])?)\$", re.S)


#: Where a page has a table that is made; the link, of any text, is for readers of the repository.
TABLE = re.compile(r"<!-- table: (\w+) -->\n\[[^\]\n]+\]\(tables/\1\.md\)")


#: Tables and code are wide: the site takes more of a wide window than the theme's 61 rem.
STYLE = """.md-grid { max-width: 84rem; }
.md-typeset table:not([class]) th, .md-typeset table:not([class]) td { min-width: 0; padding: 0.5em 0.6em; }
"""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put in the tables that are made, link the pages of notebooks, and turn LaTeX into MathML."""
    linked = re.sub(r"\]\((notebooks/\w+)\.ipynb\)", r"](\1.md)", markdown)
    return mathml(TABLE.sub(lambda found: "\n".join(TABLES[found[1]]()), linked))


def mathml(markdown: str) -> str:
    """Turn LaTeX into MathML, which browsers draw without a script; only pages that display formulas have any."""
    if "$$" not in markdown:
        return markdown
    from latex2mathml.converter import convert

    def drawn(found: re.Match[str]) -> str:
        display = found["display"]
        return convert(display, display="block") if display else convert(found["inline"])

    return FORMULA.sub(drawn, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Turn the roles of docstrings into links, which are resolved when all pages are known."""

    def link(found: re.Match[str]) -> str:
        name = found.group(1)
        return f'<autoref identifier="{name}" optional><code>{name.removeprefix("wlr_gym.")}</code></autoref>'

    return ROLE.sub(link, html)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made."""
    from mkdocs.structure.files import File

    made = {
        "index.md": root_page("README.md"),
        "commands.md": command_page(),
        "api.md": api_page(),
        "changes.md": root_page("CHANGELOG.md"),
        "contributing.md": root_page("CONTRIBUTING.md"),
        "site.css": STYLE,
    }
    made |= {f"notebooks/{path.stem}.md": notebook_page(path) for path in (ROOT / "docs" / "notebooks").glob("*.ipynb")}
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


#: Links of the pages in the clone's root: file -> where it is on the site; ``None``: the clone only has it.
_ROOT_LINKS = {
    "CHANGELOG.md": "changes.md",
    "CONTRIBUTING.md": "contributing.md",
    "LICENSE": "https://opensource.org/license/mit",
    "CITATION.cff": None,
    "examples": None,
}


def root_page(name: str) -> str:
    """A page of the clone's root with its links as they are from within docs/."""
    text = re.sub(r"\]\(docs/", "](", (ROOT / name).read_text(encoding="utf-8"))
    for file, place in _ROOT_LINKS.items():
        shown = r"`\1`" if place is None else rf"[\1]({place})"
        text = re.sub(rf"\[([^\]]+)\]\({re.escape(file)}\)", shown, text)
    return text


def notebook_page(path: Path) -> str:
    """The cells of a notebook, and where to get it."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in cells]
    shown = [
        f"```python\n{text}\n```" if cell["cell_type"] == "code" else text for cell, text in zip(cells, texts, strict=True)
    ]
    title, *rest = shown[0].split("\n\n", 1)
    note = f"This page is a notebook: [{path.name}]({path.name}){{: download }}. CI runs it; run it to see what it prints."
    return "\n\n".join([title, note, *rest, *shown[1:]]) + "\n"


def command_page() -> str:
    """Every command's help text."""
    from wlr_gym.cli import COMMANDS, options_of, usage

    os.environ["COLUMNS"], os.environ["NO_COLOR"] = "80", "1"
    parts = ["# Commands", "", _block(usage())]
    for name in COMMANDS:
        parts += [f"## wlr {name}", "", _block(help_of(name))]
        own = options_of(name)
        for word in filter(None, own if isinstance(own, dict) else ()):
            parts += [f"### wlr {name} {word}", "", _block(help_of(name, word))]
    return "\n".join(parts)


def help_of(*words: str) -> str:
    """Return what ``wlr WORDS --help`` prints."""
    from wlr_gym.cli import main

    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        main([*words, "--help"])
    return re.sub(r"\x1b\[[0-9;]*m| +$", "", text.getvalue(), flags=re.MULTILINE).rstrip()


def _block(text: str) -> str:
    return f"```text\n{text}\n```\n"


def api_page() -> str:
    """What the packages offer to programs, from their docstrings."""
    import wlr_gym

    parts = ["# Python interface", "", INTRODUCTION, "", "## The names of wlr_gym", ""]
    for name, home in wlr_gym.HOMES.items():
        # under its package, if that has a section below: a name with two addresses cannot be linked
        packages = [
            one for one in API.values() if home.startswith(f"{one}.") and name in vars(import_module(one)).get("__all__", ())
        ]
        parts += [
            f"::: {(packages or [home])[0]}.{name}",
            "    options:",
            f"      heading: wlr_gym.{name}",
            f"      toc_label: {name}",
            "",
        ]
    for title, module in API.items():
        parts += [f"## {title}", "", f"::: {module}", ""]
    return "\n".join(parts)
