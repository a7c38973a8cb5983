"""Compiles filters in C for the tests of this room."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

import replay.foreign

HEADER = Path(replay.foreign.__file__).parent
COMPILERS = {".c": ("cc", "-std=c99"), ".cpp": ("c++", "-std=c++17")}
EXAMPLES = Path(__file__).parents[3] / "docs" / "foreign"
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
