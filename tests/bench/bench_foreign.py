"""What a message costs a foreign filter beyond the filter's own time, for each way that it can be run.

The filter is that of docs/your-filter.md, with fixes; its own time is that of a loop in C that calls it
with columns which are ready. Least CPU time of this process and those that it starts; a filter in one of
its own runs once before, so that the process is there. Needs a C compiler and one for C++. Run it with
`make bench`, or `python -m tests.bench foreign`.
"""

import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil

from fuselog.recorders.log import RunMetadata, make_stream, schemas
from fuselog.recorders.recording import Recording
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import copied
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.foreign import filters
from fuselog.replay.foreign.naming import Allowed
from fuselog.replay.foreign.native.library import HEADER
from tests.docs.test_worked_pages import DOCS, blocks_of

Row = tuple[str, str, str, str]
MESSAGES, FEW = 1_000_000, 20_000
EXAMPLES, REFERENCE = DOCS / "your-filter", Path(__file__).parent / "reference"
LIMIT_NS = 150  # that the loop may add to a message


def main() -> list[Row]:
    """Nanoseconds per message beyond the filter's own, and the filter's own."""
    with tempfile.TemporaryDirectory() as folder:
        library, program, drive = compiled(Path(folder))
        log = fixes(MESSAGES)
        own_ns = own_time(drive, log)
        in_process = {"kind": "lib", "path": Allowed(library), "in_process": True}
        loop_ns = loop_time(in_process, log)
        assert loop_ns - own_ns <= LIMIT_NS
        ways: dict[str, tuple[dict[str, Any], int]] = {
            "in this process, with all around it": (in_process, MESSAGES),
            "in a process of its own": ({"kind": "lib", "path": Allowed(library)}, MESSAGES),
            "a program in C++ that answers": ({"kind": "exec", "command": Allowed(program)}, FEW),
            "a program in Python that answers": (walker(), FEW),
        }
        rows = [row(f"in this process, its loop; {MESSAGES} messages", loop_ns, own_ns)]
        for name, (settings, count) in ways.items():
            taken = replayed_ns(settings, log if count == MESSAGES else fixes(count))
            rows.append(row(f"{name}; {count} messages", taken, own_ns))
    return rows


def row(what: str, whole_ns: float, own_ns: float) -> Row:
    """A line of the table."""
    return what, f"{whole_ns - own_ns:.0f} ns", f"{own_ns:.0f} ns", f"{(whole_ns - own_ns) / own_ns:.1f}"


def compiled(folder: Path) -> tuple[Path, Path, Path]:
    """The library, the program, and the library with the loop that measures."""
    [source] = [block.text for block in blocks_of("your-filter") if block.file == "drifter.c"]
    (folder / "drifter.c").write_text(source, encoding="utf-8")
    flags = ["-O2", "-shared", "-fPIC", "-I", str(HEADER.parent)]
    made = [folder / name for name in ("drifter.so", "drifter", "drive.so")]
    library = [str(folder / "drifter.c"), "-lm"]
    commands = [
        ["cc", "-std=c99", *flags, *library, "-o", str(made[0])],
        ["c++", "-std=c++17", "-O2", str(EXAMPLES / "drifter.cpp"), "-o", str(made[1])],
        ["cc", "-std=c99", *flags, str(REFERENCE / "drive.c"), *library, "-o", str(made[2])],
    ]
    for command in commands:
        subprocess.run(command, check=True)
    return made[0], made[1], made[2]


def walker() -> dict[str, Any]:
    """The page's client in Python, with a filter that does next to nothing."""
    code = (
        "from client import serve\n"
        "class Still:\n"
        "    def __init__(self, parameters, seed): pass\n"
        "    def start(self, time_ns, mean, covariance): self.mean = [0.0, 0.0]\n"
        "    def take(self, topic, time_ns, fields): self.mean = fields[:2]\n"
        "    def state(self): return self.mean, [[1.0, 0.0], [0.0, 1.0]]\n"
        "serve({'summary': 'still', 'topics': [{'topic': 'fix', 'fields': ['position_m[2]']}],\n"
        "       'state': {'x_m': 'linear', 'y_m': 'linear'}}, Still)\n"
    )
    path = f"import sys; sys.path.insert(0, {str(EXAMPLES)!r})\n"
    return {"kind": "exec", "command": Allowed(f'{sys.executable} -c "{path}{code}"')}


