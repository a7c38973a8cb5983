"""Errors of estimates against the truth, and normalised errors that test covariances (NEES, NIS).

The channel of a stream of estimates states its components, their kinds and the topic of the truth. The
truth is interpolated at the estimate's stamps, but not over a gap; errors are differences in the tangent
space (see `fuselog.replay.engine.vectors.tangent`). NEES and NIS: Bar-Shalom, Li, Kirubarajan,
Estimation with Applications to Tracking and Navigation, 5.4.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream
from fuselog.recorders.log.planes import Origin
from fuselog.recorders.models.orientation import heading
from fuselog.replay.engine import chi2
from fuselog.replay.engine.arrays import over_columns
from fuselog.replay.engine.streams.blocks import Findings, Ragged, run_of_rows
from fuselog.replay.engine.streams.planes import into_plane_of
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.engine.vectors.components import (
    Components,
    in_body_axes,
    match_components,
    match_tangent,
    stated_components,
)
from fuselog.replay.engine.vectors.covariances import errors_squared
from fuselog.replay.engine.vectors.tangent import (
    WIDTHS,
    are_kinds,
    difference,
    manifold_blocks,
    states_at,
    states_of_runs,
    tangent_components,
)
from fuselog.replay.judging.errors.planes import ALIGNED, FirstFixes, planes_of, unlike
from fuselog.replay.judging.errors.truths import Truths

Floats = NDArray[np.float64]
POSITION, HEADING = ("x_m", "y_m", "z_m"), "heading_rad"
BOUND = "bound"  # in the metadata of a stream that has lower bounds instead of estimates


class Quantity(NamedTuple):
    """Quantity whose error is reported: name of the RMSE, columns, and scale of the unit."""

    rmse: str
    columns: list[int]
    scale: float = 1.0


@dataclass(frozen=True)
class Errors:
    """Errors of one stream of estimates of an ensemble, at stamps with a known truth.

    Attributes:
        estimator: the estimator's label, such as `ekf`.
        case: name of the estimated object, such as `robot1`; may be empty.
        components: names of the d components of the tangent space.
        kinds: kind of each component: "linear", "angle" or "rotation" (about a body axis).
        run, step, time_ns: (n,); step numbers the distinct estimate times of a run, from zero.
        elapsed_s: (n,) time since the run's epoch.
        error: (n, d) estimate minus truth.
        covariance: (n, d, d) as stated by the estimator.
        nees: (n,) normalised estimation error squared; NaN if the covariance is not positive definite.
        without_truth: number of estimates at stamps where the truth cannot be interpolated.
        components_without_truth: components of the estimate that are not judged because the truth lacks
            them.
        is_bound: whether the rows are bounds at the truth instead of estimates: the covariances are then
            the smallest possible squared errors.
        heading_rad: (n,) the true heading; None if truth and estimate have no heading.
        position_nees: (n,) NEES of the position; None if it was not computed together with `nees`.
    """

    estimator: str
    case: str
    components: tuple[str, ...]
    kinds: tuple[str, ...]
    run: NDArray[np.int64]
    step: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    elapsed_s: Floats
    error: Floats
    covariance: Floats
    nees: Floats
    without_truth: int
    components_without_truth: tuple[str, ...] = ()
    is_bound: bool = False
    heading_rad: Floats | None = None
    position_nees: Floats | None = None

    @cached_property
    def squared(self) -> Floats:
        """Return squared errors (n, d), or smallest possible ones for a bound; infinite on overflow."""
        with np.errstate(over="ignore"):
            return np.diagonal(self.covariance, axis1=1, axis2=2) if self.is_bound else self.error**2

    @property
    def position(self) -> list[int]:
        """Return the indices of the position's components."""
        return [index for index, name in enumerate(self.components) if name in POSITION]

    @property
    def rotation(self) -> list[int]:
        """Return the indices of the orientation's components, a rotation vector in rad."""
        return [index for index, kind in enumerate(self.kinds) if kind == "rotation"]

    @property
    def main(self) -> Quantity:
        """Return the main quantity: position, otherwise orientation, otherwise the first component."""
        if self.position:
            return Quantity("position_rmse_m", self.position)
        if self.rotation:
            return Quantity("orientation_rmse_deg", self.rotation, float(np.degrees(1)))
        return Quantity(f"rmse_{self.components[0]}", [0])


# The fields of `Errors` with one entry per estimate.
PER_ROW = ("run", "step", "time_ns", "elapsed_s", "error", "covariance", "nees")
MAY_BE_NONE = ("heading_rad", "position_nees")


