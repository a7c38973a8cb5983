"""Changes of a run that should not matter; each one copies the run with changed topics.

Most changes have a size, 1, 0.5 or 0.25, to test whether their effect shrinks with the size.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.recorders.log.streams import concatenate
from fuselog.recorders.models.orientation import compose
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.engine.vectors.tangent import manifold_blocks

SHIFT_NS = 1000
START_SIGMAS = 0.1
PARAMETER_SHARE = 0.01
DROPPED_SHARE = 0.01
PARAMETERS, DROPPED = "parameters", "dropped"


class Inputs(NamedTuple):
    """The inputs that a change may alter: topics of sensors, topics of controls, priors."""

    sensed: Collection[str]
    controls: Collection[str]
    priors: Collection[str]


Changed = Callable[[MemorySource, Inputs, float, int], MemorySource]


class Change(NamedTuple):
    """A change, with its description, its function, and whether it can be halved."""

    words: str
    of_run: Changed | None
    is_scaled: bool


def _with(source: MemorySource, streams: Mapping[str, Stream]) -> MemorySource:
    return replace(source, streams={**source.streams, **streams})


def _group(stream: Stream) -> str:
    """Return a topic's group; a scan's topics form one, changed with one sign and dropped together."""
    is_of_scan = any(field.name == "scan_id" for field in stream.schema)
    return stream.topic.rpartition("/")[0] if is_of_scan else stream.topic


def _groups(source: MemorySource, inputs: Inputs) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for topic in sorted(inputs.sensed):
        groups.setdefault(_group(source.streams[topic]), []).append(topic)
    return groups


def _shares(source: MemorySource, inputs: Inputs, seed: int) -> dict[str, float]:
    """Draw a factor from -1 to 1 for the topics of each group, so that groups' stamps differ."""
    groups = _groups(source, inputs)
    shares = np.linspace(1.0, -1.0, len(groups))
    drawn = np.random.default_rng(seed).permutation(shares).tolist()
    pairs = zip(groups.values(), drawn, strict=True)
    return {topic: share for topics, share in pairs for topic in topics}


def _stamps(source: MemorySource, inputs: Inputs, size: float, seed: int) -> MemorySource:
    """Move stamps, but not to before the run's first message, because earlier messages would be lost."""
    starts_ns = [source.streams[topic].publish_time_ns for topic in inputs.priors]
    first_ns = min((int(each[0]) for each in starts_ns if len(each)), default=SHIFT_NS)
    moved = {}
    for topic, share in _shares(source, inputs, seed).items():
        stream, by_ns = source.streams[topic], round(share * size * SHIFT_NS)
        stamps_ns = stream.publish_time_ns
        held_ns = np.maximum(stamps_ns + by_ns, np.minimum(stamps_ns, first_ns))
        moved[topic] = replace(stream, publish_time_ns=held_ns, log_time_ns=stream.log_time_ns + by_ns)
    if any(len(each) and each.log_time_ns.min() < 0 for each in moved.values()):
        moved = {t: replace(s, log_time_ns=source.streams[t].log_time_ns) for t, s in moved.items()}
    return _with(source, moved)


def _order(source: MemorySource, inputs: Inputs, _: float, __: int) -> MemorySource:
    """Reverse the order of topics with equal stamps, but keep the topics of a scan together."""
    last = max(int(each.position.max()) for each in source.streams.values() if len(each))
    turned = {}
    for topics in _groups(source, inputs).values():
        streams = [source.streams[topic] for topic in topics]
        stamps_ns, place = np.unique(
            np.concatenate([each.publish_time_ns for each in streams]), return_inverse=True
        )
        position = np.concatenate([each.position for each in streams])
        first = np.full(len(stamps_ns), last + 1)
        np.minimum.at(first, place, position)
        position = position + (last - first[place]) * (last + 1)
        cuts = np.cumsum([len(each) for each in streams])[:-1]
        for each, own in zip(streams, np.split(position, cuts), strict=True):
            turned[each.topic] = replace(each, position=own)
    return _with(source, turned)


def _inputs(change: Callable[[NDArray[np.float64], np.random.Generator], NDArray]) -> Changed:
    """Make a change that applies `change` to every floating-point number of sensors."""

    def changed(source: MemorySource, inputs: Inputs, size: float, seed: int) -> MemorySource:
        rng, streams = np.random.default_rng(seed), {}
        for topic in inputs.sensed:
            stream = source.streams[topic]
            columns = {
                name: np.where(
                    np.isfinite(column), column + size * (change(column, rng) - column), column
                )
                for name, column in stream.columns.items()
                if column.dtype == np.float64
            }
            streams[topic] = replace(stream, columns={**stream.columns, **columns})
        return _with(source, streams)

    return changed


def _in_single(column: NDArray[np.float64], _: np.random.Generator) -> NDArray:
    return column.astype(np.float32).astype(np.float64)


def _by_an_ulp(column: NDArray[np.float64], rng: np.random.Generator) -> NDArray:
    toward = np.where(rng.integers(0, 2, column.shape) == 0, -np.inf, np.inf)
    return np.nextafter(column, toward)


