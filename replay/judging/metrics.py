"""Metrics: what an estimator's output says, judged, comes to in numbers.

They register by name, as estimators do. NEES and NIS: Bar-Shalom, Li, Kirubarajan, Estimation with
Applications to Tracking and Navigation, 5.4.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from recorders.log import schemas
from recorders.registry import available, foreign_code, load
from replay.engine.blocks import Ragged
from replay.engine.covariances import normalized_error_squared
from replay.engine.sources import Source
from replay.judging.evaluation import Errors, Floats, Innovations, step_table


class Output(NamedTuple):
    """One output topic of an estimator, of any schema, and the runs that it was replayed from."""

    estimator: str
    case: str
    leaf: str
    rows: Ragged
    sources: Sequence[Source]


Judged = TypeVar("Judged", bound=Any)


@dataclass(frozen=True)
class Metric(Generic[Judged]):
    """A registered metric: what it tells, what it judges, and its numbers as `quantity_unit`.

    `judges` is `Errors` for what follows from estimates and truth, `SetErrors` for that of sets,
    `Innovations` for what a filter says of its measurements, and `Output` for all else; no numbers where
    it has nothing to say.
    """

    summary: str
    judges: type[Judged]
    compute: Callable[[Judged], Mapping[str, float]]


def find_metrics(names: Sequence[str] = ()) -> dict[str, Metric[Any]]:
    """The registered metrics of these names, of all where none is given; BadInput for an unknown one."""
    return {name: load("metrics", name, Metric) for name in names or available("metrics")}


def measure(judged: Iterable[Any], metrics: Mapping[str, Metric[Any]]) -> dict[str, float]:
    """What the metrics say of all that was judged, as `estimator.quantity[.case]`.

    Raises BadInput where a metric raises.
    """
    values: dict[str, float] = {}
    for each in judged:
        for name, metric in metrics.items():
            if isinstance(each, metric.judges):
                with foreign_code(f"metric {name}"):
                    numbers = metric.compute(each)
                    case = f".{each.case}" if each.case else ""
                    for quantity, value in numbers.items():
                        values[f"{each.estimator}.{quantity}{case}"] = float(value)
    return values


def accuracy(errors: Errors) -> dict[str, float]:
    """RMSE of position, orientation and every other component over all runs and steps.

    NaN, which is written as null, for a component that the truth lacks.
    """
    values: dict[str, float] = {}
    if len(errors.error) and errors.position:
        values["position_rmse_m"] = _rms(errors.error[:, errors.position])
    if len(errors.error) and errors.rotation:
        values["orientation_rmse_deg"] = float(np.degrees(_rms(errors.error[:, errors.rotation])))
    for column, name in enumerate(errors.components):
        if len(errors.error) and column not in errors.position:
            values[_rmse_of(name)] = _rms(errors.error[:, [column]])
    values |= {_rmse_of(name): np.nan for name in errors.unjudged}
    return values | {"estimates_without_truth": errors.without_truth}


def _rmse_of(component: str) -> str:
    """What the RMSE of a component is called: `turn_rmse_radps` of `turn_radps`."""
    quantity, _, unit = component.rpartition("_")
    return f"{quantity}_rmse_{unit}".strip("_")


def _rms(error: Floats) -> float:
    """Root mean square of the length of errors (n, d)."""
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def consistency(errors: Errors) -> dict[str, float]:
    """Mean NEES of state and position, and the share of steps whose mean over the runs is in bounds."""
    nees = errors.nees[np.isfinite(errors.nees)]
    if len(nees) == 0:
        return {}
    values = {"nees": float(nees.mean())}
    if len(nees) < len(errors.nees):  # of singular covariances there is none
        values["estimates_without_nees"] = float(len(errors.nees) - len(nees))
    if errors.position and len(errors.position) < len(errors.components):
        block = errors.covariance[:, errors.position][:, :, errors.position]
        squared = normalized_error_squared(errors.error[:, errors.position], block)
        values["position_nees"] = float(np.nanmean(squared))
    table = step_table(errors)
    inside = (table["nees"] >= table["nees_low"]) & (table["nees"] <= table["nees_high"])
    values["nees_steps_within_95"] = float(inside.mean())
    return values


def innovation(innovations: Innovations) -> dict[str, float]:
    """Mean NIS per measured component (1 when all is well) and the share that the gate kept out."""
    if len(innovations.squared) == 0:
        return {}
    gated = {"gated_share": float(1 - innovations.accepted.mean())}
    if not innovations.degrees.any():  # all said nothing of their states
        return gated
    return {"nis_per_component": float(innovations.squared.sum() / innovations.degrees.sum()), **gated}


def likelihood(innovations: Innovations) -> dict[str, float]:
    """The log-likelihood of a run's measurements as the filter predicted them: the mean over the runs.

    Of the measurements that a gate let in alone, so that it is no measure to tune a gate by. Nothing
    where the estimator does not state it of all of them.
    """
    stated = innovations.log_likelihood
    if stated is None or not len(stated) or not np.isfinite(stated[innovations.accepted]).all():
        return {}
    runs = len(np.unique(innovations.run))
    return {"log_likelihood": float(stated[innovations.accepted].sum() / runs)}


def failures(output: Output) -> dict[str, float]:
    """How many runs failed."""
    if output.rows.stream.schema.full_name != schemas.FAILURE.full_name:
        return {}
    return {"failed_runs": float(np.count_nonzero(np.diff(output.rows.offsets)))}


def estimated_share(coverage: Ragged) -> float | None:
    """The share of the runs' spans for which there are estimates; None where there is no span."""
    spans_s = (coverage["end_time_ns"] - coverage.stream.publish_time_ns).sum() * 1e-9
    return float(min(coverage["estimated_s"].sum() / spans_s, 1.0)) if spans_s > 0 else None


def coverage(output: Output) -> dict[str, float]:
    """What share of the span the other figures are of, and how many measurements were not used."""
    schema = output.rows.stream.schema.full_name
    if schema == schemas.SKIPPED.full_name:
        return {"skipped_measurements": float(len(output.rows))}
    share = estimated_share(output.rows) if schema == schemas.COVERAGE.full_name else None
    return {} if share is None else {"estimated_share": share}


def solution(output: Output) -> dict[str, float]:
    """How the batch solutions ended: the share that converged, and the most iterations of one."""
    if output.rows.stream.schema.full_name != schemas.SOLUTION.full_name or len(output.rows) == 0:
        return {}
    converged, iterations = output.rows["converged"] != 0, output.rows["iterations"]
    values = {"converged_share": float(converged.mean())}
    if converged.any():
        values["most_iterations"] = float(iterations[converged].max())
    return values


ACCURACY = Metric("RMSE of position and other components against truth", Errors, accuracy)
CONSISTENCY = Metric("NEES against its chi-square bounds", Errors, consistency)
INNOVATION = Metric("NIS, and the share of measurements that a gate kept out", Innovations, innovation)
LIKELIHOOD = Metric("log-likelihood of the measurements, per run", Innovations, likelihood)
FAILURES = Metric("how many runs an estimator could not follow to the end", Output, failures)
COVERAGE = Metric("what share of the span was estimated, and what was not used", Output, coverage)
SOLUTION = Metric("how many batch solutions converged, and how fast", Output, solution)
