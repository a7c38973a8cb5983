"""Comparisons of a body's topics in pairs: their lags, and the factors or angles between them.

Lags are found first, because a topic with a large delay may seem to turn in the wrong direction.
"""

from collections.abc import Iterator
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np

from fuselog.recorders.checks.body import Body, Floats, Series
from fuselog.recorders.checks.timing import SURE, Timing, timing
from fuselog.recorders.checks.windows import (
    FEWEST,
    Windows,
    chords,
    clear_moves,
    courses,
    distances,
    noise_of,
    places_of,
    travelled,
    turned,
)
from fuselog.recorders.models.orientation import heading
from fuselog.recorders.models.planar import wrap_angle

LEAST_LAG_S = 0.15
LONG_S = 1.0  # a lag too long to be due to a course that differs from the heading
CHORD = 1.3  # ratio of what noise adds to a squared chord to the variance from `noise_of`
ALIKE, PLAIN = 0.8, 0.95  # correlations; the second if the course may differ from the heading


class Slope(NamedTuple):
    """The ratio between the readings of two topics, over windows.

    Attributes:
        value: the ratio, by least squares through zero.
        likeness: correlation about zero; zero if a few windows determine the ratio.
        spread: median relative difference of a single window's ratio from `value`; infinite if a few
            windows determine the ratio.
        windows: number of windows.
    """

    value: float
    likeness: float
    spread: float
    windows: int

    @property
    def sign(self) -> int:
        """Return 1 or -1, or 0 if the topics do not correlate."""
        is_clear = self.windows >= FEWEST and abs(self.likeness) > ALIKE
        return int(np.sign(self.value)) if is_clear else 0


def slope(x: Floats, y: Floats) -> Slope:
    """Compute the slope of y on x through zero, over windows in which both are known.

    Args:
        x: (k,), NaN if unknown.
        y: (k,), NaN if unknown.

    Returns:
        The slope; its value is NaN if fewer than `FEWEST` windows are known, or x or y is zero.
    """
    known = np.isfinite(x) & np.isfinite(y)
    x, y = x[known], y[known]
    xx, xy, yy = x @ x, x @ y, y @ y
    if len(x) < FEWEST or not (xx > 0.0 and yy > 0.0):
        return Slope(np.nan, 0.0, np.inf, len(x))
    value = float(xy / xx)
    if not _agree(value, usual_slope(x, y)):
        return Slope(value, 0.0, np.inf, len(x))
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = float(np.nanmedian(np.abs(y / x - value)) / abs(value)) if value else np.inf
    return Slope(value, float(xy / np.sqrt(xx * yy)), spread, len(x))


def usual_slope(x: Floats, y: Floats) -> float:
    """Compute the slope of y on x through zero by least absolute deviations.

    The usual slope is the median of y / x with the weights |x| (Laplace), so that a few outliers do not
    determine it.

    Args:
        x: (k,), finite.
        y: (k,), finite.

    Returns:
        The slope; NaN if all x are zero.
    """
    is_moved = x != 0.0
    if not is_moved.any():
        return np.nan
    ratios, weights = y[is_moved] / x[is_moved], np.abs(x[is_moved])
    order = np.argsort(ratios)
    total = np.cumsum(weights[order])
    return float(ratios[order][np.searchsorted(total, 0.5 * total[-1])])


def _agree(value: float, usual: float) -> bool:
    """Test whether least squares and the usual slope agree approximately."""
    return bool(ALIKE * abs(value) <= np.sign(value) * usual <= abs(value) / ALIKE)


def turn_between(source: Series, begin_s: Floats, end_s: Floats) -> Floats:
    """Compute the angles turned in windows, by integrating a turn rate.

    Args:
        source: the turn rate in rad/s.
        begin_s: (k,), start times of the windows, in s.
        end_s: (k,), end times of the windows, in s.

    Returns:
        (k,), in rad; NaN beyond the rate's stamps.
    """
    return source.integral(end_s) - source.integral(begin_s)


class Lag(NamedTuple):
    """The delay of the topic `against` relative to the topic `source`."""

    source: str
    against: str
    timing: Timing


