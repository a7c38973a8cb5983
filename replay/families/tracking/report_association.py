"""Kernel of the report tracker: association of reports with tracks, and updates of the tracks."""

from typing import NamedTuple

import numpy as np

from fuselog.replay.engine.arrays import Floats, Integers, varying
from fuselog.replay.families.tracking.association.association import nearest
from fuselog.replay.families.tracking.association.clusters import AssociationMemory, Weights

LEVELS = 4


# Gain with which the usual interval of a track is updated by the observed intervals.
INTERVAL_GAIN = 0.2


# Pairs that are farther apart than this, in squared sigmas of the widest level, are ignored.
GATE = 60.0
NO_TRACK = -1


class ReportSettings(NamedTuple):
    """Parameters as the kernel reads them; parameters of the noise levels have the shape (LEVELS,)."""

    acceleration_density: Floats
    position_variance: Floats
    velocity_variance: Floats
    forgetting: float
    births: float
    resting_share: float
    usual_interval_s: float
    slow_mps: float
    course_width_rad: float
    top_speed_mps: float
    forget_s: float


@varying(2)
class Tracks(NamedTuple):
    """Tracks of all runs, with the axes run and place; the first `used` places are occupied.

    Attributes:
        used: (runs,); met: (runs,) number of all tracks so far, from which new tracks get their number.
        number, time_ns: (runs, places).
        mean: (runs, places, 4) x, vx, y, vy.
        spread: (runs, places, 3) variance of a position, covariance, variance of a velocity, per axis.
        weight: (runs, places, LEVELS).
        interval_s: (runs, places) usual time between reports.
        course_rad, speed_mps: (runs, places), last reported values.
        held: (runs, places, 2), how often a slow vessel repeated or changed its course; both counts
            start at 1.
    """

    used: Integers
    met: Integers
    number: Integers
    time_ns: Integers
    mean: Floats
    spread: Floats
    weight: Floats
    interval_s: Floats
    course_rad: Floats
    speed_mps: Floats
    held: Floats


class Reports(NamedTuple):
    """Reports of all runs in time order; each velocity (n, 2) has its own variance (n,).

    The variance is large if course or speed is unknown.
    """

    offsets: Integers
    time_ns: Integers
    position: Floats
    velocity: Floats
    velocity_variance: Floats
    course_rad: Floats
    speed_mps: Floats


class ReportInputs(NamedTuple):
    """Inputs of the tracker."""

    events: Reports
    settings: ReportSettings


class ReportResults(NamedTuple):
    """Output for every report: number of its track, mean (n, 4) and spread (n, 3)."""

    number: Integers
    mean: Floats
    spread: Floats


@varying(2)
class ReportMemory(NamedTuple):
    """Memory for associating the reports of one stamp.

    See `fuselog.replay.families.tracking.association.association`; rows are reports and columns are
    tracks. A report that is `missed` by all tracks begins a new one.
    """

    weights: Weights
    probability: Floats
    association: AssociationMemory


def widened(spread: Floats, density: float, duration_s: float) -> tuple[float, float, float]:
    """Predict the spread of one axis with constant velocity and white acceleration.

    Args:
        spread: (3,), variance of the position, covariance, variance of the velocity.
        density: power spectral density of the acceleration, in m^2/s^3.
        duration_s: duration of the prediction.
    """
    return (
        spread[0]
        + duration_s * (2.0 * spread[1] + duration_s * (spread[2] + density * duration_s / 3.0)),
        spread[1] + duration_s * (spread[2] + density * duration_s / 2.0),
        spread[2] + density * duration_s,
    )


