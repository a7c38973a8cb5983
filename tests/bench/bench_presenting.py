"""Opening a result of 2,000 runs as a dataset: the table, one run, and the same again."""

import subprocess
import sys
import tempfile
from pathlib import Path
from threading import Thread
from time import perf_counter, sleep

import psutil

RUNS = 2000
RUN = 731
FUSELOG = str(Path(sys.executable).with_name("fuselog"))


def main() -> list[tuple[str, str, str, str]]:
    """Return rows of what is opened, ours, the limit, and ours as a share of it."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder, "result")
        run = [FUSELOG, "run", "landmarks", "--runs", str(RUNS), "--out", str(result)]
        subprocess.run(run, check=True, stdout=subprocess.DEVNULL)
        table_s, table_mb = _opened(result, "--runs", "worst")
        one_s, one_mb = _opened(result, "--runs", str(RUN))
        again_s, again_mb = _opened(result, "--runs", "worst")
    found = [
        (f"the table of {RUNS} runs, at most 10 s", table_s, 10.0, "s"),
        (f"run {RUN}, recorded again and drawn, at most 5 s", one_s, 5.0, "s"),
        ("the table once more, at most 3 s", again_s, 3.0, "s"),
        ("memory of the driver, at most 1 GB", max(table_mb, one_mb, again_mb), 1000.0, "MB"),
    ]
    return [
        (name, f"{value:.3g} {unit}", f"{limit:g} {unit}", f"{value / limit:.2f} times")
        for name, value, limit, unit in found
    ]


def _opened(result: Path, *options: str) -> tuple[float, float]:
    """Return the seconds until a browser can show the dataset, and the memory that was used in MB."""
    begin = perf_counter()
    command = [FUSELOG, "view", str(result), "--web", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        most = [0]
        Thread(target=_watch, args=(process.pid, most), daemon=True).start()
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("viewing"):
                break
        took_s = perf_counter() - begin
        process.terminate()
    return took_s, most[0] * 1e-6


def _watch(pid: int, most: list[int]) -> None:
    while psutil.pid_exists(pid):
        try:
            most[0] = max(most[0], psutil.Process(pid).memory_info().rss)
        except psutil.Error:
            return
        sleep(0.05)
