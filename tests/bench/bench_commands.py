"""CPU seconds of short commands, beside those of Python with what nearly all of them import.

It is a process each, warm: modules and kernels are compiled. Run it with `make bench`, or
`python -m tests.bench commands`.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from fuselog.recorders.log import write_log
from fuselog.recorders.recording import record_run

REPEATS = 7
LEAST = "import numpy, pydantic.main, rich.table, google.protobuf.message"
MAIN = "from fuselog.pipeline.command_line import main; main()"
COMMANDS = {
    "--help": ["--help"],
    "info of a minute's log": ["info", "run.mcap"],
    "models": ["models"],
    "estimators": ["estimators"],
    "scenarios": ["scenarios"],
    "replay of a minute's log, EKF and UKF": ["replay", "run.mcap", "-e", "ekf", "-e", "ukf"],
}
Row = tuple[str, str, str, str]


def main() -> list[Row]:
    """Each command beside the least that it could take; they take turns."""
    ways = {what: [MAIN, *arguments] for what, arguments in COMMANDS.items()} | {"": [LEAST]}
    with tempfile.TemporaryDirectory() as folder:
        recording, run = record_run("landmarks", {}, 7)
        write_log(Path(folder) / "run.mcap", recording.streams, run)
        taken: dict[str, list[float]] = {what: [] for what in ways}
        for turn in range(1 + REPEATS):
            for what, code in ways.items():
                spent_s = process_s(code, Path(folder))
                if turn:  # the first one compiles
                    taken[what].append(spent_s)
    middle = {what: median(each) for what, each in taken.items()}
    least_s = middle.pop("")
    return [
        (
            f"fuselog {what}, CPU; Python with NumPy, pydantic, rich and protobuf",
            f"{spent_s:.2f} s",
            f"{least_s:.2f} s",
            f"{spent_s / least_s:.2f} times",
        )
        for what, spent_s in middle.items()
    ]


def process_s(code: list[str], folder: Path) -> float:
    """CPU seconds of a Python process, whose code and arguments these are."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen(
        [sys.executable, "-c", *code], cwd=folder, env=kept, stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    assert status == 0, code
    process.returncode = 0
    return usage.ru_utime + usage.ru_stime
