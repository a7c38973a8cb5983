"""Defines what estimators from plain functions are given: streams, one run, a block's messages."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Generic, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, Topic
from fuselog.recorders.parameters import ParametersType
from fuselog.replay.engine.arrays import AnyArray
from fuselog.replay.engine.philox import run_key
from fuselog.replay.engine.streams.blocks import Block, Ragged, ragged_rows
from fuselog.replay.engine.streams.channels import given_or_stated
from fuselog.replay.engine.streams.measurements import Vectors, numbers_of
from fuselog.replay.engine.streams.priors import gaussians
from fuselog.replay.engine.vectors.components import Components

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# What else the functions of an estimator get, and their parameters: of the estimator's own types.
Setup = Any  # type: ignore[explicit-any]
AnyParameters = Any  # type: ignore[explicit-any]


class Binding(NamedTuple):
    """Says what one estimator is bound to, where a log may have several.

    Attributes:
        streams, static: the topics by the names under which its functions know them, see `recursive`.
        suffix: what its name ends with, such as `/robot1`.
        priors: the components wanted of the static topics that are Gaussian priors, by the same names.
        setup: what else its functions get, as `Given.setup`.
    """

    streams: Mapping[str, Topic]
    static: Mapping[str, Topic] = MappingProxyType({})
    suffix: str = ""
    priors: Mapping[str, Components] = MappingProxyType({})
    setup: Setup = None


@dataclass(frozen=True, eq=False)
class Given(Mapping[str, Ragged], Generic[ParametersType]):
    """Holds what is given of all runs; topics go by the names under which an estimator asked for them.

    It maps the static topics to their streams: of a recursion what it starts from, of a batch
    all. A topic that is optional and that the log lacks is not in it.

    Attributes:
        parameters: the estimator's.
        topics: all that it is bound to.
        static: see above.
        runs: how many.
        name: the estimator's, with the suffix of its binding.
        setup: see `Binding`.
    """

    parameters: ParametersType
    topics: Mapping[str, Topic]
    static: Mapping[str, Ragged]
    runs: int
    name: str = ""
    setup: Setup = None

    def stated(self, topic: str, name: str) -> float:
        """Return the parameter `name`, or where it is None the number that `topic`'s channel states.

        Raises BadInput where neither does.
        """
        return given_or_stated(self.parameters, [self.topics[topic]], name)

    def prior(self, topic: str) -> tuple[Integers, Floats, Floats]:
        """Return each run's prior of `topic`: stamps (runs,), means (runs, d), covariances (runs, t, t).

        They are of the estimate's components, in their order, whatever the log's order is. NaN where a
        run has none that can be used: it has failed, and gets no messages.
        """
        return gaussians(self.static[topic])

    def __getitem__(self, topic: str) -> Ragged:
        """Return a static topic, all runs end to end."""
        return self.static[topic]

    def __iter__(self) -> Iterator[str]:
        """Return the names of what is given."""
        return iter(self.static)

    def __len__(self) -> int:
        """Count how many topics are given."""
        return len(self.static)


AnyGiven = Given[Any]  # type: ignore[explicit-any]


@dataclass(frozen=True, eq=False)
class OneRun(Mapping[str, Stream]):
    """Holds what is given of one run, stream by stream; see `Given` and `each_run`.

    Attributes:
        given: what is given of all runs.
        run: its number among them.
    """

    given: AnyGiven
    run: int

    def stated(self, topic: str, name: str) -> float:
        """Return the parameter `name`, or what the channel of `topic` states; see `Given.stated`."""
        return self.given.stated(topic, name)

    def prior(self, topic: str) -> tuple[int, Floats, Floats]:
        """Return the run's prior of `topic`: stamp, mean (d,), covariance (t, t); see `Given.prior`."""
        stream = self[topic]
        time_ns, mean, covariance = gaussians(Ragged(stream, np.array([0, len(stream)])))
        return int(time_ns[0]), mean[0], covariance[0]

    @cached_property
    def generator(self) -> np.random.Generator:
        """Make the run's own generator, from the parameter `seed` and the first messages of its streams.

        So it is the same on any number of cores, and whatever other runs there are.
        """
        first = [column[:1] for stream in self.values() for column in stream.columns.values()]
        return generator_of(self.given.parameters, first)

    def __getitem__(self, topic: str) -> Stream:
        """Return a topic's messages of this run."""
        return self.given[topic].of_run(self.run)

    def __iter__(self) -> Iterator[str]:
        """Return the names of what is given."""
        return iter(self.given)

    def __len__(self) -> int:
        """Count how many topics are given."""
        return len(self.given)


def generator_of(parameters: AnyParameters, first: Iterable[AnyArray]) -> np.random.Generator:
    """Return a counter-based generator (Philox), keyed by a seed and a run's first data.

    Args:
        parameters: with a `seed`.
        first: arrays of the run's first messages.
    """
    key = run_key(getattr(parameters, "seed", 0), first)
    return np.random.Generator(np.random.Philox(key=key))


class Messages(NamedTuple):
    """Holds the messages of all runs in time order: run r owns the rows offsets[r]:offsets[r + 1].

    Attributes:
        offsets: (runs + 1,).
        time_ns: (n,).
        topic: (n,) which stream, in the order in which they were asked for.
        value: (n, width) the fields after the sensor's clock, in order of declaration; NaN beyond. Of
            vectors there are the components that were asked for, in that order.
    """

    offsets: Integers
    time_ns: Integers
    topic: Integers
    value: Floats


class Skipped(NamedTuple):
    """Holds messages that were not used: offsets by run, stamps, and the number of each's reason."""

    offsets: Integers
    time_ns: Integers
    reason: Integers
    reasons: list[str]


def messages_of(
    block: Block, vectors: Mapping[str, Vectors], parameters: AnyParameters
) -> tuple[Messages, Skipped]:
    """Return a block's messages, their fields as numbers; and those that lack a covariance.

    Args:
        block: of all runs.
        vectors: the vectors that are wanted of topics, by name.
        parameters: the estimator's.
    """
    events = block.events
    read = [
        numbers_of(ragged.stream, vectors.get(topic), parameters)
        for topic, ragged in block.streams.items()
    ]
    tables, missing = zip(*read, strict=True)
    skip = np.concatenate(missing)[events.source]
    reasons = [vectors[topic].complaint(topic) if topic in vectors else "" for topic in block.streams]
    skipped = Skipped(
        ragged_rows(skip, events.offsets), events.time_ns[skip], events.topic[skip], reasons
    )
    # the messages of one topic are in order already
    value = tables[0] if len(tables) == 1 else _side_by_side(tables)[events.source]
    rows = ~skip if skip.any() else slice(None)
    kept = Messages(
        ragged_rows(~skip, events.offsets),
        events.time_ns[rows],
        events.topic[rows],
        value[rows],
    )
    return kept, skipped


def _side_by_side(tables: Sequence[Floats]) -> Floats:
    """Lay tables one after another, NaN where one has fewer columns than the widest."""
    width = max(table.shape[1] for table in tables)
    found = np.full((sum(map(len, tables)), width), np.nan)
    for begin, table in zip(np.cumsum([0, *map(len, tables)]), tables, strict=False):
        found[begin : begin + len(table), : table.shape[1]] = table
    return found
