"""Registers all methods as estimators of any model: what `-e ekf` means."""

from replay.inference.all_methods import METHODS
from replay.inference.estimators import of_any_model

EKF = of_any_model(METHODS["ekf"])
IEKF = of_any_model(METHODS["iekf"])
UKF = of_any_model(METHODS["ukf"])
LRKF = of_any_model(METHODS["lrkf"])
SQRT = of_any_model(METHODS["sqrt"])
ANALYTIC = of_any_model(METHODS["analytic"])
SMOOTHER = of_any_model(METHODS["smoother"])
IMM = of_any_model(METHODS["imm"])
BANK = of_any_model(METHODS["bank"])
PARTICLES = of_any_model(METHODS["particles"])
BOUND = of_any_model(METHODS["bound"])
