"""Diagnostics of a replay: failures, skipped messages, assumed values, and spans without estimates."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.failures import sentences_of
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.engine.vectors.components import stated_components
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.judging.errors.evaluation import split_topic
from fuselog.replay.judging.metrics.measuring import Output, Sums, plus
from fuselog.replay.judging.metrics.metrics import covered, estimated_share

ESTIMATE = schemas.GAUSSIAN_ESTIMATE.full_name
FAILURE, SKIPPED = schemas.FAILURE.full_name, schemas.SKIPPED.full_name
STARTED, COVERAGE = schemas.STARTED.full_name, schemas.COVERAGE.full_name
# Last parts of the names of topics without estimates, which are not judged.
LEAVES = ("failure", "skipped", "started", "coverage")
# A share of the span below this is reported; the first measurements of a run are often before the prior.
LEAST_SHARE = 0.995
# If an angle has a larger standard deviation, a Gaussian is a poor model: 0.2 % of it is beyond half a
# turn.
WIDE_RAD = 1.0


@dataclass
class StreamDiagnostics:
    """Diagnostics of one topic of a replay."""

    failed: dict[int, str] = field(default_factory=dict)
    with_estimates: set[int] | None = None
    skipped: Counter[str] = field(default_factory=Counter)
    started: Counter[str] = field(default_factory=Counter)
    covered: Sums = field(default_factory=dict)
    estimates: int = 0
    wide: Counter[str] = field(default_factory=Counter)

    def merge(self, other: "StreamDiagnostics") -> None:
        """Add the diagnostics of other runs."""
        self.failed |= other.failed
        self.skipped.update(other.skipped)
        self.started.update(other.started)
        if other.with_estimates is not None:
            self.with_estimates = other.with_estimates | (self.with_estimates or set())
        self.covered = plus(self.covered, other.covered)
        self.estimates += other.estimates
        self.wide.update(other.wide)


class Diagnostics:
    """Diagnostics of the topics of a replay, which are reported as sentences.

    Args:
        first_run: number of the first run in the whole ensemble.
    """

    def __init__(self, first_run: int) -> None:
        self._first_run = first_run
        self._topics: dict[str, StreamDiagnostics] = {}

    def add(self, topic: str, rows: Ragged, sources: Sequence[Source]) -> None:
        """Add a block of a topic."""
        schema = rows.stream.schema.full_name
        found = self._topics.setdefault(topic, StreamDiagnostics())
        runs = np.flatnonzero(np.diff(rows.offsets)).tolist()
        if schema == ESTIMATE:
            estimated = {self._first_run + run for run in runs}
            found.with_estimates = estimated | (found.with_estimates or set())
            found.estimates += len(rows.stream)
            found.wide.update(_wide_angles(rows.stream))
        elif schema == FAILURE:
            for run in runs:
                failures = rows.of_run(run)
                elapsed_s = (int(failures.publish_time_ns[0]) - sources[run].epoch_ns) * 1e-9
                reason = sentences_of(failures.take(slice(0, 1)))[0]
                sentence = f"{name_of(topic)} failed at {elapsed_s:.3f} s: {reason}"
                found.failed.setdefault(self._first_run + run, sentence)
        elif schema == SKIPPED:
            found.skipped.update(sentences_of(rows.stream))
        elif schema == STARTED:
            found.started.update(sentences_of(rows.stream))
        elif schema == COVERAGE:
            found.covered = plus(found.covered, covered(Output("", "", "", rows, sources)))

    def merge(self, other: "Diagnostics") -> None:
        """Add the diagnostics of other runs."""
        for topic, found in other._topics.items():
            self._topics.setdefault(topic, StreamDiagnostics()).merge(found)

    def failures(self, runs: Iterable[int]) -> list[tuple[int, str]]:
        """Return the number and a sentence for each run that an estimator did not process completely.

        Args:
            runs: the numbers of all runs.
        """
        sentences: dict[tuple[str, int], str] = {}
        for topic, found in self._topics.items():
            without: Iterable[int] = (
                [] if found.with_estimates is None else sorted({*runs} - found.with_estimates)
            )
            sentences |= {
                (name_of(topic), run): f"{name_of(topic)} gave no estimates" for run in without
            }
        for topic, found in self._topics.items():
            sentences |= {(name_of(topic), run): sentence for run, sentence in found.failed.items()}
        return [(run, sentence) for (_, run), sentence in sentences.items()]

    def notes(self) -> list[str]:
        """Return sentences about assumptions, time spans without estimates, and unused messages."""
        notes = []
        for topic, found in self._topics.items():
            for reason, count in found.started.items():
                runs = f" (in {count} runs)" if count > 1 else ""
                notes.append(f"{name_of(topic)}: {reason}{runs}")
        for topic, found in self._topics.items():
            share = estimated_share(found.covered)
            if share is not None and share < LEAST_SHARE:
                percent = f"{100 * share:.1f} % of the span was estimated"
                notes.append(f"{name_of(topic)}: {percent}; its figures cover only this part")
            for reason, count in found.skipped.items():
                notes.append(f"{name_of(topic)}: {count} not used: {reason}")
            for angle, count in found.wide.items():
                notes.append(
                    f"{name_of(topic)}: {angle} has a standard deviation above {WIDE_RAD:g} rad in "
                    f"{count} of {found.estimates} estimates: a Gaussian is a poor model of such an "
                    "angle, so positions, NEES and likelihood may be wrong; the methods bank and "
                    "particles represent several hypotheses"
                )
        return notes


def _wide_angles(estimates: Stream) -> dict[str, int]:
    """Count, for each angle, the estimates whose standard deviation exceeds `WIDE_RAD`."""
    components = stated_components(estimates.metadata, {}, estimates.topic)
    errors = tangent_components([*components], [*components.values()])
    size = len(errors)
    if not size or estimates["covariance"].shape[1] != size * size:
        return {}
    variances = estimates["covariance"][:, :: size + 1]
    counts = {
        name: int(np.count_nonzero(variances[:, place] > WIDE_RAD**2))
        for place, (name, kind) in enumerate(errors)
        if kind != "linear"
    }
    return {name: count for name, count in counts.items() if count}


def name_of(topic: str) -> str:
    """Return the name of a topic's estimator and case for use in sentences."""
    return " ".join(filter(None, split_topic(topic)))