def _start(source: MemorySource, inputs: Inputs, size: float, seed: int) -> MemorySource:
    """Shift the initial state by START_SIGMAS prior sigmas along every axis, so A = START_SIGMAS."""
    rng, streams = np.random.default_rng(seed), {}
    for topic in inputs.priors:
        stream = source.streams[topic]
        kinds, rows = stream.metadata["kinds"].split(","), len(stream)
        n = int(np.sqrt(stream["covariance"].shape[1]))
        covariance = np.nan_to_num(stream["covariance"].reshape(rows, n, n), posinf=0.0)
        signs = rng.integers(0, 2, (rows, n)) * 2.0 - 1.0
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        by = size * START_SIGMAS * np.einsum("rij,rj->ri", root, signs)
        streams[topic] = replace(stream, columns={**stream.columns, "mean": _moved(stream, kinds, by)})
    return _with(source, streams)


def _moved(stream: Stream, kinds: list[str], by: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move states in their tangent space by steps (rows, tangent components)."""
    mean, place = stream["mean"].copy(), 0
    for kind, columns in manifold_blocks(kinds):
        if kind == "quaternion":
            half = 0.5 * by[:, place : place + 3]
            turn = np.concatenate([np.ones((len(by), 1)), half], axis=1)
            turn /= np.linalg.norm(turn, axis=1, keepdims=True)
            mean[:, columns] = compose(mean[:, columns], turn)
            place += 3
            continue
        if kind != "axis":  # an axis does not change
            mean[:, columns] += by[:, place : place + 1]
        place += 1
    return mean


def _dropped(source: MemorySource, inputs: Inputs, _: float, seed: int) -> MemorySource:
    """Drop messages by one random draw per stamp and group: a scan is dropped with its detections."""
    streams = {}
    for number, topics in enumerate(_groups(source, inputs).values()):
        of_group = [source.streams[topic].publish_time_ns for topic in topics]
        stamps_ns = np.unique(np.concatenate(of_group))
        drawn = np.random.default_rng([seed, number]).uniform(size=len(stamps_ns))
        is_kept = (drawn >= DROPPED_SHARE) | (len(stamps_ns) < 2)
        for topic in topics:
            stream = source.streams[topic]
            streams[topic] = stream.take(is_kept[np.searchsorted(stamps_ns, stream.publish_time_ns)])
    return _with(source, streams)


def _again(source: MemorySource, inputs: Inputs, _: float, __: int) -> MemorySource:
    """Repeat every message of the controls."""
    streams = {}
    for topic in inputs.controls:
        stream = source.streams[topic]
        twice = concatenate([stream, stream])
        streams[topic] = twice.take(np.argsort(twice.position, kind="stable"))
    return _with(source, streams)


CHANGES: Mapping[str, Change] = {
    "stamps": Change("stamps moved by up to 1 us", _stamps, True),
    "order": Change("equal stamps in the other order", _order, False),
    "single": Change("inputs in single precision", _inputs(_in_single), True),
    "ulp": Change("inputs moved by one ulp", _inputs(_by_an_ulp), False),
    "start": Change("the start moved by a tenth of its sigma", _start, True),
    PARAMETERS: Change("parameters changed by 1 %", None, True),
    DROPPED: Change("1 % of the messages dropped", _dropped, False),
    "zero duration": Change("one more prediction of zero duration", _again, False),
}


def inputs_of(source: MemorySource, topics: Collection[str], controls: Collection[str]) -> Inputs:
    """Choose the topics of an estimator that may be changed, except truths and topics without stamps."""
    streams = {topic: source.streams[topic] for topic in topics if topic in source.streams}
    names = {topic: stream.schema.full_name for topic, stream in streams.items() if len(stream)}
    priors = [t for t, name in names.items() if name == schemas.GAUSSIAN_ESTIMATE.full_name]
    out = {schemas.TRUTH_STATE.full_name, schemas.GAUSSIAN_ESTIMATE.full_name}
    return Inputs([t for t, name in names.items() if name not in out], list(controls), priors)


def parameters_changed(parameters: Any, size: float, rng: np.random.Generator) -> Any:
    """Change every numeric parameter except integers, zeros and the probability of a gate."""
    if isinstance(parameters, Mapping):
        changed = {name: parameters_changed(each, size, rng) for name, each in parameters.items()}
        return {
            name: each if "probability" not in name else _probability(parameters[name], each)
            for name, each in changed.items()
        }
    if isinstance(parameters, list | tuple):
        return [parameters_changed(each, size, rng) for each in parameters]
    if not isinstance(parameters, float) or not np.isfinite(parameters):
        return parameters
    sign = 2.0 * rng.integers(0, 2) - 1.0
    return parameters * (1.0 + sign * size * PARAMETER_SHARE)


def _probability(before: Any, changed: Any) -> Any:
    """Change a probability above one half by changing its complement."""
    if not isinstance(before, float) or before <= 0.5 or before > 1.0:
        return changed
    return 1.0 - (1.0 - before) * (changed / before)
