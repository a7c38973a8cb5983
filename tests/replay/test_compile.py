"""Kernels are compiled once per source text, wherever they come from and whatever the cache allows."""

import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from recorders.errors import BadInput
from replay.compile import cache_folder, compile_over_runs

# A module with models and a kernel of its own, as a third party would write them: plain functions.
MODULE = """
    import numpy as np
    from typing import NamedTuple
    from replay.compile import compile_over_runs

    GAIN = 3.0

    class Columns(NamedTuple):
        given: np.ndarray
        found: np.ndarray

    def model(value):
        "A docstring is no part of the kernel."
        return GAIN * value + 1.0

    def kernel(sensor):
        def one(run, columns):
            columns.found[run] = sensor(columns.given[run])
        return one

    columns = Columns(np.arange(3.0), np.zeros(3))
    loop = compile_over_runs(kernel(model), allocates=False)
    loop(3, columns)
    compiled = loop.keywords["loop"]
    print(*columns.found, "cached" if compiled.stats.cache_hits else "compiled")
    print(compiled.py_func.__code__.co_filename)
"""


def imported(module: str, folder: Path, cache: Path) -> list[str]:
    """What the module prints when a new process imports it."""
    (folder / "third_party.py").write_text(textwrap.dedent(module))
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", "import third_party"],
        cwd=folder,
        env={"HOME": str(folder), "FUSELOG_CACHE": str(cache)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_new_process_finds_the_kernel_and_a_changed_model_is_compiled_anew(tmp_path: Path):
    """Neither a compilation at every start, nor the old model after a change."""
    cache = tmp_path / "cache"
    assert imported(MODULE, tmp_path, cache)[0] == "1.0 4.0 7.0 compiled"
    assert imported(MODULE, tmp_path, cache)[0] == "1.0 4.0 7.0 cached"
    changed = MODULE.replace("value + 1.0", "value - 1.0")
    assert imported(changed, tmp_path, cache)[0] == "-1.0 2.0 5.0 compiled"


def test_a_cache_that_cannot_be_written_does_not_stop_the_work(tmp_path: Path):
    """The kernel is compiled for this process alone, and its folder is gone with it."""
    (tmp_path / "file").touch()
    results, place = imported(MODULE, tmp_path, tmp_path / "file" / "cache")
    assert results == "1.0 4.0 7.0 compiled"
    assert Path(place).name.startswith("kernel_")
    assert not Path(place).parent.exists()


def test_the_cache_folder_can_be_moved(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FUSELOG_CACHE", "/elsewhere")
    assert cache_folder() == Path("/elsewhere")
    monkeypatch.delenv("FUSELOG_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert cache_folder() == Path("/xdg/fuselog")


def twice(value: float) -> float:
    return 2.0 * value


def fill(run: int, values: np.ndarray, found: np.ndarray, work: np.ndarray) -> None:
    """Plain Python too: the same function, uncompiled, says what the compiled one must."""
    total = 0.0
    for k in range(len(work)):
        work[k] = twice(values[run, k])
        total += np.sqrt(work[k])
    found[run] = total


def test_the_loop_does_every_run_once_whatever_the_cores(monkeypatch: pytest.MonkeyPatch):
    """Scratch memory is each core's own: a race would mix the runs."""
    loop = compile_over_runs(fill, allocates=False)
    values = np.random.default_rng(1).uniform(size=(503, 200))
    expected = np.empty(503)
    for run in range(503):
        fill(run, values, expected, np.empty(200))
    for cores in (1, 2, 7, 1000):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", cores)
        found = np.full(503, np.nan)
        loop(503, values, found, scratch=lambda: np.empty(200))
        assert_array_equal(found, expected)
    loop(0, values, found, scratch=lambda: np.empty(200))


def sorted_copy(run: int, values: np.ndarray, found: np.ndarray) -> None:
    found[run] = np.sort(values[run])[:2] @ np.ones(2)


def test_a_kernel_that_allocates_says_so():
    """With the default it may use what makes arrays; one that says that it makes none must not."""
    values, found = np.array([[3.0, 1.0, 2.0]]), np.zeros(1)
    compile_over_runs(sorted_copy)(1, values, found)
    assert found[0] == 3.0
    with pytest.raises(BadInput, match="a kernel that makes arrays is compiled with allocates=True"):
        compile_over_runs(sorted_copy, allocates=False)(1, values, found)


def divide(run: int, values: np.ndarray, found: np.ndarray) -> None:
    found[run] = 1.0 / values[run]


def test_a_division_by_zero_is_infinity_and_stops_no_other_run():
    found = np.zeros(3)
    compile_over_runs(divide, allocates=False)(3, np.array([2.0, 0.0, 4.0]), found)
    assert_array_equal(found, [0.5, np.inf, 0.25])


def kernel_of(*models: Callable[[float], float]) -> Callable[..., None]:
    first, second = models[0], models[-1]

    def one(run: int, found: np.ndarray) -> None:
        found[run] = first(run) + second(run)

    return one


def scaled_by(scale: float) -> Callable[[float], float]:
    def scaled(value: float) -> float:
        return scale * value

    return scaled


def test_numbers_that_a_kernel_closes_over_are_part_of_it():
    """The same source around another number is another kernel."""
    found = np.zeros((2, 3))
    for row, scale in enumerate((2.0, 3.0)):
        compile_over_runs(kernel_of(scaled_by(scale)), allocates=False)(3, found[row])
    assert_array_equal(found, [[0, 4, 8], [0, 6, 12]])


def test_what_cannot_be_compiled_is_told_in_one_sentence():
    typed: dict[str, Callable] = {}
    exec("def typed(value): return value", typed)
    with pytest.raises(BadInput, match="the source of typed is not at hand"):
        compile_over_runs(kernel_of(typed["typed"]))
    with pytest.raises(BadInput, match="is no `def` function; kernels are made of these"):
        compile_over_runs(kernel_of(lambda value: value))
    with pytest.raises(BadInput, match="two different things called 'scaled'"):
        compile_over_runs(kernel_of(scaled_by(2.0), scaled_by(3.0)))
    with pytest.raises(BadInput, match="kernel 'one' does not compile: "):
        compile_over_runs(kernel_of(twice))(1, "text")
