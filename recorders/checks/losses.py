"""Checks of stamps, topic by topic: lost and duplicate messages, silences, clocks that drift."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.finding import Finding, digits, since_first
from fuselog.recorders.log import Stream, schemas

FEWEST = 50
LOST, GAPS = 0.1, 0.01  # share of the messages
REGULAR = 0.8  # share of the steps that are multiples of the usual one
TOLERANCE = 0.2  # deviation of a step from a multiple
FACT = 1e-3  # deviation of a clock's rate
LONG_S = 10.0
SILENT = 20.0  # usual steps
PAUSES = 0.95  # quantile of the steps
FEWEST_BURSTS = 20
RARE = 1e-3  # expected number of equally long steps: fewer mean that a sensor saw nothing
MOST_LOST = 0.6  # if more are missing, stamps are ticks of a clock without a rate
# Topics that should be regular; sensors of targets are silent without targets.
REGULARS = {
    each.full_name
    for each in (
        schemas.ODOMETRY,
        schemas.TWIST,
        schemas.INERTIAL_SAMPLE,
        schemas.MAGNETIC_FIELD,
        schemas.POSITION_FIX,
        schemas.GEODETIC_FIX,
        schemas.VELOCITY_FIX,
        schemas.COURSE_FIX,
        schemas.POSE,
        schemas.ORIENTATION,
    )
}


def losses(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find messages missing from a regular sequence of stamps, except in silences and stated outages."""
    begin_ns, steps_s = _steps(stream, streams)
    if len(steps_s) < FEWEST:
        return
    is_short = steps_s <= SILENT * _pause_s(steps_s)
    begin_ns, steps_s = begin_ns[is_short], steps_s[is_short]
    usual_s = float(np.quantile(steps_s, 0.1))
    multiples = np.rint(steps_s / usual_s)
    is_regular = np.abs(steps_s / usual_s - multiples) < TOLERANCE
    is_gap = steps_s > 1.5 * np.median(steps_s)
    is_gap |= is_regular & (multiples > 1) & (np.median(multiples) > 1)
    is_sure = stream.schema.full_name in REGULARS
    if not is_sure:  # independently lost messages cannot explain the steps in which nothing is seen
        is_likely = len(steps_s) * np.mean(is_gap) ** np.maximum(multiples - 1.0, 0.0) >= RARE
        begin_ns, steps_s, is_regular, is_gap = (
            each[is_likely] for each in (begin_ns, steps_s, is_regular, is_gap)
        )
    lost = 1.0 - (len(steps_s) + 1) / (float(np.sum(steps_s)) / usual_s + 1.0)
    is_lossy = np.mean(is_gap) > GAPS or (lost > LOST and is_gap.any())
    if np.mean(is_regular) < REGULAR or not is_lossy or lost > MOST_LOST:
        return
    if not is_sure and _are_bursts(is_gap):
        return
    share = f"{100.0 * lost:.2g} %" if lost < 0.45 or lost > 0.55 else "half"
    first_ns = int(begin_ns[np.argmax(is_gap)])
    yield Finding(
        "lost messages",
        stream.topic,
        "",
        lost,
        f"{stream.topic}: loses {share} of its messages: steps are multiples of {usual_s:.3g} s, and "
        f"{int(is_gap.sum())} are longer than one, the first {since_first(stream, first_ns)}; "
        "the losses may also explain a delay or a noise that is found",
        otherwise="find the cause where the log is recorded",
        severity="likely" if is_sure else "hint",
        time_ns=first_ns,
    )


