"""Linear regression Kalman filters by the name of their sampling, and what they approximate.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014.
"""

from collections.abc import Mapping

import numpy as np
from pydantic import NonNegativeInt

from recorders.log.reader import Topic
from recorders.parameters import Parameters
from replay.engine import Bound, Estimator
from replay.estimators.discrete import bind_system
from replay.estimators.extended_target import EXTENDED_TARGET
from replay.estimators.reactor import REACTOR
from replay.sampling import Sampler, Samples, parse_sampling
from replay.sampling.samplers import fixed

SYSTEMS = {"batch-reactor": REACTOR, "extended-target": EXTENDED_TARGET}


class RegressionParameters(Parameters):
    """The sampling's name, see `replay.sampling.names`; the seed is for randomised ones."""

    sampling: str = "ukf"
    seed: NonNegativeInt = 0


def _bind(name: str, topics: Mapping[str, Topic], parameters: RegressionParameters) -> list[Bound]:
    sampling = parse_sampling(parameters.sampling)
    return bind_system(name, topics, SYSTEMS, "sampled", sampling.at, parameters.seed)


def _no_samples(dimension: int) -> Sampler:
    return fixed(Samples(np.empty((0, dimension)), np.empty(0)))


def _bind_analytic(name: str, topics: Mapping[str, Topic], _: Parameters) -> list[Bound]:
    return bind_system(name, topics, SYSTEMS, "analytic", _no_samples)


LRKF = Estimator(
    "linear regression Kalman filter; the sampling follows the name, as in lrkf:s2kf-50",
    "a robot's log, or the log of a batch reactor or an extended target",
    RegressionParameters,
    _bind,
    variant="sampling",
)
ANALYTIC = Estimator(
    "Kalman filter with the exact moments, which linear regression approximates",
    "the log of a batch reactor or an extended target",
    Parameters,
    _bind_analytic,
)
