"""Processes of components that are added to a state: random walks and Gauss-Markov processes.

For Gauss-Markov processes, see Gelb, Applied Optimal Estimation, 1974, section 3.6.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, create_model

from fuselog.replay.engine.arrays import AnyArgument, Settings
from fuselog.replay.inference.model.parameters import ModelParameters


class GaussMarkov(NamedTuple):
    """First-order Gauss-Markov process, or random walk.

    Attributes:
        sigma: standard deviation at the start.
        drift: density of the random walk, per square root of a second.
        time_s: time constant of the return to the mean, while noise maintains sigma; infinite for a
            random walk.
    """

    sigma: float
    drift: float
    time_s: float


def with_gauss_markov_parameters(
    parameters: type[ModelParameters], names: Sequence[str]
) -> type[ModelParameters]:
    """Add the parameters of the components' processes to the parameters of a model."""
    processes: dict[str, AnyArgument] = {
        f"{part}_{name}": (NonNegativeFloat, 1.0) for name in names for part in GaussMarkov._fields
    }
    return create_model(f"{parameters.__name__}Augmented", __base__=parameters, **processes)


def remaining_share(name: str, duration_s: float, parameters: Settings) -> float:
    """Compute the fraction of a component's deviation from the mean that remains after a step."""
    share: float = np.exp(-duration_s / getattr(parameters, f"time_s_{name}"))
    return share


def added_variance(name: str, duration_s: float, parameters: Settings) -> float:
    """Compute the variance that a step adds to a component."""
    walked = getattr(parameters, f"drift_{name}") ** 2 * duration_s
    returned = 1.0 - np.exp(-2.0 * duration_s / getattr(parameters, f"time_s_{name}"))
    variance: float = walked + returned * getattr(parameters, f"sigma_{name}") ** 2
    return variance
