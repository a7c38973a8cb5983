"""Start of further Python processes that import nothing from the current folder.

`python -m` and `python -c` put the current folder first on Python's path. In another user's folder,
a file such as `random.py` would then replace the module of the standard library.
"""

import gc
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import Any

from fuselog.recorders.errors import BadInput

# Where fuselog is installed, independent of the current folder.
_ROOT = str(Path(str(sys.modules["fuselog"].__file__)).parents[1])
# Python's variable that keeps the current folder off the path, and the value that marks it as set by us.
_SAFE_PATH, _OURS = "PYTHONSAFEPATH", "fuselog"
# Libraries read these files in the current folder. numba loads code from a cache that its file names,
# and matplotlib's file can make it run LaTeX.
_OF_NUMBA, _OF_MATPLOTLIB = ".numba_config.yaml", "matplotlibrc"
# Variables that libraries of linear algebra read when they are loaded, and what the user set them to.
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "OMP_NUM_THREADS")
_threads_of_user: dict[str, str | None] = {}


def start_module(
    module: str, *arguments: str, environment: Mapping[str, str] | None = None, **options: Any
) -> "subprocess.Popen[bytes]":
    """Start one of fuselog's modules in another process.

    Args:
        module: full name of the module.
        arguments: arguments on its command line.
        environment: environment variables of the new process; by default those of the current process.
        options: options of subprocess.Popen. By default standard input is a pipe, and standard error is
            discarded.
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
    """Keep the current folder off the path of processes that multiprocessing starts in this context."""
    if os.environ.get(_SAFE_PATH):
        yield
        return
    os.environ[_SAFE_PATH] = _OURS
    try:
        yield
    finally:
        os.environ.pop(_SAFE_PATH, None)


def users_environment() -> dict[str, str]:
    """Return the variables as the user set them, for programs that the user runs through fuselog."""
    stated: dict[str, str | None] = {**os.environ, **_threads_of_user}
    if stated.get(_SAFE_PATH) == _OURS:
        del stated[_SAFE_PATH]
    return {name: value for name, value in stated.items() if value is not None}


def limit_libraries() -> None:
    """Limit linear algebra to one core, in libraries that are loaded now or later."""
    from threadpoolctl import threadpool_limits  # slow to import

    for name in _THREADS:
        _threads_of_user.setdefault(name, os.environ.get(name))
        os.environ[name] = "1"
    threadpool_limits(1)


def collect_garbage_seldom() -> None:
    """Collect garbage less often than Python does, in a process that is fuselog's own.

    Imports leave up to 420,000 objects and no garbage; each collection would go through all of them.
    """
    gc.set_threshold(500_000, 20, 100)


def keep_off_settings_here() -> None:
    """Prevent libraries from reading settings in the current folder.

    matplotlib reads its settings file once, on import, so it is imported from another folder.

    Raises BadInput if the folder contains settings that numba would use.
    """
    if os.path.lexists(_OF_NUMBA):
        raise BadInput(
            f"{_OF_NUMBA}: numba would read its settings from this file in the current folder, and they "
            "can run programs; move the file, or run fuselog in another folder"
        )
    if os.path.lexists(_OF_MATPLOTLIB):
        with chdir(Path(__file__).parent):
            import matplotlib  # noqa: F401


def in_notebook() -> bool:
    """Test whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")
