"""Checks of the timing of topics, and of the distances that the topics imply."""

from collections.abc import Iterator
from itertools import chain

import numpy as np

from fuselog.recorders.checks.body import Floats, PlaceSeries, Series
from fuselog.recorders.checks.finding import Finding, digits
from fuselog.recorders.checks.motion import LONG_S, BodyMotion
from fuselog.recorders.checks.windows import JUMP, jumps, travelled
from fuselog.recorders.units import mistaken

NEAR = 0.05  # tolerance of a factor
SCALE = (0.8, 1.25)  # acceptable motion of positions per metre of a speed
SPREAD = 0.25
LEAP_S = {18.0: "GPS time has been 18 s ahead of UTC since 2017"}
LEAP_TOLERANCE_S = 0.6
LEAPED = 2.0  # times the motion between nearly all fixes: beyond it, the body may have moved
REST = 0.05  # share of the larger speeds
FEWEST_AT_REST = 10
TAIL_SIGMAS = 3.2905  # exceeded on each side by a Gaussian in 0.0005 of all cases
LEAST_RATIO = 1.5  # of variances: a difference that matters


def leaps(motion: BodyMotion) -> Iterator[Finding]:
    """Find positions that jump while a speed shows that the body moves as usual."""
    sources = [*motion.body.speeds, *motion.body.velocities]
    for fixes in motion.body.fixes:
        steps_m = np.linalg.norm(np.diff(fixes.values, axis=0), axis=1)
        variances_m2 = np.maximum(np.nan_to_num(fixes.variances_m2), 0.0)
        stated_m = np.sqrt(variances_m2[1:] + variances_m2[:-1])
        places = np.flatnonzero(jumps(fixes) & (steps_m > JUMP * stated_m))
        source = next((each for each in sources if each.topic != fixes.topic), None)
        if source is None or not len(places):
            continue
        moved = travelled(source, fixes.times_s[:-1], fixes.times_s[1:])
        with np.errstate(invalid="ignore"):
            is_jump = moved[places] <= LEAPED * np.nanquantile(moved, 0.95)
        if not is_jump.all():
            continue
        lengths_m = steps_m[places]
        largest = int(np.argmax(lengths_m))
        at_s = fixes.times_s[1:][places]
        times = f"{len(places)} times, from {at_s[0]:.1f} s to {at_s[-1]:.1f} s, "
        yield Finding(
            "place",
            fixes.topic,
            fixes.field,
            float(lengths_m[largest]),
            f"{fixes.topic}: its position jumps {times if len(places) > 1 else ''}by up to "
            f"{lengths_m[largest]:.3g} m at {at_s[largest]:.1f} s, while {source.topic} moves "
            f"{moved[places][largest]:.2g} m",
            otherwise="cut these messages out, or keep a gate (gate_probability) that rejects them",
        )


def delays(motion: BodyMotion) -> Iterator[Finding]:
    """Find topics with later stamps than others of the same body, by the lags of speeds and turns."""
    for topic, late_s in motion.delays_s.items():
        if not late_s:
            continue
        lag = next(
            each
            for each in (*motion.speed_lags, *motion.turn_lags)
            if topic in (each.source, each.against)
        )
        # with a lever arm or slip, the course may change before or after the heading
        slips = lag in motion.turn_lags and not motion.goes_where_it_points(lag)
        spread_s = max(lag.timing.spread_s, LONG_S if slips else 0.0)
        leap_s = next((s for s in LEAP_S if abs(abs(late_s) - s) < LEAP_TOLERANCE_S), None)
        value = late_s if leap_s is None else float(np.copysign(leap_s, late_s))
        why = "" if leap_s is None else f", and {LEAP_S[leap_s]}"
        yield Finding(
            "delay",
            topic,
            "",
            value,
            f"{topic}: its stamps are {abs(value):.3g} s {'late' if value > 0 else 'early'}, "
            f"give or take {spread_s:.2g} s: the motion of {lag.source} is most like that of "
            f"{lag.against} (correlation {abs(lag.timing.likeness):.3f}) so{why}",
            f"{topic}.delay_s={digits(value)}",
        )


def clocks(motion: BodyMotion) -> Iterator[Finding]:
    """Find clocks that run faster or slower than others, from the growing lag between two speeds."""
    for topic, gain in motion.gains.items():
        against = next(each.against for each in motion.speed_lags if each.source == topic)
        yield Finding(
            "clock drift",
            topic,
            "",
            gain,
            f"{topic}: its clock {'gains' if gain > 0 else 'loses'} {100 * abs(gain):.2g} s in 100 s on "
            f"that of {against}: only then do their speeds agree",
            f"{topic}.clock_gain={digits(gain)}",
        )


