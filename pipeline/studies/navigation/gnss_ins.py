"""A study of how well a GNSS receiver with an inertial unit bridges outages in a recording.

Fixes with errors of centimetres are withheld in many windows of a recording. The estimates of a filter
and a smoother are compared with the withheld fixes, and with two methods that use no inertial unit:
extrapolation with the last velocity, and a cubic between the ends of the outage.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.pipeline.studies.navigation.outages import (
    COASTED,
    FIX,
    HERMITE,
    INERTIAL,
    VELOCITY,
    Rows,
    error_table,
    in_runs,
    length_table,
    rows_of,
    window_table,
    windows_of,
    withheld,
)
from fuselog.recorders.errors import BadInput
from fuselog.recorders.importers.tables.mapping import adapted, read_mapping, recordings_in
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.ensembles import Ensemble
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import MemorySource, memory_source

CHI_SQUARE_95 = 7.81  # for three degrees of freedom
RUNS_AT_ONCE = 2  # limit on memory


class GnssInsOptions(Parameters):
    """The protocol of the outages.

    Attributes:
        filter: label of the filter that is compared.
        smoother: label of the smoother that is compared.
        delayed: label of a smoother that reverses the mapping's correction of the velocity delay, or "".
        lengths_s: lengths of the outages, in s.
        first_s: start of the first window, in s after the receiver's first row.
        every_s: time between the starts of successive windows.
        apart: multiple of `every_s` between the starts of windows that share a run.
        settle_s: time after the first inertial sample from which fixes are used.
        innovations_from_s: time after the receiver's first row from which innovations are counted.
    """

    filter: str = "ekf"
    smoother: str = "smoother"
    delayed: str = ""
    lengths_s: Annotated[list[PositiveFloat], Field(min_length=1)] = [10.0, 15.0, 30.0]
    first_s: NonNegativeFloat = 25.0
    every_s: PositiveFloat = 10.0
    apart: PositiveInt = 6
    settle_s: NonNegativeFloat = 0.2
    innovations_from_s: NonNegativeFloat = 20.75


class Innovations(NamedTuple):
    """NIS of a kind of measurement at good fixes: mean, share above the 95 % limit, mean by axis."""

    nis: float
    share_above: float
    by_axis: list[float]


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: GnssInsOptions = setting.options
    experiment, folder = ignoring_delay(experiment, options), recording_of(experiment, setting)
    whole, rows = _recording(experiment, folder, options)
    # the longest windows come first, because the first run is drawn
    windows = {
        length_s: windows_of(rows, length_s, options.first_s, options.every_s)
        for length_s in sorted(options.lengths_s, reverse=True)
    }
    runs = [
        together
        for found in windows.values()
        if found
        for together in in_runs(found, options.every_s, options.apart)
    ]
    if not runs:
        raise BadInput(
            f"{folder}: no window of {', '.join(f'{each:g}' for each in options.lengths_s)} s has "
            "truth in all rows; change options.first_s, options.every_s or options.lengths_s"
        )
    runner = Runner(experiment, setting)
    tables = []
    for first in range(0, len(runs), RUNS_AT_ONCE):
        now = runs[first : first + RUNS_AT_ONCE]
        sources = Ensemble(withheld(whole, rows, each) for each in now)
        outputs = replay_in_memory(sources, experiment.estimators, progress=setting.progress)
        runner.keep(sources, outputs, drawn=None if first else "", first_run=first)
        tables.append(error_table(rows, now, outputs, list(experiment.estimators)))
    errors = pd.concat(tables, ignore_index=True)
    undisturbed = Ensemble([withheld(whole, rows, [])])
    outputs = replay_in_memory(undisturbed, experiment.estimators, progress=setting.progress)
    runner.keep(undisturbed, outputs, drawn=None, first_run=len(runs))
    by_window = window_table(errors)
    by_length = length_table(by_window).sort_values("length_s", kind="stable")
    outcome = Outcome(input_sha256=hash_streams([whole]))
    for label, length_s, _, *values in by_length.itertuples(index=False):
        for name, value in zip(by_length.columns[3:], values, strict=True):
            outcome.metrics[f"{label}.{name}.{length_s:g}s"] = value
    for label, name, value in by_window[["estimator", "window", "over_rmse_m"]].to_numpy():
        outcome.metrics[f"{label}.window_rmse_m.{name}"] = value
    kinds = innovations_of(outputs, rows, options)
    for kind, each in kinds.items():
        outcome.metrics[f"{options.filter}.{kind}_nis"] = each.nis
        outcome.metrics[f"{options.filter}.{kind}_nis_share_above_95"] = each.share_above
        for axis, value in zip("xyz", each.by_axis, strict=True):
            outcome.metrics[f"{options.filter}.{kind}_nis_{axis}"] = value
    last = outputs[f"/estimates/{options.filter}/state"].stream
    end = dict(zip(last.components, last["mean"][-1].tolist(), strict=True))
    for name in [each for each in end if "_bias_" in each]:
        outcome.metrics[f"{options.filter}.end_{name}"] = end[name]
    started = outputs.get(f"/estimates/{options.filter}/started")  # missing if the log has a prior
    begun = [] if started is None else sentences_of(started.stream)
    notes = [*whole.run.notes.items(), *((sentence, "") for sentence in begun)]
    outcome.tables |= {
        "summary": summary_table(outcome.metrics),
        "outages": by_length,
        "windows": by_window,
        "errors": errors.drop(columns="nees"),
        "notes": pd.DataFrame(notes, columns=["what", "count"]),
    }
    outcome.figures["outages"] = _chart(errors)
    outcome.metrics[f"receiver.rows.{folder.name}"] = float(len(rows.time_ns))
    return outcome


def recording_of(experiment: Experiment, setting: Setting) -> Path:
    """Find the only folder at or below --data that has all files of the mapping.

    Raises BadInput if there are several such folders.
    """
    assert setting.data is not None
    assert experiment.import_ is not None
    mapping = read_mapping(str(experiment.import_.parameters.get("mapping", "")))
    folders = recordings_in(mapping, setting.data)
    if len(folders) > 1:
        names = ", ".join(str(folder) for folder in folders)
        raise BadInput(f"{setting.data}: has several recordings; give one of {names} with --data")
    return folders[0]


def ignoring_delay(experiment: Experiment, options: GnssInsOptions) -> Experiment:
    """Set the velocity delay of the estimator `delayed` to the negative of the mapping's delay."""
    assert experiment.import_ is not None
    values = experiment.import_.parameters
    if options.delayed not in experiment.estimators:
        return experiment
    mapping = adapted(read_mapping(str(values["mapping"])), delays_s=values.get("delays_s"))
    streams = [stream for table in mapping.tables for stream in table.streams]
    delay_s = next((stream.delay_s for stream in streams if stream.topic == VELOCITY), 0.0)
    delayed = {**experiment.estimators[options.delayed], "velocity_delay_s": -delay_s}
    estimators = {**experiment.estimators, options.delayed: delayed}
    return experiment.model_copy(update={"estimators": estimators})


