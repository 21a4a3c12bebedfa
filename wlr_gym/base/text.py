"""Numbers and times as people read them."""

from __future__ import annotations

import math


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits; ``-`` if it is none."""
    if not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if 10**digits <= abs(value) < 1e7 else f"{value:.{digits}g}"


def duration(seconds: float) -> str:
    """Return ``3 min 20 s``; from an hour on ``2 h 5 min``."""
    whole = round(seconds)
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60} min"
    return f"{whole // 60} min {whole % 60} s" if whole >= 60 else f"{whole} s"


def counted(count: int, word: str) -> str:
    """Return ``1 trial``, ``2 trials``."""
    return f"{count} {word}{'' if count == 1 else 's'}"
