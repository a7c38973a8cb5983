"""Monitoring of an estimator while it processes the runs of an ensemble, for any kind of estimator.

A run fails on its own if it cannot start, if the estimator's code raises an exception, if a covariance
is invalid, if stamps go back, or if its estimates end before the run does. A failed run gets no further
messages and has no further outputs; other runs are not affected. The monitor also measures the share of
each run that has estimates, and the computing time of the estimator.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial, reduce
from math import isqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.compiling.notices import seconds_done_once
from fuselog.recorders.compiling.scratch import Scratch
from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Clock, make_stream, schemas
from fuselog.recorders.log.planes import Origin, in_plane
from fuselog.replay.engine.replaying.coverage import Coverage
from fuselog.replay.engine.replaying.soundness import (
    FOREVER,
    SOUND,
    UNSOUND,
    unsound_over_runs,
    work_space,
)
from fuselog.replay.engine.replaying.usage import Usage
from fuselog.replay.engine.streams.blocks import Ragged, join, ragged_rows, run_of_rows
from fuselog.replay.engine.streams.failures import Failure, failure_stream, reason_of

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Streams = dict[str, Ragged]
Result = TypeVar("Result")

GAUSSIAN, FAILURE = schemas.GAUSSIAN_ESTIMATE.full_name, schemas.FAILURE.full_name
# Schemas with one message for every estimate, or for every element of one.
ESTIMATES = frozenset(
    schema.full_name
    for schema in (schemas.GAUSSIAN_ESTIMATE, schemas.ESTIMATE_SIZE, schemas.TRACK_ESTIMATE)
)


class RunMonitor:
    """Monitor of one bound estimator over the runs of an ensemble; see the module.

    Attributes:
        name: name of the bound estimator.
        runs: number of runs.
        seconds: computing time of the estimator in s, without one-time work such as compiling.
        usage: counts of how the estimator's measurements were used; None if they are not counted.
        static: the streams that the estimator starts from.
        refused: the exception, if all of the given runs raised one and they are only a part of an
            ensemble.
        plane: origin of the local tangent plane (ENU) of its estimates, if the runs state one.
    """

    def __init__(
        self,
        name: str,
        runs: int,
        order: Clock,
        static: Mapping[str, Ragged],
        *,
        is_batch: bool,
        is_part: bool = False,
        is_counting: bool = True,
    ) -> None:
        self.seconds = 0.0
        self.static = static
        self.usage: Usage | None = None
        if is_counting:
            self.usage = Usage(name)
            self.usage.note_start(static)
        self.refused: BadInput | None = None
        self.plane: Origin | None = None
        self.name = name
        self.runs = runs
        self._order: Clock = order
        self._is_batch = is_batch
        self._is_part = is_part
        # a run gets no messages from this time on
        self._end_ns = _repeated(FOREVER, runs).copy()
        self._has_ends = False
        self._first_ns, self._last_ns = _repeated(FOREVER, runs), _repeated(-1, runs)
        self._unable: dict[int, str] = {}
        self._failed: dict[int, Failure] = {}
        self._failures: dict[str, list[Ragged]] = {}
        self._coverages: dict[str, Coverage] = {}
        self._states: set[str] = set()
        self._speaks = False

    def exclude(self, reasons: Mapping[int, str]) -> None:
        """Exclude runs that cannot start, with a reason for each."""
        self._unable |= reasons
        for run in reasons:
            self._end(run, 0)

    def _end(self, run: int, time_ns: int) -> None:
        self._end_ns[run] = time_ns
        self._has_ends = True

    def take(self, work: Callable[[Streams], Result], streams: Streams) -> Result:
        """Pass the next streams of all runs without a failure to `work`, and return its result.

        If `work` raises BadInput, it is called again from the same state, without the runs that cause
        the exception. The exception is raised if every run of the whole ensemble causes it, or if it
        occurs even without messages.
        """
        self._note_span(streams)
        if self.usage is not None:
            self.usage.note_given(streams, self.static, self._order)
        began, compiled = time.perf_counter(), seconds_done_once()
        try:
            try:
                return work(self._before(streams, self._end_ns) if self._has_ends else streams)
            except BadInput as error:
                self._end_raising(work, streams, error)
                return work(self._before(streams, self._end_ns))
        finally:
            self.seconds += time.perf_counter() - began - (seconds_done_once() - compiled)

    def receive(self, outputs: Sequence[Ragged]) -> list[Ragged]:
        """Return outputs up to the first invalid estimate of each run; keep failures for `finish`."""
        cuts = [self._unsound(each) for each in outputs]
        sound = [self._cut(each, cut) for each, cut in zip(outputs, cuts, strict=True)]
        if self.usage is not None:
            self.usage.note_outputs(sound)
        passed = []
        for each in sound:
            topic, schema = each.stream.topic, each.stream.schema.full_name
            if schema == FAILURE:
                self._failures.setdefault(topic, []).append(each)
                continue
            if schema == GAUSSIAN and self.plane is not None:
                passed.append(replace(each, stream=in_plane(each.stream, self.plane)))
            else:
                passed.append(each)
            self._speaks = True
            if schema in ESTIMATES:
                case = topic.rpartition("/")[0]
                coverage = self._coverages.setdefault(case, Coverage(topic, self._starts()))
                if coverage.topic == topic:
                    coverage.note(each)
            if schema == GAUSSIAN:
                self._states.add(topic.rpartition("/")[0])
        return passed

    def finish(self) -> list[Ragged]:
        """Return the failures of all runs: those that the estimator reported and those found here."""
        if self.usage is not None:
            self.usage.shares.end()
        failures = {topic: join(parts) for topic, parts in self._failures.items()}
        for run, reason in self._unable.items():
            if self._last_ns[run] >= 0:
                self._failed[run] = Failure(int(self._first_ns[run]), reason)
        failed = set(self._failed).union(
            *(np.flatnonzero(np.diff(each.offsets)).tolist() for each in failures.values())
        )
        self._find_silence(failed)
        own_topic = f"/estimates/{self.name}/failure"
        topic = own_topic if own_topic in failures else next(iter(failures), own_topic)
        if not (self._failed or failures):
            return [_no_failures(topic, self.runs)]
        if self._failed:
            runs = sorted(self._failed)
            own = failure_stream(topic, [self._failed[run] for run in runs])
            ours = Ragged(own, np.searchsorted(runs, np.arange(self.runs + 1)))
            failures[topic] = join([failures[topic], ours]) if topic in failures else ours
        return list(failures.values())

    def coverage(self) -> list[Ragged]:
        """Return, by case, how much of each run's span has estimates, for all runs with messages.

        Outputs that are not estimates of a state, such as fused scores, have no coverage.
        """
        rows = np.flatnonzero(self._last_ns >= 0)
        offsets = np.searchsorted(rows, np.arange(self.runs + 1))
        cases = {case: coverage.estimated_s() for case, coverage in self._coverages.items()}
        if not self._speaks:
            cases = {f"/estimates/{self.name}": np.zeros(self.runs)}
        return [
            Ragged(
                make_stream(
                    f"{case}/coverage",
                    schemas.COVERAGE,
                    self._first_ns[rows],
                    end_time_ns=self._last_ns[rows],
                    estimated_s=estimated_s[rows],
                ),
                offsets,
            )
            for case, estimated_s in cases.items()
        ]

    def _starts(self) -> Integers:
        """Return the stamps (runs,) from which batch estimates cover each run; -1 for a recursion."""
        return self._first_ns if self._is_batch else _repeated(-1, self.runs)

    def _note_span(self, streams: Streams) -> None:
        for ragged in streams.values():
            first, last = ragged.findings.once(self._order, partial(_span_of, ragged, self._order))
            if self._last_ns is _repeated(-1, self.runs):  # no messages so far
                self._first_ns, self._last_ns = first, last
                continue
            self._first_ns = np.minimum(self._first_ns, first)
            self._last_ns = np.maximum(self._last_ns, last)

    def _before(self, streams: Streams, end_ns: Integers) -> dict[str, Ragged]:
        """Return the messages of every run before its end (runs,)."""
        return {
            topic: _kept(ragged, ragged.stream.times(self._order) < end_ns[run_of_rows(ragged.offsets)])
            for topic, ragged in streams.items()
        }

    def _end_raising(self, work: Callable[[Streams], object], streams: Streams, error: BadInput) -> None:
        """Bisect the runs to find which of them raise an exception, and at which stamp each does."""

        def raised(end_ns: Integers) -> BadInput | None:
            try:
                work(self._before(streams, end_ns))
            except BadInput as found:
                return found
            return None

        def only(runs: Sequence[int]) -> Integers:
            end_ns = np.zeros(self.runs, np.int64)
            end_ns[list(runs)] = self._end_ns[list(runs)]
            return end_ns

        def search(runs: Sequence[int]) -> dict[int, BadInput]:
            found = raised(only(runs))
            if found is None or len(runs) == 1:
                return {} if found is None else {runs[0]: found}
            half = len(runs) // 2
            return search(runs[:half]) | search(runs[half:])

        alive = np.flatnonzero(self._end_ns > 0).tolist()
        if raised(only([])):
            raise error
        guilty = search(alive)
        if len(guilty) == len(alive):
            if not self._is_part:
                raise error
            self.refused = error
        for run, found in guilty.items():
            stamps = np.unique(
                np.concatenate([each.of_run(run).times(self._order) for each in streams.values()])
            )
            good, bad = 0, len(stamps) - 1
            while good < bad and not self._is_batch:  # `bad` ends at the first stamp that raises
                middle = (good + bad) // 2
                until = only([run])
                until[run] = stamps[middle] + 1
                good, bad = (good, middle) if raised(until) else (middle + 1, bad)
            self._failed[run] = Failure(int(stamps[bad]), reason_of(found))
            self._end(run, 0 if self._is_batch else stamps[bad])

    def _unsound(self, estimates: Ragged) -> Integers | None:
        """Find the first invalid estimate (runs,) of every run and end the run there.

        Return None if all estimates are valid.
        """
        stream = estimates.stream
        if stream.schema.full_name != GAUSSIAN or not len(stream):
            return None
        coverage = self._coverages.get(stream.topic.rpartition("/")[0])
        before_ns = coverage.last_ns if coverage else _repeated(-1, self.runs)
        rows, found = np.empty(self.runs, np.int64), np.empty(self.runs, np.int64)
        mean, covariance = (np.ascontiguousarray(stream[name]) for name in ("mean", "covariance"))
        size = isqrt(covariance.shape[1])
        unsound_over_runs(
            self.runs,
            estimates.offsets,
            stream.publish_time_ns,
            np.ascontiguousarray(before_ns),
            mean,
            covariance,
            rows,
            found,
            scratch=_memory_of(size),
        )
        if rows.tobytes() == _repeated(FOREVER, self.runs).tobytes():
            return None
        for run in np.flatnonzero(found != SOUND):
            row = rows[run]
            first = row == estimates.offsets[run]
            last_ns = before_ns[run] if first else stream.publish_time_ns[row - 1]
            time_ns = max(int(stream.publish_time_ns[row]), int(last_ns))
            known = self._failed.get(int(run))
            if known is None or time_ns < known.time_ns:
                self._failed[int(run)] = Failure(time_ns, UNSOUND[found[run]])
            self._end(int(run), min(int(self._end_ns[run]), time_ns))
        return rows

    def _cut(self, output: Ragged, first_bad: Integers | None) -> Ragged:
        """Remove each run's rows from its first invalid row on, and rows after the run has ended."""
        if first_bad is None and not self._has_ends:
            return output
        run = run_of_rows(output.offsets)
        kept = np.ones(len(run), bool) if first_bad is None else np.arange(len(run)) < first_bad[run]
        if not self._is_batch:
            kept &= output.stream.publish_time_ns < self._end_ns[run]
        return output if kept.all() else _kept(output, kept)

    def _find_silence(self, failed: set[int]) -> None:
        """Record a failure for each run that has messages but no estimates, or no estimates at its end.

        Runs that have already failed are excluded.
        """
        coverages = [self._coverages[case] for case in self._states]
        ends = self._last_ns.tobytes()
        reaches_end = any(coverage.last_ns.tobytes() == ends for coverage in coverages)
        if not coverages or (not self._is_batch and reaches_end):
            return
        mute = ~reduce(np.logical_or, (coverage.has_estimates for coverage in coverages))
        found = mute
        if not self._is_batch:
            silent = (coverage.misses(self._last_ns) for coverage in coverages)
            found = mute | reduce(np.logical_and, silent)
        found = found & (self._last_ns >= 0)
        if not found.any():
            return
        last_ns = reduce(np.maximum, (coverage.last_ns for coverage in coverages))
        for run in set(np.flatnonzero(found).tolist()) - failed:
            if mute[run]:
                self._failed[run] = Failure(int(self._first_ns[run]), "there is no estimate")
                continue
            silent_s = (self._last_ns[run] - last_ns[run]) * 1e-9
            reason = f"there is no estimate in the last {silent_s:.1f} s of the measurements"
            self._failed[run] = Failure(int(last_ns[run]), reason)


