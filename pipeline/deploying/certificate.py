"""What a step of a filter in C costs: operations, counted in its graphs, and memory, by the compiler."""

import json
import re
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from pipeline.deploying.c_source.names import CFilter
from pipeline.deploying.costs import NOTHING, Cost, added, costs_of

CERTIFICATE = "certificate.json"
OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off")


class Memory(NamedTuple):
    """Holds what a compiler makes of a filter.

    Attributes:
        compiler: its name, version and target.
        text: bytes of code and constants.
        stack: bytes that the deepest chain of calls takes, without libm's own.
    """

    compiler: str
    text: int
    stack: int


class Certificate(NamedTuple):
    """Holds what a filter costs.

    Attributes:
        steps: the cost of the functions of the C, by name.
        worst: of a prediction and the costliest update after it.
        dense, sparse: flops of the products F P F', P H' and H P H' of all steps, or of F L and H L of a
            factor L, with all entries of F and H, and without those that are known to be zero or one.
        memory: None without a compiler that tells it.
    """

    steps: Mapping[str, Cost]
    worst: Cost
    dense: int
    sparse: int
    memory: Memory | None


def certificate_of(made: CFilter, source: str, header: str) -> Certificate:
    """Count what a filter costs, and have its C compiled where there is a compiler.

    Args:
        made: the filter.
        source: its C.
        header: its header.
    """
    steps, products = costs_of(made)
    updates = [cost for name, cost in steps.items() if name != "predict"]
    worst = added(steps["predict"], max(updates, default=NOTHING))
    dense, sparse = (sum(each[place].flops for each in products) for place in (0, 1))
    return Certificate(steps, worst, dense, sparse, _memory(made.name, source, header))


def certificate_text(made: CFilter, certificate: Certificate) -> str:
    """Write certificate.json."""
    memory = certificate.memory
    text = {
        "filter": made.name,
        "digest": made.digest,
        "steps": {name: cost._asdict() for name, cost in certificate.steps.items()},
        "worst": certificate.worst._asdict(),
        "products": {"dense_flops": certificate.dense, "flops": certificate.sparse},
        "memory": None if memory is None else memory._asdict(),
    }
    return json.dumps(text, indent=2) + "\n"


def _memory(name: str, source: str, header: str) -> Memory | None:
    """Compile a filter; None without a GCC that tells what its functions call and need (10 or newer)."""
    compiler = shutil.which("gcc")
    if compiler is None:
        return None
    with TemporaryDirectory() as place:
        folder = Path(place)
        (folder / f"{name}.c").write_text(source, encoding="utf-8")
        (folder / f"{name}.h").write_text(header, encoding="utf-8")

        def said(*command: str) -> str:
            return subprocess.run(
                command, cwd=folder, capture_output=True, text=True, check=True, encoding="utf-8"
            ).stdout

        try:
            said(compiler, *OPTIONS, "-fcallgraph-info=su", "-c", f"{name}.c")
            version, target = said(compiler, "-dumpfullversion"), said(compiler, "-dumpmachine")
            sizes = said("size", f"{name}.o").splitlines()[1].split()
            calls = next(folder.glob("*.ci")).read_text(encoding="utf-8")
        except (OSError, subprocess.CalledProcessError, IndexError, StopIteration):
            return None
    return Memory(f"gcc {version.strip()} for {target.strip()}", int(sizes[0]), deepest_stack(calls))


def deepest_stack(calls: str) -> int:
    """Find how many bytes the deepest chain of calls takes.

    Args:
        calls: a call graph with stack usage, as GCC writes it (`-fcallgraph-info=su`). What is called
            and not compiled with it, as libm's functions, counts nothing.
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
