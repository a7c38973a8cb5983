"""What a page says first, of numbers that are given: whom to take, why, and what is doubtful."""

import re
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from fuselog.pipeline.output.claims import Claim
from fuselog.pipeline.output.report import _named, kinds, sheet, sweeps, title_of
from fuselog.pipeline.output.report.evidence import findings
from fuselog.pipeline.output.report.kinds import how_many_differ, opening
from fuselog.pipeline.output.report.sheet import sheets, table_of_pairs
from fuselog.pipeline.output.report.story import Story, gauge, story
from fuselog.pipeline.output.results import Measured, MetricTable, Result
from fuselog.pipeline.output.words import MINUS, is_error
from fuselog.recorders.checks.finding import Finding
from fuselog.replay.judging.errors.differences import dominating
from fuselog.replay.judging.intervals import Interval
from fuselog.replay.judging.verdicts import Squares


def _told(
    runs: dict[str, dict[str, list[float]]],
    bounds: dict[str, tuple[float, float]] | None = None,
    timings: dict[str, dict[str, float]] | None = None,
    alarms: Sequence[Finding] = (),
) -> Story:
    """The story of estimators whose quantities in every run are given."""
    rows = pd.concat(
        pd.DataFrame({"estimator": label, "case": "", "run": range(len(next(iter(of.values())))), **of})
        for label, of in runs.items()
    )
    metrics = {
        f"{label}.{key}": float(np.sqrt(np.mean(np.square(of))) if "rmse" in key else np.mean(of))
        for label, each in runs.items()
        for key, of in each.items()
    }
    result = Result(
        experiment="x",
        fuselog="1",
        settings={"runs": len(rows) // len(runs)},
        input_sha256="",
        metrics=metrics,
        claims=[],
        bounds=bounds or {},
    )
    return story(findings(result, {"runs": rows}), timings=timings, alarms=alarms)


NOISE = np.random.default_rng(3).normal(0.0, 0.1, (3, 20))
HONEST = (2.0, 4.2)  # of three components over twenty runs


def test_the_story_calls_a_draw_a_draw_and_names_who_is_too_sure_first() -> None:
    """What chance explains is no winner, whoever has the smaller number; the broken one comes first."""
    error = 1.0 + NOISE[0]
    told = _told(
        {
            "a": {"position_rmse_m": list(error), "nees": list(3.0 + NOISE[1])},
            "b": {"position_rmse_m": list(error + 1e-3 * NOISE[2]), "nees": list(3.0 + NOISE[2])},
            "c": {"position_rmse_m": list(2.0 * error), "nees": list(27.0 + NOISE[2])},
        },
        {f"{label}.nees": HONEST for label in "abc"},
    )
    first, second = told.verdict
    assert first.endswith("tie in position error: take either.")
    assert second == "c is overconfident: its errors are 3 times what it states."
    assert told.cards[2].estimator == "c"
    assert [card.look for card in told.cards] == ["best", "best", "broken"]
    assert told.cards[2].consistency == "Its errors are 3 times what it states"
    assert told.cards[2].numbers.startswith("NEES 27")
    assert told.cards[2].numbers.endswith("; 3 is ideal")
    assert told.doubts == ["the covariances of c, which are too small"]
    [difference] = told.differences
    assert re.match(
        r"The error of c is 0\.98\d m larger than that of [ab] on average over the runs \(95 % 0\.9\d+ "
        r"to 1\.0\d m\)\.",
        difference,
    )


def test_a_run_that_dominates_the_mean_nees_is_named() -> None:
    """Of five runs the third has 400, and the others 3 on average; only one filter has such a run."""
    errors = [1.0, 1.1, 1.2, 1.1, 1.0]
    bad = {"position_rmse_m": errors, "nees": [2.0, 4.0, 400.0, 2.5, 3.5]}
    told = _told({"bad": bad, "good": {"position_rmse_m": errors, "nees": [3.0] * 5}})
    notes = {card.estimator: " ".join(card.notes) for card in told.cards}
    assert "Mean NEES: run 2 dominates the mean with 400; the other runs average 3." in notes["bad"]
    assert "dominates" not in notes["good"]
    assert [dominating(np.array(each)) for each in ([1.0, 9.0], [9.0, 4.0, 5.0], [9.0, 4.0, 4.9])] == [
        None,
        None,
        0,
    ]


def test_the_table_begins_with_whom_to_take() -> None:
    """So that on a phone its column is seen first, whatever the order of the experiment."""
    runs = {"a": 3.0 + NOISE[0], "b": 2.0 + NOISE[1], "c": 1.0 + NOISE[2]}
    rows = pd.concat(
        pd.DataFrame({"estimator": label, "case": "", "run": range(20), "position_rmse_m": each})
        for label, each in runs.items()
    )
    metrics = {f"{label}.position_rmse_m": float(each.mean()) for label, each in runs.items()}
    result = Result(
        experiment="x", fuselog="1", settings={}, input_sha256="", metrics=metrics, claims=[]
    )
    sheet, _ = sheets(findings(result, {"runs": rows}))
    assert sheet is not None
    assert sheet.columns == ["c", "a", "b"]
    assert [cell.look for cell in sheet.groups["Accuracy"][0].cells] == ["best", "", ""]


def test_who_diverged_is_not_called_overconfident() -> None:
    """Errors of 10,000 standard deviations and more are no matter of covariances."""
    quantities = {"position_rmse_m": list(1.0 + NOISE[0]), "nees": list(3.0 + NOISE[1])}
    lost = {"position_rmse_m": [1e152] * 20, "nees": [1e305] * 20}
    told = _told({"a": quantities, "b": lost}, {f"{label}.nees": HONEST for label in "ab"})
    assert told.verdict[-1].startswith("b diverged: its errors are 1.8 ")
    assert told.cards[1].chip == "Diverged"
    assert told.doubts[0] == "the estimates of b, which diverged"
    assert not any("too small" in each for each in told.doubts)


def test_a_card_says_what_a_message_cost() -> None:
    """Beside the one to take; nothing of who was given no message."""
    told = _told(
        {label: {"position_rmse_m": list(size + NOISE[0])} for size, label in enumerate("abc", start=1)},
        timings={
            "a": {"seconds": 0.02, "messages": 5000},
            "b": {"seconds": 0.026, "messages": 5000},
            "c": {"seconds": 0.0, "messages": 0},
        },
    )
    feet = {card.estimator: card.foot for card in told.cards}
    beside = "5.2 µs per message; a run takes 1.3 times as long as with a"
    assert feet == {"a": ["4 µs per message"], "b": [beside], "c": []}


def test_who_is_conservative_in_every_run_is_not_consistent_however_few_there_are() -> None:
    """As the scatter over the runs says, where chance over the covariances would leave it open."""
    told = _told(
        {
            "a": {"position_rmse_m": list(1.0 + NOISE[0]), "nees": list(3.0 + NOISE[1])},
            "b": {"position_rmse_m": list(2.0 + NOISE[0]), "nees": list(2.5 + NOISE[2])},
            "c": {"position_rmse_m": list(3.0 + NOISE[0]), "nees": list(2.5 + 20.0 * NOISE[2])},
            "d": {"position_rmse_m": list(4.0 + NOISE[0]), "nis_per_component": list(0.6 + NOISE[1])},
        },
        {f"{label}.nees": HONEST for label in "abc"} | {"d.nis_per_component": (0.9, 1.1)},
    )
    words = {card.estimator: card.chip for card in told.cards}
    assert words["b"] == words["d"] == "Conservative"
    assert words["c"] == "Consistent, less accurate"
    assert told.doubts == ["the covariances of b and d, which are too large"]


def test_of_those_that_tie_nobody_is_told_to_take_who_is_too_careful() -> None:
    """Whose covariances are too large comes behind a consistent one; if all are, the advice says so."""
    error = 1.0 + NOISE[0]
    nees = {"a": 1.5 + NOISE[1], "b": 3.0 + NOISE[2]}
    runs = {
        label: {"position_rmse_m": list(error + 1e-3 * place * NOISE[2]), "nees": list(of)}
        for place, (label, of) in enumerate(nees.items())
    }
    told = _told(runs, {f"{label}.nees": HONEST for label in "ab"})
    assert told.verdict == ["b and a tie in position error: take b, because a is conservative."]
    assert [card.chip for card in told.cards] == ["As good as a", "As accurate as b, but conservative"]
    runs["b"]["nees"] = runs["a"]["nees"]
    told = _told(runs, {f"{label}.nees": HONEST for label in "ab"})
    advice = "take either, but reduce its covariance, which is too large."
    assert told.verdict[0].endswith(f" tie in position error: {advice}")


def test_a_comparison_says_of_whom_it_counts_the_metrics_that_differ() -> None:
    row = {"first": "a", "second": "b", "quantity": "nees", "verdict": "worse"}
    rows = [row, {**row, "verdict": "unclear"}, {**row, "second": "c", "verdict": "no difference"}]
    told = "a and b differ in 1 of 2 metrics and a and c in none of 1 metric"
    assert how_many_differ(pd.DataFrame(rows)) == told
    many = [{**row, "second": second} for second in "bcde"]
    assert how_many_differ(pd.DataFrame(many)) == "4 pairs differ in 4 of 4 metrics"


@pytest.mark.parametrize(
    ("seconds", "take"),
    [
        ((0.03, 0.04), "take either; a takes 0.75 times as long as b."),
        ((0.04, 0.03), "take either; b takes 0.75 times as long as a."),
        ((0.038, 0.04), "take either."),
        ((0.003, 0.004), "take either."),
    ],
    ids=["first", "second", "alike", "too short to measure"],
)
def test_a_tie_is_broken_by_the_time_where_that_was_measured_and_differs(
    seconds: tuple[float, float], take: str
) -> None:
    error = 1.0 + NOISE[0]
    told = _told(
        {
            "a": {"position_rmse_m": list(error)},
            "b": {"position_rmse_m": list(error + 1e-3 * NOISE[2])},
        },
        timings={
            label: {"seconds": each, "messages": 5000} for label, each in zip("ab", seconds, strict=True)
        },
    )
    assert told.verdict[0].endswith(take)


def test_one_run_is_not_counted() -> None:
    told = _told({"a": {"position_rmse_m": [1.0]}, "b": {"position_rmse_m": [0.5]}})
    assert told.cards[0].notes == []


def test_the_story_advises_what_is_best_beyond_chance_but_nobody_who_is_too_sure() -> None:
    error = 1.0 + NOISE[0]
    runs = {
        "a": {"position_rmse_m": list(error), "nees": list(3.0 + NOISE[1])},
        "b": {"position_rmse_m": list(0.5 * error), "nees": list(3.0 + NOISE[2])},
    }
    bounds = {f"{label}.nees": HONEST for label in "ab"}
    told = _told(runs, bounds)
    assert told.verdict == ["Take b: it has the smallest position error, 49.7 cm."]
    assert told.cards[0].notes == ["Smallest error in each of the 20 runs."]
    runs["b"]["nees"] = list(48.0 + NOISE[2])
    assert _told(runs, bounds).verdict == [
        "b has the smallest error, 49.7 cm, but fix its covariance before you rely on it; of the "
        "others, "
        "a has the smallest error, 99.4 cm.",
        "b is overconfident: its errors are 4 times what it states.",
    ]


def test_the_story_of_one_run_leaves_chance_open() -> None:
    """Neither a winner beyond chance nor an interval; and a few hundredths of NEES are no fault."""
    told = _told({"a": {"position_rmse_m": [1.0]}, "b": {"position_rmse_m": [0.5]}})
    assert told.verdict[0].endswith("on this run, 0.500 m; to rule out chance, use 5 or more runs.")
    assert not told.draws + told.differences
    many = {"a": {"position_rmse_m": [1.0] * 2000, "nees": [3.15] * 2000}}
    nearly = _told(many, {"a.nees": (2.894, 3.108)})
    assert nearly.verdict == ["a has a position error of 1 m RMS; its errors are as large as it states."]
    without = _told({"a": {"nis_per_component": [1.0]}}, {"a.nis_per_component": (0.9, 1.1)})
    assert without.verdict == ["a: its innovations are as large as it states."]


def test_the_opening_says_which_claims_hold() -> None:
    claims = [
        Claim("A is 1", "1", "1", "confirmed"),
        Claim("B is 2", "2", "3", "refuted"),
        Claim("C is 3", "3", "", "not reproducible"),
        Claim("D is 4", "4", "3 to 5", "inconclusive"),
    ]
    settings = {"estimators": {"a": {}, "b": {}}, "record": {"scenario": "s"}, "runs": 4, "seed": 7}
    result = Result(
        experiment="x", fuselog="1", settings=settings, input_sha256="", metrics={}, claims=claims
    )
    begun = opening(result, {})
    assert (
        begun.tried
        == "a and b over 4 simulated runs (scenario s), seed 7, each on the same measurements."
    )
    assert begun.story.verdict == [
        "1 of 4 claims confirmed; 1 refuted, 1 inconclusive and 1 not reproducible."
    ]


LONG = (
    "the filter that has all of the sensors is better than every other one that lacks one or two of them"
)
GOSPA = {"nearest": (4.0, 5.0, 6.0), "jpda": (3.0, 4.0, 7.0), "pmbm": (2.0, 3.0, 4.0)}


def _tracked() -> Result:
    """Trackers over three cases, and how much better than others they are, case by case."""
    metrics = {
        f"{label}.gospa_m.clutter-{case}": value
        for label, values in GOSPA.items()
        for case, value in enumerate(values)
    }
    metrics |= {f"pmbm.missed_targets.clutter-{case}": 0.5 + case for case in range(3)}
    metrics |= {f"pmbm.switches.clutter-{case}": 3.0 for case in range(3)}
    pairs = {f"pmbm.change_in_gospa_m.jpda-clutter-{case}": -1.0 for case in range(3)}
    pairs |= {f"jpda.change_in_gospa_m.nearest-clutter-{case}": -1.0 for case in range(3)}
    claims = [Claim(LONG, "", "", verdict) for verdict in ("refuted", "confirmed", "refuted", "refuted")]
    return Result(
        experiment="x",
        fuselog="1",
        settings={"estimators": {label: {} for label in GOSPA}, "runs": 5},
        input_sha256="",
        metrics={**metrics, **pairs},
        claims=claims,
        intervals=dict.fromkeys(pairs, (-1.5, -0.5)),
    )


def _rows(of: dict[str, tuple[float, ...]]) -> pd.DataFrame:
    """Five runs of each case, a little apart."""
    return pd.DataFrame(
        [
            {"estimator": label, "run": run, "case": case, "gospa_m": value + 0.01 * run}
            for label, values in of.items()
            for case, value in enumerate(values)
            for run in range(5)
        ]
    )


def test_trackers_with_claims_are_told_whom_to_take_over_cases_that_are_cases() -> None:
    """Differences of pairs are no cases; claims have a card, in whole sentences, behind the trackers."""
    result = _tracked()
    begun = opening(result, {"runs": _rows(GOSPA)})
    assert [table.case for table in begun.found.tables] == ["clutter-0", "clutter-1", "clutter-2"]
    first, claims = begun.story.verdict
    assert first == "Take pmbm: it has the smallest GOSPA, 3 m (mean of 3 cases)."
    assert claims == "1 of 4 claims confirmed; 3 refuted."
    assert [card.estimator for card in begun.story.cards] == ["pmbm", "jpda", "nearest", "Claims"]
    best, *_, last = begun.story.cards
    assert best.notes[:3] == [
        "Targets on average: 1.5 missed.",
        "Identity switches: 3 per run.",
        "Smallest error in 3 of 3 cases.",
    ]
    assert last.notes == [f"Refuted: {LONG}"] * 2 + ["1 more is refuted; the table has all claims."]
    assert begun.story.doubts == ["the covariances of all 3, which were not judged"]
    table = table_of_pairs(begun.found)
    assert list(table) == ["estimator", "has more than", "of", "clutter-0", "clutter-1", "clutter-2"]
    assert table.iloc[0].tolist()[:4] == [
        "pmbm",
        "jpda",
        "GOSPA",
        f"{MINUS}1 ({MINUS}1.50 to {MINUS}0.50) m",
    ]
    assert len(table) == 2


def test_who_is_best_on_average_alone_is_doubtful() -> None:
    """In one case of three another tracker has less; without runs nobody knows what is chance."""
    lower = {**GOSPA, "jpda": (1.0, 4.0, 7.0)}
    result = _tracked()
    metrics = result.metrics | {
        f"jpda.gospa_m.clutter-{at}": each for at, each in enumerate(lower["jpda"])
    }
    begun = opening(result.model_copy(update={"metrics": metrics}), {})
    assert begun.story.doubts == [
        "that pmbm is best everywhere, because in 1 of 3 cases another estimator has the smallest "
        "GOSPA (jpda in 1)",
        "whether differences are due to chance, because the result has no table of the GOSPA of "
        "individual runs",
        "the covariances of all 3, which were not judged",
    ]


def test_a_page_of_claims_alone_has_a_card() -> None:
    claims = [Claim(LONG, "", "", "confirmed"), Claim("B", "", "", "inconclusive")]
    result = Result(
        experiment="x",
        fuselog="1",
        settings={},
        input_sha256="",
        metrics={"a.share": 1.0},
        claims=claims,
    )
    [card] = opening(result, {}).story.cards
    told = "The experiment states 2 claims; this result confirms 1 and leaves 1 inconclusive."
    assert (card.look, card.chip, card.value, card.consistency) == ("claims", "", "", told)


def test_of_a_study_nobody_is_taken_for_an_error_that_others_have_not() -> None:
    """Nor is what a study measures beside its estimators one of them."""
    stated = {"estimators": {"a": {}, "b": {}}, "runs": 5}
    metrics = {"a.rule_error_m": 0.1, "b.ratio": 0.5, "published.rule_error_m": 0.05}
    result = Result(
        experiment="x",
        fuselog="1",
        settings=stated,
        input_sha256="",
        metrics=metrics,
        claims=[Claim("A", "", "", "confirmed")],
    )
    told = opening(result, {}).story
    assert told.verdict == ["The only claim is confirmed."]
    assert [card.estimator for card in told.cards] == ["Claims"]
    both = result.model_copy(update={"metrics": {**metrics, "b.rule_error_m": 0.3, "b.nees": 3.0}})
    told = opening(both, {}).story
    assert told.verdict[0].startswith("Take a: ")
    assert [card.estimator for card in told.cards] == ["a", "b", "Claims"]
    assert "the covariances of a, which were not judged" in told.doubts


def test_what_the_checks_of_a_replay_find_is_doubtful_in_words() -> None:
    """Each kind with its estimators, once; of few runs what they leave open."""
    rows = {label: {"position_rmse_m": [1.0 + size] * 2} for size, label in enumerate("ab")}
    alarms = [
        Finding("origin", "a", "robot1", 9.0, "..."),
        Finding("origin", "a", "robot2", 8.0, "..."),
        Finding("unused", "b", "", 2.0, "..."),
    ]
    assert _told(rows, alarms=alarms).doubts == [
        "the error of a, which is mostly constant: truth and estimate may have different origins",
        "b, because measurements were not used",
        "which one is better, because 2 runs do not distinguish differences from chance",
        "the covariances of both, which were not judged",
    ]


def test_failures_are_counted_over_all_cases() -> None:
    metrics = {f"a.{key}.{case}": 3.0 for key in ("position_rmse_m", "failed_runs") for case in "xy"}
    result = Result(
        experiment="x",
        fuselog="1",
        settings={"runs": 5},
        input_sha256="",
        metrics=metrics,
        claims=[],
    )
    told = opening(result, {}).story
    assert told.cards[0].foot == ["6 of 10 runs failed"]
    assert "a, which failed in 6 of 10 runs" in told.doubts


def test_headings_say_what_a_parameter_means() -> None:
    """Of a diagnosis and of a tuning; the name stays where it is needed to set it."""
    words = "sigma_range_m (standard deviation of a range) is 4 times too small, so that R is too small"
    notes = [f"1. {words}; try --set sigma_range_m=0.1"]
    diagnosed = Result(
        experiment="diagnose",
        fuselog="1",
        settings={"notes": notes},
        input_sha256="",
        metrics={},
        claims=[],
    )
    first, second = opening(diagnosed, {}).story.verdict
    assert first.startswith("The standard deviation of a range is 4 times too small")
    assert second == "Try --set sigma_range_m=0.1."
    settings = {"meanings": {"sigma_range_m": "standard deviation of a range"}}
    tuned = diagnosed.model_copy(update={"experiment": "tune", "settings": settings})
    row = {"parameter": "sigma_range_m", "start": 1.0, "value": 0.1, "low": 0.09, "high": 0.11}
    [sentence] = opening(tuned, {"parameters": pd.DataFrame([row])}).story.verdict
    assert sentence == (
        "The standard deviation of a range (sigma_range_m) is estimated at 0.100 m (95 % 0.0900 to "
        "0.110); "
        "the search started at 1."
    )


SIGMAS = (0.05, 0.1, 0.2, 0.4)


def _swept(
    of_ekf: Sequence[float], nees: Sequence[float] = (3.0,) * 4, key: str = "ekf.sigma_range_m"
) -> tuple[Result, dict[str, pd.DataFrame]]:
    """A sweep of the EKF, whose errors at each point are given; the UKF errs 1 m at all of them."""
    points = [{key: sigma} for sigma in SIGMAS]
    errors = {"ekf": of_ekf, "ukf": (1.0,) * 4}
    table, rows = [], []
    for point, each in enumerate(points):
        for label, of in errors.items():
            about = {"point": point, **each, "estimator": label, "case": "robot1"}
            runs = of[point] * (1.0 + 0.3 * NOISE[0])
            if label == "ekf":
                runs = runs + 1e-3 * NOISE[1 + point % 2]
            rms = float(np.sqrt(np.mean(runs**2)))
            table.append({**about, "quantity": "position_rmse_m", "value": rms})
            own = nees[point] if label == "ekf" else 3.0
            ends = {"aim": 3.0, "bound_low": 2.0, "bound_high": 4.2}
            table.append({**about, "quantity": "nees", "value": own, **ends})
            rows += [{**about, "run": run, "position_rmse_m": value} for run, value in enumerate(runs)]
    settings = {
        "estimators": {"ekf": {"sigma_range_m": 0.05}, "ukf": {}},
        "runs": 20,
        "record": {"scenario": "landmarks"},
        "sweep": points,
        "meanings": {key: "standard deviation of a range"} if key.startswith("ekf") else {},
    }
    result = Result(
        experiment="x", fuselog="1", settings=settings, input_sha256="", metrics={}, claims=[]
    )
    return result, {"sweep": pd.DataFrame(table), "sweep-runs": pd.DataFrame(rows)}


def test_a_sweep_says_whom_to_take_at_which_point_with_an_interval_over_runs() -> None:
    """The point in words; where else it is as good; who was not swept has a card too."""
    begun = opening(*_swept([0.9, 0.5, 0.5, 0.8]))
    assert begun.tried.startswith(
        "Standard deviation of a range (ekf.sigma_range_m) from 0.05 to 0.4 m: 4 points, 20 runs"
    )
    first, where, still = begun.story.verdict
    assert re.fullmatch(r"Take ekf: it has the smallest position error, [\d.]+ cm\.", first)
    assert re.fullmatch(
        r"ekf has its smallest error with standard deviation of a range = 0\.[12] m\.", where
    )
    assert still == "ukf does not depend on it."
    ekf, ukf = begun.story.cards
    assert (ekf.chip, ukf.chip) == ("Take this one", "Consistent, less accurate")
    found = re.fullmatch(r"position error, RMS; 95 % ([\d.]+) to ([\d.]+)", ekf.about)
    assert found
    low, high = map(float, found.groups())
    assert low < float(ekf.value) < high < low + 4.0
    assert re.fullmatch(r"0\.[12] m is as good, within chance or 2 %\.", ekf.notes[1])
    [doubt] = begun.story.doubts
    assert re.fullmatch(r"which point is best for ekf, because 0\.[12] m may be as good", doubt)


def test_a_sweep_takes_no_point_at_which_the_estimator_is_overconfident() -> None:
    """It errs least at the first point, and states a third of that error; the best left is the last."""
    begun = opening(*_swept([0.3, 0.9, 0.8, 0.5], nees=(27.0, 3.0, 3.0, 3.0)))
    assert (
        begun.story.verdict[1]
        == "ekf has its smallest error with standard deviation of a range = 0.4 m."
    )
    assert begun.story.doubts == [
        "ekf at 0.05 m, where it is overconfident",
        "whether the error of ekf is smaller beyond 0.4 m, where the range ends",
    ]


def test_a_sweep_of_estimators_that_are_all_too_sure_says_where_none_is_believed() -> None:
    """As they are set is what the sweep changes; and its title says that it is one."""
    result, tables = _swept([0.3, 0.9, 0.8, 0.5])
    table = tables["sweep"]
    table.loc[table["quantity"] == "nees", "value"] = 27.0
    verdict = opening(result, tables).story.verdict
    assert (
        verdict[0] == "Even at the point with its smallest error, none of the estimators can be trusted."
    )
    assert title_of(result, ["ekf", "ukf"], 20) == "x, parameter sweep"
    of_logs = result.model_copy(update={"settings": {**result.settings, "logs": {"files": []}}})
    assert title_of(of_logs, ["ekf", "ukf"], 20) == "x: ekf and ukf, parameter sweep"


def test_where_the_scenario_is_swept_no_point_is_advised() -> None:
    """Nobody chooses how many robots there are: the points are cases."""
    begun = opening(*_swept([0.5, 0.5, 0.5, 1.9], key="robots"))
    assert begun.story.verdict == [
        "Take ukf: it has the smallest position error, 0.997 m (RMS of 4 cases)."
    ]
    assert begun.story.cards[0].estimator == "ukf"
    assert begun.story.cards[0].notes[0] == "Smallest error in 1 of 4 cases."
    assert begun.story.doubts == [
        "that ukf is best everywhere, because in 3 of 4 cases another estimator has the smallest "
        "position error "
        "(ekf in 3)"
    ]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("Take ukf: it is best", ["ukf"]),
        ("particles:50 and particles", ["particles:50"]),
        ("ekf.sigma_range_m of ekf.", ["ekf"]),
        ("an ekf-like filter", []),
    ],
)
def test_estimators_are_coloured_where_they_are_named(text: str, names: list[str]) -> None:
    found = re.findall(r"<b class=\"e\d\">([^<]*)</b>", _named(text, ["ukf", "ekf", "particles:50"]))
    assert found == names


