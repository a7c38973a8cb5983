"""Windows of a motion, and how far or by what angle positions or other topics move in each."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.body import Body, Floats, PlaceSeries, Series
from fuselog.recorders.models.planar import wrap_angle

SPANS_S = (2.0, 5.0, 10.0)
FEWEST = 12  # windows; with fewer nothing is concluded
CLEAR = 12.0  # times the noise of a position: the least length of a clear move
WANDERS = 3.0  # stated standard deviations, within which a body counts as at rest
JUMP = 5.0  # times the noise of a position, and times the length of nearly all steps
JUMP_STEPS = 2.0
JUMPS = 0.05  # share of the steps; if there are more, they are the body's motion
ASTRAY_S = 10.0  # before and after a jump
NEAR = 4  # steps on either side, with whose median velocity a step is compared
MOST = 2000  # windows; more are thinned


@dataclass(frozen=True)
class Windows:
    """Windows (k,) from one stamp to a later one, and the values measured in each."""

    begin_s: Floats
    end_s: Floats
    values: Floats

    def __len__(self) -> int:
        return len(self.begin_s)

    def take(self, rows: NDArray[np.bool_] | slice) -> "Windows":
        """Select some of the windows."""
        return Windows(self.begin_s[rows], self.end_s[rows], self.values[rows])


def thinned(count: int, most: int) -> slice:
    """Return a slice that keeps at most `most` of `count` items, evenly spaced."""
    return slice(None, None, max(1, -(-count // most)))


def noise_of(places: Floats) -> float:
    """Estimate the standard deviation of the white noise in samples (n, 2) from second differences.

    Acceleration adds to the differences, so the estimate is too large rather than too small.
    """
    bend = places[1:-1] - 0.5 * (places[:-2] + places[2:])
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(1.5)) if len(bend) else np.nan


def pairs(times_s: Floats, span_s: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find pairs of stamps that are a span apart, or one step apart if the steps are longer.

    Args:
        times_s: (n,), ascending.
        span_s: the span, in s.

    Returns:
        The rows of the first and of the second stamps, (k,) each, with k at most `MOST`.
    """
    step_s = float(np.median(np.diff(times_s)))
    later = np.searchsorted(times_s, times_s + max(span_s, step_s) - 1e-6)
    first = np.flatnonzero(later < len(times_s))
    is_near = times_s[later[first]] - times_s[first] < 1.5 * max(span_s, step_s)
    first = first[is_near]
    first = first[thinned(len(first), MOST)]
    return first, later[first]


def jumps(fixes: Series) -> NDArray[np.bool_]:
    """Find which of the steps (n - 1,) between positions are jumps of the receiver.

    A jump is a single step that differs from its neighbours by more than the noise, and is longer than
    nearly all steps. Successive long steps in one direction, or frequent long steps, are motion and not
    jumps.
    """
    steps, step_s = np.diff(fixes.values, axis=0), np.diff(fixes.times_s)
    if len(steps) < FEWEST:
        return np.zeros(len(steps), bool)
    padded = np.pad(steps / step_s[:, None], ((NEAR, NEAR), (0, 0)), mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR + 1, axis=0), axis=-1)
    excess = steps - usual * step_s[:, None]
    most_m = JUMP_STEPS * np.quantile(np.linalg.norm(steps, axis=1), 1.0 - JUMPS)
    found = np.linalg.norm(excess, axis=1) > max(JUMP * noise_of(fixes.values), most_m)
    goes_on = found[1:] & found[:-1] & (np.sum(excess[1:] * excess[:-1], axis=1) > 0.0)
    found[1:] &= ~goes_on
    found[:-1] &= ~goes_on
    return found if found.mean() <= JUMPS else np.zeros(len(steps), bool)


