"""Counter-based random numbers: a pure function of (seed, named stream, counter).

Nothing is consumed from a shared generator, so a new stream shifts no other, and a robot draws the same numbers alone or
in a batch. The functions below work on numpy arrays and, compiled by numba (``wlr_gym.envs.kernels``), on scalars.
Mixing function: SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators, OOPSLA 2014).
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 2.0**-53


def mix(x: Any) -> Any:
    """SplitMix64 finaliser: uint64 to well-scrambled uint64."""
    x = (x ^ (x >> _S30)) * _FIRST
    x = (x ^ (x >> _S27)) * _SECOND
    return x ^ (x >> _S31)


def random_bits(seed: Any, key: Any, counter: Any) -> Any:
    """64 random bits for (seed, stream key, counter), all uint64."""
    return mix(mix(mix(seed + _GOLDEN) ^ key) + counter * _GOLDEN)


def unit(bits: Any) -> Any:
    """Map 64 random bits to a uniform number in [0, 1)."""
    return (bits >> _S11) * _UNIT


def stream_key(*names: str) -> np.uint64:
    """Return the key of a named stream."""
    digest = hashlib.blake2b("\0".join(names).encode(), digest_size=8).digest()
    return np.uint64(int.from_bytes(digest, "little"))


def uniforms(seeds: NDArray[np.uint64], key: np.uint64, counters: NDArray[np.uint64] | int = 0) -> NDArray[np.float64]:
    """Return one uniform number in [0, 1) per seed; ``counters`` is one number or one per seed."""
    counter = np.broadcast_to(np.asarray(counters, dtype=np.uint64), seeds.shape)
    return unit(random_bits(seeds, np.full(seeds.shape, key), counter))