def reported(
    spread: Floats, level: int, duration_s: float, velocity_variance: float, settings: ReportSettings
) -> tuple[float, float, float]:
    """Predict the spread of one axis of a report, at one level of noise.

    Args:
        spread, duration_s: as for `widened`.
        level: the level, below `LEVELS`.
        velocity_variance: variance of the reported velocity, added to that of the level, in (m/s)^2.
        settings: settings with the noise of the levels.
    """
    a, b, c = widened(spread, settings.acceleration_density[level], duration_s)
    return (
        a + settings.position_variance[level],
        b,
        c + (settings.velocity_variance[level] + velocity_variance),
    )


def density_at(difference: tuple[float, float, float, float], a: float, b: float, c: float) -> float:
    """Compute the density at differences (x, vx, y, vy); each axis has the covariance (a, b; b, c)."""
    x, vx, y, vy = difference
    determinant = a * c - b * b
    squared = c * (x * x + y * y) - 2.0 * b * (x * vx + y * vy) + a * (vx * vx + vy * vy)
    return np.exp(-0.5 * squared / determinant) / (4.0 * np.pi**2 * determinant)


def differences(
    mean: Floats, position: Floats, velocity: Floats, duration_s: float
) -> tuple[float, float, float, float]:
    """Compute the difference (x, vx, y, vy) between a report and a track's prediction.

    Args:
        mean: mean of the track, (4,) x, vx, y, vy.
        position, velocity: reported values, (2,) in m and (2,) in m/s.
        duration_s: time from the track's last report to this one.
    """
    return (
        position[0] - mean[0] - duration_s * mean[1],
        velocity[0] - mean[1],
        position[1] - mean[2] - duration_s * mean[3],
        velocity[1] - mean[3],
    )


def mixed(weight: float, settings: ReportSettings) -> float:
    """Compute the predicted weight of a level at the next report."""
    return (1.0 - settings.forgetting) * weight + settings.forgetting / LEVELS


def is_held(course_rad: float, before_rad: float, settings: ReportSettings) -> bool:
    """Test whether a course repeats the previous one, or whether both courses are unavailable."""
    if np.isnan(course_rad) or np.isnan(before_rad):
        return np.isnan(course_rad) and np.isnan(before_rad)
    turned = abs((course_rad - before_rad + np.pi) % (2.0 * np.pi) - np.pi)
    return turned < settings.course_width_rad


def are_slow(tracks: Tracks, run: int, place: int, speed_mps: float, settings: ReportSettings) -> bool:
    """Test whether track and report are so slow that the course is a poor indicator of motion."""
    return speed_mps < settings.slow_mps and tracks.speed_mps[run, place] < settings.slow_mps


def birth_density(velocity: Floats, own_variance: float, settings: ReportSettings) -> float:
    """Compute the density of reports with this velocity from new vessels, per m^2, s and (m/s)^2.

    Args:
        velocity: reported velocity, (2,) in m/s.
        own_variance: variance of the reported velocity, in (m/s)^2.
        settings: settings with the rate of births and the speeds of vessels.
    """
    moving = 1.0 / (np.pi * settings.top_speed_mps**2)
    variance = settings.slow_mps**2 + own_variance
    squared = (velocity[0] ** 2 + velocity[1] ** 2) / variance
    resting = np.exp(-0.5 * squared) / (2.0 * np.pi * variance)
    share = settings.resting_share
    return settings.births * ((1.0 - share) * moving + share * resting)


