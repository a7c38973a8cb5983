"""Compiles filters in C for the tests of this room."""

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from fuselog.replay.foreign import native
from fuselog.replay.foreign.processes import orphans

HEADER = Path(native.__file__).parent
COMPILERS = {".c": ("cc", "-std=c99"), ".cpp": ("c++", "-std=c++17")}
EXAMPLES = Path(__file__).parents[3] / "docs" / "your-filter"
MISBEHAVING = Path(__file__).with_name("misbehaving.c")

Compile = Callable[..., Path]


@pytest.fixture(scope="session")
def compile_filter(tmp_path_factory: pytest.TempPathFactory) -> Compile:
    """Make a shared library of a source in C or C++, with macros defined; skips without a compiler."""
    folder = tmp_path_factory.mktemp("filters")

    def compile_it(source: Path, name: str = "", **defined: str | int) -> Path:
        compiler, standard = COMPILERS[source.suffix]
        if shutil.which(compiler) is None:
            pytest.skip(f"there is no compiler: {compiler}")
        made = folder / f"{name or source.stem}.so"
        if not made.exists():
            macros = [f"-D{key}={value}" for key, value in defined.items()]
            flags = (standard, "-O2", "-shared", "-fPIC", "-I", str(HEADER), *macros)
            command = [compiler, *flags, str(source), "-lm", "-o", str(made)]
            subprocess.run(command, check=True, capture_output=True, text=True)
        return made

    return compile_it


@pytest.fixture
def nothing_left() -> Iterator[None]:
    """No process of a filter is left behind, but for the one that guards against just that."""
    own = psutil.Process(os.getpid())

    def living() -> set[int]:
        found = own.children(recursive=True)
        living = [each for each in found if each.status() != psutil.STATUS_ZOMBIE]
        return {each.pid for each in living if orphans.__name__ not in each.cmdline()}

    before = living()
    yield
    began = time.monotonic()
    while living() - before:
        assert time.monotonic() < began + 20.0, "a filter's process is still there"
        time.sleep(0.05)
