"""All methods, and as estimators of any model: what `-e ekf` means."""

from collections.abc import Mapping

from replay.inference.estimators import of_any_model
from replay.inference.iterated import SMOOTHING
from replay.inference.methods import FILTERS, Method

METHODS: Mapping[str, Method] = {**FILTERS, "smoother": SMOOTHING}

EKF = of_any_model(METHODS["ekf"])
IEKF = of_any_model(METHODS["iekf"])
UKF = of_any_model(METHODS["ukf"])
LRKF = of_any_model(METHODS["lrkf"])
ANALYTIC = of_any_model(METHODS["analytic"])
SMOOTHER = of_any_model(METHODS["smoother"])
