"""Checks of angles: turn rates, courses and headings, and the mounting of inertial units."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from fuselog.recorders.checks.body import Floats, Series
from fuselog.recorders.checks.finding import Finding, digits
from fuselog.recorders.checks.motion import BodyMotion, Slope
from fuselog.recorders.checks.windows import FEWEST, pairs
from fuselog.recorders.models.orientation import compose, conjugate
from fuselog.recorders.models.planar import wrap_angle
from fuselog.recorders.units import STANDARD_GRAVITY_MPS2

NEAR_DEGREES = 0.1
TOO_FAST_RADPS = 35.0
BACKWARDS_RAD = 2.6
HALF = 0.5  # slope, above which a mirror image is one
CLEARER = 1.5  # ratio by which forces must fit better than their mirror image
FITS = 0.9
SMALL_RAD, STEADY_RAD, SURE = (
    0.05,
    0.25,
    6.0,
)  # of heading minus course: mean, spread and standard errors
TURNED_RAD = np.radians(20.0)
BETTER = 3.0  # times closer to the turn rates
TURNS_RADPS = 0.05
UNIT_TOLERANCE = 1e-3
NORM_G, NORM_MILLI = (0.9, 1.1), (930.0, 1030.0)
LARGEST_SHARE = 0.9


def signs(motion: BodyMotion) -> Iterator[Finding]:
    """Find turn rates, courses or headings that turn opposite to all other topics."""
    orientations = motion.body.orientations
    orientation = orientations[0] if orientations else None
    beside = motion.heading_course(orientation) if orientation else None
    headed = beside.sign if beside else 0
    for source in motion.body.turns:
        if hangs(motion, source.topic):
            continue  # reported by `gravity`
        ratio = motion.turn(source)
        course = ratio.sign if ratio else 0
        heading = motion.heading_turn(orientation, source).sign if orientation else 0
        if course < 0 and ratio and (abs(ratio.value) > HALF or _is_degrees(ratio)):
            assert motion.courses is not None
            yield from _mirrored(motion, source, ratio, witness=heading or _by_forces(motion, source))
        elif orientation and heading < 0 and (course > 0 or headed < 0):
            yield _compass(orientation, f"{source.topic} and the course turn")
        elif orientation and heading < 0 and headed > 0:
            yield _sign(source, f"{orientation.topic} and the course turn in the opposite direction")
    if orientation and headed < 0 and not motion.body.turns:
        yield _compass(orientation, "the course turns")


def _by_forces(motion: BodyMotion, source: Series) -> int:
    """Test by forces whether a frame is mirrored (1) or the rate is wrong (-1); 0 if undecided."""
    for force in motion.body.forces:
        if force.topic == source.topic:
            found = motion.forces(motion.aligned(force))
            if found and max(found.fit, found.mirrored) > FITS:
                return 1 if found.mirrored > found.fit else -1
    return 0


def _mirrored(motion: BodyMotion, source: Series, ratio: Slope, witness: int) -> Iterator[Finding]:
    """Report a mirrored frame if another sensor confirms the rate (`witness` > 0), else a wrong sign."""
    assert motion.courses is not None
    course = motion.courses
    evidence = f"the course of {course.topic} turns {ratio.value:.3g} rad per rad of this turn rate"
    if witness > 0:
        field = course.field
        yield Finding(
            "sign",
            course.topic,
            field,
            -1.0,
            f"{course.topic}: its frame is mirrored, as when east and north are swapped: the course "
            f"turns {ratio.value:.3g} rad for each rad of {source.topic}, which another sensor confirms",
            otherwise=f"in the mapping swap the columns of {field}",
        )
        return
    unless = "" if witness else f", unless the frame of {course.topic} has east and north swapped"
    yield _sign(source, evidence + unless)


def _sign(source: Series, evidence: str) -> Finding:
    what = source.field.rpartition("_")[0]
    what = f"{what}_z" if what == "turn_rate" else what
    return Finding(
        "sign",
        source.topic,
        source.field,
        -1.0,
        f"{source.topic}: {source.field} has the wrong sign, anticlockwise from above is positive: "
        f"{evidence}",
        f"{source.topic}.{what}_scale=-1",
        f"factors.{source.field} = -1 in the mapping",
    )


def _compass(orientation: Series, others: str) -> Finding:
    return Finding(
        "sign",
        orientation.topic,
        orientation.field,
        -1.0,
        f"{orientation.topic}: its heading is clockwise, as a compass's, but ours is anticlockwise "
        f"from east: {others} in the opposite direction",
        otherwise="in the mapping derive it from attitude = { heading = ... }",
    )


def degrees(motion: BodyMotion) -> Iterator[Finding]:
    """Find turn rates in deg/s, or converted from deg/s by mistake, from the course or their size."""
    for source in motion.body.turns:
        ratio = motion.turn(source)
        rates = np.abs(
            next((each for each in motion.body.rates if each.topic == source.topic), source).values
        )
        if ratio and ratio.sign and _is_degrees(ratio):
            assert motion.courses is not None
            evidence = f"the course of {motion.courses.topic} turns {ratio.value:.3g} rad per unit of it"
            is_large = abs(ratio.value) < 1.0
        elif not (ratio and ratio.sign) and np.mean(rates > TOO_FAST_RADPS) > 1e-3:
            evidence, is_large = f"in rad/s it would be up to {rates.max():.3g}", True
        else:
            continue
        what = source.field.rpartition("_")[0]
        given, factor = ("deg/s", np.pi / 180.0) if is_large else ("rad/s", 180.0 / np.pi)
        taken = "in deg/s" if is_large else "in rad/s, read as deg/s"
        yield Finding(
            "unit",
            source.topic,
            source.field,
            1.0 / factor,
            f"{source.topic}: {source.field} is {taken}: {evidence}",
            f"{source.topic}.{what}_scale={digits(factor)}",
            f'units.{source.field} = "{given}" in the mapping',
        )


def _is_degrees(ratio: Slope) -> bool:
    return any(
        abs(abs(ratio.value) / each - 1.0) < NEAR_DEGREES for each in (np.pi / 180.0, 180.0 / np.pi)
    )


def headings(motion: BodyMotion) -> Iterator[Finding]:
    """Find headings with a constant offset from the course, if the body moves the way it points."""
    for orientation in motion.body.orientations:
        ratio = motion.heading_course(orientation)
        offsets = motion.heading_offsets(orientation)
        if ratio is None or ratio.sign < 1 or len(offsets) < FEWEST:
            continue
        mean = float(np.angle(np.mean(np.exp(1j * offsets))))
        rest = wrap_angle(offsets - mean)
        spread = float(np.std(rest))
        error = spread / np.sqrt(len(rest) / 4.0)  # windows overlap
        is_backwards = abs(mean) > BACKWARDS_RAD  # or the wheels' sign is wrong
        if abs(mean) > max(SMALL_RAD, SURE * error) and spread < STEADY_RAD:
            yield Finding(
                "mounting",
                orientation.topic,
                orientation.field,
                mean,
                f"{orientation.topic}: its heading is {np.degrees(mean):.3g} deg anticlockwise of the "
                f"course ({len(rest)} windows, spread {np.degrees(spread):.2g} deg): because of the "
                "sensor's mounting, or of magnetic "
                f"north{', or of a wrong sign of speeds' * is_backwards}",
                otherwise="in the mapping rotate it by mounting_deg"
                f"{', or change the sign of the speeds with `factors`' * is_backwards}",
            )


def mounting(motion: BodyMotion) -> Iterator[Finding]:
    """Find inertial units whose forward axis is not the body's, by forces in turns and accelerations."""
    for force in motion.body.forces:
        found = motion.forces(motion.aligned(force))
        if (
            found
            and found.fit > max(FITS, CLEARER * found.mirrored)
            and abs(found.angle_rad) > TURNED_RAD
        ):
            angle = np.degrees(found.angle_rad)
            yield Finding(
                "mounting",
                force.topic,
                force.field,
                found.angle_rad,
                f"{force.topic}: it is mounted rotated about the vertical: its horizontal forces match "
                f"the course if rotated by {angle:.3g} deg (fit {found.fit:.2f} of 1)",
                otherwise=f"mounting_deg = [0, 0, {round(angle)}] in the mapping",
            )


