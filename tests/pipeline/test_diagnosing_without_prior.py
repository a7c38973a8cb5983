"""Diagnosing and tuning on a log without a prior: the sheet of sensors, section 3, principle 1."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

import fuselog as fl
from fuselog.pipeline.diagnosing import causes as seeking
from fuselog.pipeline.diagnosing.advice import Trying
from fuselog.pipeline.diagnosing.battery.car import car
from fuselog.pipeline.diagnosing.causes import Cause, find_causes
from fuselog.pipeline.diagnosing.hypotheses.hypothesis import PARTS, Hypothesis
from fuselog.pipeline.diagnosing.hypotheses.listing import hypotheses
from fuselog.pipeline.diagnosing.joint import Supposed, fit
from fuselog.pipeline.diagnosing.likelihood import (
    EVER_NS,
    Likelihood,
    _broad,
    _span,
    first_of_each,
)
from fuselog.pipeline.optimise import DROP_95
from fuselog.pipeline.runs.trials import Trial
from fuselog.pipeline.tuning.broad_starts import broad_starts
from fuselog.replay.engine.replaying.estimator import bind
from tests.replay.inference.scalar import SCALAR, VALUE, simulate, source

OPEN = {"kind": "ekf", "gate_probability": 1.0}


def likelihood(source: fl.MemorySource, stated: float = 1.0) -> float:
    """Of the car as it is, over the starts of a log whose fixes state so many times the variance."""
    told = Likelihood()
    told.begin(
        Trial("ekf", [car(2000, stated)], OPEN) if stated != 1.0 else Trial("ekf", [source], OPEN)
    )
    [found] = told([Trial("ekf", [source], OPEN)])
    return found


def test_the_likelihood_over_broad_starts_is_that_of_the_sheet() -> None:
    """All 201 fixes count; where the log is begun does not."""
    assert likelihood(car(1)) == pytest.approx(-372.645841, abs=1e-3)
    right = likelihood(car(2000))
    assert likelihood(car(2000), 16.0) == pytest.approx(right, abs=1e-6)


def test_broad_starts_are_at_the_first_fix_that_can_be_used() -> None:
    """However many before it lack their covariance."""
    log, count = car(2000), 20
    fixes = log.streams["/car/fix"]
    covariance = fixes["covariance_m2"].copy()
    covariance[:count] = np.nan
    lacking = replace(fixes, columns={**fixes.columns, "covariance_m2": covariance})
    found = [
        broad_starts(each, bind("ekf", [each], OPEN))["ekf/car"][0].static["/car/prior"]["mean"]
        for each in (
            replace(log, streams={**log.streams, "/car/fix": stream})
            for stream in (fixes.take(slice(count, None)), lacking)
        )
    ]
    assert found[0].tolist() == found[1].tolist()
    assert found[0][0, :2] == pytest.approx(fixes["position_m"][count])


def test_a_broad_model_knows_how_far_messages_are_from_the_last() -> None:
    """By root mean squares of 2, over known steps alone, and of .3 over the ends of a circle."""
    lines = [0.0, 1.0, np.nan, 4.0, 4.0 + np.sqrt(7.0), 4.0 + np.sqrt(7.0) - 2.0]
    angles = [np.pi - 0.15, 0.15 - np.pi, np.pi - 0.15, np.nan, 0.0, -0.3]
    numbers = np.stack([lines, angles, np.ones(6)], axis=1)
    wanted = sum(-0.5 * (np.log(2.0 * np.pi * sigma**2) + 1.0) for sigma in (2.0, 0.3))
    assert _broad(numbers, ["linear", "angle", "linear"]) == pytest.approx(wanted)


@pytest.mark.parametrize(("stated", "factor", "size"), [(4.0, 1.99, "large"), (1 / 16, 4.02, "small")])
@pytest.mark.paper
@pytest.mark.usefixtures("first_cause_alone")
def test_a_covariance_stated_wrongly_is_named_with_its_factor(
    stated: float, factor: float, size: str
) -> None:
    """The factor is told to .036, the sheet's standard deviation of its logarithm."""
    found = fl.diagnose(car(2000, stated), "ekf").sentences[0]
    assert (found.kind, found.where) == ("measurement noise", "/car/fix")
    assert found.setting.startswith("/car/fix.covariance_scale=")
    assert f"so that R is too {size}" in found.sentence
    assert found.cause is not None
    low, high = np.exp(np.abs(found.cause.ends))
    assert min(low, high) < factor < max(low, high)


