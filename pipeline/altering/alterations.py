"""Alterations that plant or correct faults in streams; each is a function of streams and a number.

Most faults are corrected by the same function with the opposite number. Therefore these functions define
both the faults that a diagnosis assumes and those that the experiment plants in logs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream
from fuselog.recorders.models.orientation import compose, heading
from fuselog.replay.engine.streams.sources import MemorySource

Alteration = Callable[[Stream, float], Stream]
STRAY = 20.0  # in the unit of the vector
# covariances of vectors that are rotated
_BLOCKS = {"position_m": "covariance_m2", "velocity_mps": "covariance_m2ps2"}


def altered(source: MemorySource, topic: str, alteration: Alteration, value: float) -> MemorySource:
    """Copy a run with one topic altered."""
    stream = alteration(source.streams[topic], value)
    return replace(source, streams={**source.streams, topic: stream})


def _with(stream: Stream, **columns: NDArray) -> Stream:
    return replace(stream, columns={**stream.columns, **columns})


def shifted(field: str, entry: int | None = None) -> Alteration:
    """Make an alteration that adds a bias to a field, or to one entry of a vector."""
    return partial(added, field, entry)


def added(field: str, entry: int | None, stream: Stream, by: float | NDArray[np.float64]) -> Stream:
    """Add a number to a field, or to one entry of it.

    Args:
        field: a field of n messages.
        entry: an entry of a vector; None means the whole vector.
        stream: the messages.
        by: in the field's unit: one number, or (n,), one per message.

    Returns:
        The altered stream.
    """
    column = stream[field].copy()
    if entry is None:
        column += by if column.ndim == 1 or np.ndim(by) == 0 else np.reshape(by, (-1, 1))
    else:
        column[:, entry] += by
    return _with(stream, **{field: column})


def scaled(field: str, entry: int | None = None) -> Alteration:
    """Make an alteration that multiplies a field, or one entry of a vector, by a factor."""
    return partial(_scaled, field, entry)


def _scaled(field: str, entry: int | None, stream: Stream, factor: float) -> Stream:
    column = stream[field].copy()
    if entry is None:
        column *= factor
    else:
        column[:, entry] *= factor
    return _with(stream, **{field: column})


def mixed(field: str, matrix: NDArray[np.float64]) -> Callable[[Stream], Stream]:
    """Make the alteration that multiplies a vector by a matrix, for example for non-orthogonal axes.

    Args:
        field: a vector of three components.
        matrix: (3, 3), multiplied from the left.

    Returns:
        A function that alters a stream.
    """
    return lambda stream: _with(stream, **{field: stream[field] @ matrix.T})


def spread(field: str) -> Alteration:
    """Make an alteration that multiplies standard deviations by e^value; `field` is the covariance."""
    return partial(_spread, field)


def _spread(field: str, stream: Stream, logarithm: float) -> Stream:
    return _with(stream, **{field: stream[field] * np.exp(2.0 * logarithm)})


def turned(field: str) -> Alteration:
    """Make an alteration that rotates a vector, and its covariance, about the vertical (in rad)."""
    return partial(_turned, field)


def _turned(field: str, stream: Stream, angle: float) -> Stream:
    n, m = stream[field].shape
    rotation = np.eye(m)
    rotation[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    columns = {field: stream[field] @ rotation.T}
    block = _BLOCKS.get(field, "")
    if block in stream.columns and stream[block].shape == (n, m * m):
        covariance = rotation @ stream[block].reshape(n, m, m) @ rotation.T
        columns[block] = covariance.reshape(n, m * m)
    return _with(stream, **columns)


def delayed(stream: Stream, by_s: float) -> Stream:
    """Delay stamps by `by_s` seconds."""
    return replace(stream, publish_time_ns=stream.publish_time_ns + round(by_s * 1e9))


def drifted(first_ns: int) -> Alteration:
    """Make an alteration that speeds up the clock of the stamps by `rate` s per s from `first_ns` on."""
    return partial(_drifted, first_ns)


def _drifted(first_ns: int, stream: Stream, rate: float) -> Stream:
    since_ns = (stream.publish_time_ns - first_ns) * pace(rate)
    return replace(stream, publish_time_ns=first_ns + np.rint(since_ns).astype(np.int64))


def pace(rate: float) -> float:
    """Compute the pace of a clock that gains `rate` seconds per second; -rate gives the inverse.

    >>> pace(0.25), pace(-0.25)
    (1.25, 0.8)
    """
    return 1.0 + rate if rate >= 0.0 else 1.0 / (1.0 - rate)


def multiplied(field: str, entry: int | None = None) -> Alteration:
    """Make an alteration that multiplies a field, or one entry of it, by e^value."""
    return lambda stream, logarithm: _scaled(field, entry, stream, float(np.exp(logarithm)))


def ramped(first_ns: int, field: str, entry: int | None = None) -> Alteration:
    """Make an alteration that adds a bias which is zero at `first_ns` and grows linearly."""
    return partial(_ramped, first_ns, field, entry)


def _ramped(first_ns: int, field: str, entry: int | None, stream: Stream, rate: float) -> Stream:
    return added(field, entry, stream, rate * _since_s(stream, first_ns))


def _since_s(stream: Stream, first_ns: int) -> NDArray[np.float64]:
    return np.asarray(1e-9 * (stream.publish_time_ns - first_ns), np.float64)


def permuted(field: str, order: Sequence[int]) -> Alteration:
    """Make an alteration that reorders a vector's entries and its covariance; its number is unused."""
    return partial(_permuted, field, tuple(order))


