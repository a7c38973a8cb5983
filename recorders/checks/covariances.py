"""Checks of covariances: impossible matrices, and numbers that mean "unknown"."""

from collections.abc import Iterator, Mapping
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.checks.finding import Finding, since_first
from fuselog.recorders.log import Stream, schemas

TOLERANCE = 1e-6  # relative to the largest entry
SINGULAR, SINGULAR_BELOW = "singular", 1e-12  # the least eigenvalue of its correlations
# Zero may stand for a component that does not exist, such as a planar robot's height.
_PARTIAL = {schemas.POSE.full_name, schemas.TWIST.full_name}


def impossible(stream: Stream, _: Mapping[str, Stream]) -> Iterator[Finding]:
    """Find covariances that are -1, zero, negative, not symmetric, indefinite, singular, or constant."""
    for entry in stream.schema:
        column = stream.columns[entry.name].reshape(len(stream), -1)
        if "variance" not in entry.name or not column.shape[1]:
            continue
        is_new = np.ones(len(column), bool)
        is_new[1:] = (column[1:] != column[:-1]).any(axis=1)  # the first of equal ones suffices
        rows = np.flatnonzero(is_new & np.isfinite(column).all(axis=1))
        is_partial = stream.schema.full_name in _PARTIAL
        is_prior = stream.schema.full_name == schemas.GAUSSIAN_ESTIMATE.full_name
        faults = _faults(
            column[rows], is_partial=is_partial or is_prior, is_exact=len(stream) == 1 and not is_prior
        )
        for words, bad in faults:
            if bad.any():
                share = np.repeat(bad, np.diff(np.append(rows, len(column)))).sum()
                is_unknown = words.startswith("-1")
                yield Finding(
                    "covariance",
                    stream.topic,
                    entry.name,
                    float(share),
                    f"{stream.topic}: {entry.name} is {words} in {int(share)} of "
                    f"{len(column)} messages, "
                    f"the first {since_first(stream, stream.publish_time_ns[rows[np.argmax(bad)]])}",
                    otherwise="missing = [-1] in the mapping"
                    if is_unknown
                    else f"deviations.{entry.name} = [SIGMA, ...] in the mapping, with a number for "
                    "each "
                    f"axis",
                    severity="hint" if words == SINGULAR else "fact",
                )
                break


def _faults(
    values: NDArray[np.float64], *, is_partial: bool, is_exact: bool
) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield each fault with the rows (n,) that have it, the most obvious first.

    With `is_partial`, zero may mean that a component does not exist or is known exactly. With
    `is_exact`, zero may mean this for all components.
    """
    width = values.shape[1]
    size = isqrt(width)
    is_matrix = width > 3 and size * size == width
    diagonal = values[:, :: size + 1] if is_matrix else values
    yield "-1, which means unknown", np.equal(diagonal[:, 0], -1.0)
    yield "negative on its diagonal", np.less(diagonal.min(axis=1), 0.0)
    zero = np.equal(diagonal, 0.0)
    if not is_exact:  # for a position that is stated once, zero means exact
        yield "zero", np.greater_equal(zero.sum(axis=1), zero.shape[1] if is_partial else 1)
    if not is_matrix:
        return
    is_alike = np.less_equal(np.ptp(values, axis=1), 0.0)
    yield "one number in all its entries", is_alike & np.not_equal(values[:, 0], 0.0)
    matrices = values.reshape(-1, size, size)
    scale = np.abs(values).max(axis=1, initial=0.0)
    apart = np.abs(matrices - matrices.transpose(0, 2, 1)).max(axis=(1, 2), initial=0.0)
    yield "not symmetric", apart > TOLERANCE * scale
    yield "indefinite", np.linalg.eigvalsh(matrices)[:, 0] < -TOLERANCE * scale
    deviations = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    correlations = matrices / (deviations[:, :, None] * deviations[:, None, :])
    correlations[:, range(size), range(size)] = 1.0  # a component without variance is not singular
    yield SINGULAR, np.linalg.eigvalsh(correlations)[:, 0] < SINGULAR_BELOW
