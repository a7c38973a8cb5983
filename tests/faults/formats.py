"""Mutants of every format that fuselog reads: its own logs, estimates and results, and all imports.

Each is read in a forked child with limits of memory and time. It must end with 0, or with 1 or 2 where
the command may, and say on standard error what is one line each, and one line alone where it refuses.
What falls is kept in build/faults/, with the command.
"""

import importlib
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.command_line import main
from fuselog.recorders.log.loops import load
from tests.conftest import without_drawing
from tests.faults import Tally
from tests.faults.children import how, in_child, in_children

MUTANTS = 300  # of each format
KEPT = Path("build", "faults")
# fmt: off
TOKENS = (b"nan", b"inf", b"-1", b"0", b"1e308", b"1e-320", b"1e999", b"9" * 40, b"", b"x", b"-", b'"',
          b"1,5", b"1_000", b"0x1f", b"\xff\xfe", b"\0", b"\xd9\xa1", b"9223372036854775807",
          b"2026-01-01T00:00:00Z")
# fmt: on
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
# What a child has to import is imported before it is forked: these, and those of their modules that the
# child of a whole sample needed.
ROOMS = (
    *("fuselog", "tests", "pytest", "llvmlite", "rich", "pydantic"),
    *("pandas", "pyarrow", "scipy", "h5py", "rosbags", "mcap", "rerun", "matplotlib", "sqlite3"),
)


class Format(NamedTuple):
    """A format: what writes a small sample into a folder, and the commands that read it."""

    write: Callable[[Path], object]
    commands: tuple[str, ...]


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Mutate each format `MUTANTS` times, or `most` of them once; it stops after 15 times `seconds`."""
    end = time.monotonic() + 15 * seconds
    for room in ROOMS:
        importlib.import_module(room)
    seed = int(rng.integers(1 << 32))
    names = list(FORMATS) if most is None else rng.permutation(list(FORMATS))[:most].tolist()
    tried, notes = 0, []
    whole: dict[str, Format] = {}
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as folder, without_drawing():
        for name in names:
            each = FORMATS[name]
            wrong = _sample(Path(folder, name), each)
            notes += [f"{name}, whole: {wrong}"] if wrong else []
            whole |= {} if wrong else {name: each}

        def jobs() -> Iterator[tuple[Mutant, Callable[[], object]]]:
            for number in range(MUTANTS if most is None else 1):
                for name, each in whole.items():
                    if time.monotonic() > end:
                        return
                    place = Path(folder, f"{name}-{number}")
                    shutil.copytree(Path(folder, name), place)
                    rng = np.random.default_rng([seed, number, *name.encode()])
                    done = f"{name} {number} of seed {seed}, {mutate(place / 'in', rng)}"
                    yield Mutant(each, place, done), partial(_read, each.commands, place)

        for mutant, status in in_children(jobs()):
            tried += 1
            wrong = complaint(mutant.of.commands, mutant.place, status)
            if wrong:
                notes.append(f"{mutant.done}: {wrong}")
                _keep(mutant.place, f"{mutant.place.name}-{seed}", notes[-1])
            shutil.rmtree(mutant.place)
    tried += len(names) - len(whole)
    return Tally(tried, tried - len(notes), notes)


class Mutant(NamedTuple):
    """A damaged sample: of which format, where it lies, and what was done to it."""

    of: Format
    place: Path
    done: str


def _sample(place: Path, each: Format) -> str:
    """Write a sample and read it, in a child; import here what that took; return what was wrong."""
    read = place.with_name(f"{place.name}-whole")

    def write_and_read() -> None:
        before = set(sys.modules)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        with chdir(place / "in"):
            each.write(Path())
        shutil.copytree(place, read)
        _read(each.commands, read)
        new = [
            name
            for name, module in sys.modules.items()
            if name not in before and name.partition(".")[0] in ROOMS and module.__loader__
        ]
        (read / "modules.json").write_text(json.dumps(new))

    (place / "in").mkdir(parents=True)
    wrong = complaint(each.commands, read, in_child(write_and_read))
    if wrong:
        return wrong
    for module in json.loads((read / "modules.json").read_text()):
        importlib.import_module(module)
    load()
    codes = _codes(read)
    return f"codes {codes}" if any(codes) else ""


def mutate(place: Path, rng: np.random.Generator) -> str:
    """Damage one file of a folder once or a few times; return what was done, in words."""
    files = sorted(path for path in place.rglob("*") if path.is_file() and path.stat().st_size)
    path = files[int(rng.integers(len(files)))]
    raw = path.read_bytes()
    done = []
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        change = CHANGES[int(rng.integers(len(CHANGES)))]
        raw = change(raw, rng) if raw else raw
        done.append(change.__name__.strip("_"))
    path.write_bytes(raw)
    return f"{path.relative_to(place)} {', '.join(done)}"


def _flipped(raw: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(raw)
    damaged[int(rng.integers(len(raw)))] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def _cut_off(raw: bytes, rng: np.random.Generator) -> bytes:
    return raw[: int(rng.integers(len(raw)))]


def _cut_out(raw: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(raw, rng)
    return raw[:begin] + raw[end:]


def _zeroed(raw: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(raw, rng)
    return raw[:begin] + bytes(end - begin) + raw[end:]


def _doubled(raw: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(raw, rng)
    return raw[:end] + raw[begin:]


def _inserted(raw: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(raw) + 1))
    return raw[:at] + rng.bytes(int(rng.integers(1, 40))) + raw[at:]


def _retold(raw: bytes, rng: np.random.Generator) -> bytes:
    """Put another text in the place of a number; of what has none, change eight bytes to a number's."""
    numbers = list(NUMBER.finditer(raw[:200_000]))
    if len(numbers) < 8:
        at = int(rng.integers(max(len(raw) - 8, 1)))
        value = rng.choice([np.nan, np.inf, -1.0, 1e308, 0.0, 2.0**63])
        return raw[:at] + np.float64(value).tobytes() + raw[at + 8 :]
    one = numbers[int(rng.integers(len(numbers)))]
    return raw[: one.start()] + TOKENS[int(rng.integers(len(TOKENS)))] + raw[one.end() :]


