"""Starts Python in further processes, which import nothing from the folder that fuselog runs in.

Python puts the current folder first on the path of `python -m` and `python -c`. In a folder of somebody
else, a file such as `random.py` would then run in place of the standard library's.
"""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

from fuselog.recorders.errors import BadInput

# Where fuselog is, whatever the current folder is.
_ROOT = str(Path(str(sys.modules["fuselog"].__file__)).parents[1])
# Python's variable that keeps the current folder off the path, and the value that says it is ours.
_SAFE_PATH, _OURS = "PYTHONSAFEPATH", "fuselog"
# Libraries read these in the current folder. Numba loads code from a cache that its file names, and
# matplotlib's file can have LaTeX run.
_OF_NUMBA, _OF_MATPLOTLIB = ".numba_config.yaml", "matplotlibrc"


def start_module(
    module: str, *arguments: str, environment: Mapping[str, str] | None = None, **options: Any
) -> "subprocess.Popen[bytes]":
    """Start one of our modules in a process of its own.

    Args:
        module: the module's full name.
        arguments: what follows it on the command line.
        environment: the process's variables; by default those of this process.
        options: of subprocess.Popen. By default standard input is a pipe, and standard error is dropped.
    """
    variables = os.environ if environment is None else environment
    paths = os.pathsep.join(filter(None, [_ROOT, variables.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        env={**variables, "PYTHONPATH": paths, "NUMBA_NUM_THREADS": "1"},
        **{"stdin": subprocess.PIPE, "stderr": subprocess.DEVNULL, **options},
    )


@contextmanager
def safe_spawning() -> Iterator[None]:
    """Keep the current folder off the path of all processes that multiprocessing starts meanwhile."""
    if os.environ.get(_SAFE_PATH):
        yield
        return
    os.environ[_SAFE_PATH] = _OURS
    try:
        yield
    finally:
        os.environ.pop(_SAFE_PATH, None)


def users_environment() -> dict[str, str]:
    """Return the variables as the user set them, for programs that the user names."""
    return {name: value for name, value in os.environ.items() if (name, value) != (_SAFE_PATH, _OURS)}


def keep_off_settings_here() -> None:
    """Keep libraries from the settings in the current folder.

    Matplotlib reads its file once, as it is imported: that is done from another folder.

    Raises BadInput if the folder holds a file that numba would follow.
    """
    if os.path.lexists(_OF_NUMBA):
        raise BadInput(
            f"{_OF_NUMBA}: numba would take its settings from this file of the current folder, and "
            "they can run programs; move it away, or run fuselog in another folder"
        )
    if os.path.lexists(_OF_MATPLOTLIB):
        with chdir(Path(__file__).parent):
            import matplotlib  # noqa: F401
