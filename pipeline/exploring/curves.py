"""The curves of one replay of a filter: paths, errors, NEES, NIS, whiteness, likelihood."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.pipeline.tuning.objective import innovations_in
from fuselog.recorders.log import Stream, schemas, topics_of
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.judging.consistency.whiteness import Whiteness, whitened, whiteness
from fuselog.replay.judging.errors.evaluation import (
    POSITION,
    Errors,
    Floats,
    chi_square_interval,
    nis_by_bin,
    split_topic,
)
from fuselog.replay.timeline.drawing.extremes import extremes as extremes_of

BIN_S = 1.0  # time in s over which NIS is averaged for its curve
LINES = 400  # largest number of points in a curve; more would delay it behind the slider


class Path(NamedTuple):
    """Positions in the plane (n, 2), at times (n,) since the epoch."""

    time_s: Floats
    points: Floats


class Nis(NamedTuple):
    """The mean NIS per component of each time span (n,), and its 95 % interval."""

    time_s: Floats
    mean: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class Case:
    """The curves of one estimated object, such as `robot1`.

    Attributes:
        name: its name; may be empty.
        components, kinds: names and kinds of the components of the state's tangent space.
        path: the path of the estimate; None if the state has no position.
        covariance: covariances (n, 2, 2) of the positions on the path.
        sigma: standard deviations (n, d) at `time_s` (n,), according to the filter.
        errors: errors relative to the truth; None without truth.
        nis: NIS over time; None without innovations.
        whiteness: whiteness of the innovations, by measured component.
        log_likelihood: log-likelihood of all measurements; NaN if the filter does not state it.
        beside: by name, the estimates (n,) of parameters in the state, and of components without truth.
    """

    name: str
    components: tuple[str, ...]
    kinds: tuple[str, ...]
    time_s: Floats
    sigma: Floats
    path: Path | None = None
    covariance: Floats = field(default_factory=lambda: np.empty((0, 2, 2)))
    errors: Errors | None = None
    nis: Nis | None = None
    whiteness: Mapping[str, Whiteness] = field(default_factory=dict)
    log_likelihood: float = np.nan
    beside: Mapping[str, Floats] = field(default_factory=dict)

    @property
    def nees_interval(self) -> tuple[float, float]:
        """Return the 95 % interval of a consistent filter's NEES for the truth's components."""
        assert self.errors is not None
        return chi_square_interval(len(self.errors.components), 1)


def cases_of(
    outputs: Mapping[str, Ragged],
    errors: Sequence[Errors],
    epoch_ns: int,
    estimated: Sequence[str] = (),
) -> dict[str, Case]:
    """Compute the curves of a filter's outputs on one log, by the name of the estimated object.

    Args:
        outputs: the outputs, by topic.
        errors: errors of the outputs, if there is truth.
        epoch_ns: the epoch of the log.
        estimated: parameters that are part of the state.
    """
    of_case = {each.case: each for each in errors}
    innovations = {split_topic(topic)[1]: stream for topic, stream in innovations_in(outputs)}
    found: dict[str, Case] = {}
    for topic, rows in outputs.items():
        stream = rows.stream
        if stream.schema.full_name != schemas.GAUSSIAN_ESTIMATE.full_name or not len(rows):
            continue
        case = split_topic(topic)[1]
        if case in found:  # the first of a filter's estimates is its own; others supplement it
            continue
        one = _case(case, stream, epoch_ns, of_case.get(case), innovations.get(case))
        found[case] = replace(one, beside=_beside(one, stream, estimated))
    return found


def _beside(case: Case, stream: Stream, estimated: Sequence[str]) -> dict[str, Floats]:
    components = stream.components
    mean = stream["mean"].reshape(len(stream), len(components))
    known = {*case.components} - {*estimated} if case.errors is None else {*case.errors.components}
    left = [name for name in case.components if name in components and name not in known]
    return {name: mean[:, components.index(name)] for name in left}


def _case(
    name: str, stream: Stream, epoch_ns: int, errors: Errors | None, innovations: Stream | None
) -> Case:
    components, kinds = stream.components, stream.metadata.get("kinds", "").split(",")
    tangent = tangent_components(components, kinds)
    mean = stream["mean"].reshape(len(stream), len(components))
    covariance = stream["covariance"].reshape(len(stream), len(tangent), len(tangent))
    time_s = _elapsed_s(stream, epoch_ns)
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    plane = [components.index(each) for each in POSITION[:2] if each in components]
    names = [each for each, _ in tangent]
    rows = [names.index(each) for each in POSITION[:2] if each in names]
    has_path = len(plane) == 2 and len(rows) == 2
    nis, white, likelihood = _of_innovations(innovations, epoch_ns)
    return Case(
        name,
        tuple(names),
        tuple(kind for _, kind in tangent),
        time_s,
        sigma,
        Path(time_s, mean[:, plane]) if has_path else None,
        covariance[:, rows][:, :, rows] if has_path else np.empty((0, 2, 2)),
        errors,
        nis,
        white,
        likelihood,
    )


def _of_innovations(
    stream: Stream | None, epoch_ns: int
) -> tuple[Nis | None, dict[str, Whiteness], float]:
    if stream is None:
        return None, {}, np.nan
    time_s = _elapsed_s(stream, epoch_ns)
    degrees = np.isfinite(stream["innovation"]).sum(axis=1)
    spans = np.floor(time_s / BIN_S).astype(np.int64)
    starts, *nis = nis_by_bin(spans, stream["normalised_innovation_squared"], degrees)
    series = whitened(stream).T
    white = {name: whiteness([each]) for name, each in zip(stream.components, series, strict=True)}
    stated = stream.columns.get("log_likelihood")
    return (
        Nis(np.asarray((starts + 0.5) * BIN_S), *nis),
        white,
        np.nan if stated is None else float(np.sum(stated)),
    )


def fewer(count: int, most: int = LINES) -> NDArray[np.int64]:
    """Choose evenly spaced rows to draw, including the first and the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def extremes(values: Floats, most: int = LINES) -> NDArray[np.int64]:
    """Choose the extremes of each span as rows to draw, so that no outlier is lost.

    Args:
        values: (n,); infinite and NaN values are treated as 0.
        most: the largest number of rows; if there are fewer values, all are chosen.

    Returns:
        The rows, in ascending order.
    """
    count = len(values)
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, most // 2 + 1).astype(np.int64)
    of_span = np.searchsorted(edges, np.arange(count), "right") - 1
    return extremes_of(of_span, np.where(np.isfinite(values), values, 0.0))


