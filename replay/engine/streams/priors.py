"""Priors, read by component names; a run without a usable prior fails on its own."""

from collections.abc import Mapping
from functools import lru_cache, partial
from math import isqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fuselog.recorders.errors import BadInput
from fuselog.replay.engine.streams.blocks import Ragged
from fuselog.replay.engine.streams.results import gaussian_stream
from fuselog.replay.engine.vectors.components import (
    Components,
    in_body_axes,
    match_components,
    match_tangent,
    stated_components,
)
from fuselog.replay.engine.vectors.covariances import is_positive_definite
from fuselog.replay.engine.vectors.tangent import Kind, tangent_components

MISSING = "there is no prior message"
NOT_FINITE = "the prior is not finite"
NOT_POSITIVE_DEFINITE = "the prior's covariance is not positive definite"


class Priors(NamedTuple):
    """First Gaussian of every run, with its components in the wanted order.

    Attributes:
        time_ns: (runs,) stamps.
        mean: (runs, d).
        covariance: (runs, t, t) in the tangent space.
        reasons: (runs,) why a prior cannot be used, or "" if it can be used. An unusable prior is NaN.
    """

    time_ns: NDArray[np.int64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    reasons: tuple[str, ...]


def priors_of(prior: Ragged, components: Components) -> Priors:
    """Read the priors of all runs; see `Priors`.

    Raises BadInput if the channel does not state the components (see `match_components`), or if the
    vectors' widths differ from those that it states.

    Args:
        prior: Gaussian estimates of all runs.
        components: wanted components by name, with their kinds.
    """
    stream, runs = in_body_axes(prior.stream), prior.runs
    where = f"topic {stream.topic}"
    names, kinds = (stream.metadata.get(name, "") for name in ("components", "kinds"))
    layout = _layout(names, kinds, tuple(components.items()), where)
    size = layout.tangent
    present = np.flatnonzero(np.diff(prior.offsets))
    first = prior.offsets[present]
    time_ns, mean, covariance, _ = no_priors(runs, components, MISSING)
    reasons = [""] * runs
    if len(present):
        widths = stream["mean"].shape[1], stream["covariance"].shape[1]
        if widths != (layout.stated, size**2):
            raise BadInput(
                f"{where}: the channel states {layout.stated} components, but mean and covariance have "
                f"{widths[0]} and {widths[1]} numbers; {layout.stated} and {size**2} are needed"
            )
        time_ns[present] = stream.publish_time_ns[first]
        mean[present] = stream["mean"][first][:, layout.columns]
        whole = stream["covariance"][first].reshape(-1, size, size)
        covariance[present] = whole[:, layout.rows][:, :, layout.rows]
    finite = np.isfinite(mean.sum(axis=1) + covariance.sum(axis=(1, 2)))
    usable = finite & is_positive_definite(covariance)
    if not usable.all():
        mean[~usable], covariance[~usable] = np.nan, np.nan
        wanted = f"no usable prior of {len(components)} components ({', '.join(components)})"
        for run in np.flatnonzero(~usable).tolist():
            reason = NOT_POSITIVE_DEFINITE if finite[run] else NOT_FINITE
            reasons[run] = f"{where}: {wanted}: {reason if run in present else MISSING}"
    return Priors(time_ns, mean, covariance, tuple(reasons))


class _Layout(NamedTuple):
    """How many components a channel states, and which are wanted, in the state and the tangent space."""

    stated: int
    tangent: int
    columns: list[int]
    rows: list[int]


@lru_cache(maxsize=256)
def _layout(names: str, kinds: str, wanted: tuple[tuple[str, Kind], ...], where: str) -> _Layout:
    """Make the layout of a channel that states these names and kinds; raise as `priors_of` does."""
    metadata, components = {"components": names, "kinds": kinds}, dict(wanted)
    stated = stated_components(metadata, components, where)
    return _Layout(
        len(stated),
        len(match_tangent(metadata, stated, where)),
        match_components(metadata, components, where),
        match_tangent(metadata, components, where),
    )


def no_priors(runs: int, components: Components, reason: str) -> Priors:
    """Make unusable priors for runs that cannot start, all for the same reason.

    Args:
        runs: number of runs.
        components: wanted components by name, with their kinds.
        reason: the reason, as a sentence.
    """
    size = len(tangent_components(list(components), list(components.values())))
    return Priors(
        np.zeros(runs, np.int64),
        np.full((runs, len(components)), np.nan),
        np.full((runs, size, size), np.nan),
        (reason,) * runs,
    )


def start_of_runs(
    static: Mapping[str, Ragged], priors: Mapping[str, Components]
) -> tuple[dict[str, Ragged], dict[int, str]]:
    """Return the topics that an estimator starts from, and the reasons why some runs cannot start.

    Args:
        static: topics of all runs.
        priors: the components to read from each topic that is a prior.

    In the returned topics, a prior has one message for every run, with the wanted components in their
    order; it is NaN if the run cannot start. The reasons are by run; all runs may have one. Raises
    BadInput if a prior does not have these components, see `priors_of`.
    """
    found, failed = dict(static), dict[int, str]()
    for topic, components in priors.items():
        prior, wanted = static[topic], (topic, *components.items())
        found[topic], reasons = prior.findings.once(wanted, partial(_start_of, topic, prior, components))
        failed |= {run: reason for run, reason in reasons.items() if run not in failed}
    return found, failed


def _start_of(topic: str, prior: Ragged, components: Components) -> tuple[Ragged, dict[int, str]]:
    """Return a prior with one message for every run, and the reasons why runs cannot start."""
    read = priors_of(prior, components)
    stream = gaussian_stream(topic, read.time_ns, read.mean, read.covariance, {})
    reasons = {run: reason for run, reason in enumerate(read.reasons) if reason}
    return Ragged(stream, np.arange(len(read.reasons) + 1)), reasons


def gaussians(
    prior: Ragged,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return copies of the arrays in a prior that `start_of_runs` made.

    Stamps (runs,), means (runs, d) and covariances (runs, t, t).
    """
    size = isqrt(prior["covariance"].shape[1])
    covariance = prior["covariance"].reshape(-1, size, size)
    return prior.stream.publish_time_ns.copy(), prior["mean"].copy(), covariance.copy()
