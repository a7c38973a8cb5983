"""Charts of the first run from above, of a magnified typical second, and of NIS over time."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.output.charts import Axis, Chart, Panel, Series, path, thinned
from fuselog.pipeline.output.report.first_run import (
    MOST_RUNS,
    PLANE,
    RUNS,
    FirstRun,
    Followed,
    innovations_of_runs,
)
from fuselog.pipeline.output.summary import nis_over_time, panel_over_time
from fuselog.pipeline.output.words import count
from fuselog.recorders.log import open_log, read_streams, schemas, topics_of
from fuselog.replay.engine import chi2
from fuselog.replay.engine.streams.detections import ORIGIN, detected_places
from fuselog.replay.engine.streams.sources import LogSource
from fuselog.replay.judging.consistency.consistency import ellipses
from fuselog.replay.judging.errors.evaluation import Floats, split_topic

# Number of times at which particles are drawn, and number of equally weighted particles at each.
CLOUDS, CLOUD_POINTS = 6, 150
ELLIPSES, CORNERS = 6, 48
INSIDE = float(chi2.ppf(0.95, 2))  # 95 % quantile of a normalised squared error in the plane
# If ellipses are smaller than this share of the scene, a lens magnifies them.
SMALL = 0.04
MOST_LENSES = 3
LENS_S, DOTS = 1.0, 6
# Largest ratio of width to height of a lens, and of height to width.
WIDEST, HIGHEST = 3.6, 0.8
MOST_COLUMNS = 3
MOST_FIXES = 600


def plan(run: FirstRun) -> Chart:
    """Draw truth, estimates, landmarks, fixes, particles, and ellipses that are large enough to see."""
    longest = max(run.followed.values(), key=lambda each: len(each.time_s))
    series: list[Series] = []
    clouds = _clouds(run)
    size = _extent(longest.truth)
    for label, each in run.followed.items():
        if _half_axis(each) > SMALL * size:
            rows = np.linspace(0, len(each.time_s) - 1, ELLIPSES).round().astype(int)
            series.append(_ellipses(label, each, rows))
    series += [*_fixes(run), *clouds]
    truth = path("truth", longest.truth[thinned(len(longest.truth))], reference=True)
    paths = [
        path(label, each.estimate[thinned(len(each.truth))]) for label, each in run.followed.items()
    ]
    series += [truth, *paths, *_landmarks(run)]
    panel = Panel(x=Axis(label="x (m)"), y=Axis(label="y (m)"), series=series, plane=True)
    drawn = f", with particles at {CLOUDS} times" if clouds else ""
    shapes = (
        "; ellipses: 95 % regions as claimed" if any(each.style == "area" for each in series) else ""
    )
    return Chart(title=f"{run.case or 'paths'}, first run from above{drawn}{shapes}", panels=[panel])


def lens(run: FirstRun, labels: Sequence[str]) -> Chart | None:
    """Draw one second of the run for the estimators whose ellipses are too small for the scene.

    In the typical second, the shares of true positions outside the estimators' ellipses are closest to
    the shares in the whole run. Among several such seconds, the one closest to the middle of the run is
    used. Returns None if all ellipses are large enough for the scene.
    """
    sizes = {label: _extent(each.truth) for label, each in run.followed.items()}
    shown = {
        label: run.followed[label]
        for label in labels
        if label in run.followed and _half_axis(run.followed[label]) <= SMALL * sizes[label]
    }
    shown = dict(list(shown.items())[:MOST_LENSES])
    begin_s, length_s = typical_second(list(shown.values()))
    if not shown or not length_s:
        return None
    rows = {label: _rows_within(each, begin_s, length_s) for label, each in shown.items()}
    corners = np.concatenate(
        [
            each
            for label, of in rows.items()
            for each in (*_outlines(shown[label], of), shown[label].truth[of])
        ]
    )
    low, high = np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)
    middle, half = 0.5 * (low + high), 0.58 * (high - low)
    half = np.array([max(half[0], HIGHEST * half[1]), max(half[1], half[0] / WIDEST)])
    ends = [(float(m - h), float(m + h)) for m, h in zip(middle, half, strict=True)]
    x, y = Axis(label="x (m)", limits=ends[0]), Axis(label="y (m)", limits=ends[1])
    panels = []
    for label, each in shown.items():
        of = rows[label]
        is_out = each.squared > INSIDE
        near = (each.time_s >= begin_s - 0.5 * length_s) & (each.time_s <= begin_s + 1.5 * length_s)
        series = [
            _ellipses(label, each, of),
            path("truth", each.truth[near], reference=True),
            path(label, each.estimate[near]),
            path("truth inside", each.truth[of[~is_out[of]]], "markers", reference=True),
            path("truth outside", each.truth[of[is_out[of]]], "outside"),
        ]
        title = (
            f"{label}: outside at {int(is_out[of].sum())} of {len(of)} dots, "
            f"{100 * float(np.mean(is_out)):.0f} % over the run"
        )
        drawn = [each for each in series if each.x]
        panels.append(Panel(x=x, y=y, series=drawn, title=title, plane=True))
    title = (
        f"Lens: {length_s:g} s of the first run, from {begin_s:.1f} s. Ellipses: 95 % regions that each "
        "estimator claims; for a consistent estimator the truth is outside about 5 % of the time"
    )
    return Chart(title=title, panels=panels, columns=len(panels), legend=False)


def typical_second(followed: Sequence[Followed]) -> tuple[float, float]:
    """Find the typical second's start and length (longer for rare estimates); (0, 0) if too few."""
    if not followed or min(len(each.time_s) for each in followed) < DOTS:
        return 0.0, 0.0
    step_s = max(float(np.median(np.diff(each.time_s))) for each in followed)
    length_s = max(LENS_S, np.ceil((DOTS - 1) * step_s))
    begin_s = max(float(each.time_s[0]) for each in followed)
    end_s = min(float(each.time_s[-1]) for each in followed)
    seconds = max(int((end_s - begin_s) / length_s), 1)
    away = np.zeros(seconds)
    for each in followed:
        is_out = (each.squared > INSIDE).astype(float)
        place = np.floor((each.time_s - begin_s) / length_s).astype(int)
        known = (place >= 0) & (place < seconds)
        total = np.bincount(place[known], minlength=seconds)
        with np.errstate(invalid="ignore"):
            shares = np.bincount(place[known], is_out[known], seconds) / total
        away += np.abs(np.where(total > 0, shares, np.inf) - is_out.mean())
    as_good = np.flatnonzero(away <= away.min() + 1e-9)
    middle = as_good[np.argmin(np.abs(as_good - 0.5 * (seconds - 1)))]
    return begin_s + int(middle) * float(length_s), float(length_s)


