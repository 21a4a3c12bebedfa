"""Progress of long work: what is going on, the share that is done, and the remaining time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

#: Share of the work that must be done before the remaining time is shown.
LEAST_SHARE = 0.05
#: Told of the lane, of what is going on in it, and of the share of its work that is done.
Tell = Callable[[str, str, float], None]


@contextmanager
def progress(console: Console, lanes: Sequence[str] = ("",), shown: bool = True) -> Iterator[Tell]:
    """Show a bar for each lane of work; without a terminal, a line whenever another stage of a lane begins.

    A stage's name ends at the first colon of what is told.
    """
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )  # fmt: skip
    begin, last = time.monotonic(), dict.fromkeys(lanes, "")
    live = shown and console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=not live) as bar:
        tasks = {lane: bar.add_task("", total=1.0, left="") for lane in lanes}

        def tell(lane: str, text: str, share: float) -> None:
            left = time_left(time.monotonic() - begin, share)
            bar.update(tasks[lane], description=text, completed=share, left=left)
            stage = text.partition(":")[0]
            if shown and not live and stage != last[lane]:
                console.print(f"{100.0 * share:3.0f} %  {stage}{left and '; '}{left}", markup=False)
            last[lane] = stage

        yield tell


def time_left(passed: float, share: float) -> str:
    """Return the remaining time in words; empty while nobody can know."""
    from wlr_gym.gap.report.text import duration

    return f"about {duration(passed * (1.0 - share) / share)} left" if LEAST_SHARE <= share < 1.0 and passed > 1.0 else ""
