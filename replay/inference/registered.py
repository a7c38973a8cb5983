"""All methods, and as estimators of any model: what `-e ekf` means."""

from collections.abc import Mapping

from replay.inference.bound import POSTERIOR_BOUND
from replay.inference.estimators import of_any_model
from replay.inference.imm import INTERACTING
from replay.inference.iterated import SMOOTHING
from replay.inference.methods import FILTERS, Method
from replay.inference.particles import BOOTSTRAP

METHODS: Mapping[str, Method] = {
    **FILTERS,
    "smoother": SMOOTHING,
    "imm": INTERACTING,
    "particles": BOOTSTRAP,
    "bound": POSTERIOR_BOUND,
}

EKF = of_any_model(METHODS["ekf"])
IEKF = of_any_model(METHODS["iekf"])
UKF = of_any_model(METHODS["ukf"])
LRKF = of_any_model(METHODS["lrkf"])
ANALYTIC = of_any_model(METHODS["analytic"])
SMOOTHER = of_any_model(METHODS["smoother"])
IMM = of_any_model(METHODS["imm"])
PARTICLES = of_any_model(METHODS["particles"])
BOUND = of_any_model(METHODS["bound"])