def _permuted(field: str, order: tuple[int, ...], stream: Stream, _: float) -> Stream:
    n, m = stream[field].shape
    order = (*order, *range(len(order), m))
    columns = {field: stream[field][:, order]}
    block = _BLOCKS.get(field, "")
    if block in stream.columns and stream[block].shape == (n, m * m):
        covariance = stream[block].reshape(n, m, m)[:, order][:, :, order]
        columns[block] = covariance.reshape(n, m * m)
    return _with(stream, **columns)


def heading_turned(stream: Stream, angle: float | NDArray[np.float64]) -> Stream:
    """Rotate orientations, or the orientations in Gaussian estimates, about the vertical.

    Args:
        stream: n messages with a quaternion, or with means that contain one.
        angle: rotation in rad, anticlockwise seen from above: one number, or (n,), one per message.

    Returns:
        The altered stream.
    """
    half = 0.5 * np.asarray(angle, float)
    about = np.stack([np.cos(half), 0.0 * half, 0.0 * half, np.sin(half)], axis=-1)
    if "quaternion" in stream.columns:
        return _with(stream, quaternion=compose(about, stream["quaternion"]))
    begin = stream.metadata["kinds"].split(",").index("quaternion")
    mean, places = stream["mean"].copy(), slice(begin, begin + 4)
    mean[:, places] = compose(about, mean[:, places])
    return _with(stream, mean=mean)


def heading_multiplied(stream: Stream, factor: float) -> Stream:
    """Multiply the headings of orientations, without changing roll and pitch."""
    return heading_turned(stream, (factor - 1.0) * heading(stream["quaternion"]))


def heading_ramped(first_ns: int) -> Alteration:
    """Make an alteration that rotates orientations about the vertical at a constant rate."""
    return lambda stream, rate: heading_turned(stream, rate * _since_s(stream, first_ns))


def heading_from_north(stream: Stream, _: float) -> Stream:
    """Convert headings clockwise from north to headings anticlockwise from east, and vice versa."""
    return heading_turned(stream, 0.5 * np.pi - 2.0 * heading(stream["quaternion"]))


def spread_stated(name: str) -> Alteration:
    """Make an alteration that multiplies a channel's standard deviations by e^value."""
    return partial(_spread_stated, name)


def _spread_stated(name: str, stream: Stream, logarithm: float) -> Stream:
    stated = spread_variances(stream.metadata[name], float(np.exp(2.0 * logarithm)))
    return replace(stream, metadata={**stream.metadata, name: stated})


def spread_variances(stated: str, factor: float) -> str:
    """Multiply comma-separated variances, as a channel's metadata states them, by a factor."""
    return ",".join(repr(float(each) * factor) for each in stated.split(","))


def renumbered(field: str, first: int, second: int) -> Alteration:
    """Make an alteration that swaps two identifiers in a field."""
    return partial(_renumbered, field, first, second)


def _renumbered(field: str, first: int, second: int, stream: Stream, _: float) -> Stream:
    number = stream[field]
    exchanged = np.where(number == first, second, np.where(number == second, first, number))
    return _with(stream, **{field: exchanged.astype(number.dtype)})


def exchanged(source: MemorySource, first: str, second: str) -> MemorySource:
    """Copy a run with the messages of two topics swapped."""
    streams: Mapping[str, Stream] = {
        first: replace(source.streams[second], topic=first),
        second: replace(source.streams[first], topic=second),
    }
    return replace(source, streams={**source.streams, **streams})


def thinned(seed: int) -> Alteration:
    """Make an alteration that drops a random share of the stamps with all their messages."""
    return partial(_thinned, seed)


def _thinned(seed: int, stream: Stream, share: float) -> Stream:
    stamps_ns, row = np.unique(stream.publish_time_ns, return_inverse=True)
    is_kept = np.random.default_rng(seed).uniform(size=len(stamps_ns)) >= share
    return stream.take(is_kept[row])


def strayed(seed: int, field: str) -> Alteration:
    """Make an alteration that adds errors up to STRAY to all entries of a random share of messages."""
    return partial(_strayed, seed, field)


def _strayed(seed: int, field: str, stream: Stream, share: float) -> Stream:
    rng = np.random.default_rng(seed)
    is_off = rng.uniform(size=len(stream)) < share
    off = rng.uniform(-STRAY, STRAY, stream[field].shape)
    return _with(stream, **{field: stream[field] + is_off[:, None] * off})
