"""Worker process for the filters of a library; a crash of a filter ends only this process.

`isolation` starts the process, which reads tasks as lines of JSON and ends at the end of its standard
input. The library cannot read this standard input, and everything that it prints is discarded.
"""

import json
import os
import threading
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from fuselog.recorders.errors import BadInput
from fuselog.replay.foreign.native.library import Library

IDLE_S = 5.0  # time without work after which the process ends
IDLE = 86  # exit code in this case


def main() -> None:
    """Process tasks until there are no more."""
    own_input, own_output = os.dup(0), os.dup(1)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nowhere, number)
    tasks: SimpleQueue[bytes] = SimpleQueue()
    with os.fdopen(own_input, "rb") as given, os.fdopen(own_output, "wb") as answers:

        def listen() -> None:
            for line in given:
                tasks.put(line)
            os._exit(0)  # the parent process has ended or no longer needs this one

        threading.Thread(target=listen, daemon=True).start()
        while True:
            try:
                task = json.loads(tasks.get(timeout=IDLE_S))
            except Empty:
                os._exit(IDLE)
            try:
                answer = _describe(task) if "folder" not in task else _follow(task)
            except BadInput as error:
                answer = {"refused": str(error)}
            answers.write(json.dumps(answer).encode() + b"\n")
            answers.flush()


def _library(task: dict[str, Any]) -> Library:
    """Load the library of a task; end the process if the library has changed since it was loaded."""
    path, state = task["library"], task["state"]
    if path in _LOADED and _LOADED[path][0] != state:
        os._exit(IDLE)
    if path not in _LOADED:
        _LOADED[path] = state, Library(Path(path))
    return _LOADED[path][1]


_LOADED: dict[str, tuple[list[int], Library]] = {}


def _describe(task: dict[str, Any]) -> dict[str, Any]:
    return {"description": _library(task).description.decode(errors="replace")}


def _follow(task: dict[str, Any]) -> dict[str, Any]:
    """Process one run with its filter; see `isolation.follow_apart`."""
    # imported here, because reading a description needs neither NumPy nor the compiler
    from fuselog.replay.foreign.processes.tasks import follow_task

    return follow_task(_library(task), Path(task["folder"]))


if __name__ == "__main__":
    main()
