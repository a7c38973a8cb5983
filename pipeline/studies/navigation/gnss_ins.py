"""The study of a receiver with an inertial unit: how well they bridge outages of a recording.

The fixes of a recording with centimetres of error are withheld for a while, again and again; what a
filter and a smoother make of the rest is compared with the withheld fixes, and with what takes no
inertial unit: the last velocity, and a cubic between both ends.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from pipeline.output.charts import Axis, Chart, Panel, curve
from pipeline.output.claims import Claim, judged, listed
from pipeline.output.results import Outcome
from pipeline.output.summary import summary_table
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.recorded import replay_in_memory
from pipeline.runs.runner import Runner
from pipeline.studies.navigation.outages import (
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
from recorders.errors import BadInput
from recorders.importers.tables.mapping import adapted, read_mapping, recordings_in
from recorders.parameters import Parameters
from recorders.recording import import_run
from replay.engine.streams.blocks import Ragged
from replay.engine.streams.failures import sentences_of
from replay.engine.streams.sources import Ensemble, MemorySource, memory_source

CHI_SQUARE_95 = 7.81  # of three components
RUNS_AT_ONCE = 2  # in memory, with their estimates


class Bridged(Parameters):
    """What an independent implementation has for outages of one length, in m; see the columns' names."""

    filter_end: PositiveFloat
    filter_over: PositiveFloat
    smoother_over: PositiveFloat
    coasted_end: PositiveFloat
    coasted_over: PositiveFloat
    hermite_over: PositiveFloat


class Sheet(Parameters):
    """Numbers of an independent implementation, for one recording, by the lengths of outages (s).

    Accepted is at most `factor` times the errors of its filter and smoother.
    """

    recording: str
    outages: dict[str, Bridged]
    factor: PositiveFloat = 1.25
    position_nis: float
    velocity_nis: float
    ignored_delay_over: PositiveFloat
    gyro_bias_degps: tuple[float, float, float]
    force_bias_z_mps2: float


class GnssInsOptions(Parameters):
    """The protocol of the outages; `filter` and `smoother` are the labels of what is compared.

    Attributes:
        lengths_s: how long outages are.
        first_s, every_s: when windows begin, in seconds since the receiver's first row.
        apart: windows share a run that are so many times `every_s` apart.
        settle_s: fixes are used from so long after the first inertial sample on.
        innovations_from_s: from when on innovations count.
        delayed: the label of a smoother that takes back the mapping's delay of the velocity, if any.
        sheet: what claims about one recording are held to; others have none of them.
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
    sheet: Sheet | None = None


class Innovations(NamedTuple):
    """Of one kind of measurement, where the fix was good: mean NIS, the share above 95 %, by axis."""

    nis: float
    share_above: float
    by_axis: list[float]


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
    options: GnssInsOptions = setting.options
    experiment, folder = ignoring_delay(experiment, options), recording_of(experiment, setting)
    whole, rows = _recording(experiment, folder, options)
    # the longest come first: the first run is drawn
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
            f"{folder}: no window of {listed(options.lengths_s, 0, ', ')} s has a truth throughout; "
            "options.first_s, options.every_s and options.lengths_s move them"
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
        outcome.metrics[f"{label}.over_rmse_m.{name}"] = value
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
    started = outputs.get(f"/estimates/{options.filter}/started")  # none of a log with a prior
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
    outcome.claims = _claims(by_length, "".join(begun[:1]).partition("; ")[2], options)
    if options.sheet is not None and folder.name == options.sheet.recording:
        outcome.claims += _claims_of_sheet(by_length, kinds, end, options, options.sheet)
    return outcome


def recording_of(experiment: Experiment, setting: Setting) -> Path:
    """The one folder at --data or below that has all files of the mapping."""
    assert setting.data is not None
    assert experiment.import_ is not None
    mapping = read_mapping(str(experiment.import_.parameters.get("mapping", "")))
    folders = recordings_in(mapping, setting.data)
    if len(folders) > 1:
        names = ", ".join(str(folder) for folder in folders)
        raise BadInput(f"{setting.data}: has several recordings; give one of {names} with --data")
    return folders[0]


def ignoring_delay(experiment: Experiment, options: GnssInsOptions) -> Experiment:
    """The experiment whose estimator `delayed` takes velocities for those of their rows' stamps."""
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
    """The recording with the fixes that are used, and the rows of the receiver."""
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
    """What the filter's innovations of positions and velocities are worth in the run without outages."""
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
    """The error since the beginning of outages, root mean square over the windows of a length."""
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


