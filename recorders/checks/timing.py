"""Search for the delay, and the clock's gain, at which a topic agrees best with another's motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.body import Floats, Series
from fuselog.recorders.checks.windows import FEWEST, Windows, thinned

Account = Callable[[Series, Floats], Floats]  # values of windows, from differences of an integral
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


def timing(windows: Windows, source: Series, account: Account, *, tolerance_s: float) -> Timing | None:
    """Find the lag and gain with the largest correlation; return None if there are too few windows."""
    if len(windows) < FEWEST or not np.ptp(windows.values):
        return None
    count = _independent(windows)
    lags_s = np.arange(-LONGEST_S, LONGEST_S + 0.5 * STEP_S, STEP_S)
    few = windows.take(thinned(len(windows), max(FEW, 2 * count)))
    coarse = _Lagged.of(few, lags_s).likeness(source, account)
    if not np.isfinite(coarse).any():
        return None
    best_s = float(lags_s[np.nanargmax(np.abs(coarse))])
    fine_s = best_s + np.arange(-STEP_S, STEP_S + 0.5 * FINE_S, FINE_S)
    near = _Lagged.of(windows, fine_s).likeness(source, account)
    if not np.isfinite(near).any():  # at an end of the lags, where too few windows remain
        return None
    best = int(np.nanargmax(np.abs(near)))
    lag_s, likeness = float(fine_s[best]), float(near[best])
    gain, gained_s, gained = _gained(few, source, account)
    telling = _telling(windows, source.moved(0.0, gain), account, gained_s)
    if _evidence(telling, gained, likeness) > max(10.0, 0.05 * count) and abs(gain) > 0.005:
        lag_s, likeness = gained_s, gained
    else:
        gain, telling = 0.0, _telling(windows, source, account, lag_s)
    zero_s = np.arange(-tolerance_s, tolerance_s + 0.5 * FINE_S, max(FINE_S, tolerance_s / 10.0))
    without = _Lagged.of(windows, zero_s).likeness(source, account)
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


def _gained(windows: Windows, source: Series, account: Account) -> tuple[float, float, float]:
    """Find the gain of the source's clock, with the lag and the correlation there."""
    lags_s = np.arange(-10.0, 10.0, 0.2)
    lagged = _Lagged.of(windows, lags_s).sorted()
    best = (0.0, 0.0, 0.0)
    for gain in GAINS:
        found = lagged.likeness(source.moved(0.0, gain), account)
        if np.isfinite(found).any():
            place = int(np.nanargmax(np.abs(found)))
            if abs(found[place]) > abs(best[2]):
                best = float(gain), float(lags_s[place]), float(found[place])
    return best


class _Lagged(NamedTuple):
    """Windows at several lags.

    Attributes:
        times_s: (q,), stamps at which a window begins or ends.
        begin: (lags, k), the rows of `times_s` at which the windows begin.
        end: (lags, k), the same for their ends.
        values: (k,), the values measured in the windows.
    """

    times_s: Floats
    begin: NDArray[np.int64]
    end: NDArray[np.int64]
    values: Floats

    @classmethod
    def of(cls, windows: Windows, lags_s: Floats) -> "_Lagged":
        """Shift windows by lags; a stamp at which windows begin and others end occurs once."""
        stamps_s, rows = np.unique([windows.begin_s, windows.end_s], return_inverse=True)
        offsets = len(stamps_s) * np.arange(len(lags_s))[:, None]
        begin, end = (offsets + each for each in rows.reshape(2, -1))
        return cls((stamps_s - lags_s[:, None]).ravel(), begin, end, windows.values)

    def sorted(self) -> "_Lagged":
        """Sort the stamps, at which many series can then be integrated faster."""
        order = np.argsort(self.times_s)
        places = np.empty_like(order)
        places[order] = np.arange(len(order))
        return self._replace(times_s=self.times_s[order], begin=places[self.begin], end=places[self.end])

    def likeness(self, source: Series, account: Account) -> Floats:
        """Correlate at each lag; use NaN if the source spans less than half of the windows."""
        total = source.integral(self.times_s)
        moves = account(source, total.take(self.end, axis=0) - total.take(self.begin, axis=0))
        is_in = np.isfinite(moves)
        count = np.count_nonzero(is_in, axis=1)
        moves[~is_in] = 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            x, y = moves, is_in * self.values
            x = is_in * (x - (x.sum(axis=1) / count)[:, None])
            y = is_in * (y - (y.sum(axis=1) / count)[:, None])
            xx = np.sum(x * x, axis=1)
            found = np.sum(x * y, axis=1) / np.sqrt(xx * np.sum(y * y, axis=1))
            varies = xx > VARIES**2 * np.sum(moves**2, axis=1)
        return np.where(varies & (count >= max(FEWEST, 0.5 * len(self.values))), found, np.nan)


def _telling(windows: Windows, source: Series, account: Account, lag_s: float) -> float:
    """Estimate the number of independent windows.

    Only windows that do not overlap are counted. Windows have less weight if residuals persist from one
    window to the next, as those due to a lever arm do; the reduction follows from a first-order
    autoregression.
    """
    span_s = float(np.median(windows.end_s - windows.begin_s))
    _, first = np.unique(np.floor(windows.begin_s / span_s), return_index=True)
    begin_s, end_s = windows.begin_s[first] - lag_s, windows.end_s[first] - lag_s
    moves = account(source, source.integral(end_s) - source.integral(begin_s))
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