def factors(motion: BodyMotion) -> Iterator[Finding]:
    """Find speeds in wrong units, by comparison with how far positions move."""
    for source in chain(motion.body.speeds, motion.body.velocities):
        ratio = motion.speed(source)
        if ratio is None or not ratio.sign or ratio.spread > SPREAD or SCALE[0] < ratio.value < SCALE[1]:
            continue
        assert motion.places is not None
        known = {power: name for name, by in mistaken("m/s").items() for power in (by, 1.0 / by)}
        nearest = min(known, key=lambda each: abs(np.log(each * ratio.value)))
        is_unit = abs(np.log(nearest * ratio.value)) < NEAR
        factor = nearest if is_unit else 1.0 / ratio.value
        of = f"{source.topic}: {source.field}"
        moved = (
            f"{motion.places.topic} moves {ratio.value:.4g} m for each metre of it "
            f"(in {ratio.windows} windows)"
        )
        if not is_unit:
            what, mapping = f"is {factor:.3g} times the correct value", ""
        elif factor > 1.0:
            what = f"is {factor:.4g} times too large, as when {known[nearest]} are read as m/s"
            mapping = f'units.{source.field} = "{known[nearest]}" in the mapping'
        else:
            what = f"is {1 / factor:.4g} times too small, as when m/s are read as {known[nearest]}"
            mapping = f'units.{source.field} = "m/s" in the mapping'
        yield Finding(
            "unit" if is_unit else "scale",
            source.topic,
            source.field,
            factor,
            f"{of} {what}: {moved}",
            f"{source.topic}.{source.field.rpartition('_')[0]}_scale={digits(1.0 / factor)}",
            mapping,
        )


def rest(motion: BodyMotion) -> Iterator[Finding]:
    """Find variances that contradict the scatter of a stationary body's fixes, if errors are white."""
    moving = [*motion.body.speeds, *motion.body.velocities]
    for fixes in motion.body.fixes:
        source = next((each for each in moving if each.topic != fixes.topic), None)
        if source is None:
            continue
        found = scatter(fixes, motion.aligned(source))
        if found is None:
            continue
        ratio, degrees, likeness = found
        low, high = (chance(degrees, sigmas) for sigmas in (-TAIL_SIGMAS, TAIL_SIGMAS))
        is_white = abs(likeness) < 2.5 / np.sqrt(degrees) + 2.0 / degrees
        if low < ratio < high or 1 / LEAST_RATIO < ratio < LEAST_RATIO or not is_white:
            continue
        yield Finding(
            "covariance",
            fixes.topic,
            "covariance_m2",
            ratio,
            f"{fixes.topic}: at rest its errors are white and have {ratio:.3g} times the stated "
            f"variance ({degrees // 2 + 1} fixes; {low:.2g} to {high:.2g} is chance)",
            f"{fixes.topic}.covariance_scale={digits(ratio)}",
        )


def scatter(fixes: PlaceSeries, source: Series) -> tuple[float, int, float] | None:
    """Compute the scatter of fixes while a speed shows that the body is stationary.

    Returns the variance as a multiple of the stated one, its degrees of freedom, and the correlation of
    successive errors. Returns None if the body is never stationary, or no variance is stated.
    """
    half_s = max(0.5, 2.0 * float(np.median(np.diff(source.times_s))))
    moved = source.integral(fixes.times_s + half_s) - source.integral(fixes.times_s - half_s)
    speed = (np.abs(moved) if moved.ndim == 1 else np.linalg.norm(moved, axis=1)) / (2.0 * half_s)
    # the first and last fixes are at the source's ends
    speed = _filled(speed)
    if not np.isfinite(speed).any():
        return None
    rests = speed < REST * np.quantile(speed, 0.95)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rests.astype(np.int8), [0]])))
    squares, degrees, next_ones = 0.0, 0, 0.0
    for begin, end in edges.reshape(-1, 2):
        stated = fixes.variances_m2[begin:end]
        if end - begin < FEWEST_AT_REST or not (stated > 0.0).all():
            continue
        place = fixes.values[begin:end]
        error = (place - np.average(place, axis=0, weights=1.0 / stated)) / np.sqrt(stated)[:, None]
        squares += float(np.sum(error**2))
        next_ones += float(np.sum(error[1:] * error[:-1]))
        degrees += 2 * (end - begin - 1)
    return (squares / degrees, degrees, next_ones / squares) if degrees and squares else None


def _filled(values: Floats) -> Floats:
    """Fill unknown values (n,) at the ends with the nearest known ones."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return values
    return values[np.clip(np.arange(len(values)), known[0], known[-1])]


def chance(degrees: int, sigmas: float) -> float:
    """Compute a quantile of chi-square, divided by its degrees of freedom, from a Gaussian's quantile.

    Wilson and Hilferty, PNAS 17, 1931: accurate to 2 % for at least 18 degrees of freedom.
    """
    part = 2.0 / (9.0 * degrees)
    return float((1.0 - part + sigmas * part**0.5) ** 3)
