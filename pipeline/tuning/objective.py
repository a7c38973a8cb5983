"""The cost that tuning minimises, which is computed from replays of logs with other parameters.

Every log is replayed separately, and the cost of a point is computed from the sums over all logs, in
their order. Logs and points are shared among threads, whose kernels run in parallel, or among the
workers of a pool.
"""

import pickle
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Any, Literal, NamedTuple

import numpy as np

from fuselog.pipeline.runs.executors import WorkerPool, threads
from fuselog.pipeline.runs.trials import Trial, alike, in_memory_together, together
from fuselog.pipeline.tuning.broad_starts import (
    Starts,
    begun_at,
    broad_starts,
    initialization_of,
    mean_likelihood,
    part_count,
    with_find,
)
from fuselog.pipeline.tuning.control_noise import PAIRS, disturbed
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Stream, schemas, topics_of
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.replaying.estimator import Bound, Estimator, Initialized, Recursive
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged, gather
from fuselog.replay.engine.streams.ensembles import Ensemble, ensemble_of
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import LogSource, MemorySource, in_memory
from fuselog.replay.judging.consistency.whiteness import whitened
from fuselog.replay.judging.judge import Judge
from fuselog.replay.judging.metrics.measuring import Sums, plus

By = Literal["likelihood", "nis", "nees", "rmse"]
NOISE = "noise"  # key of the cost of a log's control noise, next to the topics of estimates
INNOVATION, FAILURE = schemas.INNOVATION.full_name, schemas.FAILURE.full_name

# time in s for which controls are kept, so that the last measurement is between two controls
BEYOND_NS = 1_000_000_000


class Run(NamedTuple):
    """A log that is replayed repeatedly.

    Attributes:
        trial: the log in memory, with the settings of the estimator that are not searched for.
        begun: the initial state of each estimated object by name, if the log has none; see `begin`.
        starts: the starts with which likelihoods are compared, instead of `begun`.
        parts: the log, repeated for each part of `starts`.
        disturbed: copies with noise added to the controls, if the cost is corrected for that noise.
    """

    trial: Trial
    begun: Mapping[str, Initialized] = {}
    starts: Starts = {}
    parts: Ensemble[MemorySource] = Ensemble([])
    disturbed: Sequence[MemorySource] = ()

    @property
    def compared(self) -> Ensemble[MemorySource]:
        """Return the runs whose likelihoods are compared: the log, or its copies for `starts`."""
        return self.parts or ensemble_of(self.trial.runs)


def log_in_memory(source: LogSource | MemorySource, bound: Iterable[Bound]) -> Ensemble[MemorySource]:
    """Read the topics that estimators read, and the log's truths, into an ensemble of one run."""
    topics = {topic for each in bound for topic in (*each.static, *each.streams)}
    truths = topics_of(source.topics, schemas.TRUTH_STATE)
    topics |= {name for name in truths if not name.startswith("/estimates/")}
    return Ensemble([in_memory(source, sorted(topics))])


def for_likelihood(settings: Mapping[str, Any]) -> str:
    """Describe how a user's own estimator can return a likelihood; "" for other estimators."""
    kind = settings.get("kind")
    if isinstance(kind, Estimator):
        return (
            "in the `follow` function of the recursion, fill results.innovation, "
            "results.innovation_covariance and results.squared, and name the components in `measured`"
        )
    if kind in ("lib", "exec"):
        return (
            "a filter of your own has to describe and return its `innovation`; a program that reads a "
            "log has to write fuselog.Innovation"
        )
    return ""


def is_innovation(rows: Ragged) -> bool:
    """Test whether an output is a stream of innovations."""
    return rows.stream.schema.full_name == INNOVATION


def innovations_in(outputs: Mapping[str, Ragged]) -> Iterator[tuple[str, Stream]]:
    """Yield the innovation streams among one log's outputs, with their topics."""
    for topic, rows in outputs.items():
        if is_innovation(rows) and len(rows):
            yield topic, rows.stream