class BodyMotion:
    """A body, and the results of comparing its topics in pairs."""

    def __init__(self, body: Body) -> None:
        self.body = body
        self.places = places_of(body)
        self.courses = courses(body)
        self.turn_span_s = 1.0 if body.velocities else 2.0  # positions need longer ones

    @cached_property
    def speed_lags(self) -> list[Lag]:
        """Compute the lags of speeds and velocities behind positions."""
        if self.places is None or (windows := distances(self.places, 1.0)) is None:
            return []
        return list(self._lags(windows, self.places.topic))

    def _lags(self, windows: Windows, against: str) -> Iterator[Lag]:
        for source in chain(self.body.speeds, self.body.velocities):
            if source.topic == against:
                continue
            found = timing(windows, source, is_path=True, tolerance_s=_hold_s(source))
            if found is not None:
                yield Lag(source.topic, against, found)

    @cached_property
    def turn_lags(self) -> list[Lag]:
        """Compute the lags of turn rates behind courses."""
        if self.courses is None:
            return []
        windows = turned(self.courses, 1.0)
        found = []
        for source in self.body.turns:
            lag = timing(windows, source, is_path=False, tolerance_s=_hold_s(source))
            if lag is not None:
                found.append(Lag(source.topic, self.courses.topic, lag))
        return found

    @cached_property
    def delays_s(self) -> dict[str, float]:
        """Compute how late each topic's stamps are compared with most topics, if this is certain.

        If two topics differ, the later one is assumed to be delayed, since messages may be late, but
        never early.
        """
        late_s: dict[str, float] = {}
        if self.places is not None and self.speed_lags:
            late_s[self.places.topic] = 0.0
            for each in self.speed_lags:
                late_s[each.source] = -_sure_lag_s(each.timing)
        for each in self.turn_lags:
            if each.source in late_s:
                continue  # its speeds are more informative
            late_s.setdefault(each.against, 0.0)
            own_s = late_s[each.against] - _sure_lag_s(each.timing)
            nearest_s = min(late_s.values(), key=lambda other_s: abs(own_s - other_s))
            if self.goes_where_it_points(each):
                late_s[each.source] = own_s
            elif _sure_lag_s(each.timing) and abs(each.timing.likeness) > PLAIN:
                late_s[each.source] = nearest_s if abs(own_s - nearest_s) < LONG_S else own_s
        if not late_s:
            return {}
        sorted_s = sorted(late_s.values())
        usual_s = sorted_s[(len(sorted_s) - 1) // 2]
        return {topic: each_s - usual_s for topic, each_s in late_s.items()}

    def goes_where_it_points(self, lag: Lag) -> bool:
        """Test from forces in the body's axes whether the body moves in the direction of its heading."""
        for force in self.body.forces:
            if force.topic == lag.source:
                found = self.forces(force.moved(-lag.timing.lag_s))
                return found is not None and max(found.fit, found.mirrored) > 0.9
        return False

    @cached_property
    def gains(self) -> dict[str, float]:
        """Return the gain in s/s of each topic's clock relative to the clock of the positions."""
        return {each.source: each.timing.gain for each in self.speed_lags if each.timing.gain}

    def aligned(self, source: Series) -> Series:
        """Shift a topic to the clock of the positions, or of the courses."""
        for each in (*self.speed_lags, *self.turn_lags):
            if each.source == source.topic:
                late_s = self.delays_s.get(each.source, 0.0) - self.delays_s.get(each.against, 0.0)
                if each.timing.gain:
                    late_s = -each.timing.lag_s
                return source.moved(late_s, each.timing.gain)
        return source

    def timed(self, source: Series) -> Series:
        """Shift a topic to the clock that most topics have."""
        if source.topic in self.gains:
            return self.aligned(source)
        return source.moved(self.delays_s.get(source.topic, 0.0))

    def likened(self, source: Series) -> Series:
        """Shift a turn rate to the time at which it agrees best with the course."""
        aligned = self.aligned(source)
        for each in self.turn_lags:
            if each.source == source.topic and source.topic not in self.gains:
                lag = each.timing
                if lag.is_alone and lag.evidence > SURE and abs(lag.likeness) > ALIKE:
                    return source.moved(-lag.lag_s, lag.gain)
        return aligned

    def speed(self, source: Series) -> Slope | None:
        """Compute the distance that positions move per metre integrated from a speed or velocity."""
        if self.places is None or source.topic == self.places.topic:
            return None
        if (moved := clear_moves(self.places)) is None:
            return None
        aligned = self.aligned(source)
        found = slope(
            travelled(aligned, moved.begin_s, moved.end_s), np.linalg.norm(moved.values, axis=1)
        )
        # the windows were selected by the motion of positions, so all windows have to agree
        every = chords(self.places, float(np.median(moved.end_s - moved.begin_s)))
        distances = travelled(aligned, every.begin_s, every.end_s)
        known = np.isfinite(distances)
        squares = np.sum(every.values[known] ** 2, axis=1) - CHORD * noise_of(self.places.values) ** 2
        usual = usual_slope(distances[known], np.sqrt(np.maximum(squares, 0.0)))
        return found if _agree(found.value, usual) else found._replace(likeness=0.0, spread=np.inf)

    def turn(self, source: Series) -> Slope | None:
        """Compute the change of the course per radian integrated from a turn rate.

        If the turn rate correlates with the course without a lag, no lag is used, since half a period
        of a winding road would look like a lag. If several lags fit better, some with opposite signs,
        the sign is unknown.
        """
        if self.courses is None:
            return None
        windows = turned(self.courses, self.turn_span_s)
        for moved in (source, self.aligned(source), self.likened(source)):
            ratio = slope(turn_between(moved, windows.begin_s, windows.end_s), windows.values)
            if ratio.sign > 0:
                return ratio
        lags = [each.timing for each in self.turn_lags if each.source == source.topic]
        is_known = all(lag.is_alone or not lag.is_needed for lag in lags)
        return ratio if is_known else None

    def heading_turn(self, orientation: Series, source: Series) -> Slope:
        """Compute the change of a heading per radian integrated from a turn rate."""
        angles = Series("", "", orientation.times_s, heading(orientation.values))
        windows = turned(angles, self.turn_span_s)
        return slope(turn_between(self.timed(source), windows.begin_s, windows.end_s), windows.values)

    def heading_course(self, orientation: Series) -> Slope | None:
        """Compute the change of a heading per radian of change of the course."""
        if self.courses is None:
            return None
        windows = turned(self.timed(self.courses), self.turn_span_s)
        begin, end = (heading_at(orientation, each) for each in (windows.begin_s, windows.end_s))
        return slope(windows.values, end - begin)

    def heading_offsets(self, orientation: Series) -> Floats:
        """Compute heading minus course (k,) while the body clearly moves, forward or backward."""
        if self.courses is None:
            return np.empty(0)
        course = self.timed(self.courses)
        offsets = heading_at(orientation, course.times_s) - course.values
        if self.body.speeds:
            speed = self.timed(self.body.speeds[0])
            sign = np.interp(course.times_s, speed.times_s, np.sign(speed.values))
            offsets = offsets + np.pi * (sign < 0.0)
        return wrap_angle(offsets[np.isfinite(offsets)])

    def forces(self, force: Series) -> "Forces | None":
        """Compute how well horizontal forces fit velocity changes; return None if this is impossible."""
        if not self.body.velocities or self.courses is None:
            return None
        velocity = self.body.velocities[0]
        v = velocity.values[:, 0] + 1j * velocity.values[:, 1]
        course = np.interp(velocity.times_s, self.courses.times_s, np.unwrap(self.courses.values))
        step = max(1, round(1.0 / float(np.median(np.diff(velocity.times_s)))))
        begin_s, end_s = velocity.times_s[:-step], velocity.times_s[step:]
        middle = np.exp(-0.5j * (course[step:] + course[:-step]))
        speed = np.abs(v)
        is_clear = np.minimum(speed[step:], speed[:-step]) > 0.1 * np.quantile(speed, 0.95)
        change = (v[step:] - v[:-step]) * middle
        impulse = force.integral(end_s) - force.integral(begin_s)
        pushed = impulse[:, 0] + 1j * impulse[:, 1]
        known = np.isfinite(pushed) & is_clear & (end_s - begin_s < 2.0)
        resting = np.isfinite(pushed) & ~is_clear
        still = resting if resting.sum() >= FEWEST else known
        if known.sum() < FEWEST:
            return None
        duration_s = end_s - begin_s
        pushed = pushed - duration_s * np.sum(pushed[still]) / np.sum(duration_s[still])
        pushed, change = pushed[known], change[known]
        size = np.sqrt(np.sum(np.abs(pushed) ** 2) * np.sum(np.abs(change) ** 2))
        as_is = np.sum(np.conj(pushed) * change) / size
        mirrored = np.sum(pushed * change) / size
        return Forces(float(np.angle(as_is)), float(np.abs(as_is)), float(np.abs(mirrored)))


def heading_at(orientation: Series, times_s: Floats) -> Floats:
    """Interpolate headings at other times.

    Args:
        orientation: quaternions (n, 4).
        times_s: (k,), times at which to interpolate, in s.

    Returns:
        (k,), in rad, not wrapped; NaN before the first and after the last.
    """
    angle = np.unwrap(heading(orientation.values))
    return np.interp(times_s, orientation.times_s, angle, left=np.nan, right=np.nan)


class Forces(NamedTuple):
    """The angle (rad) by which horizontal forces have to be rotated to match the course.

    `fit` (at most 1) states how well the rotated forces match; `mirrored` states the same for their
    mirror image.
    """

    angle_rad: float
    fit: float
    mirrored: float


def _hold_s(source: Series) -> float:
    """Return the delay that a topic may have by definition: half a step, or a full step for vectors."""
    step_s = float(np.median(np.diff(source.times_s)))
    return step_s if source.values.ndim > 1 else 0.5 * step_s


def _sure_lag_s(lag: Timing) -> float:
    """Return the lag if it is certain and not negligible, and the clock has no gain; else zero."""
    is_lag = abs(lag.lag_s) > max(LEAST_LAG_S, lag.tolerance_s)
    is_sure = lag.is_alone and lag.evidence > SURE and abs(lag.likeness) > ALIKE and not lag.gain
    return lag.lag_s if is_lag and is_sure else 0.0
