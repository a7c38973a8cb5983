"""Access to an estimator's estimates under the name that a comparison uses for it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from fuselog.recorders.log import Clock, RunMetadata, Stream, Topic
from fuselog.replay.engine.streams.sources import DerivedSource


@dataclass(frozen=True)
class Renamed(DerivedSource):
    """A source that reads the estimates of one label on demand, under another name."""

    label: str
    to: str

    @property
    def run(self) -> RunMetadata:
        """Return the run's description."""
        return self.of.run or RunMetadata("unknown", epoch_ns=self.epoch_ns)

    @cached_property
    def topics(self) -> Mapping[str, Topic]:
        """Return the label's topics."""
        return {
            self._new(name): replace(topic, name=self._new(name))
            for name, topic in self.of.topics.items()
            if name.startswith(f"/estimates/{self.label}/")
        }

    def read(self, topics: Sequence[str]) -> dict[str, Stream]:
        """Read whole topics, in publish-time order."""
        return self._renamed(self.of.read([self._old(topic) for topic in topics]))

    def empty(self, topic: str) -> Stream:
        """Return the topic without its messages."""
        return replace(self.of.empty(self._old(topic)), topic=topic)

    def blocks(
        self, topics: Sequence[str], order: Clock, block_messages: int
    ) -> Iterator[dict[str, Stream]]:
        """Yield successive blocks of topics."""
        own = [self._old(topic) for topic in topics]
        return map(self._renamed, self.of.blocks(own, order, block_messages))

    def whole(self) -> "Renamed":
        """Return the whole run, not limited to a span."""
        return replace(self, of=self.of.whole())

    def _renamed(self, streams: Mapping[str, Stream]) -> dict[str, Stream]:
        return {
            self._new(name): replace(stream, topic=self._new(name)) for name, stream in streams.items()
        }

    def _new(self, topic: str) -> str:
        return f"/estimates/{self.to}/{topic.removeprefix(f'/estimates/{self.label}/')}"

    def _old(self, topic: str) -> str:
        return f"/estimates/{self.label}/{topic.removeprefix(f'/estimates/{self.to}/')}"
