"""The methods as estimators of any model: what `-e ekf` means."""

from replay.inference.estimators import of_any_model

EKF = of_any_model("ekf")
IEKF = of_any_model("iekf")
UKF = of_any_model("ukf")
LRKF = of_any_model("lrkf")
ANALYTIC = of_any_model("analytic")
