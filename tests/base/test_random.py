"""Counter-based numbers: known answers, independence of batch and order, statistics; named streams."""

import subprocess
import sys

import numpy as np
import pytest
from numba import njit
from scipy import stats

from wlr_gym.base.random import generator, normals4, philox, spawn_seeds, stream_number

ANSWERS = [  # Random123 1.09, kat_vectors: philox4x32 10
    ([0] * 6, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    ([0xFFFFFFFF] * 6, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]


KNOWN_NORMALS = ["0x1.9179578ddcb47p-1", "-0x1.6ff9ac0bc4ac6p+0", "-0x1.daf3810977addp-1", "0x1.aa6fbcf972130p-3"]
KNOWN_SEEDS = [16639639161786936313, 16424134685700656026]
KNOWN_DRAW = 5239372833451409238


@njit
def philox_of(words):
    return philox(words[0], words[1], words[2], words[3], words[4], words[5])


@pytest.mark.parametrize(("words", "answer"), ANSWERS)
def test_philox_known_answers(words, answer):
    assert [int(word) for word in philox_of(np.array(words, np.uint64))] == answer


@njit
def fill(seeds, stream, counters, out):
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] = normals4(seeds[row], stream, counters[row], column // 4)[column % 4]


def normals(seeds, counters, columns, stream="test"):
    out = np.empty((len(seeds), columns))
    fill(np.asarray(seeds, np.uint64), stream_number(stream), np.asarray(counters, np.int64), out)
    return out


@pytest.fixture(scope="module")
def sample():
    return normals(spawn_seeds(5, 4096), np.arange(4096) % 7, 50)


def test_normals_are_standard_normal(sample):
    assert stats.kstest(sample.ravel(), "norm").pvalue > 1e-3
    size = sample.size
    assert abs(sample.mean()) < 4 / np.sqrt(size)
    assert abs(sample.var() - 1) < 4 * np.sqrt(2 / size)
    assert abs(stats.kurtosis(sample.ravel())) < 4 * np.sqrt(24 / size)
    assert 4.0 < np.abs(sample).max() < 6.8


def test_columns_rows_and_squares_are_uncorrelated(sample):
    for values in (sample, sample**2, sample[:, :-1] * sample[:, 1:]):
        correlation = np.corrcoef(values.T) - np.eye(values.shape[1])
        assert np.abs(correlation).max() < 6 / np.sqrt(len(values)) * (1 if values is sample else 1.5)


def test_every_value_depends_on_seed_stream_and_counter_only(sample):
    seeds, counters = spawn_seeds(5, 4096), np.arange(4096) % 7
    order = np.random.default_rng(0).permutation(4096)
    assert np.array_equal(normals(seeds[order], counters[order], 50), sample[order])
    assert np.array_equal(normals(seeds[77:78], counters[77:78], 50), sample[77:78])
    assert np.array_equal(normals(seeds, counters, 3), sample[:, :3])


@pytest.mark.parametrize("change", ["seed", "counter", "stream", "high seed", "high counter"])
def test_any_change_of_key_or_counter_changes_everything(change):
    base = normals([1], [1], 8)
    seed = {"seed": 2, "high seed": 1 + 2**40}.get(change, 1)
    counter = {"counter": 2, "high counter": 1 + 2**40}.get(change, 1)
    other = normals([seed], [counter], 8, "other" if change == "stream" else "test")
    assert not np.isclose(base, other).any()


def test_negative_counters_are_counters_too():
    values = normals([9, 9, 9], [-1, -2, 1], 4)
    assert np.isfinite(values).all()
    assert len(np.unique(values)) == values.size


def test_known_bits_do_not_move():
    """The same numbers on every machine and in every version: runs and policies are reproducible by their seed."""
    assert [value.hex() for value in normals([12345], [7], 4)[0]] == KNOWN_NORMALS
    assert spawn_seeds(12345, 2).tolist() == KNOWN_SEEDS
    assert int(generator(12345, "events", "push").integers(2**63)) == KNOWN_DRAW


def test_streams_of_different_names_are_different_and_stable():
    assert generator(3, "a").random() == generator(3, "a").random()
    draws = [
        generator(*key).random() for key in [(3,), (3, "a"), (3, "b"), (4, "a"), (3, "a", "b"), (3, "ab"), (3, 1), (3, "1")]
    ]
    assert len(set(draws)) == len(draws)


def test_stream_numbers_do_not_depend_on_the_process():
    code = "from wlr_gym.base.random import stream_number; print(int(stream_number('sensors')))"
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(other.stdout) == int(stream_number("sensors"))


def test_no_seed_gives_fresh_entropy():
    assert generator(None, "a").random() != generator(None, "a").random()


def test_robot_seeds_are_distinct_and_do_not_depend_on_count():
    many = spawn_seeds(8, 10000)
    assert many.dtype == np.uint64
    assert len(np.unique(many)) == 10000
    assert np.array_equal(spawn_seeds(8, 3), many[:3])
    assert not np.intersect1d(many, spawn_seeds(9, 10000)).size
    assert not np.intersect1d(many, spawn_seeds(8, 10000, "evaluation")).size
