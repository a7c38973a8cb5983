"""What studies compute of made data, whose answer is known: slopes, means, spreads, the worst of n."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm, t

from pipeline.output.expressions import Values, evaluate, formatted
from pipeline.output.numbers import exactly
from pipeline.studies.toolkit.repetitions import (
    by_repetition,
    mean_interval,
    rms_length,
    rmse_of_runs,
    root_mean_square,
    share_holds,
    worst_deviation,
)
from pipeline.studies.vehicles.scaling import growth_of

# Two runs of two steps, one of which failed; errors of 5, 13 and 17 m.
MADE: Any = SimpleNamespace(
    step=np.array([0, 1, 0]),
    run=np.array([0, 0, 1]),
    error=np.array([[3.0, 4.0], [5.0, 12.0], [8.0, 15.0]]),
)


def test_growth_is_the_slope_of_the_greater_half() -> None:
    vehicles = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    constant = np.array([9.0, 9.0, 0.0, 0.0, 0.0])  # what small numbers hide
    power = growth_of(pd.DataFrame({"vehicles": vehicles, "step_ms": 0.5 * vehicles**3 + constant}))
    factor = growth_of(pd.DataFrame({"vehicles": vehicles, "step_ms": 0.5 * 1.5**vehicles + constant}))
    assert power.power == pytest.approx(3.0)
    assert factor.factor == pytest.approx(1.5)
    assert np.isnan(growth_of(pd.DataFrame({"vehicles": [2.0], "step_ms": [1.0]})).power)


def test_means_and_their_intervals() -> None:
    found = mean_interval([1.0, 2.0, 3.0, 6.0])
    half = t.ppf(0.975, 3) * np.sqrt(14.0 / 3.0) / 2.0
    assert found == pytest.approx((3.0, 3.0 - half, 3.0 + half))
    assert str(mean_interval([2.0])) == "+2.00, 95 % +nan to +nan"
    assert root_mean_square(np.array([[3.0, np.nan], [4.0, 5.0]]), 0) == pytest.approx([12.5**0.5, 5.0])


def test_errors_by_run_and_by_repetition() -> None:
    assert rms_length(MADE.error) == pytest.approx(np.sqrt((25 + 169 + 289) / 3))
    assert np.isnan(rms_length(np.empty((0, 2))))
    assert rmse_of_runs(MADE, 3) == pytest.approx([97.0**0.5, 17.0, np.nan], nan_ok=True)
    repeated = by_repetition(MADE, np.array([1.0, 2.0, 3.0]), 2)
    assert repeated == pytest.approx(np.array([[1.0, 3.0], [2.0, np.nan]]), nan_ok=True)


def test_the_worst_of_printed_numbers_in_standard_errors() -> None:
    """Squares of 1 and 3 have mean 2 and deviation 1; those of the other number 8 and 4."""
    squared = np.array([[1.0, 4.0], [3.0, 12.0]] * 8)
    error = np.sqrt(1 / 100 + 1 / 16)
    worst, allowed = worst_deviation(np.sqrt([2.0 + 3.0 * error, 8.0 - 5.0 * 4.0 * error]), squared, 100)
    assert worst == pytest.approx(5.0)
    assert allowed == pytest.approx(norm.ppf(1 - 0.025 / 2))


def test_a_share_holds_within_two_standard_errors() -> None:
    least = 0.95 - 2.0 * np.sqrt(0.95 * 0.05 / 100)
    assert share_holds(least + 1e-9, 100)
    assert not share_holds(least - 1e-9, 100)


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("median([4, 1, 3])", 3.0),
        ("median([4, 1, 3, 2])", 2.5),
        ("deviation([1, 2, 3, 6])", np.sqrt(14 / 3)),
        ("mean([1, 2, 6])", 3.0),
        ("max([1, 5, 2]) - min([1, 5, 2])", 4.0),
        ("sum([1, 2, 3]) / len([1, 2, 3])", 2.0),
        ("chi_square(0.95, 2)", -2.0 * np.log(0.05)),
        ("degrees(1)", 180.0 / np.pi),
        ("log(exp(2))", 2.0),
        ("sqrt(2) ** 2 * 3", 6.0),
    ],
)
def test_functions_of_claims(expression: str, value: float) -> None:
    assert evaluate(expression, Values({}, {}, {}))[0] == pytest.approx(value)  # type: ignore[index]


def test_ends_of_functions_of_intervals() -> None:
    """The worst of several is as sure as its ends; a spread is put on either side."""
    values = Values(
        {"a.x": 1.0, "b.x": 2.0}, {"a.x": (0.0, 4.0), "b.x": (1.5, 2.5)}, {"s": exactly(0.5)}
    )
    for expression, said in (
        ("max(x[a | b])", "2 (1.5 to 4)"),
        ("min(x[a | b])", "1 (0 to 2.5)"),
        ("mean(x[a | b])", "1.5 (0.75 to 3.25)"),
        ("-x[b]", "-2 (-2.5 to -1.5)"),
        ("abs(x[a] - 2)", "1 (0 to 2)"),
        ("plus_minus(x[a], s)", "1 (0.5 to 1.5)"),
        ("low(x[a]) + high(x[b]) + value(x[b])", "4.5"),
        ("x[b] / x[b]", "1 (0.6 to 1.67)"),
    ):
        assert formatted(f"{{{expression}}}", values) == said
