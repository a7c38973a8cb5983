"""Types that the functions of an estimator fill or return, and the output topics made from them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from fuselog.recorders.errors import BadInput
from fuselog.recorders.log import Schema, Stream, make_stream, schemas
from fuselog.replay.engine.api.inputs import Floats, Integers, Messages, Skipped
from fuselog.replay.engine.arrays import AnyArray, Columns
from fuselog.replay.engine.streams.blocks import Ragged, gather, last_of_equals
from fuselog.replay.engine.streams.failures import Failure, reason_stream
from fuselog.replay.engine.streams.results import (
    InnovationColumns,
    failures_by_run,
    innovation_stream,
    state_stream,
    states_in,
)
from fuselog.replay.engine.vectors.components import Components
from fuselog.replay.engine.vectors.covariances import log_likelihood
from fuselog.replay.engine.vectors.tangent import tangent_components

DIVERGED = "the estimate is no longer finite: the filter diverged"


class Results(NamedTuple):
    """Arrays that a recursion fills, one row for every message; a row of NaN means no value.

    Attributes:
        mean, covariance: (n, d), (n, t, t) the estimate after the message; t is the number of components
            in the tangent space (see `fuselog.replay.engine.vectors.tangent`), which is d if all
            components are linear or angles.
        innovation, innovation_covariance: (n, m), (n, m, m) the innovation of the message and its
            covariance.
        squared: (n,) the normalised innovation squared. Together with the innovation and its covariance,
            it gives the likelihood of the message, which `tune` and `diagnose` use.
        accepted: (n,) whether a gate accepted the message; 1 unless set.
        target: (n,) identifier of the target that was measured; 0 unless set.
        further: (n, k) the fields of the further outputs after the sensor's clock, side by side in order
            of declaration; a row yields a message of an output if the first field of that output is
            finite.
    """

    mean: Floats
    covariance: Floats
    innovation: Floats
    innovation_covariance: Floats
    squared: Floats
    accepted: Integers
    target: Integers
    further: Floats


class Solution(NamedTuple):
    """Convergence statistics of the solutions, (n,) each.

    Attributes:
        iterations: number of iterations.
        converged: 1 if the solver converged, otherwise 0.
        rank: rank of the Jacobian at the solution.
        cost: the minimised cost at the solution.
    """

    iterations: Integers
    converged: Integers
    rank: Integers
    cost: Floats


class Diagnostics(NamedTuple):
    """Messages of a further output of a batch estimator: stamps (n,) and the columns of its schema.

    Attributes:
        time_ns: (n,), the stamps.
        columns: the columns (n, ...) by field of the schema.
    """

    time_ns: Integers
    columns: Mapping[str, AnyArray]


class Measured(NamedTuple):
    """Innovations of the measurements of a batch estimator.

    Attributes:
        time_ns: (n,), the stamps.
        innovation: (n, m), measured minus predicted.
        covariance: (n, m, m), the covariances of the innovations.
        target: (n,), identifiers of the measured targets; 0 if not given.
    """

    time_ns: Integers
    innovation: Floats
    covariance: Floats
    target: Integers | None = None


class Estimates(NamedTuple):
    """Solution of one run.

    Attributes:
        time_ns, mean, covariance: stamps (n,), means (n, d), covariances (n, t, t).
        solution: convergence statistics.
        innovations: innovations of the measurements, if the batch estimator declares `measured`.
        further: the further `outputs` of the batch estimator, by name.
    """

    time_ns: Integers
    mean: Floats
    covariance: Floats
    solution: Solution | None = None
    innovations: Measured | None = None
    further: Mapping[str, Diagnostics] = MappingProxyType({})


class Solved(NamedTuple):
    """Estimates and failures of the runs; a failed run has no estimates.

    Attributes:
        estimates: the estimates by run number.
        failures: time and reason of each failure, the estimates by run number.
    """

    estimates: Mapping[int, Estimates]
    failures: Mapping[int, Failure]


@dataclass(frozen=True)
class Outputs:
    """Builder of the output topics of one bound estimator: state, failures and innovations."""

    name: str
    topic: str
    truth: str
    components: Components
    measured: Components
    further: Mapping[str, Schema]

    @property
    def tangent(self) -> int:
        """Return the number of components of the tangent space."""
        return len(tangent_components(list(self.components), list(self.components.values())))

    def blank(self, rows: int) -> Results:
        """Make results with `rows` rows: 1 in `accepted`, 0 in `target`, NaN in all other arrays."""
        d, t, m = len(self.components), self.tangent, len(self.measured)
        width = sum(len(schema.fields) - 1 for schema in self.further.values())
        return Results(
            np.full((rows, d), np.nan),
            np.full((rows, t, t), np.nan),
            np.full((rows, m), np.nan),
            np.full((rows, m, m), np.nan),
            np.full(rows, np.nan),
            np.ones(rows, np.int64),
            np.zeros(rows, np.int64),
            np.full((rows, width), np.nan),
        )

    def of_block(self, messages: Messages, results: Results, failing: Integers) -> list[Ragged]:
        """Make the output streams of one block, with only the last of several estimates at one stamp."""
        # invalid covariances are found and reported by the replay
        is_estimate = np.isfinite(np.einsum("nd->n", results.mean))
        rows = np.flatnonzero(is_estimate)
        rows = rows[last_of_equals(np.searchsorted(rows, messages.offsets), messages.time_ns[rows])]
        columns = messages.time_ns, messages.offsets, self.components, self.truth
        state = states_in(rows, f"{self.topic}/state", *columns, results.mean, results.covariance)
        failures = {}
        for run in failing.tolist():
            begin, end = messages.offsets[run : run + 2]
            last = np.flatnonzero(is_estimate[begin:end]).max(initial=-1)
            end_ns = messages.time_ns[min(begin + last + 1, end - 1)]
            failures[run] = Failure(int(end_ns), DIVERGED)
        made = [
            state,
            failures_by_run(self.topic, failures, len(messages.offsets) - 1),
        ]
        if self.measured:
            made.append(self._innovations_of_block(messages, results))
        return [*made, *self._further_of_block(messages, results.further)]

    def of_skipped(self, skipped: Skipped) -> list[Ragged]:
        """Make the stream that reports measurements skipped because they lack a covariance."""
        if not any(skipped.reasons):
            return []
        topic = f"{self.topic}/skipped"
        stream = reason_stream(topic, schemas.SKIPPED, skipped.time_ns, skipped.reason, skipped.reasons)
        return [Ragged(stream, skipped.offsets)]

    def of_solved(self, solved: Solved, runs: int) -> list[Ragged]:
        """Make the output streams of a batch estimator."""
        made = [failures_by_run(self.topic, solved.failures, runs)]
        parts: dict[str, dict[int, Stream]] = {}
        for run, estimates in solved.estimates.items():
            for stream in self._of_run(estimates):
                parts.setdefault(stream.topic, {})[run] = stream
        for found in parts.values():
            nothing = next(iter(found.values())).take(slice(0, 0))
            made.append(gather([found.get(run, nothing) for run in range(runs)]))
        return made

    def _innovations_of_block(self, messages: Messages, results: Results) -> Ragged:
        rows = np.flatnonzero(~np.isnan(results.squared))
        accepted, squared = results.accepted[rows], results.squared[rows]
        innovation, covariance = results.innovation[rows], results.innovation_covariance[rows]
        likelihood = np.where(accepted, log_likelihood(squared, innovation, covariance), 0.0)
        columns = InnovationColumns(
            messages.time_ns[rows],
            results.target[rows],
            accepted,
            innovation,
            covariance,
            squared,
            likelihood,
        )
        topic = f"{self.topic}/innovation"
        stream = innovation_stream(topic, self.measured, self.truth, columns)
        return Ragged(stream, np.searchsorted(rows, messages.offsets))

    def _further_of_block(self, messages: Messages, numbers: Floats) -> Iterator[Ragged]:
        first = 0
        for name, schema in self.further.items():
            names = [field.name for field in schema.fields[1:]]
            own, first = numbers[:, first : first + len(names)], first + len(names)
            rows = np.flatnonzero(np.isfinite(own[:, 0]))
            columns = dict(zip(names, own[rows].T, strict=True))
            stream = make_stream(f"{self.topic}/{name}", schema, messages.time_ns[rows], **columns)
            yield Ragged(stream, np.searchsorted(rows, messages.offsets))

    def _of_run(self, estimates: Estimates) -> Iterator[Stream]:
        """Yield the output streams of one run; raise BadInput if an array has a wrong shape."""
        time_ns, mean, covariance = self._checked(
            "", estimates[:3], ((), (len(self.components),), (self.tangent,) * 2)
        )
        topic, components = f"{self.topic}/state", self.components
        yield state_stream(topic, time_ns, components, self.truth, mean, covariance)
        if estimates.solution is not None:
            yield make_stream(
                f"{self.topic}/solution",
                schemas.SOLUTION,
                time_ns,
                metadata={"truth": self.truth},
                **estimates.solution._asdict(),
            )
        if self.measured:
            yield self._innovations_of_run(estimates.innovations)
        for name, schema in self.further.items():
            if name in estimates.further:
                further = estimates.further[name]
                columns: dict[str, Columns] = dict(further.columns)
                yield make_stream(f"{self.topic}/{name}", schema, further.time_ns, **columns)

    def _innovations_of_run(self, innovations: Measured | None) -> Stream:
        m = len(self.measured)
        innovations = innovations or Measured(
            np.empty(0, np.int64), np.empty((0, m)), np.empty((0, m, m))
        )
        time_ns, innovation, covariance = self._checked(
            "innovations.", innovations[:3], ((), (m,), (m, m))
        )
        count = len(time_ns)
        weighted = np.linalg.solve(covariance, innovation[..., None])[..., 0]
        target = np.zeros(count, np.int64) if innovations.target is None else innovations.target
        squared, accepted = np.einsum("ni,ni->n", innovation, weighted), np.ones(count, np.int64)
        columns = InnovationColumns(time_ns, target, accepted, innovation, covariance, squared)
        return innovation_stream(f"{self.topic}/innovation", self.measured, self.truth, columns)

    def _checked(
        self, part: str, arrays: Sequence[Columns], shapes: Sequence[tuple[int, ...]]
    ) -> tuple[Integers, Floats, Floats]:
        """Convert stamps, means and covariances to arrays; raise BadInput if a shape is wrong."""
        time_ns, mean, covariance = (np.asarray(array) for array in arrays)
        names = ("time_ns", "innovation" if part else "mean", "covariance")
        for name, array, shape in zip(names, (time_ns, mean, covariance), shapes, strict=True):
            wanted = (*time_ns.shape[:1], *shape)
            if array.shape != wanted:
                raise BadInput(
                    f"estimator {self.name}: {part}{name} has the shape {array.shape}; "
                    f"{wanted} is needed"
                )
        return time_ns, mean.astype(float, copy=False), covariance.astype(float, copy=False)