def test_tuning_agrees_that_the_process_noise_is_right() -> None:
    found = fl.tune(car(2000, 4.0), "ekf", "turn_noise_density").parameters.iloc[0]
    assert found["low"] < 0.01 < found["high"]


class Kept(fl.ModelParameters):
    """What is kept in a step; the noises are numbers in the model, which no fault is of."""

    kept: float = 0.9


def test_what_is_inconsistent_and_has_no_name_is_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    """Innovations of half their size are no consistent filter's; but for the value's factor that is."""
    known = seeking.hypotheses
    monkeypatch.setattr(
        seeking,
        "hypotheses",
        lambda *about: [each for each in known(*about) if each.kind != "factor or sign"],
    )
    measured = replace(VALUE, noise=lambda _: (0.49,))
    motion = replace(SCALAR.motion, noise=lambda *_: (0.25,))
    model = replace(SCALAR, parameters=Kept, sensors=(measured,), motion=motion)
    values = np.concatenate([simulate(seed) for seed in range(4)])
    [found] = fl.diagnose(source(0.5 * values), {"level": fl.modelled(model, "ekf")}).sentences
    assert found.kind == "unnamed"
    assert found.sentence.startswith(
        "the estimate: something is wrong, but the cause is unknown: NIS per component"
    )
    assert "(in 999 of 1,000 logs); none of" in found.sentence
    well = fl.diagnose(source(values), {"level": fl.modelled(model, "ekf")})
    assert well.sentences == []