def gravity(motion: BodyMotion) -> Iterator[Finding]:
    """Find forces in g, or with z down, from the mean force in the quietest second."""
    for force in motion.body.forces:
        mean = quietest(force)
        if mean is None:
            continue
        norm = float(np.linalg.norm(mean))
        scale, given = 1.0, ""
        if NORM_G[0] <= norm <= NORM_G[1]:
            scale, given = STANDARD_GRAVITY_MPS2, "g"
        elif NORM_MILLI[0] <= norm <= NORM_MILLI[1]:
            is_milli = abs(norm - 1000.0) < abs(norm - 980.665)
            scale, given = (1e-3 * STANDARD_GRAVITY_MPS2, "mg") if is_milli else (0.01, "cm/s^2")
        if given:
            yield Finding(
                "gravity",
                force.topic,
                force.field,
                1.0 / scale,
                f"{force.topic}: {force.field} is in {given}: at rest its length is {norm:.4g}",
                f"{force.topic}.specific_force_scale={digits(scale)}",
                f'units.{force.field} = "{given}" in the mapping',
            )
        moves = motion.places is not None or motion.courses is not None
        if not moves or not _is_z_down(force):
            continue
        is_down = hangs(motion, force.topic)
        either = "" if is_down else ", or its forces have the wrong sign"
        also = ", and its turn rate is opposite to that of the course" if is_down else ""
        what, more = (
            ("turn_rate", ", which rotates the forces too") if is_down else ("specific_force", "")
        )
        yield Finding(
            "gravity",
            force.topic,
            force.field,
            -1.0,
            f"{force.topic}: its z axis is down{either}: at rest the force along z is {mean[2]:.4g}, "
            f"but specific force should point up{also}",
            f"{force.topic}.{what}_z_scale=-1",
            f"mounting_deg = [180, 0, 0] in the mapping{more}, if its axes are forward, right, down",
        )