def fixes(count: int) -> MemorySource:
    """A log of so many fixes."""
    stamps_ns = np.arange(count) * 10_000_000
    places = np.random.default_rng(1).normal(size=(count, 2)).cumsum(axis=0)
    spread = np.tile([1.0, 0.0, 0.0, 1.0], (count, 1))
    stream = make_stream(
        "/drifter/fix", schemas.POSITION_FIX, stamps_ns, position_m=places, covariance_m2=spread
    )
    return memory_source(Recording([stream]), RunMetadata("fixes", epoch_ns=0))


def own_time(path: Path, log: MemorySource) -> float:
    """Nanoseconds per message of the filter alone."""
    library = ctypes.CDLL(str(path))
    library.fuselog_filter_create.restype = ctypes.c_void_p
    stream = log["/drifter/fix"]
    count = len(stream)
    fields = np.ascontiguousarray(np.hstack([stream["position_m"], stream["covariance_m2"]]))
    results = [np.empty((count, width)) for width in (2, 4, 2, 4)]
    parameters = (ctypes.c_double * 1)(20.0)
    handle = ctypes.c_void_p(library.fuselog_filter_create(parameters, ctypes.c_uint64(0)))
    places = [ctypes.c_void_p(each.ctypes.data) for each in (stream.publish_time_ns, fields, *results)]

    def work() -> None:
        library.fuselog_filter_start(handle, ctypes.c_int64(0), None, None)
        status = library.drive(
            handle, ctypes.c_int64(count), *places[:2], ctypes.c_int64(6), *places[2:]
        )
        assert status == 0

    return least_ns(work, count)


def loop_time(settings: dict[str, Any], log: MemorySource) -> float:
    """Nanoseconds per message of fuselog's loop, with arrays that are ready."""
    calls: list[Callable[[], None]] = []
    follow_all = filters.follow_all

    def noting(
        library: Any, description: Any, static: Any, events: Any, carried: Any, made: Any
    ) -> None:
        handle = np.array([library.copy(int(carried.handle[0]))])
        beginning = copied(carried)._replace(handle=handle)
        follow_all(library, description, static, events, carried, made)

        def again() -> None:
            own = copied(beginning)
            made.estimates.end[:] = 0
            made.innovations.end[:] = 0
            follow_all(library, description, static, events, own, made)

        calls.append(again)

    with patch.object(filters, "follow_all", noting):
        bound = bind("drifter", [log], settings)
        for _ in replay([log], bound, block_messages=1 << 40):
            pass
        return least_ns(calls[0], MESSAGES)


def replayed_ns(settings: dict[str, Any], log: MemorySource) -> float:
    """Nanoseconds per message of a whole replay, from columns in memory to output streams."""
    count = len(log["/drifter/fix"])

    def work() -> None:
        made = collect(replay([log], bind("drifter", [log], settings)))
        assert len(made["/estimates/drifter/drifter/state"]) == count

    work()
    return least_ns(work, count, rounds=3)


def least_ns(work: Callable[[], None], count: int, rounds: int = 7) -> float:
    """The least CPU time of this process and its children, per message."""
    return min(cpu_of(work) for _ in range(rounds)) / count * 1e9


def cpu_of(work: Callable[[], None]) -> float:
    """CPU seconds of some work, those of processes that it uses or starts among them."""
    before = cpu_seconds()
    work()
    time.sleep(0.05)
    return cpu_seconds() - before


def cpu_seconds() -> float:
    """CPU seconds until now: of this process, its children that ended, and those that live."""
    own = os.times()
    living = 0.0
    for each in psutil.Process().children(recursive=True):
        times = each.cpu_times()
        living += times.user + times.system
    return sum(own[:4]) + living
