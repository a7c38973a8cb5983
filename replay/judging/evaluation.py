"""Estimates against truth: alignment, errors, and whether the filter's own covariance can be believed.

An estimate stream names its components, their kinds and its truth topic in the channel's metadata. The
truth is interpolated at the estimate's stamps, never over a gap; errors are those of the tangent space
(see `replay.engine.tangent`). NEES and NIS: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
Tracking and Navigation, 5.4.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from recorders.errors import BadInput
from recorders.log import Stream, schemas
from replay.engine.blocks import Ragged
from replay.engine.components import Components, match_components, match_tangent, stated_components
from replay.engine.covariances import normalized_error_squared
from replay.engine.sources import Source
from replay.engine.tangent import WIDTHS, are_kinds, between, difference, tangent_components, things

Floats = NDArray[np.float64]
POSITION = ("x_m", "y_m", "z_m")


@dataclass(frozen=True)
class Errors:
    """One estimate stream of an ensemble against its truth, where there is truth.

    Attributes:
        estimator: the estimator's label, such as `ekf`.
        case: what it estimates, such as `robot1`; may be empty.
        components: names of the d components of the tangent space; kinds: "linear", "angle" or
            "rotation" (about an axis of the body) each.
        run, step, time_ns: (n,); step counts the distinct estimate times of a run, from zero.
        elapsed_s: (n,) time since the run's epoch.
        error: (n, d) estimate - truth.
        covariance: (n, d, d) the estimator's own.
        nees: (n,) normalised estimation error squared; NaN where the covariance is not positive
            definite.
        without_truth: how many estimates had no truth within the gap limit.
        unjudged: the estimate's components that the truth lacks, of which nothing is known here.
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
    unjudged: tuple[str, ...] = ()

    @property
    def position(self) -> list[int]:
        """The indices of the position's components."""
        return [index for index, name in enumerate(self.components) if name in POSITION]

    @property
    def rotation(self) -> list[int]:
        """The indices of an orientation's components, which are a rotation vector in rad."""
        return [index for index, kind in enumerate(self.kinds) if kind == "rotation"]


class Innovations(NamedTuple):
    """One innovation stream of an ensemble; `degrees` is the number of measured components.

    `log_likelihood` is NaN where the estimator states none, and None of a log from before it was stated.
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
    """Estimator and case of an estimate topic: /estimates/ESTIMATOR/CASE.../LEAF."""
    parts = topic.removeprefix("/estimates/").split("/")
    return parts[0], "/".join(parts[1:-1])


def chi_square_interval(degrees: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Where the mean of `runs` chi-square values lies with this probability if all is well.

    A mean NEES of 3 components over 50 runs is credible within

    >>> [round(bound, 3) for bound in chi_square_interval(3, 50)]
    [2.36, 3.716]
    """
    tail = 0.5 * (1 - probability)
    interval = np.asarray(chi2.ppf([tail, 1 - tail], degrees * runs)) / runs
    return float(interval[0]), float(interval[1])


def truth_at(
    truth: Stream, time_ns: NDArray[np.int64], kinds: Sequence[str], gap_limit_s: float
) -> Floats:
    """The truth's state (n, d) at any stamps, the shortest way between; NaN over gaps above the limit.

    A stamp that the truth has exactly needs no neighbour.
    """
    times = truth.publish_time_ns
    state = truth["state"]
    if len(times) == 0:
        return np.full((len(time_ns), len(kinds)), np.nan)
    right = np.searchsorted(times, time_ns, side="left").clip(0, len(times) - 1)
    left = np.where(times[right] > time_ns, right - 1, right).clip(0)
    span = times[right] - times[left]
    weight = (time_ns - times[left]) / np.maximum(span, 1)
    value = between(state[left], state[right], weight, kinds)
    inside = (times[left] <= time_ns) & (time_ns <= times[right]) & (span <= gap_limit_s * 1e9)
    value[~inside] = np.nan
    return value


def errors_of(estimates: Ragged, sources: Sequence[Source], gap_limit_s: float = 0.2) -> Errors | None:
    """Errors of a Gaussian estimate stream of an ensemble, in the components that all truths have.

    An axis or a quaternion is judged whole or not at all. None where a run has no truth topic, or the
    truths have nothing in common with the estimates (see `unjudged`).

    Raises BadInput where the stream does not say what its components are, or a truth states that one
    is of another kind.
    """
    stream = estimates.stream
    components = _components(stream)
    truth_topic = stream.metadata.get("truth", "")
    lacking = unjudged(estimates, sources)
    judged = {name: kind for name, kind in components.items() if name not in lacking}
    if not judged or not all(truth_topic in source.topics for source in sources):
        return None
    names, kinds = list(judged), list(judged.values())
    truth = np.concatenate(
        [
            reference(source, truth_topic, judged, estimates.of_run(run), gap_limit_s)
            for run, source in enumerate(sources)
        ]
    )
    where = f"topic {stream.topic}"
    columns = match_components(stream.metadata, judged, where)
    mean = stream["mean"].reshape(len(stream), len(components))[:, columns]
    error = difference(mean, truth, kinds)
    tangent = tangent_components(names, kinds)
    size = len(tangent_components(list(components), list(components.values())))
    known = np.isfinite(error).all(axis=1)
    counts = np.diff(estimates.offsets)
    run = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(stream)) - np.repeat(estimates.offsets[:-1], counts)
    epochs = np.array([source.epoch_ns for source in sources])
    rows = match_tangent(stream.metadata, judged, where)
    covariance = stream["covariance"].reshape(len(stream), size, size)[known][:, rows][:, :, rows]
    return Errors(
        *split_topic(stream.topic),
        tuple(name for name, _ in tangent),
        tuple(kind for _, kind in tangent),
        run[known],
        step[known],
        stream.publish_time_ns[known],
        (stream.publish_time_ns - epochs[run])[known] * 1e-9,
        error[known],
        covariance,
        normalized_error_squared(error[known], covariance),
        int((~known).sum()),
        lacking,
    )


