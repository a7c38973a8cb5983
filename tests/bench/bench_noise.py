"""Ten hours of an inertial unit at 200 Hz, from the log to noise with intervals: CPU seconds and memory.

It is a process on one core, with what it takes to start. Run it with `make bench`, or
`python -m tests.bench noise`.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import fuselog as fl

HOURS, STEP_S = 10, 0.005
CPU_S, PEAK_GB = 60.0, 1.0
WHITE, WALK = {"specific_force_mps2": 1e-2, "turn_rate_radps": 1e-3}, 0.01  # of the white noise
# the kernel counts the parent's memory as the child's, but for what /proc says of itself
CODE = """import sys
from fuselog.pipeline.command_line import main
code = main(sys.argv[1:])
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
open("peak", "w").write(peak)
sys.exit(code)"""
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """What it takes, and what it may take; asserted is that the noise is found."""
    with tempfile.TemporaryDirectory() as folder:
        fl.write(Path(folder) / "rest.mcap", [rest()])
        spent_s, peak_gb = measured(Path(folder))
    what = f"noise of {HOURS} h at {1 / STEP_S:.0f} Hz, six columns"
    return [
        (f"{what}, CPU; what it may take", *of_most(spent_s, CPU_S, "s")),
        (f"{what}, memory; what it may take", *of_most(peak_gb, PEAK_GB, "GB")),
    ]


def of_most(taken: float, most: float, unit: str) -> tuple[str, str, str]:
    """Numbers with units, and their ratio."""
    return f"{taken:.3g} {unit}", f"{most:.3g} {unit}", f"{taken / most:.2f} times"


def rest() -> fl.Stream:
    """A unit at rest, with white noise and a walk."""
    size = round(HOURS * 3600 / STEP_S)
    rng = np.random.Generator(np.random.Philox(key=1))
    stamps = np.rint(np.arange(size) * STEP_S * 1e9).astype(np.int64)
    columns = {"magnetic_field_ut": np.full((size, 3), np.nan)}
    for name, white in WHITE.items():
        columns[name] = np.empty((size, 3))
        for axis in range(3):
            walked = np.cumsum(rng.standard_normal(size)) * (white * WALK * np.sqrt(STEP_S))
            columns[name][:, axis] = walked + rng.standard_normal(size) * (white / np.sqrt(STEP_S))
    return fl.make_stream("/imu", fl.schemas.INERTIAL_SAMPLE, stamps, **columns)


def measured(folder: Path) -> tuple[float, float]:
    """CPU seconds and the most memory in GB of the command, on one core."""
    one = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", CODE, "noise", "rest.mcap", "--json"]
    with (folder / "said.json").open("w") as said:
        process = subprocess.Popen(command, cwd=folder, env=one, stdout=said)
        os.sched_setaffinity(process.pid, {min(os.sched_getaffinity(0))})
        _, status, usage = os.wait4(process.pid, 0)
    assert status == 0
    process.returncode = 0
    found = json.loads((folder / "said.json").read_text())["numbers"]
    ratios = [
        row["value"] / white
        for row in found
        for name, white in WHITE.items()
        if name in row["column"] and "white" in row["term"]
    ]
    assert len(ratios) == 6
    np.testing.assert_allclose(ratios, 1.0, rtol=0.02)
    peak_kib = int((folder / "peak").read_text())
    return usage.ru_utime + usage.ru_stime, peak_kib * 1024 / 1e9
