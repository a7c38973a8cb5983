"""CPU seconds and memory of commands on long logs: ten hours of an inertial unit, ten million messages.

The first goes from the log to noise with intervals; the second is replayed, judged and drawn. Each is a
process on one core, with what it takes to start. Run it with `make bench`, or
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
from fuselog.recorders.log import write_log
from fuselog.recorders.recording import record_run

HOURS, STEP_S = 10, 0.005
CPU_S, PEAK_GB = 60.0, 1.0
LONG_S, LONG_GB = 149_500.0, 0.97  # the duration of a log of ten million messages; 0.9 GiB
WHITE, WALK = {"specific_force_mps2": 1e-2, "turn_rate_radps": 1e-3}, 0.01  # of the white noise
# the kernel counts the parent's memory as the child's, but for what /proc says of itself
CODE = """import sys
from fuselog.pipeline.command_line import main
code = main(sys.argv[1:])
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
open("peak", "w").write(peak)
sys.exit(code)"""
LONG = "replay", "long.mcap", "-e", "ekf", "-o", "estimates.mcap", "--save", "long.rrd"
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """What it takes, and what it may take; asserted is that the noise is found."""
    with tempfile.TemporaryDirectory() as folder:
        fl.write(Path(folder) / "rest.mcap", [rest()])
        spent_s, peak_gb = measured(Path(folder))
        recording, run = record_run("landmarks", {"duration_s": LONG_S}, 1)
        messages = sum(map(len, recording.streams))
        write_log(Path(folder) / "long.mcap", recording.streams, run)
        del recording
        _, long_gb = taken(Path(folder), *LONG)
    what = f"noise of {HOURS} h at {1 / STEP_S:.0f} Hz, six columns"
    return [
        (f"{what}, CPU; what it may take", *of_most(spent_s, CPU_S, "s")),
        (f"{what}, memory; what it may take", *of_most(peak_gb, PEAK_GB, "GB")),
        (
            f"{messages / 1e6:.1f} million messages, EKF, judged and drawn, memory; what it may take",
            *of_most(long_gb, LONG_GB, "GB"),
        ),
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
    """CPU seconds and the most memory in GB of `noise`, which finds the noise."""
    spent_s, peak_gb = taken(folder, "noise", "rest.mcap", "--json")
    found = json.loads((folder / "said").read_text())["numbers"]
    ratios = [
        row["value"] / white
        for row in found
        for name, white in WHITE.items()
        if name in row["column"] and "white" in row["term"]
    ]
    assert len(ratios) == 6
    np.testing.assert_allclose(ratios, 1.0, rtol=0.02)
    return spent_s, peak_gb


def taken(folder: Path, *arguments: str) -> tuple[float, float]:
    """CPU seconds and the most memory in GB of a command, on one core."""
    one = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with (folder / "said").open("w") as said:
        process = subprocess.Popen(
            [sys.executable, "-c", CODE, *arguments], cwd=folder, env=one, stdout=said
        )
        os.sched_setaffinity(process.pid, {min(os.sched_getaffinity(0))})
        _, status, usage = os.wait4(process.pid, 0)
    assert status == 0
    process.returncode = 0
    peak_kib = int((folder / "peak").read_text())
    return usage.ru_utime + usage.ru_stime, peak_kib * 1024 / 1e9
