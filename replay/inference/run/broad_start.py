"""Initial states that hardly depend on parameters, so that likelihoods can be compared.

An initial state and its stamp may depend on the parameters. For example, an alignment with the first
fixes uses more fixes if the noise parameters are larger; likelihoods for different parameters would then
cover different messages.
"""

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from fuselog.recorders.log import Stream
from fuselog.replay.engine.arrays import Floats
from fuselog.replay.engine.streams.results import gaussian_stream, named
from fuselog.replay.engine.vectors.tangent import tangent_components
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.run.first_messages import unknown

BROAD_M = 1000.0  # standard deviation of a position about its first message
# Measured components of a sensor that measures the state, and the mean (n,) and sigmas (t,) of the state
# according to its first message.
Reference = tuple[Collection[str], Floats, Floats]
PARTS, BROAD_RAD = 8, 0.45  # number of equally likely parts of an angle, and the sigma of each


def broad_priors(
    model: Model,
    topic: str,
    times_ns: Sequence[int],
    references: Sequence[Iterable[Reference]],
) -> list[Stream]:
    """Make the priors of all runs, one stream for each of the equally likely parts of an angle.

    A filter is approximately linear only within a small interval of a heading, so an angle of the state
    is divided into PARTS.

    Args:
        model: model of the state.
        topic: topic of the priors.
        times_ns: stamps of the priors, one per run.
        references: first messages of each run.
    """
    names = list(model.state)
    components = [name for name, _ in tangent_components(names, model.kinds)]
    angles = [name for name, kind in model.state.items() if kind == "angle"]
    means, covariances = [], []
    for of_run in references:
        mean, sigma = unknown(model.state, model.start)
        for measured, own_mean, own_sigma in of_run:
            for name in measured:
                place = components.index(name)
                mean[names.index(name)] = own_mean[names.index(name)]
                sigma[place] = BROAD_M if name.endswith("_m") else own_sigma[place]
        means.append(mean)
        if len(angles) == 1:
            sigma[components.index(angles[0])] = BROAD_RAD
        covariances.append(np.diag(sigma**2))
    parts = [np.array(means)]
    if len(angles) == 1:
        parts = [parts[0].copy() for _ in range(PARTS)]
        for number, part in enumerate(parts):
            part[:, names.index(angles[0])] = 2.0 * np.pi * number / PARTS
    stamps, covariance = np.array(times_ns), np.array(covariances)
    return [gaussian_stream(topic, stamps, part, covariance, named(model.state)) for part in parts]
