"""What is watched while an estimator goes through an ensemble, whatever the estimator.

A run that fails ends alone: one that cannot start, whose code raises, whose covariance is none, whose
stamps go back, or that goes silent. It gets no further messages and says nothing from there on, and the
others do not notice. Beside that, this counts for how much of each run there were estimates, and the
time that the estimator took.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial, reduce
from math import isqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from recorders.errors import BadInput
from recorders.log import Clock, make_stream, schemas
from replay.engine.compiling.compile import compile_over_runs
from replay.engine.replaying.usage import Usage
from replay.engine.streams.blocks import Ragged, join, ragged_rows
from replay.engine.streams.failures import Failure, failure_stream, reason_of
from replay.engine.vectors.covariances import ROUNDING

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Streams = dict[str, Ragged]
Result = TypeVar("Result")

GAUSSIAN, FAILURE = schemas.GAUSSIAN_ESTIMATE.full_name, schemas.FAILURE.full_name
# One message of these for every estimate, or for every element of one.
ESTIMATES = frozenset(
    schema.full_name
    for schema in (schemas.GAUSSIAN_ESTIMATE, schemas.ESTIMATE_SIZE, schemas.TRACK_ESTIMATE)
)
UNSOUND = (
    "the estimate is no longer finite",
    "the covariance is no longer positive definite",
    "the stamps of its estimates go back",
)
NOT_FINITE, NOT_POSITIVE_DEFINITE, GOES_BACK = range(len(UNSOUND))
# A share of a variance: a covariance that is singular but for rounding, as of one particle, is one.
INDEFINITE = 1e-9
FOREVER = np.iinfo(np.int64).max


class Watch:
    """One bound estimator over the runs of an ensemble; see the module.

    Attributes:
        name: the bound estimator's.
        runs: how many there are.
        seconds: how long the estimator worked.
        usage: what became of its measurements.
        whole: the streams that it begins with.
        refused: what all runs of a part of an ensemble raised.
    """

    def __init__(
        self, name: str, runs: int, order: Clock, *, is_batch: bool, is_part: bool = False
    ) -> None:
        self.seconds = 0.0
        self.usage = Usage(name)
        self.whole: Mapping[str, Ragged] = {}
        self.refused: BadInput | None = None
        self.name = name
        self.runs = runs
        self._order: Clock = order
        self._is_batch = is_batch
        self._is_part = is_part
        # a run gets no message from here on
        self._end_ns = np.full(runs, FOREVER)
        self._first_ns, self._last_ns = np.full(runs, FOREVER), np.full(runs, -1)
        self._unable: dict[int, str] = {}
        self._failed: dict[int, Failure] = {}
        self._told: dict[str, list[Ragged]] = {}
        self._rhythms: dict[str, _Rhythm] = {}
        self._states: set[str] = set()
        self._speaks = False

    def exclude(self, reasons: Mapping[int, str]) -> None:
        """These runs cannot start, for a reason each."""
        self._unable |= reasons
        for run in reasons:
            self._end_ns[run] = 0

    def take(self, work: Callable[[Streams], Result], streams: Streams) -> Result:
        """What `work` makes of the next streams of the runs that have not failed.

        `work` is called again, from the same state, without a run that raises. Raises what it raises
        where every run has, and there are no others, or it is no run's fault.
        """
        self._note_span(streams)
        self.usage.note_given(streams, self.whole, self._order)
        began = time.perf_counter()
        try:
            try:
                return work(self._before(streams, self._end_ns))
            except BadInput as error:
                self._end_raising(work, streams, error)
                return work(self._before(streams, self._end_ns))
        finally:
            self.seconds += time.perf_counter() - began

    def receive(self, outputs: Sequence[Ragged]) -> list[Ragged]:
        """A block's outputs without what is no estimate and all after it; failures are held back."""
        cuts = [self._unsound(each) for each in outputs]
        sound = [self._cut(each, cut) for each, cut in zip(outputs, cuts, strict=True)]
        self.usage.note_outputs(sound)
        passed = []
        for each in sound:
            topic, schema = each.stream.topic, each.stream.schema.full_name
            if schema == FAILURE:
                self._told.setdefault(topic, []).append(each)
                continue
            passed.append(each)
            self._speaks = True
            if schema in ESTIMATES:
                case = topic.rpartition("/")[0]
                rhythm = self._rhythms.setdefault(case, _Rhythm(topic, self._starts()))
                if rhythm.topic == topic:
                    rhythm.note(each)
            if schema == GAUSSIAN:
                self._states.add(topic.rpartition("/")[0])
        return passed

    def finish(self) -> list[Ragged]:
        """All failures of all runs; what this noted is told where the estimator tells its own."""
        self.usage.shares.end()
        told = {topic: join(parts) for topic, parts in self._told.items()}
        for run, reason in self._unable.items():
            if self._last_ns[run] >= 0:
                self._failed[run] = Failure(int(self._first_ns[run]), reason)
        failed = set(self._failed).union(
            *(np.flatnonzero(np.diff(each.offsets)).tolist() for each in told.values())
        )
        self._find_silence(failed)
        own_topic = f"/estimates/{self.name}/failure"
        topic = own_topic if own_topic in told else next(iter(told), own_topic)
        if self._failed or not told:
            runs = sorted(self._failed)
            own = failure_stream(topic, [self._failed[run] for run in runs])
            ours = Ragged(own, np.searchsorted(runs, np.arange(self.runs + 1)))
            told[topic] = join([told[topic], ours]) if topic in told else ours
        return list(told.values())

    def coverage(self) -> list[Ragged]:
        """For each case, how much of every run's span was estimated; none of a run without messages.

        Nothing is said of outputs that are no estimates of a state, such as fused scores.
        """
        rows = np.flatnonzero(self._last_ns >= 0)
        offsets = np.searchsorted(rows, np.arange(self.runs + 1))
        cases = {case: rhythm.estimated_s() for case, rhythm in self._rhythms.items()}
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
        """What estimates are of before there is one: a batch's first speaks of all from the start."""
        return self._first_ns if self._is_batch else np.full(self.runs, -1)

    def _note_span(self, streams: Streams) -> None:
        for ragged in streams.values():
            runs = np.flatnonzero(np.diff(ragged.offsets))
            times = ragged.stream.times(self._order)
            begin = ragged.offsets[runs]
            first, last = np.minimum.reduceat(times, begin), np.maximum.reduceat(times, begin)
            self._first_ns[runs] = np.minimum(self._first_ns[runs], first)
            self._last_ns[runs] = np.maximum(self._last_ns[runs], last)

    def _before(self, streams: Streams, end_ns: Integers) -> dict[str, Ragged]:
        """The messages of every run before its end (runs,)."""
        if (end_ns == FOREVER).all():
            return dict(streams)
        return {
            topic: _kept(ragged, ragged.stream.times(self._order) < end_ns[_run_of(ragged)])
            for topic, ragged in streams.items()
        }

    def _end_raising(self, work: Callable[[Streams], object], streams: Streams, error: BadInput) -> None:
        """Find the runs that raise, by trying halves of them, and the stamp at which each does."""

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
            while good < bad and not self._is_batch:  # bad ends at the first stamp that raises
                middle = (good + bad) // 2
                until = only([run])
                until[run] = stamps[middle] + 1
                good, bad = (good, middle) if raised(until) else (middle + 1, bad)
            self._failed[run] = Failure(int(stamps[bad]), reason_of(found))
            self._end_ns[run] = 0 if self._is_batch else stamps[bad]

    def _unsound(self, estimates: Ragged) -> Integers | None:
        """The first row (runs,) of every run that is no estimate, and its end at that; None for none."""
        stream = estimates.stream
        if stream.schema.full_name != GAUSSIAN or not len(stream):
            return None
        rhythm = self._rhythms.get(stream.topic.rpartition("/")[0])
        before_ns = rhythm.last_ns if rhythm else np.full(self.runs, -1)
        rows, found = np.full(self.runs, FOREVER), np.full(self.runs, -1)
        mean, covariance = (np.ascontiguousarray(stream[name]) for name in ("mean", "covariance"))
        size = isqrt(covariance.shape[1])
        _over_runs(find_unsound)(
            self.runs,
            estimates.offsets,
            stream.publish_time_ns,
            np.ascontiguousarray(before_ns),
            mean,
            covariance,
            rows,
            found,
            scratch=partial(np.empty, (size, size)),
        )
        bad = np.flatnonzero(found >= 0)
        for run in bad:
            row = rows[run]
            first = row == estimates.offsets[run]
            last_ns = before_ns[run] if first else stream.publish_time_ns[row - 1]
            time_ns = max(int(stream.publish_time_ns[row]), int(last_ns))
            known = self._failed.get(int(run))
            if known is None or time_ns < known.time_ns:
                self._failed[int(run)] = Failure(time_ns, UNSOUND[found[run]])
            self._end_ns[run] = min(self._end_ns[run], time_ns)
        return rows if len(bad) else None

    def _cut(self, output: Ragged, first_bad: Integers | None) -> Ragged:
        """An output without the rows from a run's first bad one on, or from the run's end on."""
        if first_bad is None and (self._end_ns == FOREVER).all():
            return output
        run = _run_of(output)
        kept = np.ones(len(run), bool) if first_bad is None else np.arange(len(run)) < first_bad[run]
        if not self._is_batch:
            kept &= output.stream.publish_time_ns < self._end_ns[run]
        return output if kept.all() else _kept(output, kept)

    def _find_silence(self, failed: set[int]) -> None:
        """Note a failure where messages came and no state was estimated, or not any more.

        What has failed already is left out.
        """
        rhythms = [self._rhythms[case] for case in self._states]
        if not rhythms:
            return
        mute = ~reduce(np.logical_or, (rhythm.said for rhythm in rhythms))
        found = mute
        if not self._is_batch:
            silent = (rhythm.misses(self._last_ns) for rhythm in rhythms)
            found = mute | reduce(np.logical_and, silent)
        found = found & (self._last_ns >= 0)
        if not found.any():
            return
        last_ns = reduce(np.maximum, (rhythm.last_ns for rhythm in rhythms))
        for run in set(np.flatnonzero(found).tolist()) - failed:
            if mute[run]:
                self._failed[run] = Failure(int(self._first_ns[run]), "it gave no estimate")
                continue
            silent_s = (self._last_ns[run] - last_ns[run]) * 1e-9
            reason = f"it gave no estimate in the last {silent_s:.1f} s of its measurements"
            self._failed[run] = Failure(int(last_ns[run]), reason)