def ratio_of(
    run: int, place: int, event: int, reports: Reports, tracks: Tracks, settings: ReportSettings
) -> float:
    """Compute how many times more likely a report is from a given track than from a new vessel."""
    duration_s = (reports.time_ns[event] - tracks.time_ns[run, place]) * 1e-9
    if duration_s <= 0.0:
        return 0.0
    difference = differences(
        tracks.mean[run, place], reports.position[event], reports.velocity[event], duration_s
    )
    spread = tracks.spread[run, place]
    widest, _, _ = widened(spread, settings.acceleration_density[LEVELS - 1], duration_s)
    widest += settings.position_variance[LEVELS - 1]
    if difference[0] ** 2 + difference[2] ** 2 > GATE * widest:
        return 0.0
    density = 0.0
    for level in range(LEVELS):
        a, b, c = reported(spread, level, duration_s, reports.velocity_variance[event], settings)
        weight = mixed(tracks.weight[run, place, level], settings)
        density += weight * density_at(difference, a, b, c)
    # the rate of reports rises during the first half of the usual interval, and falls after a long
    # silence
    usual_s = tracks.interval_s[run, place]
    density *= min(1.0, 2.0 * duration_s / usual_s) / (usual_s + duration_s)
    if are_slow(tracks, run, place, reports.speed_mps[event], settings):
        course_rad, before_rad = reports.course_rad[event], tracks.course_rad[run, place]
        held, turned = tracks.held[run, place, 0], tracks.held[run, place, 1]
        factor = turned / (held + turned)
        if is_held(course_rad, before_rad, settings):
            factor += np.pi / settings.course_width_rad * held / (held + turned)
        density *= factor
    born = birth_density(reports.velocity[event], reports.velocity_variance[event], settings)
    return density / born


def begin(run: int, event: int, reports: Reports, tracks: Tracks, settings: ReportSettings) -> int:
    """Begin a track with a report; return the index of the track."""
    place = tracks.used[run]
    tracks.used[run] = place + 1
    tracks.number[run, place] = tracks.met[run]
    tracks.met[run] += 1
    widest = LEVELS - 1
    for axis in range(2):
        tracks.mean[run, place, 2 * axis] = reports.position[event, axis]
        tracks.mean[run, place, 2 * axis + 1] = reports.velocity[event, axis]
        tracks.held[run, place, axis] = 1.0
    tracks.spread[run, place, 0] = settings.position_variance[widest]
    tracks.spread[run, place, 1] = 0.0
    tracks.spread[run, place, 2] = settings.velocity_variance[widest] + reports.velocity_variance[event]
    for level in range(LEVELS):
        tracks.weight[run, place, level] = 1.0 / LEVELS
    tracks.interval_s[run, place] = settings.usual_interval_s
    return place


def update(
    run: int, place: int, event: int, reports: Reports, tracks: Tracks, settings: ReportSettings
) -> None:
    """Update a track by a report."""
    duration_s = (reports.time_ns[event] - tracks.time_ns[run, place]) * 1e-9
    mean, spread = tracks.mean[run, place], tracks.spread[run, place]
    weight = tracks.weight[run, place]
    x, vx, y, vy = differences(mean, reports.position[event], reports.velocity[event], duration_s)
    total = 0.0
    for level in range(LEVELS):
        a, b, c = reported(spread, level, duration_s, reports.velocity_variance[event], settings)
        weight[level] = mixed(weight[level], settings) * density_at((x, vx, y, vy), a, b, c)
        total += weight[level]
    # means of the gains (4), of the posterior spreads (3) and of the squares of the moves (3)
    g11, g12, g21, g22 = 0.0, 0.0, 0.0, 0.0
    own_a, own_b, own_c = 0.0, 0.0, 0.0
    moved_a, moved_b, moved_c = 0.0, 0.0, 0.0
    for level in range(LEVELS):
        weight[level] /= total
        w = weight[level]
        a, b, c = widened(spread, settings.acceleration_density[level], duration_s)
        seen_a = a + settings.position_variance[level]
        seen_c = c + settings.velocity_variance[level] + reports.velocity_variance[event]
        determinant = seen_a * seen_c - b * b
        k11, k12 = (a * seen_c - b * b) / determinant, b * (seen_a - a) / determinant
        k21, k22 = b * (seen_c - c) / determinant, (c * seen_a - b * b) / determinant
        g11 += w * k11
        g12 += w * k12
        g21 += w * k21
        g22 += w * k22
        own_a += w * (a - k11 * a - k12 * b)
        own_b += w * (b - k11 * b - k12 * c)
        own_c += w * (c - k21 * b - k22 * c)
        move_x, move_y = k11 * x + k12 * vx, k11 * y + k12 * vy
        move_vx, move_vy = k21 * x + k22 * vx, k21 * y + k22 * vy
        moved_a += 0.5 * w * (move_x**2 + move_y**2)
        moved_b += 0.5 * w * (move_x * move_vx + move_y * move_vy)
        moved_c += 0.5 * w * (move_vx**2 + move_vy**2)
    move_x, move_y = g11 * x + g12 * vx, g11 * y + g12 * vy
    move_vx, move_vy = g21 * x + g22 * vx, g21 * y + g22 * vy
    spread[0] = own_a + moved_a - 0.5 * (move_x**2 + move_y**2)
    spread[1] = own_b + moved_b - 0.5 * (move_x * move_vx + move_y * move_vy)
    spread[2] = own_c + moved_c - 0.5 * (move_vx**2 + move_vy**2)
    mean[0] += duration_s * mean[1] + move_x
    mean[1] += move_vx
    mean[2] += duration_s * mean[3] + move_y
    mean[3] += move_vy
    tracks.interval_s[run, place] += INTERVAL_GAIN * (duration_s - tracks.interval_s[run, place])
    if are_slow(tracks, run, place, reports.speed_mps[event], settings):
        held = is_held(reports.course_rad[event], tracks.course_rad[run, place], settings)
        tracks.held[run, place, 0 if held else 1] += 1.0


