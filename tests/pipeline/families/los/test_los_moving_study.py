"""Moving lines of sight: what is estimated, which errors count, and which verdicts intervals give."""

import numpy as np
import pandas as pd
import pytest

from fuselog.pipeline.families.los.moving import _measure, prior_sigmas, seconds_of, unknowns, weakest
from fuselog.pipeline.output.claims import decide
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.runs.experiment import load_experiment
from fuselog.recorders.families.los.moving import MovingOpticalParameters
from fuselog.replay.judging.errors.evaluation import Errors

COMPONENTS = (
    "target_1_x_m",
    "target_1_vx_mps",
    "sensor_1_yaw_bias_rad",
    "sensor_1_roll_bias_rad",
    "sensor_2_roll_bias_rad",
    "sensor_2_clock_s",
)


def errors_of(error: list[float], *, is_bound: bool = False) -> Errors:
    """One run's errors at 1.2 and 1.7 s; a bound's covariances have their products."""
    column = np.array([error, error])
    none = np.zeros(2, np.int64)
    return Errors(
        "ekf",
        "",
        COMPONENTS,
        ("linear",) * 6,
        none,
        np.arange(2),
        none,
        np.array([1.2, 1.7]),
        np.zeros_like(column) if is_bound else column,
        np.einsum("ni,nj->nij", column, column),
        np.full(2, 3.0),
        0,
        (),
        is_bound,
    )


@pytest.mark.parametrize("is_bound", [False, True])
def test_errors_count_by_second_and_the_roll_in_common_is_of_all_sensors(is_bound):
    """Rolls that err to opposite sides have nothing in common; a bound tells the same of covariances."""
    [row] = seconds_of(errors_of([3.0, 9.0, 0.1, 0.2, -0.2, 0.5], is_bound=is_bound)).to_dict("records")
    assert row["second"] == 1
    assert row["sensor_1_yaw_bias_rad"] == pytest.approx(0.01)
    assert row["target_m2"] == pytest.approx(9.0)
    assert row["bias_rad2"] == pytest.approx((0.01 + 0.04 + 0.04) / 3)
    assert row["clock_s2"] == pytest.approx(0.25)
    assert row["common_roll_rad2"] == pytest.approx(0.0, abs=1e-12)
    assert row["nees_per_component"] == pytest.approx(0.5)
    [row] = seconds_of(errors_of([3.0, 9.0, 0.1, 0.2, 0.4, 0.5], is_bound=is_bound)).to_dict("records")
    assert row["common_roll_rad2"] == pytest.approx(0.09)


def test_biases_of_all_sensors_are_unknown_and_every_clock_but_the_first():
    two = MovingOpticalParameters(sensor_position_m=[(0, 0, 0), (9, 0, 0)], weave_m=[0.0, 0.0])
    found = unknowns(two)
    assert len(found["estimate"]) == 7
    assert "sensor_1_clock_s" not in found["estimate"]
    assert found["estimate_sigma"]["sensor_2_clock_s"] == two.clock_sigma_s
    assert set(found["estimate_drift"].values()) == {two.bias_drift}
    assert "sensor_2_clock_s" not in found["estimate_drift"]


def verdicts(case: str, least: float, left: float) -> list[str]:
    """The first two claims of 5 runs with such a least eigenvalue and share of the prior left."""
    told = pd.DataFrame({"least_eigenvalue": [least * (1 + run / 9) for run in range(5)]})
    sigma = {f"sensor_{number}_roll_bias_rad": 5e-3 for number in (1, 2, 3)}
    told = told.assign(**sigma)
    square = left * 25e-6 / 3
    rows = [("smoother", run, 60, square * (1 + run / 9), 1.0) for run in range(5)]
    columns = ["estimator", "run", "second", "common_roll_rad2", "nees_per_component"]
    table = pd.DataFrame(rows, columns=columns)
    unjudged = ("target_m2", "bias_rad2", "clock_s2")
    outcome = Outcome()
    _measure(case, table.assign(**dict.fromkeys(unjudged, np.nan)), told, sigma, outcome)
    _, experiment = load_experiment("los-moving", {}, {})
    claims = decide(experiment.claims, outcome.metrics, outcome.intervals, {})
    beginnings = (f"{case}: in the weakest direction", f"{case}: after smoothing")
    return [claim.verdict for claim in claims if claim.claim.startswith(beginnings)]


def test_what_is_expected_depends_on_the_case():
    """Straight on side by side nothing is to be told of the common roll, in all others it is."""
    assert verdicts("straight", 1e-3, 0.9) == ["confirmed", "confirmed"]
    assert verdicts("straight", 1e3, 0.01) == ["refuted", "refuted"]
    assert verdicts("manoeuvre", 1e3, 0.01) == ["confirmed", "confirmed"]
    assert verdicts("manoeuvre", 1e-3, 0.9) == ["refuted", "refuted"]


def test_a_direction_is_told_in_units_of_what_is_known_beforehand():
    """A metre is little of 500, 5 mrad are all that a bias was thought to be."""
    sigmas = prior_sigmas(MovingOpticalParameters())
    assert len(sigmas) == 23
    direction = {"target_1_x_m": -250.0, "target_2_vy_mps": 1.0, "sensor_3_roll_bias_rad": 5e-3}
    assert weakest(direction, sigmas) == "+1.0 sensor_3_roll_bias_rad -0.5 target_1_x_m"
