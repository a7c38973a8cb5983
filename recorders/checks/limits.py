"""Checks of physical limits: heights, positions, speeds between fixes, turns, and dates."""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.finding import Finding
from fuselog.recorders.checks.stamps import of_stamps
from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.models.geodesy import local_metres
from fuselog.recorders.models.orientation import heading
from fuselog.recorders.models.planar import wrap_angle

FEWEST = 10
HIGHEST_M, LOWEST_M = 50_000.0, -12_000.0
ZERO_DEG = 0.01  # around latitude and longitude 0, where there is only sea
FASTEST_MPS, FARTHEST_M = 1500.0, 1000.0
ZIGZAG = 5.0  # ratio of a step to the displacement over two steps
SIDEWAYS_MPS2, SLOWEST_MPS = 10.0, 1.0
LEGS, BENT_RAD = 10, 0.5
EARLIEST_NS, LATEST_NS = 31_536_000 * 10**9, 946_684_800 * 10**9  # 1971 and 2000
FAR_H, NEAR_S = 14, 30.0
_PLACED = (schemas.GEODETIC_FIX.full_name, schemas.POSITION_FIX.full_name)

Floats = NDArray[np.float64]


def heights(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find impossible altitudes, as when mm are read as m."""
    if stream.schema.full_name != schemas.GEODETIC_FIX.full_name:
        return
    known = stream["altitude_m"][np.isfinite(stream["altitude_m"])]
    beyond = known[(known > HIGHEST_M) | (known < LOWEST_M)]
    if len(beyond):
        worst = float(beyond[np.abs(beyond).argmax()])
        yield _found(
            stream,
            "altitude_m",
            worst,
            f"{len(beyond)} of its altitudes are beyond {LOWEST_M:g} to {HIGHEST_M:g} m, up to "
            f"{worst:.6g} m",
            'units.altitude_m = "mm" in the mapping, or missing = [...] for codes of missing values',
        )


def zeros(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find fixes that are all close to latitude and longitude 0, as when degrees are scaled twice."""
    if stream.schema.full_name != schemas.GEODETIC_FIX.full_name:
        return
    latitude, longitude = (np.abs(stream[name]) for name in ("latitude_deg", "longitude_deg"))
    if len(stream) < FEWEST or max(np.nanmedian(latitude), np.nanmedian(longitude)) > ZERO_DEG:
        return
    if np.all(latitude == 0) and np.all(longitude == 0):
        return  # reported as positions without a fix
    yield _found(
        stream,
        "latitude_deg",
        float(np.nanmedian(latitude)),
        f"its fixes are near latitude 0, longitude 0 ({np.nanmedian(latitude):.3g} and "
        f"{np.nanmedian(longitude):.3g} deg away), where there is only sea: their unit differs from "
        "that in the mapping",
        "correct `units` of latitude_deg and longitude_deg, or degrees_minutes, in the mapping",
    )


def leaps(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find impossibly fast steps between fixes, and fixes that alternate between two positions."""
    if stream.schema.full_name not in _PLACED or len(stream) < FEWEST:
        return
    order = np.argsort(stream.publish_time_ns, kind="stable")
    times_s, places = 1e-9 * stream.publish_time_ns[order].astype(float), _places(stream)[order]
    steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    span_s = np.diff(times_s)
    with np.errstate(divide="ignore", invalid="ignore"):
        fast = (steps_m > FARTHEST_M) & (steps_m / span_s > FASTEST_MPS)
    if fast.any():
        first = int(np.argmax(fast))
        yield _found(
            stream,
            "",
            float(fast.sum()),
            f"{int(fast.sum())} of its steps are faster than {FASTEST_MPS:g} m/s, the first by "
            f"{steps_m[first] / 1000:.4g} km in {span_s[first]:.3g} s, "
            f"{times_s[first] - times_s[0]:.4g} s after its first stamp",
            "check the unit and the codes of missing values of its positions, whether its rows belong "
            "to several vehicles (`vehicle` in the mapping), and `time`",
        )
        return
    two_m = np.linalg.norm(places[2:] - places[:-2], axis=1)
    back = (steps_m[:-1] > ZIGZAG * two_m) & (steps_m[1:] > ZIGZAG * two_m)
    if back.mean() > 0.5 and float(np.median(steps_m)) > 10.0 * _noise_m(places):
        yield _found(
            stream,
            "",
            float(back.mean()),
            f"its fixes alternate: {np.median(steps_m):.3g} m from one to the next, but only "
            f"{np.median(two_m):.3g} m to the one after that, so they are two sequences of fixes, "
            "merged into one",
            "correct `vehicle`, or `order` and `zone` of `time`, in the mapping, or remove one "
            "recording",
        )


def _noise_m(places: Floats) -> float:
    """Estimate the scatter of fixes about straight lines, from every second fix."""
    every = places[::2]
    bend = every[2:] - 2.0 * every[1:-1] + every[:-2]
    return float(np.median(np.linalg.norm(bend, axis=1)) / np.sqrt(6.0)) if len(bend) else np.inf


def turns(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find headings that turn too fast for the fixes' speed, or stay the same while the course turns."""
    if stream.schema.full_name != schemas.ORIENTATION.full_name or len(stream) < FEWEST:
        return
    speed = max((_speed(other) for other in streams.values()), default=0.0)
    angle = heading(stream["quaternion"])
    span_s = 1e-9 * np.diff(stream.publish_time_ns)
    moving = span_s > 0
    if speed < SLOWEST_MPS or not moving.any():
        return
    bent = max((_bent(other) for other in streams.values()), default=0.0)
    if np.ptp(angle) == 0.0 and bent > BENT_RAD:
        yield _found(
            stream,
            "quaternion",
            bent,
            f"its heading is the same in all messages, but the course of the fixes turns by {bent:.3g} "
            "rad, so the heading was not measured",
            "remove it, or missing = { COLUMN = [...] } in the table of the mapping",
        )
        return
    rate = float(np.median(np.abs(wrap_angle(np.diff(angle)))[moving] / span_s[moving]))
    if rate * speed > SIDEWAYS_MPS2:
        yield _found(
            stream,
            "quaternion",
            rate,
            f"its heading turns by {rate:.3g} rad/s or more for half of the time, at {speed:.3g} m/s, "
            f"which would be {rate * speed:.3g} m/s^2 sideways",
            "correct the unit of the angle in the mapping",
        )


def _bent(stream: Stream) -> float:
    """Return the range of courses (rad) of the legs between fixes; 0 for topics without fixes."""
    if stream.schema.full_name not in _PLACED or len(stream) < FEWEST:
        return 0.0
    places = _places(stream)[np.linspace(0, len(stream) - 1, LEGS + 1).astype(int)]
    east, north = np.diff(places[np.isfinite(places).all(axis=1)], axis=0).T
    return float(np.ptp(np.unwrap(np.arctan2(north, east)))) if len(east) else 0.0


def _speed(stream: Stream) -> float:
    """Return the median speed between fixes in m/s; 0 for topics without fixes."""
    if stream.schema.full_name not in _PLACED or len(stream) < FEWEST:
        return 0.0
    moved = np.linalg.norm(np.diff(_places(stream), axis=0), axis=1)
    span_s = 1e-9 * np.diff(stream.publish_time_ns)
    moving = span_s > 0
    return float(np.nanmedian(moved[moving] / span_s[moving])) if moving.any() else 0.0


def dates(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find dates from 1971 to 2000, days swapped with months, and wrongly stated time zones."""
    first_ns, last_ns = int(stream.publish_time_ns.min()), int(stream.publish_time_ns.max())
    if EARLIEST_NS < first_ns < LATEST_NS:
        yield of_stamps(
            stream,
            0.0,
            f"its stamps begin on {_day(first_ns)}, before such logs existed",
            "correct `unit` and `zero` of `time` in the mapping",
        )
    days = np.unique(_day(stream.publish_time_ns))
    of_month = (days - days.astype("datetime64[M]")).astype(int) + 1
    if (
        first_ns > LATEST_NS
        and len(days) >= 2
        and len(set(of_month.tolist())) == 1
        and len(stream) >= 5 * len(days)
    ):
        yield of_stamps(
            stream,
            0.0,
            f"its stamps fall on {len(days)} dates, all on day {of_month[0]} of a month, the first on "
            f"{days[0]}: day and month are swapped",
            "correct `format` of `time` in the mapping",
        )
    for other in streams.values():
        apart_ns = int(other.publish_time_ns.min()) - first_ns
        hours = round(apart_ns / 3600e9)
        is_near = abs(apart_ns - hours * 3600 * 10**9) < NEAR_S * 1e9
        if 0 < hours <= FAR_H and is_near and int(other.publish_time_ns.min()) > last_ns:
            yield of_stamps(
                other,
                0.0,
                f"it begins {hours} h after {stream.topic}, which has ended by then: a time zone is "
                "stated for only one of them, or is stated twice",
                "correct `zone` or `utc_offset_h` of `time` in the mapping",
            )
            return


def _day(time_ns: int | NDArray[np.int64]) -> NDArray[np.datetime64]:
    """Convert stamps to days in UTC."""
    return np.asarray(time_ns).astype("datetime64[ns]").astype("datetime64[D]")


def _places(stream: Stream) -> Floats:
    """Return positions (n, 2) in m."""
    if stream.schema.full_name == schemas.POSITION_FIX.full_name:
        return np.asarray(stream["position_m"][:, :2])
    return local_metres(stream["latitude_deg"], stream["longitude_deg"])


def _found(stream: Stream, field: str, value: float, words: str, mapping: str) -> Finding:
    return Finding("place", stream.topic, field, value, f"{stream.topic}: {words}", otherwise=mapping)
