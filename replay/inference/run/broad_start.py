"""Makes starts that hardly depend on parameters, over which likelihoods can be compared.

A start that is found by the parameters, as one aligned with the first fixes, uses up more messages the
larger their noise is stated: likelihoods would be of different messages.
"""

from collections.abc import Collection, Iterable

import numpy as np

from recorders.log import Stream
from replay.engine.arrays import Floats
from replay.engine.streams.results import gaussian_stream, named
from replay.engine.vectors.tangent import tangent_components
from replay.inference.model.model import Model
from replay.inference.run.first_messages import unknown

BROAD_M = 1000.0  # a position's standard deviation about its first message
PARTS, BROAD_RAD = 8, 0.45  # of an angle: equally likely parts all round, and the sigma of each


def broad_priors(
    model: Model,
    topic: str,
    time_ns: int,
    references: Iterable[tuple[Collection[str], Floats, Floats]],
) -> list[Stream]:
    """Make the priors of a run at a stamp, one for each of the equally likely parts.

    A filter is linear about a heading only nearby, so an angle, where the state has one, is in PARTS.

    Args:
        model: whose state it is.
        topic: of the priors.
        time_ns: their stamp.
        references: by sensor that measures the state: what it measures, and by its first message the
            state's mean (n,) and sigmas (t,).
    """
    names = list(model.state)
    components = [name for name, _ in tangent_components(names, model.kinds)]
    mean, sigma = unknown(model.state, model.start)
    for measured, own_mean, own_sigma in references:
        for name in measured:
            place = components.index(name)
            mean[names.index(name)] = own_mean[names.index(name)]
            sigma[place] = BROAD_M if name.endswith("_m") else own_sigma[place]
    means = mean[None]
    angles = [name for name, kind in model.state.items() if kind == "angle"]
    if len(angles) == 1:
        means = np.tile(mean, (PARTS, 1))
        means[:, names.index(angles[0])] = 2.0 * np.pi * np.arange(PARTS) / PARTS
        sigma[components.index(angles[0])] = BROAD_RAD
    covariance, stamps = np.diag(sigma**2)[None], np.array([time_ns])
    return [gaussian_stream(topic, stamps, part[None], covariance, named(model.state)) for part in means]
