"""Kernels, ours and numba's, are compiled once, from wherever, and whatever the cache allows."""

import os
import re
import stat
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fuselog.recorders import environment
from fuselog.recorders.compiling.cache import cache_folder, in_turn
from fuselog.recorders.compiling.compile import compile_over_runs, compiled
from fuselog.recorders.compiling.kernels import native
from fuselog.recorders.compiling.kernels.native import Kernel
from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.through_numba import numba_over_runs
from tests.replay.engine.processes import printed

# A module with models and a kernel of its own, as a third party would write them: plain functions.
MODULE = """
    import numpy as np
    from typing import NamedTuple

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
"""
BY_NUMBA = f"""{MODULE}
    import numba
    from fuselog.replay.engine.through_numba import numba_over_runs

    numba.config.reload_config()  # it was imported before the folder of its cache was set
    loop = numba_over_runs(kernel(model))
    loop(3, columns)
    (made,) = loop.compiled_loop._kernels.values()
    print(*columns.found, "cached" if made.stats.cache_hits else "compiled")
"""
OURS = f"""{MODULE}
    from fuselog.recorders.compiling.kernels import native

    made, make = [], native._made
    native._made = lambda *given: made.append(given) or make(*given)
    native.Kernel(kernel(model)).of((columns,))(0, 3)
    print(*columns.found, "compiled" if made else "cached")
"""


def imported(module: str, folder: Path, cache: Path, action: str = "error") -> list[str]:
    """What the module prints when a new process imports it."""
    (folder / "third_party.py").write_text(textwrap.dedent(module))
    environment = {"HOME": str(folder), "FUSELOG_CACHE": str(cache), "NUMBA_CACHE_DIR": str(cache)}
    return printed(["import third_party"], folder, environment, action)[0].splitlines()


@pytest.mark.paper
def test_a_new_process_finds_the_kernel_and_a_changed_model_is_compiled_anew(tmp_path: Path):
    """Neither a compilation at every start, nor the old model after a change."""
    cache = tmp_path / "cache"
    assert imported(OURS, tmp_path, cache)[0] == "1.0 4.0 7.0 compiled"
    assert imported(OURS, tmp_path, cache)[0] == "1.0 4.0 7.0 cached"
    changed = OURS.replace("value + 1.0", "value - 1.0")
    assert imported(changed, tmp_path, cache)[0] == "-1.0 2.0 5.0 compiled"


# Keeps the others waiting until it is killed.
HOLDER = """
    import sys
    from pathlib import Path
    from fuselog.recorders.compiling.cache import cache_folder, in_turn

    with in_turn(Path(sys.argv[1])):
        print("held", flush=True)
        input()
"""


