"""What is kept of a campaign that was stopped is damaged, swapped or doubled, and the campaign goes on.

Held is: the result is, byte by byte, that of a campaign which nobody disturbed, or a sentence says why
it is not.
"""

import contextlib
import hashlib
import io
import shutil
import tempfile
import time
from collections.abc import Callable
from functools import partialmethod
from pathlib import Path

import numpy as np

from fuselog.pipeline.command_line import main
from fuselog.pipeline.output.results import TIMINGS
from fuselog.pipeline.runs.checkpoints import Checkpoints
from tests.faults import Tally

COMMANDS = (
    "run landmarks --runs 130 --logs 2 --set duration_s=1 --seed SEED --out out",
    "sweep landmarks --over robots=1,2 --runs 3 --set duration_s=1 --seed SEED --out out",
)


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Meddle with finished cells, for so long or so many times."""
    end = time.monotonic() + seconds
    tried, notes = 0, []
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as folder, contextlib.chdir(folder):
        kept: dict[str, tuple[Path, Path, dict[str, str]]] = {}
        while time.monotonic() < end and tried != most:
            number = tried % len(COMMANDS)
            command = COMMANDS[number]
            if command not in kept:
                kept[command] = _prepared(number, command)
            own, others, whole = kept[command]
            shutil.copytree(own, "out.unfinished")
            done = [_meddle(Path("out.unfinished"), others, rng) for _ in range(int(rng.integers(1, 4)))]
            code, said = _main(command.replace("SEED", "1"))
            wrong = ""
            if code not in (0, 2) or (code == 2 and said.count("\n") != 1):
                wrong = f"ended with {code}: {said[-200:]}"
            elif code == 0 and (_state(Path("out")) != whole or Path("out.unfinished").exists()):
                wrong = "left another result"
            notes += [f"{command}, {', '.join(done)}: {wrong}"] if wrong else []
            for name in ("out", "out.unfinished"):
                shutil.rmtree(name, ignore_errors=True)
            tried += 1
    return Tally(tried, tried - len(notes), notes)


def _prepared(number: int, command: str) -> tuple[Path, Path, dict[str, str]]:
    """The finished cells of a campaign and of another seed, and what the whole campaign leaves."""
    places, whole = [], {}
    finish = Checkpoints.end
    for seed in "12":
        Checkpoints.end = partialmethod(_stopped, finish)  # type: ignore[method-assign, assignment]
        try:
            assert _main(command.replace("SEED", seed))[0] == 0
        finally:
            Checkpoints.end = finish  # type: ignore[method-assign]
        whole = whole or _state(Path("out"))
        shutil.rmtree("out")
        places.append(Path(f"kept-{number}-{seed}"))
        Path("out.unfinished").rename(places[-1])
    return places[0], places[1], whole


def _stopped(checkpoints: Checkpoints, finish: Callable[..., None], **_: bool) -> None:
    """The end of a campaign as one that was stopped has it."""
    finish(checkpoints, is_done=False)


def _meddle(folder: Path, others: Path, rng: np.random.Generator) -> str:
    """Change one file of the folder, or put another there; what was done in words."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size)
    path = files[int(rng.integers(len(files)))]
    raw, kind = path.read_bytes(), int(rng.integers(6))
    there = sorted(each for each in (*folder.rglob("*"), *others.rglob("*")) if each.is_file())
    if kind == 0:
        path.write_bytes(raw[: int(rng.integers(len(raw)))])
    elif kind == 1:
        place = int(rng.integers(len(raw)))
        path.write_bytes(
            raw[:place] + bytes([raw[place] ^ 1 << int(rng.integers(8))]) + raw[place + 1 :]
        )
    elif kind == 2:
        path.unlink()
    elif kind == 3:
        like = [each for each in there if each.suffix == path.suffix]
        path.write_bytes(like[int(rng.integers(len(like)))].read_bytes())
    elif kind == 4:
        path.with_name("mine" + path.suffix).write_bytes(raw)
    else:
        like = [each for each in files if each.suffix == path.suffix]
        other = like[int(rng.integers(len(like)))]
        second = other.read_bytes()
        other.write_bytes(raw)
        path.write_bytes(second)
    return f"{('cut', 'flipped', 'removed', 'replaced', 'doubled', 'swapped')[kind]} {path.suffix}"


def _main(command: str) -> tuple[int, str]:
    said = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
        try:
            return main(command.split()), said.getvalue()
        except Exception as error:
            return 1, repr(error)


def _state(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".rrd" and path.name != TIMINGS
    }
