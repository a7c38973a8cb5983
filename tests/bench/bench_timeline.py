"""Drawing one run: ours against logging the same rows one by one, to a file, until it is closed."""

import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
import rerun as rr
import rerun.chunk as rc

from fuselog.recorders.recording import record_run
from fuselog.replay.engine.replaying.estimator import bind
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.sources import memory_source
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.show import show

SCENARIO = {"duration_s": 250.0, "range_bearing": {"rate_hz": 5.0, "outlier_probability": 0.02}}


def main() -> list[tuple[str, float, float, float]]:
    """Return rows of name, our rows per second, theirs, and how many times as many ours are."""
    sources = [memory_source(*record_run("landmarks", SCENARIO, 0))]
    bound = [each for name in ("dead-reckoning", "ekf", "ukf") for each in bind(name, sources, {})]
    outputs = collect(replay(sources, bound))
    errors = Judge(sources, {}, gap_limit_s=0.2).add(outputs).errors
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder, "ours.rrd"), Path(folder, "theirs.rrd")
        seconds = []
        for _ in range(3):
            begin = perf_counter()
            show(sources[0], outputs, errors, save=ours)
            seconds.append(perf_counter() - begin)
        rows = _rows(ours)
        begin = perf_counter()
        _log_one_by_one(rows, theirs)
        reference = len(rows) / (perf_counter() - begin)
        if len(_rows(theirs)) != len(rows):
            raise RuntimeError("the two files do not hold the same rows")
    rate = len(rows) / float(np.median(seconds))
    return [(f"draw {len(rows)} rows of one run, rows per s", rate, reference, rate / reference)]


def _rows(path):
    """Every row of a file as (entity, times, archetype, its fields)."""
    rows = []
    for chunk in rc.RrdReader(str(path)).stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        steps, spans, stamps = (
            batch.column(name).cast("int64").to_pylist() for name in ("step", "sim_time", "utc")
        )
        names = [name for name in batch.schema.names if ":" in name]
        archetype = getattr(rr, names[0].split(":")[0])
        fields = [name.split(":")[1] for name in names]
        columns = [batch.column(name).to_pylist() for name in names]
        for step, span, stamp, *values in zip(steps, spans, stamps, *columns, strict=True):
            times = (step, np.timedelta64(span, "ns"), np.datetime64(stamp, "ns"))
            rows.append(
                (
                    chunk.entity_path,
                    times,
                    archetype,
                    dict(zip(fields, map(_value, values), strict=True)),
                )
            )
    return rows


def _value(value):
    """One row's value as a program would have it at hand."""
    if not value:
        return value
    return value[0] if isinstance(value[0], str) else np.array(value)


def _log_one_by_one(rows, path):
    with rr.RecordingStream("bench", recording_id="bench", send_properties=False) as recording:
        recording.save(path)
        recording.set_log_time_enabled(False)
        for entity, (step, span, stamp), archetype, fields in rows:
            recording.set_time("step", sequence=step)
            recording.set_time("sim_time", duration=span)
            recording.set_time("utc", timestamp=stamp)
            recording.log(entity, archetype(**fields), strict=True)


if __name__ == "__main__":
    for row in main():
        print("{:55} {:12.0f} {:12.0f} {:8.1f}".format(*row))