def chords(fixes: Series, span_s: float) -> Windows:
    """Compute how positions move (k, 2) in windows of a span, without windows near a jump.

    Windows near a jump are removed because a receiver may drift slowly before it jumps back, or after it
    jumped away. If jumps are so frequent that less than half of the windows remain, only windows with a
    jump are removed.
    """
    first, second = pairs(fixes.times_s, span_s)
    at_s = fixes.times_s[1:][jumps(fixes)]
    is_sound = np.ones(len(first), bool)
    for astray_s in (ASTRAY_S, 0.0):
        begin_s, end_s = fixes.times_s[first] - astray_s, fixes.times_s[second] + astray_s
        is_sound = np.searchsorted(at_s, begin_s, "right") == np.searchsorted(at_s, end_s, "right")
        if 2 * is_sound.sum() >= len(is_sound):
            break
    first, second = first[is_sound], second[is_sound]
    return Windows(
        fixes.times_s[first], fixes.times_s[second], fixes.values[second] - fixes.values[first]
    )


def lengths(source: Series, moved: Floats) -> Floats:
    """Compute how far a body moved, forward or backward.

    Args:
        source: the speed or velocity in m/s.
        moved: differences of its integral in m, (...) for a speed, (..., 2) for a velocity.

    Returns:
        (...), in m, not negative.
    """
    if source.values.ndim == 1:
        return np.abs(moved)
    return np.sqrt(moved[..., 0] ** 2 + moved[..., 1] ** 2)


def travelled(source: Series, begin_s: Floats, end_s: Floats) -> Floats:
    """Compute the distance moved in windows, forward or backward, from a speed or velocity.

    Args:
        source: the speed or velocity in m/s.
        begin_s: (k,), start times of the windows, in s.
        end_s: (k,), end times of the windows, in s.

    Returns:
        (k,), in m, not negative; NaN beyond the source's stamps.
    """
    return lengths(source, source.integral(end_s) - source.integral(begin_s))


def _moves(fixes: PlaceSeries) -> bool:
    """Test whether positions move farther than the stated errors of a stationary receiver explain."""
    stated = fixes.variances_m2[fixes.variances_m2 > 0.0]
    sigma_m = float(np.sqrt(np.median(stated))) if len(stated) else 0.0
    away_m = np.linalg.norm(fixes.values - np.median(fixes.values, axis=0), axis=1)
    return float(away_m.max()) > WANDERS * sigma_m


def places_of(body: Body) -> Series | None:
    """Return the body's positions: fixes, or integrated velocities; return None if it is stationary."""
    if body.fixes:
        return body.fixes[0] if _moves(body.fixes[0]) else None
    if body.velocities and body.speeds:
        of = body.velocities[0]
        return Series(of.topic, of.field, of.times_s, of.integral(of.times_s))
    return None


def distances(places: Series, span_s: float) -> Windows | None:
    """Compute distances in windows of a span, or of a longer span if the distances vary too little."""
    for each_s in (span_s, *SPANS_S):
        moved = chords(places, each_s)
        found = replace(moved, values=np.linalg.norm(moved.values, axis=1))
        if len(found) >= FEWEST and np.std(found.values) > 3.0 * noise_of(places.values):
            return found
    return None


def clear_moves(places: Series) -> Windows | None:
    """Find moves (k, 2) well above the noise of positions, in the shortest windows with enough moves."""
    noise = noise_of(places.values)
    for span_s in SPANS_S:
        moved = chords(places, span_s)
        clear = moved.take(np.linalg.norm(moved.values, axis=1) > CLEAR * noise)
        if len(clear) >= FEWEST:
            return clear
    return None


def courses(body: Body) -> Series | None:
    """Compute the course (n,) in rad while the body moves clearly, from velocities or positions."""
    of: Series | None
    if body.velocities:
        of = body.velocities[0]
        moves = np.linalg.norm(of.values, axis=1) > CLEAR * noise_of(of.values)
        times_s, values = of.times_s[moves], of.values[moves]
    elif (of := places_of(body)) is not None and (moved := clear_moves(of)) is not None:
        times_s, values = 0.5 * (moved.begin_s + moved.end_s), moved.values
    else:
        return None
    if len(times_s) < FEWEST:
        return None
    return Series(of.topic, of.field, times_s, np.arctan2(values[:, 1], values[:, 0]))


def turned(angles: Series, span_s: float) -> Windows:
    """Compute the change of angles (k,) in windows of a span, wrapped to [-pi, pi)."""
    first, second = pairs(angles.times_s, span_s)
    change = angles.values[second] - angles.values[first]
    return Windows(angles.times_s[first], angles.times_s[second], wrap_angle(change))
