"""Makes the streams that recorders have in common: truths, priors, fixes and outages.

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
        topic: its name.
        time_ns: (n,) stamps.
        components: of the state, m names.
        state: (n, m), in the components' units.
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
    """Make the stream with the one message that filters start from.

    Args:
        topic: its name.
        time_ns: one stamp.
        components: of the state, n names.
        mean: (n,) of the state.
        covariance: (m, m) of the error, with one dimension less for each rotation in the state.
        stated: further metadata of the channel, such as numbers of the motion.
    """
    return make_stream(
        topic,
        schemas.GAUSSIAN_ESTIMATE,
        np.reshape(time_ns, 1),
        metadata={**state_metadata(components), **(stated or {})},
        mean=np.reshape(mean, (1, -1)),
        covariance=np.reshape(covariance, (1, -1)),
    )


def fix_stream(topic: str, time_ns: ArrayLike, position_m: ArrayLike, variance_m2: float) -> Stream:
    """Make the stream of measured positions whose axes have errors of one variance.

    Args:
        topic: its name.
        time_ns: (n,) stamps.
        position_m: (n, 2) in the plane, or (n, 3).
        variance_m2: of the error along each axis.
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
    """Make the stream of spans over which a sensor is silent.

    Args:
        topic: its name.
        spans_ns: (n, 2) begins and ends.
    """
    return make_stream(topic, schemas.OUTAGE, spans_ns[:, 0], end_time_ns=spans_ns[:, 1])


def stated_numbers(parameters: Parameters, *names: str) -> dict[str, str]:
    """Return these parameters as a channel states them, as text that gives the same numbers again."""
    return {name: repr(getattr(parameters, name)) for name in names}
