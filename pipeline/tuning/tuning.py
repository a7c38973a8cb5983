"""Search for the parameters of an estimator that explain logs best.

The main method is maximum likelihood: Durbin and Koopman, Time Series Analysis by State Space Methods,
2nd ed. 2012, chapter 7.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from fuselog.pipeline.altering.changes import is_of_topic
from fuselog.pipeline.altering.sources import split_settings
from fuselog.pipeline.api.planning import Log, Named, settings_of, sources_of
from fuselog.pipeline.optimise import DROP_95, beside, curvature
from fuselog.pipeline.runs.executors import WorkerPool, pool_for
from fuselog.pipeline.runs.trials import Trial, with_values
from fuselog.pipeline.tuning.confidence import (
    Confidence,
    SearchOutcome,
    confidence,
    unknown,
    with_noise,
)
from fuselog.pipeline.tuning.information import conditions, in_words, information, undetermined
from fuselog.pipeline.tuning.objective import (
    CRITERIA,
    Best,
    By,
    Objective,
    Run,
    is_innovation,
    log_in_memory,
    silent,
    until_last_measured,
)
from fuselog.pipeline.tuning.outcome import START, TUNED, Source, Tuning
from fuselog.pipeline.tuning.search import (
    CURVATURE_STEP,
    LOOKS,
    MOVES,
    Coordinates,
    coordinates_of,
    least,
    least_of_grid,
    scanned,
)
from fuselog.recorders.errors import BadInput, choices, without_warnings_of_numbers
from fuselog.recorders.parameters import Parameter, field_of, merge, number_of
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.replaying.estimator import Bound, Recursive, bind
from fuselog.replay.engine.streams.channels import stated
from fuselog.replay.foreign.naming import allowed

# bounds of a positive parameter without bounds: its start value divided and multiplied by this
REACH = 1e4
OPEN = {"gate_probability": 1.0}
MOVED = 0.5  # change of the log-likelihood above which the noise of the controls matters
# standard errors from the optimum at which the effect of the controls' noise is evaluated
REACHES = np.array([1.0, 3.0, 10.0])
NOISY_STEP = 0.2  # step of the differences of a corrected cost, in coordinates: two standard errors
NOISY_REACH = 5.0  # largest such step in standard errors, if the step is derived from a useful error
NOISY_PAIRS = 32  # number of pairs of copies for the covariance of slopes; a power of two
DIVERGED = 2.0  # NIS per component: twice its expected value
ROUNDS = 4  # number of searches, each with the filters' starts at the values of the previous one


@without_warnings_of_numbers()
def tune(
    logs: Log | Iterable[Log],
    estimator: Named,
    free: str | Sequence[str],
    *,
    by: By | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002
    bounds: Mapping[str, tuple[float, float]] | None = None,
    grid: int = 1,
    validate: Log | Sequence[Log] = (),
    folds: int = 0,
    gap_limit_s: float = 0.2,
    workers: int | None = None,
    scheduler: str | None = None,
    executor: Executor | None = None,
    on_best: Callable[[Best], None] = silent,
) -> Tuning:
    """Find the parameters of an estimator that explain logs best.

    Args:
        logs: one or several logs with the same topics: paths, opened logs or recordings.
        estimator: a registered name, or a label of your own mapped to an estimator; see `replay`.
        free: the full names of the parameters to search for.
        by: the criterion. "likelihood" maximises the likelihood of the measurements and needs no truth;
            "nis" brings the mean squares of normalised innovations to one; "nees" does so for normalised
            errors; "rmse" minimises the RMSE. Default: "likelihood", or "rmse" if the estimator has no
            innovations.
        set: values of other parameters, and start values of the free ones; by default those in the log's
            channels. Settings can also alter topics; see `replay`.
        bounds: the interval of each parameter. If both bounds are positive, the parameter is positive.
        grid: number of values per parameter between its bounds; the search starts from the best point.
        validate: held-out logs on which the values are judged.
        folds: number of folds for cross-validation: each fold is judged with the values from all others.
        gap_limit_s: longest gap over which the truth is interpolated.
        workers: processes that share points and logs, as for `run`; by default threads of this process.
        scheduler: as for `run`.
        executor: as for `run`.
        on_best: function that is called repeatedly with the best values so far.

    Returns:
        The parameters with 95 % intervals, and replays of the logs with the start and the tuned values.

    Ctrl-C ends the search and keeps the best values so far. The gate is open while "likelihood" or "nis"
    is optimised. Raises BadInput if there is nothing to search for, or if a log cannot be replayed with
    the start values.

    >>> from fuselog.pipeline.api.api import record
    >>> log = record("landmarks", duration_s=20.0)
    >>> found = tune(log, "ekf", "sigma_range_m", set={"sigma_range_m": 0.5})
    >>> found.parameters["value"].round(1).tolist()
    [0.1]
    """
    if by is not None and by not in CRITERIA:
        raise BadInput(f"--by {by}: {choices(by, CRITERIA)}")
    alterations, given = split_settings(set or {})
    sources = sources_of(logs, alterations)
    held_out = sources_of(validate, alterations) if validate else []
    if folds and not 2 <= folds <= len(sources):
        raise BadInput(
            f"--folds {folds}: expected a number between 2 and the number of logs, {len(sources)}"
        )
    chosen = settings_of(estimator)
    if len(chosen) > 1:
        raise BadInput(f"{', '.join(chosen)}: give one estimator; only one can be tuned at a time")
    [(label, own)] = chosen.items()
    settings = {"kind": label, **merge(own, allowed(given))}
    bound = bind(label, sources, settings)
    sources = [until_last_measured(each, bound) for each in sources]
    trials = [Trial(label, log_in_memory(source, bound), settings) for source in sources]
    by = by or _criterion(trials[0])
    searched = _searched([free] if isinstance(free, str) else free, bounds or {}, by, sources[0], bound)
    _refuse_random(label, bound, by)
    start = np.array([each.default for each in searched])
    unseen = [log_in_memory(each, bind(label, held_out, settings)) for each in held_out]
    opened = OPEN if CRITERIA[by].is_smooth and gate_of(bound) < 1.0 else {}
    runs = [Run(each.with_settings(opened)) for each in trials]
    others = [Run(Trial(label, each, merge(settings, opened))) for each in unseen]
    names = [each.name for each in searched]

    with _pool(workers, scheduler, executor) as pool:

        def objective(runs: Sequence[Run]) -> Objective:
            made = Objective(names, runs, by, gap_limit_s, on_best, pool)
            made.begin(start)
            return made

        whole, beyond = objective(runs), objective(others) if others else None
        found = _found(whole, searched, grid)
        compared = np.array([start, found.optimum])
        costs, held_out_costs = whole(compared), beyond(compared) if beyond else None
        rows = []
        for fold in range(folds):
            left_out = runs[fold::folds]
            rest = [run for number, run in enumerate(runs) if number % folds != fold]
            rows.append(_row_of_fold(fold, objective(left_out), objective(rest), searched, grid))
    whole.pool = None
    return Tuning(
        label,
        sources,
        held_out,
        {
            name: with_values(settings, dict(zip(names, values, strict=True)))
            for name, values in zip((START, TUNED), compared.tolist(), strict=True)
        },
        whole,
        found,
        costs=costs,
        held_out_costs=held_out_costs,
        folds=pd.DataFrame(rows),
        gate=gate_of(bound) if opened else 1.0,
    )


def _pool(
    workers: int | None, scheduler: str | None, executor: Executor | None
) -> AbstractContextManager[WorkerPool | None]:
    """Choose the executor of evaluations; None means threads of this process."""
    if workers is None and scheduler is None and executor is None:
        return nullcontext()
    return pool_for(workers, scheduler, 1, executor)()


def _criterion(trial: Trial) -> By:
    """Choose the criterion: likelihood, or RMSE if the estimator has no innovations."""
    return "likelihood" if any(map(is_innovation, trial.outputs().values())) else "rmse"


def gate_of(bound: Sequence[Bound]) -> float:
    """Return the probability with which the gate accepts a correct measurement; 1 without a gate."""
    return float(getattr(bound[0].parameters, "gate_probability", None) or 1.0)


def _refuse_random(label: str, bound: Sequence[Bound], by: By) -> None:
    """Raise BadInput if a search would fit the random numbers that the estimator draws."""
    if CRITERIA[by].is_smooth and any(isinstance(each, Recursive) and each.is_random for each in bound):
        raise BadInput(
            f"estimator {label}: draws random numbers, so its likelihood changes randomly between "
            "evaluations; tune a deterministic method such as -e ukf and replay this estimator with the "
            "result, or use tune --by rmse"
        )


def _searched(
    names: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    by: By,
    source: Source,
    bound: Sequence[Bound],
) -> list[Parameter]:
    """Describe the parameters to search for.

    Raises BadInput for unknown or repeated names, and for start values or bounds that cannot be used.
    """
    if not names:
        raise BadInput("--free: name at least one parameter to search for")
    for name in bounds:
        if name not in names:
            raise BadInput(f"--bound {name}: --free does not name it; {choices(name, names)}")
    for number, name in enumerate(names):
        if name in names[:number]:
            raise BadInput(f"--free {name}: the parameter is named twice; name it once")
        if name in OPEN and CRITERIA[by].is_smooth:
            raise BadInput(
                f"--free {name}: the likelihood would be largest if the gate rejected all measurements; "
                "leave it out, or tune --by nees"
            )
    return [_free(name, bounds.get(name), source, bound[0]) for name in names]


def _free(name: str, given: tuple[float, float] | None, source: Source, bound: Bound) -> Parameter:
    assert bound.parameters is not None
    try:
        declared = number_of(type(bound.parameters), name)
    except BadInput as error:
        raise BadInput(f"--free {name}: {error}") from None
    least, greatest = declared.low, declared.high
    start, is_assumed = value_at_start(name, source, bound)
    useful = 0.0
    if least < 0.0 and isinstance(bound, Recursive) and bound.reading is not None:
        useful = bound.reading().calibration.get(name, 0.0)
    is_log = least >= 0.0 or (given is not None and given[0] > 0.0 and not useful)
    if is_log and start <= 0.0 and given is None:
        raise BadInput(
            f"--free {name}: the search uses the logarithm of this parameter, but the start value is "
            f"{start:g}; give a positive start value with --set {name}=..."
        )
    low, high = given or ((start / REACH, start * REACH) if is_log else (least, greatest))
    if not (low < start < high and (low > 0.0 if is_log else low >= least)):
        raise BadInput(
            f"--bound {name}={low:g}:{high:g}: expected bounds{' above zero' if is_log else ''} on both "
            f"sides of the start value, {start:g}; give other bounds, or --set {name}=..."
        )
    return declared._replace(
        default=start,
        low=low,
        high=min(high, greatest),
        is_log=is_log,
        is_assumed=is_assumed,
        useful=useful,
    )


def value_at_start(name: str, source: Source, bound: Bound) -> tuple[float, bool]:
    """Return a parameter's value on a log, by its full name, and whether this value is assumed.

    Raises BadInput if the value is neither in the settings nor in the log's channels.
    """
    value: Any = bound.parameters
    for part in [field_of(name)] if is_of_topic(name) else name.split("."):
        value = value.get(part) if isinstance(value, Mapping) else getattr(value, part, None)
    if value is not None:
        return value, False
    if isinstance(bound, Recursive) and field_of(name) in bound.assumed:
        return bound.assumed[field_of(name)], True
    topic, _, own = name.rpartition(".") if is_of_topic(name) else ("", "", name)
    read = [source.topics[each] for each in (topic, *bound.streams, *bound.static) if each]
    kind = None if bound.parameters is None else type(bound.parameters)
    return stated(read, own, kind), False


def _found(objective: Objective, free: Sequence[Parameter], grid: int) -> SearchOutcome:
    """Search for the values with the lowest cost.

    The cost is corrected if the noise of the controls matters, and a spike of the likelihood is
    rejected. Ctrl-C ends the search with the best values so far.
    """
    start = np.array([each.default for each in free])
    try:
        if reaches_s := _blocked(objective, _held(objective, free, start)[0], start):
            objective.begin_after(start, reaches_s)
        found = _settled(objective, free, grid)
        if reaches_s := _blocked(objective, found.coordinates.free, found.optimum):
            objective.begin_after(start, reaches_s)
            found = _settled(objective, free, grid)
        if _is_moved_by_noise(objective, found):
            objective.begin(start)
            objective(np.array([found.optimum]))  # the best values so far, measured by the new cost
            found = _settled(objective, free, grid)
        return _confirmed(objective, found)
    except KeyboardInterrupt as stopped:
        if type(stopped) is not KeyboardInterrupt:  # a signal that ends the process
            raise
        coordinates = Coordinates(free, np.ones(len(free)))
        best = objective.best
        return SearchOutcome(coordinates, best.point, best.evaluations, was_stopped=True)


def _blocked(objective: Objective, free: Sequence[Parameter], values: Floats) -> dict[str, float]:
    """Return, for calibration parameters whose increase loses measurements, the largest tried values.

    An increase loses measurements if a delay moves a message to before the start of the filter.
    """
    places = [place for place, each in enumerate(free) if each.useful and not each.is_fixed]
    if not places:
        return {}
    steps = np.diag([each.useful for each in free])[places]
    return {
        free[place].name: float(values[place] + MOVES[-1] * free[place].useful)
        for place, cost in zip(places, objective(values + steps), strict=True)
        if not np.isfinite(cost)
    }


def _is_moved_by_noise(objective: Objective, found: SearchOutcome) -> bool:
    """Correct the cost for the noise of the controls if this noise may move the minimum.

    This is the case if the noise changes the cost by at least MOVED, and by at least half of the cost's
    rise, at a few standard errors of a parameter from the minimum. One standard error is too close: the
    noise matters most if stamps are shifted by half a step, and about equally on both sides.
    """
    if found.confidence is None:
        return False
    point = found.coordinates.of(found.optimum)
    errors = np.zeros(len(point))
    errors[list(found.confidence.places)] = np.nan_to_num(found.confidence.errors, posinf=0.0)
    objective.correct(found.optimum)
    errors[list(objective.held)] = 0.0
    is_moved = False
    if objective.is_corrected and errors.any():
        along = np.diag(errors)[errors > 0.0]
        ways = (reach * along for reach in (*REACHES, *(-REACHES)))
        points = found.coordinates.values(np.concatenate([point[None], *(point + way for way in ways)]))
        lost = objective.lost_by_noise(points).mean(axis=(1, 2))
        objective.leave_noise()
        costs = objective(points)
        changes = np.abs(lost - lost[0])
        is_moved = bool(np.any(changes > np.maximum(MOVED, 0.5 * (costs - costs[0]))))
    if is_moved:
        objective.correct(found.optimum)
    else:
        objective.leave_noise()
    return is_moved


def _settled(objective: Objective, free: Sequence[Parameter], grid: int) -> SearchOutcome:
    """Search until filters begin at the same stamps with the found values as in the search.

    Without a prior in the log, the stamp at which a filter begins depends on the values, for example on
    how much the filter trusts its own path between the first fixes. The stamp at which a filter begins
    is fixed during a search, because likelihoods of different measurements cannot be compared. In the
    next search, this stamp is determined by the values that the previous search found.
    """
    start = np.array([each.default for each in free])
    free, open_ = _held(objective, free, start)
    found = _search(objective, free, grid)._replace(**open_)
    nearer, there = _held(objective, free, found.optimum)
    if nearer != free:
        free, open_ = nearer, there
        found = _search(objective, free, grid)._replace(**open_)
    for _ in range(ROUNDS - 1):
        if objective.begins_alike(found.optimum):
            return found
        objective.begin(found.optimum)
        objective(np.array([found.optimum]))
        point = found.coordinates.of(found.optimum)
        found = _search(objective, free, 1, point)._replace(**open_)
    return found._replace(begins_alike=objective.begins_alike(found.optimum))


def _held(
    objective: Objective, free: Sequence[Parameter], values: Floats
) -> tuple[list[Parameter], dict[str, Any]]:
    """Fix calibration parameters at their start if the motion does not determine them at values (k,).

    Innovations are large far from the best values, so the test is repeated near the best values.
    Parameters that were fixed before stay fixed.
    """
    places = [place for place, each in enumerate(free) if each.useful]
    if objective.by != "likelihood" or not places:
        return list(free), {}
    useful = np.array([each.useful for each in free])
    known = information(objective, values, useful, places)
    lacking = undetermined(known)
    held = [
        free[place].name
        for number, place in enumerate(places)
        if number in lacking.places or free[place].is_fixed
    ]
    if not held:
        return list(free), {}
    sentence = in_words([free[place].name for place in places], lacking, free, held)
    kept = [each.fixed if each.name in held else each for each in free]
    return kept, {"held": held, "lacks": [sentence, *conditions(known, places, free, held)]}


def _search(
    objective: Objective, free: Sequence[Parameter], grid: int, point: Floats | None = None
) -> SearchOutcome:
    """Search for the values with the lowest cost and their confidence, from a point (k,) if given.

    A parameter on which the logs contain no information stays at its start. Raises BadInput if the cost
    does not depend on a parameter.
    """
    start = np.array([each.default for each in free])
    coordinates = coordinates_of(objective, free, start)
    if point is None:
        point = coordinates.of(start)
    if grid > 1:
        point = least_of_grid(objective, coordinates, grid)
    begin = coordinates.values(scanned(objective, coordinates, point))
    if not np.array_equal(begin, start):  # no unit can be found near values at which a filter diverges
        coordinates = coordinates_of(objective, free, begin)
        point = coordinates.of(begin)
    is_smooth = CRITERIA[objective.by].is_smooth
    point, has_converged = least(objective, coordinates, point, is_smooth=is_smooth)
    point, known, at_edge = _confidence_at(objective, coordinates, point)
    if known is not None and (places := unknown(known, coordinates)):
        kept = [each.fixed if place in places else each for place, each in enumerate(free)]
        nearer = replace(coordinates, free=kept)
        low, high = nearer.bounds
        ended, _ = least(objective, nearer, np.clip(point, low, high), is_smooth=is_smooth)
        best, cost = objective(np.array([coordinates.values(point), nearer.values(ended)]))
        if cost - best < DROP_95:
            coordinates = nearer
            point, known, at_edge = _confidence_at(objective, coordinates, ended)
    optimum, evaluations = coordinates.values(point), objective.best.evaluations
    return SearchOutcome(
        coordinates, optimum, evaluations, known, has_converged=has_converged, at_edge=at_edge
    )


def _confidence_at(
    objective: Objective, coordinates: Coordinates, point: Floats
) -> tuple[Floats, Confidence | None, list[str]]:
    """Compute the confidence in parameters that are not at a bound.

    Parameters are listed if runs fail near their values. If the cost is corrected for the noise of
    the controls, the point is moved too; see `_levelled`.
    """
    inner = np.flatnonzero(~coordinates.at_bounds(point))
    if objective.by != "likelihood" or not len(inner):
        return point, None, []
    steps = np.full(len(inner), CURVATURE_STEP)
    if objective.is_corrected:
        steps = _noisy_steps(objective, coordinates, point, inner.tolist())
        point = _levelled(objective, coordinates, point, inner.tolist(), steps)
    bent = _curvature(objective, coordinates, point, inner.tolist(), steps)
    is_known = np.isfinite(np.diagonal(bent))
    if not np.isfinite(bent[np.ix_(is_known, is_known)]).all():
        is_known[:] = False
    at_edge = [coordinates.free[place].name for place in inner[~is_known].tolist()]
    if not is_known.any():
        return point, None, at_edge
    places, steps, bent = inner[is_known].tolist(), steps[is_known], bent[np.ix_(is_known, is_known)]
    if objective.is_corrected:
        noise = _noise_of_slopes(objective, coordinates, point, places, steps)
        if not np.isfinite(noise).all():  # copies fail
            return point, None, [coordinates.free[place].name for place in inner.tolist()]
        bent = with_noise(bent, noise)
    return point, confidence(places, bent), at_edge


def _noisy_steps(
    objective: Objective, coordinates: Coordinates, point: Floats, places: Sequence[int]
) -> Floats:
    """Choose the difference steps (m,) for a cost that the noise of the controls makes jagged.

    The cost jumps, randomly up or down, where shifted stamps coincide with the stamps of a control.
    Differences for calibration parameters are therefore as wide as the useful error, but at most
    NOISY_REACH standard errors.
    """
    free, units = [coordinates.free[place] for place in places], coordinates.units[list(places)]
    useful = np.array([0.0 if each.is_log else each.useful for each in free]) / units
    others = np.where([each.is_log for each in free], CURVATURE_STEP, NOISY_STEP)
    steps = np.where(useful > 0.0, useful, others)
    for _ in range(LOOKS):
        bends = beside(coordinates.over(objective), point, places, steps).bends
        with np.errstate(divide="ignore", invalid="ignore"):
            nearer = NOISY_REACH / np.sqrt(bends)
        nearer = np.where(np.isfinite(bends), nearer, 0.5 * steps)
        steps = np.where((useful > 0.0) & (nearer < steps), nearer, steps)
    return steps


def _curvature(
    objective: Objective,
    coordinates: Coordinates,
    point: Floats,
    places: Sequence[int],
    steps: Floats,
) -> Floats:
    """Compute the curvature (m, m); if the cost is corrected, the steps are twice as long.

    A jump of the cost next to the point then has the same effect on the curvature as on differences of
    slopes over these steps.
    """
    times = 2.0 if objective.is_corrected else 1.0
    return curvature(coordinates.over(objective), point, places, times * steps)[1]


def _levelled(
    objective: Objective,
    coordinates: Coordinates,
    point: Floats,
    places: Sequence[int],
    steps: Floats,
) -> Floats:
    """Move a point towards one at which the costs one step (m,) ahead and behind are equal.

    The mean of the cost over these steps has its minimum at such a point; jumps of the cost do not
    attract this minimum.
    """
    low, high = coordinates.bounds
    rows = list(places)
    bent = _curvature(objective, coordinates, point, places, steps)
    if not np.isfinite(bent).all() or np.linalg.eigvalsh(bent)[0] <= 0.0:
        return point
    level = point
    for _ in range(LOOKS):
        move = -np.linalg.solve(bent, beside(coordinates.over(objective), level, places, steps).slopes)
        if not np.isfinite(move).all():
            return point
        level = level.copy()
        level[rows] = np.clip(level[rows] + np.clip(move, -steps, steps), low[rows], high[rows])
    return level


def _noise_of_slopes(
    objective: Objective,
    coordinates: Coordinates,
    point: Floats,
    places: Sequence[int],
    steps: Floats,
) -> Floats:
    """Compute the covariance (m, m) of the cost's slopes caused by the noise of the controls.

    The result is not finite if the copies fail.
    """
    along = steps[:, None] * np.eye(len(point))[list(places)]
    points = coordinates.values(np.concatenate([point + along, point - along]))
    wider = objective.with_pairs(coordinates.values(point), NOISY_PAIRS)
    lost = wider.lost_by_noise(points)
    lost = lost[:, np.isfinite(lost).all(axis=(0, 2))]
    if lost.shape[1] < 2:
        return np.full((len(steps), len(steps)), np.nan)
    ahead, behind = np.split(0.5 * (lost[:, :, 0] - lost[:, :, 1]), 2)
    return np.atleast_2d(np.cov((ahead - behind) / (2.0 * steps[:, None])))


def _confirmed(objective: Objective, found: SearchOutcome) -> SearchOutcome:
    """Search from a second start if innovations are too large with the values found.

    If this search ends at other values that explain the logs less well, the optimum is a spike of the
    likelihood of a diverging filter, and has no interval.
    """
    if found.confidence is None or objective.nis(found.optimum) < DIVERGED:
        return found
    coordinates = found.coordinates
    moves = [  # these are not steps that the scan would reverse
        0.0 if each.is_fixed else np.log(2.0) if each.is_log else 2.0 * (each.useful or unit) / unit
        for each, unit in zip(coordinates.free, coordinates.units, strict=True)
    ]
    low, high = coordinates.bounds
    second = np.clip(coordinates.of(found.optimum) + moves, low, high)
    ended, _ = least(objective, coordinates, second, is_smooth=True)
    best, cost = objective(np.array([found.optimum, coordinates.values(ended)]))
    if abs(cost - best) < DROP_95:
        return found
    if cost < best:
        better = _search(objective, coordinates.free, 1, ended)
        return better._replace(held=found.held, lacks=found.lacks, begins_alike=found.begins_alike)
    return found._replace(confidence=None, is_spike=True)


def _row_of_fold(
    number: int, left_out: Objective, rest: Objective, free: Sequence[Parameter], grid: int
) -> dict[str, Any]:
    """Tune on all other logs, and compute the cost of the logs of one fold with the result."""
    found = _found(rest, free, grid)
    start = np.array([each.default for each in free])
    costs = left_out(np.array([start, found.optimum]))
    return {
        "fold": number,
        "left_out": ", ".join(run.trial.source.name for run in left_out.runs),
        **dict(zip(rest.names, found.optimum.tolist(), strict=True)),
        f"cost_{START}": costs[0],
        f"cost_{TUNED}": costs[1],
    }
