"""What the estimator that is diagnosed gave, read as it is needed: of a long log it is much."""

from collections.abc import Iterator, Mapping

from pipeline.api.replays import Replay
from recorders.log import Schema, Stream


class Outputs(Mapping[str, Stream]):
    """The outputs of a replay that have a schema, by topic: each is read anew when it is asked for."""

    def __init__(self, done: Replay, schema: Schema) -> None:
        self._estimates = done.estimates[0]
        self._topics = [
            name
            for name, topic in self._estimates.topics.items()
            if topic.schema_name == schema.full_name and topic.messages
        ]

    def __getitem__(self, topic: str) -> Stream:
        return self._estimates[topic]

    def __iter__(self) -> Iterator[str]:
        return iter(self._topics)

    def __len__(self) -> int:
        return len(self._topics)

    def state(self, column: str) -> bool:
        """Whether all of them have a column."""
        firsts = (next(iter(self._estimates.blocks([topic], "publish_time", 1))) for topic in self)
        return all(column in stream.columns for first in firsts for stream in first.values())