@lru_cache(maxsize=8)
def _repeated(value: int, runs: int) -> Integers:
    """Return an array (runs,) that repeats a value and cannot be changed."""
    every = np.full(runs, value)
    every.flags.writeable = False
    return every


@lru_cache(maxsize=64)
def _memory_of(size: int) -> Scratch:
    return Scratch(partial(work_space, size))


@lru_cache(maxsize=64)
def _no_failures(topic: str, runs: int) -> Ragged:
    return Ragged(failure_stream(topic, []), np.zeros(runs + 1, np.int64))


def _span_of(ragged: Ragged, clock: Clock) -> tuple[Integers, Integers]:
    """Return each run's first and last stamp (runs,), or FOREVER and -1 if it has no messages."""
    first, last = np.full(ragged.runs, FOREVER), np.full(ragged.runs, -1)
    runs, times = np.flatnonzero(np.diff(ragged.offsets)), ragged.stream.times(clock)
    begin = ragged.offsets[runs]
    first[runs], last[runs] = np.minimum.reduceat(times, begin), np.maximum.reduceat(times, begin)
    return first, last


def _kept(ragged: Ragged, kept: NDArray[np.bool_]) -> Ragged:
    return Ragged(ragged.stream.take(kept), ragged_rows(kept, ragged.offsets))
