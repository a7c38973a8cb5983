"""Test in a separate process whether LLVM can compile for the requested processor.

LLVM ends the process if the processor and its features do not match.
"""

import subprocess
from functools import cache

from fuselog.recorders import environment
from fuselog.recorders.errors import BadInput
from fuselog.recorders.processes import start_module


def require_processor() -> None:
    """Raise BadInput if a processor is requested for which code cannot be compiled."""
    if any(environment.processor()):
        _try(*environment.processor())


@cache
def _try(name: str | None, features: str | None) -> None:
    process = start_module(__name__, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    said = process.communicate()[1].decode(errors="replace").strip()
    if said or process.returncode:
        stated = {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features}
        what = ", ".join(f"{each}={value}" for each, value in stated.items() if value)
        why = said.splitlines()[0] if said else f"exit code {process.returncode}"
        raise BadInput(f"{what}: LLVM cannot compile for this ({why}); correct or unset the variable")


def main() -> None:
    """Compile an addition for the requested processor."""
    from fuselog.recorders.compiling.kernels.native import object_code

    object_code(
        "define double @add(double %a, double %b) {\n %c = fadd double %a, %b\n ret double %c\n}"
    )


if __name__ == "__main__":
    main()
