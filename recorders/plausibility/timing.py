"""Finds when a topic's account of a motion is most like another's: by delay, and clock's gain."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fuselog.recorders.plausibility.body import Floats, Series
from fuselog.recorders.plausibility.windows import FEWEST, Windows, thinned

Account = Callable[[Series, Floats, Floats], Floats]  # of windows, from their begin to their end
LONGEST_S, STEP_S, FINE_S = 30.0, 0.1, 0.01
GAINS = np.linspace(-0.1, 0.1, 41)
FEW = 100  # windows at least by which a lag or a clock is sought: more of them overlap by half
NEAR_S = 1.0  # a lag within it is as likely as all that are longer


class Timing(NamedTuple):
    """Says how a source fits windows in time.

    Attributes:
        lag_s: the windows are later than the source by so much.
        gain: so many seconds a second the clock of the source gains.
        likeness: the correlation there, -1 to 1.
        evidence: by how much the log-likelihood exceeds that without lag and gain.
        tolerance_s: up to which a lag counts as none.
    """

    lag_s: float
    gain: float
    likeness: float
    evidence: float
    tolerance_s: float


def timing(windows: Windows, source: Series, account: Account, *, tolerance_s: float) -> Timing | None:
    """Return the lag, and gain, of the best correlation; None where too few windows can tell."""
    if len(windows) < FEWEST or not np.ptp(windows.values):
        return None
    count = _independent(windows)
    lags_s = np.arange(-LONGEST_S, LONGEST_S + 0.5 * STEP_S, STEP_S)
    few = windows.take(thinned(len(windows), max(FEW, 2 * count)))
    coarse = _likeness(few, source, account, lags_s)
    if not np.isfinite(coarse).any():
        return None
    best_s = float(lags_s[np.nanargmax(np.abs(coarse))])
    fine_s = best_s + np.arange(-STEP_S, STEP_S + 0.5 * FINE_S, FINE_S)
    near = _likeness(windows, source, account, fine_s)
    if not np.isfinite(near).any():  # at an end of the lags, where all windows are too few
        return None
    best = int(np.nanargmax(np.abs(near)))
    lag_s, likeness = float(fine_s[best]), float(near[best])
    gain, gained_s, gained = _gained(few, source, account)
    if _evidence(count, gained, likeness) > max(10.0, 0.05 * count) and abs(gain) > 0.005:
        lag_s, likeness = gained_s, gained
    else:
        gain = 0.0
    zero_s = np.arange(-tolerance_s, tolerance_s + 0.5 * FINE_S, max(FINE_S, tolerance_s / 10.0))
    without = _likeness(windows, source, account, zero_s)
    usual = float(np.nanmax(np.abs(without))) if np.isfinite(without).any() else 0.0
    evidence = _evidence(count * _share_within(windows, source, lag_s), likeness, usual)
    if abs(lag_s) > NEAR_S:  # some lag of so many is the best by chance
        evidence -= float(np.log(len(lags_s)))
    return Timing(lag_s, gain, likeness, evidence, tolerance_s)


def _gained(windows: Windows, source: Series, account: Account) -> tuple[float, float, float]:
    """Find the gain of the source's clock, the lag then and their likeness."""
    lags_s = np.arange(-10.0, 10.0, 0.2)
    best = (0.0, 0.0, 0.0)
    for gain in GAINS:
        found = _likeness(windows, source.moved(0.0, gain), account, lags_s)
        if np.isfinite(found).any():
            place = int(np.nanargmax(np.abs(found)))
            if abs(found[place]) > abs(best[2]):
                best = float(gain), float(lags_s[place]), float(found[place])
    return best


def _likeness(windows: Windows, source: Series, account: Account, lags_s: Floats) -> Floats:
    """Correlate at each lag; NaN where less than half of the windows are in the source's span."""
    begin_s, end_s = (each - lags_s[:, None] for each in (windows.begin_s, windows.end_s))
    moves = account(source, begin_s, end_s)
    is_in = np.isfinite(moves)
    count = is_in.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y = np.where(is_in, moves, 0.0), np.where(is_in, windows.values, 0.0)
        x = np.where(is_in, x - (x.sum(axis=1) / count)[:, None], 0.0)
        y = np.where(is_in, y - (y.sum(axis=1) / count)[:, None], 0.0)
        found = np.sum(x * y, axis=1) / np.sqrt(np.sum(x * x, axis=1) * np.sum(y * y, axis=1))
    return np.where(count >= max(FEWEST, 0.5 * len(windows)), found, np.nan)


def _share_within(windows: Windows, source: Series, lag_s: float) -> float:
    """Compute the share of windows in the source's span when they are earlier by the lag."""
    is_within = (windows.begin_s - lag_s >= source.times_s[0]) & (
        windows.end_s - lag_s <= source.times_s[-1]
    )
    return float(is_within.mean())


def _independent(windows: Windows) -> int:
    """Count the windows that do not overlap."""
    span_s = float(np.median(windows.end_s - windows.begin_s))
    return len(np.unique(np.floor(windows.begin_s / span_s)))


def _evidence(count: float, likeness: float, usual: float) -> float:
    """Compute how much likelier one correlation is than another, of so many Gaussian pairs."""
    rest, before = (max(1.0 - each * each, 1e-9) for each in (likeness, usual))
    return 0.5 * count * float(np.log(before / rest))
