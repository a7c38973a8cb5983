"""Runs programs in processes of their own, which have imported what compiles and compiled nothing yet.

They are forked from one that has imported it, where there is a fork: importing numba takes longer than
what these programs do.
"""

import io
import os
import sys
import traceback
import warnings
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing import get_all_start_methods, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

_CONTEXT: Any = get_context("forkserver" if "forkserver" in get_all_start_methods() else "spawn")
_CONTEXT.set_forkserver_preload(
    [
        "fuselog.recorders.compiling.compile",
        "fuselog.replay.engine.through_numba",
        "numba.core.typing.npydecl",
        __name__,
    ]
)


def printed(
    programs: Sequence[str], folder: Path, environment: Mapping[str, str], action: str = "error"
) -> list[str]:
    """What programs print that run at the same time in a folder; `action` is done about warnings."""
    running = []
    for program in programs:
        ours, theirs = _CONTEXT.Pipe(duplex=False)
        process = _CONTEXT.Process(
            target=_run, args=(theirs, program, str(folder), dict(environment), action)
        )
        process.start()
        theirs.close()
        running.append((process, ours))
    told = [connection.recv() for _, connection in running]
    for process, _ in running:
        process.join()
    for _, fault in told:
        assert not fault, fault
    return [text for text, _ in told]


def _run(
    told: Connection, program: str, folder: str, environment: Mapping[str, str], action: Any
) -> None:
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path.insert(0, folder)
    sys.dont_write_bytecode = True  # a file changed within a second would be run as it was
    said, fault = io.StringIO(), ""
    with warnings.catch_warnings(), redirect_stdout(said), redirect_stderr(None):
        warnings.simplefilter(action)
        try:
            exec(program, {"__name__": "__main__"})
        except BaseException:
            fault = traceback.format_exc()
    told.send((said.getvalue(), fault))
