"""Progress of long work: what is going on, the share that is done, and the remaining time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from wlr_gym.base.text import duration

if TYPE_CHECKING:
    from rich.console import Console

#: Share of the work that must be done before the remaining time is shown.
LEAST_SHARE = 0.05
#: s; without a terminal, so long after a line another one follows, though the stage is the same.
EVERY = 10.0
#: Called with the worker, what it is doing, and the share of its work that is done.
Tell = Callable[[str, str, float], None]

Item = TypeVar("Item")


@contextmanager
def progress(console: Console, workers: Sequence[str] = ("",), shown: bool = True) -> Iterator[Tell]:
    """Show a bar for each worker; without a terminal, a line whenever another stage of a worker begins, and now and then.

    A stage's name ends at the first colon of its text.
    """
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.table import Column

    columns = (
        BarColumn(bar_width=16), TaskProgressColumn(), TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        TextColumn("{task.description}", table_column=Column(ratio=1, no_wrap=True)),
    )  # fmt: skip
    begin, last, printed = time.monotonic(), dict.fromkeys(workers, ""), 0.0
    live = shown and console.is_terminal
    with Progress(*columns, console=console, transient=True, expand=True, disable=not live) as bar:
        tasks = {worker: bar.add_task("", total=1.0) for worker in workers}

        def tell(worker: str, text: str, share: float) -> None:
            nonlocal printed
            stage, now = text.partition(":")[0], time.monotonic()
            bar.update(tasks[worker], description=text, completed=share)
            is_new = stage != last[worker]
            if shown and not live and (is_new or now - printed >= EVERY):
                left = time_left(now - begin, share)
                what = stage if is_new else text
                console.print(f"{100.0 * share:3.0f} %  {what}{left and '; '}{left}", markup=False, soft_wrap=True)
                printed = now
            last[worker] = stage

        yield tell


def tracked(items: Iterable[Item], count: int, text: str, console: Console, shown: bool = True) -> Iterator[Item]:
    """Yield the items, and show how many of them are done.

    Args:
        items: to yield.
        count: of them.
        text: what is going on.
        console, shown: as for :func:`progress`.
    """
    with progress(console, shown=shown) as tell:
        for done, item in enumerate(items):
            tell("", text, done / count)
            yield item


def time_left(passed: float, share: float) -> str:
    """Return the remaining time in words; empty while it is not known."""
    is_known = LEAST_SHARE <= share < 1.0 and passed > 1.0
    return f"about {duration(passed * (1.0 - share) / share)} left" if is_known else ""
