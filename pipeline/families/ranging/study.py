"""Common parts of studies of ranges: recordings in a folder, their replay, and errors."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.sources import MemorySource, memory_source


class RangingOptions(Parameters):
    """A delay of the ranges, which the recordings do not state.

    Attributes:
        range_delay_s: age of a range at its stamp, in s; added to an estimator's own `range_delay_s`.
    """

    range_delay_s: float = 0.0


class Recording(NamedTuple):
    """A recording, with its name, its path, and additional files that belong to it."""

    name: str
    path: Path
    more: tuple[Path, ...] = ()


class Replayed(NamedTuple):
    """A recording with the outputs of every estimator, by the last part of their topics."""

    recording: Recording
    source: MemorySource
    outputs: Mapping[str, Mapping[str, Stream]]


def recordings(setting: Setting, pattern: str) -> list[Path]:
    """Find the files with this name in or below the data's folder; raise BadInput if there are none."""
    assert setting.data is not None
    found = sorted(setting.data.rglob(pattern)) if setting.data.is_dir() else []
    if not found:
        raise BadInput(
            f"{setting.data}: has no {pattern} in it or below; give the recording's folder or one "
            "above it"
        )
    return found


def replayed(experiment: Experiment, setting: Setting, found: list[Recording]) -> Iterator[Replayed]:
    """Yield the recordings one by one; keep all logs, and draw the timeline of the first."""
    assert experiment.import_ is not None
    delay_s, runner = setting.options.range_delay_s, Runner(experiment, setting)
    estimators = dict(experiment.estimators)
    if delay_s:
        for label, values in estimators.items():
            estimators[label] = {**values, "range_delay_s": values.get("range_delay_s", 0.0) + delay_s}
    for number, recording in enumerate(found):
        values = {**experiment.import_.parameters, "more": [str(path) for path in recording.more]}
        source = memory_source(*import_run(experiment.import_.source, recording.path, values))
        outputs = runner.replay([source], estimators).outputs
        folder = recording.name if len(found) > 1 else ""
        runner.keep([source], outputs, folder, drawn=None if number else "")
        by_label: dict[str, dict[str, Stream]] = {label: {} for label in estimators}
        for topic, ragged in outputs.items():
            label, _, leaf = topic.removeprefix("/estimates/").rpartition("/")
            if label in by_label:
                by_label[label][leaf] = ragged.of_run(0)
        yield Replayed(recording, source, by_label)


class Reference(NamedTuple):
    """The truth: ordered stamps (n,), and components (n, d) with unwrapped angles."""

    time_ns: Integers
    state: Floats

    def at(self, time_ns: Integers) -> Floats:
        """Interpolate linearly between stamps."""
        since = (self.time_ns - self.time_ns[0]) * 1e-9
        wanted = (time_ns - self.time_ns[0]) * 1e-9
        return np.stack([np.interp(wanted, since, column) for column in self.state.T], axis=1)


def mean_nis(innovations: Stream, begin_ns: int, end_ns: int) -> float:
    """Compute the mean NIS of single ranges within a time span."""
    stamps = innovations.publish_time_ns
    inside = (stamps >= begin_ns) & (stamps <= end_ns)
    return float(np.mean(innovations["normalised_innovation_squared"][inside]))


def outcome_of(found: list[Replayed], rows: list[dict[str, Any]]) -> Outcome:
    """Tabulate results by estimator and recording, and add them as metrics."""
    table = pd.DataFrame(rows)
    outcome = Outcome(input_sha256=hash_streams([each.source for each in found]))
    for row in rows:
        outcome.metrics |= {
            f"{row['estimator']}.{name}.{row['recording']}": float(value)
            for name, value in row.items()
            if name not in ("estimator", "recording")
        }
    outcome.tables |= {"recordings": table, "summary": summary_table(outcome.metrics)}
    notes = [(each.recording.name, *note) for each in found for note in each.source.run.notes.items()]
    outcome.tables["notes"] = pd.DataFrame(notes, columns=["recording", "what", "count"])
    return outcome


def errors_chart(errors: Mapping[str, tuple[Integers, Floats]], label: str) -> Chart:
    """Draw every estimator's errors over time, for one recording.

    Args:
        errors: stamps in ns and errors, (n,) each, by estimator.
        label: label of the error axis, with the unit.
    """
    begin_ns = min(int(time_ns[0]) for time_ns, _ in errors.values() if len(time_ns))
    panel = Panel(x=Axis(label="time (s)"), y=Axis(label=label, log=True))
    for name, (time_ns, error) in errors.items():
        rows = np.unique(np.linspace(0, max(len(time_ns) - 1, 0), 600).astype(int))
        panel.series.append(curve(name, (time_ns[rows] - begin_ns) * 1e-9, error[rows]))
    return Chart(panels=[panel])
