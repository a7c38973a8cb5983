"""A kernel's key is all that it is made of, and nothing else; what is kept serves every process."""

import gc
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from fuselog.recorders.compiling.compile import compile_over_runs
from fuselog.recorders.compiling.identity import identity
from fuselog.recorders.compiling.kernels import arguments, native
from fuselog.recorders.compiling.scratch import Scratch
from fuselog.replay.engine.arrays import varying

# --- the key -----------------------------------------------------------------------------------------

GAIN = 2.0
SETTINGS = SimpleNamespace(gain=2.0)


class Gains:
    """Constants of a class."""

    gain = 2.0


def doubled(x: float) -> float:
    return 2.0 * x


def tripled(x: float) -> float:
    return 3.0 * x


called = doubled


def by_a_global(x: float) -> float:
    return GAIN * x


def by_an_object(x: float) -> float:
    return SETTINGS.gain * x


def by_a_class(x: float) -> float:
    return Gains.gain * x


def by_a_callee(x: float) -> float:
    return called(x)


def by_a_module(x: float) -> float:
    return native.gain(x)


def by_a_default(x: float, gain: float = 2.0) -> float:
    return gain * x


def closing_over(*parts: Any) -> Callable[[float], float]:
    gain, function = parts

    def scaled(x: float) -> float:
        return gain * function(x)

    return scaled


def kernel_of(function: Callable[[float], float]) -> Callable[..., None]:
    def one(run: int, x: np.ndarray, out: np.ndarray) -> None:
        out[run] = function(x[run])

    return one


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; where its kernels will lie."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "kernels"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What is compiled rather than loaded."""
    found, make = [], native._made
    monkeypatch.setattr(native, "_made", lambda *given: found.append(given) or make(*given))
    return found


def result_of(function: Callable[[float], float]) -> float:
    out = np.zeros(1)
    compile_over_runs(kernel_of(function))(1, np.array([1.5]), out)
    return out[0]


@pytest.mark.parametrize(
    ("function", "place", "name", "before", "after"),
    [
        (by_a_global, globals(), "GAIN", 2.0, 4.0),
        (by_an_object, vars(SETTINGS), "gain", 2.0, 4.0),
        (by_a_callee, globals(), "called", doubled, tripled),
        (by_a_module, vars(native), "gain", doubled, tripled),
    ],
    ids=["a global", "an object's", "a callee", "a module's"],
)
def test_what_a_kernel_uses_is_part_of_its_key(
    function: Any, place: Any, name: str, before: Any, after: Any, kernels: Path, made: list[Any]
):
    """Changed it makes another file, changed back it finds the first."""
    with pytest.MonkeyPatch.context() as changed:
        for number, value in enumerate((before, after, before, after)):
            changed.setitem(place, name, value)
            assert result_of(function) == function(1.5)
            assert len(made) == min(number + 1, 2)
    assert len(list(kernels.iterdir())) == 2


def test_closures_classes_and_defaults_are_part_of_a_key(monkeypatch: pytest.MonkeyPatch):
    keys = [identity(closing_over(*parts)) for parts in ((2.0, doubled), (2.5, doubled), (2.0, tripled))]
    keys += [identity(by_a_default), identity(by_a_class)]
    monkeypatch.setattr(by_a_default, "__defaults__", (3.0,))
    monkeypatch.setattr(Gains, "gain", 3.0)
    keys += [identity(by_a_default), identity(by_a_class)]
    assert len({*keys}) == 7
    assert identity(closing_over(2.0, doubled)) == keys[0]


def test_a_docstring_is_not_part_of_a_key() -> None:
    made: dict[str, Any] = {}
    for text in ("Double a number.", "Compute twice a number."):
        exec(f'def twice(x):\n    """{text}"""\n    return 2.0 * x', made)
        made[text] = identity(made["twice"])
    assert made["Double a number."] == made["Compute twice a number."]


@varying(1, grid=2)
class Scene(NamedTuple):
    """Rows of which the number varies, and a grid of any size."""

    rows: np.ndarray
    grid: np.ndarray


def looked_at(run: int, scene: Scene, out: np.ndarray) -> None:
    out[run] = scene.rows.shape[1] * 1000.0 + scene.grid.shape[1] + scene.rows[run, 0]


def test_sizes_up_to_64_are_part_of_a_key_and_what_varies_is_not(kernels: Path, made: list[Any]):
    loop = compile_over_runs(looked_at)
    for count, (runs, columns, width) in enumerate(
        [(1, 3, 5), (2, 4, 5), (2, 64, 5), (2, 65, 5), (1, 3, 7), (9, 100, 70), (3, 64, 1)]
    ):
        scene, out = Scene(np.ones((runs, columns)), np.zeros((runs, width))), np.zeros(runs)
        loop(runs, scene, out)
        assert out.tolist() == [1000.0 * columns + width + 1.0] * runs
        assert len(made) == min(count + 1, 4)
    assert len(list(kernels.iterdir())) == 4


