"""Creation of goldens, which are small stored replays with which later replays are compared.

A golden is compressed JSON with the settings, a hash of every input and the tolerances. For every output
stream, a golden contains the number of rows, the metadata, hashes of both clocks and a checksum of each
row. For every column, a golden contains some evenly spaced rows in full precision and sums over all
rows. A golden contains no timings.
"""

import base64
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.checking.stored import FORMAT, Golden
from fuselog.pipeline.runs.ensemble import Settings
from fuselog.pipeline.runs.estimates import hash_files, hash_streams
from fuselog.pipeline.runs.initial_states import order_of
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.streams.sources import LogSource, MemorySource

# About NUMBERS numbers are kept per run, which determines the rows kept per stream, within the bounds.
NUMBERS, FEWEST_ROWS, MOST_ROWS = 6000, 6, 32
TOLERANCE, TOLERANCE_ELSEWHERE = 1e-12, 1e-6
# The values of these streams are indices of sentences, whose wording may change.
REASONS = {schemas.FAILURE.full_name, schemas.SKIPPED.full_name, schemas.STARTED.full_name}

Floats = NDArray[np.float64]
Outputs = Mapping[str, Stream]


class Tolerance(NamedTuple):
    """The allowed difference of a column, relative to its size, and the reason for it."""

    relative: float
    reason: str = ""
    elsewhere: bool = False
    """Whether the tolerance applies only if the CPU's arithmetic differs from the golden's."""


Tolerances = Mapping[str, Tolerance]


class Replayed(NamedTuple):
    """The golden of a new replay, together with the output streams of its runs."""

    golden: Golden
    outputs: Mapping[str, Outputs]


def make(
    sources: Mapping[str, LogSource | MemorySource],
    estimators: Settings,
    *,
    late: str | None = None,
    arrival_order: bool = False,
    columns: Sequence[str] = ("*",),
    tolerances: Tolerances | None = None,
) -> Replayed:
    """Replay runs one by one and make a golden of them.

    Args:
        sources: the runs by name.
        estimators: settings by label.
        late: handling of out-of-sequence messages, with the same values as the option `--late`.
        arrival_order: whether messages are replayed in order of log time.
        columns: patterns of the columns to keep, as `TOPIC COLUMN`.
        tolerances: allowed differences, by patterns of the same form.

    Raises BadInput if an estimator supports none of the runs.
    """
    order, policy = order_of(arrival_order=arrival_order, late=late)
    runs: dict[str, Any] = {}
    outputs: dict[str, Outputs] = {}
    for name, source in sources.items():
        replayed = replay_in_memory([source], estimators, order=order, late=policy)
        own = {topic: each.stream for topic, each in replayed.items() if _is_estimated(each.stream)}
        kept = [
            column
            for topic, stream in own.items()
            for field, column in stream.columns.items()
            if _is_kept(topic, field, columns)
        ]
        width = sum(math.prod(column.shape[1:]) for column in kept)
        rows = min(max(NUMBERS // max(width, 1), FEWEST_ROWS), MOST_ROWS)
        streams = {topic: _stream(stream, rows, columns) for topic, stream in own.items()}
        recorded = isinstance(source, MemorySource)
        runs[name] = {"input": input_hash(source), "recorded": recorded, "streams": streams}
        outputs[name] = own
    settings = {
        "estimators": estimators,
        "late": late,
        "arrival_order": arrival_order,
        "columns": list(columns),
    }
    return Replayed(golden_of(runs=runs, settings=settings, tolerances=tolerances), outputs)


def golden_of(
    *,
    runs: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    metrics: Mapping[str, Any] | None = None,
    tolerances: Tolerances | None = None,
) -> Golden:
    """Assemble a golden from its parts, in the same form as a golden that is read from a file."""
    found = {
        "format": FORMAT,
        "arithmetic": arithmetic(),
        "settings": settings or {},
        "tolerances": {key: each._asdict() for key, each in (tolerances or {}).items()},
        "runs": runs or {},
        "metrics": metrics or {},
    }
    golden: Golden = json.loads(json.dumps(found, default=str))
    return golden


def input_hash(source: LogSource | MemorySource) -> str:
    """Hash a run with SHA-256: the file of a log, or the columns of a recording."""
    return hash_files([source.log.path]) if isinstance(source, LogSource) else hash_streams([source])


def _is_estimated(stream: Stream) -> bool:
    """Test whether an output belongs in a golden; coverage and empty streams of failures do not."""
    schema = stream.schema.full_name
    return schema != schemas.COVERAGE.full_name and (len(stream) > 0 or schema not in REASONS)


def _is_kept(topic: str, column: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(f"{topic} {column}", pattern) for pattern in patterns)


def _stream(stream: Stream, rows: int, columns: Sequence[str]) -> dict[str, Any]:
    """Return the golden's entry for a stream; failures and similar events have only counts and times."""
    has_values = stream.schema.full_name not in REASONS
    kept = kept_rows(len(stream), rows)
    values = {
        name: column.astype(float)
        for name, column in stream.columns.items()
        if has_values and _is_kept(stream.topic, name, columns)
    }
    return {
        "rows": len(stream),
        "publish_times": _sha256(stream.publish_time_ns),
        "log_times": _sha256(stream.log_time_ns),
        "metadata": dict(stream.metadata) if has_values else {},
        "checksums": base64.b64encode(checksums(values).tobytes()).decode() if values else "",
        "columns": {name: _column(column, kept) for name, column in values.items()},
    }


def kept_rows(count: int, most: int) -> NDArray[np.int64]:
    """Choose at most `most` evenly spaced rows of a stream of `count` rows."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(np.int64)


def checksums(columns: Mapping[str, Floats]) -> NDArray[np.uint16]:
    """Compute a checksum of the bits of each row, (rows,), to find changed rows."""
    parts = [
        column.reshape(len(column), math.prod(column.shape[1:])) for _, column in sorted(columns.items())
    ]
    words = np.ascontiguousarray(np.hstack(parts)).view(np.uint64)
    odd = np.random.default_rng(0).integers(1, 2**63, words.shape[1], np.uint64) * 2 + 1
    mixed = (words ^ (words >> np.uint64(32))) * odd
    return (mixed.sum(axis=1, dtype=np.uint64) >> np.uint64(48)).astype("<u2")


def _column(column: Floats, kept: NDArray[np.int64]) -> dict[str, Any]:
    return {
        "kept": column[kept].tolist(),
        "missing": np.isnan(column).sum(axis=0).tolist(),
        "sum": np.nansum(column, axis=0).tolist(),
        "sum_of_squares": np.nansum(column**2, axis=0).tolist(),
    }


def _sha256(array: NDArray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()[:16]


def arithmetic() -> str:
    """Hash results of elementary functions and linear algebra, whose last digits depend on the CPU.

    If the hash differs from the golden's, inputs that are simulated or imported again differ too, and
    estimates cannot agree to 1e-12.
    """
    x = np.linspace(0.01, 10.0, 1001)
    matrix = np.exp(-np.abs(np.subtract.outer(x[:40], x[:40])))
    both = ("sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh", "sqrt")
    parts = [
        *(getattr(np, name)(x) for name in both),
        *(np.array([getattr(math, name)(value) for value in x.tolist()]) for name in both),
        *(function(x, x[::-1]) for function in (np.arctan2, np.hypot, np.power)),
        *(matrix @ matrix, np.linalg.cholesky(matrix), np.linalg.eigh(matrix)[1]),
    ]
    return _sha256(np.concatenate([np.ravel(part) for part in parts]))