def unjudged(estimates: Ragged, sources: Sequence[Source]) -> tuple[str, ...]:
    """The components of a Gaussian estimate stream that the truth of some run lacks.

    All of an axis or a quaternion where it lacks one of theirs; none where a run has no truth topic at
    all. Raises BadInput where the stream does not say what its components are.
    """
    components = _components(estimates.stream)
    names = list(components)
    topic = estimates.stream.metadata.get("truth", "")
    if not all(topic in source.topics for source in sources):
        return ()
    there = set(names).intersection(
        *(stated_components(source.topics[topic].metadata, {}, topic) for source in sources)
    )
    return tuple(
        name
        for _, columns in things(list(components.values()))
        if not there.issuperset(names[columns])
        for name in names[columns]
    )


def _components(stream: Stream) -> dict[str, Any]:
    """Names and kinds of an estimate's components; raises BadInput where it does not state them."""
    names = stream.components
    kinds = stream.metadata.get("kinds", "").split(",")
    if len(set(names)) != len(kinds) or len(names) != len(kinds) or not are_kinds(kinds):
        raise BadInput(
            f"topic {stream.topic}: the channel's metadata must name components and, for each, a kind "
            f"out of {', '.join(WIDTHS)}; an axis has two in a row, a quaternion four"
        )
    return dict(zip(names, kinds, strict=True))


def reference(
    source: Source, topic: str, components: Components, estimates: Stream, gap_limit_s: float
) -> Floats:
    """The truth's state (n, components) at the stamps of a run's estimates; see `truth_at`.

    Raises BadInput where the truth lacks a component.
    """
    truth = source.read([topic])[topic]
    if len(truth) == 0:
        return np.full((len(estimates), len(components)), np.nan)
    columns = match_components(truth.metadata, components, f"{source.name}: topic {topic}")
    known = replace(truth, columns={"state": truth["state"][:, columns]})
    return truth_at(known, estimates.publish_time_ns, list(components.values()), gap_limit_s)


def innovations_of(stream: Ragged) -> Innovations:
    """The innovations of an ensemble."""
    estimator, case = split_topic(stream.stream.topic)
    return Innovations(
        estimator,
        case,
        np.repeat(np.arange(stream.runs), np.diff(stream.offsets)),
        stream.stream.publish_time_ns,
        stream["accepted"] != 0,
        stream["normalised_innovation_squared"],
        np.isfinite(stream["innovation"]).sum(axis=1),
        stream.stream.columns.get("log_likelihood"),
    )


def error_table(errors: Errors) -> pd.DataFrame:
    """One row per run and step: error and sigma of every component, NEES."""
    sigma = np.sqrt(np.diagonal(errors.covariance, axis1=1, axis2=2))
    columns: dict[str, object] = {
        "estimator": errors.estimator,
        "case": errors.case,
        "run": errors.run,
        "step": errors.step,
        "time_ns": errors.time_ns,
        "elapsed_s": errors.elapsed_s,
    }
    for index, name in enumerate(errors.components):
        columns[f"error_{name}"] = errors.error[:, index]
        columns[f"sigma_{name}"] = sigma[:, index]
    columns["nees"] = errors.nees
    return pd.DataFrame(columns)


def step_table(errors: Errors, probability: float = 0.95) -> pd.DataFrame:
    """One row per step over the runs: RMSE of position and components, mean NEES with its interval."""
    steps, index, runs = np.unique(errors.step, return_inverse=True, return_counts=True)
    table = pd.DataFrame(
        {"estimator": errors.estimator, "case": errors.case, "step": steps, "runs": runs}
    )

    def mean(values: Floats) -> Floats:
        return np.bincount(index, values, len(runs)) / runs

    table["elapsed_s"] = mean(errors.elapsed_s)
    if errors.position:
        table["position_rmse_m"] = np.sqrt(mean(np.sum(errors.error[:, errors.position] ** 2, 1)))
    if errors.rotation:
        squared = mean(np.sum(errors.error[:, errors.rotation] ** 2, 1))
        table["orientation_rmse_deg"] = np.degrees(np.sqrt(squared))
    for column, name in enumerate(errors.components):
        table[f"rmse_{name}"] = np.sqrt(mean(errors.error[:, column] ** 2))
    table["nees"] = mean(errors.nees)
    size = len(errors.components)
    bounds = {count: chi_square_interval(size, count, probability) for count in set(runs.tolist())}
    table["nees_low"] = [bounds[count][0] for count in runs.tolist()]
    table["nees_high"] = [bounds[count][1] for count in runs.tolist()]
    return table


def gaussian_estimates(outputs: Mapping[str, Ragged]) -> list[Ragged]:
    """The Gaussian estimate streams among a replay's outputs."""
    return [
        ragged
        for ragged in outputs.values()
        if ragged.stream.schema.full_name == schemas.GAUSSIAN_ESTIMATE.full_name
    ]
