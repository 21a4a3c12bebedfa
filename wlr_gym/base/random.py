"""Random numbers that are pure functions of a seed and a name or counter.

Sensor noise is counter-based (Philox4x32-10): value = f(seed, stream, counter, column), whatever the batch size, order or
number of threads. Its normals use only arithmetic and square roots, so they are the same bits at any vector width and on
any machine. Everything rarer (randomisation, tasks, networks) takes a numpy generator from a named stream.

Source: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wlr_gym.base.compiled import bits_of, compiled, number_of_bits

_LOW = np.uint64(0xFFFFFFFF)
_HALF_WORD = np.uint64(32)
_MULTIPLIER_0 = np.uint64(0xD2511F53)
_MULTIPLIER_1 = np.uint64(0xCD9E8D57)
_WEYL_0 = np.uint64(0x9E3779B9)
_WEYL_1 = np.uint64(0xBB67AE85)
_EXPONENT_SHIFT = np.int64(52)
_MANTISSA = np.int64(0x000FFFFFFFFFFFFF)
_ONE_BITS = np.int64(0x3FF0000000000000)
_LN_2 = 0.6931471805599453
_SQRT_2 = 1.4142135623730951
_WORD = 2.0**-32
_QUARTER_TURN = 1.5707963267948966 * 2.0**-30


@compiled(inline="always")
def philox(c0: Any, c1: Any, c2: Any, c3: Any, k0: Any, k1: Any) -> Any:
    """Philox4x32-10: four 32-bit random words from four counter words and two key words, each held in a uint64."""
    for _ in range(10):
        a = _MULTIPLIER_0 * c0
        b = _MULTIPLIER_1 * c2
        c0, c1, c2, c3 = (b >> _HALF_WORD) ^ c1 ^ k0, b & _LOW, (a >> _HALF_WORD) ^ c3 ^ k1, a & _LOW
        k0 = (k0 + _WEYL_0) & _LOW
        k1 = (k1 + _WEYL_1) & _LOW
    return c0, c1, c2, c3


@compiled(inline="always")
def words4(seed: Any, stream: Any, counter: Any, block: Any) -> Any:
    """Four random 32-bit words: key = seed, counter words = (block, stream, counter low, counter high)."""
    count = np.uint64(counter)
    return philox(np.uint64(block), stream & _LOW, count & _LOW, count >> _HALF_WORD, seed & _LOW, seed >> _HALF_WORD)


@compiled(inline="always")
def _minus_log(u: float) -> float:
    """-ln(u) for a normal float in (0, 1], error below 2e-16 relative to max(1, -ln u)."""
    bits = bits_of(u)  # pyright: ignore[reportCallIssue]
    exponent = float((bits >> _EXPONENT_SHIFT) - np.int64(1023))
    mantissa = number_of_bits((bits & _MANTISSA) | _ONE_BITS)  # pyright: ignore[reportCallIssue]
    high = mantissa > _SQRT_2
    mantissa = 0.5 * mantissa if high else mantissa
    exponent = exponent + 1.0 if high else exponent
    s = (mantissa - 1.0) / (mantissa + 1.0)
    x = s * s
    p = 1 / 19 + x * (1 / 21)
    p = 1 / 15 + x * (1 / 17 + x * p)
    p = 1 / 11 + x * (1 / 13 + x * p)
    p = 1 / 7 + x * (1 / 9 + x * p)
    p = 1 / 3 + x * (1 / 5 + x * p)
    return -(exponent * _LN_2 + 2.0 * (s + s * x * p))


@compiled(inline="always")
def _normal_pair(radius_word: Any, angle_word: Any) -> Any:
    """Two independent standard normals (Box-Muller) from two 32-bit words; at most 6.7 standard deviations.

    The angle is folded to t in (-pi/4, pi/4) and two signs: cos and sin of t + pi/4 are (cos t -+ sin t) / sqrt 2.
    """
    radius = np.sqrt(_minus_log((float(np.int64(radius_word)) + 0.5) * _WORD))
    t = (float(np.int64(angle_word >> np.uint64(2))) - 536870911.5) * _QUARTER_TURN
    x = t * t
    s = 1 / 6227020800 - x * (1 / 1307674368000)
    s = 1 / 362880 - x * (1 / 39916800 - x * s)
    s = 1 / 6 - x * (1 / 120 - x * (1 / 5040 - x * s))
    s = t - t * x * s
    c = 1 / 87178291200 - x * (1 / 20922789888000)
    c = 1 / 3628800 - x * (1 / 479001600 - x * c)
    c = 1 / 24 - x * (1 / 720 - x * (1 / 40320 - x * c))
    c = 1.0 - x * (0.5 - x * c)
    first = radius * (1.0 - 2.0 * float(np.int64(angle_word & np.uint64(1))))
    second = radius * (1.0 - float(np.int64(angle_word & np.uint64(2))))
    return first * (c - s), second * (c + s)


@compiled(inline="always")
def normals4(seed: Any, stream: Any, counter: Any, block: Any) -> Any:
    """Four independent standard normals, a function of these numbers alone; ``seed`` and ``stream`` are uint64."""
    a, b, c, d = words4(seed, stream, counter, block)
    n0, n1 = _normal_pair(a, b)
    n2, n3 = _normal_pair(c, d)
    return n0, n1, n2, n3


def stream_number(name: str) -> np.uint64:
    """Return the 32-bit number of a named stream: the same on every machine and in every process."""
    return np.uint64(int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little"))


def _sequence(seed: int | None, names: tuple[str | int, ...]) -> np.random.SeedSequence:
    digest = hashlib.sha256("\x1f".join(f"{type(name).__name__}:{name}" for name in names).encode()).digest()
    key = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return np.random.SeedSequence(None if seed is None else int(seed), spawn_key=key)


def generator(seed: int | None, *names: str | int) -> np.random.Generator:
    """Return the numpy generator of a named stream, for example ``generator(7, "events", "push")``.

    Streams of different names are independent and adding one shifts no other. ``seed`` is a whole number >= 0, or None for
    fresh entropy.
    """
    return np.random.Generator(np.random.PCG64(_sequence(seed, names)))


def spawn_seeds(seed: int | None, count: int, *names: str | int) -> NDArray[np.uint64]:
    """Return (count,) distinct noise seeds; the one of robot i does not depend on ``count`` (SplitMix64)."""
    base = _sequence(seed, ("robots", *names)).generate_state(1, np.uint64)[0]
    with np.errstate(over="ignore"):
        z = base + np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


# ---- draws of many named streams at once -----------------------------------------------------------------------------

# Nothing is consumed from a shared generator: a new stream shifts no other, and a robot draws the same numbers alone or in a
# batch.


_EPISODE = stream_number("episode")


@compiled(inline="always")
def uniform(seed: Any, stream: Any, counter: Any) -> Any:
    """One uniform number in [0, 1) of 53 bits: a function of (seed, stream, counter) alone."""
    high, low, _, _ = words4(seed, stream, counter, 0)
    return float(np.int64(((high >> np.uint64(5)) << np.uint64(26)) | (low >> np.uint64(6)))) * 2.0**-53


@compiled
def _fill_uniforms(seeds: Any, streams: Any, counters: Any, out: Any) -> None:
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] = uniform(seeds[row, column], streams[column], counters[row, column])


@compiled
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
    _fill_uniforms(np.broadcast_to(seeds, shape), streams, np.broadcast_to(np.asarray(counters, dtype=np.int64), shape), out)
    return out


def stream_numbers(*names: str) -> NDArray[np.uint64]:
    """Return the stream numbers of names."""
    return np.array([stream_number(name) for name in names], dtype=np.uint64)


def episode_seeds(robot_seeds: NDArray[np.uint64], episodes: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the seed of each robot's n-th episode, shape (M,)."""
    out = np.empty(len(robot_seeds), dtype=np.uint64)
    _fill_seeds(robot_seeds, _EPISODE, episodes, out)
    return out