class Parabolas(NamedTuple):
    """Gains that are greatest at 5, of each part of a log so far above or below it.

    And at -8, by so much less.
    """

    apart: float
    less: float = np.inf
    count: Mapping[str, int] = {}

    def __call__(self, trials: Sequence[float]) -> list[float]:
        """The gains over all parts."""
        return [float(each) for [each] in self.over_parts(trials, 1)]

    def disturbed(self, _: float) -> list[Any]:
        """No control has noise."""
        return []

    def over_parts(self, trials: Sequence[float], count: int) -> np.ndarray:
        """The gains over so many parts."""
        best = 5.0 + self.apart * np.resize([1.0, -1.0], PARTS)
        at = np.reshape(trials, (-1, 1))
        gains = np.maximum(-0.5 * (at - best) ** 2, -0.5 * (at + 8.0) ** 2 - self.less / PARTS)
        return gains.reshape(len(trials), count, PARTS // count).sum(axis=2)


def sought(limit: float, apart: float) -> tuple[list[float], list[float]]:
    """The numbers that are named, and those that are in doubt."""
    tried = Hypothesis("delay", "/fix", "", (-0.1, 0.1), limit, lambda _, at: at, *[str, str])  # type: ignore[arg-type,return-value]
    found, _, in_doubt = find_causes(Parabolas(apart), 0.0, [tried], 1)  # type: ignore[arg-type]
    return [each.value for each in found], [each.value for each in in_doubt]


def test_a_number_at_the_end_of_its_search_is_no_cause() -> None:
    """A parabola about 5 that is searched up to 1, and up to 10."""
    assert sought(1.0, 0.0) == ([], [])
    assert sought(10.0, 0.0) == (pytest.approx([5.0], abs=0.02), [])


@pytest.mark.parametrize(("apart", "is_named"), [(1.0, True), (7.0, True), (9.5, False)])
def test_what_the_parts_of_a_log_disagree_about_is_in_doubt(apart: float, *, is_named: bool) -> None:
    """Each part knows its best number to 1: a gain of 250 counts 1 / (20 / 19 apart^2) of that.

    Of one fault it has to be 3.3.
    """
    named, in_doubt = sought(10.0, apart)
    assert [*named, *in_doubt] == pytest.approx([5.0], abs=0.02)
    assert bool(named) == is_named


@pytest.mark.parametrize(
    ("less", "values"),
    [(5.0, [5.0]), (2.0, [5.0, -8.0]), (-2.0, [-8.0, 5.0]), (-5.0, [-8.0])],
)
def test_what_another_number_explains_as_well_is_not_determined(
    less: float, values: list[float]
) -> None:
    """Chance explains a difference of 3.3."""
    likelihood: Any = Parabolas(0.0, less)
    tried = Hypothesis("delay", "/fix", "", (-0.1, 0.1), 10.0, lambda _, at: at, late, lambda _: None)  # type: ignore[arg-type,return-value]
    [[cause], *_] = find_causes(likelihood, 0.0, [tried], 1)  # type: ignore[arg-type]
    assert [each.value for each in (cause, *cause.others)] == pytest.approx(values, abs=0.02)
    other = f"; this log does not determine the value; equally likely: {values[-1]:.2f} late;"
    assert (other in cause.words) == (len(values) > 1)


class Paraboloid(NamedTuple):
    """Gains of several numbers, greatest at `best` and bent so much."""

    best: np.ndarray
    bend: np.ndarray
    count: Mapping[str, int] = {}
    greatest: float = 0.0

    def __call__(self, trials: Sequence[np.ndarray]) -> list[float]:
        """The gains over all parts."""
        return [float(each) for [each] in self.over_parts(trials, 1)]

    def disturbed(self, _: np.ndarray) -> list[Any]:
        """No control has noise."""
        return []

    def over_parts(self, trials: Sequence[np.ndarray], count: int) -> np.ndarray:
        """The gains over so many parts, which agree."""
        apart = np.array(trials) - self.best
        gains = self.greatest - 0.5 * np.einsum("ni,ij,nj->n", apart, self.bend, apart)
        return np.repeat(gains[:, None] / count, count, axis=1)

    @property
    def faults(self) -> list[Hypothesis]:
        """A fault for each number."""

        def of(place: int) -> Hypothesis:
            def without(trial: np.ndarray, value: float) -> np.ndarray:
                return trial + value * np.eye(len(self.best))[place]

            def words(at: float, low: float, high: float) -> str:
                return f"{place} is {at:.3f} ({low:.3f} to {high:.3f})"

            tried = (-0.1, 0.1, -1.0, 1.0)
            return Hypothesis(  # type: ignore[arg-type]
                "drifting bias", f"/{place}", "", tried, 50.0, without, words, lambda _: None
            )

        return [of(place) for place in range(len(self.best))]

    def causes(self) -> list[Cause]:
        """The causes that are named."""
        likelihood: Any = self
        return find_causes(likelihood, np.zeros(len(self.best)), self.faults, 5)[0]  # type: ignore[arg-type]


def test_causes_are_fitted_together_and_what_is_superfluous_goes() -> None:
    """The first number alone gains most, since it explains half of each other: with these it is zero."""
    bend = 400.0 * np.array([[1.0, 0.6, 0.6], [0.6, 1.0, 0.0], [0.6, 0.0, 1.0]])
    causes = Paraboloid(np.array([0.0, 5.0, 4.0]), bend).causes()
    assert [cause.hypothesis.topic for cause in causes] == ["/1", "/2"]
    assert [cause.value for cause in causes] == pytest.approx([5.0, 4.0], abs=1e-3)
    both = Paraboloid(np.array([3.0, 4.0]), 100.0 * np.array([[1.0, 0.8], [0.8, 1.0]])).causes()
    ends = sorted(end for cause in both for end in cause.ends)
    error = (1.0 / (100.0 * (1.0 - 0.8**2))) ** 0.5  # not 0.1, that of either number alone
    drop = (2.0 * DROP_95) ** 0.5
    assert ends == pytest.approx(
        [3.0 - drop * error, 3.0 + drop * error, *(4.0 + np.array([-drop, drop]) * error)], abs=1e-3
    )


@pytest.mark.parametrize("rounding", [-1e-8, 0.0, 1e-8])
def test_a_fit_that_does_not_converge_has_no_interval(rounding: float) -> None:
    """Only the sum of both numbers is told; the gains of their difference are lost in rounding."""
    bend = 100.0 * np.ones((2, 2)) + rounding * np.array([[1.0, -1.0], [-1.0, 1.0]])
    flat = Paraboloid(np.array([2.0, 1.0]), bend, greatest=-1e4)
    likelihood: Any = flat
    supposed = [Supposed(of, 1.0) for of in flat.faults]
    found = fit(likelihood, np.zeros(2), supposed, has_ends=True)  # type: ignore[arg-type]
    assert np.isnan(found.ends).all()
    cause = Cause(flat.faults[0], found.faults[0].value, found.ends[0], 10.0)
    assert re.match(r"0 is \d\.\d{3} \(no interval: the joint fit of all causes", cause.statement)


def test_a_part_of_a_log_has_the_same_measurements_in_any_order() -> None:
    """A delay of one sensor exchanges its messages with those of another."""
    rows = np.arange(12)
    values = np.where(np.stack([rows % 2 == 0, rows % 2 == 1], axis=1), rows[:, None], np.nan)
    for order in (rows, rows.reshape(-1, 2)[:, ::-1].ravel()):
        innovations = fl.make_stream(
            "/estimates/ekf/innovation",
            fl.schemas.INNOVATION,
            rows,
            metadata={"components": "x_m,v_mps", "kinds": "linear,linear"},
            target_id=np.zeros(12),
            accepted=np.ones(12),
            innovation=values[order],
            covariance=np.ones((12, 4)),
            normalised_innovation_squared=np.ones(12),
            log_likelihood=np.ones(12),
        )
        assert sorted(order[first_of_each(innovations, 0.5)]) == list(range(6))


def late(at: float, *_: float) -> str:
    """What is wrong."""
    return f"{at:.2f} late"


def test_a_gate_that_is_set_is_no_advice() -> None:
    """The gate is open while causes are sought, so that whoever gives advice knows what is set."""
    base = Trial("ekf", [car(2000)], {"kind": "ekf", **OPEN})
    tried = hypotheses(bind("ekf", [base.source], base.settings), base, {}, {})
    [outliers] = [each for each in tried if each.kind == "outliers"]
    remedy = outliers.remedy(1.0)
    assert remedy is not None
    assert remedy.setting == "gate_probability=0.999"
    is_set = {
        gate: Trying("ekf", {}, is_own=False, gate=gate).is_set(remedy) for gate in (1.0, 0.999, 0.9)
    }
    assert is_set == {1.0: False, 0.999: True, 0.9: True}


@pytest.mark.paper
def test_the_command_says_what_was_tried_and_compares_likelihoods_of_all(
    tmp_path: Path, fuselog: Callable[..., Any]
) -> None:
    """A gate that locks a filter out is one sentence; the likelihood is not of what it let in."""
    log = tmp_path / "car.mcap"
    fl.write(log, car(2000))
    found = fuselog("diagnose", log, "-e", "ekf", "--json").json
    assert found["found"] == [
        f"nothing found: none of the {found['hypotheses']} faults tried reaches the required gain in "
        f"log-likelihood, {found['least_gain']:.3g}"
    ]
    fl.write(log, car(2000, 1 / 256))
    wrong = fuselog("diagnose", log, "-e", "ekf", "--json").json
    assert sum(each["kind"] == "gate" for each in wrong["sentences"]) == 1
    assert "ekf.log_likelihood.car" not in wrong["metrics"]
    told = Likelihood()
    told.begin(base := Trial("ekf", [car(2000, 1 / 256)], OPEN))
    assert wrong["metrics"]["ekf.open_gate_log_likelihood"] == pytest.approx(told([base])[0])
    assert "16" in wrong["sentences"][0]["sentence"]


def test_measurements_are_scored_while_all_controls_last_and_from_the_prior_on() -> None:
    """Two controls from 1 to 9 s and from 2 to 8 s, of .5 and 1 s; a third has no messages."""

    def topic(begin_s: float, end_s: float, step_s: float) -> Any:
        stamps = np.arange(begin_s, end_s + 0.1 * step_s, step_s)
        stamps_ns = (1e9 * stamps).astype(np.int64)
        still = dict.fromkeys(("forward_mps", "turn_radps"), np.zeros(len(stamps)))
        return fl.make_stream("/driven", fl.schemas.ODOMETRY, stamps_ns, **still)

    streams = {"/a": topic(1, 9, 0.5), "/b": topic(2, 8, 1.0), "/none": topic(1, 0, 1.0)}
    bound: Any = SimpleNamespace(priors=["/prior", "/absent"])
    controls = ["/a", "/b", "/none"]
    assert _span(controls, bound, streams) == (2 * 10**9, 8 * 10**9, 10**9)
    later = {**streams, "/prior": topic(3, 3, 1.0)}
    assert _span(controls, bound, later) == (3 * 10**9, 8 * 10**9, 10**9)
    assert _span([], bound, streams) == (-EVER_NS, EVER_NS, 0)