def silences(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find the longest silence of a topic outside stated outages; sensors of targets are exempt."""
    begin_ns, steps_s = _steps(stream, streams)
    if len(steps_s) < FEWEST or "target_id" in stream.columns:
        return
    usual_s = _pause_s(steps_s)
    longest = int(np.argmax(steps_s))
    is_long = steps_s[longest] > LOST * float(steps_s.sum())
    if steps_s[longest] > SILENT * usual_s:
        yield Finding(
            "gap",
            stream.topic,
            "",
            float(steps_s[longest]),
            f"{stream.topic}: is silent for {steps_s[longest]:.3g} s from "
            f"{since_first(stream, int(begin_ns[longest]))} on, where the usual step is {usual_s:.3g} s",
            otherwise="find the cause where the log is recorded",
            severity="likely" if is_long and stream.schema.full_name in REGULARS else "hint",
            time_ns=int(begin_ns[longest]),
        )


def repeats(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find duplicate measurements; events, and detections of one scan, may be equal."""
    if "scan_id" in stream.columns or not is_measured(stream):
        return
    same = np.diff(stream.publish_time_ns) == 0
    for column in stream.columns.values():
        step = column[1:] == column[:-1]
        same &= step if step.ndim == 1 else step.all(axis=1)
    if not same.any():
        return
    first_ns = int(stream.publish_time_ns[int(np.argmax(same))])
    yield Finding(
        "stamps",
        stream.topic,
        "",
        float(same.sum()),
        f"{stream.topic}: {int(same.sum())} of its {len(same) + 1} messages are duplicates, with equal "
        f"stamp and content, the first {since_first(stream, first_ns)}: they count twice",
        otherwise="remove them where the log is written",
        time_ns=first_ns,
    )


def is_measured(stream: Stream) -> bool:
    """Test whether messages contain measured numbers, unlike the truth and mere events."""
    is_number = any(each.kind in ("real", "vector") for each in stream.schema)
    return is_number and stream.schema.full_name != schemas.TRUTH_STATE.full_name


def _steps(
    stream: Stream, streams: Mapping[str, Stream]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the beginnings and lengths (s) of steps between measurements, without outages."""
    stamps_ns = np.unique(stream.publish_time_ns) if is_measured(stream) else np.empty(0, np.int64)
    steps_s = np.diff(stamps_ns) * 1e-9
    begin_ns = stamps_ns[:-1]
    for outage in streams.values():
        if outage.schema.full_name == schemas.OUTAGE.full_name:
            for start, end in zip(outage.publish_time_ns, outage["end_time_ns"], strict=True):
                outside = (begin_ns > end) | (begin_ns + 1e9 * steps_s < start)
                steps_s, begin_ns = steps_s[outside], begin_ns[outside]
    return begin_ns, steps_s


def _pause_s(steps_s: NDArray[np.float64]) -> float:
    """Return the usual step, or the pause between bursts, such as ranges to many anchors."""
    return float(np.quantile(steps_s, PAUSES))


def _are_bursts(is_gap: NDArray[np.bool_]) -> bool:
    """Test whether gaps separate bursts with equal numbers of messages."""
    counts = np.diff(np.flatnonzero(is_gap))
    return len(counts) >= FEWEST_BURSTS and bool(np.mean(counts == np.median(counts)) > REGULAR)


def drifts(streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find clocks whose rate differs from other topics', or from the recorder's (as in simulations)."""
    rates = {
        topic: rate for topic, stream in streams.items() if (rate := clock_rate(stream)) is not None
    }
    if not rates:
        return
    usual = float(np.median(list(rates.values())))
    for topic, rate in rates.items():
        if abs(rate - usual) > FACT:
            gain = 1.0 - rate / usual
            yield Finding(
                "clock drift",
                topic,
                "",
                gain,
                f"{topic}: its clock {'gains' if gain > 0 else 'loses'} {100 * abs(gain):.2g} s in "
                "100 s on those of other topics, by when its messages reached the recorder",
                f"{topic}.clock_gain={digits(gain)}",
            )
    if abs(usual - 1.0) > FACT:
        first = next(iter(rates))
        yield Finding(
            "clock drift",
            first,
            "",
            1.0 - usual,
            f"{first}{' and other topics' if len(rates) > 1 else ''}: 1 s of the stamps lasts "
            f"{usual:.5g} s by the clock of the recorder, as simulated time does",
        )


def clock_rate(stream: Stream) -> float | None:
    """Estimate the recorder's clock rate relative to a topic's stamps; return None if uncertain."""
    if len(stream) < FEWEST:
        return None
    measured = (stream.publish_time_ns - stream.publish_time_ns[0]) * 1e-9
    logged = (stream.log_time_ns - stream.log_time_ns[0]) * 1e-9
    if np.ptp(measured) < LONG_S:
        return None
    rate = float(np.polyfit(measured, logged, 1)[0])
    rest = float(np.std(logged - rate * measured))
    is_sure = FACT * float(np.ptp(measured)) > 5.0 * rest
    return rate if is_sure else None