def _rows_within(each: Followed, begin_s: float, length_s: float) -> NDArray[np.int64]:
    """Find the estimates nearest to a few evenly spaced times within the typical second."""
    times = np.linspace(begin_s, begin_s + length_s, DOTS)
    return np.unique(np.abs(each.time_s[:, None] - times).argmin(axis=0))


def _extent(points: Floats) -> float:
    return float(np.max(np.ptp(points, axis=0), initial=0.0))


def _half_axis(each: Followed) -> float:
    """Compute the median of the ellipses' longer half axes."""
    return float(np.sqrt(INSIDE * np.nanmedian(np.linalg.eigvalsh(each.covariance)[:, 1].clip(0.0))))


def _ellipses(label: str, each: Followed, rows: NDArray[np.int64]) -> Series:
    """Draw the 95 % regions that an estimator claims, at some of its estimates."""
    return path(label, _parted(_outlines(each, rows)), "area")


def _outlines(each: Followed, rows: NDArray[np.int64]) -> Floats:
    return ellipses(each.estimate[rows], each.covariance[rows], vertices=CORNERS)


def _landmarks(run: FirstRun) -> list[Series]:
    topics = topics_of(run.source.topics, schemas.LANDMARK)
    found = [each["position_m"][:, :2] for each in run.source.read(topics).values() if len(each)]
    return [path("landmarks", np.concatenate(found), "triangles", reference=True)] if found else []


