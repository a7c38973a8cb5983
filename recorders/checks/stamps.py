"""Checks of stamps: unit, order, regularity, and relation to the recorder's clock."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.finding import Finding, digits, since_first
from fuselog.recorders.checks.losses import FEWEST, REGULARS, losses
from fuselog.recorders.log import Stream, schemas

YEAR_2100_NS = 4_102_444_800 * 10**9
JITTER = 0.2  # relative to the usual step
SLOWEST_HZ, FASTEST_HZ = 0.5, 2e4  # for inertial units
FASTEST_FIX_HZ = 500.0
LEAP_TOLERANCE_S, ZONE_TOLERANCE_S = 0.6, 1.0
FAR_H = 14  # the largest difference of local clocks from UTC
# Seconds by which GPS time is ahead of UTC, by the Unix time in s from which this is valid.
GPS_LEAPS = {
    915148800: 13,
    1136073600: 14,
    1230768000: 15,
    1341100800: 16,
    1435708800: 17,
    1483228800: 18,
}
TAI_LESS_GPS_S = 19
DRIFT, FACT = 1e-5, 1e-3
AGAIN, FEW_FALLS = 100.0, 10  # least fall of a clock that was reset, in usual steps, and how often
LONG_S, SURE = 100.0, 6.0
# Topics that a sensor's own clock drives; fixes and poses may come when they can be computed.
_CLOCKED = {
    schemas.INERTIAL_SAMPLE.full_name,
    schemas.MAGNETIC_FIELD.full_name,
    schemas.ODOMETRY.full_name,
}
_USES = {
    schemas.INERTIAL_SAMPLE.full_name: "estimators use the mean of both; deployed and external filters "
    "use them one by one, and one of the two may have no effect",
    schemas.ODOMETRY.full_name: "the first of the two is valid for no time, so it has no effect",
}
_FIXES = {schemas.GEODETIC_FIX.full_name, schemas.POSITION_FIX.full_name, schemas.VELOCITY_FIX.full_name}


def units(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find stamps in a wrong unit: beyond 2100, or at a rate that no sensor has."""
    last_ns = int(stream.publish_time_ns.max())
    if last_ns > YEAR_2100_NS:
        year = 1970 + last_ns / 1e9 / 31_556_952
        yield of_stamps(
            stream,
            year,
            f"its stamps reach the year {year:.0f}",
            'time = { unit = "ms" }, or "us", "ns"',
        )
        return
    name = stream.schema.full_name
    if len(stream) < FEWEST or name not in REGULARS:
        return
    steps_ns = _steps_ns(stream)
    rate_hz = 1e9 / float(np.median(steps_ns[steps_ns > 0])) if steps_ns.any() else 1e12
    fastest_hz = FASTEST_FIX_HZ if name in _FIXES else FASTEST_HZ
    is_slow = name == schemas.INERTIAL_SAMPLE.full_name and rate_hz < SLOWEST_HZ
    if not is_slow and rate_hz <= fastest_hz:
        return
    power = 0
    while (rate_hz * 10.0**power < SLOWEST_HZ) if is_slow else (rate_hz * 10.0**power > fastest_hz):
        power += 3 if is_slow else -3
    how = "large" if is_slow else "small"
    yield of_stamps(
        stream,
        10.0**power,
        f"its stamps are {10 ** abs(power):.0e} times too {how}, because of their unit: the rate would "
        f"be {rate_hz:.3g} Hz",
        'time = { unit = "ms" }, or "s", "us", "ns", whichever the column has',
    )


