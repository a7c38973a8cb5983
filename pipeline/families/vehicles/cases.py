"""Cases of cooperative vehicles, with each estimator's errors by run and by step."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeInt
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from fuselog.recorders.families.vehicles.simulator import VehiclesParameters
from fuselog.recorders.parameters import Parameters
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import MemorySource, Source
from fuselog.replay.families.sets.judging.errors import CUTOFF_M, SetErrors
from fuselog.replay.families.vehicles.streams import vehicle_numbers
from fuselog.replay.families.vehicles.updates import split_method
from fuselog.replay.judging.errors.label_errors import (
    assigned_squared_error,
    fixed_squared_error,
    total_error,
)

Floats = NDArray[np.float64]

# Sizes of a message's parts, in bytes.
POSITION_BYTES, IDENTITY_BYTES, NUMBER_BYTES = 16, 4, 8
# State of a vehicle and the lower triangle of its covariance.
TRACK_BYTES = NUMBER_BYTES * (4 + 10)


class VehiclesOptions(Parameters):
    """The cases, and the estimators for comparison.

    Attributes:
        cases: changes to the scenario's parameters, by the name of a case.
        reference: label of the Kalman filter.
        few: parameters of estimators that are too slow to replay all runs, by label.
        few_runs: number of runs of the first case that the slow estimators replay.
    """

    cases: dict[str, dict[str, Any]] = {"deterministic": {}}
    reference: str = "kf"
    few: dict[str, dict[str, Any]] = {}
    few_runs: NonNegativeInt = 0


class Scores(NamedTuple):
    """Total errors, eq (20), of every run (runs,), with fixed labels and with the best labels.

    The arrays by step, (runs, steps), contain squared errors, and GOSPA in m (cutoff 10 m). `failed`
    counts runs that did not reach the end. Set estimates have no labels, so their errors with fixed
    labels are NaN.
    """

    fixed: Floats
    assigned: Floats
    fixed_by_step: Floats
    assigned_by_step: Floats
    gospa_by_step: Floats
    failed: int

    def of_first(self, runs: int) -> "Scores":
        """Return the scores of the first runs."""
        by_step = (self.fixed_by_step, self.assigned_by_step, self.gospa_by_step)
        return _scores(*(part[:runs] for part in by_step))


class Case(NamedTuple):
    """A case with its runs, and each estimator's scores and bytes per step, by label."""

    name: str
    sources: Sequence[MemorySource]
    scores: Mapping[str, Scores]
    bytes_per_step: Mapping[str, float]

    @property
    def parameters(self) -> VehiclesParameters:
        """Return the parameters of the recording."""
        stated = self.sources[0].run
        assert stated is not None
        return VehiclesParameters.model_validate(stated.parameters)


def truths_of(sources: Sequence[Source]) -> tuple[NDArray[np.int64], Floats]:
    """Read stamps (runs, steps) and true positions (runs, steps, vehicles, 2), except the first step."""
    numbers = vehicle_numbers(sources[0].topics)
    topics = [f"/vehicle{number}/truth" for number in numbers]
    read = [source.read(topics) for source in sources]
    places = [np.stack([run[topic]["state"][1:, 0::2] for topic in topics], axis=1) for run in read]
    return np.array([run[topics[0]].publish_time_ns[1:] for run in read]), np.array(places)


def estimates_of(outputs: Mapping[str, Ragged], label: str, times_ns: NDArray[np.int64]) -> Floats:
    """Return an estimator's positions of all vehicles at the truth's stamps.

    Args:
        outputs: outputs by topic.
        label: label of the estimator.
        times_ns: (runs, steps), the truth's stamps.

    Returns:
        Positions (runs, steps, vehicles, 2), in m; NaN if there is no estimate.
    """
    topics = [topic for topic in outputs if topic.startswith(f"/estimates/{label}/vehicle")]
    states = [topic for topic in topics if topic.endswith("/state")]
    found = np.full((*times_ns.shape, len(states), 2), np.nan)
    for vehicle, topic in enumerate(states):
        ragged = outputs[topic]
        for run, times in enumerate(times_ns):
            stream = ragged.of_run(run)
            step = np.searchsorted(times, stream.publish_time_ns)
            found[run, step, vehicle] = stream["mean"][:, 0::2]
    return found


