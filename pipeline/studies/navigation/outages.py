"""Artificial outages of a receiver, in which the fixes of a recording are withheld.

A window is a span in which all fixes and velocities are withheld, selected by the stamps of the
receiver's rows. Windows that are far enough apart share a run. Errors are horizontal and are computed at
the withheld rows.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.interpolate import CubicHermiteSpline

from fuselog.recorders.common_streams import outage_stream
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Floats, Integers
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.engine.vectors.tangent import states_at

FIX, VELOCITY, TRUTH, INERTIAL = "/fix", "/velocity", "/truth", "/inertial"
NEEDED = (FIX, VELOCITY, TRUTH, INERTIAL)
COASTED, HERMITE = "constant-velocity", "hermite"
# Longest gap between estimates, in s, over which they are interpolated.
_GAP_S = 1.0


class Rows(NamedTuple):
    """The output of the receiver with a row per fix, and with east and north components.

    Attributes:
        time_ns: stamps as written by the receiver, (n,).
        place: positions in m, (n, 2); NaN if they are not accurate enough to serve as truth.
        velocity: velocities in m/s, (n, 2), as written in the row, without correction of a delay.
    """

    time_ns: Integers
    place: Floats
    velocity: Floats

    @property
    def since_s(self) -> Floats:
        """Return the seconds since the first row."""
        return (self.time_ns - self.time_ns[0]) * 1e-9


class Window(NamedTuple):
    """A span (s since the first row) in which fixes are withheld, and the indices of its rows."""

    length_s: float
    start_s: float
    rows: Integers

    @property
    def name(self) -> str:
        """Return the name of the window among the cases."""
        return f"{self.length_s:g}s-at-{self.start_s:g}s"


def rows_of(source: MemorySource) -> Rows:
    """Read the receiver's rows; raise BadInput if a topic is missing or has no messages."""
    for topic in NEEDED:
        if topic not in source.topics or not source.topics[topic].messages:
            why = ", because no row has a fixed solution" if topic == TRUTH else ""
            raise BadInput(
                f"{source.name}: has no messages of {topic}{why}; this study needs {', '.join(NEEDED)}"
            )
    fix, velocity, truth = (source.read([topic])[topic] for topic in (FIX, VELOCITY, TRUTH))
    # log times are used, because a delay in the mapping changes only publish times
    time_ns = fix.log_time_ns
    place, speed = np.full((len(fix), 2), np.nan), np.full((len(fix), 2), np.nan)
    for into, stream, values in (
        (place, truth, truth["state"]),
        (speed, velocity, velocity["velocity_mps"]),
    ):
        _, own, other = np.intersect1d(time_ns, stream.log_time_ns, return_indices=True)
        into[own] = values[other, :2]
    return Rows(time_ns, place, speed)


def windows_of(rows: Rows, length_s: float, first_s: float, every_s: float) -> list[Window]:
    """Find windows of this length in which all rows, and those just before and after, have a truth."""
    since_s = rows.since_s
    found = []
    for start_s in np.arange(first_s, since_s[-1] - length_s, every_s).tolist():
        inside = np.flatnonzero((since_s >= start_s) & (since_s < start_s + length_s))
        if len(inside) and inside[0] > 0 and inside[-1] + 1 < len(since_s):
            around = np.arange(inside[0] - 1, inside[-1] + 2)
            if np.isfinite(rows.place[around]).all():
                found.append(Window(length_s, start_s, inside))
    return found


def in_runs(windows: Sequence[Window], every_s: float, apart: int) -> list[list[Window]]:
    """Distribute windows of a length over runs, with `apart` steps of `every_s` between their starts."""
    shared: dict[int, list[Window]] = {}
    for window in windows:
        shared.setdefault(round((window.start_s - windows[0].start_s) / every_s) % apart, []).append(
            window
        )
    return list(shared.values())


def withheld(source: MemorySource, rows: Rows, windows: Sequence[Window]) -> MemorySource:
    """Remove the rows of the windows from the recording, and add a topic that lists the outages."""
    gone_ns = np.concatenate([rows.time_ns[:0], *(rows.time_ns[each.rows] for each in windows)])
    streams = dict(source.streams)
    for topic in (FIX, VELOCITY):
        stream = streams[topic]
        streams[topic] = stream.take(~np.isin(stream.log_time_ns, gone_ns))
    spans_s = np.array([(each.start_s, each.length_s) for each in windows]).reshape(-1, 2)
    spans_ns = rows.time_ns[0] + np.cumsum(np.rint(1e9 * spans_s).astype(np.int64), axis=1)
    streams[f"{FIX}/outages"] = outage_stream(f"{FIX}/outages", spans_ns)
    return replace(source, streams=streams)


