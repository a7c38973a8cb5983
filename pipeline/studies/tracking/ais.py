"""The study of tracks of reports without identities: which vessels kept one track of their own.

The identities that the log has are used to judge alone. A vessel's own track is the one that it is
assigned when tracks and vessels are paired one to one: see `replay.judging.tracks.tracks`.
"""

import numpy as np
import pandas as pd
from pydantic import NonNegativeInt, PositiveFloat

from pipeline.output.charts import Axis, Chart, Panel, curve, level, thinned
from pipeline.output.claims import Claim, judged
from pipeline.output.results import Outcome
from pipeline.output.summary import summary_table
from pipeline.runs.estimates import hash_streams
from pipeline.runs.experiment import Experiment, Setting, Study
from pipeline.runs.recorded import Replayed
from pipeline.runs.runner import Runner
from recorders.errors import BadInput
from recorders.parameters import Parameters
from replay.judging.metrics.measuring import Output
from replay.judging.tracks.tracks import (
    KEPT_SHARE,
    MANY_REPORTS,
    kept,
    live_counts,
    reports_of,
    track_tables,
)


class AisOptions(Parameters):
    """Which estimator is held to what.

    Attributes:
        estimator: label of the estimator that is held to the targets.
        kept_share: share of vessels that are to keep one track.
        mean_share: mean share of a vessel's reports that are to be in its own track.
        more_reports_than: vessels with more reports than this count.
        live_s: a track is called live for so long after a report.
    """

    estimator: str = "report-tracker"
    kept_share: PositiveFloat = 0.7
    mean_share: PositiveFloat = 0.88
    more_reports_than: NonNegativeInt = MANY_REPORTS
    live_s: PositiveFloat = 600.0


def study(experiment: Experiment, setting: Setting) -> Outcome:
    """Run the experiment; see `pipeline.runs.experiment.Study`."""
    options: AisOptions = setting.options
    replayed = Runner(experiment, setting).run()
    vessels = vessel_table(replayed)
    if options.estimator not in set(vessels["estimator"]):
        raise BadInput(
            f"no tracks of '{options.estimator}', or no identities to judge them by; give a log with "
            "both"
        )
    outcome = Outcome(input_sha256=hash_streams(replayed.sources))
    outcome.metrics.update(replayed.metrics(experiment.metrics))
    outcome.tables["summary"] = summary_table(outcome.metrics)
    outcome.tables["vessels"] = vessels
    notes = replayed.sources[0].run.notes.items()
    outcome.tables["notes"] = pd.DataFrame(notes, columns=["what", "count"])
    outcome.figures["tracks"] = tracks_chart(replayed, vessels, options)
    outcome.claims = _claims(vessels, options)
    return outcome


def vessel_table(replayed: Replayed) -> pd.DataFrame:
    """The tables of `replay.judging.tracks.tracks.track_table` of all estimators."""
    tables = [
        table.assign(estimator=each.estimator)
        for each in replayed.judged
        if isinstance(each, Output)
        for table in track_tables(reports_of(each))
    ]
    if not tables:
        raise BadInput(
            "no tracks to judge: the log has no identities, or no estimator gives tracks; give both"
        )
    return pd.concat(tables).rename(columns={"target": "mmsi"})


def tracks_chart(replayed: Replayed, vessels: pd.DataFrame, options: AisOptions) -> Chart:
    """The share of every vessel's reports in its own track, and live tracks and vessels over time."""
    many = vessels[vessels["reports"] > options.more_reports_than]
    shares = {
        str(estimator): np.sort(rows["share"])[::-1]
        for estimator, rows in many.groupby("estimator", sort=False)
    }
    series = [
        curve(name, np.arange(len(share)), share, "line+markers") for name, share in shares.items()
    ]
    most = max(map(len, shares.values()), default=1)
    above = Panel(
        x=Axis(label=f"vessels with more than {options.more_reports_than} reports, best first"),
        y=Axis(label="share of reports in the own track", limits=(0, 1.02)),
        series=[*series, level(f"kept: {KEPT_SHARE:g}", np.arange(most), KEPT_SHARE)],
    )
    [source] = replayed.sources
    identity = source.read(["/identity"])["/identity"]
    seen = {"vessels": (identity.publish_time_ns, identity["thing_id"])}
    for each in replayed.judged:
        if isinstance(each, Output) and each.leaf == "track":
            stream = each.rows.stream
            seen[f"tracks of {each.estimator}"] = stream.publish_time_ns, stream["track_id"]
    below = Panel(x=Axis(label="time (s)"), y=Axis(label=f"heard within {options.live_s:g} s"))
    for label, (time_ns, numbers) in seen.items():
        at_ns, live = live_counts(time_ns, numbers, options.live_s)
        rows = thinned(len(at_ns))
        elapsed_s = (at_ns[rows] - source.epoch_ns) * 1e-9
        below.series.append(curve(label, elapsed_s, live[rows], reference=label == "vessels"))
    return Chart(panels=[above, below])


def _claims(vessels: pd.DataFrame, options: AisOptions) -> list[Claim]:
    own = kept(vessels[vessels["estimator"] == options.estimator], reports=options.more_reports_than)
    if own.targets == 0:
        return []
    who = f"{own.targets} vessels with more than {options.more_reports_than} reports"
    return [
        judged(
            f"{options.kept_share:.0%} of {who} keep one track for {KEPT_SHARE:.0%} of their reports",
            "own target; plain nearest neighbour on position and velocity: 62 %",
            f"{100 * own.kept_share:.1f} %",
            own.kept_share >= options.kept_share,
        ),
        judged(
            f"mean share of reports in the own track of {who}: {options.mean_share:g}",
            "own target; plain nearest neighbour on position and velocity: .84",
            f"{own.mean_share:.3f}",
            own.mean_share >= options.mean_share,
        ),
    ]


AIS = Study("tracks of reports without identities, against the identities", study, AisOptions)
