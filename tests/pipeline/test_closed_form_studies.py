"""What studies compute of made data, whose answer is known: slopes, means, spreads, the worst of n."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import norm, t

from fuselog.pipeline.families.biometrics.sequential import Drawn, Options, probes_of
from fuselog.pipeline.families.los.moving import _measure
from fuselog.pipeline.families.networks.study import network_table, traces_of_equation_17
from fuselog.pipeline.families.vehicles import scaling
from fuselog.pipeline.families.vehicles.cases import score_set
from fuselog.pipeline.families.vehicles.scaling import growth_of
from fuselog.pipeline.output.expressions import Values, evaluate, formatted
from fuselog.pipeline.output.numbers import exactly
from fuselog.pipeline.output.results import Outcome
from fuselog.pipeline.studies.navigation import imu_grades
from fuselog.pipeline.studies.toolkit.repetitions import (
    by_repetition,
    rms_length,
    rmse_of_runs,
    root_mean_square,
    worst_deviation,
)
from fuselog.recorders.log import RunMetadata
from fuselog.replay.engine.streams.sources import MemorySource
from fuselog.replay.judging.intervals import mean_interval, rms_interval
from tests.goldens import keeping

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
    unmeasured = pd.DataFrame({"vehicles": vehicles, "step_ms": 0.5 * vehicles**3 * [1, 1, 0, 1, 1]})
    assert growth_of(unmeasured).power == pytest.approx(3.0)


def test_means_and_their_intervals() -> None:
    few = [1.0, 2.0, 3.0, 6.0]
    half = t.ppf(0.975, 3) * np.sqrt(14.0 / 3.0) / 2.0
    assert mean_interval(few, fewest=4)[:3] == pytest.approx((3.0, 3.0 - half, 3.0 + half))
    assert str(mean_interval(few)) == str(rms_interval([3.0] * 4)) == "3"
    assert not mean_interval(few).is_known
    found = mean_interval([*few, 3.0])
    assert found.is_bounded
    assert str(found._replace(unit="m")) == f"3 m (95 % {found.low:.3g} to {found.high:.3g})"
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


def test_traces_of_two_independent_errors() -> None:
    """At the weight of least trace, by search; the print leaves out the factors P on both sides."""
    first, second = np.diag([1.0, 0.25]), np.linalg.inv([[3.0, 1.0], [1.0, 1.0]])  # of information

    def fused(weight: float) -> np.ndarray:
        return np.linalg.inv(weight * first + (1.0 - weight) * second)

    weight = minimize_scalar(lambda of: np.trace(fused(of)), bounds=(0, 1), method="bounded").x
    inner = weight**2 * first + (1.0 - weight) ** 2 * second
    spread = fused(weight) @ inner @ fused(weight)
    wanted = {"printed": np.trace(np.linalg.inv(inner)), "fused": np.trace(spread)}
    wanted = {f"equation-17.{name}_trace": value for name, value in wanted.items()}
    assert traces_of_equation_17() == pytest.approx(wanted, rel=1e-3)


def test_networks_are_beside_one_filter_with_all_sensors() -> None:
    """Nodes that err by 5 and 10 m, where the one filter errs by 2.5 m; the velocity does not count."""

    def node(estimator: str, length_m: float, nees: float) -> Any:
        error = length_m * np.array([[0.6, 0.8, 9.0], [-0.8, 0.6, 9.0]])
        values = {"error": error, "position": [0, 1], "nees": np.array([nees, nees + 1.0])}
        return SimpleNamespace(estimator=estimator, **values)

    errors = [node("ci", 5.0, 1.0), node("ci", 10.0, 3.0), node("centralised", 2.5, 2.0)]
    table = network_table(errors).set_index("estimator")
    assert table.loc["ci"].tolist() == pytest.approx([5.0, 3.0, 2.5])
    assert table.loc["centralised"].tolist() == pytest.approx([2.5, 1.0, 2.5])


def test_a_vehicle_has_its_share_of_the_total_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four vehicles that are all 3 m off make 6 m together; two runs of five steps took 20 ms."""
    topics = [*(f"/vehicle{number}/prior" for number in (1, 2, 3, 4)), "/map/truth"]
    source: Any = SimpleNamespace(streams={**dict.fromkeys(topics), "/network/scan": range(5)})
    scores = SimpleNamespace(assigned=np.array([6.0, np.nan]), failed=1)
    times = iter([1.0, 1.02])
    for name, made in (
        ("time", SimpleNamespace(process_time=lambda: next(times))),
        ("replay_in_memory", lambda *_: {}),
        ("judge", lambda *_: SimpleNamespace(others=[])),
        ("scores_of", lambda *_: {"kf": scores}),
    ):
        monkeypatch.setattr(scaling, name, made)
    assert scaling._timed([source, source], "kf", {"kf": {}}) == (pytest.approx(2.0), 3.0, 1)


