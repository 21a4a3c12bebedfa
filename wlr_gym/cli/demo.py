"""The whole loop in three and a half minutes: learn, drive on ice, find a hidden fault, train on with it; ends with one page.

A policy learns; slip-aware and blind drive on the same ice; an emulated robot with a hidden fault is driven; the gap workflow
names the fault and is checked on held-out runs; the policy trains on with what was found and drives the robot again, beside the
old one. All pictures are in the page, demo.html.

Uses two cores. Parts whose packages are not installed are left out, and the page says how to install them; Ctrl-C leaves what
was made until then.
"""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from wlr_gym.base.errors import InputError
from wlr_gym.base.files import contents, refuse_existing
from wlr_gym.base.progress import progress
from wlr_gym.base.provenance import CONFIG_FILE, record_provenance
from wlr_gym.base.settings import read_yaml
from wlr_gym.base.text import duration
from wlr_gym.cli import FAILED, INTERRUPTED, OK
from wlr_gym.cli.options import Count, ForceOption, JsonOption, ProgressOption, Seed
from wlr_gym.cli.terminal import print_json

STEPS, QUICK_STEPS = 3_000_000, 16_384
#: Sizes with --quick.
_SHORT = {
    "episodes": 4, "film_seconds": 0.4, "run_seconds": 3.2, "runs": 3, "further_steps": 32_768, "drives": 2,
    "drive_seconds": 1.0,
}  # fmt: skip


@dataclass(frozen=True)
class DemoOptions(ProgressOption, JsonOption, ForceOption):
    out: Path = Path("out/demo")
    """Folder for the page and everything it was made from; --force replaces a demo that is in it."""
    seed: Seed = 0
    """Seed of everything random: training, episodes, and the hidden fault."""
    steps: Count | None = None
    """Environment steps to train for, all robots together; default: three million."""
    quick: bool = False
    """Everything as short as can be, to see that it works: nothing is learnt, and nothing need be found."""


def run(options: DemoOptions) -> int:
    """Run all stages, write the page; the path of the page is the last line.

    Raises:
        InputError: bad options, or a folder that holds anything else.
    """
    from wlr_gym.demo import page
    from wlr_gym.demo.workers import WORKERS, run_workers

    steps = options.steps or (QUICK_STEPS if options.quick else STEPS)
    demo = page.Demo(options.out, options.seed, steps, **(_SHORT if options.quick else {}))
    refuse_existing(demo.page, options.force)
    _clear(demo.out)
    record_provenance(demo.out, {"seed": demo.seed, "steps": demo.steps, "quick": options.quick}, demo.seed)
    console, began = Console(highlight=False, soft_wrap=True), time.monotonic()
    console.print(
        "A policy learns; slip-aware and blind drive on ice; a robot has a hidden fault; the gap workflow looks for it; "
        "the policy trains on."
    )
    with progress(console, tuple(WORKERS), options.progress) as tell:
        sections, interrupted = run_workers(demo, tell)
    page.write_page(demo, sections, interrupted)
    for one in sections:
        console.print(f"{one.title}: {one.headline or one.verdict}", markup=False)
    console.print(f"{'stopped' if interrupted else 'done'} after {duration(time.monotonic() - began)}; the page:")
    console.print(str(demo.page), markup=False)
    if options.json:
        found = [{name: getattr(one, name) for name in ("title", "headline", "verdict", "not_good")} for one in sections]
        print_json({"page": demo.page, "interrupted": interrupted, "sections": found})
    if interrupted:
        return INTERRUPTED
    return FAILED if any(one.verdict == page.FAILED for one in sections) else OK


def _clear(folder: Path) -> None:
    """Make the folder anew; one that holds anything but a demo is refused."""
    inside, config = contents(folder), folder / CONFIG_FILE
    if inside and not (config.is_file() and "quick" in read_yaml(config)):
        raise InputError(
            f"{folder}: '{inside[0].name}' is in the way, and this is not the folder of a demo; give another --out"
        )
    for path in inside:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
