"""Building blocks of HTML reports. Texts are escaped here; ``parts`` are HTML already."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape

_STYLE = """
html { font-size: 16px; }
body { font: 1rem/1.5 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; color: #1c1c1c; background: #fff;
  max-width: 62rem; margin: 2rem auto; padding: 0 1.2rem; }
header { border-left: .5rem solid var(--verdict); padding: .2rem 0 .2rem 1.1rem; margin-bottom: 1.6rem; }
header .label { color: var(--verdict); font-weight: 600; margin: 0; }
h1 { font-size: 1.45rem; line-height: 1.35; margin: .2rem 0 .4rem; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .6rem; padding-bottom: .2rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
.small, figcaption, footer { color: #555; font-size: .86rem; }
.figures { display: flex; flex-wrap: wrap; gap: .8rem; padding: 0; }
.figures li { list-style: none; border: 1px solid #ddd; border-radius: .3rem; padding: .5rem .9rem; min-width: 8rem; }
.figures b { display: block; font-size: 1.35rem; font-weight: 600; }
.scroll { overflow-x: auto; margin: .6rem 0 1rem; }
table { border-collapse: collapse; font-size: .86rem; }
th, td { text-align: left; vertical-align: top; padding: .22rem .8rem .22rem 0; border-bottom: 1px solid #e4e4e4; }
th { font-weight: 600; border-bottom: 1px solid #888; }
.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
th.n { white-space: normal; }
tr.selected td { font-weight: 600; background: #eaf1fa; }
tr.fatal td { background: #fdecea; }
code, pre { font: .86rem/1.45 ui-monospace, "Cascadia Mono", Menlo, Consolas, monospace; }
code { overflow-wrap: anywhere; }
pre { background: #f4f4f4; padding: .7rem .9rem; white-space: pre-wrap; overflow-wrap: anywhere; }
figure { margin: 1rem 0; break-inside: avoid; }
img { max-width: 100%; height: auto; }
summary { cursor: pointer; }
@page { margin: 15mm; }
@media print {
  html { font-size: 9pt; }
  body { max-width: none; margin: 0; }
  h2, h3 { break-after: avoid; }
  tr { break-inside: avoid; }
  .scroll { overflow-x: visible; }
}
"""


def document(title: str, colour: str, parts: Sequence[str]) -> str:
    """Return the whole page; ``colour`` marks the verdict."""
    head = [
        '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(title)}</title>",
        f"<style>:root {{ --verdict: {colour}; }}{_STYLE}</style>",
    ]
    body = [part for part in parts if part]
    lines = ["<!DOCTYPE html>", '<html lang="en">', "<head>", *head, "</head>", "<body>", *body, "</body>", "</html>"]
    return "\n".join(lines) + "\n"


def section(title: str, *parts: str) -> str:
    """Return a titled section that :func:`anchor` names, or nothing if all parts are empty."""
    shown = [part for part in parts if part]
    opened = [f'<section id="{anchor(title)}">', f"<h2>{escape(title)}</h2>"]
    return "\n".join([*opened, *shown, "</section>"]) if shown else ""


def anchor(title: str) -> str:
    """Return what a link to a section of this title ends with, after the ``#``."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def heading(text: str) -> str:
    """Return a heading within a section."""
    return f"<h3>{escape(text)}</h3>"


def table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], numeric: Iterable[int] = (), classes: Sequence[str] = ()
) -> str:
    """Return a table, or nothing without rows; where it is wider than the page, it scrolls, and the page does not.

    Args:
        headings, rows: texts.
        numeric: columns that stand right.
        classes: of each row; empty = none.
    """
    if not rows:
        return ""
    right = set(numeric)
    body = [_row("td", row, right, name) for row, name in zip(rows, classes or [""] * len(rows), strict=True)]
    head = ["<thead>", _row("th", headings, right), "</thead>"]
    return "\n".join(['<div class="scroll">', "<table>", *head, "<tbody>", *body, "</tbody>", "</table>", "</div>"])


def _row(tag: str, cells: Sequence[str], right: set[int], name: str = "") -> str:
    inner = [f"<{tag}{_class('n' if k in right else '')}>{escape(cell)}</{tag}>" for k, cell in enumerate(cells)]
    return f"<tr{_class(name)}>{''.join(inner)}</tr>"


def _class(name: str) -> str:
    return f' class="{name}"' if name else ""


def folded(summary: str, content: str) -> str:
    """Return what is shown on a click; nothing without content."""
    return f"<details><summary>{escape(summary)}</summary>\n{content}\n</details>" if content else ""


def commands(lines: Sequence[str]) -> str:
    """Return lines to type."""
    return f"<pre>{escape(chr(10).join(lines))}</pre>"


def picture(name: str, data: bytes, caption: str = "", media: str = "image/png") -> str:
    """Return a picture or film inside the page, with its caption."""
    source = f"data:{media};base64,{base64.b64encode(data).decode('ascii')}"
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f'<figure><img alt="{escape(name)}" src="{source}">{below}</figure>'


def pictures_of(kind: str, pictures: Mapping[str, bytes], caption: str) -> str:
    """Return the pictures named ``kind`` or ``kind_1``, ``kind_2``, ... inside the page, the caption under the last."""
    chosen = [name for name in pictures if name == kind or name.startswith(f"{kind}_")]
    return "\n".join(picture(name, pictures[name], caption if name == chosen[-1] else "") for name in chosen)
