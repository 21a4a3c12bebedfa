"""Which runs are replayed worst: the fitted ones together, or one that no fit has used; and in which channel."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol

from wlr_gym.gap.analysis import ChannelGap


class RunError(Protocol):
    """Error of one run, as in an analysis or in a result file."""

    @property
    def run(self) -> str: ...

    @property
    def heldout(self) -> bool: ...

    @property
    def after(self) -> float | None: ...


def most_left(fitted: float | None, runs: Iterable[RunError]) -> tuple[float, str]:
    """Return the largest error, and of which held-out run it is; "" = of the fitted runs together.

    Fitted runs count together, as the fit sees them. Held-out ones count one by one: a single motion may show what is missing.
    """
    return max([(fitted or 0.0, ""), *((one.after or 0.0, one.run) for one in runs if one.heldout)], key=lambda one: one[0])


def most_in(channels: Iterable[ChannelGap]) -> str:
    """Return the channel of which most noise units are left in the held-out runs."""
    return max((one for one in channels if math.isfinite(one.after)), key=lambda one: one.after).channel
