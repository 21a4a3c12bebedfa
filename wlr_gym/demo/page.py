"""A demo: what it is made with, where its results lie, what each stage contributes, and the page: one file with all inside."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wlr_gym import __version__
from wlr_gym.base.errors import InputError
from wlr_gym.base.files import write_text
from wlr_gym.base.html import anchor, document, picture, section
from wlr_gym.base.plots import save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wlr_gym.learning.evaluation.subjects import Subject

ENVIRONMENT = "WLR-Velocity-v0"


@dataclass(frozen=True)
class Demo:
    """One demo.

    Attributes:
        out: folder of all results.
        seed: of everything random: training, episodes, commands, and what the robot hides.
        steps: environment steps to train for, all robots together.
        episodes: of each policy in the comparison.
        film_seconds: length of the film.
        run_seconds: length of each measured run.
        runs: how many of them, 3 to 4.
        further_steps: environment steps to train on for, with what was found.
        drives, drive_seconds: episodes of the old and the new policy on the robot, and their length.
    """

    out: Path
    seed: int = 0
    steps: int = 3_000_000
    episodes: int = 64
    film_seconds: float = 12.0
    run_seconds: float = 10.0
    runs: int = 4
    further_steps: int = 1_000_000
    drives: int = 8
    drive_seconds: float = 5.0

    @property
    def training(self) -> Path:
        """Run folder of the training."""
        return self.out / "run"

    @property
    def measured(self) -> Path:
        """Folder of the measured runs of the robot."""
        return self.out / "measured_runs"

    @property
    def gap(self) -> Path:
        """Folder of the gap workflow's results."""
        return self.out / "gap"

    @property
    def adapted(self) -> Path:
        """Folder of the training with what was found, and of the drives after it."""
        return self.out / "adapted"

    @property
    def hidden(self) -> Path:
        """Patch file with what the robot hides."""
        return self.out / "hidden.yaml"

    @property
    def page(self) -> Path:
        """The page."""
        return self.out / "demo.html"


#: Told of what is going on and of the share of the stage that is done.
Tell = Callable[[str, float], None]
#: Verdicts of a section: what it set out to show was shown, was not tried, was not shown, or something went wrong.
SHOWN, SKIPPED, NOT_SHOWN, FAILED = "shown", "skipped", "not shown", "failed"
#: Verdict, from best to worst -> its mark, its colour, and what is said where there is no headline.
_VERDICTS = {
    SHOWN: ("✓", "#2e7d32", ""),
    SKIPPED: ("-", "#8a6d00", "Left out."),
    NOT_SHOWN: ("✗", "#8a6d00", "Not shown."),
    FAILED: ("✗", "#b03030", "Failed."),
}


@dataclass(frozen=True)
class Section:
    """What a stage has found.

    Attributes:
        title: of the section.
        headline: one sentence for the top of the page; empty = none.
        html: what stands below the title.
        verdict: one of the four above.
        caveats: what the numbers do not speak for, in clauses.
    """

    title: str
    headline: str
    html: str
    verdict: str = SHOWN
    caveats: Sequence[str] = ()


@dataclass(frozen=True)
class DemoStage:
    """One stage.

    Attributes:
        title: of its section.
        work: does it.
        share: of the time of its worker.
        needs: (package, extra) it cannot do without.
    """

    title: str
    work: Callable[[Demo, Tell], Section]
    share: float
    needs: tuple[tuple[str, str], ...] = ()


def paragraph(text: str) -> str:
    """Return text as a paragraph."""
    return f"<p>{escape(text)}</p>"


def link(demo: Demo, path: Path, text: str) -> str:
    """Return a link to a file or folder beside the page."""
    target = path.relative_to(demo.page.parent).as_posix()
    return f'<a href="{escape(target)}{"/" if path.is_dir() else ""}">{escape(text)}</a>'


def filmed(
    path: Path,
    demo: Demo,
    subjects: Sequence[Subject],
    seconds: float,
    keywords: Mapping[str, Any],
    caption: str,
    **options: Any,
) -> str:
    """Film two subjects beside each other and return the film for the page, or why there is none.

    Args:
        path, subjects, seconds, keywords, options: of :func:`wlr_gym.learning.evaluation.film.film_beside`. caption: below it.
    """
    from wlr_gym.learning.evaluation.conditions import FIRST_SEED
    from wlr_gym.learning.evaluation.film import film_beside
    from wlr_gym.render.view import View

    view = View(size=(400, 330), path=True)
    try:
        film_beside(path, ENVIRONMENT, subjects, FIRST_SEED + demo.seed, seconds, keywords, view=view, fps=10.0, **options)
    except InputError as error:
        return paragraph(f"No film: {error}.")
    return picture(path.stem, path.read_bytes(), caption, "image/webp")


def drawn(figure: Figure, path: Path, caption: str) -> str:
    """Save a figure as PNG, and return it for the page."""
    return picture(path.stem, save(figure, path).read_bytes(), caption)


# ---- the page --------------------------------------------------------------------------------------------------------

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
    worst = max((one.verdict for one in sections), key=list(_VERDICTS).index, default=SKIPPED)
    title = "wlr_gym: learn, drive, find what the simulator lacks, train on"
    lines = [
        f'<li>{_VERDICTS[one.verdict][0]} <a href="#{anchor(one.title)}"><b>{escape(one.title)}</b></a> '
        f"{escape(one.headline or _VERDICTS[one.verdict][2])}{_caveats(one)}</li>"
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
    body = [section(one.title, _caveats(one), one.html) for one in sections]
    return document(title, _VERDICTS[worst][1], [*header, *body, footer])


def _caveats(one: Section) -> str:
    return f'<p class="small"><b>Caveats:</b> {escape("; ".join(one.caveats))}.</p>' if one.caveats else ""
