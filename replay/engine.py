"""The replay: one time-ordered pass over the runs of an ensemble, several estimators at once.

An estimator is bound to topics and turns ragged streams into ragged streams. A recursive one is handed
the blocks of its topics one after another and carries a state from block to block; a batch one gets
whole streams and is done. The same call serves one run and many, so an ensemble's results are those of
the runs replayed one by one, bit for bit.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic

import numpy as np

from recorders.errors import BadInput
from recorders.log.reader import Order, Topic
from recorders.log.streams import concatenate
from recorders.parameters import Parameters, ParametersType, build
from recorders.registry import load
from replay.blocks import Block, Ragged, gather, merge_events
from replay.sources import Source

BLOCK_MESSAGES = 1 << 18


@dataclass(frozen=True)
class Recursive:
    """An estimator that goes through its topics in time.

    Attributes:
        name: what its output topics begin with, `/estimates/` + name.
        streams: the topics that `run` is handed, in the order its `Events.topic` counts them.
        whole: the topics that `start` needs whole, such as a map or a prior.
        start: whole topics -> the state before the first block.
        run: state and block -> the state after it, and the output streams. States are values: `run`
            never changes the one it is handed.
    """

    name: str
    streams: tuple[str, ...]
    whole: tuple[str, ...]
    start: Callable[[dict[str, Ragged]], Any]
    run: Callable[[Any, Block], tuple[Any, list[Ragged]]]


@dataclass(frozen=True)
class Batch:
    """An estimator that needs its topics whole: `solve` turns them into output streams."""

    name: str
    whole: tuple[str, ...]
    solve: Callable[[dict[str, Ragged]], list[Ragged]]


Bound = Recursive | Batch


@dataclass(frozen=True)
class Estimator(Generic[ParametersType]):
    """A registered estimator: what it is, its parameters, and how it binds to the topics of a log.

    `bind` gets the name to use, the log's topics and the parameters, and returns one bound estimator
    for everything it can estimate there (each robot, say); none where the log does not fit. `variant`
    names the parameter that the rest of a name such as `lrkf:s2kf-50` sets.
    """

    summary: str
    needs: str
    parameters: type[ParametersType]
    bind: Callable[[str, Mapping[str, Topic], ParametersType], list[Bound]]
    variant: str | None = None


def bind(name: str, sources: Sequence[Source], settings: Mapping[str, Any]) -> list[Bound]:
    """Bind the estimator `name`, or `name:variant`, to an ensemble.

    `settings` are its parameters; an entry `kind` gives the registered name where `name` is only a
    label, so that one estimator can be replayed with several settings at once.

    Raises BadInput where the name or a parameter is unknown, the estimator does not fit the log, or the
    runs of the ensemble do not hold the same topics.
    """
    values = dict(settings)
    kind, _, variant = str(values.pop("kind", name)).partition(":")
    estimator: Estimator[Any] = load("estimators", kind)
    if variant:
        if estimator.variant is None:
            raise BadInput(f"estimator {kind} has no variants; give '{kind}' without ':{variant}'")
        values[estimator.variant] = variant
    parameters: Parameters = build(estimator.parameters, values, f"estimator {name}")
    first = sources[0]
    bound = estimator.bind(name, first.topics, parameters)
    if not bound:
        raise BadInput(
            f"{first.name}: estimator {name} does not fit this log: it needs {estimator.needs}; "
            f"the log has {', '.join(first.topics) or 'no topics'}"
        )
    for source in sources[1:]:
        for topic in {topic for each in bound for topic in topics_of(each)}:
            there = source.topics.get(topic)
            if there is None or there.schema_name != first.topics[topic].schema_name:
                raise BadInput(
                    f"{source.name}: topic {topic} is not as in {first.name}; the runs of an "
                    "ensemble hold the same topics, replay this one on its own"
                )
    return bound


def topics_of(bound: Bound) -> tuple[str, ...]:
    """All topics that a bound estimator reads."""
    return bound.whole + (bound.streams if isinstance(bound, Recursive) else ())


def replay(
    sources: Sequence[Source],
    estimators: Sequence[Bound],
    *,
    order: Order = "publish_time",
    block_messages: int = BLOCK_MESSAGES,
) -> Iterator[list[Ragged]]:
    """Replay an ensemble; yields the output streams of all estimators, block by block.

    Args:
        sources: the runs, holding the same topics; their schedules may differ.
        estimators: bound estimators with different names.
        order: the clock to go by, publish time or (as it arrived) log time.
        block_messages: about how many messages of a run are in memory at once.
    """
    needed = {topic for bound in estimators for topic in bound.whole}
    whole = _read_whole(sources, sorted(needed))
    for bound in estimators:
        if isinstance(bound, Batch):
            yield bound.solve({topic: whole[topic] for topic in bound.whole})
    recursive = [bound for bound in estimators if isinstance(bound, Recursive)]
    states = [bound.start({topic: whole[topic] for topic in bound.whole}) for bound in recursive]
    streamed = sorted({topic for bound in recursive for topic in bound.streams})
    for block in _ensemble_blocks(sources, streamed, order, block_messages):
        outputs: list[Ragged] = []
        for index, bound in enumerate(recursive):
            streams = {topic: block[topic] for topic in bound.streams}
            states[index], produced = bound.run(
                states[index], Block(streams, merge_events(streams, order))
            )
            outputs += produced
        yield outputs


def _read_whole(sources: Sequence[Source], topics: Sequence[str]) -> dict[str, Ragged]:
    runs = [source.read(topics) for source in sources]
    return {topic: gather([run[topic] for run in runs]) for topic in topics}


def _ensemble_blocks(
    sources: Sequence[Source], topics: Sequence[str], order: Order, block_messages: int
) -> Iterator[dict[str, Ragged]]:
    """The next block of every run, until all runs are at their end.

    The runs need not be at the same time: each has its own state.
    """
    if not topics:
        return
    readers = [source.blocks(topics, order, block_messages) for source in sources]
    empty = {topic: sources[0].empty(topic) for topic in topics}
    while True:
        blocks = [next(reader, None) for reader in readers]
        if all(block is None for block in blocks):
            return
        yield {
            topic: gather([(block or {}).get(topic, empty[topic]) for block in blocks])
            for topic in topics
        }


def collect(outputs: Iterable[list[Ragged]]) -> dict[str, Ragged]:
    """Join a replay's blocks into whole output streams by topic, each run's rows together."""
    parts: dict[str, list[Ragged]] = {}
    for block in outputs:
        for ragged in block:
            parts.setdefault(ragged.stream.topic, []).append(ragged)
    return {topic: _join(found) for topic, found in parts.items()}


def _join(parts: list[Ragged]) -> Ragged:
    if len(parts) == 1:
        return parts[0]
    run = np.concatenate([np.repeat(np.arange(part.runs), np.diff(part.offsets)) for part in parts])
    stream = concatenate([part.stream for part in parts if len(part)] or [parts[0].stream])
    offsets = sum((part.offsets for part in parts), np.zeros(1, np.int64))
    return Ragged(stream.take(np.argsort(run, kind="stable")), offsets)