def test_a_standard_error_is_no_error() -> None:
    """What estimators are compared by are errors; how surely a number is known is none of them."""
    assert is_error("position_rmse_m")
    assert is_error("median_error_m")
    assert not is_error("standard_error")
    assert not is_error("standard_error_m")


@pytest.mark.parametrize(
    ("values", "words"),
    [([0.5, 0.1, 0.2], "0.1 to 0.5"), (["b", "a", "b", "a"], "b, a"), ([2, "all", 2], "2, all")],
)
def test_what_was_swept_is_a_span_of_numbers_or_each_word_once(values: list[Any], words: str) -> None:
    assert sweeps._ends(values) == words


def test_a_comparison_is_judged_case_by_case_by_the_means_of_both_sides() -> None:
    """NEES by chi square over so many runs; the mean over the cases is no case."""
    rows = [
        {"first": "a", "second": "b", "case": case, "quantity": quantity, "aim": aim, "runs": 10}
        | {"first_mean": mean, "second_mean": mean + 0.5}
        for case, mean in (("robot1", 1.0), ("robot2", 2.0), ("all", 9.0))
        for quantity, aim in (("position_rmse_m", "low"), ("nees", "3"), ("nis_per_component", "1"))
    ]
    result: Any = SimpleNamespace(stress=[])
    tables = {"differences": pd.DataFrame(rows)}
    with patch.object(kinds, "runs_of", lambda *_: 10):
        found = kinds._findings_of_comparison(result, tables, ["a", "b"])
    low, high = (float(chi2.ppf(share, 30)) / 10 for share in (0.025, 0.975))
    wanted = {"position_rmse_m": None, "nees": pytest.approx((low, high))}
    wanted["nis_per_component"] = (1.0 - kinds.MATERIAL, 1.0 + kinds.MATERIAL)
    assert [table.case for table in found.tables] == ["robot1", "robot2"]
    for table, mean in zip(found.tables, (1.0, 2.0), strict=True):
        assert table.quantities.keys() == wanted.keys()
        for name, bounds in wanted.items():
            sides = table.quantities[name]
            assert {label: each.value for label, each in sides.items()} == {"a": mean, "b": mean + 0.5}
            assert all(each.bounds == bounds for each in sides.values())


