"""Two thousand small logs: their catalog, and a replay of all of them whose worker is killed.

The replay takes wall time, and wants a machine with two cores and nothing else to do. Run it with
`make bench`, or `python -m tests.bench catalog`.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import psutil

import fuselog as fl

LOGS, DURATION_S = 2000, 10.0
KILLED_AT = 30  # finished batches, of 63
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """How long a catalog takes, and the memory of a replay that gives the same bytes after a kill."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for seed in range(LOGS):
            log = fl.record("landmarks", seed=seed, duration_s=DURATION_S)
            fl.write(folder / f"robot{seed % 20}" / f"drive{seed}.mcap", log)
        catalog = partial(_fuselog, folder, "catalog", ".", "-o", "logs.parquet")
        first_s, again_s = _cpu_seconds(catalog), _cpu_seconds(catalog)
        _, whole, whole_s = _replayed(folder, is_killed=False)
        most_bytes, found, killed_s = _replayed(folder, is_killed=True)
    about = f"{LOGS} logs of {DURATION_S:g} s"
    return [
        (
            f"{about}: catalogued, CPU, at most 60 s; again, at most 3 s",
            f"{first_s:.1f} s",
            f"{again_s:.1f} s",
            f"{first_s / again_s:.1f} times",
        ),
        (
            f"{about}, ekf, two workers, one of them killed; undisturbed, with the same bytes",
            f"{killed_s:.0f} s",
            f"{whole_s:.0f} s",
            "the same bytes" if found == whole else "other bytes",
        ),
        (
            "the process that started them: most memory, at most 500 MB",
            f"{most_bytes / 1e6:.0f} MB",
            "500 MB",
            f"{most_bytes / 500e6:.2f} times",
        ),
    ]


def _cpu_seconds(work: Callable[[], object]) -> float:
    """CPU time of the processes that a call starts and waits for."""
    before = os.times()
    work()
    after = os.times()
    return (after.children_user - before.children_user) + (
        after.children_system - before.children_system
    )


def _fuselog(folder: Path, *words: str) -> None:
    command = [Path(sys.executable).with_name("fuselog"), *words]
    subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)


def _replayed(folder: Path, *, is_killed: bool) -> tuple[int, str, float]:
    """Replay all logs; the driver's most memory in bytes, a hash of the result, and the wall time."""
    words = ["replay", "logs.parquet", "-e", "ekf", "--group", "folder", "--workers", "2", "-o", "out"]
    command = [Path(sys.executable).with_name("fuselog"), *words]
    begin, most, killed = time.perf_counter(), 0, not is_killed
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL) as driver:
        own = psutil.Process(driver.pid)
        while driver.poll() is None:
            with suppress(psutil.Error):
                most = max(most, own.memory_info().rss)
                if not killed and len(list(folder.glob("out.unfinished/*.bin"))) >= KILLED_AT:
                    workers = [each for each in own.children() if "spawn_main" in str(each.cmdline())]
                    workers[0].kill()
                    killed = True
            time.sleep(0.02)
    assert (driver.returncode, killed) == (0, True)
    digest, taken_s = hashlib.sha256(), time.perf_counter() - begin
    for path in sorted(folder.glob("out/**/*")):
        if path.is_file():
            digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
            path.unlink()
    (folder / "out").rename(folder / f"done-{is_killed}")
    return most, digest.hexdigest(), taken_s
