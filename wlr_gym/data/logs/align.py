"""How far two topics' clocks are apart, estimated from the motion that both show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: s; clocks are looked for this far apart, on a grid of this step; what is slower or quicker than these says little of them.
_REACH, _STEP, _SMOOTH, _SLOW = 1.0, 0.002, 0.06, 3.0
#: Correlation of the two motions below which they show nothing of the clocks.
_LEAST = 0.6
#: Parts of a recording, one of which is left out at a time.
_PARTS = 8
#: s that both must cover.
_LEAST_SECONDS = 3.0


@dataclass(frozen=True)
class Lag:
    """What must be added to a topic's times.

    Attributes:
        seconds: to be added.
        sigma: s; from how far parts of the recording differ.
        correlation: of the two motions once they are aligned, -1 to 1.
        opposite: the largest correlation of the other sign, at another lag, as a magnitude.
    """

    seconds: float
    sigma: float
    correlation: float
    opposite: float = 0.0

    @property
    def believable(self) -> bool:
        """Whether the motions show it."""
        return abs(self.correlation) >= _LEAST and self.sigma < 0.02


def find_lag(t: Array, values: Array, reference_t: Array, reference: Array, counts: Array | None = None) -> Lag | None:
    """Return what to add to ``t`` so that ``values`` move as ``reference`` does, up to sign and size; None = nothing moves.

    Both are freed of noise and drift alike and brought to one grid; the lag is where the magnitude of their correlation is
    largest, between grid points by a parabola. Its sigma comes from leaving out one part of the recording after the other.

    Args:
        t, values: (N,) s, signal of the topic whose clock is off.
        reference_t, reference: (M,) s, signal of the topic whose clock counts.
        counts: (M,) 0 or 1: when the two should move alike; None = always.
    """
    begin, end = max(t[0], reference_t[0]), min(t[-1], reference_t[-1])
    if end - begin < _LEAST_SECONDS:
        return None
    grid = np.arange(begin, end, _STEP)
    moved, fixed = (_smooth(np.interp(grid, at, signal)) for at, signal in ((t, values), (reference_t, reference)))
    weight = np.ones(len(grid)) if counts is None else np.round(np.interp(grid, reference_t, counts))
    if weight.mean() * (end - begin) < _LEAST_SECONDS:
        return None
    reach = round(_REACH / _STEP)
    whole = _best(moved, fixed, weight, reach)
    if whole is None:
        return None
    lag, correlation, opposite = whole
    sigma = _jackknife(moved, fixed, weight, reach)
    return Lag(lag, max(sigma, 0.1 * _STEP), correlation, opposite)


def _jackknife(moved: Array, fixed: Array, weight: Array, reach: int) -> float:
    """Return one sigma of a lag, from how it changes as each part of the recording is left out."""
    lags = []
    for part in np.array_split(np.arange(len(moved)), _PARTS):
        without = weight.copy()
        without[part] = 0.0
        found = _best(moved, fixed, without, reach)
        if found is None:
            return np.inf
        lags.append(found[0])
    return float(np.std(lags) * np.sqrt(_PARTS - 1.0))


def _smooth(values: Array) -> Array:
    """Take out noise and drift, of both signals alike: an average over a short time, less that over a long one."""
    return _average(values, _SMOOTH) - _average(values, _SLOW)


def _average(values: Array, seconds: float) -> Array:
    """Return the average around each point; near an end around as much as there is."""
    half = max(round(0.5 * seconds / _STEP), 1)
    total = np.concatenate([[0.0], np.cumsum(values)])
    place = np.arange(len(values))
    reach = np.minimum(np.minimum(half, place), len(values) - 1 - place)
    return (total[place + reach + 1] - total[place - reach]) / (2 * reach + 1)


def _best(moved: Array, fixed: Array, weight: Array, reach: int) -> tuple[float, float, float] | None:
    """Return lag (s) and correlation where two signals on one grid are most alike or most opposite, and the other of these."""
    reach = min(reach, len(moved) // 4)
    if np.std(moved) < 1e-9 or np.std(fixed) < 1e-9 or reach < 2 or weight[reach : len(weight) - reach].sum() * _STEP < 1.0:
        return None
    found = _correlations(moved, fixed, weight, reach)
    top = int(np.argmax(np.abs(found)))
    opposite = max(float(np.max(-np.sign(found[top]) * found)), 0.0)
    if top in (0, 2 * reach):
        return (top - reach) * _STEP, 0.5 * float(found[top]), opposite  # at the edge: not a peak
    before, at, after = np.abs(found[top - 1 : top + 2])
    curve = before - 2.0 * at + after
    fine = 0.5 * (before - after) / curve if curve < 0.0 else 0.0
    return float((top - reach + fine) * _STEP), float(found[top]), opposite


def _correlations(moved: Array, fixed: Array, weight: Array, reach: int) -> Array:
    """Return the correlation at each shift of ``moved`` to later times, from -reach to reach.

    The middle of ``moved`` is compared with the part of ``fixed`` under it: all shifts with the same points of ``moved``.
    """
    core, share = moved[reach : len(moved) - reach], weight[reach : len(moved) - reach]
    count = share.sum()
    core = (core - (core * share).sum() / count) * share
    size = 1 << int(np.ceil(np.log2(len(fixed) + len(core))))

    def slid(part: Array, over: Array) -> Array:
        return np.fft.irfft(np.conj(np.fft.rfft(part, size)) * np.fft.rfft(over, size), size)[: 2 * reach + 1]

    mean = slid(share, fixed) / count
    energy = slid(share, fixed * fixed) - count * mean * mean
    floor = 1e-9 * float(fixed @ fixed) + 1e-300
    return slid(core, fixed) / np.sqrt(np.maximum(energy, floor) * max(float(core @ core), 1e-300))
