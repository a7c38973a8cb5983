"""Study of Autoferry scenarios: the benefit of each sensor and of data association for vessel tracks.

Quays, marks and other craft have no reference, so GOSPA ignores everything more than 50 m from both
vessels. Trackers are replayed in stamp order. Some trackers are also replayed in order of arrival, with
each policy for late scans.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from fuselog.pipeline.families.tracking.study import (
    means_of,
    measure_changes,
    nis_metrics,
    sets_of,
    table_of,
)
from fuselog.pipeline.output.charts import Axis, Chart, Panel, curves
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import replay_in_memory
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.parameters import Parameters
from fuselog.recorders.recording import import_run
from fuselog.replay.engine.replaying.late import parse_late
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource, memory_source
from fuselog.replay.families.tracking.judging.errors import Judged, instants_of, tracks_at


class AutoferryOptions(Parameters):
    """The estimators to compare, and the policies for late scans to try.

    Attributes:
        compared: pairs of estimators to compare, the first with the second.
        late: policies for late scans to try in order of arrival.
        late_estimators: labels of the estimators that are replayed with these policies; estimators that
            the experiment does not run are ignored.
    """

    compared: list[tuple[str, str]] = []
    late: tuple[str, ...] = ("wait:1", "rewind:1", "drop")
    late_estimators: tuple[str, ...] = ()


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    names, sources = _scenarios(experiment, setting)
    runner = Runner(experiment, setting)
    replayed = runner.replay(sources)
    runner.keep(sources, replayed.outputs)
    runs = {name: instants_of(source) for name, source in zip(names, sources, strict=True)}
    table = table_of(replayed.outputs, list(experiment.estimators), runs)
    outcome = Outcome(input_sha256=hash_streams(sources))
    for label, of_mean in means_of(table).items():
        outcome.metrics |= {f"{label}.{name}": value for name, value in of_mean.items()}
    for label, name, value in table[["estimator", "run", "gospa_m"]].itertuples(index=False):
        outcome.metrics[f"{label}.gospa_m.{name}"] = float(value)
    measure_changes(table, setting.options.compared, outcome)
    outcome.metrics |= nis_metrics(replayed.innovations)
    late = _late_table(experiment, setting.options, sources, replayed.outputs, runs)
    for (late_label, policy), rows in late.groupby(["estimator", "policy"], sort=False):
        outcome.metrics[f"{late_label}.late_gospa_m.{policy}"] = float(rows["gospa_m"].mean())
        outcome.metrics[f"{late_label}.from_in_order_m.{policy}"] = float(rows["from_in_order_m"].max())
    outcome.tables |= {"scenarios": table, "summary": summary_table(outcome.metrics)}
    if len(late):
        outcome.tables["late"] = late
    notes = [
        (name, what, count)
        for name, source in zip(names, sources, strict=True)
        for what, count in source.run.notes.items()
    ]
    outcome.tables["notes"] = pd.DataFrame(notes, columns=["scenario", "what", "count"])
    outcome.figures["gospa"] = _chart(table)
    return outcome


def _scenarios(experiment: Experiment, setting: Setting) -> tuple[list[str], list[MemorySource]]:
    """Find the scenario folders in the data folder by number; if there are none, return that folder."""
    assert setting.data is not None
    assert experiment.import_ is not None
    found = sorted(setting.data.glob("*/*_detections.json")) if setting.data.is_dir() else []
    folders = sorted(
        [path.parent for path in found] or [setting.data], key=lambda each: (len(each.name), each.name)
    )
    source, values = experiment.import_.source, experiment.import_.parameters
    sources = [memory_source(*import_run(source, folder, values)) for folder in folders]
    return [folder.name for folder in folders], sources


def _late_table(
    experiment: Experiment,
    options: AutoferryOptions,
    sources: Sequence[MemorySource],
    in_order: Mapping[str, Ragged],
    runs: Mapping[str, Judged],
) -> pd.DataFrame:
    """Tabulate the results by estimator, policy for late scans, and scenario.

    `from_in_order_m` is the largest distance from the tracks in stamp order, after the last late scan;
    it is infinite if the track numbers differ.
    """
    tables = []
    known = experiment.estimators
    settings = {label: known[label] for label in options.late_estimators if label in known}
    for policy in options.late if settings else ():
        late = parse_late(policy, arrival_order=True)
        outputs = replay_in_memory(sources, settings, order="log_time", late=late)
        waited_s = late.window_ns * 1e-9 if late.policy == "wait" else 0.0
        table = table_of(outputs, list(settings), runs, waited_s)
        table.insert(1, "policy", late.policy)
        table["from_in_order_m"] = [
            _farthest(in_order, outputs, label, run, _last_late_ns(source))
            for label in settings
            for run, source in enumerate(sources)
        ]
        tables.append(table)
    return pd.concat(tables) if tables else pd.DataFrame(columns=["estimator", "policy"])


def _last_late_ns(source: MemorySource) -> int:
    """Return when the last late scan of a run arrived, or 0 if there are no late scans."""
    arrivals = [
        stream.log_time_ns[stream.log_time_ns > stream.publish_time_ns]
        for topic, stream in source.streams.items()
        if topic.endswith("/scan")
    ]
    return int(np.concatenate(arrivals).max(initial=0))


def _farthest(
    in_order: Mapping[str, Ragged], outputs: Mapping[str, Ragged], label: str, run: int, from_ns: int
) -> float:
    """Compute the largest distance between the tracks of two replays, from a given time on."""
    sizes, tracks = sets_of(in_order, label, run)
    stamps = np.unique(sizes.publish_time_ns)
    stamps = stamps[stamps >= from_ns]
    farthest = 0.0
    pairs = tracks_at(sizes, tracks, stamps), tracks_at(*sets_of(outputs, label, run), stamps)
    for one, other in zip(*pairs, strict=True):
        if one.number.tolist() != other.number.tolist():
            return np.inf
        farthest = max(farthest, float(np.abs(one.place - other.place).max(initial=0.0)))
    return farthest


def _chart(table: pd.DataFrame) -> Chart:
    """Draw GOSPA of every estimator by scenario."""
    series = curves(table, ["estimator"], "run", "gospa_m", "line+markers")
    panel = Panel(x=Axis(label="scenario"), y=Axis(label="mean GOSPA (m)"), series=series)
    return Chart(title="GOSPA (cutoff 20 m) by scenario", panels=[panel])


AUTOFERRY = Study(
    "benefit of each sensor for tracking vessels from a moving vessel", study, AutoferryOptions
)
