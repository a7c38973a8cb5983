"""Metrics for any estimator: errors, consistency, innovations, failures, coverage.

NEES and NIS: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fuselog.recorders.compiling.compile import compiled
from fuselog.recorders.log import schemas
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.judging.errors.evaluation import (
    POSITION,
    Errors,
    Floats,
    Innovations,
    chi_square_interval,
)
from fuselog.replay.judging.metrics.measuring import Metric, Output, Sums, metric_of_sums
from fuselog.replay.judging.metrics.sums import BinnedSums


def squares(errors: Errors) -> Sums:
    """Sum squared errors of the position and of every other component, by the name of their RMSE."""
    found: Sums = {"estimates": len(errors.error), "estimates_without_truth": errors.without_truth}
    found |= squares_by_name(errors.squared, errors.components, errors.kinds)
    return found | {rmse_of(name): np.nan for name in errors.components_without_truth}


def squares_by_name(squared: Floats, components: Sequence[str], kinds: Sequence[str]) -> Sums:
    """Sum squared errors (n, d) by the name of their RMSE; see `squares`.

    Args:
        squared: (n, d), in the squares of the components' units.
        components: the names of the d components.
        kinds: their kinds.
    """
    found: Sums = {}
    if squared.shape[1] > 1:  # equals the sum of NumPy, which takes six times as long
        totals = np.empty(squared.shape[1])
        _add_rows(squared, totals)
    else:
        totals = np.sum(squared, axis=0)
    position = [index for index, name in enumerate(components) if name in POSITION]
    rotation = [index for index, kind in enumerate(kinds) if kind == "rotation"]
    if position:
        found["position_rmse_m"] = float(totals[position].sum())
    if rotation:
        found["orientation_rmse_deg"] = np.degrees(np.degrees(totals[rotation].sum()))
    for column, name in enumerate(components):
        if column not in position:
            found[rmse_of(name)] = float(totals[column])
    return found


def add_rows(values: Floats, totals: Floats) -> None:
    """Sum the columns of values, row by row.

    Args:
        values: (n, d).
        totals: (d,), filled.
    """
    totals[:] = 0.0
    for row in range(len(values)):
        for column in range(values.shape[1]):
            totals[column] += values[row, column]


_add_rows = compiled(add_rows)


def accuracy(sums: Sums) -> dict[str, float]:
    """Compute the RMSE of position, orientation and all other components over all runs and steps.

    The RMSE of a component without truth is NaN, which is written as null.
    """
    if not sums:
        return {}
    count = sums["estimates"]
    values = {
        name: float(np.sqrt(value / count)) if count else np.nan
        for name, value in sums.items()
        if name not in ("estimates", "estimates_without_truth") and (count or np.isnan(value))
    }
    return values | {"estimates_without_truth": sums["estimates_without_truth"]}


def rmse_of(component: str) -> str:
    """Return the name of the RMSE of a component, such as `turn_rmse_radps` for `turn_radps`."""
    quantity, _, unit = component.rpartition("_")
    return f"{quantity}_rmse_{unit}".strip("_")


@dataclass
class Consistent:
    """Sums of NEES: over all steps and runs, and by step over the runs.

    Attributes:
        count, total: number and sum of finite NEES of the state.
        places, of_places: number and sum of finite NEES of the position.
        missing: number of estimates without a NEES because their covariance is singular.
        by_step: sums of the NEES by step, in one column.
        components: number of components of the state.
    """

    count: int
    total: float
    places: int
    of_places: float
    missing: int
    by_step: BinnedSums
    components: int


def _no_nees() -> Consistent:
    return Consistent(0, 0.0, 0, 0.0, 0, BinnedSums(1), 0)


def _add_nees(state: Consistent, errors: Errors) -> Consistent:
    if errors.is_bound:
        return state
    finite = np.isfinite(errors.nees)
    step, nees = errors.step, errors.nees
    if not finite.all():
        step, nees = step[finite], nees[finite]
    state.count += len(nees)
    state.total += float(nees.sum())
    state.missing += len(finite) - len(nees)
    state.components = len(errors.components)
    if errors.position and len(errors.position) < len(errors.components):
        squared = errors.position_nees
        if squared is None:
            block = errors.covariance[:, errors.position][:, :, errors.position]
            squared = normalized_error_squared(errors.error[:, errors.position], block)
        is_known = np.isfinite(squared)
        known = squared if is_known.all() else squared[is_known]
        state.places += len(known)
        state.of_places += float(known.sum())
    state.by_step.add(step, nees[:, None])
    return state


def _merge_nees(first: Consistent, second: Consistent) -> Consistent:
    first.count += second.count
    first.total += second.total
    first.places += second.places
    first.of_places += second.of_places
    first.missing += second.missing
    first.components = max(first.components, second.components)
    first.by_step.merge(second.by_step)
    return first


def consistency(state: Consistent) -> dict[str, float]:
    """Compute the mean NEES of state and position, and the fraction of steps within the bounds."""
    if state.count == 0:
        return {}
    values = {"nees": state.total / state.count}
    if state.missing:  # singular covariances have no NEES
        values["estimates_without_nees"] = float(state.missing)
    if state.places:
        values["position_nees"] = state.of_places / state.places
    _, runs, sums = state.by_step.filled()
    low, high = step_bounds(runs, state.components)
    nees = sums[:, 0] / runs
    values["nees_steps_within_95"] = float(((nees >= low) & (nees <= high)).mean())
    return values


def step_bounds(runs: Floats, size: int) -> tuple[Floats, Floats]:
    """Compute the lower and upper 95 % bounds (n,) of the mean NEES over the given numbers of runs.

    Args:
        runs: (n,), number of runs at each step.
        size: number of components of the error.
    """
    counts, place = np.unique(runs, return_inverse=True)
    bounds = np.array([chi_square_interval(size, int(count)) for count in counts])
    return bounds.reshape(-1, 2)[place, 0], bounds.reshape(-1, 2)[place, 1]


def _nis(innovations: Innovations) -> Sums:
    return {
        "messages": len(innovations.squared),
        "squared": float(innovations.squared.sum()),
        "degrees": int(innovations.degrees.sum()),
        "accepted": int(innovations.accepted.sum()),
    }


def innovation(sums: Sums) -> dict[str, float]:
    """Compute the mean NIS per measured component (expected: 1) and the fraction rejected by a gate."""
    if not sums.get("messages"):
        return {}
    gated = {"gated_share": 1 - sums["accepted"] / sums["messages"]}
    if not sums["degrees"]:  # no message measured a component
        return gated
    return {"nis_per_component": sums["squared"] / sums["degrees"], **gated}


def _log_likelihoods(innovations: Innovations) -> Sums:
    """Sum log-likelihoods; NaN if the likelihood of an accepted measurement is not stated."""
    stated = innovations.log_likelihood
    accepted_likelihood = np.array([np.nan]) if stated is None else stated[innovations.accepted]
    run = innovations.run
    runs = {*run[np.flatnonzero(run[1:] != run[:-1])].tolist(), *run[-1:].tolist()}
    return {"log_likelihood": float(accepted_likelihood.sum()), "runs": runs}


def likelihood(sums: Sums) -> dict[str, float]:
    """Compute the log-likelihood of the measurements of a run under the predictions, averaged over runs.

    Only accepted measurements are included, so gates cannot be tuned by this metric. There is no result
    if the estimator does not state all likelihoods.
    """
    if not sums.get("runs") or not np.isfinite(sums["log_likelihood"]):
        return {}
    return {"log_likelihood": sums["log_likelihood"] / len(sums["runs"])}


def _failed(output: Output) -> Sums:
    if output.rows.stream.schema.full_name != schemas.FAILURE.full_name:
        return {}
    return {"runs": set((output.first_run + np.flatnonzero(np.diff(output.rows.offsets))).tolist())}


def failures(sums: Sums) -> dict[str, float]:
    """Count the failed runs."""
    return {"failed_runs": float(len(sums["runs"]))} if sums else {}


def covered(output: Output) -> Sums:
    """Sum durations of runs, durations with estimates, unused measurements and ages of estimates.

    The age of an estimate is the time from its stamp to its availability.
    """
    schema, stream = output.rows.stream.schema.full_name, output.rows.stream
    if schema == schemas.GAUSSIAN_ESTIMATE.full_name:
        ages_ns = stream.log_time_ns - stream.publish_time_ns
        return {"estimates": len(stream), "age_s": float(ages_ns.sum() * 1e-9)}
    if schema == schemas.SKIPPED.full_name:
        return {"skipped": len(output.rows)}
    if schema != schemas.COVERAGE.full_name:
        return {}
    spans_ns = output.rows["end_time_ns"] - output.rows.stream.publish_time_ns
    return {
        "span_s": float(spans_ns.sum() * 1e-9),
        "estimated_s": float(output.rows["estimated_s"].sum()),
    }


def coverage(sums: Sums) -> dict[str, float]:
    """Compute the fraction of time with estimates, the unused measurements, or the mean age."""
    if "age_s" in sums:
        return {"estimate_age_s": sums["age_s"] / sums["estimates"]} if sums["age_s"] > 0.0 else {}
    if "skipped" in sums:
        return {"skipped_measurements": float(sums["skipped"])}
    share = estimated_share(sums)
    return {} if share is None else {"estimated_share": share}


def estimated_share(sums: Sums) -> float | None:
    """Compute the fraction of the time of runs that estimates cover; None if runs have no span."""
    return min(sums["estimated_s"] / sums["span_s"], 1.0) if sums.get("span_s") else None


def _solved(output: Output) -> Sums:
    if output.rows.stream.schema.full_name == schemas.ITERATION.full_name:
        starts = output.rows["iteration"] == 0
        return {"starts": int(starts.sum()), "start_cost": float(output.rows["cost"][starts].sum())}
    if output.rows.stream.schema.full_name != schemas.SOLUTION.full_name:
        return {}
    converged = output.rows["converged"] != 0
    states_start = "start" in output.rows.stream.metadata
    return {
        "solutions": len(converged),
        "converged": int(converged.sum()),
        "iterations": set(output.rows["iterations"][converged].tolist()),
        **({"cost": float(output.rows["cost"].sum())} if states_start else {}),
    }


def solution(sums: Sums) -> dict[str, float]:
    """Compute the share of batch solutions that converged, and the largest number of iterations.

    If the channel states the start, the mean final cost is included. For streams of single iterations,
    only the mean cost of the initial trajectory is computed.
    """
    if sums.get("starts"):
        return {"start_cost": sums["start_cost"] / sums["starts"]}
    if not sums.get("solutions"):
        return {}
    values = {"converged_share": sums["converged"] / sums["solutions"]}
    if sums["iterations"]:
        values["most_iterations"] = float(max(sums["iterations"]))
    if "cost" in sums:
        values["cost"] = sums["cost"] / sums["solutions"]
    return values


def _effective(output: Output) -> Sums:
    if output.rows.stream.schema.full_name != schemas.EFFECTIVE_PARTICLES.full_name:
        return {}
    shares = output.rows["effective"] / output.rows["particles"]
    return {"estimates": len(shares), "shares": float(shares.sum())}


def effective(sums: Sums) -> dict[str, float]:
    """Compute the mean effective share of particles, 1 / (N sum w^2), over all estimates."""
    return {"effective_share": sums["shares"] / sums["estimates"]} if sums.get("estimates") else {}


ACCURACY = metric_of_sums(
    "RMSE of position and other components against truth", Errors, squares, accuracy
)
CONSISTENCY = Metric(
    "NEES against its chi-square bounds", Errors, _no_nees, _add_nees, _merge_nees, consistency
)
INNOVATION = metric_of_sums(
    "NIS, and the share of measurements that a gate rejected", Innovations, _nis, innovation
)
LIKELIHOOD = metric_of_sums(
    "log-likelihood of the measurements, per run", Innovations, _log_likelihoods, likelihood
)
FAILURES = metric_of_sums(
    "number of runs that an estimator could not process to the end", Output, _failed, failures
)
COVERAGE = metric_of_sums(
    "share of the span that was estimated, unused measurements, and age of delayed estimates",
    Output,
    covered,
    coverage,
)
SOLUTION = metric_of_sums(
    "share of batch solutions that converged, and their iterations", Output, _solved, solution
)
PARTICLES = metric_of_sums(
    "effective share of the particles, given their weights",
    Output,
    _effective,
    effective,
)