class _Rhythm:
    """At what intervals a case's estimates come, run by run, in bins of factors of two.

    Intervals much longer than the usual one, and than a second, are gaps.
    """

    BINS = 64
    SECOND = 30  # the bin of intervals about one second long, 2^30 ns
    GAP = 4  # a gap is this many bins beyond the median: 8 to 32 times as long

    def __init__(self, topic: str, starts_ns: Integers) -> None:
        self.topic = topic
        self.last_ns = starts_ns.copy()
        self.said = np.zeros(len(starts_ns), bool)
        # a bin's runs side by side: most runs use one or two bins, and the rest is never touched
        self._counts = np.zeros((self.BINS, len(starts_ns)), np.int64)
        self._sums_ns = np.zeros((self.BINS, len(starts_ns)))

    def note(self, estimates: Ragged) -> None:
        """Take in the stamps of a block."""
        times_ns = estimates.stream.publish_time_ns
        noted = self.said, self.last_ns, self._counts, self._sums_ns
        _over_runs(note_intervals)(estimates.runs, estimates.offsets, times_ns, *noted)

    def estimated_s(self) -> Floats:
        """For how long (runs,) there were estimates, gaps left out."""
        is_gap = np.arange(self.BINS)[:, None] > self._longest()
        return np.where(is_gap, 0, self._sums_ns).sum(axis=0) * 1e-9

    def misses(self, now_ns: Integers) -> NDArray[np.bool_]:
        """Whether the time (runs,) since each run's last estimate is a gap."""
        interval = _bin_of(now_ns - self.last_ns)
        missed: NDArray[np.bool_] = interval > self.SECOND
        return missed & (interval > self._longest()) if missed.any() else missed

    def _longest(self) -> Integers:
        """The bin (runs,) of the longest intervals that are no gaps."""
        reached = np.cumsum(self._counts, axis=0)
        median = np.argmax(2 * reached >= reached[-1], axis=0)
        return np.maximum(median + self.GAP, self.SECOND)


