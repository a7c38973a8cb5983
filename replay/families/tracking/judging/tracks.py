"""Evaluation of tracks by the share of each target's reports that are in one track.

Each track is assigned to at most one target and vice versa, such that the number of reports in the track
of their target is largest. A track with reports from two targets is assigned to only one of them.
"""

import operator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import schemas
from fuselog.replay.judging.metrics.measuring import Metric, Output

if TYPE_CHECKING:
    import pandas as pd

Integers = NDArray[np.int64]
IDENTITY = "identity"
# Only targets with more reports are judged, because a few reports are too little evidence.
MANY_REPORTS = 50
# A target has kept its track if at least this share of its reports is in the track.
KEPT_SHARE = 0.95


class KeptTracks(NamedTuple):
    """Number of judged targets, share of kept targets, and mean share of reports in assigned tracks."""

    targets: int
    kept_share: float
    mean_share: float


def track_table(targets: Integers, tracks: Integers) -> "pd.DataFrame":
    """Make a table with one row per target, most reports first.

    The columns are `target`; `reports`, the number of the target's reports; `track`, the track assigned
    to the target, or -1; `share`, the share of the reports in this track; `largest_share`, the largest
    share of the reports in any track; `tracks`, the number of tracks that contain a report of the
    target; `switches`, how often two successive reports are in different tracks; `others`, the number of
    reports of other targets in the assigned track.

    Args:
        targets, tracks: (n,), the numbers of target and track of every report, in order of time.
    """
    import pandas as pd  # slow to import
    from scipy.optimize import linear_sum_assignment

    target, of_target = np.unique(targets, return_inverse=True)
    track, of_track = np.unique(tracks, return_inverse=True)
    counts = np.zeros((len(target), len(track)), np.int64)
    np.add.at(counts, (of_target, of_track), 1)
    rows, columns = linear_sum_assignment(counts, maximize=True)
    own = np.full(len(target), -1)
    own[rows] = np.where(counts[rows, columns] > 0, columns, -1)
    has_one = own >= 0
    reports = counts.sum(axis=1)
    in_own = np.where(has_one, counts[np.arange(len(target)), own], 0)
    order = np.argsort(of_target, kind="stable")
    changes = (np.diff(of_track[order]) != 0) & (np.diff(of_target[order]) == 0)
    table = pd.DataFrame(
        {
            "target": target,
            "reports": reports,
            "track": np.where(has_one, track[own], -1),
            "share": in_own / reports,
            "largest_share": counts.max(axis=1) / reports,
            "tracks": (counts > 0).sum(axis=1),
            "switches": np.bincount(of_target[order][1:][changes], minlength=len(target)),
            "others": np.where(has_one, counts.sum(axis=0)[own] - in_own, 0),
        }
    )
    return table.sort_values("reports", ascending=False, kind="stable", ignore_index=True)


def kept(table: "pd.DataFrame", column: str = "share", reports: int = MANY_REPORTS) -> KeptTracks:
    """Summarise the reports' shares in assigned tracks, for targets with more than `reports` reports."""
    shares = table.loc[table["reports"] > reports, column].to_numpy()
    if len(shares) == 0:
        return KeptTracks(0, np.nan, np.nan)
    return KeptTracks(len(shares), float((shares >= KEPT_SHARE).mean()), float(shares.mean()))


def live_counts(time_ns: Integers, numbers: Integers, live_s: float) -> tuple[Integers, Integers]:
    """Count the senders heard within the last `live_s`; return times (m,) of changes and counts (m,).

    Args:
        time_ns: (n,), sorted stamps of the reports.
        numbers: (n,), number of the sender of each report.
        live_s: time for which a sender is counted as live after its last report, in s.
    """
    order = np.lexsort((time_ns, numbers))
    sorted_ns, sorted_numbers = time_ns[order], numbers[order]
    live_ns = round(live_s * 1e9)
    begins = np.append(True, (np.diff(sorted_numbers) != 0) | (np.diff(sorted_ns) > live_ns))
    begin_ns = sorted_ns[begins]
    end_ns = sorted_ns[np.append(begins[1:], True)] + live_ns
    at_ns = np.unique(np.concatenate([begin_ns, end_ns]))
    at_ns = at_ns[at_ns <= time_ns[-1]]
    began = np.searchsorted(np.sort(begin_ns), at_ns, side="right")
    return at_ns, began - np.searchsorted(np.sort(end_ns), at_ns, side="right")


Reports = dict[int, list[tuple[Integers, Integers]]]


def reports_of(output: Output) -> Reports:
    """Return true targets and tracks (n,) of the reports by run, or {} if identities are unknown.

    The rows of the stream correspond to the reports in the replayed span, and therefore to their
    identities. Raises BadInput if the estimates do not belong to the log.
    """
    stream = output.rows.stream
    topic = f"{stream.metadata.get('reports', '').rpartition('/')[0]}/{IDENTITY}"
    is_known = all(topic in source.topics for source in output.sources)
    if stream.schema.full_name != schemas.TRACK_ESTIMATE.full_name or not is_known:
        return {}
    found: Reports = {}
    for run, source in enumerate(output.sources):
        tracks = output.rows.of_run(run)
        found[output.first_run + run] = []
        if len(tracks) == 0:
            continue
        identity = source.read([topic])[topic]
        times, [first_ns, last_ns] = identity.publish_time_ns, tracks.publish_time_ns[[0, -1]]
        targets = identity["thing_id"][(times >= first_ns) & (times <= last_ns)]
        if len(targets) != len(tracks):
            raise BadInput(
                f"{source.name}: {len(targets)} identities for {len(tracks)} reports on {stream.topic}; "
                "use the log from which these estimates were made"
            )
        both = targets.astype(np.int64), tracks["track_id"].astype(np.int64)
        found[output.first_run + run].append(both)
    return found


def track_tables(reports: Reports) -> "list[pd.DataFrame]":
    """Make a table per run; if any run has no reports, return no tables at all."""
    if not all(reports.values()):
        return []
    return [
        track_table(*(np.concatenate(each) for each in zip(*parts, strict=True)))
        for parts in reports.values()
    ]


def _add(state: Reports, output: Output) -> Reports:
    for run, parts in reports_of(output).items():
        state.setdefault(run, []).extend(parts)
    return state


def _finish(reports: Reports) -> dict[str, float]:
    tables = track_tables(reports)
    if not tables:
        return {}
    import pandas as pd

    found = pd.concat(tables)
    own, largest = kept(found), kept(found, "largest_share")
    tracks = np.concatenate([each for parts in reports.values() for _, each in parts])
    return {
        "judged_targets": own.targets,
        "kept_track_percent": 100.0 * own.kept_share,
        "kept_largest_percent": 100.0 * largest.kept_share,
        "own_track_mean_percent": 100.0 * own.mean_share,
        "largest_track_mean_percent": 100.0 * largest.mean_share,
        "tracks": float(np.unique(tracks).size),
        "switches": float(found["switches"].sum()),
    }


TRACKS = Metric(
    "share of reports in a single track, for targets with more than 50 reports",
    Output,
    dict,
    _add,
    operator.or_,
    _finish,
)
