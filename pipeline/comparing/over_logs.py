"""Comparison of estimators over a selection of logs, each of which is replayed by itself."""

from dataclasses import replace

import pandas as pd

from fuselog.pipeline.api.over_logs import OTHERS, SIZES, Campaign, Replaying, aims_of
from fuselog.pipeline.comparing.candidates import Candidate
from fuselog.pipeline.comparing.comparing import Differences, differences_of
from fuselog.pipeline.selecting.selection import notes_of
from fuselog.recorders.errors import BadInput


def compare_over_logs(
    task: Replaying, campaign: Campaign, margin: float, gap_limit_s: float, *, fail_if_worse: bool
) -> Differences:
    """Replay each log, compare the estimators over the logs, and write the result folder.

    The unit of the intervals is the log, or the group of logs, whose metrics are averaged.

    Raises BadInput if there are fewer than two estimators, or no log is common to them.
    """
    labels = list(task.estimators)
    if len(labels) < 2:
        raise BadInput("name two estimators to compare over a selection of logs: -e ekf -e ukf")
    with campaign.table(task) as (table, _):
        rows = _in_common(table)
        if rows["estimator"].nunique() < len(labels):
            raise BadInput(f"no log was replayed by {' and '.join(labels)}; fuselog replay shows why")
        found = differences_of([[_candidate(label, rows) for label in labels]], margin, gap_limit_s)
        if "group" in table:
            found = replace(found, paired=[each._replace(unit="group") for each in found.paired])
        left_out = table[~table["log"].isin(rows["log"])].set_index("log")["problem"]
        notes = notes_of(left_out[~left_out.index.duplicated()].to_dict())
        found = replace(found, notes=[*notes, *found.notes], tables={"logs": table})
        if fail_if_worse:
            found.worse()  # raises if it cannot be judged, before anything is written
        found.save(campaign.out)
        return found


def _in_common(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of each log, case and metric that no estimator with this metric lacks."""
    keys = ["log", *(name for name in ("group", "estimator", "case") if name in table)]
    metrics = [name for name in table if name not in OTHERS]
    rows = table.melt([*keys, *(name for name in SIZES.values() if name in table)], metrics, "quantity")
    rows = rows.dropna(subset=["value"]).fillna({"case": ""}).sort_values("log", kind="stable")
    if "estimator" not in rows or "case" not in rows:
        return pd.DataFrame({"log": [], "estimator": []})
    all_of = rows.groupby("quantity")["estimator"].transform("nunique")
    return rows[rows.groupby(["log", "case", "quantity"])["estimator"].transform("nunique") == all_of]


def _candidate(label: str, rows: pd.DataFrame) -> Candidate:
    """Make a candidate from the metrics of an estimator, averaged over the logs of each group."""
    own = rows[rows["estimator"] == label]
    unit = "group" if "group" in own else "log"
    means = own.groupby([unit, "case", "quantity"], sort=False)["value"].mean().reset_index()
    sizes = {
        (quantity, str(case)): size
        for case, of in own.groupby("case", sort=False)
        for quantity, size in aims_of(of).items()
    }
    means = means.rename(columns={unit: "run"})
    return Candidate(label, label, means, pd.DataFrame(), sizes, settings=None)
