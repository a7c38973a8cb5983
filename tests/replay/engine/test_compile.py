"""Kernels, ours and numba's, are compiled once, from wherever, and whatever the cache allows."""

import ast
import inspect
import os
import re
import stat
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.ros.files import ros1_file
from fuselog.recorders.importers.ulog import loops as ulog_loops
from fuselog.recorders.log import loops
from fuselog.replay.engine.compiling.cache import cache_folder, in_turn
from fuselog.replay.engine.compiling.compile import compile_over_runs, compiled, core_count
from fuselog.replay.engine.compiling.kernel_cache import load
from fuselog.replay.engine.compiling.kernels import native
from fuselog.replay.engine.compiling.kernels.native import Kernel
from fuselog.replay.engine.compiling.through_numba import loop_of
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
    from fuselog.replay.engine.compiling.through_numba import loop_of

    loop = loop_of(kernel(model))
    loop.of((columns,))(0, 3)
    print(*columns.found, "cached" if loop._loop.stats.cache_hits else "compiled")
"""
OURS = f"""{MODULE}
    from fuselog.replay.engine.compiling.kernels import native

    made, make = [], native._made
    native._made = lambda *given: made.append(given) or make(*given)
    native.Kernel(kernel(model)).of((columns,))(0, 3)
    print(*columns.found, "compiled" if made else "cached")
"""
BOTH = pytest.mark.parametrize(
    "module",
    [pytest.param(BY_NUMBA, marks=pytest.mark.paper, id="numba"), pytest.param(OURS, id="ours")],
)


def imported(module: str, folder: Path, cache: Path, action: str = "error") -> list[str]:
    """What the module prints when a new process imports it."""
    (folder / "third_party.py").write_text(textwrap.dedent(module))
    environment = {"HOME": str(folder), "FUSELOG_CACHE": str(cache)}
    return printed(["import third_party"], folder, environment, action)[0].splitlines()


@pytest.mark.paper
def test_a_new_process_finds_the_kernel_and_a_changed_model_is_compiled_anew(tmp_path: Path):
    """Neither a compilation at every start, nor the old model after a change; numba's are below."""
    cache = tmp_path / "cache"
    assert imported(OURS, tmp_path, cache)[0] == "1.0 4.0 7.0 compiled"
    assert imported(OURS, tmp_path, cache)[0] == "1.0 4.0 7.0 cached"
    changed = OURS.replace("value + 1.0", "value - 1.0")
    assert imported(changed, tmp_path, cache)[0] == "-1.0 2.0 5.0 compiled"


# Keeps the others waiting until it is killed.
HOLDER = """
    import sys
    from pathlib import Path
    from fuselog.replay.engine.compiling.cache import cache_folder, in_turn

    with in_turn(Path(sys.argv[1])):
        print("held", flush=True)
        input()
"""