def _fixes(run: FirstRun) -> list[Series]:
    """Draw measured positions of the estimated object."""
    topics = [
        topic
        for topic in topics_of(run.source.topics, schemas.POSITION_FIX)
        if not run.case or topic.startswith(f"/{run.case}/")
    ]
    found = [each["position_m"][:, :2] for each in run.source.read(topics).values() if len(each)]
    return _dots("fixes", found)


def _clouds(run: FirstRun) -> list[Series]:
    """Draw particles of densities at a few times spread over the run.

    The particles are sampled systematically: the chance that a particle is drawn is proportional to its
    weight.
    """
    found = []
    for topic in topics_of(run.output.topics, schemas.DENSITY_ESTIMATE):
        is_here = split_topic(topic)[1] == run.case
        if is_here and set(PLANE) <= set(run.output.empty(topic).components):
            found += _cloud_of(run, topic)
    return found


def _cloud_of(run: FirstRun, topic: str) -> list[Series]:
    estimator, case = split_topic(topic)
    sizes = [
        name
        for name in topics_of(run.output.topics, schemas.ESTIMATE_SIZE)
        if split_topic(name) == (estimator, case)
    ]
    stamps = [time for each in run.output.read(sizes).values() for time in each.publish_time_ns.tolist()]
    if not stamps or not isinstance(run.output, LogSource):
        return []
    points = []
    for row in np.linspace(0, len(stamps) - 1, CLOUDS).round().astype(int).tolist():
        time_ns = stamps[row]
        [cloud] = read_streams(run.output.log, [topic], start_ns=time_ns, end_ns=time_ns + 1).values()
        if len(cloud):
            ends = np.cumsum(cloud["weight"])
            positions = (np.arange(CLOUD_POINTS) + 0.5) / CLOUD_POINTS * ends[-1]
            columns = [cloud.components.index(name) for name in PLANE]
            points.append(cloud["mean"][np.searchsorted(ends, positions)][:, columns])
    return [path(f"{estimator}, particles", np.concatenate(points), "dots")] if points else []


def tracked(
    folder: Path, labels: Sequence[str], errors: Mapping[str, float], of_what: str
) -> Chart | None:
    """Draw the first run from above, with tracks and true paths, in a panel for each tracker.

    If there are several cases, the one with the median error is drawn. Returns None if no run has both
    truths and tracks. Raises BadInput if a log is damaged.

    Args:
        folder: the result's folder.
        labels: the trackers in order.
        errors: the errors of one tracker by case.
        of_what: the names of the error and of this tracker.
    """
    for case, log in _median_first(folder, errors).items():
        source = LogSource(open_log(log))
        output = LogSource(open_log(log.parent.parent / "estimates" / log.name))
        ways = _ways(source)
        if not ways:
            continue
        ends = [(float(of.min()), float(of.max())) for of in np.concatenate(ways).T]
        x, y = (
            Axis(label=label, limits=(low - SMALL * (high - low), high + SMALL * (high - low)))
            for label, (low, high) in zip(("x (m)", "y (m)"), ends, strict=True)
        )
        shared = [*_detections(source), path("truth", _parted(ways), reference=True)]
        found = {label: _tracks(output, label) for label in labels}
        panels = [
            Panel(x=x, y=y, series=[*shared, path(label, _parted(tracks))], title=label, plane=True)
            for label, tracks in found.items()
            if tracks
        ][:MOST_LENSES]
        if panels:
            of = f" of {case}" if case else ""
            which = f", the case of the median {of_what}," if len(errors) > 1 and case in errors else ""
            dots = f"; dots: detections, at most {MOST_FIXES}" if len(shared) > 1 else ""
            title = f"First run{of}{which} from above: tracks over the true paths (grey){dots}"
            return Chart(title=title, panels=panels, columns=len(panels), legend=False)
    return None


def _median_first(folder: Path, errors: Mapping[str, float]) -> dict[str, Path]:
    """Find each case's first log with estimates; put the case with the median error first."""
    logs = {
        "/".join(log.parent.parent.relative_to(folder).parts): log
        for log in sorted(folder.rglob("logs/run-0000.mcap"))
        if (log.parent.parent / "estimates" / log.name).is_file()
    }
    by_error = sorted((case for case in logs if case in errors), key=errors.__getitem__)
    middle = (len(by_error) - 1) // 2  # of two middle cases, the one with the smaller error
    return {case: logs[case] for case in dict.fromkeys([*by_error[middle : middle + 1], *logs])}


