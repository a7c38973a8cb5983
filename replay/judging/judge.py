"""Judge that processes the outputs of a replay block by block.

It stores only sums: of every metric, of errors by step over the runs, and of errors by time for each
run. Memory therefore does not grow with the length of a log, except for two numbers per step for the
NEES.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import schemas
from fuselog.recorders.log.planes import Origin
from fuselog.recorders.registry import available, foreign_code, load
from fuselog.replay.engine.streams.blocks import Findings, Ragged
from fuselog.replay.engine.streams.sources import MemorySource, Source
from fuselog.replay.judging.consistency.bounds import Bounds
from fuselog.replay.judging.consistency.conditioning import Conditioning, conditioning_of
from fuselog.replay.judging.diagnostics import LEAVES, Diagnostics
from fuselog.replay.judging.errors.constant import Constant
from fuselog.replay.judging.errors.evaluation import (
    Errors,
    Innovations,
    chi_square_interval,
    errors_at,
    errors_of,
    innovations_of,
    split_topic,
    unestimated,
    unjudged_sentence,
)
from fuselog.replay.judging.errors.moments import Moment, Moments, worst_of
from fuselog.replay.judging.errors.planes import first_fixes
from fuselog.replay.judging.errors.truths import Doubt, Truths
from fuselog.replay.judging.errors.uninformed import Uninformed
from fuselog.replay.judging.intervals import FEWEST_RUNS, Interval, mean_interval
from fuselog.replay.judging.kinds import JudgedRuns, KindJudge
from fuselog.replay.judging.metrics.means import MeansOfAll
from fuselog.replay.judging.metrics.measuring import (
    Metric,
    MetricCollection,
    Output,
    find_metrics,
    metric_key,
)
from fuselog.replay.judging.metrics.quantities import InnovationSums, Quantities
from fuselog.replay.judging.metrics.sums import BinnedSums
from fuselog.replay.judging.verdicts import Squares

if TYPE_CHECKING:
    import pandas as pd

GAUSSIAN, INNOVATION = schemas.GAUSSIAN_ESTIMATE.full_name, schemas.INNOVATION.full_name
BOUND_STEP = schemas.BOUND_STEP.full_name
# Largest number of steps in a table; with more, neighbouring steps share a row.
STEPS = 1 << 17
# Largest number of time bins of a run; the length of a bin is 1 ms times a power of two.
TIME_BINS = 64
# Largest number of bins over all runs; if there are very many runs, each has fewer bins.
TIME_CELLS = 1 << 18
TIME_BIN_NS = 1_000_000


class Judged(NamedTuple):
    """Judged results of a block: errors of estimates, innovations, and results of families."""

    errors: list[Errors]
    innovations: list[Innovations]
    others: list[Any]


class Judge:
    """Judge of an ensemble, or of a part of one, while its replay runs.

    Args:
        sources: the runs.
        metrics: the metrics to compute; see `find_metrics`.
        gap_limit_s: longest gap in s over which the truth is interpolated.
        first_run: number of the first run in the whole ensemble.
        burn_in_s: errors up to this time in s after the epoch are left out.
        on_errors: called with the errors of every block.

    `innovations` has the sums of innovations by topic, and `conditioning` the conditioning of
    covariances.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        metrics: Mapping[str, Metric[Any, Any]] | None = None,
        *,
        gap_limit_s: float,
        first_run: int = 0,
        burn_in_s: float | None = None,
        on_errors: Callable[[Errors], None] | None = None,
    ) -> None:
        self.runs = len(sources)
        self._sources = sources
        self._names = {first_run + run: source.name for run, source in enumerate(sources)}
        self._truths = [Truths(source) for source in sources]
        are_in_memory = all(isinstance(source, MemorySource) for source in sources)
        self._true_states = Findings(1) if are_in_memory else None
        runs = JudgedRuns(sources, self._truths, gap_limit_s, first_run)
        self._kinds: dict[str, KindJudge] = {
            name: load("judges", name, type)(runs) for name in available("judges")
        }
        self._notes: dict[str, None] = {}
        self._gap_limit_s = gap_limit_s
        self._first_run = first_run
        self._burn_in_s = burn_in_s
        self._on_errors = on_errors
        self._measured = MetricCollection(find_metrics() if metrics is None else metrics)
        self._quantities: dict[str, Quantities] = {}
        self._steps: dict[str, NDArray[np.int64]] = {}
        self._diagnostics = Diagnostics(first_run)
        self._unjudged: dict[str, str] = {}
        self._first_fixes: dict[str, list[Origin | None]] = {}
        self.innovations: dict[str, InnovationSums] = {}
        self.conditioning: dict[str, Conditioning] = {}
        self._epochs_ns = np.array([source.epoch_ns for source in sources])
        self._bounds: dict[tuple[str, str], Bounds] = {}
        self._uninformed: dict[str, Uninformed] = {}
        self._unestimated: dict[str, list[str]] = {}
        self._means = MeansOfAll()
        self._moments = Moments()
        self._doubts: dict[str, Doubt] = {}
        self._runs_table: pd.DataFrame | None = None  # of everything that has been added

    def add(self, outputs: Mapping[str, Ragged]) -> Judged:
        """Judge a block of a replay's outputs, by topic."""
        judged, self._runs_table = Judged([], [], []), None
        self._first_fixes |= first_fixes(outputs)
        for topic, rows in outputs.items():
            schema = rows.stream.schema.full_name
            if schema == GAUSSIAN:
                self._add_estimates(topic, rows, judged)
            elif schema == INNOVATION:
                innovations = innovations_of(rows, self._first_run)
                judged.innovations.append(innovations)
                if topic not in self.innovations:
                    self.innovations[topic] = InnovationSums(self._first_run)
                self.innovations[topic].add(innovations)
                self._measured.add(topic, innovations)
            if schema in (GAUSSIAN, INNOVATION):
                own = conditioning_of(rows, self._epochs_ns, self._first_run)
                self.conditioning[topic] = self.conditioning.get(topic, Conditioning()).plus(own)
            self._diagnostics.add(topic, rows, self._sources)
            named = (*split_topic(topic), topic.rpartition("/")[2])
            output = Output(*named, rows, self._sources, self._first_run)
            if schema == BOUND_STEP:
                self._bounds.setdefault(split_topic(topic), Bounds()).add(output)
            self._means.add(output)
            self._measured.add(topic, output)
        for name, kind in self._kinds.items():
            with foreign_code(f"judge {name}"):
                others = kind.add(outputs)
            for topic, found in others:
                judged.others.append(found)
                self._measured.add(topic, found)
            for topic, why in kind.unjudged.items():
                what = " ".join(filter(None, split_topic(topic)))
                self._unjudged[topic] = f"{what}: not judged: {why}" if why else ""
            self._notes |= dict.fromkeys(kind.notes)
        return judged

    def _add_estimates(self, topic: str, rows: Ragged, judged: Judged) -> None:
        begun = self._steps.setdefault(topic, np.zeros(self.runs, np.int64))
        if topic not in self._unjudged:
            self._unjudged[topic] = unjudged_sentence(rows, self._sources, self._first_fixes)
            self._unestimated[topic] = unestimated(rows.stream, self._sources)
        errors = errors_of(
            rows,
            self._truths,
            self._gap_limit_s,
            steps=begun,
            first_run=self._first_run,
            first_fixes=self._first_fixes,
            shared=self._true_states,
        )
        self._steps[topic] = begun + np.diff(rows.offsets)
        if errors is None:
            return
        self._uninformed.setdefault(topic, Uninformed()).add(rows, self._first_run)
        if self._burn_in_s is not None:
            errors = errors_at(errors, errors.elapsed_s > self._burn_in_s + 1e-9)
        judged.errors.append(errors)
        self._measured.add(topic, errors)
        self._moments.add(errors)
        if self._on_errors is not None:
            self._on_errors(errors)
        if topic not in self._quantities:
            width = 6 + len(errors.components)
            bins = {"width": TIME_BIN_NS, "limit": TIME_BINS, "cells": TIME_CELLS}
            by_time = BinnedSums(width, **bins, first=self._first_run)
            self._quantities[topic] = Quantities(errors, BinnedSums(width, limit=STEPS), by_time)
        self._quantities[topic].add(errors)

    def close(self) -> None:
        """Release the runs after judging; only sums are left, which can be pickled."""
        self._doubts = self.doubts
        self._sources, self._truths, self._kinds, self._on_errors = (), [], {}, None
        self._true_states = self._runs_table = None
        self._steps.clear()
        for of_topic in self._uninformed.values():
            of_topic.first.clear()
        for each in self._quantities.values():
            each.errors = errors_at(each.errors, np.zeros(len(each.errors.run), bool))

    def merge(self, other: "Judge") -> None:
        """Add the results of other runs."""
        self._runs_table = None
        self.runs += other.runs
        self._names |= other._names
        self._doubts = other.doubts | self.doubts
        self._measured.merge(other._measured)
        self._unjudged |= other._unjudged
        self._unestimated |= other._unestimated
        for topic, uninformed in other._uninformed.items():
            self._uninformed.setdefault(topic, Uninformed()).merge(uninformed)
        for topic, sums in other.innovations.items():
            self.innovations.setdefault(topic, InnovationSums(sums.first_run)).merge(sums)
        for topic, quantities in other._quantities.items():
            if topic in self._quantities:
                self._quantities[topic].merge(quantities)
            else:
                self._quantities[topic] = quantities
        self._notes |= other._notes
        self._means.merge(other._means)
        self._moments.merge(other._moments)
        for what, bounds in other._bounds.items():
            self._bounds.setdefault(what, Bounds()).merge(bounds)
        self._diagnostics.merge(other._diagnostics)
        for topic, each in other.conditioning.items():
            self.conditioning[topic] = self.conditioning.get(topic, Conditioning()).plus(each)

    @property
    def metrics(self) -> dict[str, float]:
        """Return values by key, `estimator.quantity[.case]`; raise BadInput if a metric raises."""
        return self._measured.finish()

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Return the 95 % intervals of the NEES and NIS of consistent estimators, by key."""
        return self.intervals(0.95)

    def intervals(self, probability: float) -> dict[str, tuple[float, float]]:
        """Compute the intervals of the NEES and NIS of consistent estimators, by key.

        Errors of the steps of a run are correlated, so the interval for the NEES is that of the mean of
        a single step over the runs; innovations are uncorrelated, so the interval for the NIS is that of
        the mean of all innovations. Each interval contains its metric with the given `probability`.
        """
        sizes = self._sizes()
        return {key: _interval(*sizes[key], probability) for key in self.metrics if key in sizes}

    def _sizes(self) -> dict[str, tuple[int, int, int]]:
        """Return the degrees of freedom, number of values and expected value of NEES and NIS, by key."""
        found: dict[str, tuple[int, int, int]] = {}
        for quantities in self._quantities.values():
            errors, runs = quantities.errors, len(quantities.by_time.by_group()[0])
            sizes = {"nees": len(errors.components), "position_nees": len(errors.position)}
            for name, size in sizes.items():
                if runs and size:
                    found[metric_key(errors.estimator, name, errors.case)] = size, runs, size
        for topic, sums in self.innovations.items():
            if degrees := sums.total.degrees:
                estimator, case = split_topic(topic)
                found[metric_key(estimator, "nis_per_component", case)] = degrees, 1, 1
        return found

    def squares(self, estimator: str, quantity: str, case: str) -> Squares:
        """Return the NEES or NIS that decides whether an `estimator` is overconfident in a `case`.

        `quantity` is the name of the metric.
        """
        key = metric_key(estimator, quantity, case)
        found = Interval(self.metrics[key])
        if self.runs >= FEWEST_RUNS and quantity in (table := self.runs_table):
            own = table[(table["estimator"] == estimator) & (table["case"] == case)]
            found = mean_interval(own[quantity].dropna())._replace(value=found.value)
        size, runs, aim = self._sizes()[key]
        return Squares(quantity, found, aim, _interval(size, runs, aim, 0.95))

    @property
    def constants(self) -> dict[tuple[str, str], Constant]:
        """Return the constant errors by estimator and case; see `ConstantSums`."""
        found = {split_topic(topic): each.constant.found() for topic, each in self._quantities.items()}
        return {what: each for what, each in found.items() if each is not None}

    @property
    def uninformed(self) -> dict[tuple[str, str], list[str]]:
        """Return the components that no measurement affects, by estimator and case."""
        found = {split_topic(topic): each.found() for topic, each in self._uninformed.items()}
        return {what: names for what, names in found.items() if names}

    @property
    def unestimated(self) -> dict[tuple[str, str], list[str]]:
        """Return the sensor errors in the truth that are not estimated, by estimator and case."""
        found = {split_topic(topic): names for topic, names in self._unestimated.items()}
        return {what: names for what, names in found.items() if names}

    @property
    def has_numbers(self) -> bool:
        """Test whether there are metrics other than failures, skipped messages and coverage."""
        return any(self._measured.finish(lambda topic: topic.rpartition("/")[2] not in LEAVES))

    @property
    def doubts(self) -> dict[str, Doubt]:
        """Return doubts about truths by topic, from the first run with a doubt."""
        found = dict(self._doubts)
        for truths in self._truths:
            found = truths.doubts | found
        return found

    @property
    def components_without_truth(self) -> list[str]:
        """Return a sentence for every estimate that cannot be judged or is judged only in part."""
        return [sentence for sentence in self._unjudged.values() if sentence]

    @property
    def moments(self) -> list[Moment]:
        """Return the moments of the largest NEES and the largest error of each estimator and case."""
        return self._moments.found

    @property
    def worst(self) -> dict[str, Moment]:
        """Return, by estimator, the moment of the largest NEES or, without NEES, the largest error."""
        found: dict[str, list[Moment]] = {}
        for moment in self.moments:
            found.setdefault(moment.estimator, []).append(moment)
        worst = {estimator: worst_of(moments) for estimator, moments in found.items()}
        return {estimator: moment for estimator, moment in worst.items() if moment is not None}

    def name_of(self, run: int) -> str:
        """Return the name of a run by its number."""
        return self._names[run]

    @property
    def failures(self) -> list[str]:
        """Return a sentence for every run that an estimator did not process completely."""
        return [f"{self._names[run]}: {sentence}" for run, sentence in self.failed_runs]

    @property
    def failed_runs(self) -> list[tuple[int, str]]:
        """Return the numbers of the failed runs, with a sentence for each."""
        return self._diagnostics.failures(self._names)

    @property
    def notes_of_coverage(self) -> list[str]:
        """Return sentences about assumptions, spans without estimates, unused messages and bounds."""
        averaged = "averaged along the true trajectories, because"
        return [*self._diagnostics.notes(), *self._notes] + [
            f"{' '.join(filter(None, what))}: {averaged} {bounds.complaint}"
            for what, bounds in self._bounds.items()
            if bounds.complaint
        ]

    @property
    def steps(self) -> "dict[str, pd.DataFrame]":
        """Return tables of estimates with truth by topic, one row per step; see `tables.step_table`."""
        from fuselog.replay.judging.tables import step_table

        return {
            topic: step_table(each, self._bounds.get(split_topic(topic)))
            for topic, each in self._quantities.items()
        }

    @property
    def runs_table(self) -> "pd.DataFrame":
        """Return a table with a row per estimator, case and run; see `tables.table_of_runs`."""
        from fuselog.replay.judging.tables import table_of_runs

        if self._runs_table is None:
            self._runs_table = table_of_runs(self._quantities.values(), self.innovations)
        return self._runs_table.copy()

    @property
    def times(self) -> "pd.DataFrame":
        """Return a table with a row per run and time span; a span ends `until_s` after the epoch."""
        from fuselog.replay.judging.tables import joined, time_table

        return joined(time_table(each) for each in self._quantities.values())

    @property
    def modes(self) -> "pd.DataFrame":
        """Return mode probabilities, a row per estimator, case, time span and mode; see `MeansOfAll`."""
        from fuselog.replay.judging.tables import joined

        return joined(self._means.modes())

    @property
    def effective(self) -> "pd.DataFrame":
        """Return the effective share of particles, a row per estimator, case and time span."""
        from fuselog.replay.judging.tables import joined

        return joined(self._means.effective())

    @property
    def late(self) -> "pd.DataFrame":
        """Return out-of-sequence messages, a row per estimator, case, treatment and time span."""
        from fuselog.replay.judging.tables import joined

        return joined(self._means.late())

    @property
    def judged(self) -> dict[str, Errors]:
        """Return, by topic, the latest errors, which state the names and kinds of the components."""
        return {topic: each.errors for topic, each in self._quantities.items()}


def _interval(size: int, runs: int, aim: int, probability: float) -> tuple[float, float]:
    """Compute the interval of a consistent filter's mean NEES or NIS, whose expected value is `aim`."""
    low, high = chi_square_interval(size, runs, probability)
    return low / (size / aim), high / (size / aim)
