"""The cost of a step of a filter in C: operations in its graphs, and memory used by compiled code."""

import json
import math
import re
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from fuselog.pipeline.deploying.c_source.names import CFilter
from fuselog.pipeline.deploying.costs import NOTHING, Cost, added, costs_of

CERTIFICATE = "certificate.json"
OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off")


class Memory(NamedTuple):
    """A filter's memory, as reported by the compiler.

    Attributes:
        compiler: its name, version and target.
        text: bytes of code and constants.
        stack: bytes of stack in the deepest chain of calls, not counting functions of libm.
    """

    compiler: str
    text: int
    stack: int


class Single(NamedTuple):
    """The effect of single precision on the results for the log with which the filter is tested.

    Attributes:
        estimates: number of estimates compared with the estimates in double precision.
        furthest: largest difference of an entry of means and covariances, relative to the entry or to
            one, whichever is larger.
        lost_event, lost_s: the event, and its time after the start, at which the covariance stops being
            positive definite in single precision but not in double; None if there is no such event.
    """

    estimates: int
    furthest: float
    lost_event: int | None
    lost_s: float | None


class Certificate(NamedTuple):
    """The cost of a filter.

    Attributes:
        steps: the cost of the C functions, by name.
        worst: the cost of a prediction plus that of the costliest update.
        dense, sparse: flops of the products F P F', P H' and H P H' of all steps (of F L and H L for a
            factor L), counted once with all entries of F and H, and once without the entries known to be
            zero or one.
        memory: memory of the compiled filter; None if the compiler does not report it.
        single: effect of single precision; None if the filter has double precision, or if there is no
            compiler.
    """

    steps: Mapping[str, Cost]
    worst: Cost
    dense: int
    sparse: int
    memory: Memory | None
    single: Single | None


def certificate_of(made: CFilter, files: Mapping[str, str]) -> Certificate:
    """Count the operations of a filter, compile its C code, and test it in single precision.

    Args:
        made: the filter.
        files: its C code and its test, by file name.
    """
    steps, products = costs_of(made)
    updates = [cost for name, cost in steps.items() if name != "predict"]
    worst = added(steps["predict"], max(updates, default=NOTHING))
    dense, sparse = (sum(each[place].flops for each in products) for place in (0, 1))
    memory, single = _compiled(made, files)
    return Certificate(steps, worst, dense, sparse, memory, single)


def certificate_text(made: CFilter, certificate: Certificate) -> str:
    """Write the text of certificate.json."""
    memory, single = certificate.memory, certificate.single
    text = {
        "filter": made.name,
        "digest": made.digest,
        "is_root": made.is_root,
        "states": made.states,
        "steps": {name: cost._asdict() for name, cost in certificate.steps.items()},
        "worst": certificate.worst._asdict(),
        "products": {"dense_flops": certificate.dense, "flops": certificate.sparse},
        "memory": None if memory is None else memory._asdict(),
        "single": None if single is None else single._asdict(),
    }
    return json.dumps(text, indent=2) + "\n"


def _compiled(made: CFilter, files: Mapping[str, str]) -> tuple[Memory | None, Single | None]:
    """Compile a filter and test it in single precision; return None without a suitable compiler."""
    compiler = shutil.which("gcc")
    if compiler is None:
        return None, None
    with TemporaryDirectory() as place:
        folder = Path(place)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
        memory = _memory(compiler, folder, made.name)
        return memory, _single(compiler, folder, made.name) if made.precision.ending else None


def _output_of(folder: Path, *command: str | Path, check: bool = True) -> str:
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=check, encoding="utf-8"
    ).stdout


def _memory(compiler: str, folder: Path, name: str) -> Memory | None:
    """Compile a filter and measure its memory; return None if GCC before 10 does not report it."""
    try:
        _output_of(folder, compiler, *OPTIONS, "-fcallgraph-info=su", "-c", f"{name}.c")
        version, target = (
            _output_of(folder, compiler, "-dumpfullversion"),
            _output_of(folder, compiler, "-dumpmachine"),
        )
        sizes = _output_of(folder, "size", f"{name}.o").splitlines()[1].split()
        calls = next(folder.glob("*.ci")).read_text(encoding="utf-8")
    except (OSError, subprocess.CalledProcessError, IndexError, StopIteration):
        return None
    return Memory(f"gcc {version.strip()} for {target.strip()}", int(sizes[0]), deepest_stack(calls))


def _single(compiler: str, folder: Path, name: str) -> Single | None:
    """Run a filter's test, or return None if the test cannot be built on this machine."""
    program = folder / "tried"
    try:
        _output_of(folder, compiler, *OPTIONS, f"test_{name}.c", f"{name}.c", "-lm", "-o", program)
        output = _output_of(folder, program, check=False)
    except (OSError, subprocess.CalledProcessError):
        return None
    compared = re.search(r"(\d+) estimates: furthest ([^,]+),", output)
    lost = re.search(r"event (\d+), after ([^ ]+) s: the covariance is no longer", output)
    return Single(
        int(compared[1]) if compared else 0,
        float(compared[2]) if compared else math.inf,
        int(lost[1]) if lost else None,
        float(lost[2]) if lost else None,
    )


def deepest_stack(calls: str) -> int:
    """Compute the bytes of stack in the deepest chain of calls.

    Args:
        calls: a call graph with stack usage, as GCC writes it (`-fcallgraph-info=su`). Functions that
            are compiled without this option, such as libm's, are not counted.
    """
    own = {
        name: int(size)
        for name, size in re.findall(r'node: { title: "([^"]+)" label: "[^"]*?(\d+) bytes', calls)
    }
    edges = set(re.findall(r'edge: { sourcename: "([^"]+)" targetname: "([^"]+)"', calls))

    @cache
    def depth(name: str) -> int:
        below = [depth(called) for caller, called in edges if caller == name and called in own]
        return own[name] + max(below, default=0)

    return max(map(depth, own), default=0)
