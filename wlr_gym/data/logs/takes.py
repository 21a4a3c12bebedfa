"""What a channel has at the times of rows that are not its own samples': ways to take a value, and how far that moved it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Times = NDArray[np.int64]

#: Usual steps between a channel's samples beyond which nothing is said of what lies between.
_HOLE = 5.0
#: s; holes up to this are bridged whatever the channel's rate.
_SHORT = 0.1


def hole(at: Times) -> float:
    """Return how far samples (ns) may be apart, at most, so that they say what is between them, ns."""
    return max(_HOLE * float(np.median(np.diff(at))), _SHORT * 1e9)


def interpolated(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    width = (at[after] - at[after - 1]).astype(np.float64)
    share = (times - at[after - 1]) / width
    result = values[after - 1] + share * (values[after] - values[after - 1])
    return np.where(bridged(times, at), result, np.nan), _rms(np.minimum(np.abs(share), np.abs(1.0 - share)) * width)


def bridged(times: Times, at: Times) -> NDArray[np.bool_]:
    """Whether the samples before and after each time say what was between them; a sample at the time itself does."""
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    usual = float(np.median(np.diff(at)))
    width = (at[after] - at[after - 1]).astype(np.float64)
    share = (times - at[after - 1]) / width
    edge = 0.5 * usual / width  # the first and last half step are read off the line
    inside = (share >= -edge) & (share <= 1.0 + edge) & (width <= hole(at))
    return inside | (at[after] == times) | (at[after - 1] == times)


def held(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    middle = times + round(0.5e9 * period)
    place = np.clip(np.searchsorted(at, middle, side="right") - 1, 0, len(at) - 1)
    return values[place], _rms((at[place] - times)[np.abs(at[place] - times) < 1e9 * period])


def nearest(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    place = _next_to(times, at)
    distance = np.abs(at[place] - times)
    return np.where(distance <= hole(at), values[place], np.nan), _rms(distance)


def framed(times: Times, at: Times, values: Array, period: float) -> tuple[Array, float]:
    """Each frame goes to the row next to it, moved along the line to the next frame; the other rows get none."""
    inside = (at >= times[0] - 0.5e9 * period) & (at <= times[-1] + 0.5e9 * period)
    rows = np.unique(_next_to(at[inside], times))
    result = np.full(len(times), np.nan)
    result[rows] = interpolated(times[rows], at, values, period)[0]
    distance = np.abs(times[rows] - at[_next_to(times[rows], at)])
    return result, _rms(distance)


def _next_to(times: Times, at: Times) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(at, times), 1, len(at) - 1)
    return after - ((times - at[after - 1]) < (at[after] - times))


def _rms(nanoseconds: NDArray[np.generic]) -> float:
    return float(np.sqrt(np.mean(np.square(nanoseconds.astype(np.float64))))) * 1e-9 if len(nanoseconds) else 0.0


#: Way -> function of rows' times, samples' times (ns), their values, and s between rows, which returns values at the rows and
#: how far they were moved (s, rms); and what is said of it.
TAKES = {
    "interpolate": (interpolated, "interpolated"),
    "hold": (held, "held at mid-step"),
    "nearest": (nearest, "nearest sample"),
    "frames": (framed, "next to frames"),
}
