"""Types that an estimator's functions receive: streams, a single run, and the messages of a block."""

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

# Further data for the functions of an estimator, and their parameters: the estimator defines both types.
Setup = Any  # type: ignore[explicit-any]
AnyParameters = Any  # type: ignore[explicit-any]


class Binding(NamedTuple):
    """Topics that one estimator is bound to; a log may have several bindings.

    Attributes:
        streams, static: the topics, by the names that the functions use for them; see `recursive`.
        suffix: the end of the estimator's name, such as `/robot1`.
        priors: components to read from each static topic that is a Gaussian prior, by the topic's name
            in `static`.
        setup: further data for the functions, which get it as `Given.setup`.
    """

    streams: Mapping[str, Topic]
    static: Mapping[str, Topic] = MappingProxyType({})
    suffix: str = ""
    priors: Mapping[str, Components] = MappingProxyType({})
    setup: Setup = None


@dataclass(frozen=True, eq=False)
class Given(Mapping[str, Ragged], Generic[ParametersType]):
    """Input of all runs; topics have the names that the estimator's functions use.

    As a mapping, it maps topic names to streams: the topics that a recursion starts from, or all topics
    of a batch estimator. An optional topic that the log lacks is not a key.

    Attributes:
        parameters: the estimator's parameters.
        topics: all topics to which the estimator is bound.
        static: the streams of the mapping, by topic name.
        runs: number of runs.
        name: the estimator's name, with the suffix of its binding.
        setup: see `Binding`.
    """

    parameters: ParametersType
    topics: Mapping[str, Topic]
    static: Mapping[str, Ragged]
    runs: int
    name: str = ""
    setup: Setup = None

    def stated(self, topic: str, name: str) -> float:
        """Return the parameter `name`, or, if it is None, the number that the channel of `topic` states.

        Raises BadInput if neither has a value.
        """
        return given_or_stated(self.parameters, [self.topics[topic]], name)

    def prior(self, topic: str) -> tuple[Integers, Floats, Floats]:
        """Return the priors on `topic`: stamps (runs,), means (runs, d), covariances (runs, t, t).

        The components have the order of the estimate, regardless of the order in the log. A run without
        a usable prior has NaN in its mean and covariance; it has failed and gets no messages.
        """
        return gaussians(self.static[topic])

    def __getitem__(self, topic: str) -> Ragged:
        """Return the stream of the static topic `topic`, all runs end to end."""
        return self.static[topic]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the given topics."""
        return iter(self.static)

    def __len__(self) -> int:
        """Return the number of given topics."""
        return len(self.static)


AnyGiven = Given[Any]  # type: ignore[explicit-any]


@dataclass(frozen=True, eq=False)
class OneRun(Mapping[str, Stream]):
    """Input of one run as a mapping from topic names to streams; see `Given` and `each_run`.

    Attributes:
        given: the input of all runs.
        run: the number of this run.
    """

    given: AnyGiven
    run: int

    def stated(self, topic: str, name: str) -> float:
        """Return the parameter `name`, or the number that channel `topic` states; see `Given.stated`."""
        return self.given.stated(topic, name)

    def prior(self, topic: str) -> tuple[int, Floats, Floats]:
        """Return the run's prior on `topic`: stamp, mean (d,), covariance (t, t); see `Given.prior`."""
        stream = self[topic]
        time_ns, mean, covariance = gaussians(Ragged(stream, np.array([0, len(stream)])))
        return int(time_ns[0]), mean[0], covariance[0]

    @cached_property
    def generator(self) -> np.random.Generator:
        """Make the run's random generator from the parameter `seed` and the run's first messages.

        The generator therefore depends neither on the number of cores nor on the other runs.
        """
        first = [column[:1] for stream in self.values() for column in stream.columns.values()]
        return generator_of(self.given.parameters, first)

    def __getitem__(self, topic: str) -> Stream:
        """Return the messages of `topic` in this run."""
        return self.given[topic].of_run(self.run)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the given topics."""
        return iter(self.given)

    def __len__(self) -> int:
        """Return the number of given topics."""
        return len(self.given)


def generator_of(parameters: AnyParameters, first: Iterable[AnyArray]) -> np.random.Generator:
    """Make a counter-based random generator (Philox), keyed by a seed and the first data of a run.

    Args:
        parameters: the estimator's parameters; the seed is their `seed`, or 0 if they have no such
            parameter.
        first: arrays of the run's first messages.
    """
    key = run_key(getattr(parameters, "seed", 0), first)
    return np.random.Generator(np.random.Philox(key=key))


class Messages(NamedTuple):
    """Messages of all runs in time order: rows offsets[r]:offsets[r + 1] belong to run r.

    Attributes:
        offsets: (runs + 1,) first row of each run, and the total number of rows.
        time_ns: (n,) stamps.
        topic: (n,) index of the stream, in the order in which the streams were requested.
        value: (n, width) the fields that follow the sensor's clock in a message, in order of
            declaration, padded with NaN. Vectors contribute only the requested components, in the
            requested order.
    """

    offsets: Integers
    time_ns: Integers
    topic: Integers
    value: Floats


class Skipped(NamedTuple):
    """Skipped messages: the offsets of the runs, the stamps, and the indices of the reasons."""

    offsets: Integers
    time_ns: Integers
    reason: Integers
    reasons: list[str]


def messages_of(
    block: Block, vectors: Mapping[str, Vectors], parameters: AnyParameters
) -> tuple[Messages, Skipped]:
    """Convert the messages of a block to arrays of numbers, and list messages that lack a covariance.

    Args:
        block: messages of all runs.
        vectors: by topic, the vectors to read.
        parameters: the estimator's parameters.
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
    # the messages of a single topic are already in order
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
    """Stack tables of different widths vertically, padded with NaN to the widest."""
    width = max(table.shape[1] for table in tables)
    found = np.full((sum(map(len, tables)), width), np.nan)
    for begin, table in zip(np.cumsum([0, *map(len, tables)]), tables, strict=False):
        found[begin : begin + len(table), : table.shape[1]] = table
    return found
