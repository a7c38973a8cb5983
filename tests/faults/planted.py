"""Values that cannot be, in each field of every scenario's streams: no command may stumble over one.

Every command must end with 0, with 2 and one sentence, or with 1 (`lint` that found something, `replay`
that says when its estimator failed), without a warning, nan or inf in what it prints; `lint` names the
topic and field of what no sensor can give.
"""

import contextlib
import io
import re
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from math import isqrt
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import numpy as np

from fuselog.pipeline.command_line import main
from fuselog.recorders.log import RunMetadata, Stream, schemas, write_log
from fuselog.recorders.log import writer as log_writer
from fuselog.recorders.log.impossible import TIMELESS, YEAR_NS
from fuselog.recorders.recording import record_run
from tests.faults import Tally

SHORT = {"duration_s": 4.0}
# By scenario, the settings of a short log and the estimator that takes it.
SCENARIOS: dict[str, tuple[Mapping[str, object], str]] = {
    "acoustic-shots": ({"shots": 2}, "shooter:native-measurements"),
    "axis": ({"steps": 10}, "bingham-axis"),
    "batch-reactor": ({"steps": 10}, "ekf"),
    "biometric-scores": ({"users": 20}, "score-rule"),
    "crossing": ({"duration_s": 5.0}, "tracker:jipda"),
    "extended-target": ({"points": 20}, "ekf"),
    "ispace": ({"steps": 20}, "network:centralised"),
    "landmarks": (SHORT, "ekf"),
    "manoeuvres": ({"duration_s": 10.0}, "ekf"),
    "moving-los": ({"duration_s": 6.0}, "ekf"),
    "navigation": ({"duration_s": 11.0, "unit": {"rate_hz": 20.0}}, "ekf"),
    "optical-los": ({}, "los-positions"),
    "orientation": ({"steps": 10}, "bingham-orientation"),
    "ranging": (SHORT, "ekf"),
    "relative-bearings": ({}, "set-membership:box"),
    "shot-sequence": ({"shots": 4}, "ekf"),
    "sound-source": ({"sound_s": 0.2}, "ekf"),
    "torus-headings": ({"steps": 10}, "torus"),
    "vehicles": ({"duration_s": 3.0}, "vehicles:hungarian-topology"),
}
NUMBERS = {
    "nan": np.nan,
    "inf": np.inf,
    "-inf": -np.inf,
    "1e308": 1e308,
    "1e200": 1e200,
    "1e-320": 1e-320,
}
QUICK = ("info LOG", "lint LOG", "replay LOG -e ESTIMATOR -o NEW/estimates.mcap")
SLOW = (
    "diagnose LOG -e ESTIMATOR",
    "view LOG --save NEW.rrd",
    "run LOG -e ESTIMATOR --out NEW/result",
    "report NEW/result --out NEW/report.html",
)
# Of values of fields, what lint has to name.
NAMED = ("inf", "-inf", "1e308", "1e200", "1e-320", "negative", "zero", "singular")
NOT_A_NUMBER = re.compile(r"(?<![\w-])[+-]?(nan|inf|infinity)(?![\w-])", re.IGNORECASE)


class Planted(NamedTuple):
    """A value that is put into one field of one topic of a scenario."""

    scenario: str
    topic: str
    field: str
    kind: str

    def __str__(self) -> str:
        return f"{self.scenario}: {self.topic}.{self.field} {self.kind}"


def run(seconds: float, rng: np.random.Generator, most: int | None = None) -> Tally:
    """Run the quick commands on all that can be planted, or `most`, then the others while there is time.

    All of it may take four times `seconds`.
    """
    end = time.monotonic() + 4 * seconds
    ordered = in_order(rng)[:most]
    notes: dict[Planted, list[str]] = {}
    for commands in (QUICK, SLOW):
        for planted in ordered:
            if time.monotonic() > end:
                break
            notes.setdefault(planted, []).extend(complaints(planted, commands))
    return Tally(
        len(notes),
        sum(not each for each in notes.values()),
        [note for each in notes.values() for note in each],
    )


def in_order(rng: np.random.Generator) -> list[Planted]:
    """Shuffle all that can be planted; one of each field, and of each kind, comes before the rest."""
    everything = [each for scenario in SCENARIOS for each in of_scenario(scenario)]
    rest = [everything[index] for index in rng.permutation(len(everything))]
    first, seen = [], set()
    for each in rest:
        marks = {(each.scenario, each.topic, each.field), each.kind}
        if not marks <= seen:
            seen |= marks
            first.append(each)
    return [*first, *(each for each in rest if each not in set(first))]


def of_scenario(scenario: str) -> Iterator[Planted]:
    """List what can be planted in a scenario: of topics of one schema in the first."""
    streams, _ = recorded(scenario)
    firsts = {stream.schema.full_name: stream for stream in reversed(streams.values()) if len(stream)}
    for stream in firsts.values():
        yield from (
            Planted(scenario, stream.topic, "", kind)
            for kind in ("equal", "zero", "last", "years", "one", "none")
        )
        for entry in stream.schema:
            if entry.kind not in ("real", "vector") or not stream[entry.name].size:
                continue
            kinds = [*NUMBERS]
            if entry.name.startswith(("covariance", "variance")):
                kinds += ["negative", "zero", "singular"]
            yield from (Planted(scenario, stream.topic, entry.name, kind) for kind in kinds)