def _claims(by_length: pd.DataFrame, doubt: str, options: GnssInsOptions) -> list[Claim]:
    """What is expected of every recording, and what its start leaves in doubt."""
    over = by_length.pivot_table("over_rmse_m", "length_s", "estimator")
    end = by_length.pivot_table("end_rmse_m", "length_s", "estimator")
    nees = by_length.pivot_table("end_nees", "length_s", "estimator")[options.filter]
    lengths = f"outages of {listed(over.index, 0, ', ')} s"
    return [
        judged(
            f"the smoother bridges {lengths} better than a cubic between both ends",
            "an inertial unit knows what happened between",
            f"{listed(over[options.smoother], 3, ', ')} m against {listed(over[HERMITE], 2, ', ')} m",
            bool((over[options.smoother] < over[HERMITE]).all()),
        ),
        judged(
            f"the filter errs less at the end of {lengths} than the last velocity does",
            "an inertial unit knows what happens",
            f"{listed(end[options.filter], 2, ', ')} m against {listed(end[COASTED], 2, ', ')} m",
            bool((end[options.filter] < end[COASTED]).all()),
        ),
        judged(
            f"the filter's covariance can be believed at the end of {lengths}",
            "mean NEES of 2 components .3 to 5, of few windows",
            listed(nees, 2, ", "),
            bool(nees.between(0.3, 5.0).all()),
            doubt,
        ),
    ]


def _claims_of_sheet(
    by_length: pd.DataFrame,
    kinds: Mapping[str, Innovations],
    end: Mapping[str, float],
    options: GnssInsOptions,
    sheet: Sheet,
) -> list[Claim]:
    """What an independent implementation has for this recording, with the tolerances that it states."""
    found: Any = by_length.set_index(["estimator", "length_s"]).to_dict("index")
    claims = []
    for text, theirs in sheet.outages.items():
        length_s = float(text)
        if (options.filter, length_s) not in found:
            continue
        own, back, coast, cubic = (
            found[label, length_s] for label in (options.filter, options.smoother, COASTED, HERMITE)
        )
        simple = [coast["end_rmse_m"], coast["over_rmse_m"], cubic["over_rmse_m"]]
        printed = [theirs.coasted_end, theirs.coasted_over, theirs.hermite_over]
        claims += [
            judged(
                f"outages of {text} s: without the inertial unit, which checks the protocol",
                f"{listed(printed, 2, ', ')} m within 1 %: last velocity at the end, over; cubic over",
                f"{listed(simple, 2, ', ')} m",
                bool(np.allclose(simple, printed, rtol=0.01)),
            ),
            judged(
                f"outages of {text} s: the filter",
                f"{theirs.filter_end:g} m at the end, {theirs.filter_over:g} m over; at most "
                f"{sheet.factor:g} times",
                f"{own['end_rmse_m']:.2f} m, {own['over_rmse_m']:.2f} m",
                own["end_rmse_m"] <= sheet.factor * theirs.filter_end
                and own["over_rmse_m"] <= sheet.factor * theirs.filter_over,
            ),
            judged(
                f"outages of {text} s: the smoother",
                f"{theirs.smoother_over:g} m over; at most {sheet.factor:g} times",
                f"{back['over_rmse_m']:.3f} m",
                back["over_rmse_m"] <= sheet.factor * theirs.smoother_over,
            ),
        ]
    if (options.delayed, 15.0) in found:
        ignored, heeded = (
            found[label, 15.0]["over_rmse_m"] for label in (options.delayed, options.smoother)
        )
        claims.append(
            judged(
                "the delay of the velocity, .125 s, matters: the smoother over 15 s that ignores it",
                f"{sheet.ignored_delay_over:g} m, within 15 %",
                f"{ignored:.3f} m instead of {heeded:.3f} m",
                abs(ignored / sheet.ignored_delay_over - 1.0) <= 0.15 and ignored > heeded,
            )
        )
    nis = {"position": sheet.position_nis, "velocity": sheet.velocity_nis}
    measured = [kinds[name].nis for name in nis]
    shares = [kinds[name].share_above for name in nis]
    bias = [float(np.degrees(end[f"gyro_bias_{axis}_radps"])) for axis in "xyz"]
    bias.append(end["accelerometer_bias_z_mps2"])
    wanted = [*sheet.gyro_bias_degps, sheet.force_bias_z_mps2]
    return [
        *claims,
        judged(
            "NIS of fixed positions and velocities, 3 components",
            f"{listed(list(nis.values()), 2, ', ')} within .4; at most 10 % above {CHI_SQUARE_95:g}",
            f"{listed(measured, 2, ', ')}; {listed(100 * np.array(shares), 1, ', ')} %",
            bool(np.allclose(measured, list(nis.values()), rtol=0, atol=0.4)) and max(shares) <= 0.1,
        ),
        judged(
            "biases at the end: gyro x, y, z in deg/s, accelerometer z in m/s2",
            f"{listed(wanted, 3, ', ')} within .03",
            listed(bias, 3, ", "),
            bool(np.allclose(bias, wanted, rtol=0, atol=0.03)),
        ),
    ]


GNSS_INS = Study("a receiver with an inertial unit: how well outages are bridged", study, GnssInsOptions)
