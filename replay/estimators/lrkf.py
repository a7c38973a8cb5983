"""Linear regression Kalman filters by the name of their sampling, and what they approximate.

Source: Steinbring and Hanebeck, "LRKF Revisited: The Smart Sampling Kalman Filter (S2KF)", JAIF 2014.
"""

from collections.abc import Mapping

from pydantic import NonNegativeInt

from recorders.errors import BadInput
from recorders.log import Topic
from recorders.parameters import Parameters
from replay.engine import Bound, Estimator
from replay.estimators.discrete import bind_system
from replay.estimators.extended_target import EXTENDED_TARGET
from replay.estimators.landmarks import LocalizationParameters, bind_robots
from replay.estimators.reactor import REACTOR
from replay.sampling import parse_sampling
from replay.sampling.samplers import no_samples

SYSTEMS = {"batch-reactor": REACTOR, "extended-target": EXTENDED_TARGET}


class RegressionParameters(LocalizationParameters):
    """The sampling's name, see `replay.sampling.names`; the seed is for randomised ones.

    What a robot's filter may be told does not apply to the other systems.
    """

    sampling: str = "ukf"
    seed: NonNegativeInt = 0


def _bind(name: str, topics: Mapping[str, Topic], parameters: RegressionParameters) -> list[Bound]:
    sampling, seed = parse_sampling(parameters.sampling), parameters.seed
    robots = bind_robots(name, topics, parameters, sampling, seed)
    systems = bind_system(name, topics, SYSTEMS, "sampled", sampling.at, seed)
    unused = parameters.model_fields_set - {"sampling", "seed"}
    if systems and unused:
        raise BadInput(f"estimator {name}: {min(unused)} is for robots; this log is of another system")
    return robots + systems


def _bind_analytic(name: str, topics: Mapping[str, Topic], _: Parameters) -> list[Bound]:
    return bind_system(name, topics, SYSTEMS, "analytic", no_samples)


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