def _bin_of(interval_ns: Integers) -> Integers:
    return np.frexp(np.maximum(interval_ns, 1).astype(float))[1].astype(np.int64) - 1


def _run_of(ragged: Ragged) -> Integers:
    return np.repeat(np.arange(ragged.runs), np.diff(ragged.offsets))


def _kept(ragged: Ragged, kept: NDArray[np.bool_]) -> Ragged:
    return Ragged(ragged.stream.take(kept), ragged_rows(kept, ragged.offsets))


@cache
def _over_runs(run_once: Callable[..., None]) -> Callable[..., None]:
    return compile_over_runs(run_once, allocates=False)


def note_intervals(
    run: int,
    offsets: Integers,
    time_ns: Integers,
    said: NDArray[np.bool_],
    last_ns: Integers,
    counts: Integers,
    sums_ns: Floats,
) -> None:
    """Take in the stamps of a run; see `_Rhythm`.

    Args:
        run: which.
        offsets: (runs + 1,) of the stamps.
        time_ns: (n,) the stamps.
        said: (runs,) whether there were any.
        last_ns: (runs,) the last one; negative where there is none.
        counts: (BINS, runs) of the intervals of every bin, how many there are.
        sums_ns: (BINS, runs) and their sum, exact up to 2^53 ns, a hundred days.
    """
    for row in range(offsets[run], offsets[run + 1]):
        interval = time_ns[row] - last_ns[run]
        if last_ns[run] >= 0 and interval > 0:
            _, exponent = math.frexp(float(interval))
            counts[exponent - 1, run] += 1
            sums_ns[exponent - 1, run] += interval
        said[run], last_ns[run] = True, time_ns[row]


