"""SIGKILL and SIGTERM at random moments of commands that write, then the same command to its end.

Held is: the user's files and the inputs are as they were; in the place is nothing, the old, or all of
the new; the next command leaves nothing else there or among the temporary files; it writes the bytes
that an undisturbed one writes. A command that was asked to end (SIGTERM) clears up by itself.
"""

import contextlib
import hashlib
import io
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rerun.chunk import RrdReader

from fuselog.pipeline.command_line import main
from fuselog.pipeline.output.results import TIMINGS
from tests.faults import Tally

FUSELOG = str(Path(sys.executable).with_name("fuselog"))
# Each writes OUT; `log.mcap` and `est.mcap` are there.
COMMANDS = {
    "record": ("record landmarks --set duration_s=20 --seed 1 -o", "new.mcap"),
    "replay": ("replay log.mcap -e ekf -e ukf -o", "new.mcap"),
    "run": ("run landmarks --runs 4 --set duration_s=3 --out", "new"),
    "view": ("view log.mcap --save", "new.rrd"),
    "sweep": ("sweep landmarks --over robots=1,2 --runs 4 --set duration_s=3 --out", "new"),
    "evaluate": ("evaluate est.mcap --log log.mcap --out", "new"),
    "compare": ("compare log.mcap -e ekf -e ukf --out", "new"),
    "tune": ("tune log.mcap -e ekf --free sigma_range_m --out", "new"),
    "diagnose": ("diagnose log.mcap -e ekf --out", "new"),
}
# How soon after it began to write a command is killed, in seconds, in every second trial.
_SOON_S = 0.3


class Whole(NamedTuple):
    """What an undisturbed command leaves, where that is, and how long it takes."""

    folder: Path
    state: dict[str, Any]
    time_s: float


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Kill commands in turn, for so long or so many times."""
    end = time.monotonic() + seconds
    tried, notes = 0, []
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as name:
        start = Path(name, "start")
        start.mkdir()
        (start / "notes.txt").write_text("mine")
        (start / "new.part").write_text("mine")
        with contextlib.chdir(start), contextlib.redirect_stdout(io.StringIO()):
            assert main(["record", "landmarks", "-o", "log.mcap"]) == 0
            assert main(["replay", "log.mcap", "-e", "ekf", "-o", "est.mcap"]) == 0
        (start / "tmp").mkdir()
        wholes: dict[str, Whole] = {}
        while time.monotonic() < end and tried != most:
            command = list(COMMANDS)[tried % len(COMMANDS)]
            if command not in wholes:
                wholes[command] = _undisturbed(command, start)
            number = (signal.SIGKILL, signal.SIGTERM)[int(rng.integers(2))]  # noqa: TID251
            over_old = bool(rng.integers(2))
            with _copy_of(wholes[command].folder if over_old else start) as work:
                done, wrong = _disturbed(command, work, wholes[command], number, rng)
            done += " over an old one" * over_old
            notes += [f"{command}, {done}: {wrong}"] if wrong else []
            tried += 1
    return Tally(tried, tried - len(notes), notes)


def _disturbed(
    command: str,
    work: Path,
    whole: Whole,
    number: signal.Signals,
    rng: np.random.Generator,
) -> tuple[str, str | None]:
    """Kill a command once and run it again; what was done, and what was wrong after it."""
    arguments, out = COMMANDS[command]
    before = _state(work)
    process = _fuselog(arguments, out, work)
    done = f"{number.name} {_wait(process, work, whole.time_s, rng)}"
    process.send_signal(number)
    said = process.communicate()[1]
    after = _state(work)
    left = {
        name: what
        for name, what in after.items()
        # a campaign keeps its finished cells there, and goes on with them
        if before.get(name) != what and Path(name).parts[0] != f"{out}.unfinished"
    }
    lost = before.keys() - after.keys()
    written = {name for name in left if Path(name).parts[0] == out}
    in_pieces = any(after.get(name) != whole.state[name] for name in whole.state if written)
    moved = any(Path(name).name == "old" for name in left)  # killed between two renames
    if (lost and not moved) or (written and in_pieces):
        return done, f"lost {sorted(lost)}, in pieces {sorted(written)}"
    if number == signal.SIGTERM:
        if left.keys() - written or process.returncode not in (0, 128 + number, -number):
            return done, f"ended with {process.returncode} and left {sorted(left)}: {said[-300:]}"
        if process.returncode != 0 and said.strip().splitlines()[-1:] not in ([], ["fuselog: stopped"]):
            return done, f"said {said[-300:]}"
    again = _fuselog(arguments, out, work)
    said = again.communicate()[1]
    if again.returncode != 0:
        return done, f"the next one ended with {again.returncode}: {said[-300:]}"
    if _state(work) != whole.state:
        other = sorted(name for name, _ in _state(work).items() ^ whole.state.items())
        return done, f"the next one left something else: {other}"
    return done, None


def _undisturbed(command: str, start: Path) -> Whole:
    folder = start.with_name(command)
    shutil.copytree(start, folder)
    begin = time.monotonic()
    process = _fuselog(*COMMANDS[command], folder)
    said = process.communicate()[1]
    assert process.returncode == 0, said
    return Whole(folder, _state(folder), time.monotonic() - begin)


def _wait(process: subprocess.Popen[str], work: Path, time_s: float, rng: np.random.Generator) -> str:
    """Wait for a random moment of a command, or one soon after it began to write; says which."""
    begin = time.monotonic()
    if rng.random() < 0.5:
        time.sleep(rng.uniform(0, time_s))
        return f"after {time.monotonic() - begin:.3f} s"
    while process.poll() is None and not list(work.glob(".new*.part")):
        time.sleep(0.002)
    soon_s = rng.uniform(0, _SOON_S) ** 2 / _SOON_S  # most are very soon
    time.sleep(soon_s)
    return f"{soon_s:.3f} s after it began to write"


def _fuselog(arguments: str, out: str, work: Path) -> subprocess.Popen[str]:
    """Start a command with a folder for temporary files of its own, and signals as a shell sets them."""
    temporary = work / "tmp"
    temporary.mkdir(exist_ok=True)
    return subprocess.Popen(
        [FUSELOG, *arguments.split(), out],
        cwd=work,
        env={**os.environ, "TMPDIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGTERM, signal.SIG_DFL),
    )


@contextlib.contextmanager
def _copy_of(start: Path) -> Iterator[Path]:
    work = start.with_name("work")
    shutil.copytree(start, work)
    try:
        yield work
    finally:
        shutil.rmtree(work)


def _state(folder: Path) -> dict[str, Any]:
    """Everything in a folder: files by their bytes, a timeline by its rows, measured times by name."""
    state: dict[str, Any] = {}
    for path in folder.rglob("*"):
        name = str(path.relative_to(folder))
        if path.is_dir():
            state[name] = "folder"
        elif path.name == TIMINGS:
            state[name] = "times"
        elif path.suffix == ".rrd" and ".part" not in name:
            chunks = RrdReader(path).stream()
            state[name] = sorted((chunk.entity_path, chunk.num_rows) for chunk in chunks)
        else:
            state[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return state
