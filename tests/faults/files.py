"""Files that were made to trouble: tables, JSON, archives of arrays, goldens, settings, mappings.

Every command must end, with 0, with 1 where a golden differs, or with 2 and one sentence, in bounded
time and memory.
"""

import contextlib
import io
import json
import lzma
import resource  # noqa: TID251
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from fuselog.pipeline.command_line import main
from tests.faults import Tally

# What one command may take.
LIMIT_S, LIMIT_BYTES = 60, 1 << 30
# fmt: off
VALUES = (None, True, -1, 0, 1.5, 2**63, 10**400, float("nan"), float("inf"), 1e308, "", "x", "1", [],
          {}, [[]], [1, [2]], ["x"], {"a": 1}, [1.0] * 7, list(range(100_000)), "\ud800", [None])
TEXTS = ("", "x", "nan", "1e308", "-inf", "1e999", "2026-01-01", "1;2", '"', "\0", "\ufeff", "9" * 400,
         "[" * 60, "é" * 5000, "=1+1", "%", "#")
PATTERNS = ("*a" * 60 + "*", "".join(f"{{v{number}}}" for number in range(12)), "{v}{v}", "{1}{2}.csv",
            "?" * 300, "[a-z]*", "**/*", "..", "/", "", "(", "\\", "*.csv", "t{v}.csv", "{v}/*")
SETTINGS = ("[ekf]\n{}", "[ekf.a]\n{}", "ekf = {}", "[[ekf]]\n{}", "ekf.gate_probability = {}",
            "[ekf]\nsigma_range_m = {}", "{}")