def score(estimates: Floats, truths: Floats) -> Scores:
    """Compute the total errors of estimated positions.

    Args:
        estimates: (runs, steps, vehicles, 2), in m; NaN if there is no estimate.
        truths: (runs, steps, vehicles, 2), in m.
    """
    return _scores(
        fixed_squared_error(estimates, truths),
        assigned_squared_error(estimates, truths),
        np.sqrt(assigned_squared_error(estimates, truths, CUTOFF_M)),
    )


def _scores(fixed: Floats, assigned: Floats, gospa_m: Floats) -> Scores:
    """Make scores from squared errors and GOSPA by run and step, and count the failed runs."""
    failed = int(np.isnan(assigned).any(axis=1).sum())
    return Scores(total_error(fixed), total_error(assigned), fixed, assigned, gospa_m, failed)


def score_set(outputs: Mapping[str, Ragged], found: SetErrors, truths: Floats) -> Scores:
    """Compute the total errors of a set estimate.

    A vehicle to which no element is assigned gets the nearest element.

    Args:
        outputs: outputs by topic.
        found: the evaluated set estimate, including its GOSPA.
        truths: (runs, steps, vehicles, 2), in m.
    """
    topic = f"/estimates/{found.estimator}/{found.case}"
    sizes, elements = outputs[f"{topic}/set"], outputs[f"{topic}/element"]
    assigned = np.full(truths.shape[:2], np.nan)
    for run in range(len(truths)):
        ends = np.cumsum(sizes.of_run(run)["elements"].astype(np.int64))
        places = elements.of_run(run)["mean"][:, 0::2]
        for step, (begin, end) in enumerate(zip(np.append(0, ends[:-1]), ends, strict=True)):
            if begin < end:
                squared = cdist(truths[run, step], places[begin:end], "sqeuclidean")
                often = -(-len(squared) // squared.shape[1])
                pairs = linear_sum_assignment(np.tile(squared, often))
                assigned[run, step] = np.tile(squared, often)[pairs].sum()
    return _scores(np.full_like(assigned, np.nan), assigned, found.gospa.reshape(assigned.shape))


def scores_of(
    sources: Sequence[Source],
    outputs: Mapping[str, Ragged],
    labels: Iterable[str],
    others: Sequence[Any] = (),
) -> dict[str, Scores]:
    """Compute the scores of all estimators. Scores of set estimators have the case `network`."""
    times_ns, truths = truths_of(sources)
    sets = [each for each in others if isinstance(each, SetErrors)]
    of_sets = {each.estimator: each for each in sets if each.case == "network"}
    return {
        label: score_set(outputs, of_sets[label], truths)
        if label in of_sets
        else score(estimates_of(outputs, label, times_ns), truths)
        for label in labels
    }


def bytes_per_step(
    sources: Sequence[Source], estimators: Mapping[str, Mapping[str, Any]]
) -> dict[str, float]:
    """Compute the mean number of bytes sent per scan of the network, by estimator.

    Fixes are sent with an identity only to estimators that must know which vehicle each fix belongs to.
    The infrastructure sensor sends nothing, a single number, or its detections, depending on the
    estimator.
    """
    fixes = [f"/vehicle{number}/fix" for number in vehicle_numbers(sources[0].topics)]
    names = ["/network/scan", "/network/detection", "/infrastructure/scan", "/infrastructure/detection"]
    counts = {name: sum(source.topics[name].messages for source in sources) for name in [*names, *fixes]}
    steps, detected, looks, seen = (counts[name] for name in names)
    own = sum(counts[name] for name in fixes)
    found = {}
    for label, settings in estimators.items():
        kind, _, method = str(settings.get("kind", label)).partition(":")
        association, sensor = split_method(method)
        is_known = kind == "vehicle-kalman" or association == "known"
        sent = own * (POSITION_BYTES + IDENTITY_BYTES) if is_known else detected * POSITION_BYTES
        sent += {"topology": NUMBER_BYTES * looks, "": 0}.get(sensor, POSITION_BYTES * seen)
        found[label] = sent / max(steps, 1)
    return found