def errors_at(errors: Errors, rows: NDArray[np.bool_]) -> Errors:
    """Select rows of errors.

    Args:
        errors: errors of an ensemble.
        rows: (n,), whether a row is selected.
    """
    given: dict[str, Any] = {name: getattr(errors, name) for name in (*PER_ROW, *MAY_BE_NONE)}
    columns = {name: each[rows] for name, each in given.items() if each is not None}
    return replace(errors, **columns)


class Innovations(NamedTuple):
    """Innovations (n,) of one stream of an ensemble.

    Attributes:
        estimator: the estimator's label, such as `ekf`.
        case: name of the estimated object, such as `robot1`; may be empty.
        run, time_ns: (n,), the run number and the stamp.
        accepted: (n,), whether the gate accepted the measurement.
        squared: (n,), normalised innovation squared (NIS).
        degrees: (n,), number of measured components.
        log_likelihood: (n,), log-likelihood of the measurements; NaN if the estimator does not state it,
            None for old logs without the field.
    """

    estimator: str
    case: str
    run: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    accepted: NDArray[np.bool_]
    squared: Floats
    degrees: NDArray[np.int64]
    log_likelihood: Floats | None = None


def split_topic(topic: str) -> tuple[str, str]:
    """Return estimator and case of an estimate topic: /estimates/ESTIMATOR/CASE.../LEAF."""
    parts = topic.removeprefix("/estimates/").split("/")
    return parts[0], "/".join(parts[1:-1])


