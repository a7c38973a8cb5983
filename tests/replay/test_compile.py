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


# A function that numba compiles by what another module says of it, as jets are.
EXTENSION = """
    from numba.extending import overload

    def gain(value):
        raise NotImplementedError("never called: numba is told below what it does")

    @overload(gain)
    def compiled_gain(value):
        return lambda value: 3.0 * value
"""


def test_what_is_imported_by_name_is_compiled_anew_when_its_module_changes(tmp_path: Path):
    """By itself numba goes on with the old one: it looks at the file of the kernel alone."""
    cache = tmp_path / "cache"
    user = MODULE.replace("GAIN = 3.0", "from extension import gain").replace(
        "GAIN * value", "gain(value)"
    )
    for extension, expected in (
        (EXTENSION, "1.0 4.0 7.0 compiled"),
        (EXTENSION, "1.0 4.0 7.0 cached"),
        (EXTENSION.replace("3.0", "5.00"), "1.0 6.0 11.0 compiled"),
    ):
        (tmp_path / "extension.py").write_text(textwrap.dedent(extension))
        assert imported(user, tmp_path, cache)[0] == expected


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
    """The same source around another number is another kernel; infinity and NumPy's numbers are fine."""
    scales = (2.0, 3.0, np.float64(0.5), -np.inf)
    found = np.zeros((len(scales), 2))
    for row, scale in enumerate(scales):
        compile_over_runs(kernel_of(scaled_by(scale)), allocates=False)(2, found[row])
    assert_array_equal(found[:, 1], [4, 6, 1, -np.inf])


def offset_by(scale: float) -> Callable[[float], float]:
    def offset(value: float) -> float:
        return scale + value

    return offset


@pytest.mark.parametrize("second", [1.5, 2.5])
def test_numbers_of_one_name_are_each_models_own(second: float):
    """Two models may each close over a `scale`, equal or not, and each keeps its own."""
    found = np.zeros(2)
    compile_over_runs(kernel_of(scaled_by(1.5), offset_by(second)), allocates=False)(2, found)
    assert_array_equal(found, [second, 1.5 + (second + 1)])


def test_what_numba_has_compiled_already_is_compiled_with_the_rest():
    found = np.zeros(2)
    compile_over_runs(kernel_of(numba.njit(twice)), allocates=False)(2, found)
    assert_array_equal(found, [0, 4])


def test_two_closures_of_one_function_stay_two():
    """A filter regresses its motion and its sensor by one function: the names must not run together."""
    found = np.zeros(3)
    compile_over_runs(kernel_of(scaled_by(2.0), scaled_by(3.0)), allocates=False)(3, found)
    assert_array_equal(found, [0, 5, 10])


def test_what_cannot_be_compiled_is_told_in_one_sentence():
    typed: dict[str, Callable] = {}
    exec("def typed(value): return value", typed)
    with pytest.raises(BadInput, match="the source of typed is not at hand"):
        compile_over_runs(kernel_of(typed["typed"]))
    with pytest.raises(BadInput, match="is no `def` function; kernels are made of these"):
        compile_over_runs(kernel_of(lambda value: value))
    with pytest.raises(BadInput, match=r"uses 'scale', a ndarray, .* hand it in as an argument"):
        compile_over_runs(kernel_of(scaled_by(np.ones(3))))
    with pytest.raises(BadInput, match="kernel 'one' does not compile: No implementation of function"):
        compile_over_runs(kernel_of(twice))(1, "text")
