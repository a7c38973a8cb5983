"""Builds deployed filters, and asks them how far they are from the replay."""

import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from fuselog.pipeline.deploying.c_target import target_lines

COMPILERS = [each for each in ("gcc", "clang") if shutil.which(each)]
WARNINGS = (
    *("-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wfloat-equal", "-Wshadow"),
    *("-pedantic", "-Werror"),
)
SANITIZERS = ("-fsanitize=address,undefined", "-O0")  # -O0: they find as much, in a third of the time
STRICT = ("-std=c99", "-O2", "-ffp-contract=off", *WARNINGS)


@cache
def sanitizes(compiler: str) -> bool:
    """Whether the compiler has the sanitizers' libraries, which Debian packs by themselves for clang."""
    with TemporaryDirectory() as place:
        source = Path(place) / "nothing.c"
        source.write_text("int main(void) { return 0; }")
        command = [compiler, *SANITIZERS, str(source), "-o", f"{source}.out"]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0


class Taken(NamedTuple):
    """Holds what a filter took on the emulated target: instructions of a message, average and most.

    And how far it was from the replay.
    """

    average: int
    most: int
    furthest: float


def compiled(folder: Path, *options: str, compiler: str = "") -> Path:
    """Build the test program, or with `-shared` the library."""
    is_library = "-shared" in options
    [first] = folder.glob("*_replay.c" if is_library else "test_*.c")
    source = folder / f"{first.stem.removeprefix('test_').removesuffix('_replay')}.c"
    out = folder.parent / (f"{folder.name}.so" if is_library else f"test_{folder.name}")
    subprocess.run(
        [compiler or COMPILERS[0], *STRICT, *options, first, source, "-lm", "-o", out], check=True
    )
    return out


def furthest(program: Path) -> float:
    """How far the program finds its estimates from fuselog's; there have to be some."""
    said = subprocess.run([program, "1e300"], capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout + said.stderr
    assert not said.stderr
    return _compared(said.stdout)


def furthest_of_all(folder: Path) -> float:
    """The furthest of programs by all compilers, and with sanitizers, which say nothing."""
    found = []
    for compiler in COMPILERS:
        found.append(furthest(compiled(folder, compiler=compiler)))
        if sanitizes(compiler):
            found.append(furthest(compiled(folder, *SANITIZERS, compiler=compiler)))
    return max(found)


def _compared(said: str) -> float:
    found = re.match(r"(\d+) updates, (\d+) estimates: furthest (\S+),", said)
    assert found is not None, said
    assert int(found[1]) > 0
    assert int(found[2]) > 0
    return float(found[3])


def missing_of_target() -> str:
    """What is missing of that which builds for the target and runs it, as Debian's packages."""
    needed = {"gcc-arm-none-eabi": "arm-none-eabi-gcc", "qemu-system-arm": "qemu-system-arm"}
    missing = [package for package, program in needed.items() if not shutil.which(program)]
    if "gcc-arm-none-eabi" not in missing:
        asked = ("arm-none-eabi-gcc", "-print-file-name=rdimon.specs")
        said = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
        missing += [] if Path(said.strip()).is_file() else ["libnewlib-arm-none-eabi"]
    return ", ".join(missing)


def on_target(folder: Path, away: float) -> Taken:
    """Build a filter's test for a Cortex-M4F, and run it there; it may be so far from the replay."""
    [program] = folder.glob("test_*.c")
    name = program.stem.removeprefix("test_")
    build, run = (line.split() for line in target_lines(name, argument=str(away)))
    subprocess.run(build, cwd=folder, check=True)
    found = subprocess.run(run, cwd=folder, capture_output=True, text=True, timeout=60, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    taken = re.search(r"(\d+) instructions for a message, at most (\d+)", found.stdout)
    assert taken is not None
    return Taken(int(taken[1]), int(taken[2]), _compared(found.stdout))
