"""The distance between two replays, in sigmas of the first, metres and degrees, and when it begins.

A(t) = sqrt(d' P^-1 d / n), with the difference d of n components and the covariance P of the unchanged
replay. If only the initial state is shifted, A never grows in a linear filter: d' P^-1 d does not
increase (Deyst and Price, Conditions for asymptotic stability of the discrete minimum-variance linear
estimator, 1968).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.log import Stream, schemas
from fuselog.replay.engine import chi2
from fuselog.replay.engine.vectors.covariances import normalized_error_squared
from fuselog.replay.engine.vectors.tangent import difference, tangent_components

Floats = NDArray[np.float64]
PARTED = 10.0  # replays diverge when A exceeds its first value by this factor
LEAST = 1e-6  # below this share of a sigma, replays have not diverged
AXES = ("x_m", "y_m", "z_m")


class Parting(NamedTuple):
    """The distance between two replays of one estimate.

    Attributes:
        topic: the topic of the estimate.
        stamps_ns: stamps (n,) of the unchanged replay.
        amplification: (n,) A.
        metres, degrees: (n,) distances of positions and of angles; NaN if the state has none.
        spread: the largest relative difference of standard deviations; NaN if none is known.
        explained: (n,) the largest A that chance explains if the other replay had less data; 0
            otherwise.
    """

    topic: str
    stamps_ns: NDArray[np.int64]
    amplification: Floats
    metres: Floats
    degrees: Floats
    spread: float
    explained: Floats

    @property
    def has_sigmas(self) -> bool:
        """Test whether any covariance is known; without one, A is zero."""
        return bool(np.isfinite(self.spread))

    @property
    def growth(self) -> float:
        """Return the ratio of the largest A to the first A that is not zero."""
        there = self.amplification[self.amplification > 0.0]
        return float(np.max(there) / there[0]) if len(there) else 1.0

    @property
    def parted(self) -> int | None:
        """Return the row from which the replays diverge; return None if they do not."""
        there = np.flatnonzero(self.amplification > 0.0)
        if not len(there):
            return None
        limit = PARTED * max(self.amplification[there[0]], LEAST)
        beyond = np.flatnonzero(self.amplification > limit)
        return int(beyond[0]) if len(beyond) else None


def partings(
    base: Mapping[str, Stream], copy: Mapping[str, Stream], within_ns: int, *, has_less: bool = False
) -> list[Parting]:
    """Compare all estimates of two replays.

    Args:
        base: the estimates of the unchanged replay, by topic.
        copy: the estimates of the other replay.
        within_ns: the largest difference in time between estimates that are compared.
        has_less: whether the other replay had less data, so that its estimates differ by chance.
    """
    return [
        _parting(stream, copy[topic], within_ns, has_less)
        for topic, stream in base.items()
        if stream.schema.full_name == schemas.GAUSSIAN_ESTIMATE.full_name
        and len(stream)
        and len(copy.get(topic, ()))
        and np.all(np.diff(stream.publish_time_ns) > 0)  # several objects at one stamp cannot be matched
    ]


def _parting(base: Stream, copy: Stream, within_ns: int, has_less: bool) -> Parting:
    stamps_ns = base.publish_time_ns
    row = np.searchsorted(copy.publish_time_ns, stamps_ns + within_ns, side="right") - 1
    both = (row >= 0) & (copy.publish_time_ns[np.maximum(row, 0)] >= stamps_ns - within_ns)
    here, there = base.take(both), copy.take(row[both])
    kinds = base.metadata["kinds"].split(",")
    names = tangent_components(base.metadata["components"].split(","), kinds)
    apart = difference(there["mean"], here["mean"], kinds)
    covariance, other = covariances(here), covariances(there)
    amplification = np.sqrt(normalized_error_squared(apart, covariance) / max(1, apart.shape[1]))
    sigmas, others = (np.sqrt(np.einsum("rii->ri", each)) for each in (covariance, other))
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.abs(others / sigmas - 1.0)
    return Parting(
        base.topic,
        here.publish_time_ns,
        np.nan_to_num(amplification),
        _norm(apart, [name in AXES for name, _ in names]),
        np.degrees(_norm(apart, [kind in ("angle", "rotation") for _, kind in names])),
        _largest_finite(spread) if np.any(sigmas > 0.0) else np.nan,
        _explained(covariance, other) if has_less else np.zeros(len(covariance)),
    )


def _largest_finite(spread: Floats) -> float:
    return float(np.max(np.nan_to_num(spread, posinf=0.0), initial=0.0))


def _explained(covariance: Floats, other: Floats) -> Floats:
    """Compute the largest A due to chance (n,) at n stamps if one replay has less data.

    The difference between a consistent estimate with covariance P and one with less data and covariance
    P' has the covariance P' - P. Therefore n A^2 is at most the largest eigenvalue of (P' - P) P^-1
    times a chi-square quantile with n degrees of freedom, which 1 of 1,000 replays exceeds at some
    stamp.
    """
    count, size = covariance.shape[:2]
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(other).all(axis=(1, 2))
    shares = np.zeros(count)
    inverse = np.linalg.pinv(covariance[known], hermitian=True)
    lost = np.linalg.eigvals(inverse @ (other - covariance)[known]).real
    shares[known] = lost.max(axis=1, initial=0.0)
    limit = chi2.isf(1e-3 / max(1, count), max(1, size))
    return np.sqrt(shares * limit / max(1, size))


def covariances(stream: Stream) -> Floats:
    """Return the covariances (rows, n, n) of Gaussian estimates."""
    n = int(np.sqrt(stream["covariance"].shape[1]))
    return stream["covariance"].reshape(len(stream), n, n)


def _norm(apart: Floats, is_in: Sequence[bool]) -> Floats:
    if not any(is_in):
        return np.full(len(apart), np.nan)
    return np.asarray(np.linalg.norm(apart[:, np.array(is_in)], axis=1), np.float64)


class Undetermined(NamedTuple):
    """A direction of the state that the measurements do not determine.

    Attributes:
        components: the names of the direction's components, which have the same unit.
        direction: (n,) the unit vector, with a positive largest entry.
        sigma: the standard deviation along the direction, at the end.
        next_sigma: the largest standard deviation perpendicular to the direction.
        since_ns: the last stamp at which a measurement reduced the standard deviation.
    """

    components: tuple[str, ...]
    direction: Floats
    sigma: float
    next_sigma: float
    since_ns: int

    @property
    def words(self) -> str:
        """Format the direction as a sum: `0.58 rate_radps - 0.58 bias_radps`."""
        parts = [
            f"{'-' if value < 0 else '+'} {abs(value):.2g} {name}"
            for name, value in zip(self.components, self.direction, strict=True)
            if abs(value) >= 0.1
        ]
        return " ".join(parts).removeprefix("+ ")


def undetermined(stream: Stream, row: int = -1, least: float = 3.0) -> Undetermined | None:
    """Find the direction in components of one unit that is much more uncertain than all others.

    Components of different units have no common length, so they are not combined.

    Args:
        stream: Gaussian estimates.
        row: the index of the estimate.
        least: the smallest ratio of the direction's standard deviation to the largest one in the other
            directions.
    """
    kinds = stream.metadata["kinds"].split(",")
    names = [name for name, _ in tangent_components(stream.metadata["components"].split(","), kinds)]
    units = [name.rpartition("_")[2] for name in names]
    all_, found = covariances(stream), list[Undetermined]()
    for unit in dict.fromkeys(units):
        places = [place for place, each in enumerate(units) if each == unit]
        own = all_[:, places][:, :, places]
        if len(places) < 2 or not np.isfinite(own[row]).all():
            continue
        values, vectors = np.linalg.eigh(own[row])
        if values[-1] <= 0.0 or values[-1] < least**2 * values[-2]:
            continue
        direction = vectors[:, -1] * np.sign(vectors[np.argmax(np.abs(vectors[:, -1])), -1])
        variances = np.einsum("i,rij,j->r", direction, own[: row + 1 or None], direction)
        found.append(
            Undetermined(
                tuple(names[place] for place in places),
                direction,
                float(np.sqrt(values[-1])),
                float(np.sqrt(max(values[-2], 0.0))),
                int(stream.publish_time_ns[_last_narrowed(variances)]),
            )
        )
    return max(found, key=lambda each: each.sigma / max(each.next_sigma, 1e-300), default=None)


def _last_narrowed(variances: Floats) -> int:
    """Find the last row whose variance is the smallest so far."""
    return int(np.flatnonzero(variances <= variances.min())[-1])