def find_unsound(
    run: int,
    offsets: Integers,
    time_ns: Integers,
    before_ns: Integers,
    mean: Floats,
    covariance: Floats,
    rows: Integers,
    found: Integers,
    factor: Floats,
) -> None:
    """Fill the first row of a run that is no estimate, and which of `UNSOUND` it is.

    Args:
        run: which.
        offsets: (runs + 1,) of the rows.
        time_ns: (n,) stamps.
        before_ns: (runs,) the last stamp before these.
        mean: (n, d).
        covariance: (n, t * t) row-major.
        rows: (runs,) filled.
        found: (runs,) filled.
        factor: (t, t) to work in.
    """
    last_ns, size = before_ns[run], factor.shape[0]
    for row in range(offsets[run], offsets[run + 1]):
        wrong = -1
        is_wrong = False
        total = 0.0
        for i in range(mean.shape[1]):
            total += mean[row, i]
        for i in range(covariance.shape[1]):
            total += covariance[row, i]
        if time_ns[row] < last_ns:
            wrong = GOES_BACK
        elif not np.isfinite(total):
            wrong = NOT_FINITE
        else:
            for column in range(size):  # Cholesky
                variance = covariance[row, column * size + column]
                for i in range(column, size):
                    entry = covariance[row, i * size + column]
                    for k in range(column):
                        entry -= factor[i, k] * factor[column, k]
                    if i == column:
                        is_wrong = not variance >= 0.0 or entry < -INDEFINITE * variance
                        factor[i, i] = np.sqrt(entry) if entry > ROUNDING * variance else 0.0
                    elif factor[column, column] > 0.0:
                        factor[i, column] = entry / factor[column, column]
                    else:  # nothing is left of this component: it cannot vary with another
                        both = variance * covariance[row, i * size + i]
                        is_wrong = entry * entry > INDEFINITE * both
                        factor[i, column] = 0.0
                    if is_wrong:
                        wrong = NOT_POSITIVE_DEFINITE
                if wrong >= 0:
                    break
        if wrong >= 0:
            rows[run] = row
            found[run] = wrong
            break
        last_ns = time_ns[row]
