"""Estimates against truth: alignment, errors, and whether the filter's own covariance can be believed.

An estimate stream names its components, their kinds and its truth topic in the channel's metadata. The
truth is interpolated at the estimate's stamps, never over a gap; errors are those of the tangent space
(see `replay.tangent`). NEES and NIS: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to
Tracking and Navigation, 5.4.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from recorders.errors import BadInput
from recorders.log import Stream, schemas
from replay.blocks import Ragged
from replay.consistency import normalized_error_squared
from replay.sources import Source
from replay.tangent import WIDTHS, are_kinds, between, difference, tangent_components

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

    @property
    def position(self) -> list[int]:
        """The indices of the position's components."""
        return [index for index, name in enumerate(self.components) if name in POSITION]

    @property
    def rotation(self) -> list[int]:
        """The indices of an orientation's components, which are a rotation vector in rad."""
        return [index for index, kind in enumerate(self.kinds) if kind == "rotation"]


class Innovations(NamedTuple):
    """One innovation stream of an ensemble; `degrees` is the number of measured components."""

    estimator: str
    case: str
    run: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    accepted: NDArray[np.bool_]
    squared: Floats
    degrees: NDArray[np.int64]


def split_topic(topic: str) -> tuple[str, str]:
    """Estimator and case of an estimate topic: /estimates/ESTIMATOR/CASE.../LEAF."""
    parts = topic.removeprefix("/estimates/").split("/")
    return parts[0], "/".join(parts[1:-1])


def chi_square_interval(degrees: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Where the mean of `runs` chi-square values lies with this probability if all is well."""
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
    """Errors of a Gaussian estimate stream of an ensemble; None unless every run has its truth topic.

    Raises BadInput where the stream does not say what its components are, or the truth lacks them.
    """
    stream = estimates.stream
    estimator, case = split_topic(stream.topic)
    components = tuple(stream.components)
    kinds = tuple(stream.metadata.get("kinds", "").split(","))
    if len(components) != len(kinds) or not are_kinds(kinds):
        raise BadInput(
            f"topic {stream.topic}: the channel's metadata must name components and, for each, a kind "
            f"out of {', '.join(WIDTHS)}; an axis has two in a row, a quaternion four"
        )
    truth_topic = stream.metadata.get("truth", "")
    if not all(truth_topic in source.topics for source in sources):
        return None
    references = [
        _reference(source, truth_topic, components, kinds, estimates.of_run(run), gap_limit_s)
        for run, source in enumerate(sources)
    ]
    mean = stream["mean"].reshape(len(stream), len(components))
    error = difference(mean, np.concatenate(references), kinds)
    tangent = tangent_components(components, kinds)
    size = len(tangent)
    known = np.isfinite(error).all(axis=1)
    counts = np.diff(estimates.offsets)
    run = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(stream)) - np.repeat(estimates.offsets[:-1], counts)
    epochs = np.array([source.epoch_ns for source in sources])
    covariance = stream["covariance"].reshape(len(stream), size, size)[known]
    return Errors(
        estimator,
        case,
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
    )


def _reference(
    source: Source,
    topic: str,
    components: Sequence[str],
    kinds: Sequence[str],
    estimates: Stream,
    gap_limit_s: float,
) -> Floats:
    truth = source.read([topic])[topic]
    if len(truth) == 0:
        return np.full((len(estimates), len(components)), np.nan)
    there = truth.components
    missing = [name for name in components if name not in there]
    if missing:
        raise BadInput(
            f"{source.name}: topic {topic} has no component {missing[0]} to judge "
            f"{estimates.topic} by; it has {', '.join(there) or 'no named components'}"
        )
    all_kinds = ["linear"] * len(there)
    columns = [there.index(name) for name in components]
    for column, kind in zip(columns, kinds, strict=True):
        all_kinds[column] = kind
    return truth_at(truth, estimates.publish_time_ns, all_kinds, gap_limit_s)[:, columns]


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
