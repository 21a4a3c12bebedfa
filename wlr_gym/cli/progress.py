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
#: Called with the worker, what it is doing, and the share of its work that is done.
Tell = Callable[[str, str, float], None]


@contextmanager
def progress(console: Console, workers: Sequence[str] = ("",), shown: bool = True) -> Iterator[Tell]:
    """Show a bar for each worker; without a terminal, a line whenever another stage of a worker begins.

    A stage's name ends at the first colon of its text.
    """
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.table import Column

    columns = (
        BarColumn(bar_width=16), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("{task.fields[left]}"),
        TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True)),
    )  # fmt: skip
    begin, last = time.monotonic(), dict.fromkeys(workers, "")
    live = shown and console.is_terminal
    with Progress(*columns, console=console, transient=True, expand=True, disable=not live) as bar:
        tasks = {worker: bar.add_task("", total=1.0, left="") for worker in workers}

        def tell(worker: str, text: str, share: float) -> None:
            left = time_left(time.monotonic() - begin, share)
            bar.update(tasks[worker], description=text, completed=share, left=left)
            stage = text.partition(":")[0]
            if shown and not live and stage != last[worker]:
                console.print(f"{100.0 * share:3.0f} %  {stage}{left and '; '}{left}", markup=False)
            last[worker] = stage

        yield tell


def time_left(passed: float, share: float) -> str:
    """Return the remaining time in words; empty while it is not known."""
    from wlr_gym.base.text import duration

    return f"about {duration(passed * (1.0 - share) / share)} left" if LEAST_SHARE <= share < 1.0 and passed > 1.0 else ""