def started(text: str, *arguments: str | Path) -> subprocess.Popen[str]:
    """A process of its own with this program, with the environment of this one."""
    command = [sys.executable, "-c", textwrap.dedent(text), *map(str, arguments)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


@pytest.mark.paper
def test_of_two_processes_that_want_a_kernel_one_compiles(tmp_path: Path, kernels: Path):
    """The other waits, and loads what the first has kept; no lock is left behind."""
    ready = (  # both are, before either compiles
        "    import os, pathlib, time\n"
        "    pathlib.Path(f'ready-{os.getpid()}').touch()\n"
        "    while len(list(pathlib.Path().glob('ready-*'))) < 2: time.sleep(0.01)\n"
    )
    together = re.sub(r"(?m)^    native\.Kernel.*\.of\(", lambda line: ready + line[0], OURS)
    (tmp_path / "third_party.py").write_text(textwrap.dedent(together))
    said = sorted(printed(["import third_party"] * 2, tmp_path, os.environ))
    assert said == ["1.0 4.0 7.0 cached\n", "1.0 4.0 7.0 compiled\n"]
    assert [path.suffix for path in kernels.iterdir()] == [".bin"]


def test_nobody_waits_long_for_a_kernel_and_not_at_all_for_the_killed(
    kernels: Path, monkeypatch: pytest.MonkeyPatch
):
    path = kernels / "kernel.bin"
    holder = started(HOLDER, path)
    assert holder.stdout.readline() == "held\n"
    monkeypatch.setattr("fuselog.recorders.compiling.cache._TURN_S", 0.1)
    with in_turn(path) as waited:
        assert waited
    holder.kill()
    holder.communicate()
    with in_turn(path) as waited:
        assert not waited


@pytest.mark.paper
def test_numba_finds_a_kernel_again_and_compiles_a_changed_one(tmp_path: Path):
    """A change in another file, which numba by itself does not see: of a function, of fields' order."""
    cache, (head, rest) = tmp_path / "cache", BY_NUMBA.split("class Columns(NamedTuple):")
    user = f"{head}from columns import Columns, gain{rest.split('found: np.ndarray', 1)[1]}"
    user = user.replace("GAIN * value", "gain(value)").replace(
        "Columns(np.arange(3.0), np.zeros(3))", "Columns(given=np.arange(3.0), found=np.zeros(3))"
    )
    for names, factor, expected in (
        (("given", "found"), 3.0, "1.0 4.0 7.0 compiled"),
        (("given", "found"), 3.0, "1.0 4.0 7.0 cached"),
        (("given", "found"), 5.0, "1.0 6.0 11.0 compiled"),
        (("found", "given"), 5.0, "1.0 6.0 11.0 compiled"),
    ):
        text = (
            f"import numpy as np\nfrom typing import NamedTuple\ndef gain(x):\n    return {factor} * x\n"
        )
        fields = "".join(f"    {name}: np.ndarray\n" for name in names)
        (tmp_path / "columns.py").write_text(f"{text}class Columns(NamedTuple):\n{fields}")
        assert imported(user, tmp_path, cache)[0] == expected


@pytest.mark.paper
def test_the_order_of_a_named_tuples_fields_is_part_of_a_kernel(tmp_path: Path):
    cache = tmp_path / "cache"
    head, rest = OURS.split("class Columns(NamedTuple):")
    rest = rest.split("found: np.ndarray", 1)[1].replace(
        "Columns(np.arange(3.0), np.zeros(3))", "Columns(given=np.arange(3.0), found=np.zeros(3))"
    )
    for names in (("given", "found"), ("found", "given")):
        body = "".join(f"    {name}: np.ndarray\n" for name in names)
        text = f"import numpy as np\nfrom typing import NamedTuple\nclass Columns(NamedTuple):\n{body}"
        (tmp_path / "columns.py").write_text(text)
        assert imported(f"{head}from columns import Columns{rest}", tmp_path, cache)[0] == (
            "1.0 4.0 7.0 compiled"
        )


def test_a_cache_that_cannot_be_written_does_not_stop_the_work(tmp_path: Path):
    """The kernel is compiled for this process alone, and nothing is left behind."""
    (tmp_path / "file").touch()
    assert imported(OURS, tmp_path, tmp_path / "file" / "cache") == ["1.0 4.0 7.0 compiled"]
    assert {path.name for path in tmp_path.iterdir()} == {"file", "third_party.py"}


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; where its kernels will lie."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "kernels"


def ours() -> bool:
    """Whether the kernel, which gives the right number, is loaded rather than compiled."""
    made, found, make = [], np.zeros(1), native._made
    with pytest.MonkeyPatch.context() as counted:
        counted.setattr(native, "_made", lambda *given: made.append(given) or make(*given))
        Kernel(divide).of((np.array([4.0]), found))(0, 1)
    assert found[0] == 0.25
    return not made


# whoever forgets the checksum fails at the first, before a cut file crashes him
@pytest.mark.parametrize(
    "damage", ["unlike its checksum", "emptied", "cut", "flipped", "not ours", "another kernel's"]
)
@pytest.mark.paper
def test_a_damaged_file_is_compiled_anew_and_replaced(kernels: Path, damage: str):
    """As a loss of power leaves it; what is executed has to be what was written."""
    assert not ours()
    assert ours()
    (path,) = kernels.iterdir()
    whole = path.read_bytes()
    middle = len(whole) // 2
    changed = {
        "emptied": b"",
        "cut": whole[:middle],
        "flipped": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
        "unlike its checksum": bytes([whole[0] ^ 1]) + whole[1:],
        "not ours": b"\x80\x04.",
    }
    path.write_bytes(changed.get(damage, whole))
    if damage == "another kernel's":
        values, found = np.array([[3.0, 1.0]]), np.zeros(1)
        Kernel(root).of((values, found))(0, 1)
        (other,) = set(kernels.iterdir()) - {path}
        other.replace(path)
    assert not ours()
    assert ours()
    assert list(kernels.iterdir()) == [path]


@pytest.mark.paper
def test_numba_compiles_where_its_cache_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    """By itself it stops at a damaged file."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    for _ in range(2):
        found = np.zeros(3)
        numba_over_runs(divide)(3, np.array([2.0, 0.0, 4.0]), found)
        assert_array_equal(found, [0.5, np.inf, 0.25])
        (code,) = tmp_path.rglob("*.nbc")
        code.write_bytes(code.read_bytes()[:100])
    (said,) = caplog.messages
    assert re.fullmatch(r"numba's cache cannot be used \(.+\): .*\.divide is compiled in every .*", said)


def test_a_full_disk_is_said_once(kernels: Path, monkeypatch: pytest.MonkeyPatch, caplog):
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    assert not ours()
    assert not ours()
    assert list(kernels.iterdir()) == []
    assert caplog.messages == [
        f"the cache {kernels} cannot be written (No space left on device): "
        "newly compiled code is not stored"
    ]


@pytest.mark.unix
def test_only_a_folder_of_this_user_alone_is_used(
    kernels: Path, monkeypatch: pytest.MonkeyPatch, caplog
):
    """The cache executes what it finds. Windows, which has no user numbers, uses its folder as it is."""
    before = os.umask(0)
    try:
        assert not ours()
    finally:
        os.umask(before)
    assert [stat.S_IMODE(path.stat().st_mode) for path in (kernels.parent, kernels)] == [0o700] * 2
    for folder in (kernels, kernels.parent):
        folder.chmod(0o770)
        assert not ours()
        assert not ours()
        folder.chmod(0o755)
        assert ours()
    user = os.getuid()
    with monkeypatch.context() as another:
        another.setattr(os, "getuid", lambda: user + 1)
        assert not ours()
    monkeypatch.delattr(os, "getuid")
    assert ours()
    assert caplog.messages == [
        f"the cache {kernels} is not used: other users may write to it; run chmod go-w on it",
        f"the cache {kernels.parent} is not used: other users may write to it; run chmod go-w on it",
        f"the cache {kernels.parent} is not used: another user owns it; "
        "set FUSELOG_CACHE to a folder of your own",
    ]


@pytest.mark.paper
def test_numba_is_imported_in_one_place_when_it_is_needed():
    """It is an extra, and a raw `njit(cache=True)` would not notice a change in another file."""
    rooms = ("fuselog", "pipeline", "recorders", "replay")
    users = {
        path.name
        for room in rooms
        for path in Path(room).rglob("*.py")
        if re.search(r"(?m)^ *(import|from) numba\b", path.read_text())
    }
    assert users == {"through_numba.py"}


def test_the_cache_folder_can_be_moved(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FUSELOG_CACHE", "/elsewhere")
    assert cache_folder() == Path("/elsewhere")
    monkeypatch.delenv("FUSELOG_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/xdg")
    assert cache_folder() == Path("/xdg/fuselog")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_folder() == Path.home() / ".cache" / "fuselog"


def twice(value: float) -> float:
    return 2.0 * value


def fill(run: int, values: np.ndarray, found: np.ndarray, work: np.ndarray) -> None:
    """Plain Python too: the same function, uncompiled, says what the compiled one must."""
    total = 0.0
    for k in range(len(work)):
        work[k] = twice(values[run, k])
        total += np.sqrt(work[k])
    found[run] = total


def test_the_loop_does_every_run_once_whatever_the_cores(on_cores: Callable[[int], None]):
    """Scratch memory is each core's own: a race would mix the runs."""
    loop = compile_over_runs(fill)
    values = np.random.default_rng(1).uniform(size=(503, 200))
    expected = np.empty(503)
    for run in range(503):
        fill(run, values, expected, np.empty(200))
    for cores in (1, 2, 7, 1000):
        on_cores(cores)
        found = np.full(503, np.nan)
        loop(503, values, found, scratch=lambda: np.empty(200))
        assert_array_equal(found, expected)
    loop(0, values, found, scratch=lambda: np.empty(200))


def root(run: int, values: np.ndarray, found: np.ndarray) -> None:
    found[run] = np.sqrt(values[run, 0])


TABLE = np.array([[1.0, 3.0], [0.5, -np.inf]])
TABLE.setflags(write=False)


@compiled
def from_table(row: int, column: int) -> float:
    """A function that Python and kernels call, around a table that nobody can change."""
    return TABLE[row, column]


def sorted_copy(run: int, values: np.ndarray, found: np.ndarray) -> None:
    found[run] = from_table(0, 1) * (np.sort(values[run])[:2] @ np.ones(2))


def copy(run: int, values: np.ndarray, found: np.ndarray) -> None:
    found[run] = from_table(0, 1) * values[run].copy()[1:].sum()


@pytest.mark.paper
def test_a_kernel_that_makes_arrays_is_numbas():
    values, found = np.array([[3.0, 1.0, 2.0]]), np.zeros(1)
    numba_over_runs(copy)(1, values, found)
    assert found[0] == 9.0 == 3.0 * from_table(0, 1)
    with pytest.raises(BadInput, match="cannot call sort, which needs allocates=True"):
        compile_over_runs(sorted_copy)(1, values, found)


def divide(run: int, values: np.ndarray, found: np.ndarray) -> None:
    found[run] = 1.0 / values[run]


def test_a_division_by_zero_is_infinity_and_stops_no_other_run():
    found = np.zeros(3)
    compile_over_runs(divide)(3, np.array([2.0, 0.0, 4.0]), found)
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
        compile_over_runs(kernel_of(scaled_by(scale)))(2, found[row])
    assert_array_equal(found[:, 1], [4, 6, 1, -np.inf])


def offset_by(scale: float) -> Callable[[float], float]:
    def offset(value: float) -> float:
        return scale + value

    return offset


@pytest.mark.parametrize("second", [1.5, 2.5])
def test_numbers_of_one_name_are_each_models_own(second: float):
    """Two models may each close over a `scale`, equal or not, and each keeps its own."""
    found = np.zeros(2)
    compile_over_runs(kernel_of(scaled_by(1.5), offset_by(second)))(2, found)
    assert_array_equal(found, [second, 1.5 + (second + 1)])


def test_what_numba_has_compiled_already_is_compiled_with_the_rest():
    found = np.zeros(2)
    compile_over_runs(kernel_of(numba.njit(twice)))(2, found)
    assert_array_equal(found, [0, 4])


def test_two_closures_of_one_function_stay_two():
    """A filter regresses its motion and its sensor by one function: the names must not run together."""
    found = np.zeros(3)
    compile_over_runs(kernel_of(scaled_by(2.0), scaled_by(3.0)))(3, found)
    assert_array_equal(found, [0, 5, 10])


def test_what_cannot_be_compiled_is_told_in_one_sentence():
    typed: dict[str, Callable] = {}
    exec("def typed(value): return value", typed)
    with pytest.raises(BadInput, match="the source of typed cannot be found"):
        compile_over_runs(kernel_of(typed["typed"]))(1, np.zeros(1))
    with pytest.raises(BadInput, match="is not a `def` function, as kernels have to be"):
        compile_over_runs(kernel_of(lambda value: value))(1, np.zeros(1))
    with pytest.raises(BadInput, match=r"uses the array 'scale', which could change: pass it as an arg"):
        numba_over_runs(kernel_of(scaled_by(np.ones(3))))(1, np.zeros(1))
    with pytest.raises(BadInput, match="kernel 'one' does not compile: No implementation of function"):
        numba_over_runs(kernel_of(twice))(1, "text")


FORKED = """
    import os
    import numpy as np
    from fuselog.recorders.compiling.compile import compile_over_runs

    def one(run, found, memory):
        memory[0] = run
        found[run] += memory[0]

    made, found = [], np.zeros(1000)

    def scratch():
        made.append(np.empty(1))
        return made[-1]

    loop = compile_over_runs(one)
    loop(1000, found, scratch=scratch)
    print(len(made), found.sum())
    child = os.fork()
    loop(1000, found, scratch=scratch)
    if child == 0:
        os._exit(int(found.sum() != 999000.0))
    print(os.waitpid(child, 0)[1])
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_cores_work_in_memory_of_their_own_also_in_a_forked_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Made once for each, and once to compile; a fork has none of the threads that its parent has."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", "2")
    told = imported(FORKED, tmp_path, tmp_path / "cache", "ignore")
    made, total = told[0].split()
    assert int(made) <= 3
    assert (float(total), told[1]) == (499500.0, "0")


@pytest.mark.parametrize("stored", [environment._STORED, None])
def test_a_variable_is_read_again_whenever_it_changes(
    stored: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment, "_STORED", stored)
    for value in ("1", "0", "", "1"):
        monkeypatch.setenv("FUSELOG_OF_A_TEST", value)
        assert environment.is_on("FUSELOG_OF_A_TEST") == (value == "1")
    monkeypatch.delenv("FUSELOG_OF_A_TEST")
    assert not environment.is_on("FUSELOG_OF_A_TEST")
