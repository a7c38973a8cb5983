"""What every scenario records, in words: of each topic how many messages, when, what its channel states.

Below it what is in its fields: the first and the last message, and the root mean square of all. A clock
of the sensor is told where it is not the stamp.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from recorders.log import Stream, schemas
from recorders.recording import record_run
from recorders.registry import available

SHORT = {"biometric-scores": {"users": 20}, "navigation": {"duration_s": 12.0}}
# Sensors that come late, fail and see what is not there.
SENSOR = {"rate_hz": 4.0, "outlier_probability": 0.2, "outages_per_minute": 20.0, "outage_s": 2.0}
LATE = {"latency_s": 0.02, "latency_jitter_s": 0.1}
ADVERSE = {"landmarks": {"duration_s": 12.0, "robots": 2, "range_bearing": {**SENSOR, **LATE}}}
MOST = 6  # numbers of a message that are told


def in_words() -> Iterator[str]:
    """What each message says; of every scenario a short run, of some an adverse one too."""
    yield "# messages"
    for schema in schemas.SCHEMAS.values():
        yield f"{schema.full_name}: {schema.purpose}"
        yield from ("  " + " ".join(_declared(field)) for field in schema)
    yield ""
    names = [name for name, entry in available("recorders").items() if ".simulators." in entry.value]
    for name, parameters in [*((name, SHORT.get(name, {})) for name in names), *ADVERSE.items()]:
        recording, run = record_run(name, parameters, 5, 0)
        yield f"# {name} {parameters or ''}".rstrip()
        for stream in recording.streams:
            yield from _told(stream, run.epoch_ns)
        yield from (f"note {name}: {note}" for name, note in run.notes.items())
        yield ""


def _declared(field: schemas.Field) -> Iterator[str]:
    yield f"{field.name}, {field.kind}"
    for may_be in ("nan", "absent", "partial"):
        if getattr(field, f"may_be_{may_be}"):
            yield f"or {may_be}"


def _told(stream: Stream, epoch_ns: int) -> Iterator[str]:
    """A topic and its fields."""
    told = [f"{stream.topic}: {len(stream)} {stream.schema.name}"]
    if len(stream):
        first_s, last_s = (1e-9 * (stream.publish_time_ns[[0, -1]] - epoch_ns)).tolist()
        late_s = 1e-9 * np.mean(stream.log_time_ns - stream.publish_time_ns)
        told.append(f"from {first_s:.3f} to {last_s:.3f} s, logged {late_s:.3f} s later")
    told += [f"{name} {_stated(value)}" for name, value in sorted(stream.metadata.items())]
    yield ", ".join(told)
    for name, column in stream.columns.items():
        same = name == "sensor_time_ns" and np.array_equal(column, stream.publish_time_ns)
        if not column.size or same:
            continue
        values = 1e-9 * (column - epoch_ns) if name.endswith("_ns") else column.astype(float)
        values = values.reshape(len(column), -1)
        told = [f"{name} {_numbers(values[0])}"]
        if len(values) > 1:
            told[0] += f" to {_numbers(values[-1])}"
            known = values[np.isfinite(values)]
            told += [f"rms {np.sqrt(np.mean(known**2)):.4g}"] if known.size else []
        missing = int(np.isnan(values).sum())
        yield "  " + ", ".join([*told, *([f"{missing} missing"] if missing else [])])


def _numbers(values: Any) -> str:
    """Some numbers; what is but a rounding beside the others is none."""
    least = 1e-9 * np.nanmax(np.abs(values), initial=0.0)
    return " ".join(f"{0.0 if abs(each) < least else each:.4g}" for each in values[:MOST].tolist())


def _stated(value: str) -> str:
    """What a channel states: numbers to four digits."""
    try:
        return " ".join(f"{float(each):.4g}" for each in value.split(","))
    except ValueError:
        return value
