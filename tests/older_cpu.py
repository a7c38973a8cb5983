"""What has NumPy, OpenBLAS and the C library compute as on a CPU without this one's newer instructions.

`python -m tests.older_cpu` prints it, a variable a line. Estimates are then the same but for rounding:
what rounding alone decides comes to light.
"""

import os
import platform

import numpy as np


def older_cpu() -> dict[str, str]:
    """Variables of the environment; none where NumPy uses nothing of this CPU that it can do without."""
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])  # type: ignore[index]
    if not found:
        return {}
    already = os.environ.get("NPY_DISABLE_CPU_FEATURES", "").replace(",", " ").split()
    variables = {"NPY_DISABLE_CPU_FEATURES": ",".join([*already, *found])}
    if platform.machine() in ("x86_64", "AMD64"):
        variables["OPENBLAS_CORETYPE"] = "Prescott"
        variables["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F"
    return variables


if __name__ == "__main__":
    for name, value in older_cpu().items():
        print(f"{name}={value}")