def order(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find stamps that go back, and repeated stamps in topics with one measurement at a time."""
    is_late = not np.array_equal(stream.publish_time_ns, stream.log_time_ns)
    rows = np.argsort(stream.log_time_ns if is_late else stream.position, kind="stable")
    stamps_ns = stream.publish_time_ns[rows]
    back = np.diff(stamps_ns) < 0
    if back.any():
        count, first_ns = int(back.sum()), int(stamps_ns[int(np.argmax(back))])
        first_s = (first_ns - int(stream.publish_time_ns.min())) * 1e-9
        steps_ns = np.diff(stamps_ns)
        usual_ns = float(np.median(steps_ns[steps_ns > 0])) if (steps_ns > 0).any() else np.inf
        began_again = not is_late and -steps_ns.min() > AGAIN * usual_ns and count <= FEW_FALLS
        behind_s = 1e-9 * float((np.maximum.accumulate(stamps_ns) - stamps_ns).max())
        how = (
            "; its clock was restarted or rolled over, or the stamps are from the clocks of several "
            "vehicles"
            if began_again
            else f"; messages overtook one another, and are up to {behind_s:.3g} s behind" * is_late
        )
        yield Finding(
            "stamps",
            stream.topic,
            "",
            float(count),
            f"{stream.topic}: {count} of its {len(stream)} stamps go back in time, the first "
            f"{first_s:.4g} s after the earliest{how}",
            otherwise=f"replay them with --arrival-order --late rewind:{np.ceil(behind_s * 10) / 10:g}"
            if is_late
            else "`rollover` of `time`, or `vehicle` of the table, in the mapping"
            if began_again
            else "sort them where the log is written",
            severity="hint" if is_late else "fact",
        )
        return
    things = _things(stream, streams)[rows]
    use = _USES.get(stream.schema.full_name, "both are used, in file order")
    same = (np.diff(stamps_ns) == 0) & (np.diff(things) == 0)
    if same.any() and stream.schema.full_name in REGULARS:
        yield Finding(
            "stamps",
            stream.topic,
            "",
            float(same.sum()),
            f"{stream.topic}: {int(same.sum())} of its {len(stream)} messages have the same stamp as "
            f"the previous one, the first {since_first(stream, stamps_ns[np.argmax(same)])}: {use}",
            otherwise="remove one of them where the log is written",
            severity="fact",
        )


def jitter(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find irregular steps of a topic that should be regular and has no losses."""
    if len(stream) < FEWEST or stream.schema.full_name not in _CLOCKED:
        return
    steps_s = 1e-9 * _steps_ns(stream)
    usual_s = float(np.median(steps_s))
    scatter = 1.4826 * float(np.median(np.abs(steps_s - usual_s)))
    if scatter > JITTER * usual_s > 0.0 and not any(losses(stream, streams)):
        yield of_stamps(
            stream,
            scatter / usual_s,
            f"its steps vary by {100 * scatter / usual_s:.2g} % of the usual {usual_s:.3g} s: its "
            "stamps give the time of writing, not of measurement",
            "time = { column = ... } of the sensor's own clock",
        )


def leaps(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find stamps that differ from the recorder's clock by leap seconds or a time zone."""
    ahead_s = _ahead_s(stream)
    name = _named_offset(ahead_s, int(stream.log_time_ns[0]) / 1e9)
    if not name or stream.schema.full_name == schemas.TRUTH_STATE.full_name:
        return
    others_s = [_ahead_s(each) for each in streams.values() if each.topic != stream.topic]
    is_alone = any(abs(each - ahead_s) > LEAP_TOLERANCE_S for each in others_s)
    value = float(round(ahead_s))
    is_zone = "time zone" in name
    setting = f"utc_offset_h = {round(value / 3600)}" if is_zone else f"leap_seconds = {value:g}"
    yield Finding(
        "delay",
        stream.topic,
        "",
        value,
        f"{stream.topic}: its stamps are {abs(value):g} s {'ahead of' if value > 0 else 'behind'} the "
        f"clock of the recorder: {name}{'' if is_alone else ', as are those of all topics'}",
        f"{stream.topic}.delay_s={digits(value)}",
        f"time = {{ column = ..., {setting} }} in the mapping",
        "likely" if is_alone else "hint",
    )


def drift(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find a clock that is slightly fast or slow; `losses.drifts` reports errors above 1e-3."""
    if len(stream) < FEWEST or np.array_equal(stream.publish_time_ns, stream.log_time_ns):
        return
    measured_s = 1e-9 * (stream.publish_time_ns - stream.publish_time_ns[0])
    span_s = float(np.ptp(measured_s))
    if span_s < LONG_S:
        return
    ahead_s = 1e-9 * (stream.publish_time_ns - stream.log_time_ns)
    centred_s = measured_s - measured_s.mean()
    gain = float(centred_s @ ahead_s / (centred_s @ centred_s))
    rest_s = ahead_s - ahead_s.mean() - gain * centred_s
    error = float(np.std(rest_s) / np.sqrt(centred_s @ centred_s))
    if max(DRIFT, SURE * error) < abs(gain) < FACT:
        yield Finding(
            "clock drift",
            stream.topic,
            "",
            gain,
            f"{stream.topic}: its clock {'gains' if gain > 0 else 'loses'} {1e6 * abs(gain):.3g} us a "
            f"second on the recorder's, {1e3 * abs(gain) * span_s:.3g} ms in {span_s:.4g} s",
            f"{stream.topic}.clock_gain={digits(gain)}",
            severity="hint",
        )


def _things(stream: Stream, streams: Mapping[str, Stream]) -> NDArray[np.uint32]:
    """Return every message's `thing_id` (n,) if another topic states it row by row, or else zeros."""
    for each in streams.values():
        is_named = each.schema.full_name == schemas.IDENTITY.full_name
        if is_named and np.array_equal(each.publish_time_ns, stream.publish_time_ns):
            return each["thing_id"]
    return np.zeros(len(stream), np.uint32)


def of_stamps(stream: Stream, value: float, words: str, mapping: str) -> Finding:
    """Make a finding about a topic's stamps; `mapping` names what to correct in the mapping."""
    return Finding("stamps", stream.topic, "", value, f"{stream.topic}: {words}", otherwise=mapping)


def _steps_ns(stream: Stream) -> NDArray[np.int64]:
    steps_ns: NDArray[np.int64] = np.diff(np.sort(stream.publish_time_ns)).astype(np.int64)
    return steps_ns


def _ahead_s(stream: Stream) -> float:
    return float(np.median(stream.publish_time_ns - stream.log_time_ns)) * 1e-9


def _named_offset(offset_s: float, unix_s: float) -> str:
    """Describe the known cause of a clock's offset in s at a Unix time; return "" if it is unknown."""
    gps_s = next((leap for since, leap in reversed(GPS_LEAPS.items()) if unix_s >= since), 0)
    for name, leap_s in (("GPS time", gps_s), ("TAI", gps_s + TAI_LESS_GPS_S)):
        if gps_s and abs(abs(offset_s) - leap_s) < LEAP_TOLERANCE_S:
            return f"{name} runs {leap_s} s ahead of UTC at that time"
    hours = round(offset_s / 3600.0)
    if 0 < abs(hours) <= FAR_H and abs(offset_s - 3600.0 * hours) <= ZONE_TOLERANCE_S:
        return f"a time zone {abs(hours)} h from UTC"
    return ""