def overwritten(run: int, out: np.ndarray, work: tuple[np.ndarray, np.ndarray]) -> None:
    first, second = work
    first[0] = 1.0
    second[0] = 2.0
    out[run] += first[0]


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: (np.empty(2), np.empty(2)), 1.0),
        (lambda: (np.empty(2),) * 2, 2.0),
        (lambda: (lambda whole: (whole, whole[:]))(np.empty(2)), 2.0),
        (lambda: (lambda whole: (whole[0], whole[0]))(np.empty((1, 2))), 2.0),
    ],
    ids=["apart", "the same", "a view", "two views"],
)
@pytest.mark.usefixtures("kernels")
def test_only_working_memory_that_is_not_shared_is_taken_to_be_apart(
    make: Callable[[], tuple[np.ndarray, ...]], expected: float
):
    loop, own = compile_over_runs(overwritten), np.zeros(2)
    for memory in [lambda: (np.empty(2), np.empty(2)), make]:  # the same kinds, shared otherwise
        out = np.zeros(2)
        loop(1, out, scratch=Scratch(memory))
    assert out[0] == expected
    loop(1, own, scratch=lambda: (np.empty(2), own))  # made for this call, so of its arguments
    assert own.tolist() == [3.0, 0.0]
    with pytest.raises(AssertionError, match="an argument is also in the memory"):
        compile_over_runs(overwritten)(1, own, scratch=Scratch(lambda: (np.empty(2), own)))
    assert arguments.are_apart(make()) == (expected == 1.0,) * 2
    known = [arguments.KnownArray("d", (2,), True, is_apart=each) for each in (False, True)]
    text = native.program_of(overwritten, (known[0], (tuple, (known[1],) * 2))).text()
    assert text.count("ptr noalias") == 4  # of two arrays, where they are defined and where given


# --- what is kept ------------------------------------------------------------------------------------

ELSEWHERE = """
import numpy as np
from fuselog.recorders.compiling.kernels import arguments, native
native._made = lambda *_: 1 / 0
from tests.replay.engine.kernels.test_native import doubled, kernel_of
from fuselog.recorders.compiling.compile import compile_over_runs
out = np.zeros(1)
compile_over_runs(kernel_of(doubled))(1, np.array([1.5]), out)
print(out[0])
"""


def test_another_process_loads_what_is_kept_and_it_holds_no_address(kernels: Path):
    assert result_of(doubled) == 3.0
    (path,) = kernels.iterdir()
    kept = path.read_bytes()
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE],
        env={**os.environ, "PYTHONPATH": str(Path.cwd()), "PYTHONHASHSEED": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "3.0\n", done.stderr
    path.unlink()
    compile_over_runs(kernel_of(doubled))(1, np.array([1.5]), np.zeros(1))
    assert path.read_bytes() == kept  # whatever lies where
    text = native.program_of(kernel_of(doubled), (arguments.KnownArray("d", (None,), True),) * 2).text()
    addresses = [int(number) for number in re.findall(r"(?<![\w%.])\d{9,}", text)]
    assert addresses == []


def test_another_processor_or_version_of_this_room_is_another_kernel(
    kernels: Path, made: list[Any], monkeypatch: pytest.MonkeyPatch
):
    assert result_of(doubled) == 3.0
    native._surroundings.cache_clear()
    monkeypatch.setattr(native, "_machine", lambda: ("x86-64", "another's features"))
    monkeypatch.setattr(native, "_loaded", lambda _: lambda *_: 0)
    monkeypatch.setattr(native, "object_code", lambda _: b"machine code")
    result_of(doubled)
    native._surroundings.cache_clear()
    assert len(made) == 2
    assert len(list(kernels.iterdir())) == 2


# --- other processes ---------------------------------------------------------------------------------


def in_a_worker(number: float) -> float:
    out = np.zeros(1)
    compile_over_runs(kernel_of(doubled))(1, np.array([number]), out)
    return out[0]


@pytest.mark.paper
@pytest.mark.usefixtures("kernels")
def test_workers_run_kernels_and_get_them_by_name():
    """Spawned, as `--workers` has them: a function is sent, and compiled or found there."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert list(pool.map(result_of, [doubled, tripled])) == [3.0, 4.5]
        assert list(pool.map(in_a_worker, [1.0, 2.0, 3.0])) == [2.0, 4.0, 6.0]
    assert pickle.loads(pickle.dumps(in_a_worker))(2.0) == 4.0


@pytest.mark.parametrize("is_collecting", [True, False])
def test_garbage_is_collected_after_a_compilation_as_before(is_collecting: bool):
    (gc.enable if is_collecting else gc.disable)()
    try:
        with native._without_garbage():
            assert not gc.isenabled()
        assert gc.isenabled() == is_collecting
    finally:
        gc.enable()
