"""Runs a library's filters in a process of its own: what they break breaks this process alone.

It is started by `isolation`, takes tasks as lines of JSON, and ends when its standard input does. The
library finds nothing to read there, and what it prints goes nowhere.
"""

import json
import os
import threading
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from fuselog.recorders.errors import BadInput
from fuselog.replay.foreign.native.library import Library

IDLE_S = 5.0  # after so long without work it ends
IDLE = 86  # the exit code then


def main() -> None:
    """Do tasks until there are no more."""
    own_input, own_output = os.dup(0), os.dup(1)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1, 2):
        os.dup2(nowhere, number)
    tasks: SimpleQueue[bytes] = SimpleQueue()
    with os.fdopen(own_input, "rb") as given, os.fdopen(own_output, "wb") as answers:

        def listen() -> None:
            for line in given:
                tasks.put(line)
            os._exit(0)  # whoever started this is gone, or wants no more

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
    """Return the library of a task; one that has changed since is for another process to load."""
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
    """Take one run through its filter; see `isolation.follow_apart`."""
    from fuselog.replay.foreign.processes.tasks import (
        follow_task,
    )  # NumPy and the compiler, which describing needs not

    return follow_task(_library(task), Path(task["folder"]))


if __name__ == "__main__":
    main()
