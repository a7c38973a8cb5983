"""Hypotheses on the initial state that a log contains."""

from collections.abc import Iterator

import numpy as np

from fuselog.pipeline.altering import alterations as alter
from fuselog.pipeline.altering.changes import bare
from fuselog.pipeline.diagnosing.advice import Advice, precise
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import Hypothesis, in_sense, in_topic
from fuselog.recorders.log import Stream
from fuselog.replay.engine.vectors.components import components_of, stated_components

SIGMAS = (-1.0, 1.0, -4.0, 4.0)  # limit in standard deviations of a prior


def of_start(prior: Stream) -> Iterator[Hypothesis]:
    """Yield hypotheses that a component of the initial state is different."""
    if len(prior) != 1 or not prior.components:
        return
    covariance = prior["covariance"][0]
    size = round(len(covariance) ** 0.5)
    names = components_of(prior.components)
    kinds = list(stated_components(prior.metadata, names, f"topic {prior.topic}").values())
    variances = np.diagonal(covariance.reshape(size, size))
    has_rotation = "quaternion" in kinds
    column = 0
    for place, (name, kind) in enumerate(zip(prior.components, kinds, strict=True)):
        if kind == "quaternion" and place and kinds[place - 1] == "quaternion":
            # a quaternion has three tangent components
            column += kinds[: place + 1].count("quaternion") < 4
            continue
        sigma = float(np.sqrt(variances[min(column, size - 1)]))
        column += 1
        if kind == "quaternion":
            yield _start(prior.topic, "heading", alter.heading_turned, sigma, "rad", np.pi)
        elif sigma > 0.0 and not (has_rotation and place > kinds.index("quaternion")):
            limit = np.pi if kind == "angle" else np.inf
            yield _start(prior.topic, name, alter.shifted("mean", place), sigma, "", limit)


def _start(
    topic: str, name: str, alteration: alter.Alteration, sigma: float, unit: str, limit: float
) -> Hypothesis:
    def words(at: float, low: float, high: float) -> str:
        is_so, at, low, high = in_sense(at, low, high)
        size = f"{at:.3g} ({low:.3g} to {high:.3g}){' ' if unit else ''}{unit}"
        return f"{topic}: {name} at the start is {is_so} by {size}, {at / sigma:.2g} of its sigmas"

    def remedy(at: float) -> Advice:
        wider = f"a prior whose sigma of {name} is at least {abs(at):.2g}"
        return Advice(f"{topic}.{bare(name)}_bias", precise(at), otherwise=wider)

    tried = tuple(sigma * each for each in SIGMAS if sigma * abs(each) < limit)
    return Hypothesis("start", topic, name, tried, limit, in_topic(topic, alteration), words, remedy)