def _recording(
    experiment: Experiment, folder: Path, options: GnssInsOptions
) -> tuple[MemorySource, Rows]:
    """Import the recording; return it without fixes before `settle_s`, and the receiver's rows."""
    assert experiment.import_ is not None
    values = experiment.import_.parameters
    recording = memory_source(*import_run(experiment.import_.source, folder, values))
    source = MemorySource(recording.streams, recording.run, str(folder))
    rows = rows_of(source)
    streams = dict(source.streams)
    begin_ns = streams[INERTIAL].publish_time_ns[0] + round(1e9 * options.settle_s)
    for topic in (FIX, VELOCITY):
        streams[topic] = streams[topic].take(streams[topic].log_time_ns >= begin_ns)
    return MemorySource(streams, source.run, source.name), rows


def innovations_of(
    outputs: Mapping[str, Ragged], rows: Rows, options: GnssInsOptions
) -> dict[str, Innovations]:
    """Compute the NIS of positions and velocities of the filter in the run without outages."""
    stream = outputs[f"/estimates/{options.filter}/innovation"].stream
    size = stream["innovation"].shape[1]
    covariance = stream["covariance"].reshape(-1, size, size)
    squares = stream["innovation"] ** 2 / np.diagonal(covariance, axis1=1, axis2=2)
    found = {}
    for name, axes in (("position", slice(0, 3)), ("velocity", slice(3, 6))):
        of_kind = np.flatnonzero(np.isfinite(squares[:, axes.start]))
        written_ns = stream.log_time_ns[of_kind]
        row = np.searchsorted(rows.time_ns, written_ns).clip(0, len(rows.time_ns) - 1)
        is_late = rows.since_s[row] > options.innovations_from_s
        chosen = of_kind[np.isfinite(rows.place[row, 0]) & is_late]
        nis = stream["normalised_innovation_squared"][chosen]
        found[name] = Innovations(
            float(nis.mean()),
            float(np.mean(nis > CHI_SQUARE_95)),
            squares[chosen, axes].mean(axis=0).tolist(),
        )
    return found


def _chart(errors: pd.DataFrame) -> Chart:
    """Draw the RMS error over the windows of each length against the time since the outage began."""
    panels = []
    for length_s, rows in errors.sort_values("length_s", kind="stable").groupby("length_s"):
        panel = Panel(
            x=Axis(label="since the fixes are withheld (s)"),
            y=Axis(label="horizontal error (m)", log=True),
            title=f"{length_s:g} s, {rows['window'].nunique()} windows",
        )
        squared = rows.assign(since_s=rows["since_s"].round(2), error_m=rows["error_m"] ** 2)
        for label, own in squared.groupby("estimator", sort=False):
            error_m = np.sqrt(own.groupby("since_s")["error_m"].mean())
            panel.series.append(
                curve(str(label), error_m.index, error_m, reference=label in (COASTED, HERMITE))
            )
        panels.append(panel)
    return Chart(panels=panels, columns=len(panels))


GNSS_INS = Study("a GNSS receiver with an inertial unit: errors during outages", study, GnssInsOptions)
