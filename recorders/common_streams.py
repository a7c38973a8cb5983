"""Streams that recorders have in common: truth, priors, position fixes and outages.

Begin with `truth_stream`.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fuselog.recorders.log import Stream, make_stream, schemas
from fuselog.recorders.models.states import state_metadata
from fuselog.recorders.parameters import Parameters


def truth_stream(topic: str, time_ns: ArrayLike, components: Sequence[str], state: ArrayLike) -> Stream:
    """Make the stream of true states.

    Args:
        topic: name of the topic.
        time_ns: (n,) stamps, in ns.
        components: names of the m components of the state.
        state: (n, m), in the units of the components.
    """
    return make_stream(
        topic, schemas.TRUTH_STATE, time_ns, metadata=state_metadata(components), state=state
    )


def prior_stream(
    topic: str,
    time_ns: int | NDArray[np.int64],
    components: Sequence[str],
    mean: ArrayLike,
    covariance: ArrayLike,
    stated: Mapping[str, str] | None = None,
) -> Stream:
    """Make the stream with the one message from which filters start, or those of several runs.

    Args:
        topic: name of the topic.
        time_ns: the stamp, in ns, or (runs,) stamps.
        components: names of the n components of the state.
        mean: (n,) mean of the state, or (runs, n).
        covariance: (m, m) covariance of the error, with one dimension less for each rotation in the
            state; or (runs, m, m).
        stated: further metadata of the channel, such as parameters of the motion.
    """
    return make_stream(
        topic,
        schemas.GAUSSIAN_ESTIMATE,
        np.reshape(time_ns, -1),
        metadata={**state_metadata(components), **(stated or {})},
        mean=np.reshape(mean, (np.size(time_ns), -1)),
        covariance=np.reshape(covariance, (np.size(time_ns), -1)),
    )


def fix_stream(topic: str, time_ns: ArrayLike, position_m: ArrayLike, variance_m2: float) -> Stream:
    """Make the stream of measured positions with the same, independent error along each axis.

    Args:
        topic: name of the topic.
        time_ns: (n,) stamps, in ns.
        position_m: (n, 2) in the local tangent plane, or (n, 3), in m.
        variance_m2: variance of the error along each axis.
    """
    count, axes = np.shape(position_m)
    return make_stream(
        topic,
        schemas.POSITION_FIX,
        time_ns,
        position_m=position_m,
        covariance_m2=np.tile(variance_m2 * np.eye(axes).ravel(), (count, 1)),
    )


def outage_stream(topic: str, spans_ns: NDArray[np.int64]) -> Stream:
    """Make the stream of outages, in which a sensor sends nothing.

    Args:
        topic: name of the topic.
        spans_ns: (n, 2) starts and ends, in ns.
    """
    return make_stream(topic, schemas.OUTAGE, spans_ns[:, 0], end_time_ns=spans_ns[:, 1])


def stated_numbers(parameters: Parameters, *names: str) -> dict[str, str]:
    """Format parameters as text for a channel; reading the text gives exactly the same numbers."""
    return {name: repr(getattr(parameters, name)) for name in names}
