"""All methods by name, and functions that make estimators from them, for a single or any model.

A method is registered by its entry in METHODS, and by an entry point that names this module and the
method, as `fuselog.replay.inference.all_methods:ekf`.
"""

from collections.abc import Mapping
from functools import cache

from fuselog.recorders.errors import BadInput, choices
from fuselog.replay.engine.replaying.estimator import AnyEstimator, set_by_variant
from fuselog.replay.inference.estimators import modelled_by, of_any_model
from fuselog.replay.inference.kalman.methods import FILTERS, Method
from fuselog.replay.inference.model.model import Model
from fuselog.replay.inference.modes.gaussian_sum import GAUSSIAN_SUM
from fuselog.replay.inference.modes.imm import INTERACTING
from fuselog.replay.inference.particles.filter import BOOTSTRAP
from fuselog.replay.inference.smoothing.bound import POSTERIOR_BOUND
from fuselog.replay.inference.smoothing.iterated import SMOOTHING

METHODS: Mapping[str, Method] = {
    **FILTERS,
    "smoother": SMOOTHING,
    "imm": INTERACTING,
    "bank": GAUSSIAN_SUM,
    "particles": BOOTSTRAP,
    "bound": POSTERIOR_BOUND,
}


def modelled(model: Model, method: str) -> AnyEstimator:
    """Make the estimator that applies one method to one model.

    Args:
        model: the model of motions and sensors.
        method: name of the method, as listed by `fuselog models NAME`, such as "ukf", "lrkf:s2kf-50" or
            "imm:ekf".

    Returns:
        An estimator that can be passed to `replay`.

    Raises BadInput if the method or variant does not exist, or if the model lacks something that the
    method needs.

    >>> from fuselog.replay.estimators.landmarks import ROBOT
    >>> modelled(ROBOT, "particles:500").parameters().particles
    500
    """
    kind, _, variant = method.partition(":")
    if kind not in METHODS:
        raise BadInput(f"no method '{kind}'; {choices(kind, METHODS)}")
    chosen = METHODS[kind]
    return modelled_by(model, chosen, method, set_by_variant("method", kind, variant, chosen.variant))


@cache
def __getattr__(method: str) -> AnyEstimator:
    """Make the estimator that applies a method to any model, for an entry point or `-e ekf`."""
    if method not in METHODS:
        raise AttributeError(method)
    return of_any_model(METHODS[method])
