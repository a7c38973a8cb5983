"""Checks of positions: impossible or swapped latitudes and longitudes, and heights."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.body import bodies
from fuselog.recorders.checks.finding import Finding, since_first
from fuselog.recorders.checks.motion import BodyMotion, Slope
from fuselog.recorders.log import Stream, schemas

GEOID_M = (5.0, 110.0)  # usual difference of heights above the ellipsoid and the sea
STEADY_M = 5.0
INTEGER = 1e6
BETTER = 3.0
CLEAR = 0.02  # spread above which a swap is tried
SCALE = (0.9, 1.1)
CLIMB_M, MIRRORED = 2.0, -0.9
FEWEST = 20
LEAP_M, CLIMB_MPS = 15.0, 100.0  # faster climbs are not usual
ABRUPT, CLIMB_MPS2 = 0.1, 30.0  # share of a leap by which neighbouring fixes climb at most
ALIKE = 0.03  # per metre of the wheels
# How degrees change if they were read in another unit.
_READ_AS: dict[str, Callable[[NDArray], NDArray]] = {
    "semicircles read as 1e-7 deg": lambda degrees: degrees * 1e7 * 180 / 2**31,
    "1e-7 deg read as semicircles": lambda degrees: degrees * 1e-7 * 2**31 / 180,
    "degrees and minutes, ddmm.mmmm, read as degrees": lambda degrees: (
        np.fix(degrees) + np.fmod(degrees, 1.0) / 0.6
    ),
}


def ranges(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find latitudes and longitudes that are out of range, scaled to integers, or both zero."""
    if stream.schema.full_name != schemas.GEODETIC_FIX.full_name:
        return
    latitude, longitude = stream["latitude_deg"], stream["longitude_deg"]
    largest = float(np.nanmax(np.abs(latitude))), float(np.nanmax(np.abs(longitude)))
    if max(largest) > INTEGER:
        yield _place(
            stream,
            1e7,
            f"latitude and longitude are integers in units of 1e-7 deg: they reach {largest[0]:.6g}",
            "factors = { latitude_deg = 1e-7, longitude_deg = 1e-7 } in the mapping",
        )
        return
    if largest[0] > 90.0:
        is_exchanged = largest[1] <= 90.0
        what = "are swapped" if is_exchanged else "are out of range"
        yield _place(
            stream,
            largest[0],
            f"latitude and longitude {what}: a latitude is {largest[0]:.6g} deg",
            "in the mapping swap the sources of latitude_deg and longitude_deg"
            if is_exchanged
            else "correct `units` of latitude_deg and longitude_deg in the mapping",
        )
    elif largest[1] > 180.0:
        yield _place(
            stream,
            largest[1],
            f"longitudes reach {largest[1]:.6g} deg, beyond 180",
            "write them from -180 to 180 deg",
        )
    zero = (latitude == 0.0) & (longitude == 0.0)
    if zero.any():
        yield _place(
            stream,
            float(zero.sum()),
            f"{int(zero.sum())} of {len(stream)} fixes are at 0, 0, which means no fix, the first "
            f"{since_first(stream, stream.publish_time_ns[np.argmax(zero)])}",
            "missing = [0] in the mapping",
        )