def started(text: str, *arguments: str | Path) -> subprocess.Popen[str]:
    """A process of its own with this program, with the environment of this one."""
    command = [sys.executable, "-c", textwrap.dedent(text), *map(str, arguments)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


@BOTH
@pytest.mark.paper
def test_of_two_processes_that_want_a_kernel_one_compiles(tmp_path: Path, kernels: Path, module: str):
    """The other waits, and loads what the first has kept; no lock is left behind."""
    ready = (  # both are, before either compiles
        "    import os, pathlib, time\n"
        "    pathlib.Path(f'ready-{os.getpid()}').touch()\n"
        "    while len(list(pathlib.Path().glob('ready-*'))) < 2: time.sleep(0.01)\n"
    )
    together = re.sub(r"(?m)^    (loop|native\.Kernel).*\.of\(", lambda line: ready + line[0], module)
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
    monkeypatch.setattr("fuselog.replay.engine.compiling.cache._TURN_S", 0.1)
    with in_turn(path) as waited:
        assert waited
    holder.kill()
    holder.communicate()
    with in_turn(path) as waited:
        assert not waited


# A function that numba compiles by what another module says of it.
EXTENSION = """
    from numba.extending import overload

    def gain(value):
        raise NotImplementedError("never called: numba is told below what it does")

    @overload(gain)
    def compiled_gain(value):
        return lambda value: 3.0 * value
"""


@pytest.mark.paper
def test_a_new_process_finds_numbas_kernel_and_a_changed_one_is_compiled_anew(tmp_path: Path):
    """Also what it imports by name: numba by itself looks at the file of the kernel alone."""
    cache = tmp_path / "cache"
    user = BY_NUMBA.replace("GAIN = 3.0", "from extension import gain").replace(
        "GAIN * value", "gain(value)"
    )
    changed, less = EXTENSION.replace("3.0", "5.00"), user.replace("value) + 1.0", "value) - 1.0")
    for extension, module, expected in (
        (EXTENSION, user, "1.0 4.0 7.0 compiled"),
        (EXTENSION, user, "1.0 4.0 7.0 cached"),
        (changed, user, "1.0 6.0 11.0 compiled"),
        (changed, less, "-1.0 4.0 9.0 compiled"),
    ):
        (tmp_path / "extension.py").write_text(textwrap.dedent(extension))
        assert imported(module, tmp_path, cache)[0] == expected


CALLED_FROM_PYTHON = """
    import numpy as np
    from model import moved
    from fuselog.replay.engine.compiling.compile import compiled

    @compiled
    def kernel(given, found):
        for k in range(len(given)):
            found[k] = moved(given[k])

    found = np.zeros(3)
    kernel(np.arange(3.0), found)
    print(*found)
"""


@pytest.mark.paper
def test_a_change_in_another_file_is_noticed(tmp_path: Path):
    """Which numba by itself does not see."""
    cache = tmp_path / "cache"
    for change, expected in ((1.0, "1.0 2.0 3.0"), (2.0, "2.0 3.0 4.0")):
        (tmp_path / "model.py").write_text(f"def moved(x):\n    return x + {change}\n")
        assert imported(CALLED_FROM_PYTHON, tmp_path, cache) == [expected]


@BOTH
@pytest.mark.paper
def test_the_order_of_a_named_tuples_fields_is_part_of_a_kernel(tmp_path: Path, module: str):
    cache = tmp_path / "cache"
    head, rest = module.split("class Columns(NamedTuple):")
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


@BOTH
def test_a_cache_that_cannot_be_written_does_not_stop_the_work(tmp_path: Path, module: str):
    """The kernel is compiled for this process alone, and nothing is left behind."""
    (tmp_path / "file").touch()
    assert imported(module, tmp_path, tmp_path / "file" / "cache") == ["1.0 4.0 7.0 compiled"]
    assert {path.name for path in tmp_path.iterdir()} == {"file", "third_party.py"}


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; where its kernels will lie."""
    monkeypatch.setenv("FUSELOG_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "kernels"


def by_numba() -> bool:
    """Whether numba's kernel, which gives the right number, is loaded rather than compiled."""
    load.cache_clear()
    loop, found = loop_of(divide), np.zeros(1)
    loop.of((np.array([4.0]), found))(0, 1)
    assert found[0] == 0.25
    return bool(loop._loop.stats.cache_hits)


def ours() -> bool:
    """The same of our own kernel."""
    made, found, make = [], np.zeros(1), native._made
    with pytest.MonkeyPatch.context() as counted:
        counted.setattr(native, "_made", lambda *given: made.append(given) or make(*given))
        Kernel(divide).of((np.array([4.0]), found))(0, 1)
    assert found[0] == 0.25
    return not made


EITHER = pytest.mark.parametrize(
    "found_in_the_cache", [pytest.param(by_numba, marks=pytest.mark.paper), ours]
)


# numba's are read by the same function, and looked into by another
# whoever forgets the checksum fails at the first, before a cut file crashes him
@pytest.mark.parametrize(
    ("found_in_the_cache", "damage"),
    [
        *((ours, damage) for damage in ("unlike its checksum", "emptied", "cut", "flipped", "not ours")),
        (ours, "another kernel's"),
        pytest.param(by_numba, "flipped", marks=pytest.mark.paper),
        pytest.param(by_numba, "another kernel's", marks=pytest.mark.paper),
    ],
)
@pytest.mark.paper
def test_a_damaged_file_is_compiled_anew_and_replaced(
    kernels: Path, damage: str, found_in_the_cache: Callable[[], bool]
):
    """As a loss of power leaves it; what is executed has to be what was written."""
    assert not found_in_the_cache()
    assert found_in_the_cache()
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
        another = Kernel(root) if found_in_the_cache is ours else loop_of(root)
        another.of((values, found))(0, 1)
        (other,) = set(kernels.iterdir()) - {path}
        other.replace(path)
    assert not found_in_the_cache()
    assert found_in_the_cache()
    assert list(kernels.iterdir()) == [path]


@pytest.mark.paper
@pytest.mark.usefixtures("kernels")
def test_a_class_that_is_gone_is_compiled_anew(monkeypatch: pytest.MonkeyPatch):
    """A whole file that cannot be loaded all the same."""
    assert not by_numba()
    with monkeypatch.context() as broken:
        broken.setattr("fuselog.replay.engine.compiling.kernel_cache.pickle.loads", lambda _: 1 / 0)
        assert not by_numba()
    assert by_numba()


@EITHER
def test_a_full_disk_is_said_once(
    kernels: Path, monkeypatch: pytest.MonkeyPatch, caplog, found_in_the_cache: Callable[[], bool]
):
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    assert not found_in_the_cache()
    assert not found_in_the_cache()
    assert list(kernels.iterdir()) == []
    assert caplog.messages == [
        f"the cache {kernels} cannot be written (No space left on device): "
        "what is compiled now is not kept"
    ]


@EITHER
@pytest.mark.unix
def test_only_a_folder_of_this_user_alone_is_used(
    kernels: Path, monkeypatch: pytest.MonkeyPatch, caplog, found_in_the_cache: Callable[[], bool]
):
    """The cache executes what it finds. Windows, which has no user numbers, uses its folder as it is."""
    before = os.umask(0)
    try:
        assert not found_in_the_cache()
    finally:
        os.umask(before)
    assert [stat.S_IMODE(path.stat().st_mode) for path in (kernels.parent, kernels)] == [0o700] * 2
    for folder in (kernels, kernels.parent):
        folder.chmod(0o770)
        assert not found_in_the_cache()
        assert not found_in_the_cache()
        folder.chmod(0o755)
        assert found_in_the_cache()
    user = os.getuid()
    with monkeypatch.context() as another:
        another.setattr(os, "getuid", lambda: user + 1)
        assert not found_in_the_cache()
    monkeypatch.delattr(os, "getuid")
    assert found_in_the_cache()
    assert caplog.messages == [
        f"the cache {kernels} is not used: other users may write to it; chmod go-w forbids them",
        f"the cache {kernels.parent} is not used: other users may write to it; chmod go-w forbids them",
        f"the cache {kernels.parent} is not used: another user owns it; set FUSELOG_CACHE to your own",
    ]


@pytest.mark.paper
def test_every_kernel_of_replay_is_compiled_here():
    """A raw `njit(cache=True)` would not notice a change in another file."""
    users = {path.name: path for path in Path("replay").rglob("*.py") if "numba" in imports_of(path)}
    assert users.keys() == {"inlining.py", "kernel_cache.py", "kernel_source.py", "through_numba.py"}


@pytest.mark.parametrize(
    ("module", "names"),
    [
        (loops, {"_scan", "_agree"}),
        (ros1_file, {"_scan", "_number"}),
        (ulog_loops, {"_resume", "_sort", "_walk"}),
    ],
    ids=["loops", "ros1_file", "ulog_loops"],
)
def test_the_loops_of_recorders_call_nothing_outside_their_file(module: ModuleType, names: set[str]):
    """Numba caches them, since recorders know no replay, and notices a change in their own file only."""
    source = inspect.getsource(module)
    compiled = re.findall(r"(?:^@njit.*\ndef |loop_for\()(_\w+)", source, re.MULTILINE)
    assert {*compiled} == names
    kernels = [vars(module)[name] for name in names]
    for kernel in kernels:
        outside = dict(inspect.getclosurevars(getattr(kernel, "py_func", kernel)).globals)
        assert outside.pop("np", np) is np
        assert all(type(value) is int or value in kernels for value in outside.values())


def test_recorders_have_no_other_loops():
    users = {path.stem for path in Path("recorders").rglob("*.py") if "numba" in imports_of(path)}
    assert users == {"loops", "ros1_file"}


def imports_of(path: Path) -> set[str]:
    """The top-level names of the modules that a file imports; none where it does not speak of numba."""
    if "numba" not in (text := path.read_text()):
        return set()
    nodes = list(ast.walk(ast.parse(text)))
    named = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    taken = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
    return {name.partition(".")[0] for name in named + taken}


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
    loop = compile_over_runs(fill, allocates=False)
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


def sorted_copy(run: int, values: np.ndarray, found: np.ndarray) -> None:
    found[run] = np.sort(values[run])[:2] @ np.ones(2)


def test_a_kernel_that_allocates_says_so():
    """With the default it may use what makes arrays; one that says that it makes none must not."""
    values, found = np.array([[3.0, 1.0, 2.0]]), np.zeros(1)
    compile_over_runs(sorted_copy)(1, values, found)
    assert found[0] == 3.0
    with pytest.raises(BadInput, match="cannot call sort; others have allocates=True"):
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


TABLE = np.array([[1.0 + 2.0j, 3.0], [0.1, -np.inf]])
TABLE.setflags(write=False)


@compiled
def from_table(row: int, column: int) -> complex:
    """A kernel that other kernels use, around a table that nobody can change."""
    return TABLE[row, column]


@compiled
def columns_of(row: int) -> np.ndarray:
    return np.array([from_table(row, 0), from_table(row, 1)])


def test_a_compiled_function_serves_python_and_other_kernels():
    assert from_table(0, 0) == 1.0 + 2.0j
    assert_array_equal(columns_of(1), TABLE[1])
    with pytest.raises(ValueError, match="read-only"):
        TABLE[0, 0] = 0.0


def through_a_module(run: int, found: np.ndarray) -> None:
    found[run] = loops.HEAD_BYTES


def test_two_closures_of_one_function_stay_two():
    """A filter regresses its motion and its sensor by one function: the names must not run together."""
    found = np.zeros(3)
    compile_over_runs(kernel_of(scaled_by(2.0), scaled_by(3.0)), allocates=False)(3, found)
    assert_array_equal(found, [0, 5, 10])


def test_what_cannot_be_compiled_is_told_in_one_sentence():
    typed: dict[str, Callable] = {}
    exec("def typed(value): return value", typed)
    with pytest.raises(BadInput, match="the source of typed cannot be found"):
        compile_over_runs(kernel_of(typed["typed"]))
    with pytest.raises(BadInput, match="is not a `def` function, of which kernels are made"):
        compile_over_runs(kernel_of(lambda value: value))
    with pytest.raises(BadInput, match=r"uses 'scale', a ndarray, .* pass it as an argument"):
        compile_over_runs(kernel_of(scaled_by(np.ones(3))))
    with pytest.raises(
        BadInput, match=r"the module fuselog.recorders.log.loops: import what it needs by"
    ):
        compile_over_runs(through_a_module)
    with pytest.raises(BadInput, match="kernel 'one' does not compile: No implementation of function"):
        compile_over_runs(kernel_of(twice))(1, "text")


FORKED = """
    import os
    import numpy as np
    from fuselog.replay.engine.compiling.compile import compile_over_runs

    def one(run, found, memory):
        memory[0] = run
        found[run] += memory[0]

    made, found = [], np.zeros(1000)

    def scratch():
        made.append(np.empty(1))
        return made[-1]

    loop = compile_over_runs(one, allocates=False)
    loop(1000, found, scratch=scratch)
    print(len(made), found.sum())
    child = os.fork()
    loop(1000, found, scratch=scratch)
    if child == 0:
        os._exit(int(found.sum() != 999000.0))
    print(os.waitpid(child, 0)[1])
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_cores_work_in_memory_of_their_own_also_in_a_forked_process(tmp_path: Path):
    """Made once for each, and once to compile; a fork has none of the threads that its parent has."""
    told = imported(FORKED, tmp_path, tmp_path / "cache", "ignore")
    made, total = told[0].split()
    assert int(made) <= core_count() + 1
    assert (float(total), told[1]) == (499500.0, "0")