@lru_cache(4096)
def chi_square_interval(degrees: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Compute the interval that contains the mean of `runs` chi-square values with this probability.

    The 95 % interval of the mean NEES of 3 components over 50 runs is

    >>> [round(bound, 3) for bound in chi_square_interval(3, 50)]
    [2.36, 3.716]
    """
    tail = 0.5 * (1 - probability)
    interval = np.asarray(chi2.ppf([tail, 1 - tail], degrees * runs)) / runs
    return float(interval[0]), float(interval[1])


def chi_square_band(degrees: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Compute the 95 % intervals of chi-square values divided by their degrees of freedom (n,)."""
    tail = 0.5 * (1 - 0.95)
    low, high = (np.asarray(chi2.ppf(np.full(len(degrees), p), degrees)) for p in (tail, 1 - tail))
    return low / degrees, high / degrees


def nis_by_bin(
    place: NDArray[np.int64], squared: Floats, degrees: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """Average NIS per component in bins.

    Args:
        place: (n,), the bin of each innovation.
        squared: (n,) NIS.
        degrees: (n,), the numbers of measured components.

    Returns the bins (m,) with at least one measured component, and the mean and its 95 % interval in
    each bin.
    """
    bins, place = np.unique(place, return_inverse=True)
    count, total = (np.bincount(place, each) for each in (degrees, squared))
    known = count > 0
    return bins[known], total[known] / count[known], *chi_square_band(count[known])


def rmse_interval(
    runs: Floats, trace: Floats, squared: Floats, probability: float = 0.95
) -> tuple[Floats, Floats]:
    """Compute the interval of an RMSE over the given runs, assuming that the covariances P are correct.

    A sum of squared errors has mean tr P and variance 2 tr P^2. Its distribution is close to a scaled
    chi-square with these moments (Box 1954, theorem 3.1), and equal to it if all variances are equal.

    Args:
        runs: (n,), number of runs.
        trace: (n,) the mean of tr P over the runs.
        squared: (n,) the mean of tr P^2 over the runs.
        probability: probability of the interval.

    Returns the lower and the upper bounds (n,); NaN if a covariance is zero or not finite.
    """
    quantiles = 0.5 - 0.5 * probability, 0.5 + 0.5 * probability
    with np.errstate(divide="ignore", invalid="ignore"):
        degrees = runs * trace**2 / squared
        low, high = (np.sqrt(trace * chi2.ppf(each, degrees) / degrees) for each in quantiles)
    return low, high


def errors_of(
    estimates: Ragged,
    truths: Sequence[Truths],
    gap_limit_s: float = 0.2,
    *,
    steps: NDArray[np.int64] | None = None,
    first_run: int = 0,
    first_fixes: FirstFixes | None = None,
    shared: Findings | None = None,
) -> Errors | None:
    """Compute the errors of the Gaussian estimates of an ensemble, in components that all truths have.

    An axis or a quaternion is judged as a whole or not at all. The result is None if a run has no truth
    topic, if truths and estimates have no common component (see `components_without_truth`), or if their
    tangent planes cannot be compared (see `unlike`). A truth in a different tangent plane is transformed
    to the estimates' plane.

    Args:
        estimates: the stream, or a block of it.
        truths: truths of every run.
        gap_limit_s: longest gap in s over which the truth is interpolated.
        steps: (runs,) number of earlier estimates of each run.
        first_run: number of the first run.
        first_fixes: origins of the tangent planes of estimates whose channels state no origin.
        shared: cache of true states for estimators with the same stamps, only for truths in memory:
            others are read along with every estimator.

    Raises BadInput if the stream does not state its components, or if a truth states another kind for
    one of the components.
    """
    sources = [each.source for each in truths]
    estimates = replace(estimates, stream=in_body_axes(estimates.stream))
    stream = estimates.stream
    components = _components(stream)
    truth_topic = stream.metadata.get("truth", "")
    lacking = components_without_truth(estimates, sources)
    judged = {name: kind for name, kind in components.items() if name not in lacking}
    first_fixes = first_fixes or {}
    if not judged or not all(truth_topic in source.topics for source in sources):
        return None
    if unlike(stream, sources, first_fixes):
        return None
    is_aligned = ALIGNED in stream.metadata
    planes = [None if is_aligned else each for each in planes_of(stream, len(sources), first_fixes)]
    names, kinds = list(judged), list(judged.values())
    time_ns, offsets = stream.publish_time_ns, estimates.offsets

    def true_states() -> Floats:
        cuts = zip(truths, planes, pairwise(offsets.tolist()), strict=True)
        there = [
            _truth_around(
                truth, truth_topic, judged, time_ns[first:end], gap_limit_s, stream.topic, plane
            )
            for truth, plane, (first, end) in cuts
        ]
        return states_of_runs(there, time_ns, offsets, kinds, gap_limit_s)

    if shared is None:
        truth = true_states()
    else:
        stamps = time_ns.tobytes(), offsets.tobytes()
        truth = shared.once((truth_topic, *judged.items(), *planes, *stamps), true_states)
    where = f"topic {stream.topic}"
    columns = match_components(stream.metadata, judged, where)
    mean = stream["mean"].reshape(len(stream), len(components))
    mean = mean if columns == list(range(len(components))) else mean[:, columns]
    error = difference(mean, truth, kinds)
    tangent = tangent_components(names, kinds)
    size = len(tangent_components(list(components), list(components.values())))
    is_known = over_columns(np.logical_and, np.isfinite(error))
    known = slice(None) if is_known.all() else is_known
    run = run_of_rows(offsets)
    before = offsets[:-1] if steps is None else offsets[:-1] - steps
    step = np.arange(len(stream)) - before[run]
    epochs = np.array([source.epoch_ns for source in sources])
    rows = match_tangent(stream.metadata, judged, where)
    covariance = stream["covariance"].reshape(len(stream), size, size)[known]
    if rows != list(range(size)):
        covariance = covariance[:, rows][:, :, rows]
    is_bound = BOUND in stream.metadata
    places = [index for index, (name, _) in enumerate(tangent) if name in POSITION]
    leading = len(places) if places == list(range(len(places))) else 0
    nees, position_nees = errors_squared(error[known], covariance, leading)
    return Errors(
        *split_topic(stream.topic),
        tuple(name for name, _ in tangent),
        tuple(kind for _, kind in tangent),
        first_run + run[known],
        step[known],
        time_ns[known],
        (time_ns - epochs[run])[known] * 1e-9,
        error[known],
        covariance,
        np.full(len(nees), np.nan) if is_bound else nees,
        int((~is_known).sum()),
        lacking,
        is_bound,
        _heading_of(truth[known], judged),
        position_nees if leading else None,
    )


def _heading_of(state: Floats, components: Components) -> Floats | None:
    """Return the heading (n,) of a state (n, components); None if it has no heading."""
    names, kinds = list(components), list(components.values())
    if components.get(HEADING) == "angle":
        return state[:, names.index(HEADING)]
    if "quaternion" in kinds:
        first = kinds.index("quaternion")
        return heading(state[:, first : first + WIDTHS["quaternion"]])
    return None


def components_without_truth(estimates: Ragged, sources: Sequence[Source]) -> tuple[str, ...]:
    """Return the components of Gaussian estimates that the truth of at least one run lacks.

    An axis or a quaternion is included as a whole if one of its components is missing. The result is
    empty if a run has no truth topic at all. Raises BadInput if the stream does not state its
    components.
    """
    components = _components(estimates.stream)
    names = list(components)
    topic = estimates.stream.metadata.get("truth", "")
    if not all(topic in source.topics for source in sources):
        return ()
    stated = [source.topics[topic].metadata for source in sources]
    alike = {(each.get("components"), each.get("kinds")): each for each in stated}
    there = set(names).intersection(*(stated_components(each, {}, topic) for each in alike.values()))
    return tuple(
        name
        for _, columns in manifold_blocks(list(components.values()))
        if not there.issuperset(names[columns])
        for name in names[columns]
    )


def unjudged_sentence(estimates: Ragged, sources: Sequence[Source], first: FirstFixes) -> str:
    """Explain which components of Gaussian estimates are not judged, and why, or return ""."""
    what = " ".join(filter(None, split_topic(estimates.stream.topic)))
    if why := unlike(estimates.stream, sources, first):
        return f"{what}: not judged: {why}"
    truth = estimates.stream.metadata.get("truth", "")
    if not all(truth in source.topics for source in sources):
        return ""
    names, own = components_without_truth(estimates, sources), _components(estimates.stream)
    true = stated_components(sources[0].topics[truth].metadata, {}, truth)
    position = [name for name in own if name in POSITION and name not in names]
    rest = [name for name in true if name in POSITION and name not in position]
    facts = []
    if names:
        verb, them = ("is", "it") if len(names) == 1 else ("are", "them")
        facts.append(f"{', '.join(names)} {verb} not judged: {truth} lacks {them}")
    if len(names) == len(own):
        facts.append(f"it has {', '.join(true)}")
    elif position and rest:
        alone, others = ", ".join(position), ", ".join(rest)
        facts.append(f"position_rmse_m covers only {alone}; {truth} also has {others}")
    return f"{what}: {'; '.join(facts)}" if facts else ""


def unestimated(estimates: Stream, sources: Sequence[Source]) -> list[str]:
    """Return the sensor errors that are components of the truth but not of the estimates."""
    topic = estimates.metadata.get("truth", "")
    if not all(topic in source.topics for source in sources):
        return []
    stated = stated_components(sources[0].topics[topic].metadata, {}, topic)
    return [
        name
        for name in stated
        if name not in estimates.components and ("bias_" in name or name.endswith("_clock_s"))
    ]


def _components(stream: Stream) -> dict[str, Any]:
    """Return names and kinds of the components of estimates; raise BadInput if none are stated."""
    names = stream.components
    kinds = stream.metadata.get("kinds", "").split(",")
    if len(set(names)) != len(kinds) or len(names) != len(kinds) or not are_kinds(kinds):
        raise BadInput(
            f"topic {stream.topic}: the channel's metadata must name components and, for each, one of "
            f"the kinds {', '.join(WIDTHS)}; an axis needs two adjacent components, a quaternion four"
        )
    return dict(zip(names, kinds, strict=True))


def reference(
    truths: Truths,
    topic: str,
    components: Components,
    estimates: Stream,
    gap_limit_s: float,
    plane: Origin | None = None,
) -> Floats:
    """Interpolate true states (n, components) at the stamps of the estimates of a run; see `truth_at`.

    If the truth states the origin of a different tangent plane, the truth is transformed to the plane of
    the estimates.

    Raises BadInput if the truth lacks a component.
    """
    time_ns = estimates.publish_time_ns
    into = None if ALIGNED in estimates.metadata else plane
    known = _truth_around(truths, topic, components, time_ns, gap_limit_s, estimates.topic, into)
    return states_at(*known, time_ns, list(components.values()), gap_limit_s)


def _truth_around(
    truths: Truths,
    topic: str,
    components: Components,
    time_ns: NDArray[np.int64],
    gap_limit_s: float,
    reader: str,
    plane: Origin | None,
) -> tuple[NDArray[np.int64], Floats]:
    """Return stamps (m,) and states (m, components) that determine the truth at the stamps (n,).

    `reader` is the topic of the estimates, and `plane` is their tangent plane; see `reference`.
    """
    truth = truths.around(topic, time_ns, gap_limit_s, reader)
    if len(truth) == 0:
        return truth.publish_time_ns, np.empty((0, len(components)))
    if plane is not None:
        truth = into_plane_of(truth, plane)
    columns = match_components(truth.metadata, components, f"{truths.source.name}: topic {topic}")
    state = truth["state"]
    return truth.publish_time_ns, state if columns == list(range(state.shape[1])) else state[:, columns]


def innovations_of(stream: Ragged, first_run: int = 0) -> Innovations:
    """Extract the innovations of an ensemble; `first_run` is the number of its first run."""
    estimator, case = split_topic(stream.stream.topic)
    return Innovations(
        estimator,
        case,
        first_run + run_of_rows(stream.offsets),
        stream.stream.publish_time_ns,
        stream["accepted"] != 0,
        stream["normalised_innovation_squared"],
        over_columns(np.add, np.isfinite(stream["innovation"]).astype(np.int64)),
        stream.stream.columns.get("log_likelihood"),
    )
