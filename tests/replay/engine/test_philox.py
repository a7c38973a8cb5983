"""Philox in kernels, against the words of its authors and of NumPy, and its normals."""

import numpy as np
import pytest
from scipy import stats

from fuselog.recorders.compiling.compile import compiled
from fuselog.replay.engine.philox import fill_normals, philox, run_key

normals = compiled(fill_normals)


@pytest.mark.parametrize(
    ("key", "counter", "words"),
    [
        ([0, 0], 0, "16554d9eca36314c db20fe9d672d0fdc d7e772cee186176b 7e68b68aec7ba23b"),
        ([5, 3], 1, "c0671201ed7f7b5a 6958bff49c70be93 b89e1c2384ada39a fc897795f0e1ec0a"),
    ],
)
def test_blocks_are_those_of_the_papers_vectors(key: list[int], counter: int, words: str) -> None:
    with np.errstate(over="ignore"):
        found = philox(counter, np.array(key, np.uint64))
    assert [f"{int(word):016x}" for word in found] == words.split()


def test_the_words_of_normals_are_numpys() -> None:
    key = run_key(7, [np.array([1.5, np.nan])])
    words = np.empty(400, np.uint64)
    normals(np.empty(400), words, key, 0)
    assert words.tolist() == np.random.Philox(key=key).random_raw(400).tolist()


def test_keys_differ_by_seed_and_by_data() -> None:
    keys = {
        tuple(run_key(seed, [np.array(first)]).tolist()) for seed in (1, 2) for first in (1.0, 1.5, 2.0)
    }
    assert len(keys) == 6


@pytest.mark.paper
def test_normals_are_normal_into_the_tail_and_go_on_where_the_counter_stands() -> None:
    """Two million, whose words end where the counter says; every layer and the tail take part."""
    key, half = np.array([3, 1], np.uint64), 1_000_000
    found, words = np.empty(2 * half), np.empty(half, np.uint64)
    middle = normals(found[:half], words, key, 0)
    end = normals(found[half:], words, key, middle)
    assert 1.01 < 4 * middle / half < 1.1
    assert middle < end
    assert stats.kstest(found, "norm").pvalue > 1e-3
    edges = np.linspace(-4.5, 4.5, 91)
    counts = np.histogram(found, np.concatenate([[-np.inf], edges, [np.inf]]))[0]
    shares = np.diff(stats.norm.cdf(np.concatenate([[-np.inf], edges, [np.inf]])))
    assert stats.chisquare(counts, len(found) * shares).pvalue > 1e-3
    assert len(np.unique(found)) == len(found)
