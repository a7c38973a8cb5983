"""Search for the delay, and the clock's gain, at which a topic agrees best with another's motion."""

import math
from typing import Any, NamedTuple

import numpy as np

from fuselog.recorders.checks.body import Floats, Series
from fuselog.recorders.checks.windows import FEWEST, Windows, lengths, thinned
from fuselog.recorders.log.loops import kernel

LONGEST_S, STEP_S, FINE_S = 30.0, 0.1, 0.01
GAINS = np.linspace(-0.1, 0.1, 41)
FEW = 100  # least number of windows to search for a lag or a clock
NEAR_S = 1.0  # lags below it are as likely as all longer ones
SURE = 2.0  # evidence for a lag; it is too small, since neighbouring windows share a position
MISFIT = 0.02  # share of a motion that lever arms and slip may leave unexplained at the right lag
CHANGES = 4  # crossings of the mean; with fewer a lever arm may look like a delay
TINY = float(np.finfo(float).tiny)
VARIES = 1e-6  # relative variation that a motion needs to determine a time


class Timing(NamedTuple):
    """The lag and gain at which a source fits the motion in windows best, with their uncertainty.

    Attributes:
        lag_s: how much later the windows are than the source.
        gain: gain of the source's clock, in s/s.
        likeness: correlation at this lag and gain, -1 to 1.
        evidence: log-likelihood with lag and gain, minus the log-likelihood without them.
        is_needed: whether the lag still fits clearly better if a share `MISFIT` of the motion is always
            treated as unexplained.
        tolerance_s: lags up to this size are ignored.
        spread_s: largest difference between equally likely lags, plus the tolerance.
        is_alone: whether only neighbouring lags explain the motion equally well, and no lag that is a
            period of the motion away.
    """

    lag_s: float
    gain: float
    likeness: float
    evidence: float
    is_needed: bool
    tolerance_s: float
    spread_s: float
    is_alone: bool


def timing(windows: Windows, source: Series, *, is_path: bool, tolerance_s: float) -> Timing | None:
    """Find the lag and gain with the largest correlation; return None if there are too few windows.

    Args:
        windows: the motion in windows: lengths if `is_path`, otherwise angles.
        source: a speed, velocity or turn rate.
        is_path: whether the length of the source's motion counts.
        tolerance_s: lags up to this size are ignored.
    """
    if len(windows) < FEWEST or not np.ptp(windows.values):
        return None
    count = _independent(windows)
    lags_s = np.arange(-LONGEST_S, LONGEST_S + 0.5 * STEP_S, STEP_S)
    few = windows.take(thinned(len(windows), max(FEW, 2 * count)))
    coarse = likenesses(few, lags_s, source, is_path=is_path)
    if not np.isfinite(coarse).any():
        return None
    best_s = float(lags_s[np.nanargmax(np.abs(coarse))])
    fine_s = best_s + np.arange(-STEP_S, STEP_S + 0.5 * FINE_S, FINE_S)
    near = likenesses(windows, fine_s, source, is_path=is_path)
    if not np.isfinite(near).any():  # at an end of the lags, where too few windows remain
        return None
    best = int(np.nanargmax(np.abs(near)))
    lag_s, likeness = float(fine_s[best]), float(near[best])
    gain, gained_s, gained = _gained(few, source, is_path=is_path)
    telling = _telling(windows, source.moved(0.0, gain), gained_s, is_path=is_path)
    if _evidence(telling, gained, likeness) > max(10.0, 0.05 * count) and abs(gain) > 0.005:
        lag_s, likeness = gained_s, gained
    else:
        gain, telling = 0.0, _telling(windows, source, lag_s, is_path=is_path)
    zero_s = np.arange(-tolerance_s, tolerance_s + 0.5 * FINE_S, max(FINE_S, tolerance_s / 10.0))
    without = likenesses(windows, zero_s, source, is_path=is_path)
    usual = float(np.nanmax(np.abs(without))) if np.isfinite(without).any() else 0.0
    evidence = float(_evidence(telling, likeness, usual))
    if abs(lag_s) > NEAR_S:  # of many lags, one is the best by chance
        evidence -= float(np.log(len(lags_s)))
    tried_s, tried = np.concatenate([lags_s, fine_s]), np.concatenate([coarse, near])
    as_likely_s = tried_s[_evidence(telling, likeness, tried) < SURE]
    spread_s = tolerance_s + float(np.max(np.abs(as_likely_s - lag_s), initial=FINE_S))
    is_needed = bool(_evidence(telling, likeness, usual, MISFIT) >= SURE)
    is_alone = _changes(windows) >= CHANGES and _is_one_peak(coarse, telling)
    return Timing(lag_s, gain, likeness, evidence, is_needed, tolerance_s, spread_s, is_alone)


