"""Diagnosing and tuning on a log without a prior: the sheet of sensors, section 3, principle 1."""

import numpy as np
import pytest

import fuselog as fl
from pipeline.diagnosing.likelihood import Likelihood, Trial
from tests.pipeline.car import car

OPEN = {"kind": "ekf", "gate_probability": 1.0}


def likelihood(source: fl.MemorySource, stated: float = 1.0) -> float:
    """Of the car as it is, over the starts of a log whose fixes state so many times the variance."""
    told = Likelihood("ekf")
    told.begin(Trial(car(2000, stated), OPEN) if stated != 1.0 else Trial(source, OPEN))
    [found] = told([Trial(source, OPEN)])
    return found


def test_the_likelihood_over_broad_starts_is_that_of_the_sheet() -> None:
    """All 201 fixes count; where the log is begun does not."""
    assert likelihood(car(1)) == pytest.approx(-372.645841, abs=1e-3)
    right = likelihood(car(2000))
    assert likelihood(car(2000), 16.0) == pytest.approx(right, abs=1e-6)


@pytest.mark.parametrize(("stated", "factor", "size"), [(4.0, 1.99, "large"), (1 / 16, 4.02, "small")])
def test_a_covariance_stated_wrongly_is_named_with_its_factor(
    stated: float, factor: float, size: str
) -> None:
    """The factor is told to .036, the sheet's standard deviation of its logarithm."""
    found = fl.diagnose(car(2000, stated), "ekf").sentences[0]
    assert (found.kind, found.topic) == ("measurement noise", "/car/fix")
    assert found.words.endswith("where the log is written")
    assert f"so that R is too {size}" in found.words
    assert found.cause is not None
    low, high = np.exp(np.abs(found.cause.ends))
    assert min(low, high) < factor < max(low, high)


def test_tuning_agrees_that_the_process_noise_is_right() -> None:
    found = fl.tune(car(2000, 4.0), "ekf", "turn_noise_density").parameters.iloc[0]
    assert found["low"] < 0.01 < found["high"]


def test_nothing_is_found_where_nothing_is_wrong() -> None:
    assert fl.diagnose(car(2000), "ekf").sentences == []