def hangs(motion: BodyMotion, topic: str) -> bool:
    """Test by force, turn rate and course whether a unit is upside down."""
    turns = next((each for each in motion.body.turns if each.topic == topic), None)
    if turns is None or not any(_is_z_down(each) for each in motion.body.forces if each.topic == topic):
        return False
    ratio = motion.turn(turns)
    return ratio is not None and ratio.sign < 0


def _is_z_down(force: Series) -> bool:
    if np.median(force.values[:, 2]) >= 0.0:
        return False
    mean = quietest(force)
    return mean is not None and bool(mean[2] < -LARGEST_SHARE * np.linalg.norm(mean))


def quietest(force: Series) -> Floats | None:
    """Average forces (3,) in the second in which they vary least; return None without a full second."""
    second = np.floor(force.times_s - force.times_s[0]).astype(int)
    edges = np.flatnonzero(np.diff(second, prepend=-1, append=second[-1] + 1))
    parts = [force.values[begin:end] for begin, end in pairwise(edges) if end - begin >= 10]
    if not parts:
        return None
    return np.asarray(min(parts, key=lambda part: float(part.var(axis=0).sum())).mean(axis=0))


ORDERS = {
    "w, x, y, z": ([0, 1, 2, 3], False),
    "x, y, z, w": ([3, 0, 1, 2], False),
    "w, x, y, z of the opposite rotation": ([0, 1, 2, 3], True),
    "x, y, z, w of the opposite rotation": ([3, 0, 1, 2], True),
}


def quaternions(motion: BodyMotion) -> Iterator[Finding]:
    """Find quaternions that are not of unit length or, compared with turn rates, in another order."""
    for orientation in (*motion.body.orientations, *motion.body.references):
        norm = np.linalg.norm(orientation.values, axis=1)
        off = float(np.median(np.abs(norm - 1.0)))
        if off > UNIT_TOLERANCE:
            yield Finding(
                "quaternion",
                orientation.topic,
                orientation.field,
                off,
                f"{orientation.topic}: its quaternions are not of unit length: half of their lengths "
                f"differ from 1 by {off:.3g} or more",
                otherwise="normalise them where the log is written",
            )
            continue
        rates = next(iter(motion.body.rates), None)
        if rates is None:
            continue
        errors = rate_errors(orientation, rates)
        if not errors:
            continue
        stated = next(iter(ORDERS))
        if any(_is_z_down(each) for each in motion.body.forces if each.topic == rates.topic):
            for half_turn in ([1, -1, -1], [-1, 1, -1]):  # of the unit, not of the orientations
                turned = replace(rates, values=rates.values * half_turn)
                errors[stated] = min(errors[stated], rate_errors(orientation, turned)[stated])
        best = min(errors, key=lambda each: errors[each])
        if BETTER * errors[best] < errors[stated]:
            yield Finding(
                "quaternion",
                orientation.topic,
                orientation.field,
                errors[stated] / errors[best],
                f"{orientation.topic}: its quaternions are {best}, read as {stated}: then they turn "
                "like "
                f"{rates.topic} to within {errors[best]:.2g} rad/s, as read {errors[stated]:.2g} rad/s",
                otherwise="in the mapping name its four columns in the order w, x, y, z",
            )


def rate_errors(orientation: Series, rates: Series) -> dict[str, float]:
    """Compare quaternions with turn rates: return rms differences (rad/s) by order; {} without turns."""
    first, second = pairs(orientation.times_s, 0.1)
    begin_s, end_s = orientation.times_s[first], orientation.times_s[second]
    duration_s = (end_s - begin_s)[:, None]
    rate = (rates.integral(end_s) - rates.integral(begin_s)) / duration_s
    known = np.isfinite(rate).all(axis=1)
    if known.sum() < FEWEST or np.sqrt(np.mean(rate[known] ** 2)) < TURNS_RADPS:
        return {}
    found = {}
    for name, (order, is_opposite) in ORDERS.items():
        q = orientation.values[:, order]
        q = conjugate(q) if is_opposite else q
        step = compose(conjugate(q[first]), q[second])
        turned = 2.0 * step[:, 1:] * np.sign(step[:, :1] + 1e-300) / duration_s
        found[name] = float(np.sqrt(np.mean(np.sum((turned - rate)[known] ** 2, axis=1))))
    return found
