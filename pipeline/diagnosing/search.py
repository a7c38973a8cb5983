"""Search for the values at which correcting a fault gains most, for all faults in parallel.

A search is a generator that yields values, receives their gains, and returns its `Peak`. Thus one replay
can compute the gains of the next values of all faults.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis, Number
from fuselog.pipeline.optimise import Search

Gains = Callable[[Sequence[Number]], Sequence[float]]  # most evaluations of a search for one value
ROUNDS = 14  # most evaluations of a refinement
NEAR = 1e-5  # accuracy of a peak in log-likelihood
CLEAR = 0.05  # the same for a peak of several values
# accuracy relative to the distance from the largest peak; a distant peak can be less accurate
FAR = 0.02
GRID = 49  # values over the whole range, among which another maximum is searched for
WIDE = 4.0  # factor on the gain that a parabola predicts, a generous bound
NUMBER_COST = 3.0  # cost in log-likelihood of each estimated value


class Peak(NamedTuple):
    """The value at which the gain of a fault is largest, and that gain.

    `is_special` states whether the value is one of the fault's special values.
    """

    value: Number
    gain: float
    is_special: bool = False

    def score(self, of: Hypothesis) -> float:
        """Compute the gain minus the cost of each estimated value."""
        is_free = of.tried and not self.is_special
        return self.gain - (NUMBER_COST * of.size if is_free else 0.0)


def peak(
    of: Hypothesis, floor: float, greatest: Callable[[], float] = lambda: 0.0
) -> Search[Number, Peak]:
    """Search for the largest gain of a fault.

    Args:
        of: the fault, whose gain is zero at the value zero.
        floor: a gain below which a search is not worthwhile.
        greatest: function that returns the largest known gain of any fault. Distant values are tried
            only if this gain, or the gain at a near or special value, is large enough.
    """
    if of.size > 1:
        return (yield from _of_several(of, floor, greatest))
    near, far = of.tried[:2], [value for value in of.tried[2:] if value not in of.specials]
    asked = [*of.specials, *near]
    known: dict[float, float] = dict(zip(asked, (yield asked), strict=True))
    special = max(of.specials, key=lambda value: known[value], default=None)
    best = Peak(special, known[special], is_special=True) if special is not None else Peak(0.0, 0.0)
    if not of.tried:
        return best
    known[0.0] = 0.0
    is_flat = max(known.values()) < 0.5 * floor and _by_parabola(known, near) < 0.5 * floor
    if is_flat and greatest() < floor:  # and there is no other fault
        return Peak(0.0, 0.0)
    known.update(zip(far, (yield far), strict=True))
    if max(known.values()) < 0.5 * floor and _by_parabola(known, near) < 0.5 * floor:
        return Peak(0.0, 0.0)  # a smooth function with its maximum about here
    before = -np.inf
    for _ in range(ROUNDS):
        now = max(known.values())
        enough = NEAR + FAR * max(greatest() - now, 0.0)
        values = _next(known, of.limit)
        if not values or (now - before < enough and _promised(known) < enough):
            break
        before = now
        known.update(zip(values, (yield values), strict=True))
    value = max(known, key=lambda each: known[each])
    free = Peak(value, known[value])
    return max(best, free, key=lambda each: each.score(of))


def _around(known: Mapping[float, float]) -> tuple[float, float, float] | None:
    """Return the value with the largest gain and its neighbours; None if a neighbour is missing."""
    values = sorted(known)
    place = max(range(len(values)), key=lambda place: known[values[place]])
    if place in (0, len(values) - 1):
        return None
    return values[place - 1], values[place], values[place + 1]


def _vertex(known: Mapping[float, float], low: float, best: float, high: float) -> float | None:
    """Find the maximum of the parabola through three values, or None if a gain is infinite."""
    left, right = known[best] - known[low], known[best] - known[high]
    if not np.isfinite(left + right) or left + right <= 0.0:
        return None
    a, b = best - low, high - best
    bend, slope = left / a + right / b, left * b / a - right * a / b
    return best + 0.5 * slope / bend if bend > 0.0 else None


def _promised(known: Mapping[float, float]) -> float:
    """Compute by how much the maximum of the parabola around the largest gain exceeds that gain."""
    around = _around(known)
    if around is None:
        return np.inf
    low, best, high = around
    at = _vertex(known, low, best, high)
    if at is None:
        return np.inf
    side = low if at < best else high
    # the parabola with this vertex, through the best value and its neighbour on the vertex's side
    share = (at - best) / (side - best)
    drop = known[best] - known[side]
    return float(drop * share**2 / (1.0 - 2.0 * share)) if 2.0 * share < 1.0 else np.inf


def _next(known: Mapping[float, float], limit: float) -> list[float]:
    """Choose the next values: around the best value or, if that value is at an end, beyond it."""
    around = _around(known)
    if around is None:
        best = max(known, key=lambda value: known[value])
        values = [float(np.clip(step * best, -limit, limit)) for step in (1.5, 3.0)]
    else:
        low, best, high = around
        middles = [0.5 * (low + best), 0.5 * (best + high)]
        at = _vertex(known, low, best, high)
        if at is None:
            values = middles
        else:
            apart = 0.25 * min(best - low, high - best) + 0.5 * abs(at - best)
            near = [at, at - apart, at + apart]
            values = [*near, *middles] if _is_lopsided(low, best, high) else near
        values = [value for value in values if low < value < high]
    return [value for value in dict.fromkeys(values) if value not in known]


def _is_lopsided(low: float, best: float, high: float) -> bool:
    """Test whether a bracket is too asymmetric for a parabola."""
    return max(best - low, high - best) > 8.0 * min(best - low, high - best)


def _by_parabola(known: Mapping[float, float], sides: Sequence[float]) -> float:
    """Compute the maximum of the parabola through zero and both sides, or infinity if it has none."""
    if len(sides) < 2 or sides[0] * sides[1] >= 0.0:
        return np.inf
    low, high = sorted(sides)
    gains = np.array([known[low], known[high]])
    if not gains.any():  # the value has no effect
        return 0.0
    if not np.isfinite(gains).all():
        return np.inf
    (bend, slope) = np.linalg.solve([[low**2, low], [high**2, high]], gains)
    return float(-(slope**2) / (4.0 * bend)) if bend < 0.0 else np.inf


def _of_several(of: Hypothesis, floor: float, greatest: Callable[[], float]) -> Search[Number, Peak]:
    """Search for several values with repeated paraboloids around the best values.

    The gain of a diverging filter is rough and has no paraboloid. Without a paraboloid, the best
    evaluated point is used, and the steps around it are reduced.
    """
    size, steps = of.size, np.array(of.tried[0])
    at, gain = np.zeros(size), 0.0
    is_rough, is_scaled = False, False
    for _ in range(ROUNDS):
        pairs = [(row, column) for row in range(size) for column in range(row)]
        units = np.diag(steps)
        asked = [*(at + each for each in units), *(at - each for each in units)]
        asked += [at + units[row] + units[column] for row, column in pairs]
        gains = np.array((yield [tuple(map(float, each)) for each in asked])) - gain
        if not np.isfinite(gains).all():
            break
        ahead, behind, both = np.split(gains, [size, 2 * size])
        slope, bend = 0.5 * (ahead - behind), np.diag(ahead + behind)
        for (row, column), value in zip(pairs, both, strict=True):
            bend[row, column] = bend[column, row] = value - ahead[row] - ahead[column]
        values, vectors = np.linalg.eigh(bend)
        along = vectors.T @ slope
        share = np.where(values < 0.0, along / np.maximum(-values, 1e-12), np.sign(along) * 4.0)
        move = vectors @ np.clip(share, -100.0, 100.0) * steps
        [found] = yield [tuple(map(float, at + move))]
        best = int(np.argmax(gains))
        if found < gain + gains[best]:
            found, move, is_rough = gain + gains[best], np.subtract(asked[best], at), True
        if found <= gain and is_rough:  # there is no parabola of this width
            steps, is_rough = 0.2 * steps, False
            continue
        if found <= gain:
            break
        improved, at, gain = found - gain, at + move, found
        if gain < 0.5 * floor or improved < max(CLEAR, FAR * (greatest() - gain)):
            break
        if not (is_rough or is_scaled):
            is_scaled = True
            with np.errstate(divide="ignore"):
                wide = np.sqrt(2.0 / np.maximum(-np.diag(bend), 1e-12)) * steps
            steps = np.minimum(steps, np.where(np.isfinite(wide), wide, steps))
    return Peak(tuple(map(float, at)), gain) if gain > 0.0 else Peak((0.0,) * size, 0.0)


def rival(of: Hypothesis, at: Peak, least: float) -> Search[Number, Peak | None]:
    """Search for another value of a fault that gains at least `least`; None if there is no such value.

    The rival value is another local maximum, for example of a delay on laps of equal length.
    """
    values = np.linspace(-of.limit, of.limit, GRID).tolist()
    known = dict(zip(values, (yield values), strict=True)) | {at.value: at.gain}
    values = sorted(known)
    tops = [
        (low, best, high)
        for low, best, high in zip(values, values[1:], values[2:], strict=False)
        if known[best] >= max(known[low], known[high]) and at.value not in (low, best, high)
    ]
    if not tops:
        return None
    top = {value: known[value] for value in max(tops, key=lambda each: known[each[1]])}
    before = -np.inf
    for _ in range(ROUNDS):
        now, promised = max(top.values()), _promised(top)
        if now + WIDE * promised < least or (now - before < NEAR and promised < NEAR):
            break
        before, asked = now, _next(top, of.limit)
        if not asked:
            break
        top.update(zip(asked, (yield asked), strict=True))
    value = max(top, key=lambda each: top[each])
    return Peak(value, top[value]) if top[value] >= least else None
