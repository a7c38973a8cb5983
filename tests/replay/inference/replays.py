"""How the tests of models and methods replay: a model by a method, over sources in memory."""

from collections.abc import Sequence
from typing import Any

from fuselog.recorders.parameters import build
from fuselog.replay.engine.replaying.estimator import Bound
from fuselog.replay.engine.replaying.replaying import collect, replay
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.sources import Source
from fuselog.replay.inference.all_methods import METHODS
from fuselog.replay.inference.estimators import bind_model, combined
from fuselog.replay.inference.model.model import Model


def bound(model: Model, method: str, sources: Sequence[Source], **values: Any) -> list[Bound]:
    """The filters of a model by a method, bound to the topics of the first source."""
    chosen = METHODS[method]
    parameters = build(combined(model, chosen), values, "test")
    return bind_model("test", sources[0].topics, parameters, model=model, method=chosen)


def outputs(
    model: Model,
    method: str,
    sources: Sequence[Source],
    block_messages: int = 1 << 18,
    **values: Any,
) -> dict[str, Ragged]:
    """All that a replay gives, by the last parts of the topics: state, innovation, failure, ..."""
    filters = bound(model, method, sources, **values)
    found = collect(replay(sources, filters, block_messages=block_messages))
    return {topic.rpartition("/")[2]: ragged for topic, ragged in found.items()}
