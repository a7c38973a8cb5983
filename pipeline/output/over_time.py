"""Panels over time: values with their 95 % range, and the mean NIS in parts of a run."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.pipeline.output.charts import Axis, Panel, Series, band, curve
from fuselog.replay.judging.errors.evaluation import Floats, nis_by_bin

BINS = 60


def panel_over_time(
    label: str,
    time_s: ArrayLike,
    values: ArrayLike,
    ends: tuple[ArrayLike, ArrayLike],
    y: Axis,
    title: str,
    of_band: str = "",
    others: Sequence[Series] = (),
) -> Panel:
    """Draw values (n,) over their range, with a strip along the bottom where they are outside.

    Args:
        label: name of the estimator; without `of_band`, also the name of the range.
        time_s: (n,).
        values: (n,).
        ends: the lower and upper ends (n,) of the range.
        y: vertical axis; the strip is drawn at its lower limit.
        title: text above the panel.
        of_band: name of a range that is the same for all estimators.
        others: further curves.
    """
    is_out = (values < np.asarray(ends[0])) | (values > np.asarray(ends[1]))
    series = [curve(label, time_s, values), *others]
    if is_out.any() and y.limits is not None:
        foot = np.full(int(is_out.sum()), 1.03 * y.limits[0])
        series.append(curve("outside", np.asarray(time_s)[is_out], foot, "outside"))
    shown = band(of_band or label, time_s, *ends, reference=bool(of_band))
    return Panel(x=Axis(label="time (s)"), y=y, series=series, bands=[shown], title=title)


def nis_over_time(
    time_s: Floats, squared: Floats, degrees: NDArray[np.int64]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Average NIS per component in `BINS` equal parts of a run.

    Args:
        time_s: (n,), times of the innovations.
        squared: (n,), NIS.
        degrees: (n,), numbers of components of the innovations.

    Returns, for the m parts with innovations, the middle of the part in s, the mean, and the lower and
    the upper end of its 95 % interval, (m,) each.
    """
    width_s = max(float(np.ptp(time_s)) / BINS, 1e-9)
    place = np.minimum(((time_s - time_s.min()) / width_s).astype(np.int64), BINS - 1)
    bins, *nis = nis_by_bin(place, squared, degrees)
    return time_s.min() + (bins + 0.5) * width_s, *nis