@pytest.mark.parametrize(
    ("values", "looks"),
    [
        ({"a": 1.0, "b": 3.0}, ["best", ""]),
        ({"a": 3.0, "b": 1.0}, ["", "best"]),
        ({"a": 1.0, "b": 1.019}, ["best", "best"]),  # within 2 %
        ({"a": 1.021, "b": 1.0}, ["", "best"]),
        ({"a": 1.0}, ["", ""]),
    ],
)
def test_who_is_best_is_marked_in_the_row(values: dict[str, float], looks: list[str]) -> None:
    table = MetricTable("", ["a", "b"], {"position_rmse_m": {k: Measured(v) for k, v in values.items()}})
    spreads = {"position_rmse_m": dict.fromkeys(values, (0.5, 4.0))}
    found: Any = SimpleNamespace(of={})
    [alone] = sheet._row(found, table, "position_rmse_m", ["a"], spreads).cells
    assert alone.look == ""  # nobody to be better than
    row = sheet._row(found, table, "position_rmse_m", ["a", "b"], spreads)
    assert [each.look for each in row.cells] == looks
    assert [each.text == sheet.MISSING for each in row.cells] == [label not in values for label in "ab"]
    assert [each.small for each in row.cells] == [
        "0.50 to 4.00" if label in values else "" for label in "ab"
    ]


@pytest.mark.parametrize(
    ("value", "place", "state", "factor"),
    [
        (2.0, 32.3, "consistent", 1.0),
        (6.0, 64.6, "overconfident", 3**0.5),
        (0.2, 0.0, "conservative", 0.1**0.5),
    ],
)
def test_a_gauge_goes_by_the_logarithm_and_a_state_by_chance(
    value: float, place: float, state: str, factor: float
) -> None:
    """The scale goes from a third of what is right to ten times it; the grey box holds 10 % at least."""
    by = Squares("NEES", Interval(value, 0.9 * value, 1.1 * value), 2.0, (1.9, 2.4))
    drawn = gauge(by)
    assert (drawn.aim, drawn.value) == pytest.approx((32.3, place), abs=0.01)
    assert drawn.usual == pytest.approx((29.2, 37.66), abs=0.01)
    if value == 6.0:
        assert drawn.spread == pytest.approx((61.5, 67.4), abs=0.01)
        assert drawn.words.startswith("NEES 6.00 (95 % 5.40 to 6.60); 2 is ideal")
    assert drawn.is_beyond == (value == 0.2)
    assert by.verdict == state
    assert by.factor == pytest.approx(factor)
