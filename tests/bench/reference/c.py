"""Programs by hand in C beside this file, compiled for this machine. Needs a C compiler."""

import ctypes
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

INTEGER = ctypes.c_int
FLOATS, INTEGERS, BOOLEANS = (
    np.ctypeslib.ndpointer(kind, flags="C") for kind in (np.float64, np.int64, np.bool_)
)


@cache
def compiled(name: str, function: str, *kinds: Any) -> Any:
    """A function of NAME.c, which returns nothing, with the kinds of its arguments."""
    source = Path(__file__).with_name(f"{name}.c")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / f"{name}.so"
        command = ["cc", "-O3", "-march=native", "-shared", "-fPIC", str(source), "-o", str(library)]
        subprocess.run([*command, "-lm"], check=True)
        found = getattr(ctypes.CDLL(str(library)), function)
    found.argtypes, found.restype = kinds, None
    return found
