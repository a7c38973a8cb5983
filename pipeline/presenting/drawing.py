"""Drawings of runs: a run is opened or made again, and drawn with a layer for each estimator."""

import math
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from urllib.parse import quote as file_name

from rerun.chunk import Chunk

from fuselog.pipeline.altering.sources import alter, alter_all
from fuselog.pipeline.comparing.renamed import Renamed
from fuselog.pipeline.output.results import RESULT_FILE, Result, read_result
from fuselog.pipeline.presenting.runs import LAYOUT, WORST_AT, Part, Segment
from fuselog.pipeline.runs.ensemble import judge_logs
from fuselog.pipeline.runs.estimates import labels_of, source_of_estimates
from fuselog.pipeline.runs.experiment import Stated
from fuselog.pipeline.runs.initial_states import order_of
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner, runner_again
from fuselog.recorders.log import RunMetadata, open_log
from fuselog.replay.engine.streams.sources import LogSource, MemorySource
from fuselog.replay.judging.errors.moments import worst_of
from fuselog.replay.judging.judge import Judge
from fuselog.replay.timeline.catalog import BASE, PROPERTIES, properties_chunk, read_chunks, write_chunks
from fuselog.replay.timeline.drawing.canvas import escaped
from fuselog.replay.timeline.show import Drawing

# Relative difference of an error that the same code may give on another processor.
SAME = 1e-6
Recorded = LogSource | MemorySource


def draw(segment: Segment, gap_limit_s: float, folder: Path) -> list[str]:
    """Draw a segment into an existing folder: a file for each layer, and the layout.

    Returns sentences on errors that differ from the result's errors because the code has changed.
    """
    source, estimates, versions = open_run(segment)
    whole = folder / "whole.rrd"
    with Drawing(source.whole(), identity=segment.name, save=whole, layout=folder / LAYOUT) as drawing:
        judge = judge_logs([estimates], [source], {}, gap_limit_s=gap_limit_s, drawing=drawing)
    layers: dict[str, list[Chunk]] = {label: [] for label in (BASE, *versions) if label != PROPERTIES}
    names = {escaped(label): label for label in layers}
    for chunk in read_chunks(whole):
        parts = chunk.entity_path.split("/")[2:]  # without the root, such as `plots`
        layers[next((names[each] for each in parts if each in names), BASE)].append(chunk)
    whole.unlink()
    for (label, case), worst_s in worst_times(judge).items():
        group = segment.group(label, case)
        if WORST_AT not in segment.properties.get(group, {}):
            layers.get(label, layers[BASE]).append(properties_chunk(group, {WORST_AT: worst_s}))
    for label, chunks in layers.items():
        write_chunks(folder / f"{file_name(label)}.rrd", segment.name, chunks)
    return differing(segment, judge)


def worst_times(judge: Judge) -> dict[tuple[str, str], float]:
    """Return the time (s) of the largest NEES, or error if there is no NEES, by estimator and case."""
    found = [(each.estimator, each.case) for each in judge.moments]
    worst = {
        key: worst_of(each for each in judge.moments if (each.estimator, each.case) == key)
        for key in found
    }
    return {key: moment.elapsed_s for key, moment in worst.items() if moment is not None}


def differing(segment: Segment, judge: Judge) -> list[str]:
    """Describe the first metric of a replay that differs from the result's; return [] if all agree."""
    if segment.parts[0].result is None:
        return []
    for row in judge.runs_table.to_dict("records"):
        label = str(row["estimator"])
        stated = segment.properties.get(segment.group(label, str(row["case"])), {})
        for key, value in stated.items():
            now = row.get(key)
            if not isinstance(value, float) or now is None:
                continue
            if not math.isclose(value, float(now), rel_tol=SAME, abs_tol=1e-12):
                return [
                    f"{segment.name}: drawn now, {key} of {label} is {now:.6g}, where the result has "
                    f"{value:.6g}; the code has changed since"
                ]
    return []


def open_run(segment: Segment) -> tuple[Recorded, MemorySource, dict[str, str]]:
    """Return the run, the estimates of all versions, and the version of each estimator by label.

    If an earlier version has an estimator with the same label, the version's title is appended to the
    label.

    Raises BadInput if the logs no longer exist and the run cannot be recorded again.
    """
    source, first = _open_part(segment.parts[0])
    versions = dict.fromkeys(labels_of(first), segment.parts[0].title)
    streams = first.read([topic for topic in first.topics if topic.startswith("/estimates/")])
    for part in segment.parts[1:]:
        _, other = _open_part(part)
        for label in labels_of(other):
            names = chain(
                [label, named := f"{label} {part.title}"], map(f"{named} {{}}".format, count(2))
            )
            name = next(each for each in names if each not in versions)
            versions[name] = part.title
            own = Renamed(other, label, name)
            streams |= own.read([*own.topics])
    run = source.run or RunMetadata("unknown", epoch_ns=source.epoch_ns)
    return source, MemorySource(streams, run, source.name), versions


def _open_part(part: Part) -> tuple[Recorded, Recorded]:
    """Open or make a run and its estimates."""
    if part.estimates is not None:
        estimates = open_log(part.estimates, recover=part.recover)
        source = source_of_estimates(estimates, part.log, recover=part.recover)
        return source, LogSource(estimates)
    if part.result is None:
        assert part.log is not None
        source = alter(LogSource(open_log(part.log, recover=part.recover)), {})
        return source, MemorySource({}, source.run or RunMetadata("unknown"), source.name)
    runner = runner_of(part.result, read_result(part.result), part.point)
    experiment = runner.experiment
    found = alter_all(runner.obtain(first_run=part.run, runs=1), experiment.alterations or {})
    order, late = order_of(arrival_order=bool(experiment.arrival_order), late=experiment.late)
    outputs = replay_in_memory(found, experiment.estimators, order=order, late=late)
    run = found[0].run or RunMetadata("unknown", epoch_ns=found[0].epoch_ns)
    streams = {topic: rows.of_run(0) for topic, rows in outputs.items()}
    return found[0], MemorySource(streams, run, found[0].name)


def runner_of(folder: Path, result: Result, point: int | None = None) -> Runner:
    """Return the runner that replays the runs of a result, or of one point of a sweep.

    Raises BadInput if the settings do not state the runs and the estimators, or if logs no longer exist.
    """
    runner = runner_again(folder, result)
    if point is None:
        return runner
    from fuselog.pipeline.runs.sweeps import settings_at  # slow to import

    entries = runner.experiment.model_dump(mode="json", by_alias=True, exclude_none=True)
    stated = Stated(result.experiment, str(folder / RESULT_FILE), entries, Path())
    settings = settings_at(result.settings["sweep"][point])
    return replace(runner, experiment=stated.with_settings(settings, {}))
