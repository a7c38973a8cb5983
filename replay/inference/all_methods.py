"""Lists all methods by name, and makes the estimator of one model by one of them."""

from collections.abc import Mapping
from typing import Any

from recorders.errors import BadInput, choices
from replay.engine.replaying.estimator import Estimator, set_by_variant
from replay.inference.estimators import modelled_by
from replay.inference.kalman.methods import FILTERS, Method
from replay.inference.model.model import Model
from replay.inference.modes.gaussian_sum import GAUSSIAN_SUM
from replay.inference.modes.imm import INTERACTING
from replay.inference.particles.filter import BOOTSTRAP
from replay.inference.smoothing.bound import POSTERIOR_BOUND
from replay.inference.smoothing.iterated import SMOOTHING

METHODS: Mapping[str, Method] = {
    **FILTERS,
    "smoother": SMOOTHING,
    "imm": INTERACTING,
    "bank": GAUSSIAN_SUM,
    "particles": BOOTSTRAP,
    "bound": POSTERIOR_BOUND,
}


def modelled(model: Model, method: str) -> Estimator[Any]:
    """Make the estimator of the state of one model by one method, named as on the command line.

    Raises BadInput where there is no such method or variant, or the model lacks what it needs.

    >>> from replay.estimators.models.landmarks import ROBOT
    >>> modelled(ROBOT, "particles:500").parameters().particles
    500
    """
    kind, _, variant = method.partition(":")
    if kind not in METHODS:
        raise BadInput(f"no method '{kind}'; {choices(kind, METHODS)}")
    chosen = METHODS[kind]
    return modelled_by(model, chosen, method, set_by_variant("method", kind, variant, chosen.variant))