def _changes(windows: Windows) -> int:
    """Count how often a motion crosses its mean."""
    return int(np.count_nonzero(np.diff(windows.values > np.mean(windows.values))))


def _is_one_peak(likeness: Floats, count: float) -> bool:
    """Test whether the lags that fit about equally well are adjacent, and exclude the first and last.

    The height of a peak between lags comes from the parabola through three neighbouring lags.
    """
    size = np.abs(likeness)
    below, above = size[1:-1] - size[:-2], size[1:-1] - size[2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        rise = (below - above) ** 2 / (8.0 * (below + above))
    size[1:-1] += np.where((below >= 0.0) & (above >= 0.0) & (below + above > 0.0), rise, 0.0)
    size = np.minimum(size, 1.0)
    as_good = np.flatnonzero(_evidence(count, np.nanmax(size), size, MISFIT) < SURE)
    known = np.flatnonzero(np.isfinite(size))
    is_within = known[0] < as_good[0] and as_good[-1] < known[-1]
    return bool(is_within and as_good[-1] - as_good[0] + 1 == len(as_good))


def _gained(windows: Windows, source: Series, *, is_path: bool) -> tuple[float, float, float]:
    """Find the gain of the source's clock, with the lag and the correlation there."""
    lags_s = np.arange(-10.0, 10.0, 0.2)
    best = (0.0, 0.0, 0.0)
    for gain in GAINS:
        found = likenesses(windows, lags_s, source.moved(0.0, gain), is_path=is_path)
        if np.isfinite(found).any():
            place = int(np.nanargmax(np.abs(found)))
            if abs(found[place]) > abs(best[2]):
                best = float(gain), float(lags_s[place]), float(found[place])
    return best


def likenesses(windows: Windows, lags_s: Floats, source: Series, *, is_path: bool) -> Floats:
    """Correlate windows with a source at each lag; NaN if the source spans less than half of them.

    Args:
        windows: k windows: lengths if `is_path`, otherwise angles.
        lags_s: (lags,), how much later the windows are than the source.
        source: a speed, velocity or turn rate.
        is_path: whether the length of the source's motion counts, not the motion itself.

    Returns:
        (lags,), -1 to 1.
    """
    found, moves = np.empty(len(lags_s)), np.empty(len(windows))
    spans = np.ascontiguousarray(windows.begin_s), np.ascontiguousarray(windows.end_s)
    values = np.ascontiguousarray(windows.values)
    slopes = np.diff(source.totals) / np.diff(source.times_s)
    integral = source.times_s, source.totals, slopes
    kernel(_correlate)(found, moves, lags_s, *spans, values, *integral, is_path)
    return found


def _correlate(
    found: Floats,
    moves: Floats,
    lags_s: Floats,
    begin_s: Floats,
    end_s: Floats,
    values: Floats,
    times_s: Floats,
    totals: Floats,
    slopes: Floats,
    is_path: bool,
) -> None:
    """Fill in the correlation at each lag.

    Args:
        found: (lags,), the correlations.
        moves: (k,), work memory.
        lags_s: (lags,), how much later the windows are than the source.
        begin_s, end_s, values: (k,), the windows.
        times_s: (n,), stamps of the source.
        totals: (m, n), its integral to each stamp.
        slopes: (m, n - 1), how the integral grows from each stamp to the next, per second.
        is_path: whether the length of the source's motion counts, not the motion itself.
    """
    for lag in range(len(lags_s)):
        _move(moves, begin_s, end_s, lags_s[lag], times_s, totals, slopes, is_path)
        found[lag] = _correlation(moves, values)


def _move(
    moves: Floats,
    begin_s: Floats,
    end_s: Floats,
    lag_s: float,
    times_s: Floats,
    totals: Floats,
    slopes: Floats,
    is_path: bool,
) -> None:
    """Fill in the motion of the source in each window; NaN for windows that it does not span."""
    final = len(times_s) - 1
    rate_hz = final / (times_s[final] - times_s[0])
    first, last = 0, 0
    for k in range(len(moves)):
        start_s, stop_s = begin_s[k] - lag_s, end_s[k] - lag_s
        moves[k] = math.nan
        if start_s >= times_s[0] and stop_s <= times_s[final]:
            first = _stamp_before(times_s, start_s, first, rate_hz)
            last = _stamp_before(times_s, stop_s, last, rate_hz)
            square, move = 0.0, 0.0
            for column in range(totals.shape[0]):
                move = totals[column, last] + slopes[column, last] * (stop_s - times_s[last])
                move -= totals[column, first] + slopes[column, first] * (start_s - times_s[first])
                square += move * move
            moves[k] = math.sqrt(square) if is_path else move


def _stamp_before(times_s: Floats, time_s: float, near: int, rate_hz: float) -> int:
    """Return the number of the last stamp that is not after a time; the final stamp is left out.

    The search begins where that stamp would be if all steps from a near stamp on had the same length.
    """
    final = len(times_s) - 2
    place = min(max(near + int((time_s - times_s[near]) * rate_hz), 0), final)
    while place > 0 and times_s[place] > time_s:
        place -= 1
    while place < final and times_s[place + 1] <= time_s:
        place += 1
    return place


def _correlation(moves: Floats, values: Floats) -> float:
    """Correlate known moves with values; NaN if fewer than half are known, or if they hardly vary."""
    count, of_moves, of_values = 0, 0.0, 0.0
    for k in range(len(moves)):
        if not math.isnan(moves[k]):
            count += 1
            of_moves += moves[k]
            of_values += values[k]
    if count < max(FEWEST, 0.5 * len(moves)):
        return math.nan
    xx, xy, yy, squares = 0.0, 0.0, 0.0, 0.0
    for k in range(len(moves)):
        if not math.isnan(moves[k]):
            x, y = moves[k] - of_moves / count, values[k] - of_values / count
            xx += x * x
            xy += x * y
            yy += y * y
            squares += moves[k] * moves[k]
    if xx <= VARIES * VARIES * squares or yy == 0.0:
        return math.nan
    return xy / math.sqrt(xx * yy)


def _telling(windows: Windows, source: Series, lag_s: float, *, is_path: bool) -> float:
    """Estimate the number of independent windows.

    Only windows that do not overlap are counted. Windows have less weight if residuals persist from one
    window to the next, as those due to a lever arm do; the reduction follows from a first-order
    autoregression.
    """
    span_s = float(np.median(windows.end_s - windows.begin_s))
    _, first = np.unique(np.floor(windows.begin_s / span_s), return_index=True)
    begin_s, end_s = windows.begin_s[first] - lag_s, windows.end_s[first] - lag_s
    moves = source.integral(end_s) - source.integral(begin_s)
    if is_path:
        moves = lengths(source, moves)
    is_in = np.isfinite(moves)
    x, y = moves[is_in], windows.values[first][is_in]
    if len(x) < FEWEST:
        return 0.0
    x, y = x - np.mean(x), y - np.mean(y)
    left = y - x * (x @ y) / max(float(x @ x), TINY)
    persists = float(np.clip(left[1:] @ left[:-1] / max(float(left @ left), TINY), 0.0, 0.99))
    return len(x) * (1.0 - persists) / (1.0 + persists)


def _independent(windows: Windows) -> int:
    """Count the windows that do not overlap."""
    span_s = float(np.median(windows.end_s - windows.begin_s))
    return len(np.unique(np.floor(windows.begin_s / span_s)))


def _evidence(count: float, likeness: float, usual: Any, misfit: float = 1e-9) -> Any:
    """Compute the log-likelihood ratio of one correlation to others, for `count` Gaussian pairs."""
    rest, before = (np.maximum(1.0 - np.square(each), misfit) for each in (likeness, usual))
    return 0.5 * count * np.log(before / rest)