def _likelihood(run: Run, outputs: Mapping[str, Ragged], gap_limit_s: float) -> Sums:  # noqa: ARG001
    return {topic: float(stream["log_likelihood"].sum()) for topic, stream in innovations_in(outputs)}


def _nis(run: Run, outputs: Mapping[str, Ragged], gap_limit_s: float) -> Sums:  # noqa: ARG001
    """Sum and count the squares of whitened innovations by measured component."""
    found: Sums = {}
    for topic, stream in innovations_in(outputs):
        for name, column in zip(stream.components, whitened(stream).T, strict=True):
            known = column[np.isfinite(column)]
            found[f"{topic} {name}"] = np.array([np.sum(known**2), len(known)])
    return found


def _nees(run: Run, outputs: Mapping[str, Ragged], gap_limit_s: float) -> Sums:
    """Sum NEES by case, and count its components."""
    found: Sums = {}
    for errors in Judge(run.trial.runs, {}, gap_limit_s=gap_limit_s).add(outputs).errors:
        known = errors.nees[np.isfinite(errors.nees)]
        found[errors.case] = np.array([np.sum(known), len(known) * len(errors.components)])
    return found


def _rmse(run: Run, outputs: Mapping[str, Ragged], gap_limit_s: float) -> Sums:
    """Sum and count squared errors of the position, or of the first quantity that is judged."""
    found: Sums = {}
    for errors in Judge(run.trial.runs, {}, gap_limit_s=gap_limit_s).add(outputs).errors:
        squared = errors.error[:, errors.main.columns] ** 2
        found = plus(found, {errors.main.rmse: np.array([np.sum(squared), len(squared)])})
    return found


def _cost_of_likelihood(sums: Sums) -> float:
    return -float(sum(sums.values()))


def _cost_of_ratios(sums: Sums) -> float:
    """Compute the deviance of mean squares s/n from one: the sum of n/4 log(s/n)^2."""
    squares = np.array(list(sums.values()))
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(squares[:, 0] / squares[:, 1])
    return float(np.sum(0.25 * squares[:, 1] * logs**2))


def _cost_of_squares(sums: Sums) -> float:
    """Sum the logarithms of the RMSEs; logs with different kinds of truth have several RMSEs."""
    squares = np.array(list(sums.values()))
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(0.5 * np.sum(np.log(squares[:, 0] / squares[:, 1])))


class Criterion(NamedTuple):
    """A criterion that tuning optimises.

    Attributes:
        sums: function that computes the sums over one log's outputs.
        cost: function that computes the cost from the sums; a run without values contributes nothing.
        is_smooth: whether the criterion uses innovations. If the criterion uses innovations, the gate is
            open, because a gate could change which innovations are used.
        lacks: description of what is missing in a log without such sums.
    """

    sums: Callable[[Run, Mapping[str, Ragged], float], Sums]
    cost: Callable[[Sums], float]
    is_smooth: bool
    lacks: str


CRITERIA: dict[By, Criterion] = {
    "likelihood": Criterion(_likelihood, _cost_of_likelihood, True, "innovations with a likelihood"),
    "nis": Criterion(_nis, _cost_of_ratios, True, "innovations"),
    "nees": Criterion(_nees, _cost_of_ratios, False, "truth to compare its estimates with"),
    "rmse": Criterion(_rmse, _cost_of_squares, False, "truth to compare its estimates with"),
}


class Best(NamedTuple):
    """The best point (k,) of a search so far, with its cost and the number of points tried."""

    evaluations: int
    point: Floats
    cost: float
    names: Sequence[str] = ()


def silent(_: Best) -> None:
    """Ignore the progress of a search."""