def _span(raw: bytes, rng: np.random.Generator) -> tuple[int, int]:
    begin = int(rng.integers(len(raw)))
    return begin, min(len(raw), begin + int(rng.integers(1, max(2, len(raw) // 4))))


CHANGES = (_flipped, _cut_off, _cut_out, _zeroed, _doubled, _inserted, _retold, _retold, _retold)


def _read(commands: Sequence[str], place: Path) -> None:
    """Run commands in a folder; how they ended and what they said lies there."""
    os.chdir(place)
    os.dup2(os.open("out", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
    for number, command in enumerate(commands):
        os.dup2(os.open(f"err-{number}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
        code = main(command.split())
        sys.stderr.flush()
        Path(f"code-{number}").write_text(str(code))


def _codes(place: Path) -> list[int]:
    return [int(path.read_text()) for path in sorted(place.glob("code-*"))]


def complaint(commands: Sequence[str], place: Path, status: int) -> str:
    """Say what is wrong with how commands ended in a folder; empty where nothing is."""
    said = [path.read_text(errors="replace") for path in sorted(place.glob("err-*"))] or [""]
    if status:
        return f"{commands[len(said) - 1]}: {how(status)}: {said[-1][-400:]!r}"
    for command, code, text in zip(commands, _codes(place), said, strict=True):
        lines = text.splitlines()
        if not all(line.startswith("fuselog: ") for line in lines):
            return f"{command}: says {text[:300]!r}"
        if code == 2 and len(lines) != 1:
            return f"{command}: refuses in {len(lines)} lines: {text[:300]!r}"
        if code not in (0, 2) and not (code == 1 and command.startswith("lint")):
            return f"{command}: code {code}, {text[:200]!r}"
    return ""


def _keep(place: Path, name: str, note: str) -> None:
    """Keep what fell, with the commands, where the next test can be made of it."""
    kept = KEPT / name
    shutil.rmtree(kept, ignore_errors=True)
    shutil.copytree(place / "in", kept / "in")
    (kept / "fell.txt").write_text(f"{note}\n")


# Samples, each as small as shows the format.


def _fuselog(*commands: str) -> Callable[[Path], object]:
    def write(_: Path) -> None:
        for command in commands:
            assert main(command.split()) == 0, command

    return write


def _table(name: str, save: Callable[[pd.DataFrame, Path], object]) -> Format:
    def write(folder: Path) -> None:
        t = np.arange(40) * 0.1
        columns = {"t": 1.7e9 + t, "speed": 2.0 + 0.1 * np.sin(t), "yaw_rate": 0.2 * np.cos(t)}
        save(pd.DataFrame(columns), folder / name)

    return Format(write, (f"import table in/{name} --guess -o new.mcap",))


def _mapped(mapping: str, name: str, line: str) -> Format:
    def write(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        head, _, body = line.rpartition("\n")
        rows = [body.format(k=k, t=1.4e9 + 0.1 * k, ns=14 * 10**17 + k * 10**8) for k in range(40)]
        (folder / name).write_text("\n".join([*filter(None, [head]), *rows, ""]))

    place = "in" if "/" in name else f"in/{name}"
    how = f"--mapping {mapping}" if mapping else "--guess"
    return Format(write, (f"import table {place} {how} -o new.mcap",))


def _bag(form: str) -> Format:
    def write(folder: Path) -> None:
        from tests.recorders.test_ros import odometry_bag

        odometry_bag(folder / "bag", form, 30)

    return Format(write, (f"import ros in/bag{'.bag' * form.startswith('bag')} -o new.mcap",))


def _ulog(folder: Path) -> None:
    from tests.recorders.test_ulog import by_hand

    (folder / "log.ulg").write_bytes(by_hand(rows=60))


def _ais(folder: Path) -> None:
    from tests.recorders.families.tracking.test_ais import SMALL, table

    table(folder, SMALL)


def _autoferry(folder: Path) -> None:
    from tests.recorders.families.tracking.test_autoferry import write

    write(folder)


def _broad(folder: Path) -> None:
    from tests.recorders.families.directional.test_broad import write

    write(folder / "trial.hdf5")


def _mrclam(folder: Path) -> None:
    from tests.recorders.test_mrclam import SMALL

    for name, text in SMALL.items():
        (folder / name).write_text(text)


def _scores(folder: Path) -> None:
    from tests.recorders.families.biometrics.test_biometrics import write

    for name in ("face", "finger"):
        write(folder, name, np.eye(3) + 0.1)
    named = (f'[[matchers]]\nname = "{each}"\nmodality = "{each}"\n' for each in ("face", "finger"))
    (folder / "matchers.toml").write_text("".join(named))


def _sounds(folder: Path) -> None:
    from tests.recorders.families.acoustic.test_sound_recordings import PLACES, samples_of, write

    for name in PLACES:
        write(folder / name, samples_of(name))
    rows = [f"{name}, {x}, {y}" for name, (x, y) in PLACES.items()]
    (folder / "coords.csv").write_text("\n".join(["file,x,y", *rows]))


def _line(folder: Path) -> None:
    rows = [f"{k} {0.1 * k} {0.01 * k**2} 0 0 0 0 1\n" for k in range(20)]
    for name in ("line.tum", "truth.tum"):
        (folder / name).write_text("".join(rows))


def _imported(source: str, name: str = "", options: str = "") -> tuple[str]:
    return (f"import {source} in/{name} -o new.mcap {options}",)


RECORD = "record landmarks --set duration_s=2 -o run.mcap"
POSE = "{t:.2f} 0.5 -1.25 3 0 0 0.6 0.8"
EUROC = "#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n{ns},.1,.2,.3,9,8,7"
POS = (
    "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) "
    "age(s) ratio\n"
    "2025/08/28 17:00:{k:02d}.000 48.5 9.25 410.5 1 9 0.01 0.01 0.02 0.0 0.0 0.0 0.0 9.9"
)
VBO = (
    "[header]\ntime\nlatitude\nlongitude\nvelocity kmh\n\n[column names]\ntime lat long velocity\n\n"
    "[data]\n1245{k:02d}.00 +03119.09730 +00058.49280 040.2"
)
FORMATS = {
    "log": Format(
        _fuselog(RECORD),
        ("info in/run.mcap", "lint in/run.mcap", "replay in/run.mcap -e ekf -o new.mcap"),
    ),
    "estimates": Format(
        _fuselog(RECORD, "replay run.mcap -e ekf -o est.mcap"),
        ("info in/est.mcap", "evaluate in/est.mcap", "export in/est.mcap --to csv -o new"),
    ),
    "result": Format(
        _fuselog("run landmarks --runs 2 --set duration_s=2 --out out"),
        ("info in/out", "report in/out --out new.html"),
    ),
    "csv": _table("t.csv", lambda table, path: table.to_csv(path, index=False)),
    "tsv": _table("t.tsv", lambda table, path: table.to_csv(path, index=False, sep="\t")),
    "parquet": _table("t.parquet", lambda table, path: table.to_parquet(path)),
    "json-lines": _table(
        "t.jsonl", lambda table, path: table.to_json(path, orient="records", lines=True)
    ),
    "npz": _table("t.npz", lambda table, path: np.savez_compressed(path, **table.to_dict("list"))),
    "tum": _mapped("tum", "line.tum", POSE),
    "kitti": _mapped("kitti", "line.txt", "1 0 0 {t} 0 1 0 2 0 0 1 3"),
    "rtklib": _mapped("rtklib", "solution.pos", POS),
    "vbo": _mapped("", "lap.vbo", VBO),
    "euroc": _mapped("euroc", "mav0/imu0/data.csv", EUROC),
    "trajectories": Format(_line, ("evaluate in/line.tum --truth in/truth.tum",)),
    "rosbag1": _bag("bag"),
    "rosbag1-lz4": _bag("bag-lz4"),
    "rosbag2-mcap": _bag("mcap"),
    "rosbag2-sqlite": _bag("db3"),
    "ulog": Format(_ulog, _imported("ulog", "log.ulg")),
    "ais": Format(_ais, _imported("ais", "ais.csv")),
    "autoferry": Format(_autoferry, _imported("autoferry")),
    "broad": Format(_broad, _imported("broad", "trial.hdf5")),
    "mrclam": Format(_mrclam, _imported("mrclam")),
    "score-matrices": Format(_scores, _imported("score-matrices")),
    "sound-recordings": Format(_sounds, _imported("sound-recordings", "", "--set band_hz=[300,3500]")),
}
