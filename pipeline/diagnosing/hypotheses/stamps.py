"""Hypotheses on stamps: delayed messages or a drifting clock."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.diagnosing.advice import Advice, number, precise
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis, in_sense, in_topic, value_of
from fuselog.recorders.log import Stream
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.replaying.estimator import Reading

Floats = NDArray[np.float64]
DELAYS_S = (-0.02, 0.02, -0.1, 0.1, -0.4, 0.4, -2.0, 2.0, -8.0, 8.0)
SPECIAL_S = {18.0: "the leap seconds between GPS and UTC", -18.0: "the leap seconds from UTC to GPS"}
RATES = (-1e-4, 1e-4, -1e-3, 1e-3, -0.01, 0.01, -0.03, 0.03, -0.1, 0.1)
LONGEST_DELAY_S, LARGEST_RATE = 30.0, 0.2
LAGS_S = np.arange(-30.0, 30.05, 0.1)
FEWEST = 20  # fewest speeds from which a lag can be estimated
MOST_CELLS = 1_000_000  # largest product of lags and speeds in memory


def of_stamps(
    stream: Stream,
    reading: Reading | None,
    parameters: Parameters | None,
    first_ns: int,
    hold_s: float,
    lags_s: tuple[float, ...],
) -> Iterator[Hypothesis]:
    """Yield the hypotheses that a topic is delayed, and that its clock drifts.

    Args:
        stream: the topic's messages.
        reading: function that reads the measured numbers of the estimated object.
        parameters: the estimator's parameters, one of which may be this delay.
        first_ns: the first stamp of the run.
        hold_s: half of the time for which a control applies; a smaller delay is no fault.
        lags_s: further delays to try.
    """
    topic = stream.topic
    own = reading.delays.get(topic, "") if reading else ""
    set_s = value_of(parameters, own, stream)

    def late(at: float, low: float, high: float) -> str:
        about = f", {SPECIAL_S[at]}" if at in SPECIAL_S else ""
        sense, at, low, high = in_sense(at, low, high, ("late", "early"))
        size, least, most = (f"{number(1e3 * each)} ms" for each in (at, low, high))
        if at >= 1.0:
            size, least, most = (f"{number(each, 4)} s" for each in (at, low, high))
        if sense == "early":
            return f"{topic}: its stamps are {size} early ({least} to {most}){about}"
        return f"{topic}: comes {size} late ({least} to {most}) by its stamps{about}"

    def mend_late(at: float) -> Advice:
        return Advice(own, precise(set_s + at)) if own else Advice(f"{topic}.delay_s", precise(at))

    def gaining(at: float, low: float, high: float) -> str:
        does, at, low, high = in_sense(at, low, high, ("gains", "loses"))
        return f"{topic}: its clock {does} {at:.3g} s a second ({low:.3g} to {high:.3g})"

    def mend_gaining(at: float) -> Advice:
        return Advice(f"{topic}.clock_gain", precise(at))

    yield Hypothesis(
        "delay",
        topic,
        "",
        tuple(dict.fromkeys((*DELAYS_S, *lags_s))),
        LONGEST_DELAY_S,
        in_topic(topic, alter.delayed),
        late,
        mend_late,
        tuple(SPECIAL_S),
        floor=hold_s,
        already=set_s,
    )
    clock = in_topic(topic, alter.drifted(first_ns))
    yield Hypothesis("clock drift", topic, "", RATES, LARGEST_RATE, clock, gaining, mend_gaining)


def hold_of(streams: Mapping[str, Stream], controls: tuple[str, ...]) -> float:
    """Return half of the longest median step of the controls, in s."""
    steps = [
        np.median(np.diff(streams[topic].publish_time_ns))
        for topic in controls
        if len(streams[topic]) > 1
    ]
    return 0.5e-9 * float(max(steps, default=0.0))


def lag_of(stream: Stream, controls: list[Stream]) -> tuple[float, ...]:
    """Estimate how far speeds from positions lag behind a control that correlates with them, in s.

    The lag with the best correlation is found on a grid of a tenth of a second, which is accurate enough
    for the start of a search.
    """
    if "position_m" not in stream.columns or len(stream) < FEWEST:
        return ()
    times_s = 1e-9 * stream.publish_time_ns
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = np.linalg.norm(np.diff(stream["position_m"], axis=0), axis=1) / np.diff(times_s)
    known = np.isfinite(speed)
    middle_s, speed = 0.5 * (times_s[1:] + times_s[:-1])[known], speed[known]
    best = 0.0, 0.0
    for control in controls:
        for name, column in control.columns.items():
            if column.ndim != 1 or column.dtype.kind != "f" or name == "sensor_time_ns":
                continue
            driven_s = 1e-9 * control.publish_time_ns
            for lags_s in np.array_split(LAGS_S, 1 + len(LAGS_S) * len(speed) // MOST_CELLS):
                at_s = middle_s - lags_s[:, None]
                is_in = (at_s >= driven_s[0]) & (at_s <= driven_s[-1])
                alike = _correlations(np.abs(np.interp(at_s, driven_s, column)), speed, is_in)
                best = max([best, *zip(alike.tolist(), lags_s.tolist(), strict=True)])
    lag_s = round(best[1], 1)
    return (lag_s,) if best[0] > 0.5 and lag_s else ()


def _correlations(rows: Floats, column: Floats, is_in: NDArray[np.bool_]) -> Floats:
    """Correlate each row (k, n) with a column (n,) over common values; -1 if unknown."""
    count = np.maximum(is_in.sum(axis=1, keepdims=True), 1)
    rows, columns = (
        np.where(is_in, each - np.where(is_in, each, 0.0).sum(axis=1, keepdims=True) / count, 0.0)
        for each in (rows, column)
    )
    size = np.sqrt((rows**2).sum(axis=1) * (columns**2).sum(axis=1))
    is_known = (count[:, 0] >= FEWEST) & (size > 0.0)  # false if one of them is NaN
    return np.where(is_known, (rows * columns).sum(axis=1) / np.where(is_known, size, 1.0), -1.0)