@dataclass
class Objective:
    """The cost of parameter values over logs.

    Attributes:
        names: the names of the parameters that are searched for.
        runs: the logs, with one estimator.
        by: the criterion.
        gap_limit_s: longest gap over which the truth is interpolated.
        on_best: function that is called with the best point after every batch.
        pool: the workers that replay; None means threads of this process.
        best: the best of all points so far.
        held: values of noise parameters, by their indices among the names (k,), that stay fixed in the
            correction of the cost; see `correct`.
        left_out: number of messages that `begin_after` left out, by topic.
    """

    names: Sequence[str]
    runs: Sequence[Run]
    by: By
    gap_limit_s: float
    on_best: Callable[[Best], None] = silent
    pool: WorkerPool | None = None
    best: Best = field(default_factory=lambda: Best(0, np.empty(0), np.inf))
    held: Mapping[int, float] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)
    _counts: list[int] = field(default_factory=list)

    def __call__(self, points: Floats) -> Floats:
        """Compute the costs (n,) of points (n, k); infinity if a run fails or uses fewer measurements.

        Raises BadInput if a worker dies.
        """
        sums = self._shared(points)
        costs = np.array(
            [self._cost([of_run[number] for of_run in sums]) for number in range(len(points))]
        )
        least = int(np.argmin(costs))
        best = Best(self.best.evaluations + len(points), points[least], float(costs[least]), self.names)
        if self.best.cost <= best.cost:
            best = self.best._replace(evaluations=best.evaluations)
        self.best = best
        self.on_best(best)
        return costs

    def _shared(self, points: Floats) -> list[list[Sums | None]]:
        """Compute the sums of every run at each point; all workers share the points."""
        with threads() if self.pool is None else nullcontext(self.pool) as pool:
            parts = np.array_split(points, min(pool.workers, len(points)))
            alone = self._without_runs()
            working = [
                [pool.executor.submit(alone.sums, part, run, count) for part in parts]
                for run, count in zip(self.runs, self._counts, strict=True)
            ]
            try:
                return [[sums for part in of_run for sums in part.result()] for of_run in working]
            except CancelledError:
                raise BadInput(
                    f"the scheduler ended while it was tuning {self.label}; start it again"
                ) from None
            except pool.lost as error:
                raise BadInput(
                    f"a worker process died while tuning {self.label} ({error}); try fewer workers"
                ) from error

    def _without_runs(self) -> "Objective":
        """Copy the objective without its runs, to send it to workers."""
        return replace(self, runs=(), on_best=silent, pool=None)

    def begin(self, start: Floats) -> None:
        """Record every log's message count, and the filters' initial states with start values (k,).

        The counts and the initial states stay fixed, because likelihoods of different measurements
        cannot be compared. Raises BadInput if a run fails, if a log lacks the quantity that is
        minimised, or if the estimator cannot be sent to other processes.
        """
        if self.pool is not None:
            try:
                pickle.dumps([run.trial.settings for run in self.runs])
            except (pickle.PicklingError, AttributeError, TypeError) as error:
                raise BadInput(
                    f"{self.label}: the estimator cannot be sent to another process ({error}); tune it "
                    "with one worker"
                ) from error
        counts, runs = [], [self.begun(start, run) for run in self.runs]
        for run in runs:
            name = run.trial.source.name
            outputs = self.outputs(start, run)
            failures = _failures(outputs)
            if failures:
                raise BadInput(
                    f"{name}: {self.label} fails with the start values of the search "
                    f"({failures[0]}); give other values with --set"
                )
            parts = _outputs_of([self._bound(start, run)], run, run.compared)
            count = max(map(self._count, parts))
            total = self._total(parts, run, count)
            if self.by == "likelihood" and total and -np.inf in total.values():
                raise BadInput(
                    f"{name}: {self.label} diverges with the start values of the search: its "
                    "log-likelihood is -inf; give other values with --set"
                )
            if not np.isfinite(self._cost([total])):
                remedy = for_likelihood(run.trial.settings) if self.by == "likelihood" else ""
                raise BadInput(
                    f"{name}: {self.label} has no {CRITERIA[self.by].lacks} on this log; tune by "
                    f"one of {', '.join(each for each in CRITERIA if each != self.by)} instead"
                    f"{', or ' if remedy else ''}{remedy}"
                )
            counts.append(count)
        self.runs, self._counts = runs, counts
        self.best = Best(self.best.evaluations, start, np.inf, self.names)

    def begin_after(self, start: Floats, reaches_s: Mapping[str, float]) -> None:
        """Begin without the messages that delays of up to `reaches_s` move to before the start.

        The messages that such delays move have no innovation, so likelihoods could not be compared.
        """
        runs = []
        for run in self.runs:
            source = run.trial.source
            streams = dict(source.streams)
            for each in self._bound(start, run):
                if not isinstance(each, Recursive) or each.reading is None:
                    continue
                first = each.streams if each.initialization else each.priors
                begin_ns = min(int(streams[topic].publish_time_ns.min()) for topic in first)
                for topic, name in each.reading().delays.items():
                    stream, reach_s = streams[topic], reaches_s.get(name, -np.inf)
                    is_after = stream.publish_time_ns >= begin_ns + 1e9 * reach_s
                    if is_after.any() and not is_after.all():
                        streams[topic] = stream.take(is_after)
                        self.left_out[topic] = self.left_out.get(topic, 0) + int(np.sum(~is_after))
            later = Ensemble([replace(source, streams=streams)])
            runs.append(run._replace(trial=replace(run.trial, runs=later)))
        self.runs = runs
        self.begin(start)

    def correct(self, values: Floats) -> None:
        """Correct the cost for the noise of the controls; see `fuselog.pipeline.tuning.control_noise`.

        If the search also covers the sizes of this noise, the correction uses the sizes in `values`
        (k,). If the correction varied with these sizes, it would remove the noise from the likelihood
        from which the sizes are estimated.
        """
        noises: set[str] = set()
        for run in self.runs:
            bound = self._bound(values, run)
            readings = [each.reading for each in bound if isinstance(each, Recursive) and each.reading]
            noises |= {name for reading in readings for name in reading().noises}
        self.runs = self.with_pairs(values, PAIRS).runs
        self.held = {
            place: float(values[place]) for place, name in enumerate(self.names) if name in noises
        }

    def with_pairs(self, values: Floats, pairs: int) -> "Objective":
        """Return a copy corrected with this number of pairs of copies per log; see `correct`."""
        runs = [
            run._replace(disturbed=disturbed(run.trial.source, self._bound(values, run), number, pairs))
            for number, run in enumerate(self.runs)
        ]
        return replace(self, runs=runs)

    def leave_noise(self) -> None:
        """Remove the correction for the noise of the controls."""
        self.runs, self.held = [run._replace(disturbed=()) for run in self.runs], {}

    def nis(self, values: Floats) -> float:
        """Compute the mean NIS per component of all logs with these values (k,)."""
        found = [stream for run in self.runs for _, stream in innovations_in(self.outputs(values, run))]
        components = sum(int(np.isfinite(stream["innovation"]).sum()) for stream in found)
        squares = sum(float(np.nansum(stream["normalised_innovation_squared"])) for stream in found)
        return squares / max(components, 1)

    @property
    def label(self) -> str:
        """Return the estimator's label."""
        return self.runs[0].trial.label

    @property
    def is_corrected(self) -> bool:
        """Test whether the cost is corrected for the noise of the controls."""
        return any(run.disturbed for run in self.runs)

    def lost_by_noise(self, points: Floats) -> Floats:
        """Compute the costs (n, pairs, 2) of pairs of opposite noises at points (n, k)."""
        return np.sum([self._lost(points, run, count) for run, count in self._corrected_runs], axis=0)

    @property
    def _corrected_runs(self) -> list[tuple[Run, int]]:
        return [pair for pair in zip(self.runs, self._counts, strict=True) if pair[0].disturbed]

    def _lost(self, points: Floats, run: Run, count: int) -> Floats:
        """Compute the costs (n, pairs, 2) of opposite noises on one log; NaN if a replay fails."""
        points = points.copy()
        points[:, list(self.held)] = list(self.held.values())
        size = part_count(run.starts)
        runs = Ensemble([each for each in (*run.trial.runs, *run.disturbed) for _ in range(size)])
        lost = []
        for outputs in self._replayed(points, run, runs):
            parts = (outputs[first : first + size] for first in range(0, len(runs), size))
            totals = [self._total(each, run, count) for each in parts]
            without, *having = [np.nan if each is None else sum(each.values()) for each in totals]
            lost.append(without - np.reshape(having, (-1, 2)))
        return np.array(lost)

    def begins_alike(self, values: Floats) -> bool:
        """Test whether filters would begin at the same stamps with these values (k,)."""
        return self.by == "likelihood" or all(
            _stamps(run) == _stamps(self.begun(values, run)) for run in self.runs
        )

    def begun(self, values: Floats, run: Run) -> Run:
        """Find the initial states for a log with values (k,); raise BadInput as `replay` does."""
        begun: dict[str, Initialized] = {}
        bound = self._bound(values, run)
        if any(initialization_of(each) for each in bound):
            noting = [with_find(each, partial(_note, begun, each)) for each in bound]
            next(replay(run.trial.runs, noting), None)
        if self.by != "likelihood" or not begun:
            return run._replace(begun=begun)
        starts = broad_starts(run.trial.source, bound)
        parts = Ensemble([run.trial.source] * part_count(starts))
        return run._replace(begun=begun, starts=starts, parts=parts)

    def _bound(self, values: Floats, run: Run) -> list[Bound]:
        return run.trial.with_settings(dict(zip(self.names, values.tolist(), strict=True))).bind()

    def outputs(self, values: Floats, run: Run) -> dict[str, Ragged]:
        """Replay a log with values (k,); return outputs by topic. Raise BadInput as `replay` does."""
        runs = ensemble_of(run.trial.runs)
        [outputs] = _outputs_of([self._bound(values, run)], run._replace(starts={}), runs)
        return outputs

    def sums(self, points: Floats, run: Run, count: int) -> list[Sums | None]:
        """Compute a log's sums at points (n, k); None at points where the number of messages changes."""
        parts = self._replayed(points, run, run.compared)
        found = [self._total(each, run, count) for each in parts]
        known = [place for place, total in enumerate(found) if total is not None]
        if run.disturbed and known:
            for place, lost in zip(known, self._lost(points[known], run, count), strict=True):
                found[place] = {**(found[place] or {}), NOISE: float(np.mean(lost))}
        return found

    def _replayed(
        self, points: Floats, run: Run, runs: Ensemble[MemorySource]
    ) -> list[list[dict[str, Ragged]]]:
        """Replay runs of a log at points (n, k); return outputs by point and run.

        Points whose estimators differ only in numbers are replayed together. There are no outputs at a
        point at which the estimator cannot be replayed, for example a batch that does not converge.
        """
        bound: dict[int, list[Bound]] = {}
        groups: dict[Hashable, list[int]] = {}
        for place, point in enumerate(points):
            with suppress(BadInput):
                bound[place] = self._bound(point, run)
                groups.setdefault(alike(bound[place]) or place, []).append(place)
        found: list[list[dict[str, Ragged]]] = [[] for _ in points]
        for places in groups.values():
            for some in in_memory_together(places, runs):
                outputs = _outputs_by_point([bound[place] for place in some], run, runs)
                for place, of_point in zip(some, outputs, strict=True):
                    found[place] = of_point
        return found

    def _total(self, parts: Sequence[Mapping[str, Ragged]], run: Run, count: int) -> Sums | None:
        """Sum over all parts; return None if all parts fail or their number of messages changes."""
        is_used = [not _failures(outputs) and self._count(outputs) == count for outputs in parts]
        if not any(is_used):
            return None
        found = [
            self._measured(run, outputs) if used else {}
            for outputs, used in zip(parts, is_used, strict=True)
        ]
        return found[0] if len(parts) == 1 else dict(mean_likelihood(found))

    def _count(self, outputs: Mapping[str, Ragged]) -> int:
        """Count the innovations, or else the output rows (which include estimates added by delays)."""
        innovations = sum(len(stream) for _, stream in innovations_in(outputs))
        return innovations or sum(len(rows) for rows in outputs.values())

    def _measured(self, run: Run, outputs: Mapping[str, Ragged]) -> Sums:
        return CRITERIA[self.by].sums(run, outputs, self.gap_limit_s)

    def _cost(self, of_runs: Sequence[Sums | None]) -> float:
        used = [each for each in of_runs if each is not None]
        total: Sums = reduce(plus, used, {})
        if len(used) < len(of_runs) or not total:
            return np.inf
        cost = CRITERIA[self.by].cost(total)
        return cost if np.isfinite(cost) else np.inf