def take_in(
    run: int,
    event: int,
    place: int,
    reports: Reports,
    tracks: Tracks,
    settings: ReportSettings,
    results: ReportResults,
) -> None:
    """Assign a report to an existing or a new track, and fill the result."""
    if place == NO_TRACK:
        place = begin(run, event, reports, tracks, settings)
    else:
        update(run, place, event, reports, tracks, settings)
    tracks.time_ns[run, place] = reports.time_ns[event]
    tracks.course_rad[run, place] = reports.course_rad[event]
    tracks.speed_mps[run, place] = reports.speed_mps[event]
    results.number[event] = tracks.number[run, place]
    results.mean[event] = tracks.mean[run, place]
    results.spread[event] = tracks.spread[run, place]


def forget(run: int, now_ns: int, tracks: Tracks, settings: ReportSettings) -> None:
    """Drop the tracks that have been silent for too long; the last track fills the gap."""
    place = 0
    while place < tracks.used[run]:
        if (now_ns - tracks.time_ns[run, place]) * 1e-9 <= settings.forget_s:
            place += 1
            continue
        last = tracks.used[run] - 1
        tracks.used[run] = last
        for whole in (tracks.number, tracks.time_ns):
            whole[run, place] = whole[run, last]
        for real in (tracks.interval_s, tracks.course_rad, tracks.speed_mps):
            real[run, place] = real[run, last]
        for vector in (tracks.mean, tracks.spread, tracks.weight, tracks.held):
            vector[run, place] = vector[run, last]


def track(
    run: int,
    first: int,
    end: int,
    inputs: ReportInputs,
    tracks: Tracks,
    results: ReportResults,
    memory: ReportMemory,
) -> bool:
    """Process the reports of one run and stamp, the most likely pair of report and track first."""
    (reports, settings), weights, probability = inputs, memory.weights, memory.probability
    count = end - first
    forget(run, reports.time_ns[first], tracks, settings)
    used = tracks.used[run]
    for row in range(count):
        weights.missed[row] = 1.0
        for place in range(used):
            ratio = ratio_of(run, place, first + row, reports, tracks, settings)
            weights.detected[row, place] = ratio
    nearest(weights, count, used, probability, memory.association)
    for row in range(count):
        chosen = NO_TRACK
        for place in range(used):
            if probability[row, 1 + place] > 0.0:
                chosen = place
        take_in(run, first + row, chosen, reports, tracks, settings, results)
    return True
