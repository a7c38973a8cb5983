"""Lists all methods by name, and makes estimators of them: of one model, or of any.

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
    """Make the estimator of the state of one model by one method, named as on the command line.

    Args:
        model: how the state moves and what sensors measure of it.
        method: as `fuselog models NAME` lists them, such as "ukf", "lrkf:s2kf-50" or "imm:ekf".

    Returns:
        The estimator, which `replay` takes.

    Raises BadInput where there is no such method or variant, or the model lacks what it needs.

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
    """Make the estimator of any model by a method: what an entry point and `-e ekf` mean."""
    if method not in METHODS:
        raise AttributeError(method)
    return of_any_model(METHODS[method])