def coasted(rows: Rows, window: Window) -> Floats:
    """Compute the errors (m, 2) of extrapolating the row before the window with its own velocity."""
    before = window.rows[0] - 1
    ahead_s = (rows.since_s[window.rows] - rows.since_s[before])[:, None]
    return rows.place[before] + ahead_s * rows.velocity[before] - rows.place[window.rows]


def hermite(rows: Rows, window: Window) -> Floats:
    """Compute the errors (m, 2) of the cubic through positions and velocities at both ends of a window.

    This cubic is the estimate of the smoother for white-noise acceleration.
    """
    ends = [window.rows[0] - 1, window.rows[-1] + 1]
    between = CubicHermiteSpline(rows.since_s[ends], rows.place[ends], rows.velocity[ends])
    return between(rows.since_s[window.rows]) - rows.place[window.rows]


def estimated(rows: Rows, window: Window, states: Stream) -> tuple[Floats, float]:
    """Compute errors (m, 2) of estimates, NaN if missing, and their NEES at the last withheld row."""
    time_ns = rows.time_ns[window.rows]
    plane = [states.components.index(name) for name in ("x_m", "y_m")]
    place = states["mean"][:, plane]
    found = states_at(states.publish_time_ns, place, time_ns, ("linear", "linear"), _GAP_S)
    error = found - rows.place[window.rows]
    if not np.isfinite(error[-1]).all():
        return error, np.nan
    last = np.searchsorted(states.publish_time_ns, time_ns[-1])
    size = round(states["covariance"].shape[1] ** 0.5)
    covariance = states["covariance"][last].reshape(size, size)[np.ix_(plane, plane)]
    return error, float(error[-1] @ np.linalg.solve(covariance, error[-1]))


def error_table(
    rows: Rows, runs: Sequence[Sequence[Window]], outputs: Mapping[str, Ragged], labels: Sequence[str]
) -> pd.DataFrame:
    """Tabulate the window, the time since its start, the error and the final NEES, by row and estimator.

    `runs` contains the windows of each run of the outputs.
    """
    tables = []
    for run, windows in enumerate(runs):
        for window in windows:
            for label, error, nees in _errors(rows, window, outputs, labels, run):
                length_m = np.linalg.norm(error, axis=1)
                tables.append(
                    pd.DataFrame(
                        {
                            "estimator": label,
                            "length_s": window.length_s,
                            "start_s": window.start_s,
                            "window": window.name,
                            "since_s": rows.since_s[window.rows] - window.start_s,
                            "error_m": length_m,
                            "nees": np.where(np.arange(len(error)) == len(error) - 1, nees, np.nan),
                        }
                    )
                )
    return pd.concat(tables, ignore_index=True)


def _errors(
    rows: Rows, window: Window, outputs: Mapping[str, Ragged], labels: Sequence[str], run: int
) -> Iterator[tuple[str, Floats, float]]:
    for label in labels:
        yield label, *estimated(rows, window, outputs[f"/estimates/{label}/state"].of_run(run))
    yield COASTED, coasted(rows, window), np.nan
    yield HERMITE, hermite(rows, window), np.nan


def window_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the error at the end, the RMSE over the window and the NEES by window and estimator."""
    by = errors.groupby(["estimator", "length_s", "start_s", "window"], sort=False)
    found = by.agg(
        end_m=("error_m", "last"),
        over_rmse_m=("error_m", lambda error: np.sqrt(np.mean(np.square(error)))),
        end_nees=("nees", "last"),
    )
    return found.reset_index()


def length_table(windows: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the RMS errors over the windows and the mean NEES by estimator and length."""
    by = windows.groupby(["estimator", "length_s"], sort=False)
    found = by.agg(
        windows=("window", "size"),
        end_rmse_m=("end_m", _root_mean_square),
        end_median_m=("end_m", "median"),
        over_rmse_m=("over_rmse_m", _root_mean_square),
        end_nees=("end_nees", "mean"),
    )
    return found.reset_index()


def _root_mean_square(values: pd.Series) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
