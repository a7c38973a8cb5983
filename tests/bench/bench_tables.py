"""CPU seconds of the import of a large CSV file; run it with `python -m tests.bench tables`."""

import tempfile
from pathlib import Path
from time import process_time

import numpy as np
import pyarrow as pa
import pyarrow.csv

from fuselog.recorders.recording import import_log

ROWS, CPU_S = 1_000_000, 5.0
MAPPING = """
[[tables]]
time = { column = "time" }
[[tables.streams]]
topic = "/inertial"
becomes = "InertialSample"
fields = { specific_force_mps2 = ["ax", "ay", "az"], turn_rate_radps = ["gx", "gy", "gz"] }
units = { specific_force_mps2 = "g", turn_rate_radps = "deg/s" }
"""
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """CPU time of all threads together, the log included."""
    numbers = np.random.default_rng(0).normal(size=(ROWS, 6)).round(6)
    columns = {
        "time": 1756402240 + np.arange(ROWS) / 200,
        **dict(zip(("ax", "ay", "az", "gx", "gy", "gz"), numbers.T, strict=True)),
    }
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        pyarrow.csv.write_csv(pa.table(columns), folder / "table.csv")
        (folder / "mapping.toml").write_text(MAPPING)
        begin_s = process_time()
        import_log(
            "table", folder / "table.csv", {"mapping": str(folder / "mapping.toml")}, folder / "log.mcap"
        )
        taken_s = process_time() - begin_s
    what = f"CSV of {ROWS} inertial samples to a log, CPU; what it may take"
    return [(what, f"{taken_s:.2f} s", f"{CPU_S:g} s", f"{taken_s / CPU_S:.2f} times")]
