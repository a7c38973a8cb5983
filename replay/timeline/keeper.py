"""Launcher of `rerun ARGUMENTS` that ends when the other end of its standard input is closed.

The operating system closes the pipe when its owner ends for any reason, so no viewer outlives the
fuselog process that started it.
"""

import os
import sys
import threading
import time

import psutil
import rerun_cli.__main__ as rerun


def _end_with_the_holder() -> None:
    os.read(0, 1)  # not sys.stdin, which could not be closed while a thread reads it
    while True:  # a child may be about to start
        for child in psutil.Process().children(recursive=True):
            child.terminate()
        time.sleep(0.1)


if __name__ == "__main__":
    threading.Thread(target=_end_with_the_holder, daemon=True).start()
    sys.exit(rerun.main())