def _stamps(run: Run) -> dict[tuple[str, str], list[int]]:
    """Return the stamps at which a log's filters begin, by estimated object and topic."""
    return {
        (name, topic): rows.stream.publish_time_ns.tolist()
        for name, opened in run.begun.items()
        for topic, rows in opened.static.items()
    }


def _outputs_of(
    bounds: Sequence[Sequence[Bound]], run: Run, runs: Ensemble[MemorySource]
) -> list[dict[str, Ragged]]:
    """Replay runs with each of some estimators that differ only in numbers; return outputs by run.

    Raises BadInput as `replay` does.
    """
    ensemble = runs if len(bounds) == 1 else Ensemble([*runs] * len(bounds))
    begun = [_begun(together(each, len(runs)), run) for each in zip(*bounds, strict=True)]
    outputs = collect(replay(ensemble, begun)).items()
    if len(ensemble) == 1:
        return [dict(outputs)]
    return [
        {topic: gather([rows.of_run(run)]) for topic, rows in outputs} for run in range(len(ensemble))
    ]


def _outputs_by_point(
    bounds: Sequence[Sequence[Bound]], run: Run, runs: Ensemble[MemorySource]
) -> list[list[dict[str, Ragged]]]:
    """Return the outputs of each estimator, by run; none if the estimator cannot be replayed."""
    size = len(runs)
    try:
        found = _outputs_of(bounds, run, runs)
    except BadInput:
        alone = [] if len(bounds) == 1 else [_outputs_by_point([each], run, runs) for each in bounds]
        return [found for [found] in alone] or [[]]
    return [found[first : first + size] for first in range(0, len(found), size)]


