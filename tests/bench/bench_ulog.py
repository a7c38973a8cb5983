"""How fast a ULog of a gigabyte is read beside pyulog, and in how much memory.

The log is one of PX4's, its data section over and over; without the real data sets there is no row.
pyulog holds all that it reads and gets fewer copies: what is compared is CPU time per byte.
"""

import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path

from fuselog.recorders.importers.ulog.file import UlogFile

SAMPLE = "./ulog/sample.ulg"
SIZES = {"ours": 1_000_000_000, "pyulog": 100_000_000}
READ = {
    "ours": "list(map(len, UlogFile(Path(sys.argv[1])).blocks(bool)))",
    "pyulog": "ULog(sys.argv[1])",
}
CODE = """import sys, time
from pathlib import Path
from pyulog import ULog
from fuselog.recorders.importers.ulog.file import UlogFile
{read}
begin = time.process_time()
{read}
spent = time.process_time() - begin
print(spent, next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))"""
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """CPU time per gigabyte of both, and the most memory of ours."""
    archive = Path(os.environ.get("FUSELOG_DATA", "")) / "sensors" / "sensors-data.tar.xz"
    if not archive.exists():
        return []
    with tempfile.TemporaryDirectory() as folder:
        return list(rows(archive, Path(folder)))


def rows(archive: Path, folder: Path) -> Iterator[Row]:
    """The logs are made, read and removed."""
    with tarfile.open(archive) as members:
        members.extract(SAMPLE, folder, filter="data")
    per_gb = {}
    for reader, most in SIZES.items():
        log = folder / f"{reader}.ulg"
        size = repeated(folder / SAMPLE, log, most)
        command = [sys.executable, "-c", CODE.format(read=READ[reader]), str(log)]
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        log.unlink()
        spent_s, peak_kib = map(float, said.split())
        per_gb[reader] = spent_s / size * 1e9
        if reader == "ours":
            peak_gb = peak_kib * 1024 / 1e9
    ours, theirs = per_gb["ours"], per_gb["pyulog"]
    name = "ULog of 1 GB, CPU s a gigabyte; pyulog, of .1 GB"
    yield name, f"{ours:.3g} s", f"{theirs:.3g} s", f"{theirs / ours:.1f} times"
    yield "the same, memory; the log", f"{peak_gb:.2g} GB", "1 GB", f"{peak_gb:.2g} times"


def repeated(log: Path, place: Path, size: int) -> int:
    """Write a log with its data section as often as it fits into a size; returns the size."""
    content = log.read_bytes()
    begin = UlogFile(log)._begins
    copies = (size - begin) // (len(content) - begin)
    with place.open("wb") as out:
        out.write(content[:begin])
        for _ in range(copies):
            out.write(content[begin:])
    return place.stat().st_size