def _detections(source: LogSource) -> list[Series]:
    """Draw the detections of a log's sensors as dots; bearings have no position and are not drawn."""
    found = []
    for topic, each in source.topics.items():
        name = f"{topic.rpartition('/')[0]}/detection"
        if each.schema_name != schemas.SCAN.full_name or name not in source.topics:
            continue
        scan, detected = (source.read([one])[one] for one in (topic, name))
        origin = scan.metadata.get(ORIGIN, "")
        fix = source.read([origin])[origin] if origin in source.topics else None
        found.append(detected_places(scan, detected, fix))
    return _dots("detections", found)


def _dots(label: str, parts: Sequence[Floats]) -> list[Series]:
    """Draw measured positions, each (n, 2), as dots, at most as many as a picture can show."""
    points = np.concatenate([*parts, np.empty((0, 2))])
    rows = thinned(len(points), MOST_FIXES)
    return [path(label, points[rows], "dots", reference=True)] if parts else []


def _ways(source: LogSource) -> list[Floats]:
    """Return the true paths of a log's targets, each (n, 2)."""
    topics = topics_of(source.topics, schemas.TRUTH_STATE)
    truths = [each for each in source.read(topics).values() if set(PLANE) <= {*each.components}]
    return [
        each["state"][:, [each.components.index(name) for name in PLANE]][thinned(len(each))]
        for each in truths
        if len(each)
    ]


def _tracks(output: LogSource, label: str) -> list[Floats]:
    """Return the tracks of an estimator, each (n, 2)."""
    topic = f"/estimates/{label}/track"
    if topic not in output.topics or not set(PLANE) <= {*output.empty(topic).components}:
        return []
    tracks = output.read([topic])[topic]
    places = tracks["mean"][:, [tracks.components.index(name) for name in PLANE]]
    return [places[tracks["track_id"] == number] for number in np.unique(tracks["track_id"])]


def _parted(ways: Iterable[Floats]) -> Floats:
    """Join paths into one curve, with NaN between them."""
    gap = np.full((1, 2), np.nan)
    return np.concatenate([part for way in ways for part in (way, gap)])


def nis_chart(folder: Path, labels: Sequence[str]) -> Chart | None:
    """Draw NIS over time, with its 95 % band, for the runs whose estimates are kept."""
    found = innovations_of_runs(folder)
    cases = list(dict.fromkeys(case for _, case in found))
    drawn = []
    for label in labels:
        if not cases or (label, cases[0]) not in found:
            continue
        parts = found[label, cases[0]]
        time_s = np.concatenate([times for times, _ in parts])
        squared = np.concatenate([each.squared for _, each in parts])
        degrees = np.concatenate([each.degrees for _, each in parts])
        known = np.isfinite(squared) & (degrees > 0)
        if known.any():
            drawn.append((label, *nis_over_time(time_s[known], squared[known], degrees[known])))
    if not drawn:
        return None
    every = np.concatenate([np.concatenate([nis, low, high]) for _, _, nis, low, high in drawn])
    ends = float(every[every > 0].min()) / 1.3, float(every.max()) * 1.2
    y = Axis(label="NIS per component", log=True, limits=ends)
    panels = []
    for label, time_s, nis, low, high in drawn:
        share = float(((nis < low) | (nis > high)).mean())
        where = "always" if share == 1.0 else f"{100 * share:.0f} % of the time" if share else "never"
        title = f"{label}: outside {where}"
        panels.append(panel_over_time(label, time_s, nis, (low, high), y, title, "95 % if consistent"))
    columns = max(1, min(len(panels), MOST_COLUMNS))
    of = f" of {cases[0]}" if cases[0] else ""
    runs = count(min(len([*folder.glob(RUNS)]), MOST_RUNS), "run")
    title = f"NIS over time{of}, {runs} together; grey: 95 % if consistent"
    return Chart(title=title, panels=panels, columns=columns, legend=False)