# fmt: on
CHECK = ("check run.mcap --against ekf.golden.xz",)
IMPORT = ("import table FILE --guess -o new.toml", "import table FILE --mapping map.toml -o new.mcap")
MAPPING = """[[tables]]
files = {}
time = {{ column = "t", unit = "s" }}
[[tables.streams]]
topic = "/x"
becomes = "Odometry"
fields = {{ forward_mps = "x", turn_radps = "x" }}
"""
Craft = Callable[[np.random.Generator], tuple[str, Iterator[str]]]


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Craft files of each kind in turn, for so long or so many."""
    end = time.monotonic() + seconds
    tried, notes = 0, []
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as folder, contextlib.chdir(folder):
        for command in (
            "record landmarks --set duration_s=2 -o run.mcap",
            "check run.mcap -e ekf --update --against ekf.golden.xz",
        ):
            assert _complaint(command) == ""
        golden = Path("ekf.golden.xz").read_bytes()
        while time.monotonic() < end and tried != most:
            Path("ekf.golden.xz").write_bytes(golden)
            Path("map.toml").write_text(MAPPING.format('"*"'))
            done, commands = CRAFTS[tried % len(CRAFTS)](rng)
            wrong = next(filter(None, map(_complaint, commands)), "")
            notes += [f"{done}: {wrong}"] if wrong else []
            tried += 1
    return Tally(tried, tried - len(notes), notes)


def _complaint(command: str) -> str:
    """What is wrong with how a command ended; empty where nothing is."""
    out, err = io.StringIO(), io.StringIO()
    for place in ("new.toml", "new.mcap"):
        Path(place).unlink(missing_ok=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with _limited():
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                code = main(command.split())
        except Exception as error:  # a traceback, whatever it is of
            return f"{command}: {type(error).__name__}: {str(error)[:200]}"
    more = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if more << 10 > LIMIT_BYTES:
        return f"{command}: took {more >> 10} MB more"
    said = err.getvalue()
    if code == 2 and not (said.startswith("fuselog: ") and said.count("\n") == 1):
        return f"{command}: said {said[:200]!r}"
    return "" if code in (0, 2) or (code == 1 and "check" in command) else f"{command}: code {code}"


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TimeoutError(f"it did not end in {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _any(rng: np.random.Generator, among: Any) -> Any:
    return among[int(rng.integers(len(among)))]


def _on(name: str, commands: tuple[str, ...] = IMPORT) -> Iterator[str]:
    return (command.replace("FILE", name) for command in commands)


# Goldens.


def _golden_value(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    """One part of a golden is another value, or is gone, or there is one more."""
    golden = json.loads(lzma.decompress(Path("ekf.golden.xz").read_bytes()))
    at, path = golden, []
    while isinstance(at, dict | list) and len(at):
        key = _any(rng, list(at) if isinstance(at, dict) else range(len(at)))
        path.append(key)
        if rng.random() < 0.3 or not isinstance(at[key], dict | list) or not at[key]:
            break
        at = at[key]
    value = _any(rng, VALUES)
    if rng.random() < 0.2:
        del at[path[-1]]
    elif rng.random() < 0.2 and isinstance(at, dict):
        at["new"] = value
    else:
        at[path[-1]] = value
    with contextlib.suppress(UnicodeEncodeError):
        Path("ekf.golden.xz").write_bytes(lzma.compress(json.dumps(golden).encode()))
    return f"golden, {'.'.join(map(str, path))} is {str(value)[:40]}", _on("", CHECK)


def _golden_bytes(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    """An archive that is cut or flipped, holds something else, or unpacks to very much."""
    path = Path("ekf.golden.xz")
    raw, place = path.read_bytes(), int(rng.integers(path.stat().st_size))
    contents: list[Callable[[], bytes]] = [
        lambda: raw[:place],
        lambda: raw[:place] + bytes([raw[place] ^ 1 << int(rng.integers(8))]) + raw[place + 1 :],
        lambda: raw + raw,
        lambda: lzma.compress(bytes(1 << 29), preset=0),
        lambda: lzma.compress(b"[" * (1 << 20)),
        lambda: lzma.compress(b"[" + b"[]," * (1 << 24) + b"[]]", preset=0),
        lambda: lzma.compress(b'{"format": 1}'),
        lambda: b"",
    ]
    kind = int(rng.integers(len(contents)))
    path.write_bytes(contents[kind]())
    update = "check run.mcap -e ekf --update --against ekf.golden.xz"
    return f"golden, bytes of kind {kind}, {place}", _on("", (*CHECK, update))


# Tables.


def _csv(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    columns = int(_any(rng, (1, 2, 3, 200, 20_000)))
    delimiter, rows = _any(rng, (",", ";", "\t", " ", "|")), 5
    cells = [[str(row) for _ in range(columns)] for row in range(rows)]
    header = ["t", "x", *(f"c{number}" for number in range(columns - 2))][:columns]
    text = _any(rng, TEXTS)
    for _ in range(int(rng.integers(4))):
        _any(rng, [header, *cells])[int(rng.integers(columns))] = text
    body = "\n".join(delimiter.join(line) for line in [header, *cells])
    raw = body.encode("utf-8", "replace")
    if rng.random() < 0.2:
        raw = raw[: len(raw) // 2] + rng.bytes(50) + raw[len(raw) // 2 :]
    Path("t1.csv").write_bytes(raw)
    return f"table of {columns} columns by {delimiter!r} with {text[:20]!r}", _on("t1.csv")


def _json_lines(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    depth, row = int(_any(rng, (0, 3, 49, 51, 1000, 100_000))), {"t": 1, "x": 2.0}
    opening = _any(rng, ("[", '{"a":', "\n[", '["]}",'))
    closing = "]" if "[" in opening else "}"
    nested = opening * depth + "1" + closing * depth
    wide = {f"k{number}": number for number in range(int(_any(rng, (0, 10, 30_000))))}
    value = _any(rng, VALUES)
    lines = [
        json.dumps({**row, **wide, "v": value}),
        json.dumps({**row, "v": _any(rng, VALUES)}),
        f'{{"t": 2, "x": {nested}}}',
    ]
    Path("t1.jsonl").write_text("\n".join(lines), encoding="utf-8", errors="replace")
    return f"JSON lines {depth} deep by {opening!r}, {len(wide)} wide", _on("t1.jsonl")


def _npz(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    count, kind = (
        int(_any(rng, (0, 1, 9, 30_000_000))),
        _any(rng, ("<f8", ">f4", "i1", "U5", "?", "c16")),
    )
    arrays: dict[str, Any] = {"t": np.zeros(count, kind), "x": np.zeros((count, 2), "f4")}
    if count < 10 and rng.random() < 0.5:
        arrays["o"] = _any(
            rng, (np.array([{}] * count), np.zeros((count, 2, 2)), np.zeros(3), np.zeros(()))
        )
    np.savez_compressed("t1.npz", **arrays)
    raw = bytearray(Path("t1.npz").read_bytes())
    if rng.random() < 0.4:
        raw[int(rng.integers(len(raw)))] ^= 1 << int(rng.integers(8))
    Path("t1.npz").write_bytes(raw)
    # a whole import of many rows takes long, and is no fault
    return f"arrays of {count} {kind}", _on("t1.npz", IMPORT if count < 10 else IMPORT[:1])


def _parquet(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    count = int(_any(rng, (0, 1, 9, 30_000_000)))
    columns = {"t": pa.array(np.zeros(count)), "x": pa.array(np.zeros(count))}
    if count < 10:
        columns["v"] = pa.array([[1.0] * 20_000] * count)
    pyarrow.parquet.write_table(pa.table(columns), "t1.parquet")
    raw = bytearray(Path("t1.parquet").read_bytes())
    if rng.random() < 0.4:
        raw[int(rng.integers(len(raw)))] ^= 1 << int(rng.integers(8))
    Path("t1.parquet").write_bytes(raw)
    return f"Parquet of {count} rows", _on("t1.parquet", IMPORT if count < 10 else IMPORT[:1])


# Mappings and settings.


def _mapping(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    pattern = _any(rng, PATTERNS)
    name = _any(rng, ("t1.csv", "a" * 200 + ".csv", "ab" * 100))
    Path(name).write_text("t,x\n1,2\n2,3\n")
    Path("map.toml").write_text(MAPPING.format(json.dumps(pattern)))
    return f"a mapping of {pattern[:40]!r}", _on(name, IMPORT[1:])


def _settings(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    value = _any(rng, VALUES)
    text = _any(rng, SETTINGS).replace("{}", json.dumps(value))
    Path("settings.toml").write_text(text)
    commands = ("replay run.mcap -e ekf --settings settings.toml -o new.mcap",)
    return f"settings {text[:60]!r}", _on("", commands)


def _trajectory(rng: np.random.Generator) -> tuple[str, Iterator[str]]:
    size = float(_any(rng, (1.0, 1e99, 1e155, 1e308, np.nan, np.inf, 0.0)))
    rows = rng.uniform(-1, 1, (9, 3)) * size if np.isfinite(size) else np.full((9, 3), size)
    Path("line.tum").write_text(
        "".join(f"{time} {x} {y} {z} 0 0 0 1\n" for time, (x, y, z) in enumerate(rows.tolist()))
    )
    Path("truth.tum").write_text("".join(f"{time} {time} {time**2} 0 0 0 0 1\n" for time in range(9)))
    align = _any(rng, ("none", "yaw", "se2", "se3", "sim3"))
    commands = (f"evaluate line.tum --truth truth.tum --align {align} --json",)
    return f"a trajectory of {size:g} m, {align}", _on("", commands)


CRAFTS: tuple[Craft, ...] = (
    *(_golden_value, _golden_bytes, _csv, _json_lines, _npz, _parquet),
    *(_mapping, _settings, _trajectory),
)
