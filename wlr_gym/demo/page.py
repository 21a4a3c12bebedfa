"""The page: one HTML file with everything inside."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from wlr_gym import __version__
from wlr_gym.base.files import write_text
from wlr_gym.base.html import anchor, document, section
from wlr_gym.demo.stage import FAILED, NOT_SHOWN, SHOWN, SKIPPED, Demo, Section, link

_MARKS = {SHOWN: "✓", NOT_SHOWN: "✗", SKIPPED: "-", FAILED: "✗"}
_COLOURS = {SHOWN: "#2e7d32", NOT_SHOWN: "#8a6d00", SKIPPED: "#8a6d00", FAILED: "#b03030"}
#: From best to worst: the page has the colour of its worst section.
_ORDER = (SHOWN, SKIPPED, NOT_SHOWN, FAILED)
#: What may lie beside the page -> its name there.
_FILES = {
    "run": "training of section 1",
    "ice.webp": "film on ice",
    "measured_runs": "measured runs",
    "hidden.yaml": "hidden fault",
    "gap/report.html": "gap report",
    "gap/patch.yaml": "patch",
    "gap/result.json": "its numbers",
    "adapted/training/policy": "adapted policy",
    "trained_on.webp": "film of the adapted policy",
    "provenance.yaml": "versions and machine",
    "log.txt": "log",
}
#: Terms of the page, as docs/glossary.md has them.
TERMS = {
    "tracking error": "rms of the episode's measures, each over its scale; a fall adds 10 (lower is better)",
    "excess slip": "slip beyond what a steady skid turn needs",
    "held-out runs": "runs that no fit has used",
    "noise floor": "the error that a perfect model would have, in units of sensor noise",
}
_MEASURES = "Measures here: the errors of velocity and yaw rate, each over 10 % of the range of commands."
_DOCS = (
    "Documentation, in the repository: docs/quickstart.md; docs/policies.md (sections 1 and 2); docs/gap.md (3 to 5); "
    "docs/adapt.md (6); docs/glossary.md (every term)."
)
_EMULATED = "Everything here is simulated or emulated; no hardware was driven."


def write_page(demo: Demo, sections: Sequence[Section], interrupted: bool = False) -> Path:
    """Write the page and return its path."""
    write_text(demo.page, page(demo, sections, interrupted))
    return demo.page


def page(demo: Demo, sections: Sequence[Section], interrupted: bool = False) -> str:
    """Return the page."""
    worst = max((one.verdict for one in sections), key=_ORDER.index, default=SKIPPED)
    title = "wlr_gym: learn, drive, find what the simulator lacks, train on"
    lines = [
        f'<li>{_MARKS[one.verdict]} <a href="#{anchor(one.title)}"><b>{escape(one.title)}</b></a> '
        f"{escape(one.headline or _WITHOUT[one.verdict])}{_not_good(one)}</li>"
        for one in sections
    ]
    files = [link(demo, demo.out / path, text) for path, text in _FILES.items() if (demo.out / path).exists()]
    words = f"{'. '.join(f'{term.capitalize()}: {meaning}' for term, meaning in TERMS.items())}. {_MEASURES}"
    header = [
        f'<header>\n<p class="label">wlr demo</p>\n<h1>{escape(title)}</h1>\n</header>',
        "<p><b>Stopped before it was over: the page has what was made until then.</b></p>" if interrupted else "",
        f'<ul style="list-style: none; padding: 0">{"".join(lines)}</ul>',
        f'<p class="small">Files: {", ".join(files)}.</p>' if files else "",
        *(f'<p class="small">{escape(text)}</p>' for text in (words, _DOCS, _EMULATED)),
    ]
    footer = (
        f"<footer><p>wlr_gym {escape(__version__)}, seed {demo.seed}: the same seed gives the same numbers on one machine. "
        f"Another hidden fault: <code>wlr demo --seed {demo.seed + 1}</code>.</p></footer>"
    )
    body = [section(one.title, _not_good(one), one.html) for one in sections]
    return document(title, _COLOURS[worst], [*header, *body, footer])


def _not_good(one: Section) -> str:
    return f'<p class="small"><b>Not good:</b> {escape("; ".join(one.not_good))}.</p>' if one.not_good else ""


_WITHOUT = {SHOWN: "", NOT_SHOWN: "Not shown.", SKIPPED: "Left out.", FAILED: "Failed."}