def _begun(bound: Bound, run: Run) -> Bound:
    """Make an estimator that begins in every run as noted."""
    if run.starts or bound.name not in run.begun:
        return begun_at(bound, run.starts)
    return with_find(bound, partial(_as_noted, run.begun[bound.name]))


def _note(begun: dict[str, Initialized], bound: Bound, *first: Any) -> Initialized:
    initialization = initialization_of(bound)
    assert initialization is not None
    begun[bound.name] = initialization.find(*first)
    return begun[bound.name]


def _as_noted(begun: Initialized, first: Mapping[str, Ragged], *_: Any) -> Initialized:
    """Repeat an initial state for every run."""
    count = next(iter(first.values())).runs
    return Initialized(
        {topic: gather([rows.stream] * count) for topic, rows in begun.static.items()},
        [gather([rows.stream] * count) for rows in begun.outputs],
    )


def _failures(outputs: Mapping[str, Ragged]) -> list[str]:
    return [
        sentence
        for rows in outputs.values()
        if rows.stream.schema.full_name == FAILURE
        for sentence in sentences_of(rows.stream)
    ]


def until_last_measured(
    source: LogSource | MemorySource, bound: Sequence[Bound]
) -> LogSource | MemorySource:
    """Cut a log one second after its last measurement if the controls continue for longer.

    Missing estimates after this time are not a failure.
    """
    readings = [
        (each, each.reading())
        for each in bound
        if isinstance(each, Recursive) and each.reading is not None
    ]
    controls = {topic for _, reading in readings for topic in reading.controls}
    measured = {topic for each, _ in readings for topic in each.streams} - controls
    if len(readings) < len(bound) or not controls or not measured:
        return source
    ends_ns = [
        int(stream.publish_time_ns.max())
        for topic in sorted(measured)
        for stream in source.read([topic]).values()
        if len(stream)
    ]
    if not ends_ns or max(ends_ns) + BEYOND_NS >= source.extent("publish_time")[1]:
        return source
    end_ns = max(ends_ns) + BEYOND_NS
    return replace(source, end_ns=end_ns if source.end_ns is None else min(end_ns, source.end_ns))
