"""Checks stamps, topic by topic: messages that are lost or there twice, clocks that drift."""

from collections.abc import Iterator, Mapping

import numpy as np

from fuselog.recorders.checks.finding import Finding, digits
from fuselog.recorders.log import Stream, schemas

FEWEST = 50
LOST, GAPS = 0.1, 0.01  # of the messages
REGULAR, TOLERANCE = 0.8, 0.2  # of the steps that are a multiple of the usual one, and by how near
FACT = 1e-3  # of a clock's rate
LONG_S = 10.0
MOST_LOST = 0.6  # where more lacks, the stamps are of a clock's ticks, and no rate
# What comes regularly: what sees targets is silent where there are none.
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
    """Find messages that lack in a regular row of stamps, but for outages that the log states."""
    if stream.schema.full_name not in REGULARS:
        return
    stamps_ns = np.unique(stream.publish_time_ns)
    steps_s = np.diff(stamps_ns) * 1e-9
    if len(steps_s) < FEWEST:
        return
    begin_ns = stamps_ns[:-1]
    for outage in streams.values():
        if outage.schema.full_name == schemas.OUTAGE.full_name:
            for start, end in zip(outage.publish_time_ns, outage["end_time_ns"], strict=True):
                outside = (begin_ns > end) | (begin_ns + 1e9 * steps_s < start)
                steps_s, begin_ns = steps_s[outside], begin_ns[outside]
    if len(steps_s) < FEWEST:
        return
    usual_s = float(np.quantile(steps_s, 0.1))
    multiples = np.rint(steps_s / usual_s)
    is_regular = np.abs(steps_s / usual_s - multiples) < TOLERANCE
    is_gap = steps_s > 1.5 * np.median(steps_s)
    is_gap |= is_regular & (multiples > 1) & (np.median(multiples) > 1)
    lost = 1.0 - (len(steps_s) + 1) / (float(np.sum(steps_s)) / usual_s + 1.0)
    is_lossy = np.mean(is_gap) > GAPS or (lost > LOST and is_gap.any())
    if np.mean(is_regular) < REGULAR or not is_lossy or lost > MOST_LOST:
        return
    share = f"{100.0 * lost:.2g} %" if lost < 0.45 or lost > 0.55 else "half"
    at_s = (int(begin_ns[np.argmax(is_gap)]) - int(stamps_ns[0])) * 1e-9
    yield Finding(
        "lost messages",
        stream.topic,
        "",
        lost,
        f"{stream.topic}: loses {share} of its messages: steps are multiples of {usual_s:.3g} s, and "
        f"{int(is_gap.sum())} are longer than one, the first {at_s:.4g} s after its first stamp; "
        "a delay or noise that is found besides may come of it",
        mapping="look for them where the log is recorded",
    )


def repeats(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find measurements that are there twice; events may be alike, and what one scan detects."""
    names = {each.name for each in stream.schema}
    is_measured = "scan_id" not in names and any(
        each.kind in ("real", "vector") for each in stream.schema
    )
    if not is_measured or stream.schema.full_name == schemas.TRUTH_STATE.full_name:
        return
    same = np.diff(stream.publish_time_ns) == 0
    for column in stream.columns.values():
        step = column[1:] == column[:-1]
        same &= step if step.ndim == 1 else step.all(axis=1)
    if not same.any():
        return
    first_s = (int(stream.publish_time_ns[int(np.argmax(same))]) - int(stream.publish_time_ns[0])) * 1e-9
    yield Finding(
        "stamps",
        stream.topic,
        "",
        float(same.sum()),
        f"{stream.topic}: {int(same.sum())} of its {len(same) + 1} messages are there twice, with equal "
        f"stamp and content, the first {first_s:.4g} s after its first stamp: they count twice",
        mapping="leave them out where the log is written",
    )


def drifts(streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find topics' clocks that run otherwise than the recorder's: all alike, as simulated, or one."""
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
                "clock",
                topic,
                "",
                gain,
                f"{topic}: its clock {'gains' if gain > 0 else 'loses'} {100 * abs(gain):.2g} s in "
                "100 s on those of other topics, by when its messages reached the recorder",
                f"{topic}.clock_gain",
                digits(gain),
            )
    if abs(usual - 1.0) > FACT:
        first = next(iter(rates))
        yield Finding(
            "clock",
            first,
            "",
            1.0 - usual,
            f"{first}{' and other topics' if len(rates) > 1 else ''}: 1 s of the stamps lasts "
            f"{usual:.5g} s by the clock of the recorder, as simulated time does",
        )


def clock_rate(stream: Stream) -> float | None:
    """Return how long 1 s of a topic's stamps lasts for the recorder; None where that cannot be told."""
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
