"""Checks for impossible data: infinite values, stamps years apart, topics without a common time."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.finding import Finding, Kind, Severity, since_first
from fuselog.recorders.checks.losses import FEWEST
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.impossible import TIMELESS, YEAR_NS, impossible

TINIEST = float(np.finfo(np.float64).tiny)  # the smallest number with full precision


def beyond(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find values that are infinite, or far beyond the limit of their unit."""
    for each in impossible(stream):
        yield _finding(
            stream,
            "values",
            each.field,
            each.rows,
            f"in {_count(each.rows)} {each.words}",
            "a replay leaves these messages out; do not write what was not measured",
        )


def integers(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find numbers smaller than any measurement, as when the bits of integers are read as doubles."""
    for entry in stream.schema:
        column = stream.columns.get(entry.name)
        if column is None or column.dtype.kind != "f":
            continue
        size = np.abs(column.reshape(len(column), -1))
        rows = ((size > 0.0) & (size < TINIEST)).any(axis=1)
        if rows.any():
            value = size[rows].min(initial=TINIEST, where=size[rows] > 0.0)
            yield _finding(
                stream,
                "values",
                entry.name,
                rows,
                f"{entry.name} is {value:.3g} in {_count(rows)}, smaller than any measured number",
                "it may be an integer that is read as a floating-point number",
                "likely",
            )


def years(span_ns: tuple[int, int] | None, stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find stamps that are years away from `span_ns`, the span of most messages."""
    if span_ns is None or stream.schema.full_name in TIMELESS:
        return
    stamps_ns = stream.publish_time_ns
    rows = (stamps_ns < span_ns[0]) | (stamps_ns > span_ns[1])
    if rows.any():
        row = int(np.argmax(rows))
        before_ns, after_ns = span_ns[0] - int(stamps_ns[row]), int(stamps_ns[row]) - span_ns[1]
        apart = max(before_ns, after_ns) / YEAR_NS
        yield Finding(
            "stamps",
            stream.topic,
            "",
            apart,
            f"{stream.topic}: {int(rows.sum())} of its {len(stream)} stamps are years away from those "
            f"of most messages of the log: the first, of message {row}, is {apart:.3g} years "
            f"{'before' if before_ns > 0 else 'after'} them",
            otherwise="a replay leaves these messages out; correct the clock where the log is written",
            severity="fact",
        )


def apart(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find a topic whose stamps end before all other topics begin, or begin after all others end."""
    others = [each for each in streams.values() if each is not stream and len(each) >= FEWEST]
    if len(stream) < FEWEST or not others:
        return
    first_ns, last_ns = int(stream.publish_time_ns.min()), int(stream.publish_time_ns.max())
    begin_ns = min(int(each.publish_time_ns.min()) for each in others)
    end_ns = max(int(each.publish_time_ns.max()) for each in others)
    if first_ns <= end_ns and last_ns >= begin_ns:
        return
    is_before = last_ns < begin_ns
    apart_s = 1e-9 * max(begin_ns - last_ns, first_ns - end_ns)
    how = "end {} s before all other topics begin" if is_before else "begin {} s after all others end"
    yield Finding(
        "stamps",
        stream.topic,
        "",
        apart_s,
        f"{stream.topic}: its stamps {how.format(f'{apart_s:.4g}')}: they have no time in common",
        f"{stream.topic}.delay_s={-round(apart_s, 3) if is_before else round(apart_s, 3)}",
        "its clock may be another",
    )


def restated(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find a landmark, or a point of a body, that is stated at several positions."""
    number = _NUMBERS.get(stream.schema.full_name)
    if number is None or len(stream) < 2:
        return
    order = np.argsort(stream[number], kind="stable")
    numbers, places = stream[number][order], stream["position_m"][order]
    moved = (np.diff(numbers) == 0) & (places[1:] != places[:-1]).any(axis=1)
    if moved.any():
        first = int(numbers[np.argmax(moved)])
        times = int((stream[number] == first).sum())
        yield Finding(
            "place",
            stream.topic,
            number,
            float(times),
            f"{stream.topic}: {number} {first} is stated {times} times, at different positions: a "
            "replay uses one of them",
            otherwise="give each point its own number",
            severity="fact",
        )


_NUMBERS = {schemas.LANDMARK.full_name: "landmark_id", schemas.BODY_POINT.full_name: "point_id"}


def _count(rows: NDArray[np.bool_]) -> str:
    return f"{int(rows.sum())} of {len(rows)} messages"


def _finding(
    stream: Stream,
    kind: Kind,
    field: str,
    rows: NDArray[np.bool_],
    words: str,
    mapping: str,
    severity: Severity = "fact",
) -> Finding:
    row = int(np.argmax(rows))
    where = f"the first, message {row}, {since_first(stream, stream.publish_time_ns[row])}"
    return Finding(
        kind,
        stream.topic,
        field,
        float(rows.sum()),
        f"{stream.topic}: {words}, {where}",
        otherwise=mapping,
        severity=severity,
    )
