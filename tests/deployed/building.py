"""Builds deployed filters, and asks them how far they are from the replay."""

import re
import shutil
import subprocess
from pathlib import Path

COMPILERS = [each for each in ("gcc", "clang") if shutil.which(each)]
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror")
STRICT = ("-std=c99", "-O2", "-ffp-contract=off", *WARNINGS)


def compiled(folder: Path, *options: str, compiler: str = "") -> Path:
    """Build the test program, or with `-shared` the library."""
    name = folder.name
    is_library = "-shared" in options
    out = folder.parent / (f"{name}.so" if is_library else f"test_{name}")
    [first] = folder.glob("*_replay.c" if is_library else "test_*.c")
    source = folder / f"{first.stem.removeprefix('test_').removesuffix('_replay')}.c"
    subprocess.run(
        [compiler or COMPILERS[0], *STRICT, *options, first, source, "-lm", "-o", out], check=True
    )
    return out


def furthest(program: Path) -> float:
    """How far the program finds its estimates from fuselog's; there have to be some."""
    said = subprocess.run([program, "1e300"], capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout + said.stderr
    assert not said.stderr
    found = re.match(r"(\d+) updates, (\d+) estimates: furthest (\S+),", said.stdout)
    assert found is not None, said.stdout
    assert int(found[1]) > 0
    assert int(found[2]) > 0
    return float(found[3])
