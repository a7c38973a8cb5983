"""Study of tracks from reports without identities: which vessels kept a track of their own.

The identities in the log are used only for evaluation. A vessel's own track is the one that a one-to-one
assignment of tracks to vessels selects; see `fuselog.replay.families.tracking.judging.tracks`.
"""

import numpy as np
import pandas as pd
from pydantic import PositiveFloat

from fuselog.pipeline.output.charts import Axis, Chart, Panel, curve, level, thinned
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.output.summary import summary_table
from fuselog.pipeline.runs.estimates import hash_streams
from fuselog.pipeline.runs.experiment import Experiment, Setting, Study
from fuselog.pipeline.runs.recorded import Replayed
from fuselog.pipeline.runs.runner import Runner
from fuselog.recorders.errors import BadInput
from fuselog.recorders.parameters import Parameters
from fuselog.replay.families.tracking.judging.tracks import (
    KEPT_SHARE,
    MANY_REPORTS,
    live_counts,
    reports_of,
    track_tables,
)
from fuselog.replay.judging.metrics.measuring import Output


class AisOptions(Parameters):
    """Options for counting tracks.

    Attributes:
        live_s: time in s after its last report for which a track counts as live.
    """

    live_s: PositiveFloat = 600.0


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `fuselog.pipeline.runs.experiment.Study`."""
    options: AisOptions = setting.options
    replayed = Runner(experiment, setting).run()
    vessels = vessel_table(replayed)
    outcome = Outcome(input_sha256=hash_streams(replayed.sources))
    outcome.metrics.update(replayed.metrics(experiment.metrics))
    outcome.tables["summary"] = summary_table(outcome.metrics)
    outcome.tables["vessels"] = vessels
    notes = replayed.sources[0].run.notes.items()
    outcome.tables["notes"] = pd.DataFrame(notes, columns=["what", "count"])
    outcome.figures["tracks"] = tracks_chart(replayed, vessels, options)
    return outcome


def vessel_table(replayed: Replayed) -> pd.DataFrame:
    """Concatenate the tables of all estimators; see `tracks.track_table`."""
    tables = [
        table.assign(estimator=each.estimator)
        for each in replayed.judged
        if isinstance(each, Output)
        for table in track_tables(reports_of(each))
    ]
    if not tables:
        raise BadInput(
            "there are no tracks to evaluate: the log has no identities, or no estimator gives tracks; "
            "give a log with identities and a tracker"
        )
    return pd.concat(tables).rename(columns={"target": "mmsi"})


def tracks_chart(replayed: Replayed, vessels: pd.DataFrame, options: AisOptions) -> Chart:
    """Draw the share of each vessel's reports in its own track, and live tracks over time."""
    many = vessels[vessels["reports"] > MANY_REPORTS]
    shares = {
        str(estimator): np.sort(rows["share"])[::-1]
        for estimator, rows in many.groupby("estimator", sort=False)
    }
    series = [
        curve(name, np.arange(len(share)), share, "line+markers") for name, share in shares.items()
    ]
    most = max(map(len, shares.values()), default=1)
    above = Panel(
        x=Axis(label=f"vessels with more than {MANY_REPORTS} reports, best first"),
        y=Axis(label="share of reports in their vessel's track", limits=(0, 1.02)),
        series=[*series, level(f"kept: {KEPT_SHARE:g}", np.arange(most), KEPT_SHARE)],
    )
    [source] = replayed.sources
    identity = source.read(["/identity"])["/identity"]
    seen = {"vessels": (identity.publish_time_ns, identity["thing_id"])}
    for each in replayed.judged:
        if isinstance(each, Output) and each.leaf == "track":
            stream = each.rows.stream
            seen[f"tracks of {each.estimator}"] = stream.publish_time_ns, stream["track_id"]
    below = Panel(x=Axis(label="time (s)"), y=Axis(label=f"received within {options.live_s:g} s"))
    for label, (time_ns, numbers) in seen.items():
        at_ns, live = live_counts(time_ns, numbers, options.live_s)
        rows = thinned(len(at_ns))
        elapsed_s = (at_ns[rows] - source.epoch_ns) * 1e-9
        below.series.append(curve(label, elapsed_s, live[rows], reference=label == "vessels"))
    return Chart(panels=[above, below])


AIS = Study("tracks of reports without identities, evaluated by the identities", study, AisOptions)