def typical_time_s(case: Case) -> float | None:
    """Choose the one-second span whose share of NEES above the interval is closest to the whole run's.

    If there are several such spans, choose the one closest to the middle of the run. Without truth,
    return None.
    """
    if case.errors is None or len(case.errors.nees) == 0:
        return None
    errors = case.errors
    _, high = case.nees_interval
    outside = errors.nees > high
    spans = np.floor(errors.elapsed_s).astype(np.int64)
    starts, place = np.unique(spans, return_inverse=True)
    share = np.bincount(place, outside) / np.bincount(place)
    away = np.abs(share - outside.mean())
    near = starts[away <= away.min() + 1e-9]
    return float(near[np.argmin(np.abs(near - np.median(starts)))])


def instant_of(case: Case | None) -> float:
    """Return the instant that the lens shows first, in a typical second or in the middle of the run."""
    if case is None or not len(case.time_s):
        return 0.0
    found = typical_time_s(case)
    return float(np.median(case.time_s)) if found is None else found


def true_path(source: MemorySource, topic: str) -> Path | None:
    """Return the path of a log's truth, or None if the truth has no position."""
    if topic not in source.topics:
        return None
    stream = source[topic]
    components = stream.components
    if not {*POSITION[:2]} <= {*components}:
        return None
    columns = [components.index(each) for each in POSITION[:2]]
    state = stream["state"].reshape(len(stream), len(components))[:, columns]
    return Path(_elapsed_s(stream, source.epoch_ns), state)


def map_points(source: MemorySource) -> Floats:
    """Return the points of the log's map in the plane (n, 2)."""
    landmarks = topics_of(source.topics, schemas.LANDMARK)
    found = [source[topic]["position_m"][:, :2] for topic in landmarks]
    return np.concatenate(found) if found else np.empty((0, 2))


def _elapsed_s(stream: Stream, epoch_ns: int) -> Floats:
    return np.asarray((stream.publish_time_ns - epoch_ns) * 1e-9, np.float64)
