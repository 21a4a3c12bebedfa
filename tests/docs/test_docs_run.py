"""Every code block of README.md and docs/ is run, page by page, or says why not."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from blocks import PAGES, ROOT, blocks, run_page

#: Page -> number of its blocks that nothing runs; each says why. All others are run.
NOT_RUN = {
    "docs/camera.md": 1,  # a camera
    "docs/evaluation.md": 1,  # runs of one training with several seeds
    "docs/gap.md": 5,  # minutes each; the quickstart has one
    "docs/gap_benchmark.md": 1,  # hours
    "docs/paper.md": 1,  # minutes
    "docs/pictures.md": 1,  # a window
    "docs/own_robot.md": 4,  # examples/own_robot.py goes the same way
    "docs/own_logs.md": 2,  # logs of somebody else's
    "docs/policy_file.md": 1,  # an archive of somebody else's
    "docs/own_rig.md": 2,  # examples/linear_axis.py goes the same way
    "docs/quickstart.md": 2,  # installation
    "docs/randomization.md": 1,  # the result of an analysis
    "docs/driving.md": 1,  # a robot
    "docs/emulator.md": 1,  # until Ctrl-C
    "docs/robot.md": 1,  # a robot
    "docs/sweep.md": 1,  # a cluster
    "docs/vision.md": 4,  # installation, pictures, a film, a photograph
}
#: Pages whose blocks take longest; the slow suite runs them.
LONG = {
    "README.md",
    *(f"docs/{name}.md" for name in ("camera", "commissioning", "compare", "driving", "learning", "pictures")),
    *(f"docs/{name}.md" for name in ("quickstart", "run_format", "sweep")),
}
BLOCKS = [block for page in PAGES for block in blocks(page)]


def _pages(*marks: str) -> list[Path]:
    return [page for page in PAGES if any(block.mark in marks for block in blocks(page))]


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _run(page: Path, request: pytest.FixtureRequest, *, slow: bool) -> None:
    chosen = [block for block in blocks(page) if not block.mark or (slow and block.mark == "slow")]
    drawn = (".render()", "wlr_gym.render", "--video", "robot show")
    if any(word in block.text for block in chosen for word in drawn):
        request.getfixturevalue("graphics")  # skips where there is no OpenGL
    run_page(page, slow=slow)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if _name(page) in LONG else [], id=_name(page))
        for page in _pages("")
        if page.name != "extending.md" and not (_name(page) in LONG and page in _pages("slow"))  # whole: below
    ],
)
def test_page_runs(page, workplace, request):
    """docs/extending.md: test_docs_extending.py."""
    _run(page, request, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", _pages("slow"), ids=_name)
def test_page_runs_with_what_takes_long(page, workplace, request):
    _run(page, request, slow=True)


def test_what_is_not_run_says_why():
    found = [block for block in BLOCKS if block.mark == "not run"]
    assert Counter(_name(block.page) for block in found) == NOT_RUN
    assert all(len(block.words) > 5 for block in found)


def test_every_other_block_can_be_run():
    for block in BLOCKS:
        assert block.mark or block.language in ("python", "bash"), f"{block}: '{block.language}': say what it is for"


def test_tests_that_marks_name_exist():
    for block in BLOCKS:
        if block.mark == "checked by":
            assert block.page.name in (ROOT / block.words).read_text(encoding="utf-8"), f"{block}: {block.words}"
        for path in [word.strip("();,") for word in block.words.split() if word.strip("();,").startswith(("tests/", "docs/"))]:
            assert (ROOT / path).is_file(), f"{block}: {path}"
