"""All methods by name, and the estimator of one model by one of them."""

from collections.abc import Mapping
from typing import Any

from recorders.errors import BadInput, choices
from replay.engine.estimator import Estimator, set_by_variant
from replay.inference.bank import BANK
from replay.inference.bound import POSTERIOR_BOUND
from replay.inference.estimators import modelled_by
from replay.inference.imm import INTERACTING
from replay.inference.iterated import SMOOTHING
from replay.inference.methods import FILTERS, Method
from replay.inference.model import Model
from replay.inference.particle_filter import BOOTSTRAP

METHODS: Mapping[str, Method] = {
    **FILTERS,
    "smoother": SMOOTHING,
    "imm": INTERACTING,
    "bank": BANK,
    "particles": BOOTSTRAP,
    "bound": POSTERIOR_BOUND,
}


def modelled(model: Model, method: str) -> Estimator[Any]:
    """The estimator of the state of one model by one method, named as on the command line.

    Raises BadInput where there is no such method or variant, or the model lacks what it needs.

    >>> from replay.estimators.landmarks import ROBOT
    >>> modelled(ROBOT, "particles:500").parameters().particles
    500
    """
    kind, _, variant = method.partition(":")
    if kind not in METHODS:
        raise BadInput(f"no method '{kind}'; {choices(kind, METHODS)}")
    chosen = METHODS[kind]
    return modelled_by(model, chosen, method, set_by_variant("method", kind, variant, chosen.variant))