@cache
def recorded(scenario: str) -> tuple[dict[str, Stream], RunMetadata]:
    """Record a short log of a scenario in memory."""
    recording, run_ = record_run(scenario, SCENARIOS[scenario][0], 0)
    return {stream.topic: stream for stream in recording.streams}, run_


def streams_with(planted: Planted) -> list[Stream]:
    """Return the streams of the scenario with the value in place."""
    streams, _ = recorded(planted.scenario)
    stream = streams[planted.topic]
    changed = _stamped(stream, planted.kind) if not planted.field else _valued(stream, planted)
    return [changed if each is stream else each for each in streams.values()]


def _stamped(stream: Stream, kind: str) -> Stream:
    stamps_ns = stream.publish_time_ns.copy()
    middle = len(stamps_ns) // 2
    if kind in ("one", "none"):
        return stream.take(slice(0, kind == "one"))
    if kind == "equal":
        stamps_ns[middle:] = stamps_ns[middle]
    elif kind == "years":
        stamps_ns[2 * len(stamps_ns) // 3 :] += 20 * YEAR_NS
    else:
        stamps_ns[0 if kind == "zero" else -1] = 0 if kind == "zero" else 2**63 - 2
    columns = {**stream.columns, "sensor_time_ns": stamps_ns}
    return replace(stream, publish_time_ns=stamps_ns, log_time_ns=stamps_ns, columns=columns)


def _valued(stream: Stream, planted: Planted) -> Stream:
    column = stream[planted.field].copy()
    row = len(column) // 2
    cells = column[row : row + 1]
    size = isqrt(cells.shape[1]) if cells.ndim == 2 else 1
    is_matrix = cells.ndim == 2 and size > 1 and size**2 == cells.shape[1]
    if planted.kind in NUMBERS:
        cells.reshape(-1)[0] = NUMBERS[planted.kind]
    elif planted.kind == "zero":
        cells[:] = 0.0
    elif planted.kind == "negative":
        cells.reshape(-1)[0] = -abs(cells.reshape(-1)[0]) or -1.0
    elif is_matrix:
        scale = np.sqrt(np.abs(np.diagonal(cells.reshape(size, size))))
        cells[:] = np.outer(scale, scale).reshape(-1)
    else:
        cells[:] = 0.0
    return replace(stream, columns={**stream.columns, planted.field: column})


def complaints(planted: Planted, commands: Sequence[str]) -> list[str]:
    """Run the commands on a log with the value; say what was wrong with each."""
    with tempfile.TemporaryDirectory(prefix="fuselog-faults-") as folder:
        log = Path(folder, "log.mcap")
        with mock.patch.object(log_writer, "check_stream"):
            write_log(log, streams_with(planted), recorded(planted.scenario)[1])
        estimator = SCENARIOS[planted.scenario][1]
        found = []
        for command in commands:
            for word, place in {"LOG": log, "NEW": log.with_name("new"), "ESTIMATOR": estimator}.items():
                command = command.replace(word, str(place))
            wrong = _complaint(command, planted)
            found += [f"{planted}: {command.replace(folder, '')}: {wrong}"] if wrong else []
        return found


def _complaint(command: str, planted: Planted) -> str:
    out, err = io.StringIO(), io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.resetwarnings()  # as in a process of its own
            code = main(command.split())
    except Exception as error:  # a traceback, whatever it is of
        return f"{type(error).__name__}: {str(error)[:200]}"
    printed, said = out.getvalue(), err.getvalue()
    if "Warning" in said:
        return f"warns {said[:300]!r}"
    if code == 2 and not (said.startswith("fuselog: ") and said.count("\n") == 1):
        return f"says {said[:300]!r}"
    is_one_right = command.startswith("lint") or (command.startswith("replay") and " failed at " in said)
    if code not in (0, 2) and not (code == 1 and is_one_right):
        return f"code {code}"
    shown = NOT_A_NUMBER.search(printed)
    if shown:
        return f"prints {printed[max(shown.start() - 60, 0) : shown.end() + 20]!r}"
    if command.startswith("lint") and code != 2 and _is_named(planted):
        named = planted.topic in printed and planted.field in printed
        return "" if named else f"does not name it: {printed[:200]!r}"
    return ""


def _is_named(planted: Planted) -> bool:
    """Tell whether lint has to name it: a map has no time, and a place that is stated once is exact."""
    stream = recorded(planted.scenario)[0][planted.topic]
    if not planted.field:
        return planted.kind in ("zero", "last", "years") and stream.schema.full_name not in TIMELESS
    is_exact = len(stream) == 1 and stream.schema.full_name == schemas.POSITION_FIX.full_name
    return planted.kind in NAMED and not (is_exact and planted.kind in ("zero", "singular"))