def misread(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find latitudes and longitudes, swapped or in another unit, by comparison with the wheels."""
    if stream.schema.full_name != schemas.GEODETIC_FIX.full_name or len(stream) < FEWEST:
        return
    as_is = _wheels(streams, stream)
    if as_is is not None:
        yield from _exchanged(stream, streams, as_is)
        yield from _scaled(stream, streams, as_is)


def _exchanged(stream: Stream, streams: Mapping[str, Stream], as_is: Slope) -> Iterator[Finding]:
    """Find swapped coordinates; `as_is` is how far fixes move per metre of the wheels as recorded."""
    largest = np.nanmax(np.abs([stream["latitude_deg"], stream["longitude_deg"]]))
    if largest > 90.0 or not as_is.spread > CLEAR:
        return
    columns = {
        **stream.columns,
        "latitude_deg": stream["longitude_deg"],
        "longitude_deg": stream["latitude_deg"],
    }
    other = _wheels(streams, replace(stream, columns=columns))
    if other and SCALE[0] < other.value < SCALE[1] and BETTER * other.spread < as_is.spread:
        yield _place(
            stream,
            as_is.spread / other.spread,
            f"latitude and longitude are swapped: after swapping, fixes move {other.value:.4g} m for "
            f"each metre of the wheels (spread {other.spread:.2g}); as recorded, {as_is.value:.4g} m "
            f"(spread {as_is.spread:.2g})",
            "in the mapping swap the sources of latitude_deg and longitude_deg",
            is_fact=False,
        )


def _scaled(stream: Stream, streams: Mapping[str, Stream], as_is: Slope) -> Iterator[Finding]:
    """Find latitudes and longitudes in another unit; `as_is` is as for `_exchanged`."""
    if not as_is.sign or abs(as_is.value - 1.0) <= ALIKE:
        return
    for what, changed in _READ_AS.items():
        columns = {
            **stream.columns,
            **{name: changed(stream[name]) for name in ("latitude_deg", "longitude_deg")},
        }
        other = _wheels(streams, replace(stream, columns=columns))
        if other is None or abs(other.value - 1.0) > ALIKE:
            continue
        if (
            BETTER * abs(other.value - 1.0) < abs(as_is.value - 1.0)
            and other.spread < as_is.spread + ALIKE
        ):
            yield _place(
                stream,
                as_is.value,
                f"latitude and longitude are {what}: corrected, fixes move {other.value:.4g} m for each "
                f"metre of the wheels; as recorded, {as_is.value:.4g} m",
                "correct `units` of latitude_deg and longitude_deg, or degrees_minutes, in the mapping",
                is_fact=False,
            )
            return


def jumps(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find altitudes that change faster than any vehicle climbs, as when their reference changes."""
    if stream.schema.full_name != schemas.GEODETIC_FIX.full_name:
        return
    rows = np.flatnonzero(np.isfinite(stream["altitude_m"]))
    rows = rows[np.argsort(stream.publish_time_ns[rows], kind="stable")]
    steps_m = np.diff(stream["altitude_m"][rows])
    steps_s = 1e-9 * np.diff(stream.publish_time_ns[rows])
    sizes_m = np.abs(steps_m)
    beside_m = np.maximum(np.append(0.0, sizes_m[:-1]), np.append(sizes_m[1:], 0.0))
    is_abrupt = (beside_m < ABRUPT * sizes_m) & (sizes_m > CLIMB_MPS2 * steps_s**2)
    leaps = np.flatnonzero((sizes_m > LEAP_M) & ((sizes_m > CLIMB_MPS * steps_s) | is_abrupt))
    if len(leaps):
        first_ns = int(stream.publish_time_ns[rows[leaps[0] + 1]])
        worst_m = float(steps_m[leaps[np.argmax(np.abs(steps_m[leaps]))]])
        yield Finding(
            "place",
            stream.topic,
            "altitude_m",
            worst_m,
            f"{stream.topic}: its altitude leaps {len(leaps)} times, by up to {abs(worst_m):.4g} m from "
            f"one fix to the next, the first {since_first(stream, first_ns)}",
            otherwise="use one altitude throughout, above the ellipsoid or above the sea",
        )


def heights(stream: Stream, streams: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find heights above the sea next to others above the ellipsoid, and a z axis that points down."""
    if stream.schema.full_name != schemas.GEODETIC_FIX.full_name or len(stream) < FEWEST:
        return
    if not np.isfinite(stream["altitude_m"]).all():
        return
    for other in streams.values():
        if len(other) < FEWEST or other.topic == stream.topic:
            continue
        if other.schema.full_name == schemas.GEODETIC_FIX.full_name and other.topic > stream.topic:
            apart = _at(stream, other.publish_time_ns) - other["altitude_m"]
            by_m = float(np.median(apart))
            if GEOID_M[0] < abs(by_m) < GEOID_M[1] and np.std(apart) < STEADY_M:
                yield Finding(
                    "place",
                    other.topic,
                    "altitude_m",
                    by_m,
                    f"{other.topic}: its altitudes are {abs(by_m):.4g} m "
                    f"{'below' if by_m > 0 else 'above'} "
                    f"those of {stream.topic}: one is above the sea, the other above the ellipsoid",
                    f"{other.topic}.altitude_bias={round(-by_m, 3)}",
                    severity="hint",
                )
        if other.schema.full_name in _PLACED and other["position_m"].shape[1] == 3:
            z, height = other["position_m"][:, 2], _at(stream, other.publish_time_ns)
            if not np.isfinite(z).all() or min(np.ptp(z), np.ptp(height)) < CLIMB_M:
                continue
            likeness = float(np.corrcoef(z, height)[0, 1])
            if likeness < MIRRORED:
                yield Finding(
                    "sign",
                    other.topic,
                    "position_m",
                    -1.0,
                    f"{other.topic}: its z axis points down (NED), but ours up: it falls as the "
                    f"altitude of {stream.topic} rises (correlation {likeness:.3f})",
                    f"{other.topic}.position_z_scale=-1",
                    "factors.position_m = [1, 1, -1] in the mapping, with north and east swapped",
                )


_PLACED = {schemas.POSITION_FIX.full_name, schemas.POSE.full_name}


def _at(stream: Stream, times_ns: np.ndarray) -> np.ndarray:
    """Interpolate altitudes at other stamps."""
    return np.interp(times_ns, np.sort(stream.publish_time_ns), stream["altitude_m"])


def _wheels(streams: Mapping[str, Stream], stream: Stream) -> Slope | None:
    """Compute the distance that fixes move per metre measured by the body's wheels."""
    for body in bodies({**streams, stream.topic: stream}):
        if body.speeds and body.fixes and body.fixes[0].topic == stream.topic:
            return BodyMotion(body).speed(body.speeds[0])
    return None


def _place(stream: Stream, value: float, words: str, mapping: str, *, is_fact: bool = True) -> Finding:
    return Finding(
        "place",
        stream.topic,
        "latitude_deg",
        value,
        f"{stream.topic}: {words}",
        otherwise=mapping,
        severity="fact" if is_fact else "likely",
    )
