"""Compiled draws of many named streams at once, on the counter-based generator of ``wlr_gym.base.random``.

Nothing is consumed from a shared generator: a new stream shifts no other, and a robot draws the same numbers alone or in a
batch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.random import stream_number, words4

_EPISODE = stream_number("episode")


@njit(cache=True, nogil=True, inline="always")
def uniform(seed: Any, stream: Any, counter: Any) -> Any:
    """One uniform number in [0, 1) of 53 bits: a function of (seed, stream, counter) alone."""
    high, low, _, _ = words4(seed, stream, counter, 0)
    return float(np.int64(((high >> np.uint64(5)) << np.uint64(26)) | (low >> np.uint64(6)))) * 2.0**-53


@njit(cache=True, nogil=True)
def _fill(seeds: Any, streams: Any, counters: Any, out: Any) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] = uniform(seeds[row, column], streams[column], counters[row, column])


@njit(cache=True, nogil=True)
def _fill_seeds(seeds: Any, stream: Any, counters: Any, out: Any) -> None:
    for row in range(out.shape[0]):
        high, low, _, _ = words4(seeds[row], stream, counters[row], 0)
        out[row] = (high << np.uint64(32)) | low


def uniforms(seeds: NDArray[np.uint64], streams: NDArray[np.uint64], counters: ArrayLike = 0) -> NDArray[np.float64]:
    """Return uniform numbers in [0, 1), shape (M, K).

    Args:
        seeds: (M,), or (M, K) where streams draw from different seeds.
        streams: (K,) stream numbers.
        counters: whole numbers that broadcast to (M, K).
    """
    shape = (seeds.shape[0], len(streams))
    out = np.empty(shape)
    if seeds.ndim == 1:
        seeds = seeds[:, None]
    _fill(np.broadcast_to(seeds, shape), streams, np.broadcast_to(np.asarray(counters, dtype=np.int64), shape), out)
    return out


def stream_numbers(*names: str) -> NDArray[np.uint64]:
    """Return the stream numbers of names."""
    return np.array([stream_number(name) for name in names], dtype=np.uint64)


def episode_seeds(robot_seeds: NDArray[np.uint64], episodes: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the seed of each robot's n-th episode, shape (M,)."""
    out = np.empty(len(robot_seeds), dtype=np.uint64)
    _fill_seeds(robot_seeds, _EPISODE, episodes, out)
    return out