def test_of_a_set_each_vehicle_takes_an_element_of_its_own_where_there_are_enough() -> None:
    """Three vehicles: one element, which is of all; two, of which one is of two; none; four."""
    vehicles = np.array([[0.0, 1.0], [0.0, 2.0], [4.0, 0.0]])
    elements = [[0, 0], [0, 0], [4, 0], [0, 0], [0, 3], [4, 1], [0, 1]]
    mean = np.insert(np.array(elements, float), 1, 9.0, axis=1)  # x, vx, y
    outputs: Any = {
        "/estimates/phd/vehicles/set": SimpleNamespace(
            of_run=lambda _: {"elements": np.array([1, 2, 0, 4], np.uint32)}
        ),
        "/estimates/phd/vehicles/element": SimpleNamespace(of_run=lambda _: {"mean": mean}),
    }
    found: Any = SimpleNamespace(estimator="phd", case="vehicles", gospa=np.zeros(4))
    scores = score_set(outputs, found, np.broadcast_to(vehicles, (1, 4, 3, 2)))
    assert scores.assigned_by_step.tolist() == [pytest.approx([21.0, 5.0, np.nan, 2.0], nan_ok=True)]


def test_an_impostor_keeps_the_identity_that_is_claimed() -> None:
    """Each probe is of some other user: ratios say whose row and column they are."""
    users = np.arange(50)
    drawn, options = Drawn(100.0 * users[:, None] + users, users), Options(sequences=20)
    person, impostor = probes_of("one-identity", drawn, options, np.random.default_rng(0))
    going = np.arange(20)
    probe, claimed = np.divmod([impostor(going) for _ in range(5)], 100)
    assert (claimed == claimed[0]).all()
    assert (probe != claimed).all()
    assert len(np.unique(probe[:, 0])) > 1
    probe, claimed = np.divmod(person(going), 100)
    assert (probe == claimed).all()


def test_least_eigenvalues_are_averaged_in_the_logarithm() -> None:
    outcome, none = Outcome(), pd.DataFrame({"estimator": [], "second": []})
    _measure("fast", none, pd.DataFrame({"least_eigenvalue": [1e-2, 1e-4]}), {}, outcome)
    assert outcome.metrics["observability.least_eigenvalue.fast"] == pytest.approx(1e-3)
    assert outcome.metrics["observability.log10_least_eigenvalue.fast"] == pytest.approx(-3.0)


def test_grades_are_told_by_the_largest_error_of_their_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the outage from 50 s on, each grade by itself: at 10 and 20 s, after 20.5 s no more."""

    def drives(scale: float) -> Any:
        after_s = np.tile([9.0, 10.0, 20.0, 20.5], 2)
        place = scale * np.stack([after_s, np.zeros(8), np.repeat([0.0, 1.0], 4)], axis=1)
        columns = {"elapsed_s": 50.0 + after_s, "run": np.repeat([0, 1], 4), "error": place}
        return SimpleNamespace(estimator="ekf", components=("x_m", "z_m", "y_m"), **columns)

    outages = {"gnss": {"outages_s": [[50.0, 70.4]]}}
    source = MemorySource({}, RunMetadata("navigation", epoch_ns=0, parameters=outages), "drive")

    def cases(grades: dict[str, Any]) -> Any:
        for scale, grade in enumerate(grades, 1):
            yield grade, SimpleNamespace(sources=[source], errors=[drives(scale)])

    monkeypatch.setattr(imu_grades, "Runner", lambda *_: SimpleNamespace(cases=cases))
    setting: Any = SimpleNamespace(options=SimpleNamespace(grades={"phone": "a", "tactical": "b"}))
    experiment: Any = None
    outcome = imu_grades.study(experiment, setting)
    keeping.hold_outcome("imu-grades", {}, outcome)
    metrics = outcome.metrics
    lengths_m = {"10s": np.hypot(10.0, 1.0), "20s": np.hypot(20.0, 1.0)}
    assert metrics == pytest.approx(
        {
            f"ekf.horizontal_95_m.{grade}-{after}": scale * length_m
            for scale, grade in ((1, "phone"), (2, "tactical"))
            for after, length_m in lengths_m.items()
        }
    )


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
